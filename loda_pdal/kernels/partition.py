"""Loops that partition a graph of voxels: moves of nodes between regions, merges of regions, contraction.

`loda_pdal.stages.partition` holds the schedule and says what is minimised. Words used here: an *arc* is one direction
of an edge; a graph is in compressed rows (``first_arc``, ``heads``, ``weights``: the arcs of node i are
``first_arc[i]:first_arc[i + 1]``), symmetric, without loops and duplicates; a *region* is a set of voxels with one
label; ``order`` and ``start`` list the members of a group g as ``order[start[g]:start[g + 1]]``.

Features and weights are whole multiples of one power of two, so that sums of weights and of absolute deviations are
exact in float64 in whatever order they are taken: equal energies compare as equal.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[Any]

_LEAST_GAIN = 1e-6
"""A move must lower the energy by more than this."""
_SHIFT = 0.02
"""Nodes are looked at again when the medians of their region shifted by more than this in sum."""
_MOST_VISITS = 8
"""How often a node is looked at in one sweep: a safety net, and a count rather than a clock."""


@njit(nogil=True, cache=True)
def members(labels: Array, n_labels: int) -> tuple[Array, Array]:
    """Members of each label by counting sort: ``order`` (m,) int32, ascending in each label; ``start`` (n + 1,)."""
    start = np.zeros(n_labels + 1, np.int32)
    for label in labels:
        start[label + 1] += 1
    for k in range(n_labels):
        start[k + 1] += start[k]
    place = start[:-1].copy()
    order = np.empty(len(labels), np.int32)
    for i in range(len(labels)):
        order[place[labels[i]]] = i
        place[labels[i]] += 1
    return order, start


@njit(nogil=True, cache=True)
def symmetric_arcs(neighbours: Array) -> tuple[Array, Array]:
    """Rows ``first_arc`` (m + 1,) and ``heads`` of the graph that joins i and j when either lists the other.

    ``neighbours`` (m, k) int32 lists k neighbours of each node, -1 where there are fewer. Heads are ascending in
    each row.
    """
    n, k = neighbours.shape
    first_arc = np.zeros(n + 1, np.int32)
    for i in range(n):
        for t in range(k):
            j = neighbours[i, t]
            if j >= 0 and j != i:
                first_arc[i + 1] += 1
                if not _lists(neighbours, j, i):
                    first_arc[j + 1] += 1
    for i in range(n):
        first_arc[i + 1] += first_arc[i]
    heads = np.empty(first_arc[n], np.int32)
    place = first_arc[:-1].copy()
    for i in range(n):
        for t in range(k):
            j = neighbours[i, t]
            if j >= 0 and j != i:
                heads[place[i]] = j
                place[i] += 1
                if not _lists(neighbours, j, i):
                    heads[place[j]] = i
                    place[j] += 1
    for i in range(n):
        _sort_short(heads, first_arc[i], first_arc[i + 1])
    return first_arc, heads


@njit(nogil=True, cache=True)
def _lists(neighbours: Array, i: int, j: int) -> bool:
    """Whether j is among the neighbours of i."""
    for t in range(neighbours.shape[1]):  # noqa: SIM110 - compiled
        if neighbours[i, t] == j:
            return True
    return False


@njit(nogil=True, cache=True)
def _sort_short(values: Array, low: int, high: int) -> None:
    """Sort ``values[low:high]`` in place, by insertion."""
    for t in range(low + 1, high):
        value = values[t]
        s = t
        while s > low and values[s - 1] > value:
            values[s] = values[s - 1]
            s -= 1
        values[s] = value


@njit(nogil=True, cache=True)
def sq_feature_distances(first_arc: Array, heads: Array, features: Array, sq_distances: Array) -> None:
    """Fill ``sq_distances`` (arcs,) float32 with the squared distance of the features at both ends of each arc."""
    for i in range(len(first_arc) - 1):
        for arc in range(first_arc[i], first_arc[i + 1]):
            total = 0.0
            for d in range(features.shape[1]):
                gap = np.float64(features[i, d]) - np.float64(features[heads[arc], d])
                total += gap * gap
            sq_distances[arc] = total


@njit(nogil=True, cache=True)
def connected_labels(first_arc: Array, heads: Array, labels: Array) -> tuple[Array, int]:
    """Labels split into connected regions, numbered in the order of their lowest node, and how many there are."""
    n = len(labels)
    regions = np.full(n, -1, np.int32)
    stack = np.empty(n, np.int32)
    n_regions = 0
    for seed in range(n):
        if regions[seed] >= 0:
            continue
        regions[seed] = n_regions
        stack[0] = seed
        top = 1
        while top > 0:
            top -= 1
            i = stack[top]
            for arc in range(first_arc[i], first_arc[i + 1]):
                j = heads[arc]
                if regions[j] < 0 and labels[j] == labels[seed]:
                    regions[j] = n_regions
                    stack[top] = j
                    top += 1
        n_regions += 1
    return regions, n_regions


@njit(nogil=True, cache=True)
def contract(
    first_arc: Array, heads: Array, weights: Array, labels: Array, n_labels: int
) -> tuple[Array, Array, Array]:
    """The graph whose nodes are the labels: arc weights are summed, arcs inside a label vanish; O(arcs).

    The order of a row's arcs follows from the order of the input. The arrays are views of longer ones whose tails
    are never touched and so take no memory.
    """
    order, start = members(labels, n_labels)
    n_crossing = 0
    for i in range(len(labels)):
        for arc in range(first_arc[i], first_arc[i + 1]):
            n_crossing += labels[heads[arc]] != labels[i]
    new_first = np.zeros(n_labels + 1, np.int32)
    new_heads = np.empty(n_crossing, np.int32)
    new_weights = np.empty(n_crossing, np.float64)
    slot = np.full(n_labels, -1, np.int32)  # where in the output this label's arc is; valid from `first` on
    n = 0
    for label in range(n_labels):
        first = n
        for t in range(start[label], start[label + 1]):
            for arc in range(first_arc[order[t]], first_arc[order[t] + 1]):
                other = labels[heads[arc]]
                if other == label:
                    continue
                if slot[other] < first:
                    slot[other] = n
                    new_heads[n] = other
                    new_weights[n] = 0.0
                    n += 1
                new_weights[slot[other]] += weights[arc]
        new_first[label + 1] = n
    return new_first, new_heads[:n], new_weights[:n]


@njit(nogil=True, cache=True)
def _select(values: Array, n: int, k: int) -> float:
    """The k-th smallest of ``values[:n]``, which is reordered (quickselect)."""
    low, high = 0, n - 1
    while low < high:
        first, middle, last = values[low], values[(low + high) // 2], values[high]
        pivot = max(min(first, middle), min(max(first, middle), last))
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return values[k]  # type: ignore[no-any-return]


@njit(nogil=True, cache=True)
def _median_and_deviation(values: Array, n: int) -> tuple[float, float]:
    """Lower median of ``values[:n]`` (reordered) and the sum of the absolute deviations from it."""
    median = _select(values, n, (n - 1) // 2)
    deviation = 0.0
    for t in range(n):
        deviation += abs(np.float64(values[t]) - np.float64(median))
    return median, deviation


@njit(nogil=True, cache=True)
def fit_regions(
    features: Array, order: Array, start: Array, is_stale: Array, medians: Array, deviations: Array
) -> None:
    """Renew the medians (n, d) float32 and the sums of absolute deviations (n, d) float64 of stale regions."""
    scratch = np.empty(max(1, np.max(start[1:] - start[:-1])), np.float32)
    for region in range(len(is_stale)):
        if not is_stale[region]:
            continue
        low, n = start[region], start[region + 1] - start[region]
        for d in range(features.shape[1]):
            for t in range(n):
                scratch[t] = features[order[low + t], d]
            medians[region, d], deviations[region, d] = _median_and_deviation(scratch, n)


@njit(nogil=True, cache=True)
def _deviation(features: Array, order: Array, low: int, high: int, medians: Array, label: int, limit: float) -> float:
    """Sum of absolute deviations of the voxels ``order[low:high]`` from a label's medians; stops at ``limit``."""
    total = 0.0
    for t in range(low, high):
        for d in range(features.shape[1]):
            total += abs(np.float64(features[order[t], d]) - np.float64(medians[label, d]))
        if total >= limit:
            break
    return total


