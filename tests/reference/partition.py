"""The L1 Potts energy from its definition, and its true minimum on small graphs."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


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
    total = 0.0
    for label in np.unique(labels):
        inside = features[labels == label].astype(float)
        total += np.abs(inside - np.median(inside, axis=0)).sum()
    return total + weights[labels[edges[:, 0]] != labels[edges[:, 1]]].sum()


def least_energy(features: Array, edges: Array, weights: Array) -> float:
    """The smallest energy of all partitions of n nodes, by dynamic programming over their 2^n subsets."""
    n = len(features)
    cost = np.zeros(1 << n)
    for subset in range(1, 1 << n):
        inside = [i for i in range(n) if subset >> i & 1]
        values = features[inside].astype(float)
        cost[subset] = np.abs(values - np.median(values, axis=0)).sum()
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
    return best[-1] + weights.sum()
