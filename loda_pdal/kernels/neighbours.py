"""Neighbours in space: a cell list, k nearest neighbours, nearest point, all within a radius.

A cell list sorts points into square columns in plan and by height within each column, so the neighbours of a point are
a few contiguous runs. Only occupied columns are stored: memory follows the points, never the extent. Coordinates
are float32 about a local centre, distances are computed in float64, and ties go to the lower index, so results
depend neither on the cell size nor on the number of threads.

A kernel of your own that visits all points within a radius reads::

    @njit(nogil=True, cache=True)
    def _count_range(start, stop, cells, queries, radius, counts):
        runs = empty_runs(cells, radius)
        for q in range(start, stop):
            x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
            for r in range(runs_within(cells, x, y, z, radius, runs)):
                for p in range(runs[r, 0], runs[r, 1]):
                    if sq_distance(cells, p, x, y, z) <= radius * radius:
                        counts[q] += 1          # cells.idx[p] is the point's index

    cells = build_cells(xyz, radius)
    run_ranges(_count_range, len(queries), cells, to_cell_frame(cells, queries), radius, counts)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from loda_pdal.kernels.parallel import run_ranges

MOST_CELLS_ALONG = 1 << 22
"""Cells along x or y; a list that would need more gets larger cells."""

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int32]
Int64Array = npt.NDArray[np.int64]


class CellList(NamedTuple):
    """Points sorted by column (x cell, then y cell) and by z within a column.

    Attributes
    ----------
    xyz : (n, 3) float32, m
        Points about ``centre``, in sorted order.
    idx : (n,) int32
        Index that each sorted point has in the cloud.
    row_start : (nx + 1,) int32
        First column of each x cell.
    column_y : (c,) int32
        y cell of each occupied column.
    column_start : (c + 1,) int32
        First sorted point of each column.
    low, high : (3,) float64, m
        Extent of the sorted points, about ``centre``.
    cell_m : float
        Edge of a column.
    centre : (3,) float64, m
        What was subtracted.
    """

    xyz: Float32Array
    idx: IntArray
    row_start: IntArray
    column_y: IntArray
    column_start: IntArray
    low: FloatArray
    high: FloatArray
    cell_m: float
    centre: FloatArray


class NeighbourTable(NamedTuple):
    """k nearest neighbours: ``idx`` (q, k) int32, -1 padded, and ``distance`` (q, k) float32 m, inf padded."""

    idx: IntArray
    distance: Float32Array


class NeighbourLists(NamedTuple):
    """Neighbours of query q are ``idx[starts[q]:starts[q + 1]]``, by column and height; int64 (q + 1,) and int32."""

    starts: Int64Array
    idx: IntArray


def build_cells(xyz: npt.NDArray[Any], cell_m: float, centre: FloatArray | None = None) -> CellList:
    """Cell list of a cloud.

    Parameters
    ----------
    xyz : (n, 3) float, m
        Finite coordinates.
    cell_m : float
        Edge of a column. Radius searches are quickest with about the radius, or half of it.
    centre : (3,) float64, m, optional
        What to subtract before rounding to float32; whole metres near the middle of the cloud by default.
    """
    centre = middle_of(xyz) if centre is None else np.asarray(centre, dtype=np.float64)
    local = _about(xyz, centre)
    n = len(local)
    if n == 0:
        none = np.zeros(0, dtype=np.int32)
        start = np.zeros(1, dtype=np.int32)
        return CellList(local, none, start, none, start, np.zeros(3), np.zeros(3), float(cell_m), centre)
    low, high = local.min(axis=0).astype(np.float64), local.max(axis=0).astype(np.float64)
    cell = max(float(cell_m), float((high - low)[:2].max()) / MOST_CELLS_ALONG)
    n_x, n_y = (int(np.floor(span / cell)) + 1 for span in (high - low)[:2])
    key = np.empty(n, dtype=np.int64)
    run_ranges(_column_key_range, n, local, low, cell, n_y, key)
    order = np.lexsort((local[:, 2], key))
    key = key[order]
    column_start = np.append(np.flatnonzero(np.diff(key, prepend=-1)), n)
    column_x, column_y = np.divmod(key[column_start[:-1]], n_y)
    return CellList(
        xyz=local[order],
        idx=order.astype(np.int32),
        row_start=np.searchsorted(column_x, np.arange(n_x + 1)).astype(np.int32),
        column_y=column_y.astype(np.int32),
        column_start=column_start.astype(np.int32),
        low=low,
        high=high,
        cell_m=cell,
        centre=centre,
    )


def middle_of(xyz: npt.NDArray[Any]) -> FloatArray:
    """Whole metres in the middle of a cloud's extent, (3,) float64; zeros for an empty cloud."""
    if len(xyz) == 0:
        return np.zeros(3)
    return np.asarray(np.round((xyz.min(axis=0).astype(np.float64) + xyz.max(axis=0)) / 2))


