"""Contact sheets: the largest mistakes of a run, or its largest changes, one small picture of each.

    +---------------------------+
    | truth label -> predicted  |   left plan: what differs; orange stood before, blue stands after, grey both alike
    | plan, what   plan, what   |   right plan: the labels that the run gave, with the edges of its objects
    | differs      was said     |   section: along the longer axis, through the middle; colours as in the left plan
    | section                   |   a dark line goes around the thing in question
    | what it is, how large,    |
    | the reason of its object  |
    +---------------------------+

Text needs Pillow (``pip install 'loda-pdal[sheet]'``).
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_closing, binary_erosion

from loda_pdal.benchmark.protocols import ScoreReport
from loda_pdal.benchmark.runs import JudgedPoints, Points
from loda_pdal.benchmark.truth import Truth
from loda_pdal.io.colours import LABEL_COLOURS, rgb
from loda_pdal.io.pictures import PlanIndex, View, depth_buffer
from loda_pdal.io.report_pictures import main_axis, round_length
from loda_pdal.kernels.splat import NOTHING, shade
from loda_pdal.model.cloud import BoolArray, Float32Array, FloatArray
from loda_pdal.model.errors import InputError
from loda_pdal.model.labels import ChangeLabel

Picture = npt.NDArray[np.uint8]
"""Pixels (rows, columns, 3), red, green, blue."""
Index = npt.NDArray[np.intp]

PER_PAGE = 24
TILE_PX = 404
GAP_PX = 6
PLAN_PX, SECTION_PX = (150, (TILE_PX - 3 * GAP_PX) // 2), (112, TILE_PX - 2 * GAP_PX)
"""Rows and columns of the two kinds of pictures."""

ALIKE_M = 0.3
"""Surfaces whose heights differ by less look alike in plan."""

VOXEL_M = 0.5
"""Things are ranked by the voxels of this edge that hold points of them: their size, whatever the density."""

_WINDOW_M = (11.0, 90.0)
_MARGIN, _LEAST_MARGIN_M = 0.35, 3.0
_SLAB_M = 1.2
"""Half the thickness of a section, at most (more where points are sparse)."""

_GREY, _BEFORE, _AFTER = "#a6abb1", "#e0701a", "#1f78c8"
_INK, _PAPER, _LINE, _FAINT = (32, 37, 43), (255, 255, 255), (215, 217, 219), (104, 110, 118)
_SHADES = 64
_LINES = 6


@dataclass(frozen=True)
class Subject:
    """Something worth a picture.

    Attributes
    ----------
    points : (k,) int
        Index of its points.
    size : int
        Voxels of `VOXEL_M` that they occupy.
    labels : list of (str, ChangeLabel)
        What the header says, with the colour of each: truth and prediction, or the prediction alone.
    lines : list of str
        What stands below: what it is, where, why.
    """

    points: Index
    size: int
    labels: list[tuple[str, ChangeLabel]]
    lines: list[str] = field(default_factory=list)


class ObjectNote(NamedTuple):
    """What the GeoPackage says about an object."""

    label: str
    object_class: str
    reason: str


class Tile(NamedTuple):
    """A finished picture and the size it is ranked by."""

    size: int
    picture: Picture


# --- what to show -----------------------------------------------------------------------------------------------------


def mistakes(
    points: JudgedPoints, truth: Truth, report: ScoreReport, notes: dict[int, ObjectNote], name: str
) -> list[Subject]:
    """Instances with a wrong label and false alarms, largest first; ``name`` of the block is written on each."""
    by_id, by_object = _Groups(points.truth_id), _Groups(points.object)
    found = []
    for j in report.judgements:
        i = j.instance
        if i.excluded is not None or j.predicted is i.label:
            continue
        own = by_id[i.instance_id]
        is_changed = points.truth_change[own] != ChangeLabel.UNCHANGED
        if i.is_changed and i.exists.before and i.exists.after and is_changed.any():
            own = own[is_changed]
        what = ", ".join(dict.fromkeys(filter(None, (i.object_class.title, i.kind, i.edit, i.note))))
        part = " (right by part)" if j.predicted_part is i.label else ""
        said = _title(j.predicted) + part
        lines = [what, f"{name} instance {i.instance_id}, {_extent(points, own)}".strip(), _note(points, own, notes)]
        found.append(Subject(own, _size(points, own), [(i.label.title, i.label), (said, j.predicted)], lines))
    for alarm in report.false_alarms:
        own = by_object[alarm.object_id]
        ids = np.unique(points.truth_id[own])
        on = ", ".join(sorted({truth.by_id[int(i)].kind if i else "ground" for i in ids}))
        lines = [f"false alarm on {on}", f"{name} {_extent(points, own)}".strip(), _note(points, own, notes)]
        labels = [("nothing changed", ChangeLabel.UNCHANGED), (alarm.label.title, alarm.label)]
        found.append(Subject(own, _size(points, own), labels, lines))
    return sorted(found, key=lambda s: -s.size)


def changed_objects(points: Points, notes: dict[int, ObjectNote]) -> list[Subject]:
    """Objects with a changed label, largest first."""
    is_changed = (points.object > 0) & (points.change > ChangeLabel.UNCHANGED) & (points.change < len(ChangeLabel))
    by_object = _Groups(np.where(is_changed, points.object, 0))
    found = []
    for number in by_object.keys[by_object.keys > 0]:
        own = by_object[int(number)]
        label = ChangeLabel(int(points.change[own[0]]))
        lines = [_extent(points, own), _note(points, own, notes)]
        found.append(Subject(own, _size(points, own), [(label.title, label)], lines))
    return sorted(found, key=lambda s: -s.size)


def object_notes(run_dir: Path) -> dict[int, ObjectNote]:
    """What the GeoPackage of a run says about its objects; nothing where there is none."""
    path = run_dir / "changes.gpkg"
    if not path.is_file():
        return {}
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as database:
        rows = database.execute("SELECT object_id, label, object_class, reason FROM objects").fetchall()
    return {int(number): ObjectNote(label, kind, reason or "") for number, label, kind, reason in rows}


class _Groups:
    """Indices of points by a number that each has."""

    def __init__(self, key: npt.NDArray[Any]) -> None:
        self._order: Index = np.argsort(key, kind="stable")
        self.keys, starts = np.unique(key[self._order], return_index=True)
        self._bounds = np.append(starts, len(key))

    def __getitem__(self, key: int) -> Index:
        at = int(np.searchsorted(self.keys, key))
        if at == len(self.keys) or self.keys[at] != key:
            return np.empty(0, dtype=np.intp)
        return self._order[self._bounds[at] : self._bounds[at + 1]]


def _size(points: Points, own: Index) -> int:
    return len(np.unique(np.floor(points.xyz[own] / VOXEL_M).astype(np.int64), axis=0))


def _extent(points: Points, own: Index) -> str:
    if not len(own):
        return "no points"
    xyz, n_after = points.xyz[own], int(np.count_nonzero(points.epoch[own]))
    axis = main_axis(xyz[:, :2])
    along, across = np.ptp(xyz[:, :2] @ axis), np.ptp(xyz[:, :2] @ np.array([-axis[1], axis[0]]))
    return f"{along:.1f} x {across:.1f} x {np.ptp(xyz[:, 2]):.1f} m, {len(own) - n_after} + {n_after} points"


def _note(points: Points, own: Index, notes: dict[int, ObjectNote]) -> str:
    """What the GeoPackage says about the object that most of the points belong to."""
    objects = points.object[own]
    if not np.any(objects > 0):
        return "of no object"
    numbers, n = np.unique(objects[objects > 0], return_counts=True)
    number = int(numbers[np.argmax(n)])
    share = n.max() / len(own)
    held = "" if share > 0.95 else f" ({100 * share:.0f} % of it)"
    note = notes.get(number)
    if note is None:
        return f"object {number}{held}"
    return f"object {number}{held}, {note.object_class}, {note.label}: {note.reason}"


def _title(label: ChangeLabel) -> str:
    return "no label" if label is ChangeLabel.UNDETERMINED else label.title


# --- pictures ---------------------------------------------------------------------------------------------------------


class Tiles:
    """Draws subjects among all points of a run.

    Parameters
    ----------
    points : Points
        Of the run.
    """

    def __init__(self, points: Points) -> None:
        self._points = points
        self._at = [np.flatnonzero(points.epoch == code) for code in (0, 1)]
        self._index = [PlanIndex(points.xyz[at]) for at in self._at]
        self._point_m = [_spacing(points.xyz[at]) for at in self._at]

    def draw(self, subject: Subject) -> Tile:
        """The tile of one subject, all of it but its frame."""
        xyz = self._points.xyz[subject.points]
        if not len(xyz):
            xyz = np.zeros((1, 3))
        middle = (xyz.min(axis=0) + xyz.max(axis=0)) / 2
        axis = main_axis(xyz[:, :2])
        is_subject = np.zeros(len(self._points), np.bool_)
        is_subject[subject.points] = True
        plan, section = _plan_view(xyz - middle), _section_view((xyz - middle) @ _turn(axis))
        differs, said = self._plans(plan, middle, is_subject)
        across = np.array([-axis[1], axis[0]])
        cut_m = float(np.median((xyz - middle)[:, :2] @ across))
        for picture in (differs, said):
            _draw_cut(picture, plan, axis, cut_m * across)
        below = self._section(section, middle, axis, cut_m, is_subject)
        return Tile(subject.size, _composed(subject, differs, said, below, plan, section))

    def _near(self, epoch: int, middle: FloatArray, reach: float) -> Index:
        low, high = middle[:2] - reach, middle[:2] + reach
        return np.asarray(self._at[epoch][self._index[epoch].near(*low, *high)])

    def _plans(self, view: View, middle: FloatArray, is_subject: BoolArray) -> tuple[Picture, Picture]:
        """What differs, and what the run said."""
        points, reach = self._points, max(view.width_m, view.height_m) / 2 + 1.0
        tops = []
        for epoch in (0, 1):
            near = self._near(epoch, middle, reach)
            x, y, z = (points.xyz[near] - middle).T
            tops.append(_seen(view, (x, y, z), near, 1.6 * self._point_m[epoch]))
        before, after = tops
        is_after_top = after.depth >= before.depth
        depth = np.maximum(before.depth, after.depth)
        top = np.where(is_after_top, after.point, before.point)
        is_empty = depth == NOTHING
        is_both = (before.depth != NOTHING) & (after.depth != NOTHING)
        dz = np.where(is_both, after.depth - before.depth, 0.0)
        hue = np.full(view.shape, 0)
        hue[dz < -ALIKE_M], hue[dz > ALIKE_M] = 1, 2
        is_own = is_subject[top] & ~is_empty
        hue[~is_both], hue[~is_both & is_own] = 3, 1
        hue[~is_both & is_after_top] += 1
        light = _shaded(depth, 0.5 + 0.42 * _scaled(depth, ~is_empty))
        differs = _coloured(light, hue, [_GREY, _BEFORE, _AFTER, _pale(_BEFORE), _pale(_AFTER)])
        labels = list(LABEL_COLOURS)
        code = np.where(points.change[top] < len(labels), points.change[top], 0)
        place = np.empty(len(labels), dtype=np.int64)
        place[[int(label) for label in labels]] = range(len(labels))
        said = _coloured(light, place[code], [LABEL_COLOURS[label] for label in labels])
        objects = np.where(is_empty, 0, points.object[top])
        said[_edges(objects) & ~is_empty] //= 2
        outline = _outline(is_subject[before.point] & ~is_empty & (before.depth != NOTHING), view)
        outline |= _outline(is_subject[after.point] & (after.depth != NOTHING), view)
        for picture in (differs, said):
            picture[is_empty] = _PAPER
            picture[outline] = _INK
        return differs, said

    def _section(
        self, view: View, middle: FloatArray, axis: FloatArray, cut_m: float, is_subject: BoolArray
    ) -> Picture:
        """A slab along ``axis``: grey where both surveys have points, coloured where only one has."""
        points, seen = self._points, []
        for epoch in (0, 1):
            near = self._near(epoch, middle, view.width_m / 2 + 2.0)
            u, w, v = ((points.xyz[near] - middle) @ _turn(axis)).T
            is_in = np.abs(w - cut_m) <= max(_SLAB_M, 2.0 * self._point_m[epoch])
            seen.append(_seen(view, (u[is_in], v[is_in], -w[is_in]), near[is_in], self._point_m[epoch]))
        before, after = seen
        has_before, has_after = before.depth != NOTHING, after.depth != NOTHING
        hue = np.select([has_before & has_after, has_before], [0, 1], 2)
        is_own = (is_subject[before.point] & has_before) | (is_subject[after.point] & has_after)
        hues = [_GREY, _BEFORE, _AFTER]
        strong = _coloured(np.full(view.shape, 0.55), hue, ["#4a5058", _BEFORE, _AFTER])
        faint = _coloured(np.full(view.shape, 0.9), hue, [_pale(h) for h in hues])
        picture = np.where(is_own[..., None], strong, faint).astype(np.uint8)
        picture[~has_before & ~has_after] = _PAPER
        return picture


class _Seen(NamedTuple):
    """Depth of what is seen in each pixel, and the point it is of (0 where there is none)."""

    depth: Float32Array
    point: Index


def _seen(view: View, points: tuple[FloatArray, FloatArray, FloatArray], number: Index, point_m: float) -> _Seen:
    """Which of the points (u, v, depth; m) is nearest to the viewer in each pixel."""
    depth, place = depth_buffer(view, points, np.arange(len(number), dtype=np.float64), point_m)
    found = np.append(number, 0)[np.where(depth == NOTHING, len(number), place).astype(np.int64)]
    return _Seen(depth, found)


def _shaded(depth: Float32Array, tone: FloatArray) -> FloatArray:
    """Brightness 0 to 1 of each pixel, darker beside what stands nearer to the viewer."""
    steps = np.zeros(depth.shape, dtype=np.uint8)
    shade(depth, tone.astype(np.float32), 0, _SHADES, steps)
    return np.asarray(steps / (_SHADES - 1))


def _coloured(light: FloatArray, hue: npt.NDArray[Any], colours: Sequence[str]) -> Picture:
    """Colour of each pixel: half of it dark, all of it pale."""
    pure = np.array([rgb(colour) for colour in colours], dtype=float)[hue]
    t = light[..., None]
    mixed = np.where(t < 0.5, pure * (0.35 + 1.3 * t), pure + (255.0 - pure) * (2 * t - 1.0) * 0.75)
    return np.asarray(np.clip(np.round(mixed), 0, 255), dtype=np.uint8)


def _pale(colour: str) -> str:
    return "#" + "".join(f"{round(c + (255 - c) * 0.7):02x}" for c in rgb(colour))


def _scaled(depth: Float32Array, is_seen: BoolArray) -> FloatArray:
    """Heights from 0 at the 2nd to 1 at the 98th percentile of what is seen, at least 4 m apart."""
    if not is_seen.any():
        return np.zeros(depth.shape)
    low, high = np.percentile(depth[is_seen], (2, 98))
    return np.asarray(np.clip((depth - low) / max(high - low, 4.0), 0.0, 1.0), dtype=np.float64)


def _edges(objects: npt.NDArray[Any]) -> BoolArray:
    """Pixels whose right or lower neighbour is of another object."""
    edge = np.zeros(objects.shape, np.bool_)
    edge[:, :-1] |= objects[:, :-1] != objects[:, 1:]
    edge[:-1] |= objects[:-1] != objects[1:]
    return edge


def _outline(mask: BoolArray, view: View) -> BoolArray:
    """The line around what a mask covers, gaps of half a metre closed."""
    reach = int(np.clip(round(0.5 / view.pixel_m), 1, 6))
    padded = np.pad(mask, 2 * reach)
    closed = binary_closing(padded, iterations=reach)
    return np.asarray((closed & ~binary_erosion(closed))[2 * reach : -2 * reach, 2 * reach : -2 * reach])


def _turn(axis: FloatArray) -> FloatArray:
    """Matrix (3, 3) that takes rows x, y, z to along, across, z."""
    return np.array([[axis[0], -axis[1], 0.0], [axis[1], axis[0], 0.0], [0.0, 0.0, 1.0]])


def _plan_view(xyz: FloatArray) -> View:
    """Window about a subject, its coordinates (n, 3) about the middle."""
    rows, columns = PLAN_PX
    size = np.ptp(xyz[:, :2], axis=0)
    wanted = size + 2 * max(_LEAST_MARGIN_M, _MARGIN * float(size.max()))
    width = float(np.clip(max(wanted[0], wanted[1] * columns / rows), *_WINDOW_M))
    return View(-width / 2, -width / 2 * rows / columns, width, width * rows / columns, width / columns)


def _section_view(turned: FloatArray) -> View:
    """Window about a subject in a section, its coordinates (n, 3) along, across, z about the middle."""
    rows, columns = SECTION_PX
    along, _, height = np.ptp(turned, axis=0)
    wanted = max(float(along) * 1.3 + 4.0, (float(height) + 2.5) * columns / rows)
    width = float(np.clip(wanted, 12.0, 2.0 * _WINDOW_M[1]))
    return View(-width / 2, -width / 2 * rows / columns, width, width * rows / columns, width / columns)


def _spacing(xyz: FloatArray) -> float:
    """Mean spacing of points where there are any, in plan, m."""
    if not len(xyz):
        return 0.1
    cells = len(np.unique(np.floor(xyz[:, :2]).astype(np.int64), axis=0))
    return float(np.clip(np.sqrt(cells / len(xyz)), 0.06, 1.0))


def _draw_cut(picture: Picture, view: View, axis: FloatArray, at: FloatArray) -> None:
    """Ticks where the section enters and leaves the window."""
    rows, columns = picture.shape[:2]
    reach = min(view.width_m / 2 / max(abs(axis[0]), 1e-9), view.height_m / 2 / max(abs(axis[1]), 1e-9))
    for way in (-1.0, 1.0):
        for step in np.linspace(0.86, 1.0, 40):
            u, v = at + way * step * reach * axis
            column, row = int((u - view.u0) / view.pixel_m), rows - 1 - int((v - view.v0) / view.pixel_m)
            if 0 <= row < rows and 0 <= column < columns:
                picture[row, max(column - 1, 0) : column + 1] = _INK


class MistakeTiles:
    """The largest mistakes of several runs.

    Parameters
    ----------
    most : int
        How many are kept.

    Attributes
    ----------
    largest : list of Tile
        Largest first.
    n : int
        Mistakes, those that were not kept too.
    """

    def __init__(self, most: int) -> None:
        self.largest: list[Tile] = []
        self.n = 0
        self._most = most

    def add(self, name: str, run_dir: Path, points: JudgedPoints, truth: Truth, report: ScoreReport) -> None:
        """Take in the mistakes of one run."""
        found = mistakes(points, truth, report, object_notes(run_dir), name)
        self.n += len(found)
        artist = Tiles(points)
        drawn = self.largest + [artist.draw(subject) for subject in found[: self._most]]
        self.largest = sorted(drawn, key=lambda tile: -tile.size)[: self._most]


def change_tiles(run_dir: Path, points: Points, most: int) -> list[Tile]:
    """The largest changes that a run reports, largest first."""
    artist = Tiles(points)
    return [artist.draw(subject) for subject in changed_objects(points, object_notes(run_dir))[:most]]


# --- composition ------------------------------------------------------------------------------------------------------


def _composed(
    subject: Subject, differs: Picture, said: Picture, section: Picture, plan_view: View, section_view: View
) -> Picture:
    """A tile: header, pictures, text."""
    image_module, draw_module, font = _pillow()
    plan_top = 26
    section_top = plan_top + PLAN_PX[0] + GAP_PX
    text_top = section_top + SECTION_PX[0] + 4
    height = text_top + 15 * _LINES + 4
    tile = image_module.new("RGB", (TILE_PX, height), _PAPER)
    pen = draw_module.Draw(tile)
    for picture, x, y in (
        (differs, GAP_PX, plan_top),
        (said, 2 * GAP_PX + PLAN_PX[1], plan_top),
        (section, GAP_PX, section_top),
    ):
        tile.paste(image_module.fromarray(picture), (x, y))
        rows, columns = picture.shape[:2]
        pen.rectangle((x, y, x + columns - 1, y + rows - 1), outline=_LINE)
    pen.rectangle((0, 0, TILE_PX - 1, height - 1), outline=_LINE)
    x = GAP_PX
    for n, (words, label) in enumerate(subject.labels):
        if n:
            pen.line((x, 13, x + 14, 13), fill=_INK, width=2)
            pen.polygon(((x + 12, 8), (x + 19, 13), (x + 12, 18)), fill=_INK)
            x += 27
        pen.rectangle((x, 7, x + 11, 18), fill=rgb(LABEL_COLOURS[label]))
        pen.text((x + 16, 4), words, fill=_INK, font=font(15))
        x += 16 + int(pen.textlength(words, font=font(15))) + 8
    for view, left, bottom in ((plan_view, GAP_PX, section_top - GAP_PX), (section_view, GAP_PX, text_top - 4)):
        _scale_bar(pen, font(11), view, left, bottom)
    lines = [line for text in subject.lines for line in _wrapped(text, pen, font(12), TILE_PX - 2 * GAP_PX)]
    if len(lines) > _LINES:
        lines = [*lines[: _LINES - 1], lines[_LINES - 1][:-2] + " ..."]
    for n, line in enumerate(lines):
        pen.text((GAP_PX, text_top + 15 * n), line, fill=_INK if n == 0 else _FAINT, font=font(12))
    return np.asarray(tile)


def _scale_bar(pen: Any, font: Any, view: View, left: int, bottom: int) -> None:
    length_m = round_length(view.width_m / 4)
    x, y, bar = left + 6, bottom - 6, length_m / view.pixel_m
    words = f"{length_m:g} m"
    pen.rectangle((x - 3, y - 15, x + bar + 3, y + 3), fill=(255, 255, 255))
    pen.line((x, y - 3, x, y, x + bar, y, x + bar, y - 3), fill=_INK)
    pen.text((x + bar / 2, y - 2), words, fill=_INK, font=font, anchor="mb")


def _wrapped(text: str, pen: Any, font: Any, width: float) -> list[str]:
    """Text in lines that are no wider than ``width`` pixels."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and pen.textlength(longer, font=font) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


