"""What was built onto a house and changes it, and what only stands before it (METHOD 2b).

An annex is as smooth as a wall, and hides the wall behind it. A scaffold, a stall or a tree over the roof does not: the
wall is seen through it.
"""

from __future__ import annotations

import numpy as np

from loda_pdal.kernels.neighbours import nearest
from loda_pdal.model.boxes import upright_boxes
from loda_pdal.model.cloud import BoolArray, FloatArray, IntArray
from loda_pdal.model.groups import Groups
from loda_pdal.model.pair import Pair
from loda_pdal.stages.cast import FOLIAGE_M
from loda_pdal.stages.cues import Cells, Surface
from loda_pdal.stages.vehicles import roughness

_SAME_M = 0.2
"""Points so close to each other lie on one wall, fused to 0.25 m."""

_BEHIND_M = 1.0
"""The wall behind begins no farther from what stands before it."""

_LEAST_BEHIND = 12
"""Points of the wall behind that tell whether it is still to be seen."""

_STILL_SEEN = 0.9
"""Share of them that one still sees through what stands before the wall."""


def are_built_on(
    cells: Cells,
    surfaces: Pair[Surface],
    parent: IntArray,
    is_asked: BoolArray,
    is_on_top: BoolArray,
    *,
    has_walls: bool,
) -> BoolArray:
    """Which of the parts of houses ``is_asked`` (n,) are solid: what came or went of them is smooth and hid the wall.

    Parameters
    ----------
    cells : Cells
        Voxels with their owners, the parts among them.
    surfaces : Pair of Surface
        Points with their objects, 0 to ``n - 1``.
    parent : (n,) int32
        The house of each part.
    is_on_top : (n,) bool
        Parts that stand on the house: too small to be smooth, a dormer is all edges.
    has_walls : bool
        Whether the surveys show walls: from the air there are hardly any to see through what stands before them.
    """
    new = _new_of(surfaces, _came_or_went(cells, surfaces), is_asked)
    is_smooth = np.asarray(is_asked & (is_on_top | (roughness(new, is_asked) < FOLIAGE_M)))
    if not has_walls:
        return is_smooth
    is_open = _is_seen_through(new.before, surfaces, parent) | _is_seen_through(new.after, surfaces.swapped, parent)
    return np.asarray(is_smooth & ~is_open)


def _came_or_went(cells: Cells, surfaces: Pair[Surface]) -> Pair[BoolArray]:
    """Which points of each epoch the other one does not have."""
    return cells.voxels.at_points(Pair(cells.is_lost, cells.is_gained), surfaces)


def _new_of(surfaces: Pair[Surface], is_new: Pair[BoolArray], is_asked: BoolArray) -> Pair[Surface]:
    """Those of the points that came or went that belong to objects ``is_asked`` (n,)."""
    asked = np.append(is_asked, False)
    return surfaces.join(is_new, lambda side, own: side.only(own & asked[side.owner]))


def _is_seen_through(new: Surface, surfaces: Pair[Surface], parent: IntArray) -> BoolArray:
    """Whether an epoch that shows ``new`` points of parts (n,) shows all the same the walls of their houses that the
    other epoch shows beside these points.

    ``surfaces`` of this epoch and of the other.
    """
    n = len(parent)
    member = np.flatnonzero(new.owner >= 0)
    low, high = Groups(new.owner, n).extremes(new.xyz[:, 2])
    shown, other = surfaces
    is_house = np.zeros(n + 1, np.bool_)
    is_house[new.owner[member]] = is_house[parent[new.owner[member]]] = True
    is_house[-1] = False
    owned = np.flatnonzero(is_house[other.owner])
    if len(owned) == 0:
        return np.zeros(n, np.bool_)
    beside, _ = nearest(new.xyz[member], other.xyz[owned], _BEHIND_M)
    wall, part = owned[beside >= 0], new.owner[member[beside[beside >= 0]]]
    height = other.xyz[wall, 2]
    is_its = (other.owner[wall] == part) | (other.owner[wall] == parent[part])
    is_behind = is_its & (height >= low[part]) & (height <= high[part])
    wall, part = wall[is_behind], part[is_behind]
    still, _ = nearest(shown.xyz[shown.owner >= 0], other.xyz[wall], _SAME_M)
    counts = np.bincount(part, minlength=n)
    return np.asarray((counts >= _LEAST_BEHIND) & (np.bincount(part[still >= 0], minlength=n) >= _STILL_SEEN * counts))


