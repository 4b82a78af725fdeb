"""What a run costs: seconds and memory of `detect` by the size of the block (paper, section 5 "Efficiency").

Every run is a process of its own, so its peak memory is that of one run. Seconds are wall-clock, taken from the
progress that `detect` reports; their growth is fitted as a power of the number of points.
"""

from __future__ import annotations

import json
import math
import os
import platform
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from statistics import fmean, linear_regression, median
from typing import Any

from loda_pdal.benchmark.metrics import markdown_table
from loda_pdal.io.las import inspect
from loda_pdal.model.errors import InputError
from loda_pdal.pipeline import STEPS

LEAF_M = 0.25
"""Voxel of the fused map (paper, section 4.1)."""

POINTS_PER_M = 2260
"""Fused points, both epochs together, in a metre of simulated street."""

BREAKDOWN = {
    "read": (),
    "R": ("fuse", "register", "ground", "lod"),
    "S": ("superpoints", "semantics", "instances"),
    "M": ("proxies", "objects"),
    "C": ("changes", "ground_changes"),
    "write": ("result",),
}
"""Our steps by the paper's parts: registration, segmentation, matching, change analysis. ``read`` is all before the
first step, program start included; ``write`` all after the last."""

QUIET_LOAD = 0.5
"""Load average above which a machine is not idle."""


@dataclass(frozen=True)
class Run:
    """One run of `detect` on one block: seconds by part (`BREAKDOWN`) and in all, seconds of processor time, peak
    resident memory (GB, 10^9 bytes), and instances of both epochs off the ground."""

    parts: dict[str, float]
    total_s: float
    cpu_s: float
    peak_gb: float
    instances: int


@dataclass(frozen=True)
class BlockProfile:
    """All runs on one block, and its fused points, both epochs together."""

    name: str
    points: int
    runs: list[Run]

    def median_of(self, value: Callable[[Run], float]) -> float:
        """Median of one figure over the runs."""
        return median(value(run) for run in self.runs)


@dataclass(frozen=True)
class Profile:
    """Runs on blocks of growing size, and the machine they ran on."""

    blocks: list[BlockProfile]
    machine: dict[str, Any]

    @property
    def exponent(self) -> float | None:
        """b in seconds = a * points^b, by least squares on the logarithms of the medians; None for one block."""
        return self._growth_of(lambda run: run.total_s)

    @property
    def cpu_exponent(self) -> float | None:
        """The same of processor time."""
        return self._growth_of(lambda run: run.cpu_s)

    @property
    def gb_per_million(self) -> float | None:
        """How much memory a million more points take, by least squares on the medians; None for one block."""
        peaks = [block.median_of(lambda run: run.peak_gb) for block in self.blocks]
        return slope_of([block.points / 1e6 for block in self.blocks], peaks)

    def _growth_of(self, value: Callable[[Run], float]) -> float | None:
        sizes = [math.log(block.points) for block in self.blocks]
        return slope_of(sizes, [math.log(block.median_of(value)) for block in self.blocks])

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain values."""
        fits = {
            "exponent": self.exponent,
            "cpu_exponent": self.cpu_exponent,
            "gb_per_million_points": self.gb_per_million,
        }
        return {"machine": self.machine, "fits": fits, "blocks": [asdict(block) for block in self.blocks]}

    def to_markdown(self) -> str:
        """The paper's table, and below it the fits and the machine."""
        header = ["Block", "Pts (M)", "Inst", "R/S/M/C (s)", "read, write (s)", "Total (s)", "CPU (s)", "Peak (GB)"]
        lines = [markdown_table(header, [_row(block) for block in self.blocks]), ""]
        lines.append(
            "Points are fused (0.25 m) and those of both epochs together, instances too. Medians; runs per block: "
            f"{min(len(block.runs) for block in self.blocks)}, each a process of its own from LAZ to all outputs."
        )
        if self.exponent is not None and self.cpu_exponent is not None and self.gb_per_million is not None:
            lines.append(
                f"Total time grows with points^{self.exponent:.2f}, processor time with "
                f"points^{self.cpu_exponent:.2f}, memory by {self.gb_per_million:.2f} GB per million points."
            )
        m = self.machine
        lines.append(
            f"Machine: {m['cpu']}, {m['processors']} processors, {m['memory_gb']:.0f} GB; {m['system']}; Python "
            f"{m['python']}, numba {m['numba']}, numpy {m['numpy']}, loda-pdal {m['loda_pdal']}; `{m['options']}`. "
            f"Load average {m['load_before']:.1f} before, {m['load_after']:.1f} after."
        )
        if m["load_before"] > QUIET_LOAD:
            lines.append("**The machine was busy before the first run: these times are not to be quoted.**")
        return "\n".join(lines)


