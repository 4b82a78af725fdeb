"""How each of the two surveys is made: its scanner and its way, the weather, the season, and what it leaves out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loda_pdal.benchmark.simulate.airborne import AirborneSensor, fly
from loda_pdal.benchmark.simulate.options import Reality, SimulationOptions
from loda_pdal.benchmark.simulate.scene import Ground
from loda_pdal.benchmark.simulate.sensor import Conditions, Drive, Scan, Scanner, Sensor, drive
from loda_pdal.model.cloud import BoolArray, FloatArray
from loda_pdal.model.pair import Pair

LEAD_M = 12.0
"""How far before the covered street the vehicle starts, and how far after it it stops."""


@dataclass(frozen=True)
class SurveyPlan:
    """One survey.

    Attributes
    ----------
    scanner : Scanner
    path : Drive
        Where it is when it fires.
    conditions : Conditions
        The weather.
    leaf_share : float
        Share of the trees' leaves that are there.
    low, high : (3,) float64, m
        Corners of what the survey covers, street's frame.
    """

    scanner: Scanner
    path: Drive
    conditions: Conditions
    leaf_share: float
    low: FloatArray
    high: FloatArray

    def covers(self, xyz: FloatArray) -> BoolArray:
        """Which places (n, 3) m the survey covers, (n,)."""
        return np.asarray(((xyz >= self.low) & (xyz < self.high)).all(axis=1))

    def cropped(self, measured: Scan) -> Scan:
        """The returns inside what the survey covers."""
        return measured.chosen(self.covers(measured.xyz))


def draw_plans(
    options: SimulationOptions,
    ground: Ground,
    of_drives: Pair[np.random.Generator],
    of_days: Pair[np.random.Generator],
    of_extent: np.random.Generator,
) -> Pair[SurveyPlan]:
    """Both surveys of a block.

    Parameters
    ----------
    options : SimulationOptions
    ground : Ground
    of_drives, of_days : Pair of numpy.random.Generator
        What each survey's way, and its day, is drawn from.
    of_extent : numpy.random.Generator
        What the extents of both are drawn from.

    Returns
    -------
    Pair of SurveyPlan
    """
    extents = _extents(options, of_extent)
    densities = Pair(options.density, options.density * options.density_after)

    wanted = densities.join(extents, lambda density, extent: (density, extent))
    drawn_from = of_drives.join(of_days, lambda of_drive, of_day: (of_drive, of_day))
    return wanted.join(drawn_from, lambda wish, randoms: _plan(options, ground, *wish, *randoms))


def _extents(options: SimulationOptions, random: np.random.Generator) -> Pair[tuple[float, float]]:
    """Where along the street each survey begins and ends, m."""
    length = options.length_m
    is_partial, which, is_late = random.random(3)
    missing = random.uniform(0.12, 0.3) * length
    if is_partial >= options.reality.partial_share:
        return Pair((0.0, length), (0.0, length))
    part = (missing, length) if is_late < 0.5 else (0.0, length - missing)
    return Pair(part, (0.0, length)) if which < 0.5 else Pair((0.0, length), part)


def _plan(
    options: SimulationOptions,
    ground: Ground,
    density: float,
    extent: tuple[float, float],
    of_drive: np.random.Generator,
    of_day: np.random.Generator,
) -> SurveyPlan:
    reality, half = options.reality, options.width_m / 2
    low, high = np.array([extent[0], -half, -np.inf]), np.array([extent[1], half, np.inf])
    conditions, leaf_share = _day(reality, of_day)
    density *= (1.0 + reality.density_spread) ** of_day.uniform(-1.0, 1.0)
    lanes = _lanes(options, of_day)
    if options.sensor == "airborne":
        plane = AirborneSensor(
            options.length_m, options.width_m, 10.0 * density, noise_m=options.noise_m, strip_shift_m=options.drift_m
        )
        return SurveyPlan(plane, fly(plane, 0.0, of_drive), conditions, leaf_share, low, high)
    car = Sensor(noise_m=options.noise_m, drift_m=options.drift_m, drift_deg=1.5 * options.drift_m)
    car = replace(car, column_share=min(car.column_share * density, 1.0))
    path = drive(car, ground, lanes, LEAD_M, of_drive)
    x = path.position[:, 0]
    is_driven = (x >= extent[0] - LEAD_M) & (x <= extent[1] + LEAD_M)
    return SurveyPlan(car, Drive(*(part[is_driven] for part in path)), conditions, leaf_share, low, high)


def _day(reality: Reality, random: np.random.Generator) -> tuple[Conditions, float]:
    """Weather, and the share of leaves on the trees."""
    is_wet = bool(random.random() < reality.wet_share)
    a, b, c = (float(phase) for phase in random.uniform(0.0, 2 * np.pi, 3))
    leaf_share = float(random.uniform(*reality.leaf_share))
    return Conditions(reality.is_glazed, is_wet, (a, b, c), reality.weakest_signal), leaf_share


def _lanes(options: SimulationOptions, random: np.random.Generator) -> tuple[float, ...]:
    """Where the vehicle drives on the day, m from the middle of the street: one pass per entry."""
    lanes = list(options.lanes)
    aside = random.normal(0.0, 1.0, len(lanes))
    leaves_one, which = random.random(2)
    driven = [
        lane + float(np.clip(options.reality.lane_spread_m * off, -0.5, 0.5))
        for lane, off in zip(lanes, aside, strict=True)
    ]
    if len(driven) > 1 and leaves_one < options.reality.one_lane_share:
        driven.pop(int(which * len(driven)))
    return tuple(driven)
