"""Smallest rectangles by trying angles, and shared volumes by half-spaces."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection

Array = npt.NDArray[Any]
Box = tuple[Array, Array, Array]


def least_rectangle_area(xy: Array, n_angles: int = 3600) -> float:
    """Area of the smallest of the rectangles around (n, 2) points at evenly spaced angles: never below the true one."""
    angles = np.linspace(0, np.pi / 2, n_angles, endpoint=False)
    along = xy @ np.stack([np.cos(angles), np.sin(angles)])
    across = xy @ np.stack([-np.sin(angles), np.cos(angles)])
    return (np.ptp(along, axis=0) * np.ptp(across, axis=0)).min()


def shared_volume(one: Box, two: Box) -> float:
    """Volume that two boxes (centre, axes in rows, size) share, m3."""
    half_spaces = np.array(
        [
            [*(sign * axis), -(sign * axis @ centre + length / 2)]
            for centre, axes, size in (one, two)
            for axis, length in zip(axes, size, strict=True)
            for sign in (-1, 1)
        ]
    )
    inner = linprog(
        [0, 0, 0, -1],
        A_ub=np.column_stack([half_spaces[:, :3], np.ones(len(half_spaces))]),
        b_ub=-half_spaces[:, 3],
        bounds=[(None, None)] * 3 + [(0, None)],
    )
    if inner.status != 0 or inner.x[3] < 1e-9:
        return 0.0
    return ConvexHull(HalfspaceIntersection(half_spaces, inner.x[:3]).intersections).volume
