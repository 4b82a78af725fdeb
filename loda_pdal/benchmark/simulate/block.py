"""One block of a street or town, surveyed twice, with everything known about it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from loda_pdal.benchmark.simulate.city_model import read_city_model
from loda_pdal.benchmark.simulate.clutter import add_clutter
from loda_pdal.benchmark.simulate.edits import EditCounts, GroundItem, Item, draw_edits
from loda_pdal.benchmark.simulate.epochs import EpochScene, changes_of_returns, epoch_scenes
from loda_pdal.benchmark.simulate.evidence import Evidence, instances_of
from loda_pdal.benchmark.simulate.options import SimulationOptions
from loda_pdal.benchmark.simulate.plan import SurveyPlan, draw_plans
from loda_pdal.benchmark.simulate.scene import Ground, draw_street
from loda_pdal.benchmark.simulate.sensor import Drive, rigid_move, scan
from loda_pdal.benchmark.simulate.town import draw_town, draw_town_edits
from loda_pdal.benchmark.simulate.traffic import CYCLE_Y_M, draw_traffic
from loda_pdal.benchmark.simulate.world import World
from loda_pdal.benchmark.truth import Truth
from loda_pdal.model.cloud import ByteArray, FloatArray, Int64Array
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.pair import Pair
from loda_pdal.model.transform import invert, transform_points
from loda_pdal.params import FuseParams
from loda_pdal.stages.fuse import fuse_points

CRS = "EPSG:7415"
"""Amersfoort / RD New with NAP heights: the simulated streets lie in the Netherlands."""

COORDINATE_STEP_M = 0.001
"""Coordinates are whole multiples of this, as a LAS file stores them."""

_STREET, _EDITS, _PLACE, _MOVE, _CLUTTER, _EXTENT = 1, 2, 3, 4, 5, 6
_SURVEY = Pair(10, 11)
_FOLIAGE = Pair(20, 21)
_DAY = Pair(30, 31)
_TRAFFIC = Pair(40, 41)
_ECHOES = Pair(50, 51)
"""Numbers of the independent random streams that one seed gives."""

PAVEMENT_Y_M = 6.1
"""Where people walk in a procedural street, m from its middle."""

_START_TIME = Pair(371_722_418.0, 435_226_418.0)
"""Adjusted standard GPS time (s) at which each survey begins: ten in the morning of the days in `writer`."""


@dataclass(frozen=True)
class SimulatedSurvey:
    """One epoch of a block, in the order of measurement.

    Attributes
    ----------
    xyz : (n, 3) float64, m
        Full map coordinates, whole multiples of `COORDINATE_STEP_M`.
    truth_id : (n,) uint32
        Annotated instance; 0 for ground that did not change.
    truth_change : (n,) uint8
        `ChangeLabel` of the surface hit: a change only where the other survey's street does not have that surface.
    gps_time : (n,) float64, s
    intensity : (n,) uint16
    return_number, n_returns : (n,) uint8
        The how manieth return of its pulse, from 1, and of how many.
    trajectory : (k, 4) float64
        GPS time (s) and recorded position of the scanner (map coordinates, m).
    """

    xyz: FloatArray
    truth_id: npt.NDArray[np.uint32]
    truth_change: ByteArray
    gps_time: FloatArray
    intensity: npt.NDArray[np.uint16]
    return_number: ByteArray
    n_returns: ByteArray
    trajectory: FloatArray

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True)
class SimulatedBlock:
    """Both surveys of a block and the truth about it."""

    surveys: Pair[SimulatedSurvey]
    truth: Truth
    seed: int
    options: SimulationOptions


def simulate_block(seed: int, options: SimulationOptions | None = None) -> SimulatedBlock:
    """A street block surveyed twice; the same seed and options give the same block to the last bit.

    Parameters
    ----------
    seed : int
        Of the street, its edits, the noise and the misregistration (independent streams, so that the same street
        comes with and without edits, at any density).
    options : SimulationOptions, optional

    Returns
    -------
    SimulatedBlock
    """
    options = options or SimulationOptions()
    terrain, items, grounds = _contents(seed, options)
    plans = draw_plans(
        options,
        terrain,
        _SURVEY.map(lambda code: _stream(seed, code)),
        _DAY.map(lambda code: _stream(seed, code)),
        _stream(seed, _EXTENT),
    )
    foliage = _FOLIAGE.map(lambda code: _stream(seed, code))
    scenes = epoch_scenes(terrain, items, grounds, foliage, plans.map(lambda plan: plan.leaf_share))
    scenes = _with_traffic(seed, options, terrain, plans, scenes)
    worlds = scenes.map(lambda scene: World(scene.surface, scene.movers))
    randoms = _ECHOES.map(lambda code: _stream(seed, code))
    scans = Pair(
        *(
            plan.cropped(scan(plan.scanner, world, plan.path, random, plan.conditions))
            for plan, world, random in zip(plans, worlds, randoms, strict=True)
        )
    )
    changes = changes_of_returns(scenes, scans, items)
    evidence = Pair(*(Evidence(*parts) for parts in zip(plans, scenes, worlds, scans, changes, strict=True)))

    T_map_street = _placement(_stream(seed, _PLACE), options)
    T_before_after = _misregistration(_stream(seed, _MOVE), options, T_map_street)
    instances = instances_of(items, grounds, evidence, T_map_street, options)
    surveys = Pair(
        _survey(evidence.before, T_before_after @ T_map_street, _START_TIME.before),
        _survey(evidence.after, T_map_street, _START_TIME.after),
    )
    truth = Truth(
        instances,
        invert(T_before_after),
        _outline(T_map_street, options),
        options.length_m * options.width_m,
        CRS,
        {"program": "loda-pdal bench simulate", "seed": seed, "options": options.to_dict()},
    )
    return SimulatedBlock(surveys, truth, seed, options)


def fused_block(block: SimulatedBlock, leaf_m: float) -> SimulatedBlock:
    """The block as a fused map: one point per voxel of ``leaf_m`` (m), the mean of its returns; all else is that of the
    first of them. The truth stays that of the returns."""

    def fused(survey: SimulatedSurvey) -> SimulatedSurvey:
        frame = LocalFrame.about(survey.xyz.min(axis=0, initial=np.inf))
        cloud = fuse_points(frame.to_local(survey.xyz), FuseParams(leaf_m=leaf_m))
        first = np.unique(cloud.voxel_idx, return_index=True)[1]
        return SimulatedSurvey(
            np.round(frame.to_map(cloud.xyz) / COORDINATE_STEP_M) * COORDINATE_STEP_M,
            survey.truth_id[first],
            survey.truth_change[first],
            survey.gps_time[first],
            survey.intensity[first],
            survey.return_number[first],
            survey.n_returns[first],
            survey.trajectory,
        )

    made_by = {**block.truth.made_by, "leaf_m": leaf_m}
    return replace(block, surveys=block.surveys.map(fused), truth=replace(block.truth, made_by=made_by))


def _stream(seed: int, purpose: int) -> np.random.Generator:
    return np.random.default_rng([seed, purpose])


def _contents(seed: int, options: SimulationOptions) -> tuple[Ground, list[Item], list[GroundItem]]:
    """What the block holds, with what changes: a street or a piece of a city, and what clutters it."""
    if not options.city:
        street = draw_street(_stream(seed, _STREET), options.length_m)
        counts = EditCounts() if options.has_edits else None
        ground: Ground = street.terrain
        items, patches = draw_edits(street, _stream(seed, _EDITS), counts)
    else:
        buildings = read_city_model(options.city)
        needs_street = options.sensor == "vehicle"
        town = draw_town(buildings, _stream(seed, _STREET), options.length_m, options.width_m, needs_street)
        ground = town.terrain
        items, patches = draw_town_edits(town, _stream(seed, _EDITS), options.has_edits)
    items = add_clutter(items, patches, ground, _stream(seed, _CLUTTER), options)
    return ground, items, patches


def _with_traffic(
    seed: int, options: SimulationOptions, terrain: Ground, plans: Pair[SurveyPlan], scenes: Pair[EpochScene]
) -> Pair[EpochScene]:
    """The scenes with who passes by while the vehicle scans."""
    amount = options.reality.traffic
    if options.sensor != "vehicle" or not options.has_edits or not amount:
        return scenes
    walk_y_m = CYCLE_Y_M if options.city else PAVEMENT_Y_M
    randoms = _TRAFFIC.map(lambda code: _stream(seed, code))
    passers = plans.join(randoms, lambda plan, random: draw_traffic(plan.path, terrain, amount, walk_y_m, random))
    first_id = int(max(scenes.before.owner.max(initial=0), scenes.after.owner.max(initial=0))) + 1
    return Pair(
        scenes.before.with_movers(passers.before, first_id, ChangeLabel.REMOVED),
        scenes.after.with_movers(passers.after, first_id + len(passers.before), ChangeLabel.ADDED),
    )


def _placement(random: np.random.Generator, options: SimulationOptions) -> FloatArray:
    """Where in the country the street lies: the transform (4, 4) from the street's frame to map coordinates."""
    azimuth = random.uniform(0, 2 * np.pi)
    corner = np.array([random.integers(11_000, 13_000) * 10.0, random.integers(48_000, 49_000) * 10.0, 0.0])
    corner[2] = np.round(random.uniform(0.5, 6.0), 1)
    middle = np.array([options.length_m / 2, 0.0, 0.0])
    T = rigid_move(np.zeros(3), np.array([0.0, 0.0, azimuth]), np.zeros(3))
    T[:3, 3] = corner - T[:3, :3] @ middle
    return T


