"""Writing the point cloud of a run: every point of both inputs once, with all it had and what was found.

The output is LAS 1.4 with a point format of 6 or higher, because the older formats cannot hold classes above 31.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
from laspy.vlrs.known import WktCoordinateSystemVlr
from pyproj import CRS
from pyproj.enums import WktVersion

import loda_pdal
from loda_pdal.model import dimensions as dims
from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.errors import OutputError
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import PointLabels
from loda_pdal.model.survey import Survey
from loda_pdal.model.transform import transform_points

logger = logging.getLogger(__name__)

CHUNK = 1_000_000
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
    sources = surveys.map(_source)
    epochs = Pair(
        _Epoch(0, surveys.before, sources.before, labels.before, None if keep_frames else T_after_before),
        _Epoch(1, surveys.after, sources.after, labels.after, None),
    )
    extras = _extra_dimensions(sources)
    header = _header(epochs, extras, surveys.after.frame)
    is_compressed = path.suffix.lower() == ".laz"
    backend = laspy.LazBackend.LazrsParallel if is_compressed else None
    with laspy.open(path, mode="w", header=header, do_compress=is_compressed, laz_backend=backend) as writer:
        for epoch in epochs:
            for part in epoch.parts():
                writer.write_points(_points(epoch, part, extras, header))


@dataclass(frozen=True)
class _Epoch:
    """One epoch on its way out; ``T_after_before`` is None where the points stay."""

    number: int
    survey: Survey
    source: Any
    labels: PointLabels
    T_after_before: FloatArray | None

    def parts(self) -> Iterator[slice]:
        for start in range(0, len(self.survey), CHUNK):
            yield slice(start, min(start + CHUNK, len(self.survey)))

    def map_coordinates(self, part: slice) -> FloatArray:
        """Full map coordinates (k, 3) as they are to be written."""
        if self.T_after_before is not None:
            return self.survey.frame.to_map(transform_points(self.T_after_before, self.survey.xyz[part]))
        points, scale, offset = self.source.points[part], self.source.header.scales, self.source.header.offsets
        return np.column_stack([points[axis] * s + o for axis, s, o in zip("XYZ", scale, offset, strict=True)])

    def stored(self, part: slice, header: Any) -> npt.NDArray[np.int32]:
        """Coordinates as stored integers (k, 3): the input's own where they need no change."""
        own = self.source.header
        is_same = np.array_equal(own.scales, header.scales) and np.array_equal(own.offsets, header.offsets)
        if self.T_after_before is None and is_same:
            points = self.source.points[part]
            return np.column_stack([np.asarray(points[axis]) for axis in "XYZ"])
        rounded = np.rint((self.map_coordinates(part) - header.offsets) / header.scales)
        return np.asarray(rounded, dtype=np.int32)

    def bounds(self) -> FloatArray:
        """Lowest and highest map coordinates, (2, 3); empty epochs have none, (0, 3)."""
        parts = [self.map_coordinates(part) for part in self.parts()]
        return np.array([f(p, axis=0) for p in parts for f in (np.min, np.max)]).reshape(-1, 3)


def _source(survey: Survey) -> Any:
    """The laspy record of a survey; a plain one for a survey made from arrays."""
    if survey.source is not None:
        return survey.source
    header = laspy.LasHeader(point_format=6, version="1.4")
    full = survey.frame.to_map(survey.xyz)
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(full.min(axis=0)) if len(full) else np.zeros(3)
    data = laspy.LasData(header)
    data.points = laspy.ScaleAwarePointRecord.zeros(len(full), header=header)
    for column, axis in enumerate("XYZ"):
        data.points[axis] = np.rint((full[:, column] - header.offsets[column]) / header.scales[column])
    return data


def _header(epochs: Pair[_Epoch], extras: list[_Extra], frame: LocalFrame) -> Any:
    names = {name for epoch in epochs for name in epoch.source.point_format.dimension_names}
    header = laspy.LasHeader(point_format=_point_format(names), version="1.4")
    header.scales, header.offsets = _scaling(epochs)
    header.system_identifier = "MERGE"
    header.generating_software = f"loda-pdal {loda_pdal.__version__}"
    after, before = epochs.after.source.header, epochs.before.source.header
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
    before, after = epochs.before.source.header, epochs.after.source.header
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


