"""Rays from a sensor through its returns: which voxels they cross before the return, and which lie behind it."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(nogil=True, cache=True)
def crossed_range(start, stop, origin, target, margin, near, far, edge, cell, low, span, passed, hidden):  # type: ignore[no-untyped-def]
    """Count the rays through each voxel of rows [start, stop) of the lattice.

    Parameters
    ----------
    start, stop : int
        Rows along x; row r holds the voxels whose first index is ``low[0] + r``.
    origin, target : (r, 3) float64, m
        Sensor and return of each ray.
    margin, near, far : float, m
        What a ray leaves ``margin`` before its return it passed; what it would enter from ``near`` to ``far`` behind
        its return is hidden by that.
    edge : float, m
        Edge of a voxel; voxel (i, j, k) starts at (i, j, k) * edge.
    cell : (c, 3) int64
        The voxels that matter, lexicographically sorted.
    low, span : (3,) int64
        Lowest index and number of voxels along each axis.
    passed, hidden : (c,) int32
        Raised by the rays that passed each voxel, and by those that a return kept from it. Of the latter only rays that
        go down count: beside one that goes up there may be others that met nothing and left no return.

    Notes
    -----
    The traversal of Amanatides and Woo (1987), but every crossing is computed from the index of the voxel instead of
    the crossing before: the answer does not depend on where a range begins.
    """
    first_voxel = _first_above(cell, 0, len(cell), 0, low[0] + start)
    last_voxel = _first_above(cell, first_voxel, len(cell), 0, low[0] + stop)
    first = np.zeros((stop - start) * span[1] + 1, dtype=np.int64)  # first voxel of each column of these rows, and last
    for v in range(first_voxel, last_voxel):
        first[(cell[v, 0] - low[0] - start) * span[1] + cell[v, 1] - low[1] + 1] += 1
    first[0] = first_voxel
    for column in range(1, len(first)):
        first[column] += first[column - 1]
    d = np.empty(3)
    for ray in range(len(origin)):
        o, length = origin[ray], 0.0
        for axis in range(3):
            d[axis] = target[ray, axis] - o[axis]
            length += d[axis] * d[axis]
        length = np.sqrt(length)
        if length <= margin:
            continue
        d /= length
        end = length + far if d[2] < 0.0 else length
        t_low, t_high = _between(o[2], d[2], low[2], low[2] + span[2], edge, 0.0, end)
        t_low, t_high = _between(o[1], d[1], low[1], low[1] + span[1], edge, t_low, t_high)
        t_low, t_high = _between(o[0], d[0], low[0] + start, low[0] + stop, edge, t_low, t_high)
        if t_low >= t_high:
            continue
        i_first, i_last = _cells(o[0], d[0], edge, t_low, t_high)
        for i in range(max(i_first, low[0] + start), min(i_last + 1, low[0] + stop)):
            x_low, x_high = _between(o[0], d[0], i, i + 1, edge, t_low, t_high)
            if x_low >= x_high:
                continue
            j_first, j_last = _cells(o[1], d[1], edge, x_low, x_high)
            for j in range(max(j_first, low[1]), min(j_last + 1, low[1] + span[1])):
                column = (i - low[0] - start) * span[1] + j - low[1]
                if first[column] == first[column + 1]:
                    continue
                y_low, y_high = _between(o[1], d[1], j, j + 1, edge, x_low, x_high)
                if y_low >= y_high:
                    continue
                k_first, k_last = _cells(o[2], d[2], edge, y_low, y_high)
                v = _first_above(cell, first[column], first[column + 1], 2, k_first)
                while v < first[column + 1] and cell[v, 2] <= k_last:
                    z_low, z_high = _between(o[2], d[2], cell[v, 2], cell[v, 2] + 1, edge, y_low, y_high)
                    if z_low < z_high:
                        if z_high <= length - margin:
                            passed[v] += 1
                        elif z_low >= length + near:
                            hidden[v] += 1
                    v += 1


@njit(nogil=True, cache=True)
def _between(o, d, first, last, edge, t_low, t_high):  # type: ignore[no-untyped-def]
    """The part of [t_low, t_high] in which o + t d lies between ``first * edge`` and ``last * edge``; empty if none."""
    if d == 0.0:
        return (t_low, t_high) if first * edge <= o < last * edge else (t_low, t_low)
    near, far = (first * edge - o) / d, (last * edge - o) / d
    return max(t_low, min(near, far)), min(t_high, max(near, far))


@njit(nogil=True, cache=True)
def _cells(o, d, edge, t_low, t_high):  # type: ignore[no-untyped-def]
    """First and last cell along an axis that a ray meets from t_low to t_high."""
    a, b = (o + t_low * d) / edge, (o + t_high * d) / edge
    return int(np.floor(min(a, b))), int(np.floor(max(a, b)))


@njit(nogil=True, cache=True)
def _first_above(cell, a, b, axis, least):  # type: ignore[no-untyped-def]
    """First of the voxels [a, b), sorted along ``axis``, whose index there is at least ``least``."""
    while a < b:
        m = (a + b) >> 1
        if cell[m, axis] < least:
            a = m + 1
        else:
            b = m
    return a
