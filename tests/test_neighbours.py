"""Cell lists against brute force, and the threads that run them."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import numpy as np
import pytest

import loda_pdal.kernels
from loda_pdal.kernels import cells, neighbours, parallel
from loda_pdal.kernels.blocks import MOST_IN_BLOCK
from loda_pdal.kernels.cells import CellList, build_cells, extent, middle_of, to_cell_frame
from loda_pdal.kernels.neighbours import k_nearest, knn, mean_distances, nearest
from loda_pdal.kernels.parallel import run_ranges, set_threads, thread_count


def cloud(seed: int = 0, n: int = 400) -> np.ndarray:
    """Points with exact ties, duplicates, a far straggler, and UTM-like coordinates."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(0, 10, (n, 3))
    xyz[:80] = np.round(xyz[:80])
    xyz[80:90] = xyz[90:100]
    xyz[-1] = [300, -200, 60]
    return xyz + np.array([390_000.0, 6_460_000.0, 20.0])


def sq_distances(xyz: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """All squared distances (q, n) of the coordinates as the kernels see them: float32 about the middle."""
    centre = middle_of(xyz)
    a, b = ((p - centre).astype(np.float32).astype(np.float64) for p in (queries, xyz))
    d = a[:, None] - b[None]
    return d[..., 0] ** 2 + d[..., 1] ** 2 + d[..., 2] ** 2


def slow_knn(sq: np.ndarray, k: int, max_distance: float, skips_self: bool) -> tuple[np.ndarray, np.ndarray]:
    idx = np.full((len(sq), k), -1)
    distance = np.full((len(sq), k), np.inf)
    for q, row in enumerate(sq):
        order = [i for i in np.lexsort((np.arange(len(row)), row)) if row[i] <= max_distance**2]
        order = [i for i in order if not (skips_self and i == q)][:k]
        idx[q, : len(order)], distance[q, : len(order)] = order, np.sqrt(row[order])
    return idx, distance


def slow_cells(xyz: np.ndarray, cell_m: float) -> CellList:
    """A cell list from its definition."""
    centre = middle_of(xyz)
    local = (xyz - centre).astype(np.float32)
    low, high = local.min(axis=0).astype(np.float64), local.max(axis=0).astype(np.float64)
    x, y = np.floor((local[:, :2] - low[:2]) / cell_m).astype(int).T
    order = np.lexsort((local[:, 2], y, x))
    columns, column_start = np.unique(np.column_stack([x, y])[order], axis=0, return_index=True)
    row_start = np.searchsorted(columns[:, 0], np.arange(x.max() + 2))
    column_start = np.append(column_start, len(xyz))
    return CellList(local[order], order, row_start, columns[:, 1], column_start, low, high, cell_m, centre)


@pytest.mark.parametrize("cell_m", [0.1, 0.7, 3.0, 1000.0])
def test_cell_list_equals_its_definition(cell_m: float) -> None:
    xyz = cloud(5, 3000) - [390_000.0, 6_460_000.0, 20.0]
    xyz[:2] = [[-400.0] * 3, [400.0] * 3]
    xyz[200:260, 2] = np.where(np.arange(60) % 2, 0.0, -0.0)  # zeros of both signs are a tie
    found = build_cells(xyz, cell_m)
    for field, expected in slow_cells(xyz, cell_m)._asdict().items():
        assert np.array_equal(getattr(found, field), expected), field
    assert {found.idx.dtype, found.row_start.dtype, found.column_y.dtype, found.column_start.dtype} == {np.dtype("i4")}


def test_extent_and_middle() -> None:
    xyz = np.array([[1.0, -2.0, 3.0], [4.0, 0.5, -6.5]], dtype=np.float32)
    low, high = extent(xyz)
    assert (low.tolist(), high.tolist()) == ([1.0, -2.0, -6.5], [4.0, 0.5, 3.0])
    assert low.dtype == high.dtype == np.float64
    assert middle_of(xyz).tolist() == [2.0, -1.0, -2.0]
    assert middle_of(np.zeros((0, 3))).tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("k", "max_distance", "includes_self"),
    [(1, np.inf, True), (5, np.inf, False), (20, 1.5, True), (20, 1.0, False), (500, np.inf, True)],
)
def test_knn_equals_brute_force(k: int, max_distance: float, includes_self: bool) -> None:
    xyz = cloud()
    found = knn(xyz, k, max_distance, includes_self=includes_self)
    idx, distance = slow_knn(sq_distances(xyz, xyz), k, max_distance, not includes_self)
    assert np.array_equal(found.idx, idx)
    assert np.allclose(found.distance, distance, rtol=1e-6)


@pytest.mark.parametrize("includes_self", [True, False])
def test_knn_in_a_crowd_and_far_from_it(includes_self: bool) -> None:
    rng = np.random.default_rng(3)
    crowd = rng.normal(0, 0.1, (3000, 3))
    crowd[: MOST_IN_BLOCK + 90] = 0.05  # more in one place than a block holds
    xyz = np.vstack([crowd, rng.uniform(20, 90, (20, 3))])
    found = knn(xyz, 6, includes_self=includes_self)
    idx, _ = slow_knn(sq_distances(xyz, xyz), 6, np.inf, not includes_self)
    assert np.array_equal(found.idx, idx)


