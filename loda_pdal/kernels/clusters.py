"""Clusters of points that are linked by distance: union-find over a cell list, no list of links is ever held."""

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
    _link(build_cells(xyz, radius), radius, np.full(len(xyz), radius), np.arange(len(xyz), dtype=np.int32), parent)
    if reach is not None:
        far = np.flatnonzero(np.asarray(reach) > radius).astype(np.int32)
        if len(far):
            longest = float(np.max(reach))
            _link(build_cells(xyz[far], longest), longest, np.asarray(reach, dtype=np.float64)[far], far, parent)
    _settle(parent)
    return parent


@njit(nogil=True, cache=True)
def _link(cells, radius, reach, index, parent):  # type: ignore[no-untyped-def]
    runs = empty_runs(cells, radius)
    for q in range(len(cells.xyz)):
        x, y, z = cells.xyz[q, 0], cells.xyz[q, 1], cells.xyz[q, 2]
        own = cells.idx[q]
        for r in range(runs_within(cells, x, y, z, radius, runs)):
            for p in range(runs[r, 0], min(runs[r, 1], q)):
                limit = min(reach[own], reach[cells.idx[p]])
                if sq_distance(cells, p, x, y, z) <= limit * limit:
                    _join(parent, index[own], index[cells.idx[p]])


@njit(nogil=True, cache=True)
def _join(parent, a, b):  # type: ignore[no-untyped-def]
    a, b = _root(parent, a), _root(parent, b)
    if a < b:
        parent[b] = a
    elif b < a:
        parent[a] = b


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
