"""The L1 Potts energy from its definition, its true minimum on small graphs, and what plain cut-pursuit makes of it."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow

from loda_pdal.stages.partition import QUANTUM

Array = npt.NDArray[Any]

_CUTS = 4
"""How often a binary split of cut-pursuit alternates between its cut and the values on both sides."""


def quantised(values: Array) -> Array:
    """Values as float32, rounded to multiples of `QUANTUM`."""
    return np.asarray(np.rint(values / QUANTUM) * QUANTUM, dtype=np.float32)


def edges_of(first_arc: Array, heads: Array, weights: Array) -> tuple[Array, Array]:
    """Edges (e, 2) with i < j and their weights (e,) of a symmetric graph in compressed rows."""
    tails = np.repeat(np.arange(len(first_arc) - 1), np.diff(first_arc))
    is_first = tails < heads
    return np.column_stack([tails, heads])[is_first], np.asarray(weights, dtype=float)[is_first]


def graph_of(n: int, edges: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Compressed rows (first_arc, heads, weights) of edges (e, 2)."""
    rows: list[list[tuple[int, float]]] = [[] for _ in range(n)]
    for (i, j), weight in zip(edges, weights, strict=True):
        rows[i].append((j, weight))
        rows[j].append((i, weight))
    rows = [sorted(row) for row in rows]
    arcs = list(itertools.chain.from_iterable(rows))
    first_arc = np.cumsum([0, *map(len, rows)]).astype(np.int32)
    return (
        first_arc,
        np.array([j for j, _ in arcs], dtype=np.int32),
        np.array([weight for _, weight in arcs], dtype=np.float32),
    )


def energy(labels: Array, features: Array, edges: Array, weights: Array) -> float:
    """Paper, equation 4: L1 distance to the medians of the segments, and the weights of the edges between segments."""
    total = sum(deviation(features[labels == label]) for label in np.unique(labels))
    return float(total + weights[labels[edges[:, 0]] != labels[edges[:, 1]]].sum())


def deviation(inside: Array) -> float:
    """L1 distance of features (n, d) to their median."""
    values = inside.astype(float)
    return float(np.abs(values - np.median(values, axis=0)).sum())


def least_energy(features: Array, edges: Array, weights: Array) -> float:
    """The smallest energy of all partitions of n nodes, by dynamic programming over their 2^n subsets."""
    n = len(features)
    cost = np.zeros(1 << n)
    for subset in range(1, 1 << n):
        inside = [i for i in range(n) if subset >> i & 1]
        cost[subset] = deviation(features[inside])
        cost[subset] -= sum(
            weight for (i, j), weight in zip(edges, weights, strict=True) if subset >> i & 1 and subset >> j & 1
        )
    best = np.zeros(1 << n)
    for subset in range(1, 1 << n):
        lowest = subset & -subset
        best[subset] = np.inf
        block = subset
        while block:
            if block & lowest:
                best[subset] = min(best[subset], cost[block] + best[subset ^ block])
            block = (block - 1) & subset
    return float(best[-1] + weights.sum())


def cut_pursuit(features: Array, edges: Array, weights: Array) -> Array:
    """Segments (n,) that plain cut-pursuit ends with, for quantised features (n, d) and weights (e,).

    Starting from one segment for each connected part, all segments are split in two by minimum cuts, the splits that
    lower the energy are kept, and then adjacent segments merge, largest gain first; until the energy falls no more.
    """
    labels = connected(len(features), edges)
    least = energy(labels, features, edges, weights)
    while True:
        split = kept_splits(labels, binary_cuts(labels, features, edges, weights), features, edges, weights)
        split = merged(split, features, edges, weights)
        found = energy(split, features, edges, weights)
        if found >= least:
            return labels
        labels, least = split, found


def connected(n: int, edges: Array) -> Array:
    """Connected part of each of n nodes."""
    joined = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    return np.asarray(connected_components(joined, directed=False)[1])


