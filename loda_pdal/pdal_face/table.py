"""Points as PDAL names them, read from and written to LAS files with laspy: what the embedded runner works on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
from pyproj import CRS

from loda_pdal.io.copc import SUFFIX, write_copc
from loda_pdal.io.crs import declared_crs
from loda_pdal.io.las import inspect
from loda_pdal.io.las_points import map_coordinates
from loda_pdal.model.errors import OutputError, PipelineError
from loda_pdal.pdal_face.partial import PartialFile

Column = npt.NDArray[Any]

_NAMES = {
    "Intensity": "intensity",
    "ReturnNumber": "return_number",
    "NumberOfReturns": "number_of_returns",
    "ScanDirectionFlag": "scan_direction_flag",
    "EdgeOfFlightLine": "edge_of_flight_line",
    "Classification": "classification",
    "UserData": "user_data",
    "PointSourceId": "point_source_id",
    "GpsTime": "gps_time",
    "ScanChannel": "scanner_channel",
    "Red": "red",
    "Green": "green",
    "Blue": "blue",
    "Infrared": "nir",
}
"""PDAL's name of a LAS dimension and laspy's; the scan angle and the flags are handled apart."""

_FLAGS = ("synthetic", "key_point", "withheld", "overlap")
"""Bits of PDAL's ClassFlags, lowest first."""

_ANGLE_STEP_DEG = 0.006
"""Unit of the stored scan angle from point format 6 on."""


@dataclass(frozen=True)
class Table:
    """Points with all their dimensions.

    Attributes
    ----------
    columns : dict of str to (n,) array
        Named as PDAL names them; X, Y, Z are float64 in map units.
    crs_wkt : str or None
        Coordinate reference system; None where the file names none.
    notes : dict of str to str
        What stages left for later ones.
    """

    columns: Mapping[str, Column]
    crs_wkt: str | None = None
    notes: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.columns["X"])


def merge_tables(tables: list[Table]) -> Table:
    """One table of the points of all, in order; dimensions that one lacks are 0 there."""
    kinds: dict[str, np.dtype[Any]] = {}
    for table in tables:
        for name, column in table.columns.items():
            kinds[name] = np.promote_types(kinds[name], column.dtype) if name in kinds else column.dtype
    columns = {
        name: np.concatenate([t.columns.get(name, np.zeros(len(t), kind)).astype(kind, copy=False) for t in tables])
        for name, kind in kinds.items()
    }
    notes = {name: text for table in tables for name, text in table.notes.items()}
    return Table(columns, next((t.crs_wkt for t in tables if t.crs_wkt), None), notes)


def read_table(path: Path) -> Table:
    """All points of a LAS, LAZ or COPC file."""
    info = inspect(path)
    data = laspy.read(path)
    xyz = map_coordinates(data.points, info.scale, info.offset)
    columns: dict[str, Column] = {axis: np.ascontiguousarray(xyz[:, i]) for i, axis in enumerate("XYZ")}
    present = set(data.point_format.dimension_names)
    for name, source in _NAMES.items():
        if source in present:
            columns[name] = np.array(data[source])
    columns["ScanAngleRank"] = _scan_angle_deg(data, present)
    columns["ClassFlags"] = _class_flags(data, present)
    for name in data.point_format.extra_dimension_names:
        columns[name] = np.array(data[name])
    return Table(columns, declared_crs(data.header).wkt)


def _scan_angle_deg(data: Any, present: set[str]) -> Column:
    if "scan_angle" in present:
        return np.asarray(np.array(data["scan_angle"]) * _ANGLE_STEP_DEG, dtype=np.float32)
    return np.asarray(data["scan_angle_rank"], dtype=np.float32)


def _class_flags(data: Any, present: set[str]) -> Column:
    flags = np.zeros(len(data.points), dtype=np.uint8)
    for bit, name in enumerate(_FLAGS):
        if name in present:
            flags |= (np.asarray(data[name]).astype(np.uint8) << bit).astype(np.uint8)
    return flags


def write_table(
    table: Table,
    path: Path,
    *,
    point_format: int,
    minor_version: int,
    scale: tuple[float, float, float],
    offset: tuple[float | None, float | None, float | None],
    with_extra: bool,
) -> None:
    """Write LAS, LAZ where the name ends in ``.laz`` or COPC (``.copc.laz``); under a temporary name until it is whole.

    Parameters
    ----------
    table : Table
        The points.
    path : Path
        Where to.
    point_format, minor_version : int
        LAS point format, and version 1.``minor_version``.
    scale : (float, float, float)
        Steps of the stored coordinates, map units.
    offset : (float or None, float or None, float or None)
        Offset of the stored coordinates, map units; None takes the lowest coordinate.
    with_extra : bool
        Whether dimensions that the point format lacks are written as extra bytes.
    """
    header = laspy.LasHeader(point_format=point_format, version=f"1.{minor_version}")
    header.scales = np.array(scale)
    lowest = [table.columns[axis].min() if len(table) else 0.0 for axis in "XYZ"]
    header.offsets = np.array([low if given is None else given for low, given in zip(lowest, offset, strict=True)])
    present = set(header.point_format.dimension_names)
    if with_extra:
        known = {"X", "Y", "Z", "ScanAngleRank", "ClassFlags"} | {
            n for n, source in _NAMES.items() if source in present
        }
        extra = [name for name in table.columns if name not in known]
        header.add_extra_dims([laspy.ExtraBytesParams(name, table.columns[name].dtype) for name in extra])
    if table.crs_wkt:
        header.add_crs(CRS.from_wkt(table.crs_wkt))
    data = laspy.LasData(header)
    data.points = laspy.ScaleAwarePointRecord.zeros(len(table), header=header)
    for i, axis in enumerate("XYZ"):
        data[axis] = _stored(table.columns[axis], float(header.scales[i]), float(header.offsets[i]), axis)
    _fill(data, table, set(header.point_format.dimension_names))
    _write_whole(data, path)


def _fill(data: Any, table: Table, present: set[str]) -> None:
    """All dimensions but the coordinates."""
    for name, column in table.columns.items():
        target = _NAMES.get(name, name)
        if target in present and name not in "XYZ":
            data[target] = column
    if "ScanAngleRank" in table.columns:
        angle = table.columns["ScanAngleRank"]
        if "scan_angle" in present:
            data["scan_angle"] = np.round(angle / _ANGLE_STEP_DEG).astype(np.int16)
        else:
            data["scan_angle_rank"] = np.round(angle).astype(np.int8)
    for bit, name in enumerate(_FLAGS):
        if name in present and "ClassFlags" in table.columns:
            data[name] = (table.columns["ClassFlags"] >> bit) & 1


def _stored(values: Column, scale: float, offset: float, axis: str) -> npt.NDArray[np.int32]:
    """Integers that stand for coordinates; `PipelineError` where they do not fit."""
    stored = np.round((values - offset) / scale)
    if len(stored) and not np.all(np.abs(stored) < 2**31):
        raise PipelineError(
            f"writers.las: {axis} does not fit with scale {scale:g} and offset {offset:g}.",
            f'Set scale_{axis.lower()} larger, or offset_{axis.lower()} to "auto".',
            "output-range",
        )
    return stored.astype(np.int32)


def _write_whole(data: Any, path: Path) -> None:
    file = PartialFile(path)
    try:
        with file.part.open("wb") as stream:
            data.write(stream, do_compress=path.suffix.lower() == ".laz")
        if path.name.lower().endswith(SUFFIX):
            write_copc(file.part, file.part)
        file.finish()
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror or error}).", "Check the folder.", "output-unwritable"
        ) from error
    finally:
        file.discard()
