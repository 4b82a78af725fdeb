"""The ground model: known terrain is recovered, what stands on it is not, and real labels agree."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest

from loda_pdal.kernels.ground_planes import fit_planes
from loda_pdal.kernels.ground_raster import group_by_cell, relax, sort_range
from loda_pdal.model.cloud import to_local_grid
from loda_pdal.params import Parameters
from loda_pdal.stages.fuse import fuse_points
from loda_pdal.stages.ground import GroundModel, ground_model, vertical_rotation

PARAMS = Parameters().ground
SLOPE = np.array([0.03, -0.02])


def _terrain(xy: np.ndarray) -> np.ndarray:
    return 5.0 + xy @ SLOPE


def _ground_points(rng: np.random.Generator, low: float, high: float, step: float = 0.25) -> np.ndarray:
    """Terrain sampled about every ``step`` metres with 1 cm noise."""
    axis = np.arange(low, high, step)
    xy = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2) + rng.uniform(0, step, (len(axis) ** 2, 2))
    return np.column_stack([xy, _terrain(xy) + rng.normal(0, 0.01, len(xy))])


def _on_box(rng: np.random.Generator, low: tuple[float, ...], high: tuple[float, ...], n: int) -> np.ndarray:
    """Points on the roof and walls of an upright box whose heights are above the terrain."""
    points = rng.uniform(low, high, (n, 3))
    side = rng.integers(0, 3, n)
    is_high = rng.random(n) < 0.5
    for axis in range(2):
        points[side == axis, axis] = np.where(is_high, high[axis], low[axis])[side == axis]
    points[side == 2, 2] = high[2]
    points[:, 2] += _terrain(points[:, :2])
    return points


def _outside(points: np.ndarray, low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
    return points[np.any((points[:, :2] < low[:2]) | (points[:, :2] > high[:2]), axis=1)]


def _street(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Terrain with a house, two cars, and a crown that hides the ground below it; and which points are terrain."""
    ground = _ground_points(rng, 0.0, 60.0)
    house, crown = ((10.0, 10.0, 0.0), (25.0, 22.0, 6.0)), ((40.0, 40.0, 3.0), (46.0, 46.0, 8.0))
    cars = [((30.0, 10.0, 0.2), (34.5, 11.8, 1.5)), ((30.0, 20.0, 0.2), (34.5, 21.8, 1.5))]
    for box in (house, crown, *cars):
        ground = _outside(ground, *box)
    objects = [_on_box(rng, *house, 8000), *(_on_box(rng, *car, 600) for car in cars)]
    leaves = rng.uniform(*crown, (4000, 3))
    leaves[:, 2] += _terrain(leaves[:, :2])
    points = to_local_grid(np.vstack([ground, *objects, leaves]))
    return points, np.arange(len(points)) < len(ground)


def _model(points: np.ndarray, n_raw: int = 5) -> GroundModel:
    return ground_model(points, np.full(len(points), n_raw, np.int32), PARAMS)


def test_known_terrain_is_recovered_under_and_beside_what_stands_on_it() -> None:
    points, is_ground = _street(np.random.default_rng(3))
    model = _model(points)
    height = points[:, 2] - model.height_at(points[:, :2])
    assert model.has_ground
    assert np.percentile(np.abs(height[is_ground]), 99) < 0.04
    # Nothing was seen under the house and the crown: there the terrain is bridged.
    hidden = np.array([[17.0, 16.0], [12.0, 12.0], [43.0, 43.0], [32.0, 11.0]])
    np.testing.assert_allclose(model.height_at(hidden), _terrain(hidden), atol=0.15)
    cell = np.floor(hidden / model.cell_m).astype(int) - model.first
    assert not model.is_plane[cell[:2, 0], cell[:2, 1]].any()
    assert np.mean(np.abs(height[~is_ground]) < 0.1) < 0.05
    np.testing.assert_allclose(model.up, np.array([*-SLOPE, 1.0]) / np.sqrt(1 + SLOPE @ SLOPE), atol=2e-3)


