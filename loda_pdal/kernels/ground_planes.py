"""One plane per ground cell by RANSAC, and the surface that blends the planes."""

from __future__ import annotations

import numpy as np

from loda_pdal.kernels.compiled import inner, kernel
from loda_pdal.kernels.parallel import run_ranges
from loda_pdal.model.cloud import FloatArray, Int64Array

SLOPE_PRIOR = 0.05
"""Half-width, in cells, of the spread in plan below which a cell's slope is drawn to level: a strip of ground a hand
wide says nothing about the slope across it."""


def fit_planes(
    xyz: FloatArray,
    n_raw: Int64Array,
    start: Int64Array,
    seed: int,
    cell_m: float,
    inlier_m: float,
    max_slope: float,
    iterations: int,
) -> tuple[FloatArray, Int64Array, Int64Array]:
    """Best plane z = h + gx x + gy y of each cell, by RANSAC with truncated squared residuals, then least squares.

    Parameters
    ----------
    xyz : (m, 3) float64, m
        Points about the centre of their own cell, sorted by cell.
    n_raw : (m,) int64
        Raw points of each.
    start : (c + 1,) int64
        First point of each cell.
    seed : int
        Of the draws; the same for every cell, so that a cell's plane depends on nothing but its points.
    cell_m, inlier_m : float, m
        Edge of a cell; distance within which a point lies in the plane.
    max_slope : float
        Steepest plane, rise per metre.
    iterations : int
        Draws per cell.

    Returns
    -------
    plane : (c, 3) float64
        h (m), gx, gy; NaN where no plane was found.
    n_inliers, n_raw_inliers : (c,) int64
        Points, and raw points, in the plane.
    """
    n_cells = len(start) - 1
    plane = np.full((n_cells, 3), np.nan)
    n_inliers, n_raw_inliers = np.zeros(n_cells, np.int64), np.zeros(n_cells, np.int64)
    run_ranges(
        _fit_range,
        n_cells,
        xyz,
        n_raw,
        start,
        int(seed),
        float(cell_m),
        float(inlier_m),
        float(max_slope),
        int(iterations),
        plane,
        n_inliers,
        n_raw_inliers,
        min_size=256,
    )
    return plane, n_inliers, n_raw_inliers


@kernel
def _fit_range(  # type: ignore[no-untyped-def]
    first, last, xyz, n_raw, start, seed, cell_m, inlier_m, max_slope, iterations, plane, n_inliers, n_raw_inliers
):
    prior = (SLOPE_PRIOR * cell_m) ** 2
    for c in range(first, last):
        a, b = start[c], start[c + 1]
        if b - a < 3:
            continue
        state = np.uint64(seed)
        best = np.inf
        h, gx, gy = np.nan, 0.0, 0.0
        for _ in range(iterations):
            state, i = _draw(state, b - a)
            state, j = _draw(state, b - a)
            state, k = _draw(state, b - a)
            is_plane, ph, px, py = _through(xyz, a + i, a + j, a + k)
            if not is_plane or px * px + py * py > max_slope * max_slope:
                continue
            cost = _cost(xyz, a, b, ph, px, py, inlier_m, best)
            if cost < best:
                best, h, gx, gy = cost, ph, px, py
        if not np.isfinite(best):
            continue
        for _ in range(3):
            h, gx, gy = _refined(xyz, a, b, h, gx, gy, inlier_m, prior)
        if gx * gx + gy * gy > max_slope * max_slope:
            continue
        scale = 1.0 / np.sqrt(1.0 + gx * gx + gy * gy)
        for p in range(a, b):
            if abs(xyz[p, 2] - h - gx * xyz[p, 0] - gy * xyz[p, 1]) * scale <= inlier_m:
                n_inliers[c] += 1
                n_raw_inliers[c] += n_raw[p]
        plane[c, 0], plane[c, 1], plane[c, 2] = h, gx, gy


@inner
def _draw(state, n):  # type: ignore[no-untyped-def]
    """Next state of the generator (SplitMix64) and a whole number below ``n``."""
    state = state + np.uint64(0x9E3779B97F4A7C15)
    z = state
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return state, np.int64((z >> np.uint64(33)) % np.uint64(n))


