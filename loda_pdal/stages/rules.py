"""What the cues of an object say about it: the rules of the paper (section 4.3) and ours, one object at a time."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from loda_pdal.model.cloud import BoolArray, ByteArray, FloatArray, IntArray
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.params import ChangeParams, ConfidenceParams, ObservabilityParams
from loda_pdal.stages.confidence import raw_confidence
from loda_pdal.stages.cues import Evidence


class Cue(NamedTuple):
    """The evidence of one object."""

    object_class: ObjectClass
    is_before: bool
    is_after: bool
    support_before: float
    support_after: float
    due_before: float
    due_after: float
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
    unshown: float
    gained_clear: float
    lost_clear: float
    column_rise: float
    column_scatter: float
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


def cues_of(evidence: Evidence, object_class: ByteArray, regions: Pair[FloatArray] | None = None) -> list[Cue]:
    """The evidence object by object; ``regions`` (n,) m3 of the largest piece that each lost and gained, 0 if left
    out."""
    regions = regions or Pair(np.zeros(len(object_class)), np.zeros(len(object_class)))
    columns = (
        evidence.n_voxels.before > 0,
        evidence.n_voxels.after > 0,
        evidence.support.before,
        evidence.support.after,
        evidence.due.before,
        evidence.due.after,
        *(getattr(evidence, name) for name in Cue._fields[7:-6]),
        np.fmax(evidence.n_voxels.before, evidence.n_voxels.after),
        *evidence.volume,
        *regions,
        np.fmax(evidence.height.before, evidence.height.after),
    )
    return [
        Cue(ObjectClass(code), *values)
        for code, values in zip(object_class.tolist(), zip(*(c.tolist() for c in columns), strict=True), strict=True)
    ]


def is_within(cue: Cue, params: ChangeParams) -> bool:
    """Whether what one epoch shows stands in the midst of what the other shows: a lamp where a tree was planted."""
    supports = cue.support_before, cue.support_after
    is_plain = cue.object_class in (ObjectClass.VEGETATION, ObjectClass.OTHER)
    is_pair = cue.is_before and cue.is_after
    return params.within_share > 0 and is_plain and is_pair and min(supports) < params.within_share <= max(supports)


def is_no_pair(cue: Cue, params: ChangeParams) -> bool:
    """A matched building or tree whose overlap or shift is beyond the paper's bounds is two objects."""
    if not (cue.is_before and cue.is_after):
        return False
    if cue.object_class == ObjectClass.BUILDING:
        return cue.iou <= params.building_iou or (cue.shift >= params.building_shift_m and _is_apart(cue, params))
    if cue.object_class == ObjectClass.VEGETATION:
        return cue.iou <= params.vegetation_iou or (cue.shift >= params.vegetation_shift_m and _is_apart(cue, params))
    return False


def _is_apart(cue: Cue, params: ChangeParams) -> bool:
    """Whether a large centroid shift means two objects: not where most of either surface is in the other epoch too."""
    return max(cue.support_before, cue.support_after) < params.min_support


def verdict_of(
    cue: Cue, is_apart: bool, is_part: bool, params: ChangeParams, observability: ObservabilityParams
) -> Verdict:
    """Label of one object; ``is_apart``: it was matched, but the pair turned out to be two objects."""
    if not (cue.is_before and cue.is_after):
        alone = _unmatched(cue, is_apart, params, observability)
        return extension(alone) if is_part and _is_piece(cue, params) else alone
    if cue.object_class == ObjectClass.MOBILE:
        found = _mobile(cue, params)
    else:
        found = (_new_part(cue, params) if is_part else None) or _pair(cue, params)
    is_same = found.label == ChangeLabel.UNCHANGED and max(cue.support_before, cue.support_after) >= params.min_support
    if observability.is_enabled and cue.observability < observability.min_observability and not is_same:
        return Verdict(
            ChangeLabel.UNDETERMINED,
            f"both surveys saw only {cue.observability:.0%} of it "
            f"(at least {observability.min_observability:.0%} needed){_hidden(cue)}",
        )
    return found


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
            (volume - own * params.voxel_m**3, _WITHIN_REACH) if params.fills_buildings else (theirs, NEXT_TO_NOTHING)
        )
        if volume == large and shown <= most * large:
            what = "a plant among others" if is_plant else "building in a row"
            return Verdict(label, f"{large:.0f} m3 of {what}, of which the {other} survey shows {shown:.0f} m3")
    return None


