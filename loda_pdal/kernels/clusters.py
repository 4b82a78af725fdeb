"""Connected components by union-find: of points linked by distance or by their normals, of pairs of nodes.

Points are joined as their links are found; no list of links is ever held.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from loda_pdal.kernels.cells import build_cells, empty_runs, runs_within, sq_distance
from loda_pdal.kernels.compiled import inner, kernel
from loda_pdal.kernels.parallel import run_ranges

IntArray = npt.NDArray[np.int32]


def linked(xyz: npt.NDArray[Any], radius: float, reach: npt.NDArray[Any] | None = None) -> IntArray:
    """Clusters of points (n, 3), m: two are linked within ``radius`` or, if given, within both points' ``reach``.

    Parameters
    ----------
    xyz : (n, 3) float, m
    radius : float, m
        Every link is at most this long, unless ``reach`` allows a longer one.
    reach : (n,) float, m, optional
        At least ``radius`` each. Points that reach farther than ``radius`` should be few and far between: only they are
        looked at again at the longest reach.

    Returns
    -------
    (n,) int32
        Cluster of each point: the lowest index in it.
    """
    parent = np.arange(len(xyz), dtype=np.int32)
    if len(xyz) == 0:
        return parent
    _link(build_cells(xyz, radius), float(radius), np.zeros(0), parent.copy(), parent)
    if reach is not None:
        far = np.flatnonzero(np.asarray(reach) > radius).astype(np.int32)
        if len(far):
            far_reach = np.asarray(reach, dtype=np.float64)[far]
            longest = float(far_reach.max())
            _link(build_cells(xyz[far], longest), longest, far_reach, far, parent)
    _settle(parent)
    return parent


def dbscan(xyz: npt.NDArray[Any], weight: IntArray, radius: float, least_weight: int) -> IntArray:
    """DBSCAN clusters of points (n, 3), m; a core point has ``least_weight`` within ``radius``, itself included.

    Returns
    -------
    (n,) int32
        Cluster of each point: the lowest index of its core points; -1 noise. A point that is no core joins the cluster
        of its nearest core (ties: lowest index), so the order of the points does not matter.
    """
    parent = np.arange(len(xyz), dtype=np.int32)
    if len(xyz) == 0:
        return parent
    cells = build_cells(xyz, radius)
    is_core = np.zeros(len(xyz), dtype=np.bool_)
    run_ranges(_core_range, len(xyz), cells, weight.astype(np.int32), float(radius), least_weight, is_core)
    _link(cells, float(radius), np.where(is_core, float(radius), 0.0), parent.copy(), parent)
    _settle(parent)
    cluster: IntArray = np.where(is_core, parent, -1)
    precise = np.ascontiguousarray(xyz, dtype=np.float64)
    run_ranges(_border_range, len(xyz), cells, precise, is_core, float(radius), cluster)
    return cluster


def count_until(xyz: npt.NDArray[Any], radius: float, enough: int) -> IntArray:
    """How many points of a cloud (n, 3) lie within ``radius``, m, of each of its points, itself included, (n,) int32.

    Counting stops somewhere behind ``enough``.
    """
    counts = np.zeros(len(xyz), dtype=np.int32)
    if len(xyz):
        run_ranges(_count_range, len(xyz), build_cells(xyz, radius), float(radius), enough, counts)
    return counts


def components(pairs: npt.NDArray[Any], n: int) -> IntArray:
    """Connected components (n,) int32 of ``n`` nodes under the pairs (e, 2), numbered by their lowest node."""
    parent = np.arange(n, dtype=np.int32)
    _join_pairs(np.ascontiguousarray(pairs, dtype=np.int32), parent)
    _settle(parent)
    number: IntArray = _numbered(parent)
    return number


def smooth_pieces(
    neighbour: IntArray, normals: npt.NDArray[np.float32], labels: IntArray, least_cosine: float
) -> IntArray:
    """Pieces of labelled points: neighbours of one label are linked where their normals agree.

    Parameters
    ----------
    neighbour : (n, k) int32
        Neighbours of each point, -1 padded.
    normals : (n, 3) float32
        Unit normals; their sign does not matter.
    labels : (n,) int32
    least_cosine : float
        Linked are neighbours whose normals have a larger cosine than this.

    Returns
    -------
    (n,) int32
        Piece of each point: the lowest index in it.
    """
    parent = np.arange(len(neighbour), dtype=np.int32)
    _join_smooth(neighbour, normals, labels, float(least_cosine), parent)
    _settle(parent)
    return parent


@kernel
def _link(cells, radius, reach, index, parent):  # type: ignore[no-untyped-def]
    """Join points of the cell list within ``radius`` and, where given, both ``reach``; ``index`` is theirs in parent.

    The trees are grown in the order of the list, where neighbours stand close together, and then handed to ``parent``.
    """
    n = len(cells.xyz)
    tree = np.empty(n, dtype=np.int32)
    runs = empty_runs(cells, radius)
    limit = radius
    for q in range(n):
        x, y, z = cells.xyz[q, 0], cells.xyz[q, 1], cells.xyz[q, 2]
        tree[q] = root = q
        for r in range(runs_within(cells, x, y, z, radius, runs)):
            for p in range(runs[r, 0], min(runs[r, 1], q)):
                if tree[p] == root:
                    continue
                if len(reach):
                    limit = min(reach[cells.idx[q]], reach[cells.idx[p]])
                if sq_distance(cells, p, x, y, z) <= limit * limit:
                    root = _join(tree, root, p)
    for q in range(n):
        _join(parent, np.int64(index[cells.idx[q]]), np.int64(index[cells.idx[tree[q]]]))


@kernel
def _core_range(start, stop, cells, weight, radius, least_weight, is_core):  # type: ignore[no-untyped-def]
    runs = empty_runs(cells, radius)
    for q in range(start, stop):
        x, y, z = cells.xyz[q, 0], cells.xyz[q, 1], cells.xyz[q, 2]
        reached = 0
        for r in range(runs_within(cells, x, y, z, radius, runs)):
            for p in range(runs[r, 0], runs[r, 1]):
                if sq_distance(cells, p, x, y, z) <= radius * radius:
                    reached += weight[cells.idx[p]]
        is_core[cells.idx[q]] = reached >= least_weight


@kernel
def _border_range(start, stop, cells, xyz, is_core, radius, cluster):  # type: ignore[no-untyped-def]
    """Give points that are no core the cluster of the nearest one in reach."""
    runs = empty_runs(cells, radius)
    for q in range(start, stop):
        own, host, least = cells.idx[q], -1, np.inf
        if is_core[own]:
            continue
        x, y, z = cells.xyz[q, 0], cells.xyz[q, 1], cells.xyz[q, 2]
        for r in range(runs_within(cells, x, y, z, radius, runs)):
            for p in range(runs[r, 0], runs[r, 1]):
                other = cells.idx[p]
                if is_core[other] and sq_distance(cells, p, x, y, z) <= radius * radius:
                    dx, dy, dz = xyz[own, 0] - xyz[other, 0], xyz[own, 1] - xyz[other, 1], xyz[own, 2] - xyz[other, 2]
                    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
                    if distance < least or (distance == least and other < host):
                        least, host = distance, other
        if host >= 0:
            cluster[own] = cluster[host]


@kernel
def _count_range(start, stop, cells, radius, enough, counts):  # type: ignore[no-untyped-def]
    runs = empty_runs(cells, radius)
    for q in range(start, stop):
        x, y, z = cells.xyz[q, 0], cells.xyz[q, 1], cells.xyz[q, 2]
        count = 0
        for r in range(runs_within(cells, x, y, z, radius, runs)):
            for p in range(runs[r, 0], runs[r, 1]):
                count += sq_distance(cells, p, x, y, z) <= radius * radius
            if count >= enough:
                break
        counts[cells.idx[q]] = count


@kernel
def _join_pairs(pairs, parent):  # type: ignore[no-untyped-def]
    for e in range(len(pairs)):
        _join(parent, np.int64(pairs[e, 0]), np.int64(pairs[e, 1]))


@kernel
def _join_smooth(neighbour, normals, labels, least_cosine, parent):  # type: ignore[no-untyped-def]
    for i in range(len(neighbour)):
        for j in neighbour[i]:
            if j < 0 or labels[i] != labels[j] or parent[i] == parent[j]:
                continue
            cosine = 0.0
            for d in range(3):
                cosine += np.float64(normals[i, d]) * np.float64(normals[j, d])
            if abs(cosine) > least_cosine:
                _join(parent, i, np.int64(j))


@inner
def _join(parent, a, b):  # type: ignore[no-untyped-def]
    """Join the trees of a and b; their common root."""
    a, b = _root(parent, a), _root(parent, b)
    low, high = min(a, b), max(a, b)
    parent[high] = low
    return low


@inner
def _root(parent, a):  # type: ignore[no-untyped-def]
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    return a


@kernel
def _settle(parent):  # type: ignore[no-untyped-def]
    for a in range(len(parent)):
        parent[a] = _root(parent, a)


@kernel
def _numbered(parent):  # type: ignore[no-untyped-def]
    """Settled roots numbered in ascending order: a root is never behind its tree."""
    number = np.empty(len(parent), dtype=np.int32)
    n = 0
    for a in range(len(parent)):
        if parent[a] == a:
            number[a] = n
            n += 1
        else:
            number[a] = number[parent[a]]
    return number
