"""Compiling every kernel once, before the first survey is waited for.

A small scene that sends something through every kernel is read, searched for changes with every preset, and a result is
written. What gets compiled on the way is kept in the cache folder of `loda_pdal.kernels`, for all processes to come.
"""

from __future__ import annotations

import gc
import logging
import pkgutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import laspy
import numpy as np
from numba.core import event
from numba.core.dispatcher import Dispatcher
from pyproj import CRS

import loda_pdal.kernels
from loda_pdal.io.las import read_epochs
from loda_pdal.io.outputs import write_outputs
from loda_pdal.kernels import mark_cache_warm
from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.pair import Pair
from loda_pdal.params import PRESETS, Parameters
from loda_pdal.pipeline import Progress, detect_changes

logger = logging.getLogger(__name__)

COMPILING = "compiling kernels, once"
"""What progress says meanwhile."""

NOTICE = "Compiling kernels, once: that takes about half a minute."
"""What is said before."""

EPSG, PLACE = 28992, np.array([121_000.0, 487_000.0, 0.0])
"""Where the scene is said to be."""

SIMULATION = frozenset({"loda_pdal.kernels.rays"})
"""Kernels that only the simulator of benchmarks runs; it compiles them itself."""


class Compiled(NamedTuple):
    """How many kernels were compiled (for all types together) and in how many seconds."""

    n: int
    seconds: float


def compile_kernels(folder: Path, progress: Progress | None = None) -> Compiled:
    """Compile what is not in the cache folder yet, and mark that as complete (`is_cache_warm`).

    Parameters
    ----------
    folder : Path
        Where a small run may leave its files.
    progress : callable, optional
        ``progress(done, total, text)``, called whenever a kernel has been compiled.
    """
    start = time.perf_counter()
    with _uncollected(), event.install_listener("numba:compile", _Count(progress)) as count:
        surveys = read_epochs(*write_scene(folder), trajectories=write_trajectories(folder))
        for preset in PRESETS:
            result = detect_changes(surveys.before, surveys.after, Parameters.preset(preset))
        write_outputs(result, surveys, folder / "result", overwrite=True)
    mark_cache_warm()
    return Compiled(len(count.compiled), time.perf_counter() - start)


@contextmanager
def _uncollected() -> Iterator[None]:
    """No search for garbage meanwhile: a compiler makes millions of small objects that all stay."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def kernels() -> list[Any]:
    """Every compiled function of the method (numba's ``Dispatcher``), by module and name."""
    found = []
    for module in pkgutil.iter_modules(loda_pdal.kernels.__path__, "loda_pdal.kernels."):
        if module.name not in SIMULATION:
            values = vars(import_module(module.name)).values()
            found += [v for v in values if isinstance(v, Dispatcher) and v.py_func.__module__ == module.name]
    return sorted(found, key=_name)


def _name(kernel: Any) -> str:
    return f"{kernel.py_func.__module__}.{kernel.py_func.__qualname__}"


class _Count(event.Listener):  # type: ignore[misc]
    """Counts our kernels as they get compiled, and logs what each took; numba compiles one at a time."""

    def __init__(self, progress: Progress | None) -> None:
        self.compiled: set[str] = set()
        self._ours = {_name(kernel) for kernel in kernels()}
        self._progress = progress or (lambda done, total, text: None)
        self._begun: list[float] = []
        self._in_callees = [0.0]

    def on_start(self, event: Any) -> None:
        """A kernel is to be compiled, maybe amid one that calls it."""
        self._begun.append(time.thread_time())
        self._in_callees.append(0.0)

    def on_end(self, event: Any) -> None:
        """It is."""
        seconds = time.thread_time() - self._begun.pop()
        own = seconds - self._in_callees.pop()
        self._in_callees[-1] += seconds
        kernel = event.data["dispatcher"]
        logger.debug("%5.2f s  %s(%s)", own, _name(kernel), ", ".join(map(str, event.data["args"])))
        if _name(kernel) in self._ours - self.compiled:
            self.compiled.add(_name(kernel))
            self._progress(len(self.compiled), len(self._ours), COMPILING)


def write_scene(folder: Path) -> Pair[Path]:
    """Two surveys of 24 x 24 m in files: a house that gets a storey, a tree, and a car that leaves. The same every
    time."""
    random = np.random.default_rng(0)
    ground = _box(random, (0, 0, 0), (24, 24, 0), 16000)
    house, storey = _box(random, (2, 3, 0), (10, 9, 4), 9000), _box(random, (2, 3, 4), (6, 9, 7), 4000)
    tree = random.normal((18, 18, 4), 0.8, (2500, 3))
    pole = _box(random, (14, 6, 0), (14.1, 6.1, 4), 300)
    car = _box(random, (15, 12, 0.3), (19, 13.8, 1.6), 1500)
    scene = Pair([ground, house, tree, pole, car], [ground, house, storey, tree, pole])
    paths = Pair(folder / "before.laz", folder / "after.laz")
    for path, parts in zip(paths, scene, strict=True):
        xyz = np.concatenate(parts)
        _write_laz(path, xyz + random.normal(0, 0.01, xyz.shape) + PLACE)
    return paths


def write_trajectories(folder: Path) -> Pair[Path | None]:
    """Where the sensor of the scene was: beside it, then above it."""
    paths = Pair(folder / "before_trajectory.csv", folder / "after_trajectory.csv")
    rows = [(0, 12, -5, 2.5), (1, 12, -4, 2.5), (2, 12, 12, 60)]
    lines = ["time,x,y,z", *(",".join(str(v) for v in (t, *(PLACE + xyz))) for t, *xyz in rows)]
    for path in paths:
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return Pair(*paths)


def _box(random: np.random.Generator, low: tuple[float, ...], high: tuple[float, ...], n: int) -> FloatArray:
    """``n`` points (n, 3) on the faces of a box that can be seen: all but the lower one."""
    at = random.random((n, 3))
    size = np.subtract(high, low)
    areas = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1] / 2])
    face = random.choice(3, n, p=areas / areas.sum())
    at[np.arange(n), face] = np.where(face == 2, 1.0, np.round(at[np.arange(n), face]))
    return np.asarray(low + at * size)


def _write_laz(path: Path, xyz: FloatArray) -> None:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.001), PLACE
    header.add_crs(CRS.from_epsg(EPSG))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.gps_time = np.linspace(0, 2, len(xyz))
    las.write(str(path))
