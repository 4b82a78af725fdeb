"""Rasters of the ground: cells of points, what is lowest in each, gaps relaxed, heights between cell centres."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(nogil=True, cache=True)
def cell_range(start, stop, xyz, cell_m, first, n_y, cell_idx):  # type: ignore[no-untyped-def]
    """Cell of points [start, stop), row by row: (i - first_x) * n_y + j - first_y; ``first`` (2,) int64."""
    for p in range(start, stop):
        i = int(np.floor(xyz[p, 0] / cell_m)) - first[0]
        j = int(np.floor(xyz[p, 1] / cell_m)) - first[1]
        cell_idx[p] = i * n_y + j


@njit(nogil=True, cache=True)
def lower_to(lowest, cell_idx, values):  # type: ignore[no-untyped-def]
    """Lower each cell (c,) to the least value (m,) in it."""
    for p in range(len(values)):
        if values[p] < lowest[cell_idx[p]]:
            lowest[cell_idx[p]] = values[p]


@njit(nogil=True, cache=True)
def group_by_cell(cell_idx, place, order):  # type: ignore[no-untyped-def]
    """Fill ``order`` with the points (m,) by cell and index; ``place`` (c,), first place of each cell, moves on."""
    for p in range(len(cell_idx)):
        order[place[cell_idx[p]]] = p
        place[cell_idx[p]] += 1


@njit(nogil=True, cache=True)
def sort_range(first, last, start, xyz, order):  # type: ignore[no-untyped-def]
    """Sort points ``order[start[g]:start[g + 1]]`` of groups [first, last) by x, y, z and index (Shell's sort)."""
    for g in range(first, last):
        a, b = start[g], start[g + 1]
        gap = 1
        while 3 * gap + 1 < b - a:
            gap = 3 * gap + 1
        while gap > 0:
            for i in range(a + gap, b):
                p, k = order[i], i
                while k >= a + gap and _is_before(xyz, p, order[k - gap]):
                    order[k] = order[k - gap]
                    k -= gap
                order[k] = p
            gap //= 3


@njit(nogil=True, cache=True)
def _is_before(xyz, p, q):  # type: ignore[no-untyped-def]
    for axis in range(3):
        if xyz[p, axis] != xyz[q, axis]:
            return xyz[p, axis] < xyz[q, axis]
    return p < q


@njit(nogil=True, cache=True)
def relax(height, is_known, sweeps):  # type: ignore[no-untyped-def]
    """Replace the cells that are not known by the mean of their four neighbours, all at once, ``sweeps`` times.

    Beyond the edge of a raster (nx, ny) lies what lies on it. Returns the result; ``height`` is overwritten too.
    """
    n_x, n_y = height.shape
    old, new = height, height.copy()
    for _ in range(sweeps):
        for i in range(n_x):
            east, west = old[min(i + 1, n_x - 1)], old[max(i - 1, 0)]
            row, known, out = old[i], is_known[i], new[i]
            for j in range(1, n_y - 1):
                mean = (east[j] + west[j] + row[j + 1] + row[j - 1]) / 4
                out[j] = row[j] if known[j] else mean
            for j in (0, n_y - 1):
                if not known[j]:
                    out[j] = (east[j] + west[j] + row[min(j + 1, n_y - 1)] + row[max(j - 1, 0)]) / 4
        old, new = new, old
    return old


@njit(nogil=True, cache=True)
def height_range(start, stop, xy, cell_m, first, height, slope, result):  # type: ignore[no-untyped-def]
    """Heights at plan positions [start, stop) of (k, 2), blended between the planes of the four cells around each.

    ``height`` (nx, ny) and ``slope`` (nx, ny, 2) are those of `GroundModel`; ``result`` (k,) is NaN where none is near.
    """
    n_x, n_y = height.shape
    for p in range(start, stop):
        x, y = xy[p, 0] / cell_m - 0.5 - first[0], xy[p, 1] / cell_m - 0.5 - first[1]
        low_i, low_j = np.floor(x), np.floor(y)
        x, y = x - low_i, y - low_j
        total = weight = 0.0
        for di in range(2):
            for dj in range(2):
                i, j = int(low_i) + di, int(low_j) + dj
                if i < 0 or i >= n_x or j < 0 or j >= n_y:
                    continue
                plane = height[i, j] + (slope[i, j, 0] * ((x - di) * cell_m) + slope[i, j, 1] * ((y - dj) * cell_m))
                w = (1.0 - abs(x - di)) * (1.0 - abs(y - dj))
                if w > 0.0 and np.isfinite(plane):
                    total += w * plane
                    weight += w
        result[p] = total / weight if weight > 1e-9 else np.nan
