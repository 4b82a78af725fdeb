"""Rasters of the ground: cells of points, what is lowest in each, and gaps relaxed."""

from __future__ import annotations

import numpy as np

from loda_pdal.kernels.compiled import inner, kernel


@kernel
def cell_range(start, stop, xyz, cell_m, first, n_y, cell_idx):  # type: ignore[no-untyped-def]
    """Cell of points [start, stop), row by row: (i - first_x) * n_y + j - first_y; ``first`` (2,) int64."""
    for p in range(start, stop):
        i = int(np.floor(xyz[p, 0] / cell_m)) - first[0]
        j = int(np.floor(xyz[p, 1] / cell_m)) - first[1]
        cell_idx[p] = i * n_y + j


@kernel
def lower_to(lowest, cell_idx, values):  # type: ignore[no-untyped-def]
    """Lower each cell (c,) to the least value (m,) in it."""
    for p in range(len(values)):
        if values[p] < lowest[cell_idx[p]]:
            lowest[cell_idx[p]] = values[p]


@kernel
def group_by_cell(cell_idx, place, order):  # type: ignore[no-untyped-def]
    """Fill ``order`` with the points (m,) by cell and index; ``place`` (c,), first place of each cell, moves on."""
    for p in range(len(cell_idx)):
        order[place[cell_idx[p]]] = p
        place[cell_idx[p]] += 1


@kernel
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


@inner
def _is_before(xyz, p, q):  # type: ignore[no-untyped-def]
    for axis in range(3):
        if xyz[p, axis] != xyz[q, axis]:
            return xyz[p, axis] < xyz[q, axis]
    return p < q


@kernel
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
