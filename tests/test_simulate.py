"""The simulated street: rays, surveys, and a truth that agrees with the geometry."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial import cKDTree

from loda_pdal.benchmark.commands import bench
from loda_pdal.benchmark.simulate import (
    Reality,
    SimulatedBlock,
    SimulationOptions,
    fused_block,
    simulate_block,
    write_block,
)
from loda_pdal.benchmark.simulate.edits import EditCounts, draw_edits
from loda_pdal.benchmark.simulate.epochs import EpochScene, epoch_scenes
from loda_pdal.benchmark.simulate.objects import Car, House
from loda_pdal.benchmark.simulate.raycast import RayCaster, normals_of
from loda_pdal.benchmark.simulate.scene import GroundPatch, Placed, Terrain, draw_street
from loda_pdal.benchmark.simulate.sensor import Drive, Sensor, drive, scan, sees
from loda_pdal.benchmark.simulate.shapes import EMPTY, Material, Opening, Shape, box, joined, leaves, of_triangles, wall
from loda_pdal.benchmark.simulate.world import World
from loda_pdal.benchmark.truth import Truth
from loda_pdal.kernels.parallel import set_threads
from loda_pdal.model.errors import InputError, OutputError, ParameterError
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.model.transform import rotation_angle, transform_points

SMALL = SimulationOptions(length_m=60.0, density=0.3)
"""A block that is made in about a second and still holds every kind of edit."""


@pytest.fixture(scope="module")
def block() -> SimulatedBlock:
    return simulate_block(3, SMALL)


@pytest.fixture(scope="module")
def scenes() -> Pair[EpochScene]:
    street = draw_street(np.random.default_rng(5), 60.0)
    terrain = street.terrain
    items, grounds = draw_edits(street, np.random.default_rng(6), EditCounts())
    return epoch_scenes(terrain, items, grounds, Pair(*np.random.default_rng(5).spawn(2)))


def nearest_by_brute_force(shape: Shape, origin: np.ndarray, direction: np.ndarray) -> tuple[float, int]:
    """The obvious way: intersect the ray with every plane, then ask whether the point lies inside the primitive."""
    best, which = np.inf, -1
    normals = normals_of(shape)
    anchors = np.concatenate([shape.triangles[:, 0], shape.discs[:, :3]])
    for i, (normal, anchor) in enumerate(zip(normals, anchors, strict=True)):
        t = np.dot(anchor - origin, normal) / np.dot(direction, normal)
        if not 1e-6 < t < best:
            continue
        p = origin + t * direction
        if i >= len(shape.triangles):
            disc = shape.discs[i - len(shape.triangles)]
            is_inside = np.linalg.norm(p - disc[:3]) <= disc[6]
        else:
            a, b, c = shape.triangles[i]
            sides = [np.dot(np.cross(v - u, p - u), normal) for u, v in ((a, b), (b, c), (c, a))]
            is_inside = min(sides) >= 0
        if is_inside:
            best, which = t, i
    return best, which


def test_rays_meet_what_brute_force_meets() -> None:
    random = np.random.default_rng(1)
    corners = random.normal(size=(90, 1, 3)) * (4, 3, 2) + random.normal(size=(90, 3, 3))
    shape = joined(
        [of_triangles(corners, Material.BRICK), leaves(random.normal(size=(70, 3)) * (4, 3, 2), 0.6, random)]
    )
    origins, directions = random.normal(size=(300, 3)) * 2, random.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = RayCaster(shape).cast(origins, directions)
    expected = [nearest_by_brute_force(shape, o, d) for o, d in zip(origins, directions, strict=True)]
    np.testing.assert_allclose(hits.range_m, [t for t, _ in expected], atol=1e-9)
    assert hits.primitive.tolist() == [i for _, i in expected]
    assert 60 < np.count_nonzero(hits.primitive >= 0) < 290


def test_rays_along_the_axes_and_beyond_the_limit() -> None:
    caster = RayCaster(box((2, -1, -1), (4, 1, 1), Material.BRICK, has_bottom=True))
    directions = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [1.0, 0, 0]])
    origins = np.array([[0.0, 0.2, 0.3], [0, 0.2, 0.3], [3.0, -5, 0.1], [3.0, 0.2, 0.3]])
    np.testing.assert_allclose(caster.cast(origins, directions).range_m, [2.0, np.inf, 4.0, 1.0])
    assert caster.cast(origins, directions, 1.5).primitive.tolist()[:3] == [-1, -1, -1]
    np.testing.assert_allclose(caster.cast(origins, directions, np.array([2.5, 9, 3, 9])).range_m[[0, 2]], [2, np.inf])


def test_no_surface_returns_nothing() -> None:
    hits = RayCaster(EMPTY).cast(np.zeros((3, 3)), np.eye(3))
    assert np.isinf(hits.range_m).all()
    assert (hits.primitive == -1).all()
    assert len(RayCaster(EMPTY).cast(np.empty((0, 3)), np.empty((0, 3))).range_m) == 0


def test_every_return_without_noise_lies_on_its_surface(scenes: Pair[EpochScene]) -> None:
    exact = Sensor(noise_m=0.0, drift_m=0.0, drift_deg=0.0, column_share=0.002)
    random = np.random.default_rng(0)
    terrain = Terrain(60.0, 0.01, 0.0, (0.1, 0.05), (0.0, 1.0))
    surface = scenes.after.surface
    measured = scan(exact, World(surface), drive(exact, terrain, (-1.6, 1.6), 5.0, random), random)
    assert len(measured.xyz) > 20_000
    is_triangle = measured.primitive < len(surface.triangles)
    triangles = surface.triangles[measured.primitive[is_triangle]]
    p = measured.xyz[is_triangle]
    normals = normals_of(surface)[measured.primitive[is_triangle]]
    assert np.abs(np.sum((p - triangles[:, 0]) * normals, axis=1)).max() < 1e-7
    for i in range(3):
        edge = triangles[:, (i + 1) % 3] - triangles[:, i]
        inward = np.sum(np.cross(edge, p - triangles[:, i]) * normals, axis=1) / np.linalg.norm(edge, axis=1)
        assert inward.min() > -1e-7
    discs = surface.discs[measured.primitive[~is_triangle] - len(surface.triangles)]
    offset = measured.xyz[~is_triangle] - discs[:, :3]
    assert len(offset) > 1000
    assert np.abs(np.sum(offset * discs[:, 3:6], axis=1)).max() < 1e-7
    assert (np.linalg.norm(offset, axis=1) - discs[:, 6]).max() < 1e-7


def test_noise_moves_returns_along_their_rays() -> None:
    screen = box((-200, 20, -50), (200, 21, 50), Material.CONCRETE)
    flat = Terrain(40.0, 0.0, 0.0, (0.0, 0.0), (0.0, 0.0))
    noisy = Sensor(noise_m=0.05, drift_m=0.0, drift_deg=0.0, column_share=0.004)
    path = drive(noisy, flat, (-1.6,), 0.0, np.random.default_rng(0))
    measured = scan(noisy, World(screen), path, np.random.default_rng(1))
    station = np.searchsorted(path.time, measured.time)
    ray = measured.xyz - path.position[station]
    range_m = np.linalg.norm(ray, axis=1)
    true_range = range_m * (20.0 - path.position[station, 1]) / ray[:, 1]
    error = range_m - true_range
    assert abs(error.mean()) < 0.003
    assert error.std() == pytest.approx(0.05, rel=0.05)


def test_what_stands_behind_a_wall_is_not_seen() -> None:
    target = box((18, 12, 0), (22, 16, 3), Material.BRICK)
    screen = box((-50, 9, -1), (90, 9.2, 30), Material.CONCRETE)
    flat = Terrain(40.0, 0.0, 0.0, (0.0, 0.0), (0.0, 0.0))
    sensor = Sensor(column_share=0.003)
    path = drive(sensor, flat, (-1.6, 1.6), 5.0, np.random.default_rng(0))

    def returns_from_target(shape: Shape) -> int:
        measured = scan(sensor, World(shape), path, np.random.default_rng(1))
        return int(np.count_nonzero(measured.primitive < len(target)))

    assert returns_from_target(target) > 500
    assert returns_from_target(joined([target, screen])) == 0

    corners = np.array([[18.0, 12.0, 3.0], [22.0, 12.0, 1.5]])
    none, all_of_it = np.zeros(len(screen), dtype=bool), np.ones(len(screen), dtype=bool)
    assert sees(sensor, World(), path, corners, np.zeros(1, dtype=bool)).all()
    assert not sees(sensor, World(screen), path, corners, none).any()
    assert sees(sensor, World(screen), path, corners, all_of_it).all()
    too_high = np.array([[20.0, 12.0, 90.0]])
    assert not sees(sensor, World(), path, too_high, np.zeros(1, dtype=bool)).any()


def test_the_drive_keeps_its_lanes_and_its_drift_small() -> None:
    terrain = Terrain(80.0, 0.02, 0.0, (0.2, 0.05), (0.3, 1.0))
    path: Drive = drive(Sensor(), terrain, (-1.6, 1.6), 10.0, np.random.default_rng(2))
    assert np.all(np.abs(np.abs(path.position[:, 1]) - 1.6) <= 0.15 + 1e-9)
    height = path.position[:, 2] - terrain.height(path.position[:, 0], path.position[:, 1])
    np.testing.assert_allclose(height, 2.0, atol=0.011)
    assert path.position[:, 0].min() < -9 and path.position[:, 0].max() > 89
    assert np.all(np.diff(path.time) >= 0)
    assert np.abs(path.shift).max() < 0.12
    for one_pass in np.split(path.shift, 2):
        assert np.abs(one_pass.mean(axis=0)).max() < 1e-12
        assert 0.003 < one_pass.std() < 0.05
        assert np.abs(np.diff(one_pass, axis=0)).max() < 0.005


def test_walls_keep_their_area_less_the_openings() -> None:
    opening = Opening(1.0, 0.5, 1.5, 1.2, depth=0.2)
    made = wall((0, 0, 0), (1, 0, 0), 5.0, 3.0, [opening])
    t = made.triangles
    area = np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1) / 2
    in_front = np.abs(t[:, :, 1]).max(axis=1) < 1e-12
    assert area[in_front].sum() == pytest.approx(5.0 * 3.0 - 1.5 * 1.2)
    glass = made.triangle_material == Material.GLASS
    assert area[glass].sum() == pytest.approx(1.5 * 1.2)
    np.testing.assert_allclose(t[glass][:, :, 1], 0.2)


@pytest.mark.parametrize("roof", ["flat", "gable", "front gable", "hip"])
def test_a_storey_leaves_the_floors_below_as_they_were(roof: str) -> None:
    random = np.random.default_rng(0)
    low, high = (House(6.0, 8.0, n, roof).surface(random).triangles for n in (2, 3))
    known = {row.tobytes() for row in np.round(high * 1e4).astype(int)}
    is_kept = np.array([row.tobytes() in known for row in np.round(low * 1e4).astype(int)])
    assert is_kept[low[:, :, 2].max(axis=1) <= 2 * 2.9 + 1e-9].mean() > 0.9
    assert high[:, :, 2].max() - low[:, :, 2].max() == pytest.approx(2.9)


def test_a_patch_raises_its_inside_by_dz() -> None:
    patch = GroundPatch(0.0, 8.0, 10.0, 15.0, -0.3)
    x, y = np.array([4.0, 0.0, 0.25, 9.0]), np.array([12.0, 12.0, 12.0, 12.0])
    np.testing.assert_allclose(patch.rise(x, y), [-0.3, 0.0, -0.15, 0.0])
    assert patch.area_m2 == 40.0
    terrain = Terrain(60.0, 0.0, 0.0, (0.0, 0.0), (0.0, 0.0))
    plain, owner = terrain.surface([], [patch])
    dug, same_owner = terrain.surface([patch], [patch])
    np.testing.assert_array_equal(owner, same_owner)
    moved = np.abs(plain.triangles - dug.triangles).max(axis=(1, 2)) > 0
    assert set(np.flatnonzero(moved)) <= set(np.flatnonzero(owner == 0))


def test_primitives_belong_to_the_thing_that_made_them() -> None:
    terrain = Terrain(60.0, 0.0, 0.0, (0.0, 0.0), (0.0, 0.0))
    street = draw_street(np.random.default_rng(5), 60.0)
    items, grounds = draw_edits(street, np.random.default_rng(6), EditCounts())
    scene = epoch_scenes(terrain, items, grounds, Pair(*np.random.default_rng(5).spawn(2))).after
    corners = np.concatenate([scene.surface.triangles.mean(axis=1), scene.surface.discs[:, :3]])
    cars = [i for i in items if i.after is not None and isinstance(i.after.thing, Car)]
    assert len(cars) > 5
    for item in [i for i in items if i.after is not None]:
        assert isinstance(item.after, Placed)
        mine = corners[scene.owner == item.instance_id]
        reach = 2.7 if isinstance(item.after.thing, Car) else 20.0
        assert np.hypot(mine[:, 0] - item.after.x, mine[:, 1] - item.after.y).max() < reach


def test_same_seed_same_block(block: SimulatedBlock) -> None:
    set_threads(1)
    try:
        again = simulate_block(3, SMALL)
    finally:
        set_threads(None)
    for mine, other in zip(block.surveys, again.surveys, strict=True):
        for name in ("xyz", "truth_id", "truth_change", "gps_time", "intensity", "trajectory"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(other, name))
    assert again.truth.to_dict() == block.truth.to_dict()


def test_another_seed_another_street(block: SimulatedBlock) -> None:
    other = simulate_block(4, SMALL)
    assert len(other.surveys.before) != len(block.surveys.before)
    assert other.truth.outline != block.truth.outline


@pytest.mark.parametrize("seed", range(8))
def test_ten_to_twenty_edits_on_hundred_metres(seed: int) -> None:
    street = draw_street(np.random.default_rng([seed, 1]), 100.0)
    items, grounds = draw_edits(street, np.random.default_rng([seed, 2]), EditCounts())
    edits = {min(i.instance_id, i.partner or i.instance_id) for i in items if i.edit} | {g.instance_id for g in grounds}
    assert 10 <= len(edits) <= 20
    ids = [i.instance_id for i in items] + [g.instance_id for g in grounds]
    assert sorted(ids) == list(range(1, len(ids) + 1))
    assert all(g.patch.area_m2 > 25 for g in grounds)


def test_labels_agree_with_what_the_surveys_caught(block: SimulatedBlock) -> None:
    truth = block.truth
    for i in truth.instances:
        assert i.exists.before == (i.label is not ChangeLabel.ADDED)
        assert i.exists.after == (i.label is not ChangeLabel.REMOVED)
        for epoch, survey in (("before", block.surveys.before), ("after", block.surveys.after)):
            is_mine = survey.truth_id == i.instance_id
            assert getattr(i.n_points, epoch) == np.count_nonzero(is_mine)
            assert getattr(i.exists, epoch) or not is_mine.any()
            assert set(np.unique(survey.truth_change[is_mine])) <= {int(i.label), int(ChangeLabel.UNCHANGED)}
            assert i.excluded or not getattr(i.exists, epoch) or np.count_nonzero(is_mine) >= SMALL.min_returns
        if i.partner is not None:
            partner = truth.by_id[i.partner]
            assert (partner.partner, partner.edit) == (i.instance_id, i.edit)
            assert {partner.label, i.label} == {ChangeLabel.ADDED, ChangeLabel.REMOVED}
    for survey in block.surveys:
        assert np.all(survey.truth_change[survey.truth_id == 0] == ChangeLabel.UNCHANGED)
    assert {i.object_class for i in truth.instances if i.is_changed} == {
        ObjectClass.BUILDING,
        ObjectClass.VEGETATION,
        ObjectClass.MOBILE,
        ObjectClass.OTHER,
        ObjectClass.GROUND,
    }


def test_the_place_of_an_added_building_was_empty(block: SimulatedBlock) -> None:
    (added,) = [i for i in block.truth.instances if i.edit == "building added"]
    house = block.surveys.after.xyz[block.surveys.after.truth_id == added.instance_id]
    before = block.surveys.before
    moved = transform_points(block.truth.T_after_before, before.xyz)
    distance, _ = cKDTree(house[house[:, 2] > house[:, 2].min() + 1.0]).query(moved, distance_upper_bound=0.5)
    assert np.count_nonzero(np.isfinite(distance)) < 0.01 * len(house)


def test_unchanged_solids_lie_on_each_other_after_the_true_move(block: SimulatedBlock) -> None:
    before = transform_points(block.truth.T_after_before, block.surveys.before.xyz)
    for kind in ("mobile", "building"):
        ids = [
            i.instance_id
            for i in block.truth.instances
            if i.object_class.title == kind and not i.edit and not i.excluded
        ]
        a = before[np.isin(block.surveys.before.truth_id, ids)]
        b = block.surveys.after.xyz[np.isin(block.surveys.after.truth_id, ids)]
        distance, _ = cKDTree(b).query(a)
        assert np.median(distance) < 0.12  # about the spacing of the returns


def test_a_street_without_edits_has_none() -> None:
    quiet = simulate_block(3, SimulationOptions(length_m=60.0, density=0.1, has_edits=False))
    assert {i.label for i in quiet.truth.instances} == {ChangeLabel.UNCHANGED}
    for survey in quiet.surveys:
        assert np.all(survey.truth_change == ChangeLabel.UNCHANGED)
    assert len(quiet.surveys.before) != len(quiet.surveys.after)  # fresh noise


def test_misregistration_is_what_the_truth_says() -> None:
    small = SimulationOptions(length_m=40.0, density=0.05, shift_m=0.0, rotation_deg=0.0)
    large = replace(small, shift_m=3.0, rotation_deg=10.0)
    still, moved = simulate_block(11, small), simulate_block(11, large)
    np.testing.assert_array_equal(still.surveys.after.xyz, moved.surveys.after.xyz)
    np.testing.assert_allclose(still.truth.T_after_before, np.eye(4), atol=1e-12)
    back = transform_points(moved.truth.T_after_before, moved.surveys.before.xyz)
    np.testing.assert_allclose(back, still.surveys.before.xyz, atol=0.0021)
    assert np.degrees(rotation_angle(moved.truth.T_after_before)) == pytest.approx(10.0, abs=1e-6)
    middle = np.append(np.mean(moved.truth.outline, axis=0), still.surveys.after.xyz[:, 2].min())
    shift = transform_points(moved.truth.T_after_before, middle[None])[0] - middle
    assert np.linalg.norm(shift) == pytest.approx(3.0, abs=0.35)  # the rotation tilts a little about the middle


def test_density_and_lanes() -> None:
    def n_points(density: float, lanes: tuple[float, ...]) -> int:
        options = SimulationOptions(length_m=40.0, density=density, lanes=lanes, reality=Reality.none())
        return len(simulate_block(2, options).surveys.after)

    both = n_points(0.1, (-1.6, 1.6))
    assert n_points(0.05, (-1.6, 1.6)) == pytest.approx(both / 2, rel=0.1)
    assert n_points(0.1, (-1.6,)) == pytest.approx(both / 2, rel=0.1)


def test_options_out_of_range_are_refused() -> None:
    with pytest.raises(ParameterError, match="length_m"):
        SimulationOptions(length_m=3.0)
    with pytest.raises(ParameterError, match="lane"):
        SimulationOptions(lanes=())


def test_files_hold_the_block_and_are_the_same_twice(block: SimulatedBlock, tmp_path: Path) -> None:
    first, second = write_block(block, tmp_path / "a"), write_block(block, tmp_path / "b")
    for name, path in first.items():
        assert path.read_bytes() == second[name].read_bytes(), name
    las = laspy.read(first["before"])
    assert (str(las.header.version), las.header.point_format.id) == ("1.4", 6)
    assert las.header.parse_crs().to_authority() == ("EPSG", "7415")
    np.testing.assert_array_equal(las.header.scales, 0.001)
    np.testing.assert_allclose(np.column_stack([las.x, las.y, las.z]), block.surveys.before.xyz, atol=1e-6)
    np.testing.assert_array_equal(las["TruthId"], block.surveys.before.truth_id)
    np.testing.assert_array_equal(las["TruthChange"], block.surveys.before.truth_change)
    np.testing.assert_array_equal(las.gps_time, block.surveys.before.gps_time)
    assert Truth.read(first["truth"]).to_dict() == block.truth.to_dict()
    with pytest.raises(OutputError, match="already holds"):
        write_block(block, tmp_path / "a")
    write_block(block, tmp_path / "a", overwrite=True)


def test_trajectory_leads_along_the_street(block: SimulatedBlock) -> None:
    for survey in block.surveys:
        time, xyz = survey.trajectory[:, 0], survey.trajectory[:, 1:]
        assert time[0] <= survey.gps_time[0] and survey.gps_time[-1] <= time[-1]
        centre = np.mean(block.truth.outline, axis=0)
        assert np.hypot(*(xyz[:, :2] - centre).T).max() < SMALL.length_m / 2 + 15
    assert np.all(np.diff(block.surveys.after.gps_time) >= 0)


def test_a_fused_block_has_one_mean_point_per_voxel(block: SimulatedBlock) -> None:
    fused = fused_block(block, 0.5)
    assert fused.truth.made_by["leaf_m"] == 0.5 and fused.truth.instances == block.truth.instances
    for raw, survey in zip(block.surveys, fused.surveys, strict=True):
        low = np.floor(raw.xyz.min(axis=0) / 1000) * 1000
        of_raw = np.floor(np.round((raw.xyz - low) * 65536) / 65536 / 0.5).astype(int)
        voxels, which = np.unique(of_raw, axis=0, return_inverse=True)
        assert len(survey) == len(voxels)
        for i in (0, len(voxels) // 2, len(voxels) - 1):
            inside = np.flatnonzero(which == i)
            assert np.allclose(survey.xyz[i], raw.xyz[inside].mean(axis=0), atol=1e-3)
            assert survey.truth_id[i] == raw.truth_id[inside[0]] and survey.gps_time[i] == raw.gps_time[inside[0]]


def test_a_foreign_truth_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "truth.json"
    path.write_text(json.dumps({"format": "something else"}))
    with pytest.raises(InputError, match="Not a truth file"):
        Truth.read(path)
    with pytest.raises(InputError, match="Cannot read"):
        Truth.read(tmp_path / "none.json")


def test_simulate_command(tmp_path: Path) -> None:
    out = tmp_path / "block"
    asked = ["simulate", str(out), "--seed", "5", "--length", "30", "--density", "0.05", "--lanes", "1", "--json"]
    result = CliRunner().invoke(bench, asked)
    assert result.exit_code == 0, result.output
    summary = json.loads(result.output)
    assert summary["points"]["before"] == len(laspy.read(out / "before.laz"))
    assert Truth.read(out / "truth.json").made_by["seed"] == 5
    result = CliRunner().invoke(bench, [*asked, "--overwrite", "--leaf", "0.25"])
    assert json.loads(result.output)["points"]["before"] < summary["points"]["before"]
    result = CliRunner().invoke(bench, [*asked, "--overwrite", "--plain"])
    assert Truth.read(out / "truth.json").made_by["options"]["reality"]["traffic"] == 0.0
    assert result.exit_code == 0 and not any(i.edit == "passing by" for i in Truth.read(out / "truth.json").instances)