def to_cell_frame(cells: CellList, xyz: npt.NDArray[Any]) -> Float32Array:
    """Queries (q, 3), m, as the kernels take them: float32 about the centre of the cell list."""
    return _about(xyz, cells.centre)


def _about(xyz: npt.NDArray[Any], centre: FloatArray) -> Float32Array:
    return np.ascontiguousarray(np.asarray(xyz, dtype=np.float64) - centre, dtype=np.float32)


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
    cells = build_cells(xyz, _cell_for(xyz, k))
    if queries is None:
        local, asked = cells.xyz, cells.idx
        skipped = np.full(0, -1, dtype=np.int32) if includes_self else cells.idx
    else:
        local, asked = to_cell_frame(cells, queries), np.arange(len(queries), dtype=np.int32)
        skipped = np.full(0, -1, dtype=np.int32)
    idx = np.full((len(local), k), -1, dtype=np.int32)
    distance = np.full((len(local), k), np.inf, dtype=np.float32)
    if len(cells.xyz):
        run_ranges(_knn_range, len(local), cells, local, asked, skipped, float(max_distance), idx, distance)
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
    cells = build_cells(xyz, radius)
    local = to_cell_frame(cells, xyz if queries is None else queries)
    starts = np.zeros(len(local) + 1, dtype=np.int64)
    if len(cells.xyz) == 0:
        return NeighbourLists(starts, np.zeros(0, dtype=np.int32))
    run_ranges(_count_range, len(local), cells, local, float(radius), starts[1:])
    np.cumsum(starts, out=starts)
    idx = np.empty(starts[-1], dtype=np.int32)
    run_ranges(_fill_range, len(local), cells, local, float(radius), starts, idx)
    return NeighbourLists(starts, idx)


def count_neighbours(xyz: npt.NDArray[Any], radius: float) -> Int64Array:
    """How many points of a cloud (n, 3) lie within ``radius``, m, of each of its points, itself included, (n,)."""
    cells = build_cells(xyz, radius)
    counts = np.zeros(len(xyz), dtype=np.int64)
    if len(cells.xyz):
        run_ranges(_count_range, len(xyz), cells, to_cell_frame(cells, xyz), float(radius), counts)
    return counts


def _cell_for(xyz: npt.NDArray[Any], k: int) -> float:
    """Column edge (m) that leaves a few points to each occupied column: a matter of speed only."""
    if len(xyz) == 0:
        return 1.0
    span = float(np.ptp(xyz[:, :2], axis=0).max())
    edge = max(span / 512, 1e-3)
    cell_xy = ((xyz[:, :2] - xyz[:, :2].min(axis=0)) / edge).astype(np.int64)
    n_occupied = np.count_nonzero(np.bincount(cell_xy[:, 0] * 514 + cell_xy[:, 1]))
    return edge * float(np.clip(np.sqrt(max(k, 4) * n_occupied / (2 * len(xyz))), 0.02, 20.0))


@njit(nogil=True, cache=True)
def sq_distance(cells, p, x, y, z):  # type: ignore[no-untyped-def]
    """Squared distance (m2, float64) of sorted point ``p`` from (x, y, z) in the frame of the cell list."""
    dx = np.float64(cells.xyz[p, 0]) - np.float64(x)
    dy = np.float64(cells.xyz[p, 1]) - np.float64(y)
    dz = np.float64(cells.xyz[p, 2]) - np.float64(z)
    return dx * dx + dy * dy + dz * dz


