"""The unit of change: what changed in a part of an object only becomes an object of its own (METHOD 2b)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from scipy import ndimage
from scipy.spatial import cKDTree

from loda_pdal.kernels.clusters import components
from loda_pdal.model.boxes import upright_boxes
from loda_pdal.model.cloud import BoolArray, ByteArray, FloatArray, Int64Array, IntArray
from loda_pdal.model.grid import Lattice, cells_of
from loda_pdal.model.groups import Groups, unique_rows
from loda_pdal.model.labels import ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.params import ChangeParams
from loda_pdal.stages.cues import Cells, Surface
from loda_pdal.stages.houses import house_about, house_behind
from loda_pdal.stages.rules import LOW_M

_LINK_VOXELS = 2.9
"""Changed voxels this far apart, in voxels, are one region: the rays of a vehicle leave stripes."""

_MOST_OF = 0.5
"""A region that takes more than this share of an object's columns is no part of it: the object itself changed."""

_LEAST_ANNEX_M = 1.0
"""What is built onto a house is longer: a drainpipe, or the stem of a tree that leans over the roof, is no annex."""

_TALL = 2.0
"""No annex is this many times as tall as it is long: that is a piece of a house that came or went."""

_WIDE = 0.6
"""Storeys wider than this many frontages are those of a house of their own, and so is what is as wide either way."""

_MOST_OF_ROW = 0.75
"""The same for a row of houses: two of three may have a new storey."""


@dataclass(frozen=True)
class Parts:
    """Owners after parts were taken out of objects.

    Attributes
    ----------
    owner : Pair of (m,) int32
        Object of each point, -1 none; parts are numbered from the old number of objects on.
    parent : (n,) int32
        Object that each object is a part of, -1 none.
    is_house : (n,) bool
        Houses that are the unit of change: what is built onto them changes them.
    is_extension : (n,) bool
        Parts that are built onto a house; a storey that is as wide as a house is a change of that house alone.
    """

    owner: Pair[IntArray]
    parent: IntArray
    is_house: BoolArray
    is_extension: BoolArray


class Region(NamedTuple):
    """Connected voxels of one object: their columns (k, 2), the voxels (m,), the share of the columns in which the
    other epoch has nothing of the object, and how high (m) half of the columns reach."""

    parent: int
    columns: Int64Array
    voxels: Int64Array
    share_new: float
    top_m: float

    @property
    def n_voxels(self) -> int:
        return len(self.voxels)


