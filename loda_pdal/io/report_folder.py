"""The report once more, from the files that a run left in its folder: after a review in QGIS, or for an old run."""

from __future__ import annotations

import dataclasses
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyogrio.raw
import shapely
from laspy.errors import LaspyException
from lazrs import LazrsError
from pyogrio.errors import DataLayerError, DataSourceError

from loda_pdal.io.report import ReportData, render
from loda_pdal.io.reviews import Review
from loda_pdal.io.transform import read_map_transform
from loda_pdal.model.cloud import FloatArray, Int64Array
from loda_pdal.model.errors import InputError, OutputError
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import GroundChangeRecord, ObjectRecord, UIntArray
from loda_pdal.model.transform import transform_points
from loda_pdal.params import Parameters

CHUNK = 1_000_000
CLOUDS = ("changes.laz", "changes.las", "changes.copc.laz")
_OBJECT_FIELDS = {f.name for f in dataclasses.fields(ObjectRecord)}
_WHOLE = {"object_id", "parent_id", "points_before", "points_after", "ground_change_id"}


def rebuild_report(folder: str | Path) -> Path:
    """Write ``report.html`` of a finished run anew and return its path."""
    folder = Path(folder)
    page = render(read_report_data(folder))
    path, part = folder / "report.html", folder / f".report-{os.getpid()}.part"
    try:
        part.write_text(page, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror or error}).",
            "Check the folder and the disk.",
            "output-unwritable",
        ) from error
    finally:
        part.unlink(missing_ok=True)
    return path


def read_report_data(folder: Path) -> ReportData:
    """What the report shows, from run.json, changes.gpkg and the cloud; `InputError` where one is missing."""
    try:
        run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        crs, leaf_m = run["crs"], float(run["parameters"]["fuse"]["leaf_m"])
        x, y, z = crs["local_origin"]
        frame = LocalFrame((x, y, z), crs["unit_xy_m"], crs["unit_z_m"], crs["wkt"])
        objects, reviews = _objects(folder / "changes.gpkg", frame)
        ground = _ground_changes(folder / "changes.gpkg", frame)
        T_map = read_map_transform(folder / "transform.json") if run["keep_frames"] else np.eye(4)
        clouds, object_of_point = _points(_cloud_path(folder), frame, leaf_m, T_map)
        parameters = Parameters.from_dict(run["parameters"])
        return ReportData(
            run["summary"], objects, ground, clouds, object_of_point, frame, parameters, run, reviews=reviews
        )
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        LaspyException,
        LazrsError,
        DataSourceError,
        DataLayerError,
    ) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{folder}: holds no whole result of a run ({_reason(error)}).",
            "Name the folder given to `loda-pdal detect -o`.",
            "run-incomplete",
        ) from error


def _reason(error: Exception) -> str:
    if isinstance(error, FileNotFoundError):
        return f"no {Path(str(error.filename)).name}"
    return f"no {error.args[0]}" if isinstance(error, KeyError) else str(error)


def _cloud_path(folder: Path) -> Path:
    for name in CLOUDS:
        if (folder / name).exists():
            return folder / name
    raise FileNotFoundError(2, "no point cloud", CLOUDS[0])


def _rows(path: Path, layer: str) -> list[dict[str, Any]]:
    """All features of a layer as dictionaries, the shape under ``footprint``; NULL is None."""
    if not path.exists():
        raise FileNotFoundError(2, "no GeoPackage", str(path))
    meta, _, shapes, columns = pyogrio.raw.read(path, layer=layer)
    rows = []
    for i, shape in enumerate(shapely.from_wkb(shapes)):
        values = {name: _value(name, column[i]) for name, column in zip(meta["fields"], columns, strict=True)}
        rows.append(values | {"footprint": shape})
    return rows


def _value(name: str, value: Any) -> Any:
    if value is None or (isinstance(value, (float, np.floating)) and not np.isfinite(value)):
        return None
    if isinstance(value, np.datetime64):
        return None if np.isnat(value) else str(value.astype("datetime64[D]"))
    if name in _WHOLE:
        return int(value)
    return value.item() if isinstance(value, np.generic) else value


