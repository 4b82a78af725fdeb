"""Surfaces: triangles and leaf discs with a material, and the solids that street objects are built from.

Every solid is made about the origin with z up, in metres; `Shape.placed` puts it where it stands.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise

import numpy as np

from loda_pdal.model.cloud import BoolArray, ByteArray, FloatArray


class Material(IntEnum):
    """What a surface is made of: it decides how often a pulse comes back and how bright.

    A facade is brick with windows that are not part of its shape: `windows_at` says where. Behind glass there is a
    room or a cabin, behind clear glass nothing.
    """

    ASPHALT = 0
    PAVING = 1
    GRASS = 2
    BRICK = 3
    GLASS = 4
    ROOF_TILE = 5
    WOOD = 6
    LEAF = 7
    METAL = 8
    LIGHT_PAINT = 9
    DARK_PAINT = 10
    RUBBER = 11
    CONCRETE = 12
    SIGN = 13
    BITUMEN = 14
    FACADE = 15
    CLEAR_GLASS = 16


_OPTICS = {
    Material.ASPHALT: (0.12, 0.97),
    Material.PAVING: (0.25, 0.98),
    Material.GRASS: (0.40, 0.97),
    Material.BRICK: (0.35, 0.99),
    Material.GLASS: (0.08, 0.30),
    Material.ROOF_TILE: (0.25, 0.98),
    Material.WOOD: (0.35, 0.98),
    Material.LEAF: (0.45, 0.93),
    Material.METAL: (0.40, 0.95),
    Material.LIGHT_PAINT: (0.60, 0.97),
    Material.DARK_PAINT: (0.08, 0.75),
    Material.RUBBER: (0.05, 0.85),
    Material.CONCRETE: (0.40, 0.99),
    Material.SIGN: (0.90, 1.00),
    Material.BITUMEN: (0.07, 0.93),
    Material.FACADE: (0.35, 0.99),
    Material.CLEAR_GLASS: (0.08, 0.20),
}

REFLECTANCE = np.array([_OPTICS[material][0] for material in Material])
"""Share of the light sent back, by `Material`."""

RETURN_SHARE = np.array([_OPTICS[material][1] for material in Material])
"""Probability of a return at normal incidence, by `Material`: most pulses pass through glass."""


@dataclass(frozen=True)
class Shape:
    """A surface.

    Attributes
    ----------
    triangles : (t, 3, 3) float64, m
        Corners.
    triangle_material : (t,) uint8
        `Material` of each.
    discs : (d, 7) float64, m
        Centre, unit normal and radius of leaves.
    disc_material : (d,) uint8
        `Material` of each.
    """

    triangles: FloatArray
    triangle_material: ByteArray
    discs: FloatArray
    disc_material: ByteArray

    def __len__(self) -> int:
        return len(self.triangles) + len(self.discs)

    @property
    def material(self) -> ByteArray:
        """`Material` of every primitive, triangles first, (t + d,)."""
        return np.concatenate([self.triangle_material, self.disc_material])

    def placed(self, x: float, y: float, z: float, yaw: float = 0.0) -> Shape:
        """The same surface turned by ``yaw`` (rad, about z) and then moved."""
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        discs = self.discs.copy()
        discs[:, :3] = discs[:, :3] @ turn.T + (x, y, z)
        discs[:, 3:6] = discs[:, 3:6] @ turn.T
        return Shape(self.triangles @ turn.T + (x, y, z), self.triangle_material, discs, self.disc_material)


def joined(shapes: Iterable[Shape]) -> Shape:
    """All surfaces as one, in order."""
    parts = [EMPTY, *shapes]
    return Shape(
        np.concatenate([p.triangles for p in parts]),
        np.concatenate([p.triangle_material for p in parts]),
        np.concatenate([p.discs for p in parts]),
        np.concatenate([p.disc_material for p in parts]),
    )


def of_triangles(triangles: FloatArray, material: Material) -> Shape:
    """A surface of ``triangles`` (t, 3, 3) of one material."""
    corners = np.asarray(triangles, dtype=float).reshape(-1, 3, 3)
    return Shape(
        corners, np.full(len(corners), material, dtype=np.uint8), np.empty((0, 7)), np.empty(0, dtype=np.uint8)
    )


def of_discs(discs: FloatArray, material: Material = Material.LEAF) -> Shape:
    """A surface of ``discs`` (d, 7) of one material."""
    return Shape(np.empty((0, 3, 3)), np.empty(0, dtype=np.uint8), discs, np.full(len(discs), material, dtype=np.uint8))


EMPTY = Shape(np.empty((0, 3, 3)), np.empty(0, dtype=np.uint8), np.empty((0, 7)), np.empty(0, dtype=np.uint8))
"""No surface at all."""


def quads(corners: FloatArray, material: Material) -> Shape:
    """Quadrilaterals ``corners`` (q, 4, 3), each as two triangles."""
    c = np.asarray(corners, dtype=float).reshape(-1, 4, 3)
    return of_triangles(np.stack([c[:, (0, 1, 2)], c[:, (0, 2, 3)]], axis=1), material)


def box(low: Sequence[float], high: Sequence[float], material: Material, *, has_bottom: bool = False) -> Shape:
    """An upright box between two corners, by default open beneath."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    faces = [
        [(x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)],
        [(x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)],
        [(x1, y1, z0), (x0, y1, z0), (x0, y1, z1), (x1, y1, z1)],
        [(x0, y1, z0), (x0, y0, z0), (x0, y0, z1), (x0, y1, z1)],
        [(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)],
    ]
    if has_bottom:
        faces.append([(x0, y0, z0), (x0, y1, z0), (x1, y1, z0), (x1, y0, z0)])
    return quads(np.array(faces), material)


