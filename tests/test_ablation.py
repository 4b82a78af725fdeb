"""The ablation table: its rows make parameters, its differences are those of the tables, and it is taken up again."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from loda_pdal import pipeline
from loda_pdal.benchmark import ablation, evaluate
from loda_pdal.benchmark.ablation import FULL, OURS, PAPER, Ablation, Outcome, Row, Variant, ablate
from loda_pdal.benchmark.commands import bench
from loda_pdal.benchmark.reuse import Runs
from loda_pdal.benchmark.runs import JudgedPoints, judged_result, read_annotation, read_run
from loda_pdal.benchmark.simulate import SimulationOptions
from loda_pdal.benchmark.suites import SIZES, SuiteBlock
from loda_pdal.benchmark.truth import Truth
from loda_pdal.io.las import read_epochs
from loda_pdal.io.outputs import write_outputs
from loda_pdal.model.pair import Pair
from loda_pdal.params import PRESETS, Parameters
from loda_pdal.pipeline import detect_changes


@pytest.mark.parametrize("variant", [*PAPER, *OURS], ids=lambda v: v.name)
def test_every_row_makes_parameters_or_says_why_not(variant: Variant) -> None:
    makes_a_change = [variant.of(Parameters.preset(name)) != Parameters.preset(name) for name in PRESETS]
    assert any(makes_a_change) or variant.why_not


def test_names_are_unique_and_the_papers_rows_complete() -> None:
    names = [variant.name for variant in (FULL, *PAPER, *OURS)]
    assert len(set(names)) == len(names)
    assert len(PAPER) == 14  # of the paper's table, but for its reference and the learned baseline


def outcome(right: int, wrong: int) -> Outcome:
    """Added instances with the right label, and those that were called Unchanged."""
    table = np.zeros((5, 6), dtype=np.int64)
    table[0, 0], table[0, 4] = right, wrong
    return Outcome(table, table, wrong, 5000.0)


def test_the_loss_is_that_of_the_pooled_tables() -> None:
    full, worse = Row(FULL, [outcome(8, 0)] * 3), Row(PAPER[0], [outcome(4, 4)] * 3)
    assert full.scores.macro_iou == 1.0 and worse.alarms_per_ha == pytest.approx(12 / 1.5)
    assert worse.loss(full) == pytest.approx((0.25 - 1.0,) * 3)  # Added 1/2, Unchanged 0; the same in every draw
    mixed = Row(PAPER[0], [outcome(8, 0), outcome(0, 8)])
    mean, low, high = mixed.loss(Row(FULL, [outcome(8, 0)] * 2))
    assert low == pytest.approx(-1.0) and high == pytest.approx(0.0) and mean == pytest.approx(-0.75)
    again = Outcome.from_dict(json.loads(json.dumps(outcome(3, 1).to_dict())))
    np.testing.assert_array_equal(again.confusion, outcome(3, 1).confusion)


def test_the_table_says_what_cannot_be_run() -> None:
    rows = [Row(PAPER[0], [outcome(4, 4)]), Row(OURS[0], remark="is so in the full method")]
    text = Ablation("a suite", Row(FULL, [outcome(8, 0)]), rows).to_markdown()
    ours = next(line for line in text.splitlines() if OURS[0].name in line)
    assert ours.count("| - ") == 10 and "(is so in the full method)" in ours
    paper = next(line for line in text.splitlines() if PAPER[0].name in line)
    assert paper.endswith("| 8.0 | -75.0 (-75.0 to -75.0) |")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, compiled_kernels: None) -> Path:
    return tmp_path_factory.mktemp("ablation")


@pytest.fixture
def one_block(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of the only block of a suite, simulated."""
    block = SuiteBlock("seed_3", "train", 3, SimulationOptions(length_m=30.0, density=0.2))
    monkeypatch.setattr(evaluate, "streets", lambda suite, split: [block])
    monkeypatch.setitem(SIZES["vehicle"], "train", (1, 0))
    list(evaluate.prepared_blocks(folder, "vehicle", "train", say=lambda text: None))
    return folder / "seed_3"


