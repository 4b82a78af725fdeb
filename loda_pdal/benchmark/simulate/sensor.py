"""A spinning multi-beam LiDAR on a vehicle that drives past the scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from loda_pdal.benchmark.simulate.scene import Ground
from loda_pdal.benchmark.simulate.shapes import REFLECTANCE, RETURN_SHARE, Material, windows_at
from loda_pdal.benchmark.simulate.world import World
from loda_pdal.model.cloud import BoolArray, ByteArray, FloatArray, Int64Array
from loda_pdal.model.transform import rotation_matrix

GRAZING_COSINE = 0.06
"""Below this cosine of the angle of incidence pulses get lost, in proportion."""


class Scanner(Protocol):
    """What a survey needs to know of its scanner: columns of pulses, where they go, and how wrong they are."""

    @property
    def max_range_m(self) -> float: ...

    @property
    def noise_m(self) -> float: ...

    @property
    def dropout(self) -> float: ...

    @property
    def max_returns(self) -> int:
        """How many returns of a pulse are recorded."""

    @property
    def bright_range_m(self) -> float:
        """Range at which a return has lost half of its strength."""

    def directions(self, path: Drive, columns: Int64Array) -> FloatArray:
        """Unit directions of all pulses of the columns, (c * n, 3) in the street's frame, column by column."""

    def can_look(self, directions: FloatArray, heading: FloatArray) -> BoolArray:
        """Which directions (m, 3) lie in the field of view of a scanner that heads there (m,), rad."""


@dataclass(frozen=True)
class Sensor:
    """A spinning multi-beam scanner on a vehicle, its mounting and its errors.

    ``column_share`` is the share of the scanner's columns that is fired: 1 is every pulse of the real thing, the
    default keeps a block small enough for a test and still dense enough for every stage.
    """

    n_beams: int = 128
    n_azimuths: int = 1024
    rotation_hz: float = 10.0
    vertical_deg: float = 22.5
    height_m: float = 2.0
    max_range_m: float = 80.0
    noise_m: float = 0.02
    dropout: float = 0.02
    speed_m_s: float = 5.0
    drift_m: float = 0.02
    drift_deg: float = 0.03
    column_share: float = 0.018
    bright_range_m: float = 40.0
    max_returns: int = 1

    def directions(self, path: Drive, columns: Int64Array) -> FloatArray:
        """All beams of columns of the drive."""
        flat = _beam_directions(self, path.time[columns])
        return _turned(flat, np.repeat(path.heading[columns], self.n_beams))

    def can_look(self, directions: FloatArray, heading: FloatArray) -> BoolArray:
        """Directions neither too steep nor too low; the scanner spins, so the heading does not matter."""
        elevation = np.degrees(np.arcsin(np.clip(directions[:, 2], -1, 1)))
        return np.asarray(np.abs(elevation) <= self.vertical_deg)


class Drive(NamedTuple):
    """Where the scanner was when it fired, in the street's frame.

    Attributes
    ----------
    time : (c,) float64, s
        Of each column, since the survey began.
    position : (c, 3) float64, m
        True position of the scanner.
    heading : (c,) float64, rad
        True heading of the vehicle.
    shift, turn : (c, 3) float64, m and rad
        Error of the recorded pose: recorded = shift + position, turned by ``turn`` (a rotation vector).
    """

    time: FloatArray
    position: FloatArray
    heading: FloatArray
    shift: FloatArray
    turn: FloatArray

    @property
    def recorded(self) -> FloatArray:
        """Positions as the survey reports them, (c, 3) m."""
        return self.position + self.shift


class Scan(NamedTuple):
    """Returns of one survey, in the order in which they were measured.

    Attributes
    ----------
    xyz : (n, 3) float64, m
        As reported, with range noise and pose error, in the street's frame.
    met_xyz : (n, 3) float64, m
        Where the pulse truly met the surface; what returns from behind a pane met the pane.
    primitive : (n,) int64
        Which primitive of the scene was hit.
    time : (n,) float64, s
        Since the survey began.
    intensity : (n,) uint16
        Strength of the return.
    return_number, n_returns : (n,) uint8
        The how manieth return of its pulse it is, from 1, and of how many.
    """

    xyz: FloatArray
    met_xyz: FloatArray
    primitive: Int64Array
    time: FloatArray
    intensity: npt.NDArray[np.uint16]
    return_number: ByteArray
    n_returns: ByteArray

    def chosen(self, is_kept: BoolArray) -> Scan:
        """Those of the returns that ``is_kept`` (n,) says."""
        parts: list[Any] = [part[is_kept] for part in self]
        return Scan(*parts)


