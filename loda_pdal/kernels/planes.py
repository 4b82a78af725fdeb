"""Local planes: normal and roughness at every point of a cell list."""

from __future__ import annotations

import numpy as np

from loda_pdal.kernels.blocks import nearest_of_block
from loda_pdal.kernels.compiled import inner, kernel
from loda_pdal.kernels.geometry import eigen_symmetric_3x3

LINE = 1e-3
"""Middle over largest eigenvalue below which the points lie on a line, which has no normal."""


@kernel
def plane_range(  # type: ignore[no-untyped-def]
    start, stop, room, blocks, cells, local, radius, min_neighbours, max_isotropy, normals, roughness
):
    """Normals and roughness of the points in blocks [start, stop), written under their index in the cloud.

    Parameters
    ----------
    room, blocks, cells
        See `run_blocks`, as for what is returned.
    local : (n, 3) float32, m
        The points about ``cells.centre``, by their index in the cloud.
    radius, min_neighbours
        The nearest points within the radius (m), the point itself among them, as many as there is room for; no plane
        with fewer than ``min_neighbours``.
    max_isotropy : float
        No plane where smallest over middle eigenvalue exceeds this.
    normals : (n, 3) float32
        Unit normals; left alone where there is no plane.
    roughness : (n,) float32, m
        1.4826 * MAD of the signed distances to the plane; left alone where there is no plane.
    """
    k = room.nearest_idx.shape[1]
    guess = min(cells.cell_m, radius)
    residual, ordered, place = np.empty(k), np.empty(k), np.empty(k, dtype=np.int32)
    for block in range(start, stop):
        first, last = blocks[block], blocks[block + 1]
        guess = nearest_of_block(room, cells, first, last, cells, guess, radius)
        if guess < 0.0:
            return block
        for row in range(last - first):
            n, i = room.n_nearest[row], cells.idx[first + row]
            if n < min_neighbours:
                continue
            x, y, z, large, middle, small, nx, ny, nz = _plane(local, room.nearest_idx, row, n)
            if middle <= LINE * large or small > max_isotropy * middle:
                continue
            normals[i, 0], normals[i, 1], normals[i, 2] = nx, ny, nz
            for j in range(n):
                p = room.nearest_idx[row, j]
                residual[j] = nx * (local[p, 0] - x) + ny * (local[p, 1] - y) + nz * (local[p, 2] - z)
            roughness[i] = mad_sigma(residual, n, ordered, place)
    return stop


@inner
def _plane(local, idx, row, n):  # type: ignore[no-untyped-def]
    """Mean, eigenvalues of the scatter matrix and normal of the points in a row of ``idx``."""
    x = y = z = 0.0
    for j in range(n):
        p = idx[row, j]
        x, y, z = x + local[p, 0], y + local[p, 1], z + local[p, 2]
    x, y, z = x / n, y / n, z / n
    xx = xy = xz = yy = yz = zz = 0.0
    for j in range(n):
        p = idx[row, j]
        dx, dy, dz = local[p, 0] - x, local[p, 1] - y, local[p, 2] - z
        xx, xy, xz = xx + dx * dx, xy + dx * dy, xz + dx * dz
        yy, yz, zz = yy + dy * dy, yz + dy * dz, zz + dz * dz
    large, middle, small, nx, ny, nz = eigen_symmetric_3x3(xx, xy, xz, yy, yz, zz)
    return x, y, z, large, middle, small, nx, ny, nz


@kernel
def mad_sigma(values, n, ordered, place):  # type: ignore[no-untyped-def]
    """Robust standard deviation of the first ``n`` values, 1.4826 * median of absolute deviations from the median.

    ``ordered`` and ``place`` are room for as many.
    """
    _sort(values, n, ordered, place)
    middle = 0.5 * (ordered[(n - 1) // 2] + ordered[n // 2])
    above = n // 2  # deviations grow from here to both ends, so two pointers meet them in order
    below = above - 1
    deviation = last = 0.0
    for _ in range(n // 2 + 1):
        last = deviation
        if above < n and (below < 0 or ordered[above] - middle < middle - ordered[below]):
            deviation = abs(ordered[above] - middle)
            above += 1
        else:
            deviation = abs(ordered[below] - middle)
            below -= 1
    return 1.4826 * (deviation if n % 2 else 0.5 * (last + deviation))


@inner
def _sort(values, n, ordered, place):  # type: ignore[no-untyped-def]
    """The first ``n`` values in order: each goes where there are so many smaller ones, which needs no branches."""
    for j in range(n):
        n_larger = 0
        for i in range(j):
            is_larger = values[i] > values[j]
            place[i] += is_larger
            n_larger += is_larger
        place[j] = j - n_larger
    for j in range(n):
        ordered[place[j]] = values[j]
