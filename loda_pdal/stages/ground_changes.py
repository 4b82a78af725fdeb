"""Changed ground on a raster of tiles (paper, section 4.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from scipy import ndimage

from loda_pdal.kernels.lod_pooling import MAD_TO_STD
from loda_pdal.model.cloud import BoolArray, ByteArray, FloatArray, Int64Array, IntArray
from loda_pdal.model.grid import Lattice, cells_of
from loda_pdal.model.groups import Groups, consecutive, unique_rows
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.pair import Pair
from loda_pdal.params import GroundChangeParams
from loda_pdal.stages.lod import SMALL_SAMPLE

SPOTS_PER_TILE = 4
"""A tile is compared on so many spots along each edge, so that only ground seen by both epochs in one place counts."""

MIN_SPOTS = 3
"""Fewer spots seen by both epochs leave a tile undetermined."""

MIN_TILES = 2
"""One tile alone is no region, however large tiles are: of thousands, a few exceed their limit by chance."""


@dataclass(frozen=True)
class GroundRegion:
    """One connected piece of ground that rose or fell.

    Attributes
    ----------
    label : ChangeLabel
        INCREASED or DECREASED; ground is never Added or Removed (paper).
    dz_m, lod95_m : float, m
        Medians over the tiles.
    area_m2, volume_m3 : float
        Area of the tiles; sum of their area times elevation change, negative where the ground fell.
    footprint : shapely MultiPolygon
        Union of the tiles, in the frame of the points.
    """

    label: ChangeLabel
    dz_m: float
    lod95_m: float
    area_m2: float
    volume_m3: float
    footprint: Any


@dataclass(frozen=True)
class GroundChanges:
    """Elevation change per tile.

    Attributes
    ----------
    cell_m : float
        Edge of a tile, m; tile (i, j) covers ``(i, j) * cell_m`` onwards.
    tiles : (t, 2) int64
        Tiles where either epoch has ground, lexicographically sorted.
    dz, lod95 : (t,) float64, m
        Median elevation change, after minus before, and median LoD95; NaN where the tile is undetermined.
    label : (t,) uint8
        `ChangeLabel` codes: UNDETERMINED where only one epoch saw the tile, else UNCHANGED, INCREASED or DECREASED.
    region : (t,) int32
        Index into ``regions``, -1 outside.
    regions : list of GroundRegion
        By their first tile.
    """

    cell_m: float
    tiles: Int64Array
    dz: FloatArray
    lod95: FloatArray
    label: ByteArray
    region: IntArray
    regions: list[GroundRegion]

    def label_at(self, xy: FloatArray) -> ByteArray:
        """`ChangeLabel` codes (k,) uint8 at plan positions (k, 2) m; UNDETERMINED where no tile is."""
        return np.append(self.label, np.uint8(ChangeLabel.UNDETERMINED))[self.tile_at(xy)]

    def tile_at(self, xy: FloatArray) -> Int64Array:
        """Index (k,) into the tiles at plan positions (k, 2) m; -1 where no tile is."""
        if len(self.tiles) == 0 or len(xy) == 0:
            return np.full(len(xy), -1, dtype=np.int64)
        lattice = Lattice.around(self.tiles)
        return lattice.find(lattice.keys(self.tiles), cells_of(xy, self.cell_m))


def ground_changes(
    clouds: Pair[FloatArray], is_ground: Pair[BoolArray], lod: LodGrid, params: GroundChangeParams
) -> GroundChanges:
    """Tiles whose ground rose or fell by more than could be by chance, over a connected region.

    Parameters
    ----------
    clouds : Pair of (m, 3) float64, m
        Fused points in the analysis frame.
    is_ground : Pair of (m,) bool
        Which of them are ground.
    lod : LodGrid
        Of the same frame.
    params : GroundChangeParams

    Returns
    -------
    GroundChanges
        In the analysis frame. Tiles that touch at a corner are connected: a trench that runs across the raster is one.

    References
    ----------
    Paper, section 4.3, paragraph on ground changes.
    """
    ground = clouds.join(is_ground, lambda xyz, is_kept: xyz[is_kept])
    tiles_seen = ground.map(lambda xyz: cells_of(xyz[:, :2], params.cell_m))
    tiles = unique_rows(np.vstack([tiles_seen.before, tiles_seen.after]))
    if len(tiles) == 0:
        nothing = np.zeros(0)
        return GroundChanges(params.cell_m, tiles, nothing, nothing, np.zeros(0, np.uint8), np.zeros(0, np.int32), [])
    dz, lod95 = _elevation_change(ground, lod, tiles, params)
    is_changed = (np.abs(dz) > params.min_dz_m) & (np.abs(dz) > params.lod_factor * lod95)
    region = _regions(tiles, np.where(is_changed, np.sign(dz), 0.0), params)
    label = np.where(np.isnan(dz), ChangeLabel.UNDETERMINED, ChangeLabel.UNCHANGED)
    label = np.where(region >= 0, np.where(dz > 0, ChangeLabel.INCREASED, ChangeLabel.DECREASED), label)
    found = [_region(tiles[region == r], dz[region == r], lod95[region == r], params) for r in range(region.max() + 1)]
    return GroundChanges(params.cell_m, tiles, dz, lod95, label.astype(np.uint8), region, found)


def _elevation_change(
    ground: Pair[FloatArray], lod: LodGrid, tiles: Int64Array, params: GroundChangeParams
) -> tuple[FloatArray, FloatArray]:
    """Median elevation change and LoD95 (t,), m, of each tile, over the spots where both epochs have ground.

    In a yard seen over a fence no cell of the LoD grid holds points enough of both epochs, though sixteen spots of a
    tile agree within centimetres: then the tile has the limit of its own median.
    """
    spot_m = params.cell_m / SPOTS_PER_TILE
    spots_seen = ground.map(lambda xyz: cells_of(xyz[:, :2], spot_m))
    spots = unique_rows(np.vstack([spots_seen.before, spots_seen.after]))
    lattice = Lattice.around(spots)
    keys = lattice.keys(spots)
    position = ground.join(spots_seen, lambda xyz, own: Groups(lattice.find(keys, own), len(keys)).mean(xyz))
    is_seen = np.isfinite(position.before[:, 2]) & np.isfinite(position.after[:, 2])
    spots, position = spots[is_seen], position.map(lambda mean: mean[is_seen])
    limits = position.map(lod.at)

    tile_lattice = Lattice.around(tiles)
    tile_idx = tile_lattice.find(tile_lattice.keys(tiles), spots // SPOTS_PER_TILE)
    groups = Groups(tile_idx, len(tiles))
    rise = position.after[:, 2] - position.before[:, 2]
    dz = groups.median(rise)
    lod95 = groups.median((limits.before + limits.after) / 2)
    if params.has_own_limit:
        middle = np.column_stack([(tiles + 0.5) * params.cell_m, groups.median(position.before[:, 2])])
        up = np.tile([0.0, 0.0, 1.0], (len(tiles), 1))
        lod95 = np.fmin(lod95, lod.limit_of(_variance_of_median(rise, groups), middle, up))
    is_enough = groups.counts >= MIN_SPOTS
    return np.where(is_enough, dz, np.nan), np.where(is_enough, lod95, np.nan)


def _variance_of_median(values: FloatArray, groups: Groups) -> FloatArray:
    """Variance of the median of each group of values: of pi / 2 sigma^2 / n, widened for small samples as a cell's."""
    spread = MAD_TO_STD * groups.median(np.abs(values - groups.median(values)[groups.labels]))
    n = np.maximum(groups.counts, 1)
    return np.asarray(np.pi / 2 * (spread * (1.0 + SMALL_SAMPLE / n)) ** 2 / n)


