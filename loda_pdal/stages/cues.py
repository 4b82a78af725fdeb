"""Change cues (paper, section 4.3): occupied volumes, overlap, height, displacement and detection limit per object.

Everything is sampled on one lattice of occupied voxels for the whole block, once: whether each epoch has a surface in
reach and saw the place. Whose a voxel is changes while pairs are undone and parts are taken out: owners come on top.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from loda_pdal.kernels.neighbours import nearest
from loda_pdal.kernels.occupancy import column_top_range, holder_range, shared_column_range
from loda_pdal.kernels.parallel import run_ranges
from loda_pdal.model.cloud import BoolArray, Float32Array, FloatArray, Int64Array, IntArray
from loda_pdal.model.grid import Lattice, cells_of
from loda_pdal.model.groups import Groups
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

    def only(self, is_kept: BoolArray) -> Surface:
        """The same points, with an owner only where ``is_kept`` (m,)."""
        return self.owned_by(np.where(is_kept, self.owner, -1).astype(np.int32))


@dataclass(frozen=True)
class Voxels:
    """Voxels in which the objects of either epoch have points, (c,), and all that does not depend on whose they are.

    The points of objects, (k,), are those of both epochs, one epoch after the other, sorted by slot: slot ``2 v`` holds
    the points of the before epoch in voxel v, slot ``2 v + 1`` those of the after epoch.

    Attributes
    ----------
    cell : (c, 3) int64
        Lattice index, lexicographically sorted, unique.
    centre : (c, 3) float64, m
    columns : (b + 1,) int64
        First voxel of each column, and c.
    point : (k,) int64
        Index of each point among the points of both epochs.
    starts : (2 c + 1,) int64
        First point of each slot, and k.
    is_open : (k,) bool
        Whether the other epoch saw the point's column.
    is_near : Pair of (c,) bool
        Whether that epoch has a surface within the query radius of the centre.
    is_covered : Pair of (c,) bool
        Whether that epoch saw the voxel, or its column where no ray says more.
    is_over : Pair of (c,) bool
        Whether that epoch has a return in the voxel's column beneath the voxel: its rays went in there. True where no
        rule asks.
    is_clear : Pair of (c,) bool
        Whether that epoch has returns in the voxel's column, all of them on the ground. False where no rule asks.
    is_hidden : Pair of (c,) bool
        Whether the voxel was hidden from that epoch behind something nearer to its sensor.
    normal : (c, 3) float64
        Mean unit normal of both epochs' nearest surfaces, of either sign; zero where either surface is missing.
    displacement : (c,) float64, m
        Along ``normal``, after minus before (equation 5); NaN where either surface is missing.
    lod95 : (c,) float64, m
        Detection limit at the centre.
    """

    cell: Int64Array
    centre: FloatArray
    columns: Int64Array
    point: Int64Array
    starts: Int64Array
    is_open: BoolArray
    is_near: Pair[BoolArray]
    is_covered: Pair[BoolArray]
    is_over: Pair[BoolArray]
    is_clear: Pair[BoolArray]
    is_hidden: Pair[BoolArray]
    normal: FloatArray
    displacement: FloatArray
    lod95: FloatArray

    def __len__(self) -> int:
        return len(self.cell)

    @cached_property
    def beside(self) -> Int64Array:
        """The voxels (c, 6) that share a face with each, -1 where there is none."""
        if len(self) == 0:
            return np.zeros((0, 6), dtype=np.int64)
        lattice = Lattice.around(self.cell)
        keys = lattice.keys(self.cell)
        steps = np.concatenate([np.eye(3, dtype=np.int64), -np.eye(3, dtype=np.int64)])
        return np.column_stack([lattice.find(keys, self.cell + step) for step in steps])

    def unseen_by(self, is_beyond: Pair[BoolArray]) -> Voxels:
        """The same voxels, those marked (c,) not seen by that epoch, and the tops of their columns not compared."""
        is_either = is_beyond.before | is_beyond.after
        if not is_either.any():
            return self
        is_column = np.repeat(np.logical_or.reduceat(is_either, self.columns[:-1]), np.diff(self.columns))
        return replace(
            self,
            is_covered=self.is_covered.join(is_beyond, lambda seen, beyond: seen & ~beyond),
            is_open=self.is_open & ~np.repeat(np.repeat(is_column, 2), np.diff(self.starts)),
        )

    def holders(self, surfaces: Pair[Surface], n: int) -> tuple[IntArray, FloatArray]:
        """Object (c, 2) that has each voxel before and after, -1 none, and its raw points (c, 2) in there.

        Where several of the objects 0 to ``n - 1`` meet, the one with most points, then the lowest, has the voxel.
        """
        holder = np.full(2 * len(self), -1, dtype=np.int32)
        n_raw = np.zeros(2 * len(self))
        points = (self.of_points([side.owner for side in surfaces]), self.of_points([side.n_raw for side in surfaces]))
        run_ranges(holder_range, 2 * len(self), self.starts, *points, n, holder, n_raw)
        return holder.reshape(-1, 2), n_raw.reshape(-1, 2)

    def of_points(self, values: list[npt.NDArray[Any]]) -> npt.NDArray[Any]:
        """Values (k,) of the sorted points from those of both epochs' points."""
        return np.asarray(np.concatenate(values)[self.point])

    def on_points(self, holder: IntArray, surfaces: Pair[Surface]) -> Pair[IntArray]:
        """The object that has the voxel of each point of either epoch, -1 for points without object."""
        return self._spread(holder, surfaces, np.int32(-1))

    def at_points(self, values: Pair[BoolArray], surfaces: Pair[Surface]) -> Pair[BoolArray]:
        """What is true (c,) of the voxel of each point of either epoch; false for points without object."""
        return self._spread(np.column_stack(list(values)), surfaces, np.bool_(False))

    def _spread(self, values: npt.NDArray[Any], surfaces: Pair[Surface], none: Any) -> Pair[npt.NDArray[Any]]:
        """Values (c, 2) of the slots on the points of either epoch, ``none`` on points without object."""
        n_before = len(surfaces.before.owner)
        spread = np.full(n_before + len(surfaces.after.owner), none)
        spread[self.point] = np.repeat(values.ravel(), np.diff(self.starts))
        return Pair(spread[:n_before], spread[n_before:])


