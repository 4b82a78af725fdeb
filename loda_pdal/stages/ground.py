"""Ground model and common vertical axis (paper, section 4.1).

The paper fits a plane by RANSAC in every 2 m cell. In a city most of what a cell holds need not be ground, so the
points that may be ground are chosen first: the lowest surface on a raster of half the cell, opened with growing
windows (after Zhang et al. 2003 and Pingel et al. 2013), so that whatever stands on the ground and is narrower than
``max_object_m`` is bridged. Cells without a plane are filled smoothly from their neighbours and marked.

Cells grow with the spacing of sparse surveys, and a plane of 8 m cuts off what the terrain does within it: there the
surface goes on, in cells of the paper's size, through what the ground points lie off the planes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from loda_pdal.kernels.ground_planes import blended_height_range, fit_planes
from loda_pdal.kernels.ground_raster import (
    cell_range,
    group_by_cell,
    lower_to,
    relax,
    sort_range,
)
from loda_pdal.kernels.parallel import run_ranges
from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array, IntArray
from loda_pdal.model.groups import Groups
from loda_pdal.model.transform import rotation_between
from loda_pdal.params import GroundParams

OPENING_SLOPE = 0.15
"""A step that rises more than this times the opening window's radius is not terrain."""

SUPPORT_STEP_M = 0.3
"""Cells whose lowest points differ less (plus slope) support each other; a lone low cell is a false echo."""

MIN_SUPPORT = 3
"""Of the 24 cells around a cell, so many must support it."""

CANDIDATE_M = 0.2
"""Points this near to the opened surface (plus its slope within a cell) may be ground."""

DETREND_PASSES = 2
"""The opening is repeated on what the first terrain leaves, so that crests are not cut."""

MIN_OPEN_SHARE = 0.12
"""Share of the occupied half-cells with nothing but ground in them below which a scene has no ground. Measured: 0.21 to
0.99 on 20 street and airborne clouds, 0.03 to 0.08 on two surveys of one place, objects only, in two crops each."""

DETAIL_PASSES = 2
"""Times that the detail between planes is looked for."""

DETAIL_QUANTILE = 0.25
"""Of what the ground points of a cell lie off the planes, this quantile is the surface."""

SMOOTHING_CELLS = 2.0
"""Standard deviation, in half-cells, of the smoothing of the surface of lowest returns."""


@dataclass(frozen=True)
class GroundModel:
    """One plane per ground cell, blended bilinearly between the cells' centres.

    Attributes
    ----------
    cell_m : float
        Edge of a cell, m (half the parameter's where there is no ground, ``detail_m`` where that is finer); cell (i, j)
        covers ``(first + (i, j)) * cell_m`` onwards.
    first : (2,) int64
        Indices of the first cell along x and y.
    height : (nx, ny) float64, m
        Height of the plane at the cell's centre; NaN where there is no ground within reach.
    slope : (nx, ny, 2) float64
        Rise of the plane per metre along x and y; zero where interpolated, and in cells of ``detail_m``.
    is_plane : (nx, ny) bool
        Whether the cell has a plane of its own, or ground points where cells are of ``detail_m``; the others are
        interpolated.
    has_ground : bool
        False for objects cut out of their scene: then heights are above the lowest returns nearby.
    up : (3,) float64
        Unit vector, the median ground normal; z where there is no ground.
    """

    cell_m: float
    first: Int64Array
    height: FloatArray
    slope: FloatArray
    is_plane: BoolArray
    has_ground: bool
    up: FloatArray

    def height_at(self, xy: FloatArray) -> FloatArray:
        """Ground height (k,) m at plan positions (k, 2) m; NaN where there is none. Continuous where defined."""
        found = np.full(len(xy), np.nan)
        planes = np.ascontiguousarray(self.height), np.ascontiguousarray(self.slope)
        run_ranges(
            blended_height_range, len(xy), np.ascontiguousarray(xy), float(self.cell_m), self.first, *planes, found
        )
        return found