def _misregistration(random: np.random.Generator, options: SimulationOptions, T_map_street: FloatArray) -> FloatArray:
    """Move (4, 4) in map coordinates from where before-points belong to where the before epoch reports them."""
    direction = random.normal(size=3) * (1.0, 1.0, 0.5)
    axis = np.append(random.normal(0.0, 0.15, 2), random.choice([-1.0, 1.0]))
    shift = options.shift_m * direction / np.linalg.norm(direction)
    turn = np.radians(options.rotation_deg) * axis / np.linalg.norm(axis)
    centre = transform_points(T_map_street, np.array([[options.length_m / 2, 0.0, 0.0]]))[0]
    return rigid_move(shift, turn, centre)


def _survey(one: Evidence, T_map_street: FloatArray, start_time: float) -> SimulatedSurvey:
    measured, path = one.measured, one.plan.path
    station = _stations(path)
    positions = transform_points(T_map_street, path.recorded[station])
    xyz = transform_points(T_map_street, measured.xyz)
    return SimulatedSurvey(
        np.round(xyz / COORDINATE_STEP_M) * COORDINATE_STEP_M,
        one.scene.owner[measured.primitive].astype(np.uint32),
        one.change,
        start_time + measured.time,
        measured.intensity,
        measured.return_number,
        measured.n_returns,
        np.column_stack([start_time + path.time[station], positions]),
    )


def _stations(path: Drive) -> Int64Array:
    """Which columns of a drive its trajectory lists: both ends of each pass, and `_STATIONS_PER_S` a second between."""
    number = np.floor((path.time - path.time[:1]) * _STATIONS_PER_S).astype(np.int64)
    is_next = np.diff(number, prepend=-1) > 0
    is_last = np.diff(path.time, append=np.inf) > 1.0
    return np.flatnonzero(is_next | is_last)


_STATIONS_PER_S = 10.0
"""Rows of a trajectory per second that was driven: half a metre on the road, six in the air."""


def _outline(T_map_street: FloatArray, options: SimulationOptions) -> list[tuple[float, float]]:
    half, length = options.width_m / 2, options.length_m
    corners = np.array([(0.0, -half, 0.0), (length, -half, 0.0), (length, half, 0.0), (0.0, half, 0.0)])
    return [(round(float(x), 3), round(float(y), 3)) for x, y, _ in transform_points(T_map_street, corners)]