def binary_cuts(labels: Array, features: Array, edges: Array, weights: Array) -> Array:
    """Side (n,) bool of each node in the best cut of its segment: minimum cuts and medians in turns."""
    values = features.astype(float)
    is_far = np.zeros(len(labels), dtype=bool)
    for label in np.unique(labels):
        inside = np.flatnonzero(labels == label)
        distance = np.abs(values[inside] - np.median(values[inside], axis=0)).sum(axis=1)
        is_far[inside[np.argmax(distance)]] = True
    is_inner = labels[edges[:, 0]] == labels[edges[:, 1]]
    for turn in range(_CUTS):
        near, far = (side_medians(labels, is_far == side, values) for side in (False, True))
        excess = np.abs(values - far).sum(axis=1) - np.abs(values - near).sum(axis=1)
        # in the first turn, k-medians without the graph: a single far voxel is no seed for a cut
        is_far = excess < 0 if turn == 0 else minimum_cut(excess, edges[is_inner], weights[is_inner])
    return is_far


def side_medians(labels: Array, is_side: Array, values: Array) -> Array:
    """For each node (n, d), the median of the nodes of its segment that are on a side; of all where none is."""
    medians = np.empty_like(values)
    for label in np.unique(labels):
        inside = labels == label
        asked = inside & is_side if np.any(inside & is_side) else inside
        medians[inside] = np.median(values[asked], axis=0)
    return medians


def minimum_cut(excess: Array, edges: Array, weights: Array) -> Array:
    """Nodes (n,) bool on the far side of the cut that costs least; ``excess`` is what that side costs a node more."""
    n = len(excess)
    source, sink = n, n + 1
    near, far = np.flatnonzero(excess > 0), np.flatnonzero(excess < 0)
    tails = np.concatenate([edges[:, 0], edges[:, 1], np.full(len(near), source), far])
    heads = np.concatenate([edges[:, 1], edges[:, 0], near, np.full(len(far), sink)])
    capacity = np.concatenate([weights, weights, excess[near], -excess[far]]) / QUANTUM
    graph = csr_array((np.rint(capacity).astype(np.int32), (tails, heads)), shape=(n + 2, n + 2))
    left = csr_array(graph - maximum_flow(graph, source, sink).flow)
    left.eliminate_zeros()
    is_far = np.ones(n + 2, dtype=bool)
    is_far[breadth_first_order(left, source, return_predecessors=False)] = False
    return is_far[:n]


def kept_splits(labels: Array, is_far: Array, features: Array, edges: Array, weights: Array) -> Array:
    """Connected parts of both sides of the segments whose split lowers the energy; the other segments as they are."""
    i, j = edges.T
    is_crossing = (labels[i] == labels[j]) & (is_far[i] != is_far[j])
    is_split = np.zeros(len(labels), dtype=bool)
    for label in np.unique(labels):
        inside = labels == label
        sides = [features[inside & is_far], features[inside & ~is_far]]
        if min(map(len, sides)):
            fall = deviation(features[inside]) - sum(map(deviation, sides))
            is_split[inside] = fall > weights[is_crossing & inside[i]].sum()
    part = 2 * labels + (is_split & is_far)
    return connected(len(labels), edges[part[i] == part[j]])


def merged(labels: Array, features: Array, edges: Array, weights: Array) -> Array:
    """Segments after merging adjacent ones, largest gain first, until no merge lowers the energy."""
    members = {label: np.flatnonzero(labels == label) for label in np.unique(labels).tolist()}
    cost = {label: deviation(features[inside]) for label, inside in members.items()}
    between: dict[int, dict[int, float]] = {label: {} for label in members}
    for a, b, weight in zip(*labels[edges].T.tolist(), weights.tolist(), strict=True):
        if a != b:
            between[a][b] = between[b][a] = between[a].get(b, 0.0) + weight

    def gain_of(a: int, b: int) -> float:
        return between[a][b] - deviation(features[np.concatenate([members[a], members[b]])]) + cost[a] + cost[b]

    gains = {(a, b): gain_of(a, b) for a in members for b in between[a] if a < b}
    while gains and max(gains.values()) > 0:
        a, b = max(gains, key=lambda pair: gains[pair])
        members[a] = np.concatenate([members[a], members.pop(b)])
        cost[a] = deviation(features[members[a]])
        for c, weight in between.pop(b).items():
            del between[c][b]
            gains.pop((min(b, c), max(b, c)))
            if c != a:
                between[a][c] = between[c][a] = between[a].get(c, 0.0) + weight
        for c in between[a]:
            gains[min(a, c), max(a, c)] = gain_of(a, c)
    result = np.empty_like(labels)
    for label, inside in members.items():
        result[inside] = label
    return result
