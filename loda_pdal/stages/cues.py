"""Change cues (paper, section 4.3): occupied volumes, overlap, height, displacement and detection limit per object.

Everything is sampled on one lattice of occupied voxels for the whole block, once: each occupied voxel knows whose it is
in each epoch, whether the other epoch has a surface in reach, and whether the other epoch could have seen it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from loda_pdal.kernels.neighbours import nearest
from loda_pdal.model.cloud import BoolArray, Float32Array, FloatArray, Int64Array, IntArray
from loda_pdal.model.grid import Lattice, cells_of
from loda_pdal.model.groups import Groups, unique_inverse, unique_rows
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.pair import Pair
from loda_pdal.params import ChangeParams
from loda_pdal.stages.observability import Coverage


@dataclass(frozen=True)
class Surface:
    """Fused points of one epoch, as the cues need them.

    Attributes
    ----------
    xyz : (m, 3) float64, m
        In the analysis frame.
    normals : (m, 3) float32
        Unit normals, zero where unknown.
    height : (m,) float64, m
        Above the ground of its epoch.
    n_raw : (m,) int32
        Raw points in each.
    owner : (m,) int32
        Object of each point, -1 none.
    is_surface : (m,) bool
        Whether the point is evidence that something stands there: all but ground, fragments without object included.
    """

    xyz: FloatArray
    normals: Float32Array
    height: FloatArray
    n_raw: IntArray
    owner: IntArray
    is_surface: BoolArray

    def owned_by(self, owner: IntArray) -> Surface:
        """The same points with other owners (m,)."""
        return replace(self, owner=owner)


@dataclass(frozen=True)
class Cells:
    """Occupied voxels of all objects of both epochs, (c,) each.

    Attributes
    ----------
    cell : (c, 3) int64
        Lattice index, lexicographically sorted, unique.
    owner : Pair of (c,) int32
        Object whose points occupy the voxel in that epoch, -1 where none.
    n_raw : Pair of (c,) float64
        Raw points of that object in the voxel.
    is_near : Pair of (c,) bool
        Whether that epoch has a surface within the query radius of the centre.
    is_seen : Pair of (c,) bool
        Whether that epoch saw the voxel's column, and would have hit what the other epoch shows there.
    normal : (c, 3) float64
        Mean unit normal of both epochs' nearest surfaces, of either sign; zero where either surface is missing.
    displacement : (c,) float64, m
        Along ``normal``, after minus before (equation 5); NaN where either surface is missing.
    lod95 : (c,) float64, m
        Detection limit at the centre.
    """

    cell: Int64Array
    owner: Pair[IntArray]
    n_raw: Pair[FloatArray]
    is_near: Pair[BoolArray]
    is_seen: Pair[BoolArray]
    normal: FloatArray
    displacement: FloatArray
    lod95: FloatArray

    @property
    def is_gained(self) -> BoolArray:
        """Occupied after, empty before where the before survey saw: growth or something new."""
        return (self.owner.after >= 0) & ~self.is_near.before & self.is_seen.before

    @property
    def is_lost(self) -> BoolArray:
        """Occupied before, empty after where the after survey saw."""
        return (self.owner.before >= 0) & ~self.is_near.after & self.is_seen.after

    @property
    def is_common(self) -> BoolArray:
        """Both epochs have a surface here."""
        return self.is_near.before & self.is_near.after


@dataclass(frozen=True)
class Evidence:
    """The cues of every object, (n,) each; NaN where a cue cannot be had.

    Attributes
    ----------
    n_points, n_voxels : Pair
        Raw points and occupied voxels of each epoch.
    volume : Pair, m3
        Of the voxels that are compared; ``dv`` is their change and ``dv_ratio`` that change over the reference volume.
    height : Pair, m
        95th percentile of height above the ground of each epoch.
    support : Pair
        Share of an epoch's voxels that the other epoch shows too.
    gained, lost
        Voxels that only the after, or only the before epoch has, where the other could have seen them;
        ``gained_above`` and ``lost_above`` are those beyond the other epoch's top.
    column_rise : m
        Median change of the top over the columns that both epochs occupy; NaN with fewer than eight of them.
    iou, shift : 3D overlap of the occupancy, and distance of the centroids (m).
    dh : m
        Change of the height that the parameters name.
    d_perp, d_typical : m
        Median signed and median absolute displacement along the normal.
    lod95 : m
        Median limit of detection.
    observability
        Share of the voxels that both surveys saw or could have seen.
    rise : m
        How far the mean height of occupancy moves up inside the overlap.
    """

    n_points: Pair[FloatArray]
    n_voxels: Pair[FloatArray]
    volume: Pair[FloatArray]
    height: Pair[FloatArray]
    support: Pair[FloatArray]
    gained: FloatArray
    lost: FloatArray
    iou: FloatArray
    shift: FloatArray
    dh: FloatArray
    dv: FloatArray
    dv_ratio: FloatArray
    d_perp: FloatArray
    d_typical: FloatArray
    gained_above: FloatArray
    lost_above: FloatArray
    column_rise: FloatArray
    lod95: FloatArray
    observability: FloatArray
    rise: FloatArray


def sample_cells(surfaces: Pair[Surface], coverage: Pair[Coverage] | None, lod: LodGrid, params: ChangeParams) -> Cells:
    """Occupied voxels of all objects (paper, section 4.3: samples x with p_23(x), p_25(x) and their normals).

    Without ``coverage`` every voxel counts as seen by both surveys, as in the paper.
    """
    occupied = surfaces.map(lambda surface: _owned_cells(surface, params.voxel_m))
    rows = np.concatenate([occupied.before.cell, occupied.after.cell])
    if len(rows) == 0:
        nothing, never, no = np.zeros(0, np.int32), np.zeros(0, np.bool_), np.zeros(0)
        return Cells(
            rows, Pair(nothing, nothing), Pair(no, no), Pair(never, never), Pair(never, never), np.zeros((0, 3)), no, no
        )
    lattice = Lattice.around(rows)
    keys, first = np.unique(lattice.keys(rows), return_index=True)
    cell = rows[first]
    owner = occupied.map(lambda side: _spread(lattice, keys, side.cell, side.owner, -1))
    n_raw = occupied.map(lambda side: _spread(lattice, keys, side.cell, side.n_raw, 0.0))
    centre = (cell + 0.5) * params.voxel_m
    found = surfaces.map(lambda surface: _nearest_surface(surface, centre, params.query_radius_m))
    is_near = found.map(lambda idx: idx >= 0)
    always = np.ones(len(cell), np.bool_)
    is_seen = coverage.map(lambda side: side.at(centre)) if coverage else Pair(always, always)
    if params.min_expected_points > 0:
        expected = _expected_points(owner, n_raw)
        is_hit = expected.map(lambda points: points >= params.min_expected_points)
        is_seen = is_seen.join(is_hit, lambda seen, hit: seen & hit)
    normal, displacement = _displacement(surfaces, found)
    return Cells(cell, owner, n_raw, is_near, is_seen, normal, displacement, lod.at(centre))


def _expected_points(owner: Pair[IntArray], n_raw: Pair[FloatArray]) -> Pair[FloatArray]:
    """Raw points (c,) that each epoch should have in a voxel that the other occupies, were the object unchanged.

    From the other epoch's points there and the ratio of both epochs' points in the voxels of the object that both
    occupy; an object without such voxels is expected to be sampled alike by both.
    """
    n = int(max(owner.before.max(), owner.after.max())) + 1
    is_both = (owner.before >= 0) & (owner.before == owner.after)
    shared = n_raw.map(lambda points: np.bincount(owner.before[is_both], weights=points[is_both], minlength=n) + 1.0)
    ratio = np.append(shared.before / shared.after, 1.0)
    return Pair(
        np.where(owner.after >= 0, n_raw.after * ratio[owner.after], np.inf),
        np.where(owner.before >= 0, n_raw.before / ratio[owner.before], np.inf),
    )


def weigh(
    cells: Cells, surfaces: Pair[Surface], coverage: Pair[Coverage] | None, n: int, params: ChangeParams
) -> Evidence:
    """Cues of objects 0 to ``n - 1`` from their voxels and points (paper, section 4.3; METHOD 1.13)."""
    own = cells.owner
    is_known = Pair(  # own voxels about which the other epoch says something
        (own.before >= 0) & (cells.is_near.after | cells.is_seen.after),
        (own.after >= 0) & (cells.is_near.before | cells.is_seen.before),
    )
    n_voxels = own.map(lambda side: _count(side, side >= 0, n))
    n_known = own.join(is_known, lambda side, known: _count(side, known, n))
    n_shared = Pair(
        _count(own.before, cells.is_near.after, n),
        _count(own.after, cells.is_near.before, n),
    )
    gained, lost = _count(own.after, cells.is_gained, n), _count(own.before, cells.is_lost, n)
    voxel, owner = _either(cells)
    compared = n_known if params.visible_only else n_voxels
    volume = compared.map(lambda count: count * params.voxel_m**3)
    if params.visible_only:
        common = _count(owner, cells.is_common[voxel], n)
        iou = common / np.maximum(common + gained + lost, 1)
        dv = (gained - lost) * params.voxel_m**3
    else:
        common = _count(own.before, own.before == own.after, n)
        iou = common / np.maximum(n_voxels.before + n_voxels.after - common, 1)
        dv = volume.after - volume.before
    base = volume.before if params.volume_reference == "before" else (volume.before + volume.after) / 2

    samples = Groups(np.where(np.isfinite(cells.displacement[voxel]), owner, -1), n)
    is_sampled = samples.counts >= params.min_samples
    displacement = cells.displacement[voxel] * _facing(cells.normal[voxel], samples)
    points = surfaces.map(lambda surface: Groups(surface.owner, n))
    height = points.join(surfaces, lambda group, surface: group.quantile(surface.height, 0.95))
    columns = Pair(
        _column_tops(surfaces.before, coverage.after if coverage else None, params.voxel_m),
        _column_tops(surfaces.after, coverage.before if coverage else None, params.voxel_m),
    )
    summit = columns.map(lambda side: Groups(side.column[:, 0], n).quantile(side.top, 0.95))
    top = height if params.height_reference == "ground" else summit
    middle = np.asarray((cells.cell + 0.5) * params.voxel_m, dtype=np.float64)
    centroid = own.join(is_known, lambda side, known: Groups(np.where(known, side, -1), n).mean(middle))
    return Evidence(
        n_points=points.join(surfaces, lambda group, surface: group.sum(surface.n_raw)),
        n_voxels=n_voxels,
        volume=volume,
        height=height,
        support=n_shared.join(n_voxels, lambda shared, count: shared / np.maximum(count, 1)),
        gained=gained,
        lost=lost,
        iou=iou,
        shift=np.linalg.norm(centroid.after - centroid.before, axis=1),
        dh=top.after - top.before,
        dv=dv,
        dv_ratio=np.divide(dv, base, out=np.full(n, np.nan), where=base > 0),
        d_perp=np.where(is_sampled, samples.median(displacement), np.nan),
        d_typical=np.where(is_sampled, samples.median(np.abs(displacement)), np.nan),
        gained_above=_count(own.after, cells.is_gained & _is_above(middle[:, 2], own.after, summit.before), n),
        lost_above=_count(own.before, cells.is_lost & _is_above(middle[:, 2], own.before, summit.after), n),
        column_rise=_column_rise(columns, n),
        lod95=Groups(owner, n).median(cells.lod95[voxel]),
        observability=(n_known.before + n_known.after) / np.maximum(n_voxels.before + n_voxels.after, 1),
        rise=_rise(cells, middle[:, 2], n),
    )


def _count(owner: IntArray, is_counted: BoolArray, n: int) -> FloatArray:
    """Voxels per object (n,) among those counted; voxels without an owner do not count."""
    return np.bincount(owner[is_counted & (owner >= 0)], minlength=n).astype(np.float64)


def _either(cells: Cells) -> tuple[Int64Array, IntArray]:
    """Voxels with their owner in either epoch: a voxel that two objects hold, one per epoch, counts for both."""
    before = np.flatnonzero(cells.owner.before >= 0)
    after = np.flatnonzero((cells.owner.after >= 0) & (cells.owner.after != cells.owner.before))
    owner = np.concatenate([cells.owner.before[before], cells.owner.after[after]])
    return np.concatenate([before, after]), owner.astype(np.int32)


class _Occupied(NamedTuple):
    """Voxels (k, 3) that an epoch's objects occupy, their owners and the owners' raw points in them (k,)."""

    cell: Int64Array
    owner: IntArray
    n_raw: FloatArray


def _owned_cells(surface: Surface, voxel_m: float) -> _Occupied:
    """Voxels that an epoch's objects occupy; where several meet, the one with most points, then the lowest, has it."""
    is_member = surface.owner >= 0
    rows = np.column_stack([cells_of(surface.xyz[is_member], voxel_m), surface.owner[is_member]])
    points = np.asarray(np.bincount(unique_inverse(rows), weights=surface.n_raw[is_member]), dtype=np.float64)
    rows = unique_rows(rows)
    order = np.lexsort((rows[:, 3], -points, rows[:, 2], rows[:, 1], rows[:, 0]))
    rows, points = rows[order], points[order]
    is_first = np.ones(len(rows), np.bool_)
    is_first[1:] = np.any(rows[1:, :3] != rows[:-1, :3], axis=1)
    return _Occupied(rows[is_first, :3], rows[is_first, 3].astype(np.int32), points[is_first])


