"""The house behind an annex from the air, and about one from the street, whichever way the row lies."""

from __future__ import annotations

import numpy as np
import pytest

from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array
from loda_pdal.model.pair import Pair
from loda_pdal.params import Parameters
from loda_pdal.stages.houses import house_about, house_behind

BODIES = Parameters.preset("aerial").changes.for_bodies()
Bounds = FloatArray | BoolArray
CELL_M = BODIES.voxel_m


def columns_of(x: tuple[float, float], y: tuple[float, float], turn: float) -> tuple[Int64Array, FloatArray]:
    """Columns (k, 2) under a rectangle that was turned about the origin, and their centres (k, 2) m before that."""
    ends = np.array([x, y]).T
    far = float(np.abs(ends).max()) * 1.5
    cell = np.stack(np.meshgrid(*[np.arange(-far, far, CELL_M)] * 2), axis=-1).reshape(-1, 2) // CELL_M
    back = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    at = ((cell + 0.5) * CELL_M) @ back.T
    is_in = np.all((at > ends[0]) & (at < ends[1]), axis=1)
    return cell[is_in].astype(np.int64), at[is_in]


def roofs_of(columns: Int64Array, top: FloatArray) -> Pair[FloatArray]:
    """The same roofs ``top`` (k,) m in both epochs, a decimetre apart."""
    roof = np.column_stack([(columns + 0.5) * CELL_M, top])
    return Pair(roof, roof + np.array([0.0, 0.0, 0.1]))


