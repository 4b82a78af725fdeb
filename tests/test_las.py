"""Reading surveys and writing the output cloud."""

from __future__ import annotations

import hashlib
import json
import struct
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from io_samples import (
    CORNER,
    explain,
    make_labels,
    make_las,
    make_registration,
    make_surveys,
    scattered,
)
from laspy.vlrs.known import GeoKeyDirectoryVlr
from pyproj import CRS

from loda_pdal.io.gps_time import gps_day
from loda_pdal.io.las import inspect, overlap, read_epochs
from loda_pdal.io.las_points import LasFile
from loda_pdal.io.las_writer import las_wkt, write_cloud
from loda_pdal.io.transform import read_map_transform, write_transform
from loda_pdal.model.cloud import LOCAL_GRID
from loda_pdal.model.dimensions import EXTRA_DIMENSIONS
from loda_pdal.model.errors import InputError, OutputError
from loda_pdal.model.extent import Extent
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.pair import Pair
from loda_pdal.model.registration import Registration
from loda_pdal.model.survey import Survey
from loda_pdal.model.transform import exp_se3
from loda_pdal.params import FuseParams
from loda_pdal.stages.fuse import fuse_survey


def written(folder: Path, surveys: Pair[Survey], name: str = "out.laz", **options: Any) -> tuple[Any, Pair[Any]]:
    """The output cloud of two surveys as it reads back, and the labels that went in."""
    labels = Pair(make_labels(surveys.before, 5), make_labels(surveys.after, 6))
    T = options.pop("T", make_registration().T_after_before)
    write_cloud(folder / name, surveys, labels, T, **options)
    return laspy.read(folder / name), labels


# Reading


@pytest.mark.parametrize(
    ("suffix", "point_format", "version"),
    [("las", 0, "1.2"), ("laz", 3, "1.2"), ("laz", 1, "1.3"), ("las", 6, "1.4"), ("laz", 8, "1.4"), ("laz", 3, "1.4")],
)
def test_local_coordinates_are_the_map_coordinates_less_a_common_origin(
    tmp_path: Path, suffix: str, point_format: int, version: str
) -> None:
    xyz = scattered()
    paths = [
        make_las(tmp_path / f"{name}.{suffix}", xyz + shift, point_format=point_format, version=version)
        for name, shift in (("a", 0.0), ("b", [5.0, 3.0, 0.0]))
    ]
    surveys = read_epochs(*paths)
    assert surveys.before.frame == surveys.after.frame
    assert surveys.before.frame.origin == (634_000, 4_831_000, 0)
    # half a LAS step and half a step of the local grid
    tolerance = 0.0005 + LOCAL_GRID
    np.testing.assert_allclose(surveys.before.xyz, xyz - [634_000, 4_831_000, 0], rtol=0, atol=tolerance)
    np.testing.assert_allclose(surveys.after.xyz, xyz - [633_995, 4_830_997, 0], rtol=0, atol=tolerance)
    assert np.all(surveys.before.xyz / LOCAL_GRID == np.round(surveys.before.xyz / LOCAL_GRID))


def test_origin_comes_from_the_lower_of_both_surveys_also_left_of_zero(tmp_path: Path) -> None:
    before = make_las(tmp_path / "a.las", scattered() - CORNER + [-10.0, 20.0, -3.0], offset=(0, 0, 0))
    after = make_las(tmp_path / "b.las", scattered() - CORNER + [5.0, 15.0, -3.0], offset=(0, 0, 0))
    for surveys in (read_epochs(before, after), read_epochs(after, before).swapped):
        assert surveys.before.frame.origin == (-1000, 0, 0)
        assert surveys.before.xyz[:, 0].min() == pytest.approx(990.0, abs=0.1)


def test_shifting_the_map_by_a_million_metres_changes_no_local_coordinate(tmp_path: Path) -> None:
    xyz = scattered()
    near = make_las(tmp_path / "near.las", xyz)
    far = make_las(tmp_path / "far.las", xyz + np.array([1e6, 1e6, 0]), offset=(1_634_000.0, 5_831_000.0, 0.0))
    np.testing.assert_array_equal(read_epochs(near, near).before.xyz, read_epochs(far, far).before.xyz)


