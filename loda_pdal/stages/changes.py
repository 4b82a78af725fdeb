"""From cues to labels: the class-specific rules of the paper (section 4.3), gated by the limit of detection.

Two questions come before the rules: could the other survey have seen the object (METHOD 2), and is the pair a pair at
all. What is unmatched is Added or Removed only if its place was seen, and its surface is not in the other survey.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from loda_pdal.model.cloud import BoolArray, ByteArray, FloatArray, IntArray
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.pair import Pair
from loda_pdal.params import ChangeParams, ConfidenceParams, ObservabilityParams
from loda_pdal.stages.confidence import calibrated, raw_confidence
from loda_pdal.stages.correspondence import rank_by_place
from loda_pdal.stages.cues import Cells, Evidence, Surface, Voxels, cells_with_owners, sample_voxels, weigh
from loda_pdal.stages.observability import Coverage
from loda_pdal.stages.parts import Parts, dissolve, largest_regions, split_parts
from loda_pdal.stages.things import split_things
from loda_pdal.stages.vehicles import ONE_VEHICLE_M, looks_like_vehicle, roughness, shape_change


@dataclass(frozen=True)
class Changes:
    """Labels of all objects, (n,) each; objects are numbered by place.

    Attributes
    ----------
    owner : Pair of (m,) int32
        Object of each voxel, -1 none.
    parent : (n,) int32
        Object that this one is a part of, -1 none.
    object_class, label : (n,) uint8
        `ObjectClass` and `ChangeLabel` codes.
    confidence, confidence_raw : (n,) float64
        Calibrated and raw score; NaN where the label is Undetermined.
    reason : tuple of str
        Which rule decided, with its figures.
    evidence : Evidence
        The cues.
    """

    owner: Pair[IntArray]
    parent: IntArray
    object_class: ByteArray
    label: ByteArray
    confidence: FloatArray
    confidence_raw: FloatArray
    reason: tuple[str, ...]
    evidence: Evidence

    def __len__(self) -> int:
        return len(self.label)

    def together(self, other: Changes, xyz: Pair[FloatArray]) -> Changes:
        """These objects and those of ``other``, which have none of the same points (m, 3) m, numbered by place."""
        n = len(self)
        owner = self.owner.join(other.owner, lambda own, more: np.where(more >= 0, more + n, own).astype(np.int32))
        rank = rank_by_place(xyz, owner, n + len(other))
        order = np.argsort(rank)
        number = np.append(rank, -1).astype(np.int32)
        parent = np.concatenate([self.parent, np.where(other.parent >= 0, other.parent + n, -1)])
        both = self.evidence.together(other.evidence)
        return Changes(
            owner=owner.map(lambda side: number[side]),
            parent=number[parent[order]],
            object_class=np.concatenate([self.object_class, other.object_class])[order],
            label=np.concatenate([self.label, other.label])[order],
            confidence=np.concatenate([self.confidence, other.confidence])[order],
            confidence_raw=np.concatenate([self.confidence_raw, other.confidence_raw])[order],
            reason=tuple((self.reason + other.reason)[i] for i in order.tolist()),
            evidence=both.at(order),
        )


def decide_changes(
    surfaces: Pair[Surface],
    object_class: ByteArray,
    coverage: Pair[Coverage],
    lod: LodGrid,
    params: ChangeParams,
    observability: ObservabilityParams,
    confidence: ConfidenceParams,
) -> Changes:
    """Label every object (paper, section 4.3).

    Parameters
    ----------
    surfaces : Pair of Surface
        Fused points of each epoch with their objects, 0 to ``len(object_class) - 1``.
    object_class : (n,) uint8
        Class of each object.
    coverage : Pair of Coverage
        Where each survey saw.
    lod : LodGrid
        Limits of detection.
    """
    seen = coverage if observability.is_enabled or params.visible_only else None
    voxels = sample_voxels(surfaces, seen, lod, params)
    n = len(object_class)
    no = np.zeros(n, np.bool_)
    cast = _Cast(surfaces, object_class, np.full(n, -1, dtype=np.int32), no, no, no).settled(voxels)
    cells = cast.cells(voxels, params)
    evidence = weigh(cells, cast.surfaces, len(cast), params)
    cues = _rows(evidence, cast.object_class, largest_regions(cells, len(cast), params))
    is_within = np.array([_is_within(cue, params) for cue in cues], dtype=np.bool_)
    is_no_pair = np.array([_is_no_pair(cue, params) for cue in cues], dtype=np.bool_) & ~is_within
    is_no_pair |= _is_replaced(cast, cues, voxels.at_points(cells.is_seen.swapped, cast.surfaces), params)
    if is_no_pair.any() or is_within.any():
        cast = cast.without_pairs(is_no_pair)
        cast = cast.without_surroundings(is_within, voxels.at_points(cells.is_near.swapped, cast.surfaces))
        cast = cast.settled(voxels)
        cells = cast.cells(voxels, params)
    if params.thing_voxels > 0:
        is_vehicle = (cast.object_class == ObjectClass.MOBILE) & looks_like_vehicle(
            cast.surfaces, len(cast), ONE_VEHICLE_M
        )
        is_asked = cast.is_pair & (cast.object_class != ObjectClass.BUILDING) & ~is_vehicle
        owner, host = split_things(cells, cast.surfaces, is_asked, params)
        is_kept = cast.with_more(owner, host).is_smooth(host)
        owner = owner.map(lambda side: is_kept[side])
        cast = cast.with_more(owner, host).settled(voxels)
        cells = cast.cells(voxels, params)
    if params.find_parts:
        cast = cast.with_parts(split_parts(cells, cast.surfaces, cast.object_class, params)).settled(voxels)
        cells = cast.cells(voxels, params)
    evidence = weigh(cells, cast.surfaces, len(cast), params)
    regions = largest_regions(cells, len(cast), params)
    surfaces, object_class, parent, is_apart = cast.surfaces, cast.object_class, cast.parent, cast.is_apart
    is_smooth = roughness(cast.surfaces, cast.is_extension) < _FOLIAGE_M
    carrier = np.append(cast.is_house, False)[parent] & cast.is_extension
    cues = _rows(evidence, object_class, regions)
    is_part = (parent >= 0) & ~cast.is_extension
    verdicts = [
        _verdict(cue, apart, part, params, observability)
        for cue, apart, part in zip(cues, is_apart.tolist(), is_part.tolist(), strict=True)
    ]
    for i in np.flatnonzero(cast.is_extension).tolist():
        verdicts[i] = _extension(verdicts[i])
    raw = np.array(
        [
            _raw(cue, v, apart, params, confidence)
            for cue, v, apart in zip(cues, verdicts, is_apart.tolist(), strict=True)
        ]
    )
    for i, part in _changed_houses(verdicts, parent, carrier & is_smooth, evidence.dv).items():
        verdicts[i] = Verdict(verdicts[part].label, f"a part of it changed: {verdicts[part].reason}")
        raw[i] = raw[part]
    sure = [calibrated(score, v.label, confidence) for score, v in zip(raw.tolist(), verdicts, strict=True)]
    label = np.array([v.label for v in verdicts], dtype=np.uint8)
    is_known = label != ChangeLabel.UNDETERMINED
    return Changes(
        owner=surfaces.map(lambda side: side.owner),
        parent=parent,
        object_class=object_class.astype(np.uint8),
        label=label,
        confidence=np.where(is_known, np.array(sure, dtype=np.float64), np.nan),
        confidence_raw=np.where(is_known, raw.astype(np.float64), np.nan),
        reason=tuple(v.reason for v in verdicts),
        evidence=evidence,
    )


@dataclass(frozen=True)
class _Cast:
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

    def without_pairs(self, is_no_pair: BoolArray) -> _Cast:
        """The before and the after side of the marked objects as objects of their own."""
        owner, partner = dissolve(self.surfaces.map(lambda side: side.owner), is_no_pair, len(self))
        apart = self.with_more(owner, partner)
        return replace(apart, is_apart=apart.is_apart | is_no_pair[np.concatenate([np.arange(len(self)), partner])])

    def without_surroundings(self, is_within: BoolArray, is_shared: Pair[BoolArray]) -> _Cast:
        """Of the marked objects (k,) keep what both epochs show; the rest is an object of its own."""
        number = np.full(len(self) + 1, -1, dtype=np.int32)
        inner = np.flatnonzero(is_within).astype(np.int32)
        number[inner] = len(self) + np.arange(len(inner), dtype=np.int32)
        owner = self.surfaces.join(
            is_shared,
            lambda side, shared: np.where(~shared & (number[side.owner] >= 0), number[side.owner], side.owner),
        )
        return self.with_more(owner, inner)

    def with_more(self, owner: Pair[IntArray], like: IntArray) -> _Cast:
        """Other owners, and behind the objects there are as many more as ``like`` (t,) names, of their kind."""
        each = np.concatenate([np.arange(len(self)), like])
        return _Cast(
            self.surfaces.join(owner, Surface.owned_by),
            self.object_class[each],
            self.parent[each],
            self.is_apart[each],
            self.is_house[each],
            self.is_extension[each],
        )

    def is_smooth(self, host: IntArray) -> IntArray:
        """Where the points of each object go, (n + 1,), the last those of none: rough things (t,) of a plant are a part
        of it and go back to their ``host``."""
        n = len(self) - len(host)
        goes_to = np.append(np.arange(len(self)), -1).astype(np.int32)
        is_asked = np.arange(len(self)) >= n
        is_rough: BoolArray = np.nan_to_num(roughness(self.surfaces, is_asked)) > _FOLIAGE_M
        counts = np.bincount(
            np.concatenate([side.owner[side.owner >= 0] for side in self.surfaces]), minlength=len(self)
        )
        is_rough &= counts >= _LEAST_FOLIAGE
        is_rough &= self.object_class == ObjectClass.VEGETATION
        goes_to[:-1][is_rough] = host[np.flatnonzero(is_rough) - n]
        return goes_to

    @property
    def is_pair(self) -> BoolArray:
        """Which objects (n,) both epochs have."""
        before, after = (np.isin(np.arange(len(self)), side.owner) for side in self.surfaces)
        return before & after

    def with_parts(self, parts: Parts) -> _Cast:
        """Parts as objects of their parents' class."""
        whole = np.arange(len(parts.parent))
        for _ in range(2):  # a part of a house, that of a row
            whole = np.where(parts.parent[whole] >= 0, parts.parent[whole], whole)
        surfaces = self.surfaces.join(parts.owner, Surface.owned_by)
        return _Cast(
            surfaces,
            self.object_class[whole],
            parts.parent,
            self.is_apart[whole],
            parts.is_house,
            parts.is_extension,
        )

    def settled(self, voxels: Voxels) -> _Cast:
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

    def _inherited(self, has_voxel: BoolArray, heir: Pair[IntArray]) -> _Cast:
        """Points of objects without a voxel given to their heirs."""
        owner = self.surfaces.join(heir, lambda side, own: np.where(has_voxel[side.owner], side.owner, own))
        return replace(self, surfaces=self.surfaces.join(owner, Surface.owned_by))

    def _by_place(self) -> _Cast:
        owner = self.surfaces.map(lambda side: side.owner)
        rank = rank_by_place(self.surfaces.map(lambda side: side.xyz), owner, len(self))
        is_used = np.zeros(len(self) + 1, np.bool_)
        for side in owner:
            is_used[side] = True
        order = np.argsort(rank)
        kept: IntArray = order[is_used[order]].astype(np.int32)
        number = np.full(len(self) + 1, -1, dtype=np.int32)
        number[kept] = np.arange(len(kept), dtype=np.int32)
        return _Cast(
            self.surfaces.join(owner.map(lambda side: number[side]), Surface.owned_by),
            self.object_class[kept],
            np.asarray(number[self.parent[kept]], dtype=np.int32),
            self.is_apart[kept],
            self.is_house[kept],
            self.is_extension[kept],
        )