def screens(cells: Cells, is_wall: BoolArray, is_asked: BoolArray) -> BoolArray:
    """Which of the objects asked for (n,) stand before walls and hide nothing of them: scaffolding, say.

    What is built onto a house takes the wall behind it out of sight. Where the epoch that has the object shows the wall
    behind it all the same, as the other epoch does, rays pass through, and the house is what it was.

    Parameters
    ----------
    cells : Cells
        Voxels with their owners.
    is_wall : (n,) bool
        Objects that walls may belong to.
    is_asked : (n,) bool
        Objects that came or went before one.
    """
    voxels, n = cells.voxels, len(is_asked)
    asked, wall = np.append(is_asked, False), np.append(is_wall, False)
    found = np.zeros(n, np.bool_)
    for own, other, near, is_new in (
        (cells.owner.before, cells.owner.after, cells.is_near.before, cells.is_lost),
        (cells.owner.after, cells.owner.before, cells.is_near.after, cells.is_gained),
    ):
        label = np.where(is_new & asked[own], own, -1)
        boxes = upright_boxes(voxels.centre, label, n)
        for i in np.unique(label[label >= 0]).tolist():
            reach = boxes.size[i] / 2 + [0.0, _DEPTH_M, 0.0]
            half = float(np.hypot(reach[0], reach[1]))
            first, last = np.searchsorted(voxels.centre[:, 0], boxes.centre[i, 0] + np.array([-half, half]))
            offset = (voxels.centre[first:last] - boxes.centre[i]) @ boxes.axes[i].T
            is_behind = np.all(np.abs(offset) <= reach, axis=1) & wall[other[first:last]]
            shown = near[first:last][is_behind]
            found[i] |= len(shown) >= _LEAST_WALL and float(shown.mean()) >= _SEEN_THROUGH
    return found


def came_into_sight(cells: Cells, is_grown: Pair[BoolArray], is_gone: Pair[BoolArray]) -> BoolArray:
    """Which walls (n,) show in one epoch alone because the building that hid them stands in the other alone.

    A party wall is seen once the house beside it is gone: it begins where that stood, all the way up, and is as high.

    Parameters
    ----------
    cells : Cells
        Voxels with their owners.
    is_grown : Pair of (n,) bool
        Buildings that are asked for, which show more before, or more after.
    is_gone : Pair of (n,) bool
        Buildings that only the before, or only the after epoch has.
    """
    voxels, n = cells.voxels, len(is_grown.before)
    z = voxels.centre[:, 2]
    found = np.zeros(n, np.bool_)
    for own, is_new, grown, other, gone in (
        (cells.owner.before, cells.is_lost, is_grown.before, cells.owner.after, is_gone.after),
        (cells.owner.after, cells.is_gained, is_grown.after, cells.owner.before, is_gone.before),
    ):
        asked = np.flatnonzero(is_new & np.append(grown, False)[own])
        hiding = np.flatnonzero(np.append(gone, False)[other])
        if len(asked) == 0 or len(hiding) == 0:
            continue
        beside, _ = nearest(voxels.centre[hiding], voxels.centre[asked], _BESIDE_M)
        foot, top = Groups(other[hiding], n).extremes(z[hiding])
        is_met = beside >= 0
        by = other[hiding[beside[is_met]]]
        high = np.full(n, -np.inf)
        np.maximum.at(high, own[asked[is_met]], foot[by] + _AS_HIGH * (top[by] - foot[by]))
        levels = np.column_stack([own[asked], voxels.cell[asked, 2]]).astype(np.int64)
        level, place = np.unique(levels, axis=0, return_inverse=True)
        is_beside = np.bincount(place.ravel(), weights=beside >= 0, minlength=len(level)) > 0
        owner = level[:, 0]
        is_hidden = np.bincount(owner, weights=is_beside, minlength=n) > _MOST_LEVELS * np.bincount(owner, minlength=n)
        begin, end = Groups(own, n).extremes(z)
        found |= is_hidden & (end >= high) & (end - begin >= _LEAST_HEIGHT_M)
    return found