@pytest.mark.parametrize(
    ("crs", "unit_xy_m", "unit_z_m"),
    [
        ("EPSG:2992", 0.3048, 0.3048),  # feet, heights not stated
        ("EPSG:2269+5703", 0.3048, 1.0),  # feet in plan, metres in height
        ("EPSG:2225+6360", 1200 / 3937, 1200 / 3937),  # US survey feet
        ("EPSG:32617+5703", 1.0, 1.0),
    ],
)
def test_feet_become_metres_in_plan_and_height_separately(
    tmp_path: Path, crs: str, unit_xy_m: float, unit_z_m: float
) -> None:
    xyz = scattered()
    path = make_las(tmp_path / "a.las", xyz, crs=crs)
    survey = read_epochs(path, path).before
    assert survey.frame.unit_xy_m == pytest.approx(unit_xy_m, rel=1e-9)
    assert survey.frame.unit_z_m == pytest.approx(unit_z_m, rel=1e-9)
    expected = (xyz - [634_000, 4_831_000, 0]) * [unit_xy_m, unit_xy_m, unit_z_m]
    np.testing.assert_allclose(survey.xyz, expected, rtol=0, atol=0.0006)
    np.testing.assert_allclose(survey.frame.to_map(survey.xyz), xyz, rtol=0, atol=0.0006)
    is_converted = unit_xy_m != 1.0
    assert any("results are in metres" in note for note in survey.notes) == is_converted


def test_reading_keeps_the_points_it_was_given(tmp_path: Path) -> None:
    path = make_las(tmp_path / "a.laz", extra={"tree": np.arange(2000, dtype=np.uint16)})
    survey = read_epochs(path, path).before
    assert survey.path == str(path)
    assert isinstance(survey.source, LasFile)
    np.testing.assert_array_equal(np.concatenate([part["tree"] for part in survey.source.records()]), np.arange(2000))


def test_inspect_says_what_the_header_says(tmp_path: Path) -> None:
    path = make_las(tmp_path / "a.laz", scattered(3600), crs="EPSG:2225+6360", extra={"tree": np.zeros(3600, "u2")})
    info = inspect(path)
    assert (info.n_points, info.version, info.point_format, info.is_compressed) == (3600, "1.4", 6, True)
    assert info.extra_dimensions == ("tree",)
    assert "gps_time" in info.dimensions
    assert info.size_m is not None and info.density is not None
    assert info.size_m[0] == pytest.approx(60 * 0.3048, rel=1e-2)  # 60 feet
    assert info.density == pytest.approx(3600 / (60 * 0.3048) ** 2, rel=0.01)
    plain = json.loads(json.dumps(info.to_dict()))
    assert plain["unit_xy_m"] == pytest.approx(1200 / 3937)
    assert plain["vertical_crs"] == "NAVD88 height (ftUS)"
    assert plain["bytes"] == path.stat().st_size


def test_overlap_is_the_share_of_the_smaller_bounds(tmp_path: Path) -> None:
    corners = np.array([[0.0, 0, 0], [100, 100, 5]])
    big = inspect(make_las(tmp_path / "big.las", corners, offset=(0, 0, 0)))
    small = inspect(make_las(tmp_path / "small.las", corners * [0.4, 0.4, 1] + [80, 0, 0], offset=(0, 0, 0)))
    apart = inspect(make_las(tmp_path / "apart.las", corners + np.array([200, 0, 0]), offset=(0, 0, 0)))
    assert overlap(big, small) == overlap(small, big) == pytest.approx(0.5)
    assert overlap(big, apart) == 0.0
    assert overlap(big, big) == 1.0


def stored(survey: Survey, name: str) -> np.ndarray:
    """One dimension of all points of the file behind a survey."""
    return np.asarray(laspy.read(survey.path)[name])


