"""Confidence that means what it says: fit the calibration of a preset on simulated training blocks (METHOD 3).

A label is right when most points of its object belong to instances with that label; Increased and Decreased are right
as well where the surface that changed within the object changed that way (a part of a house, METHOD 2b). Points of
excluded instances do not vote, and objects that lie mostly on them are left out. The share of right labels is fitted
as a logistic function of the raw score, for three kinds of labels; validation blocks then tell how far it is off.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from loda_pdal.benchmark.evaluate import (
    Say,
    described,
    naming,
    prepared_blocks,
    read_block,
    read_stamp,
    version_of,
    write_stamp,
)
from loda_pdal.benchmark.metrics import markdown_table
from loda_pdal.benchmark.runs import JudgedPoints, judged_result
from loda_pdal.benchmark.truth import Truth
from loda_pdal.model.cloud import BoolArray, FloatArray
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.records import ObjectRecord
from loda_pdal.params import Parameters
from loda_pdal.pipeline import detect_changes

KINDS = {
    ChangeLabel.ADDED: "calibration_unmatched",
    ChangeLabel.REMOVED: "calibration_unmatched",
    ChangeLabel.INCREASED: "calibration_changed",
    ChangeLabel.DECREASED: "calibration_changed",
    ChangeLabel.UNCHANGED: "calibration_unchanged",
}
"""The parameter of `ConfidenceParams` that calibrates each label."""

MIN_SHARE = 0.5
"""Share of an object's points that must belong to instances with its label; and of its points that must lie on
instances that count."""

MIN_CHANGED_SHARE = 0.1
"""Share of an object's points that must lie on surface that changed as its label says."""

N_BINS = 10
"""Bins of equal width that confidences are told apart by."""

N_DRAWS = 200
"""Draws of what chance alone makes of the calibration error."""

_PRIOR = 1.0
"""Weight of the prior that keeps the slope finite where all labels are right, in objects."""

Lines = dict[str, tuple[float, float]]
"""Logistic offset and slope by the parameter that holds them."""


class Judged(NamedTuple):
    """One labelled object: the parameter that calibrates its label, its raw score, and whether the label is right."""

    kind: str
    raw: float
    is_right: bool


class Bin(NamedTuple):
    """Objects with a confidence between two bounds: how many, their mean confidence, and the share that is right."""

    low: float
    high: float
    n: int
    confidence: float
    share_right: float


@dataclass(frozen=True)
class Reliability:
    """What confidences are worth on objects whose truth is known.

    Attributes
    ----------
    n : int
        Objects.
    error : float
        Expected calibration error: mean gap between confidence and the share that is right, over the bins.
    chance : float
        The error that exact confidences would show, on average, with as many objects.
    bins : list of Bin
        Those that hold objects.
    """

    n: int
    error: float
    chance: float
    bins: list[Bin]

    @classmethod
    def of(cls, confidence: FloatArray, is_right: BoolArray) -> Reliability:
        """The reliability of ``confidence`` (n,) of labels that are right or not (n,)."""
        random = np.random.default_rng(1)
        draws = random.random((N_DRAWS, len(confidence))) < confidence
        chance = float(np.mean([calibration_error(confidence, draw) for draw in draws])) if len(confidence) else np.nan
        which = _bin_of(confidence)
        bins = [
            Bin(b / N_BINS, (b + 1) / N_BINS, int(inside.sum()), confidence[inside].mean(), is_right[inside].mean())
            for b in range(N_BINS)
            if (inside := which == b).any()
        ]
        return cls(len(confidence), calibration_error(confidence, is_right), chance, bins)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {"n": self.n, "error": self.error, "chance": self.chance, "bins": [b._asdict() for b in self.bins]}

    def to_markdown(self) -> str:
        """The bins as a table."""
        rows = [[f"{b.low:.1f} to {b.high:.1f}", b.n, float(b.confidence), float(b.share_right)] for b in self.bins]
        return markdown_table(["confidence", "objects", "mean confidence, %", "right, %"], rows)