def behind(top: FloatArray, turn: float, annex_m: tuple[float, float], annex_top: float = 2.6) -> Bounds:
    """The house of an annex in front of a row 36 m long and 9 m deep, whose houses are 6 m wide; ``top`` of each."""
    row, at = columns_of((0, 36), (0, 9), turn)
    annex, _ = columns_of(annex_m, (-2.5, 0), turn)
    height = top[(at[:, 0] // 6).astype(int)] + np.random.default_rng(1).normal(0, 0.02, len(row))
    found = house_behind(annex, annex_top, row, roofs_of(row, height), BODIES)
    if not found.any():
        return found
    order = np.random.default_rng(0).permutation(len(row))
    again = house_behind(annex, annex_top, row[order], roofs_of(row, height).map(lambda side: side[order]), BODIES)
    np.testing.assert_array_equal(again, found[order])
    return np.column_stack([at[found].min(axis=0), at[found].max(axis=0)])


STEPS = 7.0 + np.array([0.0, 0.25, 0.0, 0.3, 0.1, 0.4])


@pytest.mark.parametrize("turn", [0.0, 0.35, 0.785, 1.5, -2.0])
def test_it_reaches_from_party_wall_to_party_wall(turn: float) -> None:
    (x_low, x_high), (y_low, y_high) = behind(STEPS, turn, (12.5, 15.0))
    assert x_low == pytest.approx(12.0, abs=1.2)
    assert x_high == pytest.approx(18.0, abs=1.2)
    assert y_low < 0.8
    assert y_high > 8.2


def test_a_chimney_within_the_width_of_the_annex_is_no_party_wall() -> None:
    row, at = columns_of((0, 36), (0, 9), 0.0)
    height = STEPS[(at[:, 0] // 6).astype(int)] + 0.5 * (
        (at[:, 0] > 14.0) & (at[:, 0] < 14.5) & (at[:, 1] > 4.0) & (at[:, 1] < 5.0)
    )
    annex, _ = columns_of((12.5, 15.5), (-2.5, 0), 0.0)
    found = house_behind(annex, 2.6, row, roofs_of(row, height), BODIES)
    assert at[found, 0].min() == pytest.approx(12.0, abs=1.2)
    assert at[found, 0].max() == pytest.approx(18.0, abs=1.2)


def test_no_house_is_narrower_than_a_house() -> None:
    row, at = columns_of((0, 36), (0, 9), 0.0)
    height = STEPS[(at[:, 0] // 6).astype(int)] + 0.5 * ((at[:, 0] > 15.5) & (at[:, 0] < 16.0))
    annex, _ = columns_of((12.5, 15.0), (-2.5, 0), 0.0)
    found = house_behind(annex, 2.6, row, roofs_of(row, height), BODIES)
    assert np.ptp(at[found, 0]) > 3.6


def test_it_is_one_frontage_where_no_roof_steps() -> None:
    (x_low, x_high), _ = behind(np.full(6, 7.0), 0.3, (15.0, 18.0))
    assert x_low == pytest.approx(13.5, abs=1.0)
    assert x_high == pytest.approx(19.5, abs=1.0)


def test_one_roof_without_a_step_is_one_house_up_to_two_frontages() -> None:
    row, at = columns_of((0, 36), (0, 9), 0.4)
    annex, _ = columns_of((12.5, 15.0), (-2.5, 0), 0.4)
    height = np.array([7.0, 6.9, 7.0])[np.searchsorted([9.0, 20.0], at[:, 0])] + 0.4 * np.abs(at[:, 1] - 4.5)
    found = house_behind(annex, 2.6, row, roofs_of(row, height), BODIES)
    assert at[found, 0].min() == pytest.approx(9.0, abs=1.2)
    assert at[found, 0].max() == pytest.approx(20.0, abs=1.2)


def test_a_ridge_is_no_party_wall_but_a_roof_of_another_slope_is() -> None:
    row, at = columns_of((0, 36), (0, 9), 0.4)
    annex, _ = columns_of((16.0, 18.5), (-2.5, 0), 0.4)
    height = 9.0 - np.where((at[:, 0] > 12.0) & (at[:, 0] < 22.0), 0.8 * np.abs(at[:, 0] - 17.0), 2.0)
    found = house_behind(annex, 2.6, row, roofs_of(row, height), BODIES)
    assert at[found, 0].min() == pytest.approx(12.0, abs=1.2)
    assert at[found, 0].max() == pytest.approx(22.0, abs=1.2)


def test_roofs_that_only_the_later_survey_shows_to_step_are_two_houses() -> None:
    row, at = columns_of((0, 36), (0, 9), 0.0)
    annex, _ = columns_of((12.5, 15.0), (-2.5, 0), 0.0)
    level, stepped = (
        roofs_of(row, np.full(len(row), 7.0)).before,
        roofs_of(row, STEPS[(at[:, 0] // 6).astype(int)]).after,
    )
    for roofs in (Pair(level, stepped), Pair(stepped, level)):
        found = house_behind(annex, 2.6, row, roofs, BODIES)
        assert at[found, 0].min() == pytest.approx(12.0, abs=1.2)
        assert at[found, 0].max() == pytest.approx(18.0, abs=1.2)


def test_it_begins_at_the_end_of_the_row() -> None:
    (x_low, x_high), _ = behind(np.full(6, 7.0), 0.3, (1.0, 4.0))
    assert x_low < 0.8
    assert x_high == pytest.approx(6.0, abs=1.0)


def test_what_is_as_high_as_the_house_is_not_built_onto_it() -> None:
    assert not behind(STEPS, 0.0, (12.5, 15.0), annex_top=6.5).any()


def test_what_stands_apart_is_not_built_onto_anything() -> None:
    row, _ = columns_of((0, 36), (0, 9), 0.0)
    shed, _ = columns_of((12, 15), (-6, -3), 0.0)
    assert not house_behind(shed, 2.6, row, roofs_of(row, np.full(len(row), 7.0)), BODIES).any()
    assert not house_behind(shed, 2.6, row[:0], roofs_of(row[:0], np.zeros(0)), BODIES).any()


STREET = Parameters.preset("street").changes


@pytest.mark.parametrize("turn", [0.0, 0.35, 0.785, 1.5, -2.0])
@pytest.mark.parametrize(
    ("porch_m", "expected_m"),
    [
        ((15.0, 17.5), (13.25, 19.25)),  # a frontage about it
        ((2.0, 4.5), (0.0, 6.25)),  # a quarter of a metre is left of the row
        ((4.5, 7.0), (0.0, 8.75)),  # less than half a frontage is left
        ((6.5, 9.0), (4.75, 10.75)),  # what is left may be a house
    ],
)
def test_from_the_street_it_is_one_frontage_or_reaches_to_the_end_of_the_row(
    turn: float, porch_m: tuple[float, float], expected_m: tuple[float, float]
) -> None:
    front, at_front = columns_of((0, 36), (0, 0.5), turn)
    end, at_end = columns_of((0, 0.5), (0.5, 9), turn)
    yard, at_yard = columns_of((-12, 0), (8.5, 9), turn)  # a wall behind, on beyond the end of the row
    porch, _ = columns_of(porch_m, (-1.5, 0), turn)
    row, at = np.concatenate([front, end, yard]), np.concatenate([at_front, at_end, at_yard])
    found = house_about(porch, row, STREET)
    assert at[found][:, 0].min() == pytest.approx(expected_m[0], abs=1.2)
    assert at[found][:, 0].max() == pytest.approx(expected_m[1], abs=1.2)
    order = np.random.default_rng(0).permutation(len(row))
    np.testing.assert_array_equal(house_about(porch, row[order], STREET), found[order])


def test_far_from_any_wall_there_is_no_house() -> None:
    row, _ = columns_of((0, 36), (0, 0.5), 0.0)
    porch, _ = columns_of((15, 17), (-12, -10), 0.0)
    assert not house_about(porch, row, STREET).any()
    assert not house_about(porch, row[:0], STREET).any()