@pytest.fixture
def unkept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are decompressed anew every time, in parts of 333 points."""
    monkeypatch.setattr("loda_pdal.io.las_points.KEPT_BYTES", 0)
    monkeypatch.setattr("loda_pdal.io.las_points.PART", 333)


@pytest.mark.parametrize("point_format", [3, 6])
def test_a_file_is_read_anew_as_it_was_read_first(
    tmp_path: Path, unkept: None, monkeypatch: pytest.MonkeyPatch, point_format: int
) -> None:
    path = make_las(tmp_path / "a.laz", point_format=point_format, fields={"intensity": np.arange(2000)})
    survey = read_epochs(path, path).before
    assert isinstance(survey.source, LasFile)
    assert [len(part) for part in survey.parts()] == [333] * 6 + [2]
    for _ in range(2):
        np.testing.assert_array_equal(np.concatenate([r["intensity"] for r in survey.source.records()]), range(2000))
    anew = survey.xyz
    monkeypatch.undo()
    np.testing.assert_array_equal(read_epochs(path, path).before.xyz, anew)


def test_a_small_file_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    survey = read_epochs(make_las(tmp_path / "a.laz"), make_las(tmp_path / "b.laz")).before
    (tmp_path / "a.laz").unlink()
    assert len(survey.xyz) == 2000


def test_what_is_known_of_a_survey_from_its_first_reading(tmp_path: Path, unkept: None) -> None:
    path = make_las(tmp_path / "a.laz")
    survey = read_epochs(path, path).before
    assert (survey.n_bytes, survey.sha256) == (path.stat().st_size, hashlib.sha256(path.read_bytes()).hexdigest())
    found, again = survey.extent, Extent.of([survey.xyz])
    assert found.n == again.n == 2000
    for name in ("low", "high", "cells", "n_in_cell"):
        np.testing.assert_array_equal(getattr(found, name), getattr(again, name))


def test_a_file_that_changes_during_a_run_is_named(tmp_path: Path, unkept: None) -> None:
    surveys = make_surveys(tmp_path)
    make_las(tmp_path / "after.laz", scattered(1500, seed=3))
    with pytest.raises(InputError, match=r"after\.laz: was changed") as caught:
        written(tmp_path, surveys)
    assert caught.value.code == "input-changed"
    (tmp_path / "before.laz").unlink()
    with pytest.raises(InputError, match=r"before\.laz: cannot be read"):
        fuse_survey(surveys.before, FuseParams())


def test_dates_come_from_absolute_gps_time_only(tmp_path: Path) -> None:
    assert gps_day(315_964_800.0 - 1e9 + 18.0 + 86_400.0 * 0) is None  # 1990: no lidar survey
    assert gps_day(1_261_872_018.0 - 1e9) == "2020-01-01"
    assert gps_day(1_261_872_017.0 - 1e9) == "2019-12-31"
    assert gps_day(float("nan")) is None
    days = np.linspace(1_261_872_018.0 - 1e9, 1_262_044_818.0 - 1e9, 2000)
    path = make_las(tmp_path / "a.laz", fields={"gps_time": days})
    assert read_epochs(path, path).before.dates == (None, None)  # seconds of an unknown week
    data = laspy.read(path)
    data.header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    data.write(path)
    assert read_epochs(path, path).before.dates == ("2020-01-01", "2020-01-03")


def make_copc(path: Path, xyz: np.ndarray) -> Path:
    """A COPC file with one octree node: all points in the root chunk."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.floor(xyz.min(axis=0))
    half = float(np.ptp(xyz, axis=0).max() / 2)
    centre = (xyz.min(axis=0) + xyz.max(axis=0)) / 2
    info = struct.pack("<5d2Q2d88x", *centre, half, half / 64, 0, 32, 0.0, 0.0)
    header.vlrs.append(laspy.VLR("copc", 1, "COPC info", info))
    header.add_crs(CRS.from_epsg(32617))
    points = laspy.ScaleAwarePointRecord.zeros(len(xyz), header=header)
    points.x, points.y, points.z = xyz.T
    with laspy.open(path, mode="w", header=header) as writer:
        writer.write_points(points)
    data = bytearray(path.read_bytes())
    start = struct.unpack_from("<I", data, 96)[0]
    chunk_table = struct.unpack_from("<q", data, start)[0]
    evlr_start, page_start = len(data), len(data) + 60
    data += struct.pack("<H16sHQ32s", 0, b"copc", 1000, 32, b"EPT hierarchy")
    data += struct.pack("<4iQ2i", 0, 0, 0, 0, start + 8, chunk_table - start - 8, len(xyz))
    struct.pack_into("<QI", data, 235, evlr_start, 1)
    struct.pack_into("<Q", data, 375 + 54 + 40, page_start)
    path.write_bytes(bytes(data))
    return path


def test_copc_reads_like_any_laz(tmp_path: Path) -> None:
    xyz = scattered()
    path = make_copc(tmp_path / "a.copc.laz", xyz)
    with laspy.CopcReader.open(path) as reader:  # the file is what it claims to be
        assert len(reader.query()) == len(xyz)
    assert inspect(path).is_copc
    survey = read_epochs(path, make_las(tmp_path / "b.las", xyz)).before
    np.testing.assert_allclose(survey.xyz, xyz - [634_000, 4_831_000, 0], rtol=0, atol=0.001)