def ground_model(xyz: FloatArray, n_raw: IntArray, params: GroundParams) -> GroundModel:
    """Ground of one epoch.

    Parameters
    ----------
    xyz : (m, 3) float64, m
        Fused points in local coordinates.
    n_raw : (m,) int32
        Raw points of each.
    params : GroundParams

    Returns
    -------
    GroundModel
        Without cells where ``xyz`` is empty.

    References
    ----------
    Paper, section 4.1 (2 m ground planes, common vertical axis); METHOD 1.1.
    """
    if len(xyz) == 0:
        return _without_planes(params.cell_m, np.zeros(2, np.int64), np.zeros((0, 0)))
    fine, coarse = _raster(xyz, params.cell_m / 2), _raster(xyz, params.cell_m)
    surface = _terrain(_lowest(xyz[:, 2], fine), fine.cell_m, params)
    is_candidate = _near(xyz, fine, surface)
    model = _filled(_cell_planes(xyz, n_raw, is_candidate, coarse, params), coarse, params)
    if not _has_ground(xyz, model, fine, params):
        return _above_lowest(surface, fine)
    return _with_detail(model, xyz, is_candidate, params.detail_m) if params.cell_m > params.detail_m else model


def vertical_rotation(up: FloatArray) -> FloatArray:
    """Smallest rotation (3, 3) that turns the unit vector ``up`` (3,) onto z (paper, section 4.1)."""
    return rotation_between(np.asarray(up, dtype=np.float64), np.array([0.0, 0.0, 1.0]))


@dataclass(frozen=True)
class _Raster:
    """Cells of a dense raster in plan: first cell and shape as in `GroundModel`, and each point's cell, row by row."""

    cell_m: float
    first: Int64Array
    shape: tuple[int, int]
    cell_idx: Int64Array


@dataclass(frozen=True)
class _Planes:
    """Cells (c, 2) int64 that have a plane, and the planes (c, 3): height at the centre (m), rise along x and y."""

    cells: Int64Array
    planes: FloatArray


def _raster(xyz: FloatArray, cell_m: float) -> _Raster:
    first, last = (
        np.array([np.floor(xyz[:, axis].min() / cell_m) for axis in (0, 1)], dtype=np.int64),
        np.array([np.floor(xyz[:, axis].max() / cell_m) for axis in (0, 1)], dtype=np.int64),
    )
    n_x, n_y = (int(n) for n in last - first + 1)
    cell_idx = np.empty(len(xyz), dtype=np.int64)
    run_ranges(cell_range, len(xyz), np.ascontiguousarray(xyz), float(cell_m), first, n_y, cell_idx)
    return _Raster(cell_m, first, (n_x, n_y), cell_idx)


def _lowest(values: FloatArray, raster: _Raster) -> FloatArray:
    """Least of the values (m,) in each cell; NaN where there is none."""
    lowest = np.full(raster.shape, np.inf)
    lower_to(lowest.reshape(-1), raster.cell_idx, np.ascontiguousarray(values))
    return np.where(lowest < np.inf, lowest, np.nan)


def _terrain(lowest: FloatArray, cell_m: float, params: GroundParams) -> FloatArray:
    """Terrain height per fine cell, m: what progressive opening leaves, filled smoothly."""
    is_supported = _is_supported(lowest, cell_m)
    low = np.where(is_supported, lowest, np.nan) if is_supported.any() else lowest
    terrain = np.zeros(low.shape)
    for _ in range(DETREND_PASSES):
        surface = low - terrain
        is_object = np.zeros(low.shape, np.bool_)
        for radius in _window_radii(params.max_object_m / 2 / cell_m):
            opened = _opened(surface, radius)
            is_object |= surface - opened > OPENING_SLOPE * radius * cell_m
            surface = opened
        terrain = _fill(np.where(is_object, np.nan, low))
    return terrain


def _is_supported(lowest: FloatArray, cell_m: float) -> BoolArray:
    """Whether enough of the 24 cells around a cell have their lowest points at about the same height."""
    padded = np.pad(lowest, 2, constant_values=np.nan)
    n_x, n_y = lowest.shape
    count = np.zeros(lowest.shape, np.int32)
    for i, j in np.ndindex(5, 5):
        if (i, j) != (2, 2):
            step = np.abs(padded[i : i + n_x, j : j + n_y] - lowest)
            count += step < SUPPORT_STEP_M + OPENING_SLOPE * cell_m * math.hypot(i - 2, j - 2)
    return np.asarray(count >= MIN_SUPPORT)