def holders(surface: Surface, voxel_m: float) -> IntArray:
    """The object that has the voxel of each point (m,), -1 for points without object."""
    occupied = _owned_cells(surface, voxel_m)
    holder = np.full(len(surface.xyz), -1, dtype=np.int32)
    is_member = surface.owner >= 0
    if is_member.any():
        lattice = Lattice.around(occupied.cell)
        found = lattice.find(lattice.keys(occupied.cell), cells_of(surface.xyz[is_member], voxel_m))
        holder[is_member] = occupied.owner[found]
    return holder


def _spread(
    lattice: Lattice, keys: Int64Array, cell: Int64Array, values: npt.NDArray[Any], unknown: float
) -> npt.NDArray[Any]:
    """Values of an epoch's voxels on the joint list of voxels."""
    spread = np.full(len(keys), unknown, dtype=values.dtype)
    spread[lattice.find(keys, cell)] = values
    return spread


def _nearest_surface(surface: Surface, centre: FloatArray, reach_m: float) -> IntArray:
    """Index of the surface point nearest to each centre, -1 where none lies within ``reach_m``."""
    members = np.flatnonzero(surface.is_surface)
    if len(members) == 0:
        return np.full(len(centre), -1, dtype=np.int32)
    found, _ = nearest(surface.xyz[members], centre, reach_m)
    return np.where(found >= 0, members[np.maximum(found, 0)], -1).astype(np.int32)


