"""Reading two surveys from LAS, LAZ or COPC files into one local frame, with every check that can spare a long run.

Headers are judged first: a run that cannot succeed stops before a point is decompressed.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from laspy.errors import LaspyException
from lazrs import LazrsError

from loda_pdal.io.crs import DeclaredCrs, MapCrs, common_crs, declared_crs
from loda_pdal.io.memory import check_memory, estimate_memory
from loda_pdal.model.cloud import ORIGIN_STEP, FloatArray, Int64Array
from loda_pdal.model.errors import InputError
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.pair import Pair
from loda_pdal.model.survey import Survey

MIN_OVERLAP = 0.20
"""Smallest share of the smaller survey's plan that the other must cover."""

OVERLAP_CELL_M = 10.0
"""Edge of the plan cells in which overlap is counted."""

MAX_EXTENT_M = 100_000.0
MIN_DENSITY = 0.01
_SMALL_AREA_M2 = 10_000.0
_SMALLEST_HEADER = 227
_POINTS_AT_ONCE = 500_000
"""Decompressing holds the interpreter lock: in pieces, so that a run can be stopped in between."""

_UNREADABLE = (LaspyException, LazrsError, ValueError, EOFError, struct.error, OverflowError, MemoryError, IndexError)


@dataclass(frozen=True)
class SurveyInfo:
    """What the header of one file says; no point was read.

    Attributes
    ----------
    scale, offset, low, high : (float, float, float)
        Of the stored integers, and the bounds; map units.
    dimensions : tuple of str
        Names of all dimensions, extra bytes last (and named again in ``extra_dimensions``).
    """

    path: str
    n_bytes: int
    n_points: int
    version: str
    point_format: int
    is_compressed: bool
    is_copc: bool
    scale: tuple[float, float, float]
    offset: tuple[float, float, float]
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    dimensions: tuple[str, ...]
    extra_dimensions: tuple[str, ...]
    crs: DeclaredCrs

    @property
    def has_bounds(self) -> bool:
        """Whether the header's bounds can be true: filled in, in order, and within reach of the stored integers."""
        bounds = np.array([self.low, self.high])
        reach = 2.0**31 * np.abs(self.scale) + np.abs(self.offset)
        is_in_order = bool(np.all(bounds[1] >= bounds[0]))  # False for NaN
        return is_in_order and bool(np.all(np.abs(bounds) <= reach)) and bool(np.any(bounds != 0.0))

    @property
    def size_m(self) -> tuple[float, float, float] | None:
        """Extent along x, y, z in metres (map units taken as metres where no CRS is named); None for degrees."""
        if not self.has_bounds or self.crs.is_geographic:
            return None
        unit_xy = self.crs.unit_xy_m or 1.0
        unit_z = self.crs.unit_z_m or unit_xy
        x, y, z = (high - low for low, high in zip(self.low, self.high, strict=True))
        return x * unit_xy, y * unit_xy, z * unit_z

    @property
    def area_m2(self) -> float | None:
        """Area of the bounds in plan."""
        return None if self.size_m is None else self.size_m[0] * self.size_m[1]

    @property
    def density(self) -> float | None:
        """Points per m2 of the bounds in plan; None where they have no area."""
        return self.n_points / self.area_m2 if self.area_m2 else None

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for `loda-pdal info --json`."""
        return {
            "path": self.path,
            "bytes": self.n_bytes,
            "points": self.n_points,
            "las_version": self.version,
            "point_format": self.point_format,
            "compressed": self.is_compressed,
            "copc": self.is_copc,
            "scale": list(self.scale),
            "offset": list(self.offset),
            "min": list(self.low),
            "max": list(self.high),
            "size_m": None if self.size_m is None else list(self.size_m),
            "density_per_m2": self.density,
            "crs": self.crs.name,
            "crs_problem": self.crs.problem or None,
            "epsg": self.crs.epsg,
            "vertical_crs": None if self.crs.vertical is None else self.crs.vertical.name,
            "unit_xy_m": self.crs.unit_xy_m,
            "unit_z_m": self.crs.unit_z_m,
            "dimensions": list(self.dimensions),
            "extra_dimensions": list(self.extra_dimensions),
        }


def inspect(path: str | Path) -> SurveyInfo:
    """Header of a LAS, LAZ or COPC file, checked for being whole; `InputError` otherwise."""
    path = Path(path)
    n_bytes = _file_size(path)
    try:
        with laspy.open(path) as reader:
            header = reader.header
            info = _info(path, n_bytes, header)
            point_start = int(header.offset_to_point_data)
    except OSError as error:
        raise _unreadable(path, error) from error
    except _UNREADABLE as error:
        raise _broken(path, str(error)) from error
    _check_header(info)
    _check_whole(path, info, point_start, header.point_format.size)
    return info


def overlap(a: SurveyInfo, b: SurveyInfo) -> float:
    """Share of the smaller survey's bounds in plan that lies in the other's, 0 to 1, from headers alone.

    Bounds are compared as they stand; bounds without an area count as covered where they touch.
    """
    low = np.maximum(a.low, b.low)[:2]
    high = np.minimum(a.high, b.high)[:2]
    if not (a.has_bounds and b.has_bounds) or np.any(high < low):
        return 0.0
    smaller = min(float(np.prod(np.subtract(i.high, i.low)[:2])) for i in (a, b))
    return float(np.prod(high - low)) / smaller if smaller > 0 else 1.0


def read_epochs(
    before_path: str | Path,
    after_path: str | Path,
    *,
    epsg: int | None = None,
    assume_same_crs: bool = False,
    max_memory: int | None = None,
    leaf_m: float = 0.25,
) -> Pair[Survey]:
    """Both surveys in one local frame, or an `InputError` that says what to do.

    Parameters
    ----------
    before_path, after_path : str or Path
        LAS 1.2 to 1.4, LAZ or COPC.
    epsg : int, optional
        CRS of both surveys, whatever their headers say.
    assume_same_crs : bool
        Go on although the headers name different CRS, or none.
    max_memory : int, optional
        Bytes the run may take; what is free if left out (`MemoryLimitError`).
    leaf_m : float, m
        Edge of the finest voxel of the run to come, for the memory estimate.

    Returns
    -------
    Pair of Survey
        Local metres from a common origin; ``source`` holds the laspy record with every dimension.
    """
    infos = Pair(inspect(before_path), inspect(after_path))
    crs = common_crs(
        infos.map(lambda info: info.crs), infos.map(_short_name), epsg=epsg, assume_same_crs=assume_same_crs
    )
    _check_headers(infos, crs)
    check_memory(_memory_needed(infos, crs, leaf_m), max_memory)
    sources = infos.map(_read_points)
    xyz = sources.join(infos, _map_coordinates)
    frame = common_frame(xyz, crs)
    local = xyz.map(frame.to_local)
    check_coverage(infos.map(_short_name), local)
    return Pair(
        Survey(local.before, frame, infos.before.path, sources.before, crs.notes.before),
        Survey(local.after, frame, infos.after.path, sources.after, crs.notes.after),
    )


def common_frame(xyz: Pair[FloatArray], crs: MapCrs) -> LocalFrame:
    """The local frame of two clouds in full map coordinates, (n, 3) each."""
    low = np.minimum(xyz.before[:, :2].min(axis=0), xyz.after[:, :2].min(axis=0))
    x, y = (int(v) for v in np.floor(low / ORIGIN_STEP) * ORIGIN_STEP)
    return LocalFrame((x, y, 0), crs.unit_xy_m, crs.unit_z_m, crs.wkt)


def check_coverage(names: Pair[str], local: Pair[FloatArray]) -> None:
    """`InputError` where two clouds (n, 3), m, spread absurdly for their number of points, or hardly overlap."""
    for name, points in zip(names, local, strict=True):
        _check_extent(name, len(points), np.ptp(points, axis=0))
    share = plan_overlap(local.before, local.after)
    if share < MIN_OVERLAP:
        raise _no_overlap(names, f"they share {100 * share:.0f} % of the smaller one's area in plan")


def plan_overlap(before: FloatArray, after: FloatArray) -> float:
    """Share of the smaller cloud's occupied plan cells of `OVERLAP_CELL_M` that the other occupies too, 0 to 1."""
    a, b = _plan_cells(before), _plan_cells(after)
    return len(np.intersect1d(a, b, assume_unique=True)) / min(len(a), len(b))


