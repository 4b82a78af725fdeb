"""Input that cannot be used: each case is named, with what to do about it, before any long work."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from io_samples import CORNER, explain, make_las, scattered
from pyproj import CRS

from loda_pdal.io.crs import DeclaredCrs, common_crs
from loda_pdal.io.las import inspect, read_epochs
from loda_pdal.io.memory import available_memory, check_memory, estimate_memory
from loda_pdal.model.errors import InputError, MemoryLimitError
from loda_pdal.model.pair import Pair

# Byte positions in a LAS 1.4 header
SCALE_AT, OFFSET_AT, BOUNDS_AT = 131, 155, 179


@pytest.fixture
def good(tmp_path: Path) -> Path:
    """A survey with nothing wrong."""
    return make_las(tmp_path / "good.las")


def refused(*paths: Path, **options: Any) -> InputError:
    """The error of reading, whichever of the two files is the bad one."""
    with pytest.raises(InputError) as caught:
        read_epochs(*paths, **options)
    explain(caught.value)
    return caught.value


def patched(path: Path, position: int, *values: float) -> Path:
    """The same file with doubles written over part of its header."""
    data = bytearray(path.read_bytes())
    struct.pack_into(f"<{len(values)}d", data, position, *values)
    path.write_bytes(bytes(data))
    return path


# Files


def test_missing_file(good: Path, tmp_path: Path) -> None:
    missing = tmp_path / "nowhere.laz"
    for paths in ((missing, good), (good, missing)):
        error = refused(*paths)
        assert error.code == "input-missing" and "nowhere.laz" in str(error)


def test_folder_instead_of_a_file(good: Path, tmp_path: Path) -> None:
    assert refused(tmp_path, good).code == "input-not-las"


def test_file_that_may_not_be_read(good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    locked = make_las(tmp_path / "locked.las")
    opened = Path.open

    def refuse(self: Path, *args: Any, **kwargs: Any) -> Any:
        if self.name == "locked.las":
            raise PermissionError(13, "Permission denied")
        return opened(self, *args, **kwargs)

    monkeypatch.setattr(Path, "open", refuse)
    error = refused(good, locked)
    assert error.code == "input-unreadable" and "Permission denied" in str(error)


@pytest.mark.parametrize("content", [b"PK\x03\x04 a zip file" * 50, b"x,y,z\n1,2,3\n" * 50, b"LA"])
def test_file_that_is_not_las(good: Path, tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other.las"
    path.write_bytes(content)
    assert refused(path, good).code == "input-not-las"


def test_empty_file(good: Path, tmp_path: Path) -> None:
    path = tmp_path / "empty.laz"
    path.touch()
    assert refused(path, good).code == "input-truncated"


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("share", [0.001, 0.004, 0.01, 0.1, 0.5, 0.9, 0.9999])
def test_truncated_file(good: Path, tmp_path: Path, suffix: str, share: float) -> None:
    path = make_las(tmp_path / f"cut.{suffix}", scattered(2000), extra={"tree": np.arange(2000)})
    data = path.read_bytes()
    path.write_bytes(data[: max(4, int(share * len(data)))])
    error = refused(path, good)
    assert error.code == "input-truncated" and "cut." in str(error)


def test_truncated_file_is_noticed_from_its_header_alone(tmp_path: Path) -> None:
    for suffix in ("las", "laz"):
        path = make_las(tmp_path / f"cut.{suffix}")
        path.write_bytes(path.read_bytes()[:-100])
        with pytest.raises(InputError, match="damaged or cut off"):
            inspect(path)


def test_damaged_compressed_points(good: Path, tmp_path: Path) -> None:
    path = make_las(tmp_path / "bad.laz", scattered(60_000))
    data = bytearray(path.read_bytes())
    start = struct.unpack_from("<I", data, 96)[0]
    data[start + 8 : start + 2000] = bytes(1992)
    path.write_bytes(bytes(data))
    # laz has no checksums: what decodes to nonsense is caught as an impossible extent or overlap
    assert refused(path, good).code in ("input-truncated", "input-extent", "no-overlap")


def test_no_points(good: Path, tmp_path: Path) -> None:
    empty = make_las(tmp_path / "none.las", np.empty((0, 3)))
    for paths in ((empty, good), (good, empty)):
        assert refused(*paths).code == "input-empty"


# Coordinates


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("position", [SCALE_AT, SCALE_AT + 16, OFFSET_AT, OFFSET_AT + 8])
def test_coordinates_that_are_not_finite(good: Path, tmp_path: Path, value: float, position: int) -> None:
    path = patched(make_las(tmp_path / "nan.las"), position, value)
    assert refused(good, path).code == "input-not-finite"


def test_scale_of_zero(good: Path, tmp_path: Path) -> None:
    assert refused(good, patched(make_las(tmp_path / "zero.las"), SCALE_AT, 0.0)).code == "input-not-finite"


def test_overflowing_coordinates(good: Path, tmp_path: Path) -> None:
    path = patched(make_las(tmp_path / "big.las"), SCALE_AT, 1e308)
    patched(path, BOUNDS_AT, *([float("nan")] * 6))
    assert refused(good, path).code == "input-not-finite"


def test_stray_point_far_away(good: Path, tmp_path: Path) -> None:
    stray = np.vstack([scattered(), [[0.0, 0.0, 0.0]]])
    error = refused(make_las(tmp_path / "stray.las", stray, scale=0.01), good)
    assert error.code == "input-extent" and "stray points" in error.remedy


def test_too_few_points_for_the_extent(tmp_path: Path) -> None:
    thin = make_las(tmp_path / "thin.las", scattered(800, size_m=300.0))
    assert refused(thin, thin).code == "input-extent"
    strip = make_las(tmp_path / "strip.las", CORNER + np.column_stack([np.linspace(0, 700, 900), *np.zeros((2, 900))]))
    assert len(read_epochs(strip, strip).before) == 900  # a thin but long strip is a survey


def test_wrong_bounds_in_the_header_do_not_matter(good: Path, tmp_path: Path) -> None:
    for number, bounds in enumerate(([0.0] * 6, [float("nan")] * 6, [1e308, -1e308] * 3)):
        path = patched(make_las(tmp_path / f"{number}.las"), BOUNDS_AT, *bounds)
        survey = read_epochs(path, good).before
        assert len(survey) == 2000 and survey.frame.origin == (634_000, 4_831_000, 0)
    far = patched(make_las(tmp_path / "far.las"), BOUNDS_AT, 634_180.0, 633_500.0)  # x only: highest, lowest
    np.testing.assert_array_equal(read_epochs(far, good).before.xyz, read_epochs(good, good).before.xyz)


# Coordinate reference systems


def test_crs_missing_in_both(tmp_path: Path) -> None:
    path = make_las(tmp_path / "none.las", crs=None)
    error = refused(path, path)
    assert error.code == "crs-missing" and "--epsg" in error.remedy and "--assume-same-crs" in error.remedy
    assert read_epochs(path, path, epsg=32617).after.frame.crs_wkt is not None
    surveys = read_epochs(path, path, assume_same_crs=True)
    assert surveys.after.frame.crs_wkt is None
    assert all("No CRS in either header" in survey.notes[0] for survey in surveys)


def test_crs_missing_in_one(good: Path, tmp_path: Path) -> None:
    bare = make_las(tmp_path / "bare.las", crs=None)
    for paths in ((bare, good), (good, bare)):
        error = refused(*paths)
        assert error.code == "crs-missing" and "bare.las" in error.message and "good.las" not in error.message
        assert "WGS 84 / UTM zone 17N" in error.remedy and "--assume-same-crs" in error.remedy
        surveys = read_epochs(*paths, assume_same_crs=True)
        assert CRS.from_wkt(surveys.after.frame.crs_wkt).to_epsg() == 32617
        assert sum(len(survey.notes) for survey in surveys) == 1


def test_crs_differs(good: Path, tmp_path: Path) -> None:
    other = make_las(tmp_path / "other.las", crs=26917)
    error = refused(good, other)
    assert error.code == "crs-differs"
    assert "EPSG:32617" in error.message and "EPSG:26917" in error.message and "--assume-same-crs" in error.remedy
    surveys = read_epochs(good, other, assume_same_crs=True)
    assert CRS.from_wkt(surveys.after.frame.crs_wkt).to_epsg() == 26917
    surveys = read_epochs(good, other, epsg=32617)
    assert CRS.from_wkt(surveys.after.frame.crs_wkt).to_epsg() == 32617
    assert surveys.before.notes == [] and "EPSG:32617 was used instead" in surveys.after.notes[0]


def test_same_crs_from_wkt_and_from_geotiff_keys_agrees(good: Path, tmp_path: Path) -> None:
    older = make_las(tmp_path / "older.las", point_format=1, version="1.2")
    assert laspy.read(older).header.vlrs.get("GeoKeyDirectoryVlr")
    assert all(survey.notes == [] for survey in read_epochs(older, good))


def test_geographic_degrees(tmp_path: Path) -> None:
    degrees = np.array([-79.3, 43.6, 75.0]) + scattered() * 0 + np.random.default_rng(1).uniform(0, 1e-3, (2000, 3))
    path = make_las(tmp_path / "deg.las", degrees, crs=4326, scale=1e-7, offset=(0, 0, 0))
    for options in ({}, {"assume_same_crs": True}):
        error = refused(path, path, **options)
        assert error.code == "crs-geographic" and "reprojection" in error.remedy
    assert inspect(path).size_m is None  # info still answers, without metres


def test_degrees_in_one_survey_only(good: Path, tmp_path: Path) -> None:
    path = make_las(tmp_path / "deg.las", crs=4326)
    assert refused(good, path, assume_same_crs=True).code == "crs-geographic"
    assert len(read_epochs(good, path, epsg=32617).after) == 2000  # only the header was wrong


@pytest.mark.parametrize("epsg", [4326, 5703, 999_999, 4978])
def test_epsg_that_is_no_projected_crs(good: Path, epsg: int) -> None:
    error = refused(good, good, epsg=epsg)
    assert error.code == "crs-unknown" and str(epsg) in error.message


def test_different_units(tmp_path: Path) -> None:
    feet = make_las(tmp_path / "feet.las", crs=2225)
    metres = make_las(tmp_path / "metres.las", crs=26941)
    for options in ({}, {"assume_same_crs": True}):
        error = refused(feet, metres, **options)
        assert error.code == "crs-units-differ" and "0.304801 m in feet.las" in error.message
    tall = make_las(tmp_path / "tall.las", crs="EPSG:32617+6360")
    level = make_las(tmp_path / "level.las", crs="EPSG:32617+5703")
    assert refused(tall, level, assume_same_crs=True).code == "crs-units-differ"


def test_different_vertical_datum(good: Path, tmp_path: Path) -> None:
    navd = make_las(tmp_path / "navd.las", crs="EPSG:32617+5703")
    cgvd = make_las(tmp_path / "cgvd.las", crs="EPSG:32617+5713")
    error = refused(navd, cgvd)
    assert error.code == "crs-vertical-differs"
    assert "NAVD88 height" in error.message and "CGVD28 height" in error.message
    surveys = read_epochs(navd, cgvd, assume_same_crs=True)
    assert "CGVD28 height was assumed for both" in surveys.before.notes[0]
    surveys = read_epochs(navd, good)  # one of them does not say: no error, but a note
    assert surveys.before.notes == [] and "NAVD88 height" in surveys.after.notes[0]


def test_crs_record_that_cannot_be_parsed(good: Path, tmp_path: Path) -> None:
    path = make_las(tmp_path / "broken.las")
    data = path.read_bytes()
    path.write_bytes(data.replace(b"PROJCS[", b"PROJXX["))
    error = refused(path, good)
    assert error.code == "crs-missing" and "cannot be parsed" in error.message
    assert len(read_epochs(path, good, epsg=32617).before) == 2000


def test_unnamed_projection_in_geotiff_keys_is_not_taken_for_degrees(good: Path, tmp_path: Path) -> None:
    path = make_las(tmp_path / "user.las", point_format=1, version="1.2")
    data = laspy.read(path)
    keys = data.header.vlrs.get("GeoKeyDirectoryVlr")[0]
    codes = {1024: 1, 2048: 4269, 3072: 32_767}
    for key in keys.geo_keys:
        key.value_offset = codes.pop(key.id, key.value_offset)
    from laspy.vlrs.known import GeoKeyEntryStruct

    for key_id, code in codes.items():
        keys.geo_keys.append(GeoKeyEntryStruct(key_id, 0, 1, code))
    keys.geo_keys_header.number_of_keys = len(keys.geo_keys)
    data.write(path)
    error = refused(path, good)
    assert error.code == "crs-missing" and "without an EPSG code" in error.message


def test_units_follow_whichever_header_names_them() -> None:
    plan, full = CRS.from_epsg(2269), CRS.from_user_input("EPSG:2269+5703")
    names = Pair("a.las", "b.las")
    for declared in (Pair(DeclaredCrs(plan), DeclaredCrs(full)), Pair(DeclaredCrs(full), DeclaredCrs(plan))):
        found = common_crs(declared, names)
        assert (found.unit_xy_m, found.unit_z_m) == (pytest.approx(0.3048), 1.0)


# Overlap and size


def test_surveys_of_different_places(good: Path, tmp_path: Path) -> None:
    other = make_las(tmp_path / "far.las", scattered() + np.array([500.0, 0, 0]))
    for paths in ((good, other), (other, good)):
        error = refused(*paths)
        assert error.code == "no-overlap" and "lie apart" in error.message


def test_overlap_under_a_fifth(good: Path, tmp_path: Path) -> None:
    for shift, is_enough in ((52.0, False), (30.0, True)):
        other = make_las(tmp_path / "edge.las", scattered(seed=2) + np.array([shift, 0, 0]))
        if is_enough:
            assert len(read_epochs(good, other).after) == 2000
        else:
            error = refused(good, other)
            assert error.code == "no-overlap" and "20 %" in error.message


def test_bounds_that_overlap_around_points_that_do_not(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    corner, frame = rng.uniform(0, 30, (2000, 3)), rng.uniform(0, 60, (4000, 3))
    frame = frame[np.any(frame[:, :2] > 40, axis=1)]
    paths = [make_las(tmp_path / f"{i}.las", CORNER + xyz) for i, xyz in enumerate((corner, frame))]
    error = refused(*paths)
    assert error.code == "no-overlap" and "share 0 %" in error.message


def test_memory_is_estimated_before_reading(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*args: Any) -> None:
        pytest.fail("points were read although the memory does not suffice")

    monkeypatch.setattr("loda_pdal.io.las_points.LasFile.records", never)
    with pytest.raises(MemoryLimitError) as caught:
        read_epochs(good, good, max_memory=10_000)
    assert caught.value.code == "memory-limit"
    assert "--max-memory" in explain(caught.value) and "tiles" in caught.value.remedy


def test_memory_estimate_grows_with_points_and_is_bounded_by_area() -> None:
    assert estimate_memory(2_000_000, 1_000_000) == estimate_memory(1_000_000, 2_000_000)
    nothing, one, two = (estimate_memory(n, n) for n in (0, 1_000_000, 2_000_000))
    assert two - nothing == 2 * (one - nothing)
    dense, sparse = (estimate_memory(10**8, 10**8, area_m2=14_400.0, leaf_m=leaf) for leaf in (0.25, 0.5))
    assert estimate_memory(10**8, 10**8) > dense > sparse
    # four times the edge squared: the voxel part falls to a quarter
    points_only = estimate_memory(10**8, 10**8, area_m2=0.0)
    assert (dense - points_only) == pytest.approx(4 * (sparse - points_only))


def test_memory_that_is_free_is_enough_for_little_and_not_for_everything() -> None:
    free = available_memory()
    assert free is not None and free > 50e6
    check_memory(1_000)
    with pytest.raises(MemoryLimitError, match="are free"):
        check_memory(10**15)
    check_memory(10**15, max_memory=10**16)
