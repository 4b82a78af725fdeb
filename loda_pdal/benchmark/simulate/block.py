"""One street block, surveyed twice, with everything known about it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from loda_pdal.benchmark.simulate.edits import EditCounts, GroundItem, Item, draw_edits
from loda_pdal.benchmark.simulate.raycast import RayCaster
from loda_pdal.benchmark.simulate.scene import Terrain, draw_street
from loda_pdal.benchmark.simulate.sensor import Drive, Scan, Sensor, drive, rigid_move, scan, sees
from loda_pdal.benchmark.simulate.shapes import EMPTY, Shape, joined
from loda_pdal.benchmark.truth import Truth, TruthInstance
from loda_pdal.model.cloud import BoolArray, ByteArray, FloatArray, Int64Array
from loda_pdal.model.errors import ParameterError
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.model.transform import invert, transform_points
from loda_pdal.params import FuseParams
from loda_pdal.stages.fuse import fuse_points

CRS = "EPSG:7415"
"""Amersfoort / RD New with NAP heights: the simulated streets lie in the Netherlands."""

COORDINATE_STEP_M = 0.001
"""Coordinates are whole multiples of this, as a LAS file stores them."""

_STREET, _EDITS, _PLACE, _MOVE = 1, 2, 3, 4
_SURVEY = Pair(10, 11)
_FOLIAGE = Pair(20, 21)
"""Numbers of the independent random streams that one seed gives."""

_START_TIME = Pair(371_722_418.0, 435_226_418.0)
"""Adjusted standard GPS time (s) at which each survey begins: ten in the morning of the days in `writer`."""


@dataclass(frozen=True)
class SimulationOptions:
    """How a block is made. Lengths in m.

    Attributes
    ----------
    length_m, width_m : float
        Extent along and across the street.
    density : float
        Pulses per survey; 1 gives about 0.65 million returns from 100 m of street.
    lanes : tuple of float
        One pass of the vehicle per entry: where it drives, m from the middle of the street.
    shift_m, rotation_deg : float
        Residual misregistration of the before epoch: how far it is moved, and turned about the middle of the block.
    noise_m, drift_m : float
        Range noise, and slow pose error.
    has_edits : bool
        False surveys an unchanged street twice, with fresh noise and foliage.
    min_returns : int
        Fewer returns in a survey that an instance stands in leave it out of the scores.
    min_visible : float
        So does a smaller share of its place that the other survey could have measured.
    """

    length_m: float = 100.0
    width_m: float = 56.0
    density: float = 1.0
    lanes: tuple[float, ...] = (-1.6, 1.6)
    shift_m: float = 0.05
    rotation_deg: float = 0.2
    noise_m: float = 0.02
    drift_m: float = 0.02
    has_edits: bool = True
    min_returns: int = 30
    min_visible: float = 0.25

    def __post_init__(self) -> None:
        for name, low, high in (
            ("length_m", 30.0, 2000.0),
            ("width_m", 10.0, 80.0),
            ("density", 0.01, 20.0),
            ("shift_m", 0.0, 100.0),
            ("rotation_deg", 0.0, 180.0),
            ("noise_m", 0.0, 1.0),
            ("drift_m", 0.0, 1.0),
        ):
            if not low <= getattr(self, name) <= high:
                raise ParameterError(
                    f"{name} = {getattr(self, name)} is outside {low} to {high}.",
                    "Choose a value in that range.",
                    "parameter-range",
                )
        if not self.lanes:
            raise ParameterError("No lane to drive on.", "Give at least one.", "parameter-range")


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
    trajectory : (k, 4) float64
        GPS time (s) and recorded position of the scanner (map coordinates, m).
    """

    xyz: FloatArray
    truth_id: npt.NDArray[np.uint32]
    truth_change: ByteArray
    gps_time: FloatArray
    intensity: npt.NDArray[np.uint16]
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


