"""A scanner on an aircraft: parallel strips, each swept from side to side, with small errors between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loda_pdal.benchmark.simulate.sensor import Drive
from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array


@dataclass(frozen=True)
class AirborneSensor:
    """The scanner, its strips over the block, and its errors. The frame is the block's: x along it, y across.

    Attributes
    ----------
    length_m, width_m : float
        Extent of the block that the strips cover.
    density : float
        Pulses per m2 of level ground, over all strips.
    offsets_m : tuple of float
        Where each strip flies, m beside the middle of the block.
    height_m, half_angle_deg, speed_m_s
        Flying height above the block, field of view to each side, and speed.
    noise_m, dropout
        Range noise (m) and share of pulses without a return.
    strip_shift_m, drift_m, drift_deg
        Error of a whole strip's position, and slow pose errors along it.
    """

    length_m: float
    width_m: float
    density: float = 10.0
    offsets_m: tuple[float, ...] = (-140.0, 110.0)
    height_m: float = 700.0
    half_angle_deg: float = 30.0
    speed_m_s: float = 60.0
    noise_m: float = 0.02
    dropout: float = 0.02
    strip_shift_m: float = 0.03
    drift_m: float = 0.01
    drift_deg: float = 0.001
    bright_range_m: float = 900.0
    max_returns: int = 3

    @property
    def max_range_m(self) -> float:
        return 3.0 * self.height_m

    @property
    def _step_m(self) -> float:
        """Distance of neighbouring pulses on the ground, along and across."""
        return float(np.sqrt(len(self.offsets_m) / self.density))

    def directions(self, path: Drive, columns: Int64Array) -> FloatArray:
        """Pulses of each sweep: as many as reach the block, their angles a little off from sweep to sweep."""
        half = self.width_m / 2 + 5.0
        y, z = path.position[columns, 1], path.position[columns, 2]
        first, last = np.arctan2(-half - y, z), np.arctan2(half - y, z)
        n = int(np.ceil(2 * half / self._step_m))
        jitter = np.mod(columns * 0.618, 1.0) - 0.5
        angle = first[:, None] + (np.arange(n) + 0.5 + jitter[:, None]) / n * (last - first)[:, None]
        nod = np.radians(0.4) * np.sin(columns * 0.7)  # sweeps are not quite across the track
        flat = np.stack([np.broadcast_to(np.sin(nod)[:, None], angle.shape), np.sin(angle), -np.cos(angle)], axis=2)
        return np.asarray((flat / np.linalg.norm(flat, axis=2, keepdims=True)).reshape(-1, 3))

    def can_look(self, directions: FloatArray, heading: FloatArray) -> BoolArray:
        """Downward directions across the track, within the field of view."""
        angle = np.degrees(np.arctan2(np.abs(directions[:, 1]), -directions[:, 2]))
        return np.asarray((angle <= self.half_angle_deg) & (np.abs(directions[:, 0]) < 0.02))


def fly(sensor: AirborneSensor, ground_m: float, random: np.random.Generator) -> Drive:
    """One strip per offset, there and back; one entry of the drive per sweep."""
    strips = [_strip(sensor, i, offset, ground_m, random) for i, offset in enumerate(sensor.offsets_m)]
    return Drive(*(np.concatenate(parts) for parts in zip(*strips, strict=True)))


def _strip(sensor: AirborneSensor, index: int, offset_m: float, ground_m: float, random: np.random.Generator) -> Drive:
    lead = 10.0
    n = int(np.ceil((sensor.length_m + 2 * lead) / sensor._step_m))
    along = (np.arange(n) + random.random(n)) * sensor._step_m - lead
    time = along / sensor.speed_m_s
    x = along if index % 2 == 0 else sensor.length_m - along
    y = offset_m + 3.0 * np.sin(2 * np.pi * x / 400.0 + random.uniform(0, 6))
    z = ground_m + sensor.height_m + 2.0 * np.sin(2 * np.pi * x / 500.0 + random.uniform(0, 6))
    phase = random.uniform(0, 2 * np.pi, 3)
    wave = np.sin(2 * np.pi * along[:, None] / (150.0, 190.0, 230.0) + phase)
    shift = random.normal(0.0, sensor.strip_shift_m, 3) * (1.0, 1.0, 0.5) + sensor.drift_m * wave
    turn = np.radians(sensor.drift_deg) * np.roll(wave, 1, axis=1)
    heading = np.full(n, 0.0 if index % 2 == 0 else np.pi)
    return Drive(time + 600.0 * index, np.stack([x, y, z], axis=1), heading, shift, turn)