def _displacement(surfaces: Pair[Surface], found: Pair[IntArray]) -> tuple[FloatArray, FloatArray]:
    """Mean normal (c, 3) of the nearest surface points and their offset (c,) m along it (equation 5)."""
    normal, displacement = np.zeros((len(found.before), 3)), np.full(len(found.before), np.nan)
    is_both = (found.before >= 0) & (found.after >= 0)
    b, a = found.before[is_both], found.after[is_both]
    n_b, n_a = surfaces.before.normals[b].astype(np.float64), surfaces.after.normals[a].astype(np.float64)
    n_a = np.where(np.sum(n_b * n_a, axis=1, keepdims=True) < 0, -n_a, n_a)
    mean = n_b + n_a
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    mean = np.divide(mean, length, out=np.zeros_like(mean), where=length > 0.5)
    offset = np.sum(mean * (surfaces.after.xyz[a] - surfaces.before.xyz[b]), axis=1)
    normal[is_both] = mean
    displacement[is_both] = np.where(length[:, 0] > 0.5, offset, np.nan)
    return normal, displacement


def _facing(normal: FloatArray, samples: Groups) -> FloatArray:
    """Sign (k,) that turns each normal to the side its object mostly faces; a fitted normal has no sign of its own."""
    scatter = samples.sum(np.einsum("ij,ik->ijk", normal, normal).reshape(len(normal), 9)).reshape(samples.n, 3, 3)
    axis = np.linalg.eigh(scatter)[1][:, :, 2] if len(scatter) else np.zeros((0, 3))
    leading = np.take_along_axis(axis, np.argmax(np.abs(axis), axis=1)[:, None], axis=1)
    axis = np.where(leading < 0, -axis, axis)
    along = np.sum(normal * np.append(axis, np.zeros((1, 3)), axis=0)[samples.labels], axis=1)
    return np.where(along < 0, -1.0, 1.0)


