"""What stands in a street, each thing described by a few numbers and able to show its surface.

A thing is built about its own origin: on the ground, x along the street, y away from the road, z up, in metres. Its
`surface` is the same at every survey, except for leaves, which are drawn anew from the generator handed in.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from loda_pdal.benchmark.simulate.shapes import (
    Material,
    Opening,
    Shape,
    box,
    joined,
    leaves,
    loft,
    of_triangles,
    quads,
    slab,
    tube,
    wall,
)
from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.labels import ObjectClass

STOREY_M = 2.9
"""Height of one storey."""

FOUNDATION_M = 0.8
"""How far walls reach below the ground, so that slopes leave no gap under them."""


class Thing(Protocol):
    """Anything that can be put into a scene."""

    @property
    def object_class(self) -> ObjectClass:
        """Class of the instance."""

    @property
    def kind(self) -> str:
        """What it is, in one or two words."""

    def surface(self, foliage: np.random.Generator) -> Shape:
        """Its surface about its own origin; ``foliage`` places leaves."""


@dataclass(frozen=True)
class Annex:
    """A flat-roofed part built onto a house: lower left corner as seen from the road, width, depth and height (m)."""

    x: float
    y: float
    width: float
    depth: float
    height: float

    def surface(self) -> Shape:
        """Walls with a window or door in front, and a roof edge."""
        x0, x1, y0, y1 = self.x, self.x + self.width, self.y, self.y + self.depth
        is_tall = self.height > 2.0
        sill, top = (0.9, min(self.height - 0.4, 2.1)) if is_tall else (0.3, self.height - 0.2)
        openings = [Opening(0.25, sill, self.width - 0.5, top - sill)] if self.width > 0.9 else []
        return joined(
            [
                wall((x0, y0, 0.0), (1, 0, 0), self.width, self.height, openings),
                wall((x1, y0, 0.0), (0, 1, 0), self.depth, self.height),
                wall((x0, y1, 0.0), (0, -1, 0), self.depth, self.height),
                wall((x1, y1, 0.0), (-1, 0, 0), self.width, self.height),
                box((x0, y0, -FOUNDATION_M), (x1, y1, 0.0), Material.CONCRETE),
                box(
                    (x0 - 0.08, y0 - 0.08, self.height),
                    (x1 + 0.08, y1 + 0.08, self.height + 0.18),
                    Material.CONCRETE,
                    has_bottom=True,
                ),
            ]
        )


@dataclass(frozen=True)
class Dormer:
    """A dormer in the front slope of a roof whose ridge lies along the street: middle, width and height (m)."""

    x: float
    width: float = 1.8
    height: float = 1.3

    def surface(self, eaves_m: float, slope: float) -> Shape:
        """Cheeks, a flat roof, and a window in front, on a slope that rises from the eaves at y = 0."""
        half, front = self.width / 2, 0.7
        foot = eaves_m + front * slope
        back = front + self.height / slope + 0.2
        pane = Opening(0.2, 0.45, self.width - 0.4, self.height - 0.3, 0.06)
        return joined(
            [
                wall((self.x - half, front, foot - 0.3), (1, 0, 0), self.width, self.height + 0.3, [pane]),
                wall((self.x + half, front, foot), (0, 1, 0), back - front, self.height),
                wall((self.x - half, back, foot), (0, -1, 0), back - front, self.height),
                box(
                    (self.x - half - 0.1, front - 0.15, foot + self.height),
                    (self.x + half + 0.1, back, foot + self.height + 0.15),
                    Material.BITUMEN,
                    has_bottom=True,
                ),
            ]
        )


@dataclass(frozen=True)
class House:
    """A house whose front stands on y = 0 and faces the road (-y).

    ``roof`` is ``flat``, ``gable`` (ridge along the street), ``front gable`` (ridge away from the street) or ``hip``.
    ``bays`` windows stand side by side on each floor; the first bay of the ground floor is the door.
    """

    width: float
    depth: float
    storeys: int
    roof: str
    pitch_deg: float = 40.0
    bays: int = 2
    has_chimney: bool = True
    annexes: tuple[Annex, ...] = ()
    dormers: tuple[Dormer, ...] = ()
    object_class: ObjectClass = ObjectClass.BUILDING

    @property
    def kind(self) -> str:
        return f"house with {self.roof} roof"

    @property
    def eaves_m(self) -> float:
        """Height of the eaves above the ground."""
        return self.storeys * STOREY_M

    def surface(self, foliage: np.random.Generator) -> Shape:
        parts = [self._storey(i) for i in range(self.storeys)]
        parts += [self._foundation(), self._roof(), *(annex.surface() for annex in self.annexes)]
        if self.has_chimney and self.roof != "flat":
            parts.append(self._chimney())
        slope = float(np.tan(np.radians(self.pitch_deg)))
        return joined([*parts, *(dormer.surface(self.eaves_m, slope) for dormer in self.dormers)])

    def _foundation(self) -> Shape:
        w = self.width / 2
        return box((-w, 0.0, -FOUNDATION_M), (w, self.depth, 0.0), Material.CONCRETE)

    def _storey(self, index: int) -> Shape:
        """Four walls of one floor: windows in front and behind, one window in each side."""
        w, z = self.width / 2, index * STOREY_M
        bay = self.width / self.bays
        window = min(1.5, bay - 0.7)
        front, back = [], []
        for i in range(self.bays):
            left = (i + 0.5) * bay
            if index == 0 and i == 0:
                front.append(Opening(left - 0.5, 0.05, 1.0, 2.2, 0.25, Material.WOOD))
            else:
                front.append(Opening(left - window / 2, 0.75, window, 1.6))
            back.append(Opening(left - window / 2, 0.75, window, 1.6))
        side = [Opening(self.depth / 2 - 0.5, 1.0, 1.0, 1.2)]
        sills = [
            box(
                (o.left - w - 0.06, -0.09, z + o.sill - 0.08),
                (o.left - w + o.width + 0.06, 0.0, z + o.sill),
                Material.CONCRETE,
                has_bottom=True,
            )
            for o in front
            if o.material is Material.GLASS
        ]
        return joined(
            [
                wall((-w, 0.0, z), (1, 0, 0), self.width, STOREY_M, front),
                wall((w, 0.0, z), (0, 1, 0), self.depth, STOREY_M, side),
                wall((-w, self.depth, z), (0, -1, 0), self.depth, STOREY_M, side),
                wall((w, self.depth, z), (-1, 0, 0), self.width, STOREY_M, back),
                *sills,
            ]
        )

    def _roof(self) -> Shape:
        if self.roof == "flat":
            return self._flat_roof()
        if self.roof == "hip":
            return self._hip_roof()
        return self._gable_roof()

    def _flat_roof(self) -> Shape:
        """A roof plane inside a parapet, with a cornice in front."""
        w, d, z, t, h = self.width / 2, self.depth, self.eaves_m, 0.22, 0.4
        roof = quads(np.array([[(-w, 0, z), (w, 0, z), (w, d, z), (-w, d, z)]]), Material.CONCRETE)
        rim = [
            box((-w - 0.05, -0.25, z), (w + 0.05, t, z + h), Material.WOOD, has_bottom=True),
            box((-w - 0.05, d - t, z), (w + 0.05, d + 0.05, z + h), Material.BRICK),
            box((-w - 0.05, t, z), (-w + t, d - t, z + h), Material.BRICK),
            box((w - t, t, z), (w + 0.05, d - t, z + h), Material.BRICK),
        ]
        return joined([roof, *rim])

    def _gable_roof(self) -> Shape:
        """Two slabs with eaves, the two gable walls beneath them, and a gutter along each eave."""
        is_front = self.roof == "front gable"
        span, length = (self.width, self.depth) if is_front else (self.depth, self.width)
        slope = np.tan(np.radians(self.pitch_deg))
        z, eave, verge, thickness = self.eaves_m, 0.4, 0.12, 0.18
        half, out = span / 2, span / 2 + eave
        rise, drop = half * slope, eave * slope
        end = length / 2 + verge
        ridge = z + rise + thickness
        # (across, along, up) about the middle of the house; turned into (x, y, z) below
        shapes = []
        for side in (-1.0, 1.0):
            corners = [
                (side * out, -end, z - drop + thickness),
                (side * out, end, z - drop + thickness),
                (0.0, end, ridge),
                (0.0, -end, ridge),
            ]
            shapes.append(slab(np.array(corners), thickness, Material.ROOF_TILE))
            gutter = sorted((side * out, side * (out + 0.14)))
            shapes.append(
                box(
                    (gutter[0], -end, z - drop - 0.02),
                    (gutter[1], end, z - drop + 0.1),
                    Material.METAL,
                    has_bottom=True,
                )
            )
            triangle = [(-half, side * length / 2, z), (half, side * length / 2, z), (0.0, side * length / 2, z + rise)]
            shapes.append(of_triangles(np.array([triangle]), Material.BRICK))
        roof = joined(shapes)
        return roof.placed(0.0, self.depth / 2, 0.0, 0.0 if is_front else np.pi / 2)

    def _hip_roof(self) -> Shape:
        """Four slopes of one pitch with eaves all round."""
        eave, slope = 0.45, np.tan(np.radians(self.pitch_deg))
        w, d, z = self.width / 2 + eave, self.depth / 2 + eave, self.eaves_m - eave * slope + 0.15
        top = z + min(w, d) * slope
        a, b = (w - d, 0.0) if w > d else (0.0, d - w)
        corners = np.array([(-w, -d, z), (w, -d, z), (w, d, z), (-w, d, z)])
        ridge = np.array([(-a, -b, top), (a, b, top)])
        sides = (
            [(corners[0], corners[1], ridge[1], ridge[0]), (corners[2], corners[3], ridge[0], ridge[1])]
            if w > d
            else [(corners[1], corners[2], ridge[1], ridge[0]), (corners[3], corners[0], ridge[0], ridge[1])]
        )
        ends = (
            [(corners[1], corners[2], ridge[1]), (corners[3], corners[0], ridge[0])]
            if w > d
            else [(corners[0], corners[1], ridge[0]), (corners[2], corners[3], ridge[1])]
        )
        soffit = quads(np.array([corners]) - (0.0, 0.0, 0.05), Material.WOOD)
        roof = joined(
            [quads(np.array(sides), Material.ROOF_TILE), of_triangles(np.array(ends), Material.ROOF_TILE), soffit]
        )
        return roof.placed(0.0, self.depth / 2, 0.0)

    def _chimney(self) -> Shape:
        slope = np.tan(np.radians(self.pitch_deg))
        span = self.width if self.roof == "front gable" else self.depth
        top = self.eaves_m + span / 2 * slope + 0.7
        x, y = 0.3 * self.width, 0.55 * self.depth
        return box((x - 0.4, y - 0.3, self.eaves_m + 0.2), (x + 0.4, y + 0.3, top), Material.BRICK)


@dataclass(frozen=True)
class Shed:
    """A small wooden building with a monopitch roof, open to the road like a house."""

    width: float
    depth: float
    height: float
    object_class: ObjectClass = ObjectClass.BUILDING
    kind: str = "shed"

    def surface(self, foliage: np.random.Generator) -> Shape:
        w, d, h = self.width / 2, self.depth, self.height
        door = [Opening(0.4, 0.05, min(1.6, self.width - 0.8), 2.0, 0.1, Material.WOOD)]
        corners = np.array(
            [(-w - 0.2, -0.3, h + 0.45), (w + 0.2, -0.3, h + 0.45), (w + 0.2, d + 0.2, h), (-w - 0.2, d + 0.2, h)]
        )
        return joined(
            [
                wall((-w, 0, 0), (1, 0, 0), self.width, h + 0.25, door, Material.WOOD),
                wall((w, 0, 0), (0, 1, 0), d, h, (), Material.WOOD),
                wall((-w, d, 0), (0, -1, 0), d, h, (), Material.WOOD),
                wall((w, d, 0), (-1, 0, 0), self.width, h, (), Material.WOOD),
                box((-w, 0, -FOUNDATION_M), (w, d, 0), Material.CONCRETE),
                slab(corners, 0.12, Material.ROOF_TILE),
            ]
        )


@dataclass(frozen=True)
class Tree:
    """A tree: total height, where its crown begins, crown radius; ``form`` fixes its limbs and the crown's lobes."""

    height: float
    crown_base: float
    crown_radius: float
    form: int
    trunk_radius: float = 0.16
    leaf_area_density: float = 1.1
    object_class: ObjectClass = ObjectClass.VEGETATION
    kind: str = "tree"

    def surface(self, foliage: np.random.Generator) -> Shape:
        form = np.random.default_rng([self.form, 77])
        crown = self.height - self.crown_base
        middle = self.crown_base + 0.45 * crown
        trunk = [
            tube(
                (0, 0, -0.4), (0, 0, self.crown_base + 0.1), self.trunk_radius * 1.15, self.trunk_radius, Material.WOOD
            ),
            tube((0, 0, self.crown_base), (0, 0, middle + 0.25 * crown), self.trunk_radius, 0.04, Material.WOOD, 6),
        ]
        lobes = self._lobes(form)
        limbs = [
            tube((0, 0, self.crown_base + 0.1 * crown), lobe[:3], 0.07, 0.02, Material.WOOD, 5)
            for lobe in lobes[1:]
            if np.hypot(lobe[0], lobe[1]) > 0.1
        ]
        return joined([*trunk, *limbs, self._leaves(lobes, foliage)])

    def _lobes(self, form: np.random.Generator) -> FloatArray:
        """Ellipsoids that make up the crown: centre, horizontal and vertical radius, (l, 5)."""
        crown, r = self.height - self.crown_base, self.crown_radius
        lobes = [(0.0, 0.0, self.crown_base + 0.52 * crown, 0.72 * r, 0.48 * crown)]
        n = 7
        for i in range(n):
            angle = 2 * np.pi * (i + form.uniform(-0.3, 0.3)) / n
            size = form.uniform(0.38, 0.52)
            reach = (1.0 - size) * r
            z = self.crown_base + crown * form.uniform(0.3, 0.72)
            lobes.append(
                (reach * np.cos(angle), reach * np.sin(angle), z, size * r, min(size * 0.6 * crown, 0.25 * crown))
            )
        return np.array(lobes)

    def _leaves(self, lobes: FloatArray, foliage: np.random.Generator) -> Shape:
        """Leaf clusters, denser towards the skin of each lobe."""
        radius = 0.11
        volume = 4 / 3 * np.pi * lobes[:, 3] ** 2 * lobes[:, 4]
        n = np.ceil(0.7 * self.leaf_area_density * volume / (np.pi * radius**2)).astype(int)
        lobe = np.repeat(np.arange(len(lobes)), n)
        direction = foliage.normal(size=(len(lobe), 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        depth = foliage.uniform(0.1, 1.0, size=(len(lobe), 1)) ** 0.28
        extent = lobes[lobe][:, (3, 3, 4)]
        return leaves(lobes[lobe, :3] + direction * depth * extent, radius, foliage)


@dataclass(frozen=True)
class Hedge:
    """A clipped hedge along x."""

    length: float
    thickness: float
    height: float
    object_class: ObjectClass = ObjectClass.VEGETATION
    kind: str = "hedge"

    def surface(self, foliage: np.random.Generator) -> Shape:
        radius = 0.07
        n = int(np.ceil(5.0 * self.length * self.thickness * self.height / (np.pi * radius**2)))
        half = np.array([self.length / 2, self.thickness / 2, self.height / 2])
        centres = foliage.uniform(-1.0, 1.0, size=(n, 3))
        centres = np.sign(centres) * np.abs(centres) ** 0.7 * half + (0.0, 0.0, half[2])
        centres[:, 2] += 0.04 * np.sin(3.1 * centres[:, 0])
        return leaves(centres, radius, foliage)


@dataclass(frozen=True)
class Bush:
    """A round shrub."""

    radius: float
    height: float
    object_class: ObjectClass = ObjectClass.VEGETATION
    kind: str = "bush"

    def surface(self, foliage: np.random.Generator) -> Shape:
        leaf = 0.07
        volume = 4 / 3 * np.pi * self.radius**2 * self.height / 2
        n = int(np.ceil(4.0 * volume / (np.pi * leaf**2)))
        direction = foliage.normal(size=(n, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        depth = foliage.uniform(0.05, 1.0, size=(n, 1)) ** 0.4
        extent = np.array([self.radius, self.radius, self.height / 2])
        return leaves(direction * depth * extent + (0.0, 0.0, 0.52 * self.height), leaf, foliage)


@dataclass(frozen=True)
class CarStyle:
    """Proportions of a vehicle: length, width, height, and its side view from nose to tail.

    ``profile`` gives, at each share of the length, the height of the bonnet or belt line and of the top, as shares of
    the height; where the two differ there is a cabin with glass.
    """

    length: float
    width: float
    height: float
    profile: tuple[tuple[float, float, float], ...]


CAR_STYLES = {
    "hatchback": CarStyle(
        3.95,
        1.72,
        1.46,
        (
            (0.0, 0.42, 0.42),
            (0.05, 0.55, 0.55),
            (0.26, 0.64, 0.64),
            (0.42, 0.65, 0.97),
            (0.6, 0.66, 1.0),
            (0.88, 0.67, 0.93),
            (0.98, 0.66, 0.66),
            (1.0, 0.4, 0.4),
        ),
    ),
    "saloon": CarStyle(
        4.65,
        1.80,
        1.44,
        (
            (0.0, 0.4, 0.4),
            (0.04, 0.53, 0.53),
            (0.27, 0.64, 0.64),
            (0.42, 0.66, 0.98),
            (0.6, 0.67, 1.0),
            (0.72, 0.68, 0.95),
            (0.86, 0.7, 0.7),
            (0.98, 0.68, 0.68),
            (1.0, 0.42, 0.42),
        ),
    ),
    "estate": CarStyle(
        4.75,
        1.84,
        1.50,
        (
            (0.0, 0.4, 0.4),
            (0.04, 0.53, 0.53),
            (0.26, 0.62, 0.62),
            (0.4, 0.64, 0.97),
            (0.6, 0.65, 1.0),
            (0.9, 0.66, 0.95),
            (0.98, 0.66, 0.66),
            (1.0, 0.4, 0.4),
        ),
    ),
    "suv": CarStyle(
        4.50,
        1.88,
        1.72,
        (
            (0.0, 0.45, 0.45),
            (0.04, 0.58, 0.58),
            (0.25, 0.66, 0.66),
            (0.36, 0.67, 0.96),
            (0.6, 0.68, 1.0),
            (0.92, 0.68, 0.96),
            (0.98, 0.67, 0.67),
            (1.0, 0.45, 0.45),
        ),
    ),
    "van": CarStyle(
        5.00,
        1.98,
        2.15,
        (
            (0.0, 0.36, 0.36),
            (0.05, 0.48, 0.48),
            (0.17, 0.54, 0.54),
            (0.3, 0.56, 0.95),
            (0.42, 0.57, 1.0),
            (0.97, 0.57, 0.99),
            (1.0, 0.56, 0.95),
        ),
    ),
    "lorry": CarStyle(
        5.60,
        2.20,
        2.95,
        (
            (0.0, 0.3, 0.3),
            (0.01, 0.38, 0.8),
            (0.2, 0.38, 0.82),
            (0.23, 0.38, 1.0),
            (0.98, 0.38, 1.0),
            (1.0, 0.38, 0.99),
        ),
    ),
    "caravan": CarStyle(
        5.10,
        2.15,
        2.55,
        (
            (0.0, 0.2, 0.2),
            (0.14, 0.24, 0.24),
            (0.16, 0.4, 0.8),
            (0.26, 0.42, 0.98),
            (0.9, 0.42, 1.0),
            (1.0, 0.4, 0.85),
        ),
    ),
}
"""Vehicles by name."""


@dataclass(frozen=True)
class Car:
    """A parked vehicle pointing along x, of one of `CAR_STYLES`."""

    style: str
    is_dark: bool = False
    object_class: ObjectClass = ObjectClass.MOBILE

    @property
    def kind(self) -> str:
        return self.style

    def surface(self, foliage: np.random.Generator) -> Shape:
        style = CAR_STYLES[self.style]
        paint = Material.DARK_PAINT if self.is_dark else Material.LIGHT_PAINT
        rings = np.array([self._ring(style, *station) for station in style.profile])
        glass = Material.GLASS if style.height < 2.0 else paint
        # strips between the corners of a ring: sill, flank, window, roof, window, flank, floor
        body = loft(rings, [paint, paint, glass, paint, glass, paint, paint, Material.RUBBER])
        ends = [
            quads(np.array([ring[[0, 1, 6, 7]], ring[[1, 2, 5, 6]], ring[[2, 3, 4, 5]]]), paint)
            for ring in (rings[0], rings[-1])
        ]
        return joined([body, *ends, *self._wheels(style), *self._mirrors(style, paint)])

    @staticmethod
    def _ring(style: CarStyle, share: float, belt: float, top: float) -> FloatArray:
        """Eight corners of the cross-section at ``share`` of the length, from the left sill over the roof, (8, 3)."""
        x = (0.5 - share) * style.length
        taper = 1.0 - 0.16 * max(abs(share - 0.5) - 0.34, 0.0) / 0.16
        half, sill = style.width / 2 * taper, 0.22
        roof_half = half * (0.94 if top <= belt else 0.78 if style.height < 2.0 else 0.88)
        z_belt, z_top = belt * style.height, max(top, belt) * style.height
        z_flank = sill + 0.55 * (z_belt - sill)
        left = [(x, half * 0.93, sill), (x, half, z_flank), (x, half * 0.97, z_belt), (x, roof_half, z_top + 0.001)]
        return np.array(left + [(x, -y, z) for _, y, z in reversed(left)])

    @staticmethod
    def _wheels(style: CarStyle) -> Iterable[Shape]:
        radius = 0.31 if style.height < 1.6 else 0.36
        for x in (0.5 - 0.19, 0.5 - 0.80):
            for side in (-1.0, 1.0):
                outer, inner = side * style.width * 0.49, side * (style.width * 0.49 - 0.22)
                yield tube(
                    (x * style.length, inner, radius),
                    (x * style.length, outer, radius),
                    radius,
                    radius,
                    Material.RUBBER,
                    12,
                )

    @staticmethod
    def _mirrors(style: CarStyle, paint: Material) -> Iterable[Shape]:
        x, z = (0.5 - 0.34) * style.length, 0.68 * style.height
        for side in (-1.0, 1.0):
            y = sorted((side * style.width * 0.47, side * (style.width * 0.47 + 0.2)))
            yield box((x, y[0], z), (x + 0.1, y[1], z + 0.14), paint, has_bottom=True)


@dataclass(frozen=True)
class GardenWall:
    """A low brick wall along x with a coping, standing on ground that rises by ``grade`` per metre of x."""

    length: float
    height: float
    grade: float = 0.0
    object_class: ObjectClass = ObjectClass.OTHER
    kind: str = "garden wall"

    def surface(self, foliage: np.random.Generator) -> Shape:
        half, rise = self.length / 2, self.grade * self.length / 2
        ends = ((-half, -rise), (half, rise))
        parts = []
        for t, low, high, material in (
            (0.11, -0.5, self.height, Material.BRICK),
            (0.15, self.height, self.height + 0.07, Material.CONCRETE),
        ):
            rings = np.array(
                [[(x, -t, z + low), (x, t, z + low), (x, t, z + high), (x, -t, z + high)] for x, z in ends]
            )
            parts += [loft(rings, material), quads(rings, material)]
        return joined(parts)


@dataclass(frozen=True)
class Fence:
    """A picket fence along x: posts, two rails and open slats; ``grade`` as for `GardenWall`."""

    length: float
    height: float
    grade: float = 0.0
    object_class: ObjectClass = ObjectClass.OTHER
    kind: str = "fence"

    def surface(self, foliage: np.random.Generator) -> Shape:
        parts = []
        for x in np.arange(-self.length / 2, self.length / 2 + 1e-6, 0.16):
            z = self.grade * x
            wide = 0.04
            parts.append(box((x - wide, -0.015, z + 0.05), (x + wide, 0.015, z + self.height), Material.WOOD))
        half = self.length / 2
        for height in (0.25, 0.8 * self.height):
            for x0 in np.linspace(-half, half, 5)[:-1]:
                z = self.grade * (x0 + half / 4) + height
                parts.append(box((x0, 0.015, z), (x0 + half / 2, 0.06, z + 0.09), Material.WOOD, has_bottom=True))
        return joined(parts)


@dataclass(frozen=True)
class LampPost:
    """A street light whose arm reaches over the road (-y)."""

    height: float
    object_class: ObjectClass = ObjectClass.OTHER
    kind: str = "lamp post"

    def surface(self, foliage: np.random.Generator) -> Shape:
        h = self.height
        return joined(
            [
                tube((0, 0, -0.2), (0, 0, 1.2), 0.11, 0.11, Material.METAL),
                tube((0, 0, 1.2), (0, 0, h), 0.075, 0.05, Material.METAL),
                tube((0, 0, h - 0.05), (0, -1.0, h + 0.1), 0.04, 0.04, Material.METAL, 6),
                box((-0.14, -1.55, h + 0.04), (0.14, -0.9, h + 0.17), Material.METAL, has_bottom=True),
            ]
        )


@dataclass(frozen=True)
class Sign:
    """A traffic sign: a round plate, or a board, on a thin pole."""

    height: float
    is_round: bool = True
    object_class: ObjectClass = ObjectClass.OTHER
    kind: str = "sign"

    def surface(self, foliage: np.random.Generator) -> Shape:
        pole = tube((0, 0, -0.2), (0, 0, self.height), 0.038, 0.038, Material.METAL)
        if not self.is_round:
            board = box((-0.045, -0.32, self.height - 0.9), (-0.04, 0.32, self.height), Material.SIGN, has_bottom=True)
            return joined([pole, board])
        angles = 2 * np.pi * np.arange(17) / 16
        rim = np.stack([np.full(17, -0.05), 0.32 * np.cos(angles), self.height - 0.3 + 0.32 * np.sin(angles)], axis=1)
        centre = np.broadcast_to([-0.05, 0.0, self.height - 0.3], (16, 3))
        return joined([pole, of_triangles(np.stack([centre, rim[:-1], rim[1:]], axis=1), Material.SIGN)])


@dataclass(frozen=True)
class Bin:
    """A wheeled bin with a slanting lid."""

    size: float = 1.0
    object_class: ObjectClass = ObjectClass.OTHER
    kind: str = "bin"

    def surface(self, foliage: np.random.Generator) -> Shape:
        s = self.size
        low = [
            (-0.24 * s, -0.27 * s, 0.06),
            (0.24 * s, -0.27 * s, 0.06),
            (0.24 * s, 0.27 * s, 0.06),
            (-0.24 * s, 0.27 * s, 0.06),
        ]
        high = [
            (-0.29 * s, -0.34 * s, 0.98 * s),
            (0.29 * s, -0.34 * s, 0.98 * s),
            (0.29 * s, 0.36 * s, 1.08 * s),
            (-0.29 * s, 0.36 * s, 1.08 * s),
        ]
        rings = np.array([low, high])
        return joined([loft(rings, Material.RUBBER), quads(rings[1:], Material.RUBBER)])


@dataclass(frozen=True)
class Bench:
    """A park bench facing the road."""

    length: float = 1.8
    object_class: ObjectClass = ObjectClass.OTHER
    kind: str = "bench"

    def surface(self, foliage: np.random.Generator) -> Shape:
        half = self.length / 2
        slats = [((-half, y, 0.43), (half, y + 0.11, 0.46)) for y in (-0.22, -0.09, 0.04)]
        back = [((-half, 0.2, z), (half, 0.23, z + 0.11)) for z in (0.55, 0.72)]
        legs = [((x - 0.04, -0.2, -0.1), (x + 0.04, 0.22, 0.43)) for x in (-half + 0.2, half - 0.2)]
        posts = [((x - 0.04, 0.19, 0.43), (x + 0.04, 0.22, 0.84)) for x in (-half + 0.2, half - 0.2)]
        return joined(
            [
                *(box(a, b, Material.WOOD, has_bottom=True) for a, b in slats + back),
                *(box(a, b, Material.METAL, has_bottom=True) for a, b in legs + posts),
            ]
        )


@dataclass(frozen=True)
class Cabinet:
    """A utility cabinet beside the pavement."""

    width: float = 1.2
    height: float = 1.3
    object_class: ObjectClass = ObjectClass.OTHER
    kind: str = "cabinet"

    def surface(self, foliage: np.random.Generator) -> Shape:
        w, h = self.width / 2, self.height
        return joined(
            [
                box((-w, -0.2, -0.2), (w, 0.2, h), Material.METAL),
                box((-w - 0.03, -0.24, h), (w + 0.03, 0.24, h + 0.06), Material.METAL, has_bottom=True),
            ]
        )
