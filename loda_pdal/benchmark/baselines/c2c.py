"""Baseline: distance of every point to the nearest point of the other epoch (C2C), cut at a threshold and clustered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from scipy.spatial import cKDTree

from loda_pdal.benchmark.baselines.baseline import Baseline
from loda_pdal.benchmark.baselines.clusters import ClusterParams, marks_of_clusters
from loda_pdal.benchmark.baselines.columns import Columns
from loda_pdal.benchmark.baselines.scene import Marks, Scene
from loda_pdal.kernels.parallel import thread_count
from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.pair import Pair


@dataclass(frozen=True)
class C2cParams(ClusterParams):
    """Choices of the baseline: points farther than ``threshold_m`` (m) from the other epoch have changed."""

    threshold_m: float = 0.5


class Measured(NamedTuple):
    """Distances (m,) to the other epoch's nearest fused point, m, and the scene's columns."""

    distance: Pair[FloatArray]
    columns: Columns


def measure(scene: Scene, params: C2cParams) -> Measured:
    """Distances of all fused points; the parameters have no part in them."""
    xyz = scene.clouds.map(lambda cloud: cloud.xyz)
    distance = xyz.join(xyz.swapped, lambda own, other: cKDTree(other).query(own, workers=thread_count())[0])
    return Measured(distance, Columns.of(scene))


def decide(scene: Scene, measured: Measured, params: C2cParams) -> Pair[Marks]:
    """Clusters of the points that are far from the other epoch."""
    is_changed = measured.distance.map(lambda distance: distance > params.threshold_m)
    return marks_of_clusters(scene, measured.columns, is_changed, params)


BASELINE = Baseline(
    "C2C",
    measure,
    decide,
    {
        "threshold_m": (0.3, 0.4, 0.5, 0.7),
        "radius_m": (0.5, 0.7, 1.0),
        "min_points": (5, 10, 25),
        "standing_m": (0.5, 1.0),
    },
)