@dataclass(frozen=True)
class Cells:
    """The voxels with their owners, (c,) each.

    Attributes
    ----------
    voxels : Voxels
        Where they are and what was sampled there.
    owner : Pair of (c,) int32
        Object whose points occupy the voxel in that epoch, -1 where none.
    is_seen : Pair of (c,) bool
        Whether that epoch saw the voxel's column, and would have hit what the other epoch shows there; of solid things
        it must show something beneath the voxel, and nothing of the same object above it.
    n_raw : Pair of (c,) float64
        Raw points of that epoch's owner there; none in what was filled in beneath a roof.
    odds : Pair of (c,) float64
        How likely that epoch's sampling was to meet what the other epoch shows there; 1 where that is not weighed.
    due : Pair of (c,) float64
        How likely it was to meet any of it within reach; 1 where no rule asks.
    """

    voxels: Voxels
    owner: Pair[IntArray]
    is_seen: Pair[BoolArray]
    n_raw: Pair[FloatArray]
    odds: Pair[FloatArray]
    due: Pair[FloatArray]

    @property
    def is_measured(self) -> Pair[BoolArray]:
        """Whether each epoch's owner has raw points there."""
        return self.n_raw.map(lambda points: points > 0)

    @property
    def is_near(self) -> Pair[BoolArray]:
        """Whether each epoch has a surface in reach."""
        return self.voxels.is_near

    @property
    def is_gained(self) -> BoolArray:
        """Occupied after, empty before where the before survey saw: growth or something new."""
        return (self.owner.after >= 0) & ~self.is_near.before & self.is_seen.before

    @property
    def is_lost(self) -> BoolArray:
        """Occupied before, empty after where the after survey saw."""
        return (self.owner.before >= 0) & ~self.is_near.after & self.is_seen.after

    @property
    def bare_columns(self) -> Pair[BoolArray]:
        """Voxels in whose columns that epoch saw, and shows next to nothing of what the other epoch has there."""
        first = self.voxels.columns[:-1]
        size = np.diff(self.voxels.columns)

        def is_bare(near: BoolArray, seen: BoolArray, others: IntArray) -> BoolArray:
            if len(near) == 0:
                return near
            shown = np.add.reduceat((near & (others >= 0)).astype(np.int64), first)
            held = np.add.reduceat((others >= 0).astype(np.int64), first)
            return np.repeat(shown <= _NEXT_TO_NOTHING * held, size) & seen

        own = self.owner.swapped
        return Pair(
            is_bare(self.is_near.before, self.is_seen.before, own.before),
            is_bare(self.is_near.after, self.is_seen.after, own.after),
        )

    @property
    def is_common(self) -> BoolArray:
        """Both epochs have a surface here."""
        return self.is_near.before & self.is_near.after