@dataclass(frozen=True)
class EpochScene:
    """Everything that stands at one survey: its surface, and for each primitive whose it is and what became of it."""

    surface: Shape
    owner: Int64Array
    change: ByteArray


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
    street = draw_street(_stream(seed, _STREET), options.length_m)
    counts = EditCounts() if options.has_edits else None
    items, grounds = draw_edits(street, _stream(seed, _EDITS), counts)
    scenes = epoch_scenes(street.terrain, items, grounds, seed)

    sensor = Sensor(noise_m=options.noise_m, drift_m=options.drift_m, drift_deg=1.5 * options.drift_m)
    sensor = replace(sensor, column_share=min(sensor.column_share * options.density, 1.0))
    randoms = _SURVEY.map(lambda code: _stream(seed, code))
    drives = randoms.map(lambda random: drive(sensor, street.terrain, options.lanes, 12.0, random))
    scans = Pair(
        scan(sensor, scenes.before.surface, drives.before, randoms.before),
        scan(sensor, scenes.after.surface, drives.after, randoms.after),
    ).map(lambda measured: _cropped(measured, options))

    T_map_street = _placement(_stream(seed, _PLACE), options)
    T_before_after = _misregistration(_stream(seed, _MOVE), options, T_map_street)
    instances = _instances(sensor, items, grounds, scenes, scans, drives, T_map_street, options)
    surveys = Pair(
        _survey(scans.before, scenes.before, drives.before, T_before_after @ T_map_street, _START_TIME.before),
        _survey(scans.after, scenes.after, drives.after, T_map_street, _START_TIME.after),
    )
    truth = Truth(
        instances,
        invert(T_before_after),
        _outline(T_map_street, options),
        options.length_m * options.width_m,
        CRS,
        {
            "program": "loda-pdal bench simulate",
            "seed": seed,
            "options": {**asdict(options), "lanes": list(options.lanes)},
        },
    )
    return SimulatedBlock(surveys, truth, seed, options)


def fused_block(block: SimulatedBlock, leaf_m: float) -> SimulatedBlock:
    """The block as a fused map: one point per voxel of ``leaf_m`` (m), the mean of its returns; all else is that of the
    first of them. The truth stays that of the returns."""

    def fused(survey: SimulatedSurvey) -> SimulatedSurvey:
        low = np.floor(survey.xyz.min(axis=0, initial=np.inf) / 1000.0) * 1000.0 if len(survey) else np.zeros(3)
        frame = LocalFrame((int(low[0]), int(low[1]), 0))
        cloud = fuse_points(frame.to_local(survey.xyz), FuseParams(leaf_m=leaf_m))
        first = np.unique(cloud.voxel_idx, return_index=True)[1]
        return SimulatedSurvey(
            np.round(frame.to_map(cloud.xyz) / COORDINATE_STEP_M) * COORDINATE_STEP_M,
            survey.truth_id[first],
            survey.truth_change[first],
            survey.gps_time[first],
            survey.intensity[first],
            survey.trajectory,
        )

    made_by = {**block.truth.made_by, "leaf_m": leaf_m}
    return replace(block, surveys=block.surveys.map(fused), truth=replace(block.truth, made_by=made_by))


def _stream(seed: int, purpose: int) -> np.random.Generator:
    return np.random.default_rng([seed, purpose])


def epoch_scenes(terrain: Terrain, items: list[Item], grounds: list[GroundItem], seed: int) -> Pair[EpochScene]:
    """Both states of the street, ready to be surveyed; foliage is drawn anew for each."""
    outlines = [g.patch for g in grounds]
    ground_ids = np.array([g.instance_id for g in grounds] + [0])
    ground_labels = np.array([g.label for g in grounds] + [ChangeLabel.UNCHANGED], dtype=np.uint8)
    foliage = _FOLIAGE.map(lambda code: _stream(seed, code))
    parts: Pair[list[EpochScene]] = Pair([], [])
    for into, patches in ((parts.before, []), (parts.after, outlines)):
        ground, patch = terrain.surface(patches, outlines)
        into.append(EpochScene(ground, ground_ids[patch], ground_labels[patch]))
    for item in items:
        before = item.before.surface(terrain, foliage.before) if item.before else EMPTY
        after = item.after.surface(terrain, foliage.after) if item.after else EMPTY
        parts.before.append(_item_scene(item, before, after))
        parts.after.append(_item_scene(item, after, before))
    return parts.map(_joined_scene)