@dataclass(frozen=True)
class Conditions:
    """How the world sends light back on the day of a survey.

    Attributes
    ----------
    is_glazed : bool
        Facades have windows, and part of what returns from glass comes from behind it.
    is_wet : bool
        Roads, pavements and flat roofs are dark, and puddles on them return nothing.
    puddles : tuple of float
        Phases (rad) of the waves whose crests are puddles.
    weakest_signal : float
        Share of the light, range and incidence allowed for, of which half of the returns get lost.
    """

    is_glazed: bool = False
    is_wet: bool = False
    puddles: tuple[float, float, float] = (0.0, 0.0, 0.0)
    weakest_signal: float = 0.0

    @property
    def reflectance(self) -> FloatArray:
        """Share of the light that each `Material` sends back."""
        share = REFLECTANCE.copy()
        if self.is_wet:
            share[list(_WETTED)] *= 0.4
        return share

    @property
    def behind_share(self) -> float:
        """Share of the returns from glass that come from behind it."""
        return _BEHIND_SHARE if self.is_glazed else 0.0

    def detected(self, signal: FloatArray) -> FloatArray:
        """Share of returns of strength ``signal`` (n,) that are strong enough."""
        power = signal**2
        return np.asarray(power / np.maximum(power + self.weakest_signal**2, 1e-30))

    def material_at(self, material: ByteArray, at: FloatArray, normals: FloatArray) -> ByteArray:
        """`Material` at places (n, 3) m of surfaces of ``material`` (n,): glass in the windows of facades."""
        is_pane = np.zeros(len(material), dtype=bool)
        if self.is_glazed:
            is_facade = material == Material.FACADE
            is_pane[is_facade] = windows_at(at[is_facade], normals[is_facade])
        return np.where(is_pane, np.uint8(Material.GLASS), material)

    def is_mirror(self, material: ByteArray, at: FloatArray, normals: FloatArray) -> BoolArray:
        """Which places (n, 3) m lie in a puddle, (n,)."""
        if not self.is_wet:
            return np.zeros(len(at), dtype=bool)
        x, y = at[:, 0], at[:, 1]
        a, b, c = self.puddles
        wave = np.sin(1.5 * x + 0.4 * y + a) + np.sin(0.9 * y - 0.5 * x + b) + np.sin(0.7 * x + 1.1 * y + c)
        return np.asarray((wave > 1.7) & (np.abs(normals[:, 2]) > 0.95) & np.isin(material, _WETTED))


_WETTED = (Material.ASPHALT, Material.PAVING, Material.BITUMEN, Material.CONCRETE)
"""Materials that rain makes dark, and on which it stands."""


def drive(
    sensor: Sensor, terrain: Ground, lanes: tuple[float, ...], lead_m: float, random: np.random.Generator
) -> Drive:
    """One pass per lane (y of each, m), there and back, from ``lead_m`` before the street to ``lead_m`` after it."""
    passes = [_pass(sensor, terrain, lane, i, lead_m, random) for i, lane in enumerate(lanes)]
    return Drive(*(np.concatenate(parts) for parts in zip(*passes, strict=True)))


def _pass(
    sensor: Sensor, terrain: Ground, lane: float, index: int, lead_m: float, random: np.random.Generator
) -> Drive:
    """One drive along the street; right-hand lanes (y < 0) go towards +x."""
    length = terrain.length + 2 * lead_m
    duration = length / sensor.speed_m_s
    n_columns = max(int(duration * sensor.rotation_hz * sensor.n_azimuths * sensor.column_share), 1)
    step = duration * sensor.rotation_hz * sensor.n_azimuths / n_columns
    column = np.floor((np.arange(n_columns) + random.random(n_columns)) * step)
    time = column / (sensor.rotation_hz * sensor.n_azimuths)
    along = sensor.speed_m_s * time - lead_m
    direction = 1.0 if lane < 0 else -1.0
    x = along if lane < 0 else terrain.length - along
    y = lane + 0.15 * np.sin(2 * np.pi * x / 55.0 + index)
    z = terrain.height(x, y) + sensor.height_m + 0.01 * np.sin(2 * np.pi * 1.4 * time)
    heading = np.full(n_columns, 0.0 if direction > 0 else np.pi) + 0.15 * 2 * np.pi / 55.0 * np.cos(
        2 * np.pi * x / 55.0 + index
    )
    shift = _wander(time, sensor.drift_m, random)
    turn = _wander(time, np.radians(sensor.drift_deg), random)
    start = index * (duration + 60.0)
    return Drive(time + start, np.stack([x, y, z], axis=1), heading, shift, turn)


