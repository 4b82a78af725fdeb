"""Neighbours in space: k nearest neighbours, nearest point, mean distances; by `cells` and `blocks`.

Ties go to the lower index, so results depend neither on the cell size nor on the number of threads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from loda_pdal.kernels.blocks import (
    block_edge,
    distance_to_far_corner,
    insert,
    nearest_of_block,
    run_blocks,
)
from loda_pdal.kernels.cells import (
    CellList,
    Float32Array,
    FloatArray,
    IntArray,
    build_cells,
    cells_between,
    first_above,
    first_column,
    sq_distance,
    sq_gap_to_column,
)
from loda_pdal.kernels.compiled import inner, kernel


class NeighbourTable(NamedTuple):
    """k nearest neighbours: ``idx`` (q, k) int32, -1 padded, and ``distance`` (q, k) float32 m, inf padded."""

    idx: IntArray
    distance: Float32Array


def knn(
    xyz: npt.NDArray[Any],
    k: int,
    max_distance: float = np.inf,
    queries: npt.NDArray[Any] | None = None,
    *,
    includes_self: bool = True,
) -> NeighbourTable:
    """The k nearest points, nearest first; equally near ones by index.

    Parameters
    ----------
    xyz : (n, 3) float, m
        The cloud.
    k : int
        Neighbours per query.
    max_distance : float, m
        Farther points are no neighbours.
    queries : (q, 3) float, m, optional
        Where to look from; the cloud itself by default.
    includes_self : bool
        Whether a point of the cloud is its own (first) neighbour, where the cloud itself is asked.

    Returns
    -------
    NeighbourTable
        ``idx`` (q, k) int32 padded with -1, ``distance`` (q, k) float32 padded with inf.
    """
    cells = build_cells(xyz, block_edge(xyz, k))
    asked = cells if queries is None else _like(cells, queries)
    includes_self = includes_self or queries is not None
    idx = np.empty((len(asked.xyz), k), dtype=np.int32)
    distance = np.empty((len(asked.xyz), k), dtype=np.float32)
    room = k if includes_self else k + 1
    run_blocks(_knn_range, asked, cells, float(max_distance), includes_self, idx, distance, k=room)
    return NeighbourTable(idx, distance)


def nearest(
    xyz: npt.NDArray[Any], queries: npt.NDArray[Any], max_distance: float = np.inf
) -> tuple[IntArray, Float32Array]:
    """The nearest point of a cloud (n, 3) to each query (q, 3), m.

    Returns
    -------
    idx : (q,) int32
        Nearest point, the lowest of equally near ones; -1 where there is none within ``max_distance``.
    distance : (q,) float32, m
        How far it is; inf where there is none.
    """
    found = knn(xyz, 1, max_distance, queries)
    return found.idx[:, 0], found.distance[:, 0]


def mean_distances(xyz: npt.NDArray[Any], k: int) -> FloatArray:
    """Mean distance, m, of each point of a cloud (n, 3) to its k nearest others, (n,) float64; k is less than n."""
    cells = build_cells(xyz, block_edge(xyz, k))
    mean = np.empty(len(xyz), dtype=np.float64)
    run_blocks(_mean_distance_range, cells, mean, k=k + 1)
    return mean


def _like(cells: CellList, queries: npt.NDArray[Any]) -> CellList:
    """Cell list of queries (q, 3), m, in the frame of another."""
    return build_cells(queries, cells.cell_m, cells.centre)


@kernel
def _knn_range(  # type: ignore[no-untyped-def]
    start, stop, room, blocks, queries, cells, max_distance, includes_self, idx, distance
):
    guess = cells.cell_m
    for block in range(start, stop):
        first, last = blocks[block], blocks[block + 1]
        guess = nearest_of_block(room, queries, first, last, cells, guess, max_distance)
        if guess < 0.0:
            return block
        for q in range(first, last):
            row, i, n = q - first, queries.idx[q], 0
            for j in range(room.n_nearest[row]):
                if n < idx.shape[1] and (includes_self or room.nearest_idx[row, j] != i):
                    idx[i, n] = room.nearest_idx[row, j]
                    distance[i, n] = np.sqrt(room.nearest_sq[row, j])
                    n += 1
            for j in range(n, idx.shape[1]):
                idx[i, j] = -1
                distance[i, j] = np.inf
    return stop


@kernel
def _mean_distance_range(start, stop, room, blocks, cells, mean):  # type: ignore[no-untyped-def]
    guess = cells.cell_m
    for block in range(start, stop):
        first, last = blocks[block], blocks[block + 1]
        guess = nearest_of_block(room, cells, first, last, cells, guess, np.inf)
        if guess < 0.0:
            return block
        for q in range(first, last):
            row, n, total = q - first, 0, 0.0
            for j in range(room.n_nearest[row]):
                if n < room.nearest_idx.shape[1] - 1 and room.nearest_idx[row, j] != cells.idx[q]:
                    total += np.float64(np.float32(np.sqrt(room.nearest_sq[row, j])))
                    n += 1
            mean[cells.idx[q]] = total / n
    return stop


@kernel
def k_nearest(cells, x, y, z, guess, max_distance, skip, best_sq, best_idx):  # type: ignore[no-untyped-def]
    """Fill ``best_*`` with the nearest points but ``skip``, by (squared distance, index); k is the length of them.

    Returns how many were found, and the ``guess`` of the distance at which they lie that suits a next query close by
    (``cells.cell_m`` suits the first). The guess is a matter of speed only.
    """
    x, y, z = np.float64(x), np.float64(y), np.float64(z)
    k = len(best_sq)
    farthest = min(max_distance, distance_to_far_corner(cells, (x, x, y, y, z, z)))
    radius = min(guess, farthest)
    n_found = k_within(cells, x, y, z, radius, skip, best_sq, best_idx)
    while n_found < k and radius < farthest:
        radius = min(radius * min(max(1.1 * np.sqrt(k / (n_found + 1.0)), 1.3), 2.0), farthest)
        n_found = k_within(cells, x, y, z, radius, skip, best_sq, best_idx)
    reached = radius if n_found < k else 1.2 * np.sqrt(best_sq[k - 1])
    return n_found, max(min(reached, 2 * guess), 0.25 * cells.cell_m)


@inner
def k_within(cells, x, y, z, radius, skip, best_sq, best_idx):  # type: ignore[no-untyped-def]
    """The k best of the points within ``radius``, by (distance, index), into ``best_*``; how many were found."""
    k = len(best_sq)
    n_found = np.int64(0)
    limit = radius * radius
    reach = radius * (1 + 1e-9)
    first_row, last_row = cells_between(x - reach - cells.low[0], x + reach - cells.low[0], cells.cell_m)
    first_y, last_y = cells_between(y - reach - cells.low[1], y + reach - cells.low[1], cells.cell_m)
    for row in range(max(first_row, 0), min(last_row, len(cells.row_start) - 2) + 1):
        c, end = first_column(cells, row, first_y), cells.row_start[row + 1]
        while c < end and cells.column_y[c] <= last_y:
            if sq_gap_to_column(cells, row, cells.column_y[c], x, y) <= limit:
                column_end = cells.column_start[c + 1]
                p = first_above(cells.xyz, cells.column_start[c], column_end, z - reach, False)
                while p < column_end and cells.xyz[p, 2] <= z + reach:
                    sq = sq_distance(cells, p, x, y, z)
                    if sq <= limit and cells.idx[p] != skip:
                        n_found = insert(sq, cells.idx[p], best_sq, best_idx, n_found)
                        if n_found == k:
                            limit = best_sq[k - 1]
                            reach = np.sqrt(limit) * (1 + 1e-9)
                    p += 1
            c += 1
    return n_found
