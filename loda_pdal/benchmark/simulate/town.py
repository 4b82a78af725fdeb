"""A block of a real city: buildings of a city model, with everything else drawn around them.

The block lies along the longest open strip that a few hundred tries find, which is its street: x runs along it and its
middle is y = 0. Buildings stand where the model has them; trees, vehicles, hedges, fences and sheds are drawn into the
space between, some of it overhanging roofs and touching walls.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
import shapely.ops

from loda_pdal.benchmark.simulate.city_model import ModelBuilding
from loda_pdal.benchmark.simulate.edits import (
    ADDED,
    DECREASED,
    INCREASED,
    REMOVED,
    UNCHANGED,
    GroundItem,
    Item,
    Ledger,
    replace_vehicle,
)
from loda_pdal.benchmark.simulate.objects import FOUNDATION_M, Bush, Fence, Hedge, LampPost, Shed, Tree
from loda_pdal.benchmark.simulate.scene import GroundPatch, Placed, draw_car, draw_tree, mesh
from loda_pdal.benchmark.simulate.shapes import Material, Shape, box, joined, of_triangles
from loda_pdal.model.cloud import FloatArray, Int64Array
from loda_pdal.model.errors import InputError
from loda_pdal.model.labels import ObjectClass

_TRIES = 600
_LEAST_COVER, _MOST_COVER = 0.12, 0.60
_WALL_TOP_M = 1.5
"""Corners higher than this above the foot of a building move when a storey is put in or taken out."""


_WALL_GAP_M = 0.1
"""A piece of outline this near to a wall has one."""


@dataclass(frozen=True, eq=False)
class ModelHouse:
    """A building of the model: triangles about the middle of its footprint (x, y) and its foot (z), m.

    ``lift_m`` is how much higher everything above the ground floor stands than in the model; ``boxes`` are annexes and
    roof structures as (low corner, high corner, yaw), the corners before turning.
    """

    name: str
    triangles: FloatArray
    footprint: Any
    lift_m: float = 0.0
    boxes: tuple[tuple[tuple[float, float, float], tuple[float, float, float], float], ...] = ()
    object_class: ObjectClass = ObjectClass.BUILDING

    @property
    def kind(self) -> str:
        return "building of the model"

    @property
    def height_m(self) -> float:
        """Height of the highest corner above the foot."""
        return float(self.triangles[:, :, 2].max()) + self.lift_m

    @property
    def eaves_m(self) -> float:
        """Height of the lowest corner that is not at the foot."""
        z = self.triangles[:, :, 2]
        return float(z[z > _WALL_TOP_M].min(initial=self.height_m - self.lift_m)) + self.lift_m

    def surface(self, foliage: np.random.Generator) -> Shape:
        corners = self.triangles.copy()
        z = corners[:, :, 2]
        z[z > _WALL_TOP_M] += self.lift_m
        z[z < 0.3] -= FOUNDATION_M
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        rise = np.abs(normal[:, 2]) / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
        kinds = (
            (rise <= 0.2, Material.FACADE),
            ((rise > 0.2) & (rise <= 0.98), Material.ROOF_TILE),
            (rise > 0.98, Material.BITUMEN),
        )
        parts = [of_triangles(corners[is_kind], material) for is_kind, material in kinds]
        parts += [box(low, high, Material.CONCRETE).placed(0, 0, 0, yaw) for low, high, yaw in self.boxes]
        return joined(parts)

    def roof_at(self, x: float, y: float) -> float:
        """Height of the highest surface over a place (m, about the same origin); 0 where there is none."""
        a, b, c = self.triangles[:, 0], self.triangles[:, 1], self.triangles[:, 2]
        det = (b[:, 1] - c[:, 1]) * (a[:, 0] - c[:, 0]) + (c[:, 0] - b[:, 0]) * (a[:, 1] - c[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):  # upright triangles have no area in plan
            u = ((b[:, 1] - c[:, 1]) * (x - c[:, 0]) + (c[:, 0] - b[:, 0]) * (y - c[:, 1])) / det
            v = ((c[:, 1] - a[:, 1]) * (x - c[:, 0]) + (a[:, 0] - c[:, 0]) * (y - c[:, 1])) / det
            z = u * a[:, 2] + v * b[:, 2] + (1 - u - v) * c[:, 2]
            is_over = (np.abs(det) > 1e-9) & (u >= 0) & (v >= 0) & (u + v <= 1)
        return float(z[is_over].max(initial=0.0)) + self.lift_m


@dataclass(frozen=True)
class TownTerrain:
    """Ground of a town: a slope and long waves, m."""

    length: float
    half_width: float
    grade: tuple[float, float]
    waves: tuple[float, float]
    phases: tuple[float, float]

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height of the ground without patches, m, of the shape of ``x``."""
        wave = self.waves[0] * np.sin(2 * np.pi * x / 140.0 + self.phases[0])
        wave = wave + self.waves[1] * np.sin(2 * np.pi * (0.6 * x + 0.8 * y) / 60.0 + self.phases[1])
        return np.asarray(self.grade[0] * x + self.grade[1] * y + wave)

    def surface(self, patches: list[GroundPatch], outlines: list[GroundPatch]) -> tuple[Shape, Int64Array]:
        """The ground with ``patches`` applied, and for each triangle which of ``outlines`` it lies in (-1 none)."""
        margin, reach = 45.0, self.half_width + 45.0
        xs = set(np.arange(-margin, self.length + margin + 0.5, 2.0).tolist())
        ys = set(np.arange(-reach, reach + 0.5, 2.0).tolist())
        triangles, owner = mesh(self, xs, ys, patches, outlines)
        is_road = np.abs(triangles.mean(axis=1)[:, 1]) < 5.0
        material = np.where(is_road, Material.ASPHALT, Material.GRASS).astype(np.uint8)
        return replace(of_triangles(triangles, Material.GRASS), triangle_material=material), owner


