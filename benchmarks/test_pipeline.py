"""The whole method from arrays to result, against the same method composed from libraries."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.composed import composed
from benchmarks.conftest import Measure
from loda_pdal.pipeline import detect_changes


@pytest.fixture(scope="module")
def expected(surveys: Any) -> Any:
    return detect_changes(surveys.before, surveys.after)


def test_ours(surveys: Any, expected: Any, measure: Measure) -> None:
    result = measure(
        "whole method",
        "loda-pdal",
        lambda: detect_changes(surveys.before, surveys.after),
        rounds=3,
        points=len(surveys.before) + len(surveys.after),
    )
    assert len(result.objects) == len(expected.objects)


def test_composed(surveys: Any, expected: Any, threads: int, measure: Measure) -> None:
    """The libraries' result differs in detail; most points must get the same label, or this compares different work."""
    with composed(threads):
        result = measure(
            "whole method",
            "composed of libraries",
            lambda: detect_changes(surveys.before, surveys.after),
            rounds=3,
            points=len(surveys.before) + len(surveys.after),
        )
    same = [np.mean(ours.change == theirs.change) for ours, theirs in zip(expected.points, result.points, strict=True)]
    assert min(same) > 0.9