def _to_local(shape: Any, frame: LocalFrame) -> Any:
    origin, scale = np.array(frame.origin[:2], dtype=float), frame.scale[:2]
    return shapely.transform(shape, lambda xy: (xy - origin) * scale)


def _objects(path: Path, frame: LocalFrame) -> tuple[list[ObjectRecord], dict[int, str]]:
    """All objects, and what a reviewer noted on some of the changes, by object_id."""
    objects = []
    for row in _rows(path, "objects"):
        values = {name: value for name, value in row.items() if name in _OBJECT_FIELDS}
        values["label"] = ChangeLabel(int(row["label_code"]))
        values["object_class"] = ObjectClass[str(row["object_class"]).upper()]
        values["footprint"] = _to_local(row["footprint"], frame)
        objects.append(ObjectRecord(**values))
    noted = [Review.of_row(row) for row in _rows(path, "changes")]
    reviews = {review.object_id: review.sentence for review in noted if not review.is_blank}
    return sorted(objects, key=lambda o: o.object_id), reviews


def _ground_changes(path: Path, frame: LocalFrame) -> list[GroundChangeRecord]:
    names = {f.name for f in dataclasses.fields(GroundChangeRecord)}
    records = []
    for row in _rows(path, "ground_changes"):
        values = {name: value for name, value in row.items() if name in names}
        values["label"] = ChangeLabel(int(row["label_code"]))
        values["footprint"] = _to_local(row["footprint"], frame)
        records.append(GroundChangeRecord(**values))
    return records


def _points(
    path: Path, frame: LocalFrame, leaf_m: float, T_map: FloatArray
) -> tuple[Pair[FloatArray], Pair[UIntArray]]:
    """The mean point of every voxel and object of each epoch in local metres, noise left out, read piece by piece.

    ``T_map`` (4, 4) moves the before-points of the file, in full map coordinates, onto the after epoch.
    """
    parts: dict[int, list[_Fused]] = {0: [_Fused.nothing()], 1: [_Fused.nothing()]}
    with laspy.open(path) as reader:
        for points in reader.chunk_iterator(CHUNK):
            full, objects = np.column_stack([points.x, points.y, points.z]), np.asarray(points["ObjectId"])
            epochs, is_noise = np.asarray(points["Epoch"]), np.asarray(points.classification) == ObjectClass.NOISE
            for epoch, fused in parts.items():
                is_here = (epochs == epoch) & ~is_noise
                moved = full[is_here] if epoch else transform_points(T_map, full[is_here])
                fused.append(_Fused.of(frame.to_local(moved), objects[is_here], leaf_m))
    before, after = (_Fused.joined(fused) for fused in parts.values())
    return Pair(before.means, after.means), Pair(before.objects, after.objects)


@dataclass(frozen=True)
class _Fused:
    """Sums of points: ``cells`` (k, 4) int64 voxel and object, sorted and unique; ``sums`` (k, 3) m; ``n`` (k,)."""

    cells: Int64Array
    sums: FloatArray
    n: Int64Array

    @classmethod
    def nothing(cls) -> _Fused:
        return cls(np.empty((0, 4), dtype=np.int64), np.empty((0, 3)), np.empty(0, dtype=np.int64))

    @classmethod
    def of(cls, xyz: FloatArray, objects: UIntArray, leaf_m: float) -> _Fused:
        cells = np.column_stack([np.floor(xyz / leaf_m).astype(np.int64), objects.astype(np.int64)])
        return cls._summed(cells, xyz, np.ones(len(xyz), dtype=np.int64))

    @classmethod
    def joined(cls, parts: list[_Fused]) -> _Fused:
        return cls._summed(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("cells", "sums", "n")))

    @classmethod
    def _summed(cls, cells: Int64Array, sums: FloatArray, n: Int64Array) -> _Fused:
        if not len(cells):
            return cls.nothing()
        order = np.lexsort(cells.T)
        cells = cells[order]
        starts = np.flatnonzero(np.r_[True, np.any(cells[1:] != cells[:-1], axis=1)])
        return cls(cells[starts], np.add.reduceat(sums[order], starts), np.add.reduceat(n[order], starts))

    @property
    def means(self) -> FloatArray:
        return np.asarray(self.sums / self.n[:, None])

    @property
    def objects(self) -> UIntArray:
        return self.cells[:, 3].astype(np.uint32)
