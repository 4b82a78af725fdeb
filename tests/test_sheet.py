"""Contact sheets: what is shown, in which order, and where it is drawn."""

from __future__ import annotations

import builtins
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from loda_pdal.benchmark.protocols import judge
from loda_pdal.benchmark.runs import JudgedPoints
from loda_pdal.benchmark.sheet import (
    PLAN_PX,
    TILE_PX,
    MistakeTiles,
    ObjectNote,
    Tiles,
    changed_objects,
    mistakes,
    object_notes,
    write_sheets,
)
from loda_pdal.benchmark.truth import Truth, TruthInstance
from loda_pdal.model.errors import InputError
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair

UNCHANGED, ADDED, REMOVED = ChangeLabel.UNCHANGED, ChangeLabel.ADDED, ChangeLabel.REMOVED
AT = np.array([119_000.0, 485_000.0, 0.0])


def box_of(low: tuple[float, float, float], size: tuple[float, float, float], n: int = 800) -> np.ndarray:
    return AT + low + np.random.default_rng(n).random((n, 3)) * size


def scene() -> tuple[JudgedPoints, Truth]:
    """Ground in both epochs; a box that was added and called Unchanged; a smaller one, Unchanged and called Removed."""
    ground = box_of((0, 0, 0), (40, 30, 0.02), 6000)
    added, kept = box_of((8, 8, 0), (10, 4, 3)), box_of((28, 20, 0), (2, 2, 2))
    rows = [
        (ground, 0, 1, 0, 0, UNCHANGED),
        (ground, 1, 1, 0, 0, UNCHANGED),
        (added, 1, 1, 5, 1, ADDED),
        (kept, 0, REMOVED, 6, 2, UNCHANGED),
        (kept, 1, REMOVED, 6, 2, UNCHANGED),
    ]
    columns: list[list[Any]] = [[], [], [], [], [], [], []]
    for xyz, epoch, change, number, truth_id, truth_change in rows:
        values = (epoch, change, number, ObjectClass.BUILDING, truth_id, truth_change)
        dtypes = (np.uint8, np.uint8, np.int64, np.uint8, np.int64, np.uint8)
        columns[0].append(xyz)
        for column, value, dtype in zip(columns[1:], values, dtypes, strict=True):
            column.append(np.full(len(xyz), value, dtype=dtype))
    both, seen = Pair(True, True), Pair(None, None)
    instances = [
        TruthInstance(1, ObjectClass.BUILDING, ADDED, "shed", Pair(False, True), Pair(0, 800), Pair(0, 800), seen),
        TruthInstance(2, ObjectClass.OTHER, UNCHANGED, "bin", both, Pair(800, 800), Pair(0, 0), seen),
    ]
    return JudgedPoints(*map(np.concatenate, columns)), Truth(instances, np.eye(4), [], 1200.0)


def test_mistakes_come_by_size_with_what_is_known_of_them() -> None:
    points, truth = scene()
    notes = {5: ObjectNote("Unchanged", "building", "no cue above its limit")}
    found = mistakes(points, truth, judge(points, truth), notes, "a block")
    shed, bin_, alarm = found
    assert [label for _, label in shed.labels] == [ADDED, UNCHANGED]
    assert shed.lines[0] == "building, shed" and shed.lines[2].startswith("object 5, building, Unchanged: no cue")
    assert shed.lines[1].startswith("a block instance 1, 10.") and shed.lines[1].endswith("m, 0 + 800 points")
    assert points.truth_id[shed.points].tolist() == [1] * 800
    assert alarm.lines[0] == "false alarm on bin" and alarm.size == bin_.size < shed.size


def test_of_an_instance_that_changed_in_part_the_part_is_shown() -> None:
    points, _ = scene()
    is_bin = points.truth_id == 2
    points.truth_change[is_bin & (points.xyz[:, 2] > 1.0)] = ChangeLabel.INCREASED
    taller = TruthInstance(
        2, ObjectClass.OTHER, ChangeLabel.INCREASED, "bin", Pair(True, True), Pair(9, 9), Pair(9, 9), Pair(None, None)
    )
    changed = Truth([taller], np.eye(4), [], 1200.0)
    found = mistakes(points, changed, judge(points, changed), {}, "")[0]
    assert points.xyz[found.points, 2].min() > 1.0


def test_largest_changes_need_no_truth() -> None:
    points, _ = scene()
    found = changed_objects(points, {})
    assert len(found) == 1 and found[0].labels == [("Removed", REMOVED)]
    assert set(points.object[found[0].points]) == {6}


def test_plans_show_what_stands_only_after_in_blue_inside_its_outline() -> None:
    points, truth = scene()
    shed = mistakes(points, truth, judge(points, truth), {}, "")[0]
    picture = Tiles(points).draw(shed).picture.astype(int)
    assert picture.shape[1] == TILE_PX
    plan = picture[26 : 26 + PLAN_PX[0], 6 : 6 + PLAN_PX[1]]
    is_blue = plan[..., 2] > plan[..., 0] + 60
    rows, columns = np.nonzero(is_blue)
    centre = np.array([rows.mean() / PLAN_PX[0], columns.mean() / PLAN_PX[1]])
    assert is_blue.mean() > 0.05 and np.abs(centre - 0.5).max() < 0.05  # the window is about it
    height, width = np.ptp(rows), np.ptp(columns)
    assert 2.0 < width / height < 3.0
    is_orange = plan[..., 0] > plan[..., 2] + 60
    assert is_orange.mean() < 0.01


def test_pages_are_filled_one_after_the_other(tmp_path: Path) -> None:
    from PIL import Image

    points, truth = scene()
    tiles = MistakeTiles(2)
    tiles.add("", tmp_path, points, truth, judge(points, truth))
    tiles.add("", tmp_path, points, truth, judge(points, truth))
    assert tiles.n == 6 and len(tiles.largest) == 2
    assert tiles.largest[0].size == tiles.largest[1].size > 400  # the shed of either run
    pages = write_sheets(tiles.largest, "mistakes", tmp_path / "out.png", per_page=1)
    assert [page.name for page in pages] == ["out.png", "out_2.png"]
    with Image.open(pages[0]) as image:
        assert image.width > 4 * TILE_PX
    empty = write_sheets([], "nothing", tmp_path / "folder")
    assert empty == [tmp_path / "folder" / "sheet.png"] and empty[0].is_file()


def test_a_run_without_geopackage_has_no_notes(tmp_path: Path) -> None:
    assert object_notes(tmp_path) == {}


def test_without_pillow_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usual = builtins.__import__

    def refuse(name: str, *rest: Any, **more: Any) -> Any:
        if name == "PIL":
            raise ImportError(name)
        return usual(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(InputError, match=r"loda-pdal\[sheet\]"):
        write_sheets([], "nothing", tmp_path / "out.png")
