"""Change rules on objects made by hand: boxes whose sizes say what the label must be."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.pair import Pair
from loda_pdal.params import ConfidenceParams, ObservabilityParams, Parameters
from loda_pdal.stages.changes import Changes, decide_changes
from loda_pdal.stages.cues import Surface
from loda_pdal.stages.observability import Coverage, coverage
from loda_pdal.stages.rules import Cue, verdict_of

STREET = Parameters.preset("street")
LOD_M = 0.05


def block(x: float, y: float, length: float, width: float, top: float) -> tuple[FloatArray, FloatArray]:
    """Points (0.25 m apart) and normals of the walls and flat roof of a box that stands on z = 0."""
    along, across, up = (np.arange(0.125, size, 0.25) for size in (length, width, top))
    walls = []
    for offset, normal in ((0.0, (0, -1, 0)), (width, (0, 1, 0))):
        grid = np.stack(np.meshgrid(along, [offset], up, indexing="ij"), -1).reshape(-1, 3)
        walls.append((grid, np.tile(normal, (len(grid), 1))))
    for offset, normal in ((0.0, (-1, 0, 0)), (length, (1, 0, 0))):
        grid = np.stack(np.meshgrid([offset], across, up, indexing="ij"), -1).reshape(-1, 3)
        walls.append((grid, np.tile(normal, (len(grid), 1))))
    roof = np.stack(np.meshgrid(along, across, [top], indexing="ij"), -1).reshape(-1, 3)
    walls.append((roof, np.tile((0, 0, 1), (len(roof), 1))))
    return np.concatenate([w[0] for w in walls]) + np.array([x, y, 0.0]), np.concatenate([w[1] for w in walls])


def porch(x: float, y: float) -> tuple[FloatArray, FloatArray]:
    """What a survey shows of a porch against a wall at ``y``: all but its back."""
    points, normals = block(x, y - 1.5, 2.5, 1.5, 2.75)
    is_front = points[:, 1] < y
    return points[is_front], normals[is_front]


GROUND = np.stack(np.meshgrid(np.arange(-5.0, 55.0, 0.25), np.arange(-5.0, 30.0, 0.25), [0.0]), -1).reshape(-1, 3)


def surface(*parts: tuple[int, tuple[FloatArray, FloatArray]]) -> Surface:
    """One epoch of numbered parts on level ground."""
    parts = (*parts, (-1, (GROUND, np.tile((0, 0, 1), (len(GROUND), 1)))))
    xyz = np.concatenate([points for _, (points, _) in parts])
    normals = np.concatenate([n for _, (_, n) in parts]).astype(np.float32)
    owner = np.concatenate([np.full(len(points), number, np.int32) for number, (points, _) in parts])
    return Surface(xyz, normals, xyz[:, 2].copy(), np.full(len(xyz), 5, np.int32), owner, owner >= 0)


def joined(*parts: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Several parts as one."""
    return np.concatenate([p for p, _ in parts]), np.concatenate([n for _, n in parts])


def lod_everywhere(surfaces: Pair[Surface]) -> LodGrid:
    """The same limit in every occupied cell."""
    xyz = np.concatenate([side.xyz[side.is_surface] for side in surfaces])
    cells = np.unique(np.floor(xyz).astype(np.int32), axis=0)
    n = len(cells)
    return LodGrid(
        cells, 1.0, np.full(n, LOD_M, np.float32), np.zeros((n, 3), np.float32), np.full(n, 50, np.int32),
        np.full(n, 50, np.int32), np.ones(n, np.bool_), np.zeros(n, np.float32), 0.5,
    )  # fmt: skip


def everywhere() -> Coverage:
    ground = np.stack(np.meshgrid(np.arange(-20.0, 80.0), np.arange(-20.0, 40.0), [0.0]), -1).reshape(-1, 3)
    return coverage(ground, ObservabilityParams())


def decide(before: Surface, after: Surface, *classes: ObjectClass, seen: Pair[Coverage] | None = None) -> Changes:
    pair = Pair(before, after)
    seen = seen or Pair(everywhere(), everywhere())
    codes = np.array(classes, dtype=np.uint8)
    return decide_changes(
        pair, codes, seen, lod_everywhere(pair), STREET.changes, STREET.observability, ConfidenceParams()
    )


def labels(changes: Changes) -> list[ChangeLabel]:
    return [ChangeLabel(code) for code in changes.label.tolist()]


HOUSE = block(0, 0, 10, 8, 6)


@pytest.mark.parametrize(
    ("after", "expected"),
    [
        (block(0, 0, 10, 8, 6), ChangeLabel.UNCHANGED),
        (block(0, 0, 10, 8, 9), ChangeLabel.INCREASED),
        (block(0, 0, 10, 8, 3), ChangeLabel.DECREASED),
        (block(0, 0, 14, 8, 6), ChangeLabel.INCREASED),
        (block(0.02, 0.02, 10, 8, 6.05), ChangeLabel.UNCHANGED),
    ],
)
def test_a_house_is_labelled_by_what_was_done_to_it(
    after: tuple[FloatArray, FloatArray], expected: ChangeLabel
) -> None:
    found = decide(surface((0, HOUSE)), surface((0, after)), ObjectClass.BUILDING)
    assert set(labels(found)) == {expected}
    assert 0 <= found.confidence[0] <= 1


def test_the_storey_is_measured() -> None:
    found = decide(surface((0, HOUSE)), surface((0, block(0, 0, 10, 8, 9))), ObjectClass.BUILDING)
    assert found.evidence.dh[0] == pytest.approx(3.0, abs=0.01)
    assert "top +3.00 m" in found.reason[0]
    assert "LoD95 0.05 m" in found.reason[0]