def _item_scene(item: Item, shape: Shape, other: Shape) -> EpochScene:
    is_changed = _is_only_here(shape, other) & (item.label is not ChangeLabel.UNCHANGED)
    change = np.where(is_changed, item.label, ChangeLabel.UNCHANGED).astype(np.uint8)
    return EpochScene(shape, np.full(len(shape), item.instance_id), change)


def _joined_scene(parts: list[EpochScene]) -> EpochScene:
    """All parts as one; triangles come before discs, here as in `Shape`."""
    n_triangles = [len(p.surface.triangles) for p in parts]
    split = [(p.owner[:n], p.owner[n:], p.change[:n], p.change[n:]) for p, n in zip(parts, n_triangles, strict=True)]
    owner_of_triangle, owner_of_disc, change_of_triangle, change_of_disc = zip(*split, strict=True)
    return EpochScene(
        joined(p.surface for p in parts),
        np.concatenate([*owner_of_triangle, *owner_of_disc]),
        np.concatenate([*change_of_triangle, *change_of_disc]),
    )


def _is_only_here(shape: Shape, other: Shape) -> BoolArray:
    """Which primitives the other epoch's surface of the same thing does not have, triangles first; leaves count as
    gone, since they are never the same twice."""
    is_only = np.ones(len(shape), dtype=bool)
    known = {row.tobytes() for row in np.round(other.triangles * 1e4).astype(np.int64)}
    mine = np.round(shape.triangles * 1e4).astype(np.int64)
    is_only[: len(mine)] = [row.tobytes() not in known for row in mine]
    return is_only


