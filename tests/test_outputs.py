"""Writing all results of a run: whole or not at all."""

from __future__ import annotations

import errno
import hashlib
import json
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyogrio
import pytest
import rasterio
from io_samples import make_result, make_surveys

from loda_pdal.io import outputs
from loda_pdal.io.outputs import OUTPUTS, check_output_folder, write_outputs
from loda_pdal.io.plain import to_json, to_plain
from loda_pdal.io.report_folder import rebuild_report
from loda_pdal.model.errors import OutputError
from loda_pdal.model.pair import Pair
from loda_pdal.model.survey import Survey

NAMES = {"changes.gpkg", "changes.laz", "lod95.tif", "transform.json", "report.html", "run.json"}


@pytest.fixture
def surveys(tmp_path: Path) -> Pair[Survey]:
    (tmp_path / "in").mkdir()
    return make_surveys(tmp_path / "in")


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def refused(*args: Any, **options: Any) -> OutputError:
    with pytest.raises(OutputError) as caught:
        write_outputs(*args, **options)
    assert caught.value.message and caught.value.remedy
    return caught.value


def test_all_results_are_written_and_nothing_else(tmp_path: Path, surveys: Pair[Survey]) -> None:
    paths = write_outputs(make_result(surveys), surveys, tmp_path / "deep" / "out", run_info={"command": "detect"})
    assert {path.name for path in (tmp_path / "deep" / "out").iterdir()} == NAMES
    assert {path.name for path in paths.values()} == NAMES
    assert laspy.read(paths["cloud"]).header.point_count == 3500
    assert len(pyogrio.list_layers(paths["changes"])) == 8
    with rasterio.open(paths["lod95"]) as raster:
        assert raster.count == 2
    assert "</html>" in paths["report"].read_text(encoding="utf-8")


def test_run_json_says_how_the_result_came_about(tmp_path: Path, surveys: Pair[Survey]) -> None:
    result = make_result(surveys)
    paths = write_outputs(result, surveys, tmp_path / "out", run_info={"command": ["loda-pdal", "detect"]})
    run = json.loads(paths["run"].read_text(encoding="utf-8"), parse_constant=pytest.fail)
    assert run["run"]["command"] == ["loda-pdal", "detect"]
    for name, survey in (("before", surveys.before), ("after", surveys.after)):
        content = Path(survey.path).read_bytes()
        assert run["inputs"][name]["sha256"] == hashlib.sha256(content).hexdigest()
        assert run["inputs"][name]["bytes"] == len(content)
        assert run["inputs"][name]["points"] == len(survey)
    assert run["parameters"] == to_plain(result.parameters.to_dict())
    assert run["crs"]["epsg"] == 32617 and run["crs"]["local_origin"] == [634_000, 4_831_000, 0]
    assert run["stages"] == {
        "fuse": {"seconds": 0.5, "peak_rss_mb": 210.0},
        "register": {"seconds": 1.25, "peak_rss_mb": 250.0},
    }
    assert run["seconds"] == 1.75
    assert run["registration"]["converged"] is True and run["registration"]["iterations"] == [12, 7, 5]
    assert run["summary"]["counts"]["Increased"] == {"building": 2, "vegetation": 0, "mobile": 0, "other": 0}
    assert "One made-up warning." in run["warnings"]
    assert run["versions"]["laspy"] == laspy.__version__
    _, _, _, (keys, values) = pyogrio.raw.read(paths["changes"], layer="run")
    layer = dict(zip(keys, values, strict=True))
    assert layer["inputs.before.sha256"] == run["inputs"]["before"]["sha256"]
    assert layer["parameters.lod.radius_m"] == str(run["parameters"]["lod"]["radius_m"])


def test_results_of_arrays_need_no_file(tmp_path: Path, surveys: Pair[Survey]) -> None:
    arrays = surveys.map(lambda s: Survey(s.xyz, s.frame))
    paths = write_outputs(make_result(arrays), arrays, tmp_path / "out", cloud_format="las")
    assert paths["cloud"].name == "changes.las"
    run = json.loads(paths["run"].read_text(encoding="utf-8"))
    assert run["inputs"]["before"] == {"path": None, "bytes": None, "sha256": None, "points": 2000, "notes": []}


def test_keep_frames_leaves_before_points_alone(tmp_path: Path, surveys: Pair[Survey]) -> None:
    paths = write_outputs(make_result(surveys), surveys, tmp_path / "out", keep_frames=True)
    np.testing.assert_array_equal(laspy.read(paths["cloud"])["X"][:2000], laspy.read(surveys.before.path)["X"])


# Not overwriting


