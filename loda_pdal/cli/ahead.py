"""Loading libraries while the points are read."""

from __future__ import annotations

import importlib
import threading
from contextlib import suppress

METHOD = ("numba", "scipy.optimize", "loda_pdal.pipeline")
WRITERS = ("pandas", "pyogrio.raw", "rasterio.io")
"""What takes long to load, in the order in which a run will want it."""


def import_ahead(*names: str) -> None:
    """Import modules in a thread of their own; a process that ends waits for the one in hand, not for the others."""
    threading.Thread(target=_import, args=(names,), name="imports").start()


def _import(names: tuple[str, ...]) -> None:
    for name in names:
        if not threading.main_thread().is_alive():
            return
        with suppress(ImportError):  # who needs it says so
            importlib.import_module(name)
