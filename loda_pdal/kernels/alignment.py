"""Normal equations of the two registration methods, summed over fixed chunks of source points.

A chunk is the same points whatever the number of threads, and the caller adds the chunks in order: so the sums are too.
The twist (tx, ty, tz, rx, ry, rz) is applied about the origin of the frame, after the pose (R, t).
"""

from __future__ import annotations

import numpy as np

from loda_pdal.kernels.compiled import inner, kernel
from loda_pdal.kernels.neighbours import k_nearest

CHUNK = 2048
"""Source points per chunk."""

N_SLOTS = 4096
"""Cubes whose distributions are remembered, a power of two."""

N_SUMS = 32
"""Values per chunk: 21 of the upper triangle of J'WJ, 6 of J'Wr, then `PAIRS`, `WEIGHT` and `SCORE`."""

PAIRS, WEIGHT, SCORE = 27, 28, 29

SEARCHED = 1.2
"""Partners are searched within this many radii, so that points without one need not search again at each step."""

ROUNDING_M = 1e-9
"""More than distances are wrong by for rounding, m."""


@kernel
def plane_chunks(  # type: ignore[no-untyped-def]
    start, stop, source, source_normals, R, t, R_last, t_last, cells, target, normals, sq_sigma, radius, min_cosine,
    tau, is_robust, match, clearance, residual, weight, sums,
):  # fmt: skip
    """Point-to-plane pairs of the source points in chunks [start, stop) (paper, equation 1).

    Parameters
    ----------
    source, source_normals : (m, 3) float32
        Points and unit normals about ``cells.centre``, before the pose.
    R, t, R_last, t_last : (3, 3), (3,) float64
        The pose, and the one of the last call.
    cells, target, normals, sq_sigma
        Cell list of the target, its points (n, 3) float32 and unit normals (n, 3) by index, and sigma_i^2 (n,), m2.
    radius, min_cosine, tau, is_robust
        Largest distance of a pair, smallest |cosine| between its normals, largest residual, and Tukey's loss or none.
    match : (m,) int32
        Nearest target point, -1 where there is none within `SEARCHED` radii.
    clearance : (m,) float64, m
        All target points but the match are at least this far away; 0 before the first call. While the match stays
        nearer than that, nothing is searched.
    residual, weight : (m,) float64
        Signed distance to the plane, m, and weight / sigma^2; both 0 where there is no pair.
    sums : (chunks, N_SUMS) float64
        Filled; ``SCORE`` is the weighted square sum of residuals and ``WEIGHT`` the weights without 1 / sigma^2.
    """
    best_sq, best_idx, J = np.empty(2), np.empty(2, dtype=np.int32), np.empty(6)
    for chunk in range(start, stop):
        total = sums[chunk]
        for s in range(N_SUMS):
            total[s] = 0.0
        guess = min(cells.cell_m, radius)
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(source))):
            residual[i] = weight[i] = 0.0
            x, y, z = _moved(R, t, source[i, 0], source[i, 1], source[i, 2])
            px, py, pz = _moved(R_last, t_last, source[i, 0], source[i, 1], source[i, 2])
            clearance[i] -= np.sqrt(_sq_length(x - px, y - py, z - pz)) + ROUNDING_M
            q, sq = match[i], radius * radius
            if q >= 0:
                sq = _sq_length(target[q, 0] - x, target[q, 1] - y, target[q, 2] - z)
            if clearance[i] <= 0.0 or sq >= clearance[i] * clearance[i]:
                n_found, guess = k_nearest(cells, x, y, z, guess, SEARCHED * radius, -1, best_sq, best_idx)
                clearance[i] = np.sqrt(best_sq[1]) if n_found == 2 else SEARCHED * radius
                match[i] = q = best_idx[0] if n_found else -1
                sq = best_sq[0]
            if q < 0 or sq > radius * radius:
                continue
            nx, ny, nz = np.float64(normals[q, 0]), np.float64(normals[q, 1]), np.float64(normals[q, 2])
            sx, sy, sz = _turned(R, source_normals[i, 0], source_normals[i, 1], source_normals[i, 2])
            r = nx * (x - target[q, 0]) + ny * (y - target[q, 1]) + nz * (z - target[q, 2])
            if abs(nx * sx + ny * sy + nz * sz) < min_cosine or abs(r) > tau:
                continue
            tukey = (1 - (r / tau) ** 2) ** 2 if is_robust else 1.0
            w = tukey / sq_sigma[q]
            residual[i], weight[i] = r, w
            _fill_row(J, x, y, z, nx, ny, nz)
            _add(total, J, w, r)
            total[PAIRS] += 1
            total[WEIGHT] += tukey
            total[SCORE] += tukey * r * r


