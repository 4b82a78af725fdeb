"""How a run reports, and how it stops: within two seconds, with nothing half-written under a final name."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from loda_pdal.benchmark.simulate import SimulationOptions, simulate_block, write_block
from loda_pdal.cli.main import run
from loda_pdal.cli.progress import BarReporter, JsonReporter, LineReporter, Reporter, reporter_for
from loda_pdal.io.outputs import OUTPUTS
from loda_pdal.model.errors import InputError
from loda_pdal.pipeline import STEPS

LIMIT_S = 2.0
WRITING = "writing the results"


@pytest.fixture(autouse=True)
def own_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """What ``--threads`` leaves in the environment ends with the test."""
    monkeypatch.setenv("LODA_THREADS", "")


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory, compiled_kernels: None) -> Path:
    """A short simulated street, surveyed twice."""
    folder = tmp_path_factory.mktemp("block")
    write_block(simulate_block(3, SimulationOptions(length_m=30.0, width_m=40.0, density=0.25, lanes=(0.0,))), folder)
    return folder


def detect(block: Path, out: Path, *more: str) -> list[str]:
    return ["detect", str(block / "before.laz"), str(block / "after.laz"), "-o", str(out), *more]


@pytest.fixture
def start(block: Path, tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts `detect --progress json` in a process of its own; what is still alive at the end is killed."""
    started: list[subprocess.Popen[str]] = []

    def begin(*more: str, stdin: Any = subprocess.DEVNULL) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "loda_pdal", *detect(block, tmp_path / "out", "--progress", "json", *more)]
        process = subprocess.Popen(command, stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        started.append(process)
        return process

    yield begin
    for process in started:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout, process.stderr):
            if pipe is not None:
                pipe.close()


def wait_for(process: subprocess.Popen[str], stage: str) -> None:
    """Read events until ``stage`` begins."""
    assert process.stdout is not None
    for line in process.stdout:
        if json.loads(line).get("stage") == stage:
            return
    raise AssertionError(f"{stage} never came: {process.communicate()[1]}")


def ends_within(process: subprocess.Popen[str], limit_s: float) -> int:
    start = time.monotonic()
    code = process.wait(timeout=30)
    assert time.monotonic() - start < limit_s
    return code


def left_in(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir()) if folder.exists() else []


def test_json_events_tell_the_run_from_start_to_result(
    block: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(detect(block, tmp_path / "out", "--progress", "json", "--json")) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    steps = [e for e in events if e["event"] == "progress"]
    assert [e["stage"] for e in steps] == ["reading the surveys", *STEPS.values(), WRITING, "done"]
    assert [e["done"] for e in steps[1:]] == list(range(len(STEPS) + 2)) and steps[-1]["total"] == len(STEPS) + 1
    result = events[-1]
    assert result["event"] == "result"
    assert set(left_in(tmp_path / "out")) == {Path(path).name for path in result["outputs"].values()}
    saved = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert result["summary"] == saved["summary"]
    warned = [e["message"] for e in events if e["event"] == "warning"]
    assert warned == saved["summary"]["warnings"]


def test_result_goes_to_stdout_and_progress_to_stderr(
    block: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(detect(block, tmp_path / "out")) == 0
    said = capsys.readouterr()
    assert "objects changed." in said.out.splitlines()[0] and str(tmp_path / "out" / "changes.gpkg") in said.out
    assert all(words in said.err for words in STEPS.values())
    assert run(detect(block, tmp_path / "out", "--json", "-q")) == 1  # a result is there
    assert "--overwrite" in capsys.readouterr().err
    assert run(detect(block, tmp_path / "out", "--json", "-q", "--overwrite", "--threads", "1")) == 0
    said = capsys.readouterr()
    assert said.err == ""
    values = json.loads(said.out)
    assert values["summary"] == json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))["summary"]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_signal_during_the_work_stops_at_once_and_leaves_nothing(
    start: Callable[..., subprocess.Popen[str]], tmp_path: Path, number: signal.Signals, code: int
) -> None:
    process = start()
    wait_for(process, STEPS["superpoints"])
    process.send_signal(number)
    assert ends_within(process, LIMIT_S) == code
    assert process.stderr is not None and process.stderr.read().endswith("loda-pdal: stopped.\n")
    assert left_in(tmp_path / "out") == []


@pytest.mark.parametrize("delay_s", [0.05, 0.3])
def test_signal_while_writing_leaves_the_old_result(
    start: Callable[..., subprocess.Popen[str]], tmp_path: Path, delay_s: float
) -> None:
    old = tmp_path / "out"
    old.mkdir()
    for name in OUTPUTS:
        (old / name).write_text("old")
    process = start("--overwrite")
    wait_for(process, WRITING)
    time.sleep(delay_s)
    process.terminate()
    code = ends_within(process, LIMIT_S)
    if (old / "run.json").read_text(encoding="utf-8") == "old":  # else it was faster than the signal
        assert code == 143
        assert {name: (old / name).read_text() for name in left_in(old)} == dict.fromkeys(OUTPUTS, "old")


