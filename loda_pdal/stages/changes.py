"""From cues to labels: the class-specific rules of the paper (section 4.3), gated by the limit of detection.

Two questions come before the rules: could the other survey have seen the object (METHOD 2), and is the pair a pair at
all. What is unmatched is Added or Removed only if its place was seen, and its surface is not in the other survey.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loda_pdal.model.boxes import upright_boxes
from loda_pdal.model.cloud import BoolArray, ByteArray, FloatArray, IntArray
from loda_pdal.model.groups import Groups
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.pair import Pair
from loda_pdal.params import ChangeParams, ConfidenceParams, ObservabilityParams
from loda_pdal.stages.annexes import are_built_on, came_into_sight, screens, slopes_from_walls
from loda_pdal.stages.cast import FOLIAGE_M, Cast
from loda_pdal.stages.confidence import calibrated
from loda_pdal.stages.correspondence import rank_by_place
from loda_pdal.stages.cues import Cells, Evidence, Surface, Voxels, median_rise, sample_voxels, share_beneath, weigh
from loda_pdal.stages.faces import face_offset
from loda_pdal.stages.observability import Coverage
from loda_pdal.stages.parts import largest_regions, split_parts
from loda_pdal.stages.rooflines import beyond_view
from loda_pdal.stages.rows import split_houses
from loda_pdal.stages.rules import (
    NEXT_TO_NOTHING,
    Cue,
    Verdict,
    changed_houses,
    cues_of,
    extension,
    is_no_pair,
    is_within,
    of_its_own,
    raw_score,
    uncovered,
    verdict_of,
)
from loda_pdal.stages.stems import split_poles
from loda_pdal.stages.things import carried_on, split_close_things, split_things
from loda_pdal.stages.vehicles import ONE_VEHICLE_M, Fit, looks_like_vehicle, roughness, shape_change, tops_differ


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
    cast, voxels = _divided(surfaces, object_class, voxels, lod, params)
    cells = cast.cells(voxels, params)
    evidence = weigh(cells, cast.surfaces, len(cast), params)
    has_walls = not params.fills_buildings
    is_row = has_walls & (cast.parent < 0) & ~cast.is_house  # a piece of it is too little of it: parts were taken out
    regions = largest_regions(cells, len(cast), params).map(lambda volume: np.where(is_row, 0.0, volume))
    cues = cues_of(evidence, cast.object_class, regions)
    is_part = (cast.parent >= 0) & ~cast.is_extension
    verdicts = [
        verdict_of(cue, apart, part, params, observability)
        for cue, apart, part in zip(cues, cast.is_apart.tolist(), is_part.tolist(), strict=True)
    ]
    is_building = cast.object_class == ObjectClass.BUILDING
    is_asked = cast.is_extension & has_walls
    is_shed = slopes_from_walls(cells, cast.surfaces, cast.parent, is_asked) > _FALLS
    is_screen = is_shed | screens(cells, is_building, is_asked)
    for i in np.flatnonzero(cast.is_extension).tolist():
        verdicts[i] = extension(verdicts[i])
    if params.needs_sight:
        verdicts = _without_uncovered(verdicts, cells, is_building, evidence.n_voxels)
    for i in np.flatnonzero(is_screen).tolist():
        why = "its roof falls towards the wall behind it" if is_shed[i] else "the wall behind it shows as before"
        verdicts[i] = of_its_own(verdicts[i], why)
    raw = np.array(
        [
            raw_score(cue, v, apart, params, confidence)
            for cue, v, apart in zip(cues, verdicts, cast.is_apart.tolist(), strict=True)
        ]
    )
    is_of_house = np.append(cast.is_house, False)[cast.parent] & cast.is_extension & ~is_screen
    is_of_house &= (evidence.observability >= _WELL_SEEN) | (not has_walls)
    is_on_top = (np.fmax(*regions) > 0) & has_walls
    is_built_on = are_built_on(cells, cast.surfaces, cast.parent, is_of_house, is_on_top, has_walls=has_walls)
    for i, part in changed_houses(verdicts, cast.parent, is_built_on, evidence.dv).items():
        verdicts[i] = Verdict(verdicts[part].label, f"a part of it changed: {verdicts[part].reason}")
        raw[i] = raw[part]
    sure = [calibrated(score, v.label, confidence) for score, v in zip(raw.tolist(), verdicts, strict=True)]
    label = np.array([v.label for v in verdicts], dtype=np.uint8)
    is_known = label != ChangeLabel.UNDETERMINED
    return Changes(
        owner=cast.surfaces.map(lambda side: side.owner),
        parent=cast.parent,
        object_class=cast.object_class.astype(np.uint8),
        label=label,
        confidence=np.where(is_known, np.array(sure, dtype=np.float64), np.nan),
        confidence_raw=np.where(is_known, raw.astype(np.float64), np.nan),
        reason=tuple(v.reason for v in verdicts),
        evidence=evidence,
    )


def _without_uncovered(
    verdicts: list[Verdict], cells: Cells, is_building: BoolArray, n_voxels: Pair[FloatArray]
) -> list[Verdict]:
    """The verdicts, those on walls that only came into sight or went out of it Unchanged."""
    label = np.array([v.label for v in verdicts], dtype=np.uint8)
    of_buildings = np.where(is_building, label, ChangeLabel.UNDETERMINED)
    changed = Pair(
        (of_buildings == ChangeLabel.DECREASED) & (n_voxels.after <= NEXT_TO_NOTHING * n_voxels.before),
        (of_buildings == ChangeLabel.INCREASED) & (n_voxels.before <= NEXT_TO_NOTHING * n_voxels.after),
    )
    gone = Pair(of_buildings == ChangeLabel.REMOVED, of_buildings == ChangeLabel.ADDED)
    is_uncovered = came_into_sight(cells, changed, gone)
    return [uncovered(v) if found else v for v, found in zip(verdicts, is_uncovered.tolist(), strict=True)]


def _divided(
    surfaces: Pair[Surface], object_class: ByteArray, voxels: Voxels, lod: LodGrid, params: ChangeParams
) -> tuple[Cast, Voxels]:
    """The objects as they are judged: pairs that are none undone, things and parts taken out (METHOD 2b); and the
    voxels, without the walls that only one survey could see."""
    n = len(object_class)
    no = np.zeros(n, np.bool_)
    cast = Cast(surfaces, object_class, np.full(n, -1, dtype=np.int32), no, no, no).settled(voxels)
    cells = cast.cells(voxels, params)
    evidence = weigh(cells, cast.surfaces, len(cast), params)
    cues = cues_of(evidence, cast.object_class)
    is_building = cast.object_class == ObjectClass.BUILDING
    is_inner = np.array([is_within(cue, params) for cue in cues], dtype=np.bool_)
    is_apart = np.array([is_no_pair(cue, params) for cue in cues], dtype=np.bool_) & ~is_inner
    is_open = voxels.at_points(cells.is_seen.swapped, cast.surfaces)
    is_another = _is_replaced(cast, cues, cells, is_open, lod, params)
    is_apart |= is_another & (share_beneath(cells, is_building) < _MOST_BENEATH)
    if is_apart.any() or is_inner.any():
        cast = cast.without_pairs(is_apart)
        cast = cast.without_surroundings(is_inner, voxels.at_points(cells.is_near.swapped, cast.surfaces))
        cast = cast.settled(voxels)
        cells = cast.cells(voxels, params)
    if params.needs_sight:
        cast = _with_poles(cast, cells, params).settled(voxels)
        cells = cast.cells(voxels, params)
    if params.thing_voxels > 0:
        is_vehicle = (cast.object_class == ObjectClass.MOBILE) & looks_like_vehicle(
            cast.surfaces, len(cast), ONE_VEHICLE_M
        )
        is_asked = cast.is_pair & (cast.object_class != ObjectClass.BUILDING) & ~is_vehicle
        if params.fills_buildings:
            is_asked &= ~_is_line(cast)
        owner, host = split_things(cells, cast.surfaces, is_asked, params)
        if params.fills_buildings:
            goes_to = cast.with_more(owner, host).smooth_only(host)
            owner = owner.map(lambda side: goes_to[side])
        cast = cast.with_more(owner, host)
        if params.needs_sight:
            cast = _with_close_things(cast, voxels, cells, params)
        is_leafy = np.isin(cast.object_class, (ObjectClass.VEGETATION, ObjectClass.OTHER))
        cast = cast.with_more(carried_on(cast.surfaces, is_leafy), host[:0]).settled(voxels)
        cells = cast.cells(voxels, params)
    if params.find_parts and params.needs_sight and not params.fills_buildings:
        is_asked = cast.is_pair & (cast.object_class == ObjectClass.BUILDING)
        voxels = voxels.unseen_by(beyond_view(cells, cast.surfaces, is_asked, params))
        cells = cast.cells(voxels, params)
        is_asked &= params.frontage_m > 0
        cast = cast.with_more(*split_houses(cells, cast.surfaces, is_asked, params)).settled(voxels)
        cells = cast.cells(voxels, params)
    if params.find_parts:
        cast = cast.with_parts(split_parts(cells, cast.surfaces, cast.object_class, params)).settled(voxels)
    return cast, voxels


def _with_poles(cast: Cast, cells: Cells, params: ChangeParams) -> Cast:
    """The objects with poles taken out of the foliage on them, where some of that may have changed."""
    n = len(cast)
    new = np.concatenate([cells.owner.before[cells.is_lost], cells.owner.after[cells.is_gained]])
    is_asked = cast.is_pair & (np.bincount(new, minlength=n) >= params.backing_voxels)
    is_plant, is_other = (is_asked & (cast.object_class == c) for c in (ObjectClass.VEGETATION, ObjectClass.OTHER))
    more = cast.with_more(*split_poles(cast.surfaces, is_plant, is_other))
    is_pole = np.arange(len(more)) >= n
    return replace(more, object_class=np.where(is_pole, ObjectClass.OTHER, more.object_class).astype(np.uint8))


def _with_close_things(cast: Cast, voxels: Voxels, cells: Cells, params: ChangeParams) -> Cast:
    """The objects with small things taken out of them, and out of what only seems to be in the other survey too."""
    is_vehicle = (cast.object_class == ObjectClass.MOBILE) & looks_like_vehicle(cast.surfaces, len(cast))
    near = voxels.at_points(cells.is_near.swapped, cast.surfaces)
    shown = cast.surfaces.join(near, lambda side, is_near: Groups(side.owner, len(cast)).share(is_near))
    is_asked = np.where(cast.is_pair, ~is_vehicle, ~cast.is_apart & (np.fmax(*shown) >= params.min_support))
    is_asked &= cast.object_class != ObjectClass.BUILDING
    more = cast.with_more(*split_close_things(cast.surfaces, is_asked, ~cast.is_pair, params))
    return replace(more, is_apart=more.is_apart | (np.arange(len(more)) >= len(cast)))


def _is_replaced(
    cast: Cast, cues: list[Cue], cells: Cells, is_open: Pair[BoolArray], lod: LodGrid, params: ChangeParams
) -> BoolArray:
    """Which vehicles, walls and fences stand where another one stood."""
    is_pair = np.array([cue.is_before and cue.is_after for cue in cues], dtype=np.bool_)
    is_loose = np.isin(cast.object_class, (ObjectClass.MOBILE, ObjectClass.OTHER)) & is_pair & (params.replaced_m > 0)
    is_vehicle = looks_like_vehicle(cast.surfaces, len(cast))
    is_large = np.array([cue.n_voxels >= _LEAST_VEHICLE for cue in cues], dtype=np.bool_)
    aside = face_offset(cast.surfaces, is_loose)
    fit = shape_change(cast.surfaces, is_open, is_loose & is_vehicle & is_large)
    is_another = _stands_aside(cast, cells, aside, is_loose & ~is_vehicle, lod, params)
    is_another |= _has_another_shape(cast, cells, aside, fit, lod, params)
    if params.replaced_top_m > 0:
        rise = np.minimum(
            [abs(cue.dh) for cue in cues], np.abs(median_rise(cells.voxels, cast.surfaces, len(cast), _LEAST_TOPS))
        )
        is_few = is_pair & (cast.object_class == ObjectClass.MOBILE) & np.isnan(fit.off)
        is_another |= is_few & ((rise > params.replaced_top_m) | (tops_differ(cast.surfaces, is_few) > _SURE))
    return np.asarray(is_another)


def _is_line(cast: Cast) -> BoolArray:
    """Which objects (n,) are hedges, fences or walls by their plan: a piece of one is cut, and no thing of its own."""
    xyz = np.concatenate([side.xyz for side in cast.surfaces])
    size = upright_boxes(xyz, np.concatenate([side.owner for side in cast.surfaces]), len(cast)).size[:, :2]
    return np.asarray(size.min(axis=1) < _LINE_M)


def _stands_aside(
    cast: Cast, cells: Cells, aside: FloatArray, is_asked: BoolArray, lod: LodGrid, params: ChangeParams
) -> BoolArray:
    """Which of the solid things asked for have their faces ``aside`` (n,) m of where they were."""
    limit = _shared_limit(cells, is_asked, cells.voxels.normal, lod, params)
    is_off = is_asked & (aside > np.fmax(params.replaced_m, limit))
    return is_off & (roughness(cast.surfaces, is_off) < FOLIAGE_M)


def _has_another_shape(
    cast: Cast, cells: Cells, aside: FloatArray, fit: Fit, lod: LodGrid, params: ChangeParams
) -> BoolArray:
    """Which of the vehicles that were compared have another shape, or stand higher or lower and not where they stood.

    What is no vehicle stays where it is: its faces lie ``aside`` (n,) m if it is another one.
    """
    is_asked = np.isfinite(fit.off)
    rough = roughness(cast.surfaces, is_asked)
    is_fixed = (cast.object_class == ObjectClass.OTHER) & (aside < params.replaced_m / 2)
    is_off = (fit.off > np.fmax(params.replaced_m, _ROUGH * rough)) & ~is_fixed
    limit = _shared_limit(cells, is_asked, np.array([0.0, 0.0, 1.0]), lod, params)
    is_lifted = np.abs(fit.move[:, 2]) > np.fmax(_SPRINGS_M, limit)
    is_elsewhere = np.hypot(fit.move[:, 0], fit.move[:, 1]) > _PARKED_M
    return np.asarray((is_off | (is_lifted & is_elsewhere)) & (rough < FOLIAGE_M))


def _shared_limit(
    cells: Cells, is_asked: BoolArray, normal: FloatArray, lod: LodGrid, params: ChangeParams
) -> FloatArray:
    """What objects (n,) must move, m, along the normals (c, 3) of their voxels, or one for all; NaN if not asked for.

    The noise of their points averages out of a median over all of them; pose and drift, which they share, do not.
    """
    before, after = cells.owner
    voxels = cells.voxels
    is_face = (before == after) & np.append(is_asked, False)[before] & np.isfinite(voxels.displacement)
    found = np.flatnonzero(is_face & params.use_lod)
    along = np.broadcast_to(normal, voxels.centre.shape)[found]
    limit = lod.limit_of(np.zeros(len(found)), voxels.centre[found], along)
    return params.lod_factor * Groups(before[found], len(is_asked)).median(limit)


_SPRINGS_M = 0.04
"""A vehicle that is loaded or cold stands no more than this lower or higher than it did."""

_PARKED_M = 0.05
"""Nobody parks another vehicle this exactly where one stood."""

_FALLS = 0.1
"""Slope of a roof, m per m, that is meant: what is level as built is measured within less."""

_WELL_SEEN = 0.55
"""Share of a part that both surveys must have seen before a whole house is called after it."""

_LINE_M = 1.5
"""Hedges, fences and walls are narrower, and vehicles, sheds and skips are wider."""

_LEAST_TOPS = 4
"""Columns that both surveys show of a vehicle, before its tops are compared."""

_LEAST_VEHICLE = 50
"""Voxels of a vehicle."""

_MOST_BENEATH = 0.5
"""Of what is a vehicle no more lies beneath a building: a piece of a wall has more of the house above it."""

_SURE = 1.1
"""Tops of another vehicle differ more surely, see `tops_differ`."""

_ROUGH = 1.0
"""A shape must be off by more than this many times its own roughness."""