def split_parts(cells: Cells, surfaces: Pair[Surface], object_class: ByteArray, params: ChangeParams) -> Parts:
    """Take what changed out of long objects and houses, and what did not out of objects that only one epoch has.

    A terrace is one object, but one of its houses may have a new storey: a connected region of gained, or of lost,
    voxels becomes a part, with all that stands in the columns under its outline. And where a new house was built
    against a shed, the two are one new object: the region that the other epoch shows too becomes a part.

    Other objects shorter than ``part_of_length_m`` that both epochs have stay whole, and so does an object of which a
    region takes most columns, unless that is a new house, or leaves as much of a body as a house has.

    A building up to that length is one house, or two of which one came or went. What changed of a longer one is part
    of a house in a row: ``frontage_m`` of the row about it are taken out too, as the house that it is a part of.
    Bodies beside other bodies are looked through whatever their length, and what was built onto one or taken from it
    has the house behind it taken out, wherever a row of them was cut: see `house_behind`.

    Plants grow together: where a piece of a plant, ``plant_width_m`` wide, stands on what the other survey saw bare, it
    is a plant of its own, and not a growth of its neighbour. Low ones that show are things: see `split_things`.
    """
    n = len(object_class)
    owner = surfaces.map(lambda surface: surface.owner)
    nobody, nothing = np.full(n, -1, dtype=np.int32), np.zeros(n, np.bool_)
    if n == 0 or len(cells.voxels) == 0:
        return Parts(owner, nobody, nothing, nothing)
    is_present = owner.map(lambda side: np.isin(np.arange(n), side))
    is_pair = is_present.before & is_present.after
    xyz = np.concatenate([surface.xyz for surface in surfaces])
    box = upright_boxes(xyz, np.concatenate(list(owner)), n).size
    is_long = np.fmax(box[:, 0], box[:, 1]) > params.part_of_length_m
    columns_of = _columns_of(cells, n)
    has_houses = (object_class == ObjectClass.BUILDING) & (params.frontage_m > 0)
    is_split = is_long | (_are_in_rows(columns_of[0], n) if params.fills_buildings else has_houses)
    is_plant = is_pair & (object_class == ObjectClass.VEGETATION) & (params.plant_width_m > 0)
    if params.thing_voxels > 0:  # which looks for what is lower
        is_plant &= np.fmax(*(Groups(side.owner, n).quantile(side.height, 0.95) for side in surfaces)) >= LOW_M
    is_split &= is_pair & ~is_plant
    is_alone = ~is_pair & (object_class != ObjectClass.MOBILE)  # vehicles stand beside others, and are one body each
    own, clear = cells.owner, cells.voxels.is_clear
    size = params.part_min_voxels, params.part_min_width_m / params.voxel_m
    plant = 1, params.plant_width_m / params.voxel_m
    bare = cells.bare_columns
    regions = [
        *_changed_regions(cells, own, cells.is_lost, bare.after, clear.after, is_split, params),
        *_changed_regions(cells, own.swapped, cells.is_gained, bare.before, clear.before, is_split, params),
        *connected_regions(cells, own, cells.is_near.after, is_alone, *size),
        *connected_regions(cells, own.swapped, cells.is_near.before, is_alone, *size),
    ]
    if is_plant.any():
        plants = connected_regions(cells, own, bare.after, is_plant, *plant)
        plants += connected_regions(cells, own.swapped, bare.before, is_plant, *plant)
        regions += [region for region in plants if region.share_new > 0.5]  # not a crown that rose
    if params.needs_sight and not params.fills_buildings:
        raised = raised_regions(cells, has_houses & is_split)
        regions += [region for side in raised for region in side if region.n_voxels < params.part_min_voxels]
    is_of_bodies = params.fills_buildings and bool(has_houses.any())
    roofs = surfaces.map(lambda side: _roof(side, columns_of[0], params.voxel_m)) if is_of_bodies else None
    columns, part, parent, is_house, is_extension = _claim(
        regions, columns_of, has_houses & is_pair, is_long, is_plant, roofs, params
    )
    if len(parent) == 0:
        return Parts(owner, nobody, nothing, nothing)
    lattice = Lattice.around(columns)
    keys = lattice.keys(columns)
    order = np.argsort(keys)
    keys, part = keys[order], part[order]

    def taken(surface: Surface) -> IntArray:
        row = np.column_stack([surface.owner.astype(np.int64), cells_of(surface.xyz[:, :2], params.voxel_m)])
        found = lattice.find(keys, row)
        return np.where(found >= 0, n + part[np.maximum(found, 0)], surface.owner).astype(np.int32)

    is_house = np.concatenate([has_houses & is_pair & ~is_long, is_house])
    is_extension = np.concatenate([nothing, is_extension])
    parent = np.where(parent < 0, n - 1 - parent, parent)  # a part of another part
    return Parts(surfaces.map(taken), np.concatenate([nobody, parent]).astype(np.int32), is_house, is_extension)


