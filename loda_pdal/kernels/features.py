"""Eigenvalue features of the neighbourhoods of points."""

from __future__ import annotations

import numpy as np
from numba import njit

from loda_pdal.kernels.blocks import around, box_of, end_of_block, hits_within, measure, room_for
from loda_pdal.kernels.geometry import eigen_symmetric_3x3


@njit(nogil=True, cache=True)
def shape_features(start, stop, cells, radius, min_neighbours, values, normals, is_valid):  # type: ignore[no-untyped-def]
    """Linearity, planarity, sphericity, |n.z| and normals of the points in columns [start, stop) of a cell list.

    Results are written at the index that each point has in the cloud; points with too few neighbours are left alone.
    """
    near = room_for(1024)
    for column in range(start, stop):
        q, column_stop = cells.column_start[column], cells.column_start[column + 1]
        while q < column_stop:
            block_stop = end_of_block(cells, q, column_stop)
            box = box_of(cells, q, block_stop)
            n = around(cells, box, radius, near)
            if n > len(near.sq):
                near = room_for(2 * n)
                around(cells, box, radius, near)
            while q < block_stop:
                measure(near, n, cells.xyz[q, 0], cells.xyz[q, 1], cells.xyz[q, 2])
                n_hits = hits_within(near, n, radius * radius)
                if n_hits >= min_neighbours:
                    _shape(near, n_hits, cells.xyz, q, 1e-12 * radius * radius, cells.idx[q], values, normals, is_valid)
                q += 1


@njit(nogil=True, cache=True)
def _shape(near, n, xyz, q, smallest, i, values, normals, is_valid):  # type: ignore[no-untyped-def]
    """Write the features of sorted point ``q`` at ``i``, unless all its ``n`` neighbours are in one place."""
    x, y, z = np.float64(xyz[q, 0]), np.float64(xyz[q, 1]), np.float64(xyz[q, 2])
    sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
    for h in range(n):
        j = near.hit[h]
        dx, dy, dz = near.x[j] - x, near.y[j] - y, near.z[j] - z
        sx, sy, sz = sx + dx, sy + dy, sz + dz
        sxx, sxy, sxz = sxx + dx * dx, sxy + dx * dy, sxz + dx * dz
        syy, syz, szz = syy + dy * dy, syz + dy * dz, szz + dz * dz
    large, middle, small, nx, ny, nz = eigen_symmetric_3x3(
        sxx / n - sx * sx / (n * n),
        sxy / n - sx * sy / (n * n),
        sxz / n - sx * sz / (n * n),
        syy / n - sy * sy / (n * n),
        syz / n - sy * sz / (n * n),
        szz / n - sz * sz / (n * n),
    )
    if large <= smallest:
        return
    middle, small = max(middle, 0.0), max(small, 0.0)
    values[i, 0] = (large - middle) / large
    values[i, 1] = (middle - small) / large
    values[i, 2] = small / large
    values[i, 3] = abs(nz)
    normals[i, 0], normals[i, 1], normals[i, 2] = nx, ny, nz
    is_valid[i] = True
