"""The pipelines with the real `pdal`, by themselves, and `detect_changes` in one go: one answer.

The scene is small and made here: ground, a house that is torn down, one that is built, one that stays, and a before
survey that is turned and shifted. Coordinates are those of a real city, so that precision matters.
"""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pytest
from pyproj import CRS

from loda_pdal import Parameters, detect_changes, read_epochs
from loda_pdal.model import dimensions as dims
from loda_pdal.model.errors import InputError, LodaError, PipelineError
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.records import ChangeResult
from loda_pdal.model.transform import exp_se3, invert, transform_points
from loda_pdal.pdal_face import builder, run_pipeline, stop_pdal

ENGINES = [pytest.param("pdal", marks=pytest.mark.pdal), "embedded"]

ORIGIN = np.array([120_500.0, 480_500.0, 2.0])
SIZE_M = 40.0
DENSITY = 40
HOUSES = {"stays": (4.0, 5.0, 9.0, 8.0, 6.0), "goes": (27.0, 6.0, 8.0, 9.0, 5.0), "comes": (16.0, 26.0, 10.0, 8.0, 7.0)}
"""Lower left corner, length, width and height of each house, m."""

BEFORE_FROM_AFTER = exp_se3(np.array([0.25, -0.15, 0.05, 0.0, 0.0, 0.004]))

STAGE_DIMENSIONS = {
    "lod": (dims.LOD95,),
    "segment": (dims.HEIGHT, dims.SUPERPOINT, dims.CLASSIFICATION, dims.INSTANCE),
    "change": dims.DIMENSIONS,
    "change_only": dims.DIMENSIONS,
}


def scene(houses: list[str], seed: int) -> npt.NDArray[np.float64]:
    """Points (n, 3) of one survey, m, DENSITY to the square metre of surface, with 1 cm of noise."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, SIZE_M, (int(DENSITY * SIZE_M**2), 2))
    z = 0.01 * xy[:, 0]
    parts = []
    for name in houses:
        x0, y0, length, width, height = HOUSES[name]
        is_under = (xy[:, 0] > x0) & (xy[:, 0] < x0 + length) & (xy[:, 1] > y0) & (xy[:, 1] < y0 + width)
        z = np.where(is_under, height, z)
        for x, y, dx, dy in (
            (x0, y0, length, 0),
            (x0, y0 + width, length, 0),
            (x0, y0, 0, width),
            (x0 + length, y0, 0, width),
        ):
            u, v = rng.random((2, int(DENSITY * (dx + dy) * height)))
            parts.append(np.column_stack([x + u * dx, y + u * dy, v * height]))
    points = np.concatenate([np.column_stack([xy, z]), *parts])
    return points + rng.normal(0, 0.01, points.shape)


def write_survey(path: Path, local: npt.NDArray[np.float64]) -> None:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.array([120_000.0, 480_000.0, 0.0])
    header.add_crs(CRS.from_epsg(28992))
    header.add_extra_dim(laspy.ExtraBytesParams("Own", "uint16"))
    data = laspy.LasData(header)
    data.x, data.y, data.z = (local + ORIGIN).T
    data.intensity = np.arange(len(local)) % 60_000
    data.Own = np.arange(len(local)) % 1000
    data.write(path)


@pytest.fixture(scope="module")
def surveys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with before.laz and after.laz."""
    folder = tmp_path_factory.mktemp("surveys")
    write_survey(folder / "before.laz", transform_points(BEFORE_FROM_AFTER, scene(["stays", "goes"], 1)))
    write_survey(folder / "after.laz", scene(["stays", "comes"], 2))
    return folder


@pytest.fixture(scope="module")
def detected(surveys: Path) -> ChangeResult:
    """What detect_changes finds in one go."""
    epochs = read_epochs(surveys / "before.laz", surveys / "after.laz")
    return detect_changes(epochs.before, epochs.after, Parameters.preset("street"))


@dataclass(frozen=True)
class Chain:
    """What one pipeline wrote: its points and its run folder."""

    points: laspy.LasData
    run: Path


Runner = Callable[[str, str], Chain]


