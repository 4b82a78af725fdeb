"""Fine pose by robust point-to-plane ICP over a voxel pyramid, and its covariance (paper, section 4.1, equation 1).

Weights are tukey(|r|; tau) / sigma_i^2 with tau in metres (METHOD 1.2). Our presets let tau follow the residuals with
which a level starts: a wall is not rejected for being where the first pose left it, and where surfaces fit to
centimetres, a road that was raised by 0.2 m draws the pose no more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loda_pdal.kernels.alignment import (
    CHUNK,
    N_SUMS,
    PAIRS,
    SCORE,
    WEIGHT,
    nearest_to_means,
    plane_blocks,
    plane_chunks,
)
from loda_pdal.kernels.cells import CellList, build_cells, to_cell_frame
from loda_pdal.kernels.parallel import run_ranges
from loda_pdal.model.cloud import BoolArray, Float32Array, FloatArray, IntArray
from loda_pdal.model.pair import Pair, at_once
from loda_pdal.model.transform import IDENTITY, exp_se3, transform_points
from loda_pdal.params import IcpParams, NormalParams
from loda_pdal.stages.fuse import mean_of_voxels, voxel_of_point
from loda_pdal.stages.ndt import is_covered, symmetric
from loda_pdal.stages.normals import estimate_normals

MIN_PAIRS = 50
"""Fewer pairs give no pose."""

MIN_INFORMATION = 1e-4
"""A direction with less of the information of the best observed one is not observed."""

MIN_INFORMATION_OVER_NOISE = 2.0
"""Nor is one with less than this many times the information that the noise of the normals feigns."""

MIN_OVERLAP = 0.35
"""Share of the jointly covered surfaces that must be paired, in the worst direction, for the pose to be believed."""

COVERED_M = 2.0
"""Cells of this edge, in plan, in which both clouds have points are covered by both."""

MAX_RMSE_SHARE = 0.3
"""Robust residual, as a share of tau, above which the surfaces do not lie on each other."""

MAX_LAST_STEP = 0.5
"""Last step, in standard deviations of the pose, that is still at rest when the iterations have run out."""

TUKEY_SIGMAS = 4.685
"""tau over the standard deviation of the residuals, where it follows them: as efficient as least squares to 95 %."""

MIN_BLOCKS = 20
"""Blocks that a block covariance needs; they are halved, down to 1 m, until there are as many."""

UNKNOWN_POSE = np.diag([1e4, 1e4, 1e4, 1.0, 1.0, 1.0])
"""Covariance of a pose about which nothing was learned: 100 m, 1 rad."""


@dataclass(frozen=True)
class FinePose:
    """The pose, its uncertainty, and what is needed to trust it.

    Attributes
    ----------
    T_target_source : (4, 4) float64
        Moves source points onto the target.
    covariance : (6, 6) float64
        Of the twist (tx, ty, tz, rx, ry, rz), m and rad, applied about ``centre`` after the pose.
    centre : (3,) float64, m
        Mean of the target points.
    converged : bool
        Whether the pose may be trusted; ``message`` says why not.
    iterations : tuple of int
        Steps per level.
    n_pairs, rmse_m, overlap
        Pairs at the end, their robust residual (m), and the share of the planar source points that have a partner.
    """

    T_target_source: FloatArray
    covariance: FloatArray
    centre: FloatArray
    converged: bool
    iterations: tuple[int, ...]
    n_pairs: int
    rmse_m: float
    overlap: float
    message: str = ""


@dataclass(frozen=True)
class Surface:
    """The part of a cloud that lies on planes.

    Attributes
    ----------
    xyz : (m, 3) float64, m
        Its points.
    normals : (m, 3) float32
        Unit normals.
    roughness : (m,) float32, m
        Robust standard deviation about the plane.
    centre : (3,) float64, m
        Mean of the whole cloud; zeros where it is empty.
    """

    xyz: FloatArray
    normals: Float32Array
    roughness: Float32Array
    centre: FloatArray

    @classmethod
    def of(cls, xyz: FloatArray, params: NormalParams) -> Surface:
        """Planes of a fused cloud (n, 3)."""
        found = estimate_normals(xyz, params)
        on_plane = np.flatnonzero(found.is_valid)
        centre = xyz.mean(axis=0) if len(xyz) else np.zeros(3)
        return cls(xyz[on_plane], found.normals[on_plane], found.roughness[on_plane], centre)

    def thinned(self, leaf_m: float) -> Surface:
        """The point nearest to the mean of each voxel of ``leaf_m``, with its plane; the first of equally near ones."""
        voxel, n = voxel_of_point(self.xyz, leaf_m)
        if n == len(self.xyz):
            return self
        kept = np.empty(n, dtype=np.int64)
        nearest_to_means(self.xyz, voxel, mean_of_voxels(self.xyz, voxel, n), kept)
        return Surface(self.xyz[kept], self.normals[kept], self.roughness[kept], self.centre)


def fine_pose(
    source: Surface,
    target: Surface,
    T_target_source: FloatArray,
    params: IcpParams,
    normal_params: NormalParams,
) -> FinePose:
    """Refine a first pose.

    Parameters
    ----------
    source, target : Surface
        Of the fused clouds. A pyramid level keeps one point of each voxel, with its plane.
    T_target_source : (4, 4) float64
        First pose, right to well under the largest correspondence radius.
    params : IcpParams
    normal_params : NormalParams
        With which the planes were estimated.

    Returns
    -------
    FinePose
        In directions that the surfaces do not hold the first pose is left alone, and it is not converged.
    """
    centre = target.centre
    if min(len(source.xyz), len(target.xyz)) < MIN_PAIRS:
        message = f"ICP: only {len(source.xyz)} and {len(target.xyz)} points lie on planes."
        return FinePose(T_target_source, UNKNOWN_POSE.copy(), centre, False, (), 0, float("nan"), 0.0, message)
    T = _about(centre, T_target_source)
    iterations: list[int] = []
    for leaf_m, radius_m, max_iterations in zip(params.leaves_m, params.radii_m, params.max_iterations, strict=True):
        own, other = at_once(Surface.thinned, Pair(source, target), Pair(leaf_m, leaf_m))
        level = _Level.of(own, other, radius_m, params, normal_params)
        level = replace(level, tau_m=_tau(level, T, params))
        T, n, last_step = _descend(level, T, max_iterations, params.stop_update)
        iterations.append(n)
    pairs = level.pair(T)
    covariance = _finite_inverse(pairs.normal_matrix, level.lever_m)
    if params.covariance == "block":
        covariance = _symmetric(covariance + _block_covariance(level, pairs, T, params.covariance_block_m))
    message = _doubt(level, pairs, T, last_step, covariance, params)
    return FinePose(
        T_target_source=_about(-centre, T),
        covariance=covariance,
        centre=centre,
        converged=not message,
        iterations=tuple(iterations),
        n_pairs=pairs.n,
        rmse_m=pairs.rmse_m,
        overlap=pairs.n / len(level.source.xyz),
        message=message,
    )


def _about(centre: FloatArray, T: FloatArray) -> FloatArray:
    """The same motion in coordinates from which ``centre`` is subtracted."""
    moved = T.copy()
    moved[:3, 3] += T[:3, :3] @ centre - centre
    return moved


@dataclass(frozen=True)
class _Pairs:
    """Pairs at one pose: nearest target point, residual (m) and weight (0: no pair) per source point; and the sums."""

    match: IntArray
    residual: FloatArray
    weight: FloatArray
    sums: FloatArray

    @property
    def n(self) -> int:
        return int(self.sums[PAIRS])

    @property
    def rmse_m(self) -> float:
        return float(np.sqrt(self.sums[SCORE] / self.sums[WEIGHT])) if self.sums[WEIGHT] > 0 else float("nan")

    @property
    def normal_matrix(self) -> FloatArray:
        """J'WJ, (6, 6)."""
        return symmetric(self.sums[:21])

    @property
    def gradient(self) -> FloatArray:
        """J'Wr, (6,)."""
        return self.sums[21:27]