def test_a_moved_facade_is_a_change_even_with_equal_height_and_volume() -> None:
    moved = block(0, -0.3, 10, 8.6, 6)
    found = decide(surface((0, HOUSE)), surface((0, moved)), ObjectClass.BUILDING)
    assert labels(found)[0] in (ChangeLabel.INCREASED, ChangeLabel.DECREASED, ChangeLabel.UNCHANGED)
    wall = tuple(part[HOUSE[1][:, 1] < 0] for part in HOUSE)
    shifted = (wall[0] + [0, -0.3, 0], wall[1])
    found = decide(surface((0, wall)), surface((0, shifted)), ObjectClass.BUILDING)
    assert abs(found.evidence.d_perp[0]) == pytest.approx(0.3, abs=0.01)
    assert labels(found)[0] in (ChangeLabel.INCREASED, ChangeLabel.DECREASED)
    assert "along its normal" in found.reason[0]


def test_what_stands_alone_is_added_or_removed_only_where_the_other_survey_saw() -> None:
    added = decide(surface(), surface((0, HOUSE)), ObjectClass.BUILDING)
    assert labels(added) == [ChangeLabel.ADDED]
    assert labels(decide(surface((0, HOUSE)), surface(), ObjectClass.BUILDING)) == [ChangeLabel.REMOVED]
    elsewhere = coverage(np.array([[60.0, 30.0, 0.0]]), ObservabilityParams())
    unseen = decide(surface(), surface((0, HOUSE)), ObjectClass.BUILDING, seen=Pair(elsewhere, everywhere()))
    assert labels(unseen) == [ChangeLabel.UNDETERMINED]
    assert np.isnan(unseen.confidence[0])
    assert "could have seen only 0%" in unseen.reason[0]


def test_a_pair_that_is_no_pair_is_two_objects() -> None:
    found = decide(surface((0, HOUSE)), surface((0, block(20, 0, 10, 8, 6))), ObjectClass.BUILDING)
    assert sorted(labels(found)) == [ChangeLabel.ADDED, ChangeLabel.REMOVED]


def test_one_house_of_a_terrace_changes_alone() -> None:
    row = block(0, 0, 40, 8, 6)
    storey = block(10, 0, 8, 8, 9)
    raised = tuple(np.concatenate(both) for both in zip(row, storey, strict=True))
    before, after = surface((0, row)), surface((0, (raised[0], raised[1])))
    found = decide(before, after, ObjectClass.BUILDING)
    assert sorted(labels(found)) == [ChangeLabel.UNCHANGED, ChangeLabel.INCREASED]
    part = labels(found).index(ChangeLabel.INCREASED)
    assert labels(found)[found.parent[part]] == ChangeLabel.UNCHANGED
    x = before.xyz[found.owner.before == part, 0]
    assert x.min() >= 9.5
    assert x.max() <= 18.5


def test_a_porch_changes_its_house_and_hides_the_wall_behind() -> None:
    inside = (HOUSE[0][:, 0] > 2) & (HOUSE[0][:, 0] < 4.5) & (HOUSE[0][:, 1] == 0) & (HOUSE[0][:, 2] < 2.75)
    hidden = (HOUSE[0][~inside], HOUSE[1][~inside])
    there = decide(surface((0, HOUSE)), surface((0, joined(hidden, porch(2, 0)))), ObjectClass.BUILDING)
    assert labels(there) == [ChangeLabel.INCREASED] * 2
    house, part = (0, 1) if there.parent[1] == 0 else (1, 0)
    assert there.parent[part] == house
    assert there.reason[house].startswith("a part of it changed")
    assert np.all(there.owner.before[: len(HOUSE[0])][HOUSE[0][:, 1] > 2] == house)
    back = decide(surface((0, joined(hidden, porch(2, 0)))), surface((0, HOUSE)), ObjectClass.BUILDING)
    assert [label.swapped for label in labels(there)] == labels(back)


def test_a_wall_that_is_seen_through_what_stands_before_it_is_no_wall_of_an_annex() -> None:
    """The same porch, but all of the wall behind it is there to be seen still: a scaffold."""
    scaffold = porch(2, 0)
    found = decide(surface((0, HOUSE)), surface((0, joined(HOUSE, scaffold))), ObjectClass.BUILDING)
    house = int(found.owner.before[0])
    assert labels(found)[house] == ChangeLabel.UNCHANGED
    assert sorted(labels(found)) == [ChangeLabel.UNCHANGED, ChangeLabel.INCREASED]
    back = decide(surface((0, joined(HOUSE, scaffold))), surface((0, HOUSE)), ObjectClass.BUILDING)
    assert [label.swapped for label in labels(found)] == labels(back)


def test_a_stem_before_a_house_does_not_change_it() -> None:
    stem = block(2.05, -0.7, 0.4, 0.4, 5.5)
    found = decide(surface((0, joined(HOUSE, stem))), surface((0, HOUSE)), ObjectClass.BUILDING)
    assert labels(found)[int(found.owner.after[0])] == ChangeLabel.UNCHANGED


def gable(with_dormer: bool) -> tuple[FloatArray, FloatArray]:
    """A house with a roof that rises from its front at 3 m, and with a dormer 2 m wide on it or not."""
    walls = block(0, 0, 6, 6, 3)
    is_wall = walls[0][:, 2] < 3
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0.125, 6, 0.25), np.arange(0.125, 6, 0.25), indexing="ij"))
    is_front = with_dormer & (x > 2) & (x < 4) & (y < 2.5)
    roof = np.column_stack([x, y, np.where(is_front, 5.5, 3.0 + 0.8 * y)])
    tilted = np.where(is_front[:, None], [0.0, 0.0, 1.0], np.array([0.0, -0.8, 1.0]) / np.hypot(1, 0.8))
    front = np.stack(np.meshgrid(np.arange(2.125, 4, 0.25), [0.0], np.arange(3.125, 5.5, 0.25)), -1).reshape(-1, 3)
    front = front[: len(front) * with_dormer]
    return joined(
        (walls[0][is_wall], walls[1][is_wall]), (roof, tilted), (front, np.tile((0.0, -1.0, 0.0), (len(front), 1)))
    )


