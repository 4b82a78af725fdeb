"""``report.html``: what changed, as one self-contained page that prints well and needs nothing but a browser.

`write_report` makes it from the result of a run, `loda_pdal.io.report_folder` from the files that a run left in its
folder; both fill one `ReportData`. All text is escaped: file names and reasons come from outside.
"""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

from loda_pdal.io.colours import LABEL_COLOURS
from loda_pdal.io.report_pictures import Scene, Shape, ground_pictures, map_svg, object_pictures
from loda_pdal.io.reviews import Review
from loda_pdal.io.summary import is_changed, summarise
from loda_pdal.kernels.parallel import run_ranges
from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.labels import OBJECT_CLASSES, ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import ChangeResult, GroundChangeRecord, ObjectRecord, UIntArray
from loda_pdal.model.survey import Survey
from loda_pdal.params import Parameters

T = TypeVar("T")

MAX_PICTURED = 150
"""Changed objects shown with pictures, at 50 to 100 kB each; the table lists more."""
MAX_PICTURED_GROUND = 30
"""Pieces of changed ground shown with pictures; the map has all."""
MAX_LISTED = 3000
"""Changes listed in the table; changes.gpkg holds all."""
MAX_OUTLINES = 4000
"""Outlines drawn on the map, unchanged objects first to go."""

LABELS = tuple(LABEL_COLOURS)
MEANINGS = {
    ChangeLabel.ADDED: "only in the later survey",
    ChangeLabel.REMOVED: "only in the earlier survey",
    ChangeLabel.INCREASED: "grew or rose",
    ChangeLabel.DECREASED: "shrank or sank",
    ChangeLabel.UNDETERMINED: "one survey could not see it, or hardly",
    ChangeLabel.UNCHANGED: "the same within the limit of detection",
}
CLASS_WORDS = {ObjectClass.MOBILE: "mobile object", ObjectClass.OTHER: "other object"}
DASH = "–"
TOLD_ELSEWHERE = ("format", "summary", "parameters", "warnings", "registration", "crs")
"""Parts of run.json that the page shows in other places."""
HOW_TO_READ = (
    '<p class="soft">Upper pictures: from above, north is up, the dashed outline is the change. Lower pictures: from '
    "the side, along the line from A to B; dashed lines mark the top before (grey) and after. Surroundings are grey. "
    "The two pictures of a row show the same place at the same scale. Changes of height and volume are measured where "
    "both surveys could see, so they can differ from the difference of the totals.</p>"
)


@dataclass(frozen=True)
class ReportData:
    """All that the page shows.

    Attributes
    ----------
    figures : dict
        As `loda_pdal.io.summary.summarise` gives them.
    objects, ground_changes : list
        Records with footprints in local metres.
    clouds : Pair of (n, 3) float64, m
        Points of both epochs in the after frame, local metres.
    object_of_point : Pair of (n,) uint32
        Object of each of those points; 0 none.
    frame : LocalFrame
        Where local metres are on the map.
    parameters : Parameters
        As resolved for the run.
    run : dict
        What run.json holds: versions, time per stage, checksums; nested plain values.
    reviews : dict of int to str
        What a reviewer noted, by object_id.
    """

    figures: dict[str, Any]
    objects: list[ObjectRecord]
    ground_changes: list[GroundChangeRecord]
    clouds: Pair[FloatArray]
    object_of_point: Pair[UIntArray]
    frame: LocalFrame
    parameters: Parameters
    run: dict[str, Any]
    reviews: dict[int, str] = field(default_factory=dict)


def write_report(
    path: Path,
    result: ChangeResult,
    surveys: Pair[Survey],
    run: dict[str, Any],
    reviews: Mapping[int, Review] | None = None,
) -> None:
    """Write the report of a run.

    Parameters
    ----------
    path : Path
        Where the page goes.
    result : ChangeResult
        What was found.
    surveys : Pair of Survey
        What it was found in.
    run : dict
        What run.json holds (`loda_pdal.io.run_json.run_document`); shown in the folded part.
    reviews : mapping of int to Review, optional
        What a reviewer noted, by object_id.
    """
    data = ReportData(
        summarise(result, surveys),
        result.objects,
        result.ground_changes,
        result.clouds,
        result.object_of_voxel,
        surveys.after.frame,
        result.parameters,
        run,
        {number: review.sentence for number, review in (reviews or {}).items()},
    )
    path.write_text(render(data), encoding="utf-8")


