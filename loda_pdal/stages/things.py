"""Things that came or went right beside others: one object with them in one epoch, or in both (METHOD 2b).

A bin beside a vehicle, a sign in a hedge, one more vehicle in a row of them: what stands on the ground, in columns of
its own, where the other survey shows the ground and nothing of the object, is no growth of its neighbour.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loda_pdal.kernels.clusters import linked
from loda_pdal.kernels.neighbours import nearest
from loda_pdal.model.boxes import upright_boxes
from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array, IntArray
from loda_pdal.model.grid import Lattice, cells_of
from loda_pdal.model.groups import Groups, favourites
from loda_pdal.model.pair import Pair
from loda_pdal.params import ChangeParams
from loda_pdal.stages.cast import FOLIAGE_M
from loda_pdal.stages.cues import Cells, Surface, Voxels
from loda_pdal.stages.parts import Region, connected_regions
from loda_pdal.stages.rules import LOW_M
from loda_pdal.stages.vehicles import roughness

_LEAST_NEW = 0.7
"""Share of a thing's columns that are its own."""

_FOOT_M = 0.8
"""A thing's lowest point lies no higher above the ground."""


def split_things(
    cells: Cells, surfaces: Pair[Surface], is_asked: BoolArray, params: ChangeParams
) -> tuple[Pair[IntArray], IntArray]:
    """Things taken out of the objects that they are merged with.

    Parameters
    ----------
    cells : Cells
        Voxels with their owners.
    surfaces : Pair of Surface
        Points with their objects, 0 to ``n - 1``.
    is_asked : (n,) bool
        Objects that are looked through.

    Returns
    -------
    owner : Pair of (m,) int32
        Object of each point; things are numbered from ``n`` on.
    host : (t,) int32
        The object that each thing was part of.
    """
    n = len(is_asked)
    owner = surfaces.map(lambda surface: surface.owner)
    if not is_asked.any() or len(cells.voxels) == 0:
        return owner, np.zeros(0, dtype=np.int32)
    clear = cells.voxels.is_clear.swapped  # from the air a thing is its top, and stands on what was ground
    height = _lowest(cells.voxels, surfaces).join(clear, lambda low, on_ground: np.where(on_ground, 0.0, low))
    came = cells.is_gained & cells.voxels.is_over.before
    went = cells.is_lost & cells.voxels.is_over.after
    things = Pair(
        _things(cells, cells.owner, went, height.before, is_asked, params),
        _things(cells, cells.owner.swapped, came, height.after, is_asked, params),
    )
    n_went = len(things.before)
    owner = Pair(
        _given(surfaces.before, things.before, n, params.voxel_m),
        _given(surfaces.after, things.after, n + n_went, params.voxel_m),
    )
    return owner, np.array([thing.parent for side in things for thing in side], dtype=np.int32)


def _things(
    cells: Cells, owner: Pair[IntArray], is_in: BoolArray, height: FloatArray, is_asked: BoolArray, params: ChangeParams
) -> list[Region]:
    """Things of one epoch; ``owner`` of this epoch and of the other, ``height`` (c,) m of the lowest point."""
    found = connected_regions(cells, owner, is_in, is_asked, params.thing_voxels)
    return [
        region
        for region in found
        if region.share_new >= _LEAST_NEW and float(np.fmin.reduce(height[region.voxels])) <= _FOOT_M
    ]


def _lowest(voxels: Voxels, surfaces: Pair[Surface]) -> Pair[FloatArray]:
    """Height above ground (c,) m of the lowest point of each epoch in each voxel; NaN where there is none."""
    height = voxels.of_points([side.height for side in surfaces])
    lowest = np.full(2 * len(voxels), np.nan)
    is_filled = np.diff(voxels.starts) > 0
    if len(height):
        lowest[is_filled] = np.fmin.reduceat(height, voxels.starts[:-1][is_filled])
    return Pair(lowest[0::2], lowest[1::2])