def test_heights_from_geotiff_keys_join_the_horizontal_crs(tmp_path: Path) -> None:
    path = make_las(tmp_path / "a.las", point_format=3, version="1.2")
    data = laspy.read(path)
    keys = data.header.vlrs.get("GeoKeyDirectoryVlr")[0]
    add_key(keys, 4096, 5703)
    data.write(path)
    info = inspect(path)
    assert info.crs.vertical is not None and info.crs.vertical.name == "NAVD88 height"
    assert info.crs.unit_z_m == 1.0
    assert info.crs.horizontal is not None and info.crs.horizontal.to_epsg() == 32617


def add_key(keys: GeoKeyDirectoryVlr, key_id: int, value: int) -> None:
    """One more short GeoTIFF key."""
    from laspy.vlrs.known import GeoKeyEntryStruct

    keys.geo_keys.append(GeoKeyEntryStruct(key_id, 0, 1, value))
    keys.geo_keys_header.number_of_keys += 1


# The real surveys


@pytest.mark.data
def test_amsterdam_has_no_crs_until_it_is_given(data_dir: Path) -> None:
    folder = data_dir / "amsterdam_mls_2epoch"
    paths = folder / "run1_2386_9702.laz", folder / "run2_2386_9702.laz"
    with pytest.raises(InputError) as caught:
        read_epochs(*paths)
    assert caught.value.code == "crs-missing" and "--epsg" in caught.value.remedy
    surveys = read_epochs(*paths, epsg=7415)
    assert (len(surveys.before), len(surveys.after)) == (454_236, 925_621)
    assert surveys.after.frame.origin == (119_000, 485_000, 0)
    found = CRS.from_wkt(surveys.after.frame.crs_wkt)
    assert found.to_epsg() == 7415 and found.is_compound


@pytest.mark.data
def test_toronto_headers_differ_until_they_are_said_to_agree(data_dir: Path) -> None:
    folder = data_dir / "toronto_ttp_als_2015_2019"
    paths = folder / "TTP_2015.laz", folder / "TTP_2019.laz"
    with pytest.raises(InputError) as caught:
        read_epochs(*paths)
    assert caught.value.code == "crs-differs"
    assert "WGS 84 / UTM zone 17N" in explain(caught.value) and "--assume-same-crs" in caught.value.remedy
    surveys = read_epochs(*paths, assume_same_crs=True)
    assert "CGVD28" in (surveys.after.frame.crs_wkt or "")
    assert any("assumed for both" in note for note in surveys.before.notes)
    assert surveys.after.notes == []


@pytest.mark.data
def test_autzen_is_read_in_metres(data_dir: Path) -> None:
    path = data_dir / "pdal_autzen_trim" / "autzen_trim_7.las"
    surveys = read_epochs(path, path)
    info = inspect(path)
    np.testing.assert_allclose(
        np.ptp(surveys.before.xyz, axis=0), np.subtract(info.high, info.low) * 0.3048, rtol=0, atol=1e-4
    )
    assert any("0.3048 m" in note for note in surveys.before.notes)
    read_epochs(path, path, epsg=2992)


# Writing


def test_every_point_is_written_once_before_first_with_its_labels(tmp_path: Path) -> None:
    surveys = make_surveys(tmp_path)
    cloud, labels = written(tmp_path, surveys)
    n = len(surveys.before)
    assert cloud.header.point_count == n + len(surveys.after) and str(cloud.header.version) == "1.4"
    np.testing.assert_array_equal(cloud["Epoch"], np.repeat([0, 1], [n, len(surveys.after)]))
    for part, found in ((slice(None, n), labels.before), (slice(n, None), labels.after)):
        np.testing.assert_array_equal(cloud["classification"][part], found.classification)
        np.testing.assert_array_equal(cloud["HeightAboveGround"][part], found.height)
        np.testing.assert_array_equal(cloud["LoD95"][part], found.lod95)
        np.testing.assert_array_equal(cloud["Superpoint"][part], found.superpoint)
        np.testing.assert_array_equal(cloud["InstanceId"][part], found.instance)
        np.testing.assert_array_equal(cloud["ObjectId"][part], found.object)
        np.testing.assert_array_equal(cloud["ChangeClass"][part], found.change)
        np.testing.assert_array_equal(cloud["ChangeConfidence"][part], found.confidence)
    types = {d.name: np.dtype(d.dtype) for d in cloud.point_format.extra_dimensions}
    assert types == {d.name: np.dtype(d.dtype) for d in EXTRA_DIMENSIONS}


