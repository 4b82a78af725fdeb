"""Local planes: normal and roughness at every point of a cell list."""

from __future__ import annotations

import numpy as np
from numba import njit

from loda_pdal.kernels.geometry import eigen_symmetric_3x3
from loda_pdal.kernels.neighbours import k_nearest

LINE = 1e-3
"""Middle over largest eigenvalue below which the points lie on a line, which has no normal."""


@njit(nogil=True, cache=True)
def plane_range(  # type: ignore[no-untyped-def]
    start, stop, cells, local, radius, k, min_neighbours, max_isotropy, normals, roughness
):
    """Normals and roughness of sorted points [start, stop), written under their index in the cloud.

    Parameters
    ----------
    cells : CellList
    local : (n, 3) float32, m
        The points about ``cells.centre``, by their index in the cloud.
    radius, k, min_neighbours
        At most the k nearest points within the radius (m), the point itself among them; no plane with fewer than
        ``min_neighbours``.
    max_isotropy : float
        No plane where smallest over middle eigenvalue exceeds this.
    normals : (n, 3) float32
        Unit normals; left alone where there is no plane.
    roughness : (n,) float32, m
        1.4826 * MAD of the signed distances to the plane; left alone where there is no plane.
    """
    best_sq, best_idx = np.empty(k, dtype=np.float64), np.empty(k, dtype=np.int32)
    residuals = np.empty(k, dtype=np.float64)
    guess = min(cells.cell_m, radius)
    for q in range(start, stop):
        n, guess = k_nearest(
            cells, cells.xyz[q, 0], cells.xyz[q, 1], cells.xyz[q, 2], guess, radius, -1, best_sq, best_idx
        )
        if n < min_neighbours:
            continue
        x, y, z = _mean(local, best_idx, n)
        xx = xy = xz = yy = yz = zz = 0.0
        for j in range(n):
            dx, dy, dz = local[best_idx[j], 0] - x, local[best_idx[j], 1] - y, local[best_idx[j], 2] - z
            xx += dx * dx
            xy += dx * dy
            xz += dx * dz
            yy += dy * dy
            yz += dy * dz
            zz += dz * dz
        large, middle, small, nx, ny, nz = eigen_symmetric_3x3(xx, xy, xz, yy, yz, zz)
        if middle <= LINE * large or small > max_isotropy * middle:
            continue
        i = cells.idx[q]
        normals[i, 0], normals[i, 1], normals[i, 2] = nx, ny, nz
        for j in range(n):
            p = best_idx[j]
            residuals[j] = nx * (local[p, 0] - x) + ny * (local[p, 1] - y) + nz * (local[p, 2] - z)
        roughness[i] = mad_sigma(residuals[:n])


@njit(nogil=True, cache=True)
def mad_sigma(values):  # type: ignore[no-untyped-def]
    """Robust standard deviation, 1.4826 * median of absolute deviations from the median; ``values`` is overwritten."""
    middle = _median(values)
    for j in range(len(values)):
        values[j] = abs(values[j] - middle)
    return 1.4826 * _median(values)


@njit(nogil=True, cache=True)
def _median(values):  # type: ignore[no-untyped-def]
    """Median; sorts ``values`` in place, by insertion: there are few."""
    n = len(values)
    for j in range(1, n):
        value, i = values[j], j
        while i > 0 and values[i - 1] > value:
            values[i] = values[i - 1]
            i -= 1
        values[i] = value
    return 0.5 * (values[(n - 1) // 2] + values[n // 2])


@njit(nogil=True, cache=True)
def _mean(local, idx, n):  # type: ignore[no-untyped-def]
    x = y = z = 0.0
    for j in range(n):
        x += local[idx[j], 0]
        y += local[idx[j], 1]
        z += local[idx[j], 2]
    return x / n, y / n, z / n
