"""Pieces of cities: CityJSON is read as it stands, an aircraft measures what is there, truth follows the edits."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from loda_pdal.benchmark.simulate import SimulationOptions, simulate_block
from loda_pdal.benchmark.simulate.airborne import AirborneSensor, fly
from loda_pdal.benchmark.simulate.block import SimulatedBlock
from loda_pdal.benchmark.simulate.city_model import read_city_model
from loda_pdal.benchmark.simulate.sensor import scan
from loda_pdal.benchmark.simulate.shapes import Material, box, distance_to_triangles, quads
from loda_pdal.benchmark.simulate.town import ModelHouse, party_walls
from loda_pdal.benchmark.simulate.world import World
from loda_pdal.model.errors import InputError
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.transform import transform_points


def _gabled(x: float, y: float, foot: float = 2.0) -> tuple[list[list[float]], list[list[list[int]]]]:
    """Corners and surfaces of a house of 10 x 8 m, 5 m to the eaves and 8 m to the ridge."""
    low = [[x, y, foot], [x + 10, y, foot], [x + 10, y + 8, foot], [x, y + 8, foot]]
    eaves = [[a, b, foot + 5] for a, b, _ in low]
    ridge = [[x, y + 4, foot + 8], [x + 10, y + 4, foot + 8]]
    surfaces = [
        [[3, 2, 1, 0]],
        [[0, 1, 5, 4]],
        [[2, 3, 7, 6]],
        [[1, 2, 6, 9, 5]],
        [[3, 0, 4, 8, 7]],
        [[4, 5, 9, 8]],
        [[6, 7, 8, 9]],
    ]
    return low + eaves + ridge, surfaces


def _city(places: list[tuple[float, float]]) -> dict[str, Any]:
    vertices: list[list[int]] = []
    objects = {}
    for n, (x, y) in enumerate(places):
        corners, surfaces = _gabled(x, y)
        first = len(vertices)
        vertices += [[round(1000 * v) for v in corner] for corner in corners]
        boundary = [[[first + i for i in ring] for ring in surface] for surface in surfaces]
        solid = {"type": "Solid", "lod": "2", "boundaries": [boundary]}
        objects[f"house {n}"] = {"type": "Building", "geometry": [solid]}
    transform = {"scale": [0.001, 0.001, 0.001], "translate": [0.0, 0.0, 0.0]}
    return {"type": "CityJSON", "version": "2.0", "transform": transform, "vertices": vertices, "CityObjects": objects}


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("city") / "rows.city.json"
    rows = [(18.0 * i, 30.0 * j) for i in range(8) for j in range(6)]
    path.write_text(json.dumps(_city(rows)), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def flown(city: Path) -> SimulatedBlock:
    return simulate_block(3, _flight(city))


def _flight(city: Path, **changed: Any) -> SimulationOptions:
    return SimulationOptions(length_m=70, width_m=60, city=str(city), sensor="airborne", density=0.5, **changed)


def test_a_house_is_read_with_its_size(tmp_path: Path) -> None:
    document = _city([(100.0, 200.0)])
    whole, lines = tmp_path / "a.city.json", tmp_path / "a.city.jsonl"
    whole.write_text(json.dumps(document), encoding="utf-8")
    head = {key: document[key] for key in ("type", "version", "transform")} | {"CityObjects": {}, "vertices": []}
    feature = {"type": "CityJSONFeature", "id": "house 0"} | {k: document[k] for k in ("vertices", "CityObjects")}
    lines.write_text(json.dumps(head) + "\n" + json.dumps(feature) + "\n", encoding="utf-8")
    for path in (whole, lines):
        (house,) = read_city_model(path)
        assert house.footprint.area == pytest.approx(80.0, abs=0.1)
        assert (house.foot_m, house.top_m) == pytest.approx((2.0, 10.0))
        edges = np.diff(house.triangles, axis=1)
        area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum() / 2
        assert area == pytest.approx(2 * 50 + 2 * (40 + 12) + 2 * 10 * 5, rel=1e-9)  # walls, gables, roof; no floor


def test_a_house_whose_model_lacks_a_wall_gets_one(tmp_path: Path) -> None:
    document = _city([(100.0, 200.0)])
    del document["CityObjects"]["house 0"]["geometry"][0]["boundaries"][0][3]  # the gable wall at the right
    path = tmp_path / "a.city.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    (house,) = read_city_model(path)
    walls = party_walls(ModelHouse(house.name, house.triangles - (0.0, 0.0, house.foot_m), house.footprint))
    np.testing.assert_allclose(walls[:, :, 0], 110.0, atol=1e-6)
    assert walls[:, :, 2].max() == pytest.approx(8.0, abs=0.5)
    edges = np.diff(walls, axis=1)
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum() / 2
    assert area == pytest.approx(40 + 12, rel=0.1)


def test_what_is_no_city_model_is_named(tmp_path: Path) -> None:
    path = tmp_path / "roads.json"
    path.write_text("[1, 2", encoding="utf-8")
    with pytest.raises(InputError, match=r"roads\.json: cannot be read as CityJSON"):
        read_city_model(path)
    path.write_text(json.dumps(_city([]) | {"vertices": []}), encoding="utf-8")
    with pytest.raises(InputError, match="no building"):
        read_city_model(path)


def test_the_aircraft_leaves_the_density_that_was_asked_for() -> None:
    sensor = AirborneSensor(60.0, 50.0, density=8.0, noise_m=0.0, strip_shift_m=0.0, drift_m=0.0, drift_deg=0.0)
    random = np.random.default_rng(5)
    ground = quads(np.array([[(-80, -80, 0), (140, -80, 0), (140, 80, 0), (-80, 80, 0)]]), Material.GRASS)
    found = scan(sensor, World(ground), fly(sensor, 0.0, random), random)
    x, y, z = found.xyz.T
    is_inside = (x > 5) & (x < 55) & (np.abs(y) < 20)
    assert np.abs(z).max() < 1e-6
    assert np.count_nonzero(is_inside) / 2000 == pytest.approx(8.0, rel=0.15)  # some pulses do not come back


def test_distance_to_triangles_of_a_box() -> None:
    shape = box((0, 0, 0), (4, 3, 2), Material.BRICK, has_bottom=True)
    points = np.random.default_rng(1).uniform(-3, 7, (300, 3))
    outside = np.linalg.norm(np.maximum(np.maximum(-points, points - (4, 3, 2)), 0), axis=1)
    inside = np.minimum(points, (4, 3, 2) - points).min(axis=1)
    expected = np.where(inside > 0, inside, outside)
    np.testing.assert_allclose(distance_to_triangles(points, shape.triangles), expected, atol=1e-9)


def test_the_same_seed_gives_the_same_city(city: Path, flown: SimulatedBlock) -> None:
    again = simulate_block(3, _flight(city))
    np.testing.assert_array_equal(again.surveys.after.xyz, flown.surveys.after.xyz)
    assert again.truth.to_dict() == flown.truth.to_dict()


def test_labels_follow_the_edits_and_returns_follow_the_labels(flown: SimulatedBlock) -> None:
    kinds = {i.edit: i for i in flown.truth.instances if i.edit}
    assert {"building added", "building removed", "storey added"} <= set(kinds)
    for instance in flown.truth.instances:
        for survey, stands in zip(flown.surveys, instance.exists, strict=True):
            n = np.count_nonzero(survey.truth_id == instance.instance_id)
            assert stands or n == 0
    raised = kinds["storey added"]
    lift = float(raised.note.split()[0])
    before, after = (survey.xyz[survey.truth_id == raised.instance_id] for survey in flown.surveys)
    before = transform_points(flown.truth.T_after_before, before)
    rise = np.percentile(after[:, 2], 95) - np.percentile(before[:, 2], 95)
    assert rise == pytest.approx(lift, abs=0.35)


def test_walls_under_a_new_storey_did_not_change(flown: SimulatedBlock) -> None:
    raised = next(i for i in flown.truth.instances if i.edit == "storey added")
    after = flown.surveys.after
    own = after.truth_id == raised.instance_id
    is_wall = own & (after.xyz[:, 2] < after.xyz[own, 2].min() + 1.0)
    assert (after.truth_change[is_wall] == ChangeLabel.UNCHANGED).all()
    is_top = own & (after.xyz[:, 2] > after.xyz[own, 2].max() - 0.5)
    assert (after.truth_change[is_top] == ChangeLabel.INCREASED).all()


def test_without_edits_nothing_changed(city: Path) -> None:
    block = simulate_block(3, _flight(city, has_edits=False))
    assert {i.label for i in block.truth.instances} == {ChangeLabel.UNCHANGED}
    assert all((survey.truth_change == ChangeLabel.UNCHANGED).all() for survey in block.surveys)


def test_a_vehicle_drives_where_no_house_stands(city: Path) -> None:
    options = SimulationOptions(length_m=60, city=str(city), density=0.05, has_edits=False)
    block = simulate_block(5, options)
    assert len(block.surveys.before) > 5000
    path = block.surveys.before.trajectory[:, 1:3]
    walls = block.surveys.before.xyz[np.isin(block.surveys.before.truth_id, _buildings(block))]
    gap = np.linalg.norm(walls[:, None, :2] - path[None, ::10], axis=2).min()
    assert gap > 1.5


def _buildings(block: SimulatedBlock) -> list[int]:
    return [i.instance_id for i in block.truth.instances if i.kind == "building of the model"]
