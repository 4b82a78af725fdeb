"""The unit of change: a change confined to a part of a long object becomes an object of its own (METHOD 2b)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from loda_pdal.model.boxes import upright_boxes
from loda_pdal.model.cloud import BoolArray, Int64Array, IntArray
from loda_pdal.model.grid import Lattice, cells_of
from loda_pdal.model.groups import unique_rows
from loda_pdal.model.pair import Pair
from loda_pdal.params import ChangeParams
from loda_pdal.stages.cues import Cells, Surface

_HALF_NEIGHBOURS = np.array([d for d in np.ndindex(3, 3, 3) if d > (1, 1, 1)], dtype=np.int64) - 1


@dataclass(frozen=True)
class Parts:
    """Owners after parts were taken out of long objects.

    Attributes
    ----------
    owner : Pair of (m,) int32
        Object of each point, -1 none; parts are numbered from the old number of objects on.
    parent : (n,) int32
        Object that each object is a part of, -1 none.
    """

    owner: Pair[IntArray]
    parent: IntArray


def split_parts(cells: Cells, surfaces: Pair[Surface], n: int, params: ChangeParams) -> Parts:
    """Take connected gained or lost regions, with all that stands in their columns, out of objects they do not fill.

    A region is connected (26 neighbours) among the gained, or among the lost, voxels of one object; its columns go to
    the largest region that claims them. Objects shorter than ``part_of_length_m``, and objects of which a region would
    take more than half the columns, stay whole.
    """
    owner = surfaces.map(lambda surface: surface.owner)
    whole = Parts(owner, np.full(n, -1, dtype=np.int32))
    if n == 0 or len(cells.cell) == 0:
        return whole
    xyz = np.concatenate([surface.xyz for surface in surfaces])
    size = upright_boxes(xyz, np.concatenate(list(owner)), n).size
    in_both = np.isin(np.arange(n), owner.before) & np.isin(np.arange(n), owner.after)
    is_long = in_both & (np.maximum(size[:, 0], size[:, 1]) > params.part_of_length_m)
    columns = _claimed_columns(cells, is_long, params.part_min_voxels)
    if not columns:
        return whole
    rows = np.array([(parent, ix, iy) for parent, ix, iy in columns], dtype=np.int64)
    part = np.array(list(columns.values()), dtype=np.int64)
    lattice = Lattice.around(rows)
    keys = lattice.keys(rows)
    order = np.argsort(keys)
    keys, part = keys[order], part[order]

    def taken(surface: Surface) -> IntArray:
        row = np.column_stack([surface.owner.astype(np.int64), cells_of(surface.xyz[:, :2], params.voxel_m)])
        found = lattice.find(keys, row)
        return np.where(found >= 0, n + part[np.maximum(found, 0)], surface.owner).astype(np.int32)

    parent = np.full(int(part.max()) + 1, -1, dtype=np.int32)
    parent[list(columns.values())] = [key[0] for key in columns]
    return Parts(surfaces.map(taken), np.concatenate([whole.parent, parent]))


def _claimed_columns(cells: Cells, is_long: BoolArray, min_voxels: int) -> dict[tuple[int, int, int], int]:
    """Part number of each claimed column ``(object, ix, iy)``."""
    regions: list[tuple[int, int, Int64Array]] = []
    for owner, is_changed in ((cells.owner.before, cells.is_lost), (cells.owner.after, cells.is_gained)):
        members = np.flatnonzero(is_changed & is_long[np.maximum(owner, 0)] & (owner >= 0))
        if len(members) == 0:
            continue
        region = _connected(cells.cell[members], owner[members])
        for index in range(int(region.max()) + 1):
            inside = members[region == index]
            if len(inside) >= min_voxels:
                regions.append((int(owner[inside[0]]), len(inside), np.unique(cells.cell[inside, :2], axis=0)))
    regions.sort(key=lambda item: (-item[1], item[0], item[2][0].tolist()))
    owned = [np.column_stack([side, cells.cell[:, :2]])[side >= 0] for side in cells.owner]
    n_columns = np.bincount(unique_rows(np.concatenate(owned))[:, 0], minlength=len(is_long))
    claimed: dict[tuple[int, int, int], int] = {}
    n_parts = 0
    for parent, _, plan in regions:
        free = [(parent, x, y) for x, y in plan.tolist() if (parent, x, y) not in claimed]
        if not free or len(plan) > 0.5 * n_columns[parent]:
            continue
        claimed.update(dict.fromkeys(free, n_parts))
        n_parts += 1
    return claimed


def _connected(cell: Int64Array, owner: IntArray) -> IntArray:
    """26-connected components (k,) of voxels of one owner."""
    lattice = Lattice.around(cell)
    keys = lattice.keys(cell)
    edges = []
    for step in _HALF_NEIGHBOURS:
        found = lattice.find(keys, cell + step)
        source = np.flatnonzero(found >= 0)
        target = found[source]
        is_same = owner[source] == owner[target]
        edges.append(np.column_stack([source[is_same], target[is_same]]))
    pairs = np.concatenate(edges)
    graph = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(cell),) * 2)
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int32)


def dissolve(owner: Pair[IntArray], is_dissolved: BoolArray, n: int) -> tuple[Pair[IntArray], IntArray]:
    """Give the after side of matched pairs that are no pair an object number of its own.

    Returns the new owners and, for each object from ``n`` on, the object it was paired with.
    """
    partner = np.flatnonzero(is_dissolved).astype(np.int32)
    number = np.arange(n, dtype=np.int32)
    number[partner] = n + np.arange(len(partner), dtype=np.int32)
    after = np.where(owner.after >= 0, number[np.maximum(owner.after, 0)], -1).astype(np.int32)
    return Pair(owner.before, after), partner