def _given(surface: Surface, things: list[Region], first: int, voxel_m: float) -> IntArray:
    """Objects (m,) of the points, those in the columns of a thing given to it."""
    if not things:
        return surface.owner
    rows = np.concatenate([np.column_stack([np.full(len(t.columns), t.parent), t.columns]) for t in things])
    number = np.repeat(np.arange(first, first + len(things)), [len(t.columns) for t in things])
    lattice = Lattice.around(rows)
    keys = lattice.keys(rows)
    order = np.argsort(keys, kind="stable")
    is_first = np.diff(keys[order], prepend=-1) != 0  # where two things share a column, the first has it
    keys, number = keys[order][is_first], number[order][is_first]
    found = lattice.find(keys, np.column_stack([surface.owner.astype(np.int64), cells_of(surface.xyz[:, :2], voxel_m)]))
    return np.where(found >= 0, number[np.maximum(found, 0)], surface.owner).astype(np.int32)


def split_close_things(
    surfaces: Pair[Surface], is_asked: BoolArray, is_single: BoolArray, params: ChangeParams
) -> tuple[Pair[IntArray], IntArray]:
    """Small things that stand nearer to what they are merged with than the occupancy tells apart.

    A bicycle against a bench, a bollard by a hedge: the bench is within reach of all of the bicycle. But nothing stands
    where its points are, to the width of a fused point, and the ground that it stands on shows in the other survey.

    Parameters
    ----------
    surfaces : Pair of Surface
        Points with their objects, 0 to ``n - 1``.
    is_asked : (n,) bool
        Objects that are looked through.
    is_single : (n,) bool
        Objects of one epoch: what touches one of them is the rest of it.

    Returns
    -------
    owner, host
        As of `split_things`.
    """
    n = len(is_asked)
    before, host_before = _close_things(surfaces, is_asked, is_single, n, params)
    after, host_after = _close_things(surfaces.swapped, is_asked, is_single, n + len(host_before), params)
    return Pair(before, after), np.concatenate([host_before, host_after])


def _close_things(
    surfaces: Pair[Surface], is_asked: BoolArray, is_single: BoolArray, first: int, params: ChangeParams
) -> tuple[IntArray, IntArray]:
    """Owners (m,) of this epoch's points with its small things, numbered from ``first``, and the host (t,) of each;
    ``surfaces`` of this epoch and of the other."""
    own, other = surfaces
    member = np.flatnonzero(np.append(is_asked, False)[own.owner])
    found, _ = nearest(other.xyz[other.is_surface], own.xyz[member], _POINT_M)
    alone = member[found < 0]
    if len(alone) == 0:
        return own.owner, np.zeros(0, dtype=np.int32)
    linked_ones = np.column_stack([linked(own.xyz[alone], _CONTACT_M), own.owner[alone]])
    pieces, cluster = np.unique(linked_ones, axis=0, return_inverse=True)
    cluster, k = cluster.ravel(), len(pieces)
    beneath, _ = nearest(other.xyz[~other.is_surface] * _FLAT, own.xyz[alone] * _FLAT, _POINT_M)
    groups = Groups(cluster, k)
    low, high = groups.extremes(own.height[alone])
    # what ends just beneath what still stands carries it: the pole of a sign, of which the other survey met the plate
    top = np.flatnonzero(own.height[alone] >= high[cluster])
    over, _ = nearest(other.xyz[other.is_surface], own.xyz[alone[top]] + [0.0, 0.0, _POINT_M], _POINT_M)
    carries = Groups(cluster[top], k).share(over >= 0) > 0
    is_thing = (groups.counts >= _LEAST_POINTS) & (groups.sum(own.n_raw[alone]) >= params.min_returns)
    is_thing &= (low <= _LOW_FOOT_M) & (high > params.raised_m) & (high <= LOW_M)
    is_thing &= (groups.share(beneath >= 0) >= _LEAST_NEW) & ~carries
    whole = _whole(own, alone, cluster, pieces[:, 1], is_single)
    is_new = is_thing & (whole < 0)
    whole[is_new] = first + np.arange(np.count_nonzero(is_new), dtype=np.int32)
    owner = own.owner.copy()
    owner[alone] = np.where(is_thing[cluster], whole[cluster], owner[alone])
    return owner, pieces[is_new, 1].astype(np.int32)


def _whole(side: Surface, piece: Int64Array, label: Int64Array, host: IntArray, is_single: BoolArray) -> IntArray:
    """Object (k,) of one epoch that the points ``piece`` (p,) with a ``label`` (p,) touch most, but for the ``host``
    (k,) of each label; -1 where there is none."""
    found = np.full(len(host), -1, dtype=np.int32)
    single = np.flatnonzero(np.append(is_single, False)[side.owner])
    if len(single):
        beside, _ = nearest(side.xyz[single], side.xyz[piece], _CONTACT_M)
        theirs = side.owner[single[beside]]
        is_other = (beside >= 0) & (theirs != host[label])
        own, other, _ = favourites(label[is_other], theirs[is_other])
        found[own] = other
    return found


