"""Coverage of the limit of detection on a grid whose shares are known, and a small suite without edits."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from loda_pdal.benchmark import evaluate
from loda_pdal.benchmark.commands import bench
from loda_pdal.benchmark.simulate import SimulationOptions
from loda_pdal.benchmark.suites import SIZES, SuiteBlock
from loda_pdal.benchmark.unchanged import SURFACES, coverage_of
from loda_pdal.model.lod_grid import LodGrid


def test_shares_are_counted_by_surface_and_only_where_valid() -> None:
    n = 8
    normal = np.zeros((n, 3), np.float32)
    displacement = np.array([0.01, -0.04, 0.06, 0.02, 0.01, 0.2, -0.2, 9.0], np.float32)
    is_valid = np.arange(n) < 7
    counts = np.full(n, 40, np.int32)
    cells = np.column_stack([np.arange(n), np.zeros(n), np.zeros(n)]).astype(np.int32)
    grid = LodGrid(cells, 1.0, np.full(n, 0.05, np.float32), normal, counts, counts, is_valid, displacement, 0.5)
    surface = np.array([0, 0, 0, 0, 1, 1, 1, 1])
    found = coverage_of(grid, surface)
    assert list(found) == ["all", *SURFACES]
    assert (len(found["ground"].is_within), found["ground"].share) == (4, 0.75)
    assert len(found["facade"].is_within) == 3
    assert found["facade"].share == pytest.approx(1 / 3)
    assert found["all"].share == pytest.approx(4 / 7)
    assert (found["roof"].share, found["roof"].median_m) == (None, None)
    assert found["all"].median_m == pytest.approx(0.05)


@pytest.mark.usefixtures("compiled_kernels")
def test_a_suite_without_edits_is_surveyed_and_told_by_surface(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    block = SuiteBlock("seed_3", "train", 3, SimulationOptions(length_m=30.0, density=0.4))
    monkeypatch.setattr(evaluate, "streets", lambda suite, split: [block])
    monkeypatch.setitem(SIZES["vehicle"], "train", (1, 0))
    arguments = ["unchanged", str(tmp_path), "--suite", "vehicle", "--split", "train"]
    found = json.loads(CliRunner().invoke(bench, [*arguments, "--json"], catch_exceptions=False).stdout)
    truth = json.loads((tmp_path / "seed_3_unchanged" / "truth.json").read_text())
    assert {i["label"] for i in truth["instances"] if i["excluded"] is None} == {"Unchanged"}
    cells = {name: surface["cells"] for name, surface in found["coverage"].items()}
    assert cells["all"] == sum(cells[name] for name in SURFACES) > 300
    assert min(cells["ground"], cells["facade"]) > 50
    assert 0.85 < found["coverage"]["ground"]["share"] <= 1.0
    assert found["blocks"]["seed_3_unchanged"]["objects"] > 3
    text = CliRunner().invoke(bench, arguments, catch_exceptions=False).stdout
    assert "# Nothing changed: suite vehicle, train split: 1 blocks, preset street" in text