@pytest.mark.parametrize("name", OUTPUTS)
def test_an_existing_output_is_refused(tmp_path: Path, surveys: Pair[Survey], name: str) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(OutputError, match=name.replace(".", r"\.")) as caught:
        check_output_folder(tmp_path)
    assert caught.value.code == "output-exists" and "--overwrite" in caught.value.remedy
    assert refused(make_result(surveys), surveys, tmp_path).code == "output-exists"
    assert (tmp_path / name).read_text() == "mine"
    check_output_folder(tmp_path, overwrite=True)


def test_overwriting_replaces_the_whole_result_and_leaves_other_files(tmp_path: Path, surveys: Pair[Survey]) -> None:
    folder = tmp_path / "out"
    write_outputs(make_result(surveys), surveys, folder, cloud_format="las")
    (folder / "changes.gpkg-wal").write_bytes(b"left by a program that had it open")
    (folder / "lod95.tif.aux.xml").write_text("<PAMDataset/>")
    (folder / "notes.txt").write_text("mine")
    write_outputs(make_result(surveys, warnings=["second"]), surveys, folder, overwrite=True)
    assert {path.name for path in folder.iterdir()} == NAMES | {"notes.txt"}  # the old changes.las is gone
    assert "second" in (folder / "run.json").read_text(encoding="utf-8")