@dataclass(frozen=True)
class _Level:
    """One level of the pyramid, ready to be paired at any pose, in coordinates about the centre.

    ``lever_m`` is the root mean square distance of the target from the centre; a rotation times it is comparable with
    a shift. ``tilt`` is the variance of a normal, rad2, per m2 of squared roughness.
    """

    source: Surface
    target: Surface
    cells: CellList
    source_xyz: Float32Array
    target_xyz: Float32Array
    sq_sigma: FloatArray
    sq_sigma0: float
    lever_m: float
    tilt: float
    radius_m: float
    tau_m: float
    min_cosine: float
    is_robust: bool
    match: IntArray
    clearance: FloatArray
    last_pose: FloatArray

    @classmethod
    def of(
        cls,
        source: Surface,
        target: Surface,
        radius_m: float,
        params: IcpParams,
        normal_params: NormalParams,
    ) -> _Level:
        cells = build_cells(target.xyz, radius_m, target.centre)
        target_xyz = to_cell_frame(cells, target.xyz)
        return cls(
            source=source,
            target=target,
            cells=cells,
            source_xyz=to_cell_frame(cells, source.xyz),
            target_xyz=target_xyz,
            sq_sigma=params.sigma0_m**2 + target.roughness.astype(np.float64) ** 2,
            sq_sigma0=params.sigma0_m**2,
            lever_m=max(float(np.sqrt((target_xyz.astype(np.float64) ** 2).sum(axis=1).mean())), 1e-3),
            tilt=4 / (normal_params.max_neighbours * normal_params.radius_m**2),
            radius_m=radius_m,
            tau_m=params.tukey_m * radius_m / params.radii_m[-1],
            min_cosine=float(np.cos(np.radians(params.max_normal_angle_deg))),
            is_robust=params.loss == "tukey",
            match=np.full(len(source.xyz), -1, dtype=np.int32),
            clearance=np.zeros(len(source.xyz)),
            last_pose=IDENTITY.copy(),
        )

    def pair(self, T: FloatArray) -> _Pairs:
        """All pairs at a pose. What it finds is kept, so that at the next pose few points need search again."""
        n = len(self.source_xyz)
        n_chunks = -(-n // CHUNK)
        residual, weight, sums = np.empty(n), np.empty(n), np.empty((n_chunks, N_SUMS))
        run_ranges(
            plane_chunks, n_chunks, self.source_xyz, self.source.normals, *_parts(T), *_parts(self.last_pose),
            self.cells, self.target_xyz, self.target.normals, self.sq_sigma, self.radius_m, self.min_cosine, self.tau_m,
            self.is_robust, self.match, self.clearance, residual, weight, sums, min_size=1,
        )  # fmt: skip
        self.last_pose[:] = T
        return _Pairs(self.match, residual, weight, sums.sum(axis=0))

    def axes(self, pairs: _Pairs) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Information (6,), directions (6, 6) in columns, and which of them the pairs observe, with scaled rotations.

        Normals scatter by ``tilt * roughness^2``, so that even a flat plane seems to hold a pose sideways, by the sum
        of weight * scatter. With weights tukey / sigma^2 and |n| = 1 that sum follows from the normal matrix.
        """
        H = pairs.normal_matrix
        information, directions = np.linalg.eigh(H / _scale(self.lever_m))
        feigned = self.tilt * max(pairs.sums[WEIGHT] - self.sq_sigma0 * np.trace(H[:3, :3]), 0.0)
        needed = max(MIN_INFORMATION * information[-1], MIN_INFORMATION_OVER_NOISE * feigned)
        return information, directions, np.asarray(information > needed)


def _parts(T: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation (3, 3) and shift (3,) of a pose, as the kernels take them."""
    return np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])


