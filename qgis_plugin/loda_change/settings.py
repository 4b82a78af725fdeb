"""Which engine QGIS uses: one setting, one folder in the user profile."""

from __future__ import annotations

from pathlib import Path

from qgis.core import QgsApplication, QgsSettings

from .engine import definitions
from .engine.errors import EngineError
from .engine.locate import find_engine

_KEY = "loda_change/engine"


def chosen_program():
    """The program or Python that the user chose by hand; empty where there is none."""
    return str(QgsSettings().value(_KEY, "") or "")


def choose_program(path):
    """Use this program from now on; empty lets the plugin look for one."""
    QgsSettings().setValue(_KEY, path)


def profile_folder():
    """Folder of this plugin in the user profile."""
    return Path(QgsApplication.qgisSettingsDirPath()) / "loda_change"


def managed_folder():
    """Where environments that the plugin made are."""
    return profile_folder() / "engines"


def engine():
    """The engine in use; `EngineMissing` where there is none."""
    return find_engine(chosen_program(), managed_folder())


def engine_definitions():
    """The parameters of the engine in use."""
    try:
        found = engine()
    except EngineError:
        found = None
    return definitions.current(found, profile_folder())
