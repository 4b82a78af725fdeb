"""Writing the point cloud of a run: every point of both inputs once, with all it had and what was found.

The output is LAS 1.4 with a point format of 6 or higher, because the older formats cannot hold classes above 31.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import laspy
import numpy as np
import numpy.typing as npt
from laspy.vlrs.known import WktCoordinateSystemVlr
from pyproj import CRS
from pyproj.enums import WktVersion

import loda_pdal
from loda_pdal.io.las_points import LasFile, map_coordinates
from loda_pdal.model import dimensions as dims
from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.errors import OutputError
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import PointLabels
from loda_pdal.model.survey import Survey
from loda_pdal.model.transform import transform_points

logger = logging.getLogger(__name__)

_FIRST_MODERN_FORMAT = 6
_INT32_MAX = 2**31 - 1
_SCAN_ANGLE_STEP_DEG = 0.006
_LEGACY_OVERLAP_CLASS = 12
_LONGEST_NAME = 32
_LONGEST_DESCRIPTION = 32
_COLOURS, _NIR, _WAVEFORM = "red", "nir", "wavepacket_index"
_OWN_NAMES = frozenset(d.name.casefold() for d in dims.EXTRA_DIMENSIONS)
_SET_APART = frozenset({"X", "Y", "Z", "classification"})
"""Standard fields that are not copied as they are."""


def write_cloud(
    path: Path,
    surveys: Pair[Survey],
    labels: Pair[PointLabels],
    T_after_before: FloatArray,
    *,
    keep_frames: bool = False,
) -> None:
    """Write both surveys, before first and each in its own order, as one LAS or LAZ file.

    Parameters
    ----------
    path : Path
        Ends in ``.las`` or ``.laz``.
    surveys : Pair of Survey
        From `read_epochs`, or made from arrays (then only coordinates are known).
    labels : Pair of PointLabels
        What was found, per point.
    T_after_before : (4, 4) float64
        Moves before-points onto the after cloud, local metres.
    keep_frames : bool
        Leave before-points where their own survey has them.

    Notes
    -----
    Coordinates keep the scale and offset where both inputs share them, and then stay the stored integers they were
    unless they are moved. Classification is replaced by ours; extra dimensions of our names are replaced as well.
    Waveform packets stay in the files they are in: only the fields that point to them are copied.
    """
    if path.name.lower().endswith(".copc.laz") or path.suffix.lower() not in (".las", ".laz"):
        raise OutputError(
            f"{path.name}: point clouds are written as .las or .laz only.",
            "Use laz, and convert it with `pdal translate changes.laz changes.copc.laz` where COPC is wanted.",
            "cloud-format",
        )
    epochs = Pair(
        _Epoch(0, surveys.before, labels.before, None if keep_frames else T_after_before),
        _Epoch(1, surveys.after, labels.after, None),
    )
    extras = _extra_dimensions(epochs.map(lambda epoch: epoch.header))
    header = _header(epochs, extras, surveys.after.frame)
    is_compressed = path.suffix.lower() == ".laz"
    backend = laspy.LazBackend.LazrsParallel if is_compressed else None
    with laspy.open(path, mode="w", header=header, do_compress=is_compressed, laz_backend=backend) as writer:
        for epoch in epochs:
            for part in epoch.parts():
                writer.write_points(_points(epoch, part, extras, header))


class _Part(NamedTuple):
    """Some points of an epoch: the number of the first, their laspy record, and local coordinates (k, 3), m."""

    start: int
    record: Any
    xyz: FloatArray


@dataclass(frozen=True)
class _Epoch:
    """One epoch on its way out; ``T_after_before`` is None where the points stay."""

    number: int
    survey: Survey
    labels: PointLabels
    T_after_before: FloatArray | None

    @cached_property
    def header(self) -> Any:
        """The laspy header of the input; a plain one for a survey made from arrays."""
        if isinstance(self.survey.source, LasFile):
            return self.survey.source.header
        header = laspy.LasHeader(point_format=6, version="1.4")
        header.scales = np.full(3, 0.001)
        header.offsets = np.floor(self.survey.frame.to_map(self.survey.extent.low)) if len(self.survey) else np.zeros(3)
        return header

    def parts(self) -> Iterator[_Part]:
        """All points in their order, read again where they are in a file."""
        source, start = self.survey.source, 0
        if isinstance(source, LasFile):
            for record in source.records():
                yield _Part(start, record, self.survey.frame.to_local(source.map_coordinates(record)))
                start += len(record)
        else:
            for xyz in self.survey.parts():
                record = laspy.ScaleAwarePointRecord.zeros(len(xyz), header=self.header)
                _set_coordinates(record, _steps(self.survey.frame.to_map(xyz), self.header))
                yield _Part(start, record, xyz)
                start += len(xyz)

    def stored(self, part: _Part, header: Any) -> npt.NDArray[np.int32]:
        """Coordinates as integers (k, 3) in the steps of ``header``: the input's own where they need no change."""
        if self.T_after_before is not None:
            return _steps(self.survey.frame.to_map(transform_points(self.T_after_before, part.xyz)), header)
        own = self.header
        if np.array_equal(own.scales, header.scales) and np.array_equal(own.offsets, header.offsets):
            return np.column_stack([np.asarray(part.record[axis]) for axis in "XYZ"])
        return _steps(map_coordinates(part.record, own.scales, own.offsets), header)

    def bounds(self) -> FloatArray:
        """Two corners (2, 3) of a box that holds all points as they are to be written; empty epochs have none."""
        if len(self.survey) == 0:
            return np.empty((0, 3))
        extent, T = self.survey.extent, self.T_after_before
        corners = np.array(list(itertools.product(*zip(extent.low, extent.high, strict=True))))
        corners = self.survey.frame.to_map(corners if T is None else transform_points(T, corners))
        return np.array([corners.min(axis=0), corners.max(axis=0)])


