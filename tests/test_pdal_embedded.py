"""The embedded runner: what it does is what PDAL does, and what it does not know it refuses before any work."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from pyproj import CRS

from loda_pdal.model.errors import LodaError, PipelineError
from loda_pdal.pdal_face import builder, run_pipeline
from loda_pdal.pdal_face.table import merge_tables, read_table, write_table

N = 500


def make_survey(path: Path, seed: int, point_format: int = 6, scale: float = 0.001) -> laspy.LasData:
    """A file whose every standard field and one extra dimension hold random values."""
    rng = np.random.default_rng(seed)
    header = laspy.LasHeader(point_format=point_format, version="1.4" if point_format >= 6 else "1.2")
    header.scales, header.offsets = np.full(3, scale), np.array([120_000.0, 480_000.0, 0.0])
    header.add_crs(CRS.from_epsg(28992))
    header.add_extra_dim(laspy.ExtraBytesParams("Own", "uint16"))
    data = laspy.LasData(header)
    data.points = laspy.ScaleAwarePointRecord.zeros(N, header=header)
    for axis, low in (("X", 500_000), ("Y", 600_000), ("Z", -3000)):
        data[axis] = rng.integers(low, low + 40_000, N)
    small = {"classification": 32, "return_number": 8, "number_of_returns": 8, "scanner_channel": 4}
    for name in data.point_format.dimension_names:
        if name in ("X", "Y", "Z"):
            continue
        if name == "gps_time":
            data[name] = rng.random(N) * 1e8
        elif name in ("scan_angle", "scan_angle_rank"):
            data[name] = rng.integers(-90, 90, N)
        else:
            bits = data.point_format.dimension_by_name(name).num_bits
            data[name] = rng.integers(0, small.get(name, 2 ** min(bits, 16)), N)
    data.write(path)
    return data


def copy_pipeline(folder: Path, **writer: Any) -> Path:
    """Reader to writer, with nothing in between."""
    output = {"type": "writers.las", "filename": str(folder / "out.las"), "extra_dims": "all", **writer}
    path = folder / "copy.json"
    path.write_text(json.dumps([str(folder / "in.las"), output]))
    return path


def test_a_copc_name_gives_copc(tmp_path: Path) -> None:
    before = make_survey(tmp_path / "in.las", 1)
    run_pipeline(copy_pipeline(tmp_path, filename=str(tmp_path / "out.copc.laz"), scale_x=0.001), engine="embedded")
    with laspy.CopcReader.open(tmp_path / "out.copc.laz") as reader:
        assert sorted(reader.query()["Own"]) == sorted(before["Own"])
    assert {path.name for path in tmp_path.iterdir()} == {"in.las", "copy.json", "out.copc.laz"}


def test_our_own_pipelines_go_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make_survey(tmp_path / "before.laz", 1)
    make_survey(tmp_path / "after.laz", 2)
    done = run_pipeline("register", {"stage.output.filename": "moved.las"}, engine="embedded", validate=True)
    assert done.outputs == [Path("moved.las")]
    (tmp_path / "register").write_text("[]")
    with pytest.raises(PipelineError, match="no list of stages"):  # a file of that name goes first
        run_pipeline("register", engine="embedded", validate=True)


@pytest.mark.parametrize("point_format", [0, 1, 3, 6, 7, 8])
def test_every_field_survives_reading_and_writing(point_format: int, tmp_path: Path) -> None:
    before = make_survey(tmp_path / "in.las", 1, point_format)
    minor = 4 if point_format >= 6 else 2
    options = {"dataformat_id": point_format, "minor_version": minor}
    scaling = {f"scale_{a}": 0.001 for a in "xyz"} | {"offset_x": 120_000, "offset_y": 480_000, "offset_z": 0}
    run = run_pipeline(copy_pipeline(tmp_path, **options, **scaling), engine="embedded")
    assert run.outputs == [tmp_path / "out.las"]
    after = laspy.read(tmp_path / "out.las")
    assert after.header.parse_crs().to_epsg() == 28992
    assert list(after.point_format.dimension_names) == list(before.point_format.dimension_names)
    for name in before.point_format.dimension_names:
        assert np.array_equal(after[name], before[name]), name


def test_coordinates_keep_their_precision_with_automatic_offsets(tmp_path: Path) -> None:
    before = make_survey(tmp_path / "in.las", 1, scale=0.0001)
    scaling = {f"scale_{a}": "0.0001" for a in "xyz"} | {f"offset_{a}": "auto" for a in "xyz"}
    run_pipeline(copy_pipeline(tmp_path, **scaling), engine="embedded")
    after = laspy.read(tmp_path / "out.las")
    assert np.allclose(after.xyz, before.xyz, rtol=0, atol=0.00005 + 1e-9)


def test_merging_keeps_the_order_and_gives_zero_where_a_dimension_is_missing(tmp_path: Path) -> None:
    make_survey(tmp_path / "a.las", 1, 6)
    make_survey(tmp_path / "b.las", 2, 7)
    a, b = read_table(tmp_path / "a.las"), read_table(tmp_path / "b.las")
    merged = merge_tables([a, b])
    assert np.array_equal(merged.columns["X"], np.concatenate([a.columns["X"], b.columns["X"]]))
    assert not merged.columns["Red"][:N].any()
    assert np.array_equal(merged.columns["Red"][N:], b.columns["Red"])
    assert merged.columns["Red"].dtype == np.uint16


def test_coordinates_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    make_survey(tmp_path / "in.las", 1)
    with pytest.raises(PipelineError, match="does not fit"):
        run_pipeline(copy_pipeline(tmp_path, scale_x=1e-7), engine="embedded")
    assert not list(tmp_path.glob("*out*"))


def test_ferry_and_assign_make_dimensions(tmp_path: Path) -> None:
    before = make_survey(tmp_path / "in.las", 1)
    stages = [
        str(tmp_path / "in.las"),
        {"type": "filters.ferry", "dimensions": "UserData=>Kept, =>Epoch"},
        {"type": "filters.assign", "value": ["Epoch = 1", "UserData=7"]},
        {"type": "filters.assign", "assignment": "PointSourceId[:]=2"},
        {"type": "writers.las", "filename": str(tmp_path / "out.las"), "extra_dims": "all", "scale_x": 0.001},
    ]
    (tmp_path / "p.json").write_text(json.dumps(stages))
    run_pipeline(tmp_path / "p.json", engine="embedded")
    after = laspy.read(tmp_path / "out.las")
    assert np.array_equal(after.Kept, before.user_data)
    assert after.Epoch.dtype == np.float64
    assert set(after.Epoch) == {1}
    assert set(after.user_data) == {7}
    assert set(after.point_source_id) == {2}


OWN_CODE = {"type": "filters.python", "module": "m", "function": "run"}


@pytest.mark.parametrize(
    ("stage", "message"),
    [
        ({"type": "filters.outlier"}, "does not know filters.outlier"),
        ({"type": "filters.merge", "tolerance": 1}, "option 'tolerance'"),
        ({"type": "filters.assign", "value": "Z = Z * 2"}, "assigns numbers only"),
        ({"type": "filters.ferry", "dimensions": "X"}, "is not A=>B"),
        ({**OWN_CODE, "source": "def run(ins, outs): return True"}, "entries of loda_pdal only"),
        ({**OWN_CODE, "script": "x.py"}, "option 'script'"),
        (
            {**OWN_CODE, "source": "import loda_pdal.pdal_face.entry as e; run = e.bind('lod', globals()); import os"},
            "entries of loda_pdal only",
        ),
        (
            {**OWN_CODE, "source": "import loda_pdal.pdal_face.entry as e; run = e.bind(open('x'), globals())"},
            "entries of loda_pdal only",
        ),
        (
            {**OWN_CODE, "source": "import loda_pdal.pdal_face.entry as e; go = e.bind('lod', globals())"},
            "entries of loda_pdal only",
        ),
        (builder.python_stage("lod") | {"add_dimension": "LoD95=half"}, "is not NAME=TYPE"),
        (builder.python_stage("lod") | {"pdalargs": {"rum": "x"}}, "unknown name 'rum'"),
        (builder.python_stage("lod") | {"module": ""}, "no module"),
        ({"type": "writers.las", "filename": "x.e57"}, "is not a .las or .laz file"),
        ({"type": "writers.las", "filename": "nowhere/x.laz"}, "no folder"),
        ({"type": "writers.las", "filename": "x.laz", "scale_x": "fine"}, "not a number"),
        ({"type": "writers.las", "filename": "x.laz", "extra_dims": "Own=uint8"}, "all extra dimensions or none"),
        ({"type": "writers.las"}, "has no filename"),
    ],
)
def test_what_it_does_not_know_is_refused_before_any_work(stage: dict[str, Any], message: str, tmp_path: Path) -> None:
    make_survey(tmp_path / "in.las", 1)
    output = {"type": "writers.las", "filename": str(tmp_path / "out.las")}
    (tmp_path / "p.json").write_text(json.dumps([str(tmp_path / "in.las"), stage, output]))
    for validate in (True, False):
        with pytest.raises(LodaError, match=message):
            run_pipeline(tmp_path / "p.json", engine="embedded", validate=validate)
    assert not (tmp_path / "out.las").exists()


def test_a_missing_file_and_a_missing_writer_are_refused(tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match="does not exist"):
        run_pipeline(copy_pipeline(tmp_path), engine="embedded", validate=True)
    make_survey(tmp_path / "in.las", 1)
    (tmp_path / "p.json").write_text(json.dumps([str(tmp_path / "in.las"), {"type": "filters.merge"}]))
    with pytest.raises(PipelineError, match="no writer"):
        run_pipeline(tmp_path / "p.json", engine="embedded", validate=True)


def test_validating_writes_nothing(tmp_path: Path) -> None:
    make_survey(tmp_path / "in.las", 1)
    run = run_pipeline(copy_pipeline(tmp_path), engine="embedded", validate=True)
    assert run.is_validated_only
    assert not (tmp_path / "out.las").exists()


def test_an_interrupted_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_survey(tmp_path / "in.las", 1)
    (tmp_path / "out.las").write_text("old")

    def fail(*args: Any, **kwargs: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(laspy.LasData, "write", fail)
    with pytest.raises(LodaError, match="No space left"):
        run_pipeline(copy_pipeline(tmp_path), engine="embedded")
    assert (tmp_path / "out.las").read_text() == "old"
    assert not list(tmp_path.glob(".*"))


def test_an_empty_table_can_be_written(tmp_path: Path) -> None:
    make_survey(tmp_path / "in.las", 1)
    table = read_table(tmp_path / "in.las")
    empty = type(table)({name: column[:0] for name, column in table.columns.items()}, table.crs_wkt)
    write_table(
        empty,
        tmp_path / "out.las",
        point_format=6,
        minor_version=4,
        scale=(0.01, 0.01, 0.01),
        offset=(None, None, None),
        with_extra=True,
    )
    assert len(laspy.read(tmp_path / "out.las").points) == 0


def test_an_unknown_engine_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match="no engine 'fast'"):
        run_pipeline(tmp_path / "p.json", engine="fast")