_NEXT_TO_NOTHING = 0.3
"""Share of a column that may be shown all the same: a car beneath a tree that was felled."""


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
        Share of an epoch's voxels with raw points that the other epoch shows too.
    due : Pair
        What that share would be, were the object unchanged, by the sampling of the other epoch.
    gained, lost
        Voxels that only the after, or only the before epoch has, where the other could have seen them;
        ``gained_above`` and ``lost_above`` are those beyond the other epoch's top, ``gained_clear`` and ``lost_clear``
        those in whose columns the other epoch shows the ground and nothing else.
    unshown
        Raw points in the gained or lost voxels, of the epoch that has more of them.
    column_rise, column_scatter : m
        Median change of the top over the columns that both epochs occupy, and what lies between the quartiles of these
        changes, more where the columns are few; NaN with fewer than eight of them.
    iou, shift : 3D overlap of the occupancy, and distance of the centroids (m).
    dh : m
        Change of the height that the parameters name.
    d_perp, d_typical : m
        Median signed and median absolute displacement along the normal.
    lod95 : m
        Median limit of detection.
    observability
        Share of the voxels that both surveys saw or could have seen.
    hidden
        Share of the voxels of which the other survey shows nothing, because something stood before them.
    rise : m
        How far the mean height of occupancy moves up inside the overlap.
    """

    n_points: Pair[FloatArray]
    n_voxels: Pair[FloatArray]
    volume: Pair[FloatArray]
    height: Pair[FloatArray]
    support: Pair[FloatArray]
    due: Pair[FloatArray]
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
    unshown: FloatArray
    gained_clear: FloatArray
    lost_clear: FloatArray
    column_rise: FloatArray
    column_scatter: FloatArray
    lod95: FloatArray
    observability: FloatArray
    hidden: FloatArray
    rise: FloatArray

    def at(self, index: Int64Array) -> Evidence:
        """The cues of the objects ``index`` (k,)."""
        return self._each(lambda values: values[index])

    def together(self, other: Evidence) -> Evidence:
        """The cues of these objects, then of those of ``other``."""
        return self._each(lambda own, more: np.concatenate([own, more]), other)

    def _each(self, change: Callable[..., FloatArray], *others: Evidence) -> Evidence:
        """Every cue changed, that of ``others`` beside it."""
        values: dict[str, Any] = {}
        for item in fields(self):
            own, *more = (getattr(side, item.name) for side in (self, *others))
            is_pair = isinstance(own, Pair)
            values[item.name] = Pair(*map(change, own, *more)) if is_pair else change(own, *more)
        return Evidence(**values)


def sample_voxels(
    surfaces: Pair[Surface], coverage: Pair[Coverage] | None, lod: LodGrid, params: ChangeParams
) -> Voxels:
    """Occupied voxels of all objects (paper, section 4.3: samples x with p_23(x), p_25(x) and their normals).

    Without ``coverage`` every voxel counts as seen by both surveys, as in the paper.
    """
    members = surfaces.map(lambda surface: np.flatnonzero(surface.owner >= 0))
    xyz = surfaces.join(members, lambda surface, idx: surface.xyz[idx])
    cell, columns, order, starts = _slots(xyz.map(lambda points: cells_of(points, params.voxel_m)))
    centre = np.asarray((cell + 0.5) * params.voxel_m, dtype=np.float64)
    found = surfaces.map(lambda surface: _nearest_surface(surface, centre, params.query_radius_m))
    normal, displacement = _displacement(surfaces, found)
    always, never = np.ones(len(cell), np.bool_), np.zeros(len(cell), np.bool_)
    covered, hidden = Pair(always, always), Pair(never, never)
    is_open = xyz.map(lambda points: np.ones(len(points), np.bool_))
    over, clear = Pair(always, always), Pair(never, never)
    z = centre[:, 2]
    if params.fills_buildings:
        heights = surfaces.map(lambda side: np.column_stack([side.xyz[:, :2], side.height])[side.n_raw > 0])
        top = heights.map(lambda points: _ends_of_columns(cell, columns, points, params.voxel_m)[1])
        clear = top.map(lambda high: (high > -np.inf) & (high < _ON_GROUND_M))
    if params.needs_sight or params.thing_voxels > 0:
        over = surfaces.map(lambda side: _ends_of_columns(cell, columns, side.xyz, params.voxel_m)[0] < z)
    measured = surfaces.map(lambda surface: surface.xyz[surface.n_raw > 0])
    if params.needs_returns:
        over = measured.map(lambda points: _ends_of_columns(cell, columns, points, params.voxel_m, reach=1)[0] < z)
    if coverage:
        shown = coverage.map(lambda side: side.shown(cell, params.voxel_m))
        hidden = shown.map(lambda rays: rays.is_hidden)
        covered = coverage.join(shown, lambda side, rays: rays.corrected(side.at(centre)))
        if params.needs_returns:
            covered = covered.join(over, np.logical_and)
        if params.looks_down:
            from_above = surfaces.map(lambda side: _from_above(side, cell, columns, params.voxel_m))
            covered = covered.join(from_above, np.logical_and)
        is_open = coverage.swapped.join(xyz, lambda other, points: other.at(points))
        if params.needs_sight:
            shaded = _in_shadow(cell, columns, surfaces, params.voxel_m)
            covered = covered.join(shaded, lambda seen, dark: seen & ~dark)
    return Voxels(
        cell=cell,
        centre=centre,
        columns=columns,
        point=np.concatenate([members.before, members.after + len(surfaces.before.xyz)])[order],
        starts=starts,
        is_open=np.concatenate(list(is_open))[order],
        is_near=found.map(lambda idx: idx >= 0),
        is_covered=covered,
        is_over=over,
        is_clear=clear,
        is_hidden=hidden,
        normal=normal,
        displacement=displacement,
        lod95=lod.at(centre),
    )


def cells_with_owners(
    voxels: Voxels, surfaces: Pair[Surface], n: int, params: ChangeParams, is_solid: BoolArray | None = None
) -> Cells:
    """The voxels with their owners among objects 0 to ``n - 1``.

    Of those that are solid, (n,) bool, what has other surface of the object above it in the other epoch, or no return
    of that epoch beneath it, was hidden there and not seen: a wall behind a new porch has not gone.
    """
    holder, points = voxels.holders(surfaces, n)
    owner, n_raw = (Pair(*np.ascontiguousarray(values.T)) for values in (holder, points))
    is_seen = voxels.is_covered
    odds = due = n_raw.map(np.ones_like)
    is_porous = np.ones(n, np.bool_) if is_solid is None else ~is_solid
    if params.min_expected_points > 0:
        within = owner.join(n_raw, lambda side, points: _with_beside(voxels.beside, side, points))
        expected = _expected_points(voxels, owner, n_raw, within, is_porous)
        is_seen = is_seen.join(expected, lambda seen, points: seen & (points >= params.min_expected_points))
        due = expected.map(_odds_of)
    if params.weighs_sampling:
        odds = _expected_points(voxels, owner, n_raw, n_raw, is_porous).map(_odds_of)
    if is_solid is not None and is_solid.any():
        own = owner.swapped  # what each epoch should have seen is the other's
        is_hidden = Pair(
            ~voxels.is_over.before | _is_beneath(voxels, own.before, owner.before),
            ~voxels.is_over.after | _is_beneath(voxels, own.after, owner.after),
        )
        solid = own.map(lambda side: np.append(is_solid, False)[side])
        is_seen = is_seen.join(solid.join(is_hidden, np.logical_and), lambda seen, hidden: seen & ~hidden)
    return Cells(voxels, owner, is_seen, n_raw, odds, due)


def _odds_of(points: FloatArray) -> FloatArray:
    """How likely (c,) a point is, where so many are expected."""
    return 1.0 - np.exp(-points)


def _ends_of_columns(
    cell: Int64Array, columns: Int64Array, xyz: FloatArray, voxel_m: float, reach: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest (c,) m of the points (m, 3) in the column of each voxel, or at most ``reach`` columns beside
    it; infinite, and the other way round, where there is none."""
    first = columns[:-1]
    low, high = np.full(len(first), np.inf), np.full(len(first), -np.inf)
    if len(first) > 0 and len(xyz) > 0:
        plan = cell[first, :2]
        lattice = Lattice.around(plan)
        keys = lattice.keys(plan)
        place = cells_of(xyz[:, :2], voxel_m)
        for step in np.ndindex(2 * reach + 1, 2 * reach + 1):
            inside = Groups(lattice.find(keys, place + (np.array(step) - reach)), len(first))
            lowest, highest = inside.extremes(xyz[:, 2])
            low, high = np.fmin(low, lowest), np.fmax(high, highest)
    size = np.diff(columns)
    return np.repeat(low, size), np.repeat(high, size)


