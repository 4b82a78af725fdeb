"""The parts of the QGIS plugin that need no QGIS: its engine process, its zip, and what it shares with the engine.

What needs QGIS is in `tests/qgis`, which runs in QGIS's own Python.
"""

from __future__ import annotations

import ast
import json
import os
import re
import sys
import time
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from loda_pdal.io.colours import LABEL_COLOURS

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "qgis_plugin"))

import package  # noqa: E402
from loda_change import legend  # noqa: E402
from loda_change.engine import definitions, install, locate, process  # noqa: E402
from loda_change.engine.errors import EngineCancelled, EngineError, EngineMissing  # noqa: E402

PLUGIN = ROOT / "qgis_plugin" / "loda_change"
MODULES = sorted(PLUGIN.rglob("*.py"))


# What plugin and engine share


def test_the_shipped_parameters_are_those_of_the_engine() -> None:
    assert json.loads(package.engine_parameters()) == definitions.shipped(), "run `make plugin`"


def test_the_colours_are_those_of_the_engine() -> None:
    assert (
        tuple((int(label), label.title, colour) for label, colour in sorted(LABEL_COLOURS.items()))
        == legend.CHANGE_CLASSES
    )


# The code: standard library and qgis, for every QGIS from 3.34 on


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PLUGIN)))
def test_modules_need_nothing_but_qgis(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 9))
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names = [node.module or ""]
        else:
            continue
        for root in {name.split(".")[0] for name in names}:
            assert root in sys.stdlib_module_names or root in ("qgis", "processing"), f"{path.name} imports {root}"
            assert root != "qgis" or path.parent.name != "engine", f"{path.name} must not know QGIS"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PLUGIN)))
def test_never_the_interpreter_of_qgis(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert "sys.executable" not in text and "PyQt5" not in text and "PyQt6" not in text and ".exec_(" not in text


# The zip, by the rules of the plugin repository


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    return zipfile.ZipFile(package.pack(tmp_path_factory.mktemp("dist")))


def test_one_folder_with_all_that_must_be_there(archive: zipfile.ZipFile) -> None:
    names = archive.namelist()
    assert {name.split("/")[0] for name in names} == {"loda_change"} and "loda_change".isidentifier()
    assert {"__init__.py", "metadata.txt", "LICENSE", "icon.svg", "parameters.json"} <= {
        name.removeprefix("loda_change/") for name in names
    }


def test_nothing_that_must_not_be_there(archive: zipfile.ZipFile) -> None:
    for entry in archive.infolist():
        assert not re.search(r"\.pyc|__pycache__|__MACOSX|\.git|\.DS_Store|/\.", entry.filename), entry.filename
        assert not entry.filename.endswith((".so", ".dll", ".exe", ".pyd"))
    assert sum(entry.file_size for entry in archive.infolist()) < 25e6


def test_metadata_is_complete() -> None:
    data = package.metadata()
    for key in ("name", "description", "about", "author", "email", "tracker", "repository", "homepage", "changelog"):
        assert data[key].strip(), key
    assert re.fullmatch(r"\d+\.\d+\.\d+", data["version"])
    assert data["qgisMinimumVersion"] == "3.34" and data["qgisMaximumVersion"] == "4.99"
    assert data["hasProcessingProvider"] == "yes" and "supportsQt6" not in data
    assert (PLUGIN / data["icon"]).is_file() and "@" in data["email"]
    assert data["version"] in data["changelog"] and data["version"] == definitions.shipped()["version"]
    assert (PLUGIN / "LICENSE").read_text() == (ROOT / "LICENSE").read_text()


def test_packing_twice_gives_the_same_zip(tmp_path: Path) -> None:
    assert package.pack(tmp_path / "a").read_bytes() == package.pack(tmp_path / "b").read_bytes()


# The engine as a process


class Told:
    """A listener that remembers."""

    def __init__(self) -> None:
        self.heard: list[tuple[Any, ...]] = []

    def __getattr__(self, name: str) -> Any:
        return lambda *values: self.heard.append((name, *values))


@pytest.fixture
def program(tmp_path: Path) -> Any:
    """``program(body)``: a shell script with this body."""

    def make(body: str, name: str = "loda-pdal") -> str:
        path = tmp_path / "bin" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"#!/bin/sh\n{body}\n")
        path.chmod(0o755)
        return str(path)

    return make


def is_running(number: int) -> bool:
    try:
        return Path(f"/proc/{number}/stat").read_text().split()[2] != "Z"
    except OSError:
        return False


RESULT = """echo '{"event": "result", "outputs": {}, "summary": {"changed": 3}}'"""


def test_events_reach_the_listener_in_order(program: Any) -> None:
    body = """
    echo '{"event": "progress", "stage": "fusing points", "done": 1, "total": 4}'
    echo '{"event": "info", "message": "compiling, once"}'
    echo '{"event": "warning", "message": "no ground"}'
    echo 'not an event'
    """
    told = Told()
    result = process.run_engine([program(body + RESULT)], told)
    assert result["summary"] == {"changed": 3}
    assert told.heard == [
        ("progress", 25.0, "fusing points"),
        ("info", "compiling, once"),
        ("warning", "no ground"),
        ("console", "not an event"),
    ]