@inner
def _through(xyz, i, j, k):  # type: ignore[no-untyped-def]
    """Whether three points span a plane that is not upright, and its h, gx, gy."""
    ux, uy, uz = xyz[j, 0] - xyz[i, 0], xyz[j, 1] - xyz[i, 1], xyz[j, 2] - xyz[i, 2]
    vx, vy, vz = xyz[k, 0] - xyz[i, 0], xyz[k, 1] - xyz[i, 1], xyz[k, 2] - xyz[i, 2]
    det = ux * vy - uy * vx
    if abs(det) < 1e-9:
        return False, 0.0, 0.0, 0.0
    gx = (uz * vy - uy * vz) / det
    gy = (ux * vz - uz * vx) / det
    return True, xyz[i, 2] - gx * xyz[i, 0] - gy * xyz[i, 1], gx, gy


@inner
def _cost(xyz, a, b, h, gx, gy, inlier_m, best):  # type: ignore[no-untyped-def]
    """Sum of squared distances, each at most inlier_m squared; stops early above ``best``."""
    limit = inlier_m * inlier_m
    sq_scale = 1.0 / (1.0 + gx * gx + gy * gy)
    cost = 0.0
    for p in range(a, b):
        r = xyz[p, 2] - h - gx * xyz[p, 0] - gy * xyz[p, 1]
        cost += min(r * r * sq_scale, limit)
        if cost >= best:
            break
    return cost


@inner
def _refined(xyz, a, b, h, gx, gy, inlier_m, prior):  # type: ignore[no-untyped-def]
    """Least-squares plane of the inliers of a plane, its slope drawn to level by ``prior`` (m2)."""
    scale = 1.0 / np.sqrt(1.0 + gx * gx + gy * gy)
    n = 0
    mx, my, mz = 0.0, 0.0, 0.0
    for p in range(a, b):
        if abs(xyz[p, 2] - h - gx * xyz[p, 0] - gy * xyz[p, 1]) * scale <= inlier_m:
            n += 1
            mx += xyz[p, 0]
            my += xyz[p, 1]
            mz += xyz[p, 2]
    if n < 3:
        return h, gx, gy
    mx, my, mz = mx / n, my / n, mz / n
    xx, xy, yy, xz, yz = n * prior, 0.0, n * prior, 0.0, 0.0
    for p in range(a, b):
        x, y, z = xyz[p, 0] - mx, xyz[p, 1] - my, xyz[p, 2] - mz
        if abs(xyz[p, 2] - h - gx * xyz[p, 0] - gy * xyz[p, 1]) * scale <= inlier_m:
            xx += x * x
            xy += x * y
            yy += y * y
            xz += x * z
            yz += y * z
    det = xx * yy - xy * xy
    gx, gy = (xz * yy - xy * yz) / det, (xx * yz - xy * xz) / det
    return mz - gx * mx - gy * my, gx, gy


@kernel
def blended_height_range(
    start: int,
    stop: int,
    xy: FloatArray,
    cell_m: float,
    first: Int64Array,
    height: FloatArray,
    slope: FloatArray,
    result: FloatArray,
) -> None:
    """Height of points [start, stop): the planes of the four nearest cells, weighted bilinearly.

    Parameters
    ----------
    xy : (n, 2) float64, m
    cell_m : float, m
        Edge of a cell.
    first : (2,) int64
        Cell of the first row and column.
    height, slope : (nx, ny) float64, m, and (nx, ny, 2) float64
        Plane of each cell: height at its centre, NaN where there is none, and rise per metre along x and y.
    result : (n,) float64, m
        Filled with the heights; NaN where none of the four cells has a plane.
    """
    for p in range(start, stop):
        x = xy[p, 0] / cell_m - 0.5 - first[0]
        y = xy[p, 1] / cell_m - 0.5 - first[1]
        base_x, base_y = np.floor(x), np.floor(y)
        total = weight = 0.0
        for corner in range(4):
            step_x, step_y = corner // 2, corner % 2
            i, j = int(base_x) + step_x, int(base_y) + step_y
            if i < 0 or i >= height.shape[0] or j < 0 or j >= height.shape[1]:
                continue
            away_x, away_y = x - base_x - step_x, y - base_y - step_y
            plane = height[i, j] + (slope[i, j, 0] * (away_x * cell_m) + slope[i, j, 1] * (away_y * cell_m))
            w = (1.0 - abs(away_x)) * (1.0 - abs(away_y))
            if w > 0.0 and np.isfinite(plane):
                total += w * plane
                weight += w
        result[p] = total / weight if weight > 1e-9 else np.nan
