"""Assignment against all possible assignments, by hand, and under exchange of epochs and objects."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference.association import least_total

from loda_pdal.model.boxes import Boxes, box_iou
from loda_pdal.model.labels import ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.params import AssociationParams
from loda_pdal.stages.association import Descriptors, Matches, associate, chi_square, describe
from loda_pdal.stages.correspondence import match_instances
from loda_pdal.stages.instances import Instances

PARAMS = AssociationParams()


def objects(centroid: np.ndarray, size: np.ndarray | float = 2.0, histogram: np.ndarray | None = None) -> Descriptors:
    """Upright cubes (or cuboids) about their centroids."""
    centroid = np.asarray(centroid, dtype=float).reshape(-1, 3)
    n = len(centroid)
    boxes = Boxes(centroid, np.tile(np.eye(3), (n, 1, 1)), np.broadcast_to(size, (n, 3)).astype(float))
    histogram = np.full((n, 10), 0.1) if histogram is None else histogram
    return Descriptors(centroid, boxes, np.full(n, 3.0), histogram, np.full(n, 300))


def random_objects(seed: int, n: int, extent: float) -> Descriptors:
    rng = np.random.default_rng(seed)
    histogram = rng.dirichlet(np.ones(10), n).reshape(n, 10)
    return objects(rng.uniform(0, extent, (n, 3)) * [1, 1, 0.3], rng.uniform(1, 4, (n, 3)), histogram)


def cost_matrix(before: Descriptors, after: Descriptors, params: AssociationParams) -> np.ndarray:
    """The paper's cost of every pair, inf where a gate is closed."""
    cost = np.full((len(before), len(after)), np.inf)
    for i in range(len(before)):
        for j in range(len(after)):
            distance = np.linalg.norm(before.centroid[i] - after.centroid[j])
            iou = box_iou(before.boxes, np.array([i]), after.boxes, np.array([j]))[0]
            a, b = before.histogram[i], after.histogram[j]
            if distance < params.gate_m and iou > params.gate_iou:
                cost[i, j] = distance**2 + 2 * (1 - iou) + 0.5 * np.sum((a - b) ** 2 / np.maximum(a + b, 1e-300)) / 2
    return cost


@given(st.integers(0, 2**32 - 1), st.integers(0, 6), st.integers(0, 6), st.floats(2, 8), st.floats(0.2, 3))
def test_the_assignment_is_the_best_of_all(seed: int, n: int, m: int, extent: float, unmatched: float) -> None:
    params = replace(PARAMS, unmatched_cost=unmatched)
    before, after = random_objects(seed, n, extent), random_objects(seed + 1, m, extent)
    cost = cost_matrix(before, after, params)
    found = associate(before, after, params)
    assert len(set(found.before_idx.tolist())) == len(set(found.after_idx.tolist())) == len(found)
    assert found.cost == pytest.approx(cost[found.before_idx, found.after_idx])
    total = found.cost.sum() + unmatched * (n + m - 2 * len(found))
    assert total == pytest.approx(least_total(cost, unmatched))


def test_cost_and_overlap_by_hand() -> None:
    before = objects([[0, 0, 0]], histogram=np.eye(10)[:1])
    after = objects([[1, 0, 0]], histogram=(np.eye(10)[:1] + np.eye(10)[1:2]) / 2)
    found = associate(before, after, PARAMS)
    assert found.iou[0] == pytest.approx(4 / 12)  # cubes of 8 m3 that share 4 m3
    assert found.cost[0] == pytest.approx(1.0 + 2.0 * 2 / 3 + 0.5 * (0.25 / 1.5 + 0.5) / 2)
    assert (found.before_idx.tolist(), found.after_idx.tolist()) == ([0], [0])


