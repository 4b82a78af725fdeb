"""Where the points of a survey are, found in one pass over them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from loda_pdal.model.cloud import FloatArray, Int64Array

CELL_M = 2.5
"""Edge of the plan cells in which points are counted; spacing is measured in cells of twice that, overlap of four times
that."""

_FURTHEST = 2.0**31 - 1


@dataclass(frozen=True)
class Extent:
    """Bounds and occupied plan cells of a cloud.

    Attributes
    ----------
    n : int
        How many points there are.
    low, high : (3,) float64, m
        Lowest and highest local coordinates; infinite, and the other way round, where there is no point.
    cells : (c,) int64
        Occupied plan cells of `CELL_M` as sorted keys: number along x in the upper half, along y in the lower.
    n_in_cell : (c,) int64
        Points in each of them.
    """

    n: int
    low: FloatArray
    high: FloatArray
    cells: Int64Array
    n_in_cell: Int64Array

    @classmethod
    def of(cls, parts: Iterable[FloatArray]) -> Extent:
        """Extent of a cloud that comes in parts (k, 3), local m."""
        n, low, high = 0, np.full(3, np.inf), np.full(3, -np.inf)
        keys, counts = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
        for xyz in parts:
            if len(xyz) == 0:
                continue
            n += len(xyz)
            for axis in range(3):
                low[axis] = min(low[axis], xyz[:, axis].min())
                high[axis] = max(high[axis], xyz[:, axis].max())
            key, count = _counted(_key(_cell(xyz[:, 0]), _cell(xyz[:, 1])))
            keys.append(key)
            counts.append(count)
        return cls(n, low, high, *_summed(np.concatenate(keys), np.concatenate(counts)))

    @property
    def size_m(self) -> FloatArray:
        """Extent (3,) along x, y, z, m; 0 where there is no point."""
        return self.high - self.low if self.n else np.zeros(3)

    @property
    def spacing_m(self) -> float:
        """Mean point spacing (m) in plan: root of the area of occupied cells, with their gaps, per point."""
        return float(2 * CELL_M * np.sqrt(len(_coarser(self.cells)) / self.n)) if self.n else 0.0

    @property
    def dense_share(self) -> float:
        """Share of the points in the densest quarter of the occupied cells: 0.25 for an even cloud, 1 at most."""
        if not self.n:
            return 0.0
        sparse_to_dense = np.sort(self.n_in_cell)
        return float(sparse_to_dense[-math.ceil(len(self.cells) / 4) :].sum() / self.n)

    def overlap(self, other: Extent) -> float:
        """Share of the smaller cloud's occupied plan cells of 4 `CELL_M` that the other occupies too, 0 to 1."""
        a, b = (_coarser(_coarser(extent.cells)) for extent in (self, other))
        return len(np.intersect1d(a, b, assume_unique=True)) / max(min(len(a), len(b)), 1)


def _cell(metres: FloatArray) -> Int64Array:
    """Number of the cell of each coordinate; coordinates beyond any map share the last cell."""
    return np.clip(np.floor(metres / CELL_M), -_FURTHEST, _FURTHEST).astype(np.int64)


def _key(i: Int64Array, j: Int64Array) -> Int64Array:
    return (i << 32) | (j & 0xFFFFFFFF)


def _coarser(keys: Int64Array) -> Int64Array:
    """Distinct keys of the cells of twice the edge."""
    j = (keys & 0xFFFFFFFF).astype(np.uint32).view(np.int32).astype(np.int64)
    return np.unique(_key(keys >> 33, j >> 1))


def _counted(keys: Int64Array) -> tuple[Int64Array, Int64Array]:
    """Distinct keys, sorted, and how often each is there; neighbours in a survey are mostly in one cell."""
    is_new = np.ones(len(keys), dtype=np.bool_)
    is_new[1:] = keys[1:] != keys[:-1]
    start = np.flatnonzero(is_new)
    return _summed(keys[start], np.diff(start, append=len(keys)))


def _summed(keys: Int64Array, counts: Int64Array) -> tuple[Int64Array, Int64Array]:
    """Distinct keys, sorted, with the sum of the counts of each."""
    distinct, which = np.unique(keys, return_inverse=True)
    total = np.zeros(len(distinct), dtype=np.int64)
    np.add.at(total, which, counts)
    return distinct, total
