"""LoD grid: direction, noise and offset of both epochs around each cell, and the limit between cells."""

from __future__ import annotations

import numpy as np

from loda_pdal.kernels.cells import empty_runs, runs_within, sq_distance
from loda_pdal.kernels.compiled import inner, kernel
from loda_pdal.kernels.geometry import eigen_symmetric_3x3
from loda_pdal.kernels.groups import select
from loda_pdal.kernels.planes import LINE

MAD_TO_STD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""

TRIM = 3.0
"""Points farther than this many standard deviations from the median leave the mean offset."""


@kernel
def pool_range(  # type: ignore[no-untyped-def]
    start, stop, before, after, centres, radius, min_points, max_isotropy, n_points, normal, sigma, offset, is_valid
):
    """Fill (c, 2) counts, (c, 3) normals, (c, 2) noise and offsets (m), (c,) validity for cells [start, stop).

    ``before`` and ``after`` are cell lists about the same centre, ``centres`` (c, 3) float32 in their frame. The common
    normal is that of the mean of the two covariance matrices, each about its own mean: neither epoch outweighs the
    other, and a displaced surface keeps its direction.
    """
    runs_b, runs_a = empty_runs(before, radius), empty_runs(after, radius)
    points_b, points_a = np.empty((256, 3)), np.empty((256, 3))
    for c in range(start, stop):
        x, y, z = centres[c, 0], centres[c, 1], centres[c, 2]
        points_b, n_b = _gather(before, x, y, z, radius, runs_b, points_b)
        points_a, n_a = _gather(after, x, y, z, radius, runs_a, points_a)
        n_points[c, 0], n_points[c, 1] = n_b, n_a
        if n_b < min_points or n_a < min_points:
            continue
        b, a = _covariance(points_b, n_b), _covariance(points_a, n_a)
        large, middle, small, nx, ny, nz = eigen_symmetric_3x3(
            0.5 * (b[0] + a[0]),
            0.5 * (b[1] + a[1]),
            0.5 * (b[2] + a[2]),
            0.5 * (b[3] + a[3]),
            0.5 * (b[4] + a[4]),
            0.5 * (b[5] + a[5]),
        )
        if middle <= LINE * large or small > max_isotropy * middle:
            continue
        normal[c, 0], normal[c, 1], normal[c, 2] = nx, ny, nz
        offset[c, 0], sigma[c, 0] = _offset_and_noise(points_b, n_b, nx, ny, nz)
        offset[c, 1], sigma[c, 1] = _offset_and_noise(points_a, n_a, nx, ny, nz)
        is_valid[c] = True


@inner
def _gather(cells, x, y, z, radius, runs, points):  # type: ignore[no-untyped-def]
    """Points within ``radius``, about (x, y, z), in a buffer that is enlarged where needed; how many."""
    n_runs = runs_within(cells, x, y, z, radius, runs)
    n_most = 0
    for r in range(n_runs):
        n_most += runs[r, 1] - runs[r, 0]
    if n_most > len(points):
        points = np.empty((2 * n_most, 3))
    n = 0
    for r in range(n_runs):
        for p in range(runs[r, 0], runs[r, 1]):
            if sq_distance(cells, p, x, y, z) <= radius * radius:
                points[n, 0] = np.float64(cells.xyz[p, 0]) - np.float64(x)
                points[n, 1] = np.float64(cells.xyz[p, 1]) - np.float64(y)
                points[n, 2] = np.float64(cells.xyz[p, 2]) - np.float64(z)
                n += 1
    return points, n


@inner
def _covariance(points, n):  # type: ignore[no-untyped-def]
    """xx, xy, xz, yy, yz, zz of the first ``n`` points about their mean."""
    mx, my, mz = 0.0, 0.0, 0.0
    for p in range(n):
        mx += points[p, 0]
        my += points[p, 1]
        mz += points[p, 2]
    mx, my, mz = mx / n, my / n, mz / n
    xx = xy = xz = yy = yz = zz = 0.0
    for p in range(n):
        x, y, z = points[p, 0] - mx, points[p, 1] - my, points[p, 2] - mz
        xx, xy, xz = xx + x * x, xy + x * y, xz + x * z
        yy, yz, zz = yy + y * y, yz + y * z, zz + z * z
    return xx / n, xy / n, xz / n, yy / n, yz / n, zz / n


