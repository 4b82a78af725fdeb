"""Coordinate reference systems: what a file declares, in which units, and whether two surveys agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pyproj import CRS
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError

from loda_pdal.model.errors import InputError
from loda_pdal.model.pair import Pair

_GEOKEY_MODEL_TYPE, _GEOKEY_PROJECTED, _GEOKEY_VERTICAL, _GEOKEY_VERTICAL_UNIT = 1024, 3072, 4096, 4099
_MODEL_TYPE_PROJECTED = 1
_UNIT_M = {9001: 1.0, 9002: 0.3048, 9003: 1200.0 / 3937.0}
_REPROJECT = "Reproject one of them first, for example with `pdal translate ... reprojection`."


@dataclass(frozen=True)
class DeclaredCrs:
    """What one file says about its coordinates.

    Attributes
    ----------
    crs : CRS or None
        Horizontal, or compound with the vertical one; None where the file names none.
    vertical_unit_m : float or None
        Metres per vertical unit where a GeoTIFF key states it without naming a vertical datum.
    problem : str
        Why a CRS record that is there could not be used; empty otherwise.
    """

    crs: CRS | None = None
    vertical_unit_m: float | None = None
    problem: str = ""

    @property
    def name(self) -> str | None:
        """Name as in the file, e.g. ``NAD83 / UTM zone 17N + CGVD28 height``."""
        return None if self.crs is None else str(self.crs.name)

    @property
    def wkt(self) -> str | None:
        """Well-known text (WKT2), None where there is no CRS."""
        return None if self.crs is None else str(self.crs.to_wkt())

    @property
    def epsg(self) -> int | None:
        """EPSG code where the CRS has one."""
        return None if self.crs is None else self.crs.to_epsg()

    @property
    def horizontal(self) -> CRS | None:
        """The part in plan."""
        if self.crs is None:
            return None
        plain = self.crs.source_crs if self.crs.is_bound and self.crs.source_crs is not None else self.crs
        return plain.sub_crs_list[0] if plain.is_compound else plain

    @property
    def vertical(self) -> CRS | None:
        """The part in height, None where no vertical datum is named."""
        if self.crs is None or not self.crs.is_compound:
            return None
        return self.crs.sub_crs_list[1]

    @property
    def is_geographic(self) -> bool:
        """Whether the coordinates are degrees (or earth-centred), in which nothing can be measured in plan."""
        return self.horizontal is not None and (self.horizontal.is_geographic or self.horizontal.is_geocentric)

    @property
    def unit_xy_m(self) -> float | None:
        """Metres per horizontal unit, None where unknown or degrees."""
        if self.horizontal is None or self.is_geographic or not self.horizontal.axis_info:
            return None
        return float(self.horizontal.axis_info[0].unit_conversion_factor)

    @property
    def unit_z_m(self) -> float | None:
        """Metres per vertical unit, None where the file does not say."""
        if self.vertical is not None and self.vertical.axis_info:
            return float(self.vertical.axis_info[0].unit_conversion_factor)
        if self.horizontal is not None and len(self.horizontal.axis_info) == 3:
            return float(self.horizontal.axis_info[2].unit_conversion_factor)
        return self.vertical_unit_m


@dataclass(frozen=True)
class MapCrs:
    """The CRS and units that both surveys of a run share.

    Attributes
    ----------
    wkt : str or None
        Of the after epoch; None where both files name none and that was accepted.
    unit_xy_m, unit_z_m : float
        Metres per horizontal and per vertical map unit.
    notes : Pair of list of str
        What was assumed or converted, per epoch.
    """

    wkt: str | None
    unit_xy_m: float
    unit_z_m: float
    notes: Pair[list[str]]


def declared_crs(header: Any) -> DeclaredCrs:
    """The CRS of an opened LAS file (a laspy header): its WKT record, else its GeoTIFF keys."""
    try:
        crs = header.parse_crs()
    except CRSError as error:
        return DeclaredCrs(problem=f"the CRS record cannot be parsed ({str(error).splitlines()[0][:120]})")
    keys = {key.id: key.value_offset for vlr in header.vlrs.get("GeoKeyDirectoryVlr") for key in vlr.geo_keys}
    is_from_keys = not any(v.string.strip("\0 ") for v in _wkt_records(header))
    if crs is not None and crs.is_geographic and is_from_keys and _is_unnamed_projection(keys):
        return DeclaredCrs(problem="its GeoTIFF keys describe a projection without an EPSG code")
    if crs is not None and not crs.is_compound and len(crs.axis_info) < 3:
        crs = _with_vertical(crs, keys.get(_GEOKEY_VERTICAL))
    return DeclaredCrs(crs, vertical_unit_m=_UNIT_M.get(keys.get(_GEOKEY_VERTICAL_UNIT, 0)))


def _wkt_records(header: Any) -> list[Any]:
    records = list(header.vlrs.get("WktCoordinateSystemVlr"))
    return records + (list(header.evlrs.get("WktCoordinateSystemVlr")) if header.evlrs else [])


def _is_unnamed_projection(keys: dict[int, int]) -> bool:
    projected = keys.get(_GEOKEY_PROJECTED, 0)
    return keys.get(_GEOKEY_MODEL_TYPE) == _MODEL_TYPE_PROJECTED and not 1024 <= projected <= 32766


def _with_vertical(crs: CRS, code: int | None) -> CRS:
    """``crs`` with the vertical CRS of an EPSG ``code``; as it is where the code names no vertical CRS."""
    try:
        vertical = CRS.from_epsg(code) if code else None
    except CRSError:
        return crs
    if vertical is None or not vertical.is_vertical:
        return crs
    return CompoundCRS(f"{crs.name} + {vertical.name}", [crs, vertical])


def common_crs(
    declared: Pair[DeclaredCrs], names: Pair[str], *, epsg: int | None = None, assume_same_crs: bool = False
) -> MapCrs:
    """The CRS both surveys are in, or an `InputError` that says what to do.

    Parameters
    ----------
    declared : Pair of DeclaredCrs
        From `declared_crs`.
    names : Pair of str
        What to call the two files in messages.
    epsg : int, optional
        The CRS of both surveys, whatever their headers say.
    assume_same_crs : bool
        Take both surveys to be in the after epoch's CRS although the headers differ or say nothing.
    """
    notes: Pair[list[str]] = Pair([], [])
    if epsg is not None:
        chosen = _from_epsg(epsg)
        for found, note in ((declared.before, notes.before), (declared.after, notes.after)):
            if found.crs is not None and not _is_same(found.crs, chosen.crs):
                note.append(f"The header names {found.name}; EPSG:{epsg} was used instead, as asked.")
        declared = Pair(chosen, chosen)
    elif declared.before.crs is None or declared.after.crs is None:
        declared = _fill_missing(declared, names, notes, assume_same_crs)
    for found, name in ((declared.before, names.before), (declared.after, names.after)):
        _check_measurable(found, name)
    _check_same(declared, names, notes, assume_same_crs)
    unit_xy_m = declared.after.unit_xy_m or 1.0
    unit_z_m = declared.after.unit_z_m or declared.before.unit_z_m or unit_xy_m
    _note_units(declared, unit_xy_m, unit_z_m, notes)
    return MapCrs(declared.after.wkt, unit_xy_m, unit_z_m, notes)


def _from_epsg(epsg: int) -> DeclaredCrs:
    try:
        crs = CRS.from_epsg(epsg)
    except CRSError:
        raise InputError(
            f"EPSG:{epsg} is not a known coordinate reference system.",
            "Give --epsg a projected CRS such as 32617, or one with heights such as 7415.",
            "crs-unknown",
        ) from None
    if crs.is_geographic or crs.is_geocentric or (crs.is_vertical and not crs.is_compound):
        raise InputError(
            f"EPSG:{epsg} ({crs.name}) is not a projected CRS.",
            "Give --epsg a projected CRS such as 32617, or one with heights such as 7415.",
            "crs-unknown",
        )
    return DeclaredCrs(crs)


def _fill_missing(
    declared: Pair[DeclaredCrs], names: Pair[str], notes: Pair[list[str]], assume_same_crs: bool
) -> Pair[DeclaredCrs]:
    """Both epochs with a CRS where one of them names none, if that was allowed."""
    known = declared.after if declared.after.crs is not None else declared.before
    if not assume_same_crs:
        problems = [
            f"{name}: {found.problem or 'no CRS in the header'}"
            for found, name in ((declared.before, names.before), (declared.after, names.after))
            if found.crs is None
        ]
        remedy = (
            "Give --epsg N with the CRS both surveys are in (with --assume-same-crs, metres without a CRS are taken)."
            if known.crs is None
            else f"The other file is in {known.name}: give --assume-same-crs if both are, or --epsg N."
        )
        raise InputError("; ".join(problems) + ".", remedy, "crs-missing")
    text = (
        "No CRS in either header; coordinates were taken as metres in one common system."
        if known.crs is None
        else f"No CRS in the header; {known.name} of the other survey was assumed."
    )
    for found, note in ((declared.before, notes.before), (declared.after, notes.after)):
        if found.crs is None:
            note.append(text)
    return declared.map(lambda found: known if found.crs is None else found)


def _check_measurable(found: DeclaredCrs, name: str) -> None:
    if found.is_geographic:
        raise InputError(
            f"{name}: coordinates are degrees or earth-centred ({found.name}), in which nothing can be measured.",
            "Reproject both surveys to a projected CRS, for example with `pdal translate ... reprojection`; "
            "if only the header is wrong, give --epsg N.",
            "crs-geographic",
        )


def _check_same(declared: Pair[DeclaredCrs], names: Pair[str], notes: Pair[list[str]], assume_same_crs: bool) -> None:
    """`InputError` where the two CRS differ in unit, plan or height, less what was assumed equal."""
    before, after = declared.before, declared.after
    for axis, b, a in (
        ("horizontal", before.unit_xy_m, after.unit_xy_m),
        ("vertical", before.unit_z_m, after.unit_z_m),
    ):
        if b is not None and a is not None and abs(b / a - 1.0) > 1e-9:
            raise InputError(
                f"The {axis} units differ: {b:.6g} m in {names.before}, {a:.6g} m in {names.after}.",
                _REPROJECT,
                "crs-units-differ",
            )
    if not _is_same(before.horizontal, after.horizontal):
        text = f"{names.before} is in {_title(before.horizontal)}, {names.after} in {_title(after.horizontal)}"
        _accept(text, "crs-differs", notes.before, after.name, assume_same_crs)
    if before.vertical is not None and after.vertical is not None and not _is_same(before.vertical, after.vertical):
        text = f"Heights of {names.before} refer to {before.vertical.name}, of {names.after} to {after.vertical.name}"
        _accept(text, "crs-vertical-differs", notes.before, after.vertical.name, assume_same_crs)
    elif before.vertical is not None and after.vertical is None:
        notes.after.append(f"No vertical datum in the header; {before.vertical.name} of the before survey was assumed.")
    elif after.vertical is not None and before.vertical is None:
        notes.before.append(f"No vertical datum in the header; {after.vertical.name} of the after survey was assumed.")


def _accept(text: str, code: str, note: list[str], assumed: str | None, assume_same_crs: bool) -> None:
    if not assume_same_crs:
        raise InputError(
            f"{text}.",
            "Give --assume-same-crs if the coordinates are in one system all the same (registration takes up what "
            f"remains), or --epsg N. {_REPROJECT}",
            code,
        )
    note.append(f"{text}; {assumed} was assumed for both, as asked.")


def _is_same(a: CRS | None, b: CRS | None) -> bool:
    if a is None or b is None:
        return a is b
    return bool(a.equals(b, ignore_axis_order=True)) or (a.to_epsg() is not None and a.to_epsg() == b.to_epsg())


def _title(crs: CRS | None) -> str:
    if crs is None:
        return "an unnamed system"
    code = crs.to_epsg()
    return str(crs.name) if code is None else f"{crs.name} (EPSG:{code})"


def _note_units(declared: Pair[DeclaredCrs], unit_xy_m: float, unit_z_m: float, notes: Pair[list[str]]) -> None:
    if unit_xy_m == 1.0 and unit_z_m == 1.0:
        return
    for found, note in ((declared.before, notes.before), (declared.after, notes.after)):
        note.append(
            f"Map units are {unit_xy_m:.6g} m in plan and {unit_z_m:.6g} m in height; results are in metres, "
            "positions in map units."
        )
        if found.unit_z_m is None:
            note.append(
                "The header does not state the unit of heights; that of the plan, or of the other survey, was taken."
            )
