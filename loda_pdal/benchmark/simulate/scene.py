"""A procedural street: terrain with kerbs, plots with houses and gardens, trees, parked vehicles, furniture.

The street runs along x and its middle is y = 0. Across it: carriageway, parking lane, kerb, pavement, front garden,
house. Everything follows from the generator handed in.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from loda_pdal.benchmark.simulate.objects import (
    Annex,
    Bench,
    Bin,
    Bush,
    Cabinet,
    Car,
    Fence,
    GardenWall,
    Hedge,
    House,
    LampPost,
    Shed,
    Sign,
    Thing,
    Tree,
)
from loda_pdal.benchmark.simulate.shapes import Material, Shape, of_triangles
from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array

ROAD_HALF_M = 2.75
"""Half the width of the carriageway."""

KERB_Y_M = 4.95
"""Where the parking lane ends and the kerb rises."""

KERB_M = 0.12
"""Height of the kerb."""

PAVEMENT_END_M = 6.95
"""Where the pavement ends and the front gardens begin."""

FACADE_Y_M = 10.2
"""Usual distance of the house fronts from the middle of the street."""

TERRAIN_MARGIN_M = 45.0
"""How far the ground goes on past both ends of the block, and half its width."""

SLOT_M = 5.9
"""Length of a parking slot."""


@dataclass(frozen=True)
class GroundPatch:
    """A rectangle of ground that is ``dz`` higher (lower where negative), with a sloping rim ``rim`` wide inside it."""

    x0: float
    x1: float
    y0: float
    y1: float
    dz: float
    rim: float = 0.5

    @property
    def area_m2(self) -> float:
        """Area in plan, rim included."""
        return (self.x1 - self.x0) * (self.y1 - self.y0)

    def contains(self, x: FloatArray, y: FloatArray) -> BoolArray:
        """Which of the places lie inside, bool of the shape of ``x``."""
        return np.asarray((x > self.x0) & (x < self.x1) & (y > self.y0) & (y < self.y1))

    def rise(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height that the patch adds, m, of the shape of ``x``."""
        inside = np.minimum(np.minimum(x - self.x0, self.x1 - x), np.minimum(y - self.y0, self.y1 - y))
        return np.asarray(self.dz * np.clip(inside / self.rim, 0.0, 1.0))


class Ground(Protocol):
    """The ground that a scene stands on."""

    @property
    def length(self) -> float:
        """Extent of the block along x, m."""

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height without patches, m, of the shape of ``x``."""

    def surface(self, patches: list[GroundPatch], outlines: list[GroundPatch]) -> tuple[Shape, Int64Array]:
        """Its surface with ``patches`` applied, and for each triangle which of ``outlines`` it lies in (-1 none)."""


@dataclass(frozen=True)
class Terrain:
    """The ground: a slope, long waves, and the street's cross-section.

    ``grade_x`` and ``grade_y`` are rises per metre; the two waves have heights ``waves`` (m), lengths of 70 and 37 m.
    """

    length: float
    grade_x: float
    grade_y: float
    waves: tuple[float, float]
    phases: tuple[float, float]

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height of the ground without patches, m, of the shape of ``x``."""
        wave = self.waves[0] * np.sin(2 * np.pi * x / 70.0 + self.phases[0])
        wave = wave + self.waves[1] * np.sin(2 * np.pi * (0.8 * x + 0.6 * y) / 37.0 + self.phases[1])
        return np.asarray(self.grade_x * x + self.grade_y * y + wave + self._section(np.abs(y)))

    @staticmethod
    def _section(across: FloatArray) -> FloatArray:
        """Cambered road, kerb, pavement and raised gardens, m above the middle of the road."""
        places = [0.0, ROAD_HALF_M, KERB_Y_M, KERB_Y_M + 0.02, PAVEMENT_END_M, PAVEMENT_END_M + 0.3, 400.0]
        camber = -0.02 * KERB_Y_M
        levels = [0.0, -0.02 * ROAD_HALF_M, camber, camber + KERB_M, camber + KERB_M + 0.03, camber + KERB_M + 0.07]
        return np.asarray(np.interp(across, places, [*levels, levels[-1]]))

    def surface(self, patches: list[GroundPatch], outlines: list[GroundPatch]) -> tuple[Shape, Int64Array]:
        """The ground with ``patches`` applied, and for each triangle which of ``outlines`` it lies in (-1 none).

        The mesh has lines along the rims of all ``outlines``, so that epochs with different patches share it.
        """
        far = TERRAIN_MARGIN_M
        xs = set(np.arange(-far, self.length + far + 0.5, 1.5).tolist())
        half = [0.0, 1.4, ROAD_HALF_M, 3.9, KERB_Y_M, KERB_Y_M + 0.02, 6.0, PAVEMENT_END_M, PAVEMENT_END_M + 0.3, 8.7]
        half += np.arange(FACADE_Y_M, far, 2.0).tolist()
        ys = {*half, *(-y for y in half)}
        triangles, owner = mesh(self, xs, ys, patches, outlines)
        across = np.abs(triangles.mean(axis=1)[:, 1])
        zones = [across < KERB_Y_M, across < PAVEMENT_END_M]
        material = np.select(zones, [Material.ASPHALT, Material.PAVING], Material.GRASS)
        shape = replace(of_triangles(triangles, Material.GRASS), triangle_material=material.astype(np.uint8))
        return shape, owner