@inner
def _offset_and_noise(points, n, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Trimmed mean offset along the normal and its standard deviation from the MAD, both in m."""
    along, room = np.empty(n), np.empty(n)
    for p in range(n):
        along[p] = points[p, 0] * nx + points[p, 1] * ny + points[p, 2] * nz
        room[p] = along[p]
    middle = _median(room, n)
    for p in range(n):
        room[p] = abs(along[p] - middle)
    sigma = MAD_TO_STD * _median(room, n)
    total, count = 0.0, 0
    for p in range(n):
        if abs(along[p] - middle) <= TRIM * sigma:
            total += along[p]
            count += 1
    return (total / count if count > 0 else middle), sigma


@inner
def _median(values, n):  # type: ignore[no-untyped-def]
    """Median of ``n`` values, which are reordered."""
    upper = select(values, n, n // 2)
    if n % 2:
        return upper
    lower = values[0]
    for p in range(1, n // 2):
        lower = max(lower, values[p])
    return 0.5 * (lower + upper)


@kernel
def limit_range(start, stop, xyz, cells, cell_m, lod95, is_valid, otherwise, result):  # type: ignore[no-untyped-def]
    """Limits (m) at points [start, stop), linear between the valid ones of the eight cell centres around each.

    Parameters
    ----------
    xyz : (k, 3) float64, m
    cells, lod95, is_valid : (c, 3) int32, (c,) float32, (c,) bool
        Cells in lexicographic order, their limits (m) and whether they count.
    otherwise : float, m
        The answer where none of the eight counts.
    result : (k,) float64, m
        Filled.
    """
    around = np.empty(8, dtype=np.int64)
    i = j = k = 0
    is_known = False
    for p in range(start, stop):
        x, y, z = xyz[p, 0] / cell_m - 0.5, xyz[p, 1] / cell_m - 0.5, xyz[p, 2] / cell_m - 0.5
        low_x, low_y, low_z = np.floor(x), np.floor(y), np.floor(z)
        if not is_known or int(low_x) != i or int(low_y) != j or int(low_z) != k:
            i, j, k, is_known = int(low_x), int(low_y), int(low_z), True
            for corner in range(0, 8, 2):
                first = _first_cell(cells, i + (corner >> 2), j + (corner >> 1 & 1), k)
                for dz in range(2):
                    around[corner + dz] = _place_in_column(
                        cells, first, i + (corner >> 2), j + (corner >> 1 & 1), k + dz
                    )
        x, y, z = x - low_x, y - low_y, z - low_z
        total = weight = 0.0
        for corner in range(8):
            c = around[corner]
            if c >= 0 and is_valid[c]:
                w = (x if corner & 4 else 1 - x) * (y if corner & 2 else 1 - y) * (z if corner & 1 else 1 - z)
                total += w * lod95[c]
                weight += w
        result[p] = total / weight if weight > 1e-6 else otherwise


@inner
def _first_cell(cells, i, j, k):  # type: ignore[no-untyped-def]
    """First of the cells that does not come before (i, j, k)."""
    a, b = 0, len(cells)
    while a < b:
        m = (a + b) >> 1
        if cells[m, 0] < i or (cells[m, 0] == i and (cells[m, 1] < j or (cells[m, 1] == j and cells[m, 2] < k))):
            a = m + 1
        else:
            b = m
    return a


@inner
def _place_in_column(cells, first, i, j, k):  # type: ignore[no-untyped-def]
    """Which of the cells from ``first`` on is (i, j, k), at most two are asked; -1 if neither."""
    for c in range(first, min(first + 2, len(cells))):
        if cells[c, 0] == i and cells[c, 1] == j and cells[c, 2] == k:
            return c
    return -1