def extension(verdict: Verdict) -> Verdict:
    """What was built onto a house has not been Added: the house grew."""
    label = {ChangeLabel.ADDED: ChangeLabel.INCREASED, ChangeLabel.REMOVED: ChangeLabel.DECREASED}.get(verdict.label)
    return verdict if label is None else Verdict(label, f"a piece of the building: {verdict.reason}")


def of_its_own(verdict: Verdict, why: str) -> Verdict:
    """What stands before a house and is not built onto it came or went itself, and the house has not grown."""
    own = {ChangeLabel.INCREASED: ChangeLabel.ADDED, ChangeLabel.DECREASED: ChangeLabel.REMOVED}
    label = own.get(verdict.label, verdict.label)
    if label not in own.values():
        return verdict
    return Verdict(label, f"{why}: {verdict.reason}")


def uncovered(verdict: Verdict) -> Verdict:
    """A wall that came into sight when what hid it went has not changed, nor has one that a new building hides."""
    return Verdict(ChangeLabel.UNCHANGED, f"only hidden by the building beside it: {verdict.reason}")


def _is_piece(cue: Cue, params: ChangeParams) -> bool:
    """Whether a part of a body that one survey alone shows is too small to be a building of its own."""
    is_body = params.fills_buildings and cue.object_class == ObjectClass.BUILDING
    return is_body and max(cue.volume_before, cue.volume_after) < params.part_is_new_m3


def changed_houses(verdicts: list[Verdict], parent: IntArray, is_of_house: BoolArray, dv: FloatArray) -> dict[int, int]:
    """Houses that are Unchanged but for a part, and the part that changed most of each."""
    found: dict[int, int] = {}
    for part in np.lexsort((np.arange(len(parent)), np.abs(dv))).tolist():
        house = int(parent[part])
        is_changed = verdicts[part].label in (ChangeLabel.INCREASED, ChangeLabel.DECREASED)
        if is_of_house[part] and is_changed and verdicts[house].label == ChangeLabel.UNCHANGED:
            found[house] = part
    return found


NEXT_TO_NOTHING = 0.2
"""Share of a part's volume that may be its neighbours' walls."""

_WITHIN_REACH = 0.4
"""Share of a body's volume that may lie within reach of its neighbours."""


def _unmatched(cue: Cue, is_apart: bool, params: ChangeParams, observability: ObservabilityParams) -> Verdict:
    """Objects of one epoch only: not seen, seen under another name, or really Added or Removed."""
    label, other = (ChangeLabel.ADDED, "before") if cue.is_after else (ChangeLabel.REMOVED, "after")
    support, due = (cue.support_after, cue.due_after) if cue.is_after else (cue.support_before, cue.due_before)
    is_plant = cue.object_class == ObjectClass.VEGETATION
    if observability.is_enabled and cue.observability < observability.min_observability:
        if is_plant and support * cue.n_voxels >= params.backing_voxels and support >= params.min_support * due:
            return Verdict(
                ChangeLabel.UNCHANGED,
                f"{support:.0%} of it is in the {other} survey too, whose sampling lets {due:.0%} be expected",
            )
        return Verdict(
            ChangeLabel.UNDETERMINED,
            f"the {other} survey could have seen only {cue.observability:.0%} of it "
            f"(at least {observability.min_observability:.0%} needed){_hidden(cue)}",
        )
    is_undone = cue.object_class in (ObjectClass.BUILDING, ObjectClass.VEGETATION)
    if is_apart and not (is_undone and support >= params.min_support):
        return Verdict(
            label, f"what the {other} survey shows there is another object; it shares {support:.0%} of the surface"
        )
    is_hidden = params.needs_sight and cue.observability - support < _LEAST_EMPTY
    least = params.min_support * (cue.observability if is_hidden else 1.0)
    if params.needs_sight and is_plant and not is_hidden:
        least = max(least, _BESIDE_OTHERS * cue.observability)
    if support >= least:
        return Verdict(
            ChangeLabel.UNCHANGED,
            f"{support:.0%} of its surface is in the {other} survey too, as part of other objects",
        )
    if cue.unshown < params.min_returns:
        return Verdict(
            ChangeLabel.UNDETERMINED,
            f"too little of it to tell: {cue.unshown:.0f} returns where the {other} survey saw nothing "
            f"(at least {params.min_returns} needed)",
        )
    if params.raised_m > 0 and cue.tall <= params.raised_m:
        return Verdict(ChangeLabel.UNDETERMINED, f"no higher than {cue.tall:.2f} m above the ground: a piece of it")
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