@njit(nogil=True, cache=True)
def empty_runs(cells, radius):  # type: ignore[no-untyped-def]
    """Room for the runs of any query of that radius, (r, 2) int32."""
    along = 2 * int(np.ceil(radius / cells.cell_m)) + 2
    return np.empty((min(along * along, len(cells.column_y)), 2), dtype=np.int32)


@njit(nogil=True, cache=True)
def runs_within(cells, x, y, z, radius, runs):  # type: ignore[no-untyped-def]
    """Fill ``runs`` with [start, stop) of sorted points that hold all points within ``radius``; how many runs."""
    x, y, z = np.float64(x), np.float64(y), np.float64(z)
    reach = radius * (1 + 1e-9)
    n_runs = 0
    first_row, last_row = _cells_between(x - reach - cells.low[0], x + reach - cells.low[0], cells.cell_m)
    first_y, last_y = _cells_between(y - reach - cells.low[1], y + reach - cells.low[1], cells.cell_m)
    for row in range(max(first_row, 0), min(last_row, len(cells.row_start) - 2) + 1):
        c, end = _first_column(cells, row, first_y), cells.row_start[row + 1]
        while c < end and cells.column_y[c] <= last_y:
            if _sq_gap_to_column(cells, row, cells.column_y[c], x, y) <= reach * reach:
                start = _first_above(cells.xyz, cells.column_start[c], cells.column_start[c + 1], z - reach, False)
                stop = _first_above(cells.xyz, start, cells.column_start[c + 1], z + reach, True)
                if stop > start:
                    runs[n_runs, 0], runs[n_runs, 1] = start, stop
                    n_runs += 1
            c += 1
    return n_runs


@njit(nogil=True, cache=True)
def _cells_between(low, high, cell):  # type: ignore[no-untyped-def]
    return int(np.floor(low / cell)), int(np.floor(high / cell))


@njit(nogil=True, cache=True)
def _first_column(cells, row, first_y):  # type: ignore[no-untyped-def]
    """First column of a row whose y cell is at least ``first_y``."""
    a, b = cells.row_start[row], cells.row_start[row + 1]
    while a < b:
        m = (a + b) >> 1
        if cells.column_y[m] < first_y:
            a = m + 1
        else:
            b = m
    return a


@njit(nogil=True, cache=True)
def _first_above(xyz, a, b, z, is_strict):  # type: ignore[no-untyped-def]
    """First of the sorted points [a, b) of a column that is at least ``z`` high, or higher where ``is_strict``."""
    while a < b:
        m = (a + b) >> 1
        if xyz[m, 2] < z or (is_strict and xyz[m, 2] == z):
            a = m + 1
        else:
            b = m
    return a


@njit(nogil=True, cache=True)
def _sq_gap_to_column(cells, row, column, x, y):  # type: ignore[no-untyped-def]
    """Squared distance in plan (m2) from (x, y) to a column, a hair too small rather than too large."""
    west = cells.low[0] + row * cells.cell_m
    south = cells.low[1] + column * cells.cell_m
    hair = 1e-6 * cells.cell_m
    dx = max(west - x, x - west - cells.cell_m, hair) - hair
    dy = max(south - y, y - south - cells.cell_m, hair) - hair
    return dx * dx + dy * dy


@njit(nogil=True, cache=True)
def _column_key_range(start, stop, xyz, low, cell, n_y, key):  # type: ignore[no-untyped-def]
    for i in range(start, stop):
        x = int(np.floor((xyz[i, 0] - low[0]) / cell))
        y = int(np.floor((xyz[i, 1] - low[1]) / cell))
        key[i] = x * n_y + y


@njit(nogil=True, cache=True)
def _knn_range(start, stop, cells, queries, asked, skipped, max_distance, out_idx, out_distance):  # type: ignore[no-untyped-def]
    k = out_idx.shape[1]
    best_sq, best_idx = np.empty(k, dtype=np.float64), np.empty(k, dtype=np.int32)
    guess = cells.cell_m
    for q in range(start, stop):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        skip = skipped[q] if len(skipped) else -1
        n_found, guess = k_nearest(cells, x, y, z, guess, max_distance, skip, best_sq, best_idx)
        for j in range(n_found):
            out_idx[asked[q], j] = best_idx[j]
            out_distance[asked[q], j] = np.sqrt(best_sq[j])