class Cue(NamedTuple):
    """The evidence of one object."""

    object_class: ObjectClass
    is_before: bool
    is_after: bool
    support_before: float
    support_after: float
    gained: float
    lost: float
    iou: float
    shift: float
    dh: float
    dv_ratio: float
    d_perp: float
    d_typical: float
    gained_above: float
    lost_above: float
    column_rise: float
    lod95: float
    observability: float
    hidden: float
    rise: float
    n_voxels: float
    volume_before: float
    volume_after: float
    cut_m3: float
    grown_m3: float
    tall: float


class Verdict(NamedTuple):
    """A label and the sentence that says why."""

    label: ChangeLabel
    reason: str


def _rows(evidence: Evidence, object_class: ByteArray, regions: Pair[FloatArray]) -> list[Cue]:
    columns = (
        evidence.n_voxels.before > 0,
        evidence.n_voxels.after > 0,
        evidence.support.before,
        evidence.support.after,
        *(getattr(evidence, name) for name in Cue._fields[5:-6]),
        np.fmax(evidence.n_voxels.before, evidence.n_voxels.after),
        *evidence.volume,
        *regions,
        np.fmax(evidence.height.before, evidence.height.after),
    )
    return [
        Cue(ObjectClass(code), *values)
        for code, values in zip(object_class.tolist(), zip(*(c.tolist() for c in columns), strict=True), strict=True)
    ]


