"""Pipeline files: which stage feeds which, overrides, and the Python spelling of the same pipelines."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from loda_pdal.model.dimensions import DIMENSIONS
from loda_pdal.model.errors import PipelineError
from loda_pdal.pdal_face import builder, entry
from loda_pdal.pdal_face.document import read_stages, to_document
from loda_pdal.pdal_face.runner import error_from


def written(folder: Path, *entries: Any) -> Path:
    path = folder / "p.json"
    path.write_text(json.dumps({"pipeline": entries}))
    return path


def test_stages_without_inputs_take_the_one_before_and_all_readers_since(tmp_path: Path) -> None:
    path = written(tmp_path, "a.laz", {"type": "readers.las", "filename": "b.las"}, {"type": "filters.merge"}, "c.laz")
    stages = read_stages(path)
    assert [s.type for s in stages] == ["readers.las", "readers.las", "filters.merge", "writers.las"]
    assert [s.inputs for s in stages] == [(), (), (0, 1), (2,)]


def test_named_inputs_count_instead(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        {"type": "readers.las", "tag": "a"},
        {"type": "filters.x", "tag": "fa"},
        {"type": "readers.las", "tag": "b"},
        {"type": "filters.x", "tag": "fb", "inputs": "b"},
        {"type": "filters.merge", "inputs": ["fa", "fb"]},
    )
    assert [s.inputs for s in read_stages(path)] == [(), (0,), (), (2,), (1, 3)]


def test_a_pipeline_written_out_has_the_same_stages(tmp_path: Path, pipelines_dir: Path) -> None:
    untagged = written(tmp_path, "a.laz", {"type": "filters.merge", "tag": "stage_0"}, "c.laz")
    for path in (untagged, *pipelines_dir.glob("*.json")):
        stages = read_stages(path)
        again = read_stages(written(tmp_path, *to_document(stages)["pipeline"]))
        assert [(s.type, s.inputs, s.options) for s in again] == [(s.type, s.inputs, s.options) for s in stages]


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ([{"type": "filters.merge"}], "nothing feeds"),
        ([{"type": "readers.las", "inputs": ["a"]}], "no stage before it"),
        (["a.laz", {"type": "filters.merge", "inputs": ["x"]}], "names the input 'x'"),
        ([{"type": "readers.las", "tag": "a"}, {"type": "readers.las", "tag": "a"}], "two stages"),
        ([3], "is no stage"),
        ([{"filename": "x.tif"}], "has no type"),
        ([], "no list of stages"),
    ],
)
def test_broken_pipelines_are_refused(entries: list[Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match=message):
        read_stages(written(tmp_path, *entries))


def test_files_that_are_no_json_are_refused(tmp_path: Path) -> None:
    (tmp_path / "p.json").write_text("{pipeline:")
    with pytest.raises(PipelineError, match="not valid JSON"):
        read_stages(tmp_path / "p.json")
    with pytest.raises(PipelineError, match="cannot be read"):
        read_stages(tmp_path / "none.json")


def test_overrides_reach_one_tag_or_all_of_a_type(pipelines_dir: Path) -> None:
    stages = read_stages(
        pipelines_dir / "lod.json",
        {"stage.before.filename": "x.laz", "filters.python.pdalargs": '{"run": "other"}'},
    )
    by_tag = {s.tag: s for s in stages}
    assert by_tag["before"].options["filename"] == "x.laz"
    assert by_tag["after"].options["filename"] == "after.laz"
    assert by_tag["lod"].options["pdalargs"] == by_tag["register"].options["pdalargs"] == '{"run": "other"}'


@pytest.mark.parametrize("key", ["stage.befor.filename", "readers.laz.filename", "filename", "stage.before."])
def test_an_override_of_nothing_is_refused(key: str, pipelines_dir: Path) -> None:
    with pytest.raises(PipelineError, match="names no stage"):
        read_stages(pipelines_dir / "lod.json", {key: "x"})


@pytest.mark.parametrize("name", builder.CHAINS)
def test_the_json_and_the_python_spelling_are_one(name: str, pipelines_dir: Path) -> None:
    text = (pipelines_dir / f"{name}.json").read_text(encoding="utf-8")
    assert text == builder.to_json(builder.pipeline(name))


def test_there_is_a_python_spelling_of_every_file(pipelines_dir: Path) -> None:
    assert {path.stem for path in pipelines_dir.glob("*.json")} == set(builder.CHAINS)


def test_the_builder_knows_every_entry_and_every_dimension() -> None:
    assert set(builder.WRITES) == set(entry.ENTRIES)
    written = {dimension for row in builder.WRITES.values() for dimension in row}
    assert written == set(DIMENSIONS)


def test_our_own_error_is_found_in_what_pdal_prints() -> None:
    said = (
        "(pdal pipeline filters.python Error) PDAL: 'Traceback (most recent call last):\\n''  File \"loda_lod\"\\n'"
        "'loda_pdal.model.errors.InputError: Two epochs. Do this.\\n'\n"
    )
    error = error_from(said, 1)
    assert type(error).__name__ == "InputError"
    assert str(error) == "Two epochs. Do this."


@pytest.mark.parametrize("said", ["PDAL: readers.las: Couldn't open file.\n\n", ""])
def test_other_failures_carry_pdals_last_words(said: str) -> None:
    assert "open file" in str(error_from(said, 1)) or "code 1" in str(error_from(said, 1))
