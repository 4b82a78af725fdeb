"""What changes between the two surveys: the edit list, which is the truth.

Edits are drawn by kind and never by how large their effect is; a label follows from the kind of edit alone. A street
state is the common stock of both surveys; each edit says what of it stands in which.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loda_pdal.benchmark.simulate.objects import Hedge, House, Sign, Tree
from loda_pdal.benchmark.simulate.scene import (
    FACADE_Y_M,
    ROAD_HALF_M,
    GroundPatch,
    Placed,
    Street,
    draw_car,
    draw_house,
    draw_tree,
    front_annex,
    in_slot,
    side_annex,
)
from loda_pdal.model.labels import ChangeLabel, ObjectClass

UNCHANGED, ADDED, REMOVED = ChangeLabel.UNCHANGED, ChangeLabel.ADDED, ChangeLabel.REMOVED
INCREASED, DECREASED = ChangeLabel.INCREASED, ChangeLabel.DECREASED


@dataclass(frozen=True)
class Item:
    """One annotated instance: what stands there at each survey, and what was done to it.

    ``edit`` is the kind of edit (empty where there was none), ``note`` its figures in words, and ``partner`` the
    instance that the same edit removed or added elsewhere (a moved vehicle).
    """

    instance_id: int
    before: Placed | None
    after: Placed | None
    label: ChangeLabel
    edit: str = ""
    note: str = ""
    partner: int | None = None

    @property
    def placed(self) -> Placed:
        """The thing at the survey that shows it; the later one where both do."""
        placed = self.after or self.before
        assert placed is not None
        return placed

    @property
    def object_class(self) -> ObjectClass:
        return self.placed.thing.object_class


@dataclass(frozen=True)
class GroundItem:
    """A patch of ground that was filled or dug between the surveys."""

    instance_id: int
    patch: GroundPatch
    label: ChangeLabel
    edit: str
    note: str


@dataclass(frozen=True)
class EditCounts:
    """How many edits of each kind are drawn, per 100 m of street, as (fewest, most)."""

    building_added: tuple[int, int] = (1, 1)
    building_removed: tuple[int, int] = (1, 1)
    building_extended: tuple[int, int] = (1, 2)
    annex_demolished: tuple[int, int] = (0, 1)
    storey_added: tuple[int, int] = (1, 1)
    storey_taken: tuple[int, int] = (0, 1)
    tree_added: tuple[int, int] = (1, 1)
    tree_removed: tuple[int, int] = (1, 1)
    tree_grown: tuple[int, int] = (1, 2)
    tree_pruned: tuple[int, int] = (1, 1)
    hedge_cut: tuple[int, int] = (0, 1)
    vehicle_added: tuple[int, int] = (1, 1)
    vehicle_removed: tuple[int, int] = (1, 1)
    vehicle_moved: tuple[int, int] = (0, 1)
    vehicle_replaced: tuple[int, int] = (1, 1)
    vehicle_reparked: tuple[int, int] = (0, 1)
    furniture_added: tuple[int, int] = (0, 1)
    furniture_removed: tuple[int, int] = (1, 1)
    ground: tuple[int, int] = (1, 1)


class Ledger:
    """The instances as edits are drawn: things leave the stock of the street (or town) once they are dealt with."""

    def __init__(self, street: Any, random: np.random.Generator) -> None:
        self.street, self.random = street, random
        self.items: list[Item] = []
        self.grounds: list[GroundItem] = []
        self._next_id = 1

    def take(self, stock: list[Any], is_fit: Callable[[Any], bool] = lambda _: True) -> Any | None:
        """One thing drawn from a stock, which loses it; None where nothing fits."""
        fit = [i for i, thing in enumerate(stock) if is_fit(thing)]
        return stock.pop(fit[int(self.random.integers(len(fit)))]) if fit else None

    def new_id(self) -> int:
        self._next_id += 1
        return self._next_id - 1

    def add(
        self, before: Placed | None, after: Placed | None, label: ChangeLabel, edit: str = "", note: str = ""
    ) -> None:
        self.items.append(Item(self.new_id(), before, after, label, edit, note))

    def add_pair(self, before: Placed, after: Placed, edit: str, note: str) -> None:
        """A thing that is gone and another that came, by one edit."""
        gone, come = self.new_id(), self.new_id()
        self.items.append(Item(gone, before, None, REMOVED, edit, note, come))
        self.items.append(Item(come, None, after, ADDED, edit, note, gone))


def draw_edits(
    street: Street, random: np.random.Generator, counts: EditCounts | None = None
) -> tuple[list[Item], list[GroundItem]]:
    """All instances of a street over both surveys, edited ones first; ``counts`` None edits nothing.

    The street's lists are used up.
    """
    ledger = Ledger(street, random)
    if counts is not None:
        for name, edit in _EDITS.items():
            low, high = getattr(counts, name)
            share = street.terrain.length / 100.0
            for _ in range(round(int(random.integers(low, high + 1)) * share)):
                edit(ledger)
    for stock in (street.houses, street.trees, street.greenery, street.cars, street.furniture, street.boundaries):
        for placed in stock:
            ledger.add(placed, placed, UNCHANGED)
    return ledger.items, ledger.grounds


def _is_house(placed: Placed) -> bool:
    return isinstance(placed.thing, House)


def _is_detached(placed: Placed) -> bool:
    return isinstance(placed.thing, House) and placed.thing.bays == 3


def _add_building(ledger: Ledger) -> None:
    plot = ledger.take(ledger.street.plots)
    if plot is not None:
        house = draw_house(ledger.random, min(plot.width - 2.5, 9.5))
        ledger.add(None, Placed(house, plot.x, plot.side * (FACADE_Y_M + 0.4), plot.yaw), ADDED, "building added")


def _remove_building(ledger: Ledger) -> None:
    placed = ledger.take(ledger.street.houses, _is_detached)
    if placed is not None:
        ledger.add(placed, None, REMOVED, "building removed")


def _extend_building(ledger: Ledger) -> None:
    placed = ledger.take(ledger.street.houses, lambda p: _is_house(p) and not p.thing.annexes)
    if placed is None:
        return
    is_side = placed.thing.bays == 3 and ledger.random.random() < 0.5
    annex = side_annex(placed.thing, ledger.random) if is_side else front_annex(placed.thing, ledger.random)
    note = (
        f"annex of {annex.width:.1f} x {annex.depth:.1f} x {annex.height:.1f} m at the {'side' if is_side else 'front'}"
    )
    after = replace(placed, thing=replace(placed.thing, annexes=(annex,)))
    ledger.add(placed, after, INCREASED, "building extended", note)


def _demolish_annex(ledger: Ledger) -> None:
    placed = ledger.take(ledger.street.houses, lambda p: _is_house(p) and bool(p.thing.annexes))
    if placed is not None:
        annex = placed.thing.annexes[0]
        note = f"annex of {annex.width:.1f} x {annex.depth:.1f} x {annex.height:.1f} m taken down"
        ledger.add(
            placed, replace(placed, thing=replace(placed.thing, annexes=())), DECREASED, "annex demolished", note
        )


def _change_storeys(ledger: Ledger, step: int, label: ChangeLabel, edit: str) -> None:
    placed = ledger.take(ledger.street.houses, lambda p: _is_house(p) and 1 <= p.thing.storeys + step <= 4)
    if placed is not None:
        after = replace(placed.thing, storeys=placed.thing.storeys + step)
        note = f"{placed.thing.storeys} to {after.storeys} storeys"
        ledger.add(placed, replace(placed, thing=after), label, edit, note)


def _is_street_tree(placed: Placed) -> bool:
    return isinstance(placed.thing, Tree) and abs(placed.y) < FACADE_Y_M


def _add_tree(ledger: Ledger) -> None:
    pit = ledger.take(ledger.street.tree_pits)
    if pit is not None:
        ledger.add(None, replace(pit, thing=draw_tree(ledger.random)), ADDED, "tree added")


def _remove_tree(ledger: Ledger) -> None:
    placed = ledger.take(ledger.street.trees, _is_street_tree)
    if placed is not None:
        ledger.add(placed, None, REMOVED, "tree removed")


def _grow_tree(ledger: Ledger) -> None:
    placed = ledger.take(ledger.street.trees, _is_street_tree)
    if placed is not None:
        tree, factor = placed.thing, ledger.random.uniform(1.12, 1.4)
        grown = replace(tree, height=tree.height * factor, crown_radius=tree.crown_radius * factor)
        note = f"{tree.height:.1f} to {grown.height:.1f} m high"
        ledger.add(placed, replace(placed, thing=grown), INCREASED, "tree grown", note)


def _prune_tree(ledger: Ledger) -> None:
    placed = ledger.take(ledger.street.trees, _is_street_tree)
    if placed is not None:
        tree, factor = placed.thing, ledger.random.uniform(0.6, 0.85)
        height = tree.crown_base + (tree.height - tree.crown_base) * factor
        pruned = replace(tree, height=height, crown_radius=tree.crown_radius * factor)
        note = f"crown cut back to {factor:.2f} of its size, {tree.height:.1f} to {height:.1f} m high"
        ledger.add(placed, replace(placed, thing=pruned), DECREASED, "tree pruned", note)


def _cut_hedge(ledger: Ledger) -> None:
    placed = ledger.take(ledger.street.greenery, lambda p: isinstance(p.thing, Hedge))
    if placed is not None:
        height = placed.thing.height * ledger.random.uniform(0.45, 0.7)
        note = f"{placed.thing.height:.1f} to {height:.1f} m high"
        ledger.add(placed, replace(placed, thing=replace(placed.thing, height=height)), DECREASED, "hedge cut", note)


def _add_vehicle(ledger: Ledger) -> None:
    slot = ledger.take(ledger.street.slots)
    if slot is not None:
        ledger.add(None, in_slot(draw_car(ledger.random), slot, ledger.random), ADDED, "vehicle added")


def _remove_vehicle(ledger: Ledger) -> None:
    placed = ledger.take(ledger.street.cars)
    if placed is not None:
        ledger.add(placed, None, REMOVED, "vehicle removed")


def _move_vehicle(ledger: Ledger) -> None:
    slot, placed = ledger.take(ledger.street.slots), ledger.take(ledger.street.cars)
    if slot is not None and placed is not None:
        after = in_slot(placed.thing, slot, ledger.random)
        ledger.add_pair(
            placed, after, "vehicle moved", f"parked {np.hypot(after.x - placed.x, after.y - placed.y):.1f} m away"
        )


def replace_vehicle(ledger: Ledger) -> None:
    """A vehicle makes room for one of another build in the same slot."""
    placed = ledger.take(ledger.street.cars)
    if placed is not None:
        others = ("hatchback", "saloon") if placed.thing.style in ("van", "suv", "estate") else ("van",)
        after = replace(placed, thing=draw_car(ledger.random, others), x=placed.x + ledger.random.normal(0, 0.3))
        note = f"{placed.thing.style} replaced by {after.thing.style} in the same slot"
        ledger.add_pair(placed, after, "vehicle replaced", note)


def _repark_vehicle(ledger: Ledger) -> None:
    """The same vehicle in the same slot, not quite as it stood: not a change."""
    placed = ledger.take(ledger.street.cars)
    if placed is not None:
        dx = ledger.random.uniform(0.2, 0.6) * ledger.random.choice([-1.0, 1.0])
        after = replace(placed, x=placed.x + dx, yaw=placed.yaw + ledger.random.normal(0, 0.02))
        ledger.add(placed, after, UNCHANGED, "vehicle reparked", f"{abs(dx):.1f} m along its slot")


def _add_furniture(ledger: Ledger) -> None:
    x = ledger.random.uniform(5, ledger.street.terrain.length - 5)
    side = float(ledger.random.choice([-1.0, 1.0]))
    sign = Sign(ledger.random.uniform(2.2, 2.9), bool(ledger.random.random() < 0.5))
    ledger.add(None, Placed(sign, x, side * 6.75, ledger.random.normal(0, 0.1)), ADDED, "furniture added", sign.kind)


def _remove_furniture(ledger: Ledger) -> None:
    placed = ledger.take(ledger.street.furniture)
    if placed is not None:
        ledger.add(placed, None, REMOVED, "furniture removed", placed.thing.kind)


def _change_ground(ledger: Ledger) -> None:
    """Fill or dig a vacant plot; where none is left, relay a stretch of the carriageway."""
    random = ledger.random
    plot = ledger.take(ledger.street.plots)
    dz = float(random.uniform(0.12, 0.7) * random.choice([-1.0, 1.0]))
    if plot is not None:
        half, near, far = random.uniform(3.0, plot.width / 2 - 1.0), 8.0, random.uniform(13.5, 17.0)
        y0, y1 = sorted((plot.side * near, plot.side * far))
        patch = GroundPatch(plot.x - half, plot.x + half, y0, y1, dz)
        place = "plot"
    else:
        x, half = random.uniform(10, ledger.street.terrain.length - 10), random.uniform(3.0, 6.0)
        dz = abs(dz) * 0.4
        patch = GroundPatch(x - half, x + half, -ROAD_HALF_M, ROAD_HALF_M, dz)
        place = "carriageway"
    label, verb = (INCREASED, "filled") if dz > 0 else (DECREASED, "dug")
    note = f"{place} {verb} by {abs(dz):.2f} m over {patch.area_m2:.0f} m2"
    ledger.grounds.append(GroundItem(ledger.new_id(), patch, label, f"ground {verb}", note))


_EDITS: dict[str, Callable[[Ledger], None]] = {
    "building_added": _add_building,
    "building_removed": _remove_building,
    "annex_demolished": _demolish_annex,
    "building_extended": _extend_building,
    "storey_added": lambda ledger: _change_storeys(ledger, 1, INCREASED, "storey added"),
    "storey_taken": lambda ledger: _change_storeys(ledger, -1, DECREASED, "storey taken"),
    "tree_added": _add_tree,
    "tree_removed": _remove_tree,
    "tree_grown": _grow_tree,
    "tree_pruned": _prune_tree,
    "hedge_cut": _cut_hedge,
    "vehicle_added": _add_vehicle,
    "vehicle_removed": _remove_vehicle,
    "vehicle_moved": _move_vehicle,
    "vehicle_replaced": replace_vehicle,
    "vehicle_reparked": _repark_vehicle,
    "furniture_added": _add_furniture,
    "furniture_removed": _remove_furniture,
    "ground": _change_ground,
}