def test_a_dormer_changes_its_house_and_an_edge_one_column_wide_does_not() -> None:
    before, after = surface((0, gable(False))), surface((0, gable(True)))
    there, back = decide(before, after, ObjectClass.BUILDING), decide(after, before, ObjectClass.BUILDING)
    assert set(labels(there)) == {ChangeLabel.INCREASED}
    assert [label.swapped for label in labels(there)] == labels(back)
    gutter = block(0, 0, 6, 0.25, 4)
    edge = decide(before, surface((0, joined(gable(False), gutter))), ObjectClass.BUILDING)
    assert labels(edge)[int(edge.owner.before[-len(GROUND) - 1])] == ChangeLabel.UNCHANGED


def test_one_of_a_pair_of_houses_is_removed_and_the_other_stays() -> None:
    neighbour = block(7, 0, 7, 8, 6)
    house = block(0, 0, 7, 8, 6)
    found = decide(surface((0, joined(house, neighbour))), surface((0, house)), ObjectClass.BUILDING)
    assert sorted(labels(found)) == [ChangeLabel.UNCHANGED, ChangeLabel.REMOVED]
    assert labels(found)[int(found.owner.after[0])] == ChangeLabel.UNCHANGED


def test_what_a_few_returns_show_is_undetermined() -> None:
    thing = block(0, 0, 0.5, 0.5, 1)
    few = (thing[0][:2], thing[1][:2])
    assert labels(decide(surface((0, thing)), surface(), ObjectClass.OTHER)) == [ChangeLabel.REMOVED]
    found = decide(surface((0, few)), surface(), ObjectClass.OTHER)
    assert labels(found) == [ChangeLabel.UNDETERMINED]
    assert found.reason == (
        "too little of it to tell: 10 returns where the after survey saw nothing (at least 12 needed)",
    )


def test_what_rises_no_higher_than_the_ground_neither_came_nor_went() -> None:
    slab, table = block(0, 0, 2, 2, 0.25), block(0, 0, 2, 2, 0.75)
    found = decide(surface((0, slab)), surface(), ObjectClass.OTHER)
    assert labels(found) == [ChangeLabel.UNDETERMINED]
    assert found.reason == ("no higher than 0.25 m above the ground: a piece of it",)
    assert labels(decide(surface((0, table)), surface(), ObjectClass.OTHER)) == [ChangeLabel.REMOVED]


def test_a_party_wall_that_shows_when_the_house_beside_it_goes_has_not_changed() -> None:
    """Of a row one house goes that hid the wall of the next, 3 m of which are seen from the street."""
    points, normals = block(0, 0, 24, 8, 6)
    is_front = points[:, 1] == 0
    row = points[is_front], normals[is_front]
    left = tuple(part[row[0][:, 0] < 16] for part in row)
    depth, up = np.arange(0.125, 3, 0.25), np.arange(0.125, 6, 0.25)
    wall = np.stack(np.meshgrid([16.0], depth, up, indexing="ij"), -1).reshape(-1, 3)
    party = wall, np.tile((1, 0, 0), (len(wall), 1))
    before, after = surface((0, row)), surface((0, joined(left, party)))
    found = decide(before, after, ObjectClass.BUILDING)
    assert set(labels(found)) == {ChangeLabel.UNCHANGED, ChangeLabel.REMOVED}
    back = decide(after, before, ObjectClass.BUILDING)
    assert [label.swapped for label in labels(found)] == labels(back)


def front(x: float, length: float, top: float) -> tuple[FloatArray, FloatArray]:
    """What the street shows of houses of a row: the wall along y = 0."""
    points, normals = block(x, 0, length, 8, top)
    is_front = (points[:, 1] == 0) & (normals[:, 1] == -1)
    return points[is_front], normals[is_front]


def test_a_narrow_house_of_a_row_is_removed_whose_front_alone_is_seen() -> None:
    """5 m of a row 9 m high: a sheet of less than 20 m3, of which a porch would be a piece."""
    whole, rest = front(0, 30, 9), joined(front(0, 12, 9), front(17, 13, 9))
    before, after = surface((0, whole)), surface((0, rest))
    found, back = decide(before, after, ObjectClass.BUILDING), decide(after, before, ObjectClass.BUILDING)
    assert sorted(labels(found)) == [ChangeLabel.UNCHANGED, ChangeLabel.REMOVED]
    x = before.xyz[found.owner.before == labels(found).index(ChangeLabel.REMOVED), 0]
    assert 12.0 <= x.min() <= 13.0
    assert 16.0 <= x.max() <= 17.0
    assert [label.swapped for label in labels(found)] == labels(back)


def test_a_house_that_goes_beside_one_that_loses_a_storey_is_removed_and_the_other_decreased() -> None:
    whole = front(0, 32, 9)
    rest = joined(front(0, 12, 9), front(18, 6, 6), front(24, 8, 9))
    before, after = surface((0, whole)), surface((0, rest))
    found, back = decide(before, after, ObjectClass.BUILDING), decide(after, before, ObjectClass.BUILDING)
    middle = [int(found.owner.before[np.argmin(np.linalg.norm(before.xyz - [x, 0, z], axis=1))])
              for x, z in ((15, 4), (21.5, 8))]  # fmt: skip
    assert [labels(found)[i] for i in middle] == [ChangeLabel.REMOVED, ChangeLabel.DECREASED]
    assert [label.swapped for label in labels(found)] == labels(back)


