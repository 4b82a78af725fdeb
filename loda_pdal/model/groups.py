"""Statistics per group of points: sort once by label, then reduce as often as needed; and distinct rows of integers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from loda_pdal.kernels.groups import (
    extremes_range,
    number_by_first,
    quantile_range,
    sort_by_label,
)
from loda_pdal.kernels.parallel import run_ranges
from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array
from loda_pdal.model.grid import Lattice, cells_of


class Groups:
    """Points grouped by label 0 to ``n - 1``; points with a negative label belong to no group.

    Parameters
    ----------
    labels : (m,) int
        Group of each point.
    n : int
        Number of groups; groups may be empty.

    Attributes
    ----------
    order : (k,) int32
        The points that belong to a group, sorted by it, ascending within each.
    starts : (n + 1,) int64
        Points of group g are ``order[starts[g]:starts[g + 1]]``.
    counts : (n,) int64
        Points of each group.
    """

    def __init__(self, labels: npt.NDArray[Any], n: int) -> None:
        self.labels = labels
        self.n = n
        self.starts: Int64Array = np.zeros(n + 1, dtype=np.int64)
        order = np.empty(len(labels), dtype=np.int32)
        if len(labels) and labels.max() >= n:
            raise ValueError(f"label {labels.max()} in only {n} groups")
        sort_by_label(np.ascontiguousarray(labels, dtype=np.int32), self.starts, order)
        self.order = order[: self.starts[-1]]
        self.counts: Int64Array = np.diff(self.starts)

    def only(self, is_kept: BoolArray) -> Groups:
        """The groups where ``is_kept`` (n,), under the same numbers; the others without points."""
        is_member = (self.labels >= 0) & is_kept[self.labels] if self.n else np.zeros(len(self.labels), np.bool_)
        return Groups(np.where(is_member, self.labels, -1), self.n)

    def members(self, group: int) -> Int64Array:
        """Indices of the points of one group, ascending."""
        return np.asarray(self.order[self.starts[group] : self.starts[group + 1]], dtype=np.int64)

    def sum(self, values: npt.NDArray[Any]) -> FloatArray:
        """Sum per group, (n,) or (n, d), of (m,) or (m, d) values; 0 for an empty group."""
        total = np.zeros((self.n, *values.shape[1:]))
        for column in np.ndindex(values.shape[1:]):
            total[:, *column] = self._sum(values[:, *column][self.order])
        return total

    def mean(self, values: npt.NDArray[Any]) -> FloatArray:
        """Mean per group; NaN for an empty group."""
        total = self.sum(values)
        counts = self.counts.astype(np.float64).reshape((-1,) + (1,) * (total.ndim - 1))
        return np.divide(total, counts, out=np.full_like(total, np.nan), where=counts > 0)

    def quantile(self, values: npt.NDArray[Any], q: float) -> FloatArray:
        """Quantile ``q`` of (m,) values per group, linear between order statistics; NaNs in a group are left out."""
        result = np.full(self.n, np.nan)
        self._run(quantile_range, np.ascontiguousarray(values, dtype=np.float64), float(q), result)
        return result

    def median(self, values: npt.NDArray[Any]) -> FloatArray:
        """Median of (m,) values per group; NaN for an empty group."""
        return self.quantile(values, 0.5)

    def extremes(self, values: npt.NDArray[Any]) -> tuple[FloatArray, FloatArray]:
        """Least and greatest per group, (n,) or (n, d) each; NaN for an empty group or one with only NaN."""
        columns = _columns(values)
        low, high = np.full((2, self.n, columns.shape[1]), np.nan)
        self._run(extremes_range, columns, low, high)
        shape = (self.n, *values.shape[1:])
        return low.reshape(shape), high.reshape(shape)

    def minimum(self, values: npt.NDArray[Any]) -> FloatArray:
        """Least per group, as `extremes`."""
        return self.extremes(values)[0]

    def maximum(self, values: npt.NDArray[Any]) -> FloatArray:
        """Greatest per group, as `extremes`."""
        return self.extremes(values)[1]

    def share(self, is_true: npt.NDArray[np.bool_]) -> FloatArray:
        """Share of true per group; NaN for an empty group."""
        return self.mean(is_true)

    def covariance(self, xyz: FloatArray) -> FloatArray:
        """Covariance matrix of (m, d) points per group, (n, d, d); zeros for an empty group."""
        d = xyz.shape[1]
        mean = self.mean(xyz)
        centred = [xyz[self.order, axis] - np.repeat(mean[:, axis], self.counts) for axis in range(d)]
        result = np.zeros((self.n, d, d))
        for a, b in zip(*np.triu_indices(d), strict=True):
            result[:, a, b] = result[:, b, a] = self._sum(centred[a] * centred[b]) / np.maximum(self.counts, 1)
        return result

    def _sum(self, sorted_values: npt.NDArray[Any]) -> FloatArray:
        """Sum per group (n,) of values (k,) that are sorted as ``order`` is; 0 for an empty group."""
        total = np.zeros(self.n)
        is_filled = self.counts > 0
        if is_filled.any():
            total[is_filled] = np.add.reduceat(sorted_values, self.starts[:-1][is_filled], dtype=np.float64)
        return total

    def _run(self, kernel: Callable[..., None], values: FloatArray, *args: Any) -> None:
        """Run a kernel of `loda_pdal.kernels.groups` over all groups."""
        run_ranges(kernel, self.n, values, self.order, self.starts, *args, min_size=_LEAST_RANGE)


_LEAST_RANGE = 64
"""Fewer groups than this are no work for a thread of their own."""


def _columns(values: npt.NDArray[Any]) -> FloatArray:
    """Values (m,) or (m, d) as the kernels take them: (m, d) float64 in C order."""
    return np.ascontiguousarray(values if values.ndim == 2 else values[:, None], dtype=np.float64)


def consecutive(labels: npt.NDArray[Any]) -> tuple[npt.NDArray[np.int32], int]:
    """Non-negative labels renumbered 0, 1, 2, ... in the order of their first point; negative ones become -1."""
    dense = np.ascontiguousarray(labels, dtype=np.int64)
    if dense.max(initial=-1) > _SPARSE * len(dense):
        dense = np.where(dense < 0, -1, unique_inverse(dense[:, None]))
    result = np.empty(len(dense), dtype=np.int32)
    n = number_by_first(dense, np.full(dense.max(initial=-1) + 1, -1, dtype=np.int32), result)
    return result, int(n)


_SPARSE = 8
"""Labels of more than this times the number of points are numbered by sorting first, not by a table of them all."""


def count_cells(points: FloatArray, labels: npt.NDArray[Any], n: int, cell_m: float) -> FloatArray:
    """Cells of ``cell_m`` that the points (m, d) of each label occupy, (n,) float64; negative labels do not count."""
    is_member = labels >= 0
    rows = unique_rows(np.column_stack([labels[is_member], cells_of(points[is_member], cell_m)]))
    return np.bincount(rows[:, 0], minlength=n).astype(np.float64)


def unique_rows(rows: Int64Array) -> Int64Array:
    """Distinct rows of (m, d) integers, lexicographically sorted."""
    if len(rows) == 0:
        return rows
    lattice = Lattice.around(rows)
    if not lattice.has_keys:
        return np.unique(rows, axis=0)
    ordered = np.sort(lattice.keys(rows))
    return lattice.cells(ordered[np.diff(ordered, prepend=-1) > 0])


def unique_inverse(rows: Int64Array) -> Int64Array:
    """Number (m,) of each row of (m, d) integers among the distinct rows in lexicographic order."""
    if len(rows) == 0:
        return np.zeros(0, dtype=np.int64)
    lattice = Lattice.around(rows)
    if not lattice.has_keys:
        return np.unique(rows, axis=0, return_inverse=True)[1].ravel()
    keys = lattice.keys(rows)
    order = np.argsort(keys)
    inverse = np.empty(len(rows), dtype=np.int64)
    inverse[order] = np.cumsum(np.diff(keys[order], prepend=keys[order[0]]) > 0)
    return inverse


def favourites(own: npt.NDArray[Any], other: npt.NDArray[Any]) -> tuple[Int64Array, Int64Array, Int64Array]:
    """For each value (f,) in ``own`` (k,), ascending, the value (f,) in ``other`` (k,) that most often goes with it (of
    equals the lowest), and how often (f,). Values are not negative."""
    n = int(other.max(initial=0)) + 1
    key, count = np.unique(own.astype(np.int64) * n + other, return_counts=True)
    first, second = np.divmod(key, n)
    order = np.lexsort((second, -count, first))
    best = order[np.diff(first[order], prepend=-1) != 0]
    return first[best], second[best], count[best].astype(np.int64)