def render(data: ReportData) -> str:
    """The page as HTML text."""
    scene = Scene.of(data.clouds, data.object_of_point, data.parameters.fuse.leaf_m)
    changes = ranked(data.objects)
    pictured = changes[:MAX_PICTURED]
    ground = sorted(data.ground_changes, key=lambda r: (-abs(r.volume_m3), r.ground_change_id))[:MAX_PICTURED_GROUND]
    assets = files("loda_pdal.io") / "report_assets"
    title = _title(data.figures)
    body = "".join(
        (
            _head(title, data.figures),
            "<main>",
            _tiles(data.objects),
            _warnings(data.figures["warnings"]),
            _map(scene, data, {r.object_id for r in pictured}, {r.ground_change_id for r in ground}),
            '<div class="columns">',
            _counts(data.figures["counts"]),
            _surveys(data.figures["epochs"], data.frame),
            "</div>",
            _detection(data.figures),
            _table(changes, data, {r.object_id for r in pictured}),
            _cards(pictured, len(changes), scene, data),
            _ground(ground, len(data.ground_changes), scene, data.frame),
            _settings(data.parameters, data.run),
            "</main>",
            "<footer>Made by loda-pdal. This page is complete in itself: it loads nothing from elsewhere.</footer>",
        )
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_text(title)}</title>\n<style>\n{assets.joinpath('style.css').read_text('utf-8')}</style></head>\n"
        f"<body>{body}\n<script>\n{assets.joinpath('script.js').read_text('utf-8')}</script></body></html>\n"
    )


def ranked(objects: list[ObjectRecord]) -> list[ObjectRecord]:
    """Changed objects, the certain and large first, the Undetermined last; ties by number."""

    def weight(record: ObjectRecord) -> float:
        size = abs(record.dv_m3) if record.dv_m3 is not None else 0.0
        size = max(size, 0.25 * record.footprint.area)
        certainty = record.confidence if record.confidence is not None else 0.5
        return -certainty * math.log1p(size)

    changes = [r for r in objects if r.label is not ChangeLabel.UNCHANGED]
    return sorted(changes, key=lambda r: (not is_changed(r), weight(r), r.object_id))


def _text(value: object) -> str:
    return html.escape(str(value))


def _sentence(reason: str) -> str:
    """A reason as a sentence of its own."""
    return _text(reason[:1].upper() + reason[1:] + ("" if reason.endswith((".", "!", "?")) or not reason else "."))


def _fixed(value: float | None, digits: int = 2, unit: str = "", sign: bool = False) -> str:
    """A number for reading, with a real minus sign and a thin space before its unit; a dash where unknown."""
    if value is None or not math.isfinite(value):
        return DASH
    text = f"{value:{'+' if sign else ''},.{digits}f}".replace("-", "−").replace(",", " ")
    return f"{text} {unit}" if unit else text


def _volume(value: float | None, sign: bool = False) -> str:
    return _fixed(value, 1 if value is not None and abs(value) < 100 else 0, "m³", sign)


def _share(value: float | None) -> str:
    return DASH if value is None or not math.isfinite(value) else f"{value:.0%}".replace("%", " %")


def _class(kind: ObjectClass) -> str:
    return CLASS_WORDS.get(kind, kind.title)


def _chip(label: ChangeLabel, text: str = "") -> str:
    """A colour with its label, or with another word for it."""
    return f'<span class="chip"><i class="swatch" style="--c:{LABEL_COLOURS[label]}"></i>{text or label.title}</span>'


def _day(text: str) -> str:
    day = date.fromisoformat(text)
    return f"{day.day} {day:%B %Y}"


def _dates(epoch: dict[str, Any]) -> str | None:
    first, last = epoch["first_date"], epoch["last_date"]
    if first is None or last is None:
        return None
    return _day(first) if first == last else f"{_day(first)} to {_day(last)}"


def _title(figures: dict[str, Any]) -> str:
    before, after = figures["epochs"]["before"], figures["epochs"]["after"]
    if before["last_date"] and after["first_date"]:
        first, last = date.fromisoformat(before["first_date"]), date.fromisoformat(after["last_date"])
        return f"What changed between {first:%B %Y} and {last:%B %Y}"
    return "What changed between the two surveys"