def test_points_that_are_not_moved_keep_their_stored_integers(tmp_path: Path) -> None:
    surveys = make_surveys(tmp_path)
    n = len(surveys.before)
    moved, _ = written(tmp_path, surveys, "moved.laz")
    kept, _ = written(tmp_path, surveys, "kept.las", keep_frames=True)
    for cloud in (moved, kept):
        np.testing.assert_array_equal(cloud.header.scales, laspy.read(surveys.after.path).header.scales)
        np.testing.assert_array_equal(cloud.header.offsets, laspy.read(surveys.after.path).header.offsets)
        for axis in "XYZ":
            np.testing.assert_array_equal(cloud[axis][n:], stored(surveys.after, axis))
    for axis in "XYZ":
        np.testing.assert_array_equal(kept[axis][:n], stored(surveys.before, axis))


@pytest.mark.parametrize("crs", ["EPSG:32617", "EPSG:2269+5703"])
def test_transform_json_reproduces_the_moved_cloud_in_full_map_coordinates(tmp_path: Path, crs: str) -> None:
    before = make_las(tmp_path / "before.laz", scattered(2000, seed=1), crs=crs)
    surveys = read_epochs(before, make_las(tmp_path / "after.laz", scattered(1500, seed=2), crs=crs))
    registration = make_registration()
    cloud, _ = written(tmp_path, surveys, T=registration.T_after_before)
    write_transform(tmp_path / "transform.json", registration, surveys.after.frame)
    T_map = read_map_transform(tmp_path / "transform.json")
    original = np.column_stack([laspy.read(before)[axis] for axis in "xyz"])
    expected = original @ T_map[:3, :3].T + T_map[:3, 3]
    moved = np.column_stack([cloud[axis] for axis in "xyz"])[: len(original)]
    assert np.abs(moved - original).max() > 0.1
    np.testing.assert_allclose(moved, expected, rtol=0, atol=0.001)


def test_transform_json_says_the_same_in_local_metres(tmp_path: Path) -> None:
    frame = LocalFrame((634_000, 4_831_000, 0), 0.3048, 1.0, None)
    registration = make_registration()
    write_transform(tmp_path / "transform.json", registration, frame)
    document = json.loads((tmp_path / "transform.json").read_text())
    np.testing.assert_array_equal(document["local"]["matrix"], registration.T_after_before)
    np.testing.assert_array_equal(document["covariance"]["matrix"], registration.covariance)
    assert document["local"]["origin"] == [634_000, 4_831_000, 0]
    assert document["covariance"]["frame"] == "after"
    assert document["diagnostics"]["shift_m"] == pytest.approx([0.31, -0.22, 0.12])
    assert document["diagnostics"]["sigma_m"] == pytest.approx([0.01, 0.01, 0.02])


def test_transform_json_is_strict_where_nothing_is_known(tmp_path: Path) -> None:
    unknown = Registration(np.eye(4), "after", np.full((6, 6), np.nan), np.zeros(3), False, message="no pairs")
    write_transform(tmp_path / "t.json", unknown, LocalFrame((0, 0, 0)))
    document = json.loads((tmp_path / "t.json").read_text(), parse_constant=pytest.fail)
    assert document["covariance"]["matrix"] == [[None] * 6] * 6
    assert document["diagnostics"]["rmse_m"] is None and document["diagnostics"]["converged"] is False
    (tmp_path / "t.json").write_text("{}")
    with pytest.raises(InputError, match="not a transform file"):
        read_map_transform(tmp_path / "t.json")


