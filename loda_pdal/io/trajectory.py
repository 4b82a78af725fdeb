"""Reading where the sensor was, and checking that this is the trajectory of a survey."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np

from loda_pdal.io.las_points import reading, unreadable
from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.errors import InputError
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.trajectory import Trajectory

FURTHEST_M = 10_000.0
"""No returns come from farther than this."""

MIN_SHARE = 0.5
"""Smallest share of a survey's points that its trajectory must know the sensor of."""

COLUMNS = ("time", "x", "y", "z")


@dataclass(frozen=True)
class MapTrajectory:
    """A trajectory as the file has it: ``time`` (k,) s ascending, ``xyz`` (k, 3) full map coordinates."""

    path: str
    time: FloatArray
    xyz: FloatArray

    def local(self, frame: LocalFrame) -> Trajectory:
        """The same in local metres."""
        return Trajectory(self.time, frame.to_local(self.xyz), self.path)


def read_trajectory(path: str | Path) -> MapTrajectory:
    """Positions of the sensor from a CSV with the columns time, x, y and z, or from LAS or LAZ points with GPS time.

    Rows may come in any order; of several at one time the first counts. `InputError` where it is no trajectory.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            is_las = file.read(4) == b"LASF"
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file.", "Check the path.", "input-missing") from error
    except OSError as error:
        raise unreadable(path, error) from error
    rows = _las_rows(path) if is_las else _csv_rows(path)
    if not np.all(np.isfinite(rows)):
        raise InputError(
            f"{path}: holds times or coordinates that are not finite.", "Write it again.", "trajectory-invalid"
        )
    time, first = np.unique(rows[:, 0], return_index=True)
    if len(time) < 2:
        raise InputError(
            f"{path}: holds {len(time)} positions at different times; two are the least.",
            "Give the whole trajectory of the survey.",
            "trajectory-invalid",
        )
    return MapTrajectory(str(path), time, rows[first, 1:])


class TrajectoryCheck:
    """Whether a trajectory belongs to a survey, from its points as they pass by.

    Parameters
    ----------
    trajectory : Trajectory
        In the frame of the points.
    name : str
        Of the survey, for messages.
    """

    def __init__(self, trajectory: Trajectory, name: str) -> None:
        self._trajectory, self._name = trajectory, name
        self._n, self._n_known, self._n_near = 0, 0, 0
        self._times = np.array([np.inf, -np.inf])
        self._low, self._high = np.full(2, np.inf), np.full(2, -np.inf)

    def add(self, xyz: FloatArray, time: FloatArray) -> None:
        """Some more points (k, 3), local m, and their GPS times (k,), s."""
        if len(time) == 0:
            return
        sensor = self._trajectory.at(time)
        is_near = sensor.is_known & (np.linalg.norm(xyz - sensor.xyz, axis=1) <= FURTHEST_M)
        self._n += len(time)
        self._n_known += int(np.count_nonzero(sensor.is_known))
        self._n_near += int(np.count_nonzero(is_near))
        self._times = np.array([min(self._times[0], time.min()), max(self._times[1], time.max())])
        self._low, self._high = np.minimum(self._low, xyz[:, :2].min(axis=0)), np.maximum(self._high, xyz[:, :2].max(0))

    def note(self) -> str:
        """What share of the points it is good for; `InputError` where that is too little."""
        own, path = self._trajectory, self._trajectory.path
        if self._n_known < MIN_SHARE * self._n:
            raise InputError(
                f"{path} knows the sensor at {self._n_known / self._n:.0%} of the points of {self._name}: it covers "
                f"times {own.time[0]:.3f} to {own.time[-1]:.3f} s, the points were measured at {self._times[0]:.3f} to "
                f"{self._times[1]:.3f} s.",
                "Give the trajectory of this survey, with its times counted like the GPS times of the points (seconds "
                "of the week, or adjusted standard GPS time).",
                "trajectory-times",
            )
        if self._n_near < MIN_SHARE * self._n:
            low, high = own.xyz[:, :2].min(axis=0), own.xyz[:, :2].max(axis=0)
            gap = float(np.linalg.norm(np.maximum(np.maximum(low - self._high, self._low - high), 0)))
            raise InputError(
                f"{path} does not run where {self._name} lies: most points are more than {FURTHEST_M / 1000:.0f} km "
                f"from the sensor's place at their time (the areas are {gap / 1000:.0f} km apart).",
                "Give the trajectory in the CRS and the units of the survey.",
                "trajectory-place",
            )
        return f"{path} knows where the sensor was for {self._n_known / self._n:.1%} of the points."


def _las_rows(path: Path) -> FloatArray:
    """Time and full map coordinates (k, 4) of LAS points."""
    with reading(path):
        points = laspy.read(path)
        if "gps_time" not in set(points.point_format.dimension_names):
            raise InputError(
                f"{path}: its points have no GPS time (point format {points.point_format.id}).",
                "Give a point format with GPS time, or a CSV with the columns time, x, y and z.",
                "trajectory-invalid",
            )
        return np.column_stack([points.gps_time, points.x, points.y, points.z]).astype(np.float64)


def _csv_rows(path: Path) -> FloatArray:
    """Time and full map coordinates (k, 4) from the columns of these names; others are passed over."""
    remedy = "Write a CSV whose first line is time,x,y,z: GPS time in s, and the CRS and units of the survey."
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            header = [name.strip().lower() for name in next(csv.reader(file), [])]
            missing = [name for name in COLUMNS if name not in header]
            if missing:
                found = ", ".join(header[:8]) or "nothing"
                raise InputError(
                    f"{path}: has no column {', '.join(missing)}; its first line holds {found}.",
                    remedy,
                    "trajectory-invalid",
                )
            columns = [header.index(name) for name in COLUMNS]
            rows = [[float(row[c]) for c in columns] for row in csv.reader(file) if row]
    except OSError as error:
        raise unreadable(path, error) from error
    except (ValueError, IndexError, csv.Error) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: is no table of numbers ({error}).", remedy, "trajectory-invalid") from error
    return np.array(rows, dtype=np.float64).reshape(-1, 4)