def test_a_wide_annex_before_a_row_is_no_house_of_it() -> None:
    annex = block(12, -3, 6, 3, 3)
    annex = tuple(part[annex[0][:, 1] < 0] for part in annex)
    row = front(0, 30, 9)
    is_hidden = (row[0][:, 0] > 12) & (row[0][:, 0] < 18) & (row[0][:, 2] < 3)
    shown = row[0][~is_hidden], row[1][~is_hidden]
    found = decide(surface((0, row)), surface((0, joined(shown, (annex[0], annex[1])))), ObjectClass.BUILDING)
    assert set(labels(found)) == {ChangeLabel.UNCHANGED, ChangeLabel.INCREASED}


def crown(x: float, length: float) -> tuple[FloatArray, FloatArray]:
    """The upper half of a box 6 m high."""
    points, normals = block(x, 0, length, 3, 6)
    return points[points[:, 2] > 3], normals[points[:, 2] > 3]


@pytest.mark.parametrize(("n_raw", "expected"), [(5, ChangeLabel.ADDED), (200, ChangeLabel.UNDETERMINED)])
def test_a_crown_is_new_only_where_the_other_survey_samples_enough_to_show_it(
    n_raw: int, expected: ChangeLabel
) -> None:
    """Beside what the before survey shows with as many returns as the after survey, or with a fortieth of them."""
    house, new = block(0, 0, 3, 3, 6), crown(4, 3)
    before, after = surface((0, house)), surface((0, house), (1, new))
    after = replace(after, n_raw=np.where(after.owner == 0, n_raw, 5).astype(np.int32))
    there = decide(before, after, ObjectClass.BUILDING, ObjectClass.VEGETATION)
    assert labels(there)[int(there.owner.after[len(house[0])])] == expected
    back = decide(after, before, ObjectClass.BUILDING, ObjectClass.VEGETATION)
    assert [label.swapped for label in labels(there)] == labels(back)


def test_of_two_crowns_in_one_piece_one_goes_and_the_other_stays() -> None:
    one, other = crown(0, 4), crown(4, 3)
    found = decide(surface((0, joined(one, other))), surface((0, one)), ObjectClass.VEGETATION)
    assert sorted(labels(found)) == [ChangeLabel.UNCHANGED, ChangeLabel.REMOVED]
    assert labels(found)[int(found.owner.after[0])] == ChangeLabel.UNCHANGED


def scaffold(x: float, y: float, length: float, top: float) -> tuple[FloatArray, FloatArray]:
    """Decks every 2 m and poles every 2.5 m, 1 m deep: the wall behind shows between them."""
    decks = np.arange(2.0, top + 0.1, 2.0)
    deck = np.stack(np.meshgrid(np.arange(0.125, length, 0.25), np.arange(0.0, 1.1, 0.25), decks), -1).reshape(-1, 3)
    pole = np.stack(np.meshgrid(np.arange(0.125, length, 2.5), [0.0], np.arange(0.125, top, 0.25)), -1).reshape(-1, 3)
    normals = np.repeat([[0, 0, 1], [0, -1, 0]], [len(deck), len(pole)], axis=0)
    return np.concatenate([deck, pole]) + np.array([x, y, 0.0]), normals


def test_scaffolding_before_a_wall_that_shows_behind_it_is_no_growth_of_the_house() -> None:
    before, after = surface((0, HOUSE)), surface((0, joined(HOUSE, scaffold(1, -1.5, 7, 6))))
    found = decide(before, after, ObjectClass.BUILDING)
    assert sorted(labels(found)) == [ChangeLabel.UNCHANGED, ChangeLabel.ADDED]
    part = labels(found).index(ChangeLabel.ADDED)
    assert found.reason[part].startswith("the wall behind it shows as before")
    assert labels(found)[found.parent[part]] == ChangeLabel.UNCHANGED
    back = decide(after, before, ObjectClass.BUILDING)
    assert [label.swapped for label in labels(found)] == labels(back)


def test_as_wide_an_extension_that_hides_the_wall_is_growth() -> None:
    wing = block(1, -1.5, 7, 1.5, 3.0)
    is_back = (wing[0][:, 1] == 0) & (wing[1][:, 1] == 1)
    wing = wing[0][~is_back], wing[1][~is_back]
    is_hidden = (HOUSE[0][:, 0] > 1) & (HOUSE[0][:, 0] < 8) & (HOUSE[0][:, 1] == 0) & (HOUSE[0][:, 2] < 3)
    rest = HOUSE[0][~is_hidden], HOUSE[1][~is_hidden]
    found = decide(surface((0, HOUSE)), surface((0, joined(rest, wing))), ObjectClass.BUILDING)
    assert set(labels(found)) == {ChangeLabel.INCREASED}


def test_of_two_houses_that_touch_one_is_removed_and_the_other_stays() -> None:
    one, other = block(0, 0, 6, 7, 6), block(6, 0, 6, 7, 6)
    before, after = surface((0, joined(one, other))), surface((0, one))
    found = decide(before, after, ObjectClass.BUILDING)
    assert sorted(labels(found)) == [ChangeLabel.UNCHANGED, ChangeLabel.REMOVED]
    gone = labels(found).index(ChangeLabel.REMOVED)
    assert before.xyz[found.owner.before == gone, 0].min() > 5.0
    assert [label.swapped for label in labels(found)] == labels(decide(after, before, ObjectClass.BUILDING))


def pent_shed(x: float, y: float, fall: float) -> tuple[FloatArray, FloatArray]:
    """What a survey shows of a shed against a wall at ``y``: front and sides, under a roof that falls to the wall."""
    points, normals = block(x, y - 2, 2.5, 2.0, 3.0)
    depth = y - points[:, 1]
    is_shown = (depth > 0) & (points[:, 2] <= 2.3 + fall * depth) & (normals[:, 2] == 0)
    return points[is_shown], normals[is_shown]


