"""Loops over the cells of a raster."""

from __future__ import annotations

from typing import Any

import numpy.typing as npt

from loda_pdal.kernels.compiled import kernel

Array = npt.NDArray[Any]


@kernel
def highest_range(first: int, last: int, surface: Array, reach: int, highest: Array) -> None:
    """Find the highest cell around each cell of rows ``first`` to ``last``.

    Parameters
    ----------
    surface : (nx, ny) float64
    reach : int
        Cells up to so many rows and columns away are looked at.
    highest : (nx, ny) int64
        Filled with flat indices: of the cell itself if none is higher, else of the first of the highest.
    """
    n_x, n_y = surface.shape
    for i in range(first, last):
        for j in range(n_y):
            best = surface[i, j]
            highest[i, j] = i * n_y + j
            for a in range(max(i - reach, 0), min(i + reach + 1, n_x)):
                for b in range(max(j - reach, 0), min(j + reach + 1, n_y)):
                    if surface[a, b] > best:
                        best = surface[a, b]
                        highest[i, j] = a * n_y + b
