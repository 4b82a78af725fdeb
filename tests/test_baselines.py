"""Baselines: an added, a removed and a raised box are found, an unchanged scene stays silent; rules by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from click.testing import CliRunner

from loda_pdal.benchmark.baselines import baseline as baseline_module
from loda_pdal.benchmark.baselines import c2c, compare, forest, m3c2, ndsm, run_baselines, tune
from loda_pdal.benchmark.baselines.baseline import Baseline
from loda_pdal.benchmark.baselines.columns import Columns, connected, label_of_regions, without_small
from loda_pdal.benchmark.baselines.scene import Block, Scene, judged_points, read_block, scene_of
from loda_pdal.benchmark.baselines.tuned import TUNED
from loda_pdal.benchmark.commands import bench
from loda_pdal.benchmark.protocols import ScoreReport, judge
from loda_pdal.benchmark.truth import Truth, TruthInstance
from loda_pdal.model.errors import InputError
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.params import Parameters

UNCHANGED, ADDED, REMOVED = ChangeLabel.UNCHANGED, ChangeLabel.ADDED, ChangeLabel.REMOVED
INCREASED, DECREASED = ChangeLabel.INCREASED, ChangeLabel.DECREASED

SIZE_M = 48.0
BOX_M = 6.0
HEIGHTS = {  # of each box before and after, m; the label follows
    UNCHANGED: (5.0, 5.0),
    ADDED: (0.0, 4.0),
    REMOVED: (4.0, 0.0),
    INCREASED: (4.0, 8.0),
    DECREASED: (8.0, 4.0),
}
PLACES = [(7.0, 7.0), (7.0, 31.0), (31.0, 7.0), (31.0, 31.0), (19.0, 19.0)]
TRAINING_SEED, VALIDATION_SEED, TEST_SEED = 101, 104, 105


def write_box_block(
    folder: Path, places: list[tuple[float, float]], changes: bool, random_seed: int, seed: int
) -> Path:
    """A block of level ground with one box per label, surveyed from above and aside with 1 cm of noise."""
    folder.mkdir()
    random = np.random.default_rng(random_seed)
    boxes = {label: (low, high) if changes else (low, low) for label, (low, high) in HEIGHTS.items()}
    for epoch, name in enumerate(("before", "after")):
        xyz, ids, change = [], [], []
        ground = random.uniform(0, SIZE_M, (round(12 * SIZE_M**2), 2))
        is_free = np.ones(len(ground), dtype=bool)
        for i, (label, heights) in enumerate(boxes.items()):
            height, other = heights[epoch], heights[1 - epoch]
            offset = np.array(places[i])
            if height == 0:
                continue
            is_free &= ~np.all((ground > offset) & (ground < offset + BOX_M), axis=1)
            points = box_points(random, height) + np.array([*offset, 0.0])
            is_only_here = (points[:, 2] > other + 0.1) | ((points[:, 2] > height - 0.1) & (other != height))
            xyz.append(points)
            ids.append(np.full(len(points), i + 1))
            change.append(np.where(is_only_here & changes, label, UNCHANGED))
        free = ground[is_free]
        xyz.append(np.column_stack([free, np.zeros(len(free))]))
        ids.append(np.zeros(len(free), dtype=int))
        change.append(np.full(len(free), UNCHANGED))
        points = np.concatenate(xyz)
        write_laz(folder / f"{name}.laz", points + random.normal(0, 0.01, points.shape), ids, change)
    instances = [
        TruthInstance(
            i + 1,
            ObjectClass.BUILDING,
            label if changes else UNCHANGED,
            "box",
            Pair(low > 0, high > 0),
            Pair(500, 500),
            Pair(500, 500),
            Pair(1.0, 1.0),
        )
        for i, (label, (low, high)) in enumerate(boxes.items())
        if low > 0 or high > 0
    ]
    corners = [(0.0, 0.0), (SIZE_M, 0.0), (SIZE_M, SIZE_M), (0.0, SIZE_M)]
    Truth(instances, np.eye(4), corners, SIZE_M**2, "", {"seed": seed}).write(folder / "truth.json")
    return folder


def box_points(random: np.random.Generator, height: float) -> np.ndarray:
    """Points on the roof and the walls of a box on the origin, 20 per m2."""
    roof = np.column_stack([random.uniform(0, BOX_M, (round(20 * BOX_M**2), 2)), np.full(round(20 * BOX_M**2), height)])
    n = round(20 * BOX_M * height)
    walls = []
    for axis in (0, 1):
        for edge in (0.0, BOX_M):
            wall = np.empty((n, 3))
            wall[:, axis], wall[:, 1 - axis] = edge, random.uniform(0, BOX_M, n)
            wall[:, 2] = random.uniform(0, height, n)
            walls.append(wall)
    return np.concatenate([roof, *walls])


def write_laz(path: Path, xyz: np.ndarray, ids: list[np.ndarray], change: list[np.ndarray]) -> None:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 0.001)
    header.add_extra_dims(
        [laspy.ExtraBytesParams("TruthId", np.uint32), laspy.ExtraBytesParams("TruthChange", np.uint8)]
    )
    las = laspy.LasData(header)
    las.x, las.y, las.z = (xyz + np.array([84_000.0, 447_000.0, 2.0])).T
    las["TruthId"], las["TruthChange"] = np.concatenate(ids), np.concatenate(change)
    las.write(str(path))


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("blocks")
    return {
        "changed": write_box_block(root / "changed", PLACES, True, 1, VALIDATION_SEED),
        "quiet": write_box_block(root / "quiet", PLACES, False, 2, VALIDATION_SEED),
        "training": write_box_block(root / "training", PLACES[2:] + PLACES[:2], True, 3, TRAINING_SEED),
        "quiet training": write_box_block(root / "quiet_training", PLACES[1:] + PLACES[:1], False, 5, TRAINING_SEED),
        "test": write_box_block(root / "test", PLACES, True, 4, TEST_SEED),
    }


@pytest.fixture(scope="module")
def known(folders: dict[str, Path]) -> dict[str, tuple[Block, Scene]]:
    aerial = Parameters.preset("aerial")
    blocks = {name: read_block(folder) for name, folder in folders.items()}
    return {name: (block, scene_of(block.surveys, aerial)) for name, block in blocks.items()}


def method_of(name: str, known: dict[str, tuple[Block, Scene]]) -> Baseline:
    if name == "forest":
        pytest.importorskip("sklearn")
        return forest.baseline([known["training"], known["quiet training"]])
    if name == "m3c2":
        pytest.importorskip("py4dgeo")
    return {"ndsm": ndsm.BASELINE, "c2c": c2c.BASELINE, "m3c2": m3c2.BASELINE}[name]


def report_of(method: Baseline, block: Block, scene: Scene) -> ScoreReport:
    params = TUNED["street"][method.name]
    marks = method.decide(scene, method.measure(scene, params), params)
    return judge(judged_points(block, scene.on_points(marks)), block.truth)


@pytest.mark.parametrize("name", ["ndsm", "c2c", "m3c2", "forest"])
def test_every_box_is_found_for_what_it_is(name: str, known: dict[str, tuple[Block, Scene]]) -> None:
    report = report_of(method_of(name, known), *known["changed"])
    found = {j.instance.label: j.predicted for j in report.judgements}
    assert {label: found[label] for label in (ADDED, REMOVED, UNCHANGED)} == {x: x for x in (ADDED, REMOVED, UNCHANGED)}
    by_part = {j.instance.label: j.predicted_part for j in report.judgements}
    assert (by_part[INCREASED], by_part[DECREASED]) == (INCREASED, DECREASED)
    assert report.false_alarms == []


@pytest.mark.parametrize("name", ["ndsm", "c2c", "m3c2", "forest"])
def test_a_scene_that_did_not_change_stays_silent(name: str, known: dict[str, tuple[Block, Scene]]) -> None:
    report = report_of(method_of(name, known), *known["quiet"])
    assert report.n_changed_objects == 0
    assert report.scores().accuracy == 1.0


def test_tops_are_heights_of_the_boxes(known: dict[str, tuple[Block, Scene]]) -> None:
    columns = Columns.of(known["changed"][1])
    for heights, place in zip(HEIGHTS.values(), PLACES, strict=True):
        i, j = (int((c + BOX_M / 2) * 2) for c in place)
        for height, top in zip(heights, columns.top, strict=True):
            assert np.nanmedian(top[i - 2 : i + 3, j - 2 : j + 3]) == pytest.approx(height, abs=0.25)


def columns_of(before: list[float], after: list[float]) -> Columns:
    none = np.zeros(0, dtype=np.int64)
    return Columns(Pair(none, none), Pair(np.array([before]), np.array([after])))


def test_a_region_is_labelled_by_what_stands_there() -> None:
    nan = np.nan
    columns = columns_of([0.1, 0.0, nan, 5.0, 4.0, 8.0, 0.2], [3.0, 3.0, 3.0, 0.1, 7.0, 4.0, 0.4])
    region = np.array([1, 1, 1, 2, 3, 4, 5])
    label = label_of_regions(columns, region, np.arange(7), 0.5)
    assert label.tolist() == [UNCHANGED, ADDED, REMOVED, INCREASED, DECREASED, INCREASED]
    assert label_of_regions(columns, region[:0], region[:0], 0.5).tolist() == [UNCHANGED]


def test_small_regions_are_dropped_and_the_rest_renumbered() -> None:
    assert without_small(np.array([0, 1, 2, 2, 3, 3, 3]), 2).tolist() == [0, 0, 1, 1, 2, 2, 2]
    assert without_small(np.zeros(0, dtype=np.int64), 2).tolist() == []
    touching = np.array([[1, 0, 0, 1], [0, 1, 0, 0]], dtype=bool)
    assert connected(touching, 2).tolist() == [[1, 0, 0, 0], [0, 1, 0, 0]]


def test_holes_take_the_mean_of_their_neighbours(known: dict[str, tuple[Block, Scene]]) -> None:
    _, scene = known["changed"]
    clouds = scene.clouds.map(lambda cloud: cloud.moved(np.floor(cloud.xyz / 0.5) * 0.5 + 0.25))
    middle = np.floor(clouds.after.xyz[:, :2].mean(axis=0) / 0.5) * 0.5 + 0.25
    is_kept = np.any(np.abs(clouds.after.xyz[:, :2] - middle) > 0.1, axis=1)
    holed = Scene(
        Pair(clouds.before, clouds.after.subset(is_kept)),
        Pair(np.full(len(clouds.before), 1.0), np.full(is_kept.sum(), 3.0)),
    )
    columns = Columns.of(holed)
    assert columns.cell.after.max() < np.prod(columns.shape)
    inside = columns.top.after[2:-2, 2:-2]
    assert np.isfinite(inside).mean() > 0.99
    np.testing.assert_allclose(inside[np.isfinite(inside)], 3.0)


def test_the_search_takes_the_best_of_its_grid(folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    small = replace(ndsm.BASELINE, grid={"threshold_m": (50.0, 1.0), "opening": (1,)})
    monkeypatch.setattr(compare, "UNTRAINED", (small,))
    deaf = replace(TUNED["aerial"][ndsm.BASELINE.name], threshold_m=100.0)
    monkeypatch.setitem(TUNED["aerial"], ndsm.BASELINE.name, deaf)
    found = tune([folders["changed"]], preset="aerial")
    assert list(found) == [ndsm.BASELINE.name]
    assert found[ndsm.BASELINE.name].params.threshold_m == 1.0
    assert found[ndsm.BASELINE.name].macro_iou == 1.0


def test_nothing_is_tuned_on_test_blocks(folders: dict[str, Path]) -> None:
    with pytest.raises(InputError, match="is a test block"):
        tune([folders["test"]], preset="aerial")


def test_what_is_not_installed_is_skipped_with_a_word(
    folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(baseline_module, "find_spec", lambda name: None)
    monkeypatch.setattr(forest, "find_spec", lambda name: None)
    comparison = run_baselines([folders["changed"]], training=[folders["training"]], preset="aerial", with_ours=False)
    assert list(comparison.reports) == [ndsm.BASELINE.name, c2c.BASELINE.name]
    assert "pip install 'loda-pdal[bench]'" in comparison.skipped[m3c2.BASELINE.name]
    assert "scikit-learn is not installed" in comparison.skipped[forest.NAME]
    assert f"Skipped: {forest.NAME}" in comparison.to_markdown()


def test_the_command_compares_all_methods_that_can_run(folders: dict[str, Path], tmp_path: Path) -> None:
    table = tmp_path / "table.md"
    arguments = ["baselines", str(folders["changed"]), str(folders["quiet"]), "--preset", "aerial", "--json"]
    result = CliRunner().invoke(bench, [*arguments, "--markdown", str(table)])
    assert result.exit_code == 0, result.output
    values = json.loads(result.stdout)
    assert values["skipped"][forest.NAME] == "no training blocks were given (--train)."
    for name in (compare.OURS, ndsm.BASELINE.name, c2c.BASELINE.name):
        assert values["methods"][name]["paper"]["n"] == 9
        assert values["methods"][name]["paper"]["labels"]["Added"]["recall"] == 1.0
        assert values["methods"][name]["seconds"] > 0
        assert f"| {name} | 9 |" in table.read_text()


def test_a_folder_that_is_no_block_is_refused(tmp_path: Path, folders: dict[str, Path]) -> None:
    (tmp_path / "truth.json").write_bytes((folders["changed"] / "truth.json").read_bytes())
    with pytest.raises(InputError, match=r"There is no .*before\.laz"):
        read_block(tmp_path)