def _wander(time: FloatArray, rms: float, random: np.random.Generator) -> FloatArray:
    """Slow random motion along three axes with about that root mean square and no mean, (c, 3): waves of 9 to 60 s."""
    total = np.zeros((len(time), 3))
    for _ in range(3):
        period, phase = random.uniform(9.0, 60.0, 3), random.uniform(0, 2 * np.pi, 3)
        total += random.normal(0.0, 0.8, 3) * np.sin(2 * np.pi * time[:, None] / period + phase)
    return np.asarray(rms * (total - total.mean(axis=0)))


def scan(
    sensor: Scanner, world: World, path: Drive, random: np.random.Generator, conditions: Conditions | None = None
) -> Scan:
    """What the sensor reports of ``world`` along ``path``; in dry weather and without windows where not told."""
    columns = np.arange(len(path.time))
    behind = random.spawn(1)[0]  # of its own, so that a first return does not depend on what lies behind it
    parts = [
        _scan_columns(
            sensor, world, path, columns[start : start + _COLUMNS_AT_ONCE], random, behind, conditions or Conditions()
        )
        for start in range(0, max(len(columns), 1), _COLUMNS_AT_ONCE)
    ]
    return Scan(*(np.concatenate(part) for part in zip(*parts, strict=True)))


_COLUMNS_AT_ONCE = 8192
"""Columns whose rays are held in memory together."""

_ROOM_DEPTH_M = 1.5
"""Mean distance from a pane to what a pulse that passed it meets inside."""

_BEHIND_SHARE = 0.6
"""Share of the returns from a window that come from behind the pane."""

_LEAF_THICKNESS_M = 0.35
"""How far behind a leaf the next return of the same pulse can lie."""

_THROUGH_SHARE = 0.55
"""Share of pulses that meet a leaf with only part of their width and go on."""


