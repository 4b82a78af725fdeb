"""Houses of rows that came or went, as the street shows them (METHOD 2b).

Little more than the front of such a house is met: a sheet as long as the house and as high as the row, on what the
other survey shows bare. That tells it from what is built onto a house, which is lower, and from a storey, which stands
on one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from loda_pdal.model.boxes import upright_boxes
from loda_pdal.model.cloud import BoolArray, FloatArray, IntArray
from loda_pdal.model.pair import Pair
from loda_pdal.params import ChangeParams
from loda_pdal.stages.cues import Cells, Surface
from loda_pdal.stages.parts import Region, connected_regions, ends_of_columns, in_column_of

_NARROWEST = 0.5
"""No front is narrower than this many frontages."""

_AS_HIGH = 0.65
"""A front reaches at least this share of the height of the row beside it; what is built onto a house does not."""

_LEAST_M = 3.0
"""No house is lower: where hardly anything of the row is seen, an annex is as high."""

_CLOSED = 0.5
"""Voxels of a front for each that it has room for: a crown is open."""

_BESIDE = 2.0
"""The row begins more than this many voxels from what came or went of it."""

_LEAST_BESIDE = 8
"""Columns of the row that tell how high it is."""

_EDGE_M = 1.0
"""A house reaches this far beyond the voxels that show its front."""


class _Front(NamedTuple):
    """The front of a house: the object that it was part of, its middle (2,) m, directions (2, 2) along the front and
    into the house, and half its length, m."""

    parent: int
    middle: FloatArray
    axes: FloatArray
    half_m: float


def split_houses(
    cells: Cells, surfaces: Pair[Surface], is_asked: BoolArray, params: ChangeParams
) -> tuple[Pair[IntArray], IntArray]:
    """Houses that came or went taken out of the rows that they stood in.

    Parameters
    ----------
    cells : Cells
        Voxels with their owners.
    surfaces : Pair of Surface
        Points with their objects, 0 to ``n - 1``.
    is_asked : (n,) bool
        Buildings that both epochs have; those longer than ``part_of_length_m`` are rows.

    Returns
    -------
    owner : Pair of (m,) int32
        Object of each point; houses are numbered from ``n`` on, and have points of one epoch alone.
    host : (h,) int32
        The object that each house was part of.
    """
    n = len(is_asked)
    xyz = np.concatenate([side.xyz for side in surfaces])
    label = np.concatenate([side.owner for side in surfaces])
    is_row = is_asked & (upright_boxes(xyz, label, n).size[:, 0] > params.part_of_length_m)
    if not is_row.any():
        return surfaces.map(lambda side: side.owner), np.zeros(0, dtype=np.int32)
    own, bare = cells.owner, _bare(cells)
    gone = _fronts(cells, own, cells.is_lost & bare.after, is_row, params)
    come = _fronts(cells, own.swapped, cells.is_gained & bare.before, is_row, params)
    near = cells.voxels.at_points(cells.is_near.swapped, surfaces)
    owner = Pair(
        _given(surfaces.before, near.before, gone, n, params),
        _given(surfaces.after, near.after, come, n + len(gone), params),
    )
    return owner, np.array([front.parent for front in (*gone, *come)], dtype=np.int32)


def _bare(cells: Cells) -> Pair[BoolArray]:
    """Voxels (c,) in whose columns that epoch has nothing of the object that the other one has there."""
    before, after = cells.owner
    every = np.arange(len(before))
    return Pair(~in_column_of(cells, after, every, before), ~in_column_of(cells, before, every, after))


def _fronts(
    cells: Cells, owner: Pair[IntArray], is_in: BoolArray, is_asked: BoolArray, params: ChangeParams
) -> list[_Front]:
    """Fronts among the voxels ``is_in`` (c,) of one epoch; ``owner`` (c,) of this epoch and of the other."""
    shortest = _NARROWEST * params.frontage_m
    found = []
    for region in connected_regions(cells, owner, is_in, is_asked, params.part_min_voxels):
        if float(np.hypot(*(np.ptp(region.columns, axis=0) + 1))) * params.voxel_m <= shortest:
            continue
        centre = cells.voxels.centre[region.voxels]
        least = max(_AS_HIGH * _height_of_row(cells, owner, region, params), _LEAST_M)
        foot = float(centre[:, 2].min())
        if np.quantile(centre[:, 2], 0.95) - foot < least:
            continue
        _, first, last = ends_of_columns(cells.voxels.cell[region.voxels])
        is_front = np.repeat(centre[last, 2] - foot >= least, last - first + 1)
        box = upright_boxes(centre, np.where(is_front, 0, -1).astype(np.int32), 1)
        length = float(box.size[0, 0]) + params.voxel_m
        if length <= shortest:
            continue
        size = (length, float(box.size[0, 2]) + params.voxel_m)
        if region.n_voxels * params.voxel_m**2 < _CLOSED * size[0] * size[1]:
            continue
        found.append(_Front(region.parent, box.centre[0, :2], box.axes[0, :2, :2], length / 2))
    return found


def _height_of_row(cells: Cells, owner: Pair[IntArray], region: Region, params: ChangeParams) -> float:
    """How high (m) half of the columns of the object reach that lie beside a region, above the lowest of them; 0 where
    there are few."""
    cell = cells.voxels.cell
    reach = int(np.ceil(params.frontage_m / params.voxel_m))
    along = region.columns[:, 0]
    first, last = np.searchsorted(cell[:, 0], [along.min() - reach, along.max() + reach + 1])
    is_own = (owner.before[first:last] == region.parent) | (owner.after[first:last] == region.parent)
    own = first + np.flatnonzero(is_own)
    plan, lowest, highest = ends_of_columns(cell[own])
    distance, _ = cKDTree(region.columns).query(plan, distance_upper_bound=float(reach))
    is_beside = (distance > _BESIDE) & np.isfinite(distance)
    if np.count_nonzero(is_beside) < _LEAST_BESIDE:
        return 0.0
    z = cells.voxels.centre[own, 2]
    return float(np.median(z[highest[is_beside]]) - np.quantile(z[lowest[is_beside]], 0.1)) + params.voxel_m


def _given(surface: Surface, is_near: BoolArray, fronts: list[_Front], first: int, params: ChangeParams) -> IntArray:
    """Objects (m,) of the points, those behind and before a front, and not in the other survey ``is_near`` (m,), given
    to its house."""
    owner = surface.owner.copy()
    for number, front in enumerate(fronts, first):
        own = np.flatnonzero((owner == front.parent) & ~is_near)
        s, t = np.abs((surface.xyz[own, :2] - front.middle) @ front.axes.T).T
        owner[own[(s <= front.half_m + _EDGE_M) & (t <= params.part_of_length_m)]] = number
    return owner
