"""Pictures of points for the report: a depth buffer, soft shading, and a PNG of 256 colours."""

from __future__ import annotations

import base64
import math
import struct
import zlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from loda_pdal.io.colours import rgb
from loda_pdal.kernels.splat import NOTHING, shade, splat
from loda_pdal.model.cloud import ByteArray, Float32Array, FloatArray, Int64Array

IndexArray = npt.NDArray[np.intp]

RAMP = 32
"""Shades per ramp of a picture's palette."""

PAPER = (250, 250, 248)
_CONTEXT_RAMP = ((52, 58, 66), (226, 228, 230))


@dataclass(frozen=True)
class View:
    """A window onto points: ``width_m`` by ``height_m`` from the lower left corner (u0, v0), m, at a pixel size."""

    u0: float
    v0: float
    width_m: float
    height_m: float
    pixel_m: float

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the picture."""
        return max(1, math.ceil(self.height_m / self.pixel_m)), max(1, math.ceil(self.width_m / self.pixel_m))


def palette(colour: str) -> ByteArray:
    """Palette (1 + 2 RAMP, 3): paper, the grey ramp of the surroundings, the ramp of ``colour`` (#rrggbb)."""
    steps = np.linspace(0.0, 1.0, RAMP)[:, None]
    dark, light = (np.array(c, dtype=float) for c in _CONTEXT_RAMP)
    pure = np.array(rgb(colour), dtype=float)
    low, high = pure * 0.35, pure + (255 - pure) * 0.30
    ramps = np.vstack([dark + (light - dark) * steps, low + (high - low) * steps])
    return np.vstack([np.array([PAPER]), np.round(ramps)]).astype(np.uint8)


def draw_points(
    picture: ByteArray,
    view: View,
    points: tuple[FloatArray, FloatArray, FloatArray],
    tone: FloatArray,
    point_m: float,
    ramp: int,
) -> None:
    """Draw points over a picture, those nearest to the viewer on top, shaded so that edges in depth stand out.

    Parameters
    ----------
    picture : (rows, columns) uint8
        Palette indices; changed where there is a point. A picture of zeros is blank.
    view : View
        What is drawn.
    points : u, v, depth, each (n,) float64, m
        Place of each point in the plane of the picture, and how near it is to the viewer.
    tone : (n,) float64
        Brightness of each point before shading, 0 to 1.
    point_m : float
        Diameter of the dot drawn for a point, m.
    ramp : int
        0 for the grey ramp of the palette, 1 for the coloured one.
    """
    nearest, colour = depth_buffer(view, points, tone, point_m)
    shade(nearest, colour, 1 + ramp * RAMP, RAMP, picture)


def depth_buffer(
    view: View, points: tuple[FloatArray, FloatArray, FloatArray], value: FloatArray, point_m: float
) -> tuple[Float32Array, Float32Array]:
    """Depth of the nearest point in each pixel (`NOTHING` where none is) and its ``value`` (n,), both (rows, columns)
    float32; the rest as for `draw_points`."""
    nearest, found = np.full(view.shape, NOTHING), np.zeros(view.shape, dtype=np.float32)
    dot = _dot(min(24, max(1, math.ceil(point_m / view.pixel_m))))
    corner = float(view.u0), float(view.v0)
    splat(*map(np.ascontiguousarray, (*points, value)), *corner, float(view.pixel_m), dot, nearest, found)
    return nearest, found


def _dot(size: int) -> Int64Array:
    """Rows (d, 3) of a dot of ``size`` pixels across: row, first and last column about the pixel of its point."""
    offset = np.arange(size) - (size - 1) / 2
    is_inside = np.hypot(offset[:, None], offset) <= size / 2
    first, last = np.argmax(is_inside, axis=1), size - 1 - np.argmax(is_inside[:, ::-1], axis=1)
    return np.column_stack([np.arange(size), first, last]) - size // 2


def png_data_uri(picture: ByteArray, colours: ByteArray) -> str:
    """A picture of palette indices (rows, columns) with its palette (k, 3) as a ``data:`` address."""
    return "data:image/png;base64," + base64.b64encode(png(picture, colours)).decode("ascii")


def png(picture: ByteArray, colours: ByteArray) -> bytes:
    """PNG file of palette indices (rows, columns) uint8 with a palette (k, 3) uint8."""
    rows, columns = picture.shape
    lines = np.zeros((rows, columns + 1), dtype=np.uint8)
    lines[:, 1:] = picture
    header = struct.pack(">IIBBBBB", columns, rows, 8, 3, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"PLTE", colours.tobytes()), (b"IDAT", zlib.compress(lines.data, 4)))
    body = b"".join(_chunk(kind, data) for kind, data in (*chunks, (b"IEND", b"")))
    return b"\x89PNG\r\n\x1a\n" + body


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


class PlanIndex:
    """Finds the points of a cloud inside upright rectangles without looking at all of them.

    Parameters
    ----------
    xyz : (n, 3) float64, m
        The points.
    cell_m : float
        Edge of the cells they are sorted into.
    """

    def __init__(self, xyz: FloatArray, cell_m: float = 8.0) -> None:
        self.cell_m = cell_m
        cells = np.floor(xyz[:, :2] / cell_m).astype(np.int64)
        self.low: Int64Array = cells.min(axis=0) if len(cells) else np.zeros(2, dtype=np.int64)
        self.n_cells: Int64Array = cells.max(axis=0) - self.low + 1 if len(cells) else np.zeros(2, dtype=np.int64)
        keys = (cells[:, 0] - self.low[0]) * self.n_cells[1] + cells[:, 1] - self.low[1]
        self.order: IndexArray = np.argsort(keys, kind="stable")
        self.keys: Int64Array = keys[self.order]

    def near(self, x0: float, y0: float, x1: float, y1: float) -> IndexArray:
        """Indices of the points in all cells that the rectangle touches, ascending."""
        first = np.maximum(np.floor(np.array([x0, y0]) / self.cell_m).astype(np.int64) - self.low, 0)
        last = np.minimum(np.floor(np.array([x1, y1]) / self.cell_m).astype(np.int64) - self.low, self.n_cells - 1)
        if np.any(last < first):
            return np.empty(0, dtype=np.intp)
        columns = np.arange(first[0], last[0] + 1) * self.n_cells[1]
        starts = np.searchsorted(self.keys, columns + first[1], side="left")
        ends = np.searchsorted(self.keys, columns + last[1], side="right")
        found = [self.order[a:b] for a, b in zip(starts, ends, strict=True)]
        return np.sort(np.concatenate(found))