def _tau(level: _Level, T: FloatArray, params: IcpParams) -> float:
    """Residual (m) at which a level rejects pairs.

    The residuals of surfaces that face along x, y and z are judged apart: level ground that fits says nothing of walls.
    """
    if not params.adapts_tukey or params.loss != "tukey":
        return params.tukey_m
    pairs = level.pair(T)
    is_pair = pairs.weight > 0
    residual = np.abs(pairs.residual[is_pair])
    faces_along = np.abs(level.target.normals[pairs.match[is_pair]]) > np.sqrt(0.5)
    sigmas = [1.4826 * float(np.median(residual[f])) for f in faces_along.T if np.count_nonzero(f) >= MIN_PAIRS]
    return float(np.clip(TUKEY_SIGMAS * max(sigmas, default=np.inf), TUKEY_SIGMAS * params.sigma0_m, level.tau_m))


def _descend(
    level: _Level, T: FloatArray, max_iterations: int, stop_update: float
) -> tuple[FloatArray, int, FloatArray]:
    """Gauss-Newton at one level: the pose, the steps taken, and the last step."""
    n, step = 0, np.full(6, np.inf)
    while n < max_iterations and not _is_at_rest(step, stop_update):
        n += 1
        pairs = level.pair(T)
        information, directions, is_observed = level.axes(pairs)
        observed = directions[:, is_observed]
        inverse = (observed / information[is_observed]) @ observed.T / _scale(level.lever_m)
        step = -inverse @ pairs.gradient
        T = exp_se3(step) @ T
    return T, n, step


def _is_at_rest(step: FloatArray, stop_update: float) -> bool:
    return bool(np.linalg.norm(step[:3]) < stop_update and np.linalg.norm(step[3:]) < stop_update)