def _is_within(cue: Cue, params: ChangeParams) -> bool:
    """Whether what one epoch shows stands in the midst of what the other shows: a lamp where a tree was planted."""
    supports = cue.support_before, cue.support_after
    is_plain = cue.object_class in (ObjectClass.VEGETATION, ObjectClass.OTHER)
    is_pair = cue.is_before and cue.is_after
    return params.within_share > 0 and is_plain and is_pair and min(supports) < params.within_share <= max(supports)


def _is_no_pair(cue: Cue, params: ChangeParams) -> bool:
    """A matched building or tree whose overlap or shift is beyond the paper's bounds is two objects."""
    if not (cue.is_before and cue.is_after):
        return False
    if cue.object_class == ObjectClass.BUILDING:
        return cue.iou <= params.building_iou or (cue.shift >= params.building_shift_m and _is_apart(cue, params))
    if cue.object_class == ObjectClass.VEGETATION:
        return cue.iou <= params.vegetation_iou or (cue.shift >= params.vegetation_shift_m and _is_apart(cue, params))
    return False


def _is_replaced(cast: _Cast, cues: list[Cue], is_open: Pair[BoolArray], params: ChangeParams) -> BoolArray:
    """Which vehicles stand where another one stood."""
    is_pair = np.array([cue.is_before and cue.is_after for cue in cues], dtype=np.bool_)
    is_loose = np.isin(cast.object_class, (ObjectClass.MOBILE, ObjectClass.OTHER))
    is_large = np.array([cue.n_voxels >= _LEAST_VEHICLE for cue in cues], dtype=np.bool_)
    is_asked = is_pair & is_loose & is_large & (params.replaced_m > 0)
    is_asked &= looks_like_vehicle(cast.surfaces, len(cast))
    off = shape_change(cast.surfaces, is_open, is_asked)
    rough = roughness(cast.surfaces, is_asked)
    is_another = (off > np.fmax(params.replaced_m, _ROUGH * rough)) & (rough < _FOLIAGE_M)
    if params.replaced_top_m > 0:
        rise = np.array([abs(cue.dh) for cue in cues])
        is_mobile = is_pair & (cast.object_class == ObjectClass.MOBILE)
        is_another |= is_mobile & np.isnan(off) & (rise > params.replaced_top_m)
    return np.asarray(is_another)