def test_kerb_is_kept() -> None:
    rng = np.random.default_rng(4)
    points = _ground_points(rng, 0.0, 40.0)
    step = np.where(points[:, 0] > 20.7, 0.12, 0.0)
    points[:, 2] += step
    height = points[:, 2] - _model(to_local_grid(points)).height_at(points[:, :2])
    is_near = np.abs(points[:, 0] - 20.7) < 2.0
    assert np.percentile(np.abs(height), 99.9) < 0.11
    assert np.median(np.abs(height[is_near])) < 0.03
    assert np.percentile(np.abs(height[~is_near]), 99) < 0.04


def test_false_echoes_below_ground_do_not_pull_it_down() -> None:
    rng = np.random.default_rng(5)
    points, is_ground = _street(rng)
    echoes = points[is_ground][rng.random(is_ground.sum()) < 0.005].copy()
    echoes[:, 2] -= rng.uniform(0.5, 4.0, len(echoes))
    model = _model(to_local_grid(np.vstack([points, echoes])))
    height = points[is_ground, 2] - model.height_at(points[is_ground, :2])
    assert np.percentile(np.abs(height), 99) < 0.05


def test_order_of_points_does_not_matter_and_a_shift_only_shifts() -> None:
    rng = np.random.default_rng(6)
    points, _ = _street(rng)
    model = _model(points)
    shuffled = _model(points[rng.permutation(len(points))])
    np.testing.assert_array_equal(model.height, shuffled.height)
    np.testing.assert_array_equal(model.slope, shuffled.slope)
    shift = np.array([1000.0, -3000.0, 40.0])
    moved = _model(points + shift)
    np.testing.assert_array_equal(moved.is_plane, model.is_plane)
    np.testing.assert_allclose(
        moved.height_at(points[:, :2] + shift[:2]), model.height_at(points[:, :2]) + 40.0, atol=1e-9
    )


def test_height_is_continuous_and_ends_where_no_ground_is_near() -> None:
    rng = np.random.default_rng(7)
    points, _ = _street(rng)
    lone = np.array([[200.0, 30.0, 9.0]])
    model = _model(to_local_grid(np.vstack([points, lone])))
    walk = np.column_stack([np.linspace(2.0, 58.0, 20001), np.linspace(3.0, 50.0, 20001)])
    height = model.height_at(walk)
    assert np.isfinite(height).all()
    assert np.abs(np.diff(height)).max() < 0.002  # 3.7 mm steps on a slope of a few per cent
    assert np.isnan(model.height_at(np.array([[150.0, 30.0], [-40.0, 0.0], [1e6, 1e6]]))).all()


def test_height_is_the_bilinear_mean_of_the_planes_around() -> None:
    rng = np.random.default_rng(11)
    height = np.where(rng.random((6, 5)) < 0.3, np.nan, rng.normal(size=(6, 5)))
    model = GroundModel(
        2.0, np.array([-3, 4]), height, rng.normal(size=(6, 5, 2)), height == height, True, np.eye(3)[2]
    )
    xy = rng.uniform([-9.0, 5.0], [9.0, 21.0], (500, 2))
    expected = np.full(len(xy), np.nan)
    for p, at in enumerate(xy):
        total = weight = 0.0
        for (i, j), level in np.ndenumerate(height):
            centre = 2.0 * (model.first + (i, j) + 0.5)
            w = np.prod(np.maximum(1.0 - np.abs(at - centre) / 2.0, 0.0))
            if w > 0 and np.isfinite(level):
                total += w * (level + model.slope[i, j] @ (at - centre))
                weight += w
        if weight > 0:
            expected[p] = total / weight
    assert 0.1 < np.isnan(expected).mean() < 0.9
    np.testing.assert_allclose(model.height_at(xy), expected, rtol=0, atol=1e-12)


def test_points_are_sorted_by_cell_and_then_by_place() -> None:
    rng = np.random.default_rng(2)
    xyz = rng.integers(0, 4, (3000, 3)).astype(float)  # many equal coordinates
    cell_idx = rng.integers(0, 7, len(xyz)) ** 2
    start, order = np.searchsorted(np.sort(cell_idx), np.arange(51)), np.empty(len(xyz), np.int64)
    group_by_cell(cell_idx, start[:-1].copy(), order)
    np.testing.assert_array_equal(order, np.argsort(cell_idx, kind="stable"))
    sort_range(0, 50, start, xyz, order)
    np.testing.assert_array_equal(order, np.lexsort((xyz[:, 2], xyz[:, 1], xyz[:, 0], cell_idx)))


