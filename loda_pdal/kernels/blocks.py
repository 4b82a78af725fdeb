"""Many queries at once: those that are close together share one copy of the points around them.

Queries are a cell list too, often that of the cloud itself. A block is a piece of one of its columns, as high as it is
wide; the points around it are copied once, coordinate by coordinate, and each query runs over these short arrays. A
kernel of your own that visits all points within a radius reads::

    @kernel
    def _count_range(start, stop, room, blocks, queries, cells, radius, counts):
        for block in range(start, stop):
            n = around(room, cells, box_of(queries, blocks[block], blocks[block + 1]), radius)
            if n < 0:
                return block
            for q in range(blocks[block], blocks[block + 1]):
                measure(room, n, queries, q)
                counts[queries.idx[q]] = hits_within(room, n, radius * radius)
                # room.idx[room.hit[h]] is the index of a point within the radius
        return stop

    cells = build_cells(xyz, max(radius, block_edge(xyz)))
    run_blocks(_count_range, cells, cells, radius, counts)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from loda_pdal.kernels.cells import CellList, cells_between, extent, first_above, first_column
from loda_pdal.kernels.compiled import inner, kernel
from loda_pdal.kernels.parallel import run_ranges

POINTS_PER_COLUMN = 24
"""Points per column, on average, at which blocks are quickest."""

MOST_IN_BLOCK = 256
"""Queries in a block."""

BLOCKS_PER_RANGE = 64
"""Blocks worth a thread."""


class Room(NamedTuple):
    """The points around a block, by column and height, and what its queries find among them.

    Attributes
    ----------
    x, y, z : (m,) float32, m
        Coordinates about the centre of the cell list; of these and what follows the first n mean something.
    idx : (m,) int32
        Indices in the cloud.
    sq : (m,) float64, m2
        Squared distances from the last query.
    hit : (m + 1,) int32
        Which of the points the last query found within a radius.
    nearest_sq : (b, k) float64, m2
        Squared distances of the nearest points of each query of the block, in order.
    nearest_idx : (b, k) int32
        Their indices in the cloud; the lower of equally near ones comes first.
    n_nearest : (b,) int32
        How many there are.
    order, ring, best_sq, best_idx
        Room to sort.
    """

    x: npt.NDArray[np.float32]
    y: npt.NDArray[np.float32]
    z: npt.NDArray[np.float32]
    idx: npt.NDArray[np.int32]
    sq: npt.NDArray[np.float64]
    hit: npt.NDArray[np.int32]
    nearest_sq: npt.NDArray[np.float64]
    nearest_idx: npt.NDArray[np.int32]
    n_nearest: npt.NDArray[np.int32]
    order: npt.NDArray[np.int32]
    ring: npt.NDArray[np.int32]
    best_sq: npt.NDArray[np.float64]
    best_idx: npt.NDArray[np.int32]


def run_blocks(kernel: Callable[..., int], queries: CellList, *args: Any, k: int = 0) -> None:
    """Call ``kernel(start, stop, room, blocks, queries, *args)`` for ranges that cover the blocks of queries once.

    Block b is the sorted queries ``blocks[b]`` to ``blocks[b + 1]``. A kernel returns the block that it reached: it is
    called again from there, with twice the room, if that is not ``stop`` because there were too many points around.
    ``k`` is how many nearest points of each query there is room for.
    """
    starts = np.empty(len(queries.xyz) + 1, dtype=np.int64)
    n_blocks = _find_blocks(queries.xyz, queries.column_start, queries.cell_m, starts)
    blocks = starts[: n_blocks + 1].copy()

    def run(start: int, stop: int) -> None:
        m = 1024
        while start < stop:
            start = kernel(start, stop, _room_for(m, k), blocks, queries, *args)
            m *= 2

    run_ranges(run, n_blocks, min_size=BLOCKS_PER_RANGE)


def block_edge(xyz: npt.NDArray[Any], k: int = 1) -> float:
    """Column edge (m) that leaves `POINTS_PER_COLUMN`, or k, to each occupied column: a matter of speed only."""
    low, high = extent(xyz[:, :2])
    edge = max(float((high - low).max()) / 512, 1e-3)
    is_occupied = np.zeros((514, 514), dtype=np.bool_)
    is_occupied[tuple(((xyz[:, axis] - low[axis]) / edge).astype(np.int32) for axis in range(2))] = True
    density = max(len(xyz), 1) / max(int(np.count_nonzero(is_occupied)), 1)
    return edge * float(np.clip(np.sqrt(max(k, POINTS_PER_COLUMN) / density), 0.02, 20.0))


def _room_for(m: int, k: int) -> Room:
    whole, real, single = np.int32, np.float64, np.float32
    return Room(
        x=np.empty(m, single),
        y=np.empty(m, single),
        z=np.empty(m, single),
        idx=np.empty(m, whole),
        sq=np.empty(m, real),
        hit=np.empty(m + 1, whole),
        nearest_sq=np.empty((MOST_IN_BLOCK, k), real),
        nearest_idx=np.empty((MOST_IN_BLOCK, k), whole),
        n_nearest=np.empty(MOST_IN_BLOCK, whole),
        order=np.empty(m, whole),
        ring=np.empty(2 * k + 24, whole),
        best_sq=np.empty(k, real),
        best_idx=np.empty(k, whole),
    )


@kernel
def _find_blocks(xyz, column_start, height, starts):  # type: ignore[no-untyped-def]
    """Fill the first point of each block, and the number of points at the end; how many blocks."""
    n_blocks = first = 0
    for column in range(len(column_start) - 1):
        for p in range(column_start[column], column_start[column + 1]):
            if p == column_start[column] or xyz[p, 2] > xyz[first, 2] + height or p - first == MOST_IN_BLOCK:
                first = starts[n_blocks] = p
                n_blocks += 1
    starts[n_blocks] = len(xyz)
    return n_blocks


@inner
def box_of(queries, start, stop):  # type: ignore[no-untyped-def]
    """Box around sorted queries [start, stop) of a block: x from, x to, y from, y to, z from, z to."""
    x0 = x1 = np.float64(queries.xyz[start, 0])
    y0 = y1 = np.float64(queries.xyz[start, 1])
    for q in range(start + 1, stop):
        x, y = np.float64(queries.xyz[q, 0]), np.float64(queries.xyz[q, 1])
        x0, x1, y0, y1 = min(x0, x), max(x1, x), min(y0, y), max(y1, y)
    return x0, x1, y0, y1, np.float64(queries.xyz[start, 2]), np.float64(queries.xyz[stop - 1, 2])


@inner
def around(room, cells, box, radius):  # type: ignore[no-untyped-def]
    """Copy all points within ``radius`` of a box, and a few more; how many, -1 if there is not enough room."""
    x0, x1, y0, y1, z0, z1 = box
    hair = 1e-6 * cells.cell_m
    reach = radius * (1 + 1e-6) + hair
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
                up = np.sqrt(sq_up) + hair
                p, stop = cells.column_start[column], cells.column_start[column + 1]
                p = first_above(cells.xyz, p, stop, z0 - up, False)
                while p < stop and cells.xyz[p, 2] <= z1 + up:
                    if n == len(room.sq):
                        return -1
                    room.x[n], room.y[n], room.z[n] = cells.xyz[p, 0], cells.xyz[p, 1], cells.xyz[p, 2]
                    room.idx[n] = cells.idx[p]
                    n += 1
                    p += 1
            column += 1
    return n


@inner
def measure(room, n, queries, q):  # type: ignore[no-untyped-def]
    """Fill the squared distances of the first ``n`` points from sorted query ``q``, float64."""
    x, y, z = np.float64(queries.xyz[q, 0]), np.float64(queries.xyz[q, 1]), np.float64(queries.xyz[q, 2])
    for j in range(n):
        dx, dy, dz = np.float64(room.x[j]) - x, np.float64(room.y[j]) - y, np.float64(room.z[j]) - z
        room.sq[j] = dx * dx + dy * dy + dz * dz


@inner
def hits_within(room, n, sq_radius):  # type: ignore[no-untyped-def]
    """Fill ``room.hit`` with those of the first ``n`` points whose measured distance is within; how many."""
    n_hits = 0
    for j in range(n):  # without a branch: which points are within cannot be foreseen
        room.hit[n_hits] = j
        n_hits += room.sq[j] <= sq_radius
    return n_hits


@inner
def nearest_of_block(room, queries, start, stop, cells, guess, max_distance):  # type: ignore[no-untyped-def]
    """Fill the nearest points of the queries [start, stop) of a block, those of the first query in the first row.

    ``guess`` is how far to look at first, m: a matter of speed only. Returns the guess that suits a next block; -1 if
    there is not enough room.
    """
    k = room.nearest_idx.shape[1]
    box = box_of(queries, start, stop)
    farthest = min(max_distance, distance_to_far_corner(cells, box))
    radius = min(guess, farthest)
    sq_expected, sq_longest = radius * radius, 0.0
    for row in range(stop - start):
        room.n_nearest[row] = -1
    n_left = stop - start
    while n_left > 0:
        n = around(room, cells, box, radius)
        if n < 0:
            return -1.0
        fewest = k
        for row in range(stop - start):
            if room.n_nearest[row] >= 0:
                continue
            q = start + row
            measure(room, n, queries, q)
            n_found = _sort_hits(room, n, min(sq_expected, radius * radius), row)
            if n_found < k and sq_expected < radius * radius:
                n_found = _sort_hits(room, n, radius * radius, row)
            if n_found == k or radius >= farthest:
                n_left -= 1
                room.n_nearest[row] = n_found
                sq_reached = room.nearest_sq[row, k - 1] if n_found == k else radius * radius
                sq_expected, sq_longest = 1.3 * sq_reached, max(sq_longest, sq_reached)
            fewest = min(fewest, n_found)
        radius = min(radius * min(max(1.1 * np.sqrt(k / (fewest + 1.0)), 1.3), 2.0), farthest)
    return max(min(1.1 * np.sqrt(sq_longest), 2 * guess), 0.25 * cells.cell_m)


@inner
def distance_to_far_corner(cells, box):  # type: ignore[no-untyped-def]
    """At least as far, m, as any point is from any place in a box."""
    x0, x1, y0, y1, z0, z1 = box
    dx = max(cells.high[0] - x0, x1 - cells.low[0])
    dy = max(cells.high[1] - y0, y1 - cells.low[1])
    dz = max(cells.high[2] - z0, z1 - cells.low[2])
    return np.sqrt(dx * dx + dy * dy + dz * dz) * (1 + 1e-9)


@inner
def _sort_hits(room, n, sq_radius, row):  # type: ignore[no-untyped-def]
    """Fill a row with the nearest of the measured points within; how many there are."""
    n_hits = hits_within(room, n, sq_radius)
    _order_by_ring(room, n_hits, sq_radius)
    n_found = np.int64(0)
    for h in range(n_hits):
        j = room.order[h]
        n_found = insert(room.sq[j], room.idx[j], room.best_sq, room.best_idx, n_found)
    for j in range(n_found):
        room.nearest_sq[row, j], room.nearest_idx[row, j] = room.best_sq[j], room.best_idx[j]
    return n_found


@inner
def _order_by_ring(room, n_hits, sq_radius):  # type: ignore[no-untyped-def]
    """Order the hits by rings of equal area, and so almost by distance: to insert them is then hardly any work."""
    scale = (len(room.ring) - 1.5) / max(sq_radius, 1e-300)
    for r in range(len(room.ring)):
        room.ring[r] = 0
    for h in range(n_hits):
        room.ring[int(room.sq[room.hit[h]] * scale) + 1] += 1
    for r in range(1, len(room.ring)):
        room.ring[r] += room.ring[r - 1]
    for h in range(n_hits):
        j = room.hit[h]
        r = int(room.sq[j] * scale)
        room.order[room.ring[r]] = j
        room.ring[r] += 1


@inner
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
