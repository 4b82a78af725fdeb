"""The objects as they stand while pairs are undone and things and parts are taken out of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loda_pdal.model.cloud import BoolArray, ByteArray, IntArray
from loda_pdal.model.labels import ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.params import ChangeParams
from loda_pdal.stages.correspondence import rank_by_place
from loda_pdal.stages.cues import Cells, Surface, Voxels, cells_with_owners
from loda_pdal.stages.parts import Parts, dissolve
from loda_pdal.stages.vehicles import roughness

FOLIAGE_M = 0.08
"""Foliage is rougher than this, vehicles, bins and walls are not."""

_LEAST_FOLIAGE = 60
"""Fused points of a piece of plant; what has less is rough whatever it is."""


@dataclass(frozen=True)
class Cast:
    """The objects as they stand: who owns which point, of which class, part of whom, whether a pair was undone, and
    whether it is a house, which what is built onto it changes, or built onto one."""

    surfaces: Pair[Surface]
    object_class: ByteArray
    parent: IntArray
    is_apart: BoolArray
    is_house: BoolArray
    is_extension: BoolArray

    def __len__(self) -> int:
        return len(self.object_class)

    def cells(self, voxels: Voxels, params: ChangeParams) -> Cells:
        """The voxels with their owners; all but vegetation is solid."""
        is_solid = (self.object_class != ObjectClass.VEGETATION) & params.needs_sight
        return cells_with_owners(voxels, self.surfaces, len(self), params, is_solid)

    def without_pairs(self, is_no_pair: BoolArray) -> Cast:
        """The before and the after side of the marked objects as objects of their own."""
        owner, partner = dissolve(self.surfaces.map(lambda side: side.owner), is_no_pair, len(self))
        apart = self.with_more(owner, partner)
        return replace(apart, is_apart=apart.is_apart | is_no_pair[np.concatenate([np.arange(len(self)), partner])])

    def without_surroundings(self, is_within: BoolArray, is_shared: Pair[BoolArray]) -> Cast:
        """Of the marked objects (k,) keep what both epochs show; the rest is an object of its own."""
        number = np.full(len(self) + 1, -1, dtype=np.int32)
        inner = np.flatnonzero(is_within).astype(np.int32)
        number[inner] = len(self) + np.arange(len(inner), dtype=np.int32)
        owner = self.surfaces.join(
            is_shared,
            lambda side, shared: np.where(~shared & (number[side.owner] >= 0), number[side.owner], side.owner),
        )
        return self.with_more(owner, inner)

    def with_more(self, owner: Pair[IntArray], like: IntArray) -> Cast:
        """Other owners, and behind the objects there are as many more as ``like`` (t,) names, of their kind."""
        each = np.concatenate([np.arange(len(self)), like])
        return Cast(
            self.surfaces.join(owner, Surface.owned_by),
            self.object_class[each],
            self.parent[each],
            self.is_apart[each],
            self.is_house[each],
            self.is_extension[each],
        )

    def smooth_only(self, host: IntArray) -> IntArray:
        """Where the points of each object go, (n + 1,), the last those of none: of the last ``len(host)`` objects those
        that were part of a plant, and do not show that they are smooth, go back to their ``host``."""
        n = len(self) - len(host)
        goes_to = np.append(np.arange(len(self)), -1).astype(np.int32)
        is_asked = np.arange(len(self)) >= n
        is_rough = np.nan_to_num(roughness(self.surfaces, is_asked), nan=np.inf) > FOLIAGE_M
        counts = np.bincount(
            np.concatenate([side.owner[side.owner >= 0] for side in self.surfaces]), minlength=len(self)
        )
        is_back = (is_rough | (counts < _LEAST_FOLIAGE)) & is_asked & (self.object_class == ObjectClass.VEGETATION)
        goes_to[:-1][is_back] = host[np.flatnonzero(is_back) - n]
        return goes_to

    @property
    def is_pair(self) -> BoolArray:
        """Which objects (n,) both epochs have."""
        before, after = (np.isin(np.arange(len(self)), side.owner) for side in self.surfaces)
        return before & after

    def with_parts(self, parts: Parts) -> Cast:
        """Parts as objects of their parents' class."""
        whole = np.arange(len(parts.parent))
        for _ in range(2):  # a part of a house, that of a row
            whole = np.where(parts.parent[whole] >= 0, parts.parent[whole], whole)
        surfaces = self.surfaces.join(parts.owner, Surface.owned_by)
        return Cast(
            surfaces,
            self.object_class[whole],
            parts.parent,
            self.is_apart[whole],
            parts.is_house,
            parts.is_extension,
        )

    def settled(self, voxels: Voxels) -> Cast:
        """Objects numbered by place, none without a voxel of its own.

        Points of an object whose voxels all belong to others go to those, and objects without points are dropped.
        """
        cast = self._by_place()
        while True:
            holder, _ = voxels.holders(cast.surfaces, len(cast))
            has_voxel = np.zeros(len(cast) + 1, np.bool_)
            has_voxel[holder] = True
            if has_voxel[:-1].all():
                return cast
            cast = cast._inherited(has_voxel, voxels.on_points(holder, cast.surfaces))._by_place()

    def _inherited(self, has_voxel: BoolArray, heir: Pair[IntArray]) -> Cast:
        """Points of objects without a voxel given to their heirs."""
        owner = self.surfaces.join(heir, lambda side, own: np.where(has_voxel[side.owner], side.owner, own))
        return replace(self, surfaces=self.surfaces.join(owner, Surface.owned_by))

    def _by_place(self) -> Cast:
        owner = self.surfaces.map(lambda side: side.owner)
        rank = rank_by_place(self.surfaces.map(lambda side: side.xyz), owner, len(self))
        is_used = np.zeros(len(self) + 1, np.bool_)
        for side in owner:
            is_used[side] = True
        order = np.argsort(rank)
        kept: IntArray = order[is_used[order]].astype(np.int32)
        number = np.full(len(self) + 1, -1, dtype=np.int32)
        number[kept] = np.arange(len(kept), dtype=np.int32)
        return Cast(
            self.surfaces.join(owner.map(lambda side: number[side]), Surface.owned_by),
            self.object_class[kept],
            np.asarray(number[self.parent[kept]], dtype=np.int32),
            self.is_apart[kept],
            self.is_house[kept],
            self.is_extension[kept],
        )
