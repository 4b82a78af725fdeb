"""Buildings from the air: bodies in rows, annexes, thin edges, and plants that grew together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from loda_pdal.model.cloud import FloatArray, IntArray
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.pair import Pair
from loda_pdal.params import ChangeParams, ConfidenceParams, ObservabilityParams, Parameters
from loda_pdal.stages.changes import Changes, decide_changes
from loda_pdal.stages.cues import Surface, cells_with_owners, sample_voxels
from loda_pdal.stages.filling import fill_columns, filled_everywhere
from loda_pdal.stages.instances import split_at_steps
from loda_pdal.stages.observability import coverage
from loda_pdal.stages.parts import largest_regions, width_of
from loda_pdal.stages.rules import Cue, verdict_of

AERIAL = Parameters.preset("aerial")


def roof(x: tuple[float, float], y: tuple[float, float], z: float, step: float = 0.45) -> FloatArray:
    """Points (k, 3) m of a flat roof."""
    grid = np.meshgrid(np.arange(x[0], x[1], step) + 0.1, np.arange(y[0], y[1], step) + 0.1)
    return np.column_stack([grid[0].ravel(), grid[1].ravel(), np.full(grid[0].size, z)])


def surface(parts: list[tuple[int, FloatArray]], bare: FloatArray | None = None) -> Surface:
    """One epoch: numbered roofs over level ground at z = 0."""
    xyz = np.concatenate([points for _, points in parts])
    owner = np.concatenate([np.full(len(points), number, np.int32) for number, points in parts])
    if bare is not None:
        xyz, owner = np.concatenate([xyz, bare]), np.append(owner, np.full(len(bare), -1, np.int32))
    normals = np.tile(np.array([0, 0, 1], np.float32), (len(xyz), 1))
    is_surface = xyz[:, 2] > 0.3
    return Surface(xyz, normals, xyz[:, 2].copy(), np.full(len(xyz), 4, np.int32), owner.astype(np.int32), is_surface)


GROUND = roof((-10, 50), (-10, 30), 0.0, 0.7)


def decide(
    before: list[tuple[int, FloatArray]],
    after: list[tuple[int, FloatArray]],
    *classes: ObjectClass,
    ground: FloatArray = GROUND,
) -> Changes:
    """Labels of bodies, as the pipeline asks for them."""
    params = AERIAL.changes.for_bodies()
    pair = Pair(surface(before, ground), surface(after, ground)).map(
        lambda side: filled_everywhere(side, params.voxel_m)
    )
    return _decided(pair, classes, params)


def _decided(pair: Pair[Surface], classes: Sequence[ObjectClass], params: ChangeParams) -> Changes:
    """Labels of objects where both surveys looked everywhere, with a limit of detection of 0.05 m."""
    cells = np.unique(np.floor(np.concatenate([side.xyz for side in pair])).astype(np.int32), axis=0)
    n = len(cells)
    lod = LodGrid(
        cells, 1.0, np.full(n, 0.05, np.float32), np.zeros((n, 3), np.float32), np.full(n, 50, np.int32),
        np.full(n, 50, np.int32), np.ones(n, np.bool_), np.zeros(n, np.float32), 0.5,
    )  # fmt: skip
    seen = Pair(coverage(GROUND, AERIAL.observability), coverage(GROUND, AERIAL.observability))
    codes = np.array(classes, dtype=np.uint8)
    return decide_changes(pair, codes, seen, lod, params, ObservabilityParams(), ConfidenceParams())


def labels_at(changes: Changes, side: list[tuple[int, FloatArray]], owner: IntArray) -> list[set[str]]:
    """Labels of the points of each part of one epoch."""
    found, start = [], 0
    for _, points in side:
        own = owner[start : start + len(points)]
        found.append({ChangeLabel(int(changes.label[o])).name for o in own if o >= 0})
        start += len(points)
    return found


def test_a_storey_on_one_house_of_a_row_is_a_part_of_it() -> None:
    row = roof((0, 24), (0, 9), 6.0)
    raised = row.copy()
    raised[(row[:, 0] > 8) & (row[:, 0] < 14), 2] += 1.4
    changes = decide([(0, row)], [(0, raised)], ObjectClass.BUILDING)
    assert [ChangeLabel(c).name for c in sorted(changes.label)] == ["UNCHANGED", "INCREASED"]
    part = int(np.argmax(changes.parent))
    is_part = changes.owner.after[: len(row)] == part
    assert raised[is_part, 0].min() == pytest.approx(8.0, abs=1.2)
    assert raised[is_part, 0].max() == pytest.approx(14.0, abs=1.2)
    assert changes.parent[part] == 1 - part


def test_a_house_that_went_and_a_storey_taken_beside_it_are_two_changes() -> None:
    row = roof((0, 30), (0, 9), 7.0)
    x = row[:, 0]
    left = row.copy()
    left[(x > 14) & (x < 20), 2] -= 2.5
    left = left[(x < 8) | (x > 14)]
    for before, after, gone, lower in ((row, left, "REMOVED", "DECREASED"), (left, row, "ADDED", "INCREASED")):
        changes = decide([(0, before)], [(0, after)], ObjectClass.BUILDING)
        owner = (changes.owner.before if before is row else changes.owner.after)[: len(row)]
        for low, high, label in ((0, 7, "UNCHANGED"), (9, 13, gone), (15, 19, lower), (21, 30, "UNCHANGED")):
            found = changes.label[owner[(x > low) & (x < high)]]
            assert {ChangeLabel(int(code)).name for code in found} == {label}


@pytest.mark.parametrize(
    ("end", "labels"), [(19.0, ["UNCHANGED", "INCREASED"]), (22.5, ["INCREASED"])], ids=["a house", "a strip"]
)
def test_a_row_of_which_most_rose_leaves_what_is_as_large_as_a_house(end: float, labels: list[str]) -> None:
    row = roof((0, 24), (0, 9), 6.0)
    raised = row.copy()
    raised[row[:, 0] < end, 2] += 1.4
    changes = decide([(0, row)], [(0, raised)], ObjectClass.BUILDING)
    assert [ChangeLabel(code).name for code in sorted(changes.label)] == labels


def test_an_annex_of_a_house_that_stands_alone_makes_it_grow() -> None:
    house, annex = roof((0, 10), (0, 9), 6.0), roof((10, 13.5), (2, 7), 2.7)
    changes = decide([(0, house)], [(0, np.concatenate([house, annex]))], ObjectClass.BUILDING)
    assert [ChangeLabel(c) for c in changes.label] == [ChangeLabel.INCREASED]
    assert "in one piece" in changes.reason[0] or "volume up" in changes.reason[0]
    swapped = decide([(0, np.concatenate([house, annex]))], [(0, house)], ObjectClass.BUILDING)
    assert [ChangeLabel(c) for c in swapped.label] == [ChangeLabel.DECREASED]


def test_an_annex_changes_its_house_and_no_other_house_of_the_row() -> None:
    row = np.concatenate([roof((6 * i, 6 * i + 6), (0, 9), 6.0 + 0.3 * (i % 2)) for i in range(5)])
    annex = roof((13.5, 16.5), (-3, -0.2), 2.7)
    with_annex = [(0, row), (0, annex)]
    grown, cut = (
        decide([(0, row)], with_annex, ObjectClass.BUILDING),
        decide(with_annex, [(0, row)], ObjectClass.BUILDING),
    )
    for changes, sign in ((grown, ChangeLabel.INCREASED), (cut, ChangeLabel.DECREASED)):
        assert sorted(changes.label) == sorted([ChangeLabel.UNCHANGED, sign, sign])
        x = row[:, 0]
        is_changed = changes.label[changes.owner.before[: len(row)]] == sign
        assert x[is_changed].min() == pytest.approx(12.0, abs=0.6)
        assert x[is_changed].max() == pytest.approx(18.0, abs=0.6)
    own = grown.owner.after[len(row) : len(row) + len(annex)]
    assert len(set(own.tolist())) == 1
    house = grown.parent[own[0]]
    assert grown.reason[house].startswith("a part of it changed")
    assert grown.label[grown.parent[house]] == ChangeLabel.UNCHANGED


@pytest.mark.parametrize(
    ("top", "label"), [(2.7, "INCREASED"), (6.0, "UNCHANGED")], ids=["an annex", "the edge of the roof"]
)
def test_what_is_narrow_is_an_annex_where_it_is_low_and_stood_on_the_ground(top: float, label: str) -> None:
    house, narrow = roof((0, 10), (0, 9), 6.0), roof((10, 11.3), (2, 7), top)
    ground = roof((-10, 50), (-10, 30), 0.0)
    changes = decide([(0, house)], [(0, np.concatenate([house, narrow]))], ObjectClass.BUILDING, ground=ground)
    assert {ChangeLabel(c).name for c in changes.label} == {label}


def test_what_is_much_taller_than_long_has_no_house_behind_it() -> None:
    row = np.concatenate([roof((6 * i, 6 * i + 6), (0, 9), 9.0 + 0.3 * (i % 2)) for i in range(5)])
    tower = roof((14, 16), (-2.2, -0.2), 7.0)
    changes = decide([(0, row)], [(0, row), (0, tower)], ObjectClass.BUILDING)
    assert sorted(changes.label) == [ChangeLabel.UNCHANGED, ChangeLabel.INCREASED]
    assert (changes.owner.after[: len(row)] == np.argmin(changes.label)).mean() > 0.95


@pytest.mark.parametrize(("grown_m3", "cut_m3", "label"), [(20, 0, "INCREASED"), (0, 20, "DECREASED")])
def test_a_body_goes_the_way_of_the_piece_that_came_or_went_whichever_way_its_top_goes(
    grown_m3: float, cut_m3: float, label: str
) -> None:
    for dh in (-9.0, 9.0):  # the edge of the house's roof in one epoch, the annex before it in the other
        figures = dict.fromkeys(Cue._fields, 0.0) | {"dh": dh, "iou": 0.8, "observability": 1.0, "lod95": 0.05}
        figures |= {"gained_above": 9.0, "lost_above": 9.0, "column_scatter": 9.0, "n_voxels": 100.0}
        figures |= {"grown_m3": grown_m3, "cut_m3": cut_m3, "support_before": 0.9, "support_after": 0.9}
        cue = Cue(**figures)._replace(object_class=ObjectClass.BUILDING, is_before=True, is_after=True)  # type: ignore[arg-type]
        verdict = verdict_of(cue, False, False, AERIAL.changes.for_bodies(), ObservabilityParams())
        assert verdict.label.name == label


def test_an_edge_that_was_sampled_once_is_no_change() -> None:
    house, edge = roof((0, 10), (0, 9), 6.0), roof((10, 10.8), (0, 9), 6.0)
    changes = decide([(0, house)], [(0, np.concatenate([house, edge]))], ObjectClass.BUILDING)
    assert [ChangeLabel(c) for c in changes.label] == [ChangeLabel.UNCHANGED]


@pytest.mark.parametrize(
    ("is_wet", "expected"), [(True, {"UNCHANGED"}), (False, {"UNCHANGED", "REMOVED"})], ids=["wet", "gone"]
)
def test_half_a_roof_that_returned_nothing_is_gone_only_where_the_ground_shows(
    is_wet: bool, expected: set[str]
) -> None:
    house = roof((0, 20), (0, 9), 6.0)
    half = house[house[:, 0] < 10]
    is_beneath = (np.abs(GROUND[:, 0] - 15) < 5) & (np.abs(GROUND[:, 1] - 4.5) < 4.5)
    ground = GROUND[~is_beneath] if is_wet else GROUND
    for sides in (([(0, house)], [(0, half)]), ([(0, half)], [(0, house)])):
        changes = decide(*sides, ObjectClass.BUILDING, ground=ground)
        found = {ChangeLabel(int(c)) for c in changes.label}
        assert {label.swapped.name if sides[0][0][1] is half else label.name for label in found} == expected


def test_a_house_that_one_survey_shows_as_fragments_has_not_gone() -> None:
    house, beside = roof((0, 10), (0, 9), 6.0), roof((10, 20), (0, 9), 6.0)
    changes = decide([(0, house), (0, beside)], [(0, house), (-1, beside)], ObjectClass.BUILDING)
    assert {ChangeLabel(c) for c in changes.label} == {ChangeLabel.UNCHANGED}


def test_gaps_between_returns_are_filled_as_high_as_the_lower_side() -> None:
    xyz = np.array([[0.25, 0.25, 6.0], [1.25, 0.25, 4.0]])
    found = fill_columns(xyz, xyz[:, 2], np.zeros(2, np.int32), np.ones(2, bool), 0.5)
    in_gap = found.xyz[found.xyz[:, 0] == 0.75]
    assert in_gap[:, 2].max() == 4.0
    assert len(in_gap) == 9  # from 4 m down to the ground, in steps of 0.5 m, the top one included
    assert (found.under[found.xyz[:, 0] == 0.75] == 1).all()


@pytest.mark.parametrize(("gap", "n"), [(0.0, 1), (0.4, 1), (2.5, 2)])
def test_rows_are_cut_where_the_roof_steps(gap: float, n: int) -> None:
    row = np.concatenate([roof((0, 8), (0, 10), 6.0), roof((8, 16), (0, 10), 6.0 + gap)])
    label = split_at_steps(row, np.zeros(len(row), np.int32), 0.6, 1.0, 70)
    assert len(np.unique(label)) == n
    mixed = np.random.default_rng(0).permutation(len(row))
    again = split_at_steps(row[mixed], np.zeros(len(row), np.int32), 0.6, 1.0, 70)
    assert len(np.unique(np.column_stack([label[mixed], again]), axis=0)) == n


def test_a_dormer_joins_the_roof_around_it() -> None:
    house = np.concatenate([roof((0, 12), (0, 10), 6.0), roof((4, 7), (4, 6), 8.0)])
    assert len(np.unique(split_at_steps(house, np.zeros(len(house), np.int32), 0.6, 1.0, 70))) == 1


@pytest.mark.parametrize(("cells", "width"), [((1, 9), 1.0), ((2, 9), 1.0), ((3, 9), 3.0), ((5, 5), 5.0)])
def test_width_of_columns(cells: tuple[int, int], width: float) -> None:
    assert width_of(np.argwhere(np.ones(cells))) == width


def test_width_does_not_depend_on_the_direction() -> None:
    along, across = np.meshgrid(np.arange(0, 12, 0.2), np.arange(0, 4, 0.2))
    turned = np.column_stack([(along - across).ravel(), (along + across).ravel()]) / np.sqrt(2)
    assert width_of(np.unique(np.floor(turned).astype(np.int64), axis=0)) == pytest.approx(4.0, abs=1.0)


def crown(x: float, y: float, seed: int, n: int = 200, radius: float = 2.2) -> FloatArray:
    random = np.random.default_rng(seed)
    ball = random.normal(size=(n, 3))
    ball *= radius * np.cbrt(random.random((n, 1))) / np.linalg.norm(ball, axis=1, keepdims=True)
    return ball + np.array([x, y, 6.0])


def vegetation(before: list[FloatArray], after: list[FloatArray], params: ChangeParams) -> Changes:
    pair = Pair(
        surface([(0, np.concatenate(before))], GROUND),
        surface([(0, np.concatenate(after))], GROUND),
    )
    return _decided(pair, [ObjectClass.VEGETATION], params)


def test_a_tree_felled_beside_its_neighbour_is_removed_and_the_neighbour_stays() -> None:
    left, right = crown(5, 5, 1), crown(10, 5, 2)
    changes = vegetation([left, right], [crown(5, 5, 3)], AERIAL.changes)
    by_tree = labels_at(changes, [(0, left), (0, right)], changes.owner.before)
    assert "REMOVED" in by_tree[1]
    assert by_tree[0] == {"UNCHANGED"} or by_tree[0] == {"UNCHANGED", "REMOVED"}
    is_removed = changes.label[changes.owner.before[: len(left) + len(right)]] == ChangeLabel.REMOVED
    assert is_removed[len(left) :].mean() > 0.7
    assert is_removed[: len(left)].mean() < 0.1


@pytest.mark.parametrize("code", [ObjectClass.VEGETATION, ObjectClass.OTHER])
def test_a_piece_of_a_hedge_that_was_cut_makes_it_less(code: ObjectClass) -> None:
    whole, rest = roof((0, 7), (4.5, 5.4), 1.5, 0.3), roof((0, 3), (4.5, 5.4), 1.5, 0.3)
    for sides, label in (((whole, rest), ChangeLabel.DECREASED), ((rest, whole), ChangeLabel.INCREASED)):
        pair = Pair(*(surface([(0, points)], GROUND) for points in sides))
        changes = _decided(pair, [code], AERIAL.changes)
        assert [ChangeLabel(c) for c in changes.label] == [label]
        assert "shows the ground" in changes.reason[0]


def test_what_came_beside_a_vehicle_is_a_thing_of_its_own_however_high_its_top() -> None:
    van, stall = roof((0, 4.8), (5, 7), 2.0), roof((5.2, 8.2), (4, 8), 2.5)
    pair = Pair(surface([(0, van)], GROUND), surface([(0, van), (0, stall)], GROUND))
    changes = _decided(pair, [ObjectClass.OTHER], AERIAL.changes)
    by_thing = labels_at(changes, [(0, van), (0, stall)], changes.owner.after)
    assert "ADDED" in by_thing[1]
    assert "UNCHANGED" in by_thing[0]


def test_a_tuft_beside_a_plant_stays_with_it_and_what_is_seen_to_be_smooth_does_not() -> None:
    bush = roof((0, 4), (4, 8), 1.5, 0.3)
    tuft = crown(5.5, 6, 3, 40, 1.4) - np.array([0, 0, 4.5])  # leaves down to the ground, as few as a flight meets
    stall = roof((4.2, 8), (4, 8), 1.5)
    for beside, is_thing in ((tuft, False), (stall, True)):
        pair = Pair(surface([(0, bush)], GROUND), surface([(0, bush), (0, beside)], GROUND))
        changes = _decided(pair, [ObjectClass.VEGETATION], AERIAL.changes)
        by_thing = labels_at(changes, [(0, bush), (0, beside)], changes.owner.after)
        assert ("ADDED" in by_thing[1]) == is_thing


def test_a_crown_sampled_twice_as_densely_has_not_grown() -> None:
    changes = vegetation([crown(5, 5, 1, 80)], [crown(5, 5, 2, 240)], AERIAL.changes)
    assert [ChangeLabel(c) for c in changes.label] == [ChangeLabel.UNCHANGED]


def test_voxels_count_by_the_odds_of_being_met() -> None:
    pair = Pair(surface([(0, crown(5, 5, 1, 60))]), surface([(0, crown(5, 5, 2, 240))]))
    lod = LodGrid(
        np.zeros((0, 3), np.int32), 1.0, np.zeros(0, np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.int32),
        np.zeros(0, np.int32), np.zeros(0, np.bool_), np.zeros(0, np.float32), 0.5,
    )  # fmt: skip
    voxels = sample_voxels(pair, None, lod, AERIAL.changes)
    cells = cells_with_owners(voxels, pair, 1, AERIAL.changes)
    mine = cells.owner.after >= 0
    assert 0.0 < cells.odds.before[mine].min() < cells.odds.before[mine].max() <= 1.0
    held = cells.owner.before >= 0
    assert cells.odds.after[held].mean() > cells.odds.before[mine].mean()  # the denser survey misses less


def test_regions_are_measured_for_bodies_only() -> None:
    house = roof((0, 10), (0, 9), 6.0)
    pair = Pair(surface([(0, house)]), surface([(0, house)]))
    lod = LodGrid(
        np.zeros((0, 3), np.int32), 1.0, np.zeros(0, np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.int32),
        np.zeros(0, np.int32), np.zeros(0, np.bool_), np.zeros(0, np.float32), 0.5,
    )  # fmt: skip
    street = Parameters().changes
    cells = cells_with_owners(sample_voxels(pair, None, lod, street), pair, 1, street)
    assert [side.tolist() for side in largest_regions(cells, 1, street)] == [[0.0], [0.0]]