def test_a_file_in_place_of_the_folder(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    for folder in (tmp_path / "out", tmp_path / "out" / "deeper"):
        with pytest.raises(OutputError) as caught:
            check_output_folder(folder)
        assert caught.value.code in ("output-not-folder", "output-unwritable")


def test_checking_creates_nothing(tmp_path: Path) -> None:
    check_output_folder(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any, **kwargs: Any) -> Any:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(outputs.tempfile, "TemporaryFile", refuse)
    with pytest.raises(OutputError, match="Permission denied") as caught:
        check_output_folder(tmp_path / "out")
    assert caught.value.code == "output-unwritable"


def test_an_unknown_cloud_format_is_refused_before_anything_is_written(tmp_path: Path, surveys: Pair[Survey]) -> None:
    error = refused(make_result(surveys), surveys, tmp_path / "out", cloud_format="e57")
    assert error.code == "cloud-format" and "copc" in str(error)
    assert not (tmp_path / "out").exists()


def test_copc_in_place_of_laz(tmp_path: Path, surveys: Pair[Survey]) -> None:
    result = make_result(surveys)
    plain = write_outputs(result, surveys, tmp_path / "out")
    copc = write_outputs(result, surveys, tmp_path / "copc", cloud_format="copc")
    assert set(contents(tmp_path / "copc")) == NAMES - {"changes.laz"} | {"changes.copc.laz"}
    points = [np.sort(laspy.read(outputs["cloud"]).points.array, order=["X", "Y", "Z"]) for outputs in (plain, copc)]
    assert points[0].tobytes() == points[1].tobytes()
    assert rebuild_report(tmp_path / "copc").is_file()


# Whole or not at all


@pytest.mark.parametrize(
    "step", ["write_cloud", "write_geopackage", "write_lod_raster", "write_transform", "write_report", "_put_in_place"]
)
@pytest.mark.parametrize("cause", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")])
def test_an_interrupted_run_leaves_nothing(
    tmp_path: Path, surveys: Pair[Survey], monkeypatch: pytest.MonkeyPatch, step: str, cause: BaseException
) -> None:
    def fail(*args: Any, **kwargs: Any) -> None:
        raise cause

    monkeypatch.setattr(outputs, step, fail)
    expected = OutputError if isinstance(cause, OSError) else KeyboardInterrupt
    with pytest.raises(expected) as caught:
        write_outputs(make_result(surveys), surveys, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    if isinstance(caught.value, OutputError):
        assert caught.value.code == "disk-full"


@pytest.mark.parametrize("last_good", [0, 3, 5])
def test_an_interruption_while_renaming_brings_the_old_result_back(
    tmp_path: Path, surveys: Pair[Survey], monkeypatch: pytest.MonkeyPatch, last_good: int
) -> None:
    folder = tmp_path / "out"
    write_outputs(make_result(surveys), surveys, folder)
    old = contents(folder)
    replace, done = Path.replace, []

    def stop_midway(self: Path, target: Path) -> Path:
        if Path(target).parent == folder and self.parent.name != "old":
            if len(done) == last_good:
                raise KeyboardInterrupt
            done.append(self.name)
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", stop_midway)
    with pytest.raises(KeyboardInterrupt):
        write_outputs(make_result(surveys, warnings=["new"]), surveys, folder, overwrite=True)
    assert contents(folder) == old


def test_run_json_comes_last_and_goes_first(
    tmp_path: Path, surveys: Pair[Survey], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out"
    write_outputs(make_result(surveys), surveys, folder)
    replace, moved = Path.replace, []

    def watch(self: Path, target: Path) -> Path:
        moved.append((self.name, "out" if self.parent == folder else "in"))
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", watch)
    write_outputs(make_result(surveys), surveys, folder, overwrite=True)
    assert moved[0] == ("run.json", "out") and moved[-1] == ("run.json", "in")


def test_staging_folders_of_dead_runs_are_removed(tmp_path: Path, surveys: Pair[Survey]) -> None:
    dead = tmp_path / "out" / ".loda-staging-dead"
    dead.mkdir(parents=True)
    (dead / "changes.laz").write_bytes(b"half of one")
    write_outputs(make_result(surveys), surveys, tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == NAMES


def test_two_runs_do_not_write_into_one_folder_at_once(tmp_path: Path, surveys: Pair[Survey]) -> None:
    folder = tmp_path / "out"
    with outputs._locked(folder):
        living = folder / ".loda-staging-living"
        living.mkdir()
        assert refused(make_result(surveys), surveys, folder).code == "output-busy"
        assert living.exists()


LIMITED = """
import resource, sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from io_samples import make_result, make_surveys
from loda_pdal.io.outputs import write_outputs
from loda_pdal.model.errors import OutputError
surveys = make_surveys(Path(sys.argv[2]))
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[4]), resource.RLIM_INFINITY))
try:
    write_outputs(make_result(surveys), surveys, sys.argv[3])
except OutputError as error:
    print(error.code)
else:
    print("written")
"""


@pytest.mark.parametrize("limit", [2_000, 50_000, 200_000])
def test_a_disk_that_takes_no_more_is_an_output_error_and_leaves_nothing(
    tmp_path: Path, surveys: Pair[Survey], limit: int
) -> None:
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] == resource.RLIM_INFINITY
    here = str(Path(__file__).parent)
    command = [sys.executable, "-c", LIMITED, here, str(tmp_path / "in"), str(tmp_path / "out"), str(limit)]
    found = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert found.stdout.strip() == "output-unwritable", found.stderr
    assert not (tmp_path / "out").exists()


ABANDONED = """
import os, sys, threading, time
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from io_samples import make_result, make_surveys
from loda_pdal.io import outputs
surveys = make_surveys(Path(sys.argv[2]))
step = threading.Event()
work = outputs.write_report
def slow(*args):
    work(*args)
    step.set()
    time.sleep(60)
outputs.write_report = slow
threading.Thread(
    target=outputs.write_outputs, args=(make_result(surveys), surveys, sys.argv[3]), kwargs={"overwrite": True}
).start()
step.wait()
outputs.abandon_outputs()
os._exit(3)
"""


@pytest.mark.parametrize("has_old", [False, True])
def test_a_process_that_ends_at_once_can_abandon_what_it_staged(
    tmp_path: Path, surveys: Pair[Survey], has_old: bool
) -> None:
    folder = tmp_path / "out"
    if has_old:
        write_outputs(make_result(surveys), surveys, folder)
    old = contents(folder) if has_old else {}
    command = [sys.executable, "-c", ABANDONED, str(Path(__file__).parent), str(tmp_path / "in"), str(folder)]
    assert subprocess.run(command, timeout=60, check=False).returncode == 3
    assert folder.exists() == has_old
    assert (contents(folder) if has_old else {}) == old


def test_without_cloud_the_cloud_of_another_program_stays(tmp_path: Path, surveys: Pair[Survey]) -> None:
    (tmp_path / "changes.laz").write_bytes(b"written by the pipeline")
    paths = write_outputs(make_result(surveys), surveys, tmp_path, overwrite=True, with_cloud=False)
    assert "cloud" not in paths and {path.name for path in paths.values()} == NAMES - {"changes.laz"}
    assert (tmp_path / "changes.laz").read_bytes() == b"written by the pipeline"


# JSON


def test_json_is_strict_and_compact_for_rows_of_numbers() -> None:
    value = {"T": np.eye(2), "none": [float("nan"), 1.0], "name": ["a", "b"], "path": Path("x"), "f": np.float32(0.5)}
    text = to_json(value)
    assert json.loads(text, parse_constant=pytest.fail) == {
        "T": [[1.0, 0.0], [0.0, 1.0]],
        "none": [None, 1.0],
        "name": ["a", "b"],
        "path": "x",
        "f": 0.5,
    }
    assert "[1.0, 0.0]" in text and text.endswith("}\n")
    assert json.loads(to_json({"s": "[\n 1,\n 2\n ]"}))["s"] == "[\n 1,\n 2\n ]"
    with pytest.raises(TypeError, match="no place in a JSON file"):
        to_plain(object())
