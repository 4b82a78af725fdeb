"""Simulated blocks: a procedural street or a piece of a city, edits with labels, ray-cast surveys, files with truth.

``scene``, ``objects``, ``furniture`` and ``town`` say what stands where, ``edits`` and ``clutter`` what changed,
``traffic`` who passes by, ``plan`` how each survey is made and ``sensor`` how its pulses come back, ``evidence`` which
instances the surveys allow to be judged; ``block`` puts both surveys and the truth together, ``writer`` makes files.
"""

from __future__ import annotations

from loda_pdal.benchmark.simulate.block import (
    SimulatedBlock,
    SimulatedSurvey,
    fused_block,
    simulate_block,
)
from loda_pdal.benchmark.simulate.options import Reality, SimulationOptions
from loda_pdal.benchmark.simulate.writer import write_block

__all__ = [
    "Reality",
    "SimulatedBlock",
    "SimulatedSurvey",
    "SimulationOptions",
    "fused_block",
    "simulate_block",
    "write_block",
]