def _head(title: str, figures: dict[str, Any]) -> str:
    n, changed, unknown = figures["objects"], figures["changed"], figures["undetermined"]
    area = figures["area_m2"]
    where = f" on {_fixed(area / 1e4, 2)} hectares" if area else ""
    pieces = sum(row["pieces"] for row in figures["ground_changes"].values())
    ground = f" The ground itself changed in {pieces} place{'s' * (pieces != 1)}." if pieces else ""
    if not n:
        sentence = f"No object was found{where}."
    elif not changed:
        sentence = f"None of {n} object{'s' * (n != 1)}{where} changed."
    else:
        sentence = f"{changed} of {n} object{'s' * (n != 1)}{where} changed."
    judged = f" {unknown} could not be judged from both surveys." if unknown else ""
    names = (figures["epochs"][epoch]["file"] for epoch in ("before", "after"))
    before, after = (_text(name) for name in names)
    return (
        f'<header class="page"><h1>{_text(title)}</h1><p class="soft">{before} compared with {after}</p>'
        f'<p class="lead">{sentence}{judged}{ground}</p></header>'
    )


def _tiles(objects: list[ObjectRecord]) -> str:
    tiles = []
    for label in LABELS:
        n = sum(r.label is label for r in objects)
        tiles.append(
            f'<div class="tile" style="--c:{LABEL_COLOURS[label]}"><b>{n}</b><span>{label.title}</span>'
            f"<small>{MEANINGS[label]}</small></div>"
        )
    return f'<div class="tiles">{"".join(tiles)}</div>'


def _warnings(warnings: Sequence[str]) -> str:
    if not warnings:
        return ""
    items = "".join(f"<li>{_text(warning)}</li>" for warning in warnings)
    return f'<section class="note"><h2>Read this first</h2><ul>{items}</ul></section>'


def _map(scene: Scene, data: ReportData, carded: set[int], ground_carded: set[int]) -> str:
    shapes = []
    for record in sorted(data.objects, key=lambda r: r.label is ChangeLabel.UNCHANGED)[:MAX_OUTLINES]:
        words = f"{record.label.title}: {_class(record.object_class)} {record.object_id}. {record.reason}"
        target = f"c{record.object_id}" if record.object_id in carded else ""
        shapes.append(Shape(record.footprint, record.label, words, target))
    for piece in data.ground_changes:
        words = f"Ground {piece.label.title.lower()} by {_fixed(piece.dz_m, 2, 'm', sign=True)}. {piece.reason}"
        target = f"g{piece.ground_change_id}" if piece.ground_change_id in ground_carded else ""
        shapes.append(Shape(piece.footprint, piece.label, words, target, is_ground=True))
    boxes = "".join(
        f'<label><input type="checkbox" value="{label.title}"{"" if label is ChangeLabel.UNCHANGED else " checked"}>'
        f'<i class="swatch" style="--c:{LABEL_COLOURS[label]}"></i>{label.title}</label>'
        for label in LABELS
        if any(shape.label is label for shape in shapes)
    )
    ground = (
        f'<span class="chip" style="font-weight:400"><i class="swatch ground" style="--c:{LABEL_COLOURS[label]}"></i>'
        f"Ground {word}</span>"
        for label, word in ((ChangeLabel.INCREASED, "raised"), (ChangeLabel.DECREASED, "lowered"))
        if any(piece.label is label for piece in data.ground_changes)
    )
    return (
        '<h2>Where</h2><figure class="map">'
        + map_svg(scene, [shape for shape in shapes if not shape.footprint.is_empty])
        + f'<div class="legend">{boxes}{"".join(ground)}</div></figure>'
        '<p class="soft">Hover over an outline for its reason, click it for its pictures. '
        "The background is the surface of the later survey, seen from above.</p>"
    )


