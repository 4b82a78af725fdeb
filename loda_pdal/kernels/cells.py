"""Cell list of a cloud: its points in square columns in plan, by height within each column.

The neighbours of a point are then a few contiguous runs. Only occupied columns are stored: memory follows the points,
never the extent. Coordinates are float32 about a local centre, distances are computed in float64, and what is said
about distances depends neither on the cell size nor on the number of threads.

A kernel of your own that visits all points within a radius of a few queries reads::

    @kernel
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

Where the queries are as many as the points, `blocks` is several times faster.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from loda_pdal.kernels.compiled import inner, kernel
from loda_pdal.kernels.parallel import run_ranges

MOST_CELLS_ALONG = 1 << 22
"""Cells along x or y; a list that would need more gets larger cells."""

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int32]
Int64Array = npt.NDArray[np.int64]


class CellList(NamedTuple):
    """Points sorted by column (x cell, then y cell), by z within a column, and equally high ones by index.

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


def build_cells(xyz: npt.NDArray[Any], cell_m: float, centre: FloatArray | None = None) -> CellList:
    """Cell list of a cloud.

    Parameters
    ----------
    xyz : (n, 3) float, m
        Finite coordinates.
    cell_m : float
        Edge of a column. Radius searches are quickest with about the radius.
    centre : (3,) float64, m, optional
        What to subtract before rounding to float32; whole metres near the middle of the cloud by default.
    """
    centre = middle_of(xyz) if centre is None else np.asarray(centre, dtype=np.float64)
    local = _about(xyz, centre)
    n = len(local)
    low, high = extent(local)
    cell = max(float(cell_m), float((high - low)[:2].max()) / MOST_CELLS_ALONG)
    n_x, n_y = (int(np.floor(span / cell)) + 1 for span in (high - low)[:2])
    cell_xy = np.empty((2, n), dtype=np.int32)
    run_ranges(_cell_range, n, local, low, cell, cell_xy)
    by_y, idx = np.arange(n, dtype=np.int32), np.empty(n, dtype=np.int32)
    _sort_by(cell_xy[1], np.zeros(n_y + 1, dtype=np.int32), by_y.copy(), by_y)
    _sort_by(cell_xy[0], np.zeros(n_x + 1, dtype=np.int32), by_y, idx)
    row_start = np.zeros(n_x + 1, dtype=np.int32)
    column_y, column_start = np.empty(n, dtype=np.int32), np.empty(n + 1, dtype=np.int32)
    n_columns = _find_columns(cell_xy, idx, row_start, column_y, column_start)
    column_y, column_start = column_y[:n_columns].copy(), column_start[: n_columns + 1].copy()
    sorted_xyz, key = np.empty_like(local), np.empty(n, dtype=np.int64)
    run_ranges(_sort_column_range, n_columns, column_start, local, local.view(np.int32), key, idx, sorted_xyz)
    return CellList(sorted_xyz, idx, row_start, column_y, column_start, low, high, cell, centre)


def extent(xyz: npt.NDArray[Any]) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest coordinates (d,) float64 of points (n, d); zeros where there are no points.

    Column by column: a reduction along the first axis of an array of points takes twenty times as long.
    """
    if len(xyz) == 0:
        return np.zeros(xyz.shape[1]), np.zeros(xyz.shape[1])
    low, high = ([reduce(column) for column in xyz.T] for reduce in (np.min, np.max))
    return np.array(low, dtype=np.float64), np.array(high, dtype=np.float64)


def middle_of(xyz: npt.NDArray[Any]) -> FloatArray:
    """Whole metres in the middle of a cloud's extent, (3,) float64; zeros for an empty cloud."""
    low, high = extent(xyz)
    return np.asarray(np.round((low + high) / 2))


def to_cell_frame(cells: CellList, xyz: npt.NDArray[Any]) -> Float32Array:
    """Queries (q, 3), m, as the kernels take them: float32 about the centre of the cell list."""
    return _about(xyz, cells.centre)


def _about(xyz: npt.NDArray[Any], centre: FloatArray) -> Float32Array:
    return np.ascontiguousarray(np.asarray(xyz, dtype=np.float64) - centre, dtype=np.float32)


@kernel
def _cell_range(start, stop, xyz, low, cell, cell_xy):  # type: ignore[no-untyped-def]
    """Cell along x and along y, (2, n) int32, of points [start, stop)."""
    for i in range(start, stop):
        cell_xy[0, i] = int(np.floor((xyz[i, 0] - low[0]) / cell))
        cell_xy[1, i] = int(np.floor((xyz[i, 1] - low[1]) / cell))


@kernel
def _sort_by(key, start, order, result):  # type: ignore[no-untyped-def]
    """Fill ``result`` with the indices ``order`` by their key; equal ones stay in order. ``start`` is all zeros."""
    for i in range(len(key)):
        start[key[i] + 1] += 1
    for k in range(1, len(start)):
        start[k] += start[k - 1]
    for j in range(len(order)):
        i = order[j]
        result[start[key[i]]] = i
        start[key[i]] += 1


