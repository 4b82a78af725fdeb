"""What a run said about every point, together with the annotation of these points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from loda_pdal.benchmark.truth import Truth
from loda_pdal.model.cloud import ByteArray, FloatArray, Int64Array
from loda_pdal.model.dimensions import CHANGE, EPOCH, OBJECT
from loda_pdal.model.errors import InputError
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.transform import transform_points

MAX_DISTANCE_M = 0.3
"""An annotated point takes the label of the nearest result point of its epoch, if it is no farther than this."""

NO_LABEL = 255
"""Predicted label of an annotated point that no result point is near."""

CLOUD_NAMES = ("changes.laz", "changes.copc.laz", "changes.las")
"""Names under which a run folder may hold its points."""


@dataclass(frozen=True)
class JudgedPoints:
    """Annotated points of both epochs with what the run predicted for them, in any order.

    Attributes
    ----------
    xy : (n, 2) float64, m
        Map coordinates in the after frame.
    truth_id : (n,) int64
        Annotated instance; 0 for unchanged ground.
    truth_change : (n,) uint8
        `ChangeLabel` of the surface the point lies on.
    epoch : (n,) uint8
        0 before, 1 after.
    change : (n,) uint8
        Predicted `ChangeLabel`; `NO_LABEL` where no result point is near.
    object : (n,) int64
        Predicted object; 0 none.
    """

    xy: FloatArray
    truth_id: Int64Array
    truth_change: ByteArray
    epoch: ByteArray
    change: ByteArray
    object: Int64Array

    def __len__(self) -> int:
        return len(self.truth_id)


@dataclass(frozen=True)
class Points:
    """Labelled points of one epoch: ``xyz`` (n, 3) m, and per point `ChangeLabel` ``change`` and ``object`` (n,)."""

    xyz: FloatArray
    change: ByteArray
    object: Int64Array


def read_run(run_dir: Path, truth: Truth, truth_dir: Path) -> JudgedPoints:
    """Points of a run folder with their annotation.

    Where the run's cloud still carries ``TruthId`` (loda-pdal keeps all dimensions of its input), every point is its
    own annotated point. Otherwise the annotated surveys next to the truth file are read, and each of their points
    takes the label of the nearest result point of its epoch within `MAX_DISTANCE_M`.
    """
    cloud = _read_cloud(run_dir)
    names = set(cloud.point_format.dimension_names)
    missing = [d.name for d in (EPOCH, OBJECT, CHANGE) if d.name not in names]
    if missing:
        raise InputError(
            f"The cloud in {run_dir} has no dimension {', '.join(missing)}.", "Score the folder of a run.", "not-a-run"
        )
    xyz = np.column_stack([cloud.x, cloud.y, cloud.z])
    epoch, change = np.asarray(cloud[EPOCH.name]), np.asarray(cloud[CHANGE.name])
    objects = np.asarray(cloud[OBJECT.name]).astype(np.int64)
    if "TruthId" in names:
        truth_id = np.asarray(cloud["TruthId"]).astype(np.int64)
        truth_change = truth_change_of(cloud, truth_id, truth)
        return JudgedPoints(xyz[:, :2], truth_id, truth_change, epoch, change, objects)
    parts = []
    for code, name in ((0, "before"), (1, "after")):
        is_here = epoch == code
        result = Points(xyz[is_here], change[is_here], objects[is_here])
        parts.append(_annotated(truth_dir / f"{name}.laz", code, truth, result))
    return JudgedPoints(*(np.concatenate([getattr(p, f) for p in parts]) for f in JudgedPoints.__dataclass_fields__))


def nearest_labels(annotated_xyz: FloatArray, result: Points) -> tuple[ByteArray, Int64Array]:
    """Label and object of the nearest result point to each annotated point, (n,) each; `NO_LABEL` and 0 where none is
    within `MAX_DISTANCE_M`."""
    change = np.full(len(annotated_xyz), NO_LABEL, dtype=np.uint8)
    objects = np.zeros(len(annotated_xyz), dtype=np.int64)
    if len(result.xyz) and len(annotated_xyz):
        # slightly more than the limit, so that a distance of just the limit counts whatever its last bit
        limit = MAX_DISTANCE_M * (1 + 1e-9)
        _, nearest = cKDTree(result.xyz).query(annotated_xyz, distance_upper_bound=limit)
        is_near = nearest < len(result.xyz)
        change[is_near], objects[is_near] = result.change[nearest[is_near]], result.object[nearest[is_near]]
    return change, objects


def _read_cloud(run_dir: Path) -> Any:
    import laspy

    for name in CLOUD_NAMES:
        if (run_dir / name).is_file():
            return laspy.read(run_dir / name)
    raise InputError(
        f"No {CLOUD_NAMES[0]} in {run_dir}.", "Give the folder that `loda-pdal detect -o` wrote.", "not-a-run"
    )


def _annotated(path: Path, epoch: int, truth: Truth, result: Points) -> JudgedPoints:
    import laspy

    if not path.is_file():
        raise InputError(
            f"The run's cloud carries no TruthId, and there is no {path} to take it from.",
            "Keep the annotated surveys next to truth.json.",
            "truth-missing",
        )
    cloud = laspy.read(path)
    xyz = np.column_stack([cloud.x, cloud.y, cloud.z])
    if epoch == 0:
        xyz = transform_points(truth.T_after_before, xyz)
    truth_id = np.asarray(cloud["TruthId"]).astype(np.int64)
    change, objects = nearest_labels(xyz, result)
    epochs = np.full(len(xyz), epoch, dtype=np.uint8)
    return JudgedPoints(xyz[:, :2], truth_id, truth_change_of(cloud, truth_id, truth), epochs, change, objects)


def truth_change_of(cloud: Any, truth_id: Int64Array, truth: Truth) -> ByteArray:
    """Label of the surface of each point; that of its whole instance where the cloud does not say."""
    if "TruthChange" in set(cloud.point_format.dimension_names):
        return np.asarray(cloud["TruthChange"])
    label = np.full(max(truth.by_id, default=0) + 1, ChangeLabel.UNCHANGED, dtype=np.uint8)
    for i in truth.instances:
        label[i.instance_id] = i.label
    return np.asarray(label[truth_id])
