"""Surveys in parts, where their points are, and what was found for them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from io_samples import made_up_height, make_labels

from loda_pdal.model.cloud import FloatArray, VoxelCloud
from loda_pdal.model.dimensions import FOUND
from loda_pdal.model.extent import Extent
from loda_pdal.model.groups import count_cells
from loda_pdal.model.survey import PART, Survey


def extent(xyz: FloatArray) -> Extent:
    return Survey(xyz).extent


def test_overlap_counts_occupied_cells() -> None:
    cells = np.array([[5.0, 5, 0], [15, 5, 0], [25, 5, 0], [5, 15, 0], [5, 16, 9]])
    shifted = np.array([[15.0, 5, 0], [25, 5, 0], [35, 5, 0], [45, 5, 0], [55, 5, 0]])
    assert extent(cells).overlap(extent(shifted)) == pytest.approx(2 / 4)  # 4 and 5 are occupied, both 2
    assert extent(shifted).overlap(extent(cells)) == pytest.approx(2 / 4)
    assert extent(cells - 1e4).overlap(extent(shifted - 1e4)) == pytest.approx(2 / 4)


@given(st.integers(0, 1000), st.integers(1, 300), st.integers(1, 100))
def test_extent_of_parts_is_that_of_the_whole(seed: int, n: int, size: int) -> None:
    xyz = np.random.default_rng(seed).uniform(-200.0, 200.0, (n, 3))
    found = Extent.of(xyz[start : start + size] for start in range(0, n, size))
    assert found.n == n
    assert np.array_equal(found.low, xyz.min(axis=0)) and np.array_equal(found.high, xyz.max(axis=0))
    n_cells = count_cells(xyz[:, :2], np.zeros(n, dtype=np.int32), 1, 5.0)[0]
    assert found.spacing_m == pytest.approx(5.0 * np.sqrt(n_cells / n), rel=1e-12)
    coarse = {tuple(cell) for cell in np.floor(xyz[:, :2] / 10.0).astype(int)}
    half = xyz[: n // 2 + 1]
    of_half = {tuple(cell) for cell in np.floor(half[:, :2] / 10.0).astype(int)}
    assert found.overlap(extent(half)) == len(coarse & of_half) / len(of_half) == 1.0
    assert len(coarse) >= len(of_half)
    whole = extent(xyz)
    assert np.array_equal(found.cells, whole.cells) and np.array_equal(found.n_in_cell, whole.n_in_cell)
    assert found.n_in_cell.sum() == n and 0.25 <= found.dense_share <= 1.0


def test_nothing_has_no_extent() -> None:
    nothing = extent(np.zeros((0, 3)))
    assert (nothing.n, nothing.spacing_m, nothing.overlap(nothing)) == (0, 0.0, 0.0)
    assert nothing.size_m.tolist() == [0, 0, 0]


def test_coordinates_beyond_any_map_are_no_trouble() -> None:
    far = extent(np.array([[1e300, -1e300, 0.0], [0.0, 0.0, 0.0]]))
    assert len(far.cells) == 2 and far.size_m[0] == 1e300


def test_parts_of_an_array_are_the_array() -> None:
    xyz = np.random.default_rng(1).uniform(size=(2 * PART + 3, 3))
    parts = list(Survey(xyz).parts())
    assert [len(part) for part in parts] == [PART, PART, 3]
    assert np.array_equal(np.concatenate(parts), xyz) and Survey(xyz).xyz is xyz


def test_what_was_found_part_by_part_is_what_was_found_for_all() -> None:
    survey = Survey(np.random.default_rng(2).uniform(0, 60, (1000, 3)))
    labels = make_labels(survey)
    parts = [labels.of_part(start, survey.xyz[start : start + 300]) for start in range(0, 1000, 300)]
    found = np.concatenate(parts)
    assert found.dtype == FOUND and len(labels) == 1000
    for values, name in (
        (labels.classification, "Classification"),
        (labels.height, "HeightAboveGround"),
        (labels.lod95, "LoD95"),
        (labels.superpoint, "Superpoint"),
        (labels.instance, "InstanceId"),
        (labels.object, "ObjectId"),
        (labels.change, "ChangeClass"),
        (labels.confidence, "ChangeConfidence"),
    ):
        np.testing.assert_array_equal(values, found[name])
        assert values.dtype == FOUND[name]
    np.testing.assert_array_equal(labels.height, made_up_height(survey.xyz))
    assert np.all(labels.classification[labels.voxel_idx < 0] == 7)


def test_voxels_that_are_taken_out_leave_points_without_one() -> None:
    cloud = VoxelCloud(
        np.arange(12.0).reshape(4, 3), np.array([1, 2, 1, 1], np.int32), np.array([3, 1, -1, 0, 1, 2], np.int32)
    )
    kept = cloud.subset(np.array([False, True, False, True]))
    assert kept.voxel_idx.tolist() == [1, 0, -1, -1, 0, -1] and kept.voxel_idx.dtype == np.int32
    assert kept.n_raw.tolist() == [2, 1] and kept.xyz[:, 0].tolist() == [3.0, 9.0]
