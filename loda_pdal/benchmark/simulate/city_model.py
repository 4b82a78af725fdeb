"""Buildings of a city model (CityJSON 1 or 2, a document or a sequence of features) as triangles and footprints."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.errors import InputError

_BUILDING_TYPES = ("Building", "BuildingPart", "BuildingInstallation")
_LEVEL_M = 0.05
"""Surfaces whose corners all lie this near to the foot of their building are its ground surface."""


@dataclass(frozen=True, eq=False)
class ModelBuilding:
    """One building, in metres of the model's own frame.

    Attributes
    ----------
    name : str
        Key in the model.
    triangles : (t, 3, 3) float64, m
        Roofs and walls; the ground surface is left out.
    footprint : shapely Polygon or MultiPolygon
        What it covers in plan.
    foot_m, top_m : float
        Lowest and highest corner.
    """

    name: str
    triangles: FloatArray
    footprint: Any
    foot_m: float
    top_m: float


def read_city_model(path: str | Path) -> list[ModelBuilding]:
    """All buildings of a CityJSON document (``.json``) or a CityJSON sequence (``.jsonl``), in the order of the file.

    The most detailed geometry of each object is taken; the parts of a building count as that building. `InputError`
    where the file is no city model or holds no building with walls.
    """
    path = Path(path)
    try:
        documents = _documents(path)
        found: dict[str, list[FloatArray]] = {}
        for document, transform in documents:
            for name, triangles in _object_triangles(document, transform):
                found.setdefault(name, []).append(triangles)
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(
            f"{path}: cannot be read as CityJSON ({error}).", "Give a CityJSON 1 or 2 file.", "city-model"
        ) from error
    buildings = [b for b in (_building(name, np.concatenate(parts)) for name, parts in found.items()) if b is not None]
    if not buildings:
        raise InputError(f"{path}: holds no building with walls.", "Give a model with LoD 1 or 2.", "city-model")
    return buildings


def _documents(path: Path) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Each part of the file with the transform of its vertices."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".jsonl":
        lines = [json.loads(line) for line in text.splitlines() if line.strip()]
        return [(feature, lines[0].get("transform", {})) for feature in lines[1:]]
    document = json.loads(text)
    return [(document, document.get("transform", {}))]


def _object_triangles(document: dict[str, Any], transform: dict[str, Any]) -> Iterator[tuple[str, FloatArray]]:
    """Name of the building and triangles (t, 3, 3) of each building object."""
    vertices = np.array(document["vertices"], dtype=float).reshape(-1, 3)
    vertices = vertices * transform.get("scale", 1.0) + transform.get("translate", 0.0)
    for name, thing in document["CityObjects"].items():
        if thing["type"] not in _BUILDING_TYPES or not thing.get("geometry"):
            continue
        finest = max(float(g.get("lod", 0)) for g in thing["geometry"])
        surfaces = [s for g in thing["geometry"] if float(g.get("lod", 0)) == finest for s in _surfaces(g)]
        triangles = [t for surface in surfaces for t in _triangulated([vertices[ring] for ring in surface])]
        if finest > 0 and triangles:
            yield (thing.get("parents") or [name])[0], np.array(triangles)


def _surfaces(geometry: dict[str, Any]) -> list[list[list[int]]]:
    """Surfaces of a geometry, each a list of rings of vertex numbers, the outer one first."""
    depth = {"MultiSurface": 0, "CompositeSurface": 0, "Solid": 1, "MultiSolid": 2, "CompositeSolid": 2}
    surfaces = geometry["boundaries"]
    for _ in range(depth.get(geometry["type"], 0)):
        surfaces = [part for whole in surfaces for part in whole]
    return surfaces if geometry["type"] in depth else []


def _triangulated(rings: list[FloatArray]) -> list[FloatArray]:
    """Triangles (3, 3) of a planar polygon with holes in space."""
    outer = rings[0]
    normal = np.sum(np.cross(outer, np.roll(outer, -1, axis=0)), axis=0)
    if len(outer) < 3 or np.linalg.norm(normal) < 1e-6:
        return []
    kept = [axis for axis in range(3) if axis != int(np.argmax(np.abs(normal)))]
    polygon = shapely.Polygon(outer[:, kept], [ring[:, kept] for ring in rings[1:] if len(ring) >= 3])
    if not polygon.is_valid:
        return []
    corners = {tuple(c[kept]): c for ring in rings for c in ring}
    pieces = shapely.constrained_delaunay_triangles(polygon).geoms
    return [np.array([corners[c] for c in piece.exterior.coords[:3]]) for piece in pieces]


def _building(name: str, triangles: FloatArray) -> ModelBuilding | None:
    """The building that these triangles make; None for what has no volume."""
    foot, top = float(triangles[:, :, 2].min()), float(triangles[:, :, 2].max())
    is_ground = np.all(triangles[:, :, 2] < foot + _LEVEL_M, axis=1)
    plan = shapely.polygons(triangles[:, :, :2])
    footprint = shapely.union_all(shapely.make_valid(plan[shapely.area(plan) > 1e-4])).buffer(0.01).buffer(-0.01)
    if top - foot < 1.5 or footprint.area < 2.0 or footprint.geom_type not in ("Polygon", "MultiPolygon"):
        return None
    return ModelBuilding(name, triangles[~is_ground], footprint, foot, top)
