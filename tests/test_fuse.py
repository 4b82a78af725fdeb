"""Fused points are exact means, whatever the order of the points."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from loda_pdal.model.cloud import to_local_grid
from loda_pdal.model.errors import InputError
from loda_pdal.model.survey import Survey
from loda_pdal.params import FuseParams
from loda_pdal.stages.fuse import downsample, fuse_points, fuse_survey

PARAMS = FuseParams(leaf_m=0.25)


def cloud(seed: int, n: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return to_local_grid(rng.uniform(-1.5, 1.5, (n, 3)) + np.array([100.0, -50.0, 0.0]))


def test_by_hand() -> None:
    xyz = np.array([[0.5, 0, 0], [0.0, 0, 0], [-0.125, 0, 0], [0.125, 0.125, 0], [0.625, 0.125, 0.125]])
    fused = fuse_points(xyz, PARAMS)
    assert fused.xyz.tolist() == [[-0.125, 0, 0], [0.0625, 0.0625, 0], [0.5625, 0.0625, 0.0625]]
    assert fused.n_raw.tolist() == [1, 2, 2]
    assert fused.voxel_idx.tolist() == [2, 1, 0, 1, 2]


def test_equals_a_dictionary_of_voxels() -> None:
    xyz = cloud(0, 3000)
    voxels: dict[tuple[int, ...], list[int]] = {}
    for i, cell in enumerate(np.floor(xyz / PARAMS.leaf_m).astype(int)):
        voxels.setdefault(tuple(cell), []).append(i)
    fused = fuse_points(xyz, PARAMS)
    assert len(fused) == len(voxels)
    for v, members in enumerate(voxels[cell] for cell in sorted(voxels)):
        assert np.array_equal(fused.xyz[v], xyz[members].sum(axis=0) / len(members))
        assert fused.n_raw[v] == len(members)
        assert (fused.voxel_idx[members] == v).all()
    assert (fused.xyz.dtype, fused.n_raw.dtype, fused.voxel_idx.dtype) == (np.float64, np.int32, np.int32)


@given(st.integers(0, 1000), st.integers(0, 400))
def test_order_of_the_points_does_not_matter(seed: int, n: int) -> None:
    xyz = cloud(seed, n)
    shuffle = np.random.default_rng(seed).permutation(n)
    fused, shuffled = fuse_points(xyz, PARAMS), fuse_points(xyz[shuffle], PARAMS)
    assert np.array_equal(fused.xyz, shuffled.xyz)
    assert np.array_equal(fused.voxel_idx[shuffle], shuffled.voxel_idx)


def test_a_shift_by_whole_voxels_shifts_the_result_exactly() -> None:
    xyz, shift = cloud(1, 2000), np.array([250.0, -1000.0, 8.25])
    fused, shifted = fuse_points(xyz, PARAMS), fuse_points(xyz + shift, PARAMS)
    assert np.array_equal(fused.voxel_idx, shifted.voxel_idx)
    assert np.abs(fused.xyz + shift - shifted.xyz).max() < 1e-12


def test_many_more_voxels_than_the_first_table_holds() -> None:
    xyz = np.stack(np.meshgrid(np.arange(400), np.arange(500), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    fused = fuse_points(xyz[::-1], PARAMS)
    assert np.array_equal(fused.xyz, xyz)


@given(st.integers(0, 1000), st.integers(1, 400), st.integers(1, 200))
def test_parts_give_what_the_whole_gives(seed: int, n: int, size: int) -> None:
    xyz = cloud(seed, n)

    class Parts:
        def __len__(self) -> int:
            return n

        def coordinates(self) -> Iterator[np.ndarray]:
            return (xyz[start : start + size] for start in range(0, n, size))

    whole, parts = fuse_points(xyz, PARAMS), fuse_survey(Survey(Parts()), PARAMS)
    for name in ("xyz", "n_raw", "voxel_idx"):
        assert np.array_equal(getattr(whole, name), getattr(parts, name))


def test_downsample_is_the_mean_per_voxel() -> None:
    assert downsample(np.array([[0.1, 0, 0], [0.9, 0, 0], [1.5, 0, 0]]), 1.0).tolist() == [[0.5, 0, 0], [1.5, 0, 0]]


def test_empty_and_absurd() -> None:
    fused = fuse_points(np.zeros((0, 3)), PARAMS)
    assert (fused.xyz.shape, fused.n_raw.dtype, fused.voxel_idx.dtype) == ((0, 3), np.int32, np.int32)
    with pytest.raises(InputError, match="too far"):
        fuse_points(np.array([[0.0, 0, 0], [1e9, 1e9, 1e9]]), PARAMS)
