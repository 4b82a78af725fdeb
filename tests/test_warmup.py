"""Kernels are compiled once: the first run says so, and no process compiles them again."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

import loda_pdal.kernels
from loda_pdal import warmup
from loda_pdal.benchmark.simulate import SimulationOptions, simulate_block, write_block
from loda_pdal.cli.main import run
from loda_pdal.kernels import is_cache_warm, mark_cache_warm
from loda_pdal.params import PRESETS
from loda_pdal.warmup import COMPILING, Compiled, compile_kernels, kernels

MISSES = """
import sys
from loda_pdal.cli.main import run
from loda_pdal.warmup import kernels
assert run(sys.argv[1:]) == 0
print([(k.py_func.__name__, list(k.stats.cache_misses)) for k in kernels() if k.stats.cache_misses])
"""

CALLED = """
import sys
from pathlib import Path
from loda_pdal.warmup import compile_kernels, kernels
compile_kernels(Path(sys.argv[1]))
print([i for i, kernel in enumerate(kernels()) if kernel.signatures])
"""


def said_by(code: str, *arguments: str) -> str:
    """Last line that a fresh Python process prints."""
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


def with_callees(called: Iterable[Any]) -> set[int]:
    """Identities of kernels and of all that they call, directly or not."""
    found: set[int] = set()
    left = list(called)
    while left:
        kernel = left.pop()
        if id(kernel) not in found:
            found.add(id(kernel))
            names = kernel.py_func.__code__.co_names
            used = [kernel.py_func.__globals__.get(name) for name in names]
            left += [value for value in used if isinstance(value, type(kernel))]
    return found


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory, compiled_kernels: None) -> Path:
    folder = tmp_path_factory.mktemp("block")
    write_block(simulate_block(3, SimulationOptions(length_m=30.0, density=0.2)), folder)
    return folder


def test_warmup_reaches_every_kernel(tmp_path: Path) -> None:
    """A kernel that fails here needs something in `write_scene` (or a preset) that makes the method call it."""
    everything = kernels()
    reached = with_callees(everything[i] for i in json.loads(said_by(CALLED, str(tmp_path))))
    assert [k.py_func.__name__ for k in everything if id(k) not in reached] == []


def test_every_module_of_kernels_is_looked_through() -> None:
    modules = {kernel.py_func.__module__.rpartition(".")[2] for kernel in kernels()}
    with_kernels = {p.stem for p in Path(loda_pdal.kernels.__file__).parent.glob("*.py") if "@kernel" in p.read_text()}
    assert with_kernels - modules == {name.rpartition(".")[2] for name in warmup.SIMULATION}


@pytest.mark.parametrize("preset", PRESETS)
def test_no_process_compiles_again(preset: str, block: Path, tmp_path: Path) -> None:
    """Neither the data nor the preset needs a kernel for types that warmup did not compile."""
    surveys = [str(block / "before.laz"), str(block / "after.laz")]
    assert said_by(MISSES, "detect", *surveys, "-o", str(tmp_path / "out"), "-q", "--preset", preset) == "[]"


def test_pipelines_do_not_compile_again(block: Path, tmp_path: Path, pipelines_dir: Path) -> None:
    options = {
        "stage.before.filename": block / "before.laz",
        "stage.after.filename": block / "after.laz",
        "stage.output.filename": tmp_path / "out.las",
    }
    arguments = [f"--{name}={value}" for name, value in options.items()]
    path = str(pipelines_dir / "change.json")
    assert said_by(MISSES, "pipeline", path, "--engine", "embedded", "--progress", "none", *arguments) == "[]"


def test_warmth_is_that_of_this_version_and_machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    assert not is_cache_warm()
    mark_cache_warm()
    assert is_cache_warm()
    monkeypatch.setattr(loda_pdal.kernels, "version", lambda name: "another")
    assert not is_cache_warm()
    monkeypatch.undo()
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    mark_cache_warm()  # nowhere to write: not remembered, no failure
    assert not is_cache_warm()


def test_an_edited_kernel_makes_the_cache_cold(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(loda_pdal.kernels, "__file__", str(tmp_path / "kernels" / "__init__.py"))
    (tmp_path / "kernels").mkdir()
    (tmp_path / "kernels" / "loops.py").write_text("one")
    mark_cache_warm()
    assert is_cache_warm()
    (tmp_path / "kernels" / "loops.py").write_text("another")
    assert not is_cache_warm()


def test_a_second_warmup_has_nothing_to_do(capsys: pytest.CaptureFixture[str], compiled_kernels: None) -> None:
    assert run(["warmup"]) == 0
    assert capsys.readouterr().out.startswith("Nothing to do")
    assert run(["warmup", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["compiled"] == 0


def test_the_first_run_shows_that_it_compiles(
    block: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a cold cache; the compiling itself is left out here, its kernels are in this process already."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))

    def pretended(folder: Path, progress: Any) -> Compiled:
        progress(1, 2, COMPILING)
        return Compiled(2, 30.0)

    monkeypatch.setattr(warmup, "compile_kernels", pretended)
    detect = ["detect", str(block / "before.laz"), str(block / "after.laz"), "-o", str(tmp_path / "out")]
    assert run([*detect, "--progress", "json"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {"event": "progress", "stage": COMPILING, "done": 1, "total": 2} in events
    assert any(e["event"] == "info" and "compiling" in e["message"].lower() for e in events)
    assert run(["warmup"]) == 0
    said = capsys.readouterr()
    assert said.out.startswith("2 kernels compiled in 30.0 s") and COMPILING in said.err


def test_progress_counts_the_kernels(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A kernel that this process and the cache do not know yet is compiled, counted and announced once."""
    from numba import njit

    def twice(x):  # type: ignore[no-untyped-def]
        return 2 * x

    fresh = njit(twice)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(warmup, "kernels", lambda: [fresh])
    monkeypatch.setattr(warmup, "detect_changes", lambda *_: (fresh(1), fresh(1.5)))
    monkeypatch.setattr(warmup, "write_outputs", lambda *_, **__: None)
    said: list[tuple[int, int, str]] = []
    done = compile_kernels(tmp_path, lambda *args: said.append(args))
    assert done.n == 1 and said == [(1, 1, COMPILING)] and is_cache_warm()
