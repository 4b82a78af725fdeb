"""Where a survey shows a wall end: at a roof, or where it saw no farther (METHOD 2).

A sensor looks up to a limit, and a crown before a wall hides a piece of it. Beneath what only the other survey shows
then no roof ends: along the wall the last that is seen follows the edge of the view, and a roof is level or a gable.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from loda_pdal.model.boxes import upright_boxes
from loda_pdal.model.cloud import BoolArray, FloatArray, IntArray
from loda_pdal.model.pair import Pair
from loda_pdal.params import ChangeParams
from loda_pdal.stages.cues import Cells, Surface
from loda_pdal.stages.parts import connected_regions

_THICK_M = 1.6
"""What is thicker in plan is no wall: roofs show their slopes."""

_LEAST_LENGTH_M = 3.0
"""Less of a wall does not tell how it ends: dormers are shorter."""

_MOST_NEW = 0.5
"""Share of the columns in which the other survey may have nothing of the wall: it must show where it ends."""

_FLANK_M = 6.0
"""The wall is followed so far to either side of what one survey shows alone."""

_SHORT_M = 0.4
"""It is followed where the other survey ends lower than this: beside a storey at once, beside a view by and by."""

_LEVEL_M = 0.6
"""Ends of the wall within this much of each other are at one level: what is fused to 0.25 m, and its gutter."""

_LEVEL_SHARE = 0.65
"""Share of a wall that ends at one level where a roof does: the rest are chimneys, and gaps of the sampling."""

_GABLE_M = 0.3
"""The middle of a gable is higher than both its sides by more than this."""


def beyond_view(cells: Cells, surfaces: Pair[Surface], is_asked: BoolArray, params: ChangeParams) -> Pair[BoolArray]:
    """Voxels (c,) of walls that the epoch does not show because its view of the wall ended beneath them.

    Parameters
    ----------
    cells : Cells
        Voxels with their owners.
    surfaces : Pair of Surface
        Points with their objects, 0 to ``n - 1``.
    is_asked : (n,) bool
        Buildings that both epochs have.
    """
    own = cells.owner
    asked = np.append(is_asked, False)
    sides = surfaces.map(lambda side: _by_x(side, asked))
    return Pair(
        _beyond(cells, own.swapped, cells.is_gained, sides.swapped, is_asked, params),
        _beyond(cells, own, cells.is_lost, sides, is_asked, params),
    )


class _Points(NamedTuple):
    """Points (m, 3) m, ascending in x, and the object (m,) of each."""

    xyz: FloatArray
    owner: IntArray


def _by_x(surface: Surface, asked: BoolArray) -> _Points:
    """The points of objects that are ``asked`` for (n + 1,), the last of those without object."""
    points = np.flatnonzero(asked[surface.owner])
    points = points[np.argsort(surface.xyz[points, 0], kind="stable")]
    return _Points(surface.xyz[points], surface.owner[points])


def _beyond(
    cells: Cells,
    owner: Pair[IntArray],
    is_in: BoolArray,
    sides: Pair[_Points],
    is_asked: BoolArray,
    params: ChangeParams,
) -> BoolArray:
    """Which of the voxels ``is_in`` (c,) of one epoch lie where the other epoch's view of their wall had ended.

    ``owner`` (c,) and ``sides`` of this epoch and of the other.
    """
    found = np.zeros(len(is_in), np.bool_)
    regions = connected_regions(cells, owner, is_in, is_asked, params.backing_voxels)
    regions = [region for region in regions if region.share_new <= _MOST_NEW]
    if not regions:
        return found
    voxels = np.concatenate([region.voxels for region in regions])
    label = np.repeat(np.arange(len(regions)), [region.n_voxels for region in regions]).astype(np.int32)
    boxes = upright_boxes(cells.voxels.centre[voxels], label, len(regions))
    for region, centre, axes, size in zip(regions, boxes.centre, boxes.axes, boxes.size, strict=True):
        if size[0] < _LEAST_LENGTH_M or size[1] > _THICK_M:
            continue
        wall = _Wall(region.parent, centre, axes, size, params.voxel_m)
        own, other = sides.map(wall.tops)
        is_short = own - other > _SHORT_M
        is_short[wall.inside] = True
        first, last = wall.inside.start, wall.inside.stop
        while first > 0 and is_short[first - 1]:
            first -= 1
        while last < len(is_short) and is_short[last]:
            last += 1
        ends = other[first:last]
        found[region.voxels] = not _is_roofline(ends[np.isfinite(ends)])
    return found


class _Wall(NamedTuple):
    """A wall of an object, followed in steps (m) past both ends of an upright box of voxels that is a piece of it."""

    parent: int
    centre: FloatArray
    axes: FloatArray
    size: FloatArray
    step_m: float

    @property
    def inside(self) -> slice:
        """The steps that lie in the box."""
        n_flank = int(np.ceil(_FLANK_M / self.step_m))
        return slice(n_flank, n_flank + int(np.floor(self.size[0] / self.step_m + 0.5)) + 1)

    def tops(self, points: _Points) -> FloatArray:
        """How high (k,) m the points reach in each step, no higher than the box; NaN where there are none."""
        reach = self.size[0] / 2 + self.size[1] + _FLANK_M
        near = slice(*np.searchsorted(points.xyz[:, 0], [self.centre[0] - reach, self.centre[0] + reach]))
        xyz = points.xyz[near][points.owner[near] == self.parent]
        along, across, up = ((xyz - self.centre) @ self.axes.T).T
        step = np.floor((along + self.size[0] / 2) / self.step_m + 0.5).astype(np.int64) + self.inside.start
        highest = np.full(self.inside.start + self.inside.stop, -np.inf)
        is_in = (step >= 0) & (step < len(highest))
        is_in &= (np.abs(across) <= self.size[1] / 2 + self.step_m) & (up <= self.size[2] / 2 + self.step_m)
        np.maximum.at(highest, step[is_in], xyz[is_in, 2])
        return np.where(np.isfinite(highest), highest, np.nan)


def _is_roofline(ends: FloatArray) -> bool:
    """Whether a wall that ends at these heights (k,) m, from one side to the other, ends level or in a gable."""
    if len(ends) < _LEAST_ENDS:
        return True
    # here and there a roof is not met, or a chimney is
    if max(_share_level(ends), _share_level(ndimage.maximum_filter1d(ends, 3))) >= _LEVEL_SHARE:
        return True
    first, middle, last = (float(np.median(side)) for side in np.array_split(ends, 3))
    return middle > max(first, last) + _GABLE_M


def _share_level(ends: FloatArray) -> float:
    """Largest share of the heights (k,) m that lie at one level."""
    level = np.sort(ends)
    n_level = np.searchsorted(level, level + _LEVEL_M, side="right") - np.arange(len(level))
    return float(n_level.max() / len(level))


_LEAST_ENDS = 3
"""Steps along a wall that tell how it ends."""