_POINT_M = 0.38
"""Points of one surface lie no farther apart, fused to 0.25 m: the diagonal of a square of that, and the noise."""

_FLAT = np.array([1.0, 1.0, 0.0])
"""Points times this lie in plan."""

_LEAST_POINTS = 8
"""Fused points of a thing."""

_LOW_FOOT_M = 0.6
"""Its lowest point lies no higher: hardly any ray reaches the ground right beside a neighbour."""


def carried_on(surfaces: Pair[Surface], is_asked: BoolArray) -> Pair[IntArray]:
    """Object of each point (m,) once what one epoch alone shows of a hedge is one with the rest of it, that both show.

    Foliage that carries on other foliage in the same line, as wide and as high, is no thing beside it: a piece that was
    taken out of a hedge, or planted on to its end, changes the hedge. What is smooth may be one vehicle behind another.
    Where the rest is merged with more than the hedge (a bush or a bench before it), what lies in the line leaves it.

    Parameters
    ----------
    surfaces : Pair of Surface
        Points with their objects, 0 to ``n - 1``.
    is_asked : (n,) bool
        Objects that may be such pieces.
    """
    n = len(is_asked)
    present = surfaces.map(lambda side: np.isin(np.arange(n), side.owner) & is_asked)
    is_pair = np.append(present.before & present.after, False)
    single = present.map(lambda own: np.append(own, False) & ~is_pair)
    before, after = surfaces
    found = _lines(before, after, single.before, is_pair) + _lines(after, before, single.after, is_pair)
    ends = np.array([(line.piece, line.rest) for line in found], dtype=np.int64).reshape(-1, 2)
    is_leafy = roughness(surfaces, np.isin(np.arange(n), ends)) > FOLIAGE_M
    line_of = {line.piece: line for line in found if is_leafy[line.piece] and is_leafy[line.rest]}
    if not line_of:
        return surfaces.map(lambda side: side.owner)
    hedges: dict[int, list[_Line]] = {}
    for line in line_of.values():
        hedges.setdefault(line.rest, []).append(line)
    owner = surfaces.map(lambda side: side.owner.copy())
    groups = surfaces.map(lambda side: Groups(side.owner, n))
    for rest, own in hedges.items():
        members = [side.members(rest) for side in groups]
        is_in = [
            np.any([line.holds(side.xyz[member]) for line in own], axis=0)
            for side, member in zip(surfaces, members, strict=True)
        ]
        is_whole = float(np.mean(np.concatenate(is_in))) >= _NEARLY_ALL
        hedge = rest if is_whole else min(line.piece for line in own)
        for side, grouped, member, inside in zip(owner, groups, members, is_in, strict=True):
            side[member[inside | is_whole]] = hedge
            for line in own:
                side[grouped.members(line.piece)] = hedge
    return owner


class _Line(NamedTuple):
    """A piece of a hedge, the rest of it, and the line of both: from ``low`` to ``high`` m along ``across`` (3,)."""

    piece: int
    rest: int
    across: FloatArray
    low: float
    high: float

    def holds(self, xyz: FloatArray) -> BoolArray:
        """Which points (k, 3) lie in the line."""
        aside = xyz @ self.across
        return np.asarray((aside >= self.low) & (aside <= self.high))


