"""Ground, buildings and vegetation against the labels of real airborne clouds (ASPRS codes of their suppliers).

ground (0.2 m)   points within 0.2 m of the ground model, against class 2: how good the model is
ground, building, vegetation   the class that the method gives, point by point, against classes 2, 6, and 4 with 5

Suppliers differ: AHN has no class of vegetation (it is in class 1 with everything else), and what is water, a bridge,
noise, or made by the supplier is left out. Low vegetation (3) lies below the height from which ours counts, and is left
out of vegetation only. Every other point that truly is something else counts as an error where it is given a class.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from loda_pdal.benchmark.metrics import markdown_table
from loda_pdal.io.las import read_epochs
from loda_pdal.model.cloud import BoolArray, ByteArray, FloatArray
from loda_pdal.model.errors import InputError
from loda_pdal.model.labels import ObjectClass
from loda_pdal.params import Parameters
from loda_pdal.pipeline import (
    classify_superpoints,
    form_superpoints,
    fuse_epochs,
    model_ground,
    resolve,
    segment_instances,
)

GROUND_DISTANCE_M = 0.2

LEFT_OUT = (7, 9, 17, 18, 26, 65, 66)
"""Codes that are no part of the comparison: noise, water, bridges (26 in AHN), artefacts and virtual points (IGN)."""

_GROUND, _BUILDING, _LOW, _VEGETATION = 2, 6, 3, (4, 5)


@dataclass(frozen=True)
class Agreement:
    """How often a class was given and true, given and not true, true and not given."""

    tp: int
    fp: int
    fn: int

    @classmethod
    def of(cls, truth: BoolArray, predicted: BoolArray) -> Agreement:
        """Of points (n,)."""
        return cls(int((truth & predicted).sum()), int((~truth & predicted).sum()), int((truth & ~predicted).sum()))

    @property
    def f1(self) -> float | None:
        """F1; None where no point truly has the class."""
        return 2 * self.tp / (2 * self.tp + self.fp + self.fn) if self.tp + self.fn else None

    @property
    def precision(self) -> float | None:
        """Of the points that were given the class; None as for `f1`."""
        return self.tp / max(self.tp + self.fp, 1) if self.tp + self.fn else None

    @property
    def recall(self) -> float | None:
        """Of the points that have the class; None where there are none."""
        return self.tp / (self.tp + self.fn) if self.tp + self.fn else None


@dataclass(frozen=True)
class LabelledCloud:
    """One cloud: its name, the points compared, and agreement by class."""

    name: str
    n_points: int
    ground_model: Agreement
    ground: Agreement
    building: Agreement
    vegetation: Agreement

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        kinds = {k: getattr(self, k) for k in _KINDS}
        scores = {k: {"f1": a.f1, "precision": a.precision, "recall": a.recall} for k, a in kinds.items()}
        return {"name": self.name, "n_points": self.n_points, **scores}


_KINDS = ("ground_model", "ground", "building", "vegetation")


def compare_labels(path: Path, parameters: Parameters, left_out: Collection[int] = LEFT_OUT) -> LabelledCloud:
    """What the method makes of one classified cloud, against its classes.

    Parameters
    ----------
    path : Path
        LAS, LAZ or COPC with ASPRS classes.
    parameters : Parameters
        Of the method.
    left_out : collection of int
        Codes of points that are not compared.
    """
    import laspy

    truth = np.asarray(laspy.read(path).classification, dtype=np.uint8)
    if not np.any(truth == _GROUND):
        raise InputError(f"{path} has no point of class 2.", "Give a cloud that is classified.", "not-classified")
    predicted, height = classes_and_heights(path, parameters)
    is_compared = ~np.isin(truth, list(left_out))
    truth, predicted, height = truth[is_compared], predicted[is_compared], height[is_compared]
    is_high = truth != _LOW
    return LabelledCloud(
        path.stem,
        len(truth),
        Agreement.of(truth == _GROUND, np.abs(height) <= GROUND_DISTANCE_M),
        Agreement.of(truth == _GROUND, predicted == ObjectClass.GROUND),
        Agreement.of(truth == _BUILDING, predicted == ObjectClass.BUILDING),
        Agreement.of(np.isin(truth, _VEGETATION)[is_high], (predicted == ObjectClass.VEGETATION)[is_high]),
    )


def classes_and_heights(path: Path, parameters: Parameters) -> tuple[ByteArray, FloatArray]:
    """`ObjectClass` (n,) uint8 and height above the ground model (n,) m of every point of one survey; noise is
    unclassified."""
    surveys = read_epochs(path, path, assume_same_crs=True)
    p = resolve(parameters, surveys)
    clouds = fuse_epochs(surveys, p)
    ground = model_ground(clouds, p)
    classes = classify_superpoints(clouds, form_superpoints(clouds, ground, p), p)
    found = segment_instances(clouds, ground, classes, p).before.classification
    xyz = surveys.before.xyz
    height = xyz[:, 2] - ground.before.model.height_at(xyz[:, :2])
    return np.append(found, np.uint8(ObjectClass.UNCLASSIFIED))[clouds.before.voxel_idx], height


def labels_table(clouds: list[LabelledCloud]) -> str:
    """F1 of every cloud in per cent, with precision and recall of the ground model; below it the plain means."""
    header = ["cloud", "points", "ground (0.2 m)", "precision", "recall", "ground", "building", "vegetation"]

    def row(cloud: LabelledCloud) -> list[float | None]:
        model = cloud.ground_model
        return [model.f1, model.precision, model.recall, *(getattr(cloud, kind).f1 for kind in _KINDS[1:])]

    rows = [row(cloud) for cloud in clouds]
    known = [[value for value in column if value is not None] for column in zip(*rows, strict=True)]
    means = [sum(column) / len(column) if column else None for column in known]
    table = [[cloud.name, cloud.n_points, *values] for cloud, values in zip(clouds, rows, strict=True)]
    return markdown_table(header, [*table, ["mean", sum(cloud.n_points for cloud in clouds), *means]])
