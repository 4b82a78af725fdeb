"""Eigenvalue features against known shapes, plain loops and NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference.features import shape_features

from loda_pdal.kernels.geometry import eigen_symmetric_3x3
from loda_pdal.kernels.parallel import set_threads
from loda_pdal.params import FeatureParams
from loda_pdal.stages.features import NO_SHAPE, eigen_features

PARAMS = FeatureParams()


def grid(*axes: np.ndarray) -> np.ndarray:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes)).astype(float)


STEPS = np.arange(17) * 0.25


@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([(3.0, 2.0, 1.0), (1.0, 1.0, 0.1), (1.0, 1e-9, 1e-9), (2.0, 1.0, 0.0), (1.0, 1.0, 1.0)]),
    st.booleans(),
)
def test_eigenvalues_and_normal_agree_with_numpy(seed: int, values: tuple[float, ...], is_aligned: bool) -> None:
    rng = np.random.default_rng(seed)
    axes = np.eye(3)[rng.permutation(3)] if is_aligned else np.linalg.qr(rng.normal(size=(3, 3)))[0]
    matrix = axes @ np.diag(values) @ axes.T
    matrix = (matrix + matrix.T) / 2
    *found, nx, ny, nz = eigen_symmetric_3x3(*matrix[np.triu_indices(3)])
    assert found == pytest.approx(np.linalg.eigvalsh(matrix)[::-1], abs=1e-14)
    normal = np.array([nx, ny, nz])
    assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-14)
    assert matrix @ normal == pytest.approx(found[2] * normal, abs=1e-14)
    assert nz >= 0


@pytest.mark.parametrize("is_clustered", [False, True])
def test_features_agree_with_the_definition(is_clustered: bool) -> None:
    rng = np.random.default_rng(4)
    xyz = rng.uniform(0, 4, (600, 3))
    if is_clustered:
        xyz[300:] = rng.normal(size=(300, 3)) * [1.0, 0.2, 0.02] + 2
    values, is_valid = shape_features(xyz, PARAMS.radius_m, PARAMS.min_neighbours)
    found = eigen_features(xyz, np.zeros(600), PARAMS)
    assert found.is_valid.tolist() == is_valid.tolist()
    assert 0 < is_valid.sum() < 600
    assert found.values[:, :4] == pytest.approx(values, abs=2e-5)


def test_known_shapes() -> None:
    line = np.column_stack([STEPS * 2 / 3, STEPS / 3, STEPS * 2 / 3])
    plane = grid(STEPS, STEPS) @ np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    solid = grid(STEPS, STEPS, STEPS)
    on_line, on_plane, in_solid = (eigen_features(x, np.zeros(len(x)), PARAMS) for x in (line, plane, solid))
    assert on_line.values[2:-2, 0] == pytest.approx(1.0, abs=1e-5)  # the ends have too few neighbours
    assert on_plane.values[:, 2] == pytest.approx(0.0, abs=1e-6)
    assert np.abs(on_plane.normals @ [0.0, -0.8, 0.6]) == pytest.approx(1.0, abs=1e-6)
    assert on_plane.values[:, 3] == pytest.approx(0.6, abs=1e-6)
    middle = np.all((solid >= 0.75) & (solid <= 3.25), axis=1)
    assert in_solid.values[middle, 2] == pytest.approx(1.0, abs=1e-5)
    for found in (on_line, on_plane, in_solid):
        assert found.values[:, :3].sum(axis=1) == pytest.approx(1.0, abs=1e-6)


def test_too_few_neighbours_have_no_shape() -> None:
    xyz = np.array(
        [[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1], [50.0, 0, 0], [80.0, 0, 0], *[[80.0, 0, 0]] * 5]
    )
    found = eigen_features(xyz, np.arange(11.0), PARAMS)
    assert not found.is_valid.any()  # four points are too few, and five in one place have no spread
    assert found.values[:, :4] == pytest.approx(np.tile(NO_SHAPE, (11, 1)))
    assert not found.normals.any()
    assert found.values[:, 4].tolist() == list(range(11))
    assert (
        eigen_features(xyz, np.zeros(11), FeatureParams(min_neighbours=4)).is_valid.tolist() == [True] * 4 + [False] * 7
    )


def test_unknown_heights_are_zero() -> None:
    xyz = np.random.default_rng(1).uniform(0, 1, (30, 3))
    heights = np.where(np.arange(30) % 2, np.nan, 2.5)
    assert eigen_features(xyz, heights, PARAMS).values[:, 4].tolist() == [2.5, 0.0] * 15
    assert np.isnan(heights[1])


def test_features_do_not_depend_on_order_place_or_threads() -> None:
    rng = np.random.default_rng(7)
    xyz = np.round(rng.uniform(0, 6, (3000, 3)) * 2**16) / 2**16
    heights = xyz[:, 2].copy()
    expected = eigen_features(xyz, heights, PARAMS)
    shuffle = rng.permutation(3000)
    shuffled = eigen_features(xyz[shuffle], heights[shuffle], PARAMS)
    assert np.array_equal(shuffled.values, expected.values[shuffle])
    moved = eigen_features(xyz + np.array([1e6, -1e6, 0]), heights, PARAMS)
    assert np.array_equal(moved.values, expected.values)
    try:
        set_threads(1)
        single = eigen_features(xyz, heights, PARAMS)
    finally:
        set_threads(None)
    assert np.array_equal(single.values, expected.values)
    assert np.array_equal(single.normals, expected.normals)


def test_no_points_have_no_features() -> None:
    found = eigen_features(np.zeros((0, 3)), np.zeros(0), PARAMS)
    assert found.values.shape == (0, 5)
    assert found.values.dtype == np.float32
    assert found.normals.shape == (0, 3)
    assert found.is_valid.dtype == np.bool_