def test_rows_are_run_once(folder: Path, one_block: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    variants = (PAPER[0], Variant("Change cues", "already so", ("changes.use_lod=true",)))
    said: list[str] = []
    found = ablate(folder, "vehicle", "train", Parameters(), variants=variants, say=said.append)
    assert [len(row.outcomes) for row in (found.full, *found.rows)] == [1, 1, 0]
    assert found.rows[1].remark == "is so in the full method"
    assert [line.split(":")[0] for line in said[1:]] == [
        "  preset street",
        "  preset street changes.use_lod=false ground_changes.lod_factor=0.0",
    ]
    monkeypatch.setattr(ablation.Runs, "detect", lambda *arguments: pytest.fail("was known"))
    assert ablate(folder, "vehicle", "train", Parameters(), variants=variants).to_dict() == found.to_dict()


def test_the_command_writes_one_table(one_block: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ablation.ablate, "__kwdefaults__", {**ablation.ablate.__kwdefaults__, "variants": PAPER[:1]})
    arguments = ["ablate", str(one_block.parent), "--suite", "vehicle", "--split", "train"]
    done = CliRunner().invoke(bench, arguments, catch_exceptions=False)
    assert done.exit_code == 0 and "| Reference | full method |" in done.stdout
    assert "# Ablation on suite vehicle, train split: 1 blocks, preset street\n" in done.stdout


def test_steps_are_not_repeated_and_the_answer_is_that_of_a_whole_run(
    one_block: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    surveys = read_epochs(one_block / "before.laz", one_block / "after.laz")
    runs = Runs(surveys)
    runs.detect(Parameters())
    called: list[str] = []
    steps = ("fuse_epochs", "register_epochs", "form_superpoints", "segment_instances", "label_objects")
    for name in steps:
        usual = getattr(pipeline, name)

        def watched(*inputs: Any, usual: Any = usual, name: str = name) -> Any:
            called.append(name)
            return usual(*inputs)

        monkeypatch.setattr(pipeline, name, watched)
        runs._first[watched] = runs._first.pop(usual)  # type: ignore[index, union-attr]
    for setting, repeated in (
        ("changes.use_height=false", ["label_objects"]),
        ("instances.splits_crowns=false", ["segment_instances", "label_objects"]),
        ("semantics.has_roofs=false", ["segment_instances", "label_objects"]),
        ("superpoints.method=components", ["form_superpoints", "segment_instances", "label_objects"]),
        ("icp.loss=l2", ["register_epochs", "form_superpoints", "segment_instances", "label_objects"]),
        ("changes.use_lod=true", []),
    ):
        called.clear()
        parameters = Parameters().with_setting(setting)
        found = runs.detect(parameters)
        assert called == repeated, setting
        alone = detect_changes(*surveys, parameters)
        assert [str(o) for o in found.objects] == [str(o) for o in alone.objects]
        for one, other in zip(found.points, alone.points, strict=True):
            np.testing.assert_array_equal(one.change, other.change)


def test_a_result_is_judged_alike_before_and_after_it_is_written(one_block: Path, tmp_path: Path) -> None:
    truth = Truth.read(one_block / "truth.json")
    paths = Pair(one_block / "before.laz", one_block / "after.laz")
    surveys = read_epochs(*paths)
    result = detect_changes(*surveys)
    annotation = paths.map(lambda path: read_annotation(path, truth))
    unwritten = judged_result(result, annotation, truth.T_after_before)
    write_outputs(result, surveys, tmp_path / "run")
    written = read_run(tmp_path / "run", truth, one_block)
    for item in fields(JudgedPoints):
        if item.name != "xyz":  # the one moved by the true move, the other by the one that was found
            np.testing.assert_array_equal(getattr(unwritten, item.name), getattr(written, item.name))
    np.testing.assert_allclose(unwritten.xyz, written.xyz, atol=0.2)