@dataclass(frozen=True)
class Calibration:
    """Fitted offsets and slopes, and how they and the present ones do.

    Attributes
    ----------
    title : str
        What was run on what.
    values, present : dict
        ``(offset, slope)`` of each calibration parameter, fitted and as the parameters have them.
    train, validation : list of Judged
        Objects of the blocks of each split.
    """

    title: str
    values: Lines
    present: Lines
    train: list[Judged]
    validation: list[Judged]

    def reliability(self, split: str, lines: Lines, kind: str | None = None) -> Reliability:
        """What ``lines`` are worth on the objects of a split, or on those of one kind among them."""
        judged = [j for j in getattr(self, split) if kind in (None, j.kind)]
        return Reliability.of(confidences(judged, lines), np.array([j.is_right for j in judged], dtype=np.bool_))

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "title": self.title,
            "values": self.values,
            "present": self.present,
            **{
                split: {
                    "fitted": self.reliability(split, self.values).to_dict(),
                    "present": self.reliability(split, self.present).to_dict(),
                    "by_kind": {kind: self.reliability(split, self.values, kind).to_dict() for kind in self.values},
                }
                for split in ("train", "validation")
            },
        }

    def to_markdown(self) -> str:
        """The fitted parameters, the calibration errors, and the reliability on validation blocks."""
        rows = []
        for split in ("train", "validation"):
            for kind in (None, *self.values):
                fitted, present = (self.reliability(split, lines, kind) for lines in (self.values, self.present))
                name = "all" if kind is None else kind.removeprefix("calibration_")
                errors = (f"{error:.3f}" for error in (fitted.error, present.error, fitted.chance))
                rows.append([split, name, fitted.n, *errors])
        values = "\n".join(f"    confidence.{name} = [{a}, {b}]" for name, (a, b) in self.values.items())
        return "\n\n".join(
            [
                f"# Calibration on {self.title}",
                f"Fitted on the training blocks:\n\n{values}",
                "## Expected calibration error",
                markdown_table(["split", "labels", "objects", "fitted", "as it is", "by chance"], rows),
                "## Reliability on validation blocks",
                self.reliability("validation", self.values).to_markdown(),
            ]
        )


def calibrate(
    folder: Path,
    suite: str,
    parameters: Parameters,
    *,
    models: Path | None = None,
    limit: int | None = None,
    say: Say = lambda text: None,
) -> Calibration:
    """Fit the confidence of ``parameters`` on the training blocks of a suite and check it on its validation blocks.

    What was found on a block is kept in ``FOLDER/NAME/calibration.json``, so that an interrupted fit goes on where it
    was; arguments as for `run_suite`.
    """
    judged: dict[str, list[Judged]] = {"train": [], "validation": []}
    n_blocks = dict.fromkeys(judged, 0)
    for split, found in judged.items():
        for name, block_dir in prepared_blocks(folder, suite, split, models=models, limit=limit, say=say):
            found += _judged_block(block_dir, parameters, name, say)
            n_blocks[split] += 1
    title = (
        f"suite {suite}: {n_blocks['train']} training and {n_blocks['validation']} validation blocks, "
        f"{described(parameters)}"
    )
    return Calibration(title, fit(judged["train"]), present_lines(parameters), judged["train"], judged["validation"])


def judged_objects(points: JudgedPoints, truth: Truth, objects: Sequence[ObjectRecord]) -> list[Judged]:
    """Whether the label of each object is right, for those with a confidence that the truth can judge."""
    n_objects = max((o.object_id for o in objects), default=0) + 1
    n_ids = int(points.truth_id.max(initial=max(truth.by_id, default=0))) + 1
    of_instance = np.full(n_ids, ChangeLabel.UNCHANGED, dtype=np.uint8)
    is_excluded = np.zeros(n_ids, dtype=np.bool_)
    for instance in truth.instances:
        of_instance[instance.instance_id] = instance.label
        is_excluded[instance.instance_id] = instance.excluded is not None
    counts = ~is_excluded[points.truth_id]
    by_instance = _votes(points.object[counts], of_instance[points.truth_id[counts]], n_objects)
    by_surface = _votes(points.object[counts], points.truth_change[counts], n_objects)
    n_points = np.bincount(points.object, minlength=n_objects)
    judged = []
    for record in objects:
        votes, changed = by_instance[record.object_id], by_surface[record.object_id]
        is_on_excluded = votes.sum() <= MIN_SHARE * n_points[record.object_id]
        if record.confidence_raw is None or record.label not in KINDS or is_on_excluded:
            continue
        is_right = bool(votes[record.label] >= MIN_SHARE * votes.sum())
        if record.label in (ChangeLabel.INCREASED, ChangeLabel.DECREASED):
            share = changed[record.label] / changed.sum()
            is_right |= bool(share >= MIN_CHANGED_SHARE and changed[record.label] == changed[ChangeLabel.ADDED :].max())
        judged.append(Judged(KINDS[record.label], record.confidence_raw, is_right))
    return judged