def _changed_regions(
    cells: Cells,
    owner: Pair[IntArray],
    is_in: BoolArray,
    is_bare: BoolArray,
    is_clear: BoolArray,
    is_split: BoolArray,
    params: ChangeParams,
) -> list[Region]:
    """Regions of gained, or of lost, voxels ``is_in`` (c,) of the objects ``is_split`` (n,); of bodies, a house that
    came or went apart from the storey of the house beside it.

    ``owner``, ``is_bare`` and ``is_clear`` (c,) as in `connected_regions` and `Cells.bare_columns`, of this epoch and
    of the other.
    """
    size = params.part_min_voxels, params.part_min_width_m / params.voxel_m
    regions = connected_regions(cells, owner, is_in, is_split, *size, is_clear=is_clear)
    if not params.fills_buildings or not regions:
        return regions
    house = int(np.ceil(params.part_is_new_m3 / params.voxel_m**3)), size[1]
    houses = connected_regions(cells, owner, is_in & is_bare, is_split, *house)
    rest = is_in.copy()
    for region in houses:
        rest[region.voxels] = False
    storeys = [r for r in connected_regions(cells, owner, rest, is_split, *size) if _has_house(r.columns, params)]
    number = np.full(len(is_in), -1)
    for i, region in enumerate(regions):
        number[region.voxels] = i
    is_both = set(number[[r.voxels[0] for r in houses]]) & set(number[[r.voxels[0] for r in storeys]])
    pieces = [r for r in houses + storeys if number[r.voxels[0]] in is_both]
    return [r for i, r in enumerate(regions) if i not in is_both] + pieces


def largest_regions(cells: Cells, n: int, params: ChangeParams) -> Pair[FloatArray]:
    """Volume (n,) m3 of the largest region that each object lost (before) and gained (after): solid ones of buildings
    that are filled; else surfaces have no inside, and only what stood on them counts, see `raised_regions`."""
    everyone, width = np.ones(n, np.bool_), params.part_min_width_m / params.voxel_m
    least, own, clear = params.part_min_voxels, cells.owner, cells.voxels.is_clear
    regions: Pair[list[Region]] = Pair([], [])
    if params.fills_buildings:
        regions = Pair(
            connected_regions(cells, own, cells.is_lost, everyone, least, width, is_clear=clear.after),
            connected_regions(cells, own.swapped, cells.is_gained, everyone, least, width, is_clear=clear.before),
        )
    elif params.needs_sight:
        regions = raised_regions(cells, everyone)

    def largest(found: list[Region]) -> FloatArray:
        volume = np.zeros(n)
        for region in found:
            volume[region.parent] = max(volume[region.parent], region.n_voxels * params.voxel_m**3)
        return volume

    return regions.map(largest)


def raised_regions(cells: Cells, is_asked: BoolArray) -> Pair[list[Region]]:
    """Pieces that came off and on to what the other epoch shows beneath them of the same object ``is_asked`` (n,).

    A dormer is small beside its house. But the edges of roofs and walls that come and go with the sampling are one
    column wide, and what is seen through a window stands on nothing that is seen.
    """
    own = cells.owner

    def raised(owner: Pair[IntArray], is_in: BoolArray) -> list[Region]:
        return [
            region
            for region in connected_regions(cells, owner, is_in, is_asked, _LEAST_RAISED)
            if region.share_new <= _OVERHANG
            and len(region.columns) >= _LEAST_RAISED
            and _least_side(region.columns) > 1.0
        ]

    return Pair(raised(own, cells.is_lost), raised(own.swapped, cells.is_gained))


_LEAST_RAISED = 5
"""Columns of a piece that stands on something."""

_OVERHANG = 0.2
"""Share of its columns that may stand out beyond what it stands on."""


def dissolve(owner: Pair[IntArray], is_dissolved: BoolArray, n: int) -> tuple[Pair[IntArray], IntArray]:
    """Give the after side of matched pairs that are no pair an object number of its own.

    Returns the new owners and, for each object from ``n`` on, the object it was paired with.
    """
    partner = np.flatnonzero(is_dissolved).astype(np.int32)
    number = np.arange(n, dtype=np.int32)
    number[partner] = n + np.arange(len(partner), dtype=np.int32)
    after = np.where(owner.after >= 0, number[np.maximum(owner.after, 0)], -1).astype(np.int32)
    return Pair(owner.before, after), partner


def _columns_of(cells: Cells, n: int) -> tuple[Int64Array, Int64Array]:
    """All columns (k, 3) of all objects as rows (object, ix, iy), sorted, and where each object's begin (n + 1,)."""
    owned = [np.column_stack([side, cells.voxels.cell[:, :2]])[side >= 0] for side in cells.owner]
    rows = unique_rows(np.concatenate(owned).astype(np.int64))
    return rows, np.searchsorted(rows[:, 0], np.arange(n + 1))


