"""Crowns that touch part in both surveys where one of them shows it."""

from __future__ import annotations

import numpy as np
import pytest

from loda_pdal.model.cloud import FloatArray, IntArray
from loda_pdal.model.pair import Pair
from loda_pdal.stages.crowns import Crowns, find_crowns


def dome(x: float, top: float, radius: float = 2.5, seed: int = 2) -> FloatArray:
    """A crown (1500, 3) about (x, 0), highest in its middle."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-radius, radius, (1500, 2))
    return np.column_stack([xy + np.array([x, 0.0]), top - 2.5 * np.sum((xy / radius) ** 2, axis=1)])


def crowns(before: FloatArray, after: FloatArray) -> Pair[Crowns]:
    return find_crowns(Pair(before, after), Pair(before[:, 2], after[:, 2]))


def split(found: Crowns, points: FloatArray) -> IntArray:
    return found.split(points, points[:, 2], np.zeros(len(points), np.int32))


def at(label: IntArray, points: FloatArray, x: float) -> set[int]:
    """Labels within 1 m of x."""
    return set(label[np.abs(points[:, 0] - x) < 1].tolist())


NOTHING = np.zeros((0, 3))


def test_touching_crowns_are_two_trees_and_a_hedge_stays_whole() -> None:
    trees = np.concatenate([dome(0, 8), dome(4.5, 7)])
    label = split(crowns(trees, NOTHING).before, trees)
    left, right = at(label, trees, 0.0), at(label, trees, 4.5)
    assert len(left) == len(right) == 1 and left != right
    rng = np.random.default_rng(3)
    hedge = np.column_stack([rng.uniform(0, 20, 2000), rng.uniform(0, 1, 2000), rng.uniform(0, 1.5, 2000)])
    assert (split(crowns(hedge, hedge).after, hedge) == 0).all()


def test_a_tree_that_outgrew_its_neighbour_is_still_two_with_it() -> None:
    small, other = dome(0, 6), dome(4.5, 7)
    before, after = np.concatenate([small, other]), np.concatenate([small, dome(4.5, 11, 6.0, seed=4)])
    alone = split(crowns(NOTHING, after).after, after)
    assert at(alone, after, 0.0) == at(alone, after, 4.5), "this survey alone cannot tell them apart"
    for found, points in zip(crowns(before, after), (before, after), strict=True):
        label = split(found, points)
        near = np.hypot(points[:, 0], points[:, 1]) < 0.8
        assert set(label[near].tolist()).isdisjoint(at(label, points, 4.5))
        assert len(at(label, points, 4.5)) == 1


def test_a_tree_that_went_parts_nothing_else() -> None:
    both = np.concatenate([dome(0, 8), dome(4.5, 7)])
    stays = dome(0, 8)
    found = crowns(both, stays)
    assert set(split(found.after, stays).tolist()) == {0}
    assert at(split(found.before, both), both, 0.0) != at(split(found.before, both), both, 4.5)


def test_surveys_may_change_places() -> None:
    before, after = np.concatenate([dome(0, 5, 2.0), dome(3.0, 6)]), dome(2.0, 11, 5.0)
    there, back = crowns(before, after), crowns(after, before)
    for one, same in zip(there, back.swapped, strict=True):
        assert np.array_equal(one.crown, same.crown) and np.array_equal(one.low, same.low)


@pytest.mark.parametrize("points", [NOTHING, np.array([[3.0, 4.0, np.nan]])])
def test_nothing_to_part(points: FloatArray) -> None:
    for found in crowns(points, NOTHING):
        assert len(split(found, points)) == len(points)