def _counts(counts: dict[str, dict[str, int]]) -> str:
    def cell(n: int) -> str:
        return f'<td class="n{"" if n else " zero"}">{n}</td>'

    kinds = [kind for kind in OBJECT_CLASSES if any(row[kind.title] for row in counts.values())]
    rows = "".join(
        f"<tr><td>{_chip(label)}</td>"
        + "".join(cell(counts[label.title][kind.title]) for kind in kinds)
        + cell(sum(counts[label.title].values()))
        + "</tr>"
        for label in LABELS
    )
    total = "".join(cell(sum(row[kind.title] for row in counts.values())) for kind in kinds)
    everything = cell(sum(sum(row.values()) for row in counts.values()))
    heads = "".join(f'<th class="n">{_class(kind).capitalize()}</th>' for kind in kinds)
    return (
        '<div><h2>How many</h2><table class="small"><thead>'
        f'<tr><th>Change</th>{heads}<th class="n">All</th></tr></thead><tbody>'
        f'{rows}<tr class="total"><td>All</td>{total}{everything}</tr></tbody></table></div>'
    )


def _surveys(epochs: dict[str, Any], frame: LocalFrame) -> str:
    before, after = epochs["before"], epochs["after"]
    rows = [
        ("File", before["file"], after["file"]),
        ("Measured", _dates(before) or "date not in the file", _dates(after) or "date not in the file"),
        ("Points", _fixed(before["points"], 0), _fixed(after["points"], 0)),
    ]
    body = "".join(f"<tr><td>{a}</td><td>{_text(b)}</td><td>{_text(c)}</td></tr>" for a, b, c in rows)
    body += f'<tr><td>Coordinates</td><td colspan="2">{_text(_crs_name(frame))}</td></tr>'
    if before["notes"] or after["notes"]:
        notes = ("<br>".join(_text(note) for note in epoch["notes"]) for epoch in (before, after))
        body += "<tr><td>Notes</td>" + "".join(f"<td>{note}</td>" for note in notes) + "</tr>"
    return (
        '<div><h2>What was compared</h2><table class="small"><thead><tr><th></th><th>Before</th><th>After</th></tr>'
        f"</thead><tbody>{body}</tbody></table></div>"
    )


def _crs_name(frame: LocalFrame) -> str:
    if not frame.crs_wkt:
        return "no reference system given"
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        crs = CRS.from_wkt(frame.crs_wkt)
    except CRSError:
        return "unreadable reference system"
    authority = crs.to_authority()
    return f"{crs.name} ({':'.join(authority)})" if authority else crs.name


def _detection(figures: dict[str, Any]) -> str:
    lod, fit = figures["lod95"], figures["registration"]
    shift = None if None in fit["shift_m"] else math.hypot(*fit["shift_m"])
    limit = (
        f"Here it is {_fixed(lod['median_m'], 2, 'm')} in the middle and {_fixed(lod['p90_m'], 2, 'm')} in the "
        f"coarsest tenth; {_share(lod['valid_share'])} of the occupied space was measured densely enough by both "
        "surveys to state it."
        if lod["median_m"] is not None
        else "Nowhere did both surveys measure densely enough to state it."
    )
    state = (
        "The surveys fit together" if fit["converged"] else "The surveys could not be fitted together with certainty"
    )
    return (
        "<h2>How small a change can be seen</h2><p>LoD95, the limit of detection, is the smallest shift of a surface "
        "that stands out from measurement noise and alignment error: on a surface that did not move, 95 of 100 "
        f"measured shifts stay below it, so nothing below it is called a change. {limit}</p>"
        f"<p>{state}: the earlier one was moved by {_fixed(shift, 2, 'm')} and turned by "
        f"{_fixed(fit['rotation_deg'], 3, '°')}; {_share(fit['overlap'])} of its points found their counterpart, with "
        f"{_fixed(fit['rmse_m'], 3, 'm')} left between them. The move itself is certain to "
        f"{_fixed(fit['sigma_position_m'], 3, 'm')} (one standard deviation).</p>"
    )


COLUMNS = (
    ("No.", True, ""),
    ("Change", False, ""),
    ("Class", False, ""),
    ("Confi&shy;dence", True, "Calibrated probability that the label is right"),
    ("Height, m", True, "Difference of the heights above ground, after minus before"),
    ("Volume, m³", True, "Difference of the occupied volume, after minus before"),
    ("Surface, m", True, "Median shift along the surface normal, after minus before"),
    ("LoD95, m", True, "Limit of detection at the object"),
    ("Area, m²", True, "Area of the outline"),
    ("Why", False, ""),
)


