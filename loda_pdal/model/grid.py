"""Sparse grids: cells of a regular lattice as sorted integer keys."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loda_pdal.kernels.lattice import find_range
from loda_pdal.kernels.parallel import run_ranges
from loda_pdal.model.cloud import FloatArray, Int64Array


@dataclass(frozen=True)
class Lattice:
    """A bounded lattice that gives each cell one integer, in lexicographic order of the cell.

    Attributes
    ----------
    low, span : (d,) int64
        Lowest cell index and number of cells along each axis, with a margin of one cell on every side.
    """

    low: Int64Array
    span: Int64Array

    @classmethod
    def around(cls, cells: Int64Array) -> Lattice:
        """Lattice that holds the given cells (c, d), at least one, and their neighbours."""
        low = np.array([column.min() for column in cells.T], dtype=np.int64) - 1
        return cls(low, np.array([column.max() for column in cells.T], dtype=np.int64) - low + 2)

    @property
    def has_keys(self) -> bool:
        """Whether the keys of all its cells are integers of 64 bits."""
        return bool(math.prod(self.span.tolist()) < 2**63)

    def keys(self, cells: Int64Array) -> Int64Array:
        """Key of each cell (k, d); only meaningful for cells inside."""
        key = np.zeros(len(cells), dtype=np.int64)
        for axis in range(len(self.low)):
            key = key * self.span[axis] + (cells[:, axis] - self.low[axis])
        return key

    def cells(self, keys: Int64Array) -> Int64Array:
        """Cell (k, d) of each key."""
        cells = np.empty((len(keys), len(self.low)), dtype=np.int64)
        for axis in reversed(range(len(self.low))):
            keys, along = np.divmod(keys, self.span[axis])
            cells[:, axis] = along + self.low[axis]
        return cells

    def find(self, sorted_keys: Int64Array, cells: Int64Array) -> Int64Array:
        """Position of each cell (k, d) in ``sorted_keys``, distinct, -1 where it is not there."""
        place = np.empty(len(cells), dtype=np.int64)
        rows = np.ascontiguousarray(cells, dtype=np.int64)
        run_ranges(find_range, len(rows), rows, self.low, self.span, np.ascontiguousarray(sorted_keys), place)
        return place


def cells_of(xyz: FloatArray, cell_m: float) -> Int64Array:
    """Cell index (k, d) of each point (k, d) m."""
    return np.asarray(np.floor(xyz / cell_m), dtype=np.int64)
