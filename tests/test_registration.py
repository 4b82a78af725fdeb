"""Known moves of simulated streets are found, to 1 cm and 0.02 degrees, or it is said that they were not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

from loda_pdal.kernels.alignment import CHUNK, N_SLOTS
from loda_pdal.kernels.parallel import set_threads
from loda_pdal.model.cloud import VoxelCloud, to_local_grid
from loda_pdal.model.pair import Pair
from loda_pdal.model.registration import Registration
from loda_pdal.model.transform import exp_se3, invert, rotation_angle, rotation_matrix, transform_points
from loda_pdal.params import FuseParams, IcpParams, NdtParams, NormalParams, Parameters
from loda_pdal.stages import icp, ndt
from loda_pdal.stages.fuse import fuse_points
from loda_pdal.stages.icp import Surface, fine_pose
from loda_pdal.stages.ndt import coarse_pose, distributions
from loda_pdal.stages.registration import register

HERE = np.array([420.0, -180.0, 12.0])
"""Middle of the scenes, in local metres."""

PARAMETERS = Parameters()


# --- a street of planes and boxes -------------------------------------------------------------------------------------


def rectangle(rng: np.random.Generator, corner: object, u: object, v: object, density: float) -> np.ndarray:
    """Points on the parallelogram at ``corner`` along ``u`` and ``v``."""
    corner, u, v = (np.asarray(p, dtype=float) for p in (corner, u, v))
    n = rng.poisson(np.linalg.norm(np.cross(u, v)) * density)
    return corner + rng.random((n, 1)) * u + rng.random((n, 1)) * v


def box(rng: np.random.Generator, x: float, y: float, size: tuple[float, float, float], density: float) -> np.ndarray:
    """Points on the four sides and the top of a box."""
    sx, sy, sz = ([size[0], 0, 0], [0, size[1], 0], [0, 0, size[2]])
    sides = [((x, y, 0), sx, sz), ((x, y, 0), sy, sz), ((x, y + size[1], 0), sx, sz), ((x + size[0], y, 0), sy, sz)]
    return np.vstack([rectangle(rng, *side, density) for side in [*sides, ((x, y, size[2]), sx, sy)]])


Item = tuple[float, float, tuple[float, float, float]]


def houses_and_cars(seed: int) -> list[Item]:
    """Two rows of houses of various sizes along 70 m, and parked cars."""
    rng = np.random.default_rng(seed)
    items: list[Item] = []
    for side in (-1, 1):
        x = -35.0
        while x < 27:
            width, depth, height = rng.uniform(6, 11), rng.uniform(6, 9), rng.uniform(4, 9)
            y = 8 + rng.uniform(0, 3)
            items.append((x, y if side > 0 else -y - depth, (width - rng.uniform(0.5, 2), depth, height)))
            x += width
    items += [(rng.uniform(-33, 30), rng.choice([-5.0, 3.5]), (4.4, 1.8, 1.5)) for _ in range(8)]
    return items


def changed(items: list[Item], seed: int) -> list[Item]:
    """About 15 % of the items gone, grown or moved."""
    rng = np.random.default_rng(seed)
    result = []
    for x, y, size in items:
        kind = rng.integers(20)
        if kind == 0:
            continue
        if kind == 1:
            x += rng.uniform(-3, 3)
        if kind == 2:
            size = (size[0], size[1], size[2] + 2.5)
        result.append((x, y, size))
    return result


def scan(items: list[Item], seed: int, noise_m: float = 0.02, density: float = 25.0) -> np.ndarray:
    """Points of undulating ground and of all items, (n, 3) m about the middle of the scene."""
    rng = np.random.default_rng(seed)
    ground = rectangle(rng, [-35, -20, 0], [70, 0, 0], [0, 40, 0], density)
    ground[:, 2] += 0.01 * ground[:, 0] + 0.1 * np.sin(ground[:, 1] / 9)
    points = np.vstack([ground, *(box(rng, *item, density) for item in items)])
    return points + rng.normal(0, noise_m, points.shape)


def fused(points: np.ndarray) -> VoxelCloud:
    return fuse_points(to_local_grid(points), FuseParams())


@cache
def two_epochs(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A street and the same street later, scanned by a noisier and sparser scanner, already registered."""
    items = houses_and_cars(seed)
    later = scan(changed(items, seed + 1), seed + 2, noise_m=0.03, density=18.0)
    return scan(items, seed + 3) + HERE, later + HERE


