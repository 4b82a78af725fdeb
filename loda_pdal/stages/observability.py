"""What a survey could have seen: occluded, uncovered and unchanged are three different things (METHOD 2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array
from loda_pdal.params import ObservabilityParams
from loda_pdal.stages.sight import Shown, Sight


@dataclass(frozen=True)
class Coverage:
    """Where one survey has returns, in plan, and the rays to them where its trajectory is known.

    A place counts as seen when the survey has returns in its column or beside it: the ground or the background that is
    measured there could not have been measured through an object. Rays know better where they come by: what they passed
    was seen, and what lies behind their returns was not. Where there are none (nothing returns from the sky above a
    place that was cleared) the column decides.

    Attributes
    ----------
    is_seen : (nx, ny) bool
        Cells with returns in them or in one of their eight neighbours.
    low : (2,) int64
        Index of cell (0, 0); cell ``i`` spans ``i * cell_m`` to ``(i + 1) * cell_m``.
    cell_m : float
        Edge of a cell, m.
    sight : Sight, optional
        The rays, in the frame of the cells.
    """

    is_seen: BoolArray
    low: Int64Array
    cell_m: float
    sight: Sight | None = None

    def shown(self, cell: Int64Array, voxel_m: float) -> Shown:
        """What the rays say about sorted voxels ``cell`` (c, 3) of a lattice of ``voxel_m``; nothing without rays."""
        if self.sight is None:
            return Shown(np.zeros(len(cell), np.bool_), np.zeros(len(cell), np.bool_))
        return self.sight.of(cell, voxel_m)

    def at(self, xyz: FloatArray) -> BoolArray:
        """Whether each point (k, 3) m lies in a column that the survey saw, (k,) bool."""
        i, j = (np.floor(xyz[:, axis] / self.cell_m).astype(np.int64) - self.low[axis] for axis in range(2))
        is_inside = (i >= 0) & (i < self.is_seen.shape[0]) & (j >= 0) & (j < self.is_seen.shape[1])
        seen = np.zeros(len(xyz), np.bool_)
        seen[is_inside] = self.is_seen[i[is_inside], j[is_inside]]
        return seen


def coverage(xyz: FloatArray, params: ObservabilityParams, sight: Sight | None = None) -> Coverage:
    """Coverage of one epoch's points (m, 3) m, ground included, with the rays to them."""
    if len(xyz) == 0:
        return Coverage(np.zeros((0, 0), np.bool_), np.zeros(2, np.int64), params.cell_m, sight)
    cell = np.floor(xyz[:, :2] / params.cell_m).astype(np.int64)
    low = cell.min(axis=0) - 1
    has_return = np.zeros(tuple(cell.max(axis=0) - low + 2), np.bool_)
    has_return[tuple((cell - low).T)] = True
    return Coverage(ndimage.binary_dilation(has_return, np.ones((3, 3))), low, params.cell_m, sight)