def _scale(lever_m: float) -> FloatArray:
    """Factors (6, 6) that turn metres and radians of a normal matrix, or its inverse, into metres only."""
    lever = np.array([1, 1, 1, lever_m, lever_m, lever_m])
    return np.outer(lever, lever)


def _finite_inverse(H: FloatArray, lever_m: float) -> FloatArray:
    """Inverse of normal matrices (..., 6, 6), at most 100 m in a direction without information."""
    information, directions = np.linalg.eigh(H / _scale(lever_m))
    scaled = directions / np.maximum(information, 1e-4)[..., None, :]
    return _symmetric(scaled @ np.swapaxes(directions, -1, -2) / _scale(lever_m))


def _symmetric(matrix: FloatArray) -> FloatArray:
    """Matrices (..., d, d) without the rounding that makes them differ from their transposes."""
    return np.asarray((matrix + np.swapaxes(matrix, -1, -2)) / 2)


def _block_covariance(level: _Level, pairs: _Pairs, T: FloatArray, block_m: float) -> FloatArray:
    """Covariance of the pose by leaving out one ground block at a time (delete-one jackknife), (6, 6).

    Residuals within a block may be correlated in any way; those of different blocks are taken as independent. Each
    solution without a block is linearised about the full one, which costs one 6x6 system.
    """
    is_pair = pairs.weight > 0
    p = transform_points(T, level.source_xyz[is_pair].astype(np.float64))
    normals = level.target.normals[pairs.match[is_pair]]
    block, n_blocks = _ground_blocks(p, block_m)
    if n_blocks < 2:
        return np.zeros((6, 6))
    own = np.zeros((n_blocks, N_SUMS))
    plane_blocks(p, normals, pairs.residual[is_pair], pairs.weight[is_pair], block, own)
    without = own.sum(axis=0) - own
    steps = -_finite_inverse(symmetric(without[:, :21]), level.lever_m) @ without[:, 21:27, None]
    steps = steps[..., 0]
    deviation = steps - steps.mean(axis=0)
    return np.asarray((n_blocks - 1) / n_blocks * deviation.T @ deviation)


def _ground_blocks(p: FloatArray, block_m: float) -> tuple[IntArray, int]:
    """Ground block of each point (k,), and how many there are."""
    while True:
        block, n_blocks = voxel_of_point(p * [1.0, 1.0, 0.0], block_m)
        if n_blocks >= MIN_BLOCKS or block_m <= 1.0:
            return block, n_blocks
        block_m /= 2


def _doubt(
    level: _Level, pairs: _Pairs, T: FloatArray, last_step: FloatArray, covariance: FloatArray, params: IcpParams
) -> str:
    """Why the pose is not to be believed; empty if it is."""
    if pairs.n < MIN_PAIRS:
        return f"ICP: only {pairs.n} pairs."
    if not level.axes(pairs)[2].all():
        return "ICP: the surfaces can slide or turn along one another; the pose is not observed in that direction."
    share = _paired_share(level, pairs, T)
    if share < MIN_OVERLAP:
        return f"ICP: only {share:.0%} of the surfaces that hold the pose in its weakest direction have a partner."
    if pairs.rmse_m > MAX_RMSE_SHARE * params.tukey_m:
        return f"ICP: the surfaces lie {pairs.rmse_m:.3f} m apart."
    is_small = last_step @ np.linalg.solve(covariance, last_step) < MAX_LAST_STEP**2
    if not is_small and not _is_at_rest(last_step, params.stop_update):
        return f"ICP: the iterations ran out while the pose still moved {np.linalg.norm(last_step[:3]):.4f} m."
    return ""


def _paired_share(level: _Level, pairs: _Pairs, T: FloatArray) -> float:
    """Share of the jointly covered source surfaces that are paired, in the worst direction (0 to 1).

    The ground of any two streets can be paired; whether the walls can is what tells one place from another. So the
    share is taken of the sums of n n' / sigma^2 and not of the points; rough surfaces (crowns) count for little.
    """
    p = transform_points(T, level.source_xyz.astype(np.float64))
    is_joint = is_covered(p, level.target_xyz.astype(np.float64), COVERED_M)
    weight = is_joint / (level.sq_sigma0 + level.source.roughness.astype(np.float64) ** 2)
    n = level.source.normals.astype(np.float64)
    of_all, of_pairs = (np.einsum("ki,kj->ij", n * w[:, None], n) for w in (weight, weight * (pairs.weight > 0)))
    sums, directions = np.linalg.eigh(of_all)
    whiten = directions / np.sqrt(np.maximum(sums, 1e-9))
    return float(np.linalg.eigvalsh(whiten.T @ of_pairs @ whiten)[0])
