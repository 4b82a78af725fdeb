"""Agreement with the classes of labelled clouds, on one whose classes are known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from io_samples import CORNER, make_las

from loda_pdal.benchmark.commands import bench
from loda_pdal.benchmark.labelled import Agreement, compare_labels, labels_table
from loda_pdal.model.errors import InputError
from loda_pdal.params import Parameters


def test_agreement_by_hand() -> None:
    truth = np.array([1, 1, 1, 0, 0], dtype=bool)
    found = Agreement.of(truth, np.array([1, 1, 0, 1, 0], dtype=bool))
    assert found == Agreement(tp=2, fp=1, fn=1)
    assert (found.f1, found.precision, found.recall) == pytest.approx((2 / 3, 2 / 3, 2 / 3))
    nothing = Agreement.of(np.zeros(3, dtype=bool), np.ones(3, dtype=bool))
    assert (nothing.f1, nothing.precision, nothing.recall) == (None, None, None)


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Level ground with a flat-roofed house, a pond, and a crown; half of the ground under the house is missing."""
    random = np.random.default_rng(4)
    ground = np.column_stack([random.uniform(0, 60, (18000, 2)), random.normal(0, 0.02, 18000)])
    is_under = np.all((ground[:, :2] > 20) & (ground[:, :2] < 34), axis=1)
    ground = ground[~is_under]
    is_pond = np.all(ground[:, :2] < 8, axis=1)
    roof = np.column_stack([random.uniform(20, 34, (1500, 2)), random.normal(7.0, 0.02, 1500)])
    spread = random.normal(size=(1500, 3))
    crown = 3.0 * spread / np.linalg.norm(spread, axis=1, keepdims=True) * random.random((1500, 1)) ** (1 / 3)
    crown += [48.0, 46.0, 6.0]
    xyz = CORNER + np.concatenate([ground, roof, crown])
    codes = np.concatenate([np.where(is_pond, 9, 2), np.full(1500, 6), np.full(1500, 5)]).astype(np.uint8)
    return make_las(tmp_path_factory.mktemp("labelled") / "town.laz", xyz, fields={"classification": codes})


def test_a_plain_town_is_told_right(cloud: Path, compiled_kernels: None) -> None:
    found = compare_labels(cloud, Parameters.preset("aerial"))
    f1 = [found.ground_model.f1, found.ground.f1, found.building.f1, found.vegetation.f1]
    assert min(value or 0.0 for value in f1) > 0.97
    with_water = compare_labels(cloud, Parameters.preset("aerial"), left_out=())
    assert with_water.n_points > found.n_points
    assert with_water.ground.fp - found.ground.fp > 250  # water is no ground, though it lies level with it
    assert labels_table([found]).splitlines()[-1].startswith(f"| mean | {found.n_points} | ")


def test_the_command_answers_for_each_cloud(cloud: Path, compiled_kernels: None) -> None:
    done = CliRunner().invoke(bench, ["classes", str(cloud), str(cloud), "--json"], catch_exceptions=False)
    first, second = json.loads(done.stdout)
    assert first == second and first["name"] == "town" and first["building"]["f1"] > 0.97


def test_clouds_without_classes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no point of class 2"):
        compare_labels(make_las(tmp_path / "plain.laz"), Parameters())