def _from_above(surface: Surface, cell: Int64Array, columns: Int64Array, voxel_m: float) -> BoolArray:
    """Whether an epoch measured something in or beneath each voxel (c,), and shows no roof above it or beside that.

    What was filled in beneath roofs has no raw points.
    """
    top = (cell[:, 2] + 1) * voxel_m
    is_measured = surface.n_raw > 0
    low, _ = _ends_of_columns(cell, columns, surface.xyz[is_measured], voxel_m)
    _, roof = _ends_of_columns(cell, columns, surface.xyz[~is_measured], voxel_m, reach=1)
    return np.asarray((low < top) & (roof <= top))


def _in_shadow(cell: Int64Array, columns: Int64Array, surfaces: Pair[Surface], voxel_m: float) -> Pair[BoolArray]:
    """Whether each voxel (c,) stands where that epoch shows hardly any of the ground that the other epoch shows.

    What came or went takes ground out of sight, or lets it be seen; where there is less of it without the thing than
    with it, something nearer to the sensor hid both.
    """
    first = columns[:-1]
    if len(first) == 0:
        return Pair(np.zeros(len(cell), np.bool_), np.zeros(len(cell), np.bool_))
    plan = cell[first, :2]

    def ground_about(surface: Surface) -> IntArray:
        place = cells_of(surface.xyz[~surface.is_surface, :2], voxel_m)
        lattice = Lattice.around(np.concatenate([plan, place]))
        keys, counts = np.unique(lattice.keys(place), return_counts=True)
        counts = np.append(counts, 0)
        steps = np.ndindex(2 * _GROUND_REACH + 1, 2 * _GROUND_REACH + 1)
        about = [counts[lattice.find(keys, plan + (np.array(step) - _GROUND_REACH))] for step in steps]
        return np.asarray(np.sum(about, axis=0), dtype=np.int32)

    shown = surfaces.map(ground_about)
    dark = shown.join(shown.swapped, lambda own, other: (other >= _LEAST_GROUND) & (own <= _HARDLY_ANY * other))
    return dark.map(lambda side: np.repeat(side, np.diff(columns)))


