"""Loops over groups of points: the points of group g are ``order[starts[g]:starts[g + 1]]``."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from loda_pdal.kernels.compiled import inner, kernel

Array = npt.NDArray[Any]


@kernel
def sort_by_label(labels: Array, starts: Array, order: Array) -> None:
    """Counting sort of points by label.

    Parameters
    ----------
    labels : (m,) int32
        Label of each point, less than n; points with a negative label are left out.
    starts : (n + 1,) int64
        Zeros; filled with the first place of each label in ``order``, and the end.
    order : (m,) int32
        Filled, as far as ``starts[n]``, with the points of label 0, 1, ..., ascending within each label.
    """
    for label in labels:
        if label >= 0:
            starts[label + 1] += 1
    for g in range(1, len(starts)):
        starts[g] += starts[g - 1]
    place = starts.copy()
    for point in range(len(labels)):
        label = labels[point]
        if label >= 0:
            order[place[label]] = point
            place[label] += 1


@kernel
def number_by_first(labels: Array, number_of: Array, number: Array) -> int:
    """Number labels 0, 1, 2, ... in the order of their first point, and return how many there are.

    Parameters
    ----------
    labels : (m,) int64
        Label of each point; negative ones get no number.
    number_of : (greatest label + 1,) int32
        All -1; filled with the number of each label that occurs.
    number : (m,) int32
        Filled with the number of each point's label; -1 where that is negative.
    """
    n = 0
    for point in range(len(labels)):
        label = labels[point]
        if label < 0:
            number[point] = -1
            continue
        if number_of[label] < 0:
            number_of[label] = n
            n += 1
        number[point] = number_of[label]
    return n


@kernel
def extremes_range(first: int, last: int, values: Array, order: Array, starts: Array, low: Array, high: Array) -> None:
    """Fill ``low`` and ``high``, (n, d) NaNs, with the extremes of ``values`` (m, d) float64; NaNs are left out."""
    for group in range(first, last):
        for t in range(starts[group], starts[group + 1]):
            for column in range(values.shape[1]):
                value = values[order[t], column]
                if value < low[group, column] or np.isnan(low[group, column]):
                    low[group, column] = value
                if value > high[group, column] or np.isnan(high[group, column]):
                    high[group, column] = value


@kernel
def quantile_range(
    first: int, last: int, values: Array, order: Array, starts: Array, q: float, quantile: Array
) -> None:
    """Fill ``quantile`` (n,) with quantile ``q`` of ``values`` (m,) float64, linear between order statistics.

    NaNs are left out; groups without any number are left alone.
    """
    picked = np.empty(_largest(first, last, starts))
    for group in range(first, last):
        n = np.int64(0)
        for t in range(starts[group], starts[group + 1]):
            picked[n] = values[order[t]]
            n += not np.isnan(picked[n])
        if n == 0:
            continue
        place = starts[group] + q * (n - 1)  # as if all groups stood sorted behind each other
        part = place - np.floor(place)
        low = int(np.floor(place)) - starts[group]
        lower = select(picked, n, low)
        upper = lower if low + 1 == n else np.inf
        for t in range(low + 1, n):
            upper = min(upper, picked[t])
        quantile[group] = lower * (1 - part) + upper * part


@inner
def _largest(first: int, last: int, starts: Array) -> int:
    """Points in the largest of the groups."""
    most = 0
    for group in range(first, last):
        most = max(most, starts[group + 1] - starts[group])
    return most


@inner
def select(values: Array, n: int, rank: int) -> float:
    """Value of that rank among the first ``n``, which are reordered: none before is larger, none behind smaller.

    Hoare's selection; pivots are drawn by a fixed generator, so that no order of the values makes it slow.
    """
    left, right, draw = 0, n - 1, np.uint64(1)
    while left < right:
        draw = draw * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        pivot = values[left + int((draw >> np.uint64(33)) % np.uint64(right - left + 1))]
        i, j = left, right
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if rank <= j:
            right = j
        elif rank >= i:
            left = i
        else:
            break
    return float(values[rank])
