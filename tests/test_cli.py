"""The command line: exit codes, one line per error, what goes to stdout and what to stderr."""

from __future__ import annotations

import json
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from io_samples import UTM, make_las, scattered

import loda_pdal
from loda_pdal.cli import main as cli_main
from loda_pdal.cli.main import COMMANDS, run
from loda_pdal.cli.options import chosen_parameters
from loda_pdal.model.errors import ParameterError
from loda_pdal.params import PRESETS, STAGES, Parameters

ROOT = Path(__file__).resolve().parent.parent


def program(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "loda_pdal", *arguments], capture_output=True, text=True, timeout=120, **options
    )


@pytest.fixture
def two_surveys(tmp_path: Path) -> tuple[str, str]:
    before = make_las(tmp_path / "before.laz", scattered(2000, seed=1))
    return str(before), str(make_las(tmp_path / "after.laz", scattered(1500, seed=2)))


def test_version_is_that_of_the_package_and_comes_at_once() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert loda_pdal.__version__ == project["version"]
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        done = program("--version")
        seconds.append(time.perf_counter() - start)
        assert (done.returncode, done.stdout, done.stderr) == (0, f"loda-pdal {loda_pdal.__version__}\n", "")
    assert min(seconds) < 0.5


@pytest.mark.parametrize("arguments", [["--version"], ["--help"], ["params"], ["detect", "--help"]])
def test_light_commands_load_nothing_heavy(arguments: list[str]) -> None:
    code = (
        "import sys; from loda_pdal.cli.main import run; code = run(sys.argv[1:]);"
        "print(sorted({'numpy', 'scipy', 'numba', 'laspy', 'shapely', 'rich'} & set(sys.modules)), file=sys.stderr);"
        "sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "[]\n")


def test_package_names_load_when_used() -> None:
    code = (
        "import sys, loda_pdal; assert 'numpy' not in sys.modules; print(loda_pdal.Parameters().name, dir(loda_pdal))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.startswith("street ") and done.stderr == ""
    for name in loda_pdal.__all__:
        assert getattr(loda_pdal, name) is not None
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = loda_pdal.no_such_name


@pytest.mark.parametrize("verb", list(COMMANDS))
def test_every_verb_explains_itself(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([verb, "--help"]) == 0
    said = capsys.readouterr()
    assert said.out.startswith(f"Usage: loda-pdal {verb}") and said.err == ""


@pytest.mark.parametrize(
    "arguments",
    [
        ["frobnicate"],
        ["detect", "only-one.laz"],
        ["detect", "a.laz", "b.laz"],
        ["detect", "a.laz", "b.laz", "-o", "out", "--preset", "moon"],
        ["detect", "a.laz", "b.laz", "-o", "out", "--threads", "0"],
        ["detect", "a.laz", "b.laz", "-o", "out", "--max-memory", "0"],
        ["pipeline", "p.json", "--frobnicate"],
        ["pipeline", "p.json", "stray"],
        ["params", "--unknown"],
    ],
)
def test_usage_errors_exit_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(arguments) == 2
    said = capsys.readouterr()
    assert said.out == "" and "Error: " in said.err and "Traceback" not in said.err


def test_auto_says_which_preset_suits_the_surveys(
    two_surveys: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["detect", *two_surveys, "-o", str(tmp_path / "out"), "--validate"]
    for choice in ([], ["--preset", "auto"]):
        assert run([*arguments, *choice]) == 0
        assert "Preset aerial: the densest quarter of the plan holds 42% and 43% of" in " ".join(
            capsys.readouterr().err.split()
        )
    assert run([*arguments, "--preset", "street"]) == 0
    assert "Preset" not in capsys.readouterr().err
    assert run([*arguments, "--set", "lod.radius=1"]) == 1


def test_a_parameter_file_chooses_before_the_surveys_do(tmp_path: Path) -> None:
    named, unnamed = tmp_path / "named.toml", tmp_path / "unnamed.toml"
    unnamed.write_text("[lod]\nradius_m = 1.5\n", encoding="utf-8")
    named.write_text('name = "street"\n[lod]\nradius_m = 1.5\n', encoding="utf-8")
    aerial, street = (Parameters.preset(name).with_setting("lod.radius_m=1.5") for name in ("aerial", "street"))
    for preset in (None, "auto"):
        assert chosen_parameters(preset, named, (), suits="aerial") == street
        assert chosen_parameters(preset, unnamed, (), suits="aerial") == aerial
    assert chosen_parameters("street", unnamed, (), suits="aerial") == street
    assert chosen_parameters(None, None, ("lod.radius_m=1.5",), suits="aerial") == aerial


DETECT = ("detect", "{here}/before.laz", "{here}/after.laz", "-o", "{here}/out")
MISTAKES: dict[str, tuple[tuple[str, ...], str]] = {
    "missing": (
        ("detect", "nowhere.laz", "{here}/after.laz", "-o", "{here}/out"),
        "nowhere.laz: there is no such file",
    ),
    "not las": (("detect", "{here}/before.laz", "{here}/notes.laz", "-o", "{here}/out"), "is not a LAS, LAZ or COPC"),
    "unknown parameter": ((*DETECT, "--set", "lod.radius=1"), "unknown parameter lod.radius"),
    "unknown stage": ((*DETECT, "--set", "lid.radius_m=1"), "unknown stage 'lid'"),
    "out of range": ((*DETECT, "--set", "lod.radius_m=999"), "outside 0.1 to 50"),
    "no assignment": ((*DETECT, "--set", "lod"), "stage.key=value"),
    "bad file": ((*DETECT, "--params", "{here}/bad.toml"), "not valid TOML"),
    "no file": ((*DETECT, "--params", "{here}/none.toml"), "none.toml: cannot be read"),
    "output is a file": ((*DETECT[:-1], "{here}/bad.toml"), "is a file, not a folder"),
    "output is input": (
        ("detect", "{here}/before.laz", "{here}/changes.laz", "-o", "{here}", "--overwrite"),
        "replace",
    ),
    "memory": ((*DETECT, "--max-memory", "0.000001"), "--max-memory"),
    "info": (("info", "nowhere.laz"), "there is no such file"),
    "report": (("report", "{here}"), "no run.json"),
    "pipeline": (("pipeline", "{here}/none.json"), "cannot be read"),
}
"""Mistakes of a user: the arguments, and what the one line on stderr must say."""


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_one_line_and_leave_nothing(
    name: str, tmp_path: Path, two_surveys: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "notes.laz").write_text("these are notes, not points")
    (tmp_path / "bad.toml").write_text("[lod\n")
    arguments, expected = MISTAKES[name]
    there = sorted(tmp_path.iterdir())
    assert run([a.format(here=tmp_path) for a in arguments] + ["-q"]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("loda-pdal: ") and said.err.count("\n") == 1 and expected in said.err
    assert sorted(tmp_path.iterdir()) == there


def test_existing_result_is_refused_without_overwrite(
    tmp_path: Path, two_surveys: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "run.json").write_text("{}")
    assert run(["detect", *two_surveys, "-o", str(tmp_path / "out"), "--validate"]) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert run(["detect", *two_surveys, "-o", str(tmp_path / "out"), "--validate", "--overwrite"]) == 0


def test_validate_computes_and_writes_nothing(
    tmp_path: Path, two_surveys: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["detect", *two_surveys, "-o", str(tmp_path / "out"), "--validate"]) == 0
    assert "Everything is in order" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_verbose_shows_the_traceback_before_and_after_the_verb(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["-v", "info", "nowhere.laz"], ["info", "nowhere.laz", "-v"]):
        assert run(arguments) == 1
        assert "Traceback" in capsys.readouterr().err
    assert run(["info", "nowhere.laz"]) == 1
    assert "Traceback" not in capsys.readouterr().err


def test_a_defect_of_ours_says_so_with_its_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*arguments: object) -> None:
        raise KeyError("lost")

    monkeypatch.setattr("loda_pdal.cli.options.Parameters.to_toml", broken)
    assert run(["params"]) == 1
    said = capsys.readouterr().err
    assert "Traceback" in said and said.splitlines()[-1].startswith("loda-pdal: this is a defect of loda-pdal")


@pytest.mark.parametrize(
    ("error", "code", "expected"),
    [
        (KeyboardInterrupt(), 130, "stopped."),
        (click.Abort(), 130, "stopped."),
        (MemoryError(), 1, "memory"),
        (OSError(28, "No space left on device", "out.json"), 1, "out.json: No space left on device."),
    ],
)
def test_what_the_system_raises_is_one_line(
    error: BaseException,
    code: int,
    expected: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def failing(*arguments: object) -> None:
        raise error

    monkeypatch.setattr("loda_pdal.cli.options.Parameters.to_toml", failing)
    assert run(["params"]) == code
    said = capsys.readouterr().err
    assert expected in said and said.strip().count("\n") == 0


def test_reader_of_stdout_may_leave_early() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "loda_pdal", "params", "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    assert process.wait(timeout=30) == 1 and process.stderr.read() == b""
    process.stderr.close()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_full_disk_under_stdout_is_one_line() -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "loda_pdal", "params"], stdout=full, stderr=subprocess.PIPE, text=True, timeout=30
        )
    assert done.returncode == 1 and "No space left" in done.stderr and done.stderr.count("\n") == 1


@pytest.mark.parametrize("preset", PRESETS)
def test_params_written_are_params_read(preset: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("p.toml", "p.json"):
        path = tmp_path / name
        assert run(["params", "--preset", preset, "--set", "lod.cell_m=2.5", "-o", str(path)]) == 0
        assert capsys.readouterr().out == f"{path}\n"
        read = chosen_parameters(None, path, ())
        assert read == Parameters.preset(preset).with_setting("lod.cell_m=2.5")
        assert run(["params", "-o", str(path)]) == 1
        assert "--overwrite" in capsys.readouterr().err
        assert run(["params", "-o", str(path), "--overwrite"]) == 0
        assert chosen_parameters(None, path, ()) == Parameters()
        capsys.readouterr()


def test_params_as_json_say_all_that_is_known(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["params", "--preset", "aerial", "--json"]) == 0
    described = json.loads(capsys.readouterr().out)
    assert described["name"] == "aerial" and [stage["name"] for stage in described["stages"]] == list(STAGES)
    entry = next(
        e for s in described["stages"] if s["name"] == "icp" for e in s["parameters"] if e["name"] == "tukey_m"
    )
    assert (entry["value"], entry["unit"], entry["symbol"], entry["low"]) == (0.30, "m", "tau", 0.01)
    assert sum(len(stage["parameters"]) for stage in described["stages"]) == len(list(Parameters().describe()))


def test_later_choice_wins(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("[lod]\ncell_m = 3.0\nradius_m = 3.0\n")
    chosen = chosen_parameters("aerial", path, ("lod.cell_m=4", "icp.loss=l2"))
    assert (chosen.lod.cell_m, chosen.lod.radius_m, chosen.icp.loss) == (4.0, 3.0, "l2")
    assert chosen.fuse.leaf_m == Parameters.preset("aerial").fuse.leaf_m
    with pytest.raises(ParameterError, match=r"unknown parameter lod\.cells"):
        chosen_parameters(None, path, ("lod.cells=4",))


def test_info_of_one_and_of_two_surveys(
    tmp_path: Path, two_surveys: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["info", two_surveys[0], "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    (survey,) = values["surveys"]
    assert survey["points"] == 2000 and survey["epsg"] == UTM and "pair" not in values
    assert survey["size_m"] == pytest.approx([60, 60, 12], abs=0.2)
    assert survey["density_per_m2"] == pytest.approx(2000 / 3600, rel=0.01)

    other = make_las(tmp_path / "other.laz", scattered(1500, seed=2) + np.array([30.0, 0.0, 0.0]), crs=26917)
    assert run(["info", two_surveys[0], str(other), "--json"]) == 0
    pair = json.loads(capsys.readouterr().out)["pair"]
    assert pair["overlap_of_bounds"] == pytest.approx(0.5, abs=0.01)
    assert "EPSG:26917" in pair["problem"] and "--epsg" in pair["remedy"]
    assert run(["info", two_surveys[0], str(other), "--assume-same-crs"]) == 0
    said = capsys.readouterr().out
    assert "Bounds overlap by 50% of the smaller one." in said and "Cannot be compared" not in said


def test_pipeline_overrides_are_passed_on_as_pdal_takes_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from loda_pdal import pdal_face

    asked: dict[str, Any] = {}

    def remember(path: Path, overrides: dict[str, str], **options: Any) -> pdal_face.PipelineRun:
        asked.update(path=path, overrides=overrides, **options)
        return pdal_face.PipelineRun("embedded", [tmp_path / "out.laz"])

    monkeypatch.setattr(pdal_face, "run_pipeline", remember)
    arguments = ["pipeline", "p.json", "--stage.before.filename=a=b.laz", "--engine", "embedded", "--json"]
    assert run(arguments) == 0
    assert asked["overrides"] == {"stage.before.filename": "a=b.laz"}
    assert (asked["path"], asked["engine"], asked["validate"]) == (Path("p.json"), "embedded", False)
    assert json.loads(capsys.readouterr().out)["outputs"] == [str(tmp_path / "out.laz")]


def test_names_of_verbs_are_found_where_the_table_says() -> None:
    context = click.Context(cli_main.cli)
    for verb in COMMANDS:
        command = cli_main.cli.get_command(context, verb)
        assert command is not None and command.name == verb
    assert cli_main.cli.get_command(context, "nothing") is None
