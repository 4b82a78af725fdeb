"""What a survey's pulses can meet: a surface that stands, and things that drive or walk through it meanwhile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loda_pdal.benchmark.simulate.raycast import Hits, RayCaster, normals_of
from loda_pdal.benchmark.simulate.scene import Ground
from loda_pdal.benchmark.simulate.shapes import EMPTY, Shape
from loda_pdal.model.cloud import ByteArray, FloatArray


@dataclass(frozen=True, eq=False)
class Mover:
    """Something that moves along the street at a constant speed while it is surveyed.

    Attributes
    ----------
    shape : Shape
        Its surface about its own origin on the ground, turned the way it heads.
    kind : str
        What it is.
    x, y, speed_m_s : float
        Where it is at the time ``start_s``, and how fast it goes along x (negative: towards -x).
    start_s, stop_s : float
        When it enters and leaves the scene, s since the survey began.
    ground : Ground
        What it moves on.
    """

    shape: Shape
    kind: str
    x: float
    y: float
    speed_m_s: float
    start_s: float
    stop_s: float
    ground: Ground

    def position(self, time: FloatArray) -> FloatArray:
        """Where it is at ``time`` (m,) s, (m, 3) m."""
        x = self.x + self.speed_m_s * (time - self.start_s)
        y = np.full(len(time), self.y)
        return np.stack([x, y, self.ground.height(x, y)], axis=1)

    @property
    def sphere(self) -> tuple[FloatArray, float]:
        """Centre (3,) about its origin and radius of a ball that holds it, m."""
        corners = self.shape.triangles.reshape(-1, 3)
        centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
        return centre, float(np.linalg.norm(corners - centre, axis=1).max())


class World:
    """A scene prepared for pulses.

    Primitives are numbered through: those of the standing surface first (triangles, then discs), then those of each
    mover in turn.
    """

    def __init__(self, standing: Shape = EMPTY, movers: Sequence[Mover] = ()) -> None:
        shapes = [standing, *(m.shape for m in movers)]
        self._standing = RayCaster(standing)
        self._movers = [(m, RayCaster(m.shape)) for m in movers]
        self._first = np.cumsum([len(s) for s in shapes])[:-1]
        self.material: ByteArray = np.concatenate([s.material for s in shapes])
        """`Material` of every primitive, (p,)."""
        self.normals: FloatArray = np.concatenate([normals_of(s) for s in shapes])
        """Unit normal of every primitive, (p, 3); its sign means nothing."""

    def cast(
        self,
        origins: FloatArray,
        directions: FloatArray,
        time: FloatArray,
        max_range_m: float | FloatArray = np.inf,
    ) -> Hits:
        """First surface along rays from ``origins`` (m, 3) in unit ``directions`` (m, 3) at ``time`` (m,) s."""
        hits = self._standing.cast(origins, directions, max_range_m)
        if not self._movers:
            return hits
        range_m, primitive = hits
        limit = np.minimum(range_m, max_range_m)
        for first, (mover, caster) in zip(self._first, self._movers, strict=True):
            centre, radius = mover.sphere
            is_there = (time >= mover.start_s) & (time <= mover.stop_s)
            along = np.abs(mover.x + mover.speed_m_s * (time - mover.start_s) - origins[:, 0])
            at = np.flatnonzero(is_there & (along < limit + radius))
            offset = mover.position(time[at]) - origins[at]
            ahead = np.sum((offset + centre) * directions[at], axis=1)
            aside = np.sum((offset + centre) ** 2, axis=1) - ahead**2
            is_near = (aside < radius**2) & (ahead > -radius) & (ahead - radius < limit[at])
            at, offset = at[is_near], offset[is_near]
            found = caster.cast(-offset, directions[at], limit[at])
            is_hit = found.primitive >= 0
            range_m[at[is_hit]] = limit[at[is_hit]] = found.range_m[is_hit]
            primitive[at[is_hit]] = first + found.primitive[is_hit]
        return Hits(range_m, primitive)