@pytest.fixture(scope="module")
def run_chain(surveys: Path, pipelines_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Runner:
    """Runs one of the project's pipelines on the surveys, each with each engine once.

    `change_only` gets the run folder that `segment` left, as its users would have it.
    """
    done: dict[tuple[str, str], Chain] = {}

    def run(name: str, engine: str) -> Chain:
        if (name, engine) not in done:
            folder = tmp_path_factory.mktemp(f"{name}_{engine}")
            run_folder = run("segment", engine).run if name == "change_only" else folder / "run"
            overrides = {
                "stage.before.filename": str(surveys / "before.laz"),
                "stage.after.filename": str(surveys / "after.laz"),
                "stage.output.filename": str(folder / "out.laz"),
                "filters.python.pdalargs": json.dumps({"run": str(run_folder), "preset": "street"}),
            }
            made = run_pipeline(pipelines_dir / f"{name}.json", overrides, engine=engine)
            assert made.engine == engine
            assert made.outputs == [folder / "out.laz"]
            assert {path.name for path in folder.iterdir()} <= {"out.laz", "run"}
            done[name, engine] = Chain(laspy.read(folder / "out.laz"), run_folder)
        return done[name, engine]

    return run


def expected(result: ChangeResult, dimension: dims.Dimension) -> npt.NDArray[Any]:
    """Values of all points, before first, as detect_changes has them."""
    field = {
        dims.CLASSIFICATION: "classification",
        dims.HEIGHT: "height",
        dims.LOD95: "lod95",
        dims.SUPERPOINT: "superpoint",
        dims.INSTANCE: "instance",
        dims.OBJECT: "object",
        dims.CHANGE: "change",
        dims.CONFIDENCE: "confidence",
    }
    if dimension is dims.EPOCH:
        return np.repeat([0, 1], [len(side.change) for side in result.points])
    return np.concatenate([getattr(side, field[dimension]) for side in result.points])


def test_the_scene_has_one_house_added_one_removed_one_unchanged(detected: ChangeResult) -> None:
    big = {o.label for o in detected.objects if o.object_class.title == "building"}
    assert big == {ChangeLabel.ADDED, ChangeLabel.REMOVED, ChangeLabel.UNCHANGED}
    T = detected.registration.T_after_before
    centre = np.array([[SIZE_M / 2, SIZE_M / 2, 2.0]])
    assert np.abs(transform_points(T @ _local(BEFORE_FROM_AFTER), centre + _shift()) - centre - _shift()).max() < 0.02


def _shift() -> npt.NDArray[np.float64]:
    """Where the scene's own origin lies in local coordinates."""
    return ORIGIN - np.array([120_000.0, 480_000.0, 0.0])


def _local(T: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """A move of scene coordinates as a move of local coordinates."""
    into = np.eye(4)
    into[:3, 3] = _shift()
    return into @ T @ invert(into)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("chain", STAGE_DIMENSIONS)
def test_stage_by_stage_equals_detect(chain: str, engine: str, run_chain: Runner, detected: ChangeResult) -> None:
    points = run_chain(chain, engine).points
    for dimension in STAGE_DIMENSIONS[chain]:
        values = np.asarray(points[dimension.name if dimension is not dims.CLASSIFICATION else "classification"])
        if dimension is not dims.CLASSIFICATION:
            assert values.dtype == dimension.dtype, dimension.name
        assert np.array_equal(values, expected(detected, dimension), equal_nan=values.dtype.kind == "f"), dimension.name


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("chain", ["register", "lod", "change"])
def test_before_points_arrive_in_the_after_frame(
    chain: str, engine: str, run_chain: Runner, surveys: Path, detected: ChangeResult
) -> None:
    points = run_chain(chain, engine).points
    epochs = read_epochs(surveys / "before.laz", surveys / "after.laz")
    moved = transform_points(detected.registration.T_after_before, epochs.before.xyz)
    whole = np.concatenate([epochs.before.frame.to_map(moved), epochs.after.frame.to_map(epochs.after.xyz)])
    assert np.abs(points.xyz - whole).max() < 0.00051


@pytest.mark.parametrize("engine", ENGINES)
def test_segmenting_leaves_the_points_where_they_are(engine: str, run_chain: Runner, surveys: Path) -> None:
    own = np.concatenate([laspy.read(surveys / f"{name}.laz").xyz for name in ("before", "after")])
    assert np.abs(run_chain("segment", engine).points.xyz - own).max() < 0.00051


@pytest.mark.parametrize("engine", ENGINES)
def test_every_point_keeps_its_place_and_its_own_dimensions(engine: str, run_chain: Runner, surveys: Path) -> None:
    before, after = (laspy.read(surveys / f"{name}.laz") for name in ("before", "after"))
    points = run_chain("change", engine).points
    assert points.header.parse_crs().to_epsg() == 28992
    for name in ("intensity", "Own", "gps_time"):
        assert np.array_equal(points[name], np.concatenate([before[name], after[name]])), name


@pytest.mark.pdal
def test_pdal_and_embedded_write_the_same_points(run_chain: Runner) -> None:
    with_pdal, embedded = (run_chain("change", engine).points for engine in ("pdal", "embedded"))
    assert np.abs(with_pdal.xyz - embedded.xyz).max() < 1e-9
    for name in embedded.point_format.dimension_names:
        if name not in "XYZ":
            a, b = np.asarray(with_pdal[name]), np.asarray(embedded[name])
            assert np.array_equal(a, b, equal_nan=a.dtype.kind == "f"), name


def small_pipeline(surveys: Path, folder: Path, stages: list[dict[str, Any]], output: str = "out.las") -> Path:
    """A pipeline of our own stages, between the merge and the writer."""
    document = builder.pipeline(
        [], before=str(surveys / "before.laz"), after=str(surveys / "after.laz"), output=str(folder / output)
    )
    document["pipeline"][-1:-1] = stages
    (folder / "own.json").write_text(builder.to_json(document))
    return folder / "own.json"


@pytest.mark.parametrize("engine", ENGINES)
def test_any_order_and_the_folder_of_an_earlier_chain(
    engine: str, surveys: Path, tmp_path: Path, detected: ChangeResult
) -> None:
    """lod before ground, what is missing made on the way, and a second pipeline that finds it all done."""
    arguments = {"run": str(tmp_path / "run"), "preset": "street"}
    path = small_pipeline(surveys, tmp_path, [builder.python_stage(name, arguments) for name in ("lod", "ground")])
    run_pipeline(path, engine=engine)
    points = laspy.read(tmp_path / "out.las")
    for dimension in (dims.LOD95, dims.HEIGHT):
        assert np.array_equal(points[dimension.name], expected(detected, dimension), equal_nan=True)
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert set(manifest["stages"]) == {"parameters", "fuse", "register", "ground", "lod"}
    stamps = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "run").glob("*.npz")}
    run_pipeline(path, engine=engine)
    assert {p.name: p.stat().st_mtime_ns for p in (tmp_path / "run").glob("*.npz")} == stamps