def _roof(surface: Surface, columns: Int64Array, cell_m: float) -> FloatArray:
    """Highest point (k, 3) m that was measured in each of the sorted ``columns`` (k, 3), NaN where none was."""
    lattice = Lattice.around(columns)
    own = np.flatnonzero((surface.owner >= 0) & (surface.n_raw > 0))
    own = own[np.lexsort(surface.xyz[own].T)]
    cell = np.column_stack([surface.owner[own].astype(np.int64), cells_of(surface.xyz[own, :2], cell_m)])
    found = lattice.find(lattice.keys(columns), cell)
    highest = np.full((len(columns), 3), np.nan)
    highest[found[found >= 0]] = surface.xyz[own[found >= 0]]
    return highest


def _are_in_rows(columns: Int64Array, n: int) -> BoolArray:
    """Whether each object (n,) has columns beside those of another; ``columns`` (k, 3) are (object, ix, iy)."""
    plan = columns[:, 1:]
    lattice = Lattice.around(plan)
    keys, place = np.unique(lattice.keys(plan), return_inverse=True)
    owner = columns[:, 0]
    low, high = np.full(len(keys), n), np.full(len(keys), -1)
    np.minimum.at(low, place.ravel(), owner)
    np.maximum.at(high, place.ravel(), owner)
    contacts = np.zeros(n, dtype=np.int64)
    for step in np.ndindex(3, 3):
        found = lattice.find(keys, plan + (np.array(step) - 1))
        is_foreign = (found >= 0) & ((low[found] != owner) | (high[found] != owner))
        contacts += np.bincount(owner[is_foreign], minlength=n)
    return np.asarray(contacts >= _ROW_CONTACTS)


_ROW_CONTACTS = 8
"""Contacts between columns that make two bodies neighbours: more than a corner."""


def connected_regions(
    cells: Cells,
    owner: Pair[IntArray],
    is_in: BoolArray,
    is_split: BoolArray,
    least: int,
    width: float = 0.0,
    is_clear: BoolArray | None = None,
) -> list[Region]:
    """Connected regions of at least ``least`` of the marked voxels (c,) within one of the objects ``is_split`` (n,), at
    least ``width`` voxels wide in plan, or low roofs where the other epoch shows the ground, ``is_clear`` (c,).

    ``owner`` (c,) of this epoch and of the other.
    """
    members = np.flatnonzero(is_in & (owner.before >= 0) & is_split[np.maximum(owner.before, 0)])
    if len(members) == 0:
        return []
    # one tree for all objects: a fourth coordinate keeps them apart
    own = owner.before[members]
    place = np.column_stack([cells.voxels.cell[members], own.astype(np.int64) * 10])
    links = cKDTree(place).query_pairs(_LINK_VOXELS, output_type="ndarray")
    region = components(links, len(members))
    groups = Groups(region, int(region.max()) + 1)
    is_shared = in_column_of(cells, own, members, owner.after)
    found = []
    for index in np.flatnonzero(groups.counts >= least).tolist():
        inside = groups.members(index)
        plan, first, last = ends_of_columns(cells.voxels.cell[members[inside]])
        tops = members[inside][last]
        is_narrow = width > 0 and width_of(plan) < width
        if is_narrow and (is_clear is None or not _is_low_roof(cells.voxels.cell, owner.before, tops, is_clear)):
            continue
        top_m = float(np.median(cells.voxels.centre[tops, 2]))
        share_new = 1.0 - float(is_shared[inside[first]].mean())
        found.append(Region(int(own[inside[0]]), plan, members[inside], share_new, top_m))
    return found


