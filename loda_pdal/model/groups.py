"""Statistics per group of points: sort once by label, then reduce as often as needed."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from loda_pdal.model.cloud import FloatArray, Int64Array


class Groups:
    """Points grouped by label 0 to ``n - 1``; points with a negative label belong to no group.

    Parameters
    ----------
    labels : (m,) int
        Group of each point.
    n : int
        Number of groups; groups may be empty.
    """

    def __init__(self, labels: npt.NDArray[Any], n: int) -> None:
        self.labels = labels
        self.n = n
        order = np.argsort(labels, kind="stable")
        self.order = order[np.searchsorted(labels[order], 0) :]
        self.counts: Int64Array = np.bincount(labels[self.order], minlength=n).astype(np.int64)
        self.starts: Int64Array = np.concatenate([[0], np.cumsum(self.counts)]).astype(np.int64)

    def members(self, group: int) -> Int64Array:
        """Indices of the points of one group, ascending."""
        return np.asarray(self.order[self.starts[group] : self.starts[group + 1]], dtype=np.int64)

    def sum(self, values: npt.NDArray[Any]) -> FloatArray:
        """Sum per group, (n,) or (n, d); 0 for an empty group."""
        picked = values[self.order].astype(np.float64)
        total = np.zeros((self.n, *picked.shape[1:]))
        is_filled = self.counts > 0
        if is_filled.any():
            total[is_filled] = np.add.reduceat(picked, self.starts[:-1][is_filled], axis=0)
        return total

    def mean(self, values: npt.NDArray[Any]) -> FloatArray:
        """Mean per group; NaN for an empty group."""
        total = self.sum(values)
        counts = self.counts.astype(np.float64).reshape((-1,) + (1,) * (total.ndim - 1))
        return np.divide(total, counts, out=np.full_like(total, np.nan), where=counts > 0)

    def quantile(self, values: npt.NDArray[Any], q: float) -> FloatArray:
        """Quantile ``q`` of (m,) values per group, linear between order statistics; NaNs in a group are left out."""
        picked = values[self.order].astype(np.float64)
        labels = self.labels[self.order]
        order = np.lexsort((picked, labels))  # NaN sorts last within its group
        ranked = picked[order]
        counts = np.bincount(labels[~np.isnan(picked)], minlength=self.n)
        position = self.starts[:-1] + q * np.maximum(counts - 1, 0)
        low = np.floor(position).astype(np.int64)
        high = np.minimum(low + 1, self.starts[:-1] + np.maximum(counts - 1, 0))
        result = np.full(self.n, np.nan)
        is_filled = counts > 0
        low, high, part = low[is_filled], high[is_filled], (position - low)[is_filled]
        result[is_filled] = ranked[low] * (1 - part) + ranked[high] * part
        return result

    def median(self, values: npt.NDArray[Any]) -> FloatArray:
        """Median of (m,) values per group; NaN for an empty group."""
        return self.quantile(values, 0.5)

    def minimum(self, values: npt.NDArray[Any]) -> FloatArray:
        """Smallest of (m,) values per group; NaN for an empty group or one with only NaN."""
        return self.quantile(values, 0.0)

    def maximum(self, values: npt.NDArray[Any]) -> FloatArray:
        """Largest of (m,) values per group; NaN for an empty group or one with only NaN."""
        return self.quantile(values, 1.0)

    def share(self, is_true: npt.NDArray[np.bool_]) -> FloatArray:
        """Share of true per group; NaN for an empty group."""
        return self.mean(is_true)

    def covariance(self, xyz: FloatArray) -> FloatArray:
        """Covariance matrix of (m, d) points per group, (n, d, d); zeros for an empty group."""
        mean = np.nan_to_num(self.mean(xyz))
        is_member = self.labels >= 0
        centred = np.where(is_member[:, None], xyz - mean[np.maximum(self.labels, 0)], 0.0)
        d = xyz.shape[1]
        outer = np.einsum("ij,ik->ijk", centred, centred).reshape(len(xyz), d * d)
        return np.asarray(self.sum(outer).reshape(self.n, d, d) / np.maximum(self.counts, 1)[:, None, None])


def consecutive(labels: npt.NDArray[Any]) -> tuple[npt.NDArray[np.int32], int]:
    """Non-negative labels renumbered 0, 1, 2, ... in the order of their first point; negative ones become -1."""
    is_member = labels >= 0
    _, first, inverse = np.unique(labels[is_member], return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int32)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first), dtype=np.int32)
    result = np.full(len(labels), -1, dtype=np.int32)
    result[is_member] = rank[inverse]
    return result, len(first)


def count_cells(points: FloatArray, labels: npt.NDArray[Any], n: int, cell_m: float) -> FloatArray:
    """Cells of ``cell_m`` that the points (m, d) of each label occupy, (n,) float64; negative labels do not count."""
    is_member = labels >= 0
    cells = np.floor(points[is_member] / cell_m).astype(np.int64)
    rows = unique_rows(np.column_stack([labels[is_member].astype(np.int64), cells]))
    return np.bincount(rows[:, 0], minlength=n).astype(np.float64)


def unique_rows(rows: Int64Array) -> Int64Array:
    """Distinct rows of (m, d) integers, lexicographically sorted."""
    ordered = rows[np.lexsort(rows.T[::-1])]
    is_new = np.ones(len(ordered), np.bool_)
    is_new[1:] = np.any(ordered[1:] != ordered[:-1], axis=1)
    return np.asarray(ordered[is_new])


def unique_inverse(rows: Int64Array) -> Int64Array:
    """Number (m,) of each row of (m, d) integers among the distinct rows in lexicographic order."""
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    is_new = np.zeros(len(ordered), dtype=np.int64)
    is_new[1:] = np.any(ordered[1:] != ordered[:-1], axis=1)
    inverse = np.empty(len(ordered), dtype=np.int64)
    inverse[order] = np.cumsum(is_new)
    return inverse