@dataclass
class Town:
    """One state of a block, sorted by what can be edited; ``slots`` are free places of vehicles, ``pits`` of trees."""

    terrain: TownTerrain
    houses: list[Placed] = field(default_factory=list)
    trees: list[Placed] = field(default_factory=list)
    pits: list[Placed] = field(default_factory=list)
    hedges: list[Placed] = field(default_factory=list)
    cars: list[Placed] = field(default_factory=list)
    slots: list[Placed] = field(default_factory=list)
    sheds: list[Placed] = field(default_factory=list)
    shed_places: list[Placed] = field(default_factory=list)
    others: list[Placed] = field(default_factory=list)
    yards: list[GroundPatch] = field(default_factory=list)
    taken: Any = None
    """What stands on the ground, as one shapely geometry."""


def draw_town(
    buildings: list[ModelBuilding], random: np.random.Generator, length: float, width: float, needs_street: bool
) -> Town:
    """A block of ``length`` x ``width`` metres of the model, furnished; `InputError` where no block fits."""
    origin, yaw = _find_block(buildings, random, length, width, 4.6 if needs_street else 0.0)
    terrain = TownTerrain(
        length,
        width / 2,
        (random.uniform(-0.02, 0.02), random.uniform(-0.02, 0.02)),
        (random.uniform(0.1, 0.5), random.uniform(0.03, 0.12)),
        (random.uniform(0, 2 * np.pi), random.uniform(0, 2 * np.pi)),
    )
    town = Town(terrain)
    near = shapely.box(-40, -width / 2 - 40, length + 40, width / 2 + 40)
    footprints = []
    for b in buildings:
        outline = _into(b.footprint, origin, yaw)
        if outline.intersects(near):
            town.houses.append(_house(b, outline, origin, yaw))
            footprints.append(outline)
    town.taken = shapely.union_all(footprints)
    block = shapely.box(0, -width / 2, length, width / 2)
    _park(town, block, random)
    _plant(town, block, random)
    _fence(town, block, random)
    _leave_yards(town, block, random)
    return town