def _cropped(measured: Scan, options: SimulationOptions) -> Scan:
    """The returns inside the block."""
    x, y = measured.xyz[:, 0], measured.xyz[:, 1]
    is_inside = (x >= 0) & (x < options.length_m) & (np.abs(y) < options.width_m / 2)
    return Scan(
        measured.xyz[is_inside], measured.primitive[is_inside], measured.time[is_inside], measured.intensity[is_inside]
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


def _survey(
    measured: Scan, scene: EpochScene, path: Drive, T_map_street: FloatArray, start_time: float
) -> SimulatedSurvey:
    station = np.unique(np.round(np.linspace(0, len(path.time) - 1, 400)).astype(int))
    positions = transform_points(T_map_street, path.recorded[station])
    xyz = transform_points(T_map_street, measured.xyz)
    return SimulatedSurvey(
        np.round(xyz / COORDINATE_STEP_M) * COORDINATE_STEP_M,
        scene.owner[measured.primitive].astype(np.uint32),
        scene.change[measured.primitive],
        start_time + measured.time,
        measured.intensity,
        np.column_stack([start_time + path.time[station], positions]),
    )


def _outline(T_map_street: FloatArray, options: SimulationOptions) -> list[tuple[float, float]]:
    half, length = options.width_m / 2, options.length_m
    corners = np.array([(0.0, -half, 0.0), (length, -half, 0.0), (length, half, 0.0), (0.0, half, 0.0)])
    return [(round(float(x), 3), round(float(y), 3)) for x, y, _ in transform_points(T_map_street, corners)]


def _instances(
    sensor: Sensor,
    items: list[Item],
    grounds: list[GroundItem],
    scenes: Pair[EpochScene],
    scans: Pair[Scan],
    drives: Pair[Drive],
    T_map_street: FloatArray,
    options: SimulationOptions,
) -> list[TruthInstance]:
    """The truth about every instance, with what the surveys caught of it."""
    casters = scenes.map(lambda scene: RayCaster(scene.surface))
    n_ids = max([i.instance_id for i in items] + [g.instance_id for g in grounds], default=0) + 1
    caught = scenes.join(scans, lambda scene, measured: _caught(scene, measured, n_ids))

    def instance_of(one: Item | GroundItem, kind: str, object_class: ObjectClass, exists: Pair[bool]) -> TruthInstance:
        points = np.concatenate([c.points[one.instance_id] for c in caught])
        sample = points[np.unique(np.linspace(0, len(points) - 1, 100).astype(int))] if len(points) else points
        replaced_by = (one.partner if isinstance(one, Item) else None) or -1

        def visible_share(stands: bool, caster: RayCaster, path: Drive, scene: EpochScene) -> float | None:
            return None if stands else _share(sees(sensor, caster, path, sample, scene.owner == replaced_by))

        instance = TruthInstance(
            one.instance_id,
            object_class,
            one.label,
            kind,
            exists,
            caught.map(lambda c: len(c.points[one.instance_id])),
            caught.map(lambda c: int(c.n_changed[one.instance_id])),
            Pair(
                visible_share(exists.before, casters.before, drives.before, scenes.before),
                visible_share(exists.after, casters.after, drives.after, scenes.after),
            ),
            one.edit,
            one.note,
            _centre(points, T_map_street),
            one.partner if isinstance(one, Item) else None,
        )
        return replace(instance, excluded=_reason_to_exclude(instance, options))

    things = [
        instance_of(i, i.placed.thing.kind, i.object_class, Pair(i.before is not None, i.after is not None))
        for i in items
    ]
    patches = [instance_of(g, "ground", ObjectClass.GROUND, Pair(True, True)) for g in grounds]
    return sorted(things + patches, key=lambda instance: instance.instance_id)


class _Caught(NamedTuple):
    """What one survey caught of each instance: its returns (street's frame, m), and how many lie on changed surface."""

    points: list[FloatArray]
    n_changed: Int64Array


def _caught(scene: EpochScene, measured: Scan, n_ids: int) -> _Caught:
    owner, change = scene.owner[measured.primitive], scene.change[measured.primitive]
    order = np.argsort(owner, kind="stable")
    bounds = np.searchsorted(owner[order], np.arange(1, n_ids))
    n_changed = np.bincount(owner[change != ChangeLabel.UNCHANGED], minlength=n_ids)
    return _Caught(np.split(measured.xyz[order], bounds), n_changed)


def _share(is_true: BoolArray) -> float:
    return round(float(is_true.mean()), 3) if len(is_true) else 0.0


def _centre(points: FloatArray, T_map_street: FloatArray) -> tuple[float, float, float] | None:
    if not len(points):
        return None
    x, y, z = np.round(transform_points(T_map_street, points.mean(axis=0)[None])[0], 3).tolist()
    return x, y, z


def _reason_to_exclude(instance: TruthInstance, options: SimulationOptions) -> str | None:
    """Why an instance cannot be judged from these two surveys; None where it can."""
    for epoch in ("before", "after"):
        n, least = getattr(instance.n_points, epoch), options.min_returns
        if getattr(instance.exists, epoch) and n < least:
            return f"{n} returns in the {epoch} survey, fewer than {least}"
        seen = getattr(instance.visible, epoch)
        if seen is not None and seen < options.min_visible:
            share, least_share = 100 * seen, 100 * options.min_visible
            return f"the {epoch} survey could see {share:.0f} % of its place, less than {least_share:.0f} %"
    changed = instance.n_changed.before + instance.n_changed.after
    if instance.is_changed and changed < options.min_returns:
        return f"{changed} returns from what changed, fewer than {options.min_returns}"
    return None
