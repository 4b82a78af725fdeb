"""Where the points of a survey are, found in one pass over them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from loda_pdal.model.cloud import FloatArray, Int64Array

CELL_M = 5.0
"""Edge of the plan cells in which spacing is measured; overlap is counted in cells of twice that."""

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
    """

    n: int
    low: FloatArray
    high: FloatArray
    cells: Int64Array

    @classmethod
    def of(cls, parts: Iterable[FloatArray]) -> Extent:
        """Extent of a cloud that comes in parts (k, 3), local m."""
        n, low, high = 0, np.full(3, np.inf), np.full(3, -np.inf)
        keys = [np.empty(0, dtype=np.int64)]
        for xyz in parts:
            if len(xyz) == 0:
                continue
            n += len(xyz)
            for axis in range(3):
                low[axis] = min(low[axis], xyz[:, axis].min())
                high[axis] = max(high[axis], xyz[:, axis].max())
            keys.append(_distinct(_key(_cell(xyz[:, 0]), _cell(xyz[:, 1]))))
        return cls(n, low, high, _distinct(np.concatenate(keys)))

    @property
    def size_m(self) -> FloatArray:
        """Extent (3,) along x, y, z, m; 0 where there is no point."""
        return self.high - self.low if self.n else np.zeros(3)

    @property
    def spacing_m(self) -> float:
        """Mean point spacing (m) in plan: root of the area of occupied cells, with their gaps, per point."""
        return float(CELL_M * np.sqrt(len(self.cells) / self.n)) if self.n else 0.0

    def overlap(self, other: Extent) -> float:
        """Share of the smaller cloud's occupied plan cells of 2 `CELL_M` that the other occupies too, 0 to 1."""
        a, b = _coarser(self.cells), _coarser(other.cells)
        return len(np.intersect1d(a, b, assume_unique=True)) / max(min(len(a), len(b)), 1)


def _cell(metres: FloatArray) -> Int64Array:
    """Number of the cell of each coordinate; coordinates beyond any map share the last cell."""
    return np.clip(np.floor(metres / CELL_M), -_FURTHEST, _FURTHEST).astype(np.int64)


def _key(i: Int64Array, j: Int64Array) -> Int64Array:
    return (i << 32) | (j & 0xFFFFFFFF)


def _coarser(keys: Int64Array) -> Int64Array:
    """Distinct keys of the cells of twice the edge."""
    j = (keys & 0xFFFFFFFF).astype(np.uint32).view(np.int32).astype(np.int64)
    return _distinct(_key(keys >> 33, j >> 1))


def _distinct(keys: Int64Array) -> Int64Array:
    """Distinct keys, sorted; neighbours in a survey are mostly in one cell, and need no sorting."""
    is_new = np.ones(len(keys), dtype=np.bool_)
    is_new[1:] = keys[1:] != keys[:-1]
    return np.unique(keys[is_new])
