"""Where the sensor was, by time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loda_pdal.model.cloud import BoolArray, FloatArray, to_local_grid

LONGEST_GAP_S = 5.0
"""Between positions farther apart than this in time nothing is interpolated: the sensor was off, or turned round."""

SLACK_S = 0.1
"""A return this much before the first or after the last position of a pass is taken to be measured there."""


class Positions(NamedTuple):
    """Where the sensor was at some times.

    ``xyz`` (n, 3) m on the local grid, ``along`` (n,) m of the way from its first position, and ``is_known`` (n,):
    whether the trajectory knows; the others mean nothing where it does not.
    """

    xyz: FloatArray
    along: FloatArray
    is_known: BoolArray


@dataclass(frozen=True)
class Trajectory:
    """The way of the sensor of one survey.

    Attributes
    ----------
    time : (k,) float64, s
        GPS time as in the survey's points, ascending, no time twice; two positions at least.
    xyz : (k, 3) float64, m
        Position of the sensor, local coordinates.
    path : str
        Where it came from; empty for arrays.
    """

    time: FloatArray
    xyz: FloatArray
    path: str = ""

    def __post_init__(self) -> None:
        if len(self.time) < 2 or len(self.time) != len(self.xyz) or not np.all(np.diff(self.time) > 0):
            raise ValueError("a trajectory needs two positions at least, at ascending times")

    def at(self, time: FloatArray) -> Positions:
        """Positions at the times (n,) s, interpolated between those listed."""
        last = np.searchsorted(self.time, time, side="right") - 1
        i = np.clip(last, 0, len(self.time) - 2)
        since, until, step = time - self.time[i], self.time[i + 1] - time, self.time[i + 1] - self.time[i]
        share = np.clip(since / step, 0.0, 1.0)
        is_within = (since >= 0) & (until >= 0) & (step <= LONGEST_GAP_S)
        is_known = is_within | (np.minimum(np.abs(since), np.abs(until)) <= SLACK_S)
        share = np.where(is_within, share, np.rint(share))
        xyz = to_local_grid(self.xyz[i] + share[:, None] * (self.xyz[i + 1] - self.xyz[i]))
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.xyz, axis=0), axis=1))])
        return Positions(xyz, way[i] + share * (way[i + 1] - way[i]), is_known)
