"""First pose by the multi-resolution normal distributions transform (paper, section 4.1).

The target becomes one normal distribution per cell; the pose maximises the likelihood of the source points, coarse
cells first. Each distribution is widened by a share of its cell, so that a facade draws points from metres away in the
coarse cells and is sharp in the fine ones.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from loda_pdal.kernels.alignment import CHUNK, N_SUMS, SCORE, distribution_chunks, sum_products
from loda_pdal.kernels.cells import CellList, build_cells, to_cell_frame
from loda_pdal.kernels.parallel import run_ranges, thread_count
from loda_pdal.model.cloud import BoolArray, Float32Array, FloatArray
from loda_pdal.model.transform import IDENTITY, exp_se3, transform_points
from loda_pdal.params import NdtParams
from loda_pdal.stages.fuse import downsample, mean_of_voxels, voxel_of_point

WIDENING = 0.15
"""Standard deviation added to each distribution, as a share of the cell."""

REACH = 1.5
"""Distributions whose mean is farther than this many cells draw no point."""

SOURCE_LEAF = 0.25
"""Voxel edge of the source points, as a share of the cell."""

OUTLIER = 0.05
"""Likelihood, against 1 at a mean, at which a point belongs to no distribution as much as to one."""

START_YAWS_DEG = (0.0, -8.0, 8.0)
"""Turns about the vertical from which the search starts; the likeliest outcome goes on."""

N_SCOUTED = 2
"""Levels climbed from every start before one is chosen."""

LONGEST_STRETCH = 4.0
"""Steps are stretched up to this while they help: a point that several cells draw moves too little by itself."""

SMALLEST_UPDATE = 1e-3
"""A level ends when the points move less than this share of its cell."""


@dataclass(frozen=True)
class CoarsePose:
    """A first pose and how it was found.

    Attributes
    ----------
    T_target_source : (4, 4) float64
        Moves source points onto the target.
    converged : bool
        Whether the finest level came to rest; ``message`` says why not.
    iterations : tuple of int
        Steps per level.
    score : float
        Log likelihood of the source points at the finest level; -inf where there was none.
    """

    T_target_source: FloatArray
    converged: bool
    iterations: tuple[int, ...]
    score: float
    message: str = ""


def coarse_pose(source_xyz: FloatArray, target_xyz: FloatArray, params: NdtParams) -> CoarsePose:
    """Pose that lays the source on the target, from no first guess.

    Parameters
    ----------
    source_xyz, target_xyz : (m, 3), (n, 3) float64, m
    params : NdtParams

    Returns
    -------
    CoarsePose
        The identity, not converged, where either cloud is too small for a single cell.
    """
    if len(source_xyz) == 0 or len(target_xyz) == 0:
        return CoarsePose(IDENTITY.copy(), False, (), -np.inf, "NDT: a cloud is empty.")
    centre = target_xyz.mean(axis=0)
    source, target = source_xyz - centre, target_xyz - centre
    with ThreadPoolExecutor(thread_count()) as pool:
        levels = list(pool.map(lambda cell_m: _Level.of(source, target, cell_m, params), params.cells_m))
    best = _best_start(levels[:N_SCOUTED], params)
    for level in levels[N_SCOUTED:]:
        best = _climb(level, best, params)
    T = best.T_target_source.copy()
    T[:3, 3] += centre - T[:3, :3] @ centre
    return CoarsePose(T, best.converged, best.iterations, best.score, best.message)


def distributions(xyz: FloatArray, cell_m: float, min_points: int) -> tuple[FloatArray, FloatArray]:
    """Normal distribution of each cell of ``cell_m`` that holds at least ``min_points`` of the points (n, 3).

    Returns
    -------
    mean : (c, 3) float64, m
    information : (c, 6) float64, 1/m2
        Inverse of the covariance, widened by `WIDENING`: xx, xy, xz, yy, yz, zz.
    """
    voxel, n = voxel_of_point(xyz, cell_m)
    mean = mean_of_voxels(xyz, voxel, n)
    count = np.bincount(voxel, minlength=n)
    products = np.zeros((n, 6))
    sum_products(xyz, voxel, mean, products)
    is_kept = count >= min_points
    covariance = symmetric(products[is_kept] / count[is_kept, None], 3)
    widened = covariance + (WIDENING * cell_m) ** 2 * np.eye(3)
    return mean[is_kept], np.ascontiguousarray(np.linalg.inv(widened)[:, *np.triu_indices(3)])


def is_covered(xyz: FloatArray, other_xyz: FloatArray, cell_m: float) -> BoolArray:
    """Which points (m, 3) lie, in plan, in a cell of ``cell_m`` that holds a point of the other cloud too, (m,)."""
    plan = np.vstack([xyz, other_xyz]) * [1.0, 1.0, 0.0]
    cell, n_cells = voxel_of_point(plan, cell_m)
    is_held = np.zeros(n_cells, dtype=np.bool_)
    is_held[cell[len(xyz) :]] = True
    return np.asarray(is_held[cell[: len(xyz)]])


def symmetric(upper: FloatArray, d: int = 6) -> FloatArray:
    """Symmetric matrices (..., d, d) of their upper triangles (..., d (d + 1) / 2), row by row."""
    row, column = np.triu_indices(d)
    full = np.empty((*upper.shape[:-1], d, d))
    full[..., row, column] = full[..., column, row] = upper
    return full


@dataclass(frozen=True)
class _Level:
    """Source points and target distributions at one cell size, about a common centre."""

    cell_m: float
    source: FloatArray
    mean: FloatArray
    cells: CellList
    distribution: FloatArray

    @classmethod
    def of(cls, source: FloatArray, target: FloatArray, cell_m: float, params: NdtParams) -> _Level:
        mean, information = distributions(target, cell_m, params.min_points)
        cells = build_cells(mean, cell_m, np.zeros(3))
        return cls(
            cell_m=cell_m,
            source=downsample(source, SOURCE_LEAF * cell_m),
            mean=mean,
            cells=cells,
            distribution=np.hstack([cells.xyz, information[cells.idx]], dtype=np.float64),
        )

    def source_over_target(self, T: FloatArray) -> Float32Array:
        """The source points that a pose lays over the target, in plan: the others would be drawn to its edge."""
        is_over = is_covered(transform_points(T, self.source), self.mean, self.cell_m)
        return to_cell_frame(self.cells, self.source[is_over])

    def normal_equations(self, source: Float32Array, T: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """J'BJ (6, 6), J'Bd (6,) and the log likelihood of source points at a pose."""
        n_chunks = -(-len(source) // CHUNK)
        sums = np.empty((n_chunks, N_SUMS))
        R, t = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
        run_ranges(
            distribution_chunks, n_chunks, source, R, t, self.cells, self.distribution, REACH * self.cell_m, OUTLIER,
            sums, min_size=1,
        )  # fmt: skip
        total = sums.sum(axis=0)
        return symmetric(total[:21]), total[21:27], float(total[SCORE])


def _best_start(levels: list[_Level], params: NdtParams) -> CoarsePose:
    """The likeliest pose at the coarsest levels over all starts; the first of equally likely ones."""
    best = CoarsePose(IDENTITY.copy(), False, (), -np.inf, "NDT: too few points for any cell.")
    for yaw_deg in START_YAWS_DEG:
        turned = exp_se3(np.array([0, 0, 0, 0, 0, np.radians(yaw_deg)]))
        pose = CoarsePose(turned, False, (), -np.inf)
        for level in levels:
            pose = _climb(level, pose, params)
        if pose.score > best.score:
            best = pose
    return best


def _climb(level: _Level, start: CoarsePose, params: NdtParams) -> CoarsePose:
    """The pose of greatest likelihood at one level, by Gauss-Newton steps stretched or shortened as they succeed."""
    T = start.T_target_source
    source = level.source_over_target(T)
    if len(source) == 0:
        return start
    spread = float(np.sqrt((source.astype(np.float64) ** 2).sum(axis=1).mean()))
    H, g, score = level.normal_equations(source, T)
    stretch, n, has_settled = 1.0, 0, False
    while n < params.max_iterations and not has_settled:
        n += 1
        damped = H + 1e-9 * np.diag(np.diag(H)) + 1e-12 * np.eye(6)
        twist = np.asarray(np.linalg.solve(damped, g), dtype=np.float64) * -stretch
        T_new = exp_se3(twist) @ T
        H_new, g_new, score_new = level.normal_equations(source, T_new)
        if score_new >= score:
            T, H, g, score = T_new, H_new, g_new, score_new
            stretch = min(1.5 * stretch, LONGEST_STRETCH)
        else:
            stretch /= 4
        has_settled = bool(
            np.linalg.norm(twist[:3]) + spread * np.linalg.norm(twist[3:]) < SMALLEST_UPDATE * level.cell_m
        )
    message = "" if has_settled else f"NDT: {n} iterations did not settle at cells of {level.cell_m:g} m."
    return CoarsePose(T, has_settled, (*start.iterations, n), score, message)
