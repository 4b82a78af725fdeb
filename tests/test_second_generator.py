"""The second generator (benchmarks/second_generator.py): what it says of a block is what its surveys meet."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from benchmarks.second_generator import (
    MIN_RETURNS,
    Block,
    Caster,
    _box,
    annotate,
    from_the_air,
    from_the_street,
    make_block,
    surfaces,
)
from loda_pdal.benchmark.simulate.city_model import ModelBuilding
from loda_pdal.benchmark.simulate.raycast import RayCaster
from loda_pdal.benchmark.simulate.shapes import Material, Shape
from loda_pdal.model.cloud import FloatArray, IntArray
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.pair import Pair


def _city() -> list[ModelBuilding]:
    """Two streets of sixteen houses each, 20 m apart."""
    city = []
    for i in range(16):
        for x in (-16.0, 16.0):
            y = 9.0 * (i - 7.5)
            shape = _box(x, y, 0.0, (10.0, 7.0, 6.0), 0.0)
            city.append(ModelBuilding(f"{i} {x}", shape, shapely.box(x - 5, y - 3.5, x + 5, y + 3.5), 0.0, 6.0))
    return city


def _caster(block: Block, epoch: int, origin: FloatArray) -> Caster:
    """As `open3d_caster`, by the tree of the first generator."""
    triangles, owner = surfaces(block, epoch)
    material = np.full(len(triangles), Material.FACADE, np.uint8)
    tree = RayCaster(Shape(triangles - origin, material, np.zeros((0, 7)), np.zeros(0, np.uint8)))

    def cast(rays: FloatArray) -> tuple[FloatArray, IntArray]:
        hits = tree.cast(rays[:, :3], rays[:, 3:])
        return hits.range_m, np.where(hits.primitive >= 0, owner[hits.primitive], -1).astype(np.int32)

    return cast


@pytest.mark.parametrize("sensor", ["airborne", "vehicle"])
def test_surveys_meet_what_the_truth_says_stands_there(sensor: str) -> None:
    block = make_block(_city(), sensor, np.random.default_rng(5))
    origin = np.array([*block.centre, block.foot_m])
    measure = from_the_air if sensor == "airborne" else from_the_street
    clouds = Pair(*(measure(block, _caster(block, e, origin), origin, np.random.default_rng((5, e))) for e in (0, 1)))
    truth = annotate(block, clouds, np.eye(4), 5)
    assert len(truth.instances) == len(block.things)
    assert {i.label for i in truth.instances} >= {ChangeLabel.ADDED, ChangeLabel.REMOVED, ChangeLabel.UNCHANGED}
    for instance in truth.instances:
        for exists, n in zip(instance.exists, instance.n_points, strict=True):
            assert exists or n == 0
        assert (instance.label == ChangeLabel.ADDED) == (not instance.exists.before)
        assert (instance.label == ChangeLabel.REMOVED) == (not instance.exists.after)
        if instance.excluded is None and instance.label != ChangeLabel.UNCHANGED:
            assert max(instance.n_changed) >= MIN_RETURNS
    ground = [xyz[owner == 0] for xyz, owner in clouds]
    for xyz in ground:
        noise_m = 0.05 if sensor == "vehicle" else 0.1
        assert np.median(np.abs(xyz[:, 2] - block.ground(xyz[:, 0], xyz[:, 1]))) < noise_m


def test_a_seed_gives_one_block() -> None:
    blocks = [make_block(_city(), "airborne", np.random.default_rng(seed)) for seed in (3, 3, 4)]
    edits = [[(thing.kind, thing.edit) for thing in block.things] for block in blocks]
    assert edits[0] == edits[1]
    assert edits[0] != edits[2]
    for one, same in zip(surfaces(blocks[0], 1), surfaces(blocks[1], 1), strict=True):
        np.testing.assert_array_equal(one, same)
