"""A virtual environment of the plugin's own with the engine in it; QGIS's Python stays as it is."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

from .errors import EngineError
from .locate import Engine, engine_version, find_python, program_in
from .process import death, run

PACKAGE = "loda-pdal"


def install(folder, source, said, is_cancelled=lambda: False, python=None):
    """Install the engine anew and use it from now on; an earlier one is kept until the new one works.

    Parameters
    ----------
    folder : Path
        Holds the environments; made where it does not exist.
    source : str
        Empty for the package index, else a folder with the project or a wheel.
    said : callable
        Called with every line that the installation writes.

    Returns
    -------
    Engine
        The new engine.
    """
    if source and not Path(source).exists():
        raise EngineError(f"{source} does not exist.", "Choose the folder of loda-pdal, or a wheel of it.")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    python = python or find_python()
    environment = folder / f"engine-{time.time_ns()}"
    try:
        said(f"Making an environment with {python}")
        _call([python, "-m", "venv", str(environment)], said, is_cancelled)
        pip = [str(program_in(environment, "python")), "-m", "pip", "--disable-pip-version-check", "install"]
        _call([*pip, "--no-input", source or PACKAGE], said, is_cancelled)
        engine = Engine([str(program_in(environment))], "installed by the plugin")
        said(f"loda-pdal {engine_version(engine)} works")
    except BaseException:
        shutil.rmtree(environment, ignore_errors=True)
        raise
    part = folder / "current.part"
    part.write_text(environment.name, encoding="utf-8")
    part.replace(folder / "current")
    for other in folder.glob("engine-*"):
        if other != environment:
            shutil.rmtree(other, ignore_errors=True)
    return engine


def _call(command, said, is_cancelled):
    code, last = run(command, lambda stream, line: said(line), is_cancelled)
    if code != 0:
        error = death(code, last)
        raise EngineError(
            f"The installation failed: {error.message.split(': ', 1)[-1]}", "See the lines above; is there a network?"
        )
