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


@given(st.integers(0, 2**32 - 1))
def test_distinct_rows_agree_with_numpy(seed: int) -> None:
    rows = np.random.default_rng(seed).integers(-2, 3, (40, 3))
    expected, inverse = np.unique(rows, axis=0, return_inverse=True)
    assert np.array_equal(unique_rows(rows), expected)
    assert np.array_equal(unique_inverse(rows), inverse.ravel())


def test_consecutive_numbers_follow_the_first_point() -> None:
    numbered, n = consecutive(np.array([7, -1, 3, 7, 3, 9]))
    assert numbered.tolist() == [0, -1, 1, 0, 1, 2]
    assert n == 3


def test_cells_are_counted_once_per_label() -> None:
    points = np.array([[0.1, 0.1, 0.1], [0.2, 0.3, 0.4], [0.6, 0.1, 0.1], [0.1, 0.1, 0.1], [9.0, 9.0, 9.0]])
    assert count_cells(points, np.array([0, 0, 0, 1, -1]), 3, 0.5).tolist() == [2.0, 1.0, 0.0]
