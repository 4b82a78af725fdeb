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
    key = Lattice.around(rows).keys(rows)
    order = np.lexsort((xyz[member, 2], key))
    is_top = np.append(key[order][1:] != key[order][:-1], True)
    top = member[order[is_top]]
    n_below = np.maximum(np.floor(height[top] / step_m), 0).astype(np.int64)
    under = np.repeat(top, n_below)
    first = np.concatenate([[0], np.cumsum(n_below)[:-1]])
    level = 1 + np.arange(len(under)) - np.repeat(first, n_below)
    centre = (cells_of(xyz[under, :2], step_m) + 0.5) * step_m
    return Filling(np.column_stack([centre, xyz[under, 2] - level * step_m]), under)


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
    n = len(filling.under)
    return Surface(
        xyz=np.concatenate([surface.xyz, filling.xyz]),
        normals=np.concatenate([surface.normals, np.zeros((n, 3), dtype=np.float32)]),
        height=np.concatenate([surface.height, np.full(n, np.nan)]),
        n_raw=np.concatenate([surface.n_raw, np.zeros(n, dtype=surface.n_raw.dtype)]),
        owner=np.concatenate([surface.owner, surface.owner[filling.under]]),
        is_surface=np.concatenate([surface.is_surface, np.ones(n, np.bool_)]),
    )