@pytest.mark.parametrize(
    ("fall", "house", "part"),
    [
        (0.0, ChangeLabel.INCREASED, ChangeLabel.INCREASED),
        (0.25, ChangeLabel.UNCHANGED, ChangeLabel.ADDED),
        (-0.25, ChangeLabel.INCREASED, ChangeLabel.INCREASED),
    ],
    ids=["level", "towards the wall", "away from it"],
)
def test_a_roof_that_falls_towards_the_wall_is_no_annex(fall: float, house: ChangeLabel, part: ChangeLabel) -> None:
    x, y, z = HOUSE[0].T
    is_hidden = (x > 2) & (x < 4.5) & (y == 0) & (z < 2.3)
    hidden = HOUSE[0][~is_hidden], HOUSE[1][~is_hidden]
    before, after = surface((0, HOUSE)), surface((0, joined(hidden, pent_shed(2, 0, fall))))
    found = decide(before, after, ObjectClass.BUILDING)
    of_house = int(found.owner.before[np.flatnonzero(y > 2)[0]])
    assert labels(found)[of_house] == house
    assert [label for i, label in enumerate(labels(found)) if i != of_house] == [part]
    assert [label.swapped for label in labels(found)] == labels(decide(after, before, ObjectClass.BUILDING))


def test_a_sliver_of_a_wall_is_no_part_of_a_house() -> None:
    """A stack of voxels up a side wall that one survey met and the other did not."""
    sliver = block(10.3, 1.0, 0.25, 0.5, 5.5)
    found = decide(surface((0, joined(HOUSE, sliver))), surface((0, HOUSE)), ObjectClass.BUILDING)
    assert labels(found) == [ChangeLabel.UNCHANGED]


def test_a_shed_that_was_paired_with_the_house_beside_it_stays_when_the_house_goes() -> None:
    house, shed = block(0, 0, 12, 9, 8), block(12.5, 0, 2.5, 2, 2.5)
    found = decide(surface((0, joined(house, shed))), surface((0, shed)), ObjectClass.BUILDING)
    assert set(labels(found)) == {ChangeLabel.UNCHANGED, ChangeLabel.REMOVED}
    assert all(labels(found)[i] == ChangeLabel.UNCHANGED for i in set(found.owner.after[: len(shed[0])].tolist()))


def without_ground(side: Surface, low: float, high: float) -> Surface:
    """The same survey, which shows no ground between ``low`` and ``high`` along x."""
    is_kept = (side.owner >= 0) | (side.xyz[:, 0] < low) | (side.xyz[:, 0] > high)
    return Surface(*(getattr(side, item.name)[is_kept] for item in fields(side)))


def test_what_stands_in_the_shadow_of_something_has_neither_come_nor_gone() -> None:
    """A car that one survey shows, where the other shows nothing of the ground beside it: a lorry stood before both."""
    car = block(10, 0, 4.5, 1.8, 1.5)
    there, bare = surface((0, car)), surface()
    assert labels(decide(there, bare, ObjectClass.MOBILE)) == [ChangeLabel.REMOVED]
    found = decide(there, without_ground(bare, 5, 20), ObjectClass.MOBILE)
    assert labels(found) == [ChangeLabel.UNDETERMINED]
    assert labels(decide(without_ground(bare, 5, 20), there, ObjectClass.MOBILE)) == [ChangeLabel.UNDETERMINED]


def test_what_both_surveys_show_of_a_thing_is_unchanged_however_little_of_the_rest_one_saw() -> None:
    row = block(0, 0, 45, 8, 6)
    is_near = row[0][:, 0] < 6
    near = coverage(GROUND[GROUND[:, 0] < 5], ObservabilityParams())
    before, after = surface((0, (row[0][is_near], row[1][is_near]))), surface((0, row))
    found = decide(before, after, ObjectClass.BUILDING, seen=Pair(near, everywhere()))
    assert found.evidence.observability[0] < STREET.observability.min_observability
    assert labels(found) == [ChangeLabel.UNCHANGED]


def test_a_porch_on_a_row_changes_one_frontage_of_it() -> None:
    row = block(0, 0, 40, 8, 6)
    is_hidden = (np.abs(row[0][:, 0] - 21.25) < 1.25) & (row[0][:, 1] == 0) & (row[0][:, 2] < 2.75)
    shown = (row[0][~is_hidden], row[1][~is_hidden])
    found = decide(surface((0, row)), surface((0, joined(shown, porch(20, 0)))), ObjectClass.BUILDING)
    assert sorted(labels(found)) == [ChangeLabel.UNCHANGED, ChangeLabel.INCREASED, ChangeLabel.INCREASED]
    x = row[0][:, 0]
    is_changed = found.label[found.owner.before[: len(x)]] == ChangeLabel.INCREASED
    assert x[is_changed].min() == pytest.approx(18.25, abs=0.5)
    assert x[is_changed].max() == pytest.approx(24.25, abs=0.5)


def hedge(x: float, length: float) -> tuple[FloatArray, FloatArray]:
    """What a survey shows of a hedge 0.75 m wide and 1.25 m high: leaves that lie anywhere and face anywhere."""
    rng = np.random.default_rng(7)
    n = int(60 * length)
    facing = rng.normal(size=(n, 3))
    points = rng.random((n, 3)) * [length, 0.75, 1.25] + [x, 0.0, 0.0]
    return points, facing / np.linalg.norm(facing, axis=1, keepdims=True)


@pytest.mark.parametrize("kind", [ObjectClass.VEGETATION, ObjectClass.OTHER])
@pytest.mark.parametrize("pieces", [(0, 0), (0, 1)])
def test_a_hedge_of_which_a_part_was_taken_out_is_less_of_a_hedge(kind: ObjectClass, pieces: tuple[int, int]) -> None:
    stays, gone = hedge(0, 2.5), hedge(2.5, 2.5)
    before, after = surface((pieces[0], stays), (pieces[1], gone)), surface((0, stays))
    classes = [kind] * (max(pieces) + 1)
    assert labels(decide(before, after, *classes)) == [ChangeLabel.DECREASED]
    assert labels(decide(after, before, *classes)) == [ChangeLabel.INCREASED]