def test_the_error_of_the_engine_is_told_in_its_words(program: Any) -> None:
    error = """echo '{"event": "error", "code": "x", "message": "No overlap.", "remedy": "Check the CRS."}'; exit 1"""
    with pytest.raises(EngineError, match=r"No overlap\. Check the CRS\."):
        process.run_engine([program(error)], Told())


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("kill -SEGV $$", "crashed"),
        ("kill -KILL $$", "memory ran out"),
        ("kill -HUP $$", "ended by SIGHUP"),
        ("echo 'loda-pdal: broken' >&2; exit 3", r"failed \(exit code 3\): broken"),
        ("exit 0", "ended without a result"),
        (RESULT + "; exit 4", "exit code 4"),
    ],
)
def test_deaths_are_told_in_words(program: Any, body: str, words: str) -> None:
    with pytest.raises(EngineError, match=words):
        process.run_engine([program(body)], Told())


def test_a_program_that_cannot_be_started(tmp_path: Path) -> None:
    with pytest.raises(EngineError, match="cannot be started"):
        process.run_engine([str(tmp_path / "nothing")], Told())


@pytest.mark.parametrize("stubborn", [False, True])
def test_cancelling_ends_the_whole_group(program: Any, tmp_path: Path, stubborn: bool, monkeypatch: Any) -> None:
    monkeypatch.setattr(process, "TERM_S", 0.5)
    trap = "trap '' TERM; " if stubborn else ""
    engine = program(f"{trap}sleep 60 & echo $! $$ > {tmp_path}/numbers; wait; sleep 60")
    began, asked = time.monotonic(), []

    def is_cancelled() -> bool:
        if (tmp_path / "numbers").exists() and not asked:
            asked.append(time.monotonic())
        return bool(asked)

    with pytest.raises(EngineCancelled):
        process.run_engine([engine], Told(), is_cancelled)
    assert time.monotonic() - asked[0] < 2.0 and time.monotonic() - began < 10.0
    for number in (tmp_path / "numbers").read_text().split():
        assert not is_running(int(number))


