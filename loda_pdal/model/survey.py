"""One survey as it was read: points handed out part by part, in local coordinates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np

from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.extent import Extent
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.trajectory import Trajectory

PART = 400_000
"""Points of one part: what is held of a survey at a time, and a multiple of the chunks of LAZ files."""


class PointSource(Protocol):
    """Points that are elsewhere, in a file, and can be gone through again and again."""

    def __len__(self) -> int: ...

    def coordinates(self) -> Iterator[FloatArray]:
        """Full map coordinates (k, 3), part by part, in the same order every time."""
        ...

    def gps_times(self) -> Iterator[FloatArray]:
        """GPS times (k,) s, part by part, in the order of the points."""
        ...


@dataclass(frozen=True)
class Survey:
    """All points of one epoch.

    Attributes
    ----------
    points : (n, 3) float64, m, or PointSource
        Local coordinates in ``frame``, on the local grid; or the file that holds them.
    frame : LocalFrame
        Shared by both epochs of a run.
    path : str
        Where it came from; empty for arrays.
    notes : list of str
        What the reader wants told: units converted, CRS assumed, points dropped from nothing.
    dates : (str or None, str or None)
        First and last day of measurement (ISO, UTC), where the points are dated.
    n_bytes, sha256 : int or None, str or None
        Size and checksum of the file as it was read.
    known_extent : Extent or None
        What the reader found in passing; worked out when first asked for if left out.
    trajectory : Trajectory or None
        Where the sensor was, at the points' GPS times; None where that is not known.
    gps_time : (n,) float64 or None, s
        Of points in memory that come with a trajectory.
    """

    points: FloatArray | PointSource
    frame: LocalFrame = field(default_factory=lambda: LocalFrame((0, 0, 0)))
    path: str = ""
    notes: list[str] = field(default_factory=list)
    dates: tuple[str | None, str | None] = (None, None)
    n_bytes: int | None = None
    sha256: str | None = None
    known_extent: Extent | None = None
    trajectory: Trajectory | None = None
    gps_time: FloatArray | None = None

    def __post_init__(self) -> None:
        if self.trajectory is not None and self.source is None and self.gps_time is None:
            raise ValueError("points in memory that come with a trajectory need their GPS times")

    def __len__(self) -> int:
        return len(self.points)

    @property
    def source(self) -> PointSource | None:
        """The file that holds the points; None where they are in memory."""
        return None if isinstance(self.points, np.ndarray) else self.points

    @property
    def xyz(self) -> FloatArray:
        """Local coordinates (n, 3) of all points, m, in their order; read anew where they are in a file."""
        if isinstance(self.points, np.ndarray):
            return self.points
        return np.concatenate([np.empty((0, 3)), *self.parts()])

    @cached_property
    def extent(self) -> Extent:
        """Where the points are."""
        return Extent.of(self.parts()) if self.known_extent is None else self.known_extent

    def parts(self) -> Iterator[FloatArray]:
        """Local coordinates (k, 3), m, part by part in the order of the points; none is longer than `PART`."""
        if isinstance(self.points, np.ndarray):
            for start in range(0, len(self.points), PART):
                yield self.points[start : start + PART]
        else:
            for xyz in self.points.coordinates():
                yield self.frame.to_local(xyz)

    def gps_times(self) -> Iterator[FloatArray]:
        """GPS times (k,) s, part by part in the order of the points, where there is a trajectory."""
        if self.gps_time is not None:
            for start in range(0, len(self.gps_time), PART):
                yield self.gps_time[start : start + PART]
        elif self.source is not None:
            yield from self.source.gps_times()
