"""Concave outlines of objects, from the plan cells that their points occupy."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from scipy import ndimage
from shapely.geometry.polygon import orient

from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array, IntArray
from loda_pdal.model.grid import cells_of
from loda_pdal.model.groups import unique_rows

CLOSING = np.ones((3, 3), np.bool_)
"""Gaps up to two cells wide are closed."""

DRAWN_IN = 0.3
"""A cell counts as covered when one point lies in it, so the covered cells reach too far: by half a cell where points
are many, less where they are few. The outline is drawn in by this share of a cell."""

SIMPLIFICATION = 0.75
"""Largest distance, in cells, by which the outline leaves the staircase of the cells: a step of 45 degrees is 0.71."""


def footprints(xy: FloatArray, labels: IntArray, n_objects: int, resolution_m: float) -> list[Any]:
    """Outline of every object in plan: concave, with holes, in as many parts as the object has.

    Parameters
    ----------
    xy : (m, 2) float64, m
        Points in plan.
    labels : (m,) int
        Object of each point, 1 to ``n_objects``; 0 for none.
    n_objects : int
        Number of objects.
    resolution_m : float, m
        Edge of a cell; about the spacing of the points, or a little more.

    Returns
    -------
    list of shapely MultiPolygon
        One per object: valid, exteriors counter-clockwise, not empty; an object without points has an empty one.
    """
    is_object = labels > 0
    cells = cells_of(xy[is_object], resolution_m)
    rows = unique_rows(np.column_stack([labels[is_object].astype(np.int64), cells]))
    start = np.searchsorted(rows[:, 0], np.arange(1, n_objects + 2))
    return [_outline(rows[a:b, 1:], resolution_m) for a, b in pairwise(start)]


def _outline(cells: Int64Array, cell_m: float) -> Any:
    """Outline of one object's occupied cells (c, 2)."""
    if len(cells) == 0:
        return shapely.MultiPolygon()
    staircase = _filled_area(*_closed(cells))  # in cells: every corner is a whole number
    outline = shapely.simplify(shapely.buffer(staircase, -DRAWN_IN, join_style="mitre"), SIMPLIFICATION)
    polygons = [orient(part) for part in shapely.get_parts(outline)]
    return shapely.transform(shapely.MultiPolygon(polygons), lambda corners: corners * cell_m)


def _closed(cells: Int64Array) -> tuple[BoolArray, Int64Array]:
    """Raster of the cells with small gaps filled and an empty border, and the index of its first cell."""
    first = cells.min(axis=0) - 2
    raster = np.zeros(cells.max(axis=0) - first + 3, np.bool_)
    raster[tuple((cells - first).T)] = True
    return np.asarray(ndimage.binary_closing(raster, CLOSING)), first


def _filled_area(covered: BoolArray, first: Int64Array) -> Any:
    """MultiPolygon of the covered cells: of the faces between the edges of the raster, those that are covered."""
    x, y = np.nonzero(covered[1:] != covered[:-1])
    upright = np.stack([np.column_stack([x + 1, y]), np.column_stack([x + 1, y + 1])], axis=1)
    x, y = np.nonzero(covered[:, 1:] != covered[:, :-1])
    level = np.stack([np.column_stack([x, y + 1]), np.column_stack([x + 1, y + 1])], axis=1)
    edges = np.concatenate([upright, level]).astype(np.float64)
    faces = shapely.get_parts(shapely.polygonize(shapely.linestrings(edges)))
    inside = np.floor(shapely.get_coordinates(shapely.point_on_surface(faces))).astype(np.int64)
    area = shapely.MultiPolygon(list(faces[covered[inside[:, 0], inside[:, 1]]]))
    return shapely.transform(area, lambda corners: corners + first)