def move(shift: tuple[float, float, float], turn_deg: tuple[float, float, float]) -> np.ndarray:
    """A turn about the middle of the scene, then a shift."""
    T = np.eye(4)
    T[:3, :3] = rotation_matrix(np.radians(turn_deg))
    T[:3, 3] = HERE - T[:3, :3] @ HERE + shift
    return T


def errors(T: np.ndarray, T_true: np.ndarray) -> tuple[float, float]:
    """How far the middle of the scene is off (m), and the angle (degrees)."""
    left = T @ invert(T_true)
    return float(np.linalg.norm(left[:3, :3] @ HERE + left[:3, 3] - HERE)), float(np.degrees(rotation_angle(left)))


def registered(before: np.ndarray, after: np.ndarray, parameters: Parameters = PARAMETERS) -> Registration:
    return register(Pair(fused(before), fused(after)), parameters)


# --- recovery ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("seed", "shift", "turn_deg"),
    [
        (0, (0.0, 0, 0), (0.0, 0, 0)),
        (10, (0.12, -0.3, 0.05), (0.1, -0.2, 0.4)),
        (20, (2.1, -2.1, 0.4), (0, 0, 10)),
        (30, (-2.0, 1.8, -1.2), (3, -3, -9)),
        (40, (0.0, 3.0, 0), (0, 10, 0)),
    ],
)
def test_finds_a_known_move_of_a_changed_street(
    seed: int, shift: tuple[float, float, float], turn_deg: tuple[float, float, float]
) -> None:
    before, after = two_epochs(seed)
    T_true = move(shift, turn_deg)
    found = registered(before, transform_points(T_true, after))
    error_m, error_deg = errors(found.T_after_before, T_true)
    assert found.converged, found.message
    assert error_m < 0.01
    assert error_deg < 0.02
    assert found.rmse_m == pytest.approx(np.hypot(0.02, 0.03), rel=0.4)
    assert found.overlap > 0.8


def test_finds_the_move_where_half_of_each_survey_is_missing_in_the_other() -> None:
    before, after = two_epochs(50)
    before, after = before[before[:, 0] < HERE[0] + 14], after[after[:, 0] > HERE[0] - 14]
    T_true = move((1.0, 0.6, -0.3), (0, 0, 3))
    found = registered(before, transform_points(T_true, after))
    error_m, error_deg = errors(found.T_after_before, T_true)
    assert found.converged, found.message
    assert error_m < 0.01
    assert error_deg < 0.03
    assert found.overlap < 0.75


def test_a_survey_against_itself_stays_where_it_is() -> None:
    before, _ = two_epochs(0)
    found = registered(before, before)
    assert found.converged
    assert found.reference == "after"
    assert np.array_equal(found.T_after_before, np.eye(4))
    assert found.rmse_m == 0
    assert found.overlap == 1
    assert np.linalg.eigvalsh(found.covariance)[0] > 0
    assert np.sqrt(np.diag(found.covariance)).max() < 0.002


# --- laws -------------------------------------------------------------------------------------------------------------


def test_swapped_epochs_give_exactly_the_inverse() -> None:
    before, after = two_epochs(10)
    clouds = Pair(fused(before), fused(transform_points(move((0.3, 0.2, 0.1), (0, 0, 1)), after)))
    found, swapped = register(clouds, PARAMETERS), register(clouds.swapped, PARAMETERS)
    assert {found.reference, swapped.reference} == {"before", "after"}
    assert np.array_equal(found.covariance, swapped.covariance)
    assert np.array_equal(found.T_frame_before, swapped.T_frame_after)
    assert np.array_equal(found.T_frame_after, swapped.T_frame_before)
    assert np.abs(found.T_after_before @ swapped.T_after_before - np.eye(4)).max() < 1e-12