def slab(corners: FloatArray, thickness: float, material: Material) -> Shape:
    """A plate of even thickness beneath the quadrilateral ``corners`` (4, 3)."""
    top = np.asarray(corners, dtype=float)
    bottom = top - (0.0, 0.0, thickness)
    sides = [[top[i], top[(i + 1) % 4], bottom[(i + 1) % 4], bottom[i]] for i in range(4)]
    return quads(np.array([top, bottom, *sides]), material)


def tube(
    start: Sequence[float], end: Sequence[float], radius: float, end_radius: float, material: Material, n_sides: int = 8
) -> Shape:
    """A round bar between two points that may taper, closed at its end."""
    a, b = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    axis = (b - a) / np.linalg.norm(b - a)
    helper = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    u = np.cross(axis, helper)
    u /= np.linalg.norm(u)
    angles = 2 * np.pi * np.arange(n_sides) / n_sides
    ring = np.cos(angles)[:, None] * u + np.sin(angles)[:, None] * np.cross(axis, u)
    lower, upper = a + radius * ring, b + end_radius * ring
    turned = np.roll(np.arange(n_sides), -1)
    sides = quads(np.stack([lower, lower[turned], upper[turned], upper], axis=1), material)
    cap = np.stack([np.broadcast_to(b, upper.shape), upper, upper[turned]], axis=1)
    return joined([sides, of_triangles(cap, material)])


def loft(rings: FloatArray, material: Material | Sequence[Material]) -> Shape:
    """The skin over closed ``rings`` (r, k, 3) of k corners each; one material, or one per strip along a ring."""
    here, there = rings[:-1], rings[1:]
    k = rings.shape[1]
    strips = []
    for i in range(k):
        j = (i + 1) % k
        strip_material = material if isinstance(material, Material) else material[i]
        strips.append(quads(np.stack([here[:, i], here[:, j], there[:, j], there[:, i]], axis=1), strip_material))
    return joined(strips)


@dataclass(frozen=True)
class Opening:
    """A window or door in a wall: left edge, sill, width and height (m), how deep it is set back, and its filling."""

    left: float
    sill: float
    width: float
    height: float
    depth: float = 0.14
    material: Material = Material.GLASS