@pytest.mark.parametrize("gone_m", [(1.5, 3.5), (3.0, 5.0)], ids=["in the middle", "at the end"])
def test_a_bush_before_a_hedge_is_none_of_it(gone_m: tuple[float, float]) -> None:
    """The bush is merged with the hedge in both surveys, and stays; of the hedge a piece went."""
    points, facing = hedge(0, 5)
    is_gone = (points[:, 0] > gone_m[0]) & (points[:, 0] < gone_m[1])
    stays, gone = (points[~is_gone], facing[~is_gone]), (points[is_gone], facing[is_gone])
    aside, around = hedge(0, 1.25)
    bush = aside[:, [1, 0, 2]] * [1, 1, 0.8] + [0.25, 0.8, 0.0], around
    before, after = surface((0, joined(stays, bush)), (1, gone)), surface((0, joined(stays, bush)))
    for found, side, label in (
        (decide(before, after, *[ObjectClass.VEGETATION] * 2), "before", ChangeLabel.DECREASED),
        (decide(after, before, *[ObjectClass.VEGETATION] * 2), "after", ChangeLabel.INCREASED),
    ):
        shown = np.concatenate([stays[0], bush[0], gone[0]])
        of_all = found.label[getattr(found.owner, side)[: len(shown)]]
        is_hedge = shown[:, 1] < 0.75
        assert np.all(of_all[~is_hedge & (shown[:, 1] > 1.1)] == ChangeLabel.UNCHANGED)
        assert np.mean(of_all[is_hedge] == label) > 0.8


def test_a_table_taken_from_a_row_is_gone() -> None:
    """Tables stand in a line, as wide and as high, and as rough as foliage with all that stands on them and about."""
    rng = np.random.default_rng(3)
    boards = rng.random((200, 3)) * [1.2, 0.7, 0.3] + [0.0, 0.0, 0.5]
    feet = rng.random((100, 3)) * [1.7, 0.7, 0.5]
    table = np.concatenate([boards, feet])

    def row(n: int) -> tuple[FloatArray, FloatArray]:
        points = np.concatenate([table + np.array([1.7 * i, 0.0, 0.0]) for i in range(n)])
        facing = rng.normal(size=points.shape)
        return points, facing / np.linalg.norm(facing, axis=1, keepdims=True)

    two, three = row(2), row(3)
    is_third = three[0][:, 0] > 3.4
    gone = three[0][is_third], three[1][is_third]
    found = decide(surface((0, two), (1, gone)), surface((0, two)), *[ObjectClass.OTHER] * 2)
    assert labels(found) == [ChangeLabel.UNCHANGED, ChangeLabel.REMOVED]


def test_a_bin_at_the_end_of_a_hedge_is_a_thing_of_its_own() -> None:
    stays, box = hedge(0, 4), block(4.25, 0, 0.75, 0.75, 1.25)
    found = decide(surface((0, joined(stays, box))), surface((0, stays)), ObjectClass.OTHER)
    assert labels(found) == [ChangeLabel.UNCHANGED, ChangeLabel.REMOVED]


@pytest.mark.parametrize("both_have", [True, False])
def test_a_bicycle_against_a_bench_is_a_thing_of_its_own(both_have: bool) -> None:
    """All of it lies within reach of the bench, and the bench of none of its points."""
    bench, bicycle = block(0, 0, 2, 0.5, 0.75), block(0.25, -0.5, 1.5, 0.05, 1.0)
    other = surface((0 if both_have else -1, bench))
    other = replace(other, is_surface=other.xyz[:, 2] > 0)
    with_it = surface((0, joined(bench, bicycle) if both_have else bicycle))
    there, back = decide(with_it, other, ObjectClass.OTHER), decide(other, with_it, ObjectClass.OTHER)
    for found, side, label in ((there, "before", ChangeLabel.REMOVED), (back, "after", ChangeLabel.ADDED)):
        owner = getattr(found.owner, side)[: len(with_it.xyz) - len(GROUND)]
        told = found.label[owner][-len(bicycle[0]) :]
        assert np.mean(told == label) > 0.8
        if both_have:
            assert np.all(found.label[owner][: len(bench[0])] == ChangeLabel.UNCHANGED)


def test_the_pole_of_a_sign_of_which_the_other_survey_met_the_plate_has_not_come() -> None:
    pole, plate = block(0, 0, 0.05, 0.05, 1.75), block(-0.25, 0, 0.5, 0.05, 0.75)
    plate = plate[0] + [0.0, 0.0, 1.75], plate[1]
    box = block(0.6, 0, 1, 1, 1)
    found = decide(surface((0, joined(plate, box))), surface((0, joined(plate, box, pole))), ObjectClass.OTHER)
    assert labels(found) == [ChangeLabel.UNCHANGED]


def test_a_plant_beside_another_is_a_thing_of_its_own_on_the_street() -> None:
    rng = np.random.default_rng(3)
    bushes = [(rng.random((150, 3)) * [1.4, 1.4, 0.9] + [x, 0.0, 0.0], rng.normal(size=(150, 3))) for x in (0.0, 2.2)]
    one, other = ((points, n / np.linalg.norm(n, axis=1, keepdims=True)) for points, n in bushes)
    found = decide(surface((0, one)), surface((0, joined(one, other))), ObjectClass.VEGETATION)
    assert labels(found) == [ChangeLabel.UNCHANGED, ChangeLabel.ADDED]


