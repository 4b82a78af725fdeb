"""What clutters a street besides `objects`: containers, shelters, stalls, bicycles, scaffolding, and who passes by.

Built like everything in `objects`: about its own origin on the ground, x along the street, y away from the road.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from loda_pdal.benchmark.simulate.shapes import Material, Shape, box, joined, loft, quads, slab, tube
from loda_pdal.model.labels import ObjectClass


@dataclass(frozen=True)
class Skip:
    """An open container for rubble with sloping ends, filled to ``fill`` of its height."""

    length: float = 3.6
    width: float = 1.75
    height: float = 1.3
    fill: float = 0.7
    object_class: ObjectClass = ObjectClass.OTHER
    kind: str = "skip"

    def surface(self, foliage: np.random.Generator) -> Shape:
        h, w = self.height, self.width / 2
        low, top = self.length / 2 - 0.5, self.length / 2
        at = low + self.fill * (top - low)
        rings = np.array([[(-x, -w, z), (x, -w, z), (x, w, z), (-x, w, z)] for x, z in ((low, 0.05), (top, h))])
        z = self.fill * h
        rubble = np.array([[(-at, -w, z), (at, -w, z), (at, w, z), (-at, w, z)]])
        return joined([loft(rings, Material.METAL), quads(rubble, Material.CONCRETE)])


@dataclass(frozen=True)
class BusShelter:
    """A shelter open to the road (-y): posts, a glass back and one glass side, a roof, a bench."""

    length: float = 3.8
    depth: float = 1.3
    height: float = 2.4
    object_class: ObjectClass = ObjectClass.OTHER
    kind: str = "bus shelter"

    def surface(self, foliage: np.random.Generator) -> Shape:
        x, y, h = self.length / 2, self.depth / 2, self.height
        roof = np.array([(-x, -y, h + 0.1), (x, -y, h + 0.1), (x, y, h), (-x, y, h)])
        panes = [
            [(-x, y, 0.2), (x, y, 0.2), (x, y, h - 0.2), (-x, y, h - 0.2)],
            [(-x, -y, 0.2), (-x, y, 0.2), (-x, y, h - 0.2), (-x, -y, h - 0.2)],
        ]
        posts = [tube((a, y - 0.03, -0.2), (a, y - 0.03, h), 0.05, 0.05, Material.METAL, 6) for a in (-x, 0.0, x)]
        advert = box((x - 0.08, -y, 0.15), (x + 0.08, y, h - 0.2), Material.SIGN, has_bottom=True)
        bench = box((-x + 0.5, y - 0.5, 0.42), (x - 0.9, y - 0.15, 0.48), Material.WOOD, has_bottom=True)
        return joined(
            [slab(roof, 0.1, Material.METAL), quads(np.array(panes), Material.CLEAR_GLASS), *posts, advert, bench]
        )


@dataclass(frozen=True)
class Stall:
    """A market stall: a table under a sloping canopy on four poles, with goods on it or without."""

    width: float = 3.0
    depth: float = 2.0
    is_stocked: bool = True
    object_class: ObjectClass = ObjectClass.OTHER
    kind: str = "market stall"

    def surface(self, foliage: np.random.Generator) -> Shape:
        x, y = self.width / 2, self.depth / 2
        canopy = np.array(
            [(-x - 0.2, -y - 0.3, 2.15), (x + 0.2, -y - 0.3, 2.15), (x + 0.2, y + 0.1, 2.6), (-x - 0.2, y + 0.1, 2.6)]
        )
        poles = [
            tube((a, b, 0), (a, b, 2.15 + 0.2 * (b > 0)), 0.03, 0.03, Material.METAL, 6)
            for a in (-x, x)
            for b in (-y, y)
        ]
        table = box((-x + 0.1, -y + 0.1, 0.75), (x - 0.1, y - 0.8, 0.85), Material.WOOD, has_bottom=True)
        goods = [
            box((a, -y + 0.2, 0.85), (a + 0.5, y - 0.9, 1.05 + 0.1 * (i % 2)), Material.WOOD)
            for i, a in enumerate(np.arange(-x + 0.2, x - 0.6, 0.6) if self.is_stocked else ())
        ]
        return joined([slab(canopy, 0.04, Material.SIGN), *poles, table, *goods])


@dataclass(frozen=True)
class CafeTable:
    """A table of a cafe terrace with its chairs, and a parasol over some."""

    n_chairs: int = 3
    has_parasol: bool = False
    object_class: ObjectClass = ObjectClass.OTHER
    kind: str = "cafe table"

    def surface(self, foliage: np.random.Generator) -> Shape:
        parts = [
            tube((0, 0, 0), (0, 0, 0.7), 0.05, 0.04, Material.METAL, 6),
            tube((0, 0, 0.7), (0, 0, 0.74), 0.36, 0.36, Material.WOOD, 12),
        ]
        for i in range(self.n_chairs):
            angle = 2 * np.pi * i / self.n_chairs + 0.4
            chair = [
                box((-0.2, -0.2, 0.42), (0.2, 0.2, 0.46), Material.WOOD, has_bottom=True),
                box((-0.2, 0.17, 0.46), (0.2, 0.2, 0.88), Material.WOOD, has_bottom=True),
                *(
                    tube((a, b, 0), (a, b, 0.42), 0.015, 0.015, Material.METAL, 4)
                    for a in (-0.18, 0.18)
                    for b in (-0.18, 0.18)
                ),
            ]
            x, y = 0.6 * np.sin(angle), -0.6 * np.cos(angle)
            parts.append(joined(chair).placed(x, y, 0, angle + np.pi))
        if self.has_parasol:
            parts.append(tube((0, 0, 0.7), (0, 0, 2.4), 0.025, 0.025, Material.METAL, 6))
            parts.append(tube((0, 0, 2.05), (0, 0, 2.5), 1.25, 0.05, Material.SIGN, 8))
        return joined(parts)


@dataclass(frozen=True)
class Bike:
    """A parked bicycle along x."""

    object_class: ObjectClass = ObjectClass.MOBILE
    kind: str = "bicycle"

    def surface(self, foliage: np.random.Generator) -> Shape:
        return _bicycle()


@dataclass(frozen=True)
class Bollard:
    """A post at the kerb."""

    height: float = 0.95
    radius: float = 0.08
    object_class: ObjectClass = ObjectClass.OTHER
    kind: str = "bollard"

    def surface(self, foliage: np.random.Generator) -> Shape:
        return tube((0, 0, -0.2), (0, 0, self.height), self.radius, 0.9 * self.radius, Material.METAL)


@dataclass(frozen=True)
class Scaffold:
    """Scaffolding before a facade that stands on y = 0: a lattice of tubes with boarded levels, towards the road (-y).

    ``depth`` lies between 1 and 1.5 m; a level has a handrail and a board on its inner two thirds.
    """

    width: float
    height: float
    depth: float = 1.2
    object_class: ObjectClass = ObjectClass.OTHER
    kind: str = "scaffolding"

    def surface(self, foliage: np.random.Generator) -> Shape:
        x0, near, far = -self.width / 2, -0.2, -0.2 - self.depth
        n_bays = max(round(self.width / 2.2), 1)
        xs = x0 + np.arange(n_bays + 1) * self.width / n_bays
        levels = np.arange(1, max(int(self.height / 2.0), 1) + 1) * 2.0
        top = float(levels[-1]) + 1.1
        bars = [((x, y, -0.3), (x, y, top)) for x in xs for y in (near, far)]
        for z in levels.tolist():
            bars += [((x0, far, z + up), (-x0, far, z + up)) for up in (0.0, 0.5, 1.0)]
            bars += [((x, far, z), (x, near, z)) for x in xs]
        for i, z in enumerate(levels.tolist()):  # braces
            left, right = (xs[0], xs[1]) if i % 2 == 0 else (xs[1], xs[0])
            bars.append(((left, far, z - 2.0), (right, far, z)))
        tubes = [tube(a, b, 0.03, 0.03, Material.METAL, 4) for a, b in bars]
        boards = [
            box((x0, far + 0.3 * self.depth, z), (-x0, near, z + 0.05), Material.WOOD, has_bottom=True)
            for z in levels.tolist()
        ]
        return joined([*tubes, *boards])


@dataclass(frozen=True)
class Person:
    """Somebody on foot, about to step towards +x."""

    height: float = 1.75
    object_class: ObjectClass = ObjectClass.MOBILE
    kind: str = "pedestrian"

    def surface(self, foliage: np.random.Generator) -> Shape:
        return _body(self.height, 0.0, 0.35)


@dataclass(frozen=True)
class Cyclist:
    """Somebody on a bicycle that goes towards +x."""

    object_class: ObjectClass = ObjectClass.MOBILE
    kind: str = "cyclist"

    def surface(self, foliage: np.random.Generator) -> Shape:
        return joined([_bicycle(), _body(1.45, 0.35, 0.2).placed(-0.15, 0.0, 0.0)])


def _body(height: float, base: float, stride: float) -> Shape:
    """Legs, trunk and head of a person whose feet are ``stride`` apart and start at ``base``, m."""
    hip, shoulder = base + 0.47 * (height - base), 0.82 * height + 0.1 * base
    legs = [
        tube((side * stride, side * 0.1, base), (0.0, side * 0.09, hip), 0.06, 0.085, Material.WOOD, 6)
        for side in (-1, 1)
    ]
    trunk = tube((0, 0, hip), (0, 0, shoulder), 0.17, 0.2, Material.WOOD, 8)
    neck = max(height - 0.24, shoulder)
    head = tube((0, 0, neck), (0, 0, neck + 0.24), 0.1, 0.09, Material.LIGHT_PAINT, 8)
    arms = [
        tube((0, s * 0.23, shoulder), (s * 0.2, s * 0.25, hip + 0.05), 0.05, 0.04, Material.WOOD, 5) for s in (-1, 1)
    ]
    return joined([*legs, trunk, head, *arms])


def _bicycle() -> Shape:
    """Two wheels, a frame, a saddle and handlebars."""
    r, x = 0.34, 0.53
    angle = 2 * np.pi * np.arange(13) / 12
    wheels = []
    for centre in (-x, x):
        rim = np.stack([centre + r * np.cos(angle), np.zeros(13), r + r * np.sin(angle)], axis=1)
        wheels += [tube(a, b, 0.02, 0.02, Material.RUBBER, 4) for a, b in pairwise(rim)]
    bars = [
        ((-x, 0, r), (-0.12, 0, 0.3)),
        ((-0.12, 0, 0.3), (-0.2, 0, 0.9)),
        ((-0.12, 0, 0.3), (0.38, 0, 0.8)),
        ((-0.18, 0, 0.8), (0.38, 0, 0.8)),
        ((-x, 0, r), (-0.18, 0, 0.8)),
        ((x, 0, r), (0.38, 0, 1.0)),
        ((0.38, -0.28, 1.02), (0.38, 0.28, 1.02)),
    ]
    frame = [tube(a, b, 0.022, 0.022, Material.METAL, 4) for a, b in bars]
    saddle = box((-0.32, -0.08, 0.9), (-0.08, 0.08, 0.97), Material.RUBBER, has_bottom=True)
    return joined([*wheels, *frame, saddle])