def wall(
    origin: Sequence[float],
    along: Sequence[float],
    width: float,
    height: float,
    openings: Sequence[Opening] = (),
    material: Material = Material.BRICK,
) -> Shape:
    """An upright wall with set-back openings.

    ``along`` is the horizontal unit direction of the wall as seen from outside, left to right; outside lies to its
    right-hand side.
    """
    base, right = np.asarray(origin, dtype=float), np.asarray(along, dtype=float)
    up, inward = np.array([0.0, 0.0, 1.0]), np.array([-right[1], right[0], 0.0])

    def quad(u0: float, u1: float, v0: float, v1: float, deep: float = 0.0) -> list[FloatArray]:
        corners = ((u0, v0), (u1, v0), (u1, v1), (u0, v1))
        return [base + u * right + v * up + deep * inward for u, v in corners]

    us = sorted({0.0, width, *(o.left for o in openings), *(o.left + o.width for o in openings)})
    vs = sorted({0.0, height, *(o.sill for o in openings), *(o.sill + o.height for o in openings)})
    solid = []
    for u0, u1 in pairwise(us):
        for v0, v1 in pairwise(vs):
            u, v = (u0 + u1) / 2, (v0 + v1) / 2
            if not any(o.left < u < o.left + o.width and o.sill < v < o.sill + o.height for o in openings):
                solid.append(quad(u0, u1, v0, v1))
    shapes = [quads(np.array(solid), material)]
    for o in openings:
        front = quad(o.left, o.left + o.width, o.sill, o.sill + o.height)
        back = quad(o.left, o.left + o.width, o.sill, o.sill + o.height, o.depth)
        reveals = [[front[i], front[(i + 1) % 4], back[(i + 1) % 4], back[i]] for i in range(4)]
        shapes += [quads(np.array(reveals), material), quads(np.array([back]), o.material)]
    return joined(shapes)


def leaves(centres: FloatArray, radius: float, random: np.random.Generator) -> Shape:
    """Leaf discs about ``centres`` (d, 3), turned every way, of radius 0.7 to 1.3 times ``radius``."""
    normals = random.normal(size=centres.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    radii = radius * random.uniform(0.7, 1.3, size=(len(centres), 1))
    return of_discs(np.hstack([centres, normals, radii]))


def windows_at(points: FloatArray, normals: FloatArray) -> BoolArray:
    """Which places (n, 3) m on facades with unit ``normals`` (n, 3) lie in a window, (n,): one of 1.3 x 1.6 m in every
    2.5 m along the wall and every 3 m up. The same at every survey, since it follows from the place alone."""
    along = points[:, 0] * normals[:, 1] - points[:, 1] * normals[:, 0]
    up = points[:, 2]
    return np.asarray((np.mod(along, 2.5) < 1.3) & (np.mod(up, 3.0) > 0.9) & (np.mod(up, 3.0) < 2.5))


def distance_to_triangles(points: FloatArray, triangles: FloatArray) -> FloatArray:
    """Distance (n,) of points (n, 3) to the nearest of the triangles (t, 3, 3), m; infinity where there is none."""
    nearest = np.full(len(points), np.inf)
    for a, b, c in triangles:
        edges, normal = np.array([b - a, c - b, a - c]), np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-12:
            continue
        normal /= length
        offset = points - a
        is_over = np.ones(len(points), dtype=bool)
        for corner, edge in zip((a, b, c), edges, strict=True):
            along = np.clip((points - corner) @ edge / (edge @ edge), 0.0, 1.0)
            gap = np.linalg.norm(points - corner - along[:, None] * edge, axis=1)
            nearest = np.minimum(nearest, gap)
            is_over &= np.cross(edge, points - corner) @ normal >= 0
        nearest[is_over] = np.minimum(nearest[is_over], np.abs(offset[is_over] @ normal))
    return nearest
