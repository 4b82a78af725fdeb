"""Loops over cells of a bounded lattice, see `loda_pdal.model.grid.Lattice`."""

from __future__ import annotations

from typing import Any

import numpy.typing as npt

from loda_pdal.kernels.compiled import kernel

Array = npt.NDArray[Any]


@kernel
def find_range(first: int, last: int, cells: Array, low: Array, span: Array, sorted_keys: Array, place: Array) -> None:
    """Fill ``place`` (k,) int64 with where the keys of ``cells`` (k, d) stand, -1 where a cell has none.

    Parameters
    ----------
    low, span : (d,) int64
        Lowest cell of the lattice and number of cells along each axis; cells outside have no key.
    sorted_keys : (n,) int64
        Distinct keys, ascending.

    Notes
    -----
    The search starts where the last one ended and doubles its steps: cells that follow each other are close together.
    """
    n, here = len(sorted_keys), 0
    for q in range(first, last):
        key, is_inside = 0, n > 0
        for axis in range(len(low)):
            along = cells[q, axis] - low[axis]
            is_inside &= 0 <= along < span[axis]
            key = key * span[axis] + along
        place[q] = -1
        if not is_inside:
            continue
        step = 1
        if sorted_keys[here] <= key:
            start = here
            while start + step < n and sorted_keys[start + step] <= key:
                start += step
                step *= 2
            stop = min(start + step, n)
        else:
            stop = here
            while stop - step > 0 and sorted_keys[stop - step] > key:
                stop -= step
                step *= 2
            start = max(stop - step, 0)
        while stop - start > 1:  # sorted_keys[start] <= key < sorted_keys[stop], as far as there are any
            middle = (start + stop) // 2
            if sorted_keys[middle] <= key:
                start = middle
            else:
                stop = middle
        here = start
        if sorted_keys[here] == key:
            place[q] = here