def _is_low_roof(cell: Int64Array, owner: IntArray, tops: Int64Array, is_clear: BoolArray) -> bool:
    """Whether the highest voxels ``tops`` (k,) of a region are a level roof on what was ground, beside something higher
    of the same object.

    Edges of roofs come and go with the sampling too, but as high as the roof, and walls beneath them are met anywhere.
    """
    level = cell[tops, 2]
    roof = np.median(level)
    if len(tops) < _LEAST_ROOF or np.mean(is_clear[tops]) < _CLEAR or np.mean(np.abs(level - roof) <= 1) < _MOST:
        return False
    low, high = cell[tops, :2].min(axis=0) - 2, cell[tops, :2].max(axis=0) + 2
    first, last = np.searchsorted(cell[:, 0], [low[0], high[0] + 1])
    about = cell[first:last]
    is_house = (owner[first:last] == owner[tops[0]]) & (about[:, 1] >= low[1]) & (about[:, 1] <= high[1])
    return bool(np.any(is_house & (about[:, 2] > roof + _HIGHER)))


_LEAST_ROOF = 8
"""Columns of a roof that is narrower than parts are."""

_MOST = 2.0 / 3.0
"""Share of them that must be level."""

_CLEAR = 1.0 / 3.0
"""Share of them that must stand on what was seen to be ground: beside a wall little of it is seen."""

_HIGHER = 2
"""Voxels by which the house rises above what is built onto it."""


def ends_of_columns(cell: Int64Array) -> tuple[Int64Array, Int64Array, Int64Array]:
    """Columns (k, 2) of the sorted voxels ``cell`` (m, 3), and the lowest and the highest voxel of each (k,)."""
    plan, first = np.unique(cell[:, :2], axis=0, return_index=True)
    return plan, first, np.append(first[1:], len(cell)) - 1


def in_column_of(cells: Cells, owner: IntArray, voxel: Int64Array, other: IntArray) -> BoolArray:
    """Whether each ``owner`` (k,) has a voxel among the ``other`` (c,) owners in the column of its ``voxel`` (k,)."""
    column = np.repeat(np.arange(len(cells.voxels.columns) - 1), np.diff(cells.voxels.columns))
    n = int(max(owner.max(initial=-1), other.max(initial=-1))) + 1
    is_held = other >= 0
    return np.isin(column[voxel] * n + owner, np.unique(column[is_held] * n + other[is_held]))


def width_of(columns: Int64Array) -> float:
    """Width of the columns (k, 2) in cells where they are widest, whichever way they lie; 1 for a line of cells."""
    low = columns.min(axis=0)
    plan = np.zeros(tuple(columns.max(axis=0) - low + 3), np.bool_)
    plan[tuple((columns - low + 1).T)] = True
    return float(2.0 * ndimage.distance_transform_edt(plan).max() - 1.0)


def _least_side(columns: Int64Array) -> float:
    """The shorter side of the smallest rectangle about the columns (k, 2), in cells."""
    plan = np.column_stack([columns, np.zeros(len(columns))]).astype(np.float64)
    return float(upright_boxes(plan, np.zeros(len(plan), np.int32), 1).size[0, 1])


def _under(region: Int64Array, columns: Int64Array, *, fills_hull: bool) -> BoolArray:
    """Which columns (k, 2) lie under a region: inside its hull where rays leave gaps in it, else in or beside it."""
    if fills_hull:
        outline = shapely.convex_hull(shapely.MultiPoint(region + 0.5)).buffer(1.0)
        return np.asarray(shapely.contains_xy(outline, columns[:, 0] + 0.5, columns[:, 1] + 0.5))
    distance, _ = cKDTree(region).query(columns, distance_upper_bound=1.1)
    return np.asarray(np.isfinite(distance))


def _has_house(columns: Int64Array, params: ChangeParams) -> bool:
    """Whether a connected piece of the columns (k, 2) is as large as the least house, and as wide."""
    least = (_WIDE * params.frontage_m / params.voxel_m) ** 2
    if len(columns) < least:
        return False
    label = components(cKDTree(columns).query_pairs(1.5, output_type="ndarray"), len(columns))
    pieces = Groups(label, int(label.max()) + 1)
    return any(
        width_of(columns[pieces.members(i)]) * params.voxel_m >= _WIDE * params.frontage_m
        for i in np.flatnonzero(pieces.counts >= least).tolist()
    )


