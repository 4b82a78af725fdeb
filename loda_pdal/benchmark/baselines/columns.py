"""Plan cells of a scene: what stands in each, in both epochs, and what happened to a region of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from loda_pdal.benchmark.baselines.scene import Marks, Scene
from loda_pdal.model.cloud import BoolArray, ByteArray, FloatArray, Int64Array
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.pair import Pair

CELL_M = 0.5
"""Edge of a plan cell (paper, section 5: nDSM grids of 0.5 m)."""

MIN_NEIGHBOURS = 3
"""A cell without a return is filled from so many measured cells of the eight around it, or stays unknown."""

NEIGHBOURS = np.ones((3, 3), dtype=bool)


@dataclass(frozen=True)
class Columns:
    """Plan cells (nx, ny) of a scene, rows along x.

    Attributes
    ----------
    cell : Pair of (m,) int64
        Flat index of the cell of each fused point.
    top : Pair of (nx, ny) float64, m
        Highest return above ground (nDSM), holes filled by their neighbours' mean; NaN where nothing was measured.
    """

    cell: Pair[Int64Array]
    top: Pair[FloatArray]

    @classmethod
    def of(cls, scene: Scene) -> Columns:
        """Columns of both epochs over their common extent."""
        idx = scene.clouds.map(lambda cloud: np.floor(cloud.xyz[:, :2] / CELL_M).astype(np.int64))
        both = np.concatenate(list(idx))
        first = both.min(axis=0) if len(both) else np.zeros(2, np.int64)
        nx, ny = (both.max(axis=0) - first + 1).tolist() if len(both) else (0, 0)
        cell = idx.map(lambda side: (side[:, 0] - first[0]) * ny + side[:, 1] - first[1])
        top = cell.join(scene.height, lambda at, height: _filled(_highest(at, height, (nx, ny))))
        return cls(cell, top)

    @property
    def shape(self) -> tuple[int, int]:
        return self.top.before.shape

    @property
    def difference(self) -> FloatArray:
        """How much higher the top is in the after epoch, (nx, ny) m; NaN where an epoch has none."""
        return self.top.after - self.top.before


def label_of_regions(columns: Columns, region: Int64Array, cell: Int64Array, standing_m: float) -> ByteArray:
    """What happened to each region, by what stands on its cells in each epoch.

    Parameters
    ----------
    columns : Columns
    region, cell : (k,) int64
        Pairs of a region (from 1, without gaps) and a flat cell that belongs to it, each pair once.
    standing_m : float, m
        Where the median top of a region's cells is lower than this, nothing stands there. Unmeasured cells are empty.

    Returns
    -------
    (n + 1,) uint8
        `ChangeLabel` per region; that of 0, no region, is Unchanged.
    """
    label = np.full(int(region.max(initial=0)) + 1, ChangeLabel.UNCHANGED, dtype=np.uint8)
    if len(region) == 0:
        return label
    before, after = (
        np.asarray(ndimage.median(np.nan_to_num(top).ravel()[cell], region, np.arange(1, len(label))))
        for top in columns.top
    )
    label[1:] = np.where(after > before, ChangeLabel.INCREASED, ChangeLabel.DECREASED)
    label[1:][(before < standing_m) & (after >= standing_m)] = ChangeLabel.ADDED
    label[1:][(before >= standing_m) & (after < standing_m)] = ChangeLabel.REMOVED
    return label


def connected(is_member: BoolArray, min_cells: int) -> Int64Array:
    """Region of each cell, (nx, ny), from 1 without gaps, 0 none: cells that touch, corners included, at least so
    many."""
    region, _ = ndimage.label(is_member, structure=NEIGHBOURS)
    return without_small(region, min_cells)


def without_small(group: npt.NDArray[np.integer], least: int) -> Int64Array:
    """Groups from 1 renumbered without those of fewer than ``least`` members, which become 0; any shape."""
    count = np.bincount(group.ravel())
    is_kept = count >= least
    is_kept[:1] = False
    number = np.where(is_kept, np.cumsum(is_kept), 0)
    return np.asarray(number[group], dtype=np.int64)


def marks_in_columns(scene: Scene, columns: Columns, region: Int64Array, label: ByteArray) -> Pair[Marks]:
    """Every point off the ground takes the region of its cell, ``region`` (nx, ny), and the label of that."""

    def of_epoch(cell: Int64Array, is_off_ground: BoolArray) -> Marks:
        return Marks.of_objects(np.where(is_off_ground, region.ravel()[cell], 0), label)

    return columns.cell.join(scene.is_off_ground, of_epoch)


def _highest(cell: Int64Array, height: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Highest value in each cell, at least 0; NaN where there is none."""
    top = np.full(shape[0] * shape[1], -np.inf)
    is_known = np.isfinite(height)
    np.maximum.at(top, cell[is_known], height[is_known])
    return np.where(np.isfinite(top), np.maximum(top, 0.0), np.nan).reshape(shape)


def _filled(top: FloatArray) -> FloatArray:
    """Holes filled by the mean of the cells around them that are known."""
    is_known = np.isfinite(top)
    total = ndimage.convolve(np.where(is_known, top, 0.0), NEIGHBOURS.astype(float), mode="constant")
    count = ndimage.convolve(is_known.astype(float), NEIGHBOURS.astype(float), mode="constant")
    is_hole = ~is_known & (count >= MIN_NEIGHBOURS)
    return np.where(is_hole, total / np.maximum(count, 1), top)