def _find_block(
    buildings: list[ModelBuilding], random: np.random.Generator, length: float, width: float, clearance_m: float
) -> tuple[FloatArray, float]:
    """Start of the street (2,) m in the model's frame and its direction, rad: the clearest of the strips tried."""
    tree = shapely.STRtree([b.footprint for b in buildings])
    middles = np.array([b.footprint.centroid.coords[0] for b in buildings])
    best: tuple[float, FloatArray, float] | None = None
    for _ in range(_TRIES):
        angle = random.uniform(0, np.pi)
        along = np.array([np.cos(angle), np.sin(angle)])
        start = middles[random.integers(len(middles))] + random.uniform(-15, 15, 2) - along * length / 2
        line = shapely.LineString([start - 8 * along, start + (length + 8) * along])
        block = shapely.LineString([start, start + length * along]).buffer(width / 2, cap_style="flat")
        inside = tree.query(block, predicate="intersects")
        cover = sum(buildings[i].footprint.intersection(block).area for i in inside) / block.area
        if not _LEAST_COVER < cover < _MOST_COVER or len(inside) < 6:
            continue
        gap = min((buildings[i].footprint.distance(line) for i in tree.query(line.buffer(8.0))), default=8.0)
        if gap >= clearance_m:
            return start, angle
        if best is None or gap > best[0]:
            best = gap, start, angle
    raise InputError(
        f"The city model has no open strip of {length:.0f} m along which to drive"
        + (f" (the widest found has {2 * best[0]:.1f} m)." if best else "."),
        "Choose a shorter block or another seed.",
        "city-model",
    )


def _into(geometry: Any, origin: FloatArray, yaw: float) -> Any:
    """A geometry of the model in the frame of the block."""
    c, s = np.cos(yaw), np.sin(yaw)
    return shapely.transform(geometry, lambda xy: (xy - origin) @ np.array([[c, -s], [s, c]]))


def _house(building: ModelBuilding, outline: Any, origin: FloatArray, yaw: float) -> Placed:
    c, s = np.cos(yaw), np.sin(yaw)
    corners = building.triangles.copy()
    corners[:, :, :2] = (corners[:, :, :2] - origin) @ np.array([[c, -s], [s, c]])
    middle = outline.centroid
    corners -= (middle.x, middle.y, building.foot_m)
    own = shapely.transform(outline, lambda xy: xy - (middle.x, middle.y))
    house = ModelHouse(building.name, corners, own)
    closed = np.concatenate([corners, party_walls(house)])
    return Placed(replace(house, triangles=closed), middle.x, middle.y)


def party_walls(house: ModelHouse) -> FloatArray:
    """Walls (t, 3, 3) where a model leaves them out because a neighbour stands there, m about the house's origin: along
    every piece of its outline that has none, up to its roof."""
    a, b = house.triangles[:, [0, 1, 2], :2], house.triangles[:, [1, 2, 0], :2]
    edges = np.cross(house.triangles[:, 1] - house.triangles[:, 0], house.triangles[:, 2] - house.triangles[:, 0])
    is_wall = np.abs(edges[:, 2]) < 0.1 * np.linalg.norm(edges, axis=1)
    known = shapely.union_all(shapely.linestrings(np.stack([a[is_wall], b[is_wall]], axis=2).reshape(-1, 2, 2)))
    pieces = house.footprint.boundary.difference(known.buffer(_WALL_GAP_M))
    inside = house.footprint.buffer(-_WALL_GAP_M)
    quads = []
    for piece in getattr(pieces, "geoms", [pieces]):
        for start, end in pairwise(shapely.segmentize(piece, 1.0).coords):
            near = shapely.ops.nearest_points(inside, shapely.LineString([start, end]).centroid)[0]
            top = house.roof_at(near.x, near.y)
            if top > _WALL_TOP_M:
                (x0, y0), (x1, y1) = start, end
                quads.append([(x0, y0, 0.0), (x1, y1, 0.0), (x1, y1, top), (x0, y0, top)])
    corners = np.array(quads, dtype=float).reshape(-1, 4, 3)
    return np.stack([corners[:, (0, 1, 2)], corners[:, (0, 2, 3)]], axis=1).reshape(-1, 3, 3)