@kernel
def distribution_chunks(start, stop, source, R, t, cells, distribution, radius, outlier, sums):  # type: ignore[no-untyped-def]
    """Point-to-distribution pairs of the source points in chunks [start, stop).

    Each point is drawn to all distributions within ``radius`` of their means, by weight exp(-d'Bd / 2) over the sum of
    these and ``outlier``.

    Parameters
    ----------
    source : (m, 3) float32
        Points about ``cells.centre``, before the pose.
    R, t : (3, 3), (3,) float64
        The pose.
    cells, distribution
        Cell list of the means, and (n, 9) float64 in its order: mean x, y, z, then xx xy xz yy yz zz of the inverse
        covariance B.
    sums : (chunks, N_SUMS) float64
        Filled; ``SCORE`` is the log likelihood, 0 for a point far from all distributions.

    Notes
    -----
    What is near is looked up once for each cube that points fall into; the lists of the last cubes are kept.
    """
    slots = np.zeros((N_SLOTS, 5), dtype=np.int64)
    near = np.empty(16 * N_SLOTS + 2 * len(cells.xyz), dtype=np.int32)
    within = np.empty(len(cells.xyz) + 1, dtype=np.int32)
    edge, x0, y0, z0 = cells.cell_m, cells.low[0], cells.low[1], cells.low[2]
    n_near = np.int64(0)
    for chunk in range(start, stop):
        total = sums[chunk]
        for s in range(N_SUMS):
            total[s] = 0.0
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(source))):
            x, y, z = _moved(R, t, source[i, 0], source[i, 1], source[i, 2])
            cx, cy, cz = int(np.floor((x - x0) / edge)), int(np.floor((y - y0) / edge)), int(np.floor((z - z0) / edge))
            slot = (cx * 73856093 ^ cy * 19349663 ^ cz * 83492791) & (N_SLOTS - 1)
            if slots[slot, 0] != cx or slots[slot, 1] != cy or slots[slot, 2] != cz or slots[slot, 4] == 0:
                n_near = _fill_slot(cells, cx, cy, cz, radius, slots, slot, near, n_near)
            likelihood = 0.0
            bx = by = bz = 0.0  # sum of e B d
            xx = xy = xz = yy = yz = zz = 0.0  # sum of e B
            n_within = 0
            for p in range(slots[slot, 3], slots[slot, 4]):
                d = near[p]
                dx, dy, dz = x - cells.xyz[d, 0], y - cells.xyz[d, 1], z - cells.xyz[d, 2]
                within[n_within] = d
                n_within += dx * dx + dy * dy + dz * dz <= radius * radius
            for p in range(n_within):
                d = within[p]
                dx, dy, dz = x - distribution[d, 0], y - distribution[d, 1], z - distribution[d, 2]
                ux = distribution[d, 3] * dx + distribution[d, 4] * dy + distribution[d, 5] * dz
                uy = distribution[d, 4] * dx + distribution[d, 6] * dy + distribution[d, 7] * dz
                uz = distribution[d, 5] * dx + distribution[d, 7] * dy + distribution[d, 8] * dz
                e = np.exp(-0.5 * (ux * dx + uy * dy + uz * dz))
                likelihood += e
                bx, by, bz = bx + e * ux, by + e * uy, bz + e * uz
                xx, xy, xz = xx + e * distribution[d, 3], xy + e * distribution[d, 4], xz + e * distribution[d, 5]
                yy, yz, zz = yy + e * distribution[d, 6], yz + e * distribution[d, 7], zz + e * distribution[d, 8]
            if likelihood <= 0.0:
                continue
            w = 1.0 / (likelihood + outlier)
            total[PAIRS] += 1
            total[WEIGHT] += likelihood * w
            total[SCORE] += np.log(likelihood / outlier + 1.0)
            _add_block(total, x, y, z, w * bx, w * by, w * bz, w * xx, w * xy, w * xz, w * yy, w * yz, w * zz)


