"""Eigenvalue features of the neighbourhoods of points."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from loda_pdal.kernels.geometry import eigen_symmetric_3x3
from loda_pdal.kernels.neighbours import empty_runs, runs_within


@njit(nogil=True, cache=True)
def shape_features(
    start: int,
    stop: int,
    cells: Any,
    radius: float,
    min_neighbours: int,
    values: npt.NDArray[np.float32],
    normals: npt.NDArray[np.float32],
    is_valid: npt.NDArray[np.bool_],
) -> None:
    """Linearity, planarity, sphericity, |n.z| and normals of the sorted points ``start`` to ``stop`` of a cell list.

    Results are written at the index that each point has in the cloud; points with too few neighbours are left alone.
    """
    runs = empty_runs(cells, radius)
    for q in range(start, stop):
        x, y, z = np.float64(cells.xyz[q, 0]), np.float64(cells.xyz[q, 1]), np.float64(cells.xyz[q, 2])
        n = 0
        sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
        for r in range(runs_within(cells, x, y, z, radius, runs)):
            for p in range(runs[r, 0], runs[r, 1]):
                dx, dy, dz = cells.xyz[p, 0] - x, cells.xyz[p, 1] - y, cells.xyz[p, 2] - z
                if dx * dx + dy * dy + dz * dz <= radius * radius:
                    n += 1
                    sx, sy, sz = sx + dx, sy + dy, sz + dz
                    sxx, sxy, sxz = sxx + dx * dx, sxy + dx * dy, sxz + dx * dz
                    syy, syz, szz = syy + dy * dy, syz + dy * dz, szz + dz * dz
        if n < min_neighbours:
            continue
        large, middle, small, nx, ny, nz = eigen_symmetric_3x3(
            sxx / n - sx * sx / (n * n),
            sxy / n - sx * sy / (n * n),
            sxz / n - sx * sz / (n * n),
            syy / n - sy * sy / (n * n),
            syz / n - sy * sz / (n * n),
            szz / n - sz * sz / (n * n),
        )
        if large <= 1e-12 * radius * radius:  # all points in one place
            continue
        middle, small = max(middle, 0.0), max(small, 0.0)
        i = cells.idx[q]
        values[i, 0] = (large - middle) / large
        values[i, 1] = (middle - small) / large
        values[i, 2] = small / large
        values[i, 3] = abs(nz)
        normals[i, 0], normals[i, 1], normals[i, 2] = nx, ny, nz
        is_valid[i] = True