_LEAST_FOLIAGE = 60
"""Fused points of a piece of plant; what has less is rough whatever it is."""

_FOLIAGE_M = 0.08
"""Foliage is rougher than this, vehicles, bins and walls are not."""

_LEAST_VEHICLE = 50
"""Voxels of a vehicle."""

_ROUGH = 1.0
"""A shape must be off by more than this many times its own roughness."""


def _is_apart(cue: Cue, params: ChangeParams) -> bool:
    """Whether a large centroid shift means two objects: not where most of either surface is in the other epoch too."""
    return max(cue.support_before, cue.support_after) < params.min_support


def _verdict(
    cue: Cue, is_apart: bool, is_part: bool, params: ChangeParams, observability: ObservabilityParams
) -> Verdict:
    """Label of one object; ``is_apart``: it was matched, but the pair turned out to be two objects."""
    if not (cue.is_before and cue.is_after):
        alone = _unmatched(cue, is_apart, params, observability)
        return _extension(alone) if is_part and _is_piece(cue, params) else alone
    if observability.is_enabled and cue.observability < observability.min_observability:
        return Verdict(
            ChangeLabel.UNDETERMINED,
            f"both surveys saw only {cue.observability:.0%} of it "
            f"(at least {observability.min_observability:.0%} needed){_hidden(cue)}",
        )
    if cue.object_class == ObjectClass.MOBILE:
        return _mobile(cue, params)
    if is_part and (new := _new_part(cue, params)):
        return new
    return _pair(cue, params)


