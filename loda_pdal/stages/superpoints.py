"""Superpoints: connected pieces of one surface kind (paper, section 4.2, equation 4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loda_pdal.kernels.clusters import components
from loda_pdal.kernels.neighbours import knn
from loda_pdal.kernels.partition import (
    closest_neighbours,
    connected_labels,
    rank_bits,
    sq_feature_distances,
    standardise,
    symmetric_arcs,
)
from loda_pdal.model.cloud import Float32Array, FloatArray, IntArray
from loda_pdal.params import SuperpointParams
from loda_pdal.stages.features import Features
from loda_pdal.stages.partition import (
    QUANTUM,
    Graph,
    Regions,
    minimise_energy,
    regrouped,
    single_voxels,
)

_NEAR_GROUND_M = 0.3
"""With method ``components``, voxels below and above this height are never in one superpoint: else all is one."""

_HEIGHT = 4

_PART = 1 << 16


@dataclass(frozen=True)
class Superpoints:
    """Superpoints of one epoch.

    Attributes
    ----------
    labels : (m,) int32
        Superpoint of each fused point, 0 to ``n - 1``, numbered by the lowest point.
    n : int
        Number of superpoints.
    energy : float
        Equation 4 of ``labels``.
    n_rounds : int
        Levels of the partition; 0 with method ``components``.
    n_absorbed : int
        Superpoints that were too small and joined a neighbour.
    energy_before_absorbing : float
        Equation 4 of the partition as it was minimised.
    """

    labels: IntArray
    n: int
    energy: float
    n_rounds: int
    n_absorbed: int
    energy_before_absorbing: float


def superpoints(xyz: FloatArray, features: Features, params: SuperpointParams) -> Superpoints:
    """Superpoints of one epoch.

    Parameters
    ----------
    xyz : (m, 3) float64, m
        Fused points, in cell order.
    features : Features
        Of the same points.
    params : SuperpointParams
        Method, graph, beta, and the size below which superpoints are absorbed.

    Notes
    -----
    Too small superpoints join a neighbour in a step of its own, after the energy has been minimised: the energy itself
    wants noise to be single voxels, and raising beta to prevent that would blur boundaries everywhere.

    References
    ----------
    Paper, section 4.2, equation 4.
    """
    if len(xyz) == 0:
        return Superpoints(np.zeros(0, dtype=np.int32), 0, 0.0, 0, 0, 0.0)
    standard = standardised(features)
    graph = voxel_graph(xyz, standard, params)
    if params.method == "components":
        is_high = (features.values[:, _HEIGHT] >= _NEAR_GROUND_M).astype(np.int32)
        connected, n_connected = connected_labels(graph.first_arc, graph.heads, is_high)
        regions = regrouped(single_voxels(graph, standard), connected, n_connected, standard)
        n_rounds = 0
    else:
        partition = minimise_energy(graph, standard)
        regions, n_rounds = partition.regions, partition.n_levels
    absorbed = absorb_small(regions, standard, params.absorb_below)
    n_absorbed = len(regions) - len(absorbed)
    return Superpoints(absorbed.labels, len(absorbed), absorbed.energy, n_rounds, n_absorbed, regions.energy)


def standardised(features: Features) -> Float32Array:
    """Features (m, 5) with zero mean and unit variance over the valid points, rounded to `QUANTUM`.

    A feature that does not vary is 0 everywhere.
    """
    is_known = features.is_valid if features.is_valid.any() else np.ones_like(features.is_valid)
    standard = np.empty_like(features.values)
    standardise(features.values, is_known, QUANTUM, standard)
    return standard


def voxel_graph(xyz: FloatArray, standard: Float32Array, params: SuperpointParams) -> Graph:
    """Graph of the k nearest neighbours, made symmetric, weighted by ``beta exp(-|f_i - f_j|^2 / sigma^2)``.

    sigma is the median distance of features over the edges; weights are rounded to `QUANTUM`.
    """
    first_arc, heads = symmetric_arcs(knn(xyz, params.k, params.max_edge_m, includes_self=False).idx)
    weights = sq_feature_distances(first_arc, heads, standard)  # becomes weights part by part, each fits the cache
    sq_sigma = _lower_median(weights)
    for start in range(0, len(weights), _PART):
        part = weights[start : start + _PART]
        similarity = np.exp(part / -sq_sigma) if sq_sigma > 0 else part == 0
        part[:] = np.rint(similarity * np.float32(params.beta / QUANTUM)) * np.float32(QUANTUM)
    return Graph(first_arc, heads, weights)


def absorb_small(regions: Regions, features: Float32Array, least_size: int) -> Regions:
    """Regions after those with fewer than ``least_size`` voxels joined the neighbour they share most weight with.

    Equal weights go to the neighbour with the nearer medians. A small region joins exactly one neighbour, so two large
    ones never get joined by a small one between them; what is still small joins again. Small regions without any
    neighbour stay.
    """
    while True:
        neighbour = np.empty(len(regions), dtype=np.int32)
        closest_neighbours(*regions.graph, regions.medians, regions.size < least_size, neighbour)
        small = np.flatnonzero(neighbour >= 0)
        if len(small) == 0:
            return regions
        group = components(np.column_stack([small, neighbour[small]]), len(regions))
        regions = regrouped(regions, group, int(group.max()) + 1, features)


def _lower_median(values: Float32Array) -> float:
    """Lower median of (a,) values; 0 if there are none."""
    if len(values) == 0:
        return 0.0
    return float(np.int32(rank_bits(values.view(np.int32), (len(values) - 1) // 2)).view(np.float32))
