"""Coverage of the limit of detection, on a grid whose shares are known."""

from __future__ import annotations

import numpy as np
import pytest

from loda_pdal.benchmark.coverage import coverage_of
from loda_pdal.model.lod_grid import LodGrid


def test_shares_are_counted_by_surface_and_only_where_valid() -> None:
    n = 8
    normal = np.zeros((n, 3), np.float32)
    normal[:4, 2] = 1.0
    normal[4:, 0] = 1.0
    displacement = np.array([0.01, -0.04, 0.06, 0.02, 0.01, 0.2, -0.2, 9.0], np.float32)
    is_valid = np.arange(n) < 7
    counts = np.full(n, 40, np.int32)
    cells = np.column_stack([np.arange(n), np.zeros(n), np.zeros(n)]).astype(np.int32)
    grid = LodGrid(cells, 1.0, np.full(n, 0.05, np.float32), normal, counts, counts, is_valid, displacement, 0.5)
    found = coverage_of(grid)
    assert (found["level"].n_cells, found["level"].share) == (4, 0.75)
    assert found["upright"].n_cells == 3
    assert found["upright"].share == pytest.approx(1 / 3)
    assert found["all"].share == pytest.approx(4 / 7)
    assert found["slanted"].n_cells == 0
    assert np.isnan(found["slanted"].share)
    assert found["all"].median_m == pytest.approx(0.05)