def _steps(full: FloatArray, header: Any) -> npt.NDArray[np.int32]:
    """Full map coordinates (k, 3) as the integers that a file with this header stores."""
    steps = full - header.offsets
    steps /= header.scales
    return np.asarray(np.rint(steps), dtype=np.int32)


def _set_coordinates(record: Any, stored: npt.NDArray[np.int32]) -> None:
    for column, axis in enumerate("XYZ"):
        record.array[axis] = stored[:, column]


def _header(epochs: Pair[_Epoch], extras: list[_Extra], frame: LocalFrame) -> Any:
    names = {name for epoch in epochs for name in epoch.header.point_format.dimension_names}
    header = laspy.LasHeader(point_format=_point_format(names), version="1.4")
    header.scales, header.offsets = _scaling(epochs)
    header.system_identifier = "MERGE"
    header.generating_software = f"loda-pdal {loda_pdal.__version__}"
    after, before = epochs.after.header, epochs.before.header
    header.global_encoding.gps_time_type = after.global_encoding.gps_time_type
    if before.global_encoding.gps_time_type != after.global_encoding.gps_time_type:
        logger.warning("The surveys count GPS time differently; each point keeps its own number.")
    if _WAVEFORM in names:
        logger.warning("Waveform packets are not copied, only the fields that point to them.")
    header.global_encoding.wkt = True
    if frame.crs_wkt is not None:
        header.vlrs.append(WktCoordinateSystemVlr(las_wkt(frame.crs_wkt)))
    for extra in extras:
        header.add_extra_dim(extra.params)
    for dimension in dims.EXTRA_DIMENSIONS:
        meaning = dimension.meaning if len(dimension.meaning) <= _LONGEST_DESCRIPTION else ""
        header.add_extra_dim(laspy.ExtraBytesParams(dimension.name, dimension.dtype, meaning))
    return header


def las_wkt(wkt: str) -> str:
    """The CRS as LAS 1.4 wants it, WKT1; WKT2 where version 1 cannot say it."""
    text = CRS.from_wkt(wkt).to_wkt(WktVersion.WKT1_GDAL)
    return str(text) if text else wkt


def _point_format(names: set[str]) -> int:
    """The smallest point format from 6 on that has the fields ``names``."""
    if _WAVEFORM in names:
        return 10 if _COLOURS in names or _NIR in names else 9
    if _NIR in names:
        return 8
    return 7 if _COLOURS in names else 6


def _scaling(epochs: Pair[_Epoch]) -> tuple[FloatArray, FloatArray]:
    """Scale and offset, (3,) each: the shared ones, else the finest scale and an offset that holds every point."""
    before, after = epochs.before.header, epochs.after.header
    bounds = np.vstack([epochs.before.bounds(), epochs.after.bounds()])
    scale = np.minimum(np.abs(before.scales), np.abs(after.scales))
    offset = np.array(after.offsets, dtype=float)
    if np.array_equal(before.scales, after.scales):
        scale = np.array(after.scales, dtype=float)
    if len(bounds) == 0:
        return scale, offset
    low, high = bounds.min(axis=0), bounds.max(axis=0)
    for axis in range(3):
        if _fits(low[axis], high[axis], scale[axis], offset[axis]):
            continue
        offset[axis] = np.floor((low[axis] + high[axis]) / 2)
        while not _fits(low[axis], high[axis], scale[axis], offset[axis]):
            scale[axis] *= 10.0
    return scale, offset


def _fits(low: float, high: float, scale: float, offset: float) -> bool:
    return bool(max(abs(low - offset), abs(high - offset)) / abs(scale) < _INT32_MAX)


@dataclass(frozen=True)
class _Extra:
    """One extra dimension of the inputs on its way out.

    ``names`` is what each epoch calls it (None where it has none), ``is_raw`` whether its stored values are copied
    as they are, ``fill`` what points without it get.
    """

    params: Any
    names: Pair[str | None]
    is_raw: bool
    fill: Any


