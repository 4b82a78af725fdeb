"""Surveys from the air are told from surveys by vehicle, by how evenly their points cover the plan."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from loda_pdal.benchmark.simulate import SimulationOptions, simulate_block
from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.pair import Pair
from loda_pdal.model.survey import Survey
from loda_pdal.preset_choice import CLEARLY_ABOVE, CLEARLY_BELOW, LIMIT, doubts_about, preset_for

DATA = Path(__file__).resolve().parent.parent.parent / "shared" / "data"


def from_the_air(n: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform(0.0, (60.0, 60.0, 8.0), (n, 3))


def from_a_vehicle(n: int, seed: int = 0) -> FloatArray:
    """Distances from a straight path along x that thin out as 1 / r, as returns on the ground do."""
    rng = np.random.default_rng(seed)
    across = 30.0 * rng.uniform(0.0, 1.0, n) ** 4 * rng.choice((-1.0, 1.0), n)
    return np.column_stack([rng.uniform(0.0, 60.0, n), 30.0 + across, np.zeros(n)])


def chosen(before: FloatArray, after: FloatArray) -> tuple[str, bool, bool]:
    found = preset_for(Pair(Survey(before), Survey(after)))
    return found.name, found.is_clear, found.is_mixed


def test_an_even_cloud_has_a_quarter_of_its_points_in_a_quarter_of_the_plan() -> None:
    grid = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0)), axis=-1).reshape(-1, 2)
    cells = np.repeat(grid * 2.5 + 1.0, 3, axis=0)
    assert Survey(np.column_stack([cells, np.zeros(len(cells))])).extent.dense_share == 0.25
    one = np.vstack([np.tile([1.0, 1.0, 0.0], (97, 1)), [[4.0, 1, 0], [6.0, 1, 0], [9.0, 1, 0]]])
    assert Survey(one).extent.dense_share == 0.97


def test_surveys_of_one_kind_are_clear() -> None:
    assert chosen(from_the_air(40000), from_the_air(9000, 1)) == ("aerial", True, False)
    assert chosen(from_a_vehicle(40000), from_a_vehicle(9000, 1)) == ("street", True, False)


def test_of_a_mixed_pair_the_sparser_one_decides() -> None:
    assert chosen(from_the_air(5000), from_a_vehicle(400_000)) == ("aerial", False, True)
    assert chosen(from_a_vehicle(400_000), from_the_air(5000)) == ("aerial", False, True)
    assert chosen(from_the_air(100_000), from_a_vehicle(8000)) == ("street", False, True)


def test_what_is_too_small_to_tell_is_a_street() -> None:
    few = from_the_air(300) * (0.1, 0.1, 1.0)
    assert chosen(few, few) == ("street", False, False)
    assert chosen(np.zeros((0, 3)), np.zeros((0, 3))) == ("street", False, False)
    assert chosen(few, from_the_air(9000)) == ("aerial", False, False)


def test_only_clear_cases_raise_a_doubt() -> None:
    air = Pair(Survey(from_the_air(9000)), Survey(from_the_air(9000, 1)))
    street = Pair(Survey(from_a_vehicle(9000)), Survey(from_a_vehicle(9000, 1)))
    assert [doubts_about(name, air) != [] for name in ("street", "aerial", "paper")] == [True, False, False]
    assert [doubts_about(name, street) != [] for name in ("street", "aerial", "paper")] == [False, True, False]
    assert "look like airborne surveys" in doubts_about("street", air)[0]
    mixed = Pair(Survey(from_the_air(5000)), Survey(from_a_vehicle(400_000)))
    assert "One survey looks airborne" in doubts_about("aerial", mixed)[0]
    few = Survey(from_the_air(300) * (0.1, 0.1, 1.0))
    assert doubts_about("street", Pair(few, few)) == []


@pytest.mark.parametrize("sensor", ["vehicle", "airborne"])
def test_simulated_surveys_are_told(sensor: str) -> None:
    block = simulate_block(3, SimulationOptions(sensor=sensor, length_m=60.0, density=0.3))
    shares = [Survey(survey.xyz - block.surveys.after.xyz.min(axis=0)).extent.dense_share for survey in block.surveys]
    assert min(shares) > CLEARLY_ABOVE if sensor == "vehicle" else max(shares) < CLEARLY_BELOW


@pytest.mark.parametrize(
    ("name", "is_airborne"),
    [
        ("ahn_tiles/3dfier_ahn3_cropped_2.laz", True),
        ("ahn_tiles/ams_ahn4_2496_9727.laz", True),
        ("ahn_tiles/laserchicken_AHN3.laz", True),
        ("ign_lidarhd/ctview_classee_77050_627755.las", True),
        ("ign_lidarhd/myria3d_870000_6618000.las", True),
        ("toronto_ttp_als_2015_2019/TTP_2015.laz", True),
        ("amsterdam_mls_2epoch/run1_2386_9702.laz", False),
        ("amsterdam_mls_2epoch/run2_2386_9702.laz", False),
        ("amsterdam_mls_ground/in_2293_9698.laz", False),
    ],
)
def test_real_surveys_are_told(name: str, is_airborne: bool) -> None:
    import laspy

    if not (DATA / name).is_file():
        pytest.skip("no shared data")
    cloud = laspy.read(DATA / name)
    xyz = np.column_stack([cloud.x, cloud.y, cloud.z])
    assert (Survey(xyz - xyz.min(axis=0)).extent.dense_share < LIMIT) is is_airborne