def fit(judged: Sequence[Judged]) -> Lines:
    """The logistic curve of each kind of label."""
    kinds = dict.fromkeys(KINDS.values())
    return {
        kind: logistic([j.raw for j in judged if j.kind == kind], [j.is_right for j in judged if j.kind == kind])
        for kind in kinds
    }


def present_lines(parameters: Parameters) -> Lines:
    """The curves that parameters have."""
    lines = {}
    for kind in dict.fromkeys(KINDS.values()):
        offset, slope = getattr(parameters.confidence, kind)
        lines[kind] = (offset, slope)
    return lines


def confidences(judged: Sequence[Judged], lines: Lines) -> FloatArray:
    """Confidence (n,) of each object."""
    score = [lines[j.kind][0] + lines[j.kind][1] * j.raw for j in judged]
    return np.asarray(1.0 / (1.0 + np.exp(-np.array(score, dtype=np.float64))))


def logistic(raw: list[float], is_right: list[bool]) -> tuple[float, float]:
    """Offset and slope of the most likely logistic curve; the slope is never negative."""
    x, y = np.array(raw, dtype=np.float64), np.array(is_right, dtype=np.float64)

    def loss(line: FloatArray) -> float:
        z = line[0] + line[1] * x
        prior = _PRIOR * ((line[0] / 3.0) ** 2 + (line[1] / 6.0) ** 2) / 2.0
        return float(np.sum(np.logaddexp(0.0, z) - y * z) + prior)

    found = minimize(loss, np.array([0.0, 1.0]), bounds=[(-20.0, 20.0), (0.0, 40.0)])
    return round(float(found.x[0]), 2), round(float(found.x[1]), 2)


def calibration_error(confidence: FloatArray, is_right: BoolArray) -> float:
    """Expected calibration error: mean gap between confidence and the share that is right, over bins of confidence."""
    if len(confidence) == 0:
        return float("nan")
    which = _bin_of(confidence)
    gap = np.bincount(which, confidence, N_BINS) - np.bincount(which, is_right, N_BINS)
    return float(np.abs(gap).sum() / len(confidence))


def _bin_of(confidence: FloatArray) -> npt.NDArray[np.int64]:
    return np.minimum((confidence * N_BINS).astype(np.int64), N_BINS - 1)


def _votes(objects: npt.NDArray[Any], labels: npt.NDArray[Any], n_objects: int) -> npt.NDArray[Any]:
    """Points of each object by label, (n_objects, 6)."""
    n_labels = len(ChangeLabel)
    keys = objects.astype(np.int64) * n_labels + labels
    return np.asarray(np.bincount(keys, minlength=n_objects * n_labels).reshape(n_objects, n_labels))


def _judged_block(block_dir: Path, parameters: Parameters, name: str, say: Say) -> list[Judged]:
    """The judged objects of a block, from the file beside it where it is of the same method and parameters."""
    path = block_dir / "calibration.json"
    version = json.dumps(parameters.to_dict(), sort_keys=True) + version_of(block_dir)
    known = read_stamp(path) or {}
    if known.get("version") != version:
        say(f"{name}: running")
        block = read_block(block_dir)
        with naming(name):
            result = detect_changes(block.surveys.before, block.surveys.after, parameters)
        points = judged_result(result, block.annotation, block.truth.T_after_before)
        known = {"version": version, "objects": judged_objects(points, block.truth, result.objects)}
        write_stamp(path, known)
    return [Judged(*row) for row in known["objects"]]