@kernel
def _find_columns(cell_xy, idx, row_start, column_y, column_start):  # type: ignore[no-untyped-def]
    """Fill three arrays of a `CellList`, given the points by column; how many columns. ``row_start`` is all zeros."""
    n_columns, x, y = 0, -1, -1
    for p in range(len(idx)):
        i = idx[p]
        if cell_xy[0, i] != x or cell_xy[1, i] != y:
            x, y = cell_xy[0, i], cell_xy[1, i]
            row_start[x + 1] += 1
            column_y[n_columns] = y
            column_start[n_columns] = p
            n_columns += 1
    column_start[n_columns] = len(idx)
    for row in range(1, len(row_start)):
        row_start[row] += row_start[row - 1]
    return n_columns


@kernel
def _sort_column_range(start, stop, column_start, xyz, xyz_bits, key, idx, sorted_xyz):  # type: ignore[no-untyped-def]
    """Sort the points of columns [start, stop) by height, then index: Shell sort of both in one integer."""
    for column in range(start, stop):
        first, last = column_start[column], column_start[column + 1]
        for p in range(first, last):
            bits = np.int64(xyz_bits[idx[p], 2])
            height = bits if bits >= 0 else -(bits & 0x7FFFFFFF)  # integers in the order of the float32
            key[p] = (height << 32) | idx[p]
        gap = 1
        while 3 * gap < last - first:
            gap = 3 * gap + 1
        while gap > 0:
            for p in range(first + gap, last):
                value, at = key[p], p
                while at >= first + gap and key[at - gap] > value:
                    key[at] = key[at - gap]
                    at -= gap
                key[at] = value
            gap //= 3
        for p in range(first, last):
            i = key[p] & 0x7FFFFFFF
            idx[p] = i
            sorted_xyz[p, 0], sorted_xyz[p, 1], sorted_xyz[p, 2] = xyz[i, 0], xyz[i, 1], xyz[i, 2]


@inner
def sq_distance(cells, p, x, y, z):  # type: ignore[no-untyped-def]
    """Squared distance (m2, float64) of sorted point ``p`` from (x, y, z) in the frame of the cell list."""
    dx = np.float64(cells.xyz[p, 0]) - np.float64(x)
    dy = np.float64(cells.xyz[p, 1]) - np.float64(y)
    dz = np.float64(cells.xyz[p, 2]) - np.float64(z)
    return dx * dx + dy * dy + dz * dz


@inner
def empty_runs(cells, radius):  # type: ignore[no-untyped-def]
    """Room for the runs of any query of that radius, (r, 2) int32."""
    along = 2 * int(np.ceil(radius / cells.cell_m)) + 2
    return np.empty((min(along * along, len(cells.column_y)), 2), dtype=np.int32)


@inner
def runs_within(cells, x, y, z, radius, runs):  # type: ignore[no-untyped-def]
    """Fill ``runs`` with [start, stop) of sorted points that hold all points within ``radius``; how many runs."""
    x, y, z = np.float64(x), np.float64(y), np.float64(z)
    reach = radius * (1 + 1e-9)
    n_runs = 0
    first_row, last_row = cells_between(x - reach - cells.low[0], x + reach - cells.low[0], cells.cell_m)
    first_y, last_y = cells_between(y - reach - cells.low[1], y + reach - cells.low[1], cells.cell_m)
    for row in range(max(first_row, 0), min(last_row, len(cells.row_start) - 2) + 1):
        c, end = first_column(cells, row, first_y), cells.row_start[row + 1]
        while c < end and cells.column_y[c] <= last_y:
            if sq_gap_to_column(cells, row, cells.column_y[c], x, y) <= reach * reach:
                start = first_above(cells.xyz, cells.column_start[c], cells.column_start[c + 1], z - reach, False)
                stop = first_above(cells.xyz, start, cells.column_start[c + 1], z + reach, True)
                if stop > start:
                    runs[n_runs, 0], runs[n_runs, 1] = start, stop
                    n_runs += 1
            c += 1
    return n_runs


@inner
def cells_between(low, high, cell):  # type: ignore[no-untyped-def]
    return int(np.floor(low / cell)), int(np.floor(high / cell))


@inner
def first_column(cells, row, first_y):  # type: ignore[no-untyped-def]
    """First column of a row whose y cell is at least ``first_y``."""
    a, b = cells.row_start[row], cells.row_start[row + 1]
    while a < b:
        m = (a + b) >> 1
        if cells.column_y[m] < first_y:
            a = m + 1
        else:
            b = m
    return a


@inner
def first_above(xyz, a, b, z, is_strict):  # type: ignore[no-untyped-def]
    """First of the sorted points [a, b) of a column that is at least ``z`` high, or higher where ``is_strict``."""
    while a < b:
        m = (a + b) >> 1
        if xyz[m, 2] < z or (is_strict and xyz[m, 2] == z):
            a = m + 1
        else:
            b = m
    return a


@inner
def sq_gap_to_column(cells, row, column, x, y):  # type: ignore[no-untyped-def]
    """Squared distance in plan (m2) from (x, y) to a column, a hair too small rather than too large."""
    west = cells.low[0] + row * cells.cell_m
    south = cells.low[1] + column * cells.cell_m
    hair = 1e-6 * cells.cell_m
    dx = max(west - x, x - west - cells.cell_m, hair) - hair
    dy = max(south - y, y - south - cells.cell_m, hair) - hair
    return dx * dx + dy * dy