_GROUND_REACH = 2
"""Columns on either side of a voxel's in which ground tells whether the place was seen."""

_LEAST_GROUND = 12
"""Points of ground there, fused, before an epoch that has hardly any must have been kept from seeing it."""

_HARDLY_ANY = 0.1
"""Share of the other epoch's ground: shadows are dark."""


_ON_GROUND_M = 0.5
"""What is no higher than this above the ground is kerbs, grass and the slope of the ground."""


def _is_beneath(voxels: Voxels, owner: IntArray, other: IntArray) -> BoolArray:
    """Whether the owner (c,) of each voxel has a voxel as high or higher in its column among ``other`` (c,) owners."""
    column = np.repeat(np.arange(len(voxels.columns) - 1), np.diff(voxels.columns))
    n = int(max(owner.max(initial=-1), other.max(initial=-1))) + 2
    key = column * n + other
    is_held = np.flatnonzero(other >= 0)
    # voxels of a column ascend: the last of a key is its highest
    keys, last = np.unique(key[is_held][::-1], return_index=True)
    highest = is_held[len(is_held) - 1 - last]
    place = np.minimum(np.searchsorted(keys, column * n + owner), max(len(keys) - 1, 0))
    if len(keys) == 0:
        return np.zeros(len(owner), np.bool_)
    is_found = (keys[place] == column * n + owner) & (owner >= 0)
    return np.asarray(is_found & (voxels.cell[highest[place], 2] >= voxels.cell[:, 2]))


def share_beneath(cells: Cells, is_roof: BoolArray) -> FloatArray:
    """Share (n,) of each object's voxels that lie beneath one of the objects ``is_roof`` (n,) in either epoch."""
    voxels, n = cells.voxels, len(is_roof)
    if len(voxels) == 0:
        return np.zeros(n)
    is_held = cells.owner.map(lambda side: np.append(is_roof, False)[side])
    z = voxels.cell[:, 2]
    low = z.min() - 1
    top = np.maximum.reduceat(np.where(is_held.before | is_held.after, z, low), voxels.columns[:-1])
    is_beneath = z < np.repeat(top, np.diff(voxels.columns))
    voxel, owner = _either(cells)
    held = np.bincount(owner, minlength=n)
    return np.bincount(owner, weights=is_beneath[voxel], minlength=n) / np.maximum(held, 1)


def _slots(cells: Pair[Int64Array]) -> tuple[Int64Array, Int64Array, Int64Array, Int64Array]:
    """Voxels (c, 3) of the points, first voxel of each column, order (k,) of all points by slot, and first of each."""
    rows = np.concatenate(list(cells))
    if len(rows) == 0:
        none = np.zeros(0, dtype=np.int64)
        return rows, np.zeros(1, dtype=np.int64), none, np.zeros(1, dtype=np.int64)
    is_after = np.repeat(np.array([0, 1]), [len(cells.before), len(cells.after)])
    key = 2 * Lattice.around(rows).keys(rows) + is_after
    order = np.argsort(key, kind="stable")
    key = key[order]
    voxel = np.cumsum(np.diff(key >> 1, prepend=-1) != 0) - 1
    cell = rows[order[np.diff(voxel, prepend=-1) != 0]]
    starts = np.searchsorted(2 * voxel + (key & 1), np.arange(2 * len(cell) + 1))
    is_column = np.any(cell[1:, :2] != cell[:-1, :2], axis=1)
    return cell, np.concatenate([[0], np.flatnonzero(is_column) + 1, [len(cell)]]), order, starts


