"""The report: true pictures, true figures, nothing that a file name or a reason could smuggle in."""

from __future__ import annotations

import base64
import re
import sqlite3
import zlib
from contextlib import closing
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapely
from io_samples import explain, make_labels, make_lod, make_registration, make_result, make_surveys
from rasterio.io import MemoryFile
from scipy.spatial import cKDTree

from loda_pdal.io import report, report_folder, report_pictures
from loda_pdal.io.colours import LABEL_COLOURS, rgb
from loda_pdal.io.outputs import write_outputs
from loda_pdal.io.pictures import RAMP, PlanIndex, View, draw_points, palette, png
from loda_pdal.io.report import MEANINGS, ranked, render, write_report
from loda_pdal.io.report_folder import read_report_data, rebuild_report
from loda_pdal.io.report_pictures import Scene, object_pictures, round_length
from loda_pdal.io.run_json import run_document
from loda_pdal.io.summary import summarise
from loda_pdal.model.errors import InputError
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import ChangeResult, GroundChangeRecord, ObjectRecord
from loda_pdal.model.survey import Survey
from loda_pdal.params import Parameters

HOSTILE = '"><script>alert(1)</script><img src=x onerror=alert(2)>'
CAR_AT = np.array([22.0, 12.0])


def grid(x0: float, y0: float, x1: float, y1: float, z: float, step: float = 0.25) -> np.ndarray:
    """Points (n, 3) of a level rectangle."""
    x, y = np.meshgrid(np.arange(x0, x1, step) + step / 2, np.arange(y0, y1, step) + step / 2)
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])


def rectangle(x0: float, y0: float, x1: float, y1: float) -> shapely.MultiPolygon:
    return shapely.MultiPolygon([shapely.box(x0, y0, x1, y1)])


def scene(reason: str = "Height +3.00 m, limit 0.05 m.") -> tuple[ChangeResult, Pair[Survey]]:
    """A level street of 40 m by 24 m: a house grew by 3 m, a car came, a shed went, a tree stayed, ground sank."""
    ground_before = grid(0, 0, 40, 24, 0.0)
    ground_after = ground_before.copy()
    is_sunk = (ground_after[:, 0] > 30) & (ground_after[:, 0] < 38) & (ground_after[:, 1] < 6)
    ground_after[is_sunk, 2] -= 0.4
    car = grid(CAR_AT[0] - 2, CAR_AT[1] - 1, CAR_AT[0] + 2, CAR_AT[1] + 1, 1.5)
    tree = grid(33, 15, 36, 18, 8.0)
    before = {0: ground_before, 1: grid(4, 4, 14, 10, 6.0), 3: grid(6, 16, 10, 19, 2.5), 4: tree}
    after = {0: ground_after, 1: grid(4, 4, 14, 10, 9.0), 2: car, 4: tree}
    clouds = Pair(*(np.vstack(list(parts.values())) for parts in (before, after)))
    numbers = Pair(
        *(
            np.concatenate([np.full(len(xyz), number, dtype=np.uint32) for number, xyz in parts.items()])
            for parts in (before, after)
        )
    )
    objects = [
        ObjectRecord(
            1,
            ChangeLabel.INCREASED,
            ObjectClass.BUILDING,
            rectangle(4, 4, 14, 10),
            reason,
            confidence=0.9,
            height_before_m=6.0,
            height_after_m=9.0,
            dh_m=3.0,
            volume_before_m3=360.0,
            volume_after_m3=540.0,
            dv_m3=180.0,
            lod95_m=0.05,
            points_before=960,
            points_after=960,
        ),
        ObjectRecord(
            2,
            ChangeLabel.ADDED,
            ObjectClass.MOBILE,
            rectangle(20, 11, 24, 13),
            "Only in the after survey.",
            confidence=0.8,
            height_after_m=1.5,
        ),
        ObjectRecord(
            3,
            ChangeLabel.UNDETERMINED,
            ObjectClass.OTHER,
            rectangle(6, 16, 10, 19),
            "The after survey could not have seen it.",
            observability=0.1,
        ),
        ObjectRecord(4, ChangeLabel.UNCHANGED, ObjectClass.VEGETATION, rectangle(33, 15, 36, 18), "Below the limit."),
    ]
    frame = LocalFrame((121_000, 486_000, 0))
    surveys = Pair(Survey(clouds.before, frame, f"/data/{HOSTILE}.laz"), Survey(clouds.after, frame, "after.laz"))
    piece = GroundChangeRecord(
        1, ChangeLabel.DECREASED, rectangle(30, 0, 38, 6), -0.4, 0.03, 48.0, -19.2, "Lowered by 0.40 m."
    )
    labels = surveys.map(make_labels)
    for epoch, number in zip(labels, numbers, strict=True):
        epoch.of_voxel["ObjectId"][:-1] = number
    result = ChangeResult(
        objects,
        [piece],
        Pair([], []),
        labels,
        make_registration(),
        make_lod(),
        clouds,
        numbers,
        shapely.box(0, 0, 40, 24),
        Parameters(),
        True,
        [f"A warning {HOSTILE}"],
    )
    return result, surveys


