"""From labelled points to scores: the paper's protocol, the same by changed part, and the strict protocol.

paper   every annotated non-ground instance gets one predicted label or none: the label that most of its points carry,
        over the epochs in which it exists; ties, no points, and "undetermined" are no prediction (paper, section 4.4)
part    the same, but an instance of which only a part changed (a storey, an annex) is judged by the points of that part
strict  predicted changed objects that overlap no annotated changed instance are false alarms, per hectare; the
        paper's protocol cannot see them

Beside them stands how well the classes of points were told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from loda_pdal.benchmark.metrics import ClassScores, Scores, class_table, markdown_table
from loda_pdal.benchmark.runs import JudgedPoints, read_run
from loda_pdal.benchmark.truth import EVALUATED_CLASSES, Truth, TruthInstance
from loda_pdal.model.cloud import BoolArray, Int64Array
from loda_pdal.model.labels import ChangeLabel, ObjectClass

MIN_OVERLAP = 0.1
"""A predicted object overlaps an annotated instance when this share of its points belongs to it (or to several)."""

_N_CODES = len(ChangeLabel)


@dataclass(frozen=True)
class Judgement:
    """One annotated instance and what was predicted for it; `ChangeLabel.UNDETERMINED` is no prediction."""

    instance: TruthInstance
    predicted: ChangeLabel
    predicted_part: ChangeLabel


@dataclass(frozen=True)
class FalseAlarm:
    """A predicted changed object where nothing was annotated as changed; ``centre`` in map coordinates (m)."""

    object_id: int
    label: ChangeLabel
    n_points: int
    centre: tuple[float, float]


@dataclass(frozen=True)
class ScoreReport:
    """Everything the protocols say about one block, or about several together.

    Attributes
    ----------
    judgements : list of Judgement
        Every annotated instance, excluded ones and ground included.
    false_alarms : list of FalseAlarm
        Strict protocol.
    n_changed_objects : int
        Predicted changed objects that were judged; those on excluded instances alone are not.
    false_ground_m2 : float
        Area of 1 m cells in which most points are unchanged ground that was predicted to have changed.
    area_m2 : float
        Area of the blocks.
    classes : ClassScores
        Classes of the points of both epochs, of every annotated instance and of the ground.
    """

    judgements: list[Judgement]
    false_alarms: list[FalseAlarm]
    n_changed_objects: int
    false_ground_m2: float
    area_m2: float
    classes: ClassScores

    def scores(self, *, by_part: bool = False, object_class: ObjectClass | None = None) -> Scores:
        """Scores of the paper's protocol, or by changed part; of all non-ground instances, or of one class."""
        counted = [
            j
            for j in self.judgements
            if j.instance.excluded is None
            and (j.instance.is_evaluated if object_class is None else j.instance.object_class is object_class)
        ]
        predicted = [j.predicted_part if by_part else j.predicted for j in counted]
        return Scores.of([j.instance.label for j in counted], predicted)

    @property
    def false_alarms_per_ha(self) -> float:
        """False alarms per hectare."""
        return len(self.false_alarms) / (self.area_m2 / 1e4)

    @property
    def by_edit(self) -> dict[str, tuple[int, int, int]]:
        """Per kind of edit: evaluated instances, how many got the right label, and how many by changed part."""
        table: dict[str, tuple[int, int, int]] = {}
        for j in self.judgements:
            if j.instance.excluded is None and (j.instance.edit or j.instance.is_evaluated):
                kind, label = j.instance.edit or "none", j.instance.label
                n, right, right_part = table.get(kind, (0, 0, 0))
                table[kind] = (n + 1, right + (j.predicted == label), right_part + (j.predicted_part == label))
        return dict(sorted(table.items()))

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "paper": self.scores().to_dict(),
            "part": self.scores(by_part=True).to_dict(),
            "by_class": {c.title: self.scores(object_class=c).to_dict() for c in EVALUATED_CLASSES},
            "ground": self.scores(object_class=ObjectClass.GROUND).to_dict(),
            "by_edit": {k: {"n": n, "right": r, "right_part": p} for k, (n, r, p) in self.by_edit.items()},
            "strict": {
                "n_changed_objects": self.n_changed_objects,
                "n_false_alarms": len(self.false_alarms),
                "false_alarms_per_ha": self.false_alarms_per_ha,
                "false_ground_m2": self.false_ground_m2,
                "area_m2": self.area_m2,
                "false_alarms": [
                    {"object_id": a.object_id, "label": a.label.title, "n_points": a.n_points, "centre": list(a.centre)}
                    for a in self.false_alarms
                ],
            },
            "classes": self.classes.to_dict(),
            "n_excluded": sum(j.instance.excluded is not None for j in self.judgements),
            "instances": [
                {
                    "instance_id": j.instance.instance_id,
                    "object_class": j.instance.object_class.title,
                    "kind": j.instance.kind,
                    "edit": j.instance.edit,
                    "label": j.instance.label.title,
                    "predicted": _title(j.predicted),
                    "predicted_part": _title(j.predicted_part),
                    "excluded": j.instance.excluded,
                }
                for j in self.judgements
            ],
        }

    def to_markdown(self) -> str:
        """The tables of a report, in per cent."""
        classes = [(c.title, self.scores(object_class=c)) for c in (*EVALUATED_CLASSES, ObjectClass.GROUND)]
        part = self.scores(by_part=True)
        n_excluded = sum(j.instance.excluded is not None for j in self.judgements)
        return "\n\n".join(
            [
                "## Paper protocol",
                self.scores().to_markdown(),
                f"{n_excluded} instances are excluded from all scores.",
                "## By changed part",
                part.to_markdown(),
                "## By class",
                markdown_table(
                    ["class", "n", "ACC", "mF1", "mIoU"],
                    [[name, s.n, s.accuracy, s.macro_f1, s.macro_iou] for name, s in classes],
                ),
                "## By kind of edit",
                markdown_table(
                    ["edit", "n", "right label", "right by part"], [[k, *row] for k, row in self.by_edit.items()]
                ),
                "## Strict protocol",
                markdown_table(
                    ["changed objects", "false alarms", "per hectare", "false ground change, m2", "area, ha"],
                    [
                        [
                            self.n_changed_objects,
                            len(self.false_alarms),
                            f"{self.false_alarms_per_ha:.1f}",
                            f"{self.false_ground_m2:.0f}",
                            f"{self.area_m2 / 1e4:.2f}",
                        ]
                    ],
                ),
                "## Classes of points",
                self.classes.to_markdown(),
            ]
        )