def _plan_cells(xyz: FloatArray) -> Int64Array:
    """Occupied plan cells as sorted unique keys."""
    cells = np.floor(xyz[:, :2] / OVERLAP_CELL_M).astype(np.int64)
    return np.unique((cells[:, 0] << 32) + cells[:, 1])


def _short_name(info: SurveyInfo) -> str:
    return Path(info.path).name


def _file_size(path: Path) -> int:
    """Bytes of the file, after a look at whether it can be a LAS file at all."""
    try:
        if path.is_dir():
            raise InputError(f"{path}: is a folder.", "Name a LAS, LAZ or COPC file.", "input-not-las")
        with path.open("rb") as file:
            start = file.read(4)
        n_bytes = path.stat().st_size
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file.", "Check the path.", "input-missing") from error
    except OSError as error:
        raise _unreadable(path, error) from error
    if n_bytes == 0:
        raise InputError(f"{path}: the file is empty (0 bytes).", "Copy or download it again.", "input-truncated")
    if start != b"LASF":
        raise InputError(
            f"{path}: is not a LAS, LAZ or COPC file.",
            "Convert it first, for example with `pdal translate`.",
            "input-not-las",
        )
    if n_bytes < _SMALLEST_HEADER:
        raise InputError(
            f"{path}: is cut off inside its header ({n_bytes} bytes).",
            "Copy or download it again.",
            "input-truncated",
        )
    return n_bytes


