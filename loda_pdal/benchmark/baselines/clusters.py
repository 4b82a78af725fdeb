"""From points that changed to objects: clusters in space, labelled by what stands at their place in each epoch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loda_pdal.benchmark.baselines.columns import Columns, label_of_regions, marks_in_columns, without_small
from loda_pdal.benchmark.baselines.scene import Marks, Scene
from loda_pdal.kernels.clusters import dbscan
from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array
from loda_pdal.model.pair import Pair


@dataclass(frozen=True)
class ClusterParams:
    """How changed points become objects; base of the choices of methods that find points.

    Attributes
    ----------
    radius_m : float, m
        Neighbourhood of DBSCAN.
    min_neighbours : int
        Points within it that make a core point, itself included.
    min_points : int
        Smaller clusters are dropped.
    standing_m : float, m
        Where the median top of the clusters' plan cells is lower than this, nothing stands.
    """

    radius_m: float = 0.7
    min_neighbours: int = 4
    min_points: int = 20
    standing_m: float = 0.7


def marks_of_clusters(
    scene: Scene, columns: Columns, is_changed: Pair[BoolArray], params: ClusterParams
) -> Pair[Marks]:
    """Objects made of changed points.

    A change is a gain where the top of its plan cell is higher in the after epoch, a loss where it is lower, and where
    that says nothing, gain if the after epoch has the point and loss if the before epoch does. Gains and losses are
    clustered apart, and a cluster takes all points above the ground in its plan cells: a house that got a storey is
    told by its roof, and its walls below go with it.

    Parameters
    ----------
    scene, columns
    is_changed : Pair of (m,) bool
        Which fused points changed; points on the ground do not count.
    params : ClusterParams
    """
    is_changed = is_changed.join(scene.is_off_ground, lambda changed, off_ground: changed & off_ground)
    at = is_changed.map(np.flatnonzero)
    xyz = np.concatenate([cloud.xyz[idx] for cloud, idx in zip(scene.clouds, at, strict=True)])
    cell = np.concatenate([side[idx] for side, idx in zip(columns.cell, at, strict=True)])
    is_after = np.repeat([False, True], [len(idx) for idx in at])
    difference = np.nan_to_num(columns.difference.ravel()[cell])
    is_gain = np.where(difference == 0, is_after, difference > 0)
    cluster = np.zeros(len(xyz), dtype=np.int64)
    for is_part in (is_gain, ~is_gain):
        found = _clusters(xyz[is_part], params)
        cluster[is_part] = np.where(found > 0, found + cluster.max(initial=0), 0)
    pairs, n_points = np.unique(np.column_stack([cell, cluster])[cluster > 0], axis=0, return_counts=True)
    label = label_of_regions(columns, pairs[:, 1], pairs[:, 0], params.standing_m)
    region = np.zeros(columns.shape, dtype=np.int64)
    order = np.argsort(n_points, kind="stable")  # of several in one cell the last written stays, that with most points
    region.ravel()[pairs[order, 0]] = pairs[order, 1]
    return marks_in_columns(scene, columns, region, label)


def _clusters(xyz: FloatArray, params: ClusterParams) -> Int64Array:
    """Cluster of each point, from 1 without gaps, 0 none."""
    root = dbscan(xyz, np.ones(len(xyz), dtype=np.int32), params.radius_m, params.min_neighbours)
    numbers, number = np.unique(root, return_inverse=True)
    has_noise = len(numbers) > 0 and numbers[0] < 0
    return without_small(number + (0 if has_noise else 1), params.min_points)