_BESIDE_OTHERS = 2 / 3
"""Share of what the other survey could see of a plant that it must show: half may be within reach of its neighbours."""


def _mobile(cue: Cue, params: ChangeParams) -> Verdict:
    """Matched mobile objects (paper, section 4.3): the same in its place, or the epoch with more of its own space."""
    figures = f"overlap {cue.iou:.2f}, centre moved {cue.shift:.2f} m"
    is_near = cue.shift < params.mobile_shift_m or cue.iou >= params.min_support
    if cue.iou > params.mobile_iou and is_near:
        return Verdict(
            ChangeLabel.UNCHANGED, f"in its place: {figures} (limits {params.mobile_iou} and {params.mobile_shift_m} m)"
        )
    if cue.gained == cue.lost:
        return Verdict(ChangeLabel.UNCHANGED, f"neither survey shows more of its own: {figures}")
    label, other = (ChangeLabel.ADDED, "after") if cue.gained > cue.lost else (ChangeLabel.REMOVED, "before")
    return Verdict(label, f"not the same object; the {other} survey shows more of its own: {figures}")


def _volume_ratio(cue: Cue, params: ChangeParams) -> float:
    """Relative change of volume; NaN where it is not known. A crown is as large as the survey says that shows more."""
    if not (params.needs_sight and cue.object_class == ObjectClass.VEGETATION and cue.tall >= LOW_M):
        return cue.dv_ratio
    large = max(cue.volume_before, cue.volume_after)
    return (cue.gained - cue.lost) * params.voxel_m**3 / large if large > 0 else math.nan


