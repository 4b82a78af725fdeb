"""Vehicles found among what leans on them and passed by."""

from __future__ import annotations

import numpy as np
import pytest

from loda_pdal.model.cloud import FloatArray
from loda_pdal.params import Parameters
from loda_pdal.stages.features import eigen_features
from loda_pdal.stages.parked import parked_vehicles, vehicle_sized

STREET, AERIAL = Parameters.preset("street"), Parameters.preset("aerial")
NOISE_M = 0.015


def shell(low: tuple[float, float, float], high: tuple[float, float, float], seed: int = 0) -> FloatArray:
    """Points of the four walls and the top of a box, m, 10 cm apart."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    x, y, z = (np.arange(a, b, 0.1) for a, b in ((x0, x1), (y0, y1), (z0, z1)))
    ends = [
        np.column_stack([np.full(len(y) * len(z), at), np.repeat(y, len(z)), np.tile(z, len(y))]) for at in (x0, x1)
    ]
    sides = [
        np.column_stack([np.repeat(x, len(z)), np.full(len(x) * len(z), at), np.tile(z, len(x))]) for at in (y0, y1)
    ]
    top = np.column_stack([np.repeat(x, len(y)), np.tile(y, len(x)), np.full(len(x) * len(y), z1)])
    points = np.concatenate([*ends, *sides, top])
    return points + np.random.default_rng(seed).normal(0.0, NOISE_M, points.shape)


def roof_of(x: tuple[float, float], top: float) -> FloatArray:
    """Points of a level surface 1.8 m wide, m, 40 cm apart."""
    grid = np.meshgrid(np.arange(*x, 0.4), np.arange(0, 1.81, 0.4))
    return np.column_stack([grid[0].ravel(), grid[1].ravel(), np.full(grid[0].size, top)])


def cloud(low: tuple[float, float, float], high: tuple[float, float, float], n: int, seed: int = 1) -> FloatArray:
    """Points anywhere in a box: leaves, or the smear of what drove past."""
    return np.random.default_rng(seed).uniform(low, high, (n, 3))


def found(*things: FloatArray) -> list[set[int]]:
    """The vehicles of each thing; ground at z = 0."""
    xyz = np.concatenate(things)
    features = eigen_features(xyz, xyz[:, 2], STREET.features)
    vehicle, _ = parked_vehicles(xyz, xyz[:, 2], features.normals, np.ones(len(xyz), np.bool_), STREET.semantics)
    ends = np.cumsum([len(thing) for thing in things])
    parts = np.split(vehicle, ends[:-1])
    return [
        {int(v) for v, n in zip(*np.unique(part, return_counts=True), strict=True) if n > 0.2 * len(part)}
        for part in parts
    ]


CAR = shell((0, 0, 0.2), (4.4, 1.8, 1.5))
POLE = np.column_stack([np.full(60, 4.7), np.full(60, 0.9), np.linspace(0.1, 6.0, 60)])


@pytest.mark.parametrize(
    "beside",
    [
        pytest.param(POLE, id="a lamp post"),
        pytest.param(cloud((-6, 1.9, 0.2), (10, 3.4, 1.5), 3000), id="the smear of traffic"),
        pytest.param(cloud((-1, -2.2, 0.1), (5, -0.2, 1.2), 3000), id="a hedge"),
        pytest.param(cloud((0, 0, 3.0), (4, 4, 5.0), 4000), id="a crown over it"),
    ],
)
def test_a_vehicle_is_found_whatever_is_beside_it(beside: FloatArray) -> None:
    assert found(CAR, beside) == [{0}, {-1}]


def test_vehicles_bumper_to_bumper_are_two() -> None:
    one, other = found(CAR, CAR + np.array([4.4 + 0.45, 0.0, 0.0]))
    assert one != other and len(one) == len(other) == 1 and -1 not in one | other


@pytest.mark.parametrize(
    "thing",
    [
        pytest.param(shell((0, 0, 0), (12, 0.3, 1.5)), id="a wall"),
        pytest.param(shell((0, 0, 0), (0.6, 0.5, 1.2)), id="a cabinet"),
        pytest.param(shell((0, 0, 0), (12, 2.5, 2.9)), id="an articulated lorry"),
        pytest.param(cloud((0, 0, 0.1), (3, 1.5, 1.5), 3000), id="a bush"),
        pytest.param(shell((0, 0, 1.2), (4, 1.8, 2.4)), id="a balcony"),
    ],
)
def test_what_is_no_vehicle(thing: FloatArray) -> None:
    assert found(thing) == [{-1}]


def test_what_lies_behind_its_glass_belongs_to_a_vehicle() -> None:
    inside = cloud((0.15, 0.15, 1.0), (0.25, 1.6, 1.4), 60)
    assert found(CAR, inside) == [{0}, {0}]


def test_a_preset_without_them_finds_none() -> None:
    for name in ("aerial", "paper"):
        params = Parameters.preset(name).semantics
        normals = np.zeros((len(CAR), 3), np.float32)
        vehicle, is_solid = parked_vehicles(CAR, CAR[:, 2], normals, np.ones(len(CAR), np.bool_), params)
        assert np.all(vehicle == -1) and not is_solid.any()
    none, _ = parked_vehicles(CAR[:0], CAR[:0, 2], normals[:0], np.zeros(0, np.bool_), STREET.semantics)
    assert len(none) == 0


@pytest.mark.parametrize(
    ("thing", "is_vehicle"),
    [
        pytest.param(np.concatenate([roof_of((0, 1), 0.9), roof_of((1, 4), 1.4)]), True, id="bonnet and roof"),
        pytest.param(roof_of((0, 4), 2.4), False, id="an awning"),
        pytest.param(roof_of((0, 4), 0.6), False, id="a table"),
        pytest.param(roof_of((0, 9), 0.9), False, id="too long"),
    ],
)
def test_from_the_air_a_vehicle_is_its_roof_and_its_bonnet(thing: FloatArray, is_vehicle: bool) -> None:
    one, height = np.zeros(len(thing), np.int32), thing[:, 2]
    is_within, is_body = vehicle_sized(
        thing, one, height.min(keepdims=True), AERIAL.semantics, height.max(keepdims=True)
    )
    assert (is_within & is_body).tolist() == [is_vehicle]
    _, is_seen_whole = vehicle_sized(thing, one, height.min(keepdims=True), AERIAL.semantics)
    assert not is_seen_whole.any()
