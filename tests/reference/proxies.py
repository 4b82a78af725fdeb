"""Closing and connected components on a dense grid."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

Array = npt.NDArray[Any]


def voxel_components(cells: Array, closing_voxels: int, min_voxels: int) -> Array:
    """Piece of each cell (m,), numbered from 0 by its lowest cell; -1 where the piece is too small."""
    margin = closing_voxels + 1
    low = cells.min(axis=0) - margin
    grid = np.zeros(cells.max(axis=0) - low + margin + 1, dtype=bool)
    grid[tuple((cells - low).T)] = True
    cube = np.ones((3, 3, 3), dtype=bool)
    if closing_voxels:
        grid = ndimage.binary_closing(grid, cube, iterations=closing_voxels)
    pieces, n = ndimage.label(grid, cube)
    number = np.full(n + 1, -1)
    kept = 0
    for piece in sorted(range(1, n + 1), key=lambda piece: np.argmax(pieces == piece)):
        if np.count_nonzero(pieces == piece) >= min_voxels:
            number[piece] = kept
            kept += 1
    return number[pieces[tuple((cells - low).T)]]
