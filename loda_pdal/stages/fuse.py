"""Raw points to one point per voxel (paper, section 4.1: the fused map).

A fused point is the mean of the raw points in its voxel. Local coordinates are whole multiples of `LOCAL_GRID`, so the
sums are exact and the result does not depend on the order of the points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from loda_pdal.kernels.parallel import run_ranges
from loda_pdal.kernels.voxels import add_points, fill_table, number_distinct, voxel_key_range
from loda_pdal.model.cloud import FloatArray, Int64Array, IntArray, VoxelCloud
from loda_pdal.model.errors import InputError
from loda_pdal.model.survey import PART, Survey
from loda_pdal.params import FuseParams


def fuse_survey(survey: Survey, params: FuseParams) -> VoxelCloud:
    """One mean point per occupied voxel, sorted by voxel (x first, then y, then z).

    The points pass by in parts; what is kept of each is the number of its voxel.

    Parameters
    ----------
    survey : Survey
        Raw points in local coordinates.
    params : FuseParams
        Edge of the voxels; voxel edges lie on its multiples.

    Returns
    -------
    VoxelCloud
        Means, raw points per voxel, and the voxel of every raw point.
    """
    voxel_idx = np.empty(len(survey), dtype=np.int32)
    if len(survey) == 0:
        return VoxelCloud(np.zeros((0, 3)), np.zeros(0, dtype=np.int32), voxel_idx)
    grid = _VoxelGrid.over(survey.extent.low, survey.extent.high, params.leaf_m)
    numbers, total, count = _Numbers(), np.zeros((0, 3)), np.zeros(0, dtype=np.int32)
    start = 0
    for xyz in survey.parts():
        number = voxel_idx[start : start + len(xyz)]
        numbers.of(grid.keys(xyz), number)
        total, count = _enlarged(total, numbers.capacity), _enlarged(count, numbers.capacity)
        add_points(number, np.ascontiguousarray(xyz), total, count)
        start += len(xyz)
    order = np.argsort(numbers.keys)
    _renumber(voxel_idx, order)
    return VoxelCloud(total[order] / count[order, None], count[order], voxel_idx)


def fuse_points(xyz: FloatArray, params: FuseParams) -> VoxelCloud:
    """`fuse_survey` of points (n, 3), local m."""
    return fuse_survey(Survey(xyz), params)


def downsample(xyz: FloatArray, leaf_m: float) -> FloatArray:
    """Mean point (v, 3) of each occupied voxel of ``leaf_m`` (m) of a cloud (n, 3), in voxel order."""
    return mean_of_voxels(xyz, *voxel_of_point(xyz, leaf_m))


def mean_of_voxels(xyz: FloatArray, voxel_idx: IntArray, n_voxels: int) -> FloatArray:
    """Mean point (v, 3) of the points (n, 3) of each voxel, given the voxel of each point (n,)."""
    count = np.bincount(voxel_idx, minlength=n_voxels)
    mean = np.empty((n_voxels, 3))
    for axis in range(3):
        mean[:, axis] = np.bincount(voxel_idx, weights=xyz[:, axis], minlength=n_voxels) / count
    return mean


def voxel_of_point(xyz: FloatArray, leaf_m: float) -> tuple[IntArray, int]:
    """Voxel of each point (n,), numbered in the order of the occupied voxels, and how many are occupied."""
    voxel_idx = np.empty(len(xyz), dtype=np.int32)
    if len(xyz) == 0:
        return voxel_idx, 0
    low, high = (np.array([function(xyz[:, axis]) for axis in range(3)]) for function in (np.min, np.max))
    numbers = _Numbers()
    numbers.of(_VoxelGrid.over(low, high, leaf_m).keys(xyz), voxel_idx)
    _renumber(voxel_idx, np.argsort(numbers.keys))
    return voxel_idx, len(numbers.keys)


@dataclass(frozen=True)
class _VoxelGrid:
    """Voxels of a box: the lowest (3,) int64, and how many there are along y and z."""

    leaf_m: float
    low: Int64Array
    n_y: int
    n_z: int

    @classmethod
    def over(cls, low: FloatArray, high: FloatArray, leaf_m: float) -> _VoxelGrid:
        """The voxels from coordinates ``low`` to ``high`` (3,), m."""
        first, last = (np.floor(corner / leaf_m).astype(np.int64) for corner in (low, high))
        n_x, n_y, n_z = (int(n) for n in last - first + 1)
        if math.log2(n_x) + math.log2(n_y) + math.log2(n_z) > 62:
            extent = " x ".join(f"{n * leaf_m:.3g}" for n in (n_x, n_y, n_z))
            raise InputError(
                f"The survey spans {extent} m, too far for voxels of {leaf_m} m.",
                "Remove stray points far from the rest, or raise fuse.leaf_m.",
                "extent-absurd",
            )
        return cls(float(leaf_m), first, n_y, n_z)

    def keys(self, xyz: FloatArray) -> Int64Array:
        """Key (n,) of the voxel of each point; keys sort by x first, then y, then z."""
        key = np.empty(len(xyz), dtype=np.int64)
        xyz = np.ascontiguousarray(xyz)
        run_ranges(voxel_key_range, len(xyz), xyz, self.leaf_m, self.low, self.n_y, self.n_z, key)
        return key


class _Numbers:
    """Distinct keys, numbered in the order in which they appear."""

    def __init__(self) -> None:
        self._n = 0
        self._distinct = np.empty(0, dtype=np.int64)
        self._table = np.empty(0, dtype=np.int32)
        self._grow()

    @property
    def keys(self) -> Int64Array:
        """The keys so far, by number."""
        return self._distinct[: self._n]

    @property
    def capacity(self) -> int:
        """Numbers stay below this until the table grows."""
        return len(self._distinct)

    def of(self, key: Int64Array, number: IntArray) -> None:
        """Write the number of each key (n,) into ``number`` (n,)."""
        reached = 0
        while reached < len(key):
            reached, self._n = number_distinct(key, reached, self._table, self._distinct, self._n, number)
            if reached < len(key):
                self._grow()

    def _grow(self) -> None:
        size = max(4 * len(self._table), 1 << 18)
        self._table = np.full(size, -1, dtype=np.int32)
        self._distinct = _enlarged(self._distinct, size // 2)
        fill_table(self._table, self._distinct, self._n)


def _enlarged(values: npt.NDArray[Any], n: int) -> npt.NDArray[Any]:
    """An array of ``n`` rows that begins with ``values`` and goes on with zeros; ``values`` itself if long enough."""
    if len(values) >= n:
        return values
    longer = np.zeros((n, *values.shape[1:]), dtype=values.dtype)
    longer[: len(values)] = values
    return longer


def _renumber(number: IntArray, order: npt.NDArray[np.intp]) -> None:
    """Replace each number (n,) by its rank, given the numbers in their new order; part by part, in place."""
    rank = np.empty(len(order), dtype=np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    for start in range(0, len(number), PART):
        number[start : start + PART] = rank[number[start : start + PART]]
