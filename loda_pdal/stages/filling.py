"""What airborne surveys do not see: the space between a roof and the ground (METHOD 1.8, 1.13).

From the air a building is a roof that hangs in space. A storey more moves all of its points, and an annex hides as many
as it shows. So buildings are compared as bodies: each column under a roof is filled with points down to the ground.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array, IntArray
from loda_pdal.model.grid import Lattice, cells_of
from loda_pdal.model.labels import ObjectClass
from loda_pdal.params import ChangeParams
from loda_pdal.stages.cues import Surface
from loda_pdal.stages.instances import Instances


class Filling(NamedTuple):
    """Points put in: where, (k, 3) float64 m, and under which point of the cloud, (k,) int64."""

    xyz: FloatArray
    under: Int64Array


def fill_columns(xyz: FloatArray, height: FloatArray, owner: np.ndarray, is_roof: BoolArray, step_m: float) -> Filling:
    """Points every ``step_m`` (m) beneath the highest point of each column of each owner, down to the ground.

    A column without a point between two that have some is filled as high as the lower of them: rays leave gaps.

    Parameters
    ----------
    xyz : (m, 3) float64, m
    height : (m,) float64, m
        Above the ground; columns whose top has none are left alone.
    owner : (m,) int
        What the points belong to; columns of different owners are filled apart.
    is_roof : (m,) bool
        Which points count.
    step_m : float
        Edge of a column and distance of the points in it.
    """
    member = np.flatnonzero(is_roof & (owner >= 0) & np.isfinite(height))
    if len(member) == 0:
        return Filling(np.zeros((0, 3)), np.zeros(0, dtype=np.int64))
    rows = np.column_stack([owner[member].astype(np.int64), cells_of(xyz[member, :2], step_m)])
    lattice = Lattice.around(rows)
    key = lattice.keys(rows)
    order = np.lexsort((xyz[member, 2], key))
    is_top = np.append(key[order][1:] != key[order][:-1], True)
    top, column = member[order[is_top]], rows[order[is_top]]
    gap, beside = _gaps(lattice, column, xyz[top, 2])
    column, top = np.concatenate([column, gap]), np.concatenate([top, top[beside]])
    first_level = np.concatenate([np.ones(len(top) - len(gap), np.int64), np.zeros(len(gap), np.int64)])
    n_below = np.maximum(np.floor(height[top] / step_m).astype(np.int64) + 1 - first_level, 0)
    under = np.repeat(np.arange(len(top)), n_below)
    start = np.concatenate([[0], np.cumsum(n_below)[:-1]])
    level = np.arange(len(under)) - np.repeat(start, n_below) + first_level[under]
    centre = (column[under, 1:] + 0.5) * step_m
    return Filling(np.column_stack([centre, xyz[top[under], 2] - level * step_m]), top[under])


def _gaps(lattice: Lattice, column: Int64Array, z: FloatArray) -> tuple[Int64Array, Int64Array]:
    """Columns (k, 3) without a point between two of the sorted columns (c, 3), and the lower of the two (k,)."""
    key = lattice.keys(column)
    gaps, lower = [], []
    for step in ((0, 1, 0), (0, 0, 1), (0, 1, 1), (0, 1, -1)):
        between = column + np.array(step)
        far = lattice.find(key, between + np.array(step))
        near = np.flatnonzero((far >= 0) & (lattice.find(key, between) < 0))
        gaps.append(between[near])
        lower.append(np.where(z[near] <= z[far[near]], near, far[near]))
    gap, host = np.concatenate(gaps), np.concatenate(lower)
    order = np.lexsort((host, z[host], lattice.keys(gap)))
    is_lowest = np.diff(lattice.keys(gap)[order], prepend=-1) != 0
    return gap[order[is_lowest]], host[order[is_lowest]]


def bodies(
    xyz: FloatArray, height: FloatArray, instances: Instances, params: ChangeParams
) -> tuple[FloatArray, IntArray]:
    """Points (k, 3) m that say what space the instances take, and the instance (k,) of each.

    Those of the instances, and with ``fills_buildings`` what lies under buildings and other objects: which of the two a
    shed is may differ between the epochs.
    """
    member = np.flatnonzero(instances.instance > 0)
    points, instance = xyz[member], instances.instance[member]
    if not params.fills_buildings:
        return points, instance
    is_body = np.isin(instances.classification, (ObjectClass.BUILDING, ObjectClass.OTHER))
    filling = fill_columns(xyz, height, instances.instance - 1, is_body, params.voxel_m)
    return np.concatenate([points, filling.xyz]), np.concatenate([instance, instances.instance[filling.under]])


def filled(surface: Surface, is_body: BoolArray, step_m: float) -> Surface:
    """The surface with points under those of its points that are bodies, behind its own; they have no raw points."""
    filling = fill_columns(surface.xyz, surface.height, surface.owner, is_body, step_m)
    return _with_filling(surface, filling, surface.owner[filling.under])


def filled_everywhere(surface: Surface, step_m: float) -> Surface:
    """The surface with points under all of it, by object, and under all that belongs to none.

    What one survey shows as a house may be scattered fragments in the other: a house is gone only where nothing stands
    as high.
    """
    group = np.where(surface.owner >= 0, surface.owner, surface.owner.max(initial=-1) + 1)
    filling = fill_columns(surface.xyz, surface.height, group, surface.is_surface, step_m)
    return _with_filling(surface, filling, surface.owner[filling.under])


def _with_filling(surface: Surface, filling: Filling, owner: IntArray) -> Surface:
    n = len(filling.under)
    return Surface(
        xyz=np.concatenate([surface.xyz, filling.xyz]),
        normals=np.concatenate([surface.normals, np.zeros((n, 3), dtype=np.float32)]),
        height=np.concatenate([surface.height, np.full(n, np.nan)]),
        n_raw=np.concatenate([surface.n_raw, np.zeros(n, dtype=surface.n_raw.dtype)]),
        owner=np.concatenate([surface.owner, owner]),
        is_surface=np.concatenate([surface.is_surface, np.ones(n, np.bool_)]),
    )
