"""The L1 Potts energy of a voxel graph, made small by multilevel moves and checked merges.

The paper minimises its energy (section 4.2, equation 4) with cut-pursuit, which splits segments by minimum cuts. Here
nothing is ever cut: one label per voxel at first; nodes move to the neighbouring label that lowers the energy most;
neighbouring regions merge where the energy falls, exactly computed; regions are contracted to nodes, and again; at the
end single voxels move on the whole graph. There are no maximum flows and no chance, and every step lowers the energy.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from loda_pdal.kernels.partition import (
    N_FEATURES,
    carry_partners,
    connected_labels,
    contract,
    find_partners,
    find_voxel_partners,
    fit_regions,
    members,
    merge_partners,
    move_nodes,
)
from loda_pdal.model.cloud import Float32Array, FloatArray, IntArray

QUANTUM = 2.0**-16
"""Features and weights are whole multiples of this: their sums, and so the energies, are exact in float64."""

_FLOAT32_EXACT = 1 << 24
"""Integers up to this are exact in float32."""

_LEVELS = 3
_SWEEPS = 2
_MERGE_ROUNDS, _MERGE_ROUNDS_LAST = 3, 4
_LEAST_FALL = 0.002
"""Share of the energy by which a level must lower it for another level to follow."""
_LEAST_MERGES = 0.0005
"""Share of the regions that must merge for another round to follow."""


class Graph(NamedTuple):
    """Symmetric graph in compressed rows: the arcs of node i are ``first_arc[i]:first_arc[i + 1]``.

    Attributes
    ----------
    first_arc : (n + 1,) int32
    heads : (a,) int32
        Node at the other end; every edge is two arcs, none occurs twice, none is a loop.
    weights : (a,) float32 or float64
        Cost of cutting the arc's edge, beta included.
    """

    first_arc: IntArray
    heads: IntArray
    weights: npt.NDArray[Any]


class Regions(NamedTuple):
    """A partition of the voxels, with what the energy needs.

    Attributes
    ----------
    labels : (m,) int32
        Region of each voxel.
    order, start : (m,), (n + 1,) int32
        Voxels of region r: ``order[start[r]:start[r + 1]]``.
    medians : (n, 5) float32
        Lower median of each feature in each region.
    deviations : (n, 5) float64
        Sum of absolute deviations from it.
    graph : Graph
        Regions as nodes; weights are sums over the edges between two regions.
    """

    labels: IntArray
    order: IntArray
    start: IntArray
    medians: Float32Array
    deviations: FloatArray
    graph: Graph

    def __len__(self) -> int:
        return len(self.medians)

    @property
    def size(self) -> IntArray:
        """Voxels in each region, (n,) int32."""
        return np.diff(self.start)

    @property
    def energy(self) -> float:
        """The paper's equation 4, exact for quantised features and weights."""
        return float(self.deviations.sum() + self.graph.weights.sum(dtype=np.float64) / 2)


class Partition(NamedTuple):
    """Regions that make the energy small; ``energies`` after every step, first that of single voxels."""

    regions: Regions
    energies: tuple[float, ...]
    n_levels: int


def minimise_energy(graph: Graph, features: Float32Array) -> Partition:
    """Connected regions of a graph that make the L1 Potts energy small.

    Parameters
    ----------
    graph : Graph
        Over the voxels; weights are multiples of `QUANTUM`.
    features : (m, d) float32
        Finite, multiples of `QUANTUM`.

    Returns
    -------
    Partition
        Regions are numbered by their lowest voxel.

    Notes
    -----
    The energy is ``sum_u sum_(i in u) |f_i - mu_u|_1 + sum_(ij) w_ij [u(i) != u(j)]`` with mu_u the median of the
    region. The schedule is fixed; the answer depends on the order of the voxels and on nothing else.

    References
    ----------
    Paper, section 4.2, equation 4.
    """
    voxels = single_voxels(graph, features)
    regions = _paired(voxels, features)
    energies = [voxels.energy, regions.energy]
    n_levels = 0
    for _ in range(_LEVELS):
        regions = _moved(regions, np.arange(len(regions), dtype=np.int32), regions, features, opens_regions=False)
        energies.append(regions.energy)
        regions = _merged(regions, features, _MERGE_ROUNDS)
        energies.append(regions.energy)
        n_levels += 1
        if energies[-1] > (1 - _LEAST_FALL) * energies[-3]:
            break
    regions = _moved(voxels, regions.labels.copy(), regions, features, opens_regions=True)
    energies.append(regions.energy)
    regions = _merged(regions, features, _MERGE_ROUNDS_LAST)
    energies.append(regions.energy)
    return Partition(regions, tuple(energies), n_levels)


