"""One survey as it was read: local coordinates for the method, everything else kept for the output."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.frame import LocalFrame


@dataclass(frozen=True)
class Survey:
    """All points of one epoch.

    Attributes
    ----------
    xyz : (n, 3) float64, m
        Local coordinates in ``frame``, on the local grid, in file order.
    frame : LocalFrame
        Shared by both epochs of a run.
    path : str
        Where it came from; empty for arrays.
    source : Any
        The reader's own record (laspy), from which the output keeps every dimension; None for arrays.
    notes : list of str
        What the reader wants told: units converted, CRS assumed, points dropped from nothing.
    """

    xyz: FloatArray
    frame: LocalFrame = field(default_factory=lambda: LocalFrame((0, 0, 0)))
    path: str = ""
    source: Any = None
    notes: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.xyz)
