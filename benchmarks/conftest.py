"""The block that everything is measured on, and how: one process, one number of threads for everybody."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
THREAD_VARIABLES = ("OMP_NUM_THREADS", "LODA_THREADS")

Measure = Callable[..., Any]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--big", action="store_true", help="2 x 0.8 million fused points instead of 2 x 0.2 million.")
    parser.addoption("--threads", type=int, default=len(os.sched_getaffinity(0)), help="Threads of every library.")
    parser.addoption("--rounds", type=int, default=5, help="Rounds of each measurement; medians count.")
    parser.addoption("--blocks", type=Path, default=ROOT / ".cache" / "benchmarks", help="Where blocks are kept.")


def pytest_configure(config: pytest.Config) -> None:
    """Before any library is imported: their thread pools read this once."""
    for name in THREAD_VARIABLES:
        os.environ[name] = str(config.getoption("--threads"))


@pytest.fixture(scope="session")
def threads(request: pytest.FixtureRequest) -> int:
    """Threads that every library is told to use."""
    n: int = request.config.getoption("--threads")
    return n


@pytest.fixture(scope="session")
def block(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the simulated block: before.laz, after.laz and truth.json, one point per 0.25 m voxel."""
    from loda_pdal.benchmark.profile import prepared_block
    from loda_pdal.kernels import is_cache_warm
    from loda_pdal.warmup import compile_kernels

    if not is_cache_warm():
        compile_kernels(tmp_path_factory.mktemp("warmup"))
    return prepared_block(request.config.getoption("--blocks"), 1.6 if request.config.getoption("--big") else 0.4)


@pytest.fixture(scope="session")
def surveys(block: Path) -> Any:
    """Both surveys of the block, read (`Pair` of `Survey`)."""
    from loda_pdal.io.las import read_epochs

    return read_epochs(block / "before.laz", block / "after.laz")


@pytest.fixture(scope="session")
def before(surveys: Any) -> Any:
    """Fused points of the before epoch, (m, 3) float64 m, local."""
    return surveys.before.xyz


@pytest.fixture(scope="session")
def after(surveys: Any) -> Any:
    """Fused points of the after epoch, (m, 3) float64 m, local."""
    return surveys.after.xyz


@pytest.fixture(scope="session")
def raw(after: Any) -> Any:
    """Six returns around every fused point of the after epoch, (6 m, 3): a survey before fusing."""
    random = np.random.default_rng(0)
    return np.repeat(after, 6, axis=0) + random.normal(0.0, 0.05, (6 * len(after), 3))


@pytest.fixture
def measure(request: pytest.FixtureRequest, benchmark: Any) -> Measure:
    """``measure(group, library, function)``: the median of some rounds after one that does not count, and its result.

    The processor time of a round, all threads together, is kept beside it: a library that uses more threads shows.
    """
    rounds = request.config.getoption("--rounds")

    def run(group: str, library: str, function: Callable[[], Any], rounds: int = rounds, **extra: Any) -> Any:
        result = function()
        benchmark.group = group
        start = time.process_time()
        benchmark.pedantic(function, rounds=rounds)
        cpu_s = (time.process_time() - start) / rounds
        benchmark.extra_info.update(library=library, cpu_s=cpu_s, **extra)
        if hasattr(result, "costs"):
            benchmark.extra_info["stages"] = {cost.stage: round(cost.seconds, 2) for cost in result.costs}
        return result

    return run
