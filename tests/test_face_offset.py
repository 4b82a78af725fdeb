"""Offsets of upright faces against moves that are known."""

from __future__ import annotations

import numpy as np
import pytest

from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.pair import Pair
from loda_pdal.stages.cues import Surface
from loda_pdal.stages.faces import face_offset

ALONG = np.arange(0.0, 8.0, 0.25)


def wall(y: FloatArray | float, owner: int = 0, noise_m: float = 0.0) -> Surface:
    """A face along x, 1 m high, whose place across may change along it."""
    x, z = (grid.ravel() for grid in np.meshgrid(ALONG, np.arange(0.1, 1.1, 0.25), indexing="ij"))
    across = np.interp(x, ALONG, np.broadcast_to(y, ALONG.shape))
    across = across + np.random.default_rng(len(x)).normal(0.0, noise_m, len(x))
    n = len(x)
    normals = np.tile(np.array([0, -1, 0], np.float32), (n, 1))
    return Surface(
        np.column_stack([x, across, z]),
        normals,
        z,
        np.full(n, 5, np.int32),
        np.full(n, owner, np.int32),
        np.ones(n, bool),
    )


ASKED = np.ones(1, np.bool_)


@pytest.mark.parametrize("moved_m", [0.0, 0.05, -0.2])
def test_a_face_that_moved_as_a_whole(moved_m: float) -> None:
    assert face_offset(Pair(wall(0.0), wall(moved_m)), ASKED) == pytest.approx([abs(moved_m)], abs=1e-6)


def test_noise_is_hardly_an_offset() -> None:
    noisy = Pair(wall(0.0, noise_m=0.02), wall(0.0))
    assert face_offset(noisy, ASKED)[0] < 0.03
    assert face_offset(noisy, ASKED) == face_offset(noisy.swapped, ASKED)


def test_what_moved_for_the_most_part_only_did_not_move() -> None:
    bent = np.where(ALONG < 2.5, 0.0, 0.1)
    assert face_offset(Pair(wall(0.0), wall(bent)), ASKED)[0] < 0.05


def test_walls_do_not_see_each_other() -> None:
    before, after = wall(0.0), wall(0.1, owner=1)
    both = Pair(before, after)
    assert np.isnan(face_offset(both, np.ones(2, np.bool_))).all()


def test_nothing_asked_for_and_too_few_faces() -> None:
    pair = Pair(wall(0.0), wall(0.1))
    assert np.isnan(face_offset(pair, np.zeros(1, np.bool_))).all()
    few = pair.map(lambda side: side.only(np.arange(len(side.owner)) < 24))
    assert np.isnan(face_offset(few, ASKED)).all()