@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (5, 1), (2, 2), (7, 9)])
def test_gaps_relax_towards_their_neighbours(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(4)
    height, is_known = rng.normal(size=shape), rng.random(shape) < 0.4
    expected = height
    for _ in range(5):
        padded = np.pad(expected, 1, mode="edge")
        mean = (padded[2:, 1:-1] + padded[:-2, 1:-1] + padded[1:-1, 2:] + padded[1:-1, :-2]) / 4
        expected = np.where(is_known, height, mean)
    np.testing.assert_allclose(relax(height.copy(), is_known, 5), expected, rtol=0, atol=1e-14)


def test_objects_cut_out_of_their_scene_have_no_ground() -> None:
    rng = np.random.default_rng(8)
    feet = [(4.0 * i, 5.0 * j) for i in range(6) for j in range(6)]
    points = np.vstack([_on_box(rng, (x, y, 0.1), (x + 1.5, y + 1.5, 2.0), 400) for x, y in feet])
    model = _model(to_local_grid(points))
    height = points[:, 2] - model.height_at(points[:, :2])
    above_terrain = points[:, 2] - _terrain(points[:, :2])
    assert not model.has_ground
    assert not model.is_plane.any()
    assert np.abs(height - above_terrain).max() < 0.4
    np.testing.assert_array_equal(model.up, [0.0, 0.0, 1.0])


def test_sparse_cells_need_fewer_raw_points() -> None:
    points = to_local_grid(_ground_points(np.random.default_rng(9), 0.0, 20.0, step=0.5))
    assert _model(points, n_raw=1).is_plane.mean() > 0.95  # 16 raw points a cell, far below 200


def test_sparse_surveys_keep_what_the_terrain_does_within_a_plane() -> None:
    rng = np.random.default_rng(12)
    xy = rng.uniform(0.0, 240.0, (9000, 2))  # a return each 2.5 m

    def hills(at: np.ndarray) -> np.ndarray:
        return np.asarray(1.5 * np.sin(at[:, 0] / 5.0) + 1.0 * np.cos(at[:, 1] / 6.0))

    plants = rng.random(len(xy)) < 0.1
    points = np.column_stack([xy, hills(xy) + rng.normal(0, 0.02, len(xy)) + plants * rng.uniform(0.2, 3.0, len(xy))])
    params = Parameters.preset("aerial").for_spacing(2.0)
    truth_at = rng.uniform(20.0, 220.0, (5000, 2))

    def off(detail_m: float) -> np.ndarray:
        ground = replace(params.ground, detail_m=detail_m)
        found = ground_model(points, np.ones(len(points), np.int32), ground)
        assert found.has_ground
        return found.height_at(truth_at) - hills(truth_at)

    coarse, fine = off(50.0), off(2.0)
    assert params.ground.cell_m == 8.0
    assert np.median(np.abs(coarse)) > 0.13  # what a plane of 8 m cuts off
    assert np.median(np.abs(fine)) < 0.06
    assert abs(np.median(fine)) < 0.02  # plants do not lift it


def test_dense_surveys_have_the_planes_of_the_paper() -> None:
    points = to_local_grid(_ground_points(np.random.default_rng(9), 0.0, 20.0))
    ones = np.full(len(points), 5, np.int32)
    for detail_m in (2.0, 50.0):
        np.testing.assert_array_equal(
            ground_model(points, ones, replace(PARAMS, detail_m=detail_m)).height, _model(points).height
        )


def test_empty_and_tiny_clouds() -> None:
    empty = _model(np.zeros((0, 3)))
    assert not empty.has_ground
    assert np.isnan(empty.height_at(np.zeros((3, 2)))).all()
    one = _model(np.array([[1.0, 2.0, 3.0]]))
    assert not one.has_ground
    np.testing.assert_allclose(one.height_at(np.array([[1.0, 2.0]])), 3.0)


def test_plane_kernel_agrees_with_least_squares_on_the_true_inliers() -> None:
    rng = np.random.default_rng(10)
    n_in, n_out = 60, 25
    xyz = np.column_stack([rng.uniform(-1, 1, (n_in + n_out, 2)), np.zeros(n_in + n_out)])
    xyz[:, 2] = 0.1 - 0.05 * xyz[:, 0] + 0.02 * xyz[:, 1] + rng.normal(0, 0.01, len(xyz))
    xyz[n_in:, 2] += rng.uniform(0.15, 0.4, n_out)
    design = np.column_stack([np.ones(n_in), xyz[:n_in, :2]])
    expected = np.linalg.lstsq(design, xyz[:n_in, 2], rcond=None)[0]
    n_raw = np.full(len(xyz), 3, np.int64)
    plane, n_inliers, n_raw_inliers = fit_planes(xyz, n_raw, np.array([0, len(xyz)]), 5, 2.0, 0.10, 0.5, 60)
    np.testing.assert_allclose(plane[0], expected, atol=0.004)
    assert n_inliers[0] == n_in
    assert n_raw_inliers[0] == 3 * n_in


def test_vertical_rotation_turns_up_onto_z() -> None:
    up = np.array([0.02, -0.05, 1.0]) / np.linalg.norm([0.02, -0.05, 1.0])
    R = vertical_rotation(up)
    np.testing.assert_allclose(R @ up, [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(vertical_rotation(np.array([0.0, 0.0, 1.0])), np.eye(3))


def _labelled(path: Path) -> tuple[np.ndarray, np.ndarray]:
    cloud = laspy.read(path)
    xyz = np.asarray(cloud.xyz)
    return to_local_grid(xyz - [*(xyz[:, :2].min(axis=0) // 1000 * 1000), 0]), np.asarray(cloud.classification)


def _height(xyz: np.ndarray, preset: str, spacing_m: float) -> tuple[np.ndarray, GroundModel]:
    params = Parameters.preset(preset).for_spacing(spacing_m)
    cloud = fuse_points(xyz, params.fuse)
    model = ground_model(cloud.xyz, cloud.n_raw, params.ground)
    return xyz[:, 2] - model.height_at(xyz[:, :2]), model


@pytest.mark.data
@pytest.mark.parametrize(
    ("file", "spacing_m", "f1", "roofs"),
    [
        ("ahn_tiles/3dfier_ahn3_cropped_1.laz", 0.26, 0.97, 0.01),
        ("ahn_tiles/3dfier_ahn3_cropped_2.laz", 0.28, 0.97, 0.01),
        ("ahn_tiles/ams_ahn4_2496_9727.laz", 0.15, 0.96, 0.01),
        ("ahn_tiles/ams_ahn_2397_9705.laz", 0.28, 0.98, 0.01),
        ("ahn_tiles/ams_ahn_2463_9714.laz", 0.19, 0.93, 0.01),
        ("ign_lidarhd/ctview_classee_77050_627755.las", 0.34, 0.97, 0.01),
        ("ign_lidarhd/semis_2021_0382_6565_cropped.laz", 1.84, 0.97, 0.01),
        ("ign_lidarhd/semis_2023_0292_6833.laz", 1.84, 0.94, 0.05),
    ],
)
def test_airborne_labels_agree(data_dir: Path, file: str, spacing_m: float, f1: float, roofs: float) -> None:
    xyz, label = _labelled(data_dir / file)
    height, model = _height(xyz, "aerial", spacing_m)
    is_judged = ~np.isin(label, (9, 17, 26))  # water and bridges: either answer is right
    is_ground, is_found = (label == 2)[is_judged], (np.abs(height) < 0.2)[is_judged]
    assert model.has_ground
    assert 2 * (is_ground & is_found).sum() / (is_ground.sum() + is_found.sum()) > f1
    assert np.count_nonzero(np.abs(height[label == 6]) < 0.2) <= roofs * np.count_nonzero(label == 6)


@pytest.mark.data
def test_street_ground_is_ground_and_cut_out_objects_have_none(data_dir: Path) -> None:
    xyz, _ = _labelled(data_dir / "amsterdam_mls_ground" / "in_2293_9698.laz")
    height, model = _height(xyz, "street", 0.06)
    assert model.has_ground
    assert np.mean(np.abs(height) < 0.1) > 0.99
    xyz, _ = _labelled(data_dir / "amsterdam_mls_2epoch" / "run1_2386_9702.laz")
    height, model = _height(xyz, "street", 0.06)
    assert not model.has_ground
    assert np.isfinite(height).all()
