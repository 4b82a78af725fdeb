"""Scores, protocols and blocks: numbers that can be checked by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from click.testing import CliRunner

from loda_pdal.benchmark.blocks import block_of, fill_share, is_kept, split_of_block, split_of_name
from loda_pdal.benchmark.commands import bench
from loda_pdal.benchmark.metrics import (
    CLASSES,
    LABELS,
    ClassScores,
    Scores,
    class_table,
    confusion_table,
    markdown_table,
)
from loda_pdal.benchmark.protocols import combined, judge, judge_instances, majority, score_run
from loda_pdal.benchmark.runs import NO_LABEL, JudgedPoints, Points, nearest_points, read_run
from loda_pdal.benchmark.simulate import SimulatedBlock, SimulationOptions, simulate_block, write_block
from loda_pdal.benchmark.truth import Truth, TruthInstance
from loda_pdal.model.errors import InputError
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.model.transform import transform_points

NONE, UNCHANGED, ADDED = ChangeLabel.UNDETERMINED, ChangeLabel.UNCHANGED, ChangeLabel.ADDED
REMOVED, INCREASED, DECREASED = ChangeLabel.REMOVED, ChangeLabel.INCREASED, ChangeLabel.DECREASED


def instance(
    instance_id: int, label: ChangeLabel, object_class: ObjectClass = ObjectClass.BUILDING, excluded: str | None = None
) -> TruthInstance:
    exists = Pair(label is not ADDED, label is not REMOVED)
    edit = "" if label is UNCHANGED else f"{object_class.title} {label.title.lower()}"
    return TruthInstance(
        instance_id,
        object_class,
        label,
        "thing",
        exists,
        Pair(9, 9),
        Pair(0, 0),
        Pair(None, None),
        edit,
        excluded=excluded,
    )


def truth_of(*instances: TruthInstance) -> Truth:
    return Truth(list(instances), np.eye(4), [(0, 0), (100, 0), (100, 50), (0, 50)], 5000.0)


def points_of(*rows: tuple[int, int, int, int, int]) -> JudgedPoints:
    """One point per row: truth id, truth change, epoch, predicted change, predicted object; 10 m apart."""
    table = np.array(rows, dtype=np.int64).reshape(-1, 5)
    xyz = np.column_stack([10.0 * np.arange(len(table)) + 0.5, np.full((len(table), 2), 0.5)])
    as_byte = table.astype(np.uint8)
    classes = np.full(len(table), ObjectClass.BUILDING, dtype=np.uint8)
    return JudgedPoints(xyz, as_byte[:, 2], as_byte[:, 3], table[:, 4], classes, table[:, 0], as_byte[:, 1])


def repeated(n: int, row: tuple[int, int, int, int, int]) -> list[tuple[int, int, int, int, int]]:
    return [row] * n


def test_confusion_table_by_hand() -> None:
    truth = [ADDED, ADDED, REMOVED, INCREASED, UNCHANGED, UNCHANGED, UNCHANGED, DECREASED]
    predicted = [ADDED, NONE, ADDED, INCREASED, UNCHANGED, UNCHANGED, DECREASED, NONE]
    expected = [
        [1, 0, 0, 0, 0, 1],
        [1, 0, 0, 0, 0, 0],
        [0, 0, 1, 0, 0, 0],
        [0, 0, 0, 0, 0, 1],
        [0, 0, 0, 1, 2, 0],
    ]
    np.testing.assert_array_equal(confusion_table(truth, predicted), expected)


def test_scores_by_hand() -> None:
    truth = [ADDED, ADDED, REMOVED, INCREASED, UNCHANGED, UNCHANGED, UNCHANGED, DECREASED]
    predicted = [ADDED, NONE, ADDED, INCREASED, UNCHANGED, UNCHANGED, DECREASED, NONE]
    scores = Scores.of(truth, predicted)
    assert scores.n == 8
    assert scores.accuracy == pytest.approx(4 / 8)
    by_label = {s.label: s for s in scores.labels}
    assert (by_label[ADDED].tp, by_label[ADDED].fp, by_label[ADDED].fn) == (1, 1, 1)
    assert (by_label[DECREASED].tp, by_label[DECREASED].fp, by_label[DECREASED].fn) == (0, 1, 1)
    assert [s.iou for s in scores.labels] == pytest.approx([1 / 3, 0, 1, 0, 2 / 3])
    assert [s.f1 for s in scores.labels] == pytest.approx([1 / 2, 0, 1, 0, 4 / 5])
    assert scores.macro_iou == pytest.approx((1 / 3 + 0 + 1 + 0 + 2 / 3) / 5)
    assert scores.macro_f1 == pytest.approx((1 / 2 + 0 + 1 + 0 + 4 / 5) / 5)
    assert by_label[UNCHANGED].precision == 1.0
    assert by_label[UNCHANGED].recall == pytest.approx(2 / 3)


def test_a_label_that_never_occurs_takes_no_part_in_the_mean() -> None:
    scores = Scores.of([ADDED, UNCHANGED], [ADDED, UNCHANGED])
    assert scores.macro_iou == 1.0
    assert [s.iou for s in scores.labels] == [1.0, None, None, None, 1.0]


def test_no_instances_no_scores() -> None:
    scores = Scores.of([], [])
    assert (scores.n, scores.accuracy, scores.macro_iou, scores.macro_f1) == (0, None, None, None)
    assert "-" in scores.to_markdown()


def test_tables_are_in_per_cent() -> None:
    assert (
        markdown_table(["a", "b", "c"], [[1, 0.123456, None]]) == "| a | b | c |\n| --- | --- | --- |\n| 1 | 12.3 | - |"
    )


@pytest.mark.parametrize(
    ("votes", "expected"),
    [
        ([0, 5, 3, 0, 0, 0], UNCHANGED),
        ([0, 3, 3, 0, 0, 0], NONE),  # a tie
        ([0, 0, 0, 0, 0, 0], NONE),  # no points
        ([4, 3, 0, 0, 0, 0], NONE),  # mostly undetermined
        ([3, 3, 0, 0, 0, 4], DECREASED),  # a plurality is enough
    ],
)
def test_majority(votes: list[int], expected: ChangeLabel) -> None:
    assert majority(np.array(votes)) is expected


def test_only_epochs_in_which_an_instance_exists_vote() -> None:
    truth = truth_of(instance(1, ADDED))
    points = points_of(*repeated(2, (1, 2, 1, ADDED, 5)), *repeated(9, (1, 2, 0, REMOVED, 6)))
    assert judge_instances(points, truth)[0].predicted is ADDED


def test_points_without_a_result_nearby_do_not_vote() -> None:
    truth = truth_of(instance(1, UNCHANGED), instance(2, REMOVED))
    points = points_of(*repeated(5, (1, 1, 0, NO_LABEL, 0)), (1, 1, 1, UNCHANGED, 3), (2, 3, 0, NO_LABEL, 0))
    assert [j.predicted for j in judge_instances(points, truth)] == [UNCHANGED, NONE]


def test_a_part_that_changed_is_judged_by_its_own_points() -> None:
    truth = truth_of(instance(1, INCREASED), instance(2, UNCHANGED))
    points = points_of(
        *repeated(30, (1, UNCHANGED, 0, UNCHANGED, 1)),
        *repeated(8, (1, INCREASED, 1, INCREASED, 2)),
        *repeated(3, (2, UNCHANGED, 1, UNCHANGED, 3)),
    )
    house, other = judge_instances(points, truth)
    assert (house.predicted, house.predicted_part) == (UNCHANGED, INCREASED)
    assert (other.predicted, other.predicted_part) == (UNCHANGED, UNCHANGED)
    report = judge(points, truth)
    assert report.scores().accuracy == 0.5
    assert report.scores(by_part=True).accuracy == 1.0
    assert report.by_edit == {"building increased": (1, 0, 1), "none": (1, 1, 1)}


def test_false_alarms_by_hand() -> None:
    truth = truth_of(instance(1, ADDED), instance(2, UNCHANGED), instance(3, REMOVED, excluded="unseen"))
    points = points_of(
        *repeated(10, (1, ADDED, 1, ADDED, 11)),  # right
        *repeated(4, (2, UNCHANGED, 1, INCREASED, 12)),  # on an unchanged instance: false
        *repeated(6, (0, UNCHANGED, 0, REMOVED, 13)),  # on the ground: false
        *repeated(5, (3, REMOVED, 0, REMOVED, 14)),  # on an excluded one: not judged
        *repeated(9, (0, UNCHANGED, 1, ADDED, 15)),
        (1, ADDED, 1, ADDED, 15),  # a tenth of it is on a changed instance: right
        *repeated(5, (2, UNCHANGED, 1, UNCHANGED, 16)),  # no change, no alarm
        *repeated(5, (2, UNCHANGED, 1, NONE, 17)),
    )
    report = judge(points, truth)
    assert [(a.object_id, a.label, a.n_points) for a in report.false_alarms] == [(12, INCREASED, 4), (13, REMOVED, 6)]
    assert report.n_changed_objects == 4
    assert report.false_alarms_per_ha == pytest.approx(2 / 0.5)
    assert report.false_alarms[0].centre == (10.0 * 11.5 + 0.5, 0.5)


def test_false_ground_counts_cells_of_a_square_metre() -> None:
    points = points_of(
        (0, UNCHANGED, 1, INCREASED, 0), (0, UNCHANGED, 1, UNCHANGED, 0), (0, UNCHANGED, 0, DECREASED, 0)
    )
    assert judge(points, truth_of()).false_ground_m2 == 2.0


def test_excluded_instances_and_ground_do_not_count() -> None:
    truth = truth_of(
        instance(1, ADDED, ObjectClass.MOBILE),
        instance(2, ADDED, ObjectClass.MOBILE, excluded="unseen"),
        instance(3, DECREASED, ObjectClass.GROUND),
    )
    report = judge(points_of((1, 2, 1, ADDED, 1), (2, 2, 1, REMOVED, 2), (3, 5, 1, DECREASED, 0)), truth)
    assert report.scores().n == 1
    assert report.scores().accuracy == 1.0
    assert report.scores(object_class=ObjectClass.GROUND).accuracy == 1.0
    assert report.scores(object_class=ObjectClass.BUILDING).n == 0
    assert report.to_dict()["n_excluded"] == 1


def test_blocks_are_pooled_before_scoring() -> None:
    one = judge(points_of((1, 2, 1, ADDED, 1)), truth_of(instance(1, ADDED)))
    two = judge(
        points_of((1, 2, 1, UNCHANGED, 1), (2, 1, 1, UNCHANGED, 2)),
        truth_of(instance(1, ADDED), instance(2, UNCHANGED)),
    )
    pooled = combined([one, two])
    np.testing.assert_array_equal(pooled.scores().confusion, one.scores().confusion + two.scores().confusion)
    assert pooled.scores().accuracy == pytest.approx(2 / 3)
    assert pooled.area_m2 == 10_000.0


def test_nearest_label_reaches_thirty_centimetres() -> None:
    at = np.array([[0.0, 0, 0], [5.0, 0, 0]])
    codes = np.array([2, 3], dtype=np.uint8)
    result = Points(at, np.zeros(2, dtype=np.uint8), codes, np.array([7, 8]), codes)
    asked = np.array([[0.3, 0, 0], [0.31, 0, 0], [5.0, 0.2, 0.2]])
    near = nearest_points(asked, result)
    assert near.change.tolist() == [2, NO_LABEL, 3]
    assert near.object.tolist() == [7, 0, 8]
    assert near.classification.tolist() == [2, ObjectClass.UNCLASSIFIED, 3]
    nothing = nearest_points(asked, result.at(np.zeros(2, dtype=bool)))
    assert nothing.change.tolist() == [NO_LABEL] * 3


def test_class_scores_by_hand() -> None:
    ground, building, vegetation, mobile = 2, 6, 5, 64
    truth = [ground] * 4 + [building] * 3 + [vegetation] * 2 + [mobile] + [7]
    predicted = [ground, ground, ground, building, building, building, 1, 3, vegetation, 65, ground]
    scores = ClassScores(class_table(truth, predicted))
    assert scores.table.sum() == 10  # noise is no class that is judged
    assert scores.table[1].tolist() == [0, 2, 0, 0, 0, 1]
    iou = {c: scores.iou(c) for c in CLASSES}
    assert iou[ObjectClass.GROUND] == pytest.approx(3 / 4)
    assert iou[ObjectClass.BUILDING] == pytest.approx(2 / 4)
    assert iou[ObjectClass.VEGETATION] == 1.0  # low vegetation is vegetation
    assert (iou[ObjectClass.MOBILE], iou[ObjectClass.OTHER]) == (0.0, None)
    assert scores.macro_iou == pytest.approx((3 / 4 + 2 / 4 + 1 + 0) / 4)
    assert scores.f1(ObjectClass.BUILDING) == pytest.approx(4 / 6)
    assert "| building | 0.0 | 66.7 | 0.0 | 0.0 | 0.0 | 33.3 |" in scores.to_markdown()


def test_points_of_no_instance_are_ground() -> None:
    points = points_of((0, 1, 1, UNCHANGED, 0), (1, 1, 1, UNCHANGED, 1))
    classes = judge(points, truth_of(instance(1, UNCHANGED))).classes
    assert classes.iou(ObjectClass.GROUND) == 0.0 and classes.iou(ObjectClass.BUILDING) == 0.5
    assert combined([judge(points, truth_of(instance(1, UNCHANGED)))] * 2).classes.table.sum() == 4


# --- whole runs -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def block() -> SimulatedBlock:
    return simulate_block(12, SimulationOptions(length_m=60.0, density=0.3))


@pytest.fixture(scope="module")
def truth_path(block: SimulatedBlock, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_block(block, tmp_path_factory.mktemp("block"))["truth"]


def write_run(
    folder: Path,
    block: SimulatedBlock,
    change: Pair[np.ndarray],
    order: np.ndarray | None = None,
    keeps_truth: bool = True,
) -> Path:
    """A run folder whose objects are the annotated instances and whose labels are ``change``."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(block.surveys.after.xyz.min(axis=0))
    names = [("Epoch", np.uint8), ("ChangeClass", np.uint8), ("ObjectId", np.uint32)]
    names += [("TruthId", np.uint32), ("TruthChange", np.uint8)] if keeps_truth else []
    header.add_extra_dims([laspy.ExtraBytesParams(name, kind) for name, kind in names])
    las = laspy.LasData(header)
    xyz = [transform_points(block.truth.T_after_before, block.surveys.before.xyz), block.surveys.after.xyz]
    ids = np.concatenate([s.truth_id for s in block.surveys])
    order = np.arange(len(ids)) if order is None else order
    las.x, las.y, las.z = np.concatenate(xyz)[order].T
    values = {
        "Epoch": np.repeat([0, 1], [len(s) for s in block.surveys]),
        "ChangeClass": np.concatenate(list(change)),
        "ObjectId": ids,
        "TruthId": ids,
        "TruthChange": np.concatenate([s.truth_change for s in block.surveys]),
    }
    for name, _ in names:
        las[name] = values[name][order]
    folder.mkdir()
    las.write(str(folder / "changes.laz"))
    return folder


