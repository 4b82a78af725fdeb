"""The unit of change: what changed in a part of an object only becomes an object of its own (METHOD 2b)."""

from __future__ import annotations

from dataclasses import dataclass, replace
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

_LINK_VOXELS = 2.9
"""Changed voxels this far apart, in voxels, are one region: the rays of a vehicle leave stripes."""

_MOST_OF = 0.5
"""A region that takes more than this share of an object's columns is no part of it: the object itself changed."""


@dataclass(frozen=True)
class Parts:
    """Owners after parts were taken out of objects.

    Attributes
    ----------
    owner : Pair of (m,) int32
        Object of each point, -1 none; parts are numbered from the old number of objects on.
    parent : (n,) int32
        Object that each object is a part of, -1 none.
    """

    owner: Pair[IntArray]
    parent: IntArray


class _Region(NamedTuple):
    parent: int
    columns: Int64Array
    n_voxels: int


def split_parts(cells: Cells, surfaces: Pair[Surface], object_class: ByteArray, params: ChangeParams) -> Parts:
    """Take what changed out of long objects, and what did not out of objects that only one epoch has.

    A terrace is one object, but one of its houses may have a new storey: a connected region of gained, or of lost,
    voxels becomes a part, with all that stands in the columns under its outline. And where a new house was built
    against a shed, the two are one new object: the region that the other epoch shows too becomes a part.

    Objects shorter than ``part_of_length_m`` that both epochs have stay whole, unless they are bodies beside other
    bodies: where one house of a row ends is not certain. So does an object of which a region takes most columns.

    Plants grow together: where a piece of a plant, ``plant_width_m`` wide, stands on what the other survey saw bare, it
    is a plant of its own, and not a growth of its neighbour.
    """
    n = len(object_class)
    owner = surfaces.map(lambda surface: surface.owner)
    nobody = np.full(n, -1, dtype=np.int32)
    if n == 0 or len(cells.voxels) == 0:
        return Parts(owner, nobody)
    is_present = owner.map(lambda side: np.isin(np.arange(n), side))
    is_pair = is_present.before & is_present.after
    xyz = np.concatenate([surface.xyz for surface in surfaces])
    size = upright_boxes(xyz, np.concatenate(list(owner)), n).size
    is_whole = np.fmax(size[:, 0], size[:, 1]) <= params.part_of_length_m
    columns_of = _columns_of(cells, n)
    if params.fills_buildings:
        is_whole &= ~_are_in_rows(columns_of[0], n)
    is_long = is_pair & ~is_whole
    own = cells.owner
    is_plant = is_pair & (object_class == ObjectClass.VEGETATION) & (params.plant_width_m > 0)
    bare = cells.bare_columns
    whole_plant = replace(params, part_min_width_m=params.plant_width_m, part_min_voxels=1)
    is_long &= ~is_plant
    regions = [
        *_regions(cells, own.before, bare.after, is_plant, whole_plant),
        *_regions(cells, own.after, bare.before, is_plant, whole_plant),
        *_regions(cells, own.before, cells.is_lost, is_long, params),
        *_regions(cells, own.after, cells.is_gained, is_long, params),
        *_regions(cells, own.before, cells.is_near.after, ~is_pair, params),
        *_regions(cells, own.after, cells.is_near.before, ~is_pair, params),
    ]
    most_of = np.where(is_plant, 1.0, _MOST_OF)
    columns, part, parent = _claim(regions, columns_of, most_of, fills_hull=not params.fills_buildings)
    if len(parent) == 0:
        return Parts(owner, nobody)
    lattice = Lattice.around(columns)
    keys = lattice.keys(columns)
    order = np.argsort(keys)
    keys, part = keys[order], part[order]

    def taken(surface: Surface) -> IntArray:
        row = np.column_stack([surface.owner.astype(np.int64), cells_of(surface.xyz[:, :2], params.voxel_m)])
        found = lattice.find(keys, row)
        return np.where(found >= 0, n + part[np.maximum(found, 0)], surface.owner).astype(np.int32)

    return Parts(surfaces.map(taken), np.concatenate([nobody, parent]))


