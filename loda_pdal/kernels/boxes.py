"""Loops over boxes: smallest rectangles around points in plan, and the volume that two boxes share."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from loda_pdal.kernels.compiled import inner, kernel

Array = npt.NDArray[Any]

_TOLERANCE_M = 1e-9
"""Faces of two boxes closer than this lie in one plane."""
_MOST_CORNERS = 16
"""A rectangle cut by six half-spaces has at most ten corners."""


@kernel
def drop_inner_points(first: int, last: int, xy: Array, order: Array, starts: Array, label: Array) -> None:
    """Set the label of plan points to -1 that are surely no corners of the convex hull of their group.

    Parameters
    ----------
    xy : (m, 2) float64, m
        Points; those of group g are ``order[starts[g]:starts[g + 1]]``.
    label : (m,) int32
        Changed for the points strictly inside the octagon of those farthest to the east, north-east, north, ... of
        their group (Akl and Toussaint 1978): of compact groups few are left.
    """
    east, north = (1.0, 1.0, 0.0, -1.0, -1.0, -1.0, 0.0, 1.0), (0.0, 1.0, 1.0, 1.0, 0.0, -1.0, -1.0, -1.0)
    reach, corner, side = np.empty(8), np.empty((8, 2)), np.empty((8, 2))
    for group in range(first, last):
        for k in range(8):
            reach[k] = -np.inf
        for t in range(starts[group], starts[group + 1]):
            x, y = xy[order[t], 0], xy[order[t], 1]
            for k in range(8):
                along = east[k] * x + north[k] * y
                if along > reach[k]:
                    reach[k], corner[k, 0], corner[k, 1] = along, x, y
        hair = 1e-12 * max(reach[0] + reach[4], reach[2] + reach[6]) ** 2
        for k in range(8):
            side[k, 0], side[k, 1] = corner[(k + 1) % 8, 0] - corner[k, 0], corner[(k + 1) % 8, 1] - corner[k, 1]
        for t in range(starts[group], starts[group + 1]):
            x, y = xy[order[t], 0], xy[order[t], 1]
            is_inner = hair > 0.0
            for k in range(8):
                turn = side[k, 0] * (y - corner[k, 1]) - side[k, 1] * (x - corner[k, 0])
                if turn <= hair and (side[k, 0] != 0.0 or side[k, 1] != 0.0):
                    is_inner = False
                    break
            if is_inner:
                label[order[t]] = -1


@kernel
def smallest_rectangles(
    first: int, last: int, xy: Array, order: Array, starts: Array, centre: Array, along: Array, size: Array
) -> None:
    """Smallest rectangle around the plan points of groups ``first`` to ``last``, exact.

    Parameters
    ----------
    xy : (m, 2) float64, m
        Points; those of group g are ``order[starts[g]:starts[g + 1]]``, sorted by x, then y.
    centre, along, size : (n, 2) float64
        Filled: centre (m), unit direction of the long side (x not negative), and both sides (m), long before short.
        Empty groups are left alone.
    """
    for group in range(first, last):
        n = starts[group + 1] - starts[group]
        if n == 0:
            continue
        points = np.empty((n, 2))
        for t in range(n):
            points[t, 0] = xy[order[starts[group] + t], 0]
            points[t, 1] = xy[order[starts[group] + t], 1]
        hull = _hull(points)
        least_area, least_length = np.inf, np.inf
        for a in range(len(hull)):
            b = a + 1 if a + 1 < len(hull) else 0
            ux, uy = hull[b, 0] - hull[a, 0], hull[b, 1] - hull[a, 1]
            norm = np.sqrt(ux * ux + uy * uy)
            ux, uy = (ux / norm, uy / norm) if norm > 0.0 else (1.0, 0.0)
            low_u, high_u, low_v, high_v = np.inf, -np.inf, np.inf, -np.inf
            for t in range(len(hull)):
                u = hull[t, 0] * ux + hull[t, 1] * uy
                v = hull[t, 1] * ux - hull[t, 0] * uy
                low_u, high_u = min(low_u, u), max(high_u, u)
                low_v, high_v = min(low_v, v), max(high_v, v)
            length, width = high_u - low_u, high_v - low_v
            is_smaller = length * width < least_area
            if is_smaller or (length * width == least_area and length + width < least_length):
                least_area, least_length = length * width, length + width
                middle_u, middle_v = 0.5 * (low_u + high_u), 0.5 * (low_v + high_v)
                centre[group, 0] = middle_u * ux - middle_v * uy
                centre[group, 1] = middle_u * uy + middle_v * ux
                if length < width:
                    ux, uy = -uy, ux
                    length, width = width, length
                if ux < 0.0 or (ux == 0.0 and uy < 0.0):
                    ux, uy = -ux, -uy
                along[group, 0], along[group, 1] = ux, uy
                size[group, 0], size[group, 1] = length, width


@inner
def _hull(points: Array) -> Array:
    """Corners of the convex hull of sorted (n, 2) points, counterclockwise from the lowest x (monotone chain)."""
    n = len(points)
    hull = np.empty((2 * n + 1, 2))
    k = none = np.int64(0)
    for t in range(n):
        k = _push_corner(hull, k, none, points[t])
    lower = k - 1
    for t in range(n - 2, -1, -1):
        k = _push_corner(hull, k, lower, points[t])
    return hull[: max(k - 1, 1)]


@inner
def _push_corner(hull: Array, k: int, fixed: int, point: Array) -> int:
    """Append a point to the chain of ``k`` corners, after those that no longer turn left; the new count."""
    while k - fixed >= 2:
        ax, ay = hull[k - 1, 0] - hull[k - 2, 0], hull[k - 1, 1] - hull[k - 2, 1]
        bx, by = point[0] - hull[k - 2, 0], point[1] - hull[k - 2, 1]
        if ax * by - ay * bx > 0.0:
            break
        k -= 1
    hull[k, 0], hull[k, 1] = point[0], point[1]
    return k + 1


@kernel
def shared_volumes(
    first: int,
    last: int,
    a: Array,
    b: Array,
    centre_a: Array,
    axes_a: Array,
    size_a: Array,
    centre_b: Array,
    axes_b: Array,
    size_b: Array,
    volume: Array,
) -> None:
    """Fill ``volume`` (p,) m3 with what box ``a[p]`` of one set shares with box ``b[p]`` of another, exact.

    The boundary of the shared body is made of the faces of each box as far as they lie in the other; by the
    divergence theorem its volume is a third of the sum of area times distance of the plane. The mean of both orders
    makes the number the same when the sets change places.
    """
    for p in range(first, last):
        i, j = a[p], b[p]
        one = _shared(centre_a[i], axes_a[i], size_a[i], centre_b[j], axes_b[j], size_b[j])
        two = _shared(centre_b[j], axes_b[j], size_b[j], centre_a[i], axes_a[i], size_a[i])
        volume[p] = max(0.5 * (one + two), 0.0)


@inner
def _shared(centre_a: Array, axes_a: Array, size_a: Array, centre_b: Array, axes_b: Array, size_b: Array) -> float:
    """Volume that boxes a and b share; a face that both have counts for a only."""
    here, offset = np.empty(3), np.empty(3)
    sq_reach = sq_a = sq_b = 0.0
    for d in range(3):
        here[d], offset[d] = 0.0, centre_b[d] - centre_a[d]
        sq_reach += offset[d] * offset[d]
        sq_a += size_a[d] * size_a[d]
        sq_b += size_b[d] * size_b[d]
    reach = 0.5 * (np.sqrt(sq_a) + np.sqrt(sq_b))
    if sq_reach > reach * reach:
        return 0.0
    volume = _faces_inside(here, axes_a, size_a, offset, axes_b, size_b, _TOLERANCE_M)
    volume += _faces_inside(offset, axes_b, size_b, here, axes_a, size_a, -_TOLERANCE_M)
    return float(volume) / 3.0


@inner
def _faces_inside(
    centre: Array, axes: Array, size: Array, other_centre: Array, other_axes: Array, other_size: Array, slack: float
) -> float:
    """Sum over a box's faces of (area inside the other box) times the plane's signed distance.

    ``slack`` widens the other box towards the side that a face looks to: of two faces in one plane that look the same
    way only the one with positive slack is inside. Faces that look at each other are both inside, and cancel.
    """
    total = 0.0
    polygon, scratch = np.empty((_MOST_CORNERS, 3)), np.empty((_MOST_CORNERS, 3))
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (-0.5, 0.5):
            n = np.int64(4)
            for corner in range(4):
                along_u = 0.5 if corner == 1 or corner == 2 else -0.5
                along_v = 0.5 if corner >= 2 else -0.5
                for d in range(3):
                    polygon[corner, d] = (
                        centre[d]
                        + side * size[axis] * axes[axis, d]
                        + along_u * size[u] * axes[u, d]
                        + along_v * size[v] * axes[v, d]
                    )
            for other in range(3):
                for sign in (-1.0, 1.0):
                    cosine = 0.0
                    for d in range(3):
                        cosine += side * sign * axes[axis, d] * other_axes[other, d]
                    limit = 0.5 * other_size[other] + (slack if cosine > 0.0 else _TOLERANCE_M)
                    n = _clip(polygon, n, sign, other_axes[other], other_centre, limit, scratch)
            area = _area_along(polygon, n, axes[axis])
            distance = 0.0
            for d in range(3):
                distance += (centre[d] + side * size[axis] * axes[axis, d]) * axes[axis, d]
            total += area * distance * (1.0 if side > 0.0 else -1.0)
    return total


@inner
def _clip(polygon: Array, n: int, sign: float, axis: Array, centre: Array, limit: float, scratch: Array) -> int:
    """Cut a polygon in place to ``sign * axis . (p - centre) <= limit``; the new number of corners."""
    k = 0
    for t in range(n):
        s = t + 1 if t + 1 < n else 0
        here, there = -limit, -limit
        for d in range(3):
            here += sign * axis[d] * (polygon[t, d] - centre[d])
            there += sign * axis[d] * (polygon[s, d] - centre[d])
        if here <= 0.0:
            for d in range(3):
                scratch[k, d] = polygon[t, d]
            k += 1
        if (here <= 0.0) != (there <= 0.0):
            part = here / (here - there)
            for d in range(3):
                scratch[k, d] = polygon[t, d] + part * (polygon[s, d] - polygon[t, d])
            k += 1
    for t in range(k):
        for d in range(3):
            polygon[t, d] = scratch[t, d]
    return k


@inner
def _area_along(polygon: Array, n: int, normal: Array) -> float:
    """Area of a plane convex polygon with a unit normal, whichever way round its corners go."""
    total = 0.0
    for t in range(1, n - 1):
        ax, ay, az = polygon[t, 0] - polygon[0, 0], polygon[t, 1] - polygon[0, 1], polygon[t, 2] - polygon[0, 2]
        s = t + 1
        bx, by, bz = polygon[s, 0] - polygon[0, 0], polygon[s, 1] - polygon[0, 1], polygon[s, 2] - polygon[0, 2]
        total += (ay * bz - az * by) * normal[0] + (az * bx - ax * bz) * normal[1] + (ax * by - ay * bx) * normal[2]
    return abs(0.5 * total)