def profile_detect(
    folder: Path,
    sizes: Sequence[float],
    *,
    repeats: int = 3,
    seed: int = 40,
    options: Sequence[str] = (),
    say: Callable[[str], None] = lambda text: None,
) -> Profile:
    """Run `detect` on simulated streets of growing length.

    Parameters
    ----------
    folder : Path
        Keeps the blocks, so that they are simulated once; ``profile.json`` and ``profile.md`` are written there.
    sizes : sequence of float
        Million fused points of each block, both epochs together.
    repeats : int
        Runs per block. All blocks are run once before any is run again, so that a busy minute hits one run of each.
    seed : int
        Of the street.
    options : sequence of str
        More options for ``loda-pdal detect``.
    say : callable
        Told what is going on.
    """
    blocks = [prepared_block(folder, size, seed, say) for size in sizes]
    machine = {**_machine(), "options": " ".join(["detect", *options]), "load_before": os.getloadavg()[0]}
    runs: dict[Path, list[Run]] = {block: [] for block in blocks}
    for _ in range(repeats):
        for block in blocks:
            runs[block].append(run_detect(block, folder / "result", options))
            say(f"{block.name}: {runs[block][-1].total_s:.1f} s, {runs[block][-1].peak_gb:.2f} GB")
    machine["load_after"] = os.getloadavg()[0]
    found = Profile([BlockProfile(block.name, _points(block), runs[block]) for block in blocks], machine)
    (folder / "profile.json").write_text(json.dumps(found.to_dict(), indent=2) + "\n", encoding="utf-8")
    (folder / "profile.md").write_text(found.to_markdown() + "\n", encoding="utf-8")
    return found


def run_detect(block: Path, out: Path, options: Sequence[str] = ()) -> Run:
    """One run in a process of its own on the ``before.laz`` and ``after.laz`` of a folder, timed by its progress."""
    surveys = [str(block / "before.laz"), str(block / "after.laz")]
    command = ["detect", *surveys, "-o", str(out), "--overwrite", "--progress", "json", *options]
    start = time.perf_counter()
    begun: dict[str, float] = {}
    with subprocess.Popen(_ourselves(*command), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            event = json.loads(line)
            if event["event"] == "progress":
                begun.setdefault(event["stage"], time.perf_counter() - start)
            elif event["event"] == "error":
                raise InputError(f"detect failed on {block}: {event['message']}", event["remedy"], "profile-failed")
        _, status, usage = os.wait4(process.pid, 0)
        total = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise InputError(
            f"detect failed on {block}.", f"Run it by hand: loda-pdal {' '.join(command)}", "profile-failed"
        )
    return Run(
        _parts(begun, total), total, usage.ru_utime + usage.ru_stime, _gigabytes(usage.ru_maxrss), _instances(out)
    )


def slope_of(x: Sequence[float], y: Sequence[float]) -> float | None:
    """Slope of the least-squares line through points; None where one cannot be told."""
    return linear_regression(x, y).slope if len(set(x)) > 1 else None


def _parts(begun: dict[str, float], total: float) -> dict[str, float]:
    """Seconds of each part of `BREAKDOWN`, given when each step began (by the words that progress shows)."""
    part_of = {step: part for part, steps in BREAKDOWN.items() for step in steps}
    starts = [("read", 0.0), *((part_of[step], begun[words]) for step, words in STEPS.items()), ("", total)]
    seconds = dict.fromkeys(BREAKDOWN, 0.0)
    for (part, start), (_, end) in pairwise(starts):
        seconds[part] += end - start
    return seconds


def prepared_block(folder: Path, size: float, seed: int = 40, say: Callable[[str], None] = lambda text: None) -> Path:
    """Folder of a block of that many million points, simulated (in a process of its own) if it is not there yet."""
    block = folder / f"seed{seed}_{size:g}M"
    if not (block / "truth.json").is_file():
        length = size * 1e6 / POINTS_PER_M
        say(f"{block.name}: simulating {length:.0f} m of street")
        options = ["--seed", str(seed), "--length", f"{length:.1f}", "--leaf", str(LEAF_M), "--overwrite"]
        subprocess.run(_ourselves("bench", "simulate", str(block), *options), check=True, stdout=subprocess.DEVNULL)
    return block


def _ourselves(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "loda_pdal", *arguments]


def _points(block: Path) -> int:
    return sum(inspect(block / name).n_points for name in ("before.laz", "after.laz"))


def _instances(out: Path) -> int:
    with closing(sqlite3.connect(out / "changes.gpkg")) as database:
        tables = ("instances_before", "instances_after")
        return sum(database.execute(f"SELECT count(*) FROM {table}").fetchone()[0] for table in tables)


def _row(block: BlockProfile) -> list[str]:
    parts = {part: block.median_of(lambda run, part=part: run.parts[part]) for part in BREAKDOWN}  # type: ignore[misc]
    return [
        block.name,
        f"{block.points / 1e6:.2f}",
        f"{fmean(run.instances for run in block.runs):.0f}",
        "/".join(f"{parts[part]:.1f}" for part in "RSMC"),
        f"{parts['read']:.1f}, {parts['write']:.1f}",
        f"{block.median_of(lambda run: run.total_s):.1f}",
        f"{block.median_of(lambda run: run.cpu_s):.1f}",
        f"{block.median_of(lambda run: run.peak_gb):.2f}",
    ]


def _machine() -> dict[str, Any]:
    """What the figures depend on."""
    return {
        "cpu": _cpu_model(),
        "processors": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gb": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9,
        "system": platform.platform(),
        "python": platform.python_version(),
        "numba": version("numba"),
        "numpy": version("numpy"),
        "loda_pdal": version("loda-pdal"),
    }


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def _gigabytes(maxrss: int) -> float:
    """Peak resident memory as the system tells it: KiB, on macOS bytes."""
    return maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9
