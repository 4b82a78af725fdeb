"""Connected components by union-find: of points linked by distance or by their normals, of pairs of nodes.

Points are joined as their links are found; no list of links is ever held.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from loda_pdal.kernels.neighbours import build_cells, empty_runs, runs_within, sq_distance

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


def components(pairs: npt.NDArray[Any], n: int) -> IntArray:
    """Connected components (n,) int32 of ``n`` nodes under the pairs (e, 2), numbered by their lowest node."""
    parent = np.arange(n, dtype=np.int32)
    _join_pairs(np.ascontiguousarray(pairs, dtype=np.int32), parent)
    _settle(parent)
    return _numbered(parent)


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


@njit(nogil=True, cache=True)
def _link(cells, radius, reach, index, parent):  # type: ignore[no-untyped-def]
    """Join sorted points within ``radius`` and, where given, within their ``reach``; ``index`` is theirs in parent."""
    runs = empty_runs(cells, radius)
    for q in range(len(cells.xyz)):
        x, y, z = cells.xyz[q, 0], cells.xyz[q, 1], cells.xyz[q, 2]
        root = _root(parent, index[cells.idx[q]])
        limit = radius
        for r in range(runs_within(cells, x, y, z, radius, runs)):
            for p in range(runs[r, 0], min(runs[r, 1], q)):
                other = index[cells.idx[p]]
                if parent[other] == root:
                    continue
                if len(reach):
                    limit = min(reach[cells.idx[q]], reach[cells.idx[p]])
                if sq_distance(cells, p, x, y, z) <= limit * limit:
                    root = _join(parent, root, other)


@njit(nogil=True, cache=True)
def _join_pairs(pairs, parent):  # type: ignore[no-untyped-def]
    for e in range(len(pairs)):
        _join(parent, pairs[e, 0], pairs[e, 1])


@njit(nogil=True, cache=True)
def _join_smooth(neighbour, normals, labels, least_cosine, parent):  # type: ignore[no-untyped-def]
    for i in range(len(neighbour)):
        for j in neighbour[i]:
            if j < 0 or labels[i] != labels[j] or parent[i] == parent[j]:
                continue
            cosine = 0.0
            for d in range(3):
                cosine += np.float64(normals[i, d]) * np.float64(normals[j, d])
            if abs(cosine) > least_cosine:
                _join(parent, i, j)


@njit(nogil=True, cache=True)
def _join(parent, a, b):  # type: ignore[no-untyped-def]
    """Join the trees of a and b; their common root."""
    a, b = _root(parent, a), _root(parent, b)
    low, high = min(a, b), max(a, b)
    parent[high] = low
    return low


@njit(nogil=True, cache=True)
def _root(parent, a):  # type: ignore[no-untyped-def]
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    return a


@njit(nogil=True, cache=True)
def _settle(parent):  # type: ignore[no-untyped-def]
    for a in range(len(parent)):
        parent[a] = _root(parent, a)


@njit(nogil=True, cache=True)
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