def mesh(
    ground: Ground, xs: set[float], ys: set[float], patches: list[GroundPatch], outlines: list[GroundPatch]
) -> tuple[FloatArray, Int64Array]:
    """Triangles (t, 3, 3) of a ground over lines at ``xs`` and ``ys`` (m) and along the rims of all outlines, with
    ``patches`` applied, and for each which of the outlines it lies in (-1 none)."""
    rims = [[(p.x0, p.y0), (p.x0 + p.rim, p.y0 + p.rim), (p.x1 - p.rim, p.y1 - p.rim), (p.x1, p.y1)] for p in outlines]
    xs, ys = xs.union(x for rim in rims for x, _ in rim), ys.union(y for rim in rims for _, y in rim)
    x, y = np.meshgrid(sorted(xs), sorted(ys), indexing="ij")
    z = ground.height(x, y) + sum((p.rise(x, y) for p in patches), np.zeros(x.shape))
    nodes = np.stack([x, y, z], axis=2)
    a, b, c, d = nodes[:-1, :-1], nodes[1:, :-1], nodes[1:, 1:], nodes[:-1, 1:]
    triangles = np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3, 3)
    middle = triangles.mean(axis=1)
    owner = np.full(len(triangles), -1)
    for i, p in enumerate(outlines):
        owner[p.contains(middle[:, 0], middle[:, 1])] = i
    return triangles, owner


@dataclass(frozen=True)
class Placed:
    """A thing where it stands: ``x``, ``y`` in m and ``yaw`` in rad in the street's frame."""

    thing: Thing
    x: float
    y: float
    yaw: float = 0.0

    def surface(self, terrain: Ground, foliage: np.random.Generator) -> Shape:
        """Its surface in the street's frame, standing on the unpatched ground."""
        z = float(terrain.height(np.array(self.x), np.array(self.y)))
        return self.thing.surface(foliage).placed(self.x, self.y, z, self.yaw)


@dataclass(frozen=True)
class Plot:
    """A vacant plot: middle of its front, side of the street, and width."""

    x: float
    side: float
    width: float

    @property
    def yaw(self) -> float:
        """Yaw of a house that stands on it."""
        return yaw_of(self.side)


@dataclass
class Street:
    """One state of a street, sorted by what can be edited."""

    terrain: Terrain
    houses: list[Placed] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)
    trees: list[Placed] = field(default_factory=list)
    tree_pits: list[Placed] = field(default_factory=list)
    greenery: list[Placed] = field(default_factory=list)
    cars: list[Placed] = field(default_factory=list)
    slots: list[tuple[float, float]] = field(default_factory=list)
    furniture: list[Placed] = field(default_factory=list)
    boundaries: list[Placed] = field(default_factory=list)


def yaw_of(side: float) -> float:
    """Yaw of things on that side of the street (+1 left, -1 right) that face the road."""
    return 0.0 if side > 0 else np.pi


def draw_street(random: np.random.Generator, length: float) -> Street:
    """A street of ``length`` metres."""
    terrain = Terrain(
        length,
        grade_x=random.uniform(-0.025, 0.025),
        grade_y=random.uniform(-0.012, 0.012),
        waves=(random.uniform(0.1, 0.3), random.uniform(0.04, 0.1)),
        phases=(random.uniform(0, 2 * np.pi), random.uniform(0, 2 * np.pi)),
    )
    street = Street(terrain)
    for side in (1.0, -1.0):
        _lay_out_plots(street, side, random)
        _line_with_trees(street, side, random)
        _park_cars(street, side, random)
        _furnish(street, side, random)
    return street


