"""Eigenvalue features from their definition, one point at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


def shape_features(xyz: Array, radius: float, min_neighbours: int) -> tuple[Array, Array]:
    """Linearity, planarity, sphericity and |n.z| (m, 4) and whether there are neighbours enough (m,)."""
    values = np.tile([1 / 3, 1 / 3, 1 / 3, 0.5], (len(xyz), 1))
    is_valid = np.zeros(len(xyz), dtype=bool)
    for i, point in enumerate(xyz):
        near = xyz[np.linalg.norm(xyz - point, axis=1) <= radius]
        if len(near) < min_neighbours:
            continue
        (small, middle, large), vectors = np.linalg.eigh(np.cov(near.T, bias=True))
        values[i] = (large - middle) / large, (middle - small) / large, small / large, abs(vectors[2, 0])
        is_valid[i] = True
    return values, is_valid