def test_children_that_outlive_the_engine_do_not_hold_it_up(program: Any, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(process, "TERM_S", 0.3)
    engine = program(f"sleep 60 & echo $! > {tmp_path}/number\n{RESULT}")
    began = time.monotonic()
    assert process.run_engine([engine], Told())["summary"] == {"changed": 3}
    assert time.monotonic() - began < 5.0 and not is_running(int((tmp_path / "number").read_text()))


def test_long_silence_is_told(program: Any) -> None:
    notes: list[str] = []
    process.run([program("sleep 0.6")], lambda stream, line: notes.append(line), silence_s=0.2)
    assert notes and "Nothing was heard" in notes[0]


def test_the_engine_sees_that_its_parent_lives(program: Any) -> None:
    """Stdin is a pipe that stays open: reading it blocks."""
    code, _ = process.run([program("timeout 0.3 cat; [ $? = 124 ]")], lambda stream, line: None)
    assert code == 0


def test_the_environment_is_cleaned() -> None:
    given = {"PROJ_LIB": "/q", "GDAL_DATA": "/q", "PYTHONHOME": "/q", "LD_LIBRARY_PATH": "/q", "HOME": "/home/me"}
    clean = process.clean_environment(given)
    assert clean["HOME"] == "/home/me" and clean["PYTHONNOUSERSITE"] == "1" and clean["PYTHONIOENCODING"] == "utf-8"
    assert not set(given) - {"HOME"} & set(clean)


def test_an_answer_has_a_time_limit(program: Any) -> None:
    with pytest.raises(EngineError, match="did not answer"):
        process.answer([program("sleep 60")], timeout_s=0.3)


# Where the engine is


def test_order_of_places(program: Any, tmp_path: Path) -> None:
    on_path = program("")
    managed = tmp_path / "engines"
    environment = {"PATH": str(Path(on_path).parent)}
    assert locate.find_engine("", managed, environment) == ([on_path], "on PATH")
    made = locate.program_in(managed / "engine-1")
    made.parent.mkdir(parents=True)
    made.write_text("")
    assert locate.find_engine("", managed, environment).origin == "on PATH"  # not finished: no `current`
    (managed / "current").write_text("engine-1")
    assert locate.find_engine("", managed, environment) == ([str(made)], "installed by the plugin")
    environment["LODA_PYTHON"] = sys.executable
    assert locate.find_engine("", managed, environment).command == [sys.executable, "-m", "loda_pdal"]
    assert locate.find_engine(on_path, managed, environment) == ([on_path], "chosen in the settings")
    assert locate.find_engine(sys.executable, managed, {}).command[1:] == ["-m", "loda_pdal"]


def test_no_engine_is_told_with_the_way_to_install_it(tmp_path: Path) -> None:
    for chosen, environment in (("", {"PATH": ""}), ("/nowhere", {}), ("", {"LODA_PYTHON": "/nowhere"})):
        with pytest.raises(EngineMissing) as caught:
            locate.find_engine(chosen, tmp_path, environment)
        assert caught.value.remedy


@pytest.mark.parametrize(
    ("says", "words"), [("loda-pdal 0.0.9", "too old"), ("GNU bash 5.2", "is not loda-pdal"), ("", "is not loda-pdal")]
)
def test_other_versions_are_refused(program: Any, says: str, words: str) -> None:
    with pytest.raises(EngineError, match=words):
        locate.engine_version(locate.Engine([program(f"echo '{says}'")], ""))


def test_versions_that_will_do(program: Any) -> None:
    for version in ("0.1.0", "0.10.2", "1.0.0rc1"):
        assert locate.engine_version(locate.Engine([program(f"echo loda-pdal {version}")], "")) == version


# Parameters of another engine than the shipped one


def test_another_version_is_asked_once(program: Any, tmp_path: Path) -> None:
    other = {**definitions.shipped(), "version": "9.9.9", "stages": []}
    (tmp_path / "params.json").write_text(json.dumps(other))
    body = f'echo asked >> {tmp_path}/log; [ "$1" = --version ] && echo loda-pdal 9.9.9 || cat {tmp_path}/params.json'
    engine = locate.Engine([program(body)], "")
    assert definitions.current(engine, tmp_path / "cache") == other
    assert definitions.current(engine, tmp_path / "cache") == other
    assert (tmp_path / "log").read_text().count("asked") == 2  # version and parameters, once each
    os.utime(engine.command[0], ns=(1, 1))  # installed anew
    assert definitions.current(engine, tmp_path / "cache") == other
    assert (tmp_path / "log").read_text().count("asked") == 4


def test_without_an_engine_the_shipped_parameters_do(program: Any, tmp_path: Path) -> None:
    assert definitions.current(None, tmp_path) == definitions.shipped()
    assert definitions.current(locate.Engine([program("exit 1")], ""), tmp_path) == definitions.shipped()
    assert definitions.current(locate.Engine([program("sleep 60")], ""), tmp_path, 0.2) == definitions.shipped()


# Installation


def make_wheel(folder: Path, version: str) -> Path:
    """A package that says it is loda-pdal and needs nothing."""
    path, info = folder / f"loda_pdal-{version}-py3-none-any.whl", f"loda_pdal-{version}.dist-info"
    files = {
        "loda_pdal.py": f"def main():\n    print('loda-pdal {version}')\n",
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: loda-pdal\nVersion: {version}\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{info}/entry_points.txt": "[console_scripts]\nloda-pdal = loda_pdal:main\n",
    }
    record = "".join(f"{name},,\n" for name in [*files, f"{info}/RECORD"])
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in {**files, f"{info}/RECORD": record}.items():
            archive.writestr(name, text)
    return path


def test_installing_an_engine_and_then_failing_to_replace_it(tmp_path: Path) -> None:
    folder, lines = tmp_path / "engines", []
    engine = install.install(folder, str(make_wheel(tmp_path, "0.2.0")), lines.append, python=sys.executable)
    assert locate.engine_version(engine) == "0.2.0" and "loda-pdal 0.2.0 works" in lines
    assert locate.find_engine("", folder, {"PATH": ""}) == engine
    broken = tmp_path / "loda_pdal-0.3.0-py3-none-any.whl"
    broken.write_text("no wheel")
    with pytest.raises(EngineError, match="installation failed"):
        install.install(folder, str(broken), lines.append, python=sys.executable)
    assert locate.find_engine("", folder, {"PATH": ""}) == engine and len(list(folder.iterdir())) == 2
    with pytest.raises(EngineCancelled):
        install.install(folder, "", lines.append, lambda: True, python=sys.executable)
    assert locate.find_engine("", folder, {"PATH": ""}) == engine and len(list(folder.iterdir())) == 2
    with pytest.raises(EngineError, match="does not exist"):
        install.install(folder, str(tmp_path / "nothing.whl"), lines.append)


def test_a_python_for_the_engine_is_new_enough(program: Any, tmp_path: Path) -> None:
    program("exit 1", "python3.13")
    good = program("exit 0", "python3")
    environment = {"PATH": str(tmp_path / "bin")}
    assert locate.find_python(environment) == good
    Path(good).unlink()
    with pytest.raises(EngineMissing, match=r"Python 3\.11"):
        locate.find_python(environment)


def test_class_factory_waits_for_qgis() -> None:
    """Importing the plugin's package needs no QGIS; making the plugin does."""
    import loda_change

    with pytest.raises(ImportError, match="qgis"):
        loda_change.classFactory(SimpleNamespace())