def _lines(side: Surface, other: Surface, is_piece: BoolArray, is_rest: BoolArray) -> list[_Line]:
    """Pieces of one epoch and the rests that carry them on, of several rests that of most contacts last; ``is_piece``
    and ``is_rest`` (n + 1,). Where both make one long box, all of the rest is the hedge."""
    piece, rest = np.flatnonzero(is_piece[side.owner]), np.flatnonzero(is_rest[side.owner])
    if len(piece) == 0 or len(rest) == 0:
        return []
    found, _ = nearest(side.xyz[rest], side.xyz[piece], _CONTACT_M)
    touching = np.column_stack([side.owner[piece], side.owner[rest[found]]])[found >= 0]
    pairs, contacts = np.unique(touching.astype(np.int64), axis=0, return_counts=True)
    n = len(is_piece) - 1
    groups = Groups(np.where(np.isin(side.owner, pairs), side.owner, -1), n)
    boxes = upright_boxes(side.xyz, groups.labels, n)
    axes, size = boxes.axes[:, :2], boxes.size[:, :2]
    top = groups.quantile(side.xyz[:, 2], 0.95)
    is_low = groups.maximum(side.height) <= LOW_M
    shown = np.zeros(len(side.xyz), np.bool_)
    shown[rest] = nearest(other.xyz[is_rest[other.owner]], side.xyz[rest], _POINT_M)[0] >= 0
    lines = []
    for i, j in pairs[np.argsort(contacts, kind="stable")].tolist():
        own, host = side.xyz[groups.members(i)], groups.members(j)
        both = np.concatenate([own, side.xyz[host]])
        length, width = upright_boxes(both, np.zeros(len(both), np.int32), 1).size[0, :2]
        is_whole = length >= max(size[i].max() + size[j].max() - _CONTACT_M, _LINE * width)
        is_whole &= width <= max(size[i].min(), size[j].min()) + _ASIDE_M and abs(top[i] - top[j]) <= _ASIDE_M / 2
        if is_whole:
            lines.append(_Line(i, j, axes[i, 1], -np.inf, np.inf))
            continue
        across = _carried_across(own, side.xyz[host], shown[host], axes[i]) if is_low[i] else None
        if across is not None:
            aside = own @ across
            lines.append(_Line(i, j, across, float(aside.min()) - _ASIDE_M / 2, float(aside.max()) + _ASIDE_M / 2))
    return lines


def _carried_across(piece: FloatArray, rest: FloatArray, is_shown: BoolArray, axes: FloatArray) -> FloatArray | None:
    """The one of the ``axes`` (2, 3) of a piece (p, 3) across which a rest (r, 3) carries it on, as wide and as high;
    None where it does not.

    Of the rest only what lies in the piece's own line is looked at: a bush may stand before the hedge. It must be what
    the other epoch shows too, ``is_shown`` (r,), and carry on either next to the piece (farther on the hedge may turn)
    or as a whole, without a gap in its upper half: tables stand in a row, but each by itself.
    """
    beside = nearest(piece * _FLAT, rest * _FLAT, _CARRIES_ON_M)[0] >= 0
    for along, across in (axes, axes[::-1]):
        own, aside = piece @ across, rest @ across
        if np.ptp(own) > _HEDGE_M:
            continue
        is_in = (aside >= own.min() - _ASIDE_M / 2) & (aside <= own.max() + _ASIDE_M / 2)
        for part in (is_in & beside, is_in):
            if not part.any() or np.mean(is_shown[part]) < _BOTH or np.ptp(aside[part]) < _AS_WIDE * np.ptp(own):
                continue
            both = np.concatenate([piece, rest[part]])
            least = max(np.ptp(piece @ along) + _CONTACT_M, _LINE * np.ptp(own))
            tops = [float(np.quantile(points[:, 2], 0.95)) for points in (piece, rest[part])]
            is_high = both[:, 2] > (max(tops) + both[:, 2].min()) / 2
            gaps = np.diff(np.sort(both[is_high] @ along))
            if (
                np.ptp(both[is_high] @ along) >= least
                and gaps.max() <= _POINT_M
                and abs(tops[0] - tops[1]) <= _ASIDE_M / 2
            ):
                return np.asarray(across)
    return None


_CONTACT_M = 0.5
"""What lies this near belongs together, as in the instances."""

_CARRIES_ON_M = 1.0
"""What lies this near to a piece in plan shows whether it carries on."""

_ASIDE_M = 0.25
"""Pieces of a line lie no farther aside of each other than a fused point, and their tops differ by half of that."""

_BOTH = 0.5
"""Share of what carries a piece on that the other epoch shows too: it is the rest of the hedge, and did not pass by."""

_HEDGE_M = 1.5
"""Hedges are no wider, and vehicles are: one behind another makes no hedge."""

_NEARLY_ALL = 0.8
"""Share of a rest that lies in its line, from which on it is nothing but the hedge."""

_AS_WIDE = 0.5
"""Share of the width of a piece that what carries it on has."""

_LINE = 3.0
"""A line is so many times as long as wide."""
