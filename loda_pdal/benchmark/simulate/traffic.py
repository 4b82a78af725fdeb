"""Who passes by while the vehicle scans: cars that go along with it or against it, cyclists, people on foot.

What goes along with the scanner is met by pulse after pulse and becomes a long smear; what comes towards it a short
one. None of it belongs to the street: every passer-by is an instance of its own that is left out of the scores.
"""

from __future__ import annotations

import numpy as np

from loda_pdal.benchmark.simulate.furniture import Cyclist, Person
from loda_pdal.benchmark.simulate.objects import Thing
from loda_pdal.benchmark.simulate.scene import Ground, draw_car
from loda_pdal.benchmark.simulate.sensor import Drive
from loda_pdal.benchmark.simulate.world import Mover

CYCLE_Y_M = 2.65
"""Where cyclists ride, m from the middle of the street: between the lanes and the parked vehicles."""

_LANE_Y_M = 1.6
"""Where oncoming cars drive at least."""

_LEAST_GAP_M = 1.8
"""Nobody whose middle would come nearer to the scanner sets out."""

_COMPANION_SHARE = 0.5
"""Passes of the scanner with a car ahead of or behind it."""

_ONCOMING, _CYCLISTS, _WALKERS = 0.07, 0.04, 0.10
"""How many of each set out per second of a pass."""


def draw_traffic(
    path: Drive, ground: Ground, amount: float, walk_y_m: float, random: np.random.Generator
) -> list[Mover]:
    """Passers-by of one survey.

    Parameters
    ----------
    path : Drive
        Of the scanning vehicle.
    ground : Ground
    amount : float
        1 is a quiet street by day, 0 an empty one.
    walk_y_m : float
        How far from the middle of the street people walk.
    random : numpy.random.Generator

    Returns
    -------
    list of Mover
    """
    movers: list[Mover] = []
    pauses = np.flatnonzero(np.diff(path.time) > 10.0) + 1
    for one_pass in np.split(np.arange(len(path.time)), pauses):
        if len(one_pass) > 1:
            movers += _of_pass(path, one_pass, ground, amount, walk_y_m, random)
    return movers


def _of_pass(
    path: Drive, one_pass: np.ndarray, ground: Ground, amount: float, walk_y_m: float, random: np.random.Generator
) -> list[Mover]:
    """Passers-by during one drive along the street."""
    time, x = path.time[one_pass], path.position[one_pass, 0]
    lane = float(np.median(path.position[one_pass, 1]))
    start, stop = float(time[0]), float(time[-1])
    forward = 1.0 if x[-1] > x[0] else -1.0
    speed = abs(float(x[-1] - x[0])) / max(stop - start, 1e-9)

    def mover(thing: Thing, at: float, y: float, velocity: float) -> Mover:
        shape = thing.surface(random).placed(0.0, 0.0, 0.0, 0.0 if velocity > 0 else np.pi)
        return Mover(shape, f"moving {thing.kind}", at, y, velocity, start, stop, ground)

    movers = []
    if random.random() < _COMPANION_SHARE * amount:
        gap = float(random.uniform(7.5, 16.0) * random.choice([-1.0, 1.0]))
        slip = float(random.uniform(0.0, 0.12) * speed * np.sign(gap))  # the gap only grows
        movers.append(mover(draw_car(random), float(x[0]) + forward * gap, lane, forward * (speed + slip)))
    if abs(lane) > 0.5:
        # all at one speed and well apart, so that none drives through another
        other_lane = -np.sign(lane) * max(abs(lane), _LANE_Y_M)
        pace, at = float(random.uniform(4.0, 8.0)), float(x[0]) + forward * random.uniform(12.0, 40.0)
        for _ in range(int(random.poisson(_ONCOMING * amount * (stop - start)))):
            movers.append(mover(draw_car(random), float(at), float(other_lane), -forward * pace))
            at += forward * random.uniform(11.0, 60.0)
    low, high = float(x.min()), float(x.max())
    for rate, y, paces in ((_CYCLISTS, CYCLE_Y_M, (3.0, 5.5)), (_WALKERS, walk_y_m, (0.7, 1.7))):
        for _ in range(int(random.poisson(rate * amount * (stop - start)))):
            thing: Thing = Cyclist() if rate == _CYCLISTS else Person(float(random.uniform(1.5, 1.95)))
            side, way = random.choice([-1.0, 1.0], 2)
            beside = float(side * (y + random.uniform(-0.08, 0.08)))
            movers.append(mover(thing, float(random.uniform(low, high)), beside, float(way * random.uniform(*paces))))
    places = path.position[one_pass, :2]
    gaps = [np.linalg.norm(m.position(time)[:, :2] - places, axis=1).min() for m in movers]
    return [m for m, gap in zip(movers, gaps, strict=True) if gap > _LEAST_GAP_M]
