"""Which instances the two surveys allow to be judged.

An instance counts in the scores when the surveys hold evidence about it:

1. Every survey that it stands in has at least ``min_returns`` returns from it.
2. Where it changed, there is a survey that (a) has at least ``min_returns`` returns from surface that the other epoch
   does not have, while (b) the other survey could have measured at least ``min_visible`` of the places of these
   returns: had that surface been there, pulses would have met it. From some place of the other survey's drive they are
   in range and in the field of view, inside the area that survey covers, and nothing that stood or drove in between
   hides them; what took the very place of the thing (its `partner`) does not count as hiding it.
3. It does not move while it is measured.

Otherwise it is excluded, and the truth says why. What is excluded depends on geometry and on the drive only, never on
the size of a change or on what a method makes of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from loda_pdal.benchmark.simulate.edits import GroundItem, Item
from loda_pdal.benchmark.simulate.epochs import EpochScene
from loda_pdal.benchmark.simulate.options import SimulationOptions
from loda_pdal.benchmark.simulate.plan import SurveyPlan
from loda_pdal.benchmark.simulate.sensor import Scan, sees
from loda_pdal.benchmark.simulate.world import World
from loda_pdal.benchmark.truth import TruthInstance
from loda_pdal.model.cloud import ByteArray, FloatArray
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.model.transform import transform_points

MOVING = "moving"
"""Why what passed by is excluded."""

_SAMPLE = 100
"""Places per instance and survey that are looked at from the other survey."""


@dataclass(frozen=True)
class Evidence:
    """One survey of the scene: how it was made, what stood there, and what was measured.

    ``change`` (n,) is the `ChangeLabel` of the surface under each return.
    """

    plan: SurveyPlan
    scene: EpochScene
    world: World
    measured: Scan
    change: ByteArray


def instances_of(
    items: list[Item],
    grounds: list[GroundItem],
    evidence: Pair[Evidence],
    T_map_street: FloatArray,
    options: SimulationOptions,
) -> list[TruthInstance]:
    """The truth about every instance, with what the surveys caught of it, by its number.

    Parameters
    ----------
    items, grounds
        What stands in the street and which ground changed; passers-by are taken from the scenes.
    evidence : Pair of Evidence
    T_map_street : (4, 4) float64
        From the street's frame to map coordinates of the after epoch.
    options : SimulationOptions

    Returns
    -------
    list of TruthInstance
    """
    known: list[TruthInstance] = [_of_item(item) for item in items] + [_of_ground(ground) for ground in grounds]
    known += _passers(evidence)
    n_ids = max((i.instance_id for i in known), default=0) + 1
    caught = evidence.map(lambda one: _caught(one, n_ids))
    found = []
    for instance in sorted(known, key=lambda i: i.instance_id):
        mine = caught.map(lambda of_all, at=instance.instance_id: of_all[at])  # type: ignore[misc]
        points = np.concatenate([of_one.points for of_one in mine])
        seen = _places_seen(instance, mine, evidence)
        instance = replace(
            instance,
            n_points=mine.map(lambda of_one: len(of_one.points)),
            n_changed=mine.map(lambda of_one: len(of_one.changed)),
            visible=seen.map(lambda of_one: of_one.visible),
            centre=_centre(points, T_map_street),
        )
        found.append(replace(instance, excluded=instance.excluded or reason_to_exclude(instance, seen, options)))
    return found


class Seen(NamedTuple):
    """What one survey could tell of the places where the other one met changed surface: the share of them that it
    covers, and the share that it could have measured; None where there are no such places."""

    covered: float | None
    visible: float | None


def reason_to_exclude(instance: TruthInstance, seen: Pair[Seen], options: SimulationOptions) -> str | None:
    """Why an instance cannot be judged from these two surveys (rules 1 and 2); None where it can."""
    least, least_share = options.min_returns, options.min_visible
    for epoch, stands, n in zip(("before", "after"), instance.exists, instance.n_points, strict=True):
        if stands and n < least:
            return f"{n} returns in the {epoch} survey, fewer than {least}"
    if not instance.is_changed:
        return None
    reasons = []
    for epoch, n, of_other in zip(("after", "before"), instance.n_changed, seen.swapped, strict=True):
        if n < least:
            reasons.append(f"{n} returns from what changed, fewer than {least}")
        elif (of_other.covered or 0.0) < least_share:
            reasons.append(f"the {epoch} survey does not cover its place")
        elif (of_other.visible or 0.0) < least_share:
            share = 100 * (of_other.visible or 0.0)
            reasons.append(
                f"the {epoch} survey could see {share:.0f} % of its place, less than {100 * least_share:.0f} %"
            )
        else:
            return None
    # the later reason speaks of the survey with more to show
    return reasons[0] if instance.n_changed.before >= instance.n_changed.after else reasons[1]


class _Caught(NamedTuple):
    """What one survey caught of an instance: its returns (n, 3), and where it met changed surface (k, 3), m."""

    points: FloatArray
    changed: FloatArray


def _caught(one: Evidence, n_ids: int) -> list[_Caught]:
    """For each instance what the survey caught of it."""
    owner = one.scene.owner[one.measured.primitive]
    order = np.argsort(owner, kind="stable")
    bounds = np.searchsorted(owner[order], np.arange(1, n_ids))
    points = np.split(one.measured.xyz[order], bounds)
    met = np.split(one.measured.met_xyz[order], bounds)
    is_changed = np.split(one.change[order] != ChangeLabel.UNCHANGED, bounds)
    return [_Caught(p, m[c]) for p, m, c in zip(points, met, is_changed, strict=True)]


def _places_seen(instance: TruthInstance, caught: Pair[_Caught], evidence: Pair[Evidence]) -> Pair[Seen]:
    """What each survey could tell of the places of changed surface that the other one met."""
    if instance.excluded is not None:
        return Pair(Seen(None, None), Seen(None, None))

    def seen(one: Evidence, of_other: _Caught) -> Seen:
        n = len(of_other.changed)
        if not n:
            return Seen(None, None)
        places = of_other.changed[np.unique(np.linspace(0, n - 1, _SAMPLE).astype(int))]
        is_covered = one.plan.covers(places)
        in_its_place = one.scene.owner == (instance.partner or -1)
        is_seen = sees(one.plan.scanner, one.world, one.plan.path, places, in_its_place)
        return Seen(round(float(is_covered.mean()), 3), round(float((is_seen & is_covered).mean()), 3))

    return evidence.join(caught.swapped, seen)


def _of_item(item: Item) -> TruthInstance:
    return TruthInstance(
        item.instance_id,
        item.object_class,
        item.label,
        item.placed.thing.kind,
        Pair(item.before is not None, item.after is not None),
        Pair(0, 0),
        Pair(0, 0),
        Pair(None, None),
        item.edit,
        item.note,
        partner=item.partner,
    )


def _of_ground(ground: GroundItem) -> TruthInstance:
    return TruthInstance(
        ground.instance_id,
        ObjectClass.GROUND,
        ground.label,
        "ground",
        Pair(True, True),
        Pair(0, 0),
        Pair(0, 0),
        Pair(None, None),
        ground.edit,
        ground.note,
    )


def _passers(evidence: Pair[Evidence]) -> Iterator[TruthInstance]:
    """What passed by each survey (rule 3)."""
    for one, exists in zip(evidence, (Pair(True, False), Pair(False, True)), strict=True):
        first = len(one.scene.surface)
        for mover in one.scene.movers:
            yield TruthInstance(
                int(one.scene.owner[first]),
                ObjectClass.MOBILE,
                ChangeLabel(int(one.scene.change[first])),
                mover.kind,
                exists,
                Pair(0, 0),
                Pair(0, 0),
                Pair(None, None),
                "passing by",
                f"at {abs(mover.speed_m_s):.1f} m/s",
                excluded=MOVING,
            )
            first += len(mover.shape)


def _centre(points: FloatArray, T_map_street: FloatArray) -> tuple[float, float, float] | None:
    if not len(points):
        return None
    x, y, z = np.round(transform_points(T_map_street, points.mean(axis=0)[None])[0], 3).tolist()
    return x, y, z