def _pair(cue: Cue, params: ChangeParams) -> Verdict:
    """Matched buildings, vegetation and other objects (paper, section 4.3)."""
    is_green = cue.object_class == ObjectClass.VEGETATION
    height_m = params.vegetation_height_m if is_green else params.building_height_m
    ratio = params.vegetation_volume_ratio if is_green else params.building_volume_ratio
    gate = params.lod_factor * cue.lod95 if params.use_lod else 0.0
    least = params.backing_voxels
    least_above = max(least, params.backing_share * cue.n_voxels)
    dh = cue.dh
    is_alike = cue.column_scatter <= _ALIKE * abs(cue.column_rise)  # twigs that were met by chance do not move alike
    if params.fills_buildings and cue.object_class == ObjectClass.BUILDING and abs(cue.column_rise) > abs(dh):
        dh = cue.column_rise  # most of the roof moved, if not its highest part
    has_height = params.use_height and abs(dh) > max(gate, height_m)  # NaN is never above
    dv_ratio = _volume_ratio(cue, params)
    has_volume = params.use_volume and abs(dv_ratio) > ratio
    if params.fills_buildings and cue.object_class == ObjectClass.BUILDING:
        # edges of roofs come and go with the sampling: a body changed where a piece of it did, or most of its roof
        has_volume &= max(cue.grown_m3, cue.cut_m3) > 0
        is_solid = (cue.grown_m3 if dh > 0 else cue.cut_m3) > 0  # what is lower than the house lowers no roof
        has_height &= is_solid or (is_alike and abs(cue.column_rise) > max(gate, height_m))
    # a top that moves by more than what hides a voxel leaves voxels behind
    is_hideable = not params.needs_sight or abs(cue.dh) < _HIDES_VOXEL * params.query_radius_m
    is_thing = params.needs_sight and cue.object_class == ObjectClass.OTHER
    rise = cue.column_rise if is_hideable and is_alike and not is_thing else math.nan
    is_crown = params.needs_sight and is_green and cue.tall >= LOW_M
    enough = max(gate, height_m if is_crown else height_m / 2)
    is_raised = least == 0 or cue.gained_above >= least_above or rise > enough
    is_lowered = least == 0 or cue.lost_above >= least_above or rise < -enough
    rises = has_height and dh > 0 and is_raised
    sinks = has_height and dh < 0 and is_lowered
    is_low = is_green and cue.tall < LOW_M
    by_columns, least_rise = False, max(gate, params.plant_rise_m)
    if params.plant_rise_m > 0 and is_low and is_alike and abs(cue.column_rise) < _HIDES_VOXEL * params.query_radius_m:
        rose, fell = cue.column_rise > least_rise, cue.column_rise < -least_rise
        by_columns = (rose and not rises) or (fell and not sinks)
        rises, sinks = rises or rose, sinks or fell
    noise = params.volume_sigmas * math.sqrt(cue.gained + cue.lost)
    has_volume = has_volume and abs(cue.gained - cue.lost) >= noise
    swells = has_volume and dv_ratio > 0 and (least == 0 or cue.gained >= max(least, cue.lost))
    shrinks = has_volume and dv_ratio < 0 and (least == 0 or cue.lost >= max(least, cue.gained))
    figures = _figures(cue, dh, height_m, ratio, gate)
    if by_columns:
        figures = f"columns {cue.column_rise:+.2f} m in the median (limit {least_rise:.2f} m), {figures}"
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
    if cue.object_class != ObjectClass.BUILDING and cue.tall < LOW_M:
        piece = max(cue.gained_clear, cue.lost_clear)
        if piece >= max(params.backing_voxels, _PIECE * cue.n_voxels, 2.0 * min(cue.gained_clear, cue.lost_clear)):
            label = ChangeLabel.INCREASED if cue.gained_clear > cue.lost_clear else ChangeLabel.DECREASED
            return Verdict(label, f"{piece:.0f} voxels of it stand where the other survey shows the ground: {figures}")
    limit = max(gate, params.displacement_m)
    if params.use_displacement and params.displacement_m > 0 and not is_green and abs(cue.d_perp) > limit:
        label = ChangeLabel.INCREASED if cue.gained >= cue.lost else ChangeLabel.DECREASED
        return Verdict(
            label, f"surface moved {abs(cue.d_perp):.2f} m along its normal (limit {limit:.2f} m): {figures}"
        )
    if has_height or has_volume:
        return Verdict(ChangeLabel.UNCHANGED, f"what stands there is the same for all that its figures say: {figures}")
    return Verdict(ChangeLabel.UNCHANGED, f"no cue above its limit: {figures}")


_PIECE = 0.25
"""Share of a hedge or a fence that is no fluke of the sampling, where the other survey shows the ground instead."""

LOW_M = 3.0
"""Plants up to here have a top of their own, and no crown that sheds its leaves."""

_ALIKE = 1.2
"""Tops of columns move alike where the quartiles of their moves lie no farther apart than so many times the median."""

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


def raw_score(cue: Cue, verdict: Verdict, is_apart: bool, params: ChangeParams, confidence: ConfidenceParams) -> float:
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
