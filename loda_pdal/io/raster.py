"""lod95.tif: the limit of detection in plan, as a Cloud-Optimised GeoTIFF."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from loda_pdal.model.cloud import Float32Array, FloatArray
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.transform import invert, transform_points

if TYPE_CHECKING:
    from rasterio.transform import Affine

BANDS = (
    ("LoD95, plan maximum over valid cells", "m"),
    ("Share of occupied cells above this pixel that are valid", "1"),
)
_BLOCK = 512


def write_lod_raster(path: Path, lod: LodGrid, T_after_frame: FloatArray, frame: LocalFrame) -> None:
    """Write the grid in map coordinates of the after epoch, one pixel per cell in plan.

    Parameters
    ----------
    path : Path
        The GeoTIFF.
    lod : LodGrid
        In the analysis frame.
    T_after_frame : (4, 4) float64
        Moves points of the analysis frame into the after frame, local metres.
    frame : LocalFrame
        From local metres to map coordinates, and the CRS.
    """
    from rasterio.crs import CRS
    from rasterio.io import MemoryFile

    bands, corner = plan_raster(lod, T_after_frame)
    count, height, width = bands.shape
    with MemoryFile() as memory:  # on a full disk GDAL's own writing can crash; a file of bytes fails cleanly
        with memory.open(
            driver="COG",
            width=width,
            height=height,
            count=count,
            dtype="float32",
            crs=None if frame.crs_wkt is None else CRS.from_wkt(frame.crs_wkt),
            transform=_placement(corner, lod.cell_m, frame),
            nodata=float("nan"),
            compress="DEFLATE",
            predictor="YES",
            blocksize=_BLOCK,
        ) as raster:
            raster.write(bands)
            for number, (description, _) in enumerate(BANDS, start=1):
                raster.set_band_description(number, description)
            raster.units = tuple(unit for _, unit in BANDS)
        path.write_bytes(memory.read())


def plan_raster(lod: LodGrid, T_after_frame: FloatArray) -> tuple[Float32Array, tuple[float, float]]:
    """Bands (2, rows, columns), north up, and the local (x, y) of the upper left corner, m.

    Every pixel takes the column of cells that holds its centre: no holes where the analysis frame is turned against
    the after frame. NaN where there is no cell; the first band also where no cell is valid.
    """
    if len(lod.cells) == 0:
        return np.full((2, 1, 1), np.nan, dtype=np.float32), (0.0, lod.cell_m)
    columns, low = _columns(lod)
    centres = lod.centres_after(T_after_frame)
    first = np.floor(centres[:, :2].min(axis=0) / lod.cell_m).astype(np.int64)
    width, height = (int(n) for n in np.floor(centres[:, :2].max(axis=0) / lod.cell_m).astype(np.int64) - first + 1)
    z = float(np.median(centres[:, 2]))
    bands = np.full((2, height, width), np.nan, dtype=np.float32)
    x = (first[0] + np.arange(width) + 0.5) * lod.cell_m
    for row in range(height):
        y = (first[1] + height - row - 0.5) * lod.cell_m
        in_frame = transform_points(invert(T_after_frame), np.column_stack([x, np.full(width, y), np.full(width, z)]))
        i, j = (np.floor(in_frame[:, axis] / lod.cell_m).astype(np.int64) - low[axis] for axis in (0, 1))
        is_inside = (i >= 0) & (j >= 0) & (i < columns.shape[1]) & (j < columns.shape[2])
        bands[:, row, is_inside] = columns[:, i[is_inside], j[is_inside]]
    upper_left = (float(first[0] * lod.cell_m), float((first[1] + height) * lod.cell_m))
    return bands, upper_left


def _columns(lod: LodGrid) -> tuple[Float32Array, FloatArray]:
    """Per column of cells, (2, nx, ny): largest valid LoD95 and valid share; and the lowest (ix, iy)."""
    low = lod.cells[:, :2].min(axis=0).astype(np.int64)
    nx, ny = (int(n) for n in lod.cells[:, :2].max(axis=0) - low + 1)
    flat = (lod.cells[:, 0] - low[0]) * ny + lod.cells[:, 1] - low[1]
    n_cells = np.bincount(flat, minlength=nx * ny)
    n_valid = np.bincount(flat[lod.is_valid], minlength=nx * ny)
    largest = np.full(nx * ny, -np.inf, dtype=np.float32)
    np.maximum.at(largest, flat[lod.is_valid], lod.lod95[lod.is_valid])
    share = np.where(n_cells > 0, n_valid / np.maximum(n_cells, 1), np.nan)
    bands = np.stack([np.where(n_valid > 0, largest, np.nan), share]).astype(np.float32)
    return bands.reshape(2, nx, ny), low


def _placement(corner: tuple[float, float], cell_m: float, frame: LocalFrame) -> Affine:
    from rasterio.transform import Affine

    west, north, _ = frame.to_map(np.array([[*corner, 0.0]]))[0]
    pixel = cell_m / frame.unit_xy_m
    return Affine(pixel, 0.0, west, 0.0, -pixel, north)
