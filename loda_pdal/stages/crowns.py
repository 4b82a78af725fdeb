"""Crowns that touch: which of them each place belongs to, told from the canopies of both surveys.

Where two crowns part is a matter of a few leaves, and a tree that outgrows its neighbour swallows its peak. Told from
each survey alone, there are two trees in one of them and one in the other, and what one tree gained would be what both
did. So the survey that tells them apart is right for both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from loda_pdal.kernels.parallel import run_ranges
from loda_pdal.kernels.rasters import highest_range
from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array, IntArray
from loda_pdal.model.groups import Groups, consecutive
from loda_pdal.model.pair import Pair

_CELL_M = 0.5
"""Cells of the canopy."""

_CLOSE_M = 1.5
"""Maxima of the canopy this close to a higher place are of its crown."""

_CROWN_HEIGHT_M = 3.0
"""Lower vegetation has no crowns to split: a hedge is one object."""

_MOST = 0.5
"""More than this share of the cells of a crown lies in the crown of the other survey that holds it."""


@dataclass(frozen=True)
class Crowns:
    """The crown of every place of one survey: the height maximum of the canopy that lies uphill of it.

    Attributes
    ----------
    low : (2,) int64
        Corner of the raster, in cells.
    crown : (r, c) int64
        Crown of each cell, that of the nearest plant where there is none.
    """

    low: Int64Array
    crown: Int64Array

    def split(self, xyz: FloatArray, height: FloatArray, cluster: IntArray) -> IntArray:
        """Clusters (m,) of points (m, 3) split by crown; those no higher than 3 m above ground stay whole."""
        last = np.array(self.crown.shape) - 1
        row, column = np.clip(np.floor(xyz[:, :2] / _CELL_M).astype(np.int64) - self.low, 0, last).T
        top = Groups(cluster, int(cluster.max(initial=-1)) + 1).quantile(height, 0.95)
        is_tall = np.nan_to_num(top)[cluster] > _CROWN_HEIGHT_M
        crown = np.where(is_tall, self.crown[row, column] + 1, 0)
        return consecutive(cluster.astype(np.int64) * (int(self.crown.max()) + 2) + crown)[0]


def find_crowns(xyz: Pair[FloatArray], height: Pair[FloatArray]) -> Pair[Crowns]:
    """Crowns of the plants of both surveys, which part where one of them at least shows that they do.

    Parameters
    ----------
    xyz : Pair of (m, 3) float64, m
        Points of vegetation, in one frame.
    height : Pair of (m,) float64, m
        Their heights above ground; NaN where it is not known.
    """
    cells = xyz.map(lambda points: np.floor(points[:, :2] / _CELL_M).astype(np.int64))
    both = np.concatenate([*cells])
    if len(both) == 0:
        empty = Crowns(np.zeros(2, np.int64), np.zeros((1, 1), np.int64))
        return Pair(empty, empty)
    margin = int(np.ceil(_CLOSE_M / _CELL_M))
    low = both.min(axis=0) - margin
    shape = tuple((both.max(axis=0) - low + margin + 1).tolist())
    own = cells.join(height, lambda cell, above: _uphill_crowns(cell - low, above, shape, margin))
    parted = Pair(_parted(own.before, own.after), _parted(own.after, own.before))
    return parted.map(lambda crown: Crowns(low, _filled(crown, crown >= 0)))


def _uphill_crowns(cell: Int64Array, height: FloatArray, shape: tuple[int, ...], margin: int) -> Int64Array:
    """Crown of each cell of one survey, -1 where it shows no plant.

    The canopy is smoothed over 1 m; each cell climbs from cell to cell to its maximum, and a maximum with a higher one
    within ``margin`` cells climbs on, so that close maxima are one crown.
    """
    canopy = np.zeros(shape)
    np.maximum.at(canopy, (cell[:, 0], cell[:, 1]), np.nan_to_num(height))
    smooth = ndimage.gaussian_filter(ndimage.maximum_filter(canopy, 3), 0.5 / _CELL_M)
    peak = _uphill(smooth, margin).ravel()[_uphill(smooth, 1)]
    is_plant = np.zeros(shape, np.bool_)
    is_plant[cell[:, 0], cell[:, 1]] = True
    return np.where(is_plant, peak, -1)


def _parted(own: Int64Array, other: Int64Array) -> Int64Array:
    """Crowns of one survey; one that holds several of the other is cut, and each cell goes to the nearest of these."""
    n = own.size
    area = np.bincount(other[other >= 0], minlength=n)
    is_both = (own >= 0) & (other >= 0)
    pair, shared = np.unique(other[is_both] * n + own[is_both], return_counts=True)
    crown, host = np.divmod(pair, n)
    is_held = shared > _MOST * area[crown]
    host_of = np.full(n, -1, np.int64)
    host_of[crown[is_held]] = host[is_held]
    is_cut = np.append(np.bincount(host[is_held], minlength=n) > 1, False)[own]
    is_seed = is_cut & is_both
    is_seed[is_seed] = host_of[other[is_seed]] == own[is_seed]
    return np.where(is_cut, n + _filled(other, is_seed), own)


def _filled(crown: Int64Array, is_known: BoolArray) -> Int64Array:
    """The crown of the nearest cell that ``is_known`` at every cell."""
    if not is_known.any():
        return crown
    return np.asarray(
        crown[tuple(ndimage.distance_transform_edt(~is_known, return_distances=False, return_indices=True))]
    )


def _uphill(surface: FloatArray, reach: int) -> Int64Array:
    """Flat index of the maximum that each cell of a raster climbs to, in steps of at most ``reach`` cells."""
    highest = np.empty(surface.shape, dtype=np.int64)
    run_ranges(highest_range, len(surface), np.ascontiguousarray(surface), reach, highest, min_size=64)
    goal = highest.ravel()
    while not np.array_equal(goal[goal], goal):
        goal = goal[goal]
    return goal.reshape(surface.shape)
