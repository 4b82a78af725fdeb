"""Simulated street blocks: a procedural street, edits with labels, a ray-cast vehicle LiDAR, files with truth.

``scene`` and ``objects`` say what stands where, ``edits`` what changed, ``sensor`` how it was measured, ``block``
puts both surveys and the truth together, ``writer`` makes files of them.
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
