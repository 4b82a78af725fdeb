"""One method, four faces: the command, Python, PDAL and the embedded runner say the same of every simulated point."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest

from loda_pdal import Parameters, detect_changes, read_epochs
from loda_pdal.benchmark.simulate import SimulationOptions, simulate_block, write_block
from loda_pdal.cli.main import run
from loda_pdal.model.records import ChangeResult
from loda_pdal.pdal_face import run_pipeline


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with before.laz and after.laz of a street with planted edits."""
    folder = tmp_path_factory.mktemp("block")
    write_block(simulate_block(12, SimulationOptions(length_m=60.0, density=0.4)), folder)
    return folder


@pytest.fixture(scope="module")
def result(block: Path) -> ChangeResult:
    surveys = read_epochs(block / "before.laz", block / "after.laz")
    return detect_changes(surveys.before, surveys.after, Parameters.preset("street"))


def check(points: laspy.LasData, result: ChangeResult) -> None:
    """The cloud carries what Python found, point by point, before first."""
    for name, field in (("ChangeClass", "change"), ("ObjectId", "object"), ("InstanceId", "instance")):
        found = np.concatenate([getattr(side, field) for side in result.points])
        assert np.array_equal(np.asarray(points[name]), found), name
    assert len(set(np.unique(np.asarray(points["ChangeClass"])).tolist()) & {2, 3, 4, 5}) >= 3


def test_the_command(block: Path, result: ChangeResult, tmp_path: Path) -> None:
    arguments = ["detect", str(block / "before.laz"), str(block / "after.laz"), "-o", str(tmp_path / "out")]
    assert run([*arguments, "-q"]) == 0
    about = json.loads((tmp_path / "out" / "run.json").read_text())["run"]
    assert about["preset"] == "street" and "densest quarter of the plan" in about["preset_reason"]
    check(laspy.read(tmp_path / "out" / "changes.laz"), result)


@pytest.mark.parametrize("engine", [pytest.param("pdal", marks=pytest.mark.pdal), "embedded"])
def test_the_pipeline(engine: str, block: Path, result: ChangeResult, pipelines_dir: Path, tmp_path: Path) -> None:
    overrides = {
        "stage.before.filename": str(block / "before.laz"),
        "stage.after.filename": str(block / "after.laz"),
        "stage.output.filename": str(tmp_path / "out.laz"),
        "filters.python.pdalargs": json.dumps({"run": str(tmp_path / "run")}),
    }
    assert run_pipeline(pipelines_dir / "change.json", overrides, engine=engine).engine == engine
    check(laspy.read(tmp_path / "out.laz"), result)


def test_the_example(block: Path, result: ChangeResult) -> None:
    example = Path(__file__).parent.parent / "examples" / "largest_changes.py"
    arguments = [sys.executable, str(example), str(block / "before.laz"), str(block / "after.laz")]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=300, check=True)
    largest = max(result.changes, key=lambda change: change.footprint.area)
    assert done.stdout.splitlines()[0].endswith(largest.reason)
