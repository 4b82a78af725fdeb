"""Voxels, their owners and the tops of their columns against loops that anyone can follow."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest

from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.pair import Pair
from loda_pdal.params import ChangeParams, ObservabilityParams
from loda_pdal.stages.cues import Surface, Voxels, cells_with_owners, sample_voxels, weigh
from loda_pdal.stages.observability import Coverage, coverage

N_OBJECTS = 7
PARAMS = ChangeParams(min_expected_points=0.0)
NO_LIMITS = LodGrid(
    np.zeros((0, 3), np.int32), 1.0, np.zeros(0, np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.int32),
    np.zeros(0, np.int32), np.zeros(0, np.bool_), np.zeros(0, np.float32), 0.5,
)  # fmt: skip


def scattered(seed: int, n: int) -> Surface:
    """Points in a box of 5 m, so dense that several objects and ties meet in most voxels; a part has no object."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform((-2.0, -2.0, -2.0), (3.0, 3.0, 1.0), (n, 3))
    normals = np.tile(np.array([0, 0, 1], np.float32), (n, 1))
    owner = rng.integers(-1, N_OBJECTS, n).astype(np.int32)
    return Surface(xyz, normals, xyz[:, 2], rng.integers(1, 4, n).astype(np.int32), owner, owner >= 0)


def half_seen() -> Pair[Coverage]:
    """The before survey saw the west, the after survey the south."""
    west, south = np.array([[-1.5, -1.5, 0.0], [-1.5, 2.5, 0.0]]), np.array([[-1.5, -1.5, 0.0], [2.5, -1.5, 0.0]])
    return Pair(west, south).map(lambda xyz: coverage(xyz, ObservabilityParams()))


@pytest.fixture(params=[(300, 4000), (0, 500), (500, 0)], ids=["both", "after only", "before only"])
def surfaces(request: pytest.FixtureRequest) -> Pair[Surface]:
    return Pair(*(scattered(seed, n) for seed, n in enumerate(request.param)))


def voxel_of(point: np.ndarray) -> tuple[int, ...]:
    return tuple(np.floor(point / PARAMS.voxel_m).astype(int).tolist())


def slow_holders(side: Surface) -> dict[tuple[int, ...], int]:
    votes: dict[tuple[int, ...], dict[int, int]] = defaultdict(lambda: defaultdict(int))
    for point, owner, n_raw in zip(side.xyz, side.owner.tolist(), side.n_raw.tolist(), strict=True):
        if owner >= 0:
            votes[voxel_of(point)][owner] += n_raw
    return {voxel: max(sorted(of), key=of.__getitem__) for voxel, of in votes.items()}


def sampled(surfaces: Pair[Surface], seen: Pair[Coverage] | None = None) -> Voxels:
    return sample_voxels(surfaces, seen, NO_LIMITS, PARAMS)


def test_a_voxel_belongs_to_the_object_with_most_points_in_it(surfaces: Pair[Surface]) -> None:
    voxels = sampled(surfaces)
    rows = [tuple(row) for row in voxels.cell.tolist()]
    expected = surfaces.map(slow_holders)
    assert rows == sorted({*expected.before, *expected.after})
    cells = cells_with_owners(voxels, surfaces, N_OBJECTS, PARAMS)
    for found, slow in zip(cells.owner, expected, strict=True):
        assert found.tolist() == [slow.get(row, -1) for row in rows]
    holder, _ = voxels.holders(surfaces, N_OBJECTS)
    for side, found, slow in zip(surfaces, voxels.on_points(holder, surfaces), expected, strict=True):
        is_member = side.owner >= 0
        assert np.all(found[~is_member] == -1)
        assert found[is_member].tolist() == [slow[voxel_of(point)] for point in side.xyz[is_member]]


def test_new_owners_need_no_new_sampling(surfaces: Pair[Surface]) -> None:
    voxels = sampled(surfaces)
    other = surfaces.map(lambda side: side.owned_by(np.where(side.owner >= 0, (side.owner + 3) % 5, -1)))
    first, second = (cells_with_owners(of, other, N_OBJECTS, PARAMS) for of in (voxels, sampled(other)))
    for a, b in zip(first.owner, second.owner, strict=True):
        assert np.array_equal(a, b)
    assert np.array_equal(voxels.displacement, sampled(other).displacement, equal_nan=True)