def _is_free(town: Town, place: Any, gap_m: float) -> bool:
    return bool(town.taken.distance(place) >= gap_m)


def _take(town: Town, place: Any) -> None:
    town.taken = shapely.union_all([town.taken, place])


def _rectangle(x: float, y: float, yaw: float, length: float, width: float) -> Any:
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (length / 2, width / 2)
    c, s = np.cos(yaw), np.sin(yaw)
    return shapely.Polygon(half @ np.array([[c, s], [-s, c]]) + (x, y))


def _somewhere(block: Any, random: np.random.Generator) -> tuple[float, float]:
    x0, y0, x1, y1 = block.bounds
    return float(random.uniform(x0, x1)), float(random.uniform(y0, y1))


def _park(town: Town, block: Any, random: np.random.Generator) -> None:
    """Vehicles along both kerbs and some in yards; some places stay free."""
    places = [
        (x + random.normal(0, 0.2), side * (3.9 + random.normal(0, 0.1)), random.normal(0, 0.03) + (side > 0) * np.pi)
        for side in (-1.0, 1.0)
        for x in np.arange(4.0, town.terrain.length - 4.0, 6.0)
    ]
    for _ in range(40):
        x, y = _somewhere(block, random)
        places.append((x, y, random.choice([0.0, np.pi / 2]) + random.normal(0, 0.1)))
    for x, y, yaw in places:
        ground = _rectangle(x, y, yaw, 5.6, 2.4)
        if (abs(y) > 5.2 or abs(y) > 3.0) and _is_free(town, ground, 0.25) and (abs(y) < 5.2 or random.random() < 0.3):
            placed = Placed(draw_car(random), float(x), float(y), float(yaw))
            (town.cars if random.random() < 0.6 else town.slots).append(placed)
            _take(town, ground)


def _plant(town: Town, block: Any, random: np.random.Generator) -> None:
    """Trees, some close enough to walls to hang over roofs, and hedges and bushes."""
    trunks: list[tuple[float, float]] = []
    for _ in range(int(block.area / 60)):
        x, y = _somewhere(block, random)
        tree = replace(draw_tree(random), height=random.uniform(4.5, 13.0))
        tree = replace(tree, crown_radius=tree.height * random.uniform(0.18, 0.32), crown_base=0.3 * tree.height)
        is_apart = all(np.hypot(x - a, y - b) > 3.5 for a, b in trunks)
        if abs(y) > 3.2 and is_apart and _is_free(town, shapely.Point(x, y), random.uniform(0.8, 3.5)):
            placed = Placed(tree, x, y, random.uniform(0, 2 * np.pi))
            (town.trees if random.random() < 0.8 else town.pits).append(placed)
            trunks.append((x, y))
            _take(town, shapely.Point(x, y).buffer(0.5))
    for _ in range(int(block.area / 300)):
        x, y = _somewhere(block, random)
        yaw, length = random.uniform(0, np.pi), random.uniform(2.0, 9.0)
        if abs(y) > 5.5 and _is_free(town, ground := _rectangle(x, y, yaw, length + 0.3, 0.9), 0.1):
            hedge: Hedge | Bush = Hedge(length, random.uniform(0.5, 0.9), random.uniform(0.8, 2.0))
            if random.random() < 0.4:
                hedge = Bush(random.uniform(0.4, 0.8), random.uniform(0.8, 1.8))
            town.hedges.append(Placed(hedge, x, y, yaw))
            _take(town, ground)


