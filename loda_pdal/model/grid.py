"""Sparse grids: cells of a regular lattice as sorted integer keys."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array


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
        """Lattice that holds the given cells (c, d) and their neighbours."""
        low = cells.min(axis=0).astype(np.int64) - 1
        return cls(low, cells.max(axis=0).astype(np.int64) - low + 2)

    def keys(self, cells: Int64Array) -> Int64Array:
        """Key of each cell (k, d); only meaningful for cells inside."""
        key = np.zeros(len(cells), dtype=np.int64)
        for axis in range(len(self.low)):
            key = key * self.span[axis] + (cells[:, axis] - self.low[axis])
        return key

    def contains(self, cells: Int64Array) -> BoolArray:
        """Whether each cell (k, d) is inside, (k,) bool."""
        return np.asarray(np.all((cells >= self.low) & (cells < self.low + self.span), axis=1))

    def find(self, sorted_keys: Int64Array, cells: Int64Array) -> Int64Array:
        """Position of each cell (k, d) in ``sorted_keys``, -1 where it is not there."""
        key = self.keys(cells)
        position = np.minimum(np.searchsorted(sorted_keys, key), max(len(sorted_keys) - 1, 0))
        if len(sorted_keys) == 0:
            return np.full(len(cells), -1, dtype=np.int64)
        return np.where(self.contains(cells) & (sorted_keys[position] == key), position, -1)


def cells_of(xyz: FloatArray, cell_m: float) -> Int64Array:
    """Cell index (k, d) of each point (k, d) m."""
    return np.asarray(np.floor(xyz / cell_m), dtype=np.int64)