def test_no_part_of_a_new_vehicle_is_taken_for_those_that_it_stands_between() -> None:
    cars = [block(0, 0, 4.5, 1.8, 1.5), block(4.9, 0, 4.5, 1.8, 1.5), block(9.8, 0, 4.5, 1.8, 1.5)]
    before = surface((0, cars[0]), (1, cars[2]))
    after = surface((0, cars[0]), (1, cars[2]), (2, cars[1]))
    found = decide(before, after, *[ObjectClass.MOBILE] * 3)
    assert sorted(labels(found)) == [ChangeLabel.UNCHANGED, ChangeLabel.UNCHANGED, ChangeLabel.ADDED]


def test_one_of_two_vehicles_in_one_piece_leaves_alone() -> None:
    one, other = block(0, 0, 4.5, 1.8, 1.5), block(5.0, 0.0, 4.5, 1.8, 1.5)
    before, after = surface((0, joined(one, other))), surface((0, one))
    there, back = decide(before, after, ObjectClass.MOBILE), decide(after, before, ObjectClass.MOBILE)
    assert labels(there) == [ChangeLabel.UNCHANGED, ChangeLabel.REMOVED]
    assert labels(back) == [ChangeLabel.UNCHANGED, ChangeLabel.ADDED]


def test_a_lamp_stays_where_a_tree_is_planted_about_it() -> None:
    lamp, crown = block(0, 0, 0.25, 0.25, 5), block(-2, -2, 4.5, 4.5, 7)
    found = decide(surface((0, lamp)), surface((0, joined(lamp, crown))), ObjectClass.VEGETATION)
    assert sorted(labels(found)) == [ChangeLabel.UNCHANGED, ChangeLabel.ADDED]
    assert labels(found)[found.owner.before[0]] == ChangeLabel.UNCHANGED


@pytest.mark.parametrize(
    ("after", "is_other"),
    [
        (block(0.4, 0.05, 4.5, 1.8, 1.5), False),
        (block(0, 0, 4.5, 1.8, 1.7), True),
    ],
    ids=["parked again", "higher"],
)
def test_another_vehicle_in_the_same_slot_is_told_by_its_shape(
    after: tuple[FloatArray, FloatArray], is_other: bool
) -> None:
    car = block(0, 0, 4.5, 1.8, 1.5)
    found = decide(surface((0, car)), surface((0, after)), ObjectClass.MOBILE)
    expected = [ChangeLabel.ADDED, ChangeLabel.REMOVED] if is_other else [ChangeLabel.UNCHANGED]
    assert sorted(labels(found)) == expected


@pytest.mark.parametrize(
    ("after", "object_class", "is_other"),
    [
        (block(0, 0.1, 8, 0.5, 1), ObjectClass.OTHER, True),
        (block(0, 0.1, 8, 0.5, 1), ObjectClass.MOBILE, True),
        (block(0, 0.1, 8, 0.5, 1), ObjectClass.VEGETATION, False),
        (block(0, 0.04, 8, 0.5, 1), ObjectClass.OTHER, False),
        (joined(block(0, 0, 5, 0.5, 1), block(5, 0.1, 3, 0.5, 1)), ObjectClass.OTHER, False),
    ],
    ids=["aside", "taken for a vehicle", "a hedge", "within the limit", "most of it in its place"],
)
def test_another_wall_in_the_same_line_is_told_by_its_faces(
    after: tuple[FloatArray, FloatArray], object_class: ObjectClass, is_other: bool
) -> None:
    before, after_side = surface((0, block(0, 0, 8, 0.5, 1))), surface((0, after))
    expected = [ChangeLabel.ADDED, ChangeLabel.REMOVED] if is_other else [ChangeLabel.UNCHANGED]
    assert sorted(labels(decide(before, after_side, object_class))) == expected
    assert sorted(labels(decide(after_side, before, object_class))) == expected


def test_a_piece_of_a_wall_is_no_other_vehicle() -> None:
    """Low pieces of two shapes, as in the test above, but under the eaves of a house."""
    car, higher, house = block(0, 0, 4.5, 1.8, 1.5), block(0, 0, 4.5, 1.8, 1.7), block(-1, -1, 8, 6, 6)
    found = decide(
        surface((0, car), (1, house)), surface((0, higher), (1, house)), ObjectClass.MOBILE, ObjectClass.BUILDING
    )
    assert labels(found) == [ChangeLabel.UNCHANGED] * 2


def test_two_vehicles_in_one_piece_in_one_survey_only_stay_in_their_place() -> None:
    one, other = block(0, 0, 4.5, 1.8, 1.5), block(5.0, 0.0, 4.5, 1.8, 1.5)
    found = decide(
        surface((0, one), (1, other)), surface((0, joined(one, other))), ObjectClass.MOBILE, ObjectClass.VEGETATION
    )
    assert set(labels(found)) == {ChangeLabel.UNCHANGED}


def bush(seed: int, top: float, spread: float) -> tuple[FloatArray, FloatArray]:
    """Points of foliage 4 m wide, down to 1 m below tops that scatter by up to ``spread`` about ``top`` m."""
    rng = np.random.default_rng(seed)
    plan = np.stack(np.meshgrid(np.arange(0.25, 4, 0.5), np.arange(0.25, 4, 0.5)), -1).reshape(-1, 2)
    tops = top + rng.uniform(-spread, spread, len(plan))
    xyz = np.concatenate([np.column_stack([plan, tops - down]) for down in (0.0, 0.4, 0.8)])
    return xyz, np.tile((0.0, 0.0, 1.0), (len(xyz), 1))


@pytest.mark.parametrize(
    ("spread", "expected"),
    [(0.05, ChangeLabel.DECREASED), (0.4, ChangeLabel.UNCHANGED)],
    ids=["cut", "met at other twigs"],
)
def test_tops_that_move_alike_moved_and_others_were_met_by_chance(spread: float, expected: ChangeLabel) -> None:
    there, lower = bush(1, 1.6, spread), bush(2, 1.3, spread)
    found = decide(surface((0, there)), surface((0, lower)), ObjectClass.VEGETATION)
    assert found.evidence.column_rise[0] == pytest.approx(-0.3, abs=0.15)
    assert labels(found) == [expected]
    assert ("in the median (limit 0.25 m)" in found.reason[0]) == (expected == ChangeLabel.DECREASED)


