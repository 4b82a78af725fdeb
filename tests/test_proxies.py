"""Proxies against a dense grid and scenes that can be counted by hand."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference import proxies as reference

from loda_pdal.params import ProxyParams
from loda_pdal.stages.proxies import Proxies, build_proxies, voxel_components

PARAMS = ProxyParams()


def block(low: tuple[float, ...], size: tuple[float, ...]) -> np.ndarray:
    """Points in the middle of every 0.5 m voxel of a solid cuboid, a millimetre off, in metres."""
    axes = [np.arange(start + 0.25, start + length, 0.5) for start, length in zip(low, size, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + 0.001


def proxies_of(xyz: np.ndarray, params: ProxyParams = PARAMS, is_ground: np.ndarray | None = None) -> Proxies:
    is_ground = np.zeros(len(xyz), dtype=bool) if is_ground is None else is_ground
    return build_proxies(xyz, xyz[:, 2], is_ground, params, "upright")


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.4), st.integers(0, 3), st.integers(1, 12), st.booleans())
def test_components_agree_with_a_dense_grid(
    seed: int, density: float, closing: int, min_voxels: int, is_flat: bool
) -> None:
    rng = np.random.default_rng(seed)
    shape = (14, 11, 2 if is_flat else 9)
    cells = np.argwhere(rng.random(shape) < density) + rng.integers(-50, 50, 3)
    cells = np.concatenate([cells, cells[: len(cells) // 3]])[rng.permutation(len(cells) + len(cells) // 3)]
    if len(cells) == 0:
        return
    expected = reference.voxel_components(cells, closing, min_voxels)
    assert voxel_components(cells, closing, min_voxels).tolist() == expected.tolist()


def test_one_empty_voxel_is_closed_and_two_are_not() -> None:
    for gap, n in ((0.5, 1), (1.0, 1), (1.5, 2)):  # a cube reaches one voxel from either side
        xyz = np.concatenate([block((0, 0, 1), (5, 5, 5)), block((5 + gap, 0, 1), (5, 5, 5))])
        assert len(proxies_of(xyz)) == n
    apart = np.concatenate([block((0, 0, 1), (5, 5, 5)), block((5.5, 0, 1), (5, 5, 5))])
    assert len(proxies_of(apart, replace(PARAMS, closing_voxels=0))) == 2


def test_corners_connect() -> None:
    xyz = np.concatenate([block((0, 0, 1), (4, 4, 4)), block((4, 4, 5), (4, 4, 4))])
    assert len(proxies_of(xyz, replace(PARAMS, closing_voxels=0))) == 1


def test_small_pieces_are_none() -> None:
    just, short = block((0, 0, 1), (5, 5, 1)), block((20, 0, 1), (5, 5, 1))[:-1]
    found = proxies_of(np.concatenate([just, short]), replace(PARAMS, closing_voxels=0))
    assert found.proxy.tolist() == [1] * 200 + [0] * 199
    assert found.descriptors.n_voxels.tolist() == [200]


def test_ground_and_low_points_are_left_out_and_unknown_heights_are_not() -> None:
    house, street = block((0, 0, 0), (5, 5, 5)), block((-10, -10, -0.5), (30, 30, 0.5))
    xyz = np.concatenate([house, street])
    is_street = np.arange(len(xyz)) >= len(house)
    found = proxies_of(xyz, is_ground=is_street)
    assert np.array_equal(found.proxy > 0, ~is_street & (xyz[:, 2] >= 0.3))
    assert len(found) == 1
    unknown = build_proxies(xyz, np.full(len(xyz), np.nan), is_street, PARAMS, "upright")
    assert np.array_equal(unknown.proxy > 0, ~is_street)
    assert np.isnan(unknown.descriptors.h95).all()


def test_descriptors_of_a_block() -> None:
    found = proxies_of(np.concatenate([block((10, 0, 0), (5, 5, 6)), block((0, 0, 0), (4, 6, 6))]))
    assert found.proxy[:600].max() == 2  # numbered by the lowest voxel: smaller x first
    described = found.descriptors
    assert described.centroid[1] == pytest.approx([12.501, 2.501, 3.251], abs=1e-9)  # the layer below 0.3 m is cut
    assert sorted(described.boxes.size[1, :2]) == pytest.approx([4.5, 4.5], abs=1e-9)
    assert described.boxes.size[1, 2] == pytest.approx(5.0, abs=1e-9)
    assert described.n_voxels.tolist() == [8 * 12 * 11, 10 * 10 * 11]
    assert described.h95[1] == pytest.approx(5.751, abs=1e-9)
    assert described.histogram[1].sum() == pytest.approx(1.0)


def test_proxies_do_not_depend_on_order_or_whole_voxel_shifts() -> None:
    rng = np.random.default_rng(1)
    xyz = np.concatenate([block((8 * k, rng.integers(0, 9), 1), (5, 5, 4)) for k in range(6)])
    expected = proxies_of(xyz)
    shuffle = rng.permutation(len(xyz))
    assert np.array_equal(proxies_of(xyz[shuffle]).proxy, expected.proxy[shuffle])
    moved = build_proxies(xyz + np.array([1e6, 1e6, 0]), xyz[:, 2], np.zeros(len(xyz), bool), PARAMS, "upright")
    assert np.array_equal(moved.proxy, expected.proxy)


def test_a_long_strip_takes_memory_for_its_surface_only() -> None:
    corners = [(0, 0, 0), (700, 0, 0), (0, 500, 55), (700, 500, 55)]
    xyz = np.concatenate([block(corner, (5, 5, 5)) for corner in corners])
    tracemalloc.start()
    found = proxies_of(xyz)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(found) == 4
    assert peak < 20e6  # the dense grid has 170 million voxels


def test_no_points_have_no_proxies() -> None:
    found = proxies_of(np.zeros((0, 3)))
    assert (len(found), found.proxy.dtype) == (0, np.int32)
    only_ground = build_proxies(np.zeros((5, 3)), np.zeros(5), np.ones(5, bool), PARAMS, "pca")
    assert only_ground.proxy.tolist() == [0] * 5