@njit(nogil=True, cache=True)
def _refit_labels(
    features: Array, order: Array, start: Array, labels: Array, is_stale: Array, medians: Array, is_shifted: Array
) -> None:
    """Renew the medians of stale labels; mark those whose medians shifted by more than `_SHIFT` in sum."""
    node_order, node_start = members(labels, len(is_stale))
    voxels = np.empty(len(order), np.int32)
    scratch = np.empty(len(order), np.float32)
    for label in range(len(is_stale)):
        is_shifted[label] = False
        if not is_stale[label]:
            continue
        is_stale[label] = False
        n = 0
        for s in range(node_start[label], node_start[label + 1]):
            for t in range(start[node_order[s]], start[node_order[s] + 1]):
                voxels[n] = order[t]
                n += 1
        if n == 0:
            continue
        shift = 0.0
        for d in range(features.shape[1]):
            for t in range(n):
                scratch[t] = features[voxels[t], d]
            median = _select(scratch, n, (n - 1) // 2)
            shift += abs(np.float64(median) - np.float64(medians[label, d]))
            medians[label, d] = median
        is_shifted[label] = shift > _SHIFT


@njit(nogil=True, cache=True)
def move_nodes(
    first_arc: Array,
    heads: Array,
    weights: Array,
    features: Array,
    order: Array,
    start: Array,
    labels: Array,
    medians: Array,
    n_labels: int,
    n_sweeps: int,
    opens_regions: bool,
) -> None:
    """Move nodes, one by one, to the neighbouring label that lowers the energy most; ``labels`` changes in place.

    A node is a frozen group of voxels (``order``, ``start``). Medians stand still during a sweep and are renewed
    between sweeps: each move lowers the energy for fixed medians, each renewal lowers it again.

    Parameters
    ----------
    labels : (n,) int32
        Label of each node, below ``n_labels``.
    medians : (n, d) float32
        Medians of the labels in the first ``n_labels`` rows; room for one label per node.
    n_sweeps : int
        Passes over the nodes: all in the first, later those whose label's medians shifted.
    opens_regions : bool
        Whether a node of one voxel may also get a new label of its own.
    """
    n = len(labels)
    size = np.zeros(n, np.int32)
    for label in labels:
        size[label] += 1
    unused = np.empty(n + 1, np.int32)  # a stack of labels without nodes
    n_unused = 0
    for label in range(n - 1, n_labels - 1, -1):
        unused[n_unused] = label
        n_unused += 1
    widest = 0
    for i in range(n):
        widest = max(widest, first_arc[i + 1] - first_arc[i])
    near_label = np.empty(widest + 1, np.int32)
    near_weight = np.empty(widest + 1, np.float64)
    slot = np.zeros(n, np.int32)  # place in near_label; valid only if that place names the label
    is_stale = np.zeros(n, np.bool_)
    is_shifted = np.ones(n, np.bool_)
    queue = np.empty(n, np.int32)
    is_queued = np.zeros(n, np.bool_)
    n_visits = np.zeros(n, np.int8)

    for sweep in range(n_sweeps):
        if sweep > 0:
            _refit_labels(features, order, start, labels, is_stale, medians, is_shifted)
        front, n_queued, n_moves = 0, 0, 0
        for i in range(n):
            n_visits[i] = 0
            is_queued[i] = is_shifted[labels[i]]
            if is_queued[i]:
                queue[n_queued] = i
                n_queued += 1
        while n_queued > 0:
            i = queue[front]
            front = front + 1 if front + 1 < n else 0
            n_queued -= 1
            n_visits[i] += 1
            is_queued[i] = False
            own = labels[i]

            near_label[0], near_weight[0], slot[own], n_near = own, 0.0, 0, 1
            for arc in range(first_arc[i], first_arc[i + 1]):
                label = labels[heads[arc]]
                s = slot[label]
                if s < n_near and near_label[s] == label:
                    near_weight[s] += weights[arc]
                else:
                    slot[label], near_label[n_near], near_weight[n_near] = n_near, label, weights[arc]
                    n_near += 1
            may_open = opens_regions and start[i + 1] - start[i] == 1 and size[own] > 1
            if n_near == 1 and not may_open:
                continue

            best = own
            best_cost = _deviation(features, order, start[i], start[i + 1], medians, own, np.inf) - near_weight[0]
            for s in range(1, n_near):
                limit = best_cost - _LEAST_GAIN + near_weight[s]
                if limit <= 0.0:
                    continue
                deviation = _deviation(features, order, start[i], start[i + 1], medians, near_label[s], limit)
                if deviation < limit:
                    best, best_cost = near_label[s], deviation - near_weight[s]
            if may_open and best_cost > _LEAST_GAIN:
                n_unused -= 1
                best = unused[n_unused]
                for d in range(features.shape[1]):
                    medians[best, d] = features[order[start[i]], d]
            if best == own:
                continue

            n_moves += 1
            labels[i] = best
            size[own] -= 1
            size[best] += 1
            is_stale[own] = True
            is_stale[best] = True
            if size[own] == 0:
                unused[n_unused] = own
                n_unused += 1
            for arc in range(first_arc[i], first_arc[i + 1]):
                j = heads[arc]
                if not is_queued[j] and labels[j] != best and n_visits[j] < _MOST_VISITS:
                    is_queued[j] = True
                    back = front + n_queued
                    queue[back if back < n else back - n] = j
                    n_queued += 1
        if n_moves == 0:
            break


@njit(nogil=True, cache=True)
def _shift_cost(n: float, spread: float, shift: float) -> float:
    """Estimated rise of a region's absolute deviation when its median is replaced by one ``shift`` away."""
    return n * (math.sqrt(shift * shift + spread * spread) - spread)


@njit(nogil=True, cache=True)
def _merge_cost(start: Array, medians: Array, deviations: Array, a: int, b: int, limit: float) -> float:
    """Estimated rise of the deviation when regions a and b merge; exact for two voxels; stops above ``limit``.

    Both ends of an arc get the identical number: mutual best partners would get lost otherwise.
    """
    if a > b:
        a, b = b, a
    n_a = np.float64(start[a + 1] - start[a])
    n_b = np.float64(start[b + 1] - start[b])
    are_similar = max(n_a, n_b) < 3.0 * min(n_a, n_b)
    cost = 0.0
    for d in range(medians.shape[1]):
        gap = abs(np.float64(medians[a, d]) - np.float64(medians[b, d]))
        if gap == 0.0:
            continue
        spread_a, spread_b = deviations[a, d] / n_a, deviations[b, d] / n_b
        least = min(_shift_cost(n_b, spread_b, gap), _shift_cost(n_a, spread_a, gap))
        if are_similar:
            total = n_a + n_b
            between = _shift_cost(n_a, spread_a, gap * n_b / total) + _shift_cost(n_b, spread_b, gap * n_a / total)
            least = min(least, between)
        cost += least
        if cost > limit:
            break
    return cost


@njit(nogil=True, cache=True)
def find_partners(
    first_arc: Array,
    heads: Array,
    weights: Array,
    start: Array,
    medians: Array,
    deviations: Array,
    is_dirty: Array,
    partner: Array,
    partner_weight: Array,
) -> None:
    """Renew, for dirty regions, the neighbour whose merge gains most by estimate (-1: none gains) and its weight.

    Equal gains go to the neighbour of lowest index.
    """
    for a in range(len(is_dirty)):
        if not is_dirty[a]:
            continue
        best, best_gain, best_weight = -1, 0.0, 0.0
        for arc in range(first_arc[a], first_arc[a + 1]):
            b, weight = heads[arc], weights[arc]
            if weight < best_gain or weight == 0.0:
                continue
            gain = weight - _merge_cost(start, medians, deviations, a, b, weight - best_gain)
            if gain > best_gain or (gain == best_gain and best >= 0 and b < best):
                best, best_gain, best_weight = b, gain, weight
        partner[a] = best
        partner_weight[a] = best_weight


@njit(nogil=True, cache=True)
def merge_partners(
    features: Array,
    order: Array,
    start: Array,
    deviations: Array,
    partner: Array,
    partner_weight: Array,
    labels: Array,
) -> tuple[int, int]:
    """Merge mutual partners whose exact gain is positive: fills ``labels`` (n,) with new numbers, in the old order.

    Pairs that fail the exact check are no partners any more. Returns the number of new regions and of merges.
    """
    n = len(partner)
    scratch = np.empty(2 * max(1, np.max(start[1:] - start[:-1])), np.float32)
    n_labels = 0
    for a in range(n):
        b = partner[a]
        if 0 <= b < a and partner[b] == a:  # merged, and numbered, when b had its turn
            labels[a] = labels[b]
            continue
        labels[a] = n_labels
        n_labels += 1
        if b > a and partner[b] == a:
            n_a, n_b = start[a + 1] - start[a], start[b + 1] - start[b]
            rise = 0.0
            for d in range(features.shape[1]):
                for t in range(n_a):
                    scratch[t] = features[order[start[a] + t], d]
                for t in range(n_b):
                    scratch[n_a + t] = features[order[start[b] + t], d]
                rise += _median_and_deviation(scratch, n_a + n_b)[1] - deviations[a, d] - deviations[b, d]
            if rise >= partner_weight[a]:
                partner[a] = -1
                partner[b] = -1
    return n_labels, n - n_labels


@njit(nogil=True, cache=True)
def carry_partners(
    old_partner: Array,
    old_weight: Array,
    labels: Array,
    is_merged: Array,
    first_arc: Array,
    heads: Array,
    partner: Array,
    partner_weight: Array,
    is_dirty: Array,
) -> None:
    """After a merge: bring partners to the new numbers; mark merged regions and their neighbours as dirty."""
    for a in range(len(labels)):
        partner[labels[a]] = labels[old_partner[a]] if old_partner[a] >= 0 else -1
        partner_weight[labels[a]] = old_weight[a]
    for region in range(len(is_merged)):
        if is_merged[region]:
            is_dirty[region] = True
            for arc in range(first_arc[region], first_arc[region + 1]):
                is_dirty[heads[arc]] = True


@njit(nogil=True, cache=True)
def closest_neighbours(
    first_arc: Array, heads: Array, weights: Array, medians: Array, is_asked: Array, neighbour: Array
) -> None:
    """Fill ``neighbour`` (n,), for asked regions, with the region they share most weight with; -1 without any.

    Equal weights go to the region with the nearer medians, then to the one of lowest index.
    """
    for a in range(len(is_asked)):
        neighbour[a] = -1
        if not is_asked[a]:
            continue
        best_weight, best_gap = -1.0, np.inf
        for arc in range(first_arc[a], first_arc[a + 1]):
            b = heads[arc]
            if weights[arc] < best_weight:
                continue
            gap = 0.0
            for d in range(medians.shape[1]):
                gap += abs(np.float64(medians[a, d]) - np.float64(medians[b, d]))
            is_tie = weights[arc] == best_weight
            if not is_tie or gap < best_gap or (gap == best_gap and b < neighbour[a]):
                neighbour[a], best_weight, best_gap = b, weights[arc], gap
