"""A real QGIS without a screen, the plugin in it, and one run on a small simulated street that all tests share.

These tests run in QGIS's own Python (`make test`, `scripts/install_qgis.sh`); the engine runs in `.venv`.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PLUGINS = ROOT / "qgis_plugin"

_state = Path(tempfile.mkdtemp(prefix="loda-qgis-"))
os.environ.update(
    QT_QPA_PLATFORM="offscreen",
    XDG_RUNTIME_DIR=str(_state),
    QGIS_CUSTOM_CONFIG_PATH=str(_state / "profile"),
    QGIS_PLUGINPATH=str(PLUGINS),
)
os.environ.pop("LODA_PYTHON", None)
sys.dont_write_bytecode = True
sys.path.insert(0, str(PLUGINS))

from qgis.core import QgsApplication, QgsProcessingContext, QgsProcessingFeedback, QgsProject  # noqa: E402


class Listening(QgsProcessingFeedback):
    """Feedback that remembers all it was told; ``on_progress`` is called with each percentage."""

    def __init__(self, on_progress=None):
        super().__init__(False)
        self.percentages, self.stages, self.lines, self.warnings = [], [], [], []
        self.progressChanged.connect(self.percentages.append)
        if on_progress is not None:
            self.progressChanged.connect(lambda percent: on_progress(self, percent))

    def setProgressText(self, text):
        self.stages.append(text)

    def pushInfo(self, text):
        self.lines.append(text)

    pushCommandInfo = pushConsoleInfo = pushInfo

    def pushWarning(self, text):
        self.warnings.append(text)


def pytest_unconfigure():
    shutil.rmtree(_state, ignore_errors=True)


@pytest.fixture(scope="session")
def engine_program():
    """The engine of this checkout as a program, first on PATH and thus the one that the plugin finds."""
    folder = _state / "engine"
    folder.mkdir()
    program = folder / "loda-pdal"
    python = ROOT / ".venv" / "bin" / "python"
    program.write_text(
        f'#!/bin/sh\nPYTHONPATH={shlex.quote(str(ROOT))} exec {shlex.quote(str(python))} -m loda_pdal "$@"\n'
    )
    program.chmod(0o755)
    os.environ["PATH"] = f"{folder}{os.pathsep}{os.environ['PATH']}"
    return program


@pytest.fixture(scope="session")
def application(engine_program):
    """QGIS with Processing and the plugin's provider."""
    app = QgsApplication([], True)
    app.initQgis()
    sys.path.append(str(Path(app.pkgDataPath()) / "python" / "plugins"))
    from processing.core.Processing import Processing

    Processing.initialize()
    from loda_change import expressions
    from loda_change.provider import LodaProvider

    provider = LodaProvider()
    app.processingRegistry().addProvider(provider)
    expressions.register()
    yield app
    expressions.unregister()
    QgsProject.instance().clear()
    app.processingRegistry().removeProvider(provider)
    # No exitQgis: Python objects that outlive it crash the interpreter on its way out.


@pytest.fixture
def project(application):
    """The project, empty before and after."""
    QgsProject.instance().clear()
    yield QgsProject.instance()
    QgsProject.instance().clear()


@pytest.fixture(scope="session")
def surveys(engine_program, tmp_path_factory):
    """Folder of before.laz and after.laz: sixty metres of street with changes of every kind."""
    folder = tmp_path_factory.mktemp("surveys")
    options = ["--seed", "1", "--length", "60", "--density", "0.5", "--plain", "--overwrite"]
    subprocess.run([engine_program, "bench", "simulate", *options, folder], check=True, stdout=subprocess.DEVNULL)
    return folder


@pytest.fixture(scope="session")
def qgis_process(engine_program):
    """``qgis_process(algorithm, **parameters)``: its results; the plugin enabled as a user would enable it."""

    def call(*arguments):
        done = subprocess.run(["qgis_process", *arguments], capture_output=True, encoding="utf-8", timeout=500)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    call("plugins", "enable", "loda_change")

    def run(algorithm, **parameters):
        given = [f"--{name}={value}" for name, value in parameters.items()]
        return json.loads(call("run", f"loda:{algorithm}", "--json", *given))["results"]

    run.call = call
    return run


@pytest.fixture(scope="session")
def detected(qgis_process, surveys, tmp_path_factory):
    """What *Detect changes* gave in `qgis_process`: the one whole run that the tests share."""
    folder = tmp_path_factory.mktemp("detected") / "street"
    return qgis_process("detectchanges", BEFORE=surveys / "before.laz", AFTER=surveys / "after.laz", OUTPUT=folder)


@pytest.fixture
def run(application):
    """``run(algorithm, parameters, feedback)`` as the toolbox runs it; its results and context."""
    import processing

    def call(algorithm, parameters, feedback=None):
        context = QgsProcessingContext()
        context.setProject(QgsProject.instance())
        given = {name: str(value) if isinstance(value, Path) else value for name, value in parameters.items()}
        return processing.run(f"loda:{algorithm}", given, feedback=feedback or Listening(), context=context), context

    return call