def test_killed_run_leaves_no_result_and_the_next_one_clears_up(
    start: Callable[..., subprocess.Popen[str]], block: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    process = start()
    wait_for(process, WRITING)
    give_up = time.monotonic() + 10
    while not left_in(tmp_path / "out") and time.monotonic() < give_up:
        time.sleep(0.002)
    process.kill()
    process.wait(timeout=10)
    assert not set(OUTPUTS) & set(left_in(tmp_path / "out"))
    assert run(detect(block, tmp_path / "out", "-q")) == 0
    assert set(left_in(tmp_path / "out")) <= set(OUTPUTS)


def test_closed_stdin_means_the_front_end_died(start: Callable[..., subprocess.Popen[str]], tmp_path: Path) -> None:
    process = start(stdin=subprocess.PIPE)
    wait_for(process, STEPS["register"])
    assert process.stdin is not None
    process.stdin.write("a front end may say things\n")
    process.stdin.flush()
    wait_for(process, STEPS["superpoints"])  # what it says changes nothing
    process.stdin.close()
    assert ends_within(process, LIMIT_S) == 1
    assert left_in(tmp_path / "out") == []


def test_closed_stdin_is_no_matter_without_json_progress(block: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "loda_pdal", *detect(block, tmp_path / "out", "--validate")]
    done = subprocess.run(command, input="", capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and "Everything is in order" in done.stderr


def test_stop_does_not_wait_for_a_busy_main_thread(tmp_path: Path) -> None:
    mark = tmp_path / "cleaned"
    code = (
        "import sys, time, threading; from pathlib import Path; from loda_pdal.cli import stopping;"
        "stopping.on_signals(); stopping.before_stopping(lambda: 1 / 0);"
        f"stopping.before_stopping(lambda: Path({str(mark)!r}).touch());"
        "print('ready', flush=True); lock = threading.Lock(); lock.acquire();"
        "[lock.acquire(timeout=60) for _ in iter(int, 1)]"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    process.terminate()
    assert ends_within(process, LIMIT_S) == 143
    assert mark.exists()  # one cleanup that fails does not keep the next from its work
    _, said = process.communicate()
    assert said == "loda-pdal: division by zero\nloda-pdal: stopped.\n"


def test_ignored_signals_stay_ignored() -> None:
    code = (
        "import os, signal, time; from loda_pdal.cli import stopping; signal.signal(signal.SIGHUP, signal.SIG_IGN);"
        "stopping.on_signals(); os.kill(os.getpid(), signal.SIGHUP); time.sleep(0.3); print('alive')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stdout) == (0, "alive\n")


def test_reporters_put_the_same_run_into_their_own_words(capsys: pytest.CaptureFixture[str]) -> None:
    def tell(reporter: Reporter) -> tuple[str, str]:
        with pytest.raises(InputError), reporter:
            reporter.progress(1, 12, "fusing points")
            reporter.warning("heights differ")
            reporter.result({"report": Path("out/report.html")}, {"changed": 3})
            raise InputError("No points.", "Give points.", "input-empty")
        return capsys.readouterr()

    assert tell(Reporter()) == ("", "Warning: heights differ\n")
    out, err = tell(LineReporter())
    assert out == "" and err.splitlines()[0].endswith("s  fusing points") and err.startswith("[ 1/12]")
    out, err = tell(JsonReporter())
    assert err == ""
    assert [json.loads(line) for line in out.splitlines()] == [
        {"event": "progress", "stage": "fusing points", "done": 1, "total": 12},
        {"event": "warning", "message": "heights differ"},
        {"event": "result", "outputs": {"report": "out/report.html"}, "summary": {"changed": 3}},
        {"event": "error", "code": "input-empty", "message": "No points.", "remedy": "Give points."},
    ]


def test_library_warnings_go_through_the_reporter(capsys: pytest.CaptureFixture[str]) -> None:
    import logging

    log = logging.getLogger("loda_pdal.io.las")
    with JsonReporter():
        log.warning("waveforms stay in %s", "before.laz")
        print("said by some other library")
    said = capsys.readouterr()
    assert json.loads(said.out) == {"event": "warning", "message": "waveforms stay in before.laz"}
    assert said.err == "said by some other library\n"
    assert not logging.getLogger("loda_pdal").handlers


def test_auto_is_a_bar_on_a_terminal_and_lines_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    assert type(reporter_for("auto")) is LineReporter
    assert type(reporter_for("none")) is Reporter
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    with reporter_for("auto") as reporter:
        assert type(reporter) is BarReporter


def test_terminal_gets_its_cursor_back_after_ctrl_c(block: Path, tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "loda_pdal", *detect(block, tmp_path / "out", "--progress", "bar")],
        stdin=theirs,
        stdout=subprocess.PIPE,
        stderr=theirs,
        env=os.environ | {"TERM": "xterm"},
    )
    os.close(theirs)
    seen = b""
    while b"superpoints" not in seen:
        seen += os.read(ours, 4096)
    process.send_signal(signal.SIGINT)
    code = process.wait(timeout=10)
    while not seen.endswith(b"stopped.\r\n"):
        seen += os.read(ours, 4096)
    os.close(ours)
    process.communicate()
    assert code == 130 and seen.rindex(b"\x1b[?25h") > seen.rindex(b"\x1b[?25l")


def test_signal_during_a_pipeline_leaves_no_file(block: Path, tmp_path: Path, pipelines_dir: Path) -> None:
    out = tmp_path / "out.laz"
    command = [sys.executable, "-m", "loda_pdal", "pipeline", str(pipelines_dir / "change.json"), "--progress", "json"]
    command += ["--engine", "embedded", f"--stage.before.filename={block / 'before.laz'}"]
    command += [f"--stage.after.filename={block / 'after.laz'}", f"--stage.output.filename={out}"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    assert process.stdout is not None
    for line in process.stdout:
        if "superpoints" in json.loads(line).get("stage", ""):
            break
    process.terminate()
    assert ends_within(process, LIMIT_S) == 143
    _, said = process.communicate()
    assert said.endswith("loda-pdal: stopped.\n")
    assert not [path for path in tmp_path.rglob("*") if path.suffix in (".laz", ".las") or "part" in path.name]