def test_older_point_formats_keep_flags_returns_and_scan_angle(tmp_path: Path) -> None:
    n = 2000
    rng = np.random.default_rng(3)
    fields = {
        "intensity": rng.integers(0, 65_536, n),
        "return_number": rng.integers(1, 6, n),
        "number_of_returns": rng.integers(1, 6, n),
        "scan_direction_flag": rng.integers(0, 2, n),
        "edge_of_flight_line": rng.integers(0, 2, n),
        "classification": rng.choice([1, 2, 12], n),
        "synthetic": rng.integers(0, 2, n),
        "key_point": rng.integers(0, 2, n),
        "withheld": rng.integers(0, 2, n),
        "scan_angle_rank": rng.integers(-90, 91, n),
        "user_data": rng.integers(0, 256, n),
        "point_source_id": rng.integers(0, 65_536, n),
        "gps_time": rng.uniform(0, 1e6, n),
        "red": rng.integers(0, 65_536, n),
    }
    before = make_las(tmp_path / "before.laz", scattered(n, 1), point_format=3, version="1.2", fields=fields)
    cloud, _ = written(tmp_path, read_epochs(before, make_las(tmp_path / "after.laz", scattered(1500, 2))))
    assert cloud.header.point_format.id == 7
    for name in set(fields) - {"classification", "scan_angle_rank"}:
        np.testing.assert_array_equal(cloud[name][:n], fields[name], err_msg=name)
    np.testing.assert_array_equal(cloud["overlap"][:n], fields["classification"] == 12)
    np.testing.assert_allclose(cloud["scan_angle"][:n] * 0.006, fields["scan_angle_rank"], rtol=0, atol=0.003)
    assert not cloud["red"][n:].any()


@pytest.mark.parametrize(
    ("before", "after", "expected"), [(0, 1, 6), (6, 6, 6), (2, 6, 7), (3, 8, 8), (4, 6, 9), (9, 7, 10), (10, 8, 10)]
)
def test_output_point_format_holds_the_fields_of_both(tmp_path: Path, before: int, after: int, expected: int) -> None:
    paths = []
    for number, point_format in enumerate((before, after)):
        version = "1.4" if point_format > 5 else "1.3"
        wave = {"wavepacket_offset": np.arange(2000)} if point_format in (4, 5, 9, 10) else {}
        nir = {"nir": np.arange(2000)} if point_format in (8, 10) else {}
        path = tmp_path / f"{number}.las"
        paths.append(make_las(path, point_format=point_format, version=version, fields={**wave, **nir}))
    cloud, _ = written(tmp_path, read_epochs(*paths))
    assert cloud.header.point_format.id == expected
    for part, point_format in ((slice(0, 2000), before), (slice(2000, 4000), after)):
        if point_format in (4, 5, 9, 10):
            np.testing.assert_array_equal(cloud["wavepacket_offset"][part], np.arange(2000))
        if point_format in (8, 10):
            np.testing.assert_array_equal(cloud["nir"][part], np.arange(2000))


def test_extra_bytes_of_both_inputs_are_kept(tmp_path: Path) -> None:
    n, m = 2000, 1500
    rng = np.random.default_rng(4)
    before_extra = {
        "label": rng.integers(0, 99, n).astype(np.uint8),
        "only_before": rng.normal(size=n).astype(np.float32),
        "mixed": rng.integers(0, 255, n).astype(np.uint8),
        "ObjectId": np.full(n, 7, dtype=np.uint16),
    }
    after_extra = {
        "label": rng.integers(0, 99, m).astype(np.uint8),
        "mixed": rng.normal(size=m),
        "count": rng.integers(-9, 9, m).astype(np.int64),
    }
    scaled = laspy.ExtraBytesParams("height", np.int16, "cm", scales=[0.01], offsets=[5.0], no_data=[-999])
    vector = laspy.ExtraBytesParams("colour", "3f4")
    before = make_las(tmp_path / "b.laz", scattered(n, 1), extra=before_extra, extra_params=[scaled, vector])
    data = laspy.read(before)
    data["height"] = heights = np.round(rng.uniform(0, 20, n), 2)
    data["colour"] = colours = rng.normal(size=(n, 3)).astype(np.float32)
    data.write(before)
    after = make_las(tmp_path / "a.laz", scattered(m, 2), extra=after_extra)
    cloud, labels = written(tmp_path, read_epochs(before, after))

    np.testing.assert_array_equal(cloud["label"], np.concatenate([before_extra["label"], after_extra["label"]]))
    np.testing.assert_array_equal(cloud["only_before"][:n], before_extra["only_before"])
    assert np.all(np.isnan(cloud["only_before"][n:]))
    np.testing.assert_array_equal(cloud["mixed"], np.concatenate([before_extra["mixed"], after_extra["mixed"]]))
    np.testing.assert_array_equal(cloud["count"][n:], after_extra["count"])
    assert not cloud["count"][:n].any()
    np.testing.assert_allclose(cloud["height"][:n], heights, rtol=0, atol=1e-9)
    assert np.all(cloud.points.array["height"][n:] == -999)
    np.testing.assert_array_equal(cloud["colour"][:n], colours)
    np.testing.assert_array_equal(cloud["ObjectId"], np.concatenate([labels.before.object, labels.after.object]))


