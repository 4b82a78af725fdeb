"""Change cues (paper, section 4.3): occupied volumes, overlap, height, displacement and detection limit per object.

Everything is sampled on one lattice of occupied voxels for the whole block, once: each occupied voxel knows whose it is
in each epoch, whether the other epoch has a surface in reach, and whether the other epoch could have seen it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

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
    """

    xyz: FloatArray
    normals: Float32Array
    height: FloatArray
    n_raw: IntArray
    owner: IntArray

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
    is_near : Pair of (c,) bool
        Whether that epoch has an object's surface within the query radius of the centre.
    is_seen : Pair of (c,) bool
        Whether that epoch saw the voxel's column.
    displacement : (c,) float64, m
        Along the mean normal, after minus before (equation 5); NaN where either surface is missing.
    lod95 : (c,) float64, m
        Detection limit at the centre.
    """

    cell: Int64Array
    owner: Pair[IntArray]
    is_near: Pair[BoolArray]
    is_seen: Pair[BoolArray]
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

    ``volume`` m3 of occupied voxels, ``height`` m above ground (95th percentile), ``support`` share of an epoch's
    voxels that the other epoch shows too, ``gained`` and ``lost`` numbers of voxels, ``observability`` share of the
    voxels that both surveys saw or could have seen, ``rise`` m by which the mean height of occupancy inside the
    overlap moves up.
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
    n_samples: FloatArray
    lod95: FloatArray
    observability: FloatArray
    rise: FloatArray
    z_min: FloatArray
    z_max: FloatArray


def sample_cells(surfaces: Pair[Surface], coverage: Pair[Coverage] | None, lod: LodGrid, params: ChangeParams) -> Cells:
    """Occupied voxels of all objects (paper, section 4.3: samples x with p_23(x), p_25(x) and their normals).

    Without ``coverage`` every voxel counts as seen by both surveys, as in the paper.
    """
    occupied = surfaces.map(lambda surface: _owned_cells(surface, params.voxel_m))
    rows = np.concatenate([occupied.before[0], occupied.after[0]])
    if len(rows) == 0:
        nothing, never, no = np.zeros(0, np.int32), np.zeros(0, np.bool_), np.zeros(0)
        return Cells(rows, Pair(nothing, nothing), Pair(never, never), Pair(never, never), no, no)
    lattice = Lattice.around(rows)
    keys, first = np.unique(lattice.keys(rows), return_index=True)
    cell = rows[first]
    owner = occupied.map(lambda side: _spread(lattice, keys, *side))
    centre = (cell + 0.5) * params.voxel_m
    found = surfaces.map(lambda surface: _nearest_surface(surface, centre, params.query_radius_m))
    is_near = found.map(lambda idx: idx >= 0)
    always = np.ones(len(cell), np.bool_)
    is_seen = coverage.map(lambda side: side.at(centre)) if coverage else Pair(always, always)
    return Cells(cell, owner, is_near, is_seen, _displacement(surfaces, found), lod.at(centre))


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
    points = surfaces.map(lambda surface: Groups(surface.owner, n))
    lowest = points.join(surfaces, lambda group, surface: group.minimum(surface.xyz[:, 2]))
    highest = points.join(surfaces, lambda group, surface: group.maximum(surface.xyz[:, 2]))
    height = points.join(surfaces, lambda group, surface: group.quantile(surface.height, 0.95))
    top = height if params.height_reference == "ground" else _tops(surfaces, coverage, n, params.voxel_m)
    middle = (cells.cell + 0.5) * params.voxel_m
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
        d_perp=np.where(samples.counts >= params.min_samples, samples.median(cells.displacement[voxel]), np.nan),
        n_samples=samples.counts.astype(np.float64),
        lod95=Groups(owner, n).median(cells.lod95[voxel]),
        observability=(n_known.before + n_known.after) / np.maximum(n_voxels.before + n_voxels.after, 1),
        rise=_rise(cells, middle[:, 2], n),
        z_min=np.fmin(lowest.before, lowest.after),
        z_max=np.fmax(highest.before, highest.after),
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


def _owned_cells(surface: Surface, voxel_m: float) -> tuple[Int64Array, IntArray]:
    """Voxels (k, 3) that an epoch's objects occupy and their owners (k,); the lowest object where several meet."""
    is_member = surface.owner >= 0
    rows = unique_rows(np.column_stack([cells_of(surface.xyz[is_member], voxel_m), surface.owner[is_member]]))
    is_first = np.ones(len(rows), np.bool_)
    is_first[1:] = np.any(rows[1:, :3] != rows[:-1, :3], axis=1)
    return rows[is_first, :3], rows[is_first, 3].astype(np.int32)


def _spread(lattice: Lattice, keys: Int64Array, cell: Int64Array, owner: IntArray) -> IntArray:
    """Owners on the joint list of voxels, -1 where the epoch has none."""
    spread = np.full(len(keys), -1, dtype=np.int32)
    spread[lattice.find(keys, cell)] = owner
    return spread


def _nearest_surface(surface: Surface, centre: FloatArray, reach_m: float) -> IntArray:
    """Index of the object point nearest to each centre, -1 where none lies within ``reach_m``."""
    members = np.flatnonzero(surface.owner >= 0)
    if len(members) == 0:
        return np.full(len(centre), -1, dtype=np.int32)
    found, _ = nearest(surface.xyz[members], centre, reach_m)
    return np.where(found >= 0, members[np.maximum(found, 0)], -1).astype(np.int32)


def _displacement(surfaces: Pair[Surface], found: Pair[IntArray]) -> FloatArray:
    """Offset between the nearest surface points along their mean normal (equation 5); NaN where one is missing."""
    displacement = np.full(len(found.before), np.nan)
    is_both = (found.before >= 0) & (found.after >= 0)
    b, a = found.before[is_both], found.after[is_both]
    n_b, n_a = surfaces.before.normals[b].astype(np.float64), surfaces.after.normals[a].astype(np.float64)
    n_a = np.where(np.sum(n_b * n_a, axis=1, keepdims=True) < 0, -n_a, n_a)
    mean = n_b + n_a
    length = np.linalg.norm(mean, axis=1)
    offset = np.sum(mean * (surfaces.after.xyz[a] - surfaces.before.xyz[b]), axis=1)
    displacement[is_both] = np.divide(offset, length, out=np.full(len(b), np.nan), where=length > 0.5)
    return displacement


def _tops(surfaces: Pair[Surface], coverage: Pair[Coverage] | None, n: int, cell_m: float) -> Pair[FloatArray]:
    """Height of the top (n,) m of each object in each epoch: 95th percentile of its columns' highest points.

    Only columns that the other epoch saw count, so that a part which one survey never saw is no growth.
    """

    def top(surface: Surface, other: Coverage | None) -> FloatArray:
        is_in = surface.owner >= 0
        if other is not None:
            is_in &= other.at(surface.xyz)
        column = np.column_stack([surface.owner[is_in], cells_of(surface.xyz[is_in, :2], cell_m)])
        z = surface.xyz[is_in, 2]
        order = np.lexsort((z, column[:, 2], column[:, 1], column[:, 0]))
        column, z = column[order], z[order]
        is_last = np.ones(len(z), np.bool_)
        is_last[:-1] = np.any(column[1:] != column[:-1], axis=1)
        return Groups(column[is_last, 0], n).quantile(z[is_last], 0.95)

    return Pair(
        top(surfaces.before, coverage.after if coverage else None),
        top(surfaces.after, coverage.before if coverage else None),
    )


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
