"""Does LoD95 mean 95 %: the share of unchanged surface whose measured displacement stays below it (METHOD 3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loda_pdal.benchmark.calibrate import surveys_of
from loda_pdal.benchmark.simulate import SimulationOptions, simulate_block
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.params import Parameters
from loda_pdal.pipeline import fuse_epochs, into_frame, limit_of_detection, register_epochs, resolve

LEVEL = 0.9
UPRIGHT = 0.3
"""Surfaces with |n.z| above the first are level (ground, flat roofs), below the second upright (facades)."""


class Coverage(NamedTuple):
    """Valid cells of one kind of surface, the share within LoD95, and the median LoD95 (m)."""

    n_cells: int
    share: float
    median_m: float


def unchanged_grid(seed: int, parameters: Parameters) -> LodGrid:
    """LoD grid of a simulated street that was surveyed twice without edits, with fresh noise, drift and foliage."""
    surveys = surveys_of(simulate_block(seed, SimulationOptions(has_edits=False)))
    p = resolve(parameters, surveys)
    fused = fuse_epochs(surveys, p)
    registration = register_epochs(fused, p)
    return limit_of_detection(into_frame(fused, registration), registration, p)


def coverage_of(lod: LodGrid) -> dict[str, Coverage]:
    """Coverage over all valid cells and by the direction of the surface."""
    rise = np.abs(lod.normal[:, 2])
    kinds = {
        "all": np.ones(len(rise), np.bool_),
        "level": rise > LEVEL,
        "upright": rise < UPRIGHT,
        "slanted": (rise <= LEVEL) & (rise >= UPRIGHT),
    }
    is_within = np.abs(lod.displacement) <= lod.lod95
    found = {}
    for name, is_kind in kinds.items():
        inside = is_kind & lod.is_valid
        n = int(inside.sum())
        share = float(is_within[inside].mean()) if n else float("nan")
        found[name] = Coverage(n, share, float(np.median(lod.lod95[inside])) if n else float("nan"))
    return found