def label_of_instance(block: SimulatedBlock) -> Pair[np.ndarray]:
    table = np.full(len(block.truth.instances) + 1, UNCHANGED, dtype=np.uint8)
    for i in block.truth.instances:
        table[i.instance_id] = i.label
    return block.surveys.map(lambda survey: table[survey.truth_id])


def test_a_run_that_knows_the_truth_is_perfect(block: SimulatedBlock, truth_path: Path, tmp_path: Path) -> None:
    report = score_run(write_run(tmp_path / "run", block, label_of_instance(block)), truth_path)
    assert report.scores().accuracy == 1.0
    assert report.scores(by_part=True).macro_iou == 1.0
    assert report.scores(object_class=ObjectClass.GROUND).accuracy == 1.0
    assert report.false_alarms == []
    assert report.false_ground_m2 == 0.0
    assert report.scores().n == sum(i.is_evaluated for i in block.truth.instances) > 30


def test_a_run_that_says_unchanged_finds_only_that(block: SimulatedBlock, truth_path: Path, tmp_path: Path) -> None:
    quiet = block.surveys.map(lambda survey: np.ones(len(survey), dtype=np.uint8))
    report = score_run(write_run(tmp_path / "run", block, quiet), truth_path)
    n_unchanged = sum(i.is_evaluated and not i.is_changed for i in block.truth.instances)
    assert report.scores().accuracy == pytest.approx(n_unchanged / report.scores().n)
    assert [s.iou for s in report.scores().labels[:4]] == [0.0] * 4
    assert (report.n_changed_objects, len(report.false_alarms)) == (0, 0)


