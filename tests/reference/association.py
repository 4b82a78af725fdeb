"""The best one-to-one assignment by trying all of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


def least_total(cost: Array, unmatched_cost: float) -> float:
    """Smallest total of a matrix of pair costs (inf: not allowed) and of the cost of each unmatched row and column."""
    n_rows, n_columns = cost.shape

    def best_from(row: int, free: frozenset[int]) -> float:
        if row == n_rows:
            return unmatched_cost * len(free)
        totals = [unmatched_cost + best_from(row + 1, free)]
        totals += [
            cost[row, column] + best_from(row + 1, free - {column})
            for column in sorted(free)
            if np.isfinite(cost[row, column])
        ]
        return min(totals)

    return best_from(0, frozenset(range(n_columns)))
