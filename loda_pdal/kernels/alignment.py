"""Normal equations of the two registration methods, summed over fixed chunks of source points.

A chunk is the same points whatever the number of threads, and the caller adds the chunks in order: so the sums are too.
The twist (tx, ty, tz, rx, ry, rz) is applied about the origin of the frame, after the pose (R, t).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from loda_pdal.kernels.neighbours import empty_runs, k_nearest, k_within, runs_within

CHUNK = 2048
"""Source points per chunk."""

N_SUMS = 32
"""Values per chunk: 21 of the upper triangle of J'WJ, 6 of J'Wr, then `PAIRS`, `WEIGHT` and `SCORE`."""

PAIRS, WEIGHT, SCORE = 27, 28, 29


@njit(nogil=True, cache=True)
def plane_chunks(  # type: ignore[no-untyped-def]
    start, stop, source, source_normals, R, t, cells, target, normals, sq_sigma, radius, min_cosine, tau, is_robust,
    match, residual, weight, sums,
):  # fmt: skip
    """Point-to-plane pairs of the source points in chunks [start, stop) (paper, equation 1).

    Parameters
    ----------
    source, source_normals : (m, 3) float32
        Points and unit normals about ``cells.centre``, before the pose.
    R, t : (3, 3), (3,) float64
        The pose.
    cells, target, normals, sq_sigma
        Cell list of the target, its points (n, 3) float32 and unit normals (n, 3) by index, and sigma_i^2 (n,), m2.
    radius, min_cosine, tau, is_robust
        Largest distance of a pair, smallest |cosine| between its normals, largest residual, and Tukey's loss or none.
    match : (m,) int32
        Nearest target point, -1 where there is none; what it holds from an earlier call makes the search quick.
    residual, weight : (m,) float64
        Signed distance to the plane, m, and weight / sigma^2; both 0 where there is no pair.
    sums : (chunks, N_SUMS) float64
        Filled; ``SCORE`` is the weighted square sum of residuals and ``WEIGHT`` the weights without 1 / sigma^2.
    """
    best_sq, best_idx = np.empty(1, dtype=np.float64), np.empty(1, dtype=np.int32)
    J = np.empty(6, dtype=np.float64)
    for chunk in range(start, stop):
        total = sums[chunk]
        total[:] = 0.0
        guess = min(cells.cell_m, radius)
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(source))):
            residual[i] = weight[i] = 0.0
            x, y, z = _moved(R, source[i, 0], source[i, 1], source[i, 2])
            x, y, z = x + t[0], y + t[1], z + t[2]
            n_found = 0
            if match[i] >= 0:
                dx, dy, dz = target[match[i], 0] - x, target[match[i], 1] - y, target[match[i], 2] - z
                reach = min(np.sqrt(dx * dx + dy * dy + dz * dz) * (1 + 1e-9), radius)
                n_found = k_within(cells, x, y, z, reach, -1, best_sq, best_idx)
            else:
                n_found, guess = k_nearest(cells, x, y, z, guess, radius, -1, best_sq, best_idx)
            match[i] = best_idx[0] if n_found else -1
            if not n_found:
                continue
            q = best_idx[0]
            nx, ny, nz = np.float64(normals[q, 0]), np.float64(normals[q, 1]), np.float64(normals[q, 2])
            sx, sy, sz = _moved(R, source_normals[i, 0], source_normals[i, 1], source_normals[i, 2])
            r = nx * (x - target[q, 0]) + ny * (y - target[q, 1]) + nz * (z - target[q, 2])
            if abs(nx * sx + ny * sy + nz * sz) < min_cosine or abs(r) > tau:
                continue
            tukey = (1 - (r / tau) ** 2) ** 2 if is_robust else 1.0
            w = tukey / sq_sigma[q]
            residual[i], weight[i] = r, w
            J[0], J[1], J[2] = nx, ny, nz
            J[3], J[4], J[5] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
            _add(total, J, w, r)
            total[PAIRS] += 1
            total[WEIGHT] += tukey
            total[SCORE] += tukey * r * r


@njit(nogil=True, cache=True)
def distribution_chunks(  # type: ignore[no-untyped-def]
    start, stop, source, R, t, cells, mean, information, radius, outlier, sums
):
    """Point-to-distribution pairs of the source points in chunks [start, stop).

    Each point is drawn to all distributions within ``radius`` of their means, by weight exp(-d'Bd / 2) over the sum of
    these and ``outlier``.

    Parameters
    ----------
    source : (m, 3) float32
        Points about ``cells.centre``, before the pose.
    R, t : (3, 3), (3,) float64
        The pose.
    cells, mean, information
        Cell list of the means, the means (n, 3) float32, and B (n, 6): xx xy xz yy yz zz of the inverse covariances.
    sums : (chunks, N_SUMS) float64
        Filled; ``SCORE`` is the log likelihood, 0 for a point far from all distributions.
    """
    runs = empty_runs(cells, radius)
    for chunk in range(start, stop):
        total = sums[chunk]
        total[:] = 0.0
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(source))):
            x, y, z = _moved(R, source[i, 0], source[i, 1], source[i, 2])
            x, y, z = x + t[0], y + t[1], z + t[2]
            n_runs = runs_within(cells, x, y, z, radius, runs)
            likelihood = 0.0
            bx = by = bz = 0.0  # sum of e B d
            xx = xy = xz = yy = yz = zz = 0.0  # sum of e B
            for run in range(n_runs):
                for p in range(runs[run, 0], runs[run, 1]):
                    d = cells.idx[p]
                    dx, dy, dz = x - mean[d, 0], y - mean[d, 1], z - mean[d, 2]
                    if dx * dx + dy * dy + dz * dz > radius * radius:
                        continue
                    B = information[d]
                    ux = B[0] * dx + B[1] * dy + B[2] * dz
                    uy = B[1] * dx + B[3] * dy + B[4] * dz
                    uz = B[2] * dx + B[4] * dy + B[5] * dz
                    e = np.exp(-0.5 * (ux * dx + uy * dy + uz * dz))
                    likelihood += e
                    bx, by, bz = bx + e * ux, by + e * uy, bz + e * uz
                    xx, xy, xz = xx + e * B[0], xy + e * B[1], xz + e * B[2]
                    yy, yz, zz = yy + e * B[3], yz + e * B[4], zz + e * B[5]
            if likelihood <= 0.0:
                continue
            w = 1.0 / (likelihood + outlier)
            total[PAIRS] += 1
            total[WEIGHT] += likelihood * w
            total[SCORE] += np.log(likelihood / outlier + 1.0)
            _add_block(total, x, y, z, w * bx, w * by, w * bz, w * xx, w * xy, w * xz, w * yy, w * yz, w * zz)


@njit(nogil=True, cache=True)
def _moved(R, x, y, z):  # type: ignore[no-untyped-def]
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )


@njit(nogil=True, cache=True)
def _add(total, J, w, r):  # type: ignore[no-untyped-def]
    """Add one residual with row ``J`` of the Jacobian."""
    k = 0
    for a in range(6):
        for b in range(a, 6):
            total[k] += w * J[a] * J[b]
            k += 1
        total[21 + a] += w * J[a] * r


@njit(nogil=True, cache=True)
def _add_block(total, x, y, z, bx, by, bz, xx, xy, xz, yy, yz, zz):  # type: ignore[no-untyped-def]
    """Add a 3D residual at (x, y, z) with Jacobian J = [I, -[p]x], given B and B d: J'BJ and J'Bd."""
    # rows of B [p]x, so that J'BJ = [[B, -B[p]x], [., [p]x' B [p]x]]
    m00, m01, m02 = xy * z - xz * y, xz * x - xx * z, xx * y - xy * x
    m10, m11, m12 = yy * z - yz * y, yz * x - xy * z, xy * y - yy * x
    m20, m21, m22 = yz * z - zz * y, zz * x - xz * z, xz * y - yz * x
    total[0] += xx
    total[1] += xy
    total[2] += xz
    total[3] -= m00
    total[4] -= m01
    total[5] -= m02
    total[6] += yy
    total[7] += yz
    total[8] -= m10
    total[9] -= m11
    total[10] -= m12
    total[11] += zz
    total[12] -= m20
    total[13] -= m21
    total[14] -= m22
    # [p]x' (B [p]x), with [p]x' = -[p]x
    total[15] += z * m10 - y * m20
    total[16] += z * m11 - y * m21
    total[17] += z * m12 - y * m22
    total[18] += x * m21 - z * m01
    total[19] += x * m22 - z * m02
    total[20] += y * m02 - x * m12
    total[21] += bx
    total[22] += by
    total[23] += bz
    total[24] += y * bz - z * by
    total[25] += z * bx - x * bz
    total[26] += x * by - y * bx