def score_run(run_dir: Path, truth_path: Path) -> ScoreReport:
    """Scores of a run folder against a truth file."""
    truth = Truth.read(Path(truth_path))
    return judge(read_run(Path(run_dir), truth, Path(truth_path).parent), truth)


def combined(reports: Sequence[ScoreReport]) -> ScoreReport:
    """Several blocks as one: scores are computed after pooling their instances (paper, section 4.4)."""
    return ScoreReport(
        [j for r in reports for j in r.judgements],
        [a for r in reports for a in r.false_alarms],
        sum(r.n_changed_objects for r in reports),
        sum(r.false_ground_m2 for r in reports),
        sum(r.area_m2 for r in reports),
        ClassScores(sum((r.classes.table for r in reports), class_table([], []))),
    )


def judge(points: JudgedPoints, truth: Truth) -> ScoreReport:
    """All protocols at once."""
    false_alarms, n_objects = _false_alarms(points, truth)
    return ScoreReport(
        judge_instances(points, truth),
        false_alarms,
        n_objects,
        _false_ground_m2(points),
        truth.area_m2,
        judge_classes(points, truth),
    )


def judge_instances(points: JudgedPoints, truth: Truth) -> list[Judgement]:
    """Predicted label of every annotated instance, as a whole and by its changed part."""
    n_ids = max(truth.by_id, default=0) + 1
    exists = np.zeros((n_ids, 2), dtype=bool)
    is_partly_changed = np.zeros(n_ids, dtype=bool)
    for i in truth.instances:
        exists[i.instance_id] = i.exists.before, i.exists.after
        is_partly_changed[i.instance_id] = i.is_changed and i.exists.before and i.exists.after
    is_known = points.truth_id < n_ids
    is_counted = is_known & (points.change < _N_CODES)
    is_counted[is_known] &= exists[points.truth_id[is_known], points.epoch[is_known]]
    is_in_part = is_counted & (points.truth_change != ChangeLabel.UNCHANGED)
    is_in_part[is_counted] |= ~is_partly_changed[points.truth_id[is_counted]]
    whole, part = _votes(points, is_counted, n_ids), _votes(points, is_in_part, n_ids)
    return [Judgement(i, majority(whole[i.instance_id]), majority(part[i.instance_id])) for i in truth.instances]


