"""The limit of detection against M3C2, at the same places with the same radius."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from benchmarks import libraries as other
from benchmarks.conftest import Measure
from loda_pdal.model.pair import Pair
from loda_pdal.model.survey import Survey
from loda_pdal.model.transform import transform_points
from loda_pdal.params import Parameters
from loda_pdal.pipeline import fuse_epochs, register_epochs
from loda_pdal.stages.lod import level_of_detection

P = Parameters()


@pytest.fixture(scope="module")
def registered(before: Any, after: Any) -> tuple[Any, Any, Any]:
    """Both epochs in the after frame, and the registration."""
    found = register_epochs(fuse_epochs(Pair(Survey(before), Survey(after)), P), P)
    return transform_points(found.T_after_before, before), after, found


@pytest.mark.parametrize("library", ["loda-pdal", "py4dgeo (M3C2)"])
def test_limit_of_detection(library: str, registered: Any, threads: int, measure: Measure) -> None:
    before, after, found = registered
    ours = level_of_detection(before, after, found.covariance, found.centre, P.lod)
    sigma = float(np.sqrt(np.trace(found.covariance[:3, :3]) / 3))
    ways: dict[str, Callable[[], Any]] = {
        "loda-pdal": lambda: level_of_detection(before, after, found.covariance, found.centre, P.lod).displacement,
        "py4dgeo (M3C2)": lambda: other.m3c2_py4dgeo(before, after, ours.centres, P.lod, sigma, threads)[0],
    }
    places = len(ours.cells)
    distance = measure("limit of detection", library, ways[library], points=len(before) + len(after), places=places)
    both = ours.is_valid & np.isfinite(distance)
    assert np.median(np.abs(np.abs(distance[both]) - np.abs(ours.displacement[both]))) < 0.02