def _unreadable(path: Path, error: OSError) -> InputError:
    return InputError(
        f"{path}: cannot be read ({error.strerror or error}).", "Check the file's permissions.", "input-unreadable"
    )


def _broken(path: Path, reason: str) -> InputError:
    return InputError(
        f"{path}: is damaged or cut off ({reason or 'unexpected end'}).",
        "Copy or download it again, and check it with `pdal info`.",
        "input-truncated",
    )


def _info(path: Path, n_bytes: int, header: Any) -> SurveyInfo:
    point_format = header.point_format
    return SurveyInfo(
        path=str(path),
        n_bytes=n_bytes,
        n_points=int(header.point_count),
        version=str(header.version),
        point_format=int(point_format.id),
        is_compressed=bool(header.are_points_compressed),
        is_copc=any(vlr.user_id == "copc" and vlr.record_id == 1 for vlr in header.vlrs),
        scale=_triple(header.scales),
        offset=_triple(header.offsets),
        low=_triple(header.mins),
        high=_triple(header.maxs),
        dimensions=tuple(point_format.dimension_names),
        extra_dimensions=tuple(point_format.extra_dimension_names),
        crs=declared_crs(header),
    )


def _triple(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _check_header(info: SurveyInfo) -> None:
    if info.n_points == 0:
        raise InputError(f"{info.path}: holds no points.", "Give a survey with points.", "input-empty")
    with np.errstate(over="ignore", invalid="ignore"):
        furthest = 2.0**31 * np.array(info.scale) + np.array(info.offset)
    if not np.all(np.isfinite(furthest)) or 0.0 in info.scale:
        raise InputError(
            f"{info.path}: scale {info.scale} and offset {info.offset} give no finite coordinates.",
            "Repair the header, or write the file again from its source.",
            "input-not-finite",
        )


def _check_whole(path: Path, info: SurveyInfo, point_start: int, point_size: int) -> None:
    """`InputError` where the file ends before its points do: by their count, or by the table of LAZ chunks."""
    if not info.is_compressed:
        needed = point_start + info.n_points * point_size
        if info.n_bytes < needed:
            held = max(0, (info.n_bytes - point_start) // point_size)
            raise _broken(path, f"the header promises {info.n_points} points, the file holds {held}")
        return
    with path.open("rb") as file:
        file.seek(point_start)
        table = file.read(8)
    table_start = struct.unpack("<q", table)[0] if len(table) == 8 else info.n_bytes
    if table_start >= info.n_bytes:
        raise _broken(path, "its table of compressed chunks is missing")


def _check_headers(infos: Pair[SurveyInfo], crs: MapCrs) -> None:
    """Extents and overlap as far as the headers tell: a wrong pair of files is named before any point is read."""
    if not (infos.before.has_bounds and infos.after.has_bounds):
        return
    units = np.array([crs.unit_xy_m, crs.unit_xy_m, crs.unit_z_m])
    for info in infos:
        _check_extent(_short_name(info), info.n_points, np.subtract(info.high, info.low) * units)
    if overlap(infos.before, infos.after) == 0.0:
        raise _no_overlap(infos.map(_short_name), "their bounds lie apart: " + " and ".join(map(_bounds_text, infos)))


def _memory_needed(infos: Pair[SurveyInfo], crs: MapCrs, leaf_m: float) -> int:
    area_m2 = None
    if infos.before.has_bounds and infos.after.has_bounds:
        area_m2 = max(float(np.prod(np.subtract(i.high, i.low)[:2])) for i in infos) * crs.unit_xy_m**2
    return estimate_memory(infos.before.n_points, infos.after.n_points, area_m2=area_m2, leaf_m=leaf_m)


def _bounds_text(info: SurveyInfo) -> str:
    return f"x {info.low[0]:.0f} to {info.high[0]:.0f}, y {info.low[1]:.0f} to {info.high[1]:.0f}"


def _check_extent(name: str, n_points: int, size_m: FloatArray) -> None:
    """`InputError` where the extent (3,), m, cannot be that of a survey with so many points."""
    area_m2 = float(size_m[0] * size_m[1])
    is_huge = bool(np.any(size_m > MAX_EXTENT_M))
    is_thin = area_m2 > _SMALL_AREA_M2 and n_points / area_m2 < MIN_DENSITY
    if is_huge or is_thin:
        raise InputError(
            f"{name}: {n_points} points spread over {size_m[0]:.0f} m by {size_m[1]:.0f} m (height {size_m[2]:.0f} m).",
            "Remove stray points (for example with filters.crop), check the CRS and its unit, or cut out the area.",
            "input-extent",
        )


def _read_points(info: SurveyInfo) -> Any:
    """All points of a file, as laspy's record."""
    path = Path(info.path)
    try:
        with laspy.open(path) as reader:
            points = laspy.ScaleAwarePointRecord.zeros(info.n_points, header=reader.header)
            n_read = 0
            for part in reader.chunk_iterator(_POINTS_AT_ONCE):
                points.array[n_read : n_read + len(part)] = part.array
                n_read += len(part)
    except OSError as error:
        raise _unreadable(path, error) from error
    except _UNREADABLE as error:
        raise _broken(path, str(error)) from error
    if n_read != info.n_points:
        raise _broken(path, f"the header promises {info.n_points} points, {n_read} could be read")
    return laspy.LasData(reader.header, points)


def _map_coordinates(source: Any, info: SurveyInfo) -> FloatArray:
    """Full map coordinates (n, 3) of a laspy record."""
    xyz = map_coordinates(source.points, info.scale, info.offset)
    if not np.all(np.isfinite(xyz)):
        raise InputError(
            f"{info.path}: holds coordinates that are not finite.",
            "Repair the scale and offset of the header, or write the file again from its source.",
            "input-not-finite",
        )
    return xyz


def map_coordinates(points: Any, scale: Any, offset: Any) -> FloatArray:
    """Full map coordinates (n, 3) of laspy points: stored integers times scale plus offset; not checked."""
    with np.errstate(over="ignore"):
        return np.column_stack(
            [points[axis] * float(s) + float(o) for axis, s, o in zip("XYZ", scale, offset, strict=True)]
        )


def _no_overlap(names: Pair[str], found: str) -> InputError:
    return InputError(
        f"{names.before} and {names.after} do not overlap enough: {found}; {100 * MIN_OVERLAP:.0f} % are needed.",
        "Check that both surveys are of the same place and in the same CRS.",
        "no-overlap",
    )
