"""The run folder keeps one run's results and never hands out another's."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
import pytest

from loda_pdal.io.run_folder import RunFolder
from loda_pdal.model.errors import OutputError


def test_results_are_read_back_by_stage_name(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run", "key", {"points_before": 3})
    folder.save("register", np.arange(3), 0.5)
    folder.save("proxies", None, 0.1)
    again = RunFolder(tmp_path / "run", "key", {"points_before": 3})
    assert again.stages == ["register", "proxies"]
    assert again.load("register").tolist() == [0, 1, 2]
    assert again.load("proxies") is None
    with pytest.raises(KeyError):
        again.load("lod")
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert manifest["points_before"] == 3
    assert manifest["stages"]["register"] == {"file": "register.npz", "seconds": 0.5}


def test_another_run_begins_anew_and_leaves_other_files_alone(tmp_path: Path) -> None:
    RunFolder(tmp_path, "first", {}).save("register", 1, 0.0)
    (tmp_path / "notes.txt").write_text("mine")
    other = RunFolder(tmp_path, "second", {})
    assert other.stages == []
    assert sorted(p.name for p in tmp_path.iterdir()) == ["manifest.json", "notes.txt"]


def test_a_damaged_result_counts_as_missing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = RunFolder(tmp_path, "key", {})
    folder.save("register", np.arange(1000), 0.0)
    whole = (tmp_path / "register.npz").read_bytes()
    for damaged in (b"", b"nonsense", whole[: len(whole) // 2]):
        (tmp_path / "register.npz").write_bytes(damaged)
        with caplog.at_level(logging.WARNING), pytest.raises(KeyError):
            folder.load("register")
    assert "will be made again" in caplog.text


def test_what_a_killed_run_left_unfinished_is_removed(tmp_path: Path) -> None:
    RunFolder(tmp_path, "key", {}).save("register", 1, 0.0)
    (tmp_path / ".lod.npz.part").write_bytes(b"half")
    assert RunFolder(tmp_path, "key", {}).stages == ["register"]
    assert not (tmp_path / ".lod.npz.part").exists()


def test_a_damaged_manifest_begins_a_new_run(tmp_path: Path) -> None:
    RunFolder(tmp_path, "key", {}).save("register", 1, 0.0)
    (tmp_path / "manifest.json").write_text('{"key": "key"')
    assert RunFolder(tmp_path, "key", {}).stages == []


def test_a_manifest_cannot_make_us_remove_files_elsewhere(tmp_path: Path) -> None:
    victim = tmp_path / "victim.npz"
    victim.write_text("precious")
    run = tmp_path / "run"
    run.mkdir()
    (run / "manifest.json").write_text(json.dumps({"format": 1, "key": "old", "stages": {"../victim": {}}}))
    RunFolder(run, "new", {})
    assert victim.read_text() == "precious"


def test_a_file_in_the_way_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be used as run folder"):
        RunFolder(tmp_path / "file", "key", {})