def single_voxels(graph: Graph, features: Float32Array) -> Regions:
    """The partition into single voxels."""
    n = len(features)
    index = np.arange(n + 1, dtype=np.int32)
    return Regions(index[:-1], index[:-1], index, features, np.zeros(features.shape), graph)


def regrouped(regions: Regions, group: IntArray, n_groups: int, features: Float32Array) -> Regions:
    """The partition in which region r is part of region ``group[r]``, 0 to ``n_groups - 1``, none of them empty."""
    labels = group[regions.labels]
    order, start = members(labels, n_groups)
    medians = np.empty((n_groups, N_FEATURES), dtype=np.float32)
    deviations = np.empty((n_groups, N_FEATURES))
    medians[group], deviations[group] = regions.medians, regions.deviations
    fit_regions(features, order, start, np.bincount(group, minlength=n_groups) > 1, medians, deviations)
    return Regions(labels, order, start, medians, deviations, _contracted(regions.graph, group, n_groups))


def _contracted(graph: Graph, group: IntArray, n_groups: int, dtype: npt.DTypeLike = np.float64) -> Graph:
    """The graph whose nodes are groups of nodes, with weights of type ``dtype``."""
    return Graph(*contract(*graph, group, np.empty(n_groups, dtype)))


def _moved(
    nodes: Regions, labels: IntArray, regions: Regions, features: Float32Array, *, opens_regions: bool
) -> Regions:
    """Connected regions after moving ``nodes``, of which ``labels`` says in which of the ``regions`` they are."""
    medians = np.empty((len(nodes), N_FEATURES), dtype=np.float32)
    medians[: len(regions)] = regions.medians
    move_nodes(
        *nodes.graph,
        features,
        nodes.order,
        nodes.start,
        nodes.medians,
        nodes.deviations,
        labels,
        medians,
        len(regions),
        _SWEEPS,
        opens_regions,
    )
    connected, n = connected_labels(nodes.graph.first_arc, nodes.graph.heads, labels)
    return regrouped(nodes, connected, n, features)


def _paired(voxels: Regions, features: Float32Array) -> Regions:
    """Mutually best voxels in pairs, all others single.

    This is the largest of the graphs of regions. A weight is the sum of at most four, exact in float32 unless beta is
    very large.
    """
    n = len(voxels)
    partner, weight, gain = np.empty(n, dtype=np.int32), np.empty(n), np.empty(n)
    find_voxel_partners(*voxels.graph, features, partner, weight, gain)
    is_exact = 4 * np.max(voxels.graph.weights, initial=0.0) <= _FLOAT32_EXACT * QUANTUM
    return _united(voxels, partner, weight, features, np.float32 if is_exact else np.float64)[0]


def _merged(regions: Regions, features: Float32Array, n_rounds: int) -> Regions:
    """Regions after ``n_rounds`` of merging mutually best neighbours."""
    n = len(regions)
    partner, weight, gain = np.empty(n, dtype=np.int32), np.empty(n), np.empty(n)
    is_new = np.ones(n, dtype=np.bool_)
    for _ in range(n_rounds):
        n = len(regions)
        find_partners(*regions.graph, regions.start, regions.medians, regions.deviations, is_new, partner, weight, gain)
        regions, group = _united(regions, partner, weight, features)
        m = len(regions)
        if n - m < _LEAST_MERGES * n:
            break
        known = partner, weight, gain
        partner, weight, gain = np.empty(m, dtype=np.int32), np.empty(m), np.empty(m)
        carry_partners(*known, group, partner, weight, gain)
        is_new = np.bincount(group) > 1
    return regions


def _united(
    regions: Regions,
    partner: IntArray,
    weight: FloatArray,
    features: Float32Array,
    dtype: npt.DTypeLike = np.float64,
) -> tuple[Regions, IntArray]:
    """Regions after merging mutual partners where the energy falls, and what each old region (n,) is part of."""
    group = np.empty(len(regions), dtype=np.int32)
    medians, deviations = np.empty_like(regions.medians), np.empty_like(regions.deviations)
    n = merge_partners(
        features,
        regions.order,
        regions.start,
        regions.medians,
        regions.deviations,
        partner,
        weight,
        group,
        medians,
        deviations,
    )
    labels = group[regions.labels]
    order, start = members(labels, n)
    graph = _contracted(regions.graph, group, n, dtype)
    return Regions(labels, order, start, medians[:n], deviations[:n], graph), group
