"""Local planes: known planes, what is no plane, and a slow twin."""

from __future__ import annotations

import numpy as np
import pytest

from loda_pdal.kernels.planes import mad_sigma
from loda_pdal.params import NormalParams
from loda_pdal.stages.normals import estimate_normals

PARAMS = NormalParams()

HERE = np.array([640.0, -310.0, 25.0])


def plane(normal: np.ndarray, noise_m: float, seed: int = 0, n: int = 4000) -> np.ndarray:
    """A noisy 12 m square across ``normal``, at map-like coordinates."""
    rng = np.random.default_rng(seed)
    u = np.cross(normal, [0.3, 0.5, 0.9])
    u /= np.linalg.norm(u)
    v = np.cross(normal, u)
    xyz = rng.uniform(-6, 6, (n, 1)) * u + rng.uniform(-6, 6, (n, 1)) * v + rng.normal(0, noise_m, (n, 1)) * normal
    return xyz + HERE


@pytest.mark.parametrize("direction", [(0, 0, 1), (1, 0, 0), (0, -1, 0), (0.2, -0.3, 0.93), (0.6, 0.8, -0.1)])
def test_normal_and_roughness_of_a_known_plane(direction: tuple[float, float, float]) -> None:
    normal = np.array(direction, dtype=float) / np.linalg.norm(direction)
    found = estimate_normals(plane(normal, 0.02), PARAMS)
    assert found.is_valid.mean() > 0.99
    angle = np.degrees(np.arccos(np.clip(np.abs(found.normals[found.is_valid] @ normal), 0, 1)))
    assert np.median(angle) < 1.5
    assert np.median(found.roughness[found.is_valid]) == pytest.approx(0.02, rel=0.15)
    assert np.allclose(np.linalg.norm(found.normals[found.is_valid], axis=1), 1, atol=1e-6)


def test_equals_a_slow_twin() -> None:
    rng = np.random.default_rng(1)
    xyz = np.vstack([plane(np.array([0, 0.6, 0.8]), 0.03, n=1500), rng.uniform(-2, 2, (300, 3)) + HERE])
    found = estimate_normals(xyz, PARAMS)
    local = (xyz - xyz.mean(axis=0)).astype(np.float32).astype(float)
    for i in range(0, len(xyz), 7):
        distance = np.linalg.norm(local - local[i], axis=1)
        near = np.argsort(distance, kind="stable")[: PARAMS.max_neighbours]
        near = near[distance[near] <= PARAMS.radius_m]
        values, vectors = (
            np.linalg.eigh(np.cov(local[near].T, bias=True)) if len(near) > 1 else (np.zeros(3), np.eye(3))
        )
        is_plane = len(near) >= PARAMS.min_neighbours and values[0] <= PARAMS.max_isotropy * values[1]
        assert found.is_valid[i] == is_plane
        if is_plane:
            residual = (local[near] - local[near].mean(axis=0)) @ vectors[:, 0]
            mad = 1.4826 * np.median(np.abs(residual - np.median(residual)))
            assert abs(found.normals[i] @ vectors[:, 0]) > 1 - 1e-5
            assert found.roughness[i] == pytest.approx(mad, abs=2e-5)


@pytest.mark.parametrize("n", [1, 2, 3, 6, 7, 30, 101])
def test_mad_equals_its_definition(n: int) -> None:
    for seed in range(20):
        values = np.random.default_rng(seed).normal(0, 1, n)
        values[: n // 3] = values[0]
        expected = 1.4826 * np.median(np.abs(values - np.median(values)))
        assert mad_sigma(values, n, np.empty(n), np.empty(n, dtype=np.int32)) == pytest.approx(expected, abs=1e-15)


def test_wires_blobs_and_lone_points_are_no_planes() -> None:
    rng = np.random.default_rng(2)
    wire = np.column_stack([np.linspace(0, 20, 400), np.zeros(400), np.full(400, 8.0)])
    blob = rng.normal((0, 20, 0), 0.4, (2000, 3))
    lone = np.array([[50.0, 50, 50], [50.1, 50, 50]])
    found = estimate_normals(np.vstack([wire, blob, lone]), PARAMS)
    assert not found.is_valid[:400].any()
    assert found.is_valid[400:2400].mean() < 0.45
    assert not found.is_valid[2400:].any()
    assert np.isnan(found.roughness[~found.is_valid]).all()
    assert (found.normals[~found.is_valid] == 0).all()


def test_normals_point_up_and_depend_on_no_order() -> None:
    xyz = plane(np.array([0.1, 0.2, -0.97]), 0.01, n=1500)
    shuffle = np.random.default_rng(0).permutation(len(xyz))
    found, shuffled = estimate_normals(xyz, PARAMS), estimate_normals(xyz[shuffle], PARAMS)
    assert (found.normals[found.is_valid, 2] > 0).all()
    assert np.array_equal(found.normals[shuffle], shuffled.normals)
    assert np.array_equal(found.roughness[shuffle], shuffled.roughness, equal_nan=True)


def test_empty() -> None:
    found = estimate_normals(np.zeros((0, 3)), PARAMS)
    assert (found.normals.shape, found.is_valid.dtype, found.roughness.dtype) == ((0, 3), np.bool_, np.float32)
