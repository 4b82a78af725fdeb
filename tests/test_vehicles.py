"""Vehicles seen from above: the same one, another one in its slot, and what is no whole vehicle."""

from __future__ import annotations

import numpy as np
import pytest

from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.pair import Pair
from loda_pdal.stages.cues import Surface
from loda_pdal.stages.vehicles import tops_differ

Profile = tuple[tuple[float, float], ...]

SALOON = ((0.0, 0.6), (1.2, 0.9), (1.9, 1.42), (3.4, 1.40), (4.0, 1.0), (4.7, 0.95))
ESTATE = ((0.0, 0.6), (1.2, 0.9), (1.9, 1.42), (4.3, 1.40), (4.7, 1.0))
VAN = ((0.0, 1.1), (0.8, 1.2), (1.4, 2.1), (5.0, 2.1))


def seen(profile: Profile, random: np.random.Generator, spacing: float) -> Surface:
    """A street of 10 m x 8 m seen from above: ground, and a vehicle 1.8 m wide with that side view (m, m) on it."""
    x, y = np.meshgrid(np.arange(-2.0, 8.0, spacing), np.arange(-4.0, 4.0, spacing))
    xy = np.column_stack([x.ravel(), y.ravel()]) + random.uniform(-spacing / 2, spacing / 2, size=(x.size, 2))
    along, top = np.array(profile).T
    is_vehicle = (np.abs(xy[:, 1]) < 0.9) & (xy[:, 0] > 0.0) & (xy[:, 0] < along[-1])
    z = np.where(is_vehicle, np.interp(xy[:, 0], along, top), 0.0) + random.normal(0, 0.02, size=len(xy))
    return surface(np.column_stack([xy, z]), np.where(is_vehicle, 0, -1))


def surface(xyz: FloatArray, owner: np.ndarray) -> Surface:
    """Points (m, 3) m that are measured once each, and their objects (m,)."""
    return Surface(
        xyz=xyz,
        normals=np.zeros((len(xyz), 3), dtype=np.float32),
        height=xyz[:, 2],
        n_raw=np.ones(len(xyz), dtype=np.int32),
        owner=owner.astype(np.int32),
        is_surface=owner >= 0,
    )


ASKED = np.array([True])
ANOTHER = 1.1


@pytest.mark.parametrize("aside", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("spacing", [0.35, 0.45, 0.6])
def test_the_same_vehicle_is_never_another_one(spacing: float, aside: float) -> None:
    random = np.random.default_rng(5)
    for profile in (SALOON, ESTATE, VAN) * 5:
        before, after = seen(profile, random, spacing), seen(profile, random, spacing)
        moved = surface(after.xyz + np.array([aside, 0.0, 0.0]), after.owner)
        assert tops_differ(Pair(before, moved), ASKED)[0] < ANOTHER


@pytest.mark.parametrize(("one", "other", "spacing"), [(SALOON, ESTATE, 0.35), (VAN, SALOON, 0.6), (ESTATE, VAN, 0.6)])
def test_another_vehicle_is_told_where_points_suffice(one: Profile, other: Profile, spacing: float) -> None:
    random = np.random.default_rng(5)
    for _ in range(20):
        sides = Pair(seen(one, random, spacing), seen(other, random, spacing))
        assert tops_differ(sides, ASKED)[0] > ANOTHER
        np.testing.assert_allclose(tops_differ(sides, ASKED), tops_differ(sides.swapped, ASKED))


def test_a_post_beside_a_vehicle_makes_it_no_other_one() -> None:
    random = np.random.default_rng(8)
    before, after = seen(SALOON, random, 0.4), seen(SALOON, random, 0.4)
    post = np.column_stack([np.full(4, 5.4), np.zeros(4), np.linspace(0.5, 2.0, 4)])
    with_post = surface(np.concatenate([before.xyz, post]), np.concatenate([before.owner, np.zeros(4, np.int32)]))
    assert tops_differ(Pair(with_post, after), ASKED)[0] < ANOTHER


def test_what_is_no_whole_vehicle_is_not_compared() -> None:
    random = np.random.default_rng(7)
    whole = seen(SALOON, random, 0.4)
    half = surface(whole.xyz, np.where(whole.xyz[:, 0] < 1.8, whole.owner, -1))
    empty = surface(np.zeros((0, 3)), np.zeros(0))
    for other in (half, empty):
        assert np.isnan(tops_differ(Pair(whole, other), ASKED)[0])
    few = surface(whole.xyz[::6], whole.owner[::6])
    assert np.isnan(tops_differ(Pair(few, few), ASKED)[0])
    assert np.isnan(tops_differ(Pair(whole, whole), ~ASKED)[0])
    assert tops_differ(Pair(empty, empty), ASKED[:0]).shape == (0,)