def _fence(town: Town, block: Any, random: np.random.Generator) -> None:
    """Fences, lamp posts and sheds, sheds also right against walls."""
    for _ in range(int(block.area / 400)):
        x, y = _somewhere(block, random)
        yaw, length = random.uniform(0, np.pi), random.uniform(3.0, 10.0)
        if abs(y) > 5.5 and _is_free(town, ground := _rectangle(x, y, yaw, length, 0.3), 0.1):
            town.others.append(Placed(Fence(length, random.uniform(0.8, 1.8), 0.0), x, y, yaw))
            _take(town, ground)
    for x in np.arange(9.0, town.terrain.length, 28.0):
        if _is_free(town, shapely.Point(x, 5.4), 0.3):
            town.others.append(Placed(LampPost(random.uniform(5.2, 7.5)), float(x), 5.4))
    for _ in range(60):
        x, y = _somewhere(block, random)
        yaw = random.uniform(0, np.pi)
        shed = Shed(random.uniform(2.0, 4.0), random.uniform(2.0, 4.0), random.uniform(2.1, 2.8))
        ground = _rectangle(x, y, yaw, shed.width + 0.4, shed.depth + 0.4)
        is_near_wall = town.taken.distance(shapely.Point(x, y)) < 6.0
        if abs(y) > 7.5 and is_near_wall and _is_free(town, ground.buffer(0.4), 0.05):
            (town.sheds if random.random() < 0.7 else town.shed_places).append(Placed(shed, x, y, yaw))
            _take(town, ground.buffer(0.4))
        if len(town.sheds) >= block.area / 1500:
            break


def _leave_yards(town: Town, block: Any, random: np.random.Generator) -> None:
    """Pieces of open ground that can be filled or dug."""
    for _ in range(60):
        x, y = _somewhere(block, random)
        a, b = random.uniform(2.0, 5.0, 2)
        if abs(y) - b > 5.2 and _is_free(town, shapely.box(x - a, y - b, x + a, y + b), 0.3):
            town.yards.append(GroundPatch(x - a, x + a, y - b, y + b, 0.0))
            _take(town, shapely.box(x - a, y - b, x + a, y + b))
        if len(town.yards) >= 4:
            break


def draw_town_edits(
    town: Town, random: np.random.Generator, has_edits: bool = True
) -> tuple[list[Item], list[GroundItem]]:
    """All instances of a block over both surveys, edited ones first; the town's lists are used up."""
    ledger = Ledger(town, random)
    if has_edits:
        for edit, least, most in _EDITS:
            for _ in range(int(random.integers(least, most + 1))):
                edit(ledger)
    for stock in (town.houses, town.trees, town.hedges, town.cars, town.sheds, town.others):
        for placed in stock:
            ledger.add(placed, placed, UNCHANGED)
    return ledger.items, ledger.grounds


def _is_inside(town: Town, margin_m: float = 3.0) -> Callable[[Placed], bool]:
    t = town.terrain
    return lambda p: margin_m < p.x < t.length - margin_m and abs(p.y) < t.half_width - margin_m


def _house_of(ledger: Ledger, is_fit: Callable[[ModelHouse], bool]) -> Any:
    """A building in the block that fits, as `Placed`; None where there is none."""
    is_inside = _is_inside(ledger.street)
    return ledger.take(ledger.street.houses, lambda p: is_inside(p) and is_fit(p.thing))


def _small(house: ModelHouse) -> bool:
    return bool(house.footprint.area < 250)


def _add_house(ledger: Ledger) -> None:
    if placed := _house_of(ledger, _small):
        ledger.add(None, placed, ADDED, "building added")


def _remove_house(ledger: Ledger) -> None:
    if placed := _house_of(ledger, _small):
        ledger.add(placed, None, REMOVED, "building removed")


def _raise_house(ledger: Ledger) -> None:
    if placed := _house_of(ledger, lambda h: h.height_m < 20):
        lift = ledger.random.uniform(1.2, 3.3)
        after = replace(placed, thing=replace(placed.thing, lift_m=lift))
        ledger.add(placed, after, INCREASED, "storey added", f"{lift:.1f} m higher")