def _window_radii(largest: float) -> list[int]:
    """Whole radii in cells from 1 to ``largest``, growing by about two fifths."""
    radii, last = [1], max(1, math.ceil(largest))
    while radii[-1] < last:
        radii.append(min(last, max(radii[-1] + 1, round(radii[-1] * 1.4))))
    return radii


def _opened(surface: FloatArray, radius: int) -> FloatArray:
    """Grey opening with a square window over the cells that are not NaN; the window's centre is one of them."""
    size = 2 * radius + 1
    is_empty = np.isnan(surface)
    eroded = ndimage.minimum_filter(np.where(is_empty, np.inf, surface), size, mode="constant", cval=np.inf)
    opened = ndimage.maximum_filter(np.where(is_empty, -np.inf, eroded), size, mode="constant", cval=-np.inf)
    return np.where(is_empty, np.nan, opened)


def _near(xyz: FloatArray, raster: _Raster, surface: FloatArray) -> BoolArray:
    """Whether each point lies on the terrain, within `CANDIDATE_M` and what the terrain rises within a cell."""
    padded = np.pad(surface, 1, mode="edge")
    rise_x = np.abs(padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    rise_y = np.abs(padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    tolerance = CANDIDATE_M + (rise_x + rise_y)
    return np.asarray(np.abs(xyz[:, 2] - surface.ravel()[raster.cell_idx]) < tolerance.ravel()[raster.cell_idx])


def _cell_planes(
    xyz: FloatArray, n_raw: IntArray, is_candidate: BoolArray, raster: _Raster, params: GroundParams
) -> _Planes:
    """Planes of the cells whose candidates make one (paper: at least 200 inliers; METHOD 1.1: scaled with density)."""
    candidates = np.flatnonzero(is_candidate)
    cell_idx = raster.cell_idx[candidates]
    count = np.bincount(cell_idx, minlength=raster.shape[0] * raster.shape[1])
    occupied = np.flatnonzero(count)
    start = np.append(0, np.cumsum(count[occupied]))
    order = np.empty(len(candidates), dtype=np.int64)
    group_by_cell(cell_idx, np.cumsum(count) - count, order)
    points = xyz[candidates]
    run_ranges(sort_range, len(occupied), start, points, order, min_size=256)
    points, weight = points[order], n_raw[candidates[order]].astype(np.int64)
    own = np.column_stack(np.divmod(occupied, raster.shape[1])) + raster.first
    points[:, :2] -= np.repeat((own + 0.5) * params.cell_m, count[occupied], axis=0)
    plane, n_inliers, n_raw_inliers = fit_planes(
        points,
        weight,
        start,
        params.seed,
        params.cell_m,
        params.inlier_m,
        math.tan(math.radians(params.max_slope_deg)),
        params.iterations,
    )
    n_raw_cell = np.add.reduceat(weight, start[:-1]) if len(own) else np.zeros(0, np.int64)
    is_plane = (n_inliers >= params.min_voxels) & (n_raw_inliers >= np.minimum(params.min_inliers, n_raw_cell / 2))
    return _Planes(own[is_plane], plane[is_plane])


def _filled(planes: _Planes, raster: _Raster, params: GroundParams) -> GroundModel:
    """The planes on a raster, cells without one interpolated as far as ``max_object_m`` from the nearest plane."""
    i, j = (planes.cells - raster.first).T
    is_plane = np.zeros(raster.shape, np.bool_)
    is_plane[i, j] = True
    height, slope = np.full(raster.shape, np.nan), np.zeros((*raster.shape, 2))
    height[i, j], slope[i, j] = planes.planes[:, 0], planes.planes[:, 1:]
    distance = ndimage.distance_transform_edt(~is_plane, sampling=params.cell_m)
    height = np.where(distance <= params.max_object_m, _fill(height), np.nan)
    up = np.append(-np.median(planes.planes[:, 1:], axis=0), 1.0) if len(planes.cells) else np.array([0.0, 0.0, 1.0])
    return GroundModel(params.cell_m, raster.first, height, slope, is_plane, True, up / np.linalg.norm(up))


def _with_detail(model: GroundModel, xyz: FloatArray, is_candidate: BoolArray, cell_m: float) -> GroundModel:
    """The planes, and in each cell of ``cell_m`` how far its ground points lie off them, smooth between.

    What lies on the surface so found is ground too, and the surface is found anew (after Axelsson 2000). Of a cell's
    points the lower ones count: plants stand above the ground, and nothing lies below it.
    """
    raster = _raster(xyz, cell_m)
    centres = (np.argwhere(np.ones(raster.shape, np.bool_)) + raster.first + 0.5).astype(np.float64) * cell_m
    detailed = replace(
        model,
        cell_m=cell_m,
        first=raster.first,
        height=model.height_at(centres).reshape(raster.shape),
        slope=np.zeros((*raster.shape, 2)),
    )
    for _ in range(DETAIL_PASSES):
        off = xyz[:, 2] - detailed.height_at(xyz[:, :2])
        is_ground = np.flatnonzero(np.isfinite(off) & (is_candidate | (np.abs(off) < CANDIDATE_M)))
        cells = Groups(raster.cell_idx[is_ground].astype(np.int32), detailed.height.size)
        rise = cells.quantile(off[is_ground], DETAIL_QUANTILE).reshape(raster.shape)
        detailed = replace(detailed, height=detailed.height + _fill(rise), is_plane=np.isfinite(rise))
    return detailed


def _has_ground(xyz: FloatArray, model: GroundModel, fine: _Raster, params: GroundParams) -> bool:
    """Whether the planes are the ground of a whole scene, and not the feet of objects cut out of one."""
    distance = np.abs(xyz[:, 2] - model.height_at(xyz[:, :2]))
    farthest = -_lowest(-np.nan_to_num(distance, nan=np.inf), fine)
    is_open = farthest[farthest >= 0] < 2 * params.inlier_m
    return bool(np.mean(is_open) >= MIN_OPEN_SHARE)


def _above_lowest(surface: FloatArray, raster: _Raster) -> GroundModel:
    """Smooth surface through the lowest returns: what heights refer to in a scene without ground."""
    return _without_planes(
        raster.cell_m, raster.first, ndimage.gaussian_filter(surface, SMOOTHING_CELLS, mode="nearest")
    )


def _without_planes(cell_m: float, first: Int64Array, height: FloatArray) -> GroundModel:
    flat, is_plane = np.zeros((*height.shape, 2)), np.zeros(height.shape, np.bool_)
    return GroundModel(cell_m, first, height, flat, is_plane, False, np.array([0.0, 0.0, 1.0]))


def _fill(height: FloatArray, sweeps: int = 100) -> FloatArray:
    """NaN cells filled smoothly from the others: means over ever larger blocks, then relaxation towards a membrane."""
    is_known = np.isfinite(height)
    if is_known.all() or not is_known.any():
        return height
    filled = np.where(is_known, height, _from_blocks(height))
    return np.asarray(relax(filled, is_known, sweeps))


def _from_blocks(height: FloatArray) -> FloatArray:
    """NaN cells of a raster from the 2 x 2 blocks that hold them, those from theirs, and so on up."""
    is_known = np.isfinite(height)
    if is_known.all():
        return height
    n_x, n_y = height.shape
    blocks = np.pad(height, ((0, n_x % 2), (0, n_y % 2)), constant_values=np.nan)
    quarters = np.stack([blocks[0::2, 0::2], blocks[1::2, 0::2], blocks[0::2, 1::2], blocks[1::2, 1::2]])
    count = np.isfinite(quarters).sum(axis=0)
    total = np.nansum(quarters, axis=0)
    coarse = _from_blocks(np.where(count > 0, total / np.maximum(count, 1), np.nan))
    spread = ndimage.zoom(coarse, 2, order=1, mode="nearest", grid_mode=True)[:n_x, :n_y]
    return np.where(is_known, height, spread)
