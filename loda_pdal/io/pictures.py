"""Pictures of points for the report: a depth buffer, soft shading, and a PNG of 256 colours; NumPy only."""

from __future__ import annotations

import base64
import math
import struct
import zlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from loda_pdal.io.colours import rgb
from loda_pdal.model.cloud import BoolArray, ByteArray, Float32Array, FloatArray, Int64Array

RAMP = 32
"""Shades per ramp of a picture's palette."""

PAPER = (250, 250, 248)
_NOTHING = np.float32(-1e6)
"""Depth where no point is drawn, m."""
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
    view: View, u: FloatArray, v: FloatArray, depth: FloatArray, tone: FloatArray, point_m: float
) -> tuple[FloatArray, BoolArray]:
    """Brightness of the nearest points in a view, shaded so that edges in depth stand out.

    Parameters
    ----------
    view : View
        What is drawn.
    u, v : (n,) float64, m
        Position of each point in the plane of the picture.
    depth : (n,) float64, m
        How near each point is to the viewer; the largest is seen.
    tone : (n,) float64
        Brightness of each point before shading, 0 to 1.
    point_m : float
        Diameter of the dot drawn for a point, m.

    Returns
    -------
    brightness : (rows, columns) float64
        0 to 1.
    is_drawn : (rows, columns) bool
        Where there is a point at all.
    """
    size = min(24, max(1, math.ceil(point_m / view.pixel_m)))
    rows, columns = view.shape
    stride = columns + 2 * size  # a margin around the picture, where dots may end without being looked after
    column = np.floor((u - view.u0) / view.pixel_m) + size
    row = rows - 1 - np.floor((v - view.v0) / view.pixel_m) + size
    reach = size // 2 + 1
    is_near = (row >= reach) & (row < rows + 2 * size - reach) & (column >= reach) & (column < stride - reach)
    order = np.flatnonzero(is_near)[np.argsort(depth[is_near], kind="stable")]
    base = row[order].astype(np.int64) * stride + column[order].astype(np.int64)
    depth, tone = depth[order].astype(np.float32), tone[order].astype(np.float32)
    nearest = np.full((rows + 2 * size) * stride, _NOTHING)
    colour = np.zeros(len(nearest), dtype=np.float32)
    for i, j in _disc(size):
        pixel = base + ((i - size // 2) * stride + j - size // 2)
        is_nearer = depth >= nearest[pixel]
        pixel = pixel[is_nearer]
        nearest[pixel] = depth[is_nearer]  # sorted by depth: of equal pixels the nearest comes last
        colour[pixel] = tone[is_nearer]
    inside = np.s_[size : size + rows, size : size + columns]
    nearest, colour = (values.reshape(-1, stride)[inside] for values in (nearest, colour))
    return (colour * _eye_dome(nearest)).astype(np.float64), nearest > _NOTHING


def _disc(size: int) -> list[tuple[int, int]]:
    """Pixels (row, column) of a dot of ``size`` pixels across."""
    middle, radius = (size - 1) / 2, size / 2
    return [(i, j) for i, j in np.ndindex(size, size) if math.hypot(i - middle, j - middle) <= radius]


def _eye_dome(nearest: Float32Array) -> Float32Array:
    """Shade (rows, columns) 0 to 1: darker where neighbours stand nearer to the viewer (eye-dome lighting)."""
    rows, columns = nearest.shape
    hidden = np.zeros_like(nearest)
    for reach in (1, 3):
        padded = np.pad(nearest, reach, constant_values=_NOTHING)
        for di, dj in ((0, 1), (1, 0), (1, 2), (2, 1), (0, 0)):  # upper left twice: light comes from there
            i, j = di * reach, dj * reach
            hidden += np.clip(padded[i : i + rows, j : j + columns] - nearest, 0.0, 1.5)
    return np.asarray(np.exp(-0.16 * hidden))


def compose(shape: tuple[int, int], *layers: tuple[FloatArray, BoolArray, int]) -> ByteArray:
    """Palette indices (rows, columns): each layer (brightness, is_drawn, ramp 0 or 1) over the one before."""
    picture: ByteArray = np.zeros(shape, dtype=np.uint8)
    for brightness, is_drawn, ramp in layers:
        shade = 1 + ramp * RAMP + np.clip(brightness * (RAMP - 1), 0, RAMP - 1).astype(np.uint8)
        picture[is_drawn] = shade[is_drawn]
    return picture


def png_data_uri(picture: ByteArray, colours: ByteArray) -> str:
    """A picture of palette indices (rows, columns) with its palette (k, 3) as a ``data:`` address."""
    return "data:image/png;base64," + base64.b64encode(png(picture, colours)).decode("ascii")


def png(picture: ByteArray, colours: ByteArray) -> bytes:
    """PNG file of palette indices (rows, columns) uint8 with a palette (k, 3) uint8."""
    rows, columns = picture.shape
    lines = np.zeros((rows, columns + 1), dtype=np.uint8)
    lines[:, 1:] = picture
    header = struct.pack(">IIBBBBB", columns, rows, 8, 3, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"PLTE", colours.tobytes()), (b"IDAT", zlib.compress(lines.tobytes(), 6)))
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
        self.order: npt.NDArray[np.intp] = np.argsort(keys, kind="stable")
        self.keys: Int64Array = keys[self.order]

    def near(self, x0: float, y0: float, x1: float, y1: float) -> npt.NDArray[np.intp]:
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
