"""Where the engine is: the settings, LODA_PYTHON, the managed environment in the user profile, PATH."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import NamedTuple

from .errors import EngineError, EngineMissing
from .process import answer, clean_environment

OLDEST = (0, 1, 0)
"""The first version that this plugin understands."""

HOW_TO_INSTALL = "Open Settings, Options, LoDA Change and press Install, or choose the program loda-pdal there by hand."


class Engine(NamedTuple):
    """A command line that begins the engine's, and where it was found."""

    command: list
    origin: str


def find_engine(chosen, managed_folder, environment=None):
    """The engine to use; `EngineMissing` where there is none.

    Parameters
    ----------
    chosen : str
        Program or Python named in the settings; empty where none is.
    managed_folder : Path
        Where `install` puts its environments.
    """
    environment = os.environ if environment is None else environment
    if chosen:
        if not Path(chosen).is_file():
            raise EngineMissing(f"The settings name {chosen} as engine, which does not exist.", HOW_TO_INSTALL)
        return Engine(_command(chosen), "chosen in the settings")
    python = environment.get("LODA_PYTHON")
    if python:
        if not Path(python).is_file():
            raise EngineMissing(f"LODA_PYTHON names {python}, which does not exist.", "Correct or unset it.")
        return Engine([python, "-m", "loda_pdal"], "LODA_PYTHON")
    managed = managed_program(managed_folder)
    if managed is not None:
        return Engine([str(managed)], "installed by the plugin")
    found = shutil.which("loda-pdal", path=environment.get("PATH"))
    if found:
        return Engine([found], "on PATH")
    raise EngineMissing("The engine loda-pdal is not installed.", HOW_TO_INSTALL)


def managed_program(folder):
    """The program of the environment that `install` made last, or None."""
    try:
        name = (Path(folder) / "current").read_text(encoding="utf-8").strip()
    except OSError:
        return None
    program = program_in(Path(folder) / name)
    return program if program.is_file() else None


def program_in(environment, name="loda-pdal"):
    """Path of a program of a virtual environment."""
    return environment / "Scripts" / f"{name}.exe" if os.name == "nt" else environment / "bin" / name


def engine_version(engine, timeout_s=30.0):
    """Version of an engine as text; `EngineError` where it does not answer or is too old."""
    text = answer([*engine.command, "--version"], timeout_s).strip().splitlines()
    words = text[-1].split() if text else []
    if len(words) != 2 or words[0] != "loda-pdal":
        raise EngineError(f"{engine.command[0]} is not loda-pdal.", HOW_TO_INSTALL)
    if _numbers(words[1]) < OLDEST:
        oldest = ".".join(map(str, OLDEST))
        raise EngineError(f"loda-pdal {words[1]} is too old; this plugin needs {oldest} or later.", HOW_TO_INSTALL)
    return words[1]


def find_python(environment=None):
    """A Python 3.11 or later that can make environments; `EngineMissing` where there is none."""
    environment = clean_environment(environment)
    names = [
        environment.get("LODA_PYTHON", ""),
        *(f"python3.{minor}" for minor in (13, 12, 11, 14)),
        "python3",
        "python",
    ]
    test = "import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))"
    for name in names:
        found = shutil.which(name, path=environment.get("PATH")) if name else None
        if found:
            try:
                answer([found, "-c", test])
            except EngineError:
                continue
            return found
    raise EngineMissing(
        "There is no Python 3.11 or later with the module venv on this computer.",
        "Install it (Debian, Ubuntu: apt install python3-venv), then try again.",
    )


def _command(program):
    is_python = Path(program).name.lower().startswith("python")
    return [program, "-m", "loda_pdal"] if is_python else [program]


def _numbers(version):
    parts = []
    for part in version.split("."):
        digits = "".join(c for c in part if c.isdigit())
        if not digits:
            break
        parts.append(int(digits))
    return tuple(parts)
