"""Classes and instances on a small scene made by hand: what each point is, is known."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from loda_pdal.kernels.clusters import components
from loda_pdal.kernels.rasters import highest_range
from loda_pdal.model.cloud import FloatArray, IntArray, to_local_grid
from loda_pdal.model.groups import Groups
from loda_pdal.model.labels import ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.params import FuseParams, Parameters
from loda_pdal.stages.crowns import find_crowns
from loda_pdal.stages.features import eigen_features
from loda_pdal.stages.fuse import fuse_points
from loda_pdal.stages.instances import (
    Instances,
    _other,
    euclidean_clusters,
    form_instances,
    with_whole_bodies,
)
from loda_pdal.stages.semantics import classify, fit_planes, split_at_edges, support_area, touching
from loda_pdal.stages.superpoints import superpoints

STREET = Parameters.preset("street")


def sheet(
    rng: np.random.Generator, corner: FloatArray, u: FloatArray, v: FloatArray, density: float = 120.0
) -> FloatArray:
    """Random points on the parallelogram ``corner + a u + b v`` with 1 cm noise."""
    n = int(density * np.linalg.norm(np.cross(u, v)))
    return corner + rng.random((n, 1)) * u + rng.random((n, 1)) * v + rng.normal(0, 0.01, (n, 3))


def box(rng: np.random.Generator, low: FloatArray, size: FloatArray) -> FloatArray:
    x, y, z = np.diag(size)
    sides = [(low, x, z), (low + y, x, z), (low, y, z), (low + x, y, z), (low + z, x, y)]
    return np.concatenate([sheet(rng, *side) for side in sides])


class Scene(NamedTuple):
    xyz: FloatArray
    truth: IntArray  # 0 ground, 1 and 2 houses, 3 tree, 4 and 5 cars, 6 pole
    instances: Instances


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = np.random.default_rng(4)
    ball = rng.normal(size=(4000, 3))
    crown = [12, 8, 5] + 2.0 * ball / np.linalg.norm(ball, axis=1, keepdims=True) * rng.random((4000, 1)) ** (1 / 3)
    trunk = np.column_stack([np.full(150, 12.0), np.full(150, 8.0), rng.uniform(0.2, 3.4, 150)])
    parts = [
        sheet(rng, np.array([-10.0, -15, 0]), np.array([50.0, 0, 0]), np.array([0, 45.0, 0]), 60),
        box(rng, np.array([-5.0, 12, 0]), np.array([9.0, 8, 6])),
        box(rng, np.array([18.0, 12, 0]), np.array([9.0, 8, 5])),
        np.concatenate([crown, trunk + rng.normal(0, 0.05, (150, 3))]),
        box(rng, np.array([0.0, 0, 0.25]), np.array([4.4, 1.8, 1.3])),
        box(rng, np.array([7.0, 0, 0.25]), np.array([4.4, 1.8, 1.3])),
        np.column_stack([rng.normal(25, 0.06, 300), rng.normal(3, 0.06, 300), rng.uniform(0, 6, 300)]),
    ]
    raw = to_local_grid(np.concatenate(parts))
    owner = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    cloud = fuse_points(raw, FuseParams())
    truth = np.zeros(len(cloud), np.int32)
    truth[cloud.voxel_idx] = owner  # where two parts share a voxel, either will do
    height = cloud.xyz[:, 2].copy()
    features = eigen_features(cloud.xyz, height, STREET.features)
    found = superpoints(cloud.xyz, features, STREET.superpoints)
    semantics = classify(cloud.xyz, 0.25, features, found.labels, found.n, STREET.semantics)
    is_plant = semantics.classification == ObjectClass.VEGETATION
    crowns = find_crowns(Pair(cloud.xyz[is_plant], cloud.xyz[:0]), Pair(height[is_plant], height[:0])).before
    instances = form_instances(cloud.xyz, cloud.n_raw, height, semantics, crowns, STREET.instances, STREET.semantics)
    return Scene(cloud.xyz, truth, instances)


@pytest.mark.parametrize(
    ("part", "expected", "share"),
    [
        (0, ObjectClass.GROUND, 0.99),
        (1, ObjectClass.BUILDING, 0.95),
        (2, ObjectClass.BUILDING, 0.95),
        (3, ObjectClass.VEGETATION, 0.90),
        (4, ObjectClass.MOBILE, 0.95),
        (5, ObjectClass.MOBILE, 0.95),
        (6, ObjectClass.OTHER, 0.85),
    ],
)
def test_each_part_gets_its_class(scene: Scene, part: int, expected: ObjectClass, share: float) -> None:
    inside = (scene.truth == part) & ((part == 0) | (scene.xyz[:, 2] > 0.15))
    assert np.mean(scene.instances.classification[inside] == expected) > share


def test_each_object_is_one_instance_of_its_own(scene: Scene) -> None:
    main = []
    for part in range(1, 7):
        number, count = np.unique(
            scene.instances.instance[(scene.truth == part) & (scene.xyz[:, 2] > 0.15)], return_counts=True
        )
        main.append(int(number[np.argmax(count)]))
        assert count.max() > 0.85 * count.sum(), f"part {part} is in pieces"
    assert 0 not in main
    assert len(set(main)) == 6


def test_the_ground_is_no_instance(scene: Scene) -> None:
    assert (scene.instances.instance[scene.instances.classification == ObjectClass.GROUND] == 0).all()


def test_clusters_are_linked_chains() -> None:
    line = np.column_stack([[0.0, 0.5, 1.0, 3.0, 3.4], np.zeros(5), np.zeros(5)])
    assert euclidean_clusters(line, 0.6).tolist() == [0, 0, 0, 1, 1]
    reach = np.array([0.6, 0.6, 2.1, 2.1, 0.6])
    assert euclidean_clusters(line, 0.6, reach).tolist() == [0, 0, 0, 0, 0]
    assert euclidean_clusters(line, 0.45, np.array([0.45, 0.45, 2.1, 0.45, 0.45])).tolist() == [0, 1, 2, 3, 3]


def test_clusters_agree_with_all_pairs() -> None:
    rng = np.random.default_rng(6)
    xyz = rng.uniform(0, 8, (400, 3))
    reach = np.where(rng.random(400) < 0.2, rng.uniform(0.7, 1.5, 400), 0.7)
    gap = np.linalg.norm(xyz[:, None] - xyz[None], axis=2)
    links = np.argwhere(gap <= np.minimum(reach[:, None], reach[None]))
    expected = components(links, 400)
    found = euclidean_clusters(xyz, 0.7, reach)
    assert len(set(zip(expected.tolist(), found.tolist(), strict=True))) == expected.max() + 1 == found.max() + 1


def test_planes_and_their_support() -> None:
    rng = np.random.default_rng(3)
    wall = sheet(rng, np.zeros(3), np.array([4.0, 0, 0]), np.array([0, 0, 3.0]))
    roof = sheet(rng, np.array([0.0, 5, 3]), np.array([4.0, 0, 0]), np.array([0, 2.0, 2.0]))
    xyz = np.concatenate([wall, roof])
    groups = Groups(np.repeat([0, 1], [len(wall), len(roof)]), 2)
    planes = fit_planes(xyz, groups)
    assert planes.normal[0] == pytest.approx([0, np.sign(planes.normal[0, 1]), 0], abs=0.01)
    assert planes.normal[1] == pytest.approx([0, -np.sqrt(0.5), np.sqrt(0.5)], abs=0.01)
    assert planes.rmse == pytest.approx([0.01, 0.01], abs=0.003)
    assert support_area(xyz, groups, planes, 0.5) == pytest.approx([12.0, 11.3], rel=0.25)


def test_segments_that_touch_are_named_once() -> None:
    xyz = np.column_stack([np.arange(6) * 0.25, np.zeros(6), np.zeros(6)])
    pairs, contact = touching(xyz, np.array([0, 0, 1, 1, -1, 2], np.int32), 0.3)
    assert pairs.tolist() == [[0, 1]]
    assert contact.tolist() == [2]


def test_only_a_superpoint_around_a_corner_is_split() -> None:
    rng = np.random.default_rng(4)
    wall = sheet(rng, np.array([0.3, 0, 0]), np.array([4.0, 0, 0]), np.array([0, 0, 3.0]))
    gable = sheet(rng, np.array([0, 0.3, 0]), np.array([0, 4.0, 0]), np.array([0, 0, 3.0]))
    far = sheet(rng, np.array([9.0, 0, 0]), np.array([4.0, 0, 0]), np.array([0, 0, 3.0]))
    xyz = fuse_points(to_local_grid(np.concatenate([wall, gable, far])), FuseParams()).xyz
    part = np.select([xyz[:, 0] > 8, xyz[:, 1] > 0.15], [2, 1], 0).astype(np.int32)
    features = eigen_features(xyz, xyz[:, 2], STREET.features)
    faces = np.array([[0, 1, 0], [1, 0, 0], [0, -1, 0]], dtype=np.float32)
    features = replace(features, normals=faces[part])
    superpoint = np.where(part == 2, 1, 0).astype(np.int32)
    piece, n = split_at_edges(xyz, 0.25, features, superpoint, 2, STREET.semantics)
    assert n == len(set(zip(part.tolist(), piece.tolist(), strict=True))) == 3


@pytest.mark.parametrize(("least_m2", "expected"), [(25.0, ObjectClass.BUILDING), (0.0, ObjectClass.OTHER)])
def test_roofs_that_step_a_little_are_a_roof_from_the_air(least_m2: float, expected: ObjectClass) -> None:
    rng = np.random.default_rng(6)
    roofs = [
        sheet(rng, np.array([8.0 * i, 0, 6 + 0.36 * (i % 2)]), np.array([8.0, 0, 0]), np.array([0, 9.0, 0]), 20)
        for i in range(4)
    ]
    aerial = Parameters.preset("aerial").with_setting(f"semantics.stepped_roof_m2={least_m2}")
    xyz = fuse_points(to_local_grid(np.concatenate(roofs)), aerial.fuse).xyz
    features = eigen_features(xyz, xyz[:, 2], aerial.features)
    one = np.zeros(len(xyz), dtype=np.int32)
    semantics = classify(xyz, aerial.fuse.leaf_m, features, one, 1, aerial.semantics)
    codes, counts = np.unique(semantics.classification, return_counts=True)
    assert codes[np.argmax(counts)] == expected
    assert counts.max() > 0.9 * len(xyz)


def test_cells_climb_to_the_maximum_around_them() -> None:
    rng = np.random.default_rng(5)
    surface = rng.integers(0, 20, (9, 7)).astype(float)
    for reach in (1, 3):
        highest = np.empty(surface.shape, np.int64)
        highest_range(0, 9, surface, reach, highest)
        for i, j in np.ndindex(surface.shape):
            window = [
                (surface[a, b], -(a * 7 + b))
                for a, b in np.ndindex(surface.shape)
                if abs(a - i) <= reach and abs(b - j) <= reach
            ]
            best, at = max(window)
            assert highest[i, j] == (i * 7 + j if surface[i, j] == best else -at)


def test_a_body_of_which_a_building_holds_a_fifth_is_the_buildings() -> None:
    body = np.repeat(np.arange(-1, 3, dtype=np.int32), 10)
    held = np.full(40, -1, dtype=np.int32)
    held[:3], held[10:12], held[20:21], held[12:13] = 7, 4, 5, 3
    found = with_whole_bodies(held, body)
    np.testing.assert_array_equal(found[:10], held[:10])  # of no body
    np.testing.assert_array_equal(found[10:20], [4, 4, 3, 4, 4, 4, 4, 4, 4, 4])
    np.testing.assert_array_equal(found[20:], held[20:])  # a tenth, and nothing
    np.testing.assert_array_equal(with_whole_bodies(held, np.full(40, -1, np.int32)), held)
    assert len(with_whole_bodies(held[:0], body[:0])) == 0


@pytest.mark.parametrize(("n_raw", "found"), [(9, True), (2, False)])
def test_a_few_fused_points_with_many_raw_ones_are_a_thing(n_raw: int, found: bool) -> None:
    xyz = np.column_stack([np.zeros((3, 2)), [0.2, 0.45, 0.7]])
    nobody = np.zeros(3, np.bool_)
    code = np.full(3, ObjectClass.OTHER, np.uint8)
    label = _other(xyz, np.full(3, n_raw, np.int32), code, nobody, Parameters.preset("street").instances)
    assert (label >= 0).tolist() == [found] * 3
    assert (_other(xyz, np.full(3, n_raw, np.int32), code, nobody, Parameters.preset("aerial").instances) < 0).all()
