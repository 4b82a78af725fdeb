"""Nearest hits of rays on triangles and discs, through a hierarchy of boxes."""

from __future__ import annotations

import numpy as np

from loda_pdal.kernels.compiled import inner, kernel
from loda_pdal.model.cloud import BoolArray, FloatArray, IntArray

LEAF_SIZE = 4
"""Primitives in one leaf of the hierarchy."""

_MAX_DEPTH = 64
_SMALLEST_T = 1e-6


@inner
def hit_triangle(o: FloatArray, d: FloatArray, p: FloatArray) -> float:
    """Distance along the ray to triangle ``p`` = (corner, edge 1, edge 2), (9,); infinity where missed.

    Moeller and Trumbore, both faces.
    """
    hx = d[1] * p[8] - d[2] * p[7]
    hy = d[2] * p[6] - d[0] * p[8]
    hz = d[0] * p[7] - d[1] * p[6]
    det = p[3] * hx + p[4] * hy + p[5] * hz
    if abs(det) < 1e-14:
        return np.inf
    sx, sy, sz = o[0] - p[0], o[1] - p[1], o[2] - p[2]
    u = (sx * hx + sy * hy + sz * hz) / det
    if u < 0.0 or u > 1.0:
        return np.inf
    qx = sy * p[5] - sz * p[4]
    qy = sz * p[3] - sx * p[5]
    qz = sx * p[4] - sy * p[3]
    v = (d[0] * qx + d[1] * qy + d[2] * qz) / det
    if v < 0.0 or u + v > 1.0:
        return np.inf
    t = (p[6] * qx + p[7] * qy + p[8] * qz) / det
    return t if t > _SMALLEST_T else np.inf


@inner
def hit_disc(o: FloatArray, d: FloatArray, p: FloatArray) -> float:
    """Distance along the ray to disc ``p`` = (centre, normal, radius, 0, 0), (9,); infinity where missed."""
    slope = d[0] * p[3] + d[1] * p[4] + d[2] * p[5]
    if abs(slope) < 1e-12:
        return np.inf
    sx, sy, sz = p[0] - o[0], p[1] - o[1], p[2] - o[2]
    t = (sx * p[3] + sy * p[4] + sz * p[5]) / slope
    if t <= _SMALLEST_T:
        return np.inf
    rx, ry, rz = t * d[0] - sx, t * d[1] - sy, t * d[2] - sz
    return t if rx * rx + ry * ry + rz * rz <= p[6] * p[6] else np.inf


@inner
def _enter_box(o: FloatArray, inverse: FloatArray, box: FloatArray, t_max: float) -> float:
    """Distance at which the ray enters ``box`` = (low, high), (6,); infinity where it does not before ``t_max``."""
    near, far = 0.0, t_max
    for axis in range(3):
        t1 = (box[axis] - o[axis]) * inverse[axis]
        t2 = (box[axis + 3] - o[axis]) * inverse[axis]
        near = max(near, min(t1, t2))
        far = min(far, max(t1, t2))
    return near if near <= far else np.inf


@kernel
def nearest_hits(
    start: int,
    stop: int,
    origins: FloatArray,
    directions: FloatArray,
    max_t: FloatArray,
    boxes: FloatArray,
    primitives: FloatArray,
    is_disc: BoolArray,
    out_t: FloatArray,
    out_slot: IntArray,
) -> None:
    """First surface met by rays ``start`` to ``stop``.

    ``boxes`` (2 l - 1, 6) is a complete binary tree in heap order whose l leaves (a power of two) hold `LEAF_SIZE`
    consecutive rows of ``primitives`` (l * LEAF_SIZE, 9) each. Writes the distance (infinity where nothing is nearer
    than ``max_t``) and the row of the primitive (-1).
    """
    stack = np.empty(_MAX_DEPTH, dtype=np.int32)
    inverse = np.empty(3)
    first_leaf = len(boxes) // 2
    for ray in range(start, stop):
        o, d = origins[ray], directions[ray]
        for axis in range(3):
            component = d[axis] if abs(d[axis]) > 1e-12 else 1e-12
            inverse[axis] = 1.0 / component
        best, slot = max_t[ray], -1
        n_stacked = 1
        stack[0] = 0
        while n_stacked > 0:
            n_stacked -= 1
            node = stack[n_stacked]
            if _enter_box(o, inverse, boxes[node], best) == np.inf:
                continue
            if node >= first_leaf:
                first = (node - first_leaf) * LEAF_SIZE
                for row in range(first, first + LEAF_SIZE):
                    p = primitives[row]
                    t = hit_disc(o, d, p) if is_disc[row] else hit_triangle(o, d, p)
                    if t < best:
                        best, slot = t, row
                continue
            left, right = 2 * node + 1, 2 * node + 2
            t_left = _enter_box(o, inverse, boxes[left], best)
            t_right = _enter_box(o, inverse, boxes[right], best)
            if t_left > t_right:
                left, right, t_left, t_right = right, left, t_right, t_left
            if t_right < np.inf:
                stack[n_stacked] = right
                n_stacked += 1
            if t_left < np.inf:
                stack[n_stacked] = left
                n_stacked += 1
        out_t[ray] = best if slot >= 0 else np.inf
        out_slot[ray] = slot
