"""Moves and shapes of parked vehicles, with what they are known to be."""

from __future__ import annotations

import numpy as np
import pytest

from loda_pdal.model.cloud import Float32Array, FloatArray
from loda_pdal.model.pair import Pair
from loda_pdal.stages.cues import Surface
from loda_pdal.stages.vehicles import shape_change


def body(length: float, roof: tuple[float, float], high: float = 1.5) -> tuple[FloatArray, Float32Array]:
    """A bonnet 0.9 m high with a roof ``high`` m from ``roof[0]`` to ``roof[1]`` along x, 1.8 m wide, and its sides."""
    along, across = np.arange(0.0, length, 0.2), np.arange(0.0, 1.81, 0.2)
    x, y = (grid.ravel() for grid in np.meshgrid(along, across, indexing="ij"))
    top = np.where((x > roof[0]) & (x < roof[1]), high, 0.9)
    parts = [(np.column_stack([x, y, top]), (0, 0, 1))]
    for place, normal in ((0.0, (0, -1, 0)), (1.8, (0, 1, 0))):
        x, z = (grid.ravel() for grid in np.meshgrid(along, np.arange(0.2, 0.9, 0.2), indexing="ij"))
        parts.append((np.column_stack([x, np.full(len(x), place), z]), normal))
    for place, normal in ((0.0, (-1, 0, 0)), (along[-1], (1, 0, 0))):
        y, z = (grid.ravel() for grid in np.meshgrid(across, np.arange(0.2, 0.9, 0.2), indexing="ij"))
        parts.append((np.column_stack([np.full(len(y), place), y, z]), normal))
    return np.concatenate([xyz for xyz, _ in parts]), np.concatenate(
        [np.tile(normal, (len(xyz), 1)) for xyz, normal in parts]
    ).astype(np.float32)


def surface(xyz: FloatArray, normals: Float32Array) -> Surface:
    n = len(xyz)
    return Surface(xyz, normals, xyz[:, 2].copy(), np.ones(n, np.int32), np.zeros(n, np.int32), np.ones(n, np.bool_))


def opened(pair: Pair[Surface]) -> Pair[np.ndarray]:
    return pair.map(lambda side: np.ones(len(side.owner), np.bool_))


SALOON = body(4.4, (1.2, 3.2))


@pytest.mark.parametrize("move", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.0), (-0.2, 0.1, 0.06)])
def test_the_move_of_a_vehicle_is_found_and_its_shape_stays(move: tuple[float, float, float]) -> None:
    xyz, normals = SALOON
    pair = Pair(surface(xyz, normals), surface(xyz + np.array(move), normals))
    there = shape_change(pair, opened(pair), np.ones(1, np.bool_))
    back = shape_change(pair.swapped, opened(pair.swapped), np.ones(1, np.bool_))
    assert there.off[0] < 0.03
    assert there.move[0] == pytest.approx(move, abs=0.03)
    np.testing.assert_array_equal(there.move, -back.move)
    np.testing.assert_array_equal(there.off, back.off)


def test_another_roof_is_another_shape() -> None:
    pair = Pair(surface(*SALOON), surface(*body(4.4, (0.4, 4.4), 2.0)))
    assert shape_change(pair, opened(pair), np.ones(1, np.bool_)).off[0] > 0.06


def test_nothing_asked_for() -> None:
    pair = Pair(surface(*SALOON), surface(*SALOON))
    fit = shape_change(pair, opened(pair), np.zeros(1, np.bool_))
    assert np.isnan(fit.off).all() and np.isnan(fit.move).all()
