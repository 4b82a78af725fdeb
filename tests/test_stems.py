"""Poles that stand in foliage, with what they are known to be."""

from __future__ import annotations

import numpy as np
import pytest

from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.pair import Pair
from loda_pdal.stages.cues import Surface
from loda_pdal.stages.stems import split_poles

PLANT, NONE = np.array([True]), np.array([False])


def stem(x: float, top: float) -> FloatArray:
    """A thin upright stem at ``x``, a point every 0.25 m."""
    z = np.arange(0.1, top, 0.25)
    return np.column_stack([np.full(len(z), x), np.zeros(len(z)), z])


def crown(x: float, n: int = 400) -> FloatArray:
    """Leaves in a ball of 2 m about (x, 0, 5)."""
    rng = np.random.default_rng(n)
    ball = rng.normal(size=(n, 3))
    return np.asarray(ball / np.linalg.norm(ball, axis=1, keepdims=True) * 2.0 * rng.random((n, 1)) + [x, 0.0, 5.0])


def surface(*parts: FloatArray) -> Surface:
    """One object of several parts."""
    xyz = np.concatenate(parts)
    n = len(xyz)
    normals, ones = np.zeros((n, 3), np.float32), np.ones(n, np.int32)
    return Surface(xyz, normals, xyz[:, 2].copy(), ones, np.zeros(n, np.int32), np.ones(n, np.bool_))


def test_the_lamp_post_leaves_the_tree_and_the_trunk_stays() -> None:
    lamp, trunk = stem(1.5, 7.0), stem(0.0, 3.5)
    before, after = surface(lamp, trunk, crown(0.0)), surface(lamp, trunk, crown(0.0, 600))
    owner, host = split_poles(Pair(before, after), PLANT, NONE)
    assert host.tolist() == [0]
    for side in owner:
        assert np.all(side[: len(lamp)] == 1)
        assert np.all(side[len(lamp) : len(lamp) + len(trunk)] == 0)
        assert np.mean(side == 1) < 0.2
    swapped, _ = split_poles(Pair(after, before), PLANT, NONE)
    np.testing.assert_array_equal(swapped.after, owner.before)
    np.testing.assert_array_equal(swapped.before, owner.after)


def test_of_a_pole_with_twigs_the_pole_is_a_thing_of_its_own() -> None:
    pole, twigs = stem(0.0, 6.0), crown(1.8, 80)
    owner, host = split_poles(Pair(surface(pole, twigs), surface(pole)), NONE, PLANT)
    assert host.tolist() == [0]
    assert np.all(owner.after == 1)
    assert np.all(owner.before[: len(pole)] == 1)
    assert np.mean(owner.before[len(pole) :] == 0) > 0.9


@pytest.mark.parametrize("moved_m", [0.4, 3.0])
def test_a_stem_of_one_epoch_alone_is_no_pole(moved_m: float) -> None:
    pair = Pair(surface(stem(1.5, 6.0), crown(0.0)), surface(stem(1.5 + moved_m, 6.0), crown(0.0)))
    owner, host = split_poles(pair, NONE, PLANT)
    assert len(host) == 0
    assert not owner.before.any() and not owner.after.any()


def test_nothing_asked_for_and_nothing_there() -> None:
    some, none = surface(stem(0.0, 6.0)), surface(np.zeros((0, 3)))
    for pair, asked in ((Pair(some, some), NONE), (Pair(some, none), PLANT), (Pair(none, none), PLANT)):
        owner, host = split_poles(pair, NONE, asked)
        assert (len(host), len(owner.before), len(owner.after)) == (0, len(pair.before.xyz), len(pair.after.xyz))
