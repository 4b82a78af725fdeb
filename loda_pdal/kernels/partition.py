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

from loda_pdal.kernels.compiled import inlined, inner, kernel

Array = npt.NDArray[Any]

N_FEATURES = 5
"""Features of a voxel: loops of a length that the compiler knows take a third of the time."""
NONE, REFUSED = -1, -2
"""Instead of a partner: no merge gains; the best one by estimate was refused."""

_LEAST_SPREAD = 1e-9
"""Features with a smaller standard deviation do not vary."""
_ROUNDING = 1e-6
"""More than an estimate of a gain loses by rounding."""
_SHIFT = 0.02
"""Nodes are looked at again when the medians of their region shifted by more than this in sum."""
_QUEUED = 128
_MOST_VISITS = 8
"""How often a node is looked at in one sweep: a safety net, and a count rather than a clock."""


@kernel
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


@inner
def _widest(start: Array) -> int:
    """The largest number of members."""
    widest = 0
    for k in range(len(start) - 1):
        widest = max(widest, start[k + 1] - start[k])
    return widest


@kernel
def standardise(values: Array, is_known: Array, quantum: float, standard: Array) -> None:
    """Fill ``standard`` (m, 5) float32: zero mean and unit variance over the known rows, in multiples of ``quantum``.

    A column that does not vary becomes 0.
    """
    n_known = 0
    mean, spread = np.zeros(N_FEATURES), np.zeros(N_FEATURES)
    for i in range(len(values)):
        n_known += is_known[i]
        for d in range(N_FEATURES):
            mean[d] += values[i, d] if is_known[i] else 0.0
    for d in range(N_FEATURES):
        mean[d] /= n_known
    for i in range(len(values)):
        for d in range(N_FEATURES):
            spread[d] += (values[i, d] - mean[d]) ** 2 if is_known[i] else 0.0
    for d in range(N_FEATURES):
        spread[d] = math.sqrt(spread[d] / n_known)
        if spread[d] <= _LEAST_SPREAD:
            spread[d] = np.inf
    for i in range(len(values)):
        for d in range(N_FEATURES):
            standard[i, d] = np.rint((values[i, d] - mean[d]) / spread[d] / quantum) * quantum


@kernel
def symmetric_arcs(neighbours: Array) -> tuple[Array, Array]:
    """Rows ``first_arc`` (m + 1,) and ``heads`` of the graph that joins i and j when either lists the other.

    ``neighbours`` (m, k) int32 lists k different neighbours of each node, -1 where there are fewer. Heads are ascending
    in each row, because tails are visited in ascending order: a node is appended to the rows of all it lists or is
    listed by.
    """
    n, k = neighbours.shape
    first_lister = np.zeros(n + 1, np.int32)  # those that list j: listers[first_lister[j]:first_lister[j + 1]]
    for i in range(n):
        for t in range(k):
            j = neighbours[i, t]
            if j >= 0 and j != i:
                first_lister[j + 1] += 1
    for i in range(n):
        first_lister[i + 1] += first_lister[i]
    listers = np.empty(first_lister[n], np.int32)
    place = first_lister[:-1].copy()
    for i in range(n):
        for t in range(k):
            j = neighbours[i, t]
            if j >= 0 and j != i:
                listers[place[j]] = i
                place[j] += 1

    first_arc = np.zeros(n + 1, np.int32)
    met = np.empty(n, np.int32)  # the last node that met this one
    for i in range(n):
        met[i] = -1
    for i in range(n):
        n_arcs = first_lister[i + 1] - first_lister[i]
        for s in range(first_lister[i], first_lister[i + 1]):
            met[listers[s]] = i
        for t in range(k):
            j = neighbours[i, t]
            n_arcs += j >= 0 and j != i and met[j] != i
        first_arc[i + 1] = first_arc[i] + n_arcs
    heads = np.empty(first_arc[n], np.int32)
    for i in range(n):
        place[i] = first_arc[i]
        met[i] = -1
    for i in range(n):
        for s in range(first_lister[i], first_lister[i + 1]):
            j = listers[s]
            met[j] = i
            heads[place[j]] = i
            place[j] += 1
        for t in range(k):
            j = neighbours[i, t]
            if j >= 0 and j != i and met[j] != i:
                heads[place[j]] = i
                place[j] += 1
    return first_arc, heads