def draw_house(random: np.random.Generator, width: float) -> House:
    """A detached house of about that width."""
    roof = str(random.choice(["gable", "front gable", "hip", "flat"], p=[0.3, 0.25, 0.3, 0.15]))
    return House(
        width,
        depth=random.uniform(7.5, 9.0),
        storeys=int(random.integers(1, 3)) if roof != "flat" else 2,
        roof=roof,
        pitch_deg=random.uniform(30, 42),
        bays=3,
        has_chimney=bool(random.random() < 0.6),
    )


def draw_tree(random: np.random.Generator) -> Tree:
    """A street tree."""
    height = random.uniform(5.5, 9.5)
    return Tree(
        height,
        crown_base=random.uniform(2.2, 2.9),
        crown_radius=height * random.uniform(0.22, 0.30),
        form=int(random.integers(1 << 30)),
        trunk_radius=0.012 * height + 0.05,
    )


def draw_car(
    random: np.random.Generator, styles: tuple[str, ...] = ("hatchback", "saloon", "estate", "suv", "van")
) -> Car:
    """A vehicle of one of the styles."""
    return Car(str(random.choice(styles)), is_dark=bool(random.random() < 0.35))


def in_slot(car: Car, slot: tuple[float, float], random: np.random.Generator) -> Placed:
    """A vehicle parked in a slot, not quite in the middle and not quite straight."""
    x, side = slot
    yaw = (np.pi if side > 0 else 0.0) + random.normal(0, 0.02)
    return Placed(car, x + random.normal(0, 0.2), side * (3.85 + random.normal(0, 0.08)), yaw)


def _lay_out_plots(street: Street, side: float, random: np.random.Generator) -> None:
    """Terraces, detached houses and vacant plots along one side."""
    x = 2.0 + random.uniform(0, 4)
    kinds: list[str] = []
    while x < street.terrain.length - 12:
        if not kinds:
            kinds = list(random.permutation(["terrace", "detached", "vacant", "detached"]))
        kind = kinds.pop(0)
        room = street.terrain.length - 2.0 - x
        if kind == "terrace":
            x += _build_terrace(street, side, x, room, random)
        elif kind == "detached":
            x += _build_detached(street, side, x, random)
        else:
            width = random.uniform(11, 13)
            street.plots.append(Plot(x + width / 2, side, width))
            x += width