def test_neither_threads_nor_a_shift_of_the_map_change_the_pose() -> None:
    before, after = two_epochs(20)
    set_threads(1)
    one = registered(before, after)
    set_threads(3)
    three = registered(before, after)
    set_threads(None)
    assert np.array_equal(one.T_after_before, three.T_after_before)
    assert np.array_equal(one.covariance, three.covariance)
    shift = np.array([1000.0, -2000.0, 0.0])
    shifted = registered(before + shift, after + shift)
    back = np.eye(4)
    back[:3, 3] = -shift
    error_m, error_deg = errors(back @ shifted.T_after_before @ invert(back), one.T_after_before)
    assert error_m < 1e-5
    assert error_deg < 1e-5


# --- what cannot be registered ----------------------------------------------------------------------------------------


def test_two_unrelated_streets_do_not_converge() -> None:
    found = registered(two_epochs(0)[0], two_epochs(10)[1])
    assert not found.converged
    assert "partner" in found.message


def test_a_bare_field_is_not_held_sideways_and_is_not_moved_sideways() -> None:
    rng = np.random.default_rng(0)
    before, after = (rectangle(rng, [-30, -30, 0], [60, 0, 0], [0, 60, 0], 30) for _ in range(2))
    before, after = (field + rng.normal(0, 0.02, field.shape) + HERE for field in (before, after))
    found = registered(before, after + np.array([0, 0, 0.4]))
    assert not found.converged
    assert "slide" in found.message
    assert found.shift_m == pytest.approx([0, 0, 0.4], abs=0.02)


def test_clouds_too_small_for_anything_leave_the_pose_alone() -> None:
    before, _ = two_epochs(0)
    for some in (before[:0], before[:3]):
        for found in (registered(some, before), registered(before, some), registered(some, some)):
            assert not found.converged
            assert found.message
            assert np.array_equal(found.T_after_before, np.eye(4))
            assert np.isfinite(found.covariance).all()


# --- the parts --------------------------------------------------------------------------------------------------------


def test_the_first_pose_alone_is_good_enough_for_icp() -> None:
    before, after = two_epochs(30)
    T_true = move((2.4, 1.8, -0.5), (-2, 2, 10))
    found = coarse_pose(fused(before).xyz, fused(transform_points(T_true, after)).xyz, NdtParams())
    error_m, error_deg = errors(found.T_target_source, T_true)
    assert found.converged
    assert len(found.iterations) == 4
    assert error_m < 0.1
    assert error_deg < 0.2


def test_icp_alone_finds_small_moves_only() -> None:
    before, after = two_epochs(0)
    parameters = replace(PARAMETERS, ndt=NdtParams(is_enabled=False))
    near, far = move((0.3, -0.2, 0.1), (0, 0, 0.5)), move((2.5, 1.5, 0), (0, 0, 10))
    found = registered(before, transform_points(near, after), parameters)
    assert found.converged
    assert errors(found.T_after_before, near)[0] < 0.01
    assert not registered(before, transform_points(far, after), parameters).converged


def test_distributions_by_hand() -> None:
    corners = np.array([[x, y, z] for x in (1.0, 3.0) for y in (1.0, 2.0) for z in (0.0, 0.5)])
    mean, information = distributions(np.vstack([corners, [[9.0, 9, 9]]]), 4.0, 8)
    assert np.allclose(mean, [[2, 1.5, 0.25]])
    assert np.allclose(information, [[1 / (1 + 0.36), 0, 0, 1 / (0.25 + 0.36), 0, 1 / (0.0625 + 0.36)]])


def test_a_raised_road_does_not_draw_the_pose() -> None:
    before, _ = two_epochs(0)
    rng = np.random.default_rng(3)
    after = before + rng.normal(0, 0.01, before.shape)
    is_raised = (before[:, 0] < HERE[0] - 20) & (before[:, 2] < HERE[2] + 0.5)  # fresh asphalt at one end
    after[is_raised, 2] += 0.2
    unchanged = before[~is_raised]
    error = {}
    for name, params in {"ours": IcpParams(), "l2": IcpParams(loss="l2")}.items():
        found = registered(before, after, replace(PARAMETERS, icp=params))
        error[name] = np.abs(transform_points(found.T_after_before, unchanged) - unchanged).max()
    assert error["ours"] < 0.005
    assert error["l2"] > 0.05


