"""COPC: every point once with all its dimensions, in an octree that another reader finds its way in."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
from io_samples import CORNER, UTM, make_las, scattered

from loda_pdal.io.copc import CELLS_PER_NODE, LARGEST_LEAF, write_copc
from loda_pdal.model.errors import OutputError

N = 60_000


@pytest.fixture(scope="module")
def clouds(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A LAZ file and the COPC file made of it."""
    folder = tmp_path_factory.mktemp("copc")
    source = make_las(
        folder / "changes.laz",
        scattered(N, seed=3),
        fields={"gps_time": np.linspace(5.0, 9.0, N), "classification": np.arange(N) % 70},
        extra={"ObjectId": np.arange(N, dtype=np.uint32), "ChangeClass": (np.arange(N) % 6).astype(np.uint8)},
    )
    write_copc(source, folder / "changes.copc.laz")
    return source, folder / "changes.copc.laz"


def test_every_point_is_there_once_with_all_it_had(clouds: tuple[Path, Path]) -> None:
    source, copc = (laspy.read(path) for path in clouds)
    by_number = np.argsort(copc["ObjectId"])
    assert np.array_equal(copc.points.array[by_number], source.points.array)


def test_the_header_says_the_same(clouds: tuple[Path, Path]) -> None:
    source, copc = (laspy.read(path).header for path in clouds)
    assert copc.parse_crs().to_epsg() == UTM
    assert np.array_equal(copc.scales, source.scales) and np.array_equal(copc.offsets, source.offsets)
    assert np.array_equal(copc.mins, source.mins) and np.array_equal(copc.maxs, source.maxs)
    assert list(copc.point_format.extra_dimension_names) == ["ObjectId", "ChangeClass"]


def test_a_copc_reader_finds_what_lies_in_a_box(clouds: tuple[Path, Path]) -> None:
    every = laspy.read(clouds[0])
    low, high = CORNER[:2] + 10.0, CORNER[:2] + 25.0
    xy = np.column_stack([every.x, every.y])
    is_inside = np.all((xy >= low) & (xy <= high), axis=1)
    with laspy.CopcReader.open(clouds[1]) as reader:
        found = reader.query(bounds=laspy.copc.Bounds(low, high))
    assert np.array_equal(np.sort(found["ObjectId"]), np.sort(every["ObjectId"][is_inside]))


def test_levels_refine_and_leaves_are_small(clouds: tuple[Path, Path]) -> None:
    with laspy.CopcReader.open(clouds[1]) as reader:
        info, entries = reader.copc_info, reader.root_page.entries
        coarse = reader.query(level=0)
    assert (info.gps_min, info.gps_max) == (5.0, 9.0)
    deepest = max(key.level for key in entries)
    assert deepest >= 1
    assert all(entry.point_count <= LARGEST_LEAF for key, entry in entries.items() if key.level == deepest)
    assert sum(entry.point_count for entry in entries.values()) == N
    for key in entries:  # no node without its parent
        assert key.level == 0 or any(child == key for parent in entries for child in parent.childs())
    cells = np.floor((np.column_stack([coarse.x, coarse.y, coarse.z]) - (info.center - info.halfsize)) / info.spacing)
    assert len(np.unique(cells, axis=0)) == len(coarse)
    assert info.spacing == pytest.approx(2 * info.halfsize / CELLS_PER_NODE)


def test_writing_twice_gives_the_same_file(clouds: tuple[Path, Path], tmp_path: Path) -> None:
    write_copc(clouds[0], tmp_path / "again.copc.laz")
    assert (tmp_path / "again.copc.laz").read_bytes() == clouds[1].read_bytes()


@pytest.mark.parametrize("n", [0, 1])
def test_hardly_any_points(tmp_path: Path, n: int) -> None:
    write_copc(make_las(tmp_path / "few.laz", scattered(n)), tmp_path / "few.copc.laz")
    assert len(laspy.read(tmp_path / "few.copc.laz")) == n


def test_points_in_one_place_end_at_the_deepest_level(tmp_path: Path) -> None:
    xyz = np.repeat(CORNER[None], LARGEST_LEAF + 50, axis=0)
    write_copc(make_las(tmp_path / "pile.laz", xyz), tmp_path / "pile.copc.laz")
    assert len(laspy.read(tmp_path / "pile.copc.laz")) == len(xyz)


def test_other_point_formats_are_refused(tmp_path: Path) -> None:
    old = make_las(tmp_path / "old.las", point_format=3, version="1.2")
    with pytest.raises(OutputError, match="point format 3"):
        write_copc(old, tmp_path / "old.copc.laz")
