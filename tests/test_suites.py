"""Suites: which blocks they are, and running them again and again."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path

import pytest
from click.testing import CliRunner

from loda_pdal.benchmark import evaluate
from loda_pdal.benchmark.blocks import split_of_name
from loda_pdal.benchmark.commands import bench
from loda_pdal.benchmark.evaluate import interval, run_suite, sources_digest
from loda_pdal.benchmark.simulate import SimulationOptions
from loda_pdal.benchmark.suites import MODELS, SEEN, SIZES, SuiteBlock, pieces, split_of_made, split_of_piece, streets
from loda_pdal.benchmark.truth import Truth
from loda_pdal.model.errors import InputError
from loda_pdal.params import Parameters


@pytest.fixture
def models(tmp_path: Path) -> Path:
    """A folder in which every city model lies, though empty."""
    for name in MODELS:
        (tmp_path / name).touch()
    return tmp_path


@pytest.mark.parametrize("suite", list(SIZES))
@pytest.mark.parametrize("split", ["train", "validation", "test"])
def test_blocks_have_one_name_and_one_split(suite: str, split: str, models: Path) -> None:
    n_streets, n_pieces = SIZES[suite][split]
    found = [*streets(suite, split), *islice(pieces(suite, split, models), n_pieces)]
    again = [*streets(suite, split), *islice(pieces(suite, split, models), n_pieces)]
    assert found == again and len({b.name for b in found}) == len(found) == n_streets + n_pieces
    assert all(b.split == split and b.options.sensor == suite for b in found)
    for block in found[:n_streets]:
        assert split_of_name(f"seed {block.seed}") == split and not block.is_city


def test_test_cities_are_of_other_towns() -> None:
    splits = {m: {split_of_piece(m, suite, s) for suite in SIZES for s in range(501, 700)} for m in MODELS}
    assert [splits[m] for m in MODELS] == [{"train", "validation"}, {"train", "validation"}, {"test"}, {"test"}]
    seen = [split_of_piece("rotterdam_delfshaven_3-20.json", "airborne", seed) for seed in (501, 502, 503)]
    assert seen == ["train"] * 3 == ["train"] * len(SEEN)
    n_train = sum(split_of_piece("rotterdam_delfshaven_3-20.json", "vehicle", s) == "train" for s in range(1000, 2000))
    assert 820 < n_train < 890


def test_conditions_vary_within_their_bounds(models: Path) -> None:
    flights = [b.options for b in islice(pieces("airborne", "train", models), 40)]
    assert all(0.5 <= o.density <= 2 and 0.5 <= o.density_after <= 2 for o in flights)
    assert min(o.density for o in flights) < 0.6 and max(o.density_after for o in flights) > 1.7
    drives = [b.options for b in streets("vehicle", "train")]
    assert {len(o.lanes) for o in drives} == {1, 2} and len({o.noise_m for o in drives}) > 5


def test_models_must_be_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no delft\.city\.json"):
        pieces("airborne", "test", tmp_path)
    with pytest.raises(InputError, match="pieces of cities"):
        run_suite(tmp_path, "airborne", "train", Parameters())


@pytest.mark.parametrize("suite", ["vehicle", "airborne"])
@pytest.mark.parametrize("split", ["train", "validation", "test"])
def test_a_block_tells_its_split(suite: str, split: str, models: Path) -> None:
    for block in [*streets(suite, split), *islice(pieces(suite, split, models), 3)]:
        assert split_of_made({"seed": block.seed, "options": block.options.to_dict()}) == split


def test_sources_are_told_apart(tmp_path: Path) -> None:
    assert sources_digest("stages") == sources_digest("stages") != sources_digest("kernels")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, compiled_kernels: None) -> Path:
    return tmp_path_factory.mktemp("suite")


@pytest.fixture
def one_block(monkeypatch: pytest.MonkeyPatch) -> SuiteBlock:
    """A suite of one small street and of one piece of a city that has no room."""
    block = SuiteBlock("seed_3", "train", 3, SimulationOptions(length_m=30.0, density=0.2))
    monkeypatch.setattr(evaluate, "streets", lambda suite, split: [block])
    monkeypatch.setitem(SIZES["vehicle"], "train", (1, 0))
    return block


def test_a_suite_is_simulated_run_scored_and_taken_up_again(folder: Path, one_block: SuiteBlock) -> None:
    arguments = ["run", str(folder), "--suite", "vehicle", "--split", "train", "--json"]
    pages = ["--sheet", str(folder / "worst.png"), "--markdown", str(folder / "scores.md")]
    first = CliRunner().invoke(bench, [*arguments, *pages], catch_exceptions=False)
    assert first.exit_code == 0
    assert "seed_3: simulating" in first.stderr and "seed_3: running" in first.stderr
    found = json.loads(first.stdout)
    assert found["pooled"]["paper"]["n"] > 20 and found["pooled"]["paper"]["acc"] > 0.5
    assert found["pooled"]["classes"]["classes"]["ground"]["iou"] > 0.8
    assert (folder / "worst.png").read_bytes().startswith(b"\x89PNG")
    text = (folder / "scores.md").read_text()
    assert "# Suite vehicle, train split: 1 blocks, preset street\n" in text and "| seed_3 |" in text
    assert not list(folder.glob(".*"))

    again = CliRunner().invoke(bench, arguments)
    assert "simulating" not in again.stderr and "running" not in again.stderr
    repeated = json.loads(again.stdout)
    assert repeated["blocks"]["seed_3"].pop("seconds") is None and found["blocks"]["seed_3"].pop("seconds") > 0
    assert repeated == found

    other = CliRunner().invoke(bench, [*arguments[:-1], "--set", "changes.use_lod=false"])
    assert "simulating" not in other.stderr and "running" in other.stderr
    assert "preset street changes.use_lod=false" in other.stdout


def test_the_same_blocks_can_be_plain(folder: Path, one_block: SuiteBlock) -> None:
    arguments = ["run", str(folder), "--suite", "vehicle", "--split", "train", "--plain"]
    found = CliRunner().invoke(bench, arguments, catch_exceptions=False)
    assert "# Suite vehicle, plain, train split: 1 blocks" in found.stdout and "| seed_3_plain |" in found.stdout
    hard, plain = (Truth.read(folder / name / "truth.json") for name in ("seed_3", "seed_3_plain"))
    assert split_of_made(hard.made_by) == split_of_made(plain.made_by)
    assert not any(i.excluded == "moving" for i in plain.instances) and len(plain.instances) < len(hard.instances)


def test_stale_blocks_are_made_again(folder: Path, one_block: SuiteBlock) -> None:
    stamp = folder / "seed_3" / "block.json"
    before = stamp.read_text()
    stamp.write_text(before.replace('"seed": 3', '"seed": 4'))
    said: list[str] = []
    list(evaluate.prepared_blocks(folder, "vehicle", "train", say=said.append))
    assert said == ["seed_3: simulating"] and stamp.read_text() == before
    assert not (folder / "seed_3" / "result").exists()


def test_pieces_without_room_are_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The next one is taken, and the search is not repeated."""
    tried: list[int] = []

    def simulate(seed: int, options: SimulationOptions) -> str:
        tried.append(seed)
        if seed == 1:
            raise InputError("no open strip", "", "city-model")
        return "a block"

    city = tmp_path / "city.json"
    city.touch()
    both = [SuiteBlock(f"piece_{n}", "train", n, SimulationOptions(city=str(city))) for n in (1, 2)]
    monkeypatch.setattr(evaluate, "pieces", lambda suite, split, models: iter(both))
    monkeypatch.setattr(evaluate, "simulate_block", simulate)
    monkeypatch.setattr(evaluate, "write_block", lambda block, folder: None)
    monkeypatch.setitem(SIZES["airborne"], "train", (0, 1))
    for _ in range(2):
        found = evaluate.prepared_blocks(tmp_path, "airborne", "train", models=tmp_path, say=lambda text: None)
        assert [name for name, _ in found] == ["piece_2"]
    assert tried == [1, 2]
    monkeypatch.setitem(SIZES["airborne"], "train", (0, 2))
    with pytest.raises(InputError, match="room for 1 of 2 pieces"):
        list(evaluate.prepared_blocks(tmp_path, "airborne", "train", models=tmp_path, say=lambda text: None))


def test_the_interval_of_equal_blocks_is_their_score(folder: Path, one_block: SuiteBlock) -> None:
    found = run_suite(folder, "vehicle", "train", Parameters())
    report = found.blocks[0].report
    assert interval([report] * 4) == pytest.approx([report.scores().macro_iou] * 2)