def _extra_dimensions(headers: Pair[Any]) -> list[_Extra]:
    """Union of the extra dimensions of both inputs, those of the before epoch first."""
    before, after = _declared(headers.before), _declared(headers.after)
    extras = []
    for name, b in before.items():
        a = after.pop(name, None)
        if a is None:
            extras.append(_copied(b, Pair(name, None)))
        elif _is_stored_alike(b, a):
            extras.append(_copied(b, Pair(name, name)))
        elif b.num_elements == a.num_elements:
            extras.append(_promoted(headers, name, b.num_elements))
        else:
            other = _free_name(name, {*before, *after})
            extras += [_copied(b, Pair(name, None)), _copied(a, Pair(None, name), other)]
    return extras + [_copied(a, Pair(None, name)) for name, a in after.items()]


def _declared(header: Any) -> dict[str, Any]:
    """The extra dimensions of an input by name, less those that ours replace; with their no-data values."""
    structs = [struct for vlr in header.vlrs.get("ExtraBytesVlr") for struct in vlr.extra_bytes_structs]
    no_data = {struct.format_name(): struct.no_data for struct in structs if struct.data_type != 0}
    return {
        d.name: d._replace(no_data=no_data.get(d.name))  # laspy reads the rest of the declaration, but not this
        for d in header.point_format.extra_dimensions
        if d.name.casefold() not in _OWN_NAMES
    }


def _is_stored_alike(a: Any, b: Any) -> bool:
    return bool(a.dtype == b.dtype and np.array_equal(a.scales, b.scales) and np.array_equal(a.offsets, b.offsets))


def _copied(info: Any, names: Pair[str | None], name: str | None = None) -> _Extra:
    params = laspy.ExtraBytesParams(
        name or info.name, info.dtype, info.description, info.offsets, info.scales, info.no_data
    )
    is_float = info.dtype.base.kind == "f"
    fill = info.no_data if info.no_data is not None else (np.nan if is_float else 0)
    return _Extra(params, names, True, fill)


def _promoted(headers: Pair[Any], name: str, n_elements: int) -> _Extra:
    """A dimension that both inputs have but store differently: written in a type that holds both."""
    empty = headers.map(lambda header: laspy.ScaleAwarePointRecord.zeros(0, header=header))
    base = np.result_type(*(np.asarray(record[name]).dtype for record in empty))
    dtype = np.dtype(base) if n_elements == 1 else np.dtype((base, (n_elements,)))
    return _Extra(laspy.ExtraBytesParams(name, dtype), Pair(name, name), False, np.nan if base.kind == "f" else 0)


def _free_name(name: str, taken: set[str]) -> str:
    suffix, candidate = "_after", name
    while candidate in taken:
        candidate = candidate[: _LONGEST_NAME - len(suffix)] + suffix
        suffix += "_"
    return candidate


def _points(epoch: _Epoch, part: _Part, extras: list[_Extra], header: Any) -> Any:
    """The output record of some points of one epoch."""
    record = laspy.ScaleAwarePointRecord.zeros(len(part.record), header=header)
    _set_coordinates(record, epoch.stored(part, header))
    _copy_standard(part.record, record)
    for extra in extras:
        name = extra.names.before if epoch.number == 0 else extra.names.after
        _copy_extra(part.record, record, extra, name)
    found = epoch.labels.of_part(part.start, part.xyz)
    record.array["classification"] = found[dims.CLASSIFICATION.name]
    for dimension in dims.EXTRA_DIMENSIONS:
        record.array[dimension.name] = epoch.number if dimension is dims.EPOCH else found[dimension.name]
    return record


def _copy_standard(source: Any, record: Any) -> None:
    """The fields of the LAS standard; those of formats 0 to 5 in the units and bits of formats 6 and up."""
    if source.point_format.id >= _FIRST_MODERN_FORMAT:  # all of these pack their flags alike
        for name in laspy.PointFormat(source.point_format.id).dtype().names:
            if name not in _SET_APART and name in record.array.dtype.names:
                record.array[name] = source.array[name]
        return
    available = set(source.point_format.standard_dimension_names)
    for name in record.point_format.standard_dimension_names:
        if name in available and name not in _SET_APART:
            record[name] = np.asarray(source[name])
    degrees = np.asarray(source["scan_angle_rank"], dtype=float)
    record["scan_angle"] = np.rint(degrees / _SCAN_ANGLE_STEP_DEG).astype(np.int16)
    record["overlap"] = np.asarray(source["classification"]) == _LEGACY_OVERLAP_CLASS


def _copy_extra(source: Any, record: Any, extra: _Extra, name: str | None) -> None:
    column = record.array[extra.params.name]
    if name is None:
        column[...] = extra.fill
    elif extra.is_raw:
        column[...] = source.array[name]
    else:
        column[...] = np.asarray(source[name])