def test_likelihood_of_many_cells_equals_its_definition() -> None:
    """On more cubes than the kernel remembers."""
    rng = np.random.default_rng(0)
    target, source = (rng.uniform(0, (70, 70, 12), (n, 3)) for n in (500_000, 4 * CHUNK))
    level = ndt._Level.of(source, target, 1.0, NdtParams())
    T = exp_se3(np.array([0.2, -0.1, 0.3, 0.01, -0.02, 0.03]))
    points = level.source_over_target(T)
    H, g, score = level.normal_equations(points, T)
    mean, information = distributions(target, 1.0, NdtParams().min_points)
    B = ndt.symmetric(information, 3)
    p = transform_points(T, points.astype(np.float64))
    log_likelihood, gradient, curvature = 0.0, np.zeros(6), np.zeros((6, 6))
    for point, near in zip(p, cKDTree(mean).query_ball_point(p, 1.5), strict=True):
        d = point - mean[near]
        e = np.exp(-0.5 * np.einsum("ki,kij,kj->k", d, B[near], d))
        if not e.any():
            continue
        w = e / (e.sum() + 0.05)
        J = np.hstack([np.eye(3), np.cross(np.eye(3), point).T])
        gradient += J.T @ np.einsum("k,kij,kj->i", w, B[near], d)
        curvature += J.T @ np.einsum("k,kij->ij", w, B[near]) @ J
        log_likelihood += np.log(e.sum() / 0.05 + 1)
    assert len(points) > 3 * CHUNK and len(mean) > N_SLOTS
    np.testing.assert_allclose(score, log_likelihood, rtol=1e-6)
    np.testing.assert_allclose(g, gradient, rtol=1e-5, atol=1e-5 * np.abs(gradient).max())
    np.testing.assert_allclose(H, curvature, rtol=1e-5, atol=1e-6 * np.abs(curvature).max())


def test_normal_equations_equal_their_definition() -> None:
    before, after = (fused(points).xyz[::12] for points in two_epochs(0))
    params, normal_params = IcpParams(), NormalParams(radius_m=2.0)
    source, target = Surface.of(before, normal_params), Surface.of(after, normal_params)
    level = icp._Level.of(source, target, 0.75, params, normal_params)
    T = exp_se3(np.array([0.05, -0.03, 0.02, 0.002, 0.001, -0.003]))
    pairs = level.pair(T)
    assert len(source.xyz) > CHUNK
    p = transform_points(T, source.xyz - target.centre)
    q = target.xyz - target.centre
    H, g, n_pairs = np.zeros((6, 6)), np.zeros(6), 0
    for i, point in enumerate(p):
        distance = np.linalg.norm(q - point, axis=1)
        j = int(np.argmin(distance))
        n = target.normals[j].astype(float)
        r = n @ (point - q[j])
        cosine = abs(n @ (T[:3, :3] @ source.normals[i]))
        if distance[j] > 0.75 or abs(r) > level.tau_m or cosine < np.cos(np.radians(30)):
            continue
        weight = (1 - (r / level.tau_m) ** 2) ** 2 / (0.02**2 + float(target.roughness[j]) ** 2)
        row = np.concatenate([n, np.cross(point, n)])
        H, g, n_pairs = H + weight * np.outer(row, row), g + weight * row * r, n_pairs + 1
    assert pairs.n == pytest.approx(n_pairs, abs=2)  # a pair on the edge of a threshold may fall either way in float32
    assert np.allclose(pairs.normal_matrix, H, rtol=2e-3, atol=1e-3 * np.abs(H).max())
    assert np.allclose(pairs.gradient, g, atol=2e-3 * np.abs(g).max())


def test_partners_kept_from_earlier_poses_are_those_of_a_fresh_search() -> None:
    before, after = (Surface.of(fused(points).xyz[::4], NormalParams(radius_m=2.0)) for points in two_epochs(0))
    level, rng = icp._Level.of(before, after, 0.75, IcpParams(), NormalParams()), np.random.default_rng(0)
    T = np.eye(4)
    for size in (0.0, 0.0, 1e-4, 1e-3, 1e-2, 1e-2, 0.1, 1e-5, 1.0, 1e-3):
        T = exp_se3(size * rng.normal(0, 1, 6) * [1, 1, 1, 0.02, 0.02, 0.02]) @ T
        kept, fresh = level.pair(T), icp._Level.of(before, after, 0.75, IcpParams(), NormalParams()).pair(T)
        assert fresh.n > 100
        np.testing.assert_array_equal(kept.residual, fresh.residual)
        np.testing.assert_array_equal(kept.weight, fresh.weight)
        np.testing.assert_array_equal(kept.sums, fresh.sums)


