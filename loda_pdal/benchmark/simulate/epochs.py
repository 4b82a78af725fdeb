"""What stands at each of the two surveys, whose it is, and what became of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loda_pdal.benchmark.simulate.edits import UNCHANGED, GroundItem, Item
from loda_pdal.benchmark.simulate.objects import Tree
from loda_pdal.benchmark.simulate.scene import Ground
from loda_pdal.benchmark.simulate.sensor import Scan
from loda_pdal.benchmark.simulate.shapes import EMPTY, Shape, distance_to_triangles, joined
from loda_pdal.benchmark.simulate.town import ModelHouse
from loda_pdal.benchmark.simulate.world import Mover
from loda_pdal.model.cloud import BoolArray, ByteArray, FloatArray, Int64Array
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.pair import Pair


@dataclass(frozen=True)
class EpochScene:
    """Everything that stands at one survey, and what passes by.

    Attributes
    ----------
    surface : Shape
        What stands.
    owner : (p,) int64
        Instance of each primitive, numbered as in `World`; 0 for ground that did not change.
    change : (p,) uint8
        `ChangeLabel` of each primitive.
    movers : tuple of Mover
        What passes by.
    """

    surface: Shape
    owner: Int64Array
    change: ByteArray
    movers: tuple[Mover, ...] = ()

    def with_movers(self, movers: Sequence[Mover], first_id: int, label: ChangeLabel) -> EpochScene:
        """The same with passers-by: instances from ``first_id`` on, there in this survey only."""
        sizes = [len(m.shape) for m in movers]
        owner = np.repeat(first_id + np.arange(len(movers)), sizes)
        change = np.full(sum(sizes), label, dtype=np.uint8)
        return EpochScene(
            self.surface, np.concatenate([self.owner, owner]), np.concatenate([self.change, change]), tuple(movers)
        )


def epoch_scenes(
    terrain: Ground,
    items: list[Item],
    grounds: list[GroundItem],
    foliage: Pair[np.random.Generator],
    leaf_share: Pair[float] | None = None,
) -> Pair[EpochScene]:
    """Both states of the street, ready to be surveyed; ``foliage`` places the leaves of each anew, and leaves out all
    but ``leaf_share`` of those of trees."""
    shares = leaf_share or Pair(1.0, 1.0)
    fallen = foliage.map(lambda random: random.spawn(1)[0])
    outlines = [g.patch for g in grounds]
    ground_ids = np.array([g.instance_id for g in grounds] + [0])
    ground_labels = np.array([g.label for g in grounds] + [ChangeLabel.UNCHANGED], dtype=np.uint8)
    parts: Pair[list[EpochScene]] = Pair([], [])
    for into, patches in ((parts.before, []), (parts.after, outlines)):
        ground, patch = terrain.surface(patches, outlines)
        into.append(EpochScene(ground, ground_ids[patch], ground_labels[patch]))
    for item in items:
        before = item.before.surface(terrain, foliage.before) if item.before else EMPTY
        after = item.after.surface(terrain, foliage.after) if item.after else EMPTY
        if isinstance(item.placed.thing, Tree):
            before = _thinned(before, shares.before, fallen.before)
            after = _thinned(after, shares.after, fallen.after)
        parts.before.append(_item_scene(item, before, after))
        parts.after.append(_item_scene(item, after, before))
    return parts.map(_joined_scene)


def _thinned(shape: Shape, share: float, random: np.random.Generator) -> Shape:
    """A tree with that share of its leaves."""
    is_left = random.random(len(shape.discs)) < share
    return replace(shape, discs=shape.discs[is_left], disc_material=shape.disc_material[is_left])


def _item_scene(item: Item, shape: Shape, other: Shape) -> EpochScene:
    is_changed = _is_only_here(shape, other) & (item.label is not ChangeLabel.UNCHANGED)
    change = np.where(is_changed, item.label, ChangeLabel.UNCHANGED).astype(np.uint8)
    return EpochScene(shape, np.full(len(shape), item.instance_id), change)


def _joined_scene(parts: list[EpochScene]) -> EpochScene:
    """All parts as one; triangles come before discs, here as in `Shape`."""
    n_triangles = [len(p.surface.triangles) for p in parts]
    split = [(p.owner[:n], p.owner[n:], p.change[:n], p.change[n:]) for p, n in zip(parts, n_triangles, strict=True)]
    owner_of_triangle, owner_of_disc, change_of_triangle, change_of_disc = zip(*split, strict=True)
    return EpochScene(
        joined(p.surface for p in parts),
        np.concatenate([*owner_of_triangle, *owner_of_disc]),
        np.concatenate([*change_of_triangle, *change_of_disc]),
    )


def _is_only_here(shape: Shape, other: Shape) -> BoolArray:
    """Which primitives the other epoch's surface of the same thing does not have, triangles first; leaves count as
    gone, since they are never the same twice."""
    is_only = np.ones(len(shape), dtype=bool)
    known = {row.tobytes() for row in np.round(other.triangles * 1e4).astype(np.int64)}
    mine = np.round(shape.triangles * 1e4).astype(np.int64)
    is_only[: len(mine)] = [row.tobytes() not in known for row in mine]
    return is_only


def changes_of_returns(scenes: Pair[EpochScene], scans: Pair[Scan], items: list[Item]) -> Pair[ByteArray]:
    """`ChangeLabel` of the surface under each return, (n,) per survey.

    A primitive that only one survey has may lie in a surface that both have (a wall under a new storey): of buildings
    of a city model that grew or shrank, returns from such places are unchanged. (Houses of a street are built so that
    they share such primitives.)
    """
    grown = [i for i in items if i.before and i.after and i.edit and isinstance(i.placed.thing, ModelHouse)]
    changes = scenes.join(scans, lambda scene, measured: scene.change[measured.primitive])
    for item in grown:
        surface = scenes.map(lambda scene, owner=item.instance_id: _surface_of(scene, owner))  # type: ignore[misc]
        for scene, measured, change, other in zip(scenes, scans, changes, surface.swapped, strict=True):
            at = np.flatnonzero((scene.owner[measured.primitive] == item.instance_id) & (change != UNCHANGED))
            change[at[distance_to_triangles(measured.met_xyz[at], other) < _SAME_SURFACE_M]] = UNCHANGED
    return changes


def _surface_of(scene: EpochScene, instance_id: int) -> FloatArray:
    """Triangles of one instance."""
    triangles = scene.surface.triangles
    return np.asarray(triangles[scene.owner[: len(triangles)] == instance_id])


_SAME_SURFACE_M = 0.05
"""Returns this near to the other survey's surface of the same building show nothing that changed."""