def test_results_of_other_points_or_parameters_are_not_used(surveys: Path, tmp_path: Path) -> None:
    def run(arguments: dict[str, Any], before: str = "before.laz") -> tuple[str, npt.NDArray[Any]]:
        own = {"run": str(tmp_path / "run"), **arguments}
        path = small_pipeline(surveys, tmp_path, [builder.python_stage("lod", own)])
        overrides = {"stage.before.filename": str(surveys / before)}
        run_pipeline(path, overrides, engine="embedded")
        key = json.loads((tmp_path / "run" / "manifest.json").read_text())["key"]
        return key, np.asarray(laspy.read(tmp_path / "out.las")["LoD95"])

    key, limits = run({})
    other_key, other_limits = run({"set": {"lod.low_observability_m": 0.7}})
    assert other_key != key
    assert np.nanmax(other_limits) == np.float32(0.7) > np.nanmax(limits)
    key_of_same, same_limits = run({})
    assert key_of_same == key
    assert np.array_equal(same_limits, limits, equal_nan=True)
    key_of_after, limits_of_after = run({}, before="after.laz")
    assert key_of_after != key
    assert len(limits_of_after) != len(limits)


def test_without_a_run_folder_nothing_is_kept(surveys: Path, tmp_path: Path, detected: ChangeResult) -> None:
    path = small_pipeline(surveys, tmp_path, [builder.python_stage("lod", {"preset": "street"})])
    run_pipeline(path, engine="embedded")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.las", "own.json"]
    points = laspy.read(tmp_path / "out.las")
    assert np.array_equal(points["LoD95"], expected(detected, dims.LOD95), equal_nan=True)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_missing_dimension_is_named_and_nothing_is_written(engine: str, surveys: Path, tmp_path: Path) -> None:
    stage = builder.python_stage("lod")
    del stage["add_dimension"]
    (tmp_path / "out.las").write_text("old")
    with pytest.raises(PipelineError, match=r'LoD95.*"add_dimension": "LoD95=float"'):
        run_pipeline(small_pipeline(surveys, tmp_path, [stage]), engine=engine)
    assert (tmp_path / "out.las").read_text() == "old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.las", "own.json"]


