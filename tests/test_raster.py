"""The raster of the detection limit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from io_samples import make_lod
from pyproj import CRS

from loda_pdal.io.raster import plan_raster, write_lod_raster
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.transform import exp_se3, transform_points

UTM = CRS.from_user_input("EPSG:32617+5703").to_wkt()


def grid(cells: np.ndarray, lod95: np.ndarray, is_valid: np.ndarray, cell_m: float = 1.0) -> LodGrid:
    base = make_lod(cell_m)
    n = len(cells)
    return replace(
        base,
        cells=cells.astype(np.int32),
        lod95=lod95.astype(np.float32),
        is_valid=is_valid,
        normal=np.zeros((n, 3), dtype=np.float32),
        n_before=np.zeros(n, dtype=np.int32),
        n_after=np.zeros(n, dtype=np.int32),
        displacement=np.zeros(n, dtype=np.float32),
    )


def test_values_and_places_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "lod95.tif"
    write_lod_raster(path, make_lod(), np.eye(4), LocalFrame((634_000, 4_831_000, 0), crs_wkt=UTM))
    with rasterio.open(path) as raster:
        assert raster.bounds == (634_120.0, 4_831_210.0, 634_124.0, 4_831_213.0)
        assert raster.res == (1.0, 1.0)
        limit, share = raster.read()
        assert [v[0] for v in raster.sample([(634_120.5, 4_831_210.5)])] == pytest.approx([0.08])
    nan = np.nan
    np.testing.assert_allclose(limit, [[nan, nan, nan, 0.11], [nan] * 4, [0.08, nan, nan, nan]], atol=1e-7)
    np.testing.assert_allclose(share, [[nan, nan, nan, 0.5], [nan] * 4, [1.0, 0.0, nan, nan]], atol=1e-7)


def test_is_a_cloud_optimised_geotiff_that_explains_itself(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    cells = np.unique(rng.integers(0, 1200, (40_000, 3)), axis=0)
    lod = grid(cells, rng.uniform(0.02, 0.5, len(cells)), rng.random(len(cells)) < 0.7)
    path = tmp_path / "lod95.tif"
    write_lod_raster(path, lod, np.eye(4), LocalFrame((634_000, 4_831_000, 0), crs_wkt=UTM))
    with rasterio.open(path) as raster:
        assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert raster.driver == "GTiff" and raster.dtypes == ("float32", "float32")
        assert raster.block_shapes == [(512, 512)] * 2
        assert raster.overviews(1) == [2, 4]
        assert np.isnan(raster.nodata)
        assert raster.units == ("m", "1")
        assert "LoD95" in raster.descriptions[0] and "valid" in raster.descriptions[1]
        assert raster.crs.to_epsg() == 32617 or "NAVD88" in raster.crs.to_wkt()
        limit, share = raster.read()
    # the slow way: cell by cell
    expected: dict[tuple[int, int], list[tuple[float, bool]]] = {}
    for (i, j, _), value, is_valid in zip(lod.cells, lod.lod95, lod.is_valid, strict=True):
        expected.setdefault((int(i), int(j)), []).append((float(value), bool(is_valid)))
    top = int(lod.cells[:, 1].max())
    west = int(lod.cells[:, 0].min())
    assert np.count_nonzero(~np.isnan(share)) == len(expected)
    for (i, j), entries in expected.items():
        valid = [value for value, is_valid in entries if is_valid]
        pixel = top - j, i - west
        assert share[pixel] == pytest.approx(len(valid) / len(entries))
        assert (np.isnan(limit[pixel]) and not valid) or limit[pixel] == pytest.approx(max(valid))


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 2])
def test_a_turned_frame_leaves_no_holes(angle: float) -> None:
    side = np.arange(-30, 30)
    cells = np.column_stack([g.ravel() for g in np.meshgrid(side, side, [5], indexing="ij")])
    ramp = 0.05 + 0.001 * (cells[:, 0] + 30)
    T = exp_se3(np.array([12.3, -4.7, 0.2, 0.0, 0.0, angle]))
    bands, corner = plan_raster(grid(cells, ramp, np.ones(len(cells), dtype=bool)), T)
    centres = transform_points(T, (cells + 0.5) * 1.0)
    inner = np.hypot(*(cells[:, :2] + 0.5).T) < 28
    column = np.floor(centres[inner, 0] - corner[0]).astype(int)
    row = np.floor(corner[1] - centres[inner, 1]).astype(int)
    found = bands[0, row, column]
    assert not np.isnan(found).any()
    assert np.abs(found - ramp[inner]).max() <= 0.0011  # within one cell of the ramp
    assert np.nansum(bands[1]) == pytest.approx(3600, rel=0.02)


def test_pixels_are_in_map_units(tmp_path: Path) -> None:
    path = tmp_path / "feet.tif"
    frame = LocalFrame((636_000, 848_000, 0), 0.3048, 0.3048, CRS.from_epsg(2992).to_wkt())
    write_lod_raster(path, make_lod(0.5), np.eye(4), frame)
    with rasterio.open(path) as raster:
        assert raster.res == pytest.approx((0.5 / 0.3048, 0.5 / 0.3048))
        assert raster.bounds.left == pytest.approx(636_000 + 60.0 / 0.3048)
        assert raster.read(1)[-1, 0] == pytest.approx(0.08)


def test_no_cells_at_all(tmp_path: Path) -> None:
    empty = grid(np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=bool))
    write_lod_raster(tmp_path / "none.tif", empty, np.eye(4), LocalFrame((0, 0, 0)))
    with rasterio.open(tmp_path / "none.tif") as raster:
        assert np.isnan(raster.read()).all()
