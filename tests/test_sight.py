"""Rays: what a survey saw empty, what was hidden from it, and what it says nothing about."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from loda_pdal.io.las import read_epochs
from loda_pdal.io.trajectory import read_trajectory
from loda_pdal.kernels.parallel import run_ranges, set_threads
from loda_pdal.kernels.sight import crossed_range
from loda_pdal.model.cloud import FloatArray, Int64Array, IntArray, to_local_grid
from loda_pdal.model.errors import InputError
from loda_pdal.model.grid import Lattice
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.model.survey import Survey
from loda_pdal.model.trajectory import Trajectory
from loda_pdal.params import FuseParams, ObservabilityParams, Parameters
from loda_pdal.pipeline import detect_changes
from loda_pdal.stages.changes import Changes
from loda_pdal.stages.fuse import fuse_survey
from loda_pdal.stages.observability import Coverage, coverage
from loda_pdal.stages.sight import Sight, lines_of_sight
from loda_pdal.warmup import write_scene, write_trajectories
from tests.io_samples import CORNER, make_las, scattered
from tests.reference.sight import crossed
from tests.test_changes import block, decide, labels, surface

PARAMS = ObservabilityParams()


def kernel(origin: FloatArray, target: FloatArray, cell: Int64Array, min_size: int = 8) -> Pair[IntArray]:
    """Rays that pass each voxel of 0.5 m, and rays that are kept from it."""
    lattice = Lattice.around(cell)
    found = Pair(np.zeros(len(cell), np.int32), np.zeros(len(cell), np.int32))
    n_rows = int(lattice.span[0])
    run_ranges(
        crossed_range,
        n_rows,
        origin,
        target,
        0.5,
        1.0,
        4.0,
        0.5,
        cell,
        lattice.low,
        lattice.span,
        *found,
        min_size=min_size,
    )
    return found


def some_voxels(n: int = 600) -> Int64Array:
    return np.unique(np.random.default_rng(3).integers(-6, 7, (n, 3)), axis=0)


def test_rays_cross_what_the_slow_twin_says() -> None:
    random = np.random.default_rng(4)
    origin, target = random.uniform(-6, 6, (60, 3)), random.uniform(-4, 4, (60, 3))
    target[:5, :2] = origin[:5, :2]  # straight up or down
    target[5:10, 2] = origin[5:10, 2]  # level
    target[10:13, 0] = origin[10:13, 0]
    target[13] = origin[13]  # no ray at all
    passed, hidden = crossed(origin, target, 0.5, 1.0, 4.0, 0.5, some_voxels())
    found = kernel(origin, target, some_voxels())
    assert found.before.tolist() == passed.tolist()
    assert found.after.tolist() == hidden.tolist()
    assert passed.sum() > 100
    assert hidden.sum() > 10


def test_one_ray_by_hand() -> None:
    cell = np.array([[k, 0, 0] for k in range(10)])  # voxels along x, from 0 to 5 m
    origin, target = np.array([[-1.0, 0.25, 0.26]]), np.array([[2.6, 0.25, 0.24]])
    found = kernel(origin, target, cell)
    # left by 2.0 m, half a metre before the return; entered from 3.6 m on, a metre behind it
    assert found.before.tolist() == [1, 1, 1, 1, 0, 0, 0, 0, 0, 0]
    assert found.after.tolist() == [0, 0, 0, 0, 0, 0, 0, 0, 1, 1]
    upwards = kernel(origin, target + np.array([0, 0, 0.05]), cell)
    assert upwards.before.tolist() == found.before.tolist()
    assert upwards.after.sum() == 0  # others may have gone to the sky beside it


@pytest.mark.parametrize("threads", [1, 3])
def test_neither_threads_nor_the_order_of_rays_matter(threads: int) -> None:
    random = np.random.default_rng(5)
    origin, target = random.uniform(-6, 6, (500, 3)), random.uniform(-4, 4, (500, 3))
    expected = kernel(origin, target, some_voxels(), min_size=1000)
    shuffled = random.permutation(500)
    set_threads(threads)
    try:
        found = kernel(origin[shuffled], target[shuffled], some_voxels(), min_size=1)
    finally:
        set_threads(None)
    assert np.array_equal(found.before, expected.before)
    assert np.array_equal(found.after, expected.after)


def test_positions_between_those_listed_and_none_in_a_gap() -> None:
    way = Trajectory(
        np.array([0.0, 1.0, 3.0, 60.0, 61.0]), np.array([[0.0, 0, 2], [4, 0, 2], [8, 0, 2], [8, 3, 2], [0, 3, 2]])
    )
    found = way.at(np.array([0.5, 2.0, 3.05, 30.0, 59.95, 60.25, 61.05, 62.0, -0.05, -1.0]))
    assert found.is_known.tolist() == [True, True, True, False, True, True, True, False, True, False]
    assert found.xyz[found.is_known, 0].tolist() == [2, 6, 8, 8, 6, 0, 0]
    assert found.along[found.is_known].tolist() == [2, 6, 8, 11, 13, 19, 0]
    with pytest.raises(ValueError, match="ascending"):
        Trajectory(np.array([1.0, 1.0]), np.zeros((2, 3)))


def driven(seed: int = 1, n: int = 3000) -> Survey:
    """Returns left and right of a street that is driven twice."""
    random = np.random.default_rng(seed)
    time = np.sort(random.uniform(0, 20, n)) + np.repeat([0.0, 40.0], n // 2)
    way = Trajectory(np.array([0.0, 20, 40, 60]), np.array([[0.0, -1, 2], [40, -1, 2], [40, 1, 2], [0, 1, 2]]))
    xyz = to_local_grid(way.at(time).xyz * [1, 0, 0] + random.uniform([-1, -8, 0], [1, 8, 3], (n, 3)))
    return Survey(xyz, trajectory=way, gps_time=time)


def test_a_fused_point_has_a_ray_for_each_stretch_it_was_seen_from() -> None:
    survey = driven()
    cloud = fuse_survey(survey, FuseParams(leaf_m=2.0))
    sight = lines_of_sight(survey, cloud, PARAMS)
    assert sight is not None and survey.gps_time is not None and survey.trajectory is not None
    at = survey.trajectory.at(survey.gps_time)
    pairs = np.column_stack([cloud.voxel_idx, np.floor(at.along / 5)])[at.is_known]
    distinct, which = np.unique(pairs, axis=0, return_inverse=True)
    assert sight.point.tolist() == distinct[:, 0].tolist()
    mean = [at.xyz[at.is_known][which == ray].mean(axis=0) for ray in range(len(distinct))]
    assert np.allclose(sight.sensor, mean, atol=1e-9)


def test_rays_do_not_depend_on_the_order_of_the_points(monkeypatch: pytest.MonkeyPatch) -> None:
    survey = driven()
    assert survey.gps_time is not None
    order = np.random.default_rng(6).permutation(len(survey))
    other = Survey(survey.xyz[order], trajectory=survey.trajectory, gps_time=survey.gps_time[order])
    expected = lines_of_sight(survey, fuse_survey(survey, FuseParams()), PARAMS)
    monkeypatch.setattr("loda_pdal.model.survey.PART", 700)  # and not on how they come in parts
    found = lines_of_sight(other, fuse_survey(other, FuseParams()), PARAMS)
    assert expected is not None and found is not None
    assert np.array_equal(found.sensor, expected.sensor)
    assert np.array_equal(found.point, expected.point)


def test_without_points_or_trajectory_there_are_no_rays() -> None:
    way = driven().trajectory
    nothing = Survey(np.zeros((0, 3)), trajectory=way, gps_time=np.zeros(0))
    sight = lines_of_sight(nothing, fuse_survey(nothing, FuseParams()), PARAMS)
    assert sight is not None and len(sight) == 0
    shown = sight.of(some_voxels(), 0.5)
    assert not shown.is_shown.any() and not shown.is_hidden.any()
    assert len(sight.of(np.zeros((0, 3), np.int64), 0.5).is_shown) == 0
    plain = Survey(np.zeros((5, 3)))
    assert lines_of_sight(plain, fuse_survey(plain, FuseParams()), PARAMS) is None
    by_columns = ObservabilityParams(method="coverage")
    assert lines_of_sight(driven(), fuse_survey(driven(), FuseParams()), by_columns) is None
    with pytest.raises(ValueError, match="GPS times"):
        Survey(np.zeros((5, 3)), trajectory=way)


BOX = block(0, 0, 4, 2, 1.5)
SENSOR = np.array([2.0, -12.0, 2.5])


def grid(x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).reshape(-1, 3)


GROUND = grid(np.arange(-9.9, 14, 0.25), np.arange(-9.9, 10, 0.25), np.array([0.0]))
WALL = grid(np.arange(-3, 7, 0.25), np.array([-3.0]), np.arange(0.125, 3, 0.25))


def seeing(returns: FloatArray, covered: FloatArray = GROUND) -> Coverage:
    """A survey with returns on all ``covered``, of which the rays to ``returns`` are known."""
    rays = Sight(np.tile(SENSOR, (len(returns), 1)), np.arange(len(returns), dtype=np.int32), returns, PARAMS)
    return coverage(covered, PARAMS, rays)


def box_and_nothing(seen: Coverage) -> Changes:
    return decide(surface((0, BOX)), surface(), ObjectClass.MOBILE, seen=Pair(coverage(GROUND, PARAMS), seen))


def test_a_box_hidden_behind_a_wall_is_undetermined_and_says_so() -> None:
    found = box_and_nothing(seeing(WALL))
    assert labels(found) == [ChangeLabel.UNDETERMINED]
    assert "was hidden behind what stood nearer" in found.reason[0]
    assert found.evidence.hidden[0] > 0.9
    by_columns = box_and_nothing(coverage(GROUND, PARAMS))
    assert labels(by_columns) == [ChangeLabel.REMOVED]  # what coverage alone says
    assert by_columns.evidence.hidden[0] == 0


def test_a_box_that_rays_now_pass_through_was_removed() -> None:
    assert labels(box_and_nothing(seeing(GROUND))) == [ChangeLabel.REMOVED]
    behind = GROUND[GROUND[:, 1] > 3]  # its own place was not measured, only passed
    found = box_and_nothing(seeing(behind, covered=behind))
    assert labels(found) == [ChangeLabel.REMOVED]
    assert labels(box_and_nothing(coverage(behind, PARAMS))) == [ChangeLabel.UNDETERMINED]


def test_a_box_that_was_never_covered_is_undetermined_but_not_hidden() -> None:
    elsewhere = GROUND[GROUND[:, 0] < -5]
    found = box_and_nothing(seeing(elsewhere, covered=elsewhere))
    assert labels(found) == [ChangeLabel.UNDETERMINED]
    assert "hidden" not in found.reason[0]


@pytest.mark.parametrize("returns", [WALL, GROUND])
def test_swapped_epochs_swap_the_label(returns: FloatArray) -> None:
    seen = Pair(coverage(GROUND, PARAMS), seeing(returns))
    one = decide(surface((0, BOX)), surface(), ObjectClass.MOBILE, seen=seen)
    other = decide(surface(), surface((0, BOX)), ObjectClass.MOBILE, seen=seen.swapped)
    swapped = {ChangeLabel.REMOVED: ChangeLabel.ADDED, ChangeLabel.UNDETERMINED: ChangeLabel.UNDETERMINED}
    assert labels(other) == [swapped[label] for label in labels(one)]
    assert other.evidence.observability.tolist() == one.evidence.observability.tolist()
    assert other.evidence.hidden.tolist() == one.evidence.hidden.tolist()


def test_surveys_with_trajectories_can_be_swapped_too(tmp_path: Path) -> None:
    paths, ways = write_scene(tmp_path), write_trajectories(tmp_path)
    surveys = read_epochs(*paths, trajectories=ways)
    assert "knows where the sensor was for 100.0%" in surveys.before.notes[-1]
    street = Parameters.preset("street")
    forth = detect_changes(surveys.before, surveys.after, street)
    back = detect_changes(surveys.after, surveys.before, street)
    assert len(forth.objects) > 0
    assert [o.observability for o in forth.objects] == [o.observability for o in back.objects]
    plain = read_epochs(*paths)
    by_columns = street.with_setting("observability.method=coverage")
    expected = detect_changes(plain.before, plain.after, street)
    found = detect_changes(surveys.before, surveys.after, by_columns)
    assert [(o.label, o.reason) for o in found.objects] == [(o.label, o.reason) for o in expected.objects]


def csv(path: Path, rows: FloatArray, header: str = "time,x,y,z") -> Path:
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows.tolist())]), encoding="utf-8")
    return path


WAY = np.column_stack([np.arange(100.0, 105.0), CORNER + np.linspace(0, 1, 5)[:, None] * [60.0, 0, 0] + [0, 0, 2]])


def timed(path: Path, start: float = 100.0, shift: FloatArray | float = 0.0) -> Path:
    xyz = scattered()
    return make_las(path, xyz + shift, fields={"gps_time": np.linspace(start, start + 4, len(xyz))})


def test_a_trajectory_is_read_from_csv_or_las(tmp_path: Path) -> None:
    way = read_trajectory(csv(tmp_path / "way.csv", WAY[::-1]))  # in any order
    named = csv(tmp_path / "named.csv", np.column_stack([WAY[:, 3], WAY[:, :3], WAY[:, 0]]), "Z, Time ,X,Y,heading")
    las = make_las(tmp_path / "way.laz", WAY[:, 1:], fields={"gps_time": WAY[:, 0]})
    for found in (way, read_trajectory(named), read_trajectory(las)):
        assert found.time.tolist() == WAY[:, 0].tolist()
        assert np.allclose(found.xyz, WAY[:, 1:], atol=0.001)
    surveys = read_epochs(
        timed(tmp_path / "a.laz"), timed(tmp_path / "b.laz"), trajectories=Pair(tmp_path / "way.csv", None)
    )
    own = surveys.before.trajectory
    assert own is not None and surveys.after.trajectory is None
    assert np.allclose(surveys.before.frame.to_map(own.xyz), WAY[:, 1:], atol=1e-4)
    assert np.concatenate(list(surveys.before.gps_times())).tolist() == np.linspace(100, 104, 2000).tolist()


@pytest.mark.parametrize(
    ("text", "code", "says"),
    [
        ("", "trajectory-invalid", "no column time, x, y, z"),
        ("t,x,y,z\n1,2,3,4\n", "trajectory-invalid", "no column time; its first line holds t, x, y, z"),
        ("time,x,y,z\n1,2,3,here\n", "trajectory-invalid", "no table of numbers"),
        ("time,x,y,z\n1,2\n", "trajectory-invalid", "no table of numbers"),
        ("time,x,y,z\n1,2,3,nan\n", "trajectory-invalid", "not finite"),
        ("time,x,y,z\n1,2,3,4\n1,2,3,5\n", "trajectory-invalid", "1 positions"),
    ],
)
def test_what_is_no_trajectory_is_refused(tmp_path: Path, text: str, code: str, says: str) -> None:
    (tmp_path / "way.csv").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=says) as error:
        read_trajectory(tmp_path / "way.csv")
    assert error.value.code == code


def test_a_trajectory_of_another_survey_is_refused(tmp_path: Path) -> None:
    later, far = WAY + np.array([5000, 0, 0, 0]), WAY + np.array([0, 0, 90_000, 0])
    before, after = timed(tmp_path / "a.laz"), timed(tmp_path / "b.laz")
    untimed = make_las(tmp_path / "untimed.laz", scattered(), point_format=0, version="1.2")
    for survey, rows, code, says in (
        (
            before,
            later,
            "trajectory-times",
            "times 5100.000 to 5104.000 s, the points were measured at 100.000 to 104.0",
        ),
        (before, far, "trajectory-place", "the areas are 90 km apart"),
        (untimed, WAY, "trajectory-times", "no GPS time"),
    ):
        way = csv(tmp_path / "way.csv", rows)
        with pytest.raises(InputError, match=says) as error:
            read_epochs(survey, after, trajectories=Pair(way, None))
        assert error.value.code == code
        assert error.value.remedy
    with pytest.raises(InputError, match="no such file"):
        read_epochs(before, after, trajectories=Pair(None, tmp_path / "none.csv"))