def _regions(tiles: Int64Array, sign: FloatArray, params: GroundChangeParams) -> IntArray:
    """Region of each tile: connected tiles (8 neighbours) of one sign and more than the least area; else -1."""
    first = tiles.min(axis=0)
    i, j = (tiles - first).T
    raster = np.zeros(tiles.max(axis=0) - first + 1)
    raster[i, j] = sign
    region = np.full(len(tiles), -1, np.int64)
    for part, direction in enumerate((1.0, -1.0)):
        labels, _ = ndimage.label(raster == direction, np.ones((3, 3)))
        size = np.bincount(labels.ravel())
        own = labels[i, j]
        is_large = (own > 0) & (size[own] * params.cell_m**2 > params.min_area_m2) & (size[own] >= MIN_TILES)
        region = np.where(is_large, 2 * own + part, region)
    return consecutive(region)[0]


def _region(tiles: Int64Array, dz: FloatArray, lod95: FloatArray, params: GroundChangeParams) -> GroundRegion:
    tile_area = params.cell_m**2
    low = tiles * params.cell_m
    boxes = shapely.box(low[:, 0], low[:, 1], low[:, 0] + params.cell_m, low[:, 1] + params.cell_m)
    footprint = shapely.union_all(boxes)
    if footprint.geom_type == "Polygon":
        footprint = shapely.MultiPolygon([footprint])
    return GroundRegion(
        label=ChangeLabel.INCREASED if dz[0] > 0 else ChangeLabel.DECREASED,
        dz_m=float(np.median(dz)),
        lod95_m=float(np.median(lod95)),
        area_m2=len(tiles) * tile_area,
        volume_m3=float(dz.sum() * tile_area),
        footprint=footprint,
    )