def _claim(
    regions: list[Region],
    columns_of: tuple[Int64Array, Int64Array],
    has_houses: BoolArray,
    is_long: BoolArray,
    is_plant: BoolArray,
    roofs: Pair[FloatArray] | None,
    params: ChangeParams,
) -> tuple[Int64Array, Int64Array, IntArray, BoolArray, BoolArray]:
    """Columns (k, 3) that parts take, the part of each, and for each part its parent, whether it is a house, and
    whether it is built onto one. ``roofs`` (k, 3) m: the highest point of each column, where buildings are bodies.

    The largest region comes first. The parent of a part in a house that is a part itself, number p, is ``-1 - p``.
    """
    rows, start = columns_of
    part_of = np.full(len(rows), -1, dtype=np.int64)
    parents: list[int] = []
    is_extension: list[bool] = []
    in_rows: list[tuple[int, Region]] = []
    for region in sorted(regions, key=lambda r: (-r.n_voxels, r.parent, r.columns[0].tolist())):
        first, last = start[region.parent], start[region.parent + 1]
        is_inside = _under(region.columns, rows[first:last, 1:], fills_hull=not params.fills_buildings)
        is_in_row = has_houses[region.parent] and is_long[region.parent]
        is_new = bool(has_houses[region.parent]) and region.share_new > 0.5
        is_new = is_new and region.n_voxels * params.voxel_m**3 > params.part_is_new_m3
        is_wide = roofs is None and _least_side(region.columns) * params.voxel_m > _WIDE * params.frontage_m
        is_new = is_new and (is_wide if roofs is None else is_in_row)
        most_of = 1.0 if is_new or is_plant[region.parent] else _MOST_OF_ROW if is_in_row else _MOST_OF
        if np.count_nonzero(is_inside) > most_of * (last - first):
            rest = rows[first:last, 1:][~is_inside & (part_of[first:last] < 0)]
            if roofs is None or not has_houses[region.parent] or not _has_house(rest, params):
                continue
        is_free = is_inside & (part_of[first:last] < 0)
        width_m = float((np.ptp(region.columns, axis=0) + 1).max()) * params.voxel_m
        if has_houses[region.parent] and roofs is None and width_m <= _LEAST_ANNEX_M:
            continue
        if is_free.any():
            is_storey = region.share_new < 0.5 and width_m > _WIDE * params.frontage_m
            is_onto = bool(has_houses[region.parent]) and width_m > _LEAST_ANNEX_M and not is_new and not is_storey
            is_extension.append(is_onto and roofs is None)  # of a body it is known once its house is found
            is_tall = region.n_voxels * params.voxel_m > _TALL * len(region.columns) * width_m
            if is_onto and (is_in_row if roofs is None else region.share_new > 0.5 and not is_tall):
                in_rows.append((len(parents), region))
            part_of[first:last][is_free] = len(parents)
            parents.append(region.parent)
    is_house = [False] * len(parents)
    for part, region in in_rows:
        if roofs is None:
            free = np.arange(start[region.parent], start[region.parent + 1])
            free = free[house_about(region.columns, rows[free, 1:], params) & (part_of[free] < 0)]
        else:
            free = np.flatnonzero((part_of < 0) & has_houses[rows[:, 0]])
            free = free[
                house_behind(
                    region.columns, region.top_m, rows[free, 1:], Pair(roofs.before[free], roofs.after[free]), params
                )
            ]
        if len(free):
            is_extension[part] = True
            parents[part] = -1 - len(parents)
            part_of[free] = len(parents)
            parents.append(int(np.bincount(rows[free, 0]).argmax()))
            is_house.append(True)
            is_extension.append(False)
    is_claimed = part_of >= 0
    return (
        rows[is_claimed],
        part_of[is_claimed],
        np.array(parents, dtype=np.int32),
        np.array(is_house, dtype=np.bool_),
        np.array(is_extension, dtype=np.bool_),
    )