@kernel
def sq_feature_distances(first_arc: Array, heads: Array, features: Array) -> Array:
    """Squared distance of the features at both ends of each arc, (a,) float32."""
    sq_distances = np.empty(len(heads), np.float32)
    for i in range(len(first_arc) - 1):
        for arc in range(first_arc[i], first_arc[i + 1]):
            total = 0.0
            for d in range(N_FEATURES):
                gap = np.float64(features[i, d]) - np.float64(features[heads[arc], d])
                total += gap * gap
            sq_distances[arc] = total
    return sq_distances


@kernel
def rank_bits(bits: Array, rank: int) -> int:
    """The value of this rank among (a,) non-negative int32: counts by the upper half, then by the lower one.

    The bits of non-negative floats are ordered as the floats are.
    """
    n_below, high = 0, 0
    counts = np.zeros(1 << 16, np.int64)
    for value in bits:
        counts[value >> 16] += 1
    while n_below + counts[high] <= rank:
        n_below += counts[high]
        high += 1
    for half in range(len(counts)):
        counts[half] = 0
    for value in bits:
        counts[value & 0xFFFF] += value >> 16 == high
    low = 0
    while n_below + counts[low] <= rank:
        n_below += counts[low]
        low += 1
    return high << 16 | low


@kernel
def connected_labels(first_arc: Array, heads: Array, labels: Array) -> tuple[Array, int]:
    """Labels split into connected regions, numbered in the order of their lowest node, and how many there are.

    Every node points to a lower one of its region, or is the lowest and points to itself (union-find).
    """
    n = len(labels)
    lower = np.empty(n, np.int32)
    for i in range(n):
        lower[i] = i
        lowest = lower[i]
        for arc in range(first_arc[i], first_arc[i + 1]):
            j = heads[arc]
            if j > i or labels[j] != labels[i] or lower[j] == lowest:
                continue
            while lower[j] != j:
                lower[j] = lower[lower[j]]
                j = lower[j]
            if j < lowest:
                lower[lowest] = j
                lowest = j
            else:
                lower[j] = lowest
    n_regions = 0
    for i in range(n):
        if lower[i] == i:
            lower[i] = n_regions
            n_regions += 1
        else:
            lower[i] = lower[lower[i]]
    return lower, n_regions


@kernel
def contract(first_arc: Array, heads: Array, weights: Array, labels: Array, total: Array) -> tuple[Array, Array, Array]:
    """The graph whose nodes are the labels: arc weights are summed, arcs inside a label vanish; O(arcs).

    ``total`` is scratch for one number a label, of the type that the sums shall have. The order of a row's arcs follows
    from the order of the input. The arrays are views of longer ones whose tails are never touched and so take no
    memory.
    """
    n_labels = len(total)
    order, start = members(labels, n_labels)
    new_first = np.zeros(n_labels + 1, np.int32)
    new_heads = np.empty(len(heads) + 1, np.int32)
    new_weights = np.empty(len(heads), total.dtype)
    for label in range(n_labels):
        total[label] = -1.0  # weight between the label in hand and this one; -1 where they have not met
    for label in range(n_labels):
        n = end = new_first[label]
        for t in range(start[label], start[label + 1]):
            for arc in range(first_arc[order[t]], first_arc[order[t] + 1]):
                other = labels[heads[arc]]
                weight = total[other]
                is_first = weight < 0.0
                new_heads[end] = other
                end += is_first
                total[other] = weights[arc] + (0.0 if is_first else weight)
        for arc in range(n, end):
            other = new_heads[arc]
            new_heads[n] = other
            new_weights[n] = total[other]
            total[other] = -1.0
            n += other != label
        new_first[label + 1] = n
    n_arcs = new_first[n_labels]
    return new_first, new_heads[:n_arcs], new_weights[:n_arcs]


