"""Statistical outlier removal against its definition."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loda_pdal.model.cloud import VoxelCloud
from loda_pdal.params import OutlierParams, Parameters
from loda_pdal.stages.outliers import find_outliers, remove_outliers


def surface(seed: int = 0, n: int = 600) -> np.ndarray:
    """A patch of ground with a few points high above it at the end."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(0, 6, (n, 2)), rng.normal(0, 0.02, n)])
    birds = np.array([[1.0, 1, 5], [4, 4, 9], [2, 5, 40]])
    return np.vstack([ground, birds])


def test_equals_the_definition() -> None:
    xyz = surface()
    params = OutlierParams(k=8, std_multiplier=1.5)
    distances = np.sqrt(((xyz[:, None] - xyz[None]) ** 2).sum(axis=-1))
    mean_distance = np.sort(distances, axis=1)[:, 1:9].mean(axis=1)
    limit = mean_distance.mean() + 1.5 * mean_distance.std(ddof=1)
    is_outlier = find_outliers(xyz, params)
    is_clear = np.abs(mean_distance - limit) > 1e-5
    assert np.array_equal(is_outlier[is_clear], (mean_distance > limit)[is_clear])
    assert is_outlier[-3:].all()
    assert is_outlier[:-3].mean() < 0.02


def test_raw_points_of_removed_voxels_are_noise() -> None:
    xyz = surface()
    cloud = VoxelCloud(xyz, np.ones(len(xyz), np.int32), np.arange(len(xyz), dtype=np.int32)[::-1].copy())
    kept = remove_outliers(cloud, OutlierParams(k=8, std_multiplier=1.0))
    assert kept.voxel_idx[:3].tolist() == [-1, -1, -1]
    is_kept = kept.voxel_idx >= 0
    assert np.array_equal(kept.xyz[kept.voxel_idx[is_kept]], cloud.xyz[cloud.voxel_idx[is_kept]])
    assert len(kept) == is_kept.sum() == len(kept.n_raw)


def test_order_of_the_points_does_not_matter() -> None:
    xyz = surface(3)
    shuffle = np.random.default_rng(0).permutation(len(xyz))
    params = OutlierParams(k=12)
    assert np.array_equal(find_outliers(xyz, params)[shuffle], find_outliers(xyz[shuffle], params))


def test_nothing_is_removed_where_nothing_stands_out() -> None:
    cloud = VoxelCloud(surface(), np.ones(603, np.int32), np.arange(603, dtype=np.int32))
    assert remove_outliers(cloud, OutlierParams(is_enabled=False)) is cloud
    square = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    for n in range(5):
        assert find_outliers(square[:n], OutlierParams(k=20)).tolist() == [False] * n
    assert not find_outliers(np.zeros((7, 3)), OutlierParams()).any()


def test_a_crown_over_dense_ground_is_no_noise_from_the_air() -> None:
    rng = np.random.default_rng(3)
    axis = np.arange(0.0, 40.0, 0.5)
    ground = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    ground = np.column_stack([ground, np.zeros(len(ground))])
    direction = rng.normal(size=(25, 3))
    crown = [20.0, 20.0, 8.0] + 3.0 * direction / np.linalg.norm(direction, axis=1)[:, None]
    birds = np.array([[5.0, 5.0, 30.0], [30.0, 10.0, 45.0], [30.5, 10.0, 45.0]])
    xyz = np.concatenate([ground, crown, birds])
    params = Parameters.preset("aerial").outliers
    assert find_outliers(xyz, replace(params, keep_voxels=0))[len(ground) : -3].sum() > 20
    is_outlier = find_outliers(xyz, params)
    assert not is_outlier[: len(ground)].any()
    assert is_outlier[len(ground) : -3].sum() <= 5
    assert is_outlier[-3:].all()
