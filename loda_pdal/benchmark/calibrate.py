"""Confidence that means what it says: fit the calibration of a preset on simulated training blocks (METHOD 3).

A label is right when most points of its object belong to instances with that label; Increased and Decreased are right
as well where the surface that changed within the object changed that way (a part of a house, METHOD 2b). The share of
right labels is fitted as a logistic function of the raw score, for three kinds of labels; validation blocks then tell
how far it is off.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from loda_pdal.benchmark.blocks import split_of_name
from loda_pdal.benchmark.simulate import SimulatedBlock, SimulationOptions, simulate_block
from loda_pdal.model.cloud import BoolArray, FloatArray
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import ChangeResult
from loda_pdal.model.survey import Survey
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
"""Share of an object's points that must belong to instances with its label."""

MIN_CHANGED_SHARE = 0.1
"""Share of an object's points that must lie on surface that changed as its label says."""

_PRIOR = 1.0
"""Weight of the prior that keeps the slope finite where all labels are right, in objects."""


class Judged(NamedTuple):
    """One labelled object: the block it is from, its parameter, raw and calibrated score, and whether it is right."""

    seed: int
    kind: str
    raw: float
    confidence: float
    is_right: bool


@dataclass(frozen=True)
class Calibration:
    """Fitted offsets and slopes by parameter, and how they do on blocks they have not seen.

    Attributes
    ----------
    values : dict
        ``(offset, slope)`` of each calibration parameter.
    n_train, n_validation : int
        Objects.
    error_train, error_validation : float
        Expected calibration error in ten bins of equal width.
    """

    values: dict[str, tuple[float, float]]
    n_train: int
    n_validation: int
    error_train: float
    error_validation: float


def judge_blocks(seeds: Iterable[int], parameters: Parameters) -> Iterator[Judged]:
    """Labelled objects of the training and validation blocks among ``seeds``; test blocks are passed over."""
    for seed in seeds:
        if split_of_name(f"seed {seed}") == "test":
            continue
        block = simulate_block(seed, SimulationOptions())
        surveys = surveys_of(block)
        yield from judged_objects(seed, block, detect_changes(surveys.before, surveys.after, parameters))


def surveys_of(block: SimulatedBlock) -> Pair[Survey]:
    """Both surveys of a simulated block, as a reader would give them."""
    low = np.floor(block.surveys.after.xyz.min(axis=0) / 1000.0) * 1000
    frame = LocalFrame((int(low[0]), int(low[1]), 0))
    return block.surveys.map(lambda survey: Survey(frame.to_local(survey.xyz), frame))


def judged_objects(seed: int, block: SimulatedBlock, result: ChangeResult) -> list[Judged]:
    """Whether each labelled object of a result is right."""
    n = max((o.object_id for o in result.objects), default=0) + 1
    of_instance = np.full(max(i.instance_id for i in block.truth.instances) + 1, ChangeLabel.UNCHANGED, dtype=np.uint8)
    for instance in block.truth.instances:
        of_instance[instance.instance_id] = instance.label
    by_instance, by_surface = np.zeros((n, len(ChangeLabel))), np.zeros((n, len(ChangeLabel)))
    for survey, points in zip(block.surveys, result.points, strict=True):
        np.add.at(by_instance, (points.object, of_instance[survey.truth_id]), 1)
        np.add.at(by_surface, (points.object, survey.truth_change), 1)
    judged = []
    for record in result.objects:
        if record.confidence is None or record.confidence_raw is None:
            continue
        instance_votes, surface_votes = by_instance[record.object_id], by_surface[record.object_id]
        is_right = bool(instance_votes[record.label] >= MIN_SHARE * instance_votes.sum())
        if record.label in (ChangeLabel.INCREASED, ChangeLabel.DECREASED):
            share = surface_votes[record.label] / max(surface_votes.sum(), 1)
            is_right |= bool(share >= MIN_CHANGED_SHARE and surface_votes[record.label] == surface_votes[2:].max())
        judged.append(Judged(seed, KINDS[record.label], record.confidence_raw, record.confidence, is_right))
    return judged


def fit(judged: list[Judged]) -> Calibration:
    """Logistic calibration from the objects of training blocks, checked on those of validation blocks."""
    train = [j for j in judged if split_of_name(f"seed {j.seed}") == "train"]
    unseen = [j for j in judged if split_of_name(f"seed {j.seed}") == "validation"]
    values = {}
    for kind in dict.fromkeys(KINDS.values()):
        own = [j for j in train if j.kind == kind]
        values[kind] = logistic([j.raw for j in own], [j.is_right for j in own])
    return Calibration(values, len(train), len(unseen), _error(train, values), _error(unseen, values))


def logistic(raw: list[float], is_right: list[bool]) -> tuple[float, float]:
    """Offset and slope of the most likely logistic curve; the slope is never negative."""
    x, y = np.array(raw, dtype=np.float64), np.array(is_right, dtype=np.float64)

    def loss(line: FloatArray) -> float:
        z = line[0] + line[1] * x
        prior = _PRIOR * ((line[0] / 3.0) ** 2 + (line[1] / 6.0) ** 2) / 2.0
        return float(np.sum(np.logaddexp(0.0, z) - y * z) + prior)

    found = minimize(loss, np.array([0.0, 1.0]), bounds=[(-20.0, 20.0), (0.0, 40.0)])
    return round(float(found.x[0]), 2), round(float(found.x[1]), 2)


def calibration_error(confidence: npt.NDArray[np.float64], is_right: BoolArray, bins: int = 10) -> float:
    """Expected calibration error: mean gap between confidence and the share that is right, over bins of confidence."""
    if len(confidence) == 0:
        return float("nan")
    which = np.minimum((confidence * bins).astype(np.int64), bins - 1)
    gap = 0.0
    for index in range(bins):
        inside = which == index
        if inside.any():
            gap += inside.mean() * abs(float(confidence[inside].mean()) - float(is_right[inside].mean()))
    return float(gap)


def _error(judged: list[Judged], values: dict[str, tuple[float, float]]) -> float:
    confidence = np.array([1 / (1 + np.exp(-(values[j.kind][0] + values[j.kind][1] * j.raw))) for j in judged])
    return calibration_error(confidence, np.array([j.is_right for j in judged], dtype=np.bool_))