def test_chi_square_is_zero_for_equal_and_one_for_disjoint_histograms() -> None:
    a = np.array([[0.5, 0.5, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    b = np.array([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert chi_square(a, b).tolist() == [0.0, 1.0, 0.0, 0.5]


def test_gates_are_strict() -> None:
    here = objects([[0, 0, 0]], 10.0)
    assert len(associate(here, objects([[2.0, 0, 0]], 10.0), PARAMS)) == 0
    assert len(associate(here, objects([[1.999, 0, 0]], 10.0), PARAMS)) == 1
    ratio = objects([[0, 0, 0]], np.array([10.0, 10.0, 1.0]))  # IoU 0.1
    assert len(associate(here, ratio, replace(PARAMS, gate_iou=0.1001))) == 0
    assert len(associate(here, ratio, replace(PARAMS, gate_iou=0.0999))) == 1


def test_a_pair_is_worth_twice_the_unmatched_cost() -> None:
    here, there = objects([[0, 0, 0]]), objects([[1.0, 0, 0]])
    cost = associate(here, there, PARAMS).cost[0]
    for solver in ("hungarian", "greedy"):
        params = replace(PARAMS, solver=solver)
        assert len(associate(here, there, replace(params, unmatched_cost=cost / 2 * 1.001))) == 1
        assert len(associate(here, there, replace(params, unmatched_cost=cost / 2 * 0.999))) == 0


def test_greedy_takes_the_cheapest_pair_first_and_the_optimum_does_not() -> None:
    before, after = objects([[0.0, 0, 0], [1.0, 0, 0]]), objects([[0.45, 0, 0], [-1.3, 0, 0]])
    greedy, best = (associate(before, after, replace(PARAMS, solver=solver)) for solver in ("greedy", "hungarian"))
    assert (greedy.before_idx.tolist(), greedy.after_idx.tolist()) == ([0], [0])
    assert (best.before_idx.tolist(), best.after_idx.tolist()) == ([0, 1], [1, 0])
    assert best.cost.sum() < greedy.cost.sum() + 2 * PARAMS.unmatched_cost


@pytest.mark.parametrize("solver", ["hungarian", "greedy"])
@pytest.mark.parametrize("is_grid", [False, True])
def test_exchanging_epochs_or_objects_exchanges_the_answer(solver: str, is_grid: bool) -> None:
    params = replace(PARAMS, solver=solver)
    rng = np.random.default_rng(11)
    if is_grid:  # every object has several equally good partners
        steps = np.stack(np.meshgrid(np.arange(6), np.arange(6), [0]), axis=-1).reshape(-1, 3) * 1.0
        before, after = objects(steps), objects(steps + np.array([0.5, 0.5, 0]))
    else:
        before, after = random_objects(1, 80, 25.0), random_objects(2, 90, 25.0)
    found = associate(before, after, params)
    assert len(found) > 10
    pairs = set(zip(found.before_idx.tolist(), found.after_idx.tolist(), strict=True))
    swapped = associate(after, before, params)
    assert {(j, i) for i, j in zip(swapped.before_idx.tolist(), swapped.after_idx.tolist(), strict=True)} == pairs
    assert sorted(swapped.cost.tolist()) == sorted(found.cost.tolist())
    i, j = rng.permutation(len(before)), rng.permutation(len(after))
    shuffled = associate(before.subset(i), after.subset(j), params)
    assert set(zip(i[shuffled.before_idx].tolist(), j[shuffled.after_idx].tolist(), strict=True)) == pairs


def test_an_epoch_matches_itself() -> None:
    same = random_objects(3, 60, 30.0)
    found = associate(same, same, PARAMS)
    assert found.before_idx.tolist() == found.after_idx.tolist() == list(range(60))
    assert found.cost == pytest.approx(0.0, abs=1e-7)


def test_many_objects_take_no_square_matrix() -> None:
    rng = np.random.default_rng(0)
    before = objects(np.column_stack([np.arange(20000) * 3.0, np.zeros((20000, 2))]))
    after = objects(before.centroid + rng.normal(0, 0.1, (20000, 3)))
    tracemalloc.start()
    found = associate(before, after, PARAMS)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.array_equal(found.before_idx, found.after_idx)
    assert len(found) == 20000
    assert peak < 100e6  # a matrix of 20000 x 20000 costs takes 3.2 GB


def test_descriptors_by_hand() -> None:
    height = np.array([0.0, 1.0, 2.0, 3.0, 4.0, np.nan, 9.0, np.nan])
    xyz = np.column_stack([np.arange(8.0), np.zeros(8), np.nan_to_num(height)])
    labels = np.array([1, 1, 1, 1, 1, 1, 0, 3])
    found = describe(xyz, height, labels, 3, bins=4, voxel_m=2.0, boxes_kind="upright")
    assert found.centroid[0] == pytest.approx([2.5, 0, 10 / 6])
    assert found.h95[0] == pytest.approx(3.8)
    assert found.histogram[0] == pytest.approx([0.25, 0.25, 0.25, 0.25])  # 4.0 lies above h95
    assert found.n_voxels.tolist() == [4, 0, 1]
    assert np.isnan(found.h95[1:]).all()
    assert not found.histogram[1:].any()
    assert np.isnan(found.centroid[1]).all()
    assert associate(found, found, PARAMS).before_idx.tolist() == [0, 2]  # object 2 has no points and no partner


def test_nothing_to_match() -> None:
    none, some = objects(np.zeros((0, 3))), objects([[0, 0, 0]])
    for before, after in ((none, none), (none, some), (some, none), (some, objects([[50, 0, 0]]))):
        found = associate(before, after, PARAMS)
        assert (len(found), found.before_idx.dtype, found.cost.dtype) == (0, np.int32, np.float64)
    described = describe(np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=int), 0, 10, 0.5, "pca")
    assert described.histogram.shape == (0, 10)


def test_what_each_epoch_calls_by_another_name_stays_in_its_place() -> None:
    """Of two vans in one proxy the first epoch knows one as a vehicle, the second the other."""
    van = np.stack(np.meshgrid(np.arange(0, 5, 0.25), np.arange(0, 2, 0.25), [1.0]), axis=-1).reshape(-1, 3)
    xyz = np.concatenate([van, van + np.array([5.5, 0.0, 0.0])])
    which = np.repeat([0, 1], len(xyz) // 2)
    one_proxy = np.ones(len(xyz), np.int32)
    kinds = Pair([ObjectClass.MOBILE, ObjectClass.OTHER], [ObjectClass.OTHER, ObjectClass.MOBILE])
    instances = kinds.map(
        lambda kind: Instances(
            (which + 1).astype(np.int32), np.array(kind, dtype=np.uint8), np.array(kind, dtype=np.uint8)[which]
        )
    )
    found = match_instances(
        Pair(xyz, xyz),
        instances,
        instances.map(lambda side: (xyz, side.instance)),
        Pair(*[describe(xyz, xyz[:, 2], which + 1, 2, 10, 0.5, "upright")] * 2),
        (
            Pair(one_proxy, one_proxy),
            Matches(np.zeros(1, np.int32), np.zeros(1, np.int32), np.zeros(1), np.ones(1)),
        ),
        0.6,
        PARAMS,
        has_sides=True,
    )
    np.testing.assert_array_equal(found.owner.before, found.owner.after)
    np.testing.assert_array_equal(found.owner.before, which)


@pytest.mark.parametrize(("has_sides", "expected"), [(False, ObjectClass.MOBILE), (True, ObjectClass.OTHER)])
def test_from_the_air_what_either_epoch_calls_a_vehicle_is_one(has_sides: bool, expected: ObjectClass) -> None:
    """A vehicle of 40 points in the first epoch, a thing of no known kind with 160 points in the second."""
    sides = Pair(0.5, 0.25).map(
        lambda step: np.stack(np.meshgrid(np.arange(0, 5, step), np.arange(0, 2, step), [1.0]), axis=-1).reshape(-1, 3)
    )
    kinds = Pair(ObjectClass.MOBILE, ObjectClass.OTHER)
    instances = sides.join(
        kinds,
        lambda xyz, kind: Instances(
            np.ones(len(xyz), np.int32), np.array([kind], dtype=np.uint8), np.full(len(xyz), kind, np.uint8)
        ),
    )
    found = match_instances(
        sides,
        instances,
        sides.join(instances, lambda xyz, side: (xyz, side.instance)),
        sides.map(lambda xyz: describe(xyz, xyz[:, 2], np.ones(len(xyz), np.int32), 1, 10, 0.5, "upright")),
        None,
        0.6,
        PARAMS,
        has_sides=has_sides,
    )
    assert found.object_class.tolist() == [expected]


@pytest.mark.parametrize(
    ("kinds", "expected"),
    [
        ((ObjectClass.MOBILE, ObjectClass.BUILDING), ObjectClass.MOBILE),
        ((ObjectClass.BUILDING, ObjectClass.MOBILE), ObjectClass.MOBILE),
        ((ObjectClass.OTHER, ObjectClass.BUILDING), ObjectClass.BUILDING),
    ],
)
def test_what_is_a_vehicle_in_one_epoch_and_a_building_in_the_other_is_a_vehicle(
    kinds: tuple[ObjectClass, ObjectClass], expected: ObjectClass
) -> None:
    van = np.stack(np.meshgrid(np.arange(0, 5, 0.25), np.arange(0, 2, 0.25), [1.0]), axis=-1).reshape(-1, 3)
    one = np.ones(len(van), np.int32)
    instances = Pair(*kinds).map(
        lambda kind: Instances(one, np.array([kind], np.uint8), np.full(len(van), kind, np.uint8))
    )
    found = match_instances(
        Pair(van, van),
        instances,
        Pair((van, one), (van, one)),
        Pair(*[describe(van, van[:, 2], one, 1, 10, 0.5, "upright")] * 2),
        None,
        0.6,
        PARAMS,
        has_sides=True,
    )
    assert found.object_class.tolist() == [expected]
