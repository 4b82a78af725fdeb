"""Neighbours in space: k nearest neighbours, nearest point, all within a radius; by `cells` and `blocks`.

Ties go to the lower index, so results depend neither on the cell size nor on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from loda_pdal.kernels.blocks import (
    around,
    box_of,
    distance_to_far_corner,
    end_of_block,
    hits_within,
    insert,
    measure,
    nearest_of_block,
    room_for,
    room_for_nearest,
    run_columns,
)
from loda_pdal.kernels.cells import (
    CellList,
    Float32Array,
    FloatArray,
    Int64Array,
    IntArray,
    block_edge,
    build_cells,
    cells_between,
    empty_runs,
    first_above,
    first_column,
    middle_of,
    runs_within,
    sq_distance,
    sq_gap_to_column,
    to_cell_frame,
)
from loda_pdal.kernels.parallel import run_ranges


class NeighbourTable(NamedTuple):
    """k nearest neighbours: ``idx`` (q, k) int32, -1 padded, and ``distance`` (q, k) float32 m, inf padded."""

    idx: IntArray
    distance: Float32Array


class NeighbourLists(NamedTuple):
    """Neighbours of query q are ``idx[starts[q]:starts[q + 1]]``, by column and height; int64 (q + 1,) and int32."""

    starts: Int64Array
    idx: IntArray


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
    skips_self = queries is None and not includes_self
    idx = np.full((len(asked.xyz), k), -1, dtype=np.int32)
    distance = np.full((len(asked.xyz), k), np.inf, dtype=np.float32)
    if len(cells.xyz):
        run_columns(_knn_range, asked, cells, float(max_distance), skips_self, idx, distance)
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


def radius_neighbours(xyz: npt.NDArray[Any], radius: float, queries: npt.NDArray[Any] | None = None) -> NeighbourLists:
    """All points of a cloud (n, 3) within ``radius``, m, of each query (q, 3), the cloud itself by default.

    A point of the cloud is among its own neighbours.
    """
    cells = build_cells(xyz, max(radius, block_edge(xyz)))
    asked = cells if queries is None else _like(cells, queries)
    starts = np.zeros(len(asked.xyz) + 1, dtype=np.int64)
    run_columns(_count_range, asked, cells, float(radius), starts[1:])
    np.cumsum(starts, out=starts)
    idx = np.empty(starts[-1], dtype=np.int32)
    run_columns(_fill_range, asked, cells, float(radius), starts, idx)
    return NeighbourLists(starts, idx)


def count_neighbours(xyz: npt.NDArray[Any], radius: float) -> Int64Array:
    """How many points of a cloud (n, 3) lie within ``radius``, m, of each of its points, itself included, (n,)."""
    cells = build_cells(xyz, max(radius, block_edge(xyz)))
    counts = np.zeros(len(xyz), dtype=np.int64)
    run_columns(_count_range, cells, cells, float(radius), counts)
    return counts


def _like(cells: CellList, queries: npt.NDArray[Any]) -> CellList:
    """Cell list of queries (q, 3), m, in the frame of another."""
    return build_cells(queries, cells.cell_m, cells.centre)


@njit(nogil=True, cache=True)
def _knn_range(start, stop, queries, cells, max_distance, skips_self, idx, distance):  # type: ignore[no-untyped-def]
    near, found = room_for(1024), room_for_nearest(idx.shape[1])
    guess = cells.cell_m
    for column in range(start, stop):
        q, column_stop = queries.column_start[column], queries.column_start[column + 1]
        while q < column_stop:
            block_stop = end_of_block(queries, q, column_stop)
            near, guess = nearest_of_block(cells, queries, q, block_stop, guess, max_distance, skips_self, near, found)
            for row in range(block_stop - q):
                i = queries.idx[q + row]
                for j in range(found.n[row]):
                    idx[i, j] = found.idx[row, j]
                    distance[i, j] = np.sqrt(found.sq[row, j])
            q = block_stop


@njit(nogil=True, cache=True)
def _count_range(start, stop, queries, cells, radius, counts):  # type: ignore[no-untyped-def]
    near = room_for(1024)
    for column in range(start, stop):
        q, column_stop = queries.column_start[column], queries.column_start[column + 1]
        while q < column_stop:
            block_stop = end_of_block(queries, q, column_stop)
            box = box_of(queries, q, block_stop)
            n = around(cells, box, radius, near)
            if n > len(near.sq):
                near = room_for(2 * n)
                around(cells, box, radius, near)
            while q < block_stop:
                measure(near, n, queries.xyz[q, 0], queries.xyz[q, 1], queries.xyz[q, 2])
                counts[queries.idx[q]] = hits_within(near, n, radius * radius)
                q += 1


@njit(nogil=True, cache=True)
def _fill_range(start, stop, queries, cells, radius, starts, idx):  # type: ignore[no-untyped-def]
    near = room_for(1024)
    for column in range(start, stop):
        q, column_stop = queries.column_start[column], queries.column_start[column + 1]
        while q < column_stop:
            block_stop = end_of_block(queries, q, column_stop)
            box = box_of(queries, q, block_stop)
            n = around(cells, box, radius, near)
            if n > len(near.sq):
                near = room_for(2 * n)
                around(cells, box, radius, near)
            while q < block_stop:
                measure(near, n, queries.xyz[q, 0], queries.xyz[q, 1], queries.xyz[q, 2])
                first = starts[queries.idx[q]]
                for h in range(hits_within(near, n, radius * radius)):
                    idx[first + h] = near.idx[near.hit[h]]
                q += 1


@njit(nogil=True, cache=True)
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


@njit(nogil=True, cache=True)
def k_within(cells, x, y, z, radius, skip, best_sq, best_idx):  # type: ignore[no-untyped-def]
    """The k best of the points within ``radius``, by (distance, index), into ``best_*``; how many were found."""
    k = len(best_sq)
    n_found = 0
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


