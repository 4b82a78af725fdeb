"""Changed ground: planted fill is found with its figures, what is too small or not a change is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.pair import Pair
from loda_pdal.params import GroundChangeParams, Parameters
from loda_pdal.stages.ground_changes import GroundChanges, ground_changes
from loda_pdal.stages.lod import level_of_detection

PARAMS = Parameters()
POSE = np.diag([0.005**2] * 3 + [1e-4**2] * 3)


def _ground(seed: int, slope: float = 0.02, spacing_m: float = 0.25) -> FloatArray:
    """A 40 m square of sloping ground with 1 cm of noise."""
    rng = np.random.default_rng(seed)
    axis = np.arange(0.0, 40.0, spacing_m)
    xy = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    xy = xy + rng.uniform(0.0, spacing_m, xy.shape)
    return np.column_stack([xy, slope * xy[:, 0] + rng.normal(0, 0.01, len(xy))])


def _raised(xyz: FloatArray, low: tuple[float, float], high: tuple[float, float], dz: float) -> FloatArray:
    is_in = np.all((xyz[:, :2] >= low) & (xyz[:, :2] < high), axis=1)
    return xyz + np.column_stack([np.zeros((len(xyz), 2)), np.where(is_in, dz, 0.0)])


def _changes(clouds: Pair[FloatArray], params: GroundChangeParams = PARAMS.ground_changes) -> GroundChanges:
    lod = level_of_detection(clouds.before, clouds.after, POSE, np.array([20.0, 20.0, 0.0]), PARAMS.lod)
    return ground_changes(clouds, clouds.map(lambda xyz: np.ones(len(xyz), np.bool_)), lod, params)


@pytest.mark.parametrize("dz", [0.3, -0.3])
def test_fill_of_40_m2_is_found_with_its_figures(dz: float) -> None:
    found = _changes(Pair(_ground(1), _raised(_ground(2), (10.0, 10.0), (18.0, 15.0), dz)))
    (region,) = found.regions
    assert region.label == (ChangeLabel.INCREASED if dz > 0 else ChangeLabel.DECREASED)
    assert region.dz_m == pytest.approx(dz, abs=0.02)
    assert region.lod95_m < 0.05
    # 8 m x 5 m: two full rows of tiles; the third is half covered and may fall on either side.
    assert region.area_m2 in (32.0, 36.0, 40.0, 44.0, 48.0)
    assert region.volume_m3 == pytest.approx(dz * region.area_m2, rel=0.15)
    assert region.footprint.is_valid
    assert region.footprint.geom_type == "MultiPolygon"
    assert region.footprint.area == pytest.approx(region.area_m2)
    codes = found.label_at(np.array([[14.0, 12.0], [30.0, 30.0], [100.0, 100.0]]))
    np.testing.assert_array_equal(codes, [region.label, ChangeLabel.UNCHANGED, ChangeLabel.UNDETERMINED])
    assert codes.dtype == np.uint8


def test_fill_of_9_m2_is_too_small() -> None:
    found = _changes(Pair(_ground(1), _raised(_ground(2), (10.0, 10.0), (13.0, 13.0), 0.3)))
    assert found.regions == []
    assert set(found.label) == {ChangeLabel.UNCHANGED}


def test_a_single_tile_of_a_sparse_survey_is_no_region() -> None:
    before, after = _ground(1, spacing_m=1.0), _ground(2, spacing_m=1.0)
    params = replace(PARAMS.ground_changes, cell_m=8.0, min_dz_m=0.1)
    for width, n in ((8.0, 0), (16.0, 1)):
        raised = _raised(after, (16.0, 16.0), (16.0 + width, 24.0), 0.6)
        assert len(_changes(Pair(before, raised), params).regions) == n


def test_steep_slope_seen_in_different_places_is_no_change() -> None:
    before, after = _ground(1, slope=0.3), _ground(2, slope=0.3, spacing_m=0.4)
    before = before[(before[:, 0] % 2 < 1.2) | (before[:, 1] > 20)]  # the lower part of every tile only
    found = _changes(Pair(before, after))
    assert found.regions == []
    assert np.nanmax(np.abs(found.dz)) < 0.08


def test_kerb_with_a_small_misregistration_is_no_change() -> None:
    before, after = _ground(1), _ground(2)
    before[:, 2] += np.where(before[:, 0] > 21.0, 0.14, 0.0)
    after[:, 2] += np.where(after[:, 0] > 21.1, 0.14, 0.0)
    assert _changes(Pair(before, after)).regions == []


def test_rise_within_the_limit_of_detection_is_no_change() -> None:
    clouds = Pair(_ground(1), _raised(_ground(2), (10.0, 10.0), (20.0, 20.0), 0.3))
    lod = level_of_detection(*clouds, np.diag([0.2**2] * 3 + [0.0] * 3), np.zeros(3), PARAMS.lod)
    found = ground_changes(clouds, clouds.map(lambda xyz: np.ones(len(xyz), np.bool_)), lod, PARAMS.ground_changes)
    assert np.nanmin(found.lod95) > 0.35
    assert found.regions == []


def test_tiles_seen_once_and_points_that_are_not_ground_decide_nothing() -> None:
    before, after = _ground(1), _raised(_ground(2), (0.0, 0.0), (40.0, 40.0), 0.5)
    before = before[before[:, 0] < 20]
    clouds = Pair(before, after)
    lod = level_of_detection(*clouds, POSE, np.zeros(3), PARAMS.lod)
    is_ground = Pair(np.ones(len(before), np.bool_), after[:, 1] > 20)
    found = ground_changes(clouds, is_ground, lod, PARAMS.ground_changes)
    corners = np.array([[10.0, 30.0], [30.0, 30.0], [10.0, 10.0], [30.0, 10.0]])
    np.testing.assert_array_equal(
        found.label_at(corners),
        [ChangeLabel.INCREASED, ChangeLabel.UNDETERMINED, ChangeLabel.UNDETERMINED, ChangeLabel.UNDETERMINED],
    )
    assert np.isnan(found.dz[found.label == ChangeLabel.UNDETERMINED]).all()


def test_swapping_the_epochs_swaps_the_answer() -> None:
    after = _raised(_raised(_ground(2), (4.0, 4.0), (12.0, 12.0), 0.4), (24.0, 24.0), (32.0, 34.0), -0.25)
    clouds = Pair(_ground(1), after)
    there, back = _changes(clouds), _changes(clouds.swapped)
    assert len(there.regions) == 2
    np.testing.assert_array_equal(there.dz, -back.dz)
    np.testing.assert_array_equal(there.lod95, back.lod95)
    np.testing.assert_array_equal(there.region, back.region)
    assert [r.label.swapped for r in there.regions] == [r.label for r in back.regions]


def test_touching_rise_and_fall_are_two_regions() -> None:
    after = _raised(_raised(_ground(2), (10.0, 10.0), (16.0, 18.0), 0.4), (16.0, 10.0), (22.0, 18.0), -0.4)
    assert {r.label for r in _changes(Pair(_ground(1), after)).regions} == {
        ChangeLabel.INCREASED,
        ChangeLabel.DECREASED,
    }


def test_no_ground_at_all() -> None:
    nothing = np.zeros((0, 3))
    found = _changes(Pair(nothing, nothing))
    assert found.regions == []
    assert len(found.label) == 0
    np.testing.assert_array_equal(found.label_at(np.zeros((2, 2))), [0, 0])
    seen_once = _changes(Pair(nothing, _ground(1)))
    assert set(seen_once.label) == {ChangeLabel.UNDETERMINED}


def test_a_sparse_yard_has_limits_of_its_own() -> None:
    def sparse(seed: int, noise_m: float) -> FloatArray:
        xyz = _ground(seed, spacing_m=0.45)  # 14 points within a metre, 30 make a cell of the LoD grid
        return xyz + np.column_stack(
            [np.zeros((len(xyz), 2)), np.random.default_rng(seed).normal(0, noise_m, len(xyz))]
        )

    fill = (10.0, 10.0), (18.0, 18.0), 0.3
    found = _changes(Pair(sparse(1, 0.0), _raised(sparse(2, 0.0), *fill)))
    (region,) = found.regions
    assert region.dz_m == pytest.approx(0.3, abs=0.02)
    assert region.lod95_m < 0.05
    assert region.area_m2 == pytest.approx(64.0, abs=16.0)
    letter = replace(PARAMS.ground_changes, has_own_limit=False)
    assert _changes(Pair(sparse(1, 0.0), _raised(sparse(2, 0.0), *fill)), letter).regions == []
    rough = _changes(Pair(sparse(1, 0.4), sparse(2, 0.4)))  # grass to the knee
    assert rough.regions == []
    assert np.nanmedian(rough.lod95) > 0.15
