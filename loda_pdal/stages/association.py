"""One-to-one assignment of the objects of two epochs (paper, section 4.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from loda_pdal.kernels.clusters import components
from loda_pdal.model.boxes import Boxes, box_iou, boxes_of
from loda_pdal.model.cloud import FloatArray, Int64Array, IntArray
from loda_pdal.model.groups import Groups, count_cells
from loda_pdal.params import AssociationParams


@dataclass(frozen=True)
class Descriptors:
    """What the assignment knows of the objects of one epoch.

    Attributes
    ----------
    centroid : (o, 3) float64, m
        Mean of the object's fused points.
    boxes : Boxes
        Oriented box of each object.
    h95 : (o,) float64, m
        95th percentile of height above ground; NaN where no height is known.
    histogram : (o, bins) float64
        Shares of the heights in equal bins on [0, h95]; all 0 where no height is known. Heights outside are left
        out.
    n_voxels : (o,) int64
        Occupancy voxels.
    """

    centroid: FloatArray
    boxes: Boxes
    h95: FloatArray
    histogram: FloatArray
    n_voxels: Int64Array

    def __len__(self) -> int:
        return len(self.centroid)

    def subset(self, idx: npt.NDArray[Any]) -> Descriptors:
        """The objects at ``idx``."""
        return Descriptors(
            self.centroid[idx], self.boxes.subset(idx), self.h95[idx], self.histogram[idx], self.n_voxels[idx]
        )


@dataclass(frozen=True)
class Matches:
    """Objects of the two epochs that belong together, by ascending ``before_idx``.

    Attributes
    ----------
    before_idx, after_idx : (p,) int32
        0-based indices into the descriptors; each object occurs at most once.
    cost : (p,) float64
        The paper's cost of each pair.
    iou : (p,) float64
        Intersection over union of the boxes.
    """

    before_idx: IntArray
    after_idx: IntArray
    cost: FloatArray
    iou: FloatArray

    def __len__(self) -> int:
        return len(self.before_idx)


def describe(
    xyz: FloatArray,
    height: FloatArray,
    labels: npt.NDArray[Any],
    n_objects: int,
    bins: int,
    voxel_m: float,
    boxes_kind: str,
) -> Descriptors:
    """Descriptors of the objects of one epoch.

    Parameters
    ----------
    xyz : (m, 3) float64, m
        Fused points, z up.
    height : (m,) float64, m
        Height above ground; NaN where it is not known.
    labels : (m,) int
        Object of each point, 1 to ``n_objects``; 0 none.
    bins : int
        Bins of the height histogram.
    voxel_m : float
        Edge of an occupancy voxel, m.
    boxes_kind : str
        ``upright`` or ``pca``.
    """
    owner = np.asarray(labels, dtype=np.int64) - 1
    groups = Groups(owner, n_objects)
    h95 = groups.quantile(height, 0.95)
    return Descriptors(
        groups.mean(xyz),
        boxes_of(boxes_kind, xyz, owner, n_objects),
        h95,
        _height_histogram(height, owner, h95, bins),
        count_cells(xyz, owner, n_objects, voxel_m).astype(np.int64),
    )


def associate(before: Descriptors, after: Descriptors, params: AssociationParams) -> Matches:
    """Pairs of objects at least total cost; an object is left unmatched where no pair is worth it.

    Parameters
    ----------
    before, after : Descriptors
        Objects of the two epochs in one frame.
    params : AssociationParams
        Gates, weights, and the cost of leaving an object unmatched.

    Notes
    -----
    Candidates are the pairs with centroids closer than ``gate_m`` and box IoU above ``gate_iou``; the cost is

        w_p |c_i - c_j|^2 + w_b (1 - IoU(B_i, B_j)) + w_h D(H_i, H_j)

    with D the chi-square distance 1/2 sum_k (H_ik - H_jk)^2 / (H_ik + H_jk), 0 to 1. Each object that stays
    unmatched, of either epoch, costs ``unmatched_cost``: a pair is worth its cost while that is below twice as much.
    The candidates fall into small groups that share no object; each group is solved by itself, so nothing grows with
    the product of the numbers of objects. Exchanging the epochs exchanges the answer: which of them stands in the rows
    is decided by where the objects are.

    References
    ----------
    Paper, section 4.1, last paragraph.
    """
    before_idx, after_idx = _by_place(before), _by_place(after)
    first, second = before.subset(before_idx), after.subset(after_idx)
    if _stands_first(second, first):
        column, row, cost, iou = _assigned(second, first, params)
    else:
        row, column, cost, iou = _assigned(first, second, params)
    order = np.argsort(before_idx[row])
    return Matches(
        before_idx[row][order].astype(np.int32), after_idx[column][order].astype(np.int32), cost[order], iou[order]
    )


def chi_square(a: FloatArray, b: FloatArray) -> FloatArray:
    """Chi-square distance (p,) of histograms (p, bins), 1/2 sum (a - b)^2 / (a + b): 0 equal, 1 nothing in common."""
    total = a + b
    terms = np.divide((a - b) ** 2, total, out=np.zeros_like(total), where=total > 0)
    return np.asarray(0.5 * terms.sum(axis=1))


def _by_place(objects: Descriptors) -> Int64Array:
    """Indices of the objects sorted by centroid, x first; those without points are left out."""
    order = np.lexsort(objects.centroid.T[::-1])
    return np.asarray(order[np.all(np.isfinite(objects.centroid[order]), axis=1)], dtype=np.int64)


def _stands_first(a: Descriptors, b: Descriptors) -> bool:
    """Whether ``a`` stands in the rows: fewer objects, else the first centroid coordinate that differs is smaller."""
    if len(a) != len(b):
        return len(a) < len(b)
    differs = np.argwhere(a.centroid != b.centroid)
    return len(differs) > 0 and bool(a.centroid[tuple(differs[0])] < b.centroid[tuple(differs[0])])


def _assigned(
    rows: Descriptors, columns: Descriptors, params: AssociationParams
) -> tuple[Int64Array, Int64Array, FloatArray, FloatArray]:
    """Row, column, cost and IoU of each pair chosen."""
    i, j = _pairs_within(rows.centroid, columns.centroid, params.gate_m)
    iou = box_iou(rows.boxes, i, columns.boxes, j)
    is_candidate = iou > params.gate_iou
    i, j, iou = i[is_candidate], j[is_candidate], iou[is_candidate]
    cost = (
        params.weight_position * np.sum((rows.centroid[i] - columns.centroid[j]) ** 2, axis=1)
        + params.weight_box * (1.0 - iou)
        + params.weight_histogram * chi_square(rows.histogram[i], columns.histogram[j])
    )
    worth = np.flatnonzero(cost < 2.0 * params.unmatched_cost)
    solve = _greedy if params.solver == "greedy" else _optimal
    chosen = worth[solve(i[worth], j[worth], cost[worth] - 2.0 * params.unmatched_cost)]
    return i[chosen], j[chosen], cost[chosen], iou[chosen]


def _pairs_within(a: FloatArray, b: FloatArray, radius: float) -> tuple[Int64Array, Int64Array]:
    """Index pairs of points (n, 3) and (k, 3) closer than ``radius``, in ascending order."""
    none = np.zeros(0, dtype=np.int64)
    if len(a) == 0 or len(b) == 0:
        return none, none
    lists = cKDTree(b).query_ball_point(a, radius)
    counts = np.array([len(found) for found in lists], dtype=np.int64)
    if not counts.any():
        return none, none
    i = np.repeat(np.arange(len(a), dtype=np.int64), counts)
    j = np.concatenate([np.sort(np.asarray(found, dtype=np.int64)) for found in lists])
    is_close = np.sum((a[i] - b[j]) ** 2, axis=1) < radius**2
    return i[is_close], j[is_close]


def _optimal(i: Int64Array, j: Int64Array, gain: FloatArray) -> Int64Array:
    """Which of the pairs make the total of their (negative) gains least, each object in one pair at most."""
    if len(i) == 0:
        return np.zeros(0, dtype=np.int64)
    n_rows = int(i.max()) + 1
    component = components(np.column_stack([i, j + n_rows]), n_rows + int(j.max()) + 1)[i]
    groups = Groups(component, int(component.max()) + 1)
    chosen = [_solved(groups.members(int(k)), i, j, gain) for k in np.flatnonzero(groups.counts)]
    return np.sort(np.concatenate(chosen))


def _solved(members: Int64Array, i: Int64Array, j: Int64Array, gain: FloatArray) -> Int64Array:
    """The chosen ones of the pairs ``members``, which share no object with any others.

    A pair that is no candidate gains nothing, which is the same as leaving both objects unmatched: so the rectangular
    assignment needs no further rows and columns for the unmatched.
    """
    if len(members) == 1:
        return members
    row_of, row = np.unique(i[members], return_inverse=True)
    column_of, column = np.unique(j[members], return_inverse=True)
    matrix = np.zeros((len(row_of), len(column_of)))
    pair = np.full(matrix.shape, -1, dtype=np.int64)
    matrix[row, column] = gain[members]
    pair[row, column] = members
    found = pair[linear_sum_assignment(matrix)]
    return np.asarray(found[found >= 0])


def _greedy(i: Int64Array, j: Int64Array, gain: FloatArray) -> Int64Array:
    """Pairs taken by ascending gain as long as both objects are free."""
    taken_rows: set[int] = set()
    taken_columns: set[int] = set()
    chosen = []
    for k in np.argsort(gain, kind="stable").tolist():
        if i[k] not in taken_rows and j[k] not in taken_columns:
            taken_rows.add(int(i[k]))
            taken_columns.add(int(j[k]))
            chosen.append(k)
    return np.sort(np.array(chosen, dtype=np.int64))


def _height_histogram(height: FloatArray, owner: Int64Array, h95: FloatArray, bins: int) -> FloatArray:
    """Shares (n, bins) of each object's heights in equal bins on [0, h95], the last bin closed."""
    n = len(h95)
    member = np.flatnonzero(owner >= 0)
    top = h95[owner[member]]
    is_inside = (top > 0) & (height[member] >= 0) & (height[member] <= top)
    member, top = member[is_inside], top[is_inside]
    bin_idx = np.minimum((height[member] / top * bins).astype(np.int64), bins - 1)
    counts = np.bincount(owner[member] * bins + bin_idx, minlength=n * bins).reshape(n, bins)
    return np.asarray(counts / np.maximum(counts.sum(axis=1, keepdims=True), 1))
