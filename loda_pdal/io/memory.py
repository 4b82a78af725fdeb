"""How much memory a run will need, and whether it is there."""

from __future__ import annotations

from pathlib import Path

from loda_pdal.model.errors import MemoryLimitError

BYTES_AT_START = 650_000_000
"""What the libraries, the kernels and the parts of the surveys in hand take, however many points there are."""

BYTES_PER_POINT = 12
"""Per raw point: the number of its voxel, twice while noise is taken out. Points themselves are not held."""

BYTES_PER_VOXEL = 1050
"""Peak per fused point: neighbour lists and graph of the superpoints, features, occupancy of both epochs.

Measured: 0.48 GB for next to nothing, 1.73 GB for 1.6 million raw and as many fused points, 1.80 GB for 20 and
1.9 million; the constants ask for a third more, because a city has more surfaces than the simulated street.
"""

SURFACES_PER_CELL = 2.5
"""Fused points above one cell of the plan where a city is dense (the simulated street has 1.3)."""


def estimate_memory(n_before: int, n_after: int, *, area_m2: float | None = None, leaf_m: float = 0.25) -> int:
    """Bytes that a run will need at its peak.

    Parameters
    ----------
    n_before, n_after : int
        Raw points of each epoch.
    area_m2 : float, optional
        Area in plan of the larger survey, which bounds the fused points; without it every point is one.
    leaf_m : float, m
        Edge of the finest voxel (`FuseParams.leaf_m`).
    """
    most = float("inf") if area_m2 is None else SURFACES_PER_CELL * area_m2 / leaf_m**2
    n_voxels = min(n_before, most) + min(n_after, most)
    return int(BYTES_AT_START + BYTES_PER_POINT * (n_before + n_after) + BYTES_PER_VOXEL * n_voxels)


def available_memory() -> int | None:
    """Bytes this process may still take, the limit of a container included; None where the system does not say."""
    limits = [value for value in (_from_meminfo(), _from_cgroup()) if value is not None]
    return min(limits) if limits else None


def check_memory(needed: int, max_memory: int | None = None) -> None:
    """`MemoryLimitError` where ``needed`` bytes are more than ``max_memory``, or than what is free if that is None."""
    limit = available_memory() if max_memory is None else max_memory
    if limit is None or needed <= limit:
        return
    allowed = "are free" if max_memory is None else "are allowed by --max-memory"
    raise MemoryLimitError(
        f"The run would need about {_gigabytes(needed)}, of which {_gigabytes(limit)} {allowed}.",
        "Cut the surveys into tiles (for example with `pdal tile`) and run them one by one, or raise --max-memory.",
        "memory-limit",
    )


def _gigabytes(n_bytes: int) -> str:
    return f"{n_bytes / 1e9:.1f} GB"


def _from_meminfo() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    kilobytes = [int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    return kilobytes[0] * 1024 if kilobytes else None


def _from_cgroup() -> int | None:
    """What a container's limit leaves (cgroup v2, then v1); file cache that can be dropped counts as free."""
    for folder, limit, used, cache in (
        ("/sys/fs/cgroup", "memory.max", "memory.current", "inactive_file"),
        ("/sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ):
        try:
            allowed, taken = int(Path(folder, limit).read_text()), int(Path(folder, used).read_text())
            stat = dict(line.split() for line in Path(folder, "memory.stat").read_text().splitlines())
        except (OSError, ValueError):  # no such cgroup, or no limit ("max")
            continue
        return max(0, allowed - taken + int(stat.get(cache, 0)))
    return None