def slopes_from_walls(cells: Cells, surfaces: Pair[Surface], parent: IntArray, is_asked: BoolArray) -> FloatArray:
    """How steeply the tops of the parts asked for (n,) rise away from the wall of the house that they stand against,
    m per m; NaN where it cannot be told.

    What is built onto a house sheds its water away from it. A roof that falls towards the wall is that of a thing of
    its own: a shed put there.

    Parameters
    ----------
    cells : Cells
        Voxels with their owners, the parts among them.
    surfaces : Pair of Surface
        Points with their objects, 0 to ``n - 1``.
    parent : (n,) int32
        The house of each part.
    is_asked : (n,) bool
        Parts that came or went.
    """
    n = len(is_asked)
    slope = np.full(n, np.nan)
    if not is_asked.any():
        return slope
    is_new = _came_or_went(cells, surfaces)
    new = _new_of(surfaces, is_new, is_asked)
    old = surfaces.join(is_new, lambda side, own: side.only(~own))
    label = np.concatenate([side.owner for side in new])
    xyz = np.concatenate([side.xyz for side in new])
    of_house, house_xyz = np.concatenate([side.owner for side in old]), np.concatenate([side.xyz for side in old])
    boxes, parts = upright_boxes(xyz, label, n), Groups(label, n)
    foot = parts.minimum(np.concatenate([side.height for side in new]))
    for i in np.flatnonzero((foot <= _FOOT_M) & (parts.counts >= _LEAST_BEHIND)).tolist():
        own = (xyz[parts.members(i)] - boxes.centre[i]) @ boxes.axes[i].T
        wall = (house_xyz[(of_house == i) | (of_house == parent[i])] - boxes.centre[i]) @ boxes.axes[i].T
        half = boxes.size[i] / 2
        is_high = wall[:, 2] > -half[2]
        sides = []
        for axis, sign in ((0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)):
            depth = sign * wall[:, axis] - half[axis]
            is_behind = is_high & (np.abs(depth) <= _BEHIND_M / 2) & (np.abs(wall[:, 1 - axis]) <= half[1 - axis])
            sides.append((np.count_nonzero(is_behind), axis, -sign))
        most, axis, sign = max(sides)
        if most >= _LEAST_BEHIND:
            slope[i] = _slope(sign * own[:, axis], own[:, 2])
    return slope


def _slope(u: FloatArray, z: FloatArray) -> float:
    """Median slope of the highest points ``z`` (k,) m along ``u`` (k,) m; NaN over less than `_LEAST_DEPTH_M`."""
    step = np.floor((u - u.min()) / _SAME_M).astype(np.int32)
    top = Groups(step, int(step.max()) + 1).maximum(z)
    is_top = top >= np.nanmax(top) - _BEHIND_M
    place, top = np.flatnonzero(is_top) * _SAME_M, top[is_top]
    if np.ptp(place) < _LEAST_DEPTH_M:
        return float("nan")
    a, b = np.triu_indices(len(place), 1)
    return float(np.median((top[b] - top[a]) / (place[b] - place[a])))


_BESIDE_M = 1.5
"""A wall that came into sight begins no farther from what hid it."""

_MOST_LEVELS = 0.5
"""Share of its levels at which it does."""

_AS_HIGH = 0.65
"""It reaches at least this share of the height of what hid it; an annex beside that does not."""

_LEAST_HEIGHT_M = 3.5
"""And it is higher than an annex."""

_FOOT_M = 0.8
"""What stands on the ground begins no higher above it."""

_LEAST_DEPTH_M = 1.2
"""So much of a roof must be seen, from the wall outwards, before it slopes."""

_DEPTH_M = 1.5
"""A wall this far behind what stands before it is looked for."""

_LEAST_WALL = 60
"""Voxels of a wall that must be known: what is small hides little of it whatever it is."""

_SEEN_THROUGH = 0.95
"""Share of them that show."""