def _table(changes: list[ObjectRecord], data: ReportData, carded: set[int]) -> str:
    if not changes:
        return ""
    heads = "".join(
        f'<th scope="col"{" class=n" if is_number else ""}{f" title={chr(34)}{_text(hint)}{chr(34)}" if hint else ""}>'
        f"{name}</th>"
        for name, is_number, hint in COLUMNS
    )
    rows = "".join(_row(record, record.object_id in carded) for record in changes[:MAX_LISTED])
    rest = (
        f"The table lists the first {MAX_LISTED} of {len(changes)} changes; changes.gpkg holds them all."
        if len(changes) > MAX_LISTED
        else "Click a heading to sort."
    )
    return (
        f'<h2>All changes</h2><p class="soft">{rest} {DASH} means unknown, which is not zero.</p>'
        f'<div class="scroll"><table class="changes"><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


def _row(record: ObjectRecord, has_card: bool) -> str:
    name = f'<a href="#c{record.object_id}">{record.object_id}</a>' if has_card else str(record.object_id)
    numbers = (
        (record.confidence, _fixed(record.confidence, 2)),
        (record.dh_m, _fixed(record.dh_m, 2, sign=True)),
        (record.dv_m3, _fixed(record.dv_m3, 1, sign=True)),
        (record.d_perp_m, _fixed(record.d_perp_m, 2, sign=True)),
        (record.lod95_m, _fixed(record.lod95_m, 2)),
        (record.footprint.area, _fixed(record.footprint.area, 1)),
    )
    kind = _class(record.object_class)
    return (
        f'<tr data-label="{record.label.title}"><td class="n" data-v="{record.object_id}">{name}</td>'
        f'<td data-v="{record.label.title}">{_chip(record.label)}</td><td data-v="{kind}">{kind}</td>'
        + "".join(f'<td class="n" data-v="{_sort_key(value)}">{text}</td>' for value, text in numbers)
        + f'<td class="reason" data-v="{_text(record.reason)}">{_sentence(record.reason)}</td></tr>'
    )


def _sort_key(value: float | None) -> str:
    return "" if value is None or not math.isfinite(value) else f"{value:.6g}"


def _cards(pictured: list[ObjectRecord], n_changes: int, scene: Scene, data: ReportData) -> str:
    if not pictured:
        return ""
    some = (
        f'<p class="soft">The {len(pictured)} largest and most certain of {n_changes} changes are pictured; the '
        "others are in the table above and in changes.gpkg.</p>"
        if len(pictured) < n_changes
        else ""
    )
    return f"<h2>Change by change</h2>{some}{HOW_TO_READ}" + _drawn(lambda record: _card(record, scene, data), pictured)


def _drawn(card: Callable[[T], str], records: Sequence[T]) -> str:
    """The cards of all records in their order; pictures are drawn and packed on all threads."""
    cards = [""] * len(records)

    def fill(start: int, stop: int) -> None:
        cards[start:stop] = map(card, records[start:stop])

    run_ranges(fill, len(records), min_size=1)
    return "".join(cards)


def _card(record: ObjectRecord, scene: Scene, data: ReportData) -> str:
    pictures = object_pictures(scene, record.object_id, record.label, record.footprint)
    confidence = (
        f'<span class="bar"><i style="width:{100 * record.confidence:.0f}%"></i></span>{_share(record.confidence)}'
        if record.confidence is not None
        else DASH
    )
    facts = [
        ("Confidence", confidence),
        ("Height above ground", _change(record.height_before_m, record.height_after_m, _metres)),
        ("Height change", _fixed(record.dh_m, 2, "m", sign=True)),
        ("Volume", _change(record.volume_before_m3, record.volume_after_m3, _volume)),
        ("Volume change", _volume(record.dv_m3, sign=True)),
        ("Surface shift", _fixed(record.d_perp_m, 2, "m", sign=True)),
        ("LoD95", _fixed(record.lod95_m, 2, "m")),
        ("Centre moved by", _fixed(record.shift_m, 2, "m")),
        ("Overlap (3D IoU)", _fixed(record.iou_3d, 2)),
        ("Other survey could see", _share(record.observability)),
        ("Area of outline", _fixed(record.footprint.area, 1, "m²")),
        ("Points", _change(record.points_before, record.points_after, lambda n: _fixed(n, 0))),
        ("Position", _position(record.footprint, data.frame)),
        ("Review", _text(data.reviews.get(record.object_id, DASH))),
    ]
    part = f"<small>part of object {record.parent_id}</small>" if record.parent_id is not None else ""
    return (
        f'<article class="card" id="c{record.object_id}" data-label="{record.label.title}" '
        f'style="--c:{LABEL_COLOURS[record.label]}"><div><h3>{_chip(record.label)} {_class(record.object_class)} '
        f'{record.object_id} {part}</h3><p class="why">{_sentence(record.reason)}</p>{_facts(facts)}</div>'
        f"{pictures}</article>"
    )


def _metres(value: float | None) -> str:
    return _fixed(value, 2, "m")


def _change(before: float | None, after: float | None, show: Callable[[float | None], str]) -> str:
    """``before → after``; what only one survey has stands alone."""
    if before is None or after is None:
        return f"{show(before)} before" if after is None and before is not None else show(after)
    return f"{show(before)} → {show(after)}"


def _facts(facts: Iterable[tuple[str, str]]) -> str:
    return "<dl>" + "".join(f"<dt>{name}</dt><dd>{value}</dd>" for name, value in facts if value != DASH) + "</dl>"


def _position(footprint: Any, frame: LocalFrame) -> str:
    import numpy as np

    centre = footprint.representative_point()
    x, y, _ = frame.to_map(np.array([[centre.x, centre.y, 0.0]]))[0]
    return f"{x:.1f}, {y:.1f}"


def _ground(records: list[GroundChangeRecord], n_all: int, scene: Scene, frame: LocalFrame) -> str:
    if not records:
        return ""
    some = f'<p class="soft">The {len(records)} largest of {n_all} are shown.</p>' if len(records) < n_all else ""
    cards = _drawn(lambda record: _ground_card(record, scene, frame), records)
    return f"<h2>Changes of the ground</h2>{some}{HOW_TO_READ}{cards}"


def _ground_card(record: GroundChangeRecord, scene: Scene, frame: LocalFrame) -> str:
    word = "raised" if record.label is ChangeLabel.INCREASED else "lowered"
    facts = [
        ("Height change", _fixed(record.dz_m, 2, "m", sign=True)),
        ("LoD95", _fixed(record.lod95_m, 2, "m")),
        ("Area", _fixed(record.area_m2, 0, "m²")),
        ("Volume", _volume(record.volume_m3, sign=True)),
        ("Position", _position(record.footprint, frame)),
    ]
    return (
        f'<article class="card" id="g{record.ground_change_id}" data-label="{record.label.title}" '
        f'style="--c:{LABEL_COLOURS[record.label]}"><div><h3>{_chip(record.label, f"Ground {word}")} '
        f'<small>no. {record.ground_change_id}</small></h3><p class="why">{_sentence(record.reason)}</p>'
        f"{_facts(facts)}</div>{ground_pictures(scene, record.label, record.footprint)}</article>"
    )


def _settings(parameters: Parameters, run: dict[str, Any]) -> str:
    sections: list[str] = []
    stage = ""
    for entry in parameters.describe():
        if entry.stage != stage:
            stage = entry.stage
            sections.append(f"{'</table>' if sections else ''}<h3>{_text(entry.stage_doc)}</h3><table>")
        value = ", ".join(map(str, entry.value)) if isinstance(entry.value, list) else entry.value
        mark = "" if entry.value == entry.default else " <b>(set)</b>"
        sections.append(
            f"<tr><td><code>{entry.stage}.{entry.name}</code></td><td class=n>{_text(value)} {_text(entry.unit)}{mark}"
            f"</td><td>{_text(entry.doc)}{f' ({_text(entry.symbol)})' if entry.symbol else ''}</td></tr>"
        )
    told = {key: value for key, value in run.items() if key not in TOLD_ELSEWHERE}
    rows = "".join(f"<tr><td>{_text(key)}</td><td><code>{_text(value)}</code></td></tr>" for key, value in _flat(told))
    return (
        "<h2>Settings and versions</h2>"
        f"<details><summary>Parameters: preset {_text(parameters.name)}</summary>{''.join(sections)}</table></details>"
        f"<details><summary>This run</summary><table>{rows}</table></details>"
    )


def _flat(values: dict[str, Any], before: str = "") -> Iterable[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{key}: ")
        else:
            yield f"{before}{key}", value
