"""The house behind an annex: the piece of a row, from party wall to party wall, that what changed is built onto.

From the air a row of houses is one roof. Where one house ends its neighbour's roof lies a little higher or lower all
through the depth of the row, or its wall stands back; both show in the tops of the columns.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array
from loda_pdal.params import ChangeParams

_STEP_M = 0.08
"""Roofs that differ by this much beyond their slope, all through a row, are two; one column says nothing."""

_WALL_SHARE = 0.5
"""A party wall runs through at least this share of the depth of the row."""

_CONTACT = 2.1
"""Columns this far from a part, in columns, lie beside it: the wall between them has no returns of its own."""

_LOWER_M = 1.0
"""An annex is lower than its house by at least this; what is as high is a house or a storey of its own."""

_LARGER = 2.0
"""A house covers at least this many times as much as what is built onto it."""

_NARROWER = 0.6
"""No house is narrower than this many frontages: what looks like a party wall in it is a dormer or a chimney."""

_WIDER = 5.0 / 3.0
"""What is wider than this many frontages may be several houses of one height."""


def house_behind(
    part: Int64Array, part_top: float, columns: Int64Array, top: FloatArray, params: ChangeParams
) -> BoolArray:
    """Which columns (k,) are those of the house that a part is built onto.

    The house reaches along the wall from one party wall to the next, past both ends of the part, and away from it
    through the row. Where the roofs show no two party walls near each other it is one frontage, beside the wall there
    is or about the part.

    Parameters
    ----------
    part : (p, 2) int64
        Columns of the part.
    part_top : float, m
        How high it reaches; what is no lower than what it stands against is no annex.
    columns : (k, 2) int64
        Columns of the buildings about it, without those of parts.
    top : (k,) float64, m
        Highest point of each.
    params : ChangeParams
        Edge of a column, width of a house in a row, and how deep one is at most.
    """
    is_house = np.zeros(len(columns), np.bool_)
    reach, frontage = params.part_of_length_m / params.voxel_m, params.frontage_m / params.voxel_m
    middle = part.mean(axis=0)
    near = np.flatnonzero(np.hypot(*(columns - middle).T) <= 1.5 * reach + np.ptp(part, axis=0).max())
    if len(near) == 0:
        return is_house
    low = np.minimum(columns[near].min(axis=0), part.min(axis=0)) - 2
    place, own = columns[near] - low, part - low
    roof = np.full(tuple(np.maximum(place.max(axis=0), own.max(axis=0)) + 3), np.nan)
    roof[tuple(place.T)] = top[near]
    is_part = np.zeros(roof.shape, np.bool_)
    is_part[tuple(own.T)] = True
    beside = place[ndimage.distance_transform_edt(~is_part)[tuple(place.T)] <= _CONTACT]
    if len(beside) == 0:
        return is_house
    foot = beside.mean(axis=0)
    along, inward = _axes(np.isfinite(roof), foot - own.mean(axis=0))
    s, t = (place - foot) @ along, (place - foot) @ inward
    is_in = (t >= -_CONTACT) & (t <= reach)
    left, right = _between_walls(s[is_in], t[is_in], top[near][is_in], (own - foot) @ along, frontage)
    is_in &= (s >= left) & (s <= right)
    inside = np.zeros(roof.shape, np.bool_)
    inside[tuple(place[is_in].T)] = True
    piece, _ = ndimage.label(inside, np.ones((3, 3)))
    seeds = piece[tuple(beside.T)]
    is_in &= np.isin(piece[tuple(place.T)], seeds[seeds > 0])
    is_larger = np.count_nonzero(is_in) >= _LARGER * len(part)
    if is_larger and np.median(top[near][is_in]) > part_top + _LOWER_M:
        is_house[near] = is_in
    return is_house


def _axes(is_roof: BoolArray, inward: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors along the wall and away from it: walls are square to each other, ``inward`` says which is which."""
    gx, gy = np.gradient(ndimage.gaussian_filter(is_roof.astype(np.float64), 1.0))
    angle = np.angle(np.sum((gx + 1j * gy) ** 4)) / 4
    toward = np.arctan2(inward[1], inward[0])
    angle += np.round((toward - angle) / (np.pi / 2)) * (np.pi / 2)
    along, away = np.array([-np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
    return along, away


def _between_walls(
    s: FloatArray, t: FloatArray, top: FloatArray, part: FloatArray, frontage: float
) -> tuple[float, float]:
    """From where to where along ``s`` the house reaches that ``part`` (p,) along it stands against; all in columns."""
    walls = _party_walls(s, t, top)
    middle, half = float(part.mean()), max(float(np.ptp(part)) / 2 - 1.0, 0.0)
    left = [*walls[walls <= middle - half].tolist()[::-1], -np.inf]
    right = [*walls[walls >= middle + half].tolist(), np.inf]
    while right[0] - left[0] < _NARROWER * frontage:
        del (left if middle - left[0] <= right[0] - middle else right)[0]
    if right[0] - left[0] <= _WIDER * frontage:
        return left[0], right[0]
    if min(middle - left[0], right[0] - middle) >= frontage:
        return middle - frontage / 2, middle + frontage / 2
    if middle - left[0] < right[0] - middle:
        return left[0], left[0] + frontage
    return right[0] - frontage, right[0]


def _party_walls(s: FloatArray, t: FloatArray, top: FloatArray) -> FloatArray:
    """Where along ``s`` the roofs step, begin or end through most of the depth of the row: ascending, in columns."""
    first = int(np.floor(s.min())) - 1
    row, band = np.floor(s).astype(np.int64) - first, np.floor((t - t.min()) / 2).astype(np.int64)
    grid = np.full((int(row.max()) + 2, int(band.max()) + 1), -np.inf)
    np.maximum.at(grid, (row, band), top)
    grid[np.isneginf(grid)] = np.nan
    is_gap = np.isnan(grid[1:-1])
    grid[1:-1][is_gap] = ((grid[:-2] + grid[2:]) / 2)[is_gap]
    has = np.isfinite(grid)
    rise = np.nan_to_num(np.abs(np.diff(grid, axis=0)))
    padded = np.pad(rise, ((1, 1), (0, 0)))
    is_step = (rise - np.maximum(padded[:-2], padded[2:]) > _STEP_M) | (has[:-1] != has[1:])
    is_step[:-1] |= is_step[1:]  # a wall that is not parallel to the columns lies in two places
    depth = np.maximum(has[:-1].sum(axis=1), has[1:].sum(axis=1))
    is_wall = is_step.sum(axis=1) >= _WALL_SHARE * np.maximum(depth, 1)
    return np.flatnonzero(is_wall).astype(np.float64) + (first + 1.0)
