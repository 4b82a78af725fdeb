"""Baseline: M3C2 distances with their level of detection (Lague et al. 2013, by py4dgeo), clustered.

M3C2 asks from the points of one epoch only. Here it is asked from both, so that what only one survey has is found in
either: a point has changed where its distance is significant, or where the other survey has nothing in its cylinder.
"""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from loda_pdal.benchmark.baselines.baseline import Baseline
from loda_pdal.benchmark.baselines.clusters import ClusterParams, marks_of_clusters
from loda_pdal.benchmark.baselines.columns import Columns
from loda_pdal.benchmark.baselines.scene import Marks, Scene
from loda_pdal.kernels.parallel import thread_count
from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.pair import Pair


@dataclass(frozen=True)
class M3c2Params(ClusterParams):
    """Choices of the baseline.

    Attributes
    ----------
    normal_radii_m : tuple of float, m
        Scales of the normals; the flattest wins.
    cylinder_m, depth_m : float, m
        Radius of the cylinder, and how far it reaches to either side.
    registration_m : float, m
        Registration error in the level of detection.
    min_distance_m : float, m
        Significant distances that are shorter do not count.
    """

    normal_radii_m: tuple[float, ...] = (0.5, 1.0)
    cylinder_m: float = 0.5
    depth_m: float = 1.0
    registration_m: float = 0.02
    min_distance_m: float = 0.3


class Distances(NamedTuple):
    """Distance to the other epoch along the normal, (m,) m, NaN without a counterpart; and its level of detection."""

    distance: FloatArray
    lod: FloatArray


class Measured(NamedTuple):
    """Distances from the points of each epoch, and the scene's columns."""

    distances: Pair[Distances]
    columns: Columns


def measure(scene: Scene, params: M3c2Params) -> Measured:
    """M3C2 from all fused points of each epoch."""
    py4dgeo = _py4dgeo()
    if "OMP_NUM_THREADS" not in os.environ:  # it would warn
        py4dgeo.set_num_threads(thread_count())
    epochs = scene.clouds.map(lambda cloud: py4dgeo.Epoch(np.ascontiguousarray(cloud.xyz)))

    def distances(own: Any, other: Any) -> Distances:
        method = py4dgeo.M3C2(
            epochs=(own, other),
            corepoints=own.cloud,
            normal_radii=params.normal_radii_m,
            cyl_radius=params.cylinder_m,
            max_distance=params.depth_m,
            registration_error=params.registration_m,
        )
        distance, found = method.run()
        return Distances(distance, found["lodetection"])

    return Measured(epochs.join(epochs.swapped, distances), Columns.of(scene))


def decide(scene: Scene, measured: Measured, params: M3c2Params) -> Pair[Marks]:
    """Clusters of the points whose distance is significant and of those without a counterpart."""

    def is_changed(found: Distances) -> Any:
        least = np.fmax(found.lod, params.min_distance_m)
        return np.isnan(found.distance) | (np.abs(found.distance) > least)

    return marks_of_clusters(scene, measured.columns, measured.distances.map(is_changed), params)


def _py4dgeo() -> Any:
    import py4dgeo

    logging.getLogger("py4dgeo").handlers.clear()  # they would leave a log file wherever one is
    return py4dgeo


BASELINE = Baseline(
    "M3C2",
    measure,
    decide,
    {
        "depth_m": (0.5, 1.0, 2.0),
        "min_distance_m": (0.1, 0.2, 0.35, 0.5),
        "radius_m": (0.5, 0.7, 1.0),
        "min_points": (10, 25),
        "standing_m": (0.5, 1.0),
    },
    measured_by=("depth_m",),
    needs="py4dgeo",
)
