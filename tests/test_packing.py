"""Results as files: what goes in comes out, and a file cannot make us build anything but our own types."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import shapely

from loda_pdal.io.packing import load_packed, save_packed
from loda_pdal.model.cloud import VoxelCloud
from loda_pdal.model.dimensions import EPOCH
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import ObjectRecord
from loda_pdal.params import Parameters


def round_trip(value: object, folder: Path) -> object:
    save_packed(folder / "x.npz", value)
    return load_packed(folder / "x.npz")


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        -3,
        1e-300,
        "text with \u03c3",
        (1, (2.5, None), []),
        {"a": [1], 2: ("b",), None: {}},
        ChangeLabel.REMOVED,
        EPOCH,
        Parameters.preset("aerial"),
        {"$": "enum"},
    ],
)
def test_plain_values_come_back_equal_and_of_the_same_type(value: object, tmp_path: Path) -> None:
    back = round_trip(value, tmp_path)
    assert back == value
    assert type(back) is type(value)


def test_arrays_come_back_with_dtype_shape_and_bits(tmp_path: Path) -> None:
    arrays = [
        np.array([[np.nan, -0.0, np.inf]]),
        np.zeros((0, 3), np.float32),
        np.arange(6, dtype=np.uint8).reshape(2, 3)[:, ::2],
        np.array([True, False]),
        np.array(["a", "bcd"]),
    ]
    for array, back in zip(arrays, round_trip(arrays, tmp_path), strict=True):  # type: ignore[call-overload]
        assert back.dtype == array.dtype
        assert back.shape == array.shape
        assert back.tobytes() == array.tobytes()


def test_nested_results_with_shapes_come_back(tmp_path: Path) -> None:
    footprint = shapely.MultiPolygon([shapely.box(0, 0, 2, 1)])
    record = ObjectRecord(1, ChangeLabel.ADDED, ObjectClass.BUILDING, footprint, "new", lod95_m=float("nan"))
    cloud = VoxelCloud(np.ones((2, 3)), np.ones(2, np.int32), np.array([0, -1, 1], np.int32))
    back = round_trip(Pair([record], cloud), tmp_path)
    assert isinstance(back, Pair)
    assert back.before[0].footprint.equals_exact(footprint)
    assert np.isnan(back.before[0].lod95_m)
    assert dataclasses.replace(back.before[0], lod95_m=None, footprint=None) == dataclasses.replace(
        record, lod95_m=None, footprint=None
    )
    assert isinstance(back.after, VoxelCloud)
    assert back.after.voxel_idx.tolist() == [0, -1, 1]
    shapes = np.array([shapely.Point(1, 2), None], dtype=object)
    assert round_trip(shapes, tmp_path).tolist() == shapes.tolist()  # type: ignore[attr-defined]


def test_one_array_in_two_places_is_stored_once(tmp_path: Path) -> None:
    array = np.arange(100_000)
    save_packed(tmp_path / "once.npz", [array])
    save_packed(tmp_path / "twice.npz", [array, array])
    assert (tmp_path / "twice.npz").stat().st_size < 1.1 * (tmp_path / "once.npz").stat().st_size


@pytest.mark.parametrize("value", [object(), {1, 2}, np.array([object()]), Path("x"), ValueError])
def test_what_cannot_be_stored_is_refused(value: object, tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="cannot store"):
        save_packed(tmp_path / "x.npz", value)


@pytest.mark.parametrize(
    "name",
    [
        "os:system",
        "subprocess:Popen",
        "loda_pdal.io.packing:np",
        "loda_pdal.io.packing:save_packed",
        "loda_pdal.io.run_folder:Path",
        "loda_pdal.io.run_folder:RunFolder",
    ],
)
def test_a_file_cannot_name_anything_but_our_data_types(name: str, tmp_path: Path) -> None:
    tree = json.dumps({"$": "data", "type": name, "fields": {}}).encode()
    np.savez(tmp_path / "x.npz", tree=np.frombuffer(tree, np.uint8))
    with pytest.raises(ValueError, match="type"):
        load_packed(tmp_path / "x.npz")


def test_pickled_arrays_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", tree=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ValueError, match="allow_pickle"):
        load_packed(tmp_path / "x.npz")


def test_files_of_others_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match="not written by loda-pdal"):
        load_packed(tmp_path / "x.npz")