def test_thinning_keeps_the_point_nearest_to_the_mean_of_its_voxel() -> None:
    rng = np.random.default_rng(6)
    xyz = rng.integers(-40, 40, (2000, 3)) / 8.0  # many points equally near
    normals = rng.normal(size=xyz.shape).astype(np.float32)
    surface = Surface(xyz, normals, np.arange(2000, dtype=np.float32), np.zeros(3))
    thinned, kept = surface.thinned(1.0), []
    voxels = np.floor(xyz).astype(int)
    for voxel in np.unique(voxels, axis=0):
        own = np.flatnonzero(np.all(voxels == voxel, axis=1))
        kept.append(own[np.argmin(np.square(xyz[own] - xyz[own].mean(axis=0)).sum(axis=1))])
    np.testing.assert_array_equal(thinned.roughness, kept)
    np.testing.assert_array_equal(thinned.normals, normals[kept])


# --- covariance -------------------------------------------------------------------------------------------------------


def test_block_covariance_is_that_of_leaving_out_one_block_at_a_time() -> None:
    before, after = (Surface.of(fused(points).xyz[::4], NormalParams(radius_m=2.0)) for points in two_epochs(0))
    level = icp._Level.of(before, after, 0.75, IcpParams(), NormalParams())
    pairs = level.pair(np.eye(4))
    p = before.xyz - after.centre
    n = after.normals.astype(float)[pairs.match]
    J, is_pair = np.hstack([n, np.cross(p, n)]), pairs.weight > 0
    block = np.floor(p[:, :2] / 10.0)
    steps = []
    for own in np.unique(block[is_pair], axis=0):
        w = pairs.weight * np.any(block != own, axis=1)
        steps.append(-np.linalg.solve(J.T @ (w[:, None] * J), J.T @ (w * pairs.residual)))
    deviation = np.array(steps) - np.mean(steps, axis=0)
    expected = (len(steps) - 1) / len(steps) * deviation.T @ deviation
    assert len(steps) >= icp.MIN_BLOCKS
    found = icp._block_covariance(level, pairs, np.eye(4), 10.0)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-6 * expected.max())


def independent_noise(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return points


def patchy_noise(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Each 5 m patch of ground is off by about 2 cm: as where the trajectory of a scanner is."""
    patch = np.floor((points[:, :2] + 100) / 5).astype(int)
    return points + rng.normal(0, 0.02, (41, 41, 3))[patch[:, 0], patch[:, 1]]


def errors_over_sigma(kind: str, noise: Callable[[np.ndarray, np.random.Generator], np.ndarray], n: int) -> float:
    """Root mean square of the errors of ``n`` poses, all six components, each over its standard deviation."""
    items, ratios = houses_and_cars(5), []
    for trial in range(n):
        rng = np.random.default_rng(trial)
        before, after = (
            Surface.of(fused(noise(scan(items, 100 + 2 * trial + e, density=12.0), rng) + HERE).xyz, NormalParams())
            for e in (0, 1)
        )
        pose = fine_pose(before, after, np.eye(4), IcpParams(covariance=kind), NormalParams())
        assert np.array_equal(pose.covariance, pose.covariance.T)
        assert np.linalg.eigvalsh(pose.covariance)[0] > 0
        R, t = pose.T_target_source[:3, :3], pose.T_target_source[:3, 3]
        turn = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        twist = np.concatenate([R @ pose.centre + t - pose.centre, turn])
        ratios.append(twist / np.sqrt(np.diag(pose.covariance)))
    return float(np.sqrt(np.mean(np.square(ratios))))


def test_block_covariance_covers_the_errors() -> None:
    assert 0.4 < errors_over_sigma("block", independent_noise, 5) < 1.6
    assert 0.4 < errors_over_sigma("block", patchy_noise, 5) < 1.6


def test_the_closed_form_takes_a_patch_for_hundreds_of_independent_points() -> None:
    assert errors_over_sigma("normal", independent_noise, 3) < 2
    assert errors_over_sigma("normal", patchy_noise, 3) > 5
