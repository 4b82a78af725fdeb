"""Where a survey shows a wall end: at a roof, or where it saw no farther (METHOD 2).

A sensor looks up to a limit, and a crown before a wall hides a piece of it. Beneath what only the other survey shows
then no roof ends: along the wall the last that is seen follows the edge of the view, and a roof is level or a gable.
"""

from __future__ import annotations

import numpy as np

from loda_pdal.model.boxes import upright_boxes
from loda_pdal.model.cloud import BoolArray, FloatArray, IntArray
from loda_pdal.model.pair import Pair
from loda_pdal.params import ChangeParams
from loda_pdal.stages.cues import Cells, Surface
from loda_pdal.stages.parts import Region, connected_regions

_THICK_M = 1.6
"""What is thicker in plan is no wall: roofs show their slopes."""

_LEAST_LENGTH_M = 3.0
"""Less of a wall does not tell how it ends: dormers are shorter."""

_MOST_NEW = 0.5
"""Share of the columns in which the other survey may have nothing of the wall: it must show where it ends."""

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
    return Pair(
        _beyond(cells, own.swapped, cells.is_gained, surfaces.before, is_asked, params),
        _beyond(cells, own, cells.is_lost, surfaces.after, is_asked, params),
    )


def _beyond(
    cells: Cells, owner: Pair[IntArray], is_in: BoolArray, other: Surface, is_asked: BoolArray, params: ChangeParams
) -> BoolArray:
    """Which of the voxels ``is_in`` (c,) of one epoch lie where the ``other`` epoch's view of their wall had ended.

    ``owner`` (c,) of this epoch and of the other.
    """
    found = np.zeros(len(is_in), np.bool_)
    regions = connected_regions(cells, owner, is_in, is_asked, params.part_min_voxels)
    regions = [region for region in regions if region.share_new <= _MOST_NEW]
    if not regions:
        return found
    voxels = np.concatenate([region.voxels for region in regions])
    label = np.repeat(np.arange(len(regions)), [region.n_voxels for region in regions]).astype(np.int32)
    boxes = upright_boxes(cells.voxels.centre[voxels], label, len(regions))
    asked = np.append(is_asked, False)
    points = np.flatnonzero(asked[other.owner])
    points = points[np.argsort(other.xyz[points, 0], kind="stable")]
    x = other.xyz[points, 0]
    for region, centre, axes, size in zip(regions, boxes.centre, boxes.axes, boxes.size, strict=True):
        if size[0] < _LEAST_LENGTH_M or size[1] > _THICK_M:
            continue
        reach = float(np.hypot(size[0], size[1])) / 2 + params.voxel_m
        near = points[slice(*np.searchsorted(x, [centre[0] - reach, centre[0] + reach]))]
        ends = _ends(other.xyz[near[other.owner[near] == region.parent]], centre, axes, size, params.voxel_m)
        if len(ends) and not _is_roofline(ends):
            found[region.voxels] = True
    return found


def _ends(xyz: FloatArray, centre: FloatArray, axes: FloatArray, size: FloatArray, step_m: float) -> FloatArray:
    """How high (k,) m the points (m, 3) reach in steps along an upright box of voxels, from one end to the other, no
    higher than it; steps without points are left out."""
    along, across, up = ((xyz - centre) @ axes.T).T
    step = np.floor((along + size[0] / 2) / step_m + 0.5).astype(np.int64)
    n_steps = int(np.floor(size[0] / step_m + 0.5)) + 1
    is_in = (step >= 0) & (step < n_steps) & (np.abs(across) <= size[1] / 2 + step_m) & (up <= size[2] / 2 + step_m)
    highest = np.full(n_steps, -np.inf)
    np.maximum.at(highest, step[is_in], xyz[is_in, 2])
    return highest[np.isfinite(highest)]


def _is_roofline(ends: FloatArray) -> bool:
    """Whether a wall that ends at these heights (k,) m, from one side to the other, ends level or in a gable."""
    level = np.sort(ends)
    most = np.max(np.searchsorted(level, level + _LEVEL_M, side="right") - np.arange(len(level)))
    if most >= _LEVEL_SHARE * len(level):
        return True
    first, middle, last = (float(np.median(side)) for side in np.array_split(ends, 3)[:3] if len(side))
    return middle > max(first, last) + _GABLE_M
