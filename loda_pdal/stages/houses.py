"""The house behind an annex: the piece of a row, from party wall to party wall, that what changed is built onto.

From the air a row of houses is one roof. Where one house ends its neighbour's roof lies a little higher or lower all
through the depth of the row, or its wall stands back; both show in the planes of the roofs on either side.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array
from loda_pdal.model.pair import Pair
from loda_pdal.params import ChangeParams

_STEP_M = 0.03
"""Roofs that lie this much off each other's planes, all through a row, are two; one place says nothing."""

_ROUGH = 1.5
"""A step is more than this many times what the roofs beside it are off their planes: a ridge or a dormer is none."""

_SIDE = 5
"""Columns along the row, from the one beside the wall on, that show the plane of a roof."""

_CLOSE = 2
"""Columns next to the wall that lie off the plane of the other side: farther in a slope may end."""

_BAND = 3
"""Columns through the row that are looked at together."""

_LEAST = 7
"""Points of a plane."""

_WALL_SHARE = 0.3
"""A party wall shows in at least this share of the depth of the row."""

_CONTACT = 2.1
"""Columns this far from a part, in columns, lie beside it: the wall between them has no returns of its own."""

_LOWER_M = 1.0
"""An annex is lower than its house by at least this; what is as high is a house or a storey of its own."""

_LARGER = 2.0
"""A house covers at least this many times as much as what is built onto it."""

_GAP = 2
"""A row ends where more than one column along it is empty."""

_NARROWER = 0.6
"""No house is narrower than this many frontages: what looks like a party wall in it is a dormer or a chimney."""

_WIDER = 2.0
"""What is wider than this many frontages and shows no party wall is several houses of one height."""

_NEXT = 2
"""Of the places of a wall this many columns apart one is the wall."""


