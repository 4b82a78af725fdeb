"""Calibration of the confidence, on scores whose truth is drawn from a known curve, and on a small suite."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from loda_pdal.benchmark import calibrate as calibration
from loda_pdal.benchmark import evaluate
from loda_pdal.benchmark.calibrate import (
    Judged,
    Reliability,
    calibration_error,
    confidences,
    fit,
    judged_objects,
    logistic,
    present_lines,
)
from loda_pdal.benchmark.commands import bench
from loda_pdal.benchmark.runs import JudgedPoints
from loda_pdal.benchmark.simulate import SimulationOptions
from loda_pdal.benchmark.suites import SIZES, SuiteBlock
from loda_pdal.benchmark.truth import Truth, TruthInstance
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import ObjectRecord
from loda_pdal.params import Parameters


def test_a_known_curve_is_found_again() -> None:
    rng = np.random.default_rng(0)
    raw = rng.random(20000)
    is_right = rng.random(20000) < 1 / (1 + np.exp(-(-1.0 + 4.0 * raw)))
    offset, slope = logistic(raw.tolist(), is_right.tolist())
    assert offset == pytest.approx(-1.0, abs=0.15)
    assert slope == pytest.approx(4.0, abs=0.3)
    confidence = 1 / (1 + np.exp(-(offset + slope * raw)))
    assert calibration_error(confidence, is_right) < 0.02
    judged = [Judged("calibration_changed", r, bool(k)) for r, k in zip(raw, is_right, strict=True)]
    lines = fit(judged)
    assert lines["calibration_changed"] == (offset, slope)
    np.testing.assert_allclose(confidences(judged[:9], lines), confidence[:9])


def test_labels_that_are_always_right_keep_a_finite_slope() -> None:
    offset, slope = logistic([0.5, 0.9, 0.7], [True, True, True])
    assert 0 <= slope < 40
    assert offset < 20


def test_the_calibration_error_can_be_checked_by_hand() -> None:
    confidence = np.array([0.95, 0.95, 0.15, 0.15])
    assert calibration_error(confidence, np.array([True, True, False, False])) == pytest.approx(0.1)
    assert calibration_error(confidence, np.array([False, False, True, True])) == pytest.approx(0.9)
    assert np.isnan(calibration_error(np.zeros(0), np.zeros(0, np.bool_)))


def test_reliability_tells_chance_from_error() -> None:
    rng = np.random.default_rng(1)
    confidence = rng.random(400)
    found = Reliability.of(confidence, rng.random(400) < confidence)
    assert found.n == 400 == sum(b.n for b in found.bins) and len(found.bins) == 10
    assert 0.02 < found.chance < 0.06 and found.error < 1.6 * found.chance
    wrong = Reliability.of(np.full(50, 0.9), np.zeros(50, np.bool_))
    assert wrong.error == pytest.approx(0.9) and wrong.chance < 0.1
    assert wrong.to_markdown().splitlines()[-1] == "| 0.9 to 1.0 | 50 | 90.0 | 0.0 |"
    assert Reliability.of(np.zeros(0), np.zeros(0, np.bool_)).bins == []


def instance(number: int, label: ChangeLabel, excluded: str | None = None) -> TruthInstance:
    nothing: Pair[Any] = Pair(0, 0)
    return TruthInstance(
        number,
        ObjectClass.MOBILE,
        label,
        "car",
        Pair(True, True),
        nothing,
        nothing,
        Pair(None, None),
        excluded=excluded,
    )


def judged_as(label: ChangeLabel, truth_id: list[int], truth_change: list[int] | None = None) -> list[bool]:
    """Whether an object with such points is right; empty where it is not judged."""
    instances = [
        instance(1, ChangeLabel.ADDED),
        instance(2, ChangeLabel.UNCHANGED),
        instance(3, ChangeLabel.ADDED, "x"),
    ]
    truth = Truth(instances, np.eye(4), [], 1.0)
    n = len(truth_id)
    surface = np.ones(n, np.uint8) if truth_change is None else np.array(truth_change, np.uint8)
    same = np.ones(n, np.uint8)
    points = JudgedPoints(np.zeros((n, 3)), same, same, np.full(n, 1), same, np.array(truth_id, np.int64), surface)
    record = ObjectRecord(1, label, ObjectClass.MOBILE, None, "", confidence=0.5, confidence_raw=0.5)
    return [j.is_right for j in judged_objects(points, truth, [record])]


def test_most_points_of_an_object_decide_whether_its_label_is_right() -> None:
    assert judged_as(ChangeLabel.ADDED, [1, 1, 2]) == [True]
    assert judged_as(ChangeLabel.ADDED, [1, 2, 2]) == [False]
    assert judged_as(ChangeLabel.UNCHANGED, [0, 0, 1]) == [True]
    assert judged_as(ChangeLabel.UNDETERMINED, [1, 1]) == []


def test_what_changed_within_an_object_counts_too() -> None:
    assert judged_as(ChangeLabel.INCREASED, [2] * 10, [4, 4] + [1] * 8) == [True]
    assert judged_as(ChangeLabel.INCREASED, [2] * 10, [5, 5] + [1] * 8) == [False]


def test_excluded_instances_do_not_vote() -> None:
    assert judged_as(ChangeLabel.ADDED, [3, 3, 3, 2]) == []
    assert judged_as(ChangeLabel.ADDED, [3, 2, 2]) == [False]
    assert judged_as(ChangeLabel.ADDED, [3, 1, 1]) == [True]


@pytest.mark.usefixtures("compiled_kernels")
def test_a_suite_is_calibrated_and_its_objects_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def street(suite: str, split: str) -> list[SuiteBlock]:
        seed = {"train": 3, "validation": 5}[split]
        return [SuiteBlock(f"seed_{seed}", split, seed, SimulationOptions(length_m=30.0, density=0.2))]

    monkeypatch.setattr(evaluate, "streets", street)
    for split in ("train", "validation"):
        monkeypatch.setitem(SIZES["vehicle"], split, (1, 0))
    arguments = ["calibrate", str(tmp_path), "--suite", "vehicle"]
    text = CliRunner().invoke(bench, arguments, catch_exceptions=False).stdout
    assert "1 training and 1 validation blocks, preset street" in text
    assert "confidence.calibration_unchanged = [" in text and "## Reliability on validation blocks" in text
    monkeypatch.setattr(calibration, "detect_changes", lambda *given: pytest.fail("was known"))
    found = json.loads(CliRunner().invoke(bench, [*arguments, "--json"], catch_exceptions=False).stdout)
    assert found["train"]["fitted"]["n"] > 10 and found["validation"]["fitted"]["n"] > 10
    assert {k: tuple(v) for k, v in found["present"].items()} == present_lines(Parameters())
    assert found["train"]["fitted"]["error"] < 0.2
