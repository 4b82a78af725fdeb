"""Every algorithm through `qgis_process`, as a script or a server would call it, and through Processing itself."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from qgis.core import QgsPointCloudLayer, QgsProcessingAlgorithm, QgsProcessingException, QgsRasterLayer, QgsVectorLayer

from conftest import PLUGINS, Listening

ALGORITHMS = {
    "detectchanges",
    "registerclouds",
    "detectionlimit",
    "segmentobjects",
    "comparesegmented",
    "changereport",
    "checkinputs",
}


def test_the_provider_offers_all_algorithms(qgis_process):
    offered = json.loads(qgis_process.call("list", "--json"))["providers"]["loda"]
    assert set(offered["algorithms"]) == {f"loda:{name}" for name in ALGORITHMS}


def test_every_algorithm_is_explained(application):
    for algorithm in application.processingRegistry().providerById("loda").algorithms():
        assert algorithm.shortHelpString() and algorithm.shortDescription() and len(algorithm.tags()) > 6
        assert not algorithm.icon().isNull() and Path(algorithm.svgIconPath()).is_file()
        assert algorithm.flags() & QgsProcessingAlgorithm.Flag.FlagSupportsBatch
        assert not algorithm.flags() & QgsProcessingAlgorithm.Flag.FlagHideFromModeler
        for parameter in algorithm.parameterDefinitions():
            assert parameter.help() and parameter.description(), (algorithm.id(), parameter.name())


def test_advanced_parameters_are_those_of_the_engine(application, engine_program):
    told = json.loads(subprocess.check_output([engine_program, "params", "--json"]))
    keys = {f"{stage['name']}_{p['name']}".upper() for stage in told["stages"] for p in stage["parameters"]}
    detect = application.processingRegistry().algorithmById("loda:detectchanges")
    assert keys <= {parameter.name() for parameter in detect.parameterDefinitions()}
    assert "r_LoD" in detect.parameterDefinition("LOD_RADIUS_M").help()
    assert "aerial 2.0" in detect.parameterDefinition("LOD_RADIUS_M").help()
    lod = application.processingRegistry().algorithmById("loda:detectionlimit")
    assert lod.parameterDefinition("LOD_CELL_M") and not lod.parameterDefinition("INSTANCES_MOBILE_EPS_M")


def test_detect_changes(detected):
    folder = Path(detected["OUTPUT"])
    names = {"changes.gpkg", "changes.copc.laz", "lod95.tif", "transform.json", "report.html", "run.json"}
    assert {path.name for path in folder.iterdir()} == names
    assert detected["OBJECTS"] > detected["CHANGED"] > 5
    assert QgsVectorLayer(detected["CHANGES"]).featureCount() == detected["CHANGED"] + detected["UNDETERMINED"]
    assert QgsRasterLayer(detected["LOD95"]).isValid()
    cloud = QgsPointCloudLayer(detected["CLOUD"], "cloud", "copc")
    assert cloud.isValid() and cloud.attributes().indexOf("ChangeClass") >= 0
    run = json.loads((folder / "run.json").read_text())
    points = [run["inputs"][epoch]["points"] for epoch in ("before", "after")]
    assert cloud.pointCount() == sum(points)
    assert Path(detected["REPORT"]).is_file() and Path(detected["TRANSFORM"]).is_file()


def test_register_two_clouds(qgis_process, surveys, tmp_path):
    before, after = surveys / "before.laz", surveys / "after.laz"
    found = qgis_process("registerclouds", BEFORE=before, AFTER=after, OUTPUT=tmp_path / "out", ICP_TUKEY_M=0.25)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"registered.copc.laz", "transform.json"}
    assert json.loads(Path(found["TRANSFORM"]).read_text())["from"] == "before"
    assert QgsPointCloudLayer(found["CLOUD"], "cloud", "copc").attributes().indexOf("Epoch") >= 0


def test_detection_limit(qgis_process, surveys, tmp_path):
    before, after = surveys / "before.laz", surveys / "after.laz"
    found = qgis_process("detectionlimit", BEFORE=before, AFTER=after, OUTPUT=tmp_path / "out", PRESET="street")
    raster = QgsRasterLayer(found["LOD95"])
    assert raster.isValid() and 0.0 < raster.dataProvider().bandStatistics(1).minimumValue < 0.1
    assert QgsPointCloudLayer(found["CLOUD"], "cloud", "copc").attributes().indexOf("LoD95") >= 0


def test_segment_then_compare_gives_what_detect_gives(qgis_process, surveys, detected, tmp_path):
    inputs = {"BEFORE": surveys / "before.laz", "AFTER": surveys / "after.laz"}
    segmented = qgis_process("segmentobjects", OUTPUT=tmp_path / "out", **inputs)
    assert QgsPointCloudLayer(segmented["CLOUD"], "cloud", "copc").attributes().indexOf("InstanceId") >= 0
    steps = {path.name: path.stat().st_mtime_ns for path in Path(segmented["OUTPUT"]).glob("*.npz")}
    assert "instances.npz" in steps
    compared = qgis_process("comparesegmented", SEGMENTED=segmented["OUTPUT"], **inputs)
    assert {name: (tmp_path / "out" / name).stat().st_mtime_ns for name in steps} == steps  # nothing was made again
    changes, expected = (
        sorted(f["reason"] for f in QgsVectorLayer(r["CHANGES"]).getFeatures()) for r in (compared, detected)
    )
    assert changes == expected
    assert Path(compared["REPORT"]).is_file() and QgsRasterLayer(compared["LOD95"]).isValid()


def test_change_report(qgis_process, detected):
    report = Path(detected["REPORT"])
    report.unlink()
    assert Path(qgis_process("changereport", FOLDER=detected["OUTPUT"])["REPORT"]) == report and report.is_file()


def test_check_inputs(qgis_process, surveys):
    both = qgis_process("checkinputs", BEFORE=surveys / "before.laz", AFTER=surveys / "after.laz")
    assert both["COMPARABLE"] is True and both["OVERLAP"] > 0.9 and not both["PROBLEM"]
    assert both["POINTS_BEFORE"] > 100_000 and both["POINTS_AFTER"] > 100_000
    one = qgis_process("checkinputs", BEFORE=surveys / "before.laz")
    assert one["POINTS_BEFORE"] == both["POINTS_BEFORE"]


def test_the_words_of_the_engine_reach_the_user(run, surveys, tmp_path):
    (tmp_path / "run.json").write_text("{}")
    inputs = {"BEFORE": surveys / "before.laz", "AFTER": surveys / "after.laz"}
    with pytest.raises(QgsProcessingException, match=r"holds run\.json already"):
        run("detectchanges", {**inputs, "OUTPUT": tmp_path})
    with pytest.raises(QgsProcessingException, match="cells_m = 4000"):
        run("detectchanges", {**inputs, "OUTPUT": tmp_path / "new", "NDT_CELLS_M": "8, 4000"})
    assert not (tmp_path / "new").exists()


def test_nothing_of_a_cancelled_run_is_left(run, surveys, tmp_path):
    cancelled_at = []

    def cancel(feedback, percent):
        if percent > 10 and not cancelled_at:
            cancelled_at.append(time.monotonic())
            feedback.cancel()

    inputs = {"BEFORE": surveys / "before.laz", "AFTER": surveys / "after.laz"}
    for algorithm in ("detectchanges", "segmentobjects"):
        cancelled_at.clear()
        with pytest.raises(QgsProcessingException, match="Stopped"):
            run(algorithm, {**inputs, "OUTPUT": tmp_path / "out"}, Listening(cancel))
        assert time.monotonic() - cancelled_at[0] < 2.0
        assert list(tmp_path.iterdir()) == []
        assert str(tmp_path) not in subprocess.check_output(["ps", "-eo", "args"], encoding="utf-8")


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("kill -SEGV $$", "crashed"),
        ("trap '' TERM; sleep 60", "Stopped"),
        ("echo no such thing >&2; exit 3", "no such thing"),
    ],
    ids=["segfault", "hang", "failure"],
)
def test_engines_that_die_or_hang(run, surveys, tmp_path, monkeypatch, body, words):
    engine = tmp_path / "bin" / "loda-pdal"
    engine.parent.mkdir()
    start = """echo '{"event": "progress", "stage": "starting", "done": 1, "total": 4}'"""
    engine.write_text(f'#!/bin/sh\n[ "$1" = --version ] && echo "loda-pdal 0.1.0" && exit\n{start}\n{body}\n')
    engine.chmod(0o755)
    monkeypatch.setenv("PATH", f"{engine.parent}{os.pathsep}{os.environ['PATH']}")
    feedback = Listening(lambda feedback, percent: feedback.cancel() if "TERM" in body and percent > 20 else None)
    began = time.monotonic()
    with pytest.raises(QgsProcessingException, match=words):
        run(
            "registerclouds",
            {"BEFORE": surveys / "before.laz", "AFTER": surveys / "after.laz", "OUTPUT": tmp_path / "o"},
            feedback,
        )
    assert time.monotonic() - began < 8.0 and not (tmp_path / "o").exists()
    assert feedback.stages == ["Starting"]


def test_a_missing_engine_is_told_with_the_way_to_install_it(run, surveys, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(QgsProcessingException, match="press Install"):
        run("checkinputs", {"BEFORE": surveys / "before.laz"})


def test_the_plugin_brings_no_package_into_the_python_of_qgis():
    """All that loading it imports is the plugin itself, QGIS, Qt and the standard library."""
    code = (
        "import sys; before = set(sys.modules); import qgis.core, qgis.gui, qgis.PyQt.QtSvg;"
        "known = set(sys.modules) - before; known_roots = {m.split('.')[0] for m in known | before};"
        "import loda_change.plugin; roots = {m.split('.')[0] for m in sys.modules};"
        "print(*sorted(roots - known_roots - set(sys.stdlib_module_names)))"
    )
    environment = {**os.environ, "PYTHONPATH": str(PLUGINS), "PYTHONDONTWRITEBYTECODE": "1"}
    found = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, encoding="utf-8")
    assert found.stdout.split() == ["loda_change"], found.stderr
