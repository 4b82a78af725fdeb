"""Points as shaded dots on a picture: a depth buffer, and shade where something nearer stands beside a pixel."""

from __future__ import annotations

import numpy as np

from loda_pdal.kernels.compiled import inner, kernel

NOTHING = np.float32(-1e6)
"""Depth where no point is drawn, m."""

_LEVEL, _STEEPEST = np.float32(0.0), np.float32(1.5)
_DARKNESS = np.float32(-0.16)


@kernel
def splat(u, v, depth, tone, u0, v0, pixel_m, dot, nearest, colour):  # type: ignore[no-untyped-def]
    """Draw points as dots where they are nearest; of equally near ones the brightest is seen, so order is no matter.

    Parameters
    ----------
    u, v : (n,) float64, m
        Place in the plane of the picture.
    depth : (n,) float64, m
        How near; the largest is seen.
    tone : (n,) float64
        Brightness.
    u0, v0, pixel_m : float, m
        Lower left corner of the picture, and edge of a pixel.
    dot : (d, 3) int64
        Rows of a dot: row, first and last column of its pixels, all about the pixel of the point.
    nearest, colour : (rows, columns) float32
        Depth and tone of what is seen so far; updated.
    """
    rows, columns = nearest.shape
    for p in range(len(u)):
        column = np.floor((u[p] - u0) / pixel_m)
        row = rows - 1 - np.floor((v[p] - v0) / pixel_m)
        if not (-len(dot) <= row < rows + len(dot) and -len(dot) <= column < columns + len(dot)):
            continue
        near, light = np.float32(depth[p]), np.float32(tone[p])
        for k in range(len(dot)):
            i = int(row) + dot[k, 0]
            if 0 <= i < rows:
                for j in range(max(int(column) + dot[k, 1], 0), min(int(column) + dot[k, 2] + 1, columns)):
                    if near > nearest[i, j] or (near == nearest[i, j] and light > colour[i, j]):
                        nearest[i, j], colour[i, j] = near, light


@kernel
def shade(nearest, colour, first, n_shades, picture):  # type: ignore[no-untyped-def]
    """Paint what was drawn over a picture, darker where neighbours stand nearer to the viewer (eye-dome lighting).

    Parameters
    ----------
    nearest, colour : (rows, columns) float32
        As `splat` leaves them, ``nearest`` `NOTHING` where no point is.
    first, n_shades : int
        Palette index of the darkest shade, and how many shades there are.
    picture : (rows, columns) uint8
        Palette indices; overwritten where a point is drawn.
    """
    rows, columns = nearest.shape
    hidden = np.empty(columns, dtype=np.float32)
    for i in range(rows):
        hidden[:] = 0.0
        for reach in (1, 3):
            for di, dj in ((-1, 0), (0, -1), (0, 1), (1, 0), (-1, -1)):  # upper left twice: light comes from there
                a, b = i + di * reach, dj * reach
                if 0 <= a < rows:
                    first_column, end = max(-b, 0), max(min(columns - b, columns), 0)
                    _add_steps(
                        nearest[i, first_column:end], nearest[a, first_column + b : end + b], hidden[first_column:]
                    )
        for j in range(columns):
            if nearest[i, j] != NOTHING:
                brightness = colour[i, j]
                if hidden[j] > 0:
                    brightness *= np.exp(_DARKNESS * hidden[j])
                step = np.float64(brightness) * (n_shades - 1)
                picture[i, j] = first + int(min(max(step, 0.0), n_shades - 1.0))


@inner
def _add_steps(here, beside, hidden):  # type: ignore[no-untyped-def]
    """Add to ``hidden`` how much nearer each pixel of one row is than that of another, 0 to `_STEEPEST`."""
    for j in range(len(here)):
        step = beside[j] - here[j]
        step = step if step > _LEVEL else _LEVEL
        hidden[j] += step if step < _STEEPEST else _STEEPEST
