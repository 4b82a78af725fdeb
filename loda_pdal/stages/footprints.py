"""Concave outlines of objects, from the plan cells that their points occupy."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array, IntArray
from loda_pdal.model.grid import cells_of

GeometryArray = npt.NDArray[np.object_]

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
    rasters = _Rasters.of(labels[is_object].astype(np.int64) - 1, cells_of(xy[is_object], resolution_m), n_objects)
    staircases = rasters.closed().areas()  # in cells: every corner is a whole number
    outlines = shapely.simplify(shapely.buffer(staircases, -DRAWN_IN, join_style="mitre"), SIMPLIFICATION)
    polygons, owner = shapely.get_parts(outlines, return_index=True)
    outlines = _multipolygons(shapely.orient_polygons(polygons), owner, n_objects)
    return list(shapely.transform(outlines, lambda corners: corners * resolution_m))


def _multipolygons(polygons: GeometryArray, owner: Int64Array, n: int) -> GeometryArray:
    """MultiPolygon (n,) of each owner's polygons; owners are sorted, and one without polygons has an empty one."""
    found: GeometryArray = np.full(n, shapely.MultiPolygon(), dtype=object)
    shapely.multipolygons(polygons, indices=owner, out=found)
    return found


@dataclass(frozen=True)
class _Rasters:
    """Covered cells of every object, each on a raster of its own, x by x; all rasters in one long array.

    Two rows and columns around each object are empty, so that its neighbourhoods end on its own raster.

    Attributes
    ----------
    first : (n, 2) int64
        Cell that the first element of each raster stands for.
    shape : (n, 2) int64
        Cells along x and y; 0 for an object without points.
    is_covered : (s,) bool
        Elements of all rasters.
    element, raster : (k,) int64
        The covered elements, ascending, and the raster of each.
    """

    first: Int64Array
    shape: Int64Array
    is_covered: BoolArray
    element: Int64Array
    raster: Int64Array

    @classmethod
    def of(cls, number: Int64Array, cells: Int64Array, n: int) -> _Rasters:
        """Rasters of objects 0 to ``n - 1`` from cells (m, 2) and the object (m,) of each."""
        first, shape = np.zeros((n, 2), dtype=np.int64), np.zeros((n, 2), dtype=np.int64)
        is_present = np.bincount(number, minlength=n) > 0
        for axis in range(2):
            low, high = np.full(n, np.iinfo(np.int64).max), np.full(n, np.iinfo(np.int64).min)
            np.minimum.at(low, number, cells[:, axis])
            np.maximum.at(high, number, cells[:, axis])
            first[is_present, axis] = low[is_present] - 2
            shape[is_present, axis] = (high - low)[is_present] + 5
        nothing = np.zeros(0, dtype=np.int64)
        rasters = cls(first, shape, np.zeros(shape.prod(axis=1).sum(), np.bool_), nothing, nothing)
        x, y = (cells - first[number]).T
        return rasters.with_covered(rasters.start[number] + x * shape[number, 1] + y)

    @property
    def start(self) -> Int64Array:
        """First element (n,) of each raster."""
        size = self.shape.prod(axis=1)
        return np.asarray(np.cumsum(size) - size)

    @property
    def left(self) -> Int64Array:
        """Where each raster (n,) begins along x when all lie side by side."""
        return np.asarray(np.cumsum(self.shape[:, 0]) - self.shape[:, 0])

    def with_covered(self, element: Int64Array) -> _Rasters:
        """The same rasters with these elements covered, in any order and number, and no others."""
        is_covered = np.zeros_like(self.is_covered)
        is_covered[element] = True
        element = np.flatnonzero(is_covered)
        return replace(self, is_covered=is_covered, element=element, raster=self._raster_of(element))

    def closed(self) -> _Rasters:
        """Gaps up to two cells wide closed: grown by a cell to all eight sides, then shrunk again."""
        grown = self.with_covered(np.concatenate([self.element + step for step in self._around()]))
        is_inner = np.all([grown.is_covered[grown.element + step] for step in grown._around()], axis=0)
        return self.with_covered(grown.element[is_inner])

    def _around(self) -> list[Int64Array]:
        """Steps from each covered element to itself and its eight neighbours."""
        stride = self.shape[self.raster, 1]
        return [i * stride + j for i in (-1, 0, 1) for j in (-1, 0, 1)]

    def areas(self) -> GeometryArray:
        """MultiPolygon (n,) of the covered cells: of the faces between the edges of all of them, those covered."""
        left = self.left
        x, y = self._borders(self.shape[self.raster, 1])
        upright = np.stack([np.column_stack([x + 1, y]), np.column_stack([x + 1, y + 1])], axis=1)
        x, y = self._borders(np.ones(len(self.raster), dtype=np.int64))
        level = np.stack([np.column_stack([x, y + 1]), np.column_stack([x + 1, y + 1])], axis=1)
        edges = np.concatenate([upright, level]).astype(np.float64)
        faces = shapely.get_parts(shapely.polygonize(shapely.linestrings(edges)))
        x, y = np.floor(shapely.get_coordinates(shapely.point_on_surface(faces))).astype(np.int64).T
        raster = np.searchsorted(left, x, side="right") - 1
        is_area = self.is_covered[self.start[raster] + (x - left[raster]) * self.shape[raster, 1] + y]
        faces, raster = faces[is_area], raster[is_area]
        order = np.argsort(raster, kind="stable")
        areas = _multipolygons(faces[order], raster[order], len(self.first))
        place = self.first - np.column_stack([left, np.zeros_like(left)])
        moved = shapely.transform(areas, lambda xy: xy + place[np.searchsorted(left, xy[:, 0], side="right") - 1])
        return np.asarray(moved)

    def _borders(self, step: Int64Array) -> tuple[Int64Array, Int64Array]:
        """Elements that differ in cover from the one a ``step`` (k,) on, as x and y with all rasters side by side."""
        leaves = self.element[~self.is_covered[self.element + step]]
        enters = (self.element - step)[~self.is_covered[self.element - step]]
        element = np.sort(np.concatenate([leaves, enters]))
        raster = self._raster_of(element)
        x, y = np.divmod(element - self.start[raster], self.shape[raster, 1])
        return x + self.left[raster], y

    def _raster_of(self, element: Int64Array) -> Int64Array:
        return np.searchsorted(self.start, element, side="right") - 1