def _new_part(cue: Cue, params: ChangeParams) -> Verdict | None:
    """A part of which the other survey has next to nothing: one house of a row, one of several plants, came or went."""
    is_plant = cue.object_class == ObjectClass.VEGETATION and params.plant_width_m > 0
    if not is_plant and (cue.object_class != ObjectClass.BUILDING or params.part_is_new_m3 == 0):
        return None
    large = max(cue.volume_before, cue.volume_after)
    if not is_plant and large < params.part_is_new_m3:
        return None
    for label, own, volume, theirs, other in (
        (ChangeLabel.ADDED, cue.gained, cue.volume_after, cue.volume_before, "before"),
        (ChangeLabel.REMOVED, cue.lost, cue.volume_before, cue.volume_after, "after"),
    ):
        # bodies are within reach of the bodies beside them
        shown, most = (
            (volume - own * params.voxel_m**3, _WITHIN_REACH) if params.fills_buildings else (theirs, _NEXT_TO_NOTHING)
        )
        if volume == large and shown <= most * large:
            what = "a plant among others" if is_plant else "building in a row"
            return Verdict(label, f"{large:.0f} m3 of {what}, of which the {other} survey shows {shown:.0f} m3")
    return None


def _extension(verdict: Verdict) -> Verdict:
    """What was built onto a house has not been Added: the house grew."""
    label = {ChangeLabel.ADDED: ChangeLabel.INCREASED, ChangeLabel.REMOVED: ChangeLabel.DECREASED}.get(verdict.label)
    return verdict if label is None else Verdict(label, f"a piece of the building: {verdict.reason}")


def _is_piece(cue: Cue, params: ChangeParams) -> bool:
    """Whether a part of a body that one survey alone shows is too small to be a building of its own."""
    is_body = params.fills_buildings and cue.object_class == ObjectClass.BUILDING
    return is_body and max(cue.volume_before, cue.volume_after) < params.part_is_new_m3


def _changed_houses(
    verdicts: list[Verdict], parent: IntArray, is_of_house: BoolArray, dv: FloatArray
) -> dict[int, int]:
    """Houses that are Unchanged but for a part, and the part that changed most of each."""
    found: dict[int, int] = {}
    for part in np.lexsort((np.arange(len(parent)), np.abs(dv))).tolist():
        house = int(parent[part])
        is_changed = verdicts[part].label in (ChangeLabel.INCREASED, ChangeLabel.DECREASED)
        if is_of_house[part] and is_changed and verdicts[house].label == ChangeLabel.UNCHANGED:
            found[house] = part
    return found


_NEXT_TO_NOTHING = 0.2
"""Share of a part's volume that may be its neighbours' walls."""

_WITHIN_REACH = 0.4
"""Share of a body's volume that may lie within reach of its neighbours."""


def _unmatched(cue: Cue, is_apart: bool, params: ChangeParams, observability: ObservabilityParams) -> Verdict:
    """Objects of one epoch only: not seen, seen under another name, or really Added or Removed."""
    label, other = (ChangeLabel.ADDED, "before") if cue.is_after else (ChangeLabel.REMOVED, "after")
    support = cue.support_after if cue.is_after else cue.support_before
    if observability.is_enabled and cue.observability < observability.min_observability:
        return Verdict(
            ChangeLabel.UNDETERMINED,
            f"the {other} survey could have seen only {cue.observability:.0%} of it "
            f"(at least {observability.min_observability:.0%} needed){_hidden(cue)}",
        )
    if is_apart:
        return Verdict(
            label, f"what the {other} survey shows there is another object; it shares {support:.0%} of the surface"
        )
    is_hidden = params.needs_sight and cue.observability - support < _LEAST_EMPTY
    if support >= params.min_support * (cue.observability if is_hidden else 1.0):
        return Verdict(
            ChangeLabel.UNCHANGED,
            f"{support:.0%} of its surface is in the {other} survey too, as part of other objects",
        )
    return Verdict(
        label,
        f"no match in the {other} survey, which shows {support:.0%} of its surface "
        f"and could have seen {cue.observability:.0%} of it",
    )


