"""Vehicles among what stands loose on the ground, whatever leans on them or passed by (beyond the paper).

The paper takes a superpoint that fits a vehicle's box for a vehicle. A street is fuller than that: signs and lamp posts
stand beside vehicles, crowns hang over them, and traffic leaves its smear along them, so that what touches fits no box.
A body of sheet metal is smooth, foliage and smears are not, and poles rise above it. What is left of a place without
those falls apart into things that have a vehicle's size, or have not.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from loda_pdal.kernels.clusters import linked
from loda_pdal.kernels.neighbours import knn, nearest
from loda_pdal.model.boxes import upright_boxes
from loda_pdal.model.cloud import BoolArray, Float32Array, FloatArray, Int64Array, IntArray
from loda_pdal.model.groups import Groups, consecutive
from loda_pdal.params import SemanticParams

CELL_M = 0.25
"""Edge of the columns in which smoothness is judged, with the eight around each."""

_NEIGHBOURS, _REACH_M = 4, 0.6  # of which one is the point itself
_GAPS_M = (0.5, 0.35, 0.25)
"""What is nearer belongs together; where that fits no vehicle, the next."""

_LEAST_M = (1.5, 0.9, 0.8)
"""Length, width and height of a vehicle."""

_LEAST_VOXELS = 40
_FOOT_M = 0.8
"""A vehicle's lowest point lies no higher above the ground."""

_BONNET_M = 1.0
"""The lowest point of it that is seen from the air lies no higher: a bonnet, a boot."""

_MARGIN_M = 1.5
"""Vans and trailers are longer than the paper's 5 m; the limit is for superpoints, this is added for whole vehicles."""

_TRIM_M = 0.3
"""Mirrors, frames and what lies behind glass are no farther from the body."""


def parked_vehicles(
    xyz: FloatArray, height: FloatArray, normals: Float32Array, is_loose: BoolArray, params: SemanticParams
) -> tuple[IntArray, BoolArray]:
    """Vehicle (m,) of each point, 0 to ``n - 1``, -1 none; and which points (m,) lie low and smooth: on what is solid.

    Parameters
    ----------
    xyz : (m, 3) float64, m
        Fused points.
    height : (m,) float, m
        Above ground.
    normals : (m, 3) float32
        Unit normals.
    is_loose : (m,) bool
        What is neither ground nor building.
    """
    vehicle = np.full(len(xyz), -1, dtype=np.int32)
    is_low = height < params.mobile_height_m
    low = np.flatnonzero(is_loose & is_low)
    is_solid = np.zeros(len(xyz), np.bool_)
    if params.vehicle_roughness == 0 or len(low) < _LEAST_VOXELS:
        return vehicle, is_solid
    above = np.flatnonzero(is_loose & ~is_low & (height < params.mobile_height_m + 1.0))
    place, shape = _columns(xyz[np.concatenate([low, above]), :2])
    is_tall = np.zeros(shape, np.bool_)
    is_tall.ravel()[place[len(low) :]] = True
    is_pole = is_tall & ~ndimage.binary_opening(is_tall, np.ones((3, 3)))  # crowns are wider
    place = place[: len(low)]
    is_smooth = _roughness(xyz[low], normals[low], place, shape) < params.vehicle_roughness
    is_solid[low[is_smooth]] = True
    is_open = ~is_pole.ravel()[place]
    rest = np.flatnonzero(is_smooth & is_open)
    n = 0
    for gap in _GAPS_M:
        if len(rest) == 0:
            break
        number = _of_vehicle_size(xyz[low[rest]], height[low[rest]], gap, params)
        is_found = number >= 0
        vehicle[low[rest[is_found]]] = number[is_found] + n
        n += int(number.max()) + 1
        rest = rest[~is_found]
    body = low[vehicle[low] >= 0]
    trim = low[is_open & (vehicle[low] < 0)]
    if len(body) and len(trim):
        found, _ = nearest(xyz[body], xyz[trim], _TRIM_M)
        vehicle[trim] = np.where(found >= 0, vehicle[body[found]], -1)
    return vehicle, is_solid


def across(xyz: FloatArray, normals: Float32Array) -> tuple[IntArray, FloatArray, FloatArray]:
    """The nearest neighbours (m, 4) of points, -1 none, their distances from the planes through each other, and their
    distances, m."""
    neighbour = knn(xyz, _NEIGHBOURS, _REACH_M).idx
    offset = xyz[neighbour] - xyz[:, None, :]
    distance = np.abs(np.einsum("ijk,ijk->ij", normals.astype(np.float64)[neighbour], offset))
    return neighbour, distance, np.linalg.norm(offset, axis=2)


def _roughness(xyz: FloatArray, normals: Float32Array, place: Int64Array, shape: tuple[int, int]) -> FloatArray:
    """How far neighbours lie from each other's planes over how far they lie apart (m,), in the column of each point and
    those around it: 0 in a plane, about a half where they lie anywhere, whatever the sampling."""
    neighbour, off_plane, apart = across(xyz, normals)
    sums = (np.where(neighbour >= 0, length, 0.0).sum(axis=1) for length in (off_plane, apart))
    total, whole = (
        ndimage.uniform_filter(np.bincount(place, part, shape[0] * shape[1]).reshape(shape), 3, mode="constant")
        for part in sums
    )
    return np.asarray((total / np.maximum(whole, 1e-9)).ravel()[place])


def _columns(xy: FloatArray) -> tuple[Int64Array, tuple[int, int]]:
    """Flat column (m,) of each place on a raster about them all, and the raster's shape."""
    cell = np.floor((xy - np.floor(xy.min(axis=0))) / CELL_M).astype(np.int64)
    nx, ny = (cell.max(axis=0) + 1).tolist()
    return cell[:, 0] * ny + cell[:, 1], (nx, ny)


def _of_vehicle_size(xyz: FloatArray, height: FloatArray, gap_m: float, params: SemanticParams) -> IntArray:
    """Number (k,) of the connected things that have a vehicle's size and stand on the ground, -1 for what has not."""
    thing, n = consecutive(linked(xyz, gap_m))
    groups = Groups(thing, n)
    is_within, is_body = vehicle_sized(xyz, thing, groups.minimum(height), params)
    fits = is_within & is_body & (groups.counts >= _LEAST_VOXELS)
    return np.where(fits, np.cumsum(fits) - 1, -1).astype(np.int32)[thing]


def vehicle_sized(
    xyz: FloatArray, thing: IntArray, lowest: FloatArray, params: SemanticParams, top: FloatArray | None = None
) -> tuple[BoolArray, BoolArray]:
    """Which things (n,) are no longer and wider than a vehicle, and which are as large as one and stand on the ground.

    ``thing`` (k,) of each point; ``lowest`` (n,) m, how high above the ground each begins, and for surveys from the air
    ``top`` (n,) m, how high it reaches: there a vehicle is its roof and its bonnet, and nothing beneath is seen.
    """
    size = upright_boxes(xyz, thing, len(lowest)).size
    length, width, tall = size[:, :2].max(axis=1), size[:, :2].min(axis=1), size[:, 2]
    is_within = (length < params.mobile_length_m + _MARGIN_M) & (width < params.mobile_width_m)
    is_body = (length > _LEAST_M[0]) & (width > _LEAST_M[1])
    if top is None:
        is_body &= (tall > _LEAST_M[2]) & (lowest < _FOOT_M)
    else:
        is_body &= (top > _LEAST_M[2]) & (lowest < _BONNET_M)
    return is_within, is_body
