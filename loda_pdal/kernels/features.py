"""Eigenvalue features of the neighbourhoods of points."""

from __future__ import annotations

import numpy as np

from loda_pdal.kernels.blocks import around, box_of, hits_within, measure
from loda_pdal.kernels.compiled import inner, kernel
from loda_pdal.kernels.geometry import eigen_symmetric_3x3


@kernel
def shape_features(  # type: ignore[no-untyped-def]
    start, stop, room, blocks, cells, radius, min_neighbours, values, normals, is_valid
):
    """Linearity, planarity, sphericity, |n.z| and normals of the points in blocks [start, stop), see `run_blocks`.

    Results are written at the index that each point has in the cloud; points with too few neighbours are left alone.
    """
    for block in range(start, stop):
        n = around(room, cells, box_of(cells, blocks[block], blocks[block + 1]), radius)
        if n < 0:
            return block
        for q in range(blocks[block], blocks[block + 1]):
            x, y, z = np.float64(cells.xyz[q, 0]), np.float64(cells.xyz[q, 1]), np.float64(cells.xyz[q, 2])
            measure(room, n, cells, q)
            n_hits = hits_within(room, n, radius * radius)
            if n_hits >= min_neighbours:
                _shape(room, n_hits, x, y, z, 1e-12 * radius * radius, cells.idx[q], values, normals, is_valid)
    return stop


@inner
def _shape(room, n, x, y, z, smallest, i, values, normals, is_valid):  # type: ignore[no-untyped-def]
    """Write features at ``i``, of ``n`` hits around (x, y, z), unless these are all in one place."""
    sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
    for h in range(n):
        j = room.hit[h]
        dx, dy, dz = room.x[j] - x, room.y[j] - y, room.z[j] - z
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