class _Columns(NamedTuple):
    """Columns (k, 3) of an epoch's objects as rows (object, ix, iy), sorted, and their highest points (k,) m."""

    column: Int64Array
    top: FloatArray


def _column_tops(surface: Surface, other: Coverage | None, cell_m: float) -> _Columns:
    """Highest point in each column of each object, in the columns that the other epoch saw.

    A part that one survey never saw is no growth.
    """
    is_in = surface.owner >= 0
    if other is not None:
        is_in &= other.at(surface.xyz)
    column = np.column_stack([surface.owner[is_in], cells_of(surface.xyz[is_in, :2], cell_m)])
    z = surface.xyz[is_in, 2]
    order = np.lexsort((z, column[:, 2], column[:, 1], column[:, 0]))
    column, z = column[order], z[order]
    is_last = np.ones(len(z), np.bool_)
    is_last[:-1] = np.any(column[1:] != column[:-1], axis=1)
    return _Columns(column[is_last], z[is_last])


def _column_rise(columns: Pair[_Columns], n: int) -> FloatArray:
    """Median change of the columns' tops (n,) m over the columns that both epochs have."""
    if len(columns.before.column) == 0 or len(columns.after.column) == 0:
        return np.full(n, np.nan)
    lattice = Lattice.around(np.concatenate([side.column for side in columns]))
    found = lattice.find(lattice.keys(columns.before.column), columns.after.column)
    is_both = found >= 0
    groups = Groups(columns.after.column[is_both, 0], n)
    rise = groups.median(columns.after.top[is_both] - columns.before.top[found[is_both]])
    return np.where(groups.counts >= _LEAST_COLUMNS, rise, np.nan)


_LEAST_COLUMNS = 8


def _is_above(z: FloatArray, owner: IntArray, top: FloatArray) -> BoolArray:
    """Whether each voxel (c,) lies above the given top of its owner; never where there is no owner or no top."""
    return np.asarray(z > np.append(top, np.nan)[owner])


def _rise(cells: Cells, z: FloatArray, n: int) -> FloatArray:
    """How far the mean height of occupancy moves up (n,) m in the columns that both epochs occupy (tie-break)."""
    own = cells.owner
    voxel, owner = _either(cells)
    column = unique_inverse(np.column_stack([owner.astype(np.int64), cells.cell[voxel, :2]]))
    is_own = own.map(lambda side: side[voxel] == owner)
    is_in = is_own.map(lambda side: np.bincount(column, weights=side)[column] > 0 if len(column) else side)
    is_shared = is_in.before & is_in.after
    mean = is_own.map(lambda side: Groups(np.where(is_shared & side, owner, -1), n).mean(z[voxel]))
    return mean.after - mean.before