def _lower_house(ledger: Ledger) -> None:
    if placed := _house_of(ledger, lambda h: h.eaves_m > 5.0):
        lift = ledger.random.uniform(1.2, min(3.3, placed.thing.eaves_m - 2.2))
        after = replace(placed, thing=replace(placed.thing, lift_m=-lift))
        ledger.add(placed, after, DECREASED, "storey taken", f"{lift:.1f} m lower")


def _with_annex(ledger: Ledger) -> tuple[Placed, Placed, str] | None:
    """A building without and with an annex against one of its walls, where there is room for one."""
    random = ledger.random
    for _ in range(12):
        placed = _house_of(ledger, lambda h: h.footprint.area > 25 and h.height_m > 2.8)
        if placed is None:
            return None
        whole = placed.thing.footprint
        outer = max(getattr(whole, "geoms", [whole]), key=lambda g: g.area).exterior
        ring = np.array(shapely.normalize(shapely.Polygon(outer)).exterior.coords)[::-1]  # anticlockwise
        edges = np.diff(ring, axis=0)
        for i in random.permutation(len(edges)):
            span = float(np.hypot(*edges[i]))
            if span < 2.6:
                continue
            width, depth = random.uniform(2.0, min(6.0, span - 0.4)), random.uniform(1.2, 4.0)
            height = random.uniform(2.3, min(3.2, placed.thing.height_m))
            left = random.uniform(0.1, span - width - 0.1)
            yaw = float(np.arctan2(edges[i][1], edges[i][0]))
            along, out = edges[i] / span, np.array([edges[i][1], -edges[i][0]]) / span
            base = ring[i] + left * along
            ground = shapely.Polygon(
                [base + 0.15 * out, base + width * along + 0.15 * out, base + width * along + depth * out,
                 base + depth * out]
            )  # fmt: skip
            ground = shapely.transform(ground, lambda xy, at=(placed.x, placed.y): xy + at)
            t = ledger.street.terrain
            block = shapely.box(0, -t.half_width, t.length, t.half_width)
            if not _is_free(ledger.street, ground, 0.1) or not block.contains(ground) or _crosses_road(ground):
                continue
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            x, y = base @ turn
            low, high = (x, y - depth, -FOUNDATION_M), (x + width, y, height)
            after = replace(placed, thing=replace(placed.thing, boxes=((low, high, yaw),)))
            _take(ledger.street, ground)
            return placed, after, f"annex of {width:.1f} x {depth:.1f} x {height:.1f} m"
        ledger.add(placed, placed, UNCHANGED)
    return None


def _crosses_road(ground: Any) -> bool:
    return bool(ground.bounds[1] < 3.2 and ground.bounds[3] > -3.2)


def _extend_house(ledger: Ledger) -> None:
    if found := _with_annex(ledger):
        ledger.add(found[0], found[1], INCREASED, "building extended", found[2])


def _cut_house(ledger: Ledger) -> None:
    if found := _with_annex(ledger):
        ledger.add(found[1], found[0], DECREASED, "annex demolished", found[2] + " taken down")


def _add_roof_structure(ledger: Ledger) -> None:
    """A dormer, lift shaft or plant room on a roof: the smallest edit of a building."""
    placed = _house_of(ledger, lambda h: h.footprint.area > 40)
    if placed is None:
        return
    at = placed.thing.footprint.representative_point()
    size, height = ledger.random.uniform(1.6, 3.2, 2), ledger.random.uniform(1.2, 2.6)
    roof = placed.thing.roof_at(at.x, at.y)
    low = (at.x - size[0] / 2, at.y - size[1] / 2, roof - 1.0)
    high = (at.x + size[0] / 2, at.y + size[1] / 2, roof + height)
    after = replace(placed, thing=replace(placed.thing, boxes=((low, high, 0.0),)))
    note = f"roof structure of {size[0]:.1f} x {size[1]:.1f} x {height:.1f} m"
    ledger.add(placed, after, INCREASED, "roof structure added", note)