def _build_terrace(street: Street, side: float, x: float, room: float, random: np.random.Generator) -> float:
    """Three to five houses wall to wall; returns the frontage used."""
    width, depth = random.uniform(5.2, 6.4), random.uniform(8.0, 9.5)
    n = min(int(random.integers(3, 6)), int(room // width))
    roof, storeys, pitch = str(random.choice(["gable", "flat"])), int(random.integers(2, 4)), random.uniform(34, 45)
    for i in range(n):
        at = x + (i + 0.5) * width
        house = House(width, depth, storeys, roof, pitch, 2, bool(random.random() < 0.7))
        if random.random() < 0.25:
            house = replace(house, annexes=(front_annex(house, random),))
        street.houses.append(Placed(house, at, side * (FACADE_Y_M + random.uniform(0, 0.06)), yaw_of(side)))
        _plant_front(street, side, at, width, random)
    return n * width + random.uniform(2.5, 4.0)


def _build_detached(street: Street, side: float, x: float, random: np.random.Generator) -> float:
    """One house with room on both sides; returns the frontage used."""
    width, gap = random.uniform(7.5, 9.5), random.uniform(2.6, 3.6)
    at = x + gap / 2 + width / 2
    setback = random.uniform(0.0, 1.2)
    street.houses.append(Placed(draw_house(random, width), at, side * (FACADE_Y_M + setback), yaw_of(side)))
    _plant_front(street, side, at, width + 0.5 * gap, random)
    if random.random() < 0.6:
        y = side * random.uniform(21, 25)
        tree = replace(draw_tree(random), crown_base=1.6)
        street.trees.append(Placed(tree, at + random.uniform(-3, 3) + width / 2, y, 0.0))
    if random.random() < 0.35:
        shed = Shed(random.uniform(2.2, 3.0), random.uniform(2.0, 3.0), random.uniform(2.1, 2.4))
        street.houses.append(Placed(shed, x + gap + width + 0.6, side * (FACADE_Y_M + 6.5), yaw_of(side)))
    return width + gap + 1.6


def front_annex(house: House, random: np.random.Generator) -> Annex:
    """A porch or bay built onto the front of a house."""
    width = min(random.uniform(1.8, 2.6), house.width - 0.6)
    x = -house.width / 2 + random.uniform(0.2, house.width - width - 0.2)
    depth = random.uniform(1.0, 1.5)
    return Annex(x, -depth, width, depth, random.uniform(2.4, 2.9))


def side_annex(house: House, random: np.random.Generator) -> Annex:
    """A garage built onto the right-hand side of a house."""
    return Annex(house.width / 2, random.uniform(0.3, 1.2), random.uniform(2.3, 2.6), random.uniform(3.8, 5.0), 2.7)


def _plant_front(street: Street, side: float, x: float, width: float, random: np.random.Generator) -> None:
    """A wall, fence or hedge towards the pavement with a gap at the door, and sometimes a shrub or a bin."""
    yaw = yaw_of(side)
    left = -width / 2 + 2.0  # the door is the leftmost bay as seen from the road
    length = width / 2 - left - 0.15
    middle = x + np.cos(yaw) * (left + length / 2)
    y = side * (PAVEMENT_END_M + 0.45)
    slope = street.terrain.height(np.array([middle + 1, middle - 1]), np.array([y, y]))
    grade = float(slope[0] - slope[1]) / 2 * float(np.cos(yaw))
    kind = random.choice(["wall", "fence", "hedge", "none"], p=[0.3, 0.2, 0.3, 0.2])
    if kind == "wall":
        street.boundaries.append(Placed(GardenWall(length, random.uniform(0.55, 1.0), grade), middle, y, yaw))
    elif kind == "fence":
        street.boundaries.append(Placed(Fence(length, random.uniform(0.8, 1.1), grade), middle, y, yaw))
    elif kind == "hedge":
        hedge = Hedge(length, random.uniform(0.5, 0.7), random.uniform(0.9, 1.7))
        street.greenery.append(Placed(hedge, middle, y, yaw))
    if random.random() < 0.4:
        bush = Bush(random.uniform(0.4, 0.65), random.uniform(0.8, 1.4))
        at = x + np.cos(yaw) * random.uniform(-0.1, 0.3) * width
        street.greenery.append(Placed(bush, at, side * random.uniform(8.1, 8.4), 0.0))
    if random.random() < 0.3:
        at = x + np.cos(yaw) * (-width / 2 + 0.45)
        street.furniture.append(Placed(Bin(random.uniform(0.95, 1.15)), at, side * 9.3, yaw + random.normal(0, 0.2)))


def _line_with_trees(street: Street, side: float, random: np.random.Generator) -> None:
    """Street trees in the pavement; some pits are empty."""
    x = random.uniform(4, 9)
    while x < street.terrain.length - 3:
        placed = Placed(draw_tree(random), x, side * 5.6, random.uniform(0, 2 * np.pi))
        (street.trees if random.random() < 0.75 else street.tree_pits).append(placed)
        x += random.uniform(9.5, 14)


def _park_cars(street: Street, side: float, random: np.random.Generator) -> None:
    """Vehicles in the parking lane; some slots are empty."""
    for x in np.arange(4.0, street.terrain.length - 4.0, SLOT_M):
        slot = (float(x), side)
        if random.random() < 0.55:
            street.cars.append(in_slot(draw_car(random), slot, random))
        else:
            street.slots.append(slot)


def _furnish(street: Street, side: float, random: np.random.Generator) -> None:
    """Street lights, signs, cabinets, benches and litter bins."""
    yaw, length = yaw_of(side), street.terrain.length
    taken = [tree.x for tree in street.trees + street.tree_pits if tree.y * side > 0 and abs(tree.y) < 7]

    def free(x: float) -> float:
        """The place nearest to ``x`` that keeps clear of what stands there already."""
        steps = np.concatenate([[0.0], *([[s, -s] for s in np.arange(0.5, 8.0, 0.5)])])
        chosen = next((x + s for s in steps if all(abs(x + s - t) > 1.7 for t in taken)), x)
        taken.append(chosen)
        return float(chosen)

    for x in np.arange(8.0 if side > 0 else 21.0, length - 2.0, 27.0):
        street.furniture.append(Placed(LampPost(random.uniform(5.2, 6.2)), free(float(x)), side * 5.35, yaw))
    for thing, y, share in (
        (Sign(random.uniform(2.3, 2.8), True), 5.4, 0.03),
        (Sign(random.uniform(2.2, 2.6), False), 5.4, 0.02),
        (Cabinet(random.uniform(0.9, 1.4), random.uniform(1.0, 1.4)), 6.6, 0.015),
        (Bench(), 6.5, 0.015),
        (Bin(1.0), 5.5, 0.015),
    ):
        for _ in range(max(1, round(share * length))):
            x = free(random.uniform(3, length - 3))
            street.furniture.append(Placed(thing, x, side * y, yaw + random.normal(0, 0.03)))