def _hidden(cue: Cue) -> str:
    """How much of an object that was not seen had something before it, where rays say so."""
    return f"; {cue.hidden:.0%} was hidden behind what stood nearer to the sensor" if cue.hidden > 0 else ""


_LEAST_EMPTY = 0.2
"""Share of an object that the other survey must have seen empty, where it shows half of what it could see of it."""


def _mobile(cue: Cue, params: ChangeParams) -> Verdict:
    """Matched mobile objects (paper, section 4.3): the same in its place, or the epoch with more of its own space."""
    figures = f"overlap {cue.iou:.2f}, centre moved {cue.shift:.2f} m"
    if cue.iou > params.mobile_iou and cue.shift < params.mobile_shift_m:
        return Verdict(
            ChangeLabel.UNCHANGED, f"in its place: {figures} (limits {params.mobile_iou} and {params.mobile_shift_m} m)"
        )
    if cue.gained == cue.lost:
        return Verdict(ChangeLabel.UNCHANGED, f"neither survey shows more of its own: {figures}")
    label, other = (ChangeLabel.ADDED, "after") if cue.gained > cue.lost else (ChangeLabel.REMOVED, "before")
    return Verdict(label, f"not the same object; the {other} survey shows more of its own: {figures}")


def _pair(cue: Cue, params: ChangeParams) -> Verdict:
    """Matched buildings, vegetation and other objects (paper, section 4.3)."""
    is_green = cue.object_class == ObjectClass.VEGETATION
    height_m = params.vegetation_height_m if is_green else params.building_height_m
    ratio = params.vegetation_volume_ratio if is_green else params.building_volume_ratio
    gate = params.lod_factor * cue.lod95 if params.use_lod else 0.0
    least = params.backing_voxels
    least_above = max(least, params.backing_share * cue.n_voxels)
    dh = cue.dh
    if params.fills_buildings and cue.object_class == ObjectClass.BUILDING and abs(cue.column_rise) > abs(dh):
        dh = cue.column_rise  # most of the roof moved, if not its highest part
    has_height = params.use_height and abs(dh) > max(gate, height_m)  # NaN is never above
    has_volume = params.use_volume and abs(cue.dv_ratio) > ratio
    if params.fills_buildings and cue.object_class == ObjectClass.BUILDING:
        # edges of roofs come and go with the sampling: a body changed where a piece of it did, or most of its roof
        is_solid = max(cue.grown_m3, cue.cut_m3) > 0
        has_volume &= is_solid
        has_height &= is_solid or abs(cue.column_rise) > max(gate, height_m)
    # a top that moves by more than what hides a voxel leaves voxels behind
    rise = cue.column_rise if not params.needs_sight or abs(cue.dh) < _HIDES_VOXEL * params.query_radius_m else math.nan
    is_crown = params.needs_sight and is_green and cue.tall >= _LOW_M
    enough = max(gate, height_m if is_crown else height_m / 2)
    is_raised = least == 0 or cue.gained_above >= least_above or rise > enough
    is_lowered = least == 0 or cue.lost_above >= least_above or rise < -enough
    rises = has_height and dh > 0 and is_raised
    sinks = has_height and dh < 0 and is_lowered
    is_low = is_green and cue.tall < _LOW_M
    if params.plant_rise_m > 0 and is_low and abs(cue.column_rise) < _HIDES_VOXEL * params.query_radius_m:
        rises |= cue.column_rise > max(gate, params.plant_rise_m)
        sinks |= cue.column_rise < -max(gate, params.plant_rise_m)
    noise = params.volume_sigmas * math.sqrt(cue.gained + cue.lost)
    has_volume = has_volume and abs(cue.gained - cue.lost) >= noise
    swells = has_volume and cue.dv_ratio > 0 and (least == 0 or cue.gained >= max(least, cue.lost))
    shrinks = has_volume and cue.dv_ratio < 0 and (least == 0 or cue.lost >= max(least, cue.gained))
    figures = _figures(cue, dh, height_m, ratio, gate)
    if (rises or swells) and (sinks or shrinks):
        if math.isnan(cue.rise) or cue.rise == 0:
            return Verdict(
                ChangeLabel.UNCHANGED, f"height and volume disagree, and the occupied space does not move: {figures}"
            )
        label = ChangeLabel.INCREASED if cue.rise > 0 else ChangeLabel.DECREASED
        return Verdict(label, f"height and volume disagree, but the occupied space moves {cue.rise:+.2f} m: {figures}")
    if rises or swells:
        return Verdict(ChangeLabel.INCREASED, f"{_named(rises, swells)} up: {figures}")
    if sinks or shrinks:
        return Verdict(ChangeLabel.DECREASED, f"{_named(sinks, shrinks)} down: {figures}")
    if cue.object_class == ObjectClass.BUILDING and max(cue.grown_m3, cue.cut_m3) > 0:
        if cue.grown_m3 >= cue.cut_m3:
            return Verdict(ChangeLabel.INCREASED, f"{cue.grown_m3:.0f} m3 built on in one piece: {figures}")
        return Verdict(ChangeLabel.DECREASED, f"{cue.cut_m3:.0f} m3 taken away in one piece: {figures}")
    limit = max(gate, params.displacement_m)
    if params.use_displacement and params.displacement_m > 0 and not is_green and abs(cue.d_perp) > limit:
        label = ChangeLabel.INCREASED if cue.gained >= cue.lost else ChangeLabel.DECREASED
        return Verdict(
            label, f"surface moved {abs(cue.d_perp):.2f} m along its normal (limit {limit:.2f} m): {figures}"
        )
    return Verdict(ChangeLabel.UNCHANGED, f"no cue above its limit: {figures}")


