"""What makes simulated blocks hard: passers-by, clutter, glass, rain, seasons, gaps; and what the scores leave out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
import shapely

from loda_pdal.benchmark.simulate import Reality, SimulatedBlock, SimulationOptions, simulate_block, write_block
from loda_pdal.benchmark.simulate.airborne import AirborneSensor, fly
from loda_pdal.benchmark.simulate.clutter import add_clutter, footprint
from loda_pdal.benchmark.simulate.edits import ADDED, INCREASED, REMOVED, UNCHANGED, EditCounts, Item, draw_edits
from loda_pdal.benchmark.simulate.epochs import changes_of_returns, epoch_scenes
from loda_pdal.benchmark.simulate.evidence import MOVING, Evidence, instances_of
from loda_pdal.benchmark.simulate.objects import Annex, Car, Dormer, GardenWall, House, Tree
from loda_pdal.benchmark.simulate.plan import SurveyPlan, draw_plans
from loda_pdal.benchmark.simulate.raycast import RayCaster
from loda_pdal.benchmark.simulate.scene import Placed, Terrain, draw_street
from loda_pdal.benchmark.simulate.sensor import Conditions, Scan, Sensor, drive, scan
from loda_pdal.benchmark.simulate.shapes import Material, Shape, box, joined, quads, windows_at
from loda_pdal.benchmark.simulate.traffic import draw_traffic
from loda_pdal.benchmark.simulate.world import Mover, World
from loda_pdal.benchmark.truth import TruthInstance
from loda_pdal.model.errors import ParameterError
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.pair import Pair

FLAT = Terrain(60.0, 0.0, 0.0, (0.0, 0.0), (0.0, 0.0))
PLAIN = SimulationOptions(length_m=60.0, density=0.15, reality=Reality.none())


@pytest.fixture(scope="module")
def block() -> SimulatedBlock:
    return simulate_block(21, SimulationOptions(length_m=60.0, density=0.3))


def lorry(speed: float, y: float = 1.6, x: float = 10.0) -> Mover:
    shape = box((-3, -1.1, 0.2), (3, 1.1, 3.0), Material.LIGHT_PAINT, has_bottom=True)
    return Mover(shape, "lorry", x, y, speed, 0.0, 100.0, FLAT)


def test_rays_meet_what_moves_where_it_is_when_they_are_fired() -> None:
    random = np.random.default_rng(3)
    standing = box((-40, 9, -1), (90, 10, 9), Material.BRICK)
    mover = lorry(4.0)
    world = World(standing, [mover])
    origins = np.column_stack([random.uniform(-10, 70, 400), random.uniform(-3, -1, 400), random.uniform(1, 3, 400)])
    directions = random.normal(size=(400, 3)) * (1, 1, 0.2) + (0, 1, 0)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    time = random.uniform(-5.0, 12.0, 400)
    found = world.cast(origins, directions, time, 60.0)
    n_met = 0
    for i in range(400):
        x = np.array([10.0 + 4.0 * time[i]])
        shapes = [standing]
        if time[i] >= 0.0:
            shapes.append(mover.shape.placed(float(x[0]), 1.6, float(FLAT.height(x, np.array([1.6]))[0])))
        expected = RayCaster(joined(shapes)).cast(origins[i : i + 1], directions[i : i + 1], 60.0)
        assert found.range_m[i] == pytest.approx(expected.range_m[0])
        assert found.primitive[i] == expected.primitive[0]
        n_met += expected.primitive[0] >= len(standing)
    assert 20 < n_met < 300


def test_what_goes_along_with_the_scanner_is_smeared() -> None:
    sensor = Sensor(noise_m=0.0, drift_m=0.0, drift_deg=0.0, column_share=0.004)
    path = drive(sensor, FLAT, (-1.6,), 12.0, np.random.default_rng(0))

    def returns_from(mover: Mover) -> Scan:
        measured = scan(sensor, World(FLAT.surface([], [])[0], [mover]), path, np.random.default_rng(1))
        return measured.chosen(measured.primitive >= len(FLAT.surface([], [])[0]))

    most = {}
    for name, mover in (("companion", lorry(5.0, -1.6, 4.0)), ("oncoming", lorry(-6.0, 1.6, 60.0))):
        measured = returns_from(mover)
        own = measured.xyz - mover.position(measured.time)
        assert np.all(np.abs(own[:, :2]) < (3.001, 1.101))  # every return lies on the lorry as it stood just then
        assert np.ptp(measured.xyz[:, 0]) > 30.0
        most[name] = np.histogram(measured.xyz[:, 0], np.arange(-40, 120, 10.0))[0].max() / len(measured.xyz)
    # what goes along is met all the way, what comes along mostly where it passes
    assert most["companion"] < 0.4 and most["oncoming"] > 0.6


def test_traffic_keeps_its_distance() -> None:
    path = drive(Sensor(column_share=0.002), FLAT, (-1.6, 1.6), 12.0, np.random.default_rng(0))
    seen: set[str] = set()
    for seed in range(20):
        movers = draw_traffic(path, FLAT, 1.0, 6.1, np.random.default_rng(seed))
        seen |= {m.kind for m in movers}
        for m in movers:
            during = (path.time >= m.start_s) & (path.time <= m.stop_s)
            gap = np.linalg.norm(m.position(path.time[during])[:, :2] - path.position[during, :2], axis=1)
            assert gap.min() > 1.8
    assert {"moving cyclist", "moving pedestrian", "moving saloon", "moving van"} <= seen
    assert draw_traffic(path, FLAT, 0.0, 6.1, np.random.default_rng(0)) == []


def test_who_passes_by_is_left_out_of_the_scores(block: SimulatedBlock) -> None:
    moving = [i for i in block.truth.instances if i.edit == "passing by"]
    assert len(moving) > 3
    for i in moving:
        assert i.excluded == MOVING and not i.is_evaluated
        assert i.exists.before != i.exists.after
        assert i.label is (ADDED if i.exists.after else REMOVED)
    met = [i for i in moving if sum(i.n_points) > 0]
    assert met
    for i in met:
        survey = block.surveys.after if i.exists.after else block.surveys.before
        other = block.surveys.before if i.exists.after else block.surveys.after
        assert np.count_nonzero(survey.truth_id == i.instance_id) == sum(i.n_points)
        assert i.instance_id not in other.truth_id
    quiet = simulate_block(21, replace(block.options, reality=replace(Reality(), traffic=0.0)))
    assert not any(i.excluded == MOVING for i in quiet.truth.instances)
    assert [i.edit for i in quiet.truth.instances] == [i.edit for i in block.truth.instances if i.edit != "passing by"]


def surveyed(
    items: list[Item], plans: Pair[SurveyPlan] | None = None, movers: Pair[list[Mover]] | None = None
) -> dict[int, TruthInstance]:
    """Truth about hand-made instances on a flat street, as two surveys show them."""
    if plans is None:
        plans = draw_plans(PLAIN, FLAT, streams(1), streams(2), np.random.default_rng(3))
    scenes = epoch_scenes(FLAT, items, [], streams(4))
    if movers is not None:
        scenes = scenes.join(movers, lambda scene, those: scene.with_movers(those, 90, ADDED))
    worlds = scenes.map(lambda scene: World(scene.surface, scene.movers))
    scans = plans.join(
        worlds, lambda plan, world: plan.cropped(scan(plan.scanner, world, plan.path, np.random.default_rng(5)))
    )
    changes = changes_of_returns(scenes, scans, items)
    parts = [Evidence(*one) for one in zip(plans, scenes, worlds, scans, changes, strict=True)]
    found = instances_of(items, [], Pair(*parts), np.eye(4), PLAIN)
    return {i.instance_id: i for i in found}


def streams(seed: int) -> Pair[np.random.Generator]:
    return Pair(*np.random.default_rng(seed).spawn(2))


NEW_CAR = Item(1, None, Placed(Car("saloon"), 30.0, 9.0), ADDED, "vehicle added")
HOARDING = Item(2, Placed(GardenWall(120.0, 3.5), 30.0, 5.0), None, REMOVED, "hoarding removed")


def test_an_addition_that_a_hoarding_hid_is_excluded() -> None:
    in_the_open = surveyed([NEW_CAR])[1]
    assert in_the_open.excluded is None and in_the_open.visible == Pair(1.0, None)
    hidden = surveyed([NEW_CAR, HOARDING])
    assert hidden[1].visible.before == 0.0
    assert hidden[1].excluded == "the before survey could see 0 % of its place, less than 25 %"
    assert hidden[2].excluded is None  # the hoarding itself could be seen to be gone


def test_what_made_way_does_not_hide_what_replaced_it() -> None:
    van = Item(1, Placed(Car("van"), 30.0, 4.0), None, REMOVED, "vehicle replaced", partner=2)
    saloon = Item(2, None, Placed(Car("saloon"), 30.0, 4.0), ADDED, "vehicle replaced", partner=1)
    for one in surveyed([van, saloon]).values():
        assert one.excluded is None
    strangers = surveyed([replace(van, partner=None), replace(saloon, partner=None)])
    assert strangers[2].visible.before is not None and strangers[2].visible.before < 0.5


def test_a_part_that_only_one_survey_could_see_is_excluded() -> None:
    house = House(7.0, 8.0, 2, "gable")
    porch = replace(house, annexes=(Annex(-3.0, -1.2, 2.0, 1.2, 2.4),))
    extended = Item(1, Placed(house, 30.0, 10.0), Placed(porch, 30.0, 10.0), INCREASED, "building extended")
    assert surveyed([extended])[1].excluded is None
    hidden = surveyed([extended, HOARDING])[1]
    assert hidden.excluded is not None and hidden.excluded.startswith("the before survey could see")


def test_a_lorry_that_keeps_pace_hides_what_is_behind_it() -> None:
    plans = draw_plans(replace(PLAIN, lanes=(-1.6,)), FLAT, streams(1), streams(2), np.random.default_rng(3))
    wall_on_wheels = box((-90, -1, 0.1), (90, 1, 9.0), Material.LIGHT_PAINT)
    convoy = Mover(wall_on_wheels, "convoy", 30.0, 2.0, 5.0, 0.0, 100.0, FLAT)
    hidden = surveyed([NEW_CAR], plans, Pair([convoy], []))
    assert hidden[1].visible.before == 0.0 and hidden[1].excluded is not None
    assert hidden[90].excluded == MOVING


def test_what_lies_outside_one_survey_is_excluded() -> None:
    plans = draw_plans(PLAIN, FLAT, streams(1), streams(2), np.random.default_rng(3))
    late = replace(plans.before, low=np.array([40.0, -28.0, -np.inf]))
    found = surveyed(
        [NEW_CAR, Item(2, Placed(Car("suv"), 15.0, 9.0), Placed(Car("suv"), 15.0, 9.0), UNCHANGED)],
        Pair(late, plans.after),
    )
    assert found[1].excluded == "the before survey does not cover its place"
    assert found[2].excluded == "0 returns in the before survey, fewer than 30"


def test_too_few_returns_are_excluded() -> None:
    far = Item(1, None, Placed(Car("saloon"), 30.0, 9.0), ADDED, "vehicle added")
    sparse = replace(PLAIN, density=0.01)
    plans = draw_plans(sparse, FLAT, streams(1), streams(2), np.random.default_rng(3))
    found = surveyed([far], plans)[1]
    assert 0 < found.n_points.after < 30
    assert found.excluded == f"{found.n_points.after} returns in the after survey, fewer than 30"


def test_partial_coverage_leaves_an_end_to_one_survey() -> None:
    partial = replace(Reality.none(), partial_share=1.0)
    block = simulate_block(6, SimulationOptions(length_m=60.0, density=0.1, reality=partial))
    along = np.diff(np.array(block.truth.outline)[:2], axis=0)[0] / 60.0
    extents = []
    for survey in block.surveys:
        x = (survey.xyz[:, :2] - block.truth.outline[0]) @ along
        extents.append((round(float(x.min())), round(float(x.max()))))
    lengths = sorted(stop - start for start, stop in extents)
    assert 41 <= lengths[0] <= 54 and lengths[1] == 60
    reasons = [i.excluded for i in block.truth.instances if i.excluded]
    assert any("0 returns" in reason for reason in reasons)


def facade() -> Shape:
    wall = quads(np.array([[(-60, 12, -0.1), (120, 12, -0.1), (120, 12, 6), (-60, 12, 6)]]), Material.FACADE)
    back = quads(np.array([[(-60, 20, -0.1), (120, 20, -0.1), (120, 20, 6), (-60, 20, 6)]]), Material.BRICK)
    return joined([wall, back])


def test_windows_swallow_pulses_and_return_some_from_behind() -> None:
    sensor = Sensor(noise_m=0.0, drift_m=0.0, drift_deg=0.0, column_share=0.004)
    path = drive(sensor, FLAT, (-1.6,), 12.0, np.random.default_rng(0))
    shape = facade()

    def measure(conditions: Conditions) -> tuple[Scan, np.ndarray]:
        measured = scan(sensor, World(shape), path, np.random.default_rng(1), conditions)
        normals = np.broadcast_to([0.0, -1.0, 0.0], measured.met_xyz.shape)
        return measured, windows_at(measured.met_xyz, normals)

    solid, in_window = measure(Conditions())
    glazed, in_pane = measure(Conditions(is_glazed=True))
    np.testing.assert_allclose(solid.xyz[:, 1], 12.0, atol=1e-9)
    np.testing.assert_allclose(glazed.met_xyz[:, 1], 12.0, atol=1e-9)
    assert np.count_nonzero(~in_pane) == np.count_nonzero(~in_window)  # brick returns as before
    assert np.count_nonzero(in_pane) == pytest.approx(0.3 * np.count_nonzero(in_window), rel=0.1)
    depth = glazed.xyz[:, 1] - 12.0
    assert np.abs(depth[~in_pane]).max() < 1e-9
    assert np.mean(depth[in_pane] > 0.01) == pytest.approx(0.6, abs=0.05)
    assert depth.max() <= 8.0 + 1e-6  # not through the far wall of the room


def test_windows_of_a_house_have_fewer_returns_than_its_wall() -> None:
    sensor = Sensor(column_share=0.006)
    path = drive(sensor, FLAT, (-1.6, 1.6), 12.0, np.random.default_rng(0))
    house = House(8.0, 8.0, 2, "flat", bays=3).surface(np.random.default_rng(0)).placed(30.0, 10.0, 0.0)
    measured = scan(sensor, World(house), path, np.random.default_rng(1), Conditions(is_glazed=True))
    on_glass = house.material[measured.primitive] == Material.GLASS
    edges = np.diff(house.triangles, axis=1)
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
    front = (np.abs(house.triangles[:, :, 1] - 10.0).max(axis=1) < 0.3) & (house.triangle_material != Material.CONCRETE)
    glass = front & (house.triangle_material == Material.GLASS)
    brick = front & (house.triangle_material == Material.BRICK)
    per_m2 = [np.isin(measured.primitive, np.flatnonzero(part)).sum() / area[part].sum() for part in (glass, brick)]
    assert per_m2[0] < 0.4 * per_m2[1]
    assert on_glass.any() and measured.xyz[on_glass, 1].max() > 11.0


def test_dark_and_wet_surfaces_fade_with_range() -> None:
    sensor = Sensor(noise_m=0.0, drift_m=0.0, drift_deg=0.0, dropout=0.0, column_share=0.004)
    path = drive(sensor, FLAT, (-1.6,), 12.0, np.random.default_rng(0))
    road = quads(np.array([[(-80, -60, 0), (140, -60, 0), (140, 60, 0), (-80, 60, 0)]]), Material.ASPHALT)
    dry = Conditions(weakest_signal=0.002)

    def shares(conditions: Conditions) -> tuple[float, float]:
        every = scan(sensor, World(road), path, np.random.default_rng(1))
        some = scan(sensor, World(road), path, np.random.default_rng(1), conditions)
        n_near, n_far = (
            [np.count_nonzero((np.abs(s.xyz[:, 1]) > a) & (np.abs(s.xyz[:, 1]) < b)) for s in (some, every)]
            for a, b in ((5, 9), (20, 28))
        )
        return n_near[0] / n_near[1], n_far[0] / n_far[1]

    near, far = shares(dry)
    wet_near, wet_far = shares(replace(dry, is_wet=True))
    assert near > 0.95 > far > wet_far
    assert near > wet_near > 0.75  # a tenth or so of the ground lies under puddles
    wet = scan(sensor, World(road), path, np.random.default_rng(1), Conditions(is_wet=True))
    up = np.broadcast_to([0.0, 0.0, 1.0], wet.met_xyz.shape)
    asphalt = np.full(len(wet.xyz), Material.ASPHALT, dtype=np.uint8)
    assert not Conditions(is_wet=True).is_mirror(asphalt, wet.met_xyz, up).any()


def test_a_survey_meets_its_share_of_the_leaves() -> None:
    tree = Item(1, Placed(Tree(8.0, 2.5, 2.2, 7), 30.0, 6.0), Placed(Tree(8.0, 2.5, 2.2, 7), 30.0, 6.0), UNCHANGED)
    hedge = draw_edits(draw_street(np.random.default_rng(5), 60.0), np.random.default_rng(6), None)[0]
    hedges = [i for i in hedge if i.placed.thing.kind == "hedge"]
    scenes = epoch_scenes(FLAT, [tree, *hedges], [], streams(1), Pair(0.2, 1.0))
    leaves = scenes.map(lambda scene: np.count_nonzero(scene.owner[len(scene.surface.triangles) :] == 1))
    assert leaves.before == pytest.approx(0.2 * leaves.after, rel=0.1)
    n_hedge = scenes.map(lambda scene: np.count_nonzero(scene.owner == hedges[0].instance_id))
    assert n_hedge.before == n_hedge.after


def test_pulses_from_the_air_come_back_from_leaves_and_from_below_them() -> None:
    sensor = AirborneSensor(60.0, 50.0, density=12.0, noise_m=0.0)
    random = np.random.default_rng(2)
    crowns = joined(Tree(9.0, 3.0, 3.0, k).surface(random).placed(12.0 * k, 0.0, 0.0) for k in range(1, 5))
    ground = quads(np.array([[(-80, -80, 0), (140, -80, 0), (140, 80, 0), (-80, 80, 0)]]), Material.GRASS)
    measured = scan(sensor, World(joined([ground, crowns])), fly(sensor, 0.0, random), random)
    assert measured.return_number.max() > 1 and measured.n_returns.max() <= 3
    assert np.all(measured.return_number <= measured.n_returns)
    is_leaf = np.abs(measured.xyz[:, 2] - 6.0) < 3.0
    later = measured.return_number > 1
    assert np.mean(measured.xyz[later, 2]) < np.mean(measured.xyz[is_leaf & ~later, 2])
    assert not later[measured.n_returns == 1].any()
    single = replace(sensor, max_returns=1)
    assert scan(single, World(ground), fly(single, 0.0, random), random).n_returns.max() == 1


def test_surveys_differ_in_lanes_and_density() -> None:
    options = replace(PLAIN, reality=replace(Reality(), traffic=0.0, clutter=0.0))
    n_columns, n_lanes = [], []
    for seed in range(30):
        plans = draw_plans(options, FLAT, streams(seed), streams([seed, 1]), np.random.default_rng(seed))
        for plan in plans:
            n_columns.append(len(plan.path.time))
            n_lanes.append(1 + np.count_nonzero(np.diff(plan.path.time) > 10.0))
    two = np.array(n_columns)[np.array(n_lanes) == 2]
    assert 0.05 < n_lanes.count(1) / 60 < 0.4
    assert 1.2 < two.max() / two.min() < 2.3
    same = draw_plans(PLAIN, FLAT, streams(1), streams(2), np.random.default_rng(3))
    assert len(same.before.path.time) == len(same.after.path.time)


def cluttered(seed: int, **changed: object) -> tuple[list[Item], list[Item]]:
    street = draw_street(np.random.default_rng([seed, 1]), 100.0)
    options = replace(SimulationOptions(), **changed)  # type: ignore[arg-type]
    counts = EditCounts() if options.has_edits else None
    items, grounds = draw_edits(street, np.random.default_rng([seed, 2]), counts)
    return items, add_clutter(items, grounds, street.terrain, np.random.default_rng([seed, 5]), options)


def test_clutter_stands_where_there_is_room_and_changes_no_numbers() -> None:
    kinds: set[str] = set()
    for seed in range(12):
        tidy, full = cluttered(seed)
        assert [i.instance_id for i in full[: len(tidy)]] == [i.instance_id for i in tidy]
        assert len({i.instance_id for i in full}) == len(full)
        for before, after in zip(tidy, full, strict=False):
            assert not before.edit or before == after  # an edit is never edited again
        kinds |= {i.edit for i in full if i.edit}
        new = full[len(tidy) :]
        assert len(new) > 10
        placed_new = [i for i in new if i.partner is None]
        old = shapely.union_all([footprint(p) for i in tidy for p in (i.before, i.after) if p is not None])
        for i in placed_new:
            assert footprint(i.placed).intersection(old).area < 1e-6, i.placed.thing.kind
    assert {"skip added", "skip removed", "scaffolding added", "shed against a wall added", "vehicle replaced"} <= kinds
    assert {"boundary replaced", "part of hedge removed", "house of a row removed", "tree over a roof added"} <= kinds


def test_without_edits_clutter_stays_where_it_is() -> None:
    tidy, full = cluttered(2, has_edits=False)
    assert len(full) > len(tidy) + 5
    assert all(i.before == i.after and i.label is UNCHANGED and not i.edit for i in full)
    assert cluttered(2, reality=Reality.none())[1] == cluttered(2)[0]


def test_a_dormer_leaves_the_rest_of_its_house_alone() -> None:
    random = np.random.default_rng(0)
    house = House(6.0, 8.0, 2, "gable")
    plain, changed = (h.surface(random).triangles for h in (house, replace(house, dormers=(Dormer(0.4),))))
    known = {row.tobytes() for row in np.round(changed * 1e4).astype(int)}
    assert all(row.tobytes() in known for row in np.round(plain * 1e4).astype(int))
    extra = changed[
        [
            i
            for i, t in enumerate(np.round(changed * 1e4).astype(int))
            if t.tobytes() not in {r.tobytes() for r in np.round(plain * 1e4).astype(int)}
        ]
    ]
    assert len(extra) > 10
    assert extra[:, :, 2].min() > house.eaves_m - 0.4 and extra[:, :, 2].max() < house.eaves_m + 4.2


def test_options_travel_as_plain_values_and_are_checked(block: SimulatedBlock, tmp_path: Path) -> None:
    options = block.truth.made_by["options"]
    assert options["reality"]["leaf_share"] == [0.55, 1.0] and options["lanes"] == [-1.6, 1.6]
    with pytest.raises(ParameterError, match="wet_share"):
        Reality(wet_share=2.0)
    with pytest.raises(ParameterError, match="leaf_share"):
        Reality(leaf_share=(0.9, 0.5))
    paths = write_block(block, tmp_path)
    las = laspy.read(paths["after"])
    np.testing.assert_array_equal(np.asarray(las.return_number), block.surveys.after.return_number)
    for name, survey in (("before", block.surveys.before), ("after", block.surveys.after)):
        rows = np.loadtxt(paths[f"{name}_trajectory"], delimiter=",", skiprows=1)
        np.testing.assert_allclose(rows, survey.trajectory, atol=6e-4)
        assert np.all(np.diff(rows[:, 0]) > 0)
        # every return can be traced to where the scanner was
        behind = np.searchsorted(rows[:, 0], survey.gps_time - 1e-3)
        assert np.abs(rows[np.minimum(behind, len(rows) - 1), 0] - survey.gps_time).max() < 0.35


def test_labels_of_passers_by_never_touch_other_instances(block: SimulatedBlock) -> None:
    moving = {i.instance_id for i in block.truth.instances if i.excluded == MOVING}
    unchanged = {i.instance_id for i in block.truth.instances if i.label is ChangeLabel.UNCHANGED} | {0}
    for survey in block.surveys:
        is_changed = survey.truth_change != ChangeLabel.UNCHANGED
        assert not np.isin(survey.truth_id[is_changed], list(unchanged)).any()
        assert is_changed[np.isin(survey.truth_id, list(moving))].all()