def test_one_query_at_a_time_finds_the_same() -> None:
    xyz = cloud(4)
    found, asked = knn(xyz, 5, 2.0), build_cells(xyz, 0.8)
    best_sq, best_idx, guess = np.empty(5), np.empty(5, dtype=np.int32), asked.cell_m
    for i, (x, y, z) in enumerate(to_cell_frame(asked, xyz)[::9]):
        n, guess = k_nearest(asked, x, y, z, guess, 2.0, -1, best_sq, best_idx)
        assert best_idx[:n].tolist() == [j for j in found.idx[9 * i] if j >= 0]
        assert np.sqrt(best_sq[:n]) == pytest.approx(found.distance[9 * i, :n], rel=1e-6)


@pytest.mark.parametrize("k", [1, 9, 399])
def test_mean_distances_equal_their_definition(k: int) -> None:
    xyz = cloud()
    _, distance = slow_knn(sq_distances(xyz, xyz), k, np.inf, True)
    assert mean_distances(xyz, k) == pytest.approx(distance.mean(axis=1), rel=1e-6)


def test_knn_of_other_queries_equals_brute_force() -> None:
    xyz, queries = cloud(), cloud(1, 150) + np.array([3.0, 0.5, -0.2])
    found = knn(xyz, 7, 4.0, queries)
    idx, _ = slow_knn(sq_distances(xyz, queries), 7, 4.0, False)
    assert np.array_equal(found.idx, idx)


def test_nearest_by_hand() -> None:
    xyz = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 3, 0]])
    idx, distance = nearest(xyz, np.array([[0.9, 0, 0], [0, 2.0, 0], [0, 0, 9.0]]), 2.0)
    assert idx.tolist() == [1, 3, -1]
    assert np.allclose(distance, [0.1, 1.0, np.inf])


def test_cell_size_does_not_change_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    xyz = cloud()
    expected = knn(xyz, 6)
    for cell_m in (0.05, 0.4, 30.0):
        monkeypatch.setattr(neighbours, "block_edge", lambda _xyz, _k, cell_m=cell_m: cell_m)
        found = knn(xyz, 6)
        assert np.array_equal(found.idx, expected.idx)


def test_memory_follows_the_points_and_not_the_extent() -> None:
    xyz = np.array([[0.0, 0, 0], [2e5, 0, 0], [2e5, 3e5, 0.0], [0.1, 0, 0]])
    found = build_cells(xyz, 0.25)
    assert found.row_start.size <= 2 * cells.MOST_CELLS_ALONG
    assert found.column_y.size <= 4
    assert nearest(xyz, xyz + np.array([0.0, 0.2, 0]), 1.0)[0].tolist() == [0, 1, 2, 3]


def test_empty_clouds_have_no_neighbours() -> None:
    none, some = np.zeros((0, 3)), np.ones((2, 3))
    assert knn(none, 3).idx.shape == (0, 3)
    assert nearest(none, some)[0].tolist() == [-1, -1]
    assert nearest(some, none)[0].size == 0


def test_threads_do_not_change_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    xyz = cloud(2, 5000)
    monkeypatch.setattr(parallel, "LARGEST_RANGE", 700)
    answers = []
    for n in (1, 3):
        set_threads(n)
        answers.append((*knn(xyz, 9), mean_distances(xyz, 5)))
    set_threads(None)
    for one, three in zip(*answers, strict=True):
        assert np.array_equal(one, three)


@pytest.mark.parametrize("n", [0, 1, 999, 10_000])
@pytest.mark.parametrize("threads", [1, 4])
def test_ranges_cover_the_index_once(n: int, threads: int) -> None:
    counts = np.zeros(n, dtype=int)

    def count(start: int, stop: int, out: np.ndarray) -> None:
        out[start:stop] += 1

    set_threads(threads)
    run_ranges(count, n, counts, min_size=10)
    set_threads(None)
    assert (counts == 1).all()


def test_an_error_in_a_range_comes_out_and_stops_the_rest() -> None:
    calls = []
    lock = threading.Lock()

    def fail(start: int, stop: int) -> None:
        with lock:
            calls.append(start)
        raise RuntimeError(f"range {start}")

    set_threads(2)
    with pytest.raises(RuntimeError, match="range"):
        run_ranges(fail, 100 * parallel.LARGEST_RANGE)
    set_threads(None)
    assert len(calls) < 100


def test_thread_count_follows_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LODA_THREADS", "3")
    assert thread_count() == 3
    monkeypatch.setenv("LODA_THREADS", "many")
    assert thread_count() >= 1
    with pytest.raises(ValueError, match="at least 1"):
        set_threads(0)


def test_kernels_are_cached_where_the_user_may_write(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert loda_pdal.kernels._writable_folder() == tmp_path / "loda-pdal" / "numba"
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    folder = loda_pdal.kernels._writable_folder()
    assert folder.parent == tmp_path
    assert os.access(folder, os.W_OK)
    if os.name != "nt":
        folder.chmod(0o777)  # others could plant code there
        assert loda_pdal.kernels._writable_folder() != folder
