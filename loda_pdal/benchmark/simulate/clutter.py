"""What a tidy street lacks: more things that stand close to others, and edits that are hard to tell from no edit.

Works on any block whose street runs along x with its middle on y = 0. Things are put where there is room at both
surveys, some of it right against a wall or under a crown. As in `edits`, a label follows from the kind of edit alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import shapely

from loda_pdal.benchmark.simulate.edits import ADDED, DECREASED, INCREASED, REMOVED, UNCHANGED, GroundItem, Item
from loda_pdal.benchmark.simulate.furniture import Bike, Bollard, BusShelter, CafeTable, Scaffold, Skip, Stall
from loda_pdal.benchmark.simulate.objects import (
    CAR_STYLES,
    Car,
    Dormer,
    Fence,
    GardenWall,
    Hedge,
    House,
    Shed,
    Thing,
    Tree,
)
from loda_pdal.benchmark.simulate.options import SimulationOptions
from loda_pdal.benchmark.simulate.scene import Ground, Placed, draw_car, draw_tree
from loda_pdal.model.labels import ObjectClass

_REACH_M = 2.2
"""What a thing has below this height takes up ground."""

_ROAD_Y_M = 2.95
"""Nothing is put nearer to the middle of the street."""

_TRIES = 40


def add_clutter(
    items: list[Item],
    grounds: list[GroundItem],
    ground: Ground,
    random: np.random.Generator,
    options: SimulationOptions,
) -> list[Item]:
    """The instances of a block with what clutters it.

    Parameters
    ----------
    items, grounds
        All instances of the tidy block. Those that were not edited may be edited here; none gets another number.
    ground : Ground
    random : numpy.random.Generator
    options : SimulationOptions
        Its ``reality.clutter`` says how much; without edits only things that stay are added.

    Returns
    -------
    list of Item
        Those of ``items`` in their order, then new ones.
    """
    amount = options.reality.clutter * options.length_m / 100.0
    if not amount:
        return items
    site = _Site(items, grounds, ground, random, options)
    for fill, least, most in _FILLS:
        for _ in range(_drawn(random, amount, least, most)):
            fill(site)
    for edit, least, most in _EDITS:
        n = _drawn(random, amount, least, most)
        for _ in range(n if options.has_edits else 0):
            edit(site)
    return site.items


def _drawn(random: np.random.Generator, amount: float, least: int, most: int) -> int:
    return round(int(random.integers(least, most + 1)) * amount)


class _Site:
    """The block while it fills up: its instances, and the ground that they take up at either survey."""

    def __init__(
        self,
        items: list[Item],
        grounds: list[GroundItem],
        ground: Ground,
        random: np.random.Generator,
        options: SimulationOptions,
    ) -> None:
        self.items, self.ground, self.random = list(items), ground, random
        self.half_width, self.length = options.width_m / 2, options.length_m
        self.has_edits = options.has_edits
        taken = [footprint(placed) for item in items for placed in _states(item)]
        taken += [shapely.box(g.patch.x0, g.patch.y0, g.patch.x1, g.patch.y1) for g in grounds]
        self._taken, self._tree = taken, shapely.STRtree(taken)
        self._new: list[Any] = []
        self._next_id = max([i.instance_id for i in items] + [g.instance_id for g in grounds], default=0) + 1

    def is_free(self, place: Any, gap_m: float = 0.15) -> bool:
        """Whether nothing stands on a place or nearer to it than that, and it lies in the block beside the road."""
        x0, y0, x1, y1 = place.bounds
        is_inside = x0 > 0.5 and x1 < self.length - 0.5 and max(abs(y0), abs(y1)) < self.half_width - 0.5
        is_beside = y0 > _ROAD_Y_M or y1 < -_ROAD_Y_M
        if not (is_inside and is_beside) or len(self._tree.query(place, predicate="dwithin", distance=gap_m)):
            return False
        return all(other.distance(place) > gap_m for other in self._new)

    def put(self, placed: Placed, temporary_share: float, gap_m: float = 0.15, name: str = "") -> bool:
        """Put something where there is room for it: for good, or with that chance at one of the surveys only."""
        place = footprint(placed)
        if not self.is_free(place, gap_m):
            return False
        is_temporary, is_new = self.random.random(2) < (temporary_share, 0.5)
        if is_temporary and not self.has_edits:
            return True
        name = name or placed.thing.kind
        if not is_temporary:
            self._add(placed, placed, UNCHANGED)
        elif is_new:
            self._add(None, placed, ADDED, f"{name} added")
        else:
            self._add(placed, None, REMOVED, f"{name} removed")
        self._new.append(place)
        return True

    def _add(self, before: Placed | None, after: Placed | None, *rest: Any) -> None:
        self.items.append(Item(self._next_id, before, after, *rest))
        self._next_id += 1

    def replace_pair(self, item: Item, after: Placed, edit: str, note: str) -> None:
        """One thing makes way for another in its place."""
        i = self.items.index(item)
        self.items[i] = replace(item, after=None, label=REMOVED, edit=edit, note=note, partner=self._next_id)
        self._add(None, after, ADDED, edit, note, item.instance_id)

    def change(self, item: Item, after: Placed | None, edit: Any, note: str = "") -> None:
        """Edit what was not edited before; ``edit`` is its label and name."""
        label, name = edit
        i = self.items.index(item)
        self.items[i] = replace(item, after=after, label=label, edit=name, note=note)

    def reverse(self, item: Item, before: Placed, edit: Any, note: str = "") -> None:
        """The same, where what the street has now is the later state."""
        label, name = edit
        i = self.items.index(item)
        self.items[i] = replace(item, before=before, label=label, edit=name, note=note)

    def pick(self, kind: type, is_fit: Callable[[Any], bool] = lambda _: True) -> Item | None:
        """An instance of that kind in the block that nobody edited; None where there is none that fits."""
        fit = [
            item
            for item in self.items
            if not item.edit
            and isinstance(item.placed.thing, kind)
            and 2.0 < item.placed.x < self.length - 2.0
            and abs(item.placed.y) < self.half_width - 2.0
            and is_fit(item.placed.thing)
        ]
        return fit[int(self.random.integers(len(fit)))] if fit else None

    def beside(self, low: float, high: float) -> tuple[float, float, float]:
        """A place beside the road whose distance from its middle lies between two, and the yaw of what faces it."""
        side = float(self.random.choice([-1.0, 1.0]))
        x, y = self.random.uniform(3.0, self.length - 3.0), side * self.random.uniform(low, high)
        return float(x), float(y), 0.0 if side > 0 else float(np.pi)


def _states(item: Item) -> list[Placed]:
    """The different places of an instance over both surveys."""
    states = [placed for placed in (item.before, item.after) if placed is not None]
    return states[:1] if len(states) == 2 and states[0] == states[1] else states


def footprint(placed: Placed) -> Any:
    """Ground that a thing takes up, as a shapely geometry: the hull of what it has below `_REACH_M`."""
    thing = placed.thing
    if isinstance(thing, Tree):
        return shapely.Point(placed.x, placed.y).buffer(0.4)
    if hasattr(thing, "footprint"):
        outline = shapely.transform(thing.footprint, lambda xy: xy + np.array([placed.x, placed.y]))
        return shapely.union_all([outline, *_boxes(placed)])
    shape = thing.surface(np.random.default_rng(0)).placed(placed.x, placed.y, 0.0, placed.yaw)
    corners = np.concatenate([shape.triangles.reshape(-1, 3), shape.discs[:, :3]])
    return shapely.MultiPoint(corners[corners[:, 2] < _REACH_M, :2]).convex_hull


def _boxes(placed: Placed) -> list[Any]:
    """What the annexes of a building of a city model cover."""
    hulls = []
    for low, high, yaw in placed.thing.boxes:  # type: ignore[attr-defined]
        c, s = np.cos(yaw), np.sin(yaw)
        corners = np.array([(a, b) for a in (low[0], high[0]) for b in (low[1], high[1])])
        hulls.append(shapely.MultiPoint(corners @ np.array([[c, s], [-s, c]]) + (placed.x, placed.y)).convex_hull)
    return hulls


def _fill(
    thing_of: Callable[[np.random.Generator], Thing], low: float, high: float, share: float, turn: float = 0.05
) -> Callable[[_Site], None]:
    """Puts one thing beside the road, at a distance between two from its middle."""

    def fill(site: _Site) -> None:
        thing = thing_of(site.random)
        for _ in range(_TRIES):
            x, y, yaw = site.beside(low, high)
            if site.put(Placed(thing, x, y, yaw + site.random.normal(0.0, turn)), share):
                return

    return fill


def _row(
    thing_of: Callable[[np.random.Generator], Thing],
    n: tuple[int, int],
    step: float,
    low: float,
    high: float,
    share: float,
    turn: float,
    spread: float = 0.0,
) -> Callable[[_Site], None]:
    """Puts a row of things along the road, each of which may be there at one of the surveys only."""

    def fill(site: _Site) -> None:
        random = site.random
        x, y, yaw = site.beside(low, high)
        for i in range(int(random.integers(n[0], n[1] + 1))):
            at = (x + i * step + spread * random.normal(), y + spread * random.normal())
            site.put(Placed(thing_of(random), at[0], at[1], yaw + turn + random.normal(0.0, 0.1)), share, 0.05)

    return fill


def _against_wall(site: _Site, depth: float, width: tuple[float, float], faces_road: bool) -> tuple[Any, ...] | None:
    """A stretch of wall with free ground before it: the building, its middle (x, y), the yaw of what stands there with
    its back to the wall, and its width."""
    random = site.random
    for _ in range(_TRIES):
        item = site.pick(object, lambda thing: thing.object_class is ObjectClass.BUILDING and _is_tall(thing))
        if item is None:
            return None
        outline = footprint(item.placed)
        outer = max(getattr(outline, "geoms", [outline]), key=lambda g: g.area)
        ring = np.array(shapely.normalize(outer).exterior.coords)[::-1]  # anticlockwise
        edges = np.diff(ring, axis=0)
        spans = np.hypot(*edges.T)
        i = int(random.integers(len(edges)))
        out = np.array([edges[i][1], -edges[i][0]]) / max(spans[i], 1e-9)
        towards_road = -np.sign(ring[i][1]) * out[1]
        if spans[i] < width[0] + 0.2 or towards_road < (0.8 if faces_road else -0.3):
            continue
        wide = min(width[1], spans[i] - 0.1) if faces_road else random.uniform(width[0], min(width[1], spans[i] - 0.1))
        left = random.uniform(0.0, spans[i] - wide)
        middle = ring[i] + edges[i] / spans[i] * (left + wide / 2)
        far = middle + depth * out
        strip = shapely.LineString([middle + 0.15 * out, far]).buffer(wide / 2, cap_style="flat")
        if site.is_free(strip, 0.02):
            return item, middle, float(np.arctan2(out[0], -out[1])), wide, out
    return None


def _is_tall(thing: Any) -> bool:
    return bool(getattr(thing, "eaves_m", 0.0) > 2.6)


def _lean_shed(site: _Site) -> None:
    """A shed with its back right against a wall."""
    depth = site.random.uniform(1.6, 2.6)
    found = _against_wall(site, depth + 0.4, (2.0, 3.2), faces_road=False)
    if found is not None:
        _, middle, yaw, wide, out = found
        shed = Shed(wide, depth, site.random.uniform(2.1, 2.4))
        # a shed stands on its front and is built towards +y: towards the wall
        x, y = (middle + (depth + 0.22) * out).tolist()
        site.put(Placed(shed, x, y, yaw), 0.7, 0.02, "shed against a wall")


def _scaffold(site: _Site) -> None:
    """Scaffolding before a facade, at one of the surveys."""
    depth = site.random.uniform(1.0, 1.5)
    found = _against_wall(site, depth + 0.3, (4.0, 9.0), faces_road=True)
    if found is not None:
        item, middle, yaw, wide, _ = found
        thing: Any = item.placed.thing
        height = min(thing.eaves_m, 12.0)
        site.put(Placed(Scaffold(wide - 0.2, height, depth), float(middle[0]), float(middle[1]), yaw), 1.0, 0.02)


def _overhanging_tree(site: _Site) -> None:
    """A tree so near to a wall that its crown lies over the roof."""
    found = _against_wall(site, 1.6, (1.2, 3.0), faces_road=False)
    if found is not None:
        _, middle, _, _, out = found
        tree = replace(draw_tree(site.random), height=site.random.uniform(7.0, 11.0))
        tree = replace(tree, crown_radius=0.3 * tree.height, crown_base=0.35 * tree.height)
        x, y = (middle + site.random.uniform(0.9, 1.4) * out).tolist()
        site.put(Placed(tree, x, y, float(site.random.uniform(0, 2 * np.pi))), 0.5, 0.2, "tree over a roof")


def _remove_from_row(site: _Site) -> None:
    """One house of a terrace is taken down; its neighbours stay."""
    item = site.pick(House, lambda house: house.bays == 2)
    if item is not None:
        site.change(item, None, (REMOVED, "house of a row removed"))


def _change_dormer(site: _Site) -> None:
    item = site.pick(House, lambda house: house.roof == "gable" and not house.dormers and house.storeys <= 3)
    if item is not None:
        random, placed = site.random, item.placed
        house: Any = placed.thing
        width = random.uniform(1.4, min(2.6, house.width - 1.6))
        reach = house.width / 2 - width / 2 - 0.4
        dormer = Dormer(random.uniform(-reach, reach), width, random.uniform(1.1, 1.5))
        other = replace(placed, thing=replace(house, dormers=(dormer,)))
        note = f"dormer of {width:.1f} x {dormer.height:.1f} m"
        if random.random() < 0.6:
            site.change(item, other, (INCREASED, "dormer added"), note)
        else:
            site.reverse(item, other, (DECREASED, "dormer removed"), note)


def _other_vehicle(site: _Site) -> None:
    """A vehicle in the slot of another, of any other build that fits."""
    item = site.pick(Car)
    if item is not None:
        placed, random = item.placed, site.random
        style = placed.thing.kind
        longest = CAR_STYLES[style].length + 0.9
        styles = tuple(s for s, build in CAR_STYLES.items() if s != style and build.length <= longest)
        after = replace(placed, thing=draw_car(random, styles), x=placed.x + random.normal(0, 0.15))
        site.replace_pair(item, after, "vehicle replaced", f"{style} by {after.thing.kind} in the same slot")


def _halve_hedge(site: _Site) -> None:
    """One end of a hedge is taken out."""
    item = site.pick(Hedge, lambda hedge: hedge.length > 1.6)
    if item is not None:
        placed = item.placed
        hedge: Any = placed.thing
        left = hedge.length * site.random.uniform(0.4, 0.65)
        aside = site.random.choice([-1.0, 1.0]) * (hedge.length - left) / 2
        after = replace(
            placed,
            thing=replace(hedge, length=left),
            x=placed.x + aside * np.cos(placed.yaw),
            y=placed.y + aside * np.sin(placed.yaw),
        )
        note = f"{hedge.length:.1f} to {left:.1f} m long"
        site.change(item, after, (DECREASED, "part of hedge removed"), note)


def _other_boundary(site: _Site) -> None:
    """A fence makes way for a wall, or a wall for a fence."""
    item = site.pick(object, lambda thing: isinstance(thing, (Fence, GardenWall)))
    if item is not None:
        thing: Any = item.placed.thing
        other = GardenWall if isinstance(thing, Fence) else Fence
        new = other(thing.length, site.random.uniform(0.6, 1.3), thing.grade)
        after = replace(item.placed, thing=new)
        note = f"{thing.kind} of {thing.height:.1f} m by {new.kind} of {new.height:.1f} m"
        site.replace_pair(item, after, "boundary replaced", note)


def _lorry(random: np.random.Generator) -> Thing:
    return Car(str(random.choice(["lorry", "caravan", "van"])), bool(random.random() < 0.2))


_FILLS: tuple[tuple[Callable[[_Site], None], int, int], ...] = (
    (_fill(lambda r: BusShelter(r.uniform(3.0, 4.5)), 6.1, 6.4, 0.3, 0.02), 1, 1),
    (_fill(lambda r: Skip(r.uniform(2.6, 3.8), fill=r.uniform(0.2, 0.95)), 3.9, 8.5, 0.8, 0.15), 1, 2),
    (_fill(_lorry, 3.85, 4.0, 0.7, 0.02), 1, 2),
    (_fill(lambda r: Stall(r.uniform(2.2, 3.6), 2.0, bool(r.random() < 0.7)), 5.2, 8.5, 0.8), 0, 2),
    (
        _row(lambda r: CafeTable(int(r.integers(2, 5)), bool(r.random() < 0.3)), (3, 6), 1.9, 5.8, 8.4, 0.5, 0.4, 0.12),
        1,
        1,
    ),
    (_row(lambda r: Bike(), (2, 6), 0.65, 5.6, 7.5, 0.6, np.pi / 2, 0.05), 1, 2),
    (_row(lambda r: Bollard(), (3, 7), 1.6, 5.15, 5.25, 0.15, 0.0), 1, 2),
    (_lean_shed, 1, 2),
    (_overhanging_tree, 1, 2),
    (_scaffold, 0, 1),
)
"""Each kind of thing with the fewest and the most of it per 100 m of street."""

_EDITS: tuple[tuple[Callable[[_Site], None], int, int], ...] = (
    (_remove_from_row, 0, 1),
    (_change_dormer, 0, 2),
    (_other_vehicle, 1, 2),
    (_halve_hedge, 0, 2),
    (_other_boundary, 0, 2),
)
"""Each kind of edit of what stands there with the fewest and the most of it per 100 m of street."""
