"""Rays against a scene: a balanced tree of boxes over triangles and leaf discs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loda_pdal.benchmark.simulate.shapes import Shape
from loda_pdal.kernels.parallel import run_ranges
from loda_pdal.kernels.rays import LEAF_SIZE, nearest_hits
from loda_pdal.model.cloud import FloatArray, IntArray


class Hits(NamedTuple):
    """What rays met first.

    Attributes
    ----------
    range_m : (m,) float64, m
        Distance along the ray; infinity where nothing was met.
    primitive : (m,) int32
        Which triangle or disc of the shape (triangles first); -1 where nothing was met.
    """

    range_m: FloatArray
    primitive: IntArray


class RayCaster:
    """A surface prepared for ray casting.

    The tree halves its primitives at the median of their centres along the longest axis, level by level, until
    `LEAF_SIZE` are left; the last row is repeated to fill the final leaf.
    """

    def __init__(self, shape: Shape) -> None:
        low, high = _bounds(shape)
        n = max(len(shape), 1)
        n_leaves = 1 << max(int(np.ceil(np.log2(n / LEAF_SIZE))), 0)
        order = np.minimum(np.arange(n_leaves * LEAF_SIZE), n - 1)
        if len(shape) == 0:
            self._boxes = np.tile([np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf], (1, 1))
            self._slot_to_primitive = np.full(LEAF_SIZE, -1)
            self._rows, self._is_disc = np.zeros((LEAF_SIZE, 9)), np.zeros(LEAF_SIZE, dtype=bool)
            return
        centre = (low + high) / 2
        n_nodes = 1
        while n_nodes < n_leaves:
            parts = order.reshape(n_nodes, -1)
            centres = centre[parts]
            axis = np.argmax(np.ptp(centres, axis=1), axis=1)
            along = np.take_along_axis(centres, axis[:, None, None], axis=2)[:, :, 0]
            order = np.take_along_axis(parts, np.argsort(along, axis=1, kind="stable"), axis=1).ravel()
            n_nodes *= 2
        self._slot_to_primitive = order
        self._boxes = _boxes(low[order], high[order])
        self._rows = _rows(shape)[order]
        self._is_disc = (order >= len(shape.triangles)).astype(bool)

    def cast(self, origins: FloatArray, directions: FloatArray, max_range_m: float | FloatArray = np.inf) -> Hits:
        """First surface along rays from ``origins`` (m, 3) in unit ``directions`` (m, 3), m, nearer than
        ``max_range_m`` (one number, or one per ray)."""
        n = len(origins)
        range_m, slot = np.empty(n), np.empty(n, dtype=np.int32)
        limit = np.ascontiguousarray(np.broadcast_to(np.asarray(max_range_m, dtype=float), n))
        run_ranges(
            nearest_hits,
            n,
            np.ascontiguousarray(origins, dtype=float),
            np.ascontiguousarray(directions, dtype=float),
            limit,
            self._boxes,
            self._rows,
            self._is_disc,
            range_m,
            slot,
        )
        primitive = np.where(slot >= 0, self._slot_to_primitive[slot], -1).astype(np.int32)
        return Hits(range_m, primitive)


def normals_of(shape: Shape) -> FloatArray:
    """Unit normal of every primitive, triangles first, (t + d, 3); its sign means nothing."""
    t = shape.triangles
    normals = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-15)
    return np.concatenate([normals, shape.discs[:, 3:6]])


def _bounds(shape: Shape) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corner of the box about each primitive, (p, 3) each."""
    centre, normal, radius = shape.discs[:, :3], shape.discs[:, 3:6], shape.discs[:, 6:]
    reach = radius * np.sqrt(np.maximum(1.0 - normal**2, 0.0)) + 1e-9
    low = np.concatenate([shape.triangles.min(axis=1), centre - reach])
    high = np.concatenate([shape.triangles.max(axis=1), centre + reach])
    return low, high


def _rows(shape: Shape) -> FloatArray:
    """One row of nine numbers per primitive, as `nearest_hits` reads them."""
    t = shape.triangles
    triangles = np.concatenate([t[:, 0], t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]], axis=1)
    discs = np.pad(shape.discs, ((0, 0), (0, 2)))
    return np.concatenate([triangles, discs])


def _boxes(low: FloatArray, high: FloatArray) -> FloatArray:
    """Boxes of the whole tree in heap order, from the primitives in leaf order."""
    low, high = low.reshape(-1, LEAF_SIZE, 3).min(axis=1), high.reshape(-1, LEAF_SIZE, 3).max(axis=1)
    levels = [np.hstack([low, high])]
    while len(low) > 1:
        low, high = low.reshape(-1, 2, 3).min(axis=1), high.reshape(-1, 2, 3).max(axis=1)
        levels.append(np.hstack([low, high]))
    return np.ascontiguousarray(np.concatenate(levels[::-1]))
