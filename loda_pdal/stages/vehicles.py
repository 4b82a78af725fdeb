"""Is it the same vehicle: shapes compared after a small move (beyond the paper, which asks for overlap alone).

Another vehicle in the same slot overlaps with the one that left, and may be as high; the same one may have been parked
again, half a metre on. So each is moved and turned until it fits, and what then still lies apart is another shape.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from loda_pdal.kernels.neighbours import nearest
from loda_pdal.model.boxes import upright_boxes
from loda_pdal.model.cloud import BoolArray, FloatArray, IntArray
from loda_pdal.model.groups import Groups, count_cells
from loda_pdal.model.pair import Pair
from loda_pdal.stages.cues import Surface
from loda_pdal.stages.parked import across

_ITERATIONS = 10
_REACH_M = 0.6
"""Surfaces farther apart do not pull at each other while a vehicle is moved."""

_SOFT_M = 0.05
"""Residual at which a pair of points pulls half as much as a perfect one."""

_MOST = np.array([0.8, 0.8, 0.1, 0.1])
"""A vehicle is moved no farther along x, y and z (m), and turned no more about its middle (rad)."""

_NEAR_M = 0.35
"""Surfaces this close are the same surface: seen by both."""

_FAR_M = 1.0
"""Residual of points with nothing closer."""

_LEAST_M = (1.2, 2.2, 1.1)
"""Width, length and height of what can be a vehicle."""

ONE_VEHICLE_M = (2.8, 7.0)
"""Width and length beyond which it is two of them, or something else."""

_LEAST_FILL = 0.6
_CELL_M = 0.5
_MIN_POINTS = 30
_APART_M = 100.0
"""Vehicles are lifted so far from each other that none sees another: one search serves them all."""


class Fit(NamedTuple):
    """How well objects fit themselves in the other epoch; NaN where not asked for or too few points.

    Attributes
    ----------
    off : (n,) float64, m
        How far their shapes differ after the best move.
    move : (n, 3) float64, m
        That move along x, y and z, from before to after.
    """

    off: FloatArray
    move: FloatArray


def shape_change(surfaces: Pair[Surface], is_open: Pair[BoolArray], is_asked: BoolArray) -> Fit:
    """How far the shapes of objects differ between the epochs, and how far they were moved to fit.

    The upper quartile of the point-to-plane residuals of one epoch's points on the other's surface after the best move,
    from the epoch that fits better: what only one epoch shows of a vehicle does not count against it. The move is the
    mean of that of one epoch onto the other, and of the other one back.

    Parameters
    ----------
    surfaces : Pair of Surface
        Points with their objects.
    is_open : Pair of (m,) bool
        Whether the other epoch could see where the point is.
    is_asked : (n,) bool
        Objects that are compared, present in both epochs.
    """
    n = len(is_asked)
    if not is_asked.any():
        return Fit(np.full(n, np.nan), np.full((n, 3), np.nan))
    sides = lifted(surfaces, is_asked, is_open)
    forth, back = _fit(sides.before, sides.after, n), _fit(sides.after, sides.before, n)
    return Fit(np.fmin(forth.off, back.off), (forth.move - back.move) / 2)


def roughness(surfaces: Pair[Surface], is_asked: BoolArray) -> FloatArray:
    """Upper quartile (n,) m of the distances of an object's points from the planes of their neighbours, in the rougher
    epoch; NaN where not asked for: foliage lies that far from itself, and so do noisy surveys."""
    n = len(is_asked)
    rough = [np.full(n, np.nan)]
    for side in surfaces:
        members = np.flatnonzero(np.append(is_asked, False)[side.owner])
        if len(members) < 2:
            continue
        neighbour, distance, _ = across(side.xyz[members], side.normals[members])
        label = np.where(neighbour >= 0, side.owner[members][:, None], -1)
        rough.append(Groups(label.ravel(), n).quantile(distance.ravel(), 0.75))
    return np.asarray(np.fmax.reduce(rough))


def looks_like_vehicle(
    surfaces: Pair[Surface], n: int, most_m: tuple[float, float] = (math.inf, math.inf)
) -> BoolArray:
    """Which objects (n,) are as large as a vehicle in both epochs, but no wider and longer than ``most_m``, and fill
    their box: no wall, hedge or bin."""
    fits = np.ones(n, np.bool_)
    for side in surfaces:
        size = upright_boxes(side.xyz, side.owner, n).size
        width, length = np.sort(size[:, :2], axis=1).T
        filled = count_cells(side.xyz[:, :2], side.owner, n, _CELL_M) * _CELL_M**2
        fits &= (width > _LEAST_M[0]) & (length > _LEAST_M[1]) & (size[:, 2] > _LEAST_M[2])
        fits &= (width < most_m[0]) & (length < most_m[1])
        fits &= filled > _LEAST_FILL * width * length
    return fits


def tops_differ(surfaces: Pair[Surface], is_asked: BoolArray) -> FloatArray:
    """How surely the tops of vehicles that are seen from above differ, (n,); NaN where not asked for, where one is no
    whole vehicle, or where too few points tell.

    A few returns have no shape, and the roofs of an estate and a saloon are as high: they differ along a metre of their
    length. A top counts by how far it lies above or below all that the other epoch shows within a point spacing of it,
    the ground beside it too. What is higher counts against what is lower, along each metre of the vehicle, over
    the root of the number of points there, as the sum of what is chance would grow; after the move that leaves least.

    Parameters
    ----------
    surfaces : Pair of Surface
        All points, those of objects with their owners 0 to ``n - 1``.
    is_asked : (n,) bool
        Objects that are compared, present in both epochs.
    """
    n = len(is_asked)
    sure = np.full(n, np.nan)
    is_whole = is_asked.copy()
    for side in surfaces:
        tops = side.only((side.n_raw > 0) & np.append(is_asked, False)[side.owner])
        length, width = upright_boxes(tops.xyz, tops.owner, n).size[:, :2].T
        is_whole &= (width > _LEAST_M[0]) & (length > np.fmax(_LEAST_M[1], _SLENDER * width))
        is_whole &= (width < ONE_VEHICLE_M[0]) & (length < ONE_VEHICLE_M[1])
    if not is_whole.any():
        return sure
    measured = surfaces.map(lambda side: np.flatnonzero((side.n_raw > 0) & np.append(is_whole, False)[side.owner]))
    xyz = surfaces.join(measured, lambda side, top: side.xyz[top])
    owner = np.concatenate(list(surfaces.join(measured, lambda side, top: side.owner[top])))
    about = surfaces.map(lambda side: side.xyz[side.n_raw > 0])
    tree = about.map(lambda points: cKDTree(points[:, :2]))
    both, groups = np.concatenate(list(xyz))[:, :2], Groups(owner, n)
    number = tree.map(lambda side: groups.mean(side.query_ball_point(both, _AROUND_M, return_length=True)))
    spacing = _AROUND_M * np.sqrt(np.pi / np.fmax(np.fmin(*number), 1.0))  # of the sparser epoch
    reach = _SPACINGS * spacing[owner]
    boxes = upright_boxes(np.column_stack([both, np.zeros(len(both))]), owner, n)
    along = np.sum((both - boxes.centre[owner, :2]) * boxes.axes[owner, 0, :2], axis=1)
    n_before = len(xyz.before)
    before = _Facing.of(xyz.before, about.after, tree.after, reach[:n_before])
    after = _Facing.of(xyz.after, about.before, tree.before, reach[n_before:])
    for move in _MOVES_M:
        off = np.concatenate([-before.beyond(move), after.beyond(-move)])
        place = along.copy()
        place[:n_before] += boxes.axes[owner[:n_before], 0, :2] @ move
        sure = np.fmin(sure, _along(place, off, owner, n))
    return sure


class _Facing(NamedTuple):
    """Points (k, 3) m of one epoch, those (m, 3) m of the other one, pairs (p,) of them that are near in plan, and the
    ``reach`` (k,) m within which they count."""

    xyz: FloatArray
    other: FloatArray
    own: IntArray
    theirs: IntArray
    reach: FloatArray

    @staticmethod
    def of(xyz: FloatArray, other: FloatArray, tree: cKDTree, reach: FloatArray) -> _Facing:
        """All pairs that any move may bring within reach; ``tree`` of the other points in plan."""
        found = tree.query_ball_point(xyz[:, :2], reach + _FARTHEST_M, return_sorted=True)
        own = np.repeat(np.arange(len(xyz), dtype=np.int32), [len(ids) for ids in found])
        return _Facing(xyz, other, own, np.fromiter(itertools.chain(*found), np.int32, len(own)), reach)

    def beyond(self, move: FloatArray) -> FloatArray:
        """How far each point (k,), after a ``move`` (2,) m, lies above or below (less than 0) all others in its reach,
        over `_DIFFERS_M` and at most 1; NaN where there are fewer than two."""
        offset = self.xyz[self.own, :2] + move - self.other[self.theirs, :2]
        is_in = np.sum(offset**2, axis=1) <= self.reach[self.own] ** 2
        near = Groups(np.where(is_in, self.own, -1), len(self.xyz))
        low, high = near.extremes(self.other[self.theirs, 2])
        z = self.xyz[:, 2]
        off = np.clip((np.fmax(z - high, 0.0) - np.fmax(low - z, 0.0)) / _DIFFERS_M, -1.0, 1.0)
        return np.where(near.counts >= 2, off, np.nan)


def _along(place: FloatArray, off: FloatArray, owner: IntArray, n: int) -> FloatArray:
    """The largest sum (n,) of ``off`` (k,) over a metre of each vehicle over the root of the points there; ``place``
    (k,) m along it. NaN where fewer than `_LEAST_TOPS` points tell."""
    order = np.lexsort((place, owner))
    order = order[np.isfinite(off[order])]
    number, off = owner[order], off[order]
    place = place[order] + number * _APART_M
    first = np.searchsorted(place, place - _STRETCH_M / 2)
    last = np.searchsorted(place, place + _STRETCH_M / 2, side="right")
    total = np.concatenate([[0.0], np.cumsum(off)])
    count = last - first
    surplus = np.where(count >= _LEAST_ALONG, np.abs(total[last] - total[first]) / np.sqrt(count), 0.0)
    groups = Groups(number, n)
    return np.where(groups.counts >= _LEAST_TOPS, groups.maximum(surplus), np.nan)


_SLENDER = 1.5
"""Vehicles are more than so many times as long as wide; boxes about a few returns of one are too."""

_AROUND_M = 3.0
"""The point spacing about a vehicle is that within so wide a circle."""

_SPACINGS = 1.1
"""Point spacings within which the other epoch shows a few points of the same surface."""

_MOVES_M = 0.1 * np.array([(x, y) for x in range(-2, 3) for y in range(-2, 3)])
"""Moves (25, 2) in plan that are tried: what is left of the registration, and a slot that was not met the same way."""

_FARTHEST_M = 0.3
"""No move is longer."""

_DIFFERS_M = 0.3
"""A top that lies so far beyond all about it counts in full."""

_STRETCH_M = 1.0
"""Builds differ along so much of their length."""

_LEAST_ALONG = 5
"""Points along a metre of it that tell: the post beside a vehicle has fewer."""

_LEAST_TOPS = 25
"""Points of both epochs that tell."""


class Aloft(NamedTuple):
    """The points (k,) of some objects of one epoch, each object at a height of its own."""

    owner: IntArray
    xyz: FloatArray
    normals: FloatArray
    is_open: BoolArray


def lifted(surfaces: Pair[Surface], is_asked: BoolArray, is_open: Pair[BoolArray] | None = None) -> Pair[Aloft]:
    """The points of the objects ``is_asked`` (n,), lifted so far that none sees another; open if that is not said."""
    lift = _APART_M * np.cumsum(is_asked)

    def of_epoch(surface: Surface, seen: BoolArray) -> Aloft:
        members = np.flatnonzero(np.append(is_asked, False)[surface.owner])
        owner, xyz = surface.owner[members], surface.xyz[members].copy()
        xyz[:, 2] += lift[owner]
        return Aloft(owner, xyz, surface.normals[members].astype(np.float64), seen[members])

    return surfaces.join(is_open or surfaces.map(lambda side: np.ones(len(side.owner), np.bool_)), of_epoch)


def _fit(side: Aloft, other: Aloft, n: int) -> Fit:
    """Upper quartile of the residuals of one epoch's points on the other's, and the move of ``side``."""
    owner, xyz = side.owner, side.xyz
    groups = Groups(owner, n)
    arm = xyz[:, :2] - groups.mean(xyz[:, :2])[owner]
    arm = np.column_stack([-arm[:, 1], arm[:, 0]])  # where a turn takes the points
    move = np.zeros((n, 4))
    for _ in range(_ITERATIONS):
        move = _moved_on(_at(xyz, arm, move[owner]), arm, other.xyz, other.normals, groups, move)
    moved = _at(xyz, arm, move[owner])
    found, distance = nearest(other.xyz, moved, _FAR_M)
    normal = other.normals[found]
    across = np.abs(np.sum(normal * (other.xyz[found] - moved), axis=1))
    residual = np.where(np.any(normal != 0, axis=1), across, distance)
    residual = np.where(found >= 0, residual, _FAR_M)
    residual[~(side.is_open | (distance <= _NEAR_M))] = np.nan
    counted = Groups(np.where(np.isfinite(residual), owner, -1), n)
    is_told = counted.counts >= _MIN_POINTS
    off = np.where(is_told, groups.quantile(residual, 0.75), np.nan)
    return Fit(off, np.where(is_told[:, None], move[:, :3], np.nan))


def _at(xyz: FloatArray, arm: FloatArray, move: FloatArray) -> FloatArray:
    """Points (k, 3) after their moves (k, 4): x, y, z and a small turn."""
    moved = xyz + move[:, :3]
    moved[:, :2] += move[:, 3:] * arm
    return moved


def _moved_on(
    moved: FloatArray, arm: FloatArray, other_xyz: FloatArray, normals: FloatArray, groups: Groups, move: FloatArray
) -> FloatArray:
    """The moves (n, 4) after one robust Gauss-Newton step."""
    found, _ = nearest(other_xyz, moved, _REACH_M)
    normal = np.where(found[:, None] >= 0, normals[found], 0.0)
    residual = np.sum(normal * (other_xyz[found] - moved), axis=1)
    weight = 1.0 / (1.0 + (residual / _SOFT_M) ** 2)
    slope = np.column_stack([normal, np.sum(normal[:, :2] * arm, axis=1)])
    pull = groups.sum((weight * residual)[:, None] * slope)
    stiffness = groups.sum(weight[:, None, None] * slope[:, :, None] * slope[:, None, :])
    # a side seen alone says nothing about the other directions
    stiffness += (0.01 * groups.counts + 1e-9)[:, None, None] * np.eye(4)
    return np.clip(move + np.linalg.solve(stiffness, pull[:, :, None])[:, :, 0], -_MOST, _MOST)
