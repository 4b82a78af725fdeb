"""``loda-pdal info``: what the headers of one or two surveys say, and whether they can be compared."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from loda_pdal.cli import options, verbosity
from loda_pdal.model.errors import LodaError

if TYPE_CHECKING:
    from loda_pdal.io.las import SurveyInfo


@click.command(short_help="Say what one or two surveys are.")
@click.argument("before", type=click.Path(path_type=Path))
@click.argument("after", type=click.Path(path_type=Path), required=False)
@options.epsg
@options.assume_same_crs
@options.as_json
@verbosity.options
def info(before: Path, after: Path | None, epsg: int | None, assume_same_crs: bool, as_json: bool) -> None:
    """Points, CRS, extent and density of one survey, or of two and how far they overlap. Reads headers only."""
    from loda_pdal.io.las import inspect
    from loda_pdal.io.plain import to_json

    infos = [inspect(path) for path in (before, after) if path is not None]
    values: dict[str, Any] = {"surveys": [found.to_dict() for found in infos]}
    if len(infos) == 2:
        values["pair"] = _pair(infos[0], infos[1], epsg, assume_same_crs)
    click.echo(to_json(values).rstrip() if as_json else _readable(values))


def _pair(before: SurveyInfo, after: SurveyInfo, epsg: int | None, assume_same_crs: bool) -> dict[str, Any]:
    """Overlap of the bounds, and what would keep `detect` from starting."""
    from loda_pdal.io.crs import common_crs
    from loda_pdal.io.las import overlap
    from loda_pdal.model.pair import Pair

    pair = Pair(before, after)
    names = pair.map(lambda found: Path(found.path).name)
    values: dict[str, Any] = {"overlap_of_bounds": overlap(before, after), "problem": None, "remedy": None}
    try:
        common_crs(pair.map(lambda found: found.crs), names, epsg=epsg, assume_same_crs=assume_same_crs)
    except LodaError as error:
        values |= {"problem": error.message, "remedy": error.remedy}
    return values


def _readable(values: dict[str, Any]) -> str:
    lines = []
    for found in values["surveys"]:
        kind = "COPC" if found["copc"] else "LAZ" if found["compressed"] else "LAS"
        size, density = found["size_m"], found["density_per_m2"]
        unit = found["unit_xy_m"]
        crs = found["crs"] or found["crs_problem"] or "none"
        lines += [
            found["path"],
            f"  points    {found['points']:,} ({kind} {found['las_version']}, point format {found['point_format']})",
            f"  CRS       {crs}" + (f" (EPSG:{found['epsg']})" if found["epsg"] else ""),
            f"  vertical  {found['vertical_crs'] or 'not named'}",
            f"  extent    x {_span(found, 0)}, y {_span(found, 1)}, z {_span(found, 2)}",
        ]
        if unit not in (None, 1.0):
            lines.append(f"  unit      {unit:.6g} m")
        if size is not None:
            lines.append(f"  size      {size[0]:.1f} x {size[1]:.1f} x {size[2]:.1f} m")
        if density is not None:
            lines.append(f"  density   {density:.1f} points per m2 of its bounds")
        if found["extra_dimensions"]:
            lines.append(f"  extra     {', '.join(found['extra_dimensions'])}")
    if "pair" in values:
        pair = values["pair"]
        lines.append(f"Bounds overlap by {pair['overlap_of_bounds']:.0%} of the smaller one.")
        if pair["problem"]:
            lines.append(f"Cannot be compared yet: {pair['problem']} {pair['remedy']}")
    return "\n".join(lines)


def _span(found: dict[str, Any], axis: int) -> str:
    return f"{found['min'][axis]:.2f} to {found['max'][axis]:.2f}"