def test_vegetation_grows_above_its_own_limit_only() -> None:
    shrub = block(0, 0, 4, 4, 3)
    for top, expected in ((3.2, ChangeLabel.UNCHANGED), (4.5, ChangeLabel.INCREASED)):
        grown = block(0, 0, 4, 4, top)
        assert labels(decide(surface((0, shrub)), surface((0, grown)), ObjectClass.VEGETATION)) == [expected]


def test_a_parked_car_in_its_slot_is_unchanged_and_one_that_left_is_removed() -> None:
    car = block(0, 0, 4.5, 1.8, 1.5)
    assert labels(decide(surface((0, car)), surface((0, car)), ObjectClass.MOBILE)) == [ChangeLabel.UNCHANGED]
    longer = block(4.0, 0, 4.5, 1.8, 1.5)
    found = decide(surface((0, car)), surface((0, longer)), ObjectClass.MOBILE)
    assert labels(found)[0] in (ChangeLabel.ADDED, ChangeLabel.REMOVED, ChangeLabel.UNCHANGED)


def test_swapping_the_epochs_swaps_every_label() -> None:
    before = surface((0, HOUSE), (1, block(30, 0, 10, 8, 6)), (2, block(0, 20, 4, 4, 5)))
    after = surface((0, block(0, 0, 10, 8, 9)), (2, block(0, 20, 4, 4, 3)), (3, block(30, 20, 4.5, 1.8, 1.5)))
    classes = (ObjectClass.BUILDING, ObjectClass.BUILDING, ObjectClass.VEGETATION, ObjectClass.MOBILE)
    there, back = decide(before, after, *classes), decide(after, before, *classes)
    assert [label.swapped for label in labels(there)] == labels(back)
    assert set(labels(there)) == {
        ChangeLabel.INCREASED, ChangeLabel.REMOVED, ChangeLabel.DECREASED, ChangeLabel.ADDED,
    }  # fmt: skip
    assert there.confidence == pytest.approx(back.confidence, nan_ok=True)
    assert np.array_equal(there.owner.before, back.owner.after)


def test_points_may_come_in_any_order() -> None:
    after = surface((0, block(0, 0, 10, 8, 9)))
    order = np.random.default_rng(1).permutation(len(after.xyz))
    shuffled = replace(
        after, xyz=after.xyz[order], normals=after.normals[order], height=after.height[order],
        n_raw=after.n_raw[order], owner=after.owner[order],
        is_surface=after.is_surface[order],
    )  # fmt: skip
    first, second = (decide(surface((0, HOUSE)), side, ObjectClass.BUILDING) for side in (after, shuffled))
    assert first.reason == second.reason
    assert first.confidence[0] == second.confidence[0]


def test_nothing_gives_nothing() -> None:
    none = surface().owner[:0]
    nothing = Surface(np.zeros((0, 3)), np.zeros((0, 3), np.float32), np.zeros(0), none, none, np.zeros(0, np.bool_))
    for found in (decide(surface(), surface()), decide(nothing, nothing)):
        assert len(found) == 0
    assert found.reason == ()


def plant(**figures: float) -> Cue:
    """A plant that the before survey alone shows, as a whole."""
    cue = Cue(**dict.fromkeys(Cue._fields, 0.0) | {"n_voxels": 100.0, "unshown": 50.0, "tall": 6.0} | figures)  # type: ignore[arg-type]
    return cue._replace(object_class=ObjectClass.VEGETATION, is_before=True, is_after=False)


@pytest.mark.parametrize(
    ("support", "due", "seen", "expected"),
    [
        (0.28, 0.5, 0.3, ChangeLabel.UNCHANGED),  # as much of it as that sampling lets be expected
        (0.28, 0.9, 0.3, ChangeLabel.UNDETERMINED),
        (0.05, 0.08, 0.3, ChangeLabel.UNDETERMINED),  # five voxels tell nothing
        (0.55, 1.0, 1.0, ChangeLabel.REMOVED),  # half of it lies within reach of its neighbours
        (0.70, 1.0, 1.0, ChangeLabel.UNCHANGED),
        (0.55, 0.9, 0.7, ChangeLabel.UNCHANGED),
    ],
)
def test_a_plant_of_one_survey_is_judged_by_what_the_other_could_show_of_it(
    support: float, due: float, seen: float, expected: ChangeLabel
) -> None:
    cue = plant(support_before=support, due_before=due, observability=seen)
    assert verdict_of(cue, False, False, STREET.changes, STREET.observability).label == expected


def test_a_wall_that_stands_aside_of_a_fence_is_another_thing_however_few_points_a_cell_holds() -> None:
    fence, wall = block(0, 0, 8, 0.05, 1.25), block(0, 0.1, 8, 0.05, 1.25)
    pair = Pair(surface((0, fence)), surface((0, wall)))
    coarse = replace(lod_everywhere(pair), lod95=np.full(len(lod_everywhere(pair).cells), 0.5, np.float32))
    codes, seen = np.array([ObjectClass.OTHER], np.uint8), Pair(everywhere(), everywhere())
    found = decide_changes(pair, codes, seen, coarse, STREET.changes, STREET.observability, ConfidenceParams())
    assert sorted(labels(found)) == [ChangeLabel.ADDED, ChangeLabel.REMOVED]
    drifting = replace(coarse, drift=np.diag([0.0025, 0.0025, 0.0]))
    found = decide_changes(pair, codes, seen, drifting, STREET.changes, STREET.observability, ConfidenceParams())
    assert labels(found) == [ChangeLabel.UNCHANGED]
