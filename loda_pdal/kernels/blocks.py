"""Many queries at once: those close together share one copy of the points around them.

Queries are a cell list too, often that of the cloud itself; a block is a piece of one of its columns. The points around
a block are copied once, coordinate by coordinate, so that each query then runs over a few short arrays. A kernel of
your own that visits all points within a radius reads::

    @njit(nogil=True, cache=True)
    def _count_range(start, stop, cells, queries, radius, counts):
        near = no_surroundings()
        for column in range(start, stop):
            q, column_stop = queries.column_start[column], queries.column_start[column + 1]
            while q < column_stop:
                block_stop = end_of_block(queries, q, column_stop)
                near, n = around(cells, queries, q, block_stop, radius, near)
                for q in range(q, block_stop):
                    for h in range(within(near, n, queries.xyz[q], radius * radius)):
                        counts[queries.idx[q]] += 1         # near.idx[near.hit[h]] is the point's index
                q = block_stop

    run_ranges(_count_range, len(queries.column_y), cells, queries, radius, counts, min_size=COLUMNS_PER_RANGE)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from loda_pdal.kernels.cells import CellList, cells_between, first_above, first_column
from loda_pdal.kernels.parallel import run_ranges

MOST_IN_BLOCK = 256
"""Queries in a block."""

COLUMNS_PER_RANGE = 64
"""Columns of queries worth a thread."""


def run_columns(function: Callable[..., Any], queries: CellList, *args: Any) -> None:
    """Call ``function(start, stop, queries, *args)`` for ranges that cover the columns of ``queries`` once."""
    run_ranges(function, len(queries.column_y), queries, *args, min_size=COLUMNS_PER_RANGE)


class Surroundings(NamedTuple):
    """The points around a block, by column and height, and room for what a query finds among them.

    Attributes
    ----------
    x, y, z : (m,) float32, m
        Their coordinates about the centre of the cell list; only the first n of each array mean anything.
    idx : (m,) int32
        Their indices in the cloud.
    sq : (m,) float64, m2
        Squared distances from the last query.
    hit, order : (m + 1,) int32
        Which of them the last query found; and these almost by distance.
    """

    x: npt.NDArray[np.float32]
    y: npt.NDArray[np.float32]
    z: npt.NDArray[np.float32]
    idx: npt.NDArray[np.int32]
    sq: npt.NDArray[np.float64]
    hit: npt.NDArray[np.int32]
    order: npt.NDArray[np.int32]


@njit(nogil=True, cache=True)
def room_for(m):  # type: ignore[no-untyped-def]
    """Surroundings with room for ``m`` points."""
    xyz, whole, sq = np.empty((3, m), dtype=np.float32), np.empty((3, m + 1), dtype=np.int32), np.empty(m)
    return Surroundings(xyz[0], xyz[1], xyz[2], whole[0], sq, whole[1], whole[2])


@njit(nogil=True, cache=True)
def end_of_block(queries, q, column_stop):  # type: ignore[no-untyped-def]
    """End of the block that begins at sorted query ``q``: as high as its column is wide."""
    top = queries.xyz[q, 2] + queries.cell_m
    stop = min(column_stop, q + MOST_IN_BLOCK)
    while q < stop and queries.xyz[q, 2] <= top:
        q += 1
    return q


@njit(nogil=True, cache=True)
def box_of(queries, start, stop):  # type: ignore[no-untyped-def]
    """Box around sorted queries [start, stop) of a column: x from, x to, y from, y to, z from, z to."""
    x0 = x1 = queries.xyz[start, 0]
    y0 = y1 = queries.xyz[start, 1]
    for q in range(start + 1, stop):
        x0, x1 = min(x0, queries.xyz[q, 0]), max(x1, queries.xyz[q, 0])
        y0, y1 = min(y0, queries.xyz[q, 1]), max(y1, queries.xyz[q, 1])
    z0, z1 = queries.xyz[start, 2], queries.xyz[stop - 1, 2]
    return np.float64(x0), np.float64(x1), np.float64(y0), np.float64(y1), np.float64(z0), np.float64(z1)


@njit(nogil=True, cache=True)
def around(cells, box, radius, near):  # type: ignore[no-untyped-def]
    """Copy all points within ``radius`` of a box, and a few more; how many, or more than there is room for."""
    x0, x1, y0, y1, z0, z1 = box
    reach = radius * (1 + 1e-6) + 1e-6 * cells.cell_m
    n = 0
    first_row, last_row = cells_between(x0 - reach - cells.low[0], x1 + reach - cells.low[0], cells.cell_m)
    first_y, last_y = cells_between(y0 - reach - cells.low[1], y1 + reach - cells.low[1], cells.cell_m)
    for row in range(max(first_row, 0), min(last_row, len(cells.row_start) - 2) + 1):
        west = cells.low[0] + row * cells.cell_m
        dx = max(west - x1, x0 - west - cells.cell_m, 0.0)
        column, end = first_column(cells, row, first_y), cells.row_start[row + 1]
        while column < end and cells.column_y[column] <= last_y:
            south = cells.low[1] + cells.column_y[column] * cells.cell_m
            dy = max(south - y1, y0 - south - cells.cell_m, 0.0)
            sq_up = reach * reach - dx * dx - dy * dy
            if sq_up > 0.0:
                up = np.sqrt(sq_up) + 1e-6 * cells.cell_m
                p, stop = cells.column_start[column], cells.column_start[column + 1]
                p = first_above(cells.xyz, p, stop, z0 - up, False)
                while p < stop and cells.xyz[p, 2] <= z1 + up:
                    if n < len(near.sq):
                        near.x[n], near.y[n], near.z[n] = cells.xyz[p, 0], cells.xyz[p, 1], cells.xyz[p, 2]
                        near.idx[n] = cells.idx[p]
                    n += 1
                    p += 1
            column += 1
    return n


@njit(nogil=True, cache=True)
def measure(near, n, x, y, z):  # type: ignore[no-untyped-def]
    """Fill the squared distances of the first ``n`` points from (x, y, z), float64."""
    x, y, z = np.float64(x), np.float64(y), np.float64(z)
    for j in range(n):
        dx, dy, dz = np.float64(near.x[j]) - x, np.float64(near.y[j]) - y, np.float64(near.z[j]) - z
        near.sq[j] = dx * dx + dy * dy + dz * dz


@njit(nogil=True, cache=True)
def hits_within(near, n, sq_radius):  # type: ignore[no-untyped-def]
    """Fill ``near.hit`` with those of the first ``n`` points whose measured distance is within; how many."""
    n_hits = 0
    for j in range(n):
        near.hit[n_hits] = j
        n_hits += near.sq[j] <= sq_radius
    return n_hits


class Nearest(NamedTuple):
    """The nearest points of each query of a block, and room to sort them.

    Attributes
    ----------
    sq : (b, k) float64, m2
        Squared distances, nearest first.
    idx : (b, k) int32
        Indices in the cloud; the lower of equally near ones comes first.
    n : (b,) int32
        How many there are.
    best_sq, best_idx, bucket
        Room to sort.
    """

    sq: npt.NDArray[np.float64]
    idx: npt.NDArray[np.int32]
    n: npt.NDArray[np.int32]
    best_sq: npt.NDArray[np.float64]
    best_idx: npt.NDArray[np.int32]
    bucket: npt.NDArray[np.int32]


@njit(nogil=True, cache=True)
def room_for_nearest(k):  # type: ignore[no-untyped-def]
    """Room for the ``k`` nearest points of each query of a block."""
    return Nearest(
        np.empty((MOST_IN_BLOCK, k), dtype=np.float64),
        np.empty((MOST_IN_BLOCK, k), dtype=np.int32),
        np.empty(MOST_IN_BLOCK, dtype=np.int32),
        np.empty(k, dtype=np.float64),
        np.empty(k, dtype=np.int32),
        np.empty(2 * k + 24, dtype=np.int32),
    )


@njit(nogil=True, cache=True)
def nearest_of_block(cells, queries, start, stop, guess, max_distance, skips_self, near, found):  # type: ignore[no-untyped-def]
    """Fill ``found`` for sorted queries [start, stop) of one block, the first row for the first query.

    ``guess`` is how far to look at first, m: a matter of speed only. ``skips_self`` leaves out the point that has the
    index of the query. Returns the surroundings, perhaps with more room, and the guess that suits a next block.
    """
    k = found.idx.shape[1]
    box = box_of(queries, start, stop)
    farthest = min(max_distance, distance_to_far_corner(cells, box))
    radius = min(guess, farthest)
    sq_expected, sq_longest = radius * radius, 0.0
    found.n[: stop - start] = -1
    n_left = stop - start
    while n_left > 0:
        n = around(cells, box, radius, near)
        if n > len(near.sq):
            near = room_for(2 * n)
            around(cells, box, radius, near)
        fewest = k
        for q in range(start, stop):
            row = q - start
            if found.n[row] >= 0:
                continue
            skip = queries.idx[q] if skips_self else -1
            measure(near, n, queries.xyz[q, 0], queries.xyz[q, 1], queries.xyz[q, 2])
            n_found = _best_hits(near, n, min(sq_expected, radius * radius), skip, found, row)
            if n_found < k and sq_expected < radius * radius:
                n_found = _best_hits(near, n, radius * radius, skip, found, row)
            if n_found == k or radius >= farthest:
                n_left -= 1
                found.n[row] = n_found
                sq_reached = found.sq[row, k - 1] if n_found == k else radius * radius
                sq_expected, sq_longest = 1.3 * sq_reached, max(sq_longest, sq_reached)
            fewest = min(fewest, n_found)
        radius = min(radius * min(max(1.1 * np.sqrt(k / (fewest + 1.0)), 1.3), 2.0), farthest)
    return near, max(min(1.1 * np.sqrt(sq_longest), 2 * guess), 0.25 * cells.cell_m)


@njit(nogil=True, cache=True)
def distance_to_far_corner(cells, box):  # type: ignore[no-untyped-def]
    """At least as far as any point is from any place in the box, m."""
    x0, x1, y0, y1, z0, z1 = box
    dx = max(cells.high[0] - x0, x1 - cells.low[0])
    dy = max(cells.high[1] - y0, y1 - cells.low[1])
    dz = max(cells.high[2] - z0, z1 - cells.low[2])
    return np.sqrt(dx * dx + dy * dy + dz * dz) * (1 + 1e-9)


@njit(nogil=True, cache=True)
def _best_hits(near, n, sq_radius, skip, found, row):  # type: ignore[no-untyped-def]
    """Fill a row of ``found`` with the best of the measured points within, by (distance, index); how many there are."""
    n_hits = hits_within(near, n, sq_radius)
    _presort(near, n_hits, sq_radius, found.bucket)
    n_found = 0
    for h in range(n_hits):
        j = near.order[h]
        if near.idx[j] != skip:
            n_found = insert(near.sq[j], near.idx[j], found.best_sq, found.best_idx, n_found)
    for j in range(n_found):
        found.sq[row, j], found.idx[row, j] = found.best_sq[j], found.best_idx[j]
    return n_found


@njit(nogil=True, cache=True)
def _presort(near, n_hits, sq_radius, bucket):  # type: ignore[no-untyped-def]
    """Fill ``near.order`` with the hits, almost by distance: to insert them is then hardly any work."""
    n_buckets = len(bucket) - 1
    scale = (n_buckets - 0.5) / max(sq_radius, 1e-300)
    for b in range(n_buckets):
        bucket[b] = 0
    for h in range(n_hits):
        bucket[int(near.sq[near.hit[h]] * scale) + 1] += 1
    for b in range(1, n_buckets):
        bucket[b] += bucket[b - 1]
    for h in range(n_hits):
        j = near.hit[h]
        b = int(near.sq[j] * scale)
        near.order[bucket[b]] = j
        bucket[b] += 1


@njit(nogil=True, cache=True)
def insert(sq, idx, best_sq, best_idx, n_found):  # type: ignore[no-untyped-def]
    """Keep (sq, idx) if it is among the best, in order; how many there are now."""
    k = len(best_sq)
    if n_found == k:
        if not (sq < best_sq[k - 1] or (sq == best_sq[k - 1] and idx < best_idx[k - 1])):
            return k
        j = k - 1
    else:
        j = n_found
        n_found += 1
    while j > 0 and (best_sq[j - 1] > sq or (best_sq[j - 1] == sq and best_idx[j - 1] > idx)):
        best_sq[j], best_idx[j] = best_sq[j - 1], best_idx[j - 1]
        j -= 1
    best_sq[j], best_idx[j] = sq, idx
    return n_found