@inner
def _select(values: Array, n: int, k: int) -> float:
    """The k-th smallest of ``values[:n]``, which is reordered (quickselect).

    The loops swap always and count by comparing, because a branch on the order of values is mostly guessed wrong.
    """
    low, high = 0, n
    while high - low > 1:
        first, middle, last = values[low], values[(low + high) // 2], values[high - 1]
        pivot = max(min(first, middle), min(max(first, middle), last))
        smaller = low
        for t in range(low, high):
            value = values[t]
            values[t] = values[smaller]
            values[smaller] = value
            smaller += value < pivot
        if k < smaller:
            high = smaller
            continue
        larger = smaller
        for t in range(smaller, high):
            value = values[t]
            values[t] = values[larger]
            values[larger] = value
            larger += value == pivot
        if k < larger:
            return pivot  # type: ignore[no-any-return]
        low = larger
    return values[k]  # type: ignore[no-any-return]


@inner
def _median_and_deviation(values: Array, n: int) -> tuple[float, float]:
    """Lower median of ``values[:n]`` (reordered) and the sum of the absolute deviations from it."""
    median = _select(values, n, (n - 1) // 2)
    deviation = 0.0
    for t in range(n):
        deviation += abs(np.float64(values[t]) - np.float64(median))
    return median, deviation


@inner
def _gather(features: Array, voxels: Array, low: int, high: int, columns: Array, at: int) -> None:
    """Copy the features of ``voxels[low:high]`` into ``columns`` (5, n) from column ``at`` on."""
    for t in range(low, high):
        for d in range(N_FEATURES):
            columns[d, at + t - low] = features[voxels[t], d]


@kernel
def fit_regions(
    features: Array, order: Array, start: Array, is_stale: Array, medians: Array, deviations: Array
) -> None:
    """Renew the medians (n, d) float32 and the sums of absolute deviations (n, d) float64 of stale regions."""
    columns = np.empty((N_FEATURES, _widest(start)), np.float32)
    for region in range(len(is_stale)):
        if is_stale[region]:
            low, high = start[region], start[region + 1]
            _gather(features, order, low, high, columns, np.int64(0))
            for d in range(N_FEATURES):
                medians[region, d], deviations[region, d] = _median_and_deviation(columns[d], high - low)


@inner
def _least_deviation(
    n: int, node_medians: Array, node_deviations: Array, i: int, medians: Array, label: int
) -> tuple[float, bool]:
    """Sum of absolute deviations of the n voxels of node i from a label's medians, or a lower bound; whether exact."""
    total = 0.0
    if n <= 2:
        for d in range(N_FEATURES):
            gap = np.float64(node_medians[i, d]) - np.float64(medians[label, d])
            total += max(node_deviations[i, d], abs(n * gap + node_deviations[i, d]))
        return total, True
    is_same = True
    for d in range(N_FEATURES):
        gap = abs(np.float64(node_medians[i, d]) - np.float64(medians[label, d]))
        total += max(node_deviations[i, d], n * gap - node_deviations[i, d])
        is_same &= gap == 0.0
    return total, is_same


@inner
def _deviation(features: Array, order: Array, low: int, high: int, medians: Array, label: int, limit: float) -> float:
    """Sum of absolute deviations of the voxels ``order[low:high]`` from a label's medians; stops at ``limit``."""
    total = 0.0
    for t in range(low, high):
        voxel = order[t]
        for d in range(N_FEATURES):
            total += abs(np.float64(features[voxel, d]) - np.float64(medians[label, d]))
        if total >= limit:
            break
    return total


@inner
def _refit_labels(
    features: Array, order: Array, start: Array, labels: Array, is_stale: Array, medians: Array, is_shifted: Array
) -> None:
    """Renew the medians of stale labels; mark those whose medians shifted by more than `_SHIFT` in sum."""
    node_order, node_start = members(labels, len(is_stale))
    size = np.zeros(len(is_stale), np.int32)
    most = 0
    for i in range(len(labels)):
        size[labels[i]] += start[i + 1] - start[i]
        most = max(most, size[labels[i]])
    columns = np.empty((N_FEATURES, most), np.float32)
    for label in range(len(is_stale)):
        is_shifted[label] = False
        if not is_stale[label]:
            continue
        is_stale[label] = False
        if size[label] == 0:
            continue
        n = np.int64(0)
        for s in range(node_start[label], node_start[label + 1]):
            low, high = start[node_order[s]], start[node_order[s] + 1]
            _gather(features, order, low, high, columns, n)
            n += high - low
        shift = 0.0
        for d in range(N_FEATURES):
            median = _select(columns[d], n, (n - 1) // 2)
            shift += abs(np.float64(median) - np.float64(medians[label, d]))
            medians[label, d] = median
        is_shifted[label] = shift > _SHIFT


@kernel
def move_nodes(
    first_arc: Array,
    heads: Array,
    weights: Array,
    features: Array,
    order: Array,
    start: Array,
    node_medians: Array,
    node_deviations: Array,
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
    node_medians, node_deviations : (n, 5) float32 and float64
        Medians of each node's own voxels and the sums of absolute deviations from them.
    labels : (n,) int32
        Label of each node; each of 0 to ``n_labels - 1`` has nodes.
    medians : (n, 5) float32
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
    near_label = np.empty(1 + _widest(first_arc), np.int32)  # its own label first
    near_weight = np.zeros(n)  # weight towards each label; 0 but for the node in hand
    is_stale, is_shifted = np.empty(n, np.bool_), np.empty(n, np.bool_)
    for label in range(n):
        is_stale[label], is_shifted[label] = False, True
    queue = np.empty(n + 1, np.int32)  # a ring
    visits = np.empty(n, np.uint8)  # how often a node was looked at in this sweep, `_QUEUED` added while it waits

    for sweep in range(n_sweeps):
        if sweep > 0:
            _refit_labels(features, order, start, labels, is_stale, medians, is_shifted)
        front, back, n_moves = 0, 0, 0
        for i in range(n):
            queue[back] = i
            back += is_shifted[labels[i]]
            visits[i] = _QUEUED if is_shifted[labels[i]] else 0
        while front != back:
            i = queue[front]
            front = front + 1 if front < n else 0
            visits[i] -= np.uint8(_QUEUED - 1)
            own, n_voxels = labels[i], start[i + 1] - start[i]

            near_label[0], n_near = own, 1
            for arc in range(first_arc[i], first_arc[i + 1]):
                label = labels[heads[arc]]
                weight = near_weight[label]
                near_label[n_near] = label
                n_near += weight == 0.0
                near_weight[label] = weight + weights[arc]
            may_open = opens_regions and n_voxels == 1 and size[own] > 1
            if not may_open and n_near <= 2 and near_label[n_near - 1] == own:
                near_weight[own] = 0.0
                continue

            best, best_cost = own, np.inf
            for s in range(n_near):
                label = near_label[s]
                weight = near_weight[label]
                limit = best_cost + weight
                near_weight[label] = 0.0
                deviation, is_exact = _least_deviation(n_voxels, node_medians, node_deviations, i, medians, label)
                if deviation < limit:
                    if not is_exact:
                        deviation = _deviation(features, order, start[i], start[i + 1], medians, label, limit)
                    if deviation < limit:
                        best, best_cost = label, deviation - weight
            if may_open and best_cost > 0.0:
                n_unused -= 1
                best = unused[n_unused]
                for d in range(N_FEATURES):
                    medians[best, d] = node_medians[i, d]
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
                is_asked = (labels[j] != best) & (visits[j] < _MOST_VISITS)
                queue[back] = j
                back = (back + 1 if back < n else 0) if is_asked else back
                visits[j] += _QUEUED if is_asked else 0
        if n_moves == 0:
            break


@inner
def _shift_cost(n: float, spread: float, shift: float) -> float:
    """Estimated rise of a region's absolute deviation when its median is replaced by one ``shift`` away."""
    return n * (math.sqrt(shift * shift + spread * spread) - spread)


@inlined  # a call would take three times as long
def _least_merge_cost(n_a: float, n_b: float, medians: Array, deviations: Array, a: int, b: int) -> float:
    """Lower bound of `_merge_cost`, without roots: sqrt(shift^2 + spread^2) is at least the shift."""
    are_similar = 1.0 if max(n_a, n_b) < 3.0 * min(n_a, n_b) else 0.0
    cost = 0.0
    for d in range(N_FEATURES):
        gap = abs(np.float64(medians[a, d]) - np.float64(medians[b, d]))
        cost_a = n_a * gap - deviations[a, d] - are_similar * deviations[b, d]
        cost_b = n_b * gap - deviations[b, d] - are_similar * deviations[a, d]
        cost += max(0.0, min(cost_a, cost_b))
    return cost


@inner
def _merge_cost(start: Array, medians: Array, deviations: Array, a: int, b: int) -> float:
    """Estimated rise of the deviation when regions a and b merge; exact for two voxels.

    Both ends of an arc get the identical number: mutual best partners would get lost otherwise.
    """
    if a > b:
        a, b = b, a
    n_a = np.float64(start[a + 1] - start[a])
    n_b = np.float64(start[b + 1] - start[b])
    are_similar = max(n_a, n_b) < 3.0 * min(n_a, n_b)
    cost = 0.0
    for d in range(N_FEATURES):
        gap = abs(np.float64(medians[a, d]) - np.float64(medians[b, d]))
        spread_a, spread_b = deviations[a, d] / n_a, deviations[b, d] / n_b
        least = min(_shift_cost(n_b, spread_b, gap), _shift_cost(n_a, spread_a, gap))
        if are_similar:
            total = n_a + n_b
            between = _shift_cost(n_a, spread_a, gap * n_b / total) + _shift_cost(n_b, spread_b, gap * n_a / total)
            least = min(least, between)
        cost += least
    return cost


@kernel
def find_voxel_partners(
    first_arc: Array,
    heads: Array,
    weights: Array,
    features: Array,
    partner: Array,
    partner_weight: Array,
    partner_gain: Array,
) -> None:
    """What `find_partners` finds among single voxels, whose gains need no estimate. Heads are ascending in each row."""
    for a in range(len(partner)):
        best, best_gain, best_weight = np.int32(NONE), 0.0, 0.0
        for arc in range(first_arc[a], first_arc[a + 1]):
            b = heads[arc]
            gain = np.float64(weights[arc])
            for d in range(N_FEATURES):
                gain -= abs(np.float64(features[a, d]) - np.float64(features[b, d]))
            if gain > best_gain:
                best, best_gain, best_weight = b, gain, np.float64(weights[arc])
        partner[a], partner_gain[a], partner_weight[a] = best, best_gain, best_weight


@kernel
def find_partners(
    first_arc: Array,
    heads: Array,
    weights: Array,
    start: Array,
    medians: Array,
    deviations: Array,
    is_new: Array,
    partner: Array,
    partner_weight: Array,
    partner_gain: Array,
) -> None:
    """Renew for each region the neighbour whose merge gains most by estimate, that merge's weight and its gain.

    Equal gains go to the neighbour of lowest index; `NONE` where no merge gains. Only what new regions change is
    computed: a region that is not new, and whose partner is not, compares it with its new neighbours alone.
    """
    for a in range(len(is_new)):
        best, best_gain, best_weight = NONE, 0.0, 0.0
        asks_all = is_new[a]
        if not asks_all:
            has_new = False
            for arc in range(first_arc[a], first_arc[a + 1]):
                has_new |= is_new[heads[arc]]
            if not has_new:
                continue
            old = partner[a]
            asks_all = old == REFUSED or (old >= 0 and is_new[old])
            if not asks_all:
                best, best_gain, best_weight = old, partner_gain[a], partner_weight[a]
        n_a = np.float64(start[a + 1] - start[a])
        for arc in range(first_arc[a], first_arc[a + 1]):
            b, weight = heads[arc], weights[arc]
            if not (asks_all or is_new[b]):
                continue
            n_b = np.float64(start[b + 1] - start[b])
            most = weight - _least_merge_cost(n_a, n_b, medians, deviations, a, b)
            if most < best_gain - _ROUNDING or most <= 0.0:
                continue
            gain = weight - _merge_cost(start, medians, deviations, a, b)
            if gain > best_gain or (gain == best_gain and best >= 0 and b < best):
                best, best_gain, best_weight = b, gain, weight
        partner[a], partner_gain[a], partner_weight[a] = best, best_gain, best_weight


@kernel
def merge_partners(
    features: Array,
    order: Array,
    start: Array,
    medians: Array,
    deviations: Array,
    partner: Array,
    partner_weight: Array,
    labels: Array,
    new_medians: Array,
    new_deviations: Array,
) -> int:
    """Merge mutual partners whose exact gain is positive; returns the number of new regions.

    Fills ``labels`` (n,) with new numbers, in the old order, and the first rows of ``new_medians`` (n, 5) and
    ``new_deviations`` (n, 5). Partners that fail the exact check become `REFUSED`.
    """
    n = len(partner)
    columns = np.empty((N_FEATURES, 2 * _widest(start)), np.float32)
    n_labels = 0
    for a in range(n):
        b = partner[a]
        is_pair = b >= 0 and partner[b] == a
        if is_pair and b < a:  # merged, and numbered, when b had its turn
            labels[a] = labels[b]
            continue
        new = n_labels
        labels[a] = new
        n_labels += 1
        if is_pair:
            n_a, n_b = start[a + 1] - start[a], start[b + 1] - start[b]
            rise = 0.0
            if n_a + n_b > 2:
                _gather(features, order, start[a], start[a + 1], columns, np.int64(0))
                _gather(features, order, start[b], start[b + 1], columns, n_a)
            for d in range(N_FEATURES):
                if n_a + n_b > 2:
                    median, deviation = _median_and_deviation(columns[d], n_a + n_b)
                else:
                    median = min(medians[a, d], medians[b, d])
                    deviation = abs(np.float64(medians[a, d]) - np.float64(medians[b, d]))
                new_medians[new, d], new_deviations[new, d] = median, deviation
                rise += deviation - deviations[a, d] - deviations[b, d]
            if rise < partner_weight[a]:
                continue
            partner[a] = REFUSED
            partner[b] = REFUSED
        for d in range(N_FEATURES):
            new_medians[new, d] = medians[a, d]
            new_deviations[new, d] = deviations[a, d]
    return n_labels


@kernel
def carry_partners(
    old_partner: Array,
    old_weight: Array,
    old_gain: Array,
    labels: Array,
    partner: Array,
    partner_weight: Array,
    partner_gain: Array,
) -> None:
    """After a merge: bring partners to the new numbers. What is said of merged regions is to be renewed."""
    for a in range(len(labels)):
        partner[labels[a]] = labels[old_partner[a]] if old_partner[a] >= 0 else old_partner[a]
        partner_weight[labels[a]] = old_weight[a]
        partner_gain[labels[a]] = old_gain[a]


@kernel
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
            for d in range(N_FEATURES):
                gap += abs(np.float64(medians[a, d]) - np.float64(medians[b, d]))
            is_tie = weights[arc] == best_weight
            if not is_tie or gap < best_gap or (gap == best_gap and b < neighbour[a]):
                neighbour[a], best_weight, best_gap = b, weights[arc], gap