def _with_beside(beside: Int64Array, owner: IntArray, n_raw: FloatArray) -> FloatArray:
    """Raw points (c,) of each voxel's owner in the voxel and in those ``beside`` (c, 6) it: what lies within reach of
    its centre, where a surface must be missing for the voxel to be empty."""
    is_own = np.append(owner, -1)[beside] == owner[:, None]
    return np.asarray(n_raw + (np.append(n_raw, 0.0)[beside] * is_own).sum(axis=1))


def _expected_points(
    voxels: Voxels, owner: Pair[IntArray], n_raw: Pair[FloatArray], n_there: Pair[FloatArray], is_porous: BoolArray
) -> Pair[FloatArray]:
    """Raw points (c,) that each epoch should have where the other has ``n_there`` of an object, were it unchanged.

    By the ratio of both epochs' points ``n_raw`` in the voxels of the object that both occupy; of an object without
    such voxels, in those about it that both occupy, whosever they are.
    """
    n = len(is_porous)
    is_both = (owner.before >= 0) & (owner.before == owner.after)
    shared = n_raw.map(lambda points: _count(owner.before, is_both, n, points))
    is_alone = is_porous & (_count(owner.before, is_both, n) == 0)
    about = _points_about(voxels, owner, n_raw, is_alone)
    shared = shared.join(about, lambda own, near: np.where(is_alone, near, own) + 1.0)
    ratio = np.append(shared.before / shared.after, 1.0)
    return Pair(
        np.where(owner.after >= 0, n_there.after * ratio[owner.after], np.inf),
        np.where(owner.before >= 0, n_there.before / ratio[owner.before], np.inf),
    )


def _points_about(
    voxels: Voxels, owner: Pair[IntArray], n_raw: Pair[FloatArray], is_asked: BoolArray
) -> Pair[FloatArray]:
    """Raw points (n,) of each epoch about the objects asked for (n,), in voxels that something occupies in both: what
    the sampling of the place is. Voxels count once for each voxel of the object that they are near to."""
    n = len(is_asked)
    is_both = np.flatnonzero((owner.before >= 0) & (owner.after >= 0))
    asked = np.append(is_asked, False)
    member = [np.flatnonzero(asked[side]) for side in owner]
    if len(is_both) == 0 or not any(len(side) for side in member):
        return Pair(np.zeros(n), np.zeros(n))
    place = cells_of(voxels.centre, _ABOUT_M)
    lattice = Lattice.around(place)
    keys, cell = np.unique(lattice.keys(place[is_both]), return_inverse=True)
    counts = [np.append(np.bincount(cell, weights=side[is_both], minlength=len(keys)), 0.0) for side in n_raw]
    total = np.zeros((2, n))
    for side, inside in zip(owner, member, strict=True):
        for step in np.ndindex(3, 3, 3):
            found = lattice.find(keys, place[inside] + (np.array(step) - 1))
            for sums, count in zip(total, counts, strict=True):
                sums += np.bincount(side[inside], weights=count[found], minlength=n)
    return Pair(*total)


_ABOUT_M = 2.0
"""What lies within a cell of this edge, or one beside it, is about a voxel."""