def _add(stock: str, name: str) -> Callable[[Ledger], None]:
    def edit(ledger: Ledger) -> None:
        if placed := ledger.take(getattr(ledger.street, stock), _is_inside(ledger.street, 1.5)):
            ledger.add(None, placed, ADDED, f"{name} added")

    return edit


def _remove(stock: str, name: str) -> Callable[[Ledger], None]:
    def edit(ledger: Ledger) -> None:
        if placed := ledger.take(getattr(ledger.street, stock), _is_inside(ledger.street, 1.5)):
            ledger.add(placed, None, REMOVED, f"{name} removed")

    return edit


def _move_car(ledger: Ledger) -> None:
    slot, placed = ledger.take(ledger.street.slots), ledger.take(ledger.street.cars)
    if slot is not None and placed is not None:
        ledger.add_pair(placed, replace(slot, thing=placed.thing), "vehicle moved", "parked elsewhere")


def _scale_tree(low: float, high: float) -> Callable[[Ledger], None]:
    def edit(ledger: Ledger) -> None:
        inside = _is_inside(ledger.street, 2.0)
        placed = ledger.take(ledger.street.trees, lambda p: isinstance(p.thing, Tree) and inside(p))
        if placed is not None:
            tree, factor = placed.thing, ledger.random.uniform(low, high)
            height = tree.crown_base + (tree.height - tree.crown_base) * factor
            after = replace(tree, height=height, crown_radius=tree.crown_radius * factor)
            label, name = (INCREASED, "tree grown") if factor > 1 else (DECREASED, "tree pruned")
            note = f"crown to {factor:.2f} of its size, {tree.height:.1f} to {height:.1f} m high"
            ledger.add(placed, replace(placed, thing=after), label, name, note)

    return edit


def _cut_hedge(ledger: Ledger) -> None:
    inside = _is_inside(ledger.street, 2.0)
    placed = ledger.take(
        ledger.street.hedges, lambda p: isinstance(p.thing, Hedge) and p.thing.height > 1.2 and inside(p)
    )
    if placed is not None:
        height = placed.thing.height * ledger.random.uniform(0.4, 0.65)
        note = f"{placed.thing.height:.1f} to {height:.1f} m high"
        ledger.add(placed, replace(placed, thing=replace(placed.thing, height=height)), DECREASED, "hedge cut", note)


def _change_ground(ledger: Ledger) -> None:
    patch = ledger.take(ledger.street.yards)
    if patch is not None:
        dz = float(ledger.random.uniform(0.15, 0.9) * ledger.random.choice([-1.0, 1.0]))
        label, verb = (INCREASED, "filled") if dz > 0 else (DECREASED, "dug")
        note = f"yard {verb} by {abs(dz):.2f} m over {patch.area_m2:.0f} m2"
        ledger.grounds.append(GroundItem(ledger.new_id(), replace(patch, dz=dz), label, f"ground {verb}", note))


_EDITS: tuple[tuple[Callable[[Ledger], None], int, int], ...] = (
    (_add_house, 1, 2),
    (_remove_house, 1, 2),
    (_raise_house, 1, 2),
    (_lower_house, 1, 1),
    (_extend_house, 1, 3),
    (_cut_house, 1, 2),
    (_add_roof_structure, 0, 1),
    (_add("shed_places", "shed"), 0, 1),
    (_remove("sheds", "shed"), 0, 1),
    (_add("pits", "tree"), 1, 3),
    (_remove("trees", "tree"), 1, 3),
    (_scale_tree(1.15, 1.5), 1, 3),
    (_scale_tree(0.5, 0.8), 1, 2),
    (_cut_hedge, 0, 1),
    (_add("slots", "vehicle"), 1, 3),
    (_remove("cars", "vehicle"), 1, 3),
    (_move_car, 0, 1),
    (replace_vehicle, 1, 1),
    (_change_ground, 1, 2),
)
"""Each kind of edit with the fewest and the most of it per block."""
