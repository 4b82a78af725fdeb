"""Urb3DCD: files, classes and scores that can be checked by hand, and a simulated block taken through all of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from loda_pdal.benchmark.commands import bench
from loda_pdal.benchmark.simulate import SimulationOptions, simulate_block, write_block
from loda_pdal.benchmark.urb3dcd import (
    Known,
    UrbClass,
    UrbScene,
    UrbScores,
    classes_of,
    pieces_only,
    read_scene,
    scene_of_block,
    to_markdown,
    write_scene,
)
from loda_pdal.io.ply import read_ply, write_ply
from loda_pdal.model.errors import InputError, OutputError
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair

UNCHANGED, ADDED, REMOVED = ChangeLabel.UNCHANGED, ChangeLabel.ADDED, ChangeLabel.REMOVED
INCREASED, DECREASED = ChangeLabel.INCREASED, ChangeLabel.DECREASED
GROUND, BUILDING, PLANT, CAR = ObjectClass.GROUND, ObjectClass.BUILDING, ObjectClass.VEGETATION, ObjectClass.MOBILE


# --- PLY ------------------------------------------------------------------------------------------------------------

COLUMNS = {
    "x": np.array([0.5, -1.25, 3e5], dtype=np.float32),
    "y": np.array([1.0, 2.0, 5.6e6], dtype=np.float64),
    "label_ch": np.array([0, 6, 2], dtype=np.uint8),
    "n": np.array([-1, 70_000, 3], dtype=np.int32),
}


def test_columns_go_through_a_file(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", "params", COLUMNS)
    found = read_ply(tmp_path / "a.ply", ("params", "Urb3DSimul"))
    assert list(found) == list(COLUMNS)
    for name, values in COLUMNS.items():
        np.testing.assert_array_equal(found[name], values)
        assert found[name].dtype == values.dtype


HEADER = """ply
format {} 1.0
comment made by hand
obj_info nothing
element camera 2
property double f
element Urb3DSimul 3
property float x
property float32 y
property int label_ch
element face 1
property list uchar int vertex_indices
end_header
"""


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_all_encodings_and_other_elements(tmp_path: Path, encoding: str) -> None:
    rows = [(1.5, 2.0, 0), (-3.0, 4.25, 6), (0.0, 1e6, 2)]
    if encoding == "ascii":
        body = "50\n60\n" + "".join(f"{x} {y} {c}\n" for x, y, c in rows) + "3 0 1 2\n"
        data = body.encode()
    else:
        order = ">" if "big" in encoding else "<"
        table = np.array(rows, dtype=[("x", order + "f4"), ("y", order + "f4"), ("c", order + "i4")])
        data = np.array([50.0, 60.0], dtype=order + "f8").tobytes() + table.tobytes() + b"\x03" + bytes(12)
    path = tmp_path / "a.ply"
    path.write_bytes(HEADER.format(encoding).encode() + data)
    found = read_ply(path, ("params", "Urb3DSimul"))
    assert found["x"].tolist() == [1.5, -3.0, 0.0]
    assert found["y"].tolist() == [2.0, 4.25, 1e6]
    assert found["label_ch"].tolist() == [0, 6, 2]
    assert read_ply(path, ("camera",))["f"].tolist() == [50.0, 60.0]
    with pytest.raises(InputError, match="face has list properties"):
        read_ply(path, ("params",))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"solid cube", "does not begin with a PLY header"),
        (b"ply\nformat ascii 1.0\nelement params 1\nproperty float x\n", "does not begin with a PLY header"),
        (b"ply\nformat zip 1.0\nelement params 0\nend_header\n", "its format is 'zip'"),
        (b"ply\nformat ascii 1.0\nelement params 1\nproperty quad x\nend_header\n1\n", "property quad x"),
        (b"ply\nformat ascii 1.0\nelement params 2\nproperty float x\nend_header\n1\n", "does not hold 2 points"),
        (b"ply\nformat ascii 1.0\nelement params 1\nproperty float x\nend_header\nabc\n", "does not hold 1 points"),
        (b"ply\nformat binary_little_endian 1.0\nelement params 2\nproperty int x\nend_header\nabcd", "ends before"),
        (b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "only: vertex"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_ply(tmp_path / "a.ply", ("params", "Urb3DSimul"))


def test_an_element_may_be_empty(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", "params", {name: values[:0] for name, values in COLUMNS.items()})
    assert all(len(values) == 0 for values in read_ply(tmp_path / "a.ply", ("params",)).values())
    with pytest.raises(InputError, match="Cannot read"):
        read_ply(tmp_path / "b.ply", ("params",))


# --- scenes ---------------------------------------------------------------------------------------------------------


def test_a_scene_goes_through_its_folder(tmp_path: Path) -> None:
    before, after = np.array([[0.0, 1.0, 2.0]]), np.array([[3.5, 4.0, 5.0], [6.0, 7.0, 8.25]])
    scene = UrbScene("lyon", Pair(before, after), np.array([0, 6], dtype=np.uint8))
    write_scene(scene, tmp_path / "lyon")
    found = read_scene(tmp_path / "lyon")
    assert (found.name, found.label.tolist()) == ("lyon", [0, 6])
    np.testing.assert_array_equal(found.clouds.before, before)
    np.testing.assert_array_equal(found.clouds.after, after)
    with pytest.raises(OutputError, match="already holds a scene"):
        write_scene(scene, tmp_path / "lyon")


def test_scenes_with_other_labels_are_refused(tmp_path: Path) -> None:
    xyz = {axis: np.zeros(1, dtype=np.float32) for axis in "xyz"}
    write_ply(tmp_path / "pointCloud0.ply", "params", xyz)
    write_ply(tmp_path / "pointCloud1.ply", "params", xyz)
    with pytest.raises(InputError, match="has no label_ch"):
        read_scene(tmp_path)
    write_ply(tmp_path / "pointCloud1.ply", "params", {**xyz, "label_ch": np.array([7.0], dtype=np.float32)})
    with pytest.raises(InputError, match="runs from 7 to 7"):
        read_scene(tmp_path)


# --- classes --------------------------------------------------------------------------------------------------------


def known(*rows: tuple[float, float, float, int, int, int]) -> Known:
    """One point per row: x, y, z, object class, change, object."""
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    return Known(table[:, :3], table[:, 3].astype(np.uint8), table[:, 4].astype(np.uint8), table[:, 5].astype(np.int64))


def test_what_stands_there_has_the_class_of_its_change() -> None:
    rows = [(BUILDING, c) for c in (UNCHANGED, ADDED, INCREASED, DECREASED)]
    rows += [(PLANT, c) for c in (UNCHANGED, ADDED, INCREASED, DECREASED)]
    rows += [(CAR, UNCHANGED), (CAR, ADDED), (GROUND, UNCHANGED), (GROUND, INCREASED)]
    rows += [(BUILDING, ChangeLabel.UNDETERMINED), (ObjectClass.OTHER, ADDED)]
    after = known(*((10.0 * i, 0.0, 0.0, c, change, i) for i, (c, change) in enumerate(rows)))
    assert classes_of(Pair(known(), after)).tolist() == [0, 1, 1, 2, 0, 3, 4, 0, 0, 6, 0, 0, 0, 6]


def square(x: float, z: float, object_class: int, change: int, number: int) -> list[tuple[float, ...]]:
    """Points 0.5 m apart on a square of 4 m."""
    return [(x + i / 2, j / 2, z, object_class, change, number) for i in range(9) for j in range(9)]


def test_what_is_gone_is_labelled_on_the_ground_that_took_its_place() -> None:
    before = known(
        *square(0, 5, BUILDING, REMOVED, 1),
        *square(20, 3, PLANT, REMOVED, 2),
        *square(40, 1, CAR, REMOVED, 3),
        *square(60, 5, BUILDING, UNCHANGED, 4),
    )
    places = [2.0, 22.0, 42.0, 62.0, 10.0]
    after = known(*((x, 2.0, 0.0, GROUND, UNCHANGED, 0) for x in places), (3.0, 2.0, 2.0, CAR, UNCHANGED, 9))
    assert classes_of(Pair(before, after)).tolist() == [2, 5, 6, 0, 0, 0]


def test_the_roof_of_a_house_that_got_an_annex_is_not_new() -> None:
    before = known(*square(0, 6, BUILDING, INCREASED, 1), *square(5, 0, GROUND, UNCHANGED, 0))
    after = known(*square(0, 6, BUILDING, INCREASED, 1), *square(5, 3, BUILDING, INCREASED, 2))
    found = classes_of(pieces_only(Pair(before, after)))
    assert found.tolist() == [UrbClass.UNCHANGED] * 81 + [UrbClass.NEW_BUILDING] * 81
    grown = after._replace(object_class=np.full_like(after.object_class, PLANT))
    assert np.all(classes_of(pieces_only(Pair(before, grown))) == UrbClass.VEGETATION_GROWTH)
    assert np.all(classes_of(pieces_only(Pair(known(), after))) == UrbClass.NEW_BUILDING)


def test_no_points_no_classes() -> None:
    assert classes_of(Pair(known(), known())).tolist() == []
    assert classes_of(Pair(known(*square(0, 5, BUILDING, REMOVED, 1)), known())).tolist() == []


# --- scores ---------------------------------------------------------------------------------------------------------


def test_scores_by_hand() -> None:
    truth = np.array([0, 0, 0, 0, 1, 1, 2, 6], dtype=np.uint8)
    predicted = np.array([0, 0, 0, 1, 1, 0, 2, 3], dtype=np.uint8)
    scores = UrbScores.of(truth, predicted)
    assert scores.confusion[0].tolist() == [3, 1, 0, 0, 0, 0, 0]
    assert scores.confusion[6].tolist() == [0, 0, 0, 1, 0, 0, 0]
    assert scores.recall[[0, 1, 2, 6]].tolist() == [0.75, 0.5, 1.0, 0.0]
    assert np.isnan(scores.recall[[3, 4, 5]]).all()
    assert scores.mean_accuracy == pytest.approx((0.75 + 0.5 + 1.0 + 0.0) / 4)
    assert scores.iou[[0, 1, 2, 3, 6]].tolist() == pytest.approx([3 / 5, 1 / 3, 1.0, 0.0, 0.0])
    assert scores.mean_iou_of_change == pytest.approx((1 / 3 + 1.0 + 0.0 + 0.0) / 4)
    assert scores.to_dict()["recall"][UrbClass.NEW_VEGETATION.title] is None
    assert "| ours | 8 | 56.2 | 33.3 | 60.0 | 33.3 |" in to_markdown({"ours": scores})


def test_no_points_no_scores() -> None:
    nothing = np.zeros(0, dtype=np.uint8)
    values = UrbScores.of(nothing, nothing).to_dict()
    assert (values["n"], values["macc"], values["miou_ch"]) == (0, None, None)


# --- a simulated block ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def block_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("block")
    write_block(simulate_block(12, SimulationOptions(length_m=60.0, density=0.3)), folder)
    return folder


def test_a_block_as_a_scene_has_the_classes_of_its_truth(block_dir: Path) -> None:
    scene = scene_of_block(block_dir)
    truth = json.loads((block_dir / "truth.json").read_text())
    changed = {(i["object_class"], i["label"]) for i in truth["instances"] if i["n_changed"]["after"] > 50}
    present = set(np.unique(scene.label).tolist())
    for kind, urb_class in (
        (("building", "Added"), UrbClass.NEW_BUILDING),
        (("vegetation", "Added"), UrbClass.NEW_VEGETATION),
        (("vegetation", "Increased"), UrbClass.VEGETATION_GROWTH),
        (("mobile", "Added"), UrbClass.MOBILE),
    ):
        assert (kind in changed) <= (urb_class in present)
    assert {UrbClass.UNCHANGED, UrbClass.MOBILE} <= present
    height = scene.clouds.after[:, 2]
    is_gone = scene.label == UrbClass.DEMOLISHED
    if is_gone.any():
        assert np.median(height[is_gone]) < np.median(height[scene.label == UrbClass.NEW_BUILDING])


def test_the_commands_export_a_block_and_score_its_scene(block_dir: Path, tmp_path: Path) -> None:
    exported = CliRunner().invoke(bench, ["urb3dcd-export", str(block_dir), str(tmp_path / "scene")])
    assert exported.exit_code == 0, exported.output
    table = tmp_path / "table.md"
    arguments = ["urb3dcd", str(tmp_path / "scene"), "--preset", "street", "--json", "--markdown", str(table)]
    result = CliRunner().invoke(bench, arguments)
    assert result.exit_code == 0, result.output
    scores = json.loads(result.stdout)
    n = len(read_scene(tmp_path / "scene").label)
    assert {s["n"] for s in scores.values()} == {n}
    assert {"loda-pdal", "nDSM difference", "C2C"} <= set(scores)
    assert scores["loda-pdal"]["iou"]["Unchanged"] > 0.8
    assert scores["loda-pdal"]["macc"] > 0.5
    assert "| loda-pdal |" in table.read_text()
