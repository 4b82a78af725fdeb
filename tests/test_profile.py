"""What a run costs: the arithmetic of the table, and one real run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from loda_pdal.benchmark.commands import bench
from loda_pdal.benchmark.profile import BREAKDOWN, BlockProfile, Profile, Run, prepared_block, run_detect, slope_of
from loda_pdal.benchmark.simulate import SimulationOptions, simulate_block, write_block
from loda_pdal.model.errors import InputError
from loda_pdal.pipeline import STEPS

MACHINE = {
    "cpu": "a processor",
    "processors": 2,
    "memory_gb": 24.0,
    "system": "a system",
    "python": "3",
    "numba": "0",
    "numpy": "2",
    "loda_pdal": "0",
    "options": "detect",
    "load_before": 0.1,
    "load_after": 1.9,
}


def run_of(seconds: float, peak_gb: float) -> Run:
    return Run(dict.fromkeys(BREAKDOWN, seconds / len(BREAKDOWN)), seconds, seconds * 1.5, peak_gb, 100)


def profile_of(power: float, load: float = 0.1) -> Profile:
    """Blocks whose time grows with that power of the points, and memory by 0.5 GB a million; one run of each is off."""
    blocks = []
    for million in (0.4, 0.8, 1.6, 3.2):
        usual = run_of(10 * million**power, 0.3 + 0.5 * million)
        blocks.append(BlockProfile(f"{million}M", int(million * 1e6), [run_of(500.0, 9.0), usual, usual]))
    return Profile(blocks, {**MACHINE, "load_before": load})


def test_every_step_has_its_part() -> None:
    assert sorted(step for steps in BREAKDOWN.values() for step in steps) == sorted(STEPS)


@pytest.mark.parametrize("power", [1.0, 1.1, 2.0])
def test_growth_is_that_of_the_medians(power: float) -> None:
    found = profile_of(power)
    assert found.exponent == pytest.approx(power)
    assert found.gb_per_million == pytest.approx(0.5)


def test_one_block_has_no_growth() -> None:
    assert slope_of([1.0], [2.0]) is None
    alone = Profile(profile_of(1.0).blocks[:1], MACHINE)
    assert alone.exponent is None and "grows" not in alone.to_markdown()


def test_the_table_says_what_was_measured_and_where() -> None:
    text = profile_of(1.1).to_markdown()
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert len(rows) == 2 + 4 and "| 1.60 | 100 | 2.8/2.8/2.8/2.8 | 2.8, 2.8 | 16.8 | 25.2 | 1.10 |" in rows[4]
    assert "points^1.10" in text and "a processor, 2 processors" in text
    assert "busy" not in text and "busy" in profile_of(1.1, load=3.0).to_markdown()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, compiled_kernels: None) -> Path:
    """With a block that is there already, under the name of one of 0.1 million points."""
    folder = tmp_path_factory.mktemp("profile")
    write_block(simulate_block(3, SimulationOptions(length_m=30.0, density=0.2)), folder / "seed40_0.1M")
    return folder


def test_profile_runs_detect_on_the_blocks_that_are_there(folder: Path) -> None:
    done = CliRunner().invoke(bench, ["profile", str(folder), "--points", "0.1", "--repeats", "1", "--threads", "1"])
    assert done.exit_code == 0, done.output
    assert (folder / "profile.md").read_text().strip() in done.output
    saved = json.loads((folder / "profile.json").read_text())
    run = saved["blocks"][0]["runs"][0]
    assert set(run["parts"]) == set(BREAKDOWN) and sum(run["parts"].values()) == pytest.approx(run["total_s"])
    assert all(seconds > 0 for seconds in run["parts"].values())
    assert 0.1 < run["peak_gb"] < 4 and run["cpu_s"] > 0.5 and run["instances"] > 10
    assert saved["machine"]["options"] == "detect --preset street --threads 1"


def test_a_failed_run_is_an_error(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="detect failed"):
        run_detect(folder / "nowhere", tmp_path / "out")


def test_missing_blocks_are_simulated(tmp_path: Path) -> None:
    said: list[str] = []
    block = prepared_block(tmp_path, 0.1, seed=3, say=said.append)
    assert block.name == "seed3_0.1M" and said == ["seed3_0.1M: simulating 44 m of street"]
    assert json.loads((block / "truth.json").read_text())["made_by"]["leaf_m"] == 0.25
    before = (block / "before.laz").stat().st_mtime_ns
    assert prepared_block(tmp_path, 0.1, seed=3, say=said.append) == block and len(said) == 1
    assert (block / "before.laz").stat().st_mtime_ns == before