def weigh(cells: Cells, surfaces: Pair[Surface], n: int, params: ChangeParams) -> Evidence:
    """Cues of objects 0 to ``n - 1`` from their voxels and points (paper, section 4.3; METHOD 1.13)."""
    voxels, own = cells.voxels, cells.owner
    is_known = Pair(  # own voxels about which the other epoch says something
        (own.before >= 0) & (cells.is_near.after | cells.is_seen.after),
        (own.after >= 0) & (cells.is_near.before | cells.is_seen.before),
    )
    n_voxels = own.map(lambda side: _count(side, side >= 0, n))
    n_known = own.join(is_known, lambda side, known: _count(side, known, n))
    n_hidden = Pair(
        _count(own.before, ~is_known.before & voxels.is_hidden.after, n),
        _count(own.after, ~is_known.after & voxels.is_hidden.before, n),
    )
    n_measured = own.join(cells.is_measured, lambda side, measured: _count(side, measured, n))
    n_shared = Pair(
        _count(own.before, cells.is_measured.before & cells.is_near.after, n),
        _count(own.after, cells.is_measured.after & cells.is_near.before, n),
    )
    n_due = Pair(
        _count(own.before, cells.is_measured.before, n, cells.due.after),
        _count(own.after, cells.is_measured.after, n, cells.due.before),
    )
    gained = _count(own.after, cells.is_gained, n, cells.odds.before)
    lost = _count(own.before, cells.is_lost, n, cells.odds.after)
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

    displacement = voxels.displacement[voxel]
    samples = Groups(np.where(np.isfinite(displacement), owner, -1), n)
    is_sampled = samples.counts >= params.min_samples
    displacement = displacement * _facing(voxels.normal[voxel], samples)
    points = surfaces.map(lambda surface: Groups(surface.owner, n))
    height = points.join(surfaces, lambda group, surface: group.quantile(surface.height, 0.95))
    columns = _column_tops(voxels, surfaces, n)
    summit = columns.top.map(lambda top: _summit(columns.owner, top, n))
    top = height if params.height_reference == "ground" else summit
    column_rise, column_scatter = _rise_of_columns(
        _fair_rises(voxels, surfaces, n) if params.fair_tops else columns.rises, n, _LEAST_COLUMNS
    )
    z = voxels.centre[:, 2]
    centroid = own.join(is_known, lambda side, known: Groups(np.where(known, side, -1), n).mean(voxels.centre))
    return Evidence(
        n_points=points.join(surfaces, lambda group, surface: group.sum(surface.n_raw)),
        n_voxels=n_voxels,
        volume=volume,
        height=height,
        support=n_shared.join(n_measured, lambda shared, count: shared / np.maximum(count, 1)),
        due=n_due.join(n_measured, lambda expected, count: expected / np.maximum(count, 1)),
        gained=gained,
        lost=lost,
        iou=iou,
        shift=np.linalg.norm(centroid.after - centroid.before, axis=1),
        dh=top.after - top.before,
        dv=dv,
        dv_ratio=np.divide(dv, base, out=np.full(n, np.nan), where=base > 0),
        d_perp=np.where(is_sampled, samples.median(displacement), np.nan),
        d_typical=np.where(is_sampled, samples.median(np.abs(displacement)), np.nan),
        gained_above=_count(own.after, cells.is_gained & _is_above(z, own.after, summit.before), n, cells.odds.before),
        lost_above=_count(own.before, cells.is_lost & _is_above(z, own.before, summit.after), n, cells.odds.after),
        unshown=np.fmax(
            _count(own.before, cells.is_lost, n, cells.n_raw.before),
            _count(own.after, cells.is_gained, n, cells.n_raw.after),
        ),
        gained_clear=_count(own.after, cells.is_gained & voxels.is_clear.before, n),
        lost_clear=_count(own.before, cells.is_lost & voxels.is_clear.after, n),
        column_rise=column_rise,
        column_scatter=column_scatter,
        lod95=Groups(owner, n).median(voxels.lod95[voxel]),
        observability=(n_known.before + n_known.after) / np.maximum(n_voxels.before + n_voxels.after, 1),
        hidden=(n_hidden.before + n_hidden.after) / np.maximum(n_voxels.before + n_voxels.after, 1),
        rise=_rise(cells, n),
    )


def _count(owner: IntArray, is_counted: BoolArray, n: int, odds: FloatArray | None = None) -> FloatArray:
    """Voxels per object (n,) among those counted, each by its odds; voxels without an owner do not count."""
    is_in = is_counted & (owner >= 0)
    return np.bincount(owner[is_in], weights=None if odds is None else odds[is_in], minlength=n).astype(np.float64)


def _either(cells: Cells) -> tuple[Int64Array, IntArray]:
    """Voxels with their owner in either epoch: a voxel that two objects hold, one per epoch, counts for both."""
    before = np.flatnonzero(cells.owner.before >= 0)
    after = np.flatnonzero((cells.owner.after >= 0) & (cells.owner.after != cells.owner.before))
    owner = np.concatenate([cells.owner.before[before], cells.owner.after[after]])
    return np.concatenate([before, after]), owner.astype(np.int32)


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
    # points filled in under roofs have no raw points, and are no surface that could have moved
    is_measured = surfaces.join(found, lambda surface, idx: np.append(surface.n_raw, 0)[idx] > 0)
    is_both = is_measured.before & is_measured.after
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
    """Columns of the objects: the object (b,) of each, and its highest point (b,) m there by epoch; NaN if none."""

    owner: IntArray
    top: Pair[FloatArray]

    @property
    def rises(self) -> tuple[IntArray, FloatArray]:
        """Columns that both epochs have: the object of each, and how far its top rises, m."""
        rise = self.top.after - self.top.before
        is_both = np.isfinite(rise)
        return self.owner[is_both], rise[is_both]