@pytest.mark.parametrize("engine", ENGINES)
def test_epochs_that_were_not_merged_are_an_error_that_says_so(engine: str, surveys: Path, tmp_path: Path) -> None:
    document = builder.pipeline(["lod"], before=str(surveys / "before.laz"), after=str(surveys / "after.laz"))
    stages = [s for s in document["pipeline"] if s["type"] != "filters.merge"]
    for stage in stages:
        stage["inputs"] = ["epoch_before", "epoch_after"] if stage.get("tag") == "lod" else stage.get("inputs", [])
    stages = [{key: value for key, value in s.items() if value != []} for s in stages]
    stages[-1]["filename"] = str(tmp_path / "out.las")
    (tmp_path / "p.json").write_text(json.dumps(stages))
    with pytest.raises(PipelineError, match=r"both epochs in one view.*filters\.merge"):
        run_pipeline(tmp_path / "p.json", {"stage.lod.pdalargs": "{}"}, engine=engine)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_missing_crs_is_asked_for_in_pdals_words(engine: str, surveys: Path, tmp_path: Path) -> None:
    data = laspy.read(surveys / "before.laz")
    data.header.vlrs = [v for v in data.header.vlrs if v.record_id != 2112]
    data.write(tmp_path / "plain.laz")
    path = small_pipeline(surveys, tmp_path, [builder.python_stage("register", {"run": str(tmp_path / "run")})])
    plain = {f"stage.{name}.filename": str(tmp_path / "plain.laz") for name in ("before", "after")}
    with pytest.raises(InputError, match=r'"epsg": N.*pdalargs'):
        run_pipeline(path, plain, engine=engine)
    fixed = json.dumps({"run": str(tmp_path / "run"), "epsg": 28992})
    run_pipeline(path, {**plain, "stage.register.pdalargs": fixed}, engine=engine)


@pytest.mark.parametrize("engine", ENGINES)
def test_surveys_in_different_systems_are_refused(engine: str, surveys: Path, tmp_path: Path) -> None:
    """Also by PDAL, which itself would merge them: the stages `before` and `after` note the CRS of their own survey."""
    data = laspy.read(surveys / "before.laz")
    data.header.vlrs = [v for v in data.header.vlrs if v.record_id != 2112]
    data.header.add_crs(CRS.from_epsg(32631))
    data.write(tmp_path / "other.laz")
    path = small_pipeline(surveys, tmp_path, [builder.python_stage("register")])
    with pytest.raises(InputError, match=r"UTM zone 31N.*Amersfoort.*assume_same_crs"):
        run_pipeline(path, {"stage.before.filename": str(tmp_path / "other.laz")}, engine=engine)


def test_surveys_of_different_places_are_refused(surveys: Path, tmp_path: Path) -> None:
    data = laspy.read(surveys / "before.laz")
    data.x = np.asarray(data.x) + 500
    data.write(tmp_path / "elsewhere.laz")
    path = small_pipeline(surveys, tmp_path, [builder.python_stage("register")])
    with pytest.raises(InputError, match="do not overlap enough"):
        run_pipeline(path, {"stage.before.filename": str(tmp_path / "elsewhere.laz")}, engine="embedded")