def write_sheets(tiles: Iterable[Tile], title: str, path: Path, per_page: int = PER_PAGE) -> list[Path]:
    """Write tiles in their order, page by page, as PNG: to ``path``, then ``path`` with the number of the page; into
    a folder as ``sheet.png`` and so on. No tiles make one page that says so."""
    image_module, draw_module, font = _pillow()
    tiles = list(tiles)
    first = path / "sheet.png" if path.is_dir() or not path.suffix else path
    first.parent.mkdir(parents=True, exist_ok=True)
    pages = [tiles[start : start + per_page] for start in range(0, len(tiles), per_page)] or [[]]
    columns = 4 if min(per_page, len(tiles)) <= 16 else 6
    written = []
    for n, page in enumerate(pages):
        height = page[0].picture.shape[0] + GAP_PX if page else 0
        size = (columns * (TILE_PX + GAP_PX) + GAP_PX, 40 + max(-(-len(page) // columns), 1) * max(height, 40))
        sheet = image_module.new("RGB", size, (242, 243, 244))
        pen = draw_module.Draw(sheet)
        number = f", page {n + 1} of {len(pages)}" if len(pages) > 1 else ""
        pen.text((GAP_PX + 2, 10), f"{title}{number}", fill=_INK, font=font(17))
        _legend(pen, font(13), size[0])
        if not page:
            pen.text((GAP_PX + 2, 48), "nothing to show", fill=_FAINT, font=font(15))
        for k, tile in enumerate(page):
            at = (GAP_PX + k % columns * (TILE_PX + GAP_PX), 40 + k // columns * height)
            sheet.paste(image_module.fromarray(tile.picture), at)
        target = first if n == 0 else first.with_name(f"{first.stem}_{n + 1}{first.suffix}")
        sheet.save(target)
        written.append(target)
    return written


def _legend(pen: Any, font: Any, width: int) -> None:
    """Colours, from the right edge: labels, then what differs."""
    entries = [("only before", _BEFORE), ("only after", _AFTER), ("both", _GREY)]
    entries += [(_title(label), colour) for label, colour in LABEL_COLOURS.items()]
    x = width - GAP_PX
    for words, colour in reversed(entries):
        x -= int(pen.textlength(words, font=font)) + 32
        pen.rectangle((x, 14, x + 11, 25), fill=rgb(colour))
        pen.text((x + 16, 12), words, fill=_INK, font=font)


def _pillow() -> tuple[Any, Any, Any]:
    """Pillow's modules for images and drawing, and its font by size."""
    try:
        from PIL import Image, ImageDraw, ImageFont
    except ImportError as error:
        raise InputError(
            "Contact sheets need Pillow, which is not installed.", "pip install 'loda-pdal[sheet]'", "extra-missing"
        ) from error
    return Image, ImageDraw, ImageFont.load_default