def _column_tops(voxels: Voxels, surfaces: Pair[Surface], n: int) -> _Columns:
    """Highest point in each column of each object, in the columns that the other epoch saw.

    A part that one survey never saw is no growth.
    """
    points = (voxels.of_points([side.owner for side in surfaces]), voxels.of_points([s.xyz[:, 2] for s in surfaces]))
    owner = np.full(len(voxels.point), -1, dtype=np.int32)
    top = np.full((len(owner), 2), np.nan)
    n_columns = len(voxels.columns) - 1
    run_ranges(column_top_range, n_columns, voxels.columns, voxels.starts, *points, voxels.is_open, n, owner, top)
    is_column = owner >= 0
    return _Columns(owner[is_column], Pair(*np.ascontiguousarray(top[is_column].T)))


def median_rise(voxels: Voxels, surfaces: Pair[Surface], n: int, least: int) -> FloatArray:
    """How far the tops of each object (n,) rise, m, in the median of the columns that both epochs have of it; NaN with
    fewer than ``least`` of these."""
    return _rise_of_columns(_column_tops(voxels, surfaces, n).rises, n, least)[0]


def _summit(owner: IntArray, top: FloatArray, n: int) -> FloatArray:
    """95th percentile (n,) m of the tops of each object's columns."""
    is_known = np.isfinite(top)
    return Groups(owner[is_known], n).quantile(top[is_known], 0.95)


def _rise_of_columns(rises: tuple[IntArray, FloatArray], n: int, least: int) -> tuple[FloatArray, FloatArray]:
    """Median change of the columns' tops (n,) m over the columns that both epochs have, and the distance (n,) m of the
    quartiles, wider where the median of few columns is less sure; NaN with fewer than ``least`` columns."""
    groups = Groups(rises[0], n)
    is_told = groups.counts >= least
    scatter = groups.quantile(rises[1], 0.75) - groups.quantile(rises[1], 0.25)
    scatter *= np.sqrt(np.fmax(_SURE_COLUMNS / np.maximum(groups.counts, 1), 1.0))
    return np.where(is_told, groups.median(rises[1]), np.nan), np.where(is_told, scatter, np.nan)


_LEAST_COLUMNS = 8

_SURE_COLUMNS = 25
"""Columns whose median is as sure as one asks for: the error of a median goes with the root of their number."""


def _fair_rises(voxels: Voxels, surfaces: Pair[Surface], n: int) -> tuple[IntArray, FloatArray]:
    """Columns that both epochs have: the object (b,) of each, and how far its top rises (b,) m between equals.

    The more points, the higher the highest of them: where an epoch has m points of the object in a column and the other
    k < m, its top is that of k points drawn from the m, which lies at rank (m + 1) / (k + 1) in the mean.
    """
    owner = voxels.of_points([side.owner for side in surfaces])
    kept = np.flatnonzero((owner >= 0) & voxels.is_open)
    slot = np.repeat(np.arange(2 * len(voxels)), np.diff(voxels.starts))[kept]
    column = np.repeat(np.arange(len(voxels.columns) - 1), np.diff(voxels.columns))[slot >> 1]
    z = voxels.of_points([side.xyz[:, 2] for side in surfaces])[kept]
    key = (column * n + owner[kept]) * 2 + (slot & 1)
    order = np.lexsort((-z, key))
    key, z = key[order], z[order]
    first = np.flatnonzero(np.diff(key, prepend=-1))
    count = np.diff(first, append=len(key))
    before = np.flatnonzero((key[first[:-1]] % 2 == 0) & (key[first[1:]] == key[first[:-1]] + 1))
    tops = []
    for own, other in ((before, before + 1), (before + 1, before)):
        rank = (count[own] + 1) / (np.minimum(count[own], count[other]) + 1) - 1.0
        low = np.minimum(rank.astype(np.int64), count[own] - 1)
        high = np.minimum(low + 1, count[own] - 1)
        tops.append(z[first[own] + low] + (rank - low) * (z[first[own] + high] - z[first[own] + low]))
    return ((key[first[before]] // 2) % max(n, 1)).astype(np.int32), tops[1] - tops[0]


def _is_above(z: FloatArray, owner: IntArray, top: FloatArray) -> BoolArray:
    """Whether each voxel (c,) lies above the given top of its owner; never where there is no owner or no top."""
    return np.asarray(z > np.append(top, np.nan)[owner])


def _rise(cells: Cells, n: int) -> FloatArray:
    """How far the mean height of occupancy moves up (n,) m in the columns that both epochs occupy (tie-break)."""
    columns, holder = cells.voxels.columns, np.column_stack(list(cells.owner))
    is_shared = np.zeros(holder.shape, np.bool_)
    run_ranges(shared_column_range, len(columns) - 1, columns, holder, n, is_shared)
    z = cells.voxels.centre[:, 2]
    shared = Pair(*is_shared.T)
    mean = cells.owner.join(shared, lambda side, is_in: Groups(np.where(is_in, side, -1), n).mean(z))
    return mean.after - mean.before
