"""The limit of detection: figures one can check by hand, and that 95 % means 95 %."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from loda_pdal.model.cloud import FloatArray, to_local_grid
from loda_pdal.model.lod_grid import LodGrid, pose_jacobian
from loda_pdal.model.transform import exp_se3, transform_points
from loda_pdal.params import FuseParams, LodParams
from loda_pdal.stages.drift import drift_covariance, rigid_part
from loda_pdal.stages.fuse import fuse_points
from loda_pdal.stages.lod import level_of_detection

PARAMS = LodParams()
NO_POSE = np.zeros((6, 6))
ORIGIN = np.zeros(3)
NO_DRIFT = replace(PARAMS, drift_term="none")
LETTER = replace(NO_DRIFT, small_sample=False, pose_term="translation")


def _level(half_step_m: float, height_m: float) -> FloatArray:
    """A level 6 m square, 0.25 m apart, whose points lie ``half_step_m`` above and below in a chequered pattern."""
    i, j = np.mgrid[0:24, 0:24].reshape(2, -1)
    z = height_m + np.where((i + j) % 2 == 0, half_step_m, -half_step_m)
    return np.column_stack([i * 0.25 + 0.125, j * 0.25 + 0.125, z])


def _cell(grid: LodGrid, cell: tuple[int, int, int]) -> int:
    return int(np.flatnonzero(np.all(grid.cells == cell, axis=1))[0])


def test_level_plane_by_hand() -> None:
    before, after = _level(0.02, 0.5), _level(0.01, 0.55)
    covariance = np.diag([0.1**2, 0.1**2, 0.004**2, 0.0, 0.0, 0.0])
    grid = level_of_detection(before, after, covariance, ORIGIN, LETTER)
    at = _cell(grid, (3, 3, 0))
    n = 52  # points of a 0.25 m raster within 1 m of the middle of four of them
    assert grid.n_before[at] == n
    assert grid.n_after[at] == n
    np.testing.assert_allclose(np.abs(grid.normal[at]), [0.0, 0.0, 1.0], atol=1e-3)
    assert grid.displacement[at] == pytest.approx(0.05, abs=1e-4)
    sigma_before, sigma_after = 1.4826 * 0.02, 1.4826 * 0.01  # half of the points lie above, half below the median
    expected = 1.96 * np.sqrt(sigma_before**2 / n + sigma_after**2 / n + 0.004**2)
    assert grid.lod95[at] == pytest.approx(expected, rel=1e-3)
    assert grid.at(np.array([[3.5, 3.5, 0.5]]))[0] == pytest.approx(expected, rel=1e-3)
    widened = level_of_detection(before, after, NO_POSE, ORIGIN, NO_DRIFT)
    plain = level_of_detection(before, after, NO_POSE, ORIGIN, LETTER)
    assert widened.lod95[at] == pytest.approx(plain.lod95[at] * (1 + 4 / n), rel=1e-4)


def _pose_variance(
    point: FloatArray, normal: FloatArray, covariance: FloatArray, centre: FloatArray, term: str
) -> float:
    nothing = np.zeros((0, 3))
    grid = level_of_detection(nothing, nothing, covariance, centre, replace(NO_DRIFT, pose_term=term))
    return float(grid.limit_of(np.zeros(1), point, normal.reshape(1, 3))[0] / 1.96) ** 2


def test_pose_term_grows_with_the_lever() -> None:
    covariance = np.diag([0.01**2, 0.02**2, 0.03**2, 1e-6, 4e-6, 9e-6])
    point, up = np.array([[60.0, 0.0, 2.0]]), np.array([[0.0, 0.0, 1.0]])
    # 60 m east of the centre a turn of 2 mrad about y lifts the point by 12 cm.
    assert _pose_variance(point, up, covariance, ORIGIN, "full") == pytest.approx(0.03**2 + (60 * 0.002) ** 2)
    assert _pose_variance(point, up, covariance, ORIGIN, "translation") == pytest.approx(0.03**2)
    assert _pose_variance(point, up, covariance, ORIGIN, "none") == 0.0
    # The term is the variance of the displacement that small twists make.
    rng = np.random.default_rng(1)
    normal = np.array([0.6, 0.0, 0.8])
    centre = np.array([5.0, -3.0, 1.0])
    twists = rng.multivariate_normal(np.zeros(6), covariance, 5000)
    moved = [(transform_points(exp_se3(t), point - centre) + centre - point)[0] @ normal for t in twists]
    expected = _pose_variance(point, normal[None], covariance, centre, "full")
    assert np.var(moved) == pytest.approx(expected, rel=0.06)


def test_cells_of_low_observability() -> None:
    plane = _level(0.01, 0.5)
    sparse = plane[np.random.default_rng(2).random(len(plane)) < 0.2]
    grid = level_of_detection(plane, sparse, NO_POSE, ORIGIN, PARAMS)
    assert not grid.is_valid.any()
    np.testing.assert_array_equal(grid.lod95, np.float32(0.5))
    assert np.isnan(grid.displacement).all()
    np.testing.assert_array_equal(grid.normal, 0.0)
    # A crown has no plane, whatever its density; a cable has no normal.
    crown = np.random.default_rng(3).uniform(0, 4, (8000, 3))
    inner = np.all(np.abs(level_of_detection(crown, crown, NO_POSE, ORIGIN, PARAMS).cells - 1.5) < 1, axis=1)
    assert not level_of_detection(crown, crown, NO_POSE, ORIGIN, PARAMS).is_valid[inner].any()
    cable = np.column_stack([np.linspace(0, 8, 400), np.full(400, 0.5), np.full(400, 0.5)])
    assert not level_of_detection(cable, cable, NO_POSE, ORIGIN, PARAMS).is_valid.any()


def test_global_limit_is_the_median() -> None:
    rng = np.random.default_rng(4)
    before = _level(0.0, 0.5) + rng.normal(0, 0.01, (576, 3))
    after = _level(0.0, 0.5) + rng.normal(0, 0.02, (576, 3))
    spatial = level_of_detection(before, after, NO_POSE, ORIGIN, PARAMS)
    whole = level_of_detection(before, after, NO_POSE, ORIGIN, replace(PARAMS, variation="global"))
    assert len(np.unique(spatial.lod95[spatial.is_valid])) > 5
    assert set(whole.lod95[whole.is_valid]) == {np.median(spatial.lod95[spatial.is_valid])}
    np.testing.assert_array_equal(whole.lod95[~whole.is_valid], np.float32(0.5))


def test_facade_has_the_normal_of_a_facade_and_its_displacement() -> None:
    rng = np.random.default_rng(5)

    def facade(y: float) -> FloatArray:
        return np.column_stack([rng.uniform(0, 8, 3000), rng.normal(y, 0.01, 3000), rng.uniform(0, 6, 3000)])

    grid = level_of_detection(facade(3.0), facade(3.2), NO_POSE, ORIGIN, NO_DRIFT)
    at = _cell(grid, (4, 3, 3))
    np.testing.assert_allclose(grid.normal[at], [0.0, 1.0, 0.0], atol=0.02)
    assert grid.displacement[at] == pytest.approx(0.2, abs=0.005)
    assert grid.lod95[at] < 0.01


def test_swap_changes_only_the_sign_and_order_changes_nothing() -> None:
    rng = np.random.default_rng(6)
    before, after = _scene(rng, 0.02), _scene(rng, 0.02)
    covariance = np.diag([1e-4] * 3 + [1e-7] * 3)
    there = level_of_detection(before, after, covariance, np.ones(3), PARAMS)
    back = level_of_detection(after, before, covariance, np.ones(3), PARAMS)
    shuffled = level_of_detection(rng.permutation(before), rng.permutation(after), covariance, np.ones(3), PARAMS)
    np.testing.assert_array_equal(there.cells, back.cells)
    np.testing.assert_array_equal(there.lod95, back.lod95)
    np.testing.assert_array_equal(there.displacement, -back.displacement)
    np.testing.assert_array_equal(there.n_before, back.n_after)
    np.testing.assert_allclose(there.lod95, shuffled.lod95, atol=1e-6)
    np.testing.assert_allclose(there.displacement, shuffled.displacement, atol=1e-6)


def test_kernel_agrees_with_a_slow_twin() -> None:
    rng = np.random.default_rng(7)
    before, after = _scene(rng, 0.02)[::3], _scene(rng, 0.02)[::3]
    grid = level_of_detection(before, after, NO_POSE, ORIGIN, NO_DRIFT)
    for c in np.flatnonzero(grid.is_valid)[::40]:
        near = [xyz[np.linalg.norm(xyz - grid.centres[c], axis=1) <= 1.0] for xyz in (before, after)]
        covariance = sum(np.cov(p.T, bias=True) for p in near) / 2
        normal = np.linalg.eigh(covariance)[1][:, 0]
        normal *= np.sign(normal @ grid.normal[c])
        variance, offset = 0.0, []
        for points in near:
            along = points @ normal
            sigma = 1.4826 * np.median(np.abs(along - np.median(along)))
            offset.append(along[np.abs(along - np.median(along)) <= 3 * sigma].mean())
            variance += (sigma * (1 + 4 / len(points))) ** 2 / len(points)
        assert (grid.n_before[c], grid.n_after[c]) == (len(near[0]), len(near[1]))
        assert grid.lod95[c] == pytest.approx(1.96 * np.sqrt(variance), rel=1e-3)
        assert grid.displacement[c] == pytest.approx(offset[1] - offset[0], abs=1e-5)


def test_limit_between_cells_is_trilinear_over_the_valid_ones() -> None:
    rng = np.random.default_rng(3)
    cells = np.argwhere(rng.random((6, 5, 4)) < 0.6).astype(np.int32) - 2
    n = len(cells)
    limit, is_valid = rng.uniform(0.01, 0.2, n).astype(np.float32), rng.random(n) < 0.7
    nothing = np.zeros(n, np.int32)
    grid = LodGrid(cells, 0.5, limit, np.zeros((n, 3), np.float32), nothing, nothing, is_valid, limit, 0.7)
    place = {tuple(cell): c for c, cell in enumerate(cells)}
    xyz = rng.uniform(-2.0, 2.5, (400, 3))
    xyz[::7] = 0.25 * np.round(xyz[::7] / 0.25)  # on the centres, edges and corners of cells
    expected = np.full(len(xyz), 0.7)
    for p, at in enumerate(xyz / 0.5 - 0.5):
        total = weight = 0.0
        for cell in np.floor(at).astype(int) + np.argwhere(np.ones((2, 2, 2))):
            c = place.get(tuple(cell), -1)
            if c >= 0 and is_valid[c]:
                w = np.prod(1 - np.abs(at - cell))
                total, weight = total + w * limit[c], weight + w
        if weight > 1e-6:
            expected[p] = total / weight
    assert 0.1 < np.mean(expected == 0.7) < 0.9
    np.testing.assert_allclose(grid.at(xyz), expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(grid.at(xyz[::-1]), grid.at(xyz)[::-1])


def test_empty_epochs() -> None:
    nothing = np.zeros((0, 3))
    assert len(level_of_detection(nothing, nothing, NO_POSE, ORIGIN, PARAMS).cells) == 0
    grid = level_of_detection(nothing, _level(0.01, 0.5), NO_POSE, ORIGIN, PARAMS)
    assert len(grid.cells) > 0
    assert not grid.is_valid.any()


def _scene(rng: np.random.Generator, noise_m: float, height_m: float = 0.37) -> FloatArray:
    """Uneven ground and two facades, measured with noise along the surface normal and fused at 0.25 m."""
    xy = rng.uniform(0, 20, (24000, 2))
    z = height_m + 0.02 * xy[:, 0] + 0.01 * xy[:, 1] + 0.03 * np.sin(xy[:, 0] / 7) * np.cos(xy[:, 1] / 9)
    surfaces = [np.column_stack([xy, z + rng.normal(0, noise_m, len(xy))])]
    for angle, start in ((0.3, (3.0, 3.0)), (0.0, (2.0, 17.07))):
        along, up = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([0.0, 0.0, 1.0])
        normal = np.cross(along, up)
        u, v, w = rng.uniform(0, 15, 6000), rng.uniform(1.0, 7.0, 6000), rng.normal(0, noise_m, 6000)
        surfaces.append(np.array([*start, 0.0]) + np.outer(u, along) + np.outer(v, up) + np.outer(w, normal))
    return fuse_points(to_local_grid(np.vstack(surfaces)), FuseParams()).xyz


def _wandered(rng: np.random.Generator, xyz: FloatArray, sigma_m: FloatArray) -> FloatArray:
    """The points after a drift whose waves are 15 to 40 m long, ``sigma_m`` (3,) along x, y and z."""
    length, direction = rng.uniform(15, 40, (3, 8)), rng.uniform(0, 2 * np.pi, (3, 8))
    phase = rng.uniform(0, 2 * np.pi, (3, 8))
    along = np.einsum("m,kw->mkw", xyz[:, 0], np.cos(direction)) + np.einsum("m,kw->mkw", xyz[:, 1], np.sin(direction))
    waves = np.sin(2 * np.pi * along / length + phase)
    return xyz + sigma_m * waves.sum(axis=2) * np.sqrt(2 / 8)


def _coverage(
    n_seeds: int,
    params: LodParams,
    shift_sigma_m: float = 0.0,
    turn_sigma: float = 0.0,
    drift_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    changed_share: float = 0.0,
) -> tuple[float, float]:
    """Share of valid cells of an unchanged scene within LoD95, on ground and on facades, over many seeds.

    The after scene is misregistered by a twist drawn from the covariance that the limit is told; the drift it is not
    told. Where a share of the ground is changed, cells near the change are not judged.
    """
    covariance = np.diag([shift_sigma_m**2] * 3 + [turn_sigma**2] * 3)
    centre = np.array([10.0, 10.0, 2.0])
    within, is_ground = [], []
    for seed in range(n_seeds):
        rng = np.random.default_rng(seed)
        height = rng.uniform(0, 1)
        before, after = _scene(rng, 0.02, height), _scene(rng, 0.02, height)
        after[after[:, 0] < 20 * changed_share, 2] += 0.4
        before = _wandered(rng, before, np.array(drift_m))
        twist = rng.multivariate_normal(np.zeros(6), covariance)
        after = transform_points(exp_se3(twist), after - centre) + centre
        grid = level_of_detection(before, after, covariance, centre, params)
        is_judged = grid.is_valid & ((changed_share == 0) | (grid.centres[:, 0] > 20 * changed_share + 1.1))
        within.append(np.abs(grid.displacement[is_judged]) <= grid.lod95[is_judged])
        is_ground.append(np.abs(grid.normal[is_judged, 2]) > 0.98)
    hit, ground = np.concatenate(within), np.concatenate(is_ground)
    return float(hit[ground].mean()), float(hit[~ground].mean())


@pytest.mark.parametrize("params", [NO_DRIFT, PARAMS])
def test_95_per_cent_of_unchanged_cells_are_within_the_limit_when_noise_prevails(params: LodParams) -> None:
    ground, facades = _coverage(10, params)
    assert 0.93 <= ground <= 0.97
    assert 0.93 <= facades <= 0.97


@pytest.mark.parametrize("params", [NO_DRIFT, PARAMS])
def test_95_per_cent_of_unchanged_cells_are_within_the_limit_under_misregistration(params: LodParams) -> None:
    # All cells of one scene share one misregistration: the share varies between seeds, and its mean is judged.
    ground, facades = _coverage(60, params, shift_sigma_m=0.01, turn_sigma=5e-4)
    assert 0.93 <= ground <= 0.97
    assert 0.93 <= facades <= 0.97


def test_what_a_rigid_move_makes_is_pose_and_no_drift() -> None:
    rng = np.random.default_rng(9)
    xyz, normal = rng.uniform(-50, 50, (3000, 3)), rng.normal(size=(3000, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    covariance = np.diag([0.01**2] * 3 + [2e-4**2] * 3)
    jacobian = pose_jacobian(xyz, normal, ORIGIN)
    twist = np.array([0.012, -0.008, 0.01, 1e-4, -2e-4, 2e-4])
    displacement = jacobian @ twist + rng.normal(0, 0.004, 3000)
    displacement[:300] += 0.5  # changes
    found = rigid_part(displacement, np.full(3000, 0.004**2), jacobian, covariance)
    np.testing.assert_allclose(found, jacobian @ twist, atol=0.0015)
    # A covariance that knows of no such move leaves it to the drift.
    assert np.abs(rigid_part(displacement, np.full(3000, 0.004**2), jacobian, covariance / 1e4)).max() < 0.002


@pytest.mark.parametrize("changed_share", [0.0, 0.15])
def test_95_per_cent_of_unchanged_cells_are_within_the_limit_under_drift(changed_share: float) -> None:
    told = {"shift_sigma_m": 0.005, "turn_sigma": 1e-4}
    drift_m = (0.02, 0.01, 0.015)
    ground, facades = _coverage(40, PARAMS, **told, drift_m=drift_m, changed_share=changed_share)
    assert 0.93 <= ground <= 0.97
    assert 0.93 <= facades <= 0.97
    unaware, _ = _coverage(10, NO_DRIFT, **told, drift_m=drift_m, changed_share=changed_share)
    assert unaware < 0.80  # what the drift term is for


def test_drift_is_recovered_along_the_facades_and_in_height() -> None:
    rng = np.random.default_rng(8)
    turn = 0.4
    axes = np.array([[np.cos(turn), np.sin(turn), 0.0], [-np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    normal = axes[rng.integers(0, 3, 6000)] * rng.choice([-1.0, 1.0], (6000, 1)) + rng.normal(0, 0.02, (6000, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    drift = axes.T @ np.diag([0.03**2, 0.01**2, 0.015**2]) @ axes
    variance = rng.uniform(0.003, 0.02, 6000) ** 2
    displacement = rng.normal(0, np.sqrt(variance + np.einsum("ki,ij,kj->k", normal, drift, normal)))
    found = drift_covariance(displacement, variance, normal, 0.1)
    np.testing.assert_allclose(np.sqrt(np.diag(axes @ found @ axes.T)), [0.03, 0.01, 0.015], rtol=0.1)
    np.testing.assert_array_equal(found, drift_covariance(-displacement, variance, -normal, 0.1))
    # One cell in ten changed: the drift found grows by little. All of them changed: it is not believed.
    some = displacement + np.where(rng.random(6000) < 0.1, 1.0, 0.0)
    grown = np.sqrt(np.diag(axes @ drift_covariance(some, variance, normal, 0.1) @ axes.T))
    assert (grown < np.array([0.03, 0.01, 0.015]) * 1.45).all()
    np.testing.assert_allclose(np.linalg.eigvalsh(drift_covariance(displacement + 1, variance, normal, 0.1)), 0.1**2)
    # Noise alone needs no drift.
    alone = drift_covariance(rng.normal(0, np.sqrt(variance)), variance, normal, 0.1)
    assert np.sqrt(np.linalg.eigvalsh(alone)).max() < 0.003
    assert not drift_covariance(np.zeros(0), np.zeros(0), np.zeros((0, 3)), 0.1).any()
