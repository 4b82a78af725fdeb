"""What a run said about every point, together with the annotation of these points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from loda_pdal.benchmark.truth import Truth
from loda_pdal.model.cloud import ByteArray, FloatArray, Int64Array
from loda_pdal.model.dimensions import CHANGE, EPOCH, OBJECT
from loda_pdal.model.errors import InputError
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import ChangeResult
from loda_pdal.model.transform import transform_points

MAX_DISTANCE_M = 0.3
"""An annotated point takes the label of the nearest result point of its epoch, if it is no farther than this."""

NO_LABEL = 255
"""Predicted label of an annotated point that no result point is near."""

CLOUD_NAMES = ("changes.laz", "changes.copc.laz", "changes.las")
"""Names under which a run folder may hold its points."""


@dataclass(frozen=True)
class Points:
    """What a run says about points of both epochs, in any order.

    Attributes
    ----------
    xyz : (n, 3) float64, m
        Map coordinates in the after frame.
    epoch : (n,) uint8
        0 before, 1 after.
    change : (n,) uint8
        Predicted `ChangeLabel`; `NO_LABEL` where no result point is near.
    object : (n,) int64
        Predicted object; 0 none.
    classification : (n,) uint8
        Predicted `ObjectClass`; unclassified where no result point is near.
    """

    xyz: FloatArray
    epoch: ByteArray
    change: ByteArray
    object: Int64Array
    classification: ByteArray

    def __len__(self) -> int:
        return len(self.xyz)

    def at(self, index: npt.NDArray[Any]) -> Self:
        """Some of them, by index or mask."""
        return type(self)(*(getattr(self, item.name)[index] for item in fields(self)))


@dataclass(frozen=True)
class JudgedPoints(Points):
    """The same with the annotation of these points.

    Attributes
    ----------
    truth_id : (n,) int64
        Annotated instance; 0 for unchanged ground.
    truth_change : (n,) uint8
        `ChangeLabel` of the surface the point lies on.
    """

    truth_id: Int64Array
    truth_change: ByteArray


def read_run(run_dir: Path, truth: Truth, truth_dir: Path) -> JudgedPoints:
    """Points of a run folder with their annotation.

    Where the run's cloud still carries ``TruthId`` (loda-pdal keeps all dimensions of its input), every point is its
    own annotated point. Otherwise the annotated surveys next to the truth file are read, and each of their points
    takes the label of the nearest result point of its epoch within `MAX_DISTANCE_M`.
    """
    cloud = _read_cloud(run_dir)
    points = _points_of(cloud)
    if "TruthId" in set(cloud.point_format.dimension_names):
        truth_id = np.asarray(cloud["TruthId"]).astype(np.int64)
        truth_change = truth_change_of(cloud, truth_id, truth)
        return _judged(points, truth_id, truth_change)
    parts = [
        _annotated(truth_dir / f"{name}.laz", code, truth, points.at(points.epoch == code))
        for code, name in ((0, "before"), (1, "after"))
    ]
    return _together(parts)


def read_points(run_dir: Path) -> Points:
    """What a run folder says about its points, without any annotation."""
    return _points_of(_read_cloud(run_dir))


def nearest_points(annotated_xyz: FloatArray, result: Points) -> Points:
    """What is known of the nearest result point to each annotated point; `NO_LABEL`, object 0 and unclassified where
    none is within `MAX_DISTANCE_M`."""
    n = len(annotated_xyz)
    nearest = np.full(n, len(result.xyz))
    if len(result.xyz) and n:
        # slightly more than the limit, so that a distance of just the limit counts whatever its last bit
        _, nearest = cKDTree(result.xyz).query(annotated_xyz, distance_upper_bound=MAX_DISTANCE_M * (1 + 1e-9))

    def taken(values: npt.NDArray[Any], unknown: int) -> npt.NDArray[Any]:
        return np.asarray(np.append(values, values.dtype.type(unknown))[nearest])

    return Points(
        annotated_xyz,
        taken(result.epoch, 0),
        taken(result.change, NO_LABEL),
        taken(result.object, 0),
        taken(result.classification, ObjectClass.UNCLASSIFIED),
    )


def _points_of(cloud: Any) -> Points:
    names = set(cloud.point_format.dimension_names)
    missing = [d.name for d in (EPOCH, OBJECT, CHANGE) if d.name not in names]
    if missing:
        raise InputError(f"The cloud has no dimension {', '.join(missing)}.", "Give the folder of a run.", "not-a-run")
    return Points(
        np.column_stack([cloud.x, cloud.y, cloud.z]),
        np.asarray(cloud[EPOCH.name]),
        np.asarray(cloud[CHANGE.name]),
        np.asarray(cloud[OBJECT.name]).astype(np.int64),
        np.asarray(cloud.classification, dtype=np.uint8),
    )


def _read_cloud(run_dir: Path) -> Any:
    import laspy

    for name in CLOUD_NAMES:
        if (run_dir / name).is_file():
            return laspy.read(run_dir / name)
    raise InputError(
        f"No {CLOUD_NAMES[0]} in {run_dir}.", "Give the folder that `loda-pdal detect -o` wrote.", "not-a-run"
    )


class Annotation(NamedTuple):
    """What is known of the points of one annotated survey, in their order: ``xyz`` (n, 3) m where the survey has them,
    and per point as in `JudgedPoints`."""

    xyz: FloatArray
    truth_id: Int64Array
    truth_change: ByteArray


def read_annotation(path: Path, truth: Truth) -> Annotation:
    """The annotation of one survey."""
    import laspy

    if not path.is_file():
        raise InputError(
            f"The run's cloud carries no TruthId, and there is no {path} to take it from.",
            "Keep the annotated surveys next to truth.json.",
            "truth-missing",
        )
    cloud = laspy.read(path)
    truth_id = np.asarray(cloud["TruthId"]).astype(np.int64)
    return Annotation(np.column_stack([cloud.x, cloud.y, cloud.z]), truth_id, truth_change_of(cloud, truth_id, truth))


def judged_result(result: ChangeResult, annotation: Pair[Annotation], T_after_before: FloatArray) -> JudgedPoints:
    """What a run found, before it is written, with the annotation of its input: points of both in the same order.

    ``T_after_before`` is the true move of before-points, (4, 4), in map coordinates.
    """
    sides = []
    moves = (T_after_before, np.eye(4))
    for code, (said, known, T) in enumerate(zip(result.points, annotation, moves, strict=True)):
        sides.append(
            JudgedPoints(
                transform_points(T, known.xyz),
                np.full(len(said), code, dtype=np.uint8),
                said.change,
                said.object.astype(np.int64),
                said.classification,
                known.truth_id,
                known.truth_change,
            )
        )
    return _together(sides)


def _annotated(path: Path, epoch: int, truth: Truth, result: Points) -> JudgedPoints:
    known = read_annotation(path, truth)
    xyz = transform_points(truth.T_after_before, known.xyz) if epoch == 0 else known.xyz
    near = replace(nearest_points(xyz, result), epoch=np.full(len(xyz), epoch, dtype=np.uint8))
    return _judged(near, known.truth_id, known.truth_change)


def _together(sides: Sequence[JudgedPoints]) -> JudgedPoints:
    return JudgedPoints(*(np.concatenate([getattr(s, item.name) for s in sides]) for item in fields(JudgedPoints)))


def _judged(points: Points, truth_id: Int64Array, truth_change: ByteArray) -> JudgedPoints:
    said = {item.name: getattr(points, item.name) for item in fields(points)}
    return JudgedPoints(**said, truth_id=truth_id, truth_change=truth_change)


def truth_change_of(cloud: Any, truth_id: Int64Array, truth: Truth) -> ByteArray:
    """Label of the surface of each point; that of its whole instance where the cloud does not say."""
    if "TruthChange" in set(cloud.point_format.dimension_names):
        return np.asarray(cloud["TruthChange"])
    label = np.full(max(truth.by_id, default=0) + 1, ChangeLabel.UNCHANGED, dtype=np.uint8)
    for i in truth.instances:
        label[i.instance_id] = i.label
    return np.asarray(label[truth_id])