def _extra_dimensions(sources: Pair[Any]) -> list[_Extra]:
    """Union of the extra dimensions of both inputs, those of the before epoch first."""
    before, after = _declared(sources.before), _declared(sources.after)
    extras = []
    for name, b in before.items():
        a = after.pop(name, None)
        if a is None:
            extras.append(_copied(b, Pair(name, None)))
        elif _is_stored_alike(b, a):
            extras.append(_copied(b, Pair(name, name)))
        elif b.num_elements == a.num_elements:
            extras.append(_promoted(sources, name, b.num_elements))
        else:
            other = _free_name(name, {*before, *after})
            extras += [_copied(b, Pair(name, None)), _copied(a, Pair(None, name), other)]
    return extras + [_copied(a, Pair(None, name)) for name, a in after.items()]


def _declared(source: Any) -> dict[str, Any]:
    """The extra dimensions of an input by name, less those that ours replace; with their no-data values."""
    structs = [struct for vlr in source.header.vlrs.get("ExtraBytesVlr") for struct in vlr.extra_bytes_structs]
    no_data = {struct.format_name(): struct.no_data for struct in structs if struct.data_type != 0}
    return {
        d.name: d._replace(no_data=no_data.get(d.name))  # laspy reads the rest of the declaration, but not this
        for d in source.point_format.extra_dimensions
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


def _promoted(sources: Pair[Any], name: str, n_elements: int) -> _Extra:
    """A dimension that both inputs have but store differently: written in a type that holds both."""
    base = np.result_type(*(np.asarray(source.points[name][:0]).dtype for source in sources))
    dtype = np.dtype(base) if n_elements == 1 else np.dtype((base, (n_elements,)))
    return _Extra(laspy.ExtraBytesParams(name, dtype), Pair(name, name), False, np.nan if base.kind == "f" else 0)


def _free_name(name: str, taken: set[str]) -> str:
    suffix, candidate = "_after", name
    while candidate in taken:
        candidate = candidate[: _LONGEST_NAME - len(suffix)] + suffix
        suffix += "_"
    return candidate


def _points(epoch: _Epoch, part: slice, extras: list[_Extra], header: Any) -> Any:
    """The output record of some points of one epoch."""
    source = epoch.source.points[part]
    record = laspy.ScaleAwarePointRecord.zeros(len(source), header=header)
    stored = epoch.stored(part, header)
    for column, axis in enumerate("XYZ"):
        record.array[axis] = stored[:, column]
    _copy_standard(source, record)
    for extra in extras:
        name = extra.names.before if epoch.number == 0 else extra.names.after
        _copy_extra(source, record, extra, name)
    _set_labels(record, epoch, part)
    return record


def _copy_standard(source: Any, record: Any) -> None:
    """The fields of the LAS standard; those of formats 0 to 5 in the units and bits of formats 6 and up."""
    available = set(source.point_format.standard_dimension_names)
    for name in record.point_format.standard_dimension_names:
        if name in available and name not in _SET_APART:
            record[name] = np.asarray(source[name])
    if "scan_angle_rank" in available:
        degrees = np.asarray(source["scan_angle_rank"], dtype=float)
        record["scan_angle"] = np.rint(degrees / _SCAN_ANGLE_STEP_DEG).astype(np.int16)
    if "overlap" not in available:
        record["overlap"] = np.asarray(source["classification"]) == _LEGACY_OVERLAP_CLASS


def _copy_extra(source: Any, record: Any, extra: _Extra, name: str | None) -> None:
    column = record.array[extra.params.name]
    if name is None:
        column[...] = extra.fill
    elif extra.is_raw:
        column[...] = source.array[name]
    else:
        column[...] = np.asarray(source[name])


def _set_labels(record: Any, epoch: _Epoch, part: slice) -> None:
    labels = epoch.labels
    record["classification"] = labels.classification[part]
    for dimension, values in (
        (dims.HEIGHT, labels.height),
        (dims.LOD95, labels.lod95),
        (dims.SUPERPOINT, labels.superpoint),
        (dims.INSTANCE, labels.instance),
        (dims.OBJECT, labels.object),
        (dims.CHANGE, labels.change),
        (dims.CONFIDENCE, labels.confidence),
    ):
        record.array[dimension.name] = values[part]
    record.array[dims.EPOCH.name] = epoch.number