def top_of_as_many(z: list[float], other: list[float]) -> float:
    """Mean rank of the highest of as many heights as ``other`` has, drawn from those of ``z``; the highest of fewer."""
    rank = (len(z) + 1) / (min(len(z), len(other)) + 1) - 1
    return float(np.interp(rank, range(len(z)), sorted(z, reverse=True)))


@pytest.mark.parametrize("seen", [None, half_seen()], ids=["all seen", "half seen"])
def test_tops_and_rise_of_the_columns_as_a_loop_finds_them(
    surfaces: Pair[Surface], seen: Pair[Coverage] | None
) -> None:
    voxels = sampled(surfaces, seen)
    cells = cells_with_owners(voxels, surfaces, N_OBJECTS, PARAMS)
    evidence = weigh(cells, surfaces, N_OBJECTS, PARAMS)

    tops: Pair[dict[tuple[int, ...], list[float]]] = Pair({}, {})
    others = seen.swapped if seen else Pair(None, None)
    for side, other, top in zip(surfaces, others, tops, strict=True):
        is_open = other.at(side.xyz) if other else np.ones(len(side.xyz), bool)
        for point, owner in zip(side.xyz[is_open], side.owner[is_open].tolist(), strict=True):
            if owner >= 0:
                top.setdefault((owner, *voxel_of(point)[:2]), []).append(point[2])
    heights = Pair({}, {})
    for side, height in zip(cells.owner, heights, strict=True):
        for cell, owner in zip(voxels.cell, side.tolist(), strict=True):
            height.setdefault((owner, *cell[:2].tolist()), []).append((cell[2] + 0.5) * PARAMS.voxel_m)

    for o in range(N_OBJECTS):
        summit = [np.quantile(z, 0.95) if (z := [max(v) for c, v in t.items() if c[0] == o]) else np.nan for t in tops]
        assert evidence.dh[o] == pytest.approx(summit[1] - summit[0], nan_ok=True)
        shared = [c for c in tops.before if c[0] == o and c in tops.after]
        rise = [
            top_of_as_many(tops.after[c], tops.before[c]) - top_of_as_many(tops.before[c], tops.after[c])
            for c in shared
        ]
        assert evidence.column_rise[o] == pytest.approx(np.median(rise) if len(rise) >= 8 else np.nan, nan_ok=True)
        scatter = np.quantile(rise, 0.75) - np.quantile(rise, 0.25) if len(rise) >= 8 else np.nan
        few = max(np.sqrt(25 / len(rise)), 1.0) if rise else 1.0
        assert evidence.column_scatter[o] == pytest.approx(scatter * few, nan_ok=True)
        shared = [c for c in heights.before if c[0] == o and c in heights.after]
        mean = [np.mean([z for c in shared for z in height[c]]) if shared else np.nan for height in heights]
        assert evidence.rise[o] == pytest.approx(mean[1] - mean[0], nan_ok=True)


def test_a_sparse_wall_that_rose_is_gained_though_no_voxel_of_it_has_many_points() -> None:
    """A wall of two points to the voxel, 4 m and then 6 m high, and one new voxel of two points far from it."""

    def wall(n_high: int, more: list[list[float]]) -> Surface:
        i, k = np.meshgrid(np.arange(12), np.arange(n_high), indexing="ij")
        centre = np.column_stack([0.5 * i.ravel() + 0.25, np.full(i.size, 0.25), 0.5 * k.ravel() + 0.25])
        xyz = np.concatenate([centre, np.array(more, dtype=np.float64).reshape(-1, 3)])
        normals = np.tile(np.array([0, 1, 0], np.float32), (len(xyz), 1))
        owner = np.zeros(len(xyz), np.int32)
        return Surface(xyz, normals, xyz[:, 2], np.full(len(xyz), 2, np.int32), owner, owner >= 0)

    lone = [10.25, 0.25, 3.25]
    surfaces = Pair(wall(8, []), wall(12, [lone]))
    for least, expected in ((0.0, 12 * 3 + 1), (6.0, 12 * 3), (12.0, 0)):
        params = ChangeParams(min_expected_points=least)
        voxels = sample_voxels(surfaces, None, NO_LIMITS, params)
        cells = cells_with_owners(voxels, surfaces, 1, params)
        # the lowest row of the new voxels is within reach of the old wall's top
        assert np.count_nonzero(cells.is_gained) == expected
        assert not cells.is_lost.any()