def largest_regions(cells: Cells, n: int, params: ChangeParams) -> Pair[FloatArray]:
    """Volume (n,) m3 of the largest solid region that each object lost (before) and gained (after); 0 where buildings
    are not filled, and surfaces have no inside."""
    if not params.fills_buildings:
        return Pair(np.zeros(n), np.zeros(n))
    everyone = np.ones(n, np.bool_)
    sides = Pair((cells.owner.before, cells.is_lost), (cells.owner.after, cells.is_gained))

    def largest(side: tuple[IntArray, BoolArray]) -> FloatArray:
        volume = np.zeros(n)
        for region in _regions(cells, *side, everyone, params):
            volume[region.parent] = max(volume[region.parent], region.n_voxels * params.voxel_m**3)
        return volume

    return sides.map(largest)


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


def _regions(
    cells: Cells, owner: IntArray, is_in: BoolArray, is_split: BoolArray, params: ChangeParams
) -> list[_Region]:
    """Connected regions of the marked voxels within one object."""
    members = np.flatnonzero(is_in & (owner >= 0) & is_split[np.maximum(owner, 0)])
    if len(members) == 0:
        return []
    # one tree for all objects: a fourth coordinate keeps them apart
    place = np.column_stack([cells.voxels.cell[members], owner[members].astype(np.int64) * 10])
    links = cKDTree(place).query_pairs(_LINK_VOXELS, output_type="ndarray")
    region = components(links, len(members))
    groups = Groups(region, int(region.max()) + 1)
    found = []
    for index in np.flatnonzero(groups.counts >= params.part_min_voxels).tolist():
        inside = members[groups.members(index)]
        plan = unique_rows(cells.voxels.cell[inside, :2])
        if params.part_min_width_m == 0 or width_of(plan) * params.voxel_m >= params.part_min_width_m:
            found.append(_Region(int(owner[inside[0]]), plan, len(inside)))
    return found


def width_of(columns: Int64Array) -> float:
    """Width of the columns (k, 2) in cells where they are widest, whichever way they lie; 1 for a line of cells."""
    low = columns.min(axis=0)
    plan = np.zeros(tuple(columns.max(axis=0) - low + 3), np.bool_)
    plan[tuple((columns - low + 1).T)] = True
    return float(2.0 * ndimage.distance_transform_edt(plan).max() - 1.0)


def _under(region: Int64Array, columns: Int64Array, *, fills_hull: bool) -> BoolArray:
    """Which columns (k, 2) lie under a region: inside its hull where rays leave gaps in it, else in or beside it."""
    if fills_hull:
        outline = shapely.convex_hull(shapely.MultiPoint(region + 0.5)).buffer(1.0)
        return np.asarray(shapely.contains_xy(outline, columns[:, 0] + 0.5, columns[:, 1] + 0.5))
    distance, _ = cKDTree(region).query(columns, distance_upper_bound=1.1)
    return np.asarray(np.isfinite(distance))


def _claim(
    regions: list[_Region], columns_of: tuple[Int64Array, Int64Array], most_of: FloatArray, *, fills_hull: bool
) -> tuple[Int64Array, Int64Array, IntArray]:
    """Columns (k, 3) that parts take, the part of each, and the parent of each part; the largest region comes first."""
    rows, start = columns_of
    part_of = np.full(len(rows), -1, dtype=np.int64)
    parents: list[int] = []
    for region in sorted(regions, key=lambda r: (-r.n_voxels, r.parent, r.columns[0].tolist())):
        first, last = start[region.parent], start[region.parent + 1]
        is_inside = _under(region.columns, rows[first:last, 1:], fills_hull=fills_hull)
        if np.count_nonzero(is_inside) > most_of[region.parent] * (last - first):
            continue
        is_free = is_inside & (part_of[first:last] < 0)
        if is_free.any():
            part_of[first:last][is_free] = len(parents)
            parents.append(region.parent)
    is_claimed = part_of >= 0
    return rows[is_claimed], part_of[is_claimed], np.array(parents, dtype=np.int32)
