"""Oriented boxes and their overlap against hand-made cases, angle sweeps and half-space intersections."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from reference.boxes import least_rectangle_area, shared_volume

from loda_pdal.kernels.boxes import drop_inner_points
from loda_pdal.model.boxes import LEAST_SIZE_M, Boxes, box_iou, boxes_of, pca_boxes, upright_boxes


def turned(xyz: np.ndarray, degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return xyz @ turn.T


def solid(length: float, width: float, height: float, n: int = 9) -> np.ndarray:
    """Points of a cuboid with one corner at the origin, corners included."""
    axes = [np.linspace(0, side, n) for side in (length, width, height)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def cuboid(centre: tuple[float, ...], size: tuple[float, ...], degrees: float = 0.0) -> Boxes:
    axes = turned(np.eye(3), degrees)
    return Boxes(np.array([centre]), axes[None], np.array([size]))


def random_boxes(seed: int, n: int) -> Boxes:
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    return Boxes(rng.uniform(-1, 1, (n, 3)), axes, rng.uniform(0.3, 3, (n, 3)))


ONE = np.zeros(1, dtype=int)


@pytest.mark.parametrize("degrees", [0.0, 17.0, 45.0, 90.0, 133.0])
def test_a_turned_cuboid_is_found(degrees: float) -> None:
    xyz = turned(solid(6.0, 2.0, 3.0), degrees) + np.array([10.0, -20.0, 1.0])
    for kind in ("upright", "pca"):
        boxes = boxes_of(kind, xyz, np.zeros(len(xyz), dtype=int), 1)
        middle = turned(np.array([[3.0, 1.0, 1.5]]), degrees)[0] + np.array([10.0, -20.0, 1.0])
        assert boxes.centre[0] == pytest.approx(middle, abs=1e-9)
        assert sorted(boxes.size[0]) == pytest.approx([2.0, 3.0, 6.0], abs=1e-9)
        assert abs(boxes.axes[0, 0] @ turned(np.array([1.0, 0, 0]), degrees)) == pytest.approx(1.0, abs=1e-9)
        assert boxes.axes[0] @ boxes.axes[0].T == pytest.approx(np.eye(3), abs=1e-12)
        assert boxes.volume[0] == pytest.approx(36.0, abs=1e-8)
    upright = upright_boxes(xyz, np.zeros(len(xyz), dtype=int), 1)
    assert upright.size[0] == pytest.approx([6.0, 2.0, 3.0], abs=1e-9)
    assert upright.axes[0, 0, 0] >= 0


@given(st.integers(0, 2**32 - 1), st.integers(3, 60))
def test_the_upright_box_is_the_smallest_that_holds_all_points(seed: int, n: int) -> None:
    xyz = np.random.default_rng(seed).normal(size=(n, 3)) * [3.0, 1.0, 1.0] + np.array([100, 200, 300])
    box = upright_boxes(xyz, np.zeros(n, dtype=int), 1)
    within = np.abs((xyz - box.centre[0]) @ box.axes[0].T)
    assert np.all(within <= box.size[0] / 2 + 1e-9)
    if box.size[0, 1] > LEAST_SIZE_M:
        area = box.size[0, 0] * box.size[0, 1]
        assert area <= least_rectangle_area(xyz[:, :2]) + 1e-9
        assert area >= 0.995 * least_rectangle_area(xyz[:, :2])


@pytest.mark.parametrize(
    ("shape", "least_share"), [("disc", 0.8), ("square", 0.8), ("wall", 0.4), ("corner", 0.0), ("twice", 0.0)]
)
def test_only_inner_points_are_dropped(shape: str, least_share: float) -> None:
    rng = np.random.default_rng(7)
    u, v = rng.uniform(-1, 1, (2, 3000))
    plan = {
        "disc": np.column_stack([u, v])[u**2 + v**2 < 1],
        "square": np.column_stack([np.round(u, 1), np.round(v, 1)]),
        "wall": np.column_stack([5 * u, 0.01 * v]),
        "corner": np.column_stack([np.where(v > 0, u, -1), np.where(v > 0, -1, u)]),
        "twice": np.repeat(np.column_stack([u, v])[:3], 2, axis=0),
    }[shape]
    xy = turned(np.column_stack([plan, np.zeros(len(plan))]), 31.0)[:, :2].copy()
    label = np.zeros(len(xy), np.int32)
    starts = np.array([0, len(xy)])
    drop_inner_points(0, 1, xy, np.arange(len(xy), dtype=np.int32), starts, label)
    assert np.mean(label < 0) >= least_share
    hull = shapely.MultiPoint(xy).convex_hull
    assert shapely.MultiPoint(xy[label == 0]).convex_hull.normalize() == hull.normalize()


def test_groups_get_their_own_boxes_whatever_the_order() -> None:
    rng = np.random.default_rng(3)
    xyz, labels = rng.normal(size=(500, 3)), rng.integers(-1, 5, 500)
    shuffle = rng.permutation(500)
    for make in (upright_boxes, pca_boxes):
        boxes = make(xyz, labels, 6)
        assert np.isnan(boxes.size[5]).all()  # a group without points
        for group in range(5):
            alone = make(xyz[labels == group], np.zeros(np.sum(labels == group), dtype=int), 1)
            assert boxes.centre[group] == pytest.approx(alone.centre[0], abs=1e-12)
            assert boxes.size[group] == pytest.approx(alone.size[0], abs=1e-12)
        shuffled = make(xyz[shuffle], labels[shuffle], 6)
        assert shuffled.size[:5] == pytest.approx(boxes.size[:5], abs=1e-9)


@pytest.mark.parametrize("kind", ["upright", "pca"])
def test_points_and_walls_have_a_least_thickness(kind: str) -> None:
    wall = solid(8.0, 0.0, 5.0)
    line = solid(4.0, 0.0, 0.0)
    for xyz, size in ((wall, [0.25, 5, 8]), (line, [0.25, 0.25, 4]), (np.ones((3, 3)), [0.25] * 3)):
        boxes = boxes_of(kind, turned(xyz, 30), np.zeros(len(xyz), dtype=int), 1)
        assert sorted(boxes.size[0]) == pytest.approx(size, abs=1e-9)
        assert box_iou(boxes, ONE, boxes, ONE) == pytest.approx(1.0, abs=1e-9)


def test_overlaps_that_can_be_checked_by_hand() -> None:
    unit = cuboid((0, 0, 0), (1, 1, 1))
    cases = [
        (unit, 1.0),
        (cuboid((0.5, 0, 0), (1, 1, 1)), 1 / 3),
        (cuboid((0.5, 0, 0.5), (1, 1, 1)), 1 / 7),
        (cuboid((0, 0, 0), (2, 1, 1)), 1 / 2),
        (cuboid((0, 0, 0), (2, 2, 2)), 1 / 8),
        (cuboid((0, 0, 0), (1, 1, 1), 90), 1.0),
        (cuboid((0, 0, 0), (1, 1, 1), 45), 2 * (np.sqrt(2) - 1) / (2 - 2 * (np.sqrt(2) - 1))),
        (cuboid((1, 0, 0), (1, 1, 1)), 0.0),
        (cuboid((9, 0, 0), (1, 1, 1)), 0.0),
        (cuboid((np.nan, 0, 0), (1, 1, 1)), 0.0),
    ]
    for other, expected in cases:
        assert box_iou(unit, ONE, other, ONE) == pytest.approx(expected, abs=1e-8)
        assert box_iou(other, ONE, unit, ONE) == pytest.approx(expected, abs=1e-8)


def test_overlap_of_nearly_equal_boxes_is_nearly_one() -> None:
    boxes = random_boxes(2, 50)
    idx = np.arange(50)
    for shift in (0.0, 1e-15, 1e-12, 1e-9, 1e-6):
        moved = Boxes(boxes.centre + shift, boxes.axes, boxes.size)
        assert box_iou(boxes, idx, moved, idx) == pytest.approx(1.0, abs=1e-4)


def test_overlap_agrees_with_half_space_intersection() -> None:
    one, two = random_boxes(0, 40), random_boxes(1, 40)
    idx = np.arange(40)
    found = box_iou(one, idx, two, idx)
    for k in idx:
        shared = shared_volume((one.centre[k], one.axes[k], one.size[k]), (two.centre[k], two.axes[k], two.size[k]))
        assert found[k] == pytest.approx(shared / (one.volume[k] + two.volume[k] - shared), abs=1e-7)
    assert 10 < np.count_nonzero(found) < 40
    assert np.array_equal(found, box_iou(two, idx, one, idx))


def test_footprint_overlap_agrees_with_shapely() -> None:
    rng = np.random.default_rng(5)
    labels = np.repeat(np.arange(30), 20)
    xyz = rng.normal(size=(600, 3)) * [2, 1, 1] + np.repeat(rng.uniform(-2, 2, (30, 3)), 20, axis=0)
    boxes = upright_boxes(xyz, labels, 30)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    plans = [
        shapely.Polygon(boxes.centre[k, :2] + (corners * boxes.size[k, :2]) @ boxes.axes[k, :2, :2]) for k in range(30)
    ]
    a, b = (index.ravel() for index in np.meshgrid(np.arange(30), np.arange(30)))
    expected = [plans[i].intersection(plans[j]).area / plans[i].union(plans[j]).area for i, j in zip(a, b, strict=True)]
    assert boxes.footprint_overlap(a, b) == pytest.approx(expected, abs=1e-7)


def test_no_points_and_no_boxes() -> None:
    for make in (upright_boxes, pca_boxes):
        assert len(make(np.zeros((0, 3)), np.zeros(0, dtype=int), 0)) == 0
        assert np.isnan(make(np.zeros((0, 3)), np.zeros(0, dtype=int), 2).size).all()
        assert np.isnan(make(np.zeros((4, 3)), np.full(4, -1), 1).size).all()
    none = np.zeros(0, dtype=int)
    boxes = random_boxes(0, 3)
    assert box_iou(boxes, none, boxes, none).shape == (0,)
