"""Poles among twigs: what stands upright and thin in both epochs, out of the foliage that hangs on it (METHOD 2b).

A lamp post in a crown is one object with the tree, and where the tree grows the post has grown; a pole from which the
twigs of a tree hung that was felled has shrunk. But the ground floor of a street has no foliage: there each stem shows
by itself, and what shows in both epochs at one place has not changed with what is above it.
"""

from __future__ import annotations

import numpy as np

from loda_pdal.kernels.clusters import linked
from loda_pdal.kernels.neighbours import nearest
from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array, IntArray
from loda_pdal.model.groups import Groups, consecutive
from loda_pdal.model.pair import Pair
from loda_pdal.stages.cues import Surface

_BREAST_M = (0.6, 2.2)
"""Heights above ground between which stems show."""

_LINK_M = 0.4
"""Points of a stem lie no farther apart in plan: a fused point and the noise."""

_WIDE_M = 0.6
"""Stems are no wider."""

_TALL_M = 1.0
"""Between these heights they are seen over as much, unless something stands before them."""

_LEAST_POINTS = 4
"""Fused points of a stem there."""

_PLACE_M = 0.25
"""Stems of two epochs this near in plan are one."""

_REACH_M = 0.35
"""What lies this near to the middle of a pole, in plan, belongs to it, however high."""

_CROWN_M = 3.0
"""What is higher tells which stem a tree has."""


def split_poles(surfaces: Pair[Surface], is_plant: BoolArray, is_other: BoolArray) -> tuple[Pair[IntArray], IntArray]:
    """Poles taken out of what hangs on them.

    Parameters
    ----------
    surfaces : Pair of Surface
        Points with their objects, 0 to ``n - 1``.
    is_plant, is_other : (n,) bool
        Objects of both epochs that are looked through. A plant keeps the stem that stands nearest to the middle of its
        crown: its own.

    Returns
    -------
    owner : Pair of (m,) int32
        Object of each point; poles are numbered from ``n`` on.
    host : (t,) int32
        The object that each pole was part of.
    """
    n = len(is_plant)
    owner = surfaces.map(lambda side: side.owner)
    before, after = surfaces.map(lambda side: _stems(side, is_plant | is_other))
    if len(before) == 0 or len(after) == 0:
        return owner, np.zeros(0, dtype=np.int32)
    found, back = nearest(after, before, _PLACE_M)[0], nearest(before, after, _PLACE_M)[0]
    both = np.flatnonzero((found >= 0) & (back[found] == np.arange(len(before))))
    place = (before[both] + after[found[both]]) / 2
    host = np.rint(place[:, 2] / _LIFT_M).astype(np.int32)
    away = np.linalg.norm(place[:, :2] - _crown_middles(surfaces, n)[host], axis=1)
    order = np.lexsort((away, host))
    is_own = np.zeros(len(host), np.bool_)
    is_own[order] = np.diff(host[order], prepend=-1) != 0
    is_pole = ~(is_own & is_plant[host])
    place, host = place[is_pole], host[is_pole]

    def with_poles(side: Surface) -> IntArray:
        member = np.flatnonzero(np.isin(side.owner, host))
        pole, _ = nearest(place, _flat(side, member), _REACH_M)
        mine = side.owner.copy()
        mine[member] = np.where(pole >= 0, n + pole, mine[member])
        return mine

    return (surfaces.map(with_poles) if len(host) else owner), host


_LIFT_M = 100.0
"""Objects are lifted so far from each other that none sees another."""


def _stems(side: Surface, is_asked: BoolArray) -> FloatArray:
    """Middles (s, 3) of the stems of one epoch: x, y, and the object they belong to, lifted."""
    low, high = _BREAST_M
    is_breast = np.append(is_asked, False)[side.owner] & (side.height > low) & (side.height < high)
    member = np.flatnonzero(is_breast)
    flat = _flat(side, member)
    label, k = consecutive(linked(flat, _LINK_M))
    groups = Groups(label, k)
    lowest, highest = groups.extremes(side.height[member])
    wide = groups.maximum(flat[:, :2]) - groups.minimum(flat[:, :2])
    is_stem = (
        (groups.counts >= _LEAST_POINTS) & (highest - lowest >= _TALL_M) & (wide.max(axis=1, initial=0) <= _WIDE_M)
    )
    return np.asarray(groups.mean(flat)[is_stem])


def _flat(side: Surface, member: Int64Array) -> FloatArray:
    """Some points (k, 3) in plan, each object at a height of its own."""
    return np.column_stack([side.xyz[member, :2], side.owner[member] * _LIFT_M])


def _crown_middles(surfaces: Pair[Surface], n: int) -> FloatArray:
    """Middle in plan (n, 2) m of what each object has above 3 m, the mean of both epochs'; NaN where it has none."""

    def middle(side: Surface) -> FloatArray:
        return Groups(np.where(side.height > _CROWN_M, side.owner, -1), n).mean(side.xyz[:, :2])

    before, after = surfaces.map(middle)
    return np.asarray((before + after) / 2)
