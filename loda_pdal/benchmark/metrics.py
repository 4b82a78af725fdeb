"""Scores of labelled instances: confusion table, accuracy, IoU and F1 per label (paper, section 4.4); and IoU of the
classes of points."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from loda_pdal.model.cloud import Int64Array
from loda_pdal.model.labels import ChangeLabel, ObjectClass

LABELS = (
    ChangeLabel.ADDED,
    ChangeLabel.REMOVED,
    ChangeLabel.INCREASED,
    ChangeLabel.DECREASED,
    ChangeLabel.UNCHANGED,
)
"""Rows and columns of every table, in the paper's order; a sixth column counts instances without a prediction."""

NO_PREDICTION = ChangeLabel.UNDETERMINED
"""What stands for "no prediction" among labels."""


def confusion_table(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> Int64Array:
    """How often each true label was given each predicted one.

    Parameters
    ----------
    truth : (n,) int
        `ChangeLabel` codes 1 to 5.
    predicted : (n,) int
        `ChangeLabel` codes; 0 where there is no prediction.

    Returns
    -------
    (5, 6) int64
        Rows are truth, columns prediction, in the order of `LABELS`, then no prediction.
    """
    place = np.zeros(len(ChangeLabel), dtype=np.int64)
    place[[NO_PREDICTION, *LABELS]] = [len(LABELS), *range(len(LABELS))]
    rows, columns = place[np.asarray(truth, dtype=np.int64)], place[np.asarray(predicted, dtype=np.int64)]
    table = np.bincount(rows * 6 + columns, minlength=36).reshape(6, 6)
    return table[: len(LABELS)]


@dataclass(frozen=True)
class LabelScore:
    """How well one label was told: counts and the ratios made of them (None where there is nothing to divide by)."""

    label: ChangeLabel
    tp: int
    fp: int
    fn: int

    @property
    def iou(self) -> float | None:
        return _ratio(self.tp, self.tp + self.fp + self.fn)

    @property
    def f1(self) -> float | None:
        return _ratio(2 * self.tp, 2 * self.tp + self.fp + self.fn)

    @property
    def precision(self) -> float | None:
        return _ratio(self.tp, self.tp + self.fp)

    @property
    def recall(self) -> float | None:
        return _ratio(self.tp, self.tp + self.fn)

    @property
    def n_true(self) -> int:
        """Instances that truly have this label."""
        return self.tp + self.fn


@dataclass(frozen=True)
class Scores:
    """Scores of a set of instances.

    Attributes
    ----------
    confusion : (5, 6) int64
        As `confusion_table` returns it.
    """

    confusion: Int64Array

    @staticmethod
    def of(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> Scores:
        """Scores of predictions; arguments as for `confusion_table`."""
        return Scores(confusion_table(truth, predicted))

    @property
    def n(self) -> int:
        """Instances evaluated."""
        return int(self.confusion.sum())

    @property
    def accuracy(self) -> float | None:
        """ACC: true positives over all instances; one without a prediction counts as wrong."""
        return _ratio(int(np.trace(self.confusion)), self.n)

    @property
    def labels(self) -> list[LabelScore]:
        """Per label, in the order of `LABELS`."""
        square = self.confusion[:, : len(LABELS)]
        return [
            LabelScore(
                label,
                tp=int(square[i, i]),
                fp=int(square[:, i].sum() - square[i, i]),
                fn=int(self.confusion[i].sum() - square[i, i]),
            )
            for i, label in enumerate(LABELS)
        ]

    @property
    def macro_iou(self) -> float | None:
        """Plain mean of IoU over the labels; one that is neither true nor predicted anywhere does not take part."""
        return _mean(score.iou for score in self.labels)

    @property
    def macro_f1(self) -> float | None:
        """Plain mean of F1 over the labels, as for `macro_iou`."""
        return _mean(score.f1 for score in self.labels)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; None where undefined."""
        return {
            "n": self.n,
            "acc": self.accuracy,
            "macro_f1": self.macro_f1,
            "macro_iou": self.macro_iou,
            "labels": {
                s.label.title: {
                    "n": s.n_true,
                    "tp": s.tp,
                    "fp": s.fp,
                    "fn": s.fn,
                    "iou": s.iou,
                    "f1": s.f1,
                    "precision": s.precision,
                    "recall": s.recall,
                }
                for s in self.labels
            },
            "confusion": {
                "rows_truth": [label.title for label in LABELS],
                "columns_predicted": [*(label.title for label in LABELS), "none"],
                "counts": self.confusion.tolist(),
            },
        }

    def to_markdown(self) -> str:
        """Two tables: the scores in per cent, and the confusion table."""
        summary = markdown_table(
            ["n", "ACC", "mF1", "mIoU", *(f"{label.title} IoU" for label in LABELS)],
            [[self.n, self.accuracy, self.macro_f1, self.macro_iou, *(s.iou for s in self.labels)]],
        )
        confusion = markdown_table(
            ["truth \\ predicted", *(label.title for label in LABELS), "none"],
            [[label.title, *row] for label, row in zip(LABELS, self.confusion.tolist(), strict=True)],
        )
        return f"{summary}\n\n{confusion}"


CLASSES = (
    ObjectClass.GROUND,
    ObjectClass.BUILDING,
    ObjectClass.VEGETATION,
    ObjectClass.MOBILE,
    ObjectClass.OTHER,
)
"""Rows and columns of the table of classes; a last column counts points of any other class."""


def class_table(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> Int64Array:
    """How often points of each true class were given each predicted one.

    Parameters
    ----------
    truth, predicted : (n,) int
        `ObjectClass` codes, 0 to 255; points whose true class is none of `CLASSES` are not counted.

    Returns
    -------
    (5, 6) int64
        Rows are truth, columns prediction, in the order of `CLASSES`, then anything else.
    """
    n = len(CLASSES)
    place = np.full(256, n)
    place[list(CLASSES)] = np.arange(n)
    place[[3, 4]] = place[ObjectClass.VEGETATION]  # ASPRS tells low and medium vegetation apart
    rows, columns = place[np.asarray(truth, dtype=np.int64)], place[np.asarray(predicted, dtype=np.int64)]
    return np.bincount(rows * (n + 1) + columns, minlength=(n + 1) ** 2).reshape(n + 1, n + 1)[:n]


@dataclass(frozen=True)
class ClassScores:
    """Scores of the classes of points.

    Attributes
    ----------
    table : (5, 6) int64
        As `class_table` returns it.
    """

    table: Int64Array

    def iou(self, object_class: ObjectClass) -> float | None:
        """Intersection over union of one class; None where no point truly has it."""
        tp, fp, fn = self._counts(object_class)
        return _ratio(tp, tp + fp + fn) if tp + fn else None

    def f1(self, object_class: ObjectClass) -> float | None:
        """F1 of one class; None where no point truly has it."""
        tp, fp, fn = self._counts(object_class)
        return _ratio(2 * tp, 2 * tp + fp + fn) if tp + fn else None

    @property
    def macro_iou(self) -> float | None:
        """Plain mean over the paper's classes (all but other) that some point truly has."""
        return _mean(self.iou(c) for c in CLASSES if c is not ObjectClass.OTHER)

    def _counts(self, object_class: ObjectClass) -> tuple[int, int, int]:
        i = CLASSES.index(object_class)
        tp = int(self.table[i, i])
        return tp, int(self.table[:, i].sum()) - tp, int(self.table[i].sum()) - tp

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "macro_iou": self.macro_iou,
            "classes": {c.title: {"iou": self.iou(c), "f1": self.f1(c)} for c in CLASSES},
            "confusion": {
                "rows_truth": [c.title for c in CLASSES],
                "columns_predicted": [*(c.title for c in CLASSES), "none"],
                "counts": self.table.tolist(),
            },
        }

    def to_markdown(self) -> str:
        """IoU of each class, and where the points of each class went, in per cent."""
        header = ["points", "mean IoU", *(f"{c.title} IoU" for c in CLASSES)]
        scores = [int(self.table.sum()), self.macro_iou, *(self.iou(c) for c in CLASSES)]
        shares = [
            [c.title, *(float(n) / max(int(row.sum()), 1) for n in row)]
            for c, row in zip(CLASSES, self.table, strict=True)
        ]
        went = markdown_table(["truth \\ predicted, %", *(c.title for c in CLASSES), "none"], shares)
        return f"{markdown_table(header, [scores])}\n\n{went}"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A Markdown table; fractions are written in per cent with one decimal, None as a dash."""
    lines = [header, ["---"] * len(header), *([_cell(value) for value in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{100 * value:.1f}" if isinstance(value, float) else str(value)


def _ratio(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None