def test_point_order_changes_no_score(block: SimulatedBlock, truth_path: Path, tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    noisy = block.surveys.map(lambda survey: random.integers(0, 6, len(survey)).astype(np.uint8))
    shuffled = random.permutation(sum(len(survey) for survey in block.surveys))
    one = score_run(write_run(tmp_path / "one", block, noisy), truth_path)
    two = score_run(write_run(tmp_path / "two", block, noisy, shuffled), truth_path)
    assert one.to_dict() == two.to_dict()


def test_annotation_by_nearest_point_agrees(block: SimulatedBlock, truth_path: Path, tmp_path: Path) -> None:
    labels = label_of_instance(block)
    kept = write_run(tmp_path / "kept", block, labels)
    bare = write_run(tmp_path / "bare", block, labels, keeps_truth=False)
    assert score_run(bare, truth_path).scores().accuracy == 1.0
    truth = Truth.read(truth_path)
    points, same = read_run(bare, truth, truth_path.parent), read_run(kept, truth, truth_path.parent)
    assert np.mean(points.change == same.change) > 0.999  # written to the millimetre, before-points have moved a little


def test_score_command(block: SimulatedBlock, truth_path: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", block, label_of_instance(block))
    tables = tmp_path / "scores.md"
    result = CliRunner().invoke(bench, ["score", str(run), str(truth_path), "--json", "--markdown", str(tables)])
    assert result.exit_code == 0, result.output
    values = json.loads(result.output)
    assert values["paper"]["acc"] == 1.0
    assert values["strict"]["n_false_alarms"] == 0
    assert values["paper"]["confusion"]["columns_predicted"] == [*(label.title for label in LABELS), "none"]
    text = tables.read_text()
    assert "## Strict protocol" in text
    assert "| 100.0 |" in text


def test_a_folder_that_is_no_run_is_refused(block: SimulatedBlock, truth_path: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"No changes\.laz"):
        score_run(tmp_path, truth_path)
    laspy.read(truth_path.parent / "before.laz").write(str(tmp_path / "changes.laz"))
    with pytest.raises(InputError, match="no dimension Epoch, ObjectId, ChangeClass"):
        score_run(tmp_path, truth_path)
    bare = write_run(tmp_path / "bare", block, label_of_instance(block), keeps_truth=False)
    alone = tmp_path / "truth.json"
    block.truth.write(alone)
    with pytest.raises(InputError, match="no TruthId"):
        score_run(bare, alone)


def test_truth_goes_through_json(block: SimulatedBlock) -> None:
    assert Truth.from_dict(json.loads(json.dumps(block.truth.to_dict()))).instances == block.truth.instances
    odd = replace(block.truth, instances=[])
    assert Truth.from_dict(json.loads(json.dumps(odd.to_dict()))).counts() == {}


# --- blocks ---------------------------------------------------------------------------------------------------------


def test_blocks_are_half_open() -> None:
    xy = np.array([[0.0, 0.0], [119.999, 120.0], [120.0, -0.001]])
    assert block_of(xy).tolist() == [[0, 0], [0, 1], [1, -1]]


def test_the_split_never_changes() -> None:
    blocks = ((0, 0), (1, 0), (0, 1), (-3, 7), (1012, 4051))
    assert [split_of_block(*index) for index in blocks] == ["train", "train", "test", "validation", "train"]
    names = [split_of_name(f"seed {i}") for i in range(3000)]
    shares = [names.count(split) / 3000 for split in ("train", "validation", "test")]
    np.testing.assert_allclose(shares, [0.6, 0.1, 0.3], atol=0.02)


def test_blocks_are_kept_when_full_and_aligned() -> None:
    x, y = np.meshgrid(np.arange(0.25, 120, 0.5), np.arange(0.25, 60, 0.5))
    half = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    assert fill_share(half[:, :2]) == pytest.approx(0.5)
    assert fill_share(np.empty((0, 2))) == 0.0
    assert is_kept(Pair(half, half + np.array([0, 0, 0.4])))
    assert not is_kept(Pair(half, half + np.array([0, 0, 0.6])))
    sparse = half[half[:, 1] < 40]
    assert not is_kept(Pair(half, sparse))
