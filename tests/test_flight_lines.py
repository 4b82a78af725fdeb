"""Real flight lines of one hour as two surveys: nothing that is built or grows changed (METHOD 2)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.flight_lines import split
from loda_pdal import detect_changes, read_epochs
from loda_pdal.model.cloud import FloatArray, IntArray
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.pair import Pair
from loda_pdal.params import Parameters
from loda_pdal.stages.cues import Surface, sample_voxels
from loda_pdal.stages.observability import coverage

AERIAL = Parameters.preset("aerial")

NO_LIMITS = LodGrid(
    np.zeros((0, 3), np.int32), 1.0, np.zeros(0, np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.int32),
    np.zeros(0, np.int32), np.zeros(0, np.bool_), np.zeros(0, np.float32), 0.5,
)  # fmt: skip

TILES = {
    "ahn3": ("ahn_tiles/ams_ahn_2397_9705.laz", Pair([56028], [56027, 56029])),
    "ahn4": ("ahn_tiles/ams_ahn4_2496_9727.laz", Pair([115], [116])),
    "a street of four lines": ("amsterdam_mls_2epoch/ahn_2386_9702.laz", Pair([56029], [56030, 56031])),
}
"""Tiles of 52 m, by the point source ids of either survey; the second was flown from the other side of 15 m walls."""


@pytest.mark.data
@pytest.mark.parametrize("name", TILES)
def test_what_stands_between_two_flight_lines_has_not_changed(name: str, data_dir: Path, tmp_path: Path) -> None:
    file, lines = TILES[name]
    area = split(data_dir / file, tmp_path, lines)
    assert area > 2500.0
    surveys = read_epochs(tmp_path / "before.laz", tmp_path / "after.laz", epsg=7415)
    result = detect_changes(*surveys, AERIAL)
    told = [o for o in result.objects if o.label not in (ChangeLabel.UNCHANGED, ChangeLabel.UNDETERMINED)]
    assert [o.reason for o in told if o.object_class != ObjectClass.MOBILE] == []
    assert len(told) <= 1
    assert sum(o.label == ChangeLabel.UNCHANGED for o in result.objects) > 50


def test_from_the_air_a_place_is_seen_by_what_is_measured_beneath_it() -> None:
    """A house with its roof at 6 m, a shadow of 5 m beside it, and a survey that met its wall and a car there."""
    grid = np.mgrid[-9.75:20:0.5, 0.25:10:0.5].reshape(2, -1).T
    roof = grid[(grid[:, 0] > 0) & (grid[:, 0] < 10)]
    house = np.concatenate([np.column_stack([roof, np.full(len(roof), z)]) for z in np.arange(6.2, 0.0, -0.5)])
    bare = grid[(grid[:, 0] < 0) | (grid[:, 0] > 15)]
    ground = np.column_stack([bare, np.full(len(bare), 0.2)])
    things = np.array([[10.5, 5.5, 1.5], [13.5, 5.5, 1.5], [17.5, 5.5, 1.5], [-3.5, 5.5, 1.5], [5.5, 5.5, 8.5]])
    n_raw = np.concatenate([np.where(house[:, 2] > 6.0, 3, 0), np.full(len(ground), 3)]).astype(np.int32)
    other = _surface(np.concatenate([house, ground]), n_raw, np.full(len(n_raw), -1))
    own = _surface(things, np.full(5, 9), np.zeros(5))
    surfaces = Pair(other, own)
    covered = surfaces.map(lambda side: coverage(side.xyz, AERIAL.observability))
    voxels = sample_voxels(surfaces, covered, NO_LIMITS, AERIAL.changes)
    assert voxels.centre.tolist() == sorted(things.tolist())
    is_seen = dict(zip(map(tuple, voxels.centre.tolist()), voxels.is_covered.before.tolist(), strict=True))
    assert [is_seen[tuple(thing)] for thing in things.tolist()] == [False, False, True, True, True]


def _surface(xyz: FloatArray, n_raw: IntArray, owner: IntArray) -> Surface:
    normals = np.tile(np.array([0, 0, 1], np.float32), (len(xyz), 1))
    whose = np.asarray(owner, dtype=np.int32)
    return Surface(xyz, normals, xyz[:, 2].copy(), np.asarray(n_raw, dtype=np.int32), whose, xyz[:, 2] > 0.5)
