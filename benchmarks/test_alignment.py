"""Registration: one level of ICP from the same start with the same number of iterations."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import libraries as other
from benchmarks.conftest import Measure
from loda_pdal.model.transform import IDENTITY, transform_points
from loda_pdal.params import Parameters
from loda_pdal.stages.icp import Surface, fine_pose

P = Parameters()
ITERATIONS = 12
ONE_LEVEL = replace(
    P.icp,
    leaves_m=(0.25,),
    radii_m=(0.75,),
    max_iterations=(ITERATIONS,),
    stop_update=1e-9,
    adapts_tukey=False,
    covariance="normal",
)
"""All points within 0.75 m, every iteration made; tau is 0.30 m for those that have a robust loss."""


def rms_error(T: Any, block: Path, surveys: Any) -> float:
    """Root mean square distance (m) of the before points from where the truth has them."""
    truth = np.array(json.loads((block / "truth.json").read_text(encoding="utf-8"))["T_after_before"])
    frame = surveys.before.frame
    sample = surveys.before.xyz[::100]
    expected = frame.to_local(transform_points(truth, frame.to_map(sample)))
    return float(np.sqrt(np.mean(np.sum((transform_points(T, sample) - expected) ** 2, axis=1))))


def icp_ours(before: Any, after: Any) -> Any:
    """Pose (4, 4) from planes of both clouds, estimated first."""
    source, target = (Surface.of(xyz, P.normals) for xyz in (before, after))
    return fine_pose(source, target, IDENTITY, ONE_LEVEL, P.normals).T_target_source


@pytest.mark.parametrize("library", ["loda-pdal", "Open3D", "small_gicp (plane)", "small_gicp (GICP)"])
def test_icp(library: str, before: Any, after: Any, block: Path, surveys: Any, threads: int, measure: Measure) -> None:
    ways: dict[str, Callable[[], Any]] = {
        "loda-pdal": lambda: icp_ours(before, after),
        "Open3D": lambda: other.icp_open3d(before, after, ONE_LEVEL, P.normals, is_stopped=False),
        "small_gicp (plane)": lambda: other.icp_small_gicp(before, after, "PLANE_ICP", ONE_LEVEL, threads),
        "small_gicp (GICP)": lambda: other.icp_small_gicp(before, after, "GICP", ONE_LEVEL, threads),
    }
    error = rms_error(ways[library](), block, surveys)
    measure(f"ICP, {ITERATIONS} iterations", library, ways[library], points=len(before), error_m=error)
    assert error < 0.05
