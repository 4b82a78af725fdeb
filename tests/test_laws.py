"""What must be true of every result (METHOD 3), on a simulated block, through the whole method."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from loda_pdal.benchmark.simulate import Reality, SimulatedBlock, SimulationOptions, simulate_block
from loda_pdal.kernels.parallel import set_threads
from loda_pdal.model.cloud import FloatArray, to_local_grid
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.records import ChangeResult, PointLabels
from loda_pdal.model.survey import Survey
from loda_pdal.model.transform import invert, transform_points
from loda_pdal.params import PRESETS, Parameters
from loda_pdal.pipeline import detect_changes

SMALL = SimulationOptions(length_m=60.0, density=0.6, reality=Reality.none())


def survey(xyz: FloatArray, shift: float = 0.0) -> Survey:
    """A survey of full map coordinates, all moved by ``shift`` m in x and y."""
    moved = xyz + np.array([shift, shift, 0.0])
    frame = LocalFrame((int(120_000 + shift), int(488_000 + shift), 0))
    return Survey(frame.to_local(moved), frame)


def labels(points: PointLabels) -> list[FloatArray]:
    return [points.change, points.object, points.classification, points.instance]


def same(a: ChangeResult, b: ChangeResult) -> None:
    """Both results say the same of every point and every object, to the last bit."""
    for one, other in zip(a.points, b.points, strict=True):
        for left, right in zip(labels(one), labels(other), strict=True):
            assert np.array_equal(left, right)
        assert np.array_equal(one.confidence, other.confidence, equal_nan=True)
        assert np.array_equal(one.lod95, other.lod95, equal_nan=True)
    for mine, yours in zip(a.objects, b.objects, strict=True):
        assert mine.footprint.equals(yours.footprint)
        assert replace(mine, footprint=None) == replace(yours, footprint=None)


@pytest.fixture(scope="module")
def block() -> SimulatedBlock:
    return simulate_block(12, SMALL)


@pytest.fixture(scope="module")
def result(block: SimulatedBlock) -> ChangeResult:
    return detect_changes(survey(block.surveys.before.xyz), survey(block.surveys.after.xyz))


def test_most_planted_edits_are_found(block: SimulatedBlock, result: ChangeResult) -> None:
    """Each edited object has most of its changed points in objects with its label."""
    right, n = 0, 0
    for instance in block.truth.instances:
        if instance.excluded or instance.label == ChangeLabel.UNCHANGED or instance.object_class.title == "ground":
            continue
        votes = np.zeros(6, np.int64)
        for measured, points in zip(block.surveys, result.points, strict=True):
            is_own = (measured.truth_id == instance.instance_id) & (measured.truth_change > ChangeLabel.UNCHANGED)
            votes += np.bincount(points.change[is_own], minlength=6)
        right += int(votes.argmax() == instance.label)
        n += 1
    assert n >= 8
    assert right >= 0.7 * n, f"{right} of {n}"


def test_the_result_is_complete(block: SimulatedBlock, result: ChangeResult) -> None:
    for measured, points in zip(block.surveys, result.points, strict=True):
        assert len(points.change) == len(measured)
        assert set(np.unique(points.classification)) <= {2, 5, 6, 7, 64, 65}
        assert (points.object[points.classification == 2] == 0).all()
        assert np.isnan(points.confidence[points.change == 0]).all()
        assert (points.confidence[points.change > 0] >= 0).all()
        of_objects = {o.object_id: int(o.label) for o in result.objects}
        owned = points.object > 0
        assert [of_objects[i] for i in points.object[owned][:2000].tolist()] == points.change[owned][:2000].tolist()
    assert [o.object_id for o in result.objects] == list(range(1, len(result.objects) + 1))
    assert all(o.footprint.is_valid and not o.footprint.is_empty for o in result.objects)
    assert all(o.reason for o in result.objects)


def test_a_survey_against_itself_shows_no_change(block: SimulatedBlock) -> None:
    itself = survey(block.surveys.after.xyz)
    found = detect_changes(itself, itself)
    assert [o for o in found.objects if o.label != ChangeLabel.UNCHANGED] == []
    assert found.ground_changes == []
    assert found.registration.converged
    assert np.abs(found.registration.shift_m).max() < 1e-6


def test_a_street_surveyed_twice_without_edits_shows_no_changed_objects() -> None:
    still = simulate_block(14, replace(SMALL, has_edits=False))
    found = detect_changes(survey(still.surveys.before.xyz), survey(still.surveys.after.xyz))
    n_points = sum((o.points_before or 0) + (o.points_after or 0) for o in found.changes)
    assert n_points < 0.02 * (len(still.surveys.before) + len(still.surveys.after))
    assert found.ground_changes == []


def test_swapping_the_epochs_swaps_the_labels(block: SimulatedBlock, result: ChangeResult) -> None:
    swapped = detect_changes(survey(block.surveys.after.xyz), survey(block.surveys.before.xyz))
    assert len(swapped.objects) == len(result.objects)
    for there, back in zip(result.objects, swapped.objects, strict=True):
        assert back.label == there.label.swapped
        assert back.object_class == there.object_class
        assert back.confidence == pytest.approx(there.confidence, abs=1e-9)
        assert (back.points_before, back.points_after) == (there.points_after, there.points_before)
    for there_points, back_points in zip(result.points, swapped.points.swapped, strict=True):
        assert np.array_equal(there_points.object, back_points.object)
    both = swapped.registration.T_after_before @ result.registration.T_after_before
    assert both == pytest.approx(np.eye(4), abs=1e-9)


@pytest.mark.parametrize(
    "choice",
    [
        "superpoints.method=components",
        "association.solver=greedy",
        "association.boxes=pca",
        "ground.vertical=ground",
        "icp.loss=l2",
        "instances.join_by_footprint=false",
        "changes.visible_only=false",
    ],
)
def test_every_choice_obeys_the_swap(choice: str) -> None:
    scene = simulate_block(12, replace(SMALL, density=0.3, reality=Reality()))
    before, after = (survey(side.xyz) for side in scene.surveys)
    parameters = Parameters().with_setting(choice)
    there, back = detect_changes(before, after, parameters), detect_changes(after, before, parameters)
    assert [o.label for o in back.objects] == [o.label.swapped for o in there.objects]
    assert len(there.changes) >= 5


@pytest.mark.parametrize("preset", ["paper", "aerial"])
def test_other_presets_show_no_change_in_a_survey_against_itself(block: SimulatedBlock, preset: str) -> None:
    itself = survey(block.surveys.after.xyz)
    found = detect_changes(itself, itself, Parameters.preset(preset))
    assert len(found.objects) > 20
    assert found.changes == []
    assert found.ground_changes == []


@pytest.mark.parametrize("n_threads", [1, 4])
def test_point_order_and_threads_do_not_matter(block: SimulatedBlock, result: ChangeResult, n_threads: int) -> None:
    rng = np.random.default_rng(0)
    order = [rng.permutation(len(side)) for side in block.surveys]
    set_threads(n_threads)
    try:
        shuffled = detect_changes(survey(block.surveys.before.xyz[order[0]]), survey(block.surveys.after.xyz[order[1]]))
    finally:
        set_threads(None)
    for own, points, other in zip(order, result.points, shuffled.points, strict=True):
        for left, right in zip(labels(points), labels(other), strict=True):
            assert np.array_equal(left[own], right)
    for mine, yours in zip(result.objects, shuffled.objects, strict=True):
        assert replace(mine, footprint=None) == replace(yours, footprint=None)


def test_two_runs_at_once_in_threads_of_somebody_else(block: SimulatedBlock, result: ChangeResult) -> None:
    """As a scheduler of tiles would: each run makes threads of its own inside a thread that it was given."""
    with ThreadPoolExecutor(2) as workers:
        runs = [
            workers.submit(detect_changes, *(survey(epoch.xyz) for epoch in block.surveys)),
            workers.submit(detect_changes, *(survey(epoch.xyz) for epoch in block.surveys)),
        ]
        for run in runs:
            same(result, run.result())


def test_a_shift_of_the_whole_map_changes_nothing(block: SimulatedBlock, result: ChangeResult) -> None:
    there = [survey(side.xyz, 1e6) for side in block.surveys]
    same(result, detect_changes(there[0], there[1]))


@pytest.mark.parametrize(("reality", "limit_deg"), [(Reality.none(), 0.02), (Reality(), 0.05)], ids=["tidy", "hard"])
def test_registration_recovers_a_known_offset(reality: Reality, limit_deg: float) -> None:
    moved = simulate_block(15, replace(SMALL, shift_m=3.0, rotation_deg=10.0, reality=reality))
    before, after = (survey(side.xyz) for side in moved.surveys)
    found = detect_changes(before, after).registration
    assert found.converged, found.message
    into = np.eye(4)
    into[:3, 3] = -np.array(before.frame.origin, dtype=float)
    truth = into @ moved.truth.T_after_before @ invert(into)
    centre = after.xyz.mean(axis=0)
    start = transform_points(invert(truth), centre[None])
    assert transform_points(found.T_after_before, start)[0] == pytest.approx(centre, abs=0.01)
    turn = found.T_after_before[:3, :3] @ truth[:3, :3].T
    assert np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < limit_deg


@pytest.mark.parametrize("n", [0, 1, 10, 200])
@pytest.mark.parametrize("preset", PRESETS)
def test_next_to_no_points_give_no_objects_and_a_warning(n: int, preset: str) -> None:
    rng = np.random.default_rng(n)
    before, after = (
        Survey(to_local_grid(np.column_stack([rng.uniform(0, 20, (n, 2)), rng.normal(0, 0.02, n)]))) for _ in range(2)
    )
    found = detect_changes(before, after, Parameters.preset(preset))
    assert found.objects == []
    assert found.ground_changes == []
    assert "did not converge" in found.warnings[0]
    assert [len(side.change) for side in found.points] == [n, n]