@inner
def _fill_slot(cells, i, j, k, radius, slots, slot, near, n_near):  # type: ignore[no-untyped-def]
    """List the sorted points within ``radius`` of a cube. Cubes have the edge of the cells and begin where they do.

    A slot holds the cube along x, y, z, and first and last + 1 of its list in ``near``, of which ``n_near`` are in use;
    it is empty where the last is 0. Once there may be no room, all lists are forgotten. Returns ``n_near``.
    """
    edge, low = cells.cell_m, cells.low
    if n_near + len(cells.xyz) > len(near):
        n_near = 0
        for s in range(N_SLOTS):
            slots[s, 4] = 0
    slots[slot, 0], slots[slot, 1], slots[slot, 2], slots[slot, 3] = i, j, k, n_near
    x, y, z = low[0] + (i + 0.5) * edge, low[1] + (j + 0.5) * edge, low[2] + (k + 0.5) * edge
    n = int(radius / edge) + 1
    for row in range(max(i - n, 0), min(i + n + 1, len(cells.row_start) - 1)):
        end = cells.row_start[row + 1]
        first = _first_at_least(cells.column_y, np.int64(cells.row_start[row]), end, j - n)
        last = _first_at_least(cells.column_y, first, end, j + n + 1)
        for p in range(cells.column_start[first], cells.column_start[last]):
            dx = max(abs(cells.xyz[p, 0] - x) - 0.5 * edge, 0.0)
            dy = max(abs(cells.xyz[p, 1] - y) - 0.5 * edge, 0.0)
            dz = max(abs(cells.xyz[p, 2] - z) - 0.5 * edge, 0.0)
            near[n_near] = p
            n_near += dx * dx + dy * dy + dz * dz <= radius * radius * (1 + 1e-9)
    slots[slot, 4] = n_near
    return n_near


@inner
def _first_at_least(values, a, b, least):  # type: ignore[no-untyped-def]
    """First of the ascending values [a, b) that is at least ``least``; b if none is."""
    while a < b:
        m = (a + b) >> 1
        if values[m] < least:
            a = m + 1
        else:
            b = m
    return a


@kernel
def plane_blocks(xyz, normals, residual, weight, block, sums):  # type: ignore[no-untyped-def]
    """Point-to-plane pairs summed by block: ``block`` (k,) of each pair, points (k, 3) float64 after the pose, normals.

    ``sums`` (blocks, `N_SUMS`) is added to, in the order of the pairs.
    """
    J = np.empty(6)
    for i in range(len(xyz)):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        _fill_row(J, x, y, z, np.float64(normals[i, 0]), np.float64(normals[i, 1]), np.float64(normals[i, 2]))
        _add(sums[block[i]], J, weight[i], residual[i])


@kernel
def nearest_to_means(xyz, voxel, mean, kept):  # type: ignore[no-untyped-def]
    """Of the points (m, 3) of each voxel, the one nearest to its mean (v, 3); the first of equally near ones.

    ``kept`` (v,) int64 is filled with their indices; ``voxel`` (m,) int32 leaves none empty.
    """
    best_sq = np.empty(len(mean))
    for v in range(len(mean)):
        best_sq[v] = np.inf
    for i in range(len(xyz)):
        v = voxel[i]
        sq = _sq_length(xyz[i, 0] - mean[v, 0], xyz[i, 1] - mean[v, 1], xyz[i, 2] - mean[v, 2])
        if sq < best_sq[v]:
            best_sq[v], kept[v] = sq, i


@kernel
def sum_products(xyz, voxel, mean, products):  # type: ignore[no-untyped-def]
    """Add the products xx, xy, xz, yy, yz, zz of each point's (m, 3) offset from its voxel's mean to (v, 6)."""
    for i in range(len(xyz)):
        v = voxel[i]
        x, y, z = xyz[i, 0] - mean[v, 0], xyz[i, 1] - mean[v, 1], xyz[i, 2] - mean[v, 2]
        products[v, 0] += x * x
        products[v, 1] += x * y
        products[v, 2] += x * z
        products[v, 3] += y * y
        products[v, 4] += y * z
        products[v, 5] += z * z


@inner
def _moved(R, t, x, y, z):  # type: ignore[no-untyped-def]
    x, y, z = _turned(R, x, y, z)
    return x + t[0], y + t[1], z + t[2]


@inner
def _turned(R, x, y, z):  # type: ignore[no-untyped-def]
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )


@inner
def _sq_length(x, y, z):  # type: ignore[no-untyped-def]
    return x * x + y * y + z * z


@inner
def _fill_row(J, x, y, z, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Row of the Jacobian of a point's distance along a normal: the normal, and its moment about the origin."""
    J[0], J[1], J[2] = nx, ny, nz
    J[3], J[4], J[5] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx


@inner
def _add(total, J, w, r):  # type: ignore[no-untyped-def]
    """Add one residual with row ``J`` of the Jacobian."""
    k = 0
    for a in range(6):
        for b in range(a, 6):
            total[k] += w * J[a] * J[b]
            k += 1
        total[21 + a] += w * J[a] * r


@inner
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
