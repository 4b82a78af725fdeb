"""Footprints: areas of known shapes, holes, parts, and outlines that are always valid."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from loda_pdal.model.cloud import Int64Array
from loda_pdal.stages.footprints import _Rasters, footprints


def _placed(points: np.ndarray, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s], [-s, c]]) + np.array([103.3, -50.2])


def _square(rng: np.random.Generator, n: int, side: float) -> np.ndarray:
    return rng.uniform(0.0, side, (n, 2))


def _outline(points: np.ndarray, resolution_m: float) -> shapely.MultiPolygon:
    (outline,) = footprints(points, np.ones(len(points), np.int32), 1, resolution_m)
    return outline


@pytest.mark.parametrize("angle", [0.0, 0.4, 0.785])
@pytest.mark.parametrize("resolution_m", [0.25, 0.5])
def test_l_shape_has_its_area_and_stays_concave(angle: float, resolution_m: float) -> None:
    points = _square(np.random.default_rng(1), 16000, 12.0)
    points = points[(points[:, 0] < 6.0) | (points[:, 1] < 5.0)]
    outline = _outline(_placed(points, angle), resolution_m)
    assert outline.area == pytest.approx(144.0 - 6.0 * 7.0, rel=0.05)
    assert not outline.contains(shapely.Point(_placed(np.array([[9.0, 8.5]]), angle)[0]))
    assert len(outline.geoms) == 1


def test_courtyard_is_a_hole_and_a_small_gap_is_not() -> None:
    points = _square(np.random.default_rng(2), 20000, 20.0)
    is_court = np.all(np.abs(points - 10.0) < 4.0, axis=1)
    is_gap = np.all(np.abs(points - [2.5, 2.5]) < 0.3, axis=1)
    outline = _outline(_placed(points[~is_court & ~is_gap], 0.2), 0.5)
    assert len(outline.geoms[0].interiors) == 1
    assert outline.area == pytest.approx(400.0 - 64.0, rel=0.05)


def test_thin_wall_keeps_its_length() -> None:
    rng = np.random.default_rng(3)
    wall = np.column_stack([rng.uniform(0, 20, 2000), rng.uniform(0, 0.1, 2000)])
    outline = _outline(_placed(wall, 0.5), 0.25)
    box = outline.minimum_rotated_rectangle
    sides = np.hypot(*np.diff(shapely.get_coordinates(box)[:3], axis=0).T)
    assert max(sides) == pytest.approx(20.0, abs=0.4)
    assert len(outline.geoms) == 1


def test_one_point_and_two_parts() -> None:
    single = _outline(np.array([[7.3, 2.1]]), 0.5)
    assert 0 < single.area <= 0.25
    assert single.distance(shapely.Point(7.3, 2.1)) < 0.2
    rng = np.random.default_rng(4)
    apart = np.vstack([_square(rng, 3000, 5.0), _square(rng, 3000, 5.0) + np.array([20.0, 0.0])])
    outline = _outline(_placed(apart, 0.4), 0.5)
    assert outline.geom_type == "MultiPolygon"
    assert len(outline.geoms) == 2
    assert outline.area == pytest.approx(50.0, rel=0.06)


def test_labels_keep_apart_and_missing_ones_are_empty() -> None:
    rng = np.random.default_rng(5)
    beside = np.array([2.0, 0.0])
    points = np.vstack([_square(rng, 1000, 4.0), _square(rng, 1000, 4.0) + beside, _square(rng, 50, 90.0)])
    labels = np.repeat([1, 3, 0], [1000, 1000, 50]).astype(np.int32)
    first, missing, third = footprints(_placed(points, 0.4), labels, 3, 0.5)
    assert missing.is_empty
    assert missing.geom_type == "MultiPolygon"
    assert first.area == pytest.approx(16.0, rel=0.1)
    assert first.intersection(third).area == pytest.approx(8.0, rel=0.15)
    assert footprints(np.zeros((0, 2)), np.zeros(0, np.int32), 0, 0.5) == []


def test_order_does_not_matter_and_a_shift_only_shifts() -> None:
    rng = np.random.default_rng(6)
    points = _placed(_square(rng, 2000, 8.0), 0.3)
    outline = _outline(points, 0.5)
    assert outline.equals(_outline(rng.permutation(points), 0.5))
    shift = np.array([1000.0, 2000.0])
    expected = shapely.transform(outline, lambda corners: corners + shift)
    assert shapely.equals_exact(_outline(points + shift, 0.5), expected, tolerance=1e-6)


@given(st.integers(0, 2**32 - 1), st.integers(1, 400), st.floats(1.0, 30.0))
def test_any_scatter_gives_a_valid_right_handed_outline(seed: int, n: int, extent: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, extent, (n, 2)) + rng.uniform(-1e4, 1e4, 2)
    outline = _outline(points, 0.5)
    assert outline.is_valid
    assert not outline.is_empty
    assert all(part.exterior.is_ccw for part in outline.geoms)
    assert all(not hole.is_ccw for part in outline.geoms for hole in part.interiors)
    distance = shapely.distance(outline, shapely.points(points))
    assert distance.max() < 1.0


def _scattered_cells(seed: int) -> tuple[Int64Array, Int64Array]:
    """Cells of objects 0, 1 and 3 of four: thin enough for gaps, and for corners that touch."""
    rng = np.random.default_rng(seed)
    number = np.repeat(np.array([0, 1, 3]), [40, 1, 300])
    return number, np.vstack([rng.integers(-9, 3, (40, 2)), [[5, -7]], rng.integers(0, 40, (300, 2))])


@pytest.mark.parametrize("seed", range(5))
def test_gaps_are_closed_as_by_morphology_and_every_covered_cell_is_in_the_area(seed: int) -> None:
    number, cells = _scattered_cells(seed)
    closed = _Rasters.of(number, cells, 4).closed()
    for o, area in enumerate(closed.areas()):
        raster = np.zeros((80, 80), np.bool_)
        raster[tuple((cells[number == o] + 20).T)] = True
        expected = ndimage.binary_closing(raster, np.ones((3, 3)))
        is_own = closed.raster == o
        x, y = np.divmod(closed.element[is_own] - closed.start[o], max(closed.shape[o, 1], 1))
        assert np.array_equal(np.column_stack([x, y]) + closed.first[o], np.argwhere(expected) - 20)
        centres = np.argwhere(np.ones_like(raster)) - 20 + 0.5
        assert np.array_equal(shapely.contains_xy(area, *centres.T), expected.ravel())


def test_an_outline_does_not_depend_on_the_other_objects() -> None:
    number, cells = _scattered_cells(5)
    together = footprints(cells + 0.5, number + 1, 4, 1.0)
    for o, outline in enumerate(together):
        (alone,) = footprints(cells[number == o] + 0.5, np.ones(np.count_nonzero(number == o), np.int32), 1, 1.0)
        assert shapely.to_wkb(alone) == shapely.to_wkb(outline)