def judge_classes(points: JudgedPoints, truth: Truth) -> ClassScores:
    """Predicted against true classes, point by point; what belongs to no instance is ground."""
    classes = np.full(int(points.truth_id.max(initial=max(truth.by_id, default=0))) + 1, ObjectClass.GROUND)
    for i in truth.instances:
        classes[i.instance_id] = i.object_class
    return ClassScores(class_table(classes[points.truth_id], points.classification))


def majority(votes: Int64Array) -> ChangeLabel:
    """The label with most ``votes`` (6,), by code; `ChangeLabel.UNDETERMINED` for a tie or no votes at all."""
    most = int(votes.max())
    winners = np.flatnonzero(votes == most)
    return ChangeLabel(int(winners[0])) if most > 0 and len(winners) == 1 else ChangeLabel.UNDETERMINED


def _votes(points: JudgedPoints, is_counted: BoolArray, n_ids: int) -> Int64Array:
    """How many points of each instance carry each label, (n_ids, 6)."""
    keys = points.truth_id[is_counted] * _N_CODES + points.change[is_counted]
    return np.asarray(np.bincount(keys, minlength=n_ids * _N_CODES).reshape(n_ids, _N_CODES))


def _is_change(codes: Int64Array) -> BoolArray:
    return np.asarray((codes > ChangeLabel.UNCHANGED) & (codes < _N_CODES))


def _false_alarms(points: JudgedPoints, truth: Truth) -> tuple[list[FalseAlarm], int]:
    """Changed objects that overlap no annotated changed instance, and the number of changed objects judged.

    An object that overlaps excluded instances only is neither right nor wrong.
    """
    is_of_object = (points.object > 0) & _is_change(points.change.astype(np.int64))
    ids, place = np.unique(points.object[is_of_object], return_inverse=True)
    change = points.change[is_of_object].astype(np.int64)
    xy, truth_id = points.xyz[is_of_object, :2], points.truth_id[is_of_object]
    changed = [i.instance_id for i in truth.instances if i.is_changed and i.excluded is None]
    excluded = [i.instance_id for i in truth.instances if i.excluded is not None]
    n_points = np.bincount(place, minlength=len(ids))
    on_changed = np.bincount(place[np.isin(truth_id, changed)], minlength=len(ids))
    on_excluded = np.bincount(place[np.isin(truth_id, excluded)], minlength=len(ids))
    labels = np.bincount(place * _N_CODES + change, minlength=len(ids) * _N_CODES).reshape(len(ids), _N_CODES)
    is_right = on_changed >= MIN_OVERLAP * n_points
    is_judged = is_right | (on_excluded < MIN_OVERLAP * n_points)
    alarms = [
        FalseAlarm(
            int(ids[o]),
            ChangeLabel(int(labels[o].argmax())),
            int(n_points[o]),
            (round(float(xy[place == o, 0].mean()), 2), round(float(xy[place == o, 1].mean()), 2)),
        )
        for o in np.flatnonzero(is_judged & ~is_right)
    ]
    return alarms, int(is_judged.sum())


def _false_ground_m2(points: JudgedPoints) -> float:
    """Area of the 1 m cells in which most points of unchanged ground carry a change and belong to no object."""
    is_ground = (points.truth_id == 0) & (points.object == 0)
    if not is_ground.any():
        return 0.0
    cells, place = np.unique(np.floor(points.xyz[is_ground, :2]).astype(np.int64), axis=0, return_inverse=True)
    is_false = _is_change(points.change[is_ground].astype(np.int64))
    n, n_false = (
        np.bincount(place.ravel(), minlength=len(cells)),
        np.bincount(place.ravel()[is_false], minlength=len(cells)),
    )
    return float(np.count_nonzero(2 * n_false > n))


def _title(label: ChangeLabel) -> str | None:
    return None if label is ChangeLabel.UNDETERMINED else label.title
