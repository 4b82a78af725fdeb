"""Boxes around groups of points, and how much two of them overlap."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from loda_pdal.kernels.boxes import drop_inner_points, shared_volumes, smallest_rectangles
from loda_pdal.kernels.parallel import run_ranges
from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.groups import Groups

LEAST_SIZE_M = 0.25
"""No side of a box is shorter: a fused point stands for a voxel, and a wall seen from one side has no thickness."""


@dataclass(frozen=True)
class Boxes:
    """Oriented boxes, one per group of points; NaN for a group without points.

    Attributes
    ----------
    centre : (n, 3) float64, m
        Middle of each box.
    axes : (n, 3, 3) float64
        Unit vectors along the sides, one per row. Upright boxes: the long level side (its x is not negative), the
        short level side, up. Principal boxes: by descending spread of the points.
    size : (n, 3) float64, m
        Full lengths of the sides along ``axes``, at least `LEAST_SIZE_M`.
    """

    centre: FloatArray
    axes: FloatArray
    size: FloatArray

    def __len__(self) -> int:
        return len(self.centre)

    @property
    def volume(self) -> FloatArray:
        """Volume of each box, (n,) m3."""
        return np.asarray(np.prod(self.size, axis=1))

    def subset(self, idx: npt.NDArray[Any]) -> Boxes:
        """The boxes at ``idx``."""
        return Boxes(self.centre[idx], self.axes[idx], self.size[idx])

    def flattened(self) -> Boxes:
        """The same boxes with their z side pressed to one metre about z = 0: their volume is their footprint's area."""
        return Boxes(self.centre * [1.0, 1.0, 0.0], self.axes, np.column_stack([self.size[:, :2], np.ones(len(self))]))

    def footprint_overlap(self, a: npt.NDArray[Any], b: npt.NDArray[Any]) -> FloatArray:
        """Intersection over union (p,) of the footprints of upright boxes ``a`` and ``b`` of this set, (p,) indices."""
        flat = self.flattened()
        return box_iou(flat, a, flat, b)


def upright_boxes(xyz: FloatArray, labels: npt.NDArray[Any], n: int) -> Boxes:
    """Gravity-aligned boxes: the smallest rectangle in plan, from the lowest to the highest point.

    Parameters
    ----------
    xyz : (m, 3) float64, m
        Points, z up.
    labels : (m,) int
        Group of each point, 0 to ``n - 1``; points with a negative label belong to none.
    n : int
        Number of groups.

    Notes
    -----
    The rectangle of least area has a side on an edge of the convex hull; all edges are tried, so it is exact. Where
    several have the same area, that of least perimeter is taken.
    """
    groups = Groups(labels, n)
    xy = np.ascontiguousarray(xyz[:, :2])
    outer_label = labels.astype(np.int32)
    run_ranges(drop_inner_points, n, xy, groups.order, groups.starts, outer_label, min_size=64)
    outer = Groups(outer_label, n)
    by_place = outer.order[np.lexsort((xy[outer.order, 1], xy[outer.order, 0], outer_label[outer.order]))]
    plan, along, rectangle = np.full((n, 2), np.nan), np.full((n, 2), np.nan), np.full((n, 2), np.nan)
    run_ranges(smallest_rectangles, n, xy, by_place, outer.starts, plan, along, rectangle, min_size=64)
    low, high = groups.extremes(xyz[:, 2])
    size = np.column_stack([rectangle, high - low])
    axes = np.zeros((n, 3, 3))
    axes[:, 0, :2] = along
    axes[:, 1, 0], axes[:, 1, 1] = -along[:, 1], along[:, 0]
    axes[:, 2, 2] = 1.0
    return Boxes(np.column_stack([plan, (low + high) / 2]), axes, np.maximum(size, LEAST_SIZE_M))


def pca_boxes(xyz: FloatArray, labels: npt.NDArray[Any], n: int) -> Boxes:
    """Boxes along the principal axes of the points (paper, section 4.1); parameters as in `upright_boxes`."""
    if n == 0 or not np.any(labels >= 0):
        return Boxes(np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan))
    groups = Groups(labels, n)
    mean = groups.mean(xyz)
    _, vectors = np.linalg.eigh(groups.covariance(xyz))
    axes = np.swapaxes(vectors, 1, 2)[:, ::-1]  # rows, by descending spread
    strongest = np.take_along_axis(axes, np.argmax(np.abs(axes), axis=2)[:, :, None], axis=2)
    axes = axes * np.where(strongest < 0, -1.0, 1.0)
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    owner = np.maximum(labels, 0)
    offset = xyz - mean[owner]
    along = [np.einsum("ij,ij->i", offset, axes[owner, axis]) for axis in range(3)]
    low, high = groups.extremes(np.column_stack(along))
    centre = mean + np.einsum("ij,ijk->ik", (low + high) / 2, axes)
    return Boxes(centre, axes, np.maximum(high - low, LEAST_SIZE_M))


def boxes_of(kind: str, xyz: FloatArray, labels: npt.NDArray[Any], n: int) -> Boxes:
    """`upright_boxes` or `pca_boxes`, by the name that the parameters use: ``upright`` or ``pca``."""
    return pca_boxes(xyz, labels, n) if kind == "pca" else upright_boxes(xyz, labels, n)


def box_iou(a: Boxes, i: npt.NDArray[Any], b: Boxes, j: npt.NDArray[Any]) -> FloatArray:
    """Intersection over union, in volume, of box ``i`` of one set and box ``j`` of another, pair by pair.

    Parameters
    ----------
    a, b : Boxes
        Two sets, upright or not.
    i, j : (p,) int
        Indices into ``a`` and ``b``.

    Returns
    -------
    (p,) float64
        0 to 1, exact up to rounding, and the same number when the sets change places; 0 where a box is NaN.
    """
    first, second = np.ascontiguousarray(i, dtype=np.int64), np.ascontiguousarray(j, dtype=np.int64)
    boxes = [np.ascontiguousarray(each) for each in (a.centre, a.axes, a.size, b.centre, b.axes, b.size)]
    shared = np.zeros(len(first))
    run_ranges(shared_volumes, len(first), first, second, *boxes, shared)
    union = a.volume[first] + b.volume[second] - shared
    return np.clip(np.divide(shared, union, out=np.zeros(len(first)), where=union > 0), 0.0, 1.0)