def page_of(result: ChangeResult, surveys: Pair[Survey], tmp_path: Path) -> str:
    path = tmp_path / "report.html"
    write_report(path, result, surveys, run_document(result, surveys))
    return path.read_text(encoding="utf-8")


class Page(HTMLParser):
    """What a browser would find in the page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.open: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open, f"not closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "br", "input"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self.text += data

    def count(self, tag: str, **wanted: str) -> int:
        return sum(name == tag and wanted.items() <= attrs.items() for name, attrs in self.tags)


def pictures(fragment: str) -> list[np.ndarray]:
    """Palette indices of all pictures in HTML, in order."""
    found = []
    for data in re.findall(r"data:image/png;base64,([^\"]+)", fragment):
        with MemoryFile(base64.b64decode(data)) as file, file.open() as picture:
            found.append(picture.read(1))
    return found


def is_coloured(picture: np.ndarray) -> np.ndarray:
    return picture > RAMP


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_png_holds_the_picture_and_its_palette() -> None:
    picture = np.random.default_rng(1).integers(0, 1 + 2 * RAMP, (13, 29)).astype(np.uint8)
    colours = palette("#0072b2")
    with MemoryFile(png(picture, colours)) as file, file.open() as read:
        assert np.array_equal(read.read(1), picture)
        table = read.colormap(1)
    assert [table[i][:3] for i in range(len(colours))] == [tuple(c) for c in colours.tolist()]


def test_png_checksums_are_right() -> None:
    body = png(np.zeros((2, 3), dtype=np.uint8), palette("#d55e00"))[8:]
    while body:
        length, kind = int.from_bytes(body[:4], "big"), body[4:8]
        data, check = body[8 : 8 + length], body[8 + length : 12 + length]
        assert zlib.crc32(kind + data) == int.from_bytes(check, "big"), kind
        body = body[12 + length :]


def blank(view: View) -> np.ndarray:
    return np.zeros(view.shape, dtype=np.uint8)


def slowly_drawn(view: View, points: np.ndarray, tone: np.ndarray, point_m: float) -> np.ndarray:
    """Shades 0 to `RAMP` - 1 of the nearest dots, pixel by pixel; -1 where there is none."""
    size = max(1, int(np.ceil(point_m / view.pixel_m)))
    nearest, colour = np.full(view.shape, -1e6), np.zeros(view.shape)
    for (u, v, depth), light in zip(points, tone, strict=True):
        row = view.shape[0] - 1 - int(np.floor((v - view.v0) / view.pixel_m)) - size // 2
        column = int(np.floor((u - view.u0) / view.pixel_m)) - size // 2
        for i, j in np.ndindex(size, size):
            pixel = row + i, column + j
            is_in_dot = np.hypot(i - (size - 1) / 2, j - (size - 1) / 2) <= size / 2
            if is_in_dot and min(pixel) >= 0 and np.all(np.less(pixel, view.shape)) and depth > nearest[pixel]:
                nearest[pixel], colour[pixel] = depth, light
    shades = np.full(view.shape, -1)
    for i, j in np.argwhere(nearest > -1e6):
        hidden = 0.0
        for reach in (1, 3):
            for di, dj in ((-1, 0), (0, -1), (0, 1), (1, 0), (-1, -1)):
                a, b = i + di * reach, j + dj * reach
                if 0 <= a < view.shape[0] and 0 <= b < view.shape[1]:
                    hidden += min(max(nearest[a, b] - nearest[i, j], 0.0), 1.5)
        shades[i, j] = int(colour[i, j] * np.exp(-0.16 * hidden) * (RAMP - 1))
    return shades


@pytest.mark.parametrize("point_m", [0.2, 0.5, 1.0, 1.3])
@pytest.mark.parametrize("ramp", [0, 1])
def test_dots_and_their_shade_are_as_a_slow_twin_draws_them(point_m: float, ramp: int) -> None:
    rng = np.random.default_rng(3)
    points, tone = rng.uniform((-1, -1, 0), (11, 9, 3), (400, 3)), rng.random(400)
    view = View(0.0, 0.0, 10.0, 8.0, 0.2)
    picture = blank(view)
    draw_points(picture, view, tuple(points.T), tone, point_m, ramp)
    expected = slowly_drawn(view, points, tone, point_m)
    assert np.array_equal(picture > 0, expected >= 0)
    is_drawn = picture > 0
    difference = np.abs(picture[is_drawn] - 1.0 - ramp * RAMP - expected[is_drawn])
    assert difference.max() <= 1 and np.mean(difference > 0) < 0.001  # float32 may fall to either side of a step


def test_pictures_do_not_depend_on_the_order_of_the_points() -> None:
    rng = np.random.default_rng(5)
    points, tone = rng.uniform(0, 10, (500, 3)).round(), rng.random(500)  # many are equally near
    view = View(0.0, 0.0, 10.0, 10.0, 0.1)
    first, second = blank(view), blank(view)
    draw_points(first, view, tuple(points.T), tone, 0.5, 0)
    draw_points(second, view, tuple(points[::-1].T), tone[::-1], 0.5, 0)
    assert np.array_equal(first, second)


def test_shading_darkens_the_foot_of_a_step_and_no_level_surface() -> None:
    low, high = grid(0, 0, 10, 5, 0.0, 0.5), grid(0, 5, 10, 10, 3.0, 0.5)
    points = np.vstack([low, high])
    view = View(0, 0, 10, 10, 0.5)
    picture = blank(view)
    draw_points(picture, view, tuple(points.T), np.ones(len(points)), point_m=0.4, ramp=0)
    assert picture[11, 10] < 0.95 * RAMP and picture[4, 10] == picture[18, 10] == RAMP


def test_what_is_drawn_later_lies_on_top() -> None:
    view, one = View(0, 0, 2, 2, 1.0), np.ones(1)
    picture = blank(view)
    for x, y in ((0.5, 0.5), (1.5, 0.5), (0.5, 1.5)):
        draw_points(picture, view, (x * one, y * one, 9.0 * one), 0.0 * one, 1.0, ramp=0)
    draw_points(picture, view, (0.5 * one, 1.5 * one, 0.0 * one), one, 1.0, ramp=1)
    assert picture.tolist() == [[2 * RAMP, 0], [1, 1]]


def test_plan_index_finds_what_a_look_at_all_points_finds() -> None:
    xyz = np.random.default_rng(2).uniform(-100, 100, (5000, 3))
    index = PlanIndex(xyz)
    for x0, y0, x1, y1 in ((-30, -20, -10, 5), (-500, -500, 500, 500), (90, 90, 400, 400), (150, 0, 160, 10)):
        found = index.near(x0, y0, x1, y1)
        is_inside = np.all((xyz[:, :2] >= (x0, y0)) & (xyz[:, :2] <= (x1, y1)), axis=1)
        assert np.all(np.diff(found) > 0)
        assert set(np.flatnonzero(is_inside)) <= set(found)
        assert len(found) == 0 or np.all(
            np.abs(xyz[found, :2] - (x0, y0)).max(axis=0) <= np.array([x1 - x0, y1 - y0]) + 8
        )
    assert len(PlanIndex(np.empty((0, 3))).near(-1, -1, 1, 1)) == 0


@pytest.mark.parametrize(("at_most", "length"), [(0.9, 0.5), (1.0, 1), (4.99, 2), (5, 5), (49, 20), (120, 100)])
def test_scale_bars_have_round_lengths(at_most: float, length: float) -> None:
    assert round_length(at_most) == pytest.approx(length)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_pictures_show_the_object_where_it_is_and_when_it_is() -> None:
    result, _ = scene()
    drawn = Scene.of(result.clouds, result.object_of_voxel, 0.25)
    record = result.objects[1]
    fragment = object_pictures(drawn, 2, record.label, record.footprint)
    plan_before, plan_after, profile_before, profile_after = pictures(fragment)
    assert not is_coloured(plan_before).any() and not is_coloured(profile_before).any()

    view = report_pictures._plan_view(result.clouds.after[result.object_of_voxel.after == 2], record.footprint)
    rows, columns = np.nonzero(is_coloured(plan_after))
    xy = np.array([view.u0 + columns.mean() * view.pixel_m, view.v0 + view.height_m - rows.mean() * view.pixel_m])
    assert np.abs(xy - CAR_AT).max() < 0.1
    size = np.array([np.ptp(columns), np.ptp(rows)]) * view.pixel_m
    assert np.abs(size - [4.0, 2.0]).max() < 0.4
    assert np.mean(plan_before == 0) < 0.02  # the ground is drawn without holes

    side, _ = report_pictures._profile_view(
        result.clouds.after[result.object_of_voxel.after == 2], np.array([1.0, 0.0])
    )
    rows, _ = np.nonzero(is_coloured(profile_after))
    assert side.v0 + side.height_m - rows.mean() * side.pixel_m == pytest.approx(1.5, abs=0.15)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_before_and_after_have_one_place_and_scale() -> None:
    result, _ = scene()
    drawn = Scene.of(result.clouds, result.object_of_voxel, 0.25)
    fragment = object_pictures(drawn, 1, ChangeLabel.INCREASED, result.objects[0].footprint)
    before, after, side_before, side_after = pictures(fragment)
    assert np.mean(is_coloured(before) == is_coloured(after)) > 0.99  # the house stands where it stood
    lift = np.nonzero(is_coloured(side_before))[0].mean() - np.nonzero(is_coloured(side_after))[0].mean()
    top_before, top_after, *_ = (float(row) for row in re.findall(r'd="M0 ([\d.]+)H', fragment))
    assert lift == pytest.approx(top_before - top_after, abs=2.0)  # 3 m, as the dashed lines say
    bars = re.findall(r">([\d.]+ m)</text>", fragment)
    assert bars[0] == bars[1] and bars[2] == bars[3]


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_pictures_of_ground_colour_the_ground_and_not_what_stands_on_it() -> None:
    result, _ = scene()
    xyz = Pair(np.vstack([result.clouds.before, grid(32, 2, 34, 4, 3.0)]), result.clouds.after)
    numbers = xyz.map(lambda points: np.zeros(len(points), dtype=np.uint32))
    drawn = Scene.of(xyz, numbers, 0.25)
    piece = result.ground_changes[0]
    _, plan_after, side_before, side_after = pictures(
        report_pictures.ground_pictures(drawn, piece.label, piece.footprint)
    )
    view = report_pictures._plan_view(grid(30, 0, 38, 6, 0.0), piece.footprint)
    assert is_coloured(plan_after).sum() * view.pixel_m**2 == pytest.approx(48.0, rel=0.15)
    assert (side_before[: side_before.shape[0] // 2] > RAMP).sum() == 0  # the box above it stays grey
    assert is_coloured(side_before).any() and is_coloured(side_after).any()


def test_nothing_from_outside_becomes_markup(tmp_path: Path) -> None:
    result, surveys = scene(reason=f"Reason {HOSTILE}")
    page = Page(page_of(result, surveys, tmp_path))
    assert page.count("script") == 1 and page.count("img") == 0 and page.count("style") == 1
    for tag, attrs in page.tags:
        assert not any(name.startswith("on") for name in attrs), (tag, attrs)
        for name in ("src", "href", "xlink:href"):
            address = attrs.get(name)
            assert address is None or address.startswith(("#", "data:image/png;base64,")), (tag, address)
    assert page.text.count("alert(1)") >= 4  # shown as text: title line, warning, table, card


def test_page_says_what_was_found(tmp_path: Path) -> None:
    result, surveys = scene()
    page = Page(page_of(result, surveys, tmp_path))
    assert "2 of 4 objects on 0.10 hectares changed. 1 could not be judged" in page.text
    assert "The ground itself changed in 1 place." in page.text
    assert page.count("article", **{"class": "card"}) == 4  # two changes, one undetermined, one of the ground
    assert "6.00 m → 9.00 mHeight change+3.00 m" in page.text.replace(" ", " ")
    assert "Height +3.00 m, limit 0.05 m." in page.text
    targets = {attrs["href"] for tag, attrs in page.tags if tag == "a" and attrs.get("href")}
    ids = {f"#{attrs['id']}" for _, attrs in page.tags if "id" in attrs}
    assert targets == ids == {"#c1", "#c2", "#c3", "#g1"}


def test_unknown_is_a_dash_and_never_zero(tmp_path: Path) -> None:
    result, surveys = scene()
    text = page_of(result, surveys, tmp_path)
    row = re.search(r'<tr data-label="Added">.*?</tr>', text)
    assert row is not None
    cells = re.findall(r'<td class="n" data-v="([^"]*)">([^<]*)</td>', row.group())
    assert cells[:5] == [("0.8", "0.80"), ("", "–"), ("", "–"), ("", "–"), ("", "–")]


def test_without_changes_the_page_says_so(tmp_path: Path) -> None:
    result, surveys = scene()
    same = ChangeResult(**{**vars(result), "objects": [result.objects[3]], "ground_changes": [], "warnings": []})
    page = Page(page_of(same, surveys, tmp_path))
    assert "None of 1 object on 0.10 hectares changed." in page.text
    assert page.count("article") == 0


def test_empty_result_makes_a_page(tmp_path: Path) -> None:
    result, surveys = scene()
    nothing = Pair(np.empty((0, 3)), np.empty((0, 3)))
    empty = ChangeResult(
        **{
            **vars(result),
            "objects": [],
            "ground_changes": [],
            "clouds": nothing,
            "object_of_voxel": nothing.map(lambda xyz: np.empty(0, dtype=np.uint32)),
            "block": None,
        }
    )
    assert "No object was found." in Page(page_of(empty, surveys, tmp_path)).text


def test_pictures_are_capped_and_the_page_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "MAX_PICTURED", 1)
    result, surveys = scene()
    page = Page(page_of(result, surveys, tmp_path))
    assert page.count("article", id="c1") == 1 and page.count("article", id="c2") == 0
    assert "The 1 largest and most certain of 3 changes are pictured" in page.text
    assert page.count("tr", **{"data-label": "Added"}) == 1  # still in the table, without a link


def test_certain_and_large_changes_come_first_and_undetermined_last() -> None:
    result, _ = scene()
    assert [record.object_id for record in ranked(result.objects)] == [1, 2, 3]


def test_every_label_has_a_colour_and_a_meaning() -> None:
    assert set(LABEL_COLOURS) == set(MEANINGS) == set(ChangeLabel)
    assert len({rgb(colour) for colour in LABEL_COLOURS.values()}) == len(ChangeLabel)


def without_pictures(page: str) -> str:
    return re.sub(r'<div class="pictures">.*?</div>|<figure class="map">.*?</figure>', "", page, flags=re.DOTALL)


def test_report_made_again_from_the_folder_is_the_same(tmp_path: Path) -> None:
    result, surveys = scene()
    outputs = write_outputs(result, surveys, tmp_path)
    first = outputs["report"].read_text(encoding="utf-8")
    assert rebuild_report(tmp_path) == outputs["report"]
    second = outputs["report"].read_text(encoding="utf-8")
    assert without_pictures(second) == without_pictures(first)
    assert second.count("<image ") == first.count("<image ") == 1 + 4 * 4
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(p.name for p in outputs.values())


def test_points_from_the_folder_are_means_of_voxels_however_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, leaf_m = np.random.default_rng(4), Parameters().fuse.leaf_m
    cells = [rng.integers(0, 8, (n, 3)) for n in (3000, 2000)]
    xyz = Pair(*((cell + rng.uniform(0.05, 0.95, cell.shape)) * leaf_m for cell in cells))
    surveys = xyz.map(lambda points: Survey(points, LocalFrame((121_000, 486_000, 0))))
    labels = surveys.map(make_labels)
    for epoch in labels:
        epoch.of_voxel["ObjectId"] %= 3
    still = replace(make_registration(), T_after_before=np.eye(4))
    write_outputs(make_result(surveys, points=labels, registration=still), surveys, tmp_path)
    whole = read_report_data(tmp_path)
    monkeypatch.setattr(report_folder, "CHUNK", 700)
    for data in (whole, read_report_data(tmp_path)):
        for points, epoch, read, numbers in zip(xyz, labels, data.clouds, data.object_of_point, strict=True):
            voxels: dict[tuple[int, ...], list[np.ndarray]] = {}
            for point, number, kind in zip(points, epoch.object, epoch.classification, strict=True):
                if kind != ObjectClass.NOISE:
                    voxels.setdefault((*np.floor(point / leaf_m).astype(int), int(number)), []).append(point)
            found = {
                (*np.floor(point / leaf_m).astype(int), int(n)): point for point, n in zip(read, numbers, strict=True)
            }
            assert len(read) == len(found) and found.keys() == voxels.keys()
            assert all(np.abs(np.mean(voxels[key], axis=0) - found[key]).max() < 0.001 for key in voxels)


@pytest.mark.parametrize("keep_frames", [False, True])
def test_points_from_the_folder_lie_where_the_run_had_them(tmp_path: Path, keep_frames: bool) -> None:
    surveys = make_surveys(tmp_path)
    result = make_result(surveys)
    write_outputs(result, surveys, tmp_path / "out", keep_frames=keep_frames)
    data = read_report_data(tmp_path / "out")
    T = result.registration.T_after_before
    moved = surveys.before.xyz @ T[:3, :3].T + T[:3, 3]
    is_shown = result.points.map(lambda labels: labels.classification != ObjectClass.NOISE)
    for epoch, xyz in (("before", moved), ("after", surveys.after.xyz)):
        shown, numbers = getattr(is_shown, epoch), getattr(result.points, epoch).object
        read = getattr(data.clouds, epoch)
        assert len(read) == shown.sum()  # spread so thinly that no voxel of an object holds two
        distance, nearest = cKDTree(xyz[shown]).query(read)
        assert distance.max() < 0.002 and len(set(nearest)) == len(read)
        assert np.array_equal(getattr(data.object_of_point, epoch), numbers[shown][nearest])
    for read, made in zip(data.objects, result.objects, strict=True):
        assert read.label is made.label and read.dh_m == made.dh_m and read.parent_id == made.parent_id
        assert shapely.symmetric_difference(read.footprint, made.footprint).area < 1e-6


def test_review_notes_reach_the_report(tmp_path: Path) -> None:
    result, surveys = scene()
    write_outputs(result, surveys, tmp_path)
    with closing(sqlite3.connect(tmp_path / "changes.gpkg")) as database, database:
        for name in ("ST_IsEmpty", "ST_MinX", "ST_MaxX", "ST_MinY", "ST_MaxY"):  # the index's triggers name them
            database.create_function(name, 1, lambda geometry: 0)
        database.execute(
            "UPDATE changes SET review_status = 'rejected', reviewer = 'M. Jansen', "
            "reviewed_at = '2024-05-01T10:30:00.000Z', review_note = ? WHERE object_id = 2",
            (HOSTILE,),
        )
    page = Page(rebuild_report(tmp_path).read_text(encoding="utf-8"))
    assert "rejected (M. Jansen, 2024-05-01): " + HOSTILE in page.text
    assert page.count("script") == 1


@pytest.mark.parametrize("missing", ["run.json", "changes.gpkg", "changes.laz"])
def test_incomplete_folder_is_refused_by_name(tmp_path: Path, missing: str) -> None:
    result, surveys = scene()
    write_outputs(result, surveys, tmp_path)
    (tmp_path / missing).unlink()
    with pytest.raises(InputError) as caught:
        rebuild_report(tmp_path)
    assert missing in explain(caught.value)


def test_summary_counts_and_figures() -> None:
    result, surveys = scene()
    figures = summarise(result, surveys)
    assert (figures["objects"], figures["changed"], figures["undetermined"]) == (4, 2, 1)
    assert figures["counts"]["Increased"]["building"] == 1 and sum(figures["counts"]["Removed"].values()) == 0
    assert figures["ground_changes"]["Decreased"] == {"pieces": 1, "area_m2": 48.0, "volume_m3": -19.2}
    assert figures["lod95"]["median_m"] == pytest.approx(0.08)  # of 0.05, 0.08, 0.11
    assert figures["lod95"]["valid_share"] == pytest.approx(0.6)
    assert figures["registration"]["sigma_position_m"] == pytest.approx(np.sqrt(6e-4))


def test_pages_of_equal_data_are_equal(tmp_path: Path) -> None:
    result, surveys = scene()
    assert page_of(result, surveys, tmp_path) == page_of(result, surveys, tmp_path)
    data = report.ReportData(
        summarise(result, surveys),
        result.objects,
        result.ground_changes,
        Pair(*(cloud[::-1].copy() for cloud in result.clouds)),
        Pair(*(numbers[::-1].copy() for numbers in result.object_of_voxel)),
        surveys.after.frame,
        result.parameters,
        run_document(result, surveys),
    )
    assert render(data) == page_of(result, surveys, tmp_path)  # the order of the points does not matter here


assert rasterio  # MemoryFile needs the package loaded whole
