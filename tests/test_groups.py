"""Grouped statistics against plain loops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from loda_pdal.model.groups import Groups, consecutive, count_cells, unique_inverse, unique_rows


@given(st.integers(0, 2**32 - 1), st.integers(0, 60), st.integers(1, 8))
def test_groups_agree_with_a_loop(seed: int, n_points: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    labels = rng.integers(-1, n, n_points)
    values = np.where(rng.random(n_points) < 0.2, np.nan, rng.normal(size=n_points))
    xyz = rng.normal(size=(n_points, 3))
    groups = Groups(labels, n)
    for g in range(n):
        inside = labels == g
        assert groups.members(g).tolist() == np.flatnonzero(inside).tolist()
        assert groups.counts[g] == inside.sum()
        assert groups.sum(xyz)[g] == pytest.approx(xyz[inside].sum(axis=0))
        finite = values[inside & np.isfinite(values)]
        for q in (0.0, 0.3, 0.5, 1.0):
            expected = np.quantile(finite, q) if len(finite) else np.nan
            assert groups.quantile(values, q)[g] == pytest.approx(expected, nan_ok=True)
        if inside.sum() > 1:
            assert groups.covariance(xyz)[g] == pytest.approx(np.cov(xyz[inside].T, bias=True), abs=1e-12)
        elif not inside.any():
            assert np.isnan(groups.mean(xyz)[g]).all()
            assert not groups.covariance(xyz)[g].any()
    assert np.array_equal(groups.order, np.concatenate([np.flatnonzero(labels == g) for g in range(n)]))


@given(st.integers(0, 2**32 - 1), st.integers(1, 2000), st.integers(1, 50))
def test_order_statistics_of_large_groups_with_ties(seed: int, n_points: int, n_values: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.integers(0, n_values, n_points).astype(np.float32)
    for arranged in (values, np.sort(values), np.sort(values)[::-1]):
        groups = Groups(np.zeros(n_points, np.int32), 1)
        for q in (0.0, 0.05, 0.5, 0.95, 1.0):
            assert groups.quantile(arranged, q)[0] == pytest.approx(np.quantile(values.astype(float), q))
        assert groups.extremes(arranged) == (values.min(), values.max())
        assert np.array_equal(groups.members(0), np.arange(n_points))


def test_extremes_leave_nan_out_and_take_columns() -> None:
    groups = Groups(np.array([1, 0, 1, -1, 0, 2], np.int8), 4)
    values = np.array([[3.0, np.nan], [1.0, 5.0], [np.nan, -2.0], [-9.0, 9.0], [2.0, 4.0], [np.nan, 1.0]])
    low, high = groups.extremes(values)
    nan = np.nan
    assert np.array_equal(low, [[1, 4], [3, -2], [nan, 1], [nan, nan]], equal_nan=True)
    assert np.array_equal(high, [[2, 5], [3, -2], [nan, 1], [nan, nan]], equal_nan=True)
    assert np.array_equal(groups.minimum(values[:, 0]), low[:, 0], equal_nan=True)
    assert np.array_equal(groups.maximum(values[:, 1]), high[:, 1], equal_nan=True)


def test_some_groups_keep_their_numbers() -> None:
    groups = Groups(np.array([0, 1, 2, -1, 2]), 3).only(np.array([True, False, True]))
    assert groups.labels.tolist() == [0, -1, 2, -1, 2]
    assert groups.counts.tolist() == [1, 0, 2]
    assert Groups(np.full(2, -1), 0).only(np.zeros(0, bool)).n == 0


def test_a_label_without_a_group_is_an_error() -> None:
    with pytest.raises(ValueError, match="label 3 in only 3 groups"):
        Groups(np.array([0, 3]), 3)


@given(st.integers(0, 2**32 - 1))
def test_distinct_rows_agree_with_numpy(seed: int) -> None:
    rows = np.random.default_rng(seed).integers(-2, 3, (40, 3))
    expected, inverse = np.unique(rows, axis=0, return_inverse=True)
    assert np.array_equal(unique_rows(rows), expected)
    assert np.array_equal(unique_inverse(rows), inverse.ravel())
    far = rows * 10**12  # no key of 64 bits holds such a row
    assert np.array_equal(unique_rows(far), expected * 10**12)
    assert np.array_equal(unique_inverse(far), inverse.ravel())


def test_no_rows_are_no_distinct_rows() -> None:
    assert unique_rows(np.zeros((0, 3), np.int64)).shape == (0, 3)
    assert unique_inverse(np.zeros((0, 3), np.int64)).shape == (0,)


def test_consecutive_numbers_follow_the_first_point() -> None:
    labels = np.array([7, -1, 3, 7, 3, 9])
    for scale in (1, 10**15):
        numbered, n = consecutive(labels * scale)
        assert numbered.tolist() == [0, -1, 1, 0, 1, 2]
        assert n == 3
    assert consecutive(np.full(2, -5, np.int32))[0].tolist() == [-1, -1]
    assert consecutive(np.zeros(0, np.int32))[1] == 0


def test_cells_are_counted_once_per_label() -> None:
    points = np.array([[0.1, 0.1, 0.1], [0.2, 0.3, 0.4], [0.6, 0.1, 0.1], [0.1, 0.1, 0.1], [9.0, 9.0, 9.0]])
    assert count_cells(points, np.array([0, 0, 0, 1, -1]), 3, 0.5).tolist() == [2.0, 1.0, 0.0]