@pytest.mark.pdal
def test_an_exception_inside_a_stage_ends_pdal_with_its_message(
    pdal_program: Path, surveys: Path, tmp_path: Path
) -> None:
    stage = builder.python_stage("lod", {"preset": "boat"})
    path = small_pipeline(surveys, tmp_path, [stage])
    done = subprocess.run([pdal_program, "pipeline", path], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "ParameterError: There is no preset 'boat'." in done.stderr + done.stdout
    assert not (tmp_path / "out.las").exists()
    with pytest.raises(LodaError, match="There is no preset 'boat'"):
        run_pipeline(path, engine="pdal")


@pytest.mark.pdal
def test_the_command_of_the_documentation_works_as_it_stands(
    pdal_program: Path, surveys: Path, pipelines_dir: Path, tmp_path: Path, detected: ChangeResult
) -> None:
    """`pdal pipeline` itself, with filenames given by --stage.TAG.filename and the run folder of the file."""
    command = [
        str(pdal_program),
        "pipeline",
        str(pipelines_dir / "register.json"),
        f"--stage.before.filename={surveys / 'before.laz'}",
        f"--stage.after.filename={surveys / 'after.laz'}",
        "--writers.las.filename=out.laz",
    ]
    subprocess.run(command, cwd=tmp_path, check=True)
    assert (tmp_path / "loda_run" / "register.npz").is_file()
    assert (tmp_path / "loda_run" / "transform.json").is_file()
    n_points = sum(len(side.change) for side in detected.points)
    assert len(laspy.read(tmp_path / "out.laz").points) == n_points


@pytest.mark.pdal
def test_validating_with_pdal_computes_nothing(surveys: Path, tmp_path: Path) -> None:
    path = small_pipeline(surveys, tmp_path, [builder.python_stage("lod", {"run": str(tmp_path / "run")})])
    assert run_pipeline(path, engine="pdal", validate=True).is_validated_only
    assert sorted(p.name for p in tmp_path.iterdir()) == ["own.json"]
    with pytest.raises(PipelineError, match="PDAL failed"):
        run_pipeline(path, {"stage.before.filename": "nowhere.laz"}, engine="pdal")


@pytest.mark.pdal
def test_stopping_ends_the_program_and_leaves_nothing(surveys: Path, tmp_path: Path) -> None:
    path = small_pipeline(surveys, tmp_path, [builder.python_stage("lod")])
    timer = threading.Timer(0.8, stop_pdal)
    start = time.perf_counter()
    timer.start()
    with pytest.raises(PipelineError):
        run_pipeline(path, engine="pdal")
    timer.join()
    assert time.perf_counter() - start < 3
    assert sorted(p.name for p in tmp_path.iterdir()) == ["own.json"]


def test_ctrl_c_in_the_embedded_runner_leaves_nothing(surveys: Path, tmp_path: Path) -> None:
    path = small_pipeline(surveys, tmp_path, [builder.python_stage("lod")])
    code = f"from loda_pdal.pdal_face import run_pipeline; run_pipeline({str(path)!r}, engine='embedded')"
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL)
    time.sleep(1.0)
    os.kill(process.pid, signal.SIGINT)
    assert process.wait(timeout=20) != 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["own.json"]


@pytest.mark.parametrize("engine", ENGINES)
def test_the_run_folder_of_change_holds_what_qgis_opens(engine: str, run_chain: Runner, detected: ChangeResult) -> None:
    run = run_chain("change", engine).run
    names = {path.name for path in run.iterdir()}
    assert names >= {"changes.gpkg", "lod95.tif", "transform.json", "report.html", "run.json", "manifest.json"}
    assert not names & {"changes.laz", "changes.las"}
    labels = [row[0] for row in _rows(run / "changes.gpkg", "SELECT label_code FROM objects ORDER BY object_id")]
    assert labels == [int(o.label) for o in detected.objects]


def _rows(geopackage: Path, query: str) -> list[Any]:
    with closing(sqlite3.connect(geopackage)) as database:
        return database.execute(query).fetchall()