_LOW_M = 3.0
"""Plants up to here have a top of their own, and no crown that sheds its leaves."""

_HIDES_VOXEL = 1.5
"""Query radii that a top may move without a voxel gained or lost."""


def _named(is_height: bool, is_volume: bool) -> str:
    return "height and volume" if is_height and is_volume else "height" if is_height else "volume"


def _figures(cue: Cue, dh: float, height_m: float, ratio: float, gate: float) -> str:
    parts = []
    if not math.isnan(dh):
        parts.append(f"top {dh:+.2f} m (limit {max(height_m, gate):.2f} m)")
    if not math.isnan(cue.dv_ratio):
        parts.append(f"volume {cue.dv_ratio:+.0%} (limit {ratio:.0%})")
    if not math.isnan(cue.lod95):
        parts.append(f"LoD95 {cue.lod95:.2f} m")
    return ", ".join([*parts, f"overlap {cue.iou:.2f}"])


def _raw(cue: Cue, verdict: Verdict, is_apart: bool, params: ChangeParams, confidence: ConfidenceParams) -> float:
    is_green = cue.object_class == ObjectClass.VEGETATION
    height_m = params.vegetation_height_m if is_green else params.building_height_m
    ratio = params.vegetation_volume_ratio if is_green else params.building_volume_ratio
    shift_m = params.vegetation_shift_m if is_green else params.building_shift_m
    return raw_confidence(
        verdict.label,
        height=cue.dh / max(height_m, params.lod_factor * cue.lod95, 1e-9),
        volume=cue.dv_ratio / max(ratio, 1e-9),
        overlap=cue.iou,
        shift=cue.shift / max(shift_m, 1e-9),
        displacement=cue.d_perp / max(params.lod_factor * cue.lod95, params.displacement_m, 1e-9),
        support=0.0 if is_apart else cue.support_before if verdict.label == ChangeLabel.REMOVED else cue.support_after,
        observability=cue.observability,
        params=confidence,
    )
