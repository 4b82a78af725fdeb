"""What airborne surveys do not see: the space between a roof and the ground (METHOD 1.8, 1.13).

From the air a building is a roof that hangs in space. A storey more moves all of its points, and an annex hides as many
as it shows. So buildings are compared as bodies: each column under a roof is filled with points down to the ground.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array
from loda_pdal.model.grid import Lattice, cells_of


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