@njit(nogil=True, cache=True)
def k_nearest(cells, x, y, z, guess, max_distance, skip, best_sq, best_idx):  # type: ignore[no-untyped-def]
    """Fill ``best_*`` with the nearest points but ``skip``, by (squared distance, index); k is the length of them.

    Returns how many were found, and the ``guess`` of the distance at which they lie that suits a next query close by
    (``cells.cell_m`` suits the first). The guess is a matter of speed only.
    """
    x, y, z = np.float64(x), np.float64(y), np.float64(z)
    k = len(best_sq)
    farthest = min(max_distance, _distance_to_far_corner(cells, x, y, z))
    radius = min(guess, farthest)
    n_found = k_within(cells, x, y, z, radius, skip, best_sq, best_idx)
    while n_found < k and radius < farthest:
        radius = min(radius * min(max(1.1 * np.sqrt(k / (n_found + 1.0)), 1.3), 2.0), farthest)
        n_found = k_within(cells, x, y, z, radius, skip, best_sq, best_idx)
    reached = radius if n_found < k else 1.2 * np.sqrt(best_sq[k - 1])
    return n_found, max(min(reached, 2 * guess), 0.25 * cells.cell_m)


@njit(nogil=True, cache=True)
def _distance_to_far_corner(cells, x, y, z):  # type: ignore[no-untyped-def]
    dx = max(abs(x - cells.low[0]), abs(x - cells.high[0]))
    dy = max(abs(y - cells.low[1]), abs(y - cells.high[1]))
    dz = max(abs(z - cells.low[2]), abs(z - cells.high[2]))
    return np.sqrt(dx * dx + dy * dy + dz * dz) * (1 + 1e-9)


@njit(nogil=True, cache=True)
def k_within(cells, x, y, z, radius, skip, best_sq, best_idx):  # type: ignore[no-untyped-def]
    """The k best of the points within ``radius``, by (distance, index), into ``best_*``; how many were found."""
    k = len(best_sq)
    n_found = 0
    limit = radius * radius
    reach = radius * (1 + 1e-9)
    first_row, last_row = _cells_between(x - reach - cells.low[0], x + reach - cells.low[0], cells.cell_m)
    first_y, last_y = _cells_between(y - reach - cells.low[1], y + reach - cells.low[1], cells.cell_m)
    for row in range(max(first_row, 0), min(last_row, len(cells.row_start) - 2) + 1):
        c, end = _first_column(cells, row, first_y), cells.row_start[row + 1]
        while c < end and cells.column_y[c] <= last_y:
            if _sq_gap_to_column(cells, row, cells.column_y[c], x, y) <= limit:
                column_end = cells.column_start[c + 1]
                p = _first_above(cells.xyz, cells.column_start[c], column_end, z - reach, False)
                while p < column_end and cells.xyz[p, 2] <= z + reach:
                    sq = sq_distance(cells, p, x, y, z)
                    if sq <= limit and cells.idx[p] != skip:
                        n_found = _insert(sq, cells.idx[p], best_sq, best_idx, n_found)
                        if n_found == k:
                            limit = best_sq[k - 1]
                            reach = np.sqrt(limit) * (1 + 1e-9)
                    p += 1
            c += 1
    return n_found


@njit(nogil=True, cache=True)
def _insert(sq, idx, best_sq, best_idx, n_found):  # type: ignore[no-untyped-def]
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


@njit(nogil=True, cache=True)
def _count_range(start, stop, cells, queries, radius, counts):  # type: ignore[no-untyped-def]
    runs = empty_runs(cells, radius)
    for q in range(start, stop):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        for r in range(runs_within(cells, x, y, z, radius, runs)):
            for p in range(runs[r, 0], runs[r, 1]):
                if sq_distance(cells, p, x, y, z) <= radius * radius:
                    counts[q] += 1


@njit(nogil=True, cache=True)
def _fill_range(start, stop, cells, queries, radius, starts, idx):  # type: ignore[no-untyped-def]
    runs = empty_runs(cells, radius)
    for q in range(start, stop):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        i = starts[q]
        for r in range(runs_within(cells, x, y, z, radius, runs)):
            for p in range(runs[r, 0], runs[r, 1]):
                if sq_distance(cells, p, x, y, z) <= radius * radius:
                    idx[i] = cells.idx[p]
                    i += 1
