"""Object-level change detection between two LiDAR surveys, with an explicit limit of detection.

    from loda_pdal import detect_changes, read_epochs, write_outputs

    surveys = read_epochs("before.laz", "after.laz")
    result = detect_changes(surveys.before, surveys.after)
    write_outputs(result, surveys, "changes")

The names load when they are first used: importing the package costs next to nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from loda_pdal.io.las import read_epochs
    from loda_pdal.io.outputs import write_outputs
    from loda_pdal.params import Parameters
    from loda_pdal.pipeline import detect_changes
    from loda_pdal.preset_choice import preset_for

__version__ = "0.1.0"
__all__ = ["Parameters", "__version__", "detect_changes", "preset_for", "read_epochs", "write_outputs"]

_HOMES = {
    "Parameters": "loda_pdal.params",
    "detect_changes": "loda_pdal.pipeline",
    "preset_for": "loda_pdal.preset_choice",
    "read_epochs": "loda_pdal.io.las",
    "write_outputs": "loda_pdal.io.outputs",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