def _scan_columns(
    sensor: Scanner,
    world: World,
    path: Drive,
    columns: Int64Array,
    random: np.random.Generator,
    behind: np.random.Generator,
    conditions: Conditions,
) -> Scan:
    """Returns of some columns of the drive, in the order of the pulses."""
    directions = sensor.directions(path, columns)
    column = np.repeat(columns, len(directions) // len(columns) if len(columns) else 0)
    pulse, start_m = np.arange(len(column)), np.zeros(len(column))
    echoes = []
    for number in range(1, sensor.max_returns + 1):
        own = random if number == 1 else behind
        origins = path.position[column[pulse]] + start_m[:, None] * directions[pulse]
        hits = world.cast(origins, directions[pulse], path.time[column[pulse]], sensor.max_range_m - start_m)
        noise = own.normal(0.0, sensor.noise_m, len(pulse))
        luck, speckle = own.random(len(pulse)), own.normal(1.0, 0.08, len(pulse))

        hit = np.flatnonzero(hits.primitive >= 0)
        at = origins[hit] + hits.range_m[hit, None] * directions[pulse[hit]]
        normal = world.normals[hits.primitive[hit]]
        material = conditions.material_at(world.material[hits.primitive[hit]], at, normal)
        cosine = np.abs(np.sum(normal * directions[pulse[hit]], axis=1))
        range_m = start_m[hit] + hits.range_m[hit]
        signal = conditions.reflectance[material] * cosine / (1.0 + (range_m / sensor.bright_range_m) ** 2)
        share = RETURN_SHARE[material] * (1.0 - sensor.dropout) * np.clip(cosine / GRAZING_COSINE, 0.0, 1.0)
        share *= conditions.detected(signal) * ~conditions.is_mirror(material, at, normal)
        kept = luck[hit] < share
        is_behind = kept & (material == Material.GLASS) & (behind.random(len(hit)) < conditions.behind_share)
        range_m[is_behind] += _depth_behind(
            world, at[is_behind], directions[pulse[hit[is_behind]]], path.time[column[pulse[hit[is_behind]]]], behind
        )
        echoes.append(
            _Echoes(
                pulse[hit[kept]],
                at[kept],
                (range_m + noise[hit])[kept],
                hits.primitive[hit[kept]].astype(np.int64),
                np.clip(60000.0 * signal * speckle[hit], 1, 65535)[kept].astype(np.uint16),
            )
        )
        is_through = (world.material[hits.primitive[hit]] == Material.LEAF) & (behind.random(len(hit)) < _THROUGH_SHARE)
        pulse, start_m = pulse[hit[is_through]], range_m[is_through] + _LEAF_THICKNESS_M
    found = _in_order(echoes)
    return_number, n_returns = _numbered(found.pulse)
    pose = column[found.pulse]
    measured = directions[found.pulse] * found.range_m[:, None]
    xyz = path.recorded[pose] + measured + np.cross(path.turn[pose], measured)
    return Scan(xyz, found.met_xyz, found.primitive, path.time[pose], found.intensity, return_number, n_returns)


class _Echoes(NamedTuple):
    """Returns of pulses: which pulse, where it met the surface, its range (m), which primitive, how bright."""

    pulse: Int64Array
    met_xyz: FloatArray
    range_m: FloatArray
    primitive: Int64Array
    intensity: npt.NDArray[np.uint16]


def _in_order(echoes: list[_Echoes]) -> _Echoes:
    """All returns in the order of their pulses, near ones first."""
    joined: list[Any] = [np.concatenate(part) for part in zip(*echoes, strict=True)]
    order = np.argsort(joined[0], kind="stable")
    return _Echoes(*(part[order] for part in joined))


def _depth_behind(
    world: World, at: FloatArray, directions: FloatArray, time: FloatArray, random: np.random.Generator
) -> FloatArray:
    """How far behind a pane pulses that passed it end, (n,) m: at something in the room, at the latest at its wall."""
    gap = 0.05
    depth = random.exponential(_ROOM_DEPTH_M, len(at))
    return gap + world.cast(at + gap * directions, directions, time, depth + 1.0).range_m.clip(max=depth)


def _numbered(pulse: Int64Array) -> tuple[ByteArray, ByteArray]:
    """For each return of ascending ``pulse`` (n,), the how manieth of its pulse it is, and of how many."""
    _, first, place, n = np.unique(pulse, return_index=True, return_inverse=True, return_counts=True)
    return (np.arange(len(pulse)) - first[place] + 1).astype(np.uint8), n[place].astype(np.uint8)


def sees(
    sensor: Scanner,
    world: World,
    path: Drive,
    targets: FloatArray,
    see_through: BoolArray,
    station_m: float = 6.0,
    margin_m: float = 0.15,
) -> BoolArray:
    """Which of ``targets`` (k, 3) m the survey could measure, (k,).

    A target counts when it is in range and in the field of view of at least one place of the drive (one is tried
    every ``station_m``), and the first thing that a ray towards it meets is nearer than ``margin_m`` to it, or beyond,
    or one of the primitives of ``see_through`` (p,): something that stands in its very place.
    """
    n_stations = int(np.ceil(np.linalg.norm(np.diff(path.position, axis=0), axis=1).sum() / station_m)) + 1
    station = np.unique(np.linspace(0, len(path.time) - 1, n_stations).astype(int))
    origins = np.repeat(path.position[station], len(targets), axis=0)
    offset = np.tile(targets, (len(station), 1)) - origins
    distance = np.linalg.norm(offset, axis=1)
    directions = offset / np.maximum(distance, 1e-9)[:, None]
    is_in_view = sensor.can_look(directions, np.repeat(path.heading[station], len(targets)))
    candidate = np.flatnonzero((distance < sensor.max_range_m) & is_in_view)
    time = np.repeat(path.time[station], len(targets))[candidate]
    hits = world.cast(origins[candidate], directions[candidate], time, np.maximum(distance[candidate] - margin_m, 0.0))
    is_seen = np.zeros(len(offset), dtype=bool)
    is_seen[candidate] = (hits.primitive < 0) | see_through[hits.primitive]
    return np.asarray(is_seen.reshape(len(station), -1).any(axis=0))


def _beam_directions(sensor: Sensor, time: FloatArray) -> FloatArray:
    """Unit directions of all beams of columns fired at ``time``, in the vehicle's frame, (c * n_beams, 3)."""
    elevation = np.radians(np.linspace(-sensor.vertical_deg, sensor.vertical_deg, sensor.n_beams))
    azimuth = 2 * np.pi * np.mod(time * sensor.rotation_hz, 1.0)
    # the beams of a column do not fire in one plane: four banks look a little aside, as those of real scanners do
    bank = np.radians(360.0 / sensor.n_azimuths) * (np.arange(sensor.n_beams) % 4 - 1.5) * 3.0
    angle = azimuth[:, None] + bank
    flat = np.broadcast_to(np.cos(elevation), angle.shape)
    up = np.broadcast_to(np.sin(elevation), angle.shape)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), up], axis=2).reshape(-1, 3)


def _turned(vectors: FloatArray, yaw: FloatArray) -> FloatArray:
    """``vectors`` (m, 3) turned about z by ``yaw`` (m,) rad."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y = vectors[:, 0], vectors[:, 1]
    return np.stack([c * x - s * y, s * x + c * y, vectors[:, 2]], axis=1)


def rigid_move(shift_m: FloatArray, rotation_vector: FloatArray, centre: FloatArray) -> FloatArray:
    """Transform (4, 4) that turns by ``rotation_vector`` (rad) about ``centre`` and then shifts, m."""
    T = np.eye(4)
    T[:3, :3] = rotation_matrix(rotation_vector)
    T[:3, 3] = centre - T[:3, :3] @ centre + shift_m
    return T