def test_different_scales_give_the_finest_and_an_offset_that_holds_all(tmp_path: Path) -> None:
    coarse = make_las(tmp_path / "b.las", scattered(2000, 1), scale=0.01, offset=(0, 0, 0))
    fine = make_las(tmp_path / "a.las", scattered(1500, 2), scale=0.0001, offset=(634_000.0, 4_831_000.0, 50.0))
    surveys = read_epochs(coarse, fine)
    cloud, _ = written(tmp_path, surveys, keep_frames=True)
    np.testing.assert_array_equal(cloud.header.scales, np.full(3, 0.0001))
    for axis in "xyz":
        expected = np.concatenate([stored(surveys.before, axis), stored(surveys.after, axis)])
        np.testing.assert_allclose(cloud[axis], expected, rtol=0, atol=1e-8)


def test_offset_changes_where_the_shared_one_cannot_hold_the_moved_points(tmp_path: Path) -> None:
    scale = 1e-7  # 32 bits reach 214 m either way
    xyz = scattered()
    path = make_las(tmp_path / "a.las", xyz, scale=scale, offset=CORNER - 150.0)
    surveys = read_epochs(path, path)
    cloud, _ = written(tmp_path, surveys, T=exp_se3(np.array([60.0, 0, 0, 0, 0, 0])))
    np.testing.assert_array_equal(cloud.header.scales, np.full(3, scale))
    np.testing.assert_allclose(cloud["x"][:2000], xyz[:, 0] + 60.0, rtol=0, atol=2e-5)
    np.testing.assert_allclose(cloud["x"][2000:], xyz[:, 0], rtol=0, atol=2e-5)


def test_crs_of_the_after_epoch_is_written_as_wkt(tmp_path: Path) -> None:
    surveys = make_surveys(tmp_path, crs="EPSG:32617+5703")
    cloud, _ = written(tmp_path, surveys)
    found = cloud.header.parse_crs()
    assert cloud.header.global_encoding.wkt
    assert found.is_compound and found.sub_crs_list[0].to_epsg() == 32617 and found.sub_crs_list[1].to_epsg() == 5703
    assert las_wkt(CRS.from_epsg(32617).to_wkt()).startswith("PROJCS[")


def test_surveys_made_from_arrays_can_be_written(tmp_path: Path) -> None:
    frame = LocalFrame((634_000, 4_831_000, 0))
    full = scattered(500)
    survey = Survey(frame.to_local(full), frame)
    cloud, _ = written(tmp_path, Pair(survey, survey), T=np.eye(4))
    np.testing.assert_allclose(np.column_stack([cloud[a] for a in "xyz"])[:500], full, rtol=0, atol=0.0006)


def test_cloud_is_written_in_parts_without_a_seam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, _ = written(tmp_path, make_surveys(tmp_path), "whole.las")
    monkeypatch.setattr("loda_pdal.io.las_points.KEPT_BYTES", 0)
    monkeypatch.setattr("loda_pdal.io.las_points.PART", 333)
    parts, _ = written(tmp_path, make_surveys(tmp_path), "parts.las")
    assert whole.points.array.tobytes() == parts.points.array.tobytes()


@pytest.mark.parametrize("name", ["changes.copc.laz", "changes.txt"])
def test_other_cloud_formats_are_refused_by_name(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutputError, match="point clouds are written as"):
        written(tmp_path, make_surveys(tmp_path), name)


@pytest.mark.data
def test_real_surveys_of_different_kinds_come_out_whole(tmp_path: Path, data_dir: Path) -> None:
    folder = data_dir / "toronto_ttp_als_2015_2019"
    surveys = read_epochs(folder / "TTP_2015.laz", folder / "TTP_2019.laz", assume_same_crs=True)
    cloud, _ = written(tmp_path, surveys)
    n = len(surveys.before)
    for axis in "XYZ":
        np.testing.assert_array_equal(cloud[axis][n:], stored(surveys.after, axis))
    np.testing.assert_array_equal(cloud["intensity"][:n], stored(surveys.before, "intensity"))
    assert cloud.header.parse_crs().is_compound
