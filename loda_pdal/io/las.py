"""Reading two surveys from LAS, LAZ or COPC files into one local frame, with every check that can spare a long run.

Headers are judged first: a run that cannot succeed stops before a point is decompressed. Then every point is looked at
once. Points are not kept (see `LasFile`): who needs them later goes through the file again.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np

from loda_pdal.io.crs import DeclaredCrs, MapCrs, common_crs, declared_crs
from loda_pdal.io.gps_time import gps_day
from loda_pdal.io.las_points import LasFile, broken, reading, unreadable
from loda_pdal.io.memory import check_memory, estimate_memory
from loda_pdal.io.trajectory import MapTrajectory, TrajectoryCheck, read_trajectory
from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.errors import InputError
from loda_pdal.model.extent import Extent
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.pair import Pair, at_once
from loda_pdal.model.survey import Survey

MIN_OVERLAP = 0.20
"""Smallest share of the smaller survey's plan that the other must cover."""

MAX_EXTENT_M = 100_000.0
MIN_DENSITY = 0.01
_SMALL_AREA_M2 = 10_000.0
_SMALLEST_HEADER = 227


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
    with reading(path), laspy.open(path) as reader:
        header = reader.header
        info = _info(path, n_bytes, header)
        point_start = int(header.offset_to_point_data)
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
    trajectories: Pair[Path | None] | None = None,
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
    trajectories : Pair of Path or None, optional
        Where the sensor was (see `read_trajectory`), in the CRS of the survey; either may be left out.

    Returns
    -------
    Pair of Survey
        Local metres from a common origin; their `LasFile` as ``source`` hands out every dimension.
    """
    infos = Pair(inspect(before_path), inspect(after_path))
    crs = common_crs(
        infos.map(lambda info: info.crs), infos.map(_short_name), epsg=epsg, assume_same_crs=assume_same_crs
    )
    _check_headers(infos, crs)
    paths = trajectories or Pair(None, None)
    ways = infos.join(paths, lambda info, path: None if path is None else _trajectory_for(info, path))
    check_memory(_memory_needed(infos, crs, leaf_m), max_memory)
    files = infos.map(lambda info: LasFile(Path(info.path), info.n_points))
    frame = common_frame(infos.map(lambda info: np.array(info.low if info.has_bounds else (0.0, 0.0, 0.0))), crs)
    found = at_once(lambda file, way: _look_through(file, frame, way), files, ways)
    true_frame = common_frame(found.map(lambda each: each.low), crs)
    if true_frame != frame:  # a header's bounds are wrong
        frame = true_frame
        found = at_once(lambda file, way: _look_through(file, frame, way), files, ways)
    check_coverage(infos.map(_short_name), found.map(lambda each: each.extent))

    def survey(file: LasFile, seen: _Found, notes: list[str], way: MapTrajectory | None) -> Survey:
        return Survey(
            file,
            frame,
            str(file.path),
            [*notes, *seen.notes],
            seen.dates,
            file.n_bytes,
            seen.sha256,
            seen.extent,
            None if way is None else way.local(frame),
        )

    return Pair(*(survey(*each) for each in zip(files, found, crs.notes, ways, strict=True)))


def common_frame(low: Pair[FloatArray], crs: MapCrs) -> LocalFrame:
    """The local frame of two clouds whose lowest full map coordinates are ``low``, (3,) each."""
    frame = LocalFrame.about(np.minimum(low.before, low.after))
    return replace(frame, unit_xy_m=crs.unit_xy_m, unit_z_m=crs.unit_z_m, crs_wkt=crs.wkt)


def check_coverage(names: Pair[str], extents: Pair[Extent]) -> None:
    """`InputError` where two clouds spread absurdly for their number of points, or hardly overlap."""
    for name, extent in zip(names, extents, strict=True):
        _check_extent(name, extent.n, extent.size_m)
    share = extents.before.overlap(extents.after)
    if share < MIN_OVERLAP:
        raise _no_overlap(names, f"they share {100 * share:.0f} % of the smaller one's area in plan")


@dataclass(frozen=True)
class _Found:
    """What a first look at all points of a file finds.

    ``low`` are the lowest full map coordinates (3,), ``dates`` the first and last day of measurement, ``notes`` what is
    to be said about the trajectory.
    """

    extent: Extent
    low: FloatArray
    dates: tuple[str | None, str | None]
    sha256: str
    notes: list[str]


def _look_through(file: LasFile, frame: LocalFrame, way: MapTrajectory | None) -> _Found:
    """Decompress everything once: damage shows here, and not after long work."""
    low, times = np.full(3, np.inf), [np.inf, -np.inf]
    is_dated = _has_absolute_time(file.header)
    check = None if way is None else TrajectoryCheck(way.local(frame), file.path.name)

    def local_parts() -> Iterator[FloatArray]:
        for record in file.records():
            xyz = file.map_coordinates(record)
            for axis in range(3):
                low[axis] = min(low[axis], xyz[:, axis].min())
            if is_dated:
                gps_time = np.asarray(record["gps_time"])
                times[:] = min(times[0], float(gps_time.min())), max(times[1], float(gps_time.max()))
            local = frame.to_local(xyz)
            if check is not None:
                check.add(local, np.asarray(record["gps_time"], dtype=np.float64))
            yield local

    extent = Extent.of(local_parts())
    notes = [] if check is None else [check.note()]
    return _Found(extent, low, (gps_day(times[0]), gps_day(times[1])), file.sha256(), notes)


def _trajectory_for(info: SurveyInfo, path: Path) -> MapTrajectory:
    """The trajectory of a survey; `InputError` where its points do not say when they were measured."""
    if "gps_time" not in info.dimensions:
        raise InputError(
            f"{info.path}: its points have no GPS time (point format {info.point_format}), which a trajectory needs.",
            "Leave the trajectory out, or give the survey with GPS times (point format 1, 3 or 6 and above).",
            "trajectory-times",
        )
    return read_trajectory(path)


def _has_absolute_time(header: Any) -> bool:
    """Whether GPS times say the day; otherwise they are seconds of an unknown week."""
    has_time = "gps_time" in set(header.point_format.standard_dimension_names)
    return has_time and bool(header.global_encoding.gps_time_type.value)


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
        raise unreadable(path, error) from error
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
            raise broken(path, f"the header promises {info.n_points} points, the file holds {held}")
        return
    with path.open("rb") as file:
        file.seek(point_start)
        table = file.read(8)
    table_start = struct.unpack("<q", table)[0] if len(table) == 8 else info.n_bytes
    if table_start >= info.n_bytes:
        raise broken(path, "its table of compressed chunks is missing")


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


def _no_overlap(names: Pair[str], found: str) -> InputError:
    return InputError(
        f"{names.before} and {names.after} do not overlap enough: {found}; {100 * MIN_OVERLAP:.0f} % are needed.",
        "Check that both surveys are of the same place and in the same CRS.",
        "no-overlap",
    )