def house_behind(
    part: Int64Array, part_top: float, columns: Int64Array, roofs: Pair[FloatArray], params: ChangeParams
) -> BoolArray:
    """Which columns (k,) are those of the house that a part is built onto.

    The house reaches along the wall from one party wall to the next, past both ends of the part, and away from it
    through the row. Where the roofs show no two party walls near each other it is one frontage, beside the wall there
    is or about the part. Party walls are looked for in the nearer half of the depth: behind it stands what likes to.

    Parameters
    ----------
    part : (p, 2) int64
        Columns of the part.
    part_top : float, m
        How high it reaches; what is no lower than what it stands against is no annex.
    columns : (k, 2) int64
        Columns of the buildings about it, without those of parts.
    roofs : Pair of (k, 3) float64, m
        Highest point of each in either epoch, NaN where there is none.
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
    is_roof = np.zeros(tuple(np.maximum(place.max(axis=0), own.max(axis=0)) + 3), np.bool_)
    is_roof[tuple(place.T)] = True
    is_part = np.zeros(is_roof.shape, np.bool_)
    is_part[tuple(own.T)] = True
    beside = place[ndimage.distance_transform_edt(~is_part)[tuple(place.T)] <= _CONTACT]
    if len(beside) == 0:
        return is_house
    foot = beside.mean(axis=0)
    axes = np.column_stack(_axes(is_roof, foot - own.mean(axis=0)))
    s, t = ((place - foot) @ axes).T
    is_in = (t >= -_CONTACT) & (t <= reach)
    is_front = is_in & (t <= reach / 2)
    tops = [side[near][is_front & np.isfinite(side[near, 2])] for side in roofs]
    of_roofs = [np.column_stack([(xyz[:, :2] / params.voxel_m - 0.5 - low - foot) @ axes, xyz[:, 2]]) for xyz in tops]
    walls = _party_walls(s[is_front], t[is_front], of_roofs) if is_front.any() else np.zeros(0)
    walls = walls[np.abs(walls) < np.sqrt(2.0) * reach]  # there the row ends with what was looked at
    left, right = _between_walls(walls, (own - foot) @ axes[:, 0], frontage)
    is_in &= (s >= left) & (s <= right)
    inside = np.zeros(is_roof.shape, np.bool_)
    inside[tuple(place[is_in].T)] = True
    piece, _ = ndimage.label(inside, np.ones((3, 3)))
    seeds = piece[tuple(beside.T)]
    is_in &= np.isin(piece[tuple(place.T)], seeds[seeds > 0])
    is_larger = np.count_nonzero(is_in) >= _LARGER * len(part)
    top = np.fmin(*(side[near[is_in], 2] for side in roofs))
    top = top[np.isfinite(top)]
    if is_larger and len(top) and np.median(top) > part_top + _LOWER_M:
        is_house[near] = is_in
    return is_house


def house_about(part: Int64Array, columns: Int64Array, params: ChangeParams) -> BoolArray:
    """Which columns (k,) of a row of houses are the house that has the part: one frontage about it, all through.

    From the street the walls of the row and hardly any roof are seen. What would be left of the row beyond the frontage
    and is less than half of one is no house, but belongs to this one.

    Parameters
    ----------
    part : (p, 2) int64
        Columns of the part.
    columns : (k, 2) int64
        Columns of the row, the part among them or not.
    params : ChangeParams
        Edge of a column, width of a house in a row, and how deep one is at most.
    """
    is_house = np.zeros(len(columns), np.bool_)
    reach, frontage = params.part_of_length_m / params.voxel_m, params.frontage_m / params.voxel_m
    middle = (part.min(axis=0) + part.max(axis=0)) / 2
    near = np.flatnonzero(np.hypot(*(columns - middle).T) <= reach)
    offset = columns[near] - middle
    close = offset[np.hypot(*offset.T) <= frontage]
    if len(close) == 0:
        return is_house
    place = columns[near] - columns[near].min(axis=0) + 2
    is_wall = np.zeros(tuple(place.max(axis=0) + 3), np.bool_)
    is_wall[tuple(place.T)] = True
    along, inward = _axes(is_wall, np.linalg.eigh(np.cov(close.T, bias=True))[1][:, 0])
    s, front = offset @ along, np.abs(offset @ inward) <= frontage / 2
    half = max(frontage / 2, float(np.abs((part - middle) @ along).max()))
    low, high = (_to_end(side, half, half + frontage / 2) for side in (-s[front], s[front]))
    is_house[near] = (s >= -low) & (s <= high)
    return is_house


def _to_end(s: FloatArray, half: float, most: float) -> float:
    """How far a house reaches from its middle along ``s`` (k,): ``half``, or to the end of the row that lies no farther
    than ``most``; all in columns."""
    row = np.unique(np.floor(s[s >= 0]).astype(np.int64))
    gap = np.flatnonzero(np.diff(row) > _GAP)
    end = float(row[gap[0] if len(gap) else -1] + 1) if len(row) else 0.0
    return max(end, half) if end <= most else half


def _axes(is_roof: BoolArray, inward: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors along the wall and away from it: walls are square to each other, ``inward`` says which is which."""
    gx, gy = np.gradient(ndimage.gaussian_filter(is_roof.astype(np.float64), 1.0))
    angle = np.angle(np.sum((gx + 1j * gy) ** 4)) / 4
    toward = np.arctan2(inward[1], inward[0])
    angle += np.round((toward - angle) / (np.pi / 2)) * (np.pi / 2)
    along, away = np.array([-np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
    return along, away


def _between_walls(walls: FloatArray, part: FloatArray, frontage: float) -> tuple[float, float]:
    """From where to where the house reaches that ``part`` (p,) stands against, between ``walls`` (w,) in order; all in
    columns along the row."""
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


def _party_walls(s: FloatArray, t: FloatArray, roofs: list[FloatArray]) -> FloatArray:
    """Where along ``s`` the roofs step, begin or end through much of the depth of the row: ascending, in columns.

    ``s``, ``t`` (k,) of the columns and ``roofs`` (m, 3) of each epoch: s, t and m above any level. The epochs are
    looked at apart, so that it does not matter how well they lie on each other.
    """
    first, begin = int(np.floor(s.min())) - 1, float(t.min())
    shape = int(np.floor(s.max())) - first + 2, int((t.max() - begin) // _BAND) + 1
    has = np.zeros(shape, np.bool_)
    has[np.floor(s).astype(np.int64) - first, ((t - begin) // _BAND).astype(np.int64)] = True
    has[1:-1] |= has[:-2] & has[2:]
    is_end = has[:-1] != has[1:]
    is_end[:-1] |= is_end[1:]  # a wall that is not parallel to the columns lies in two places
    n_steps, n_asked, size = np.zeros(shape[0] - 1), np.zeros(shape[0] - 1), np.zeros(shape[0] - 1)
    for points in roofs:
        step, off, is_known = _steps(points - [first, begin, 0.0], shape)
        is_step = step > np.maximum(_STEP_M, off)
        n_steps += (is_step | (is_end & ~is_known)).sum(axis=1)
        n_asked += (is_known | is_end).sum(axis=1)
        size += np.where(is_step, np.minimum(step - off, _LARGE_M), 0.0).sum(axis=1)
    share = n_steps / np.maximum(n_asked, 1)
    score = np.where(share >= _WALL_SHARE, share + _LESS * size, 0.0)
    is_wall = (score > 0) & (score >= ndimage.maximum_filter1d(score, 2 * _NEXT + 1))
    return np.flatnonzero(is_wall).astype(np.float64) + (first + 1.0)


_LARGE_M, _LESS = 0.3, 1e-3
"""Of places with the same share of steps the one with the clearer steps, up to the first, is the wall."""


def _steps(points: FloatArray, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray, BoolArray]:
    """How far the roof on either side of each place along a row lies off the plane of the other side, in each band
    through it, how much of that their roughness may be, (r - 1, b) m each, and whether both are known.

    ``points`` (m, 3) in columns and m, in r rows and b bands.
    """
    n_rows, n_bands = shape
    row, band = np.floor(points[:, 0]).astype(np.int64), (points[:, 1] // _BAND).astype(np.int64)
    is_in = (row >= 0) & (row < n_rows) & (band >= 0) & (band < n_bands)
    x, y, z = points[is_in].T
    z = z - np.median(z) if len(z) else z
    cell = row[is_in] * n_bands + band[is_in]
    moments = (np.ones(len(x)), x, y, z, x * x, x * y, y * y, x * z, y * z, z * z)
    sums = [np.bincount(cell, weights=moment, minlength=n_rows * n_bands) for moment in moments]
    total = np.zeros((n_rows + 1, n_bands, len(moments)))
    np.cumsum(np.stack(sums, axis=-1).reshape(n_rows, n_bands, -1), axis=0, out=total[1:])
    far, near, begin, close, end = (
        total[np.clip(np.arange(1, n_rows) + by, 0, n_rows)] for by in (-1 - _SIDE, -1 - _CLOSE, -1, 1, 1 + _CLOSE)
    )
    beyond = total[np.clip(np.arange(1, n_rows) + 1 + _SIDE, 0, n_rows)]
    left, right = _planes(begin - far), _planes(beyond - close)
    step = np.minimum(_off(left.plane, end - close), _off(right.plane, begin - near))
    is_known = left.is_known & right.is_known
    return np.where(is_known, step, 0.0), _ROUGH * np.maximum(left.rough, right.rough), is_known


class _Planes(NamedTuple):
    """Planes (..., 3), whether enough points show them, and how far these are off them (rms, m), (...) each."""

    plane: FloatArray
    is_known: BoolArray
    rough: FloatArray


def _planes(sums: FloatArray) -> _Planes:
    """The planes of points with the ``sums`` (..., 10) of 1, x, y, z, xx, xy, yy, xz, yz, zz."""
    n = sums[..., 0]
    is_known = n >= _LEAST
    normal = sums[..., [[0, 1, 2], [1, 4, 5], [2, 5, 6]]] + 1e-6 * np.eye(3)
    normal[~is_known] = np.eye(3)
    right = sums[..., [3, 7, 8]]
    plane: FloatArray = np.linalg.solve(normal, right[..., None])[..., 0].astype(np.float64)
    off = np.maximum(sums[..., 9] - np.sum(plane * right, axis=-1), 0.0)
    return _Planes(plane, is_known, np.sqrt(off / np.maximum(n - 3.0, 1.0)))


def _off(plane: FloatArray, sums: FloatArray) -> FloatArray:
    """How far (...) m points with these ``sums`` (..., 10) lie off a ``plane`` (..., 3) in the mean, 0 for none."""
    off = sums[..., 3] - np.sum(plane * sums[..., :3], axis=-1)
    return np.asarray(np.abs(off) / np.maximum(sums[..., 0], 1.0))
