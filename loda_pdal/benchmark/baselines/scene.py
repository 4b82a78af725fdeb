"""A block made ready for every method alike, and a method's answer turned into what the protocols judge.

All baselines get what our own method has at the same point: fused points without outliers, the epochs registered by our
registration, and heights above our ground model. Only the decision what changed is theirs (paper, section 5: shared
preprocessing).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from loda_pdal.benchmark.runs import JudgedPoints, truth_change_of
from loda_pdal.benchmark.truth import Truth
from loda_pdal.model.cloud import BoolArray, ByteArray, FloatArray, Int64Array, VoxelCloud
from loda_pdal.model.errors import InputError
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.pair import Pair
from loda_pdal.model.survey import Survey
from loda_pdal.model.transform import transform_points
from loda_pdal.params import Parameters
from loda_pdal.pipeline import fuse_epochs, into_frame, model_ground, register_epochs, resolve

GROUND_M = 0.2
"""Points lower than this above the ground model are ground and take part in no change."""


@dataclass(frozen=True)
class Annotated:
    """One epoch of a block: its points, and for each its instance ``truth_id`` (n,), the label ``truth_change`` (n,) of
    its surface, and its true place ``xyz`` (n, 3) in map metres of the after frame."""

    survey: Survey
    truth_id: Int64Array
    truth_change: ByteArray
    xyz: FloatArray


@dataclass(frozen=True)
class Block:
    """Both annotated epochs of a block folder, and its truth."""

    name: str
    epochs: Pair[Annotated]
    truth: Truth

    @property
    def surveys(self) -> Pair[Survey]:
        return self.epochs.map(lambda epoch: epoch.survey)


@dataclass(frozen=True)
class Scene:
    """Both surveys as every baseline gets them.

    Attributes
    ----------
    clouds : Pair of VoxelCloud
        Fused points in one frame whose z is the common vertical.
    height : Pair of (m,) float64, m
        Of each fused point above the ground of its epoch; NaN where that is unknown.
    """

    clouds: Pair[VoxelCloud]
    height: Pair[FloatArray]

    @property
    def is_off_ground(self) -> Pair[BoolArray]:
        """Fused points that may belong to objects, (m,) each."""
        return self.height.map(lambda height: height >= GROUND_M)

    def on_points(self, marks: Pair[Marks]) -> Pair[Marks]:
        """Marks on fused points, on all raw points."""
        return marks.join(self.clouds, lambda side, cloud: side.of_points(cloud))


@dataclass(frozen=True)
class Marks:
    """A method's answer on points of one epoch: `ChangeLabel` ``change`` (k,) uint8, and ``object`` (k,) int64, 0 none.

    Objects of the two epochs are numbered together.
    """

    change: ByteArray
    object: Int64Array

    @classmethod
    def of_objects(cls, objects: Int64Array, label: ByteArray) -> Marks:
        """Points of ``objects`` (k,) with the label of theirs; ``label`` (n + 1,), the first that of no object."""
        return cls(label[objects], objects)

    def of_points(self, cloud: VoxelCloud) -> Marks:
        """Marks on fused points given to the raw points; points taken out as noise get none."""
        change = np.append(self.change, np.uint8(ChangeLabel.UNDETERMINED))
        return Marks(change[cloud.voxel_idx], np.append(self.object, 0)[cloud.voxel_idx])


def read_block(folder: Path) -> Block:
    """The block that ``bench simulate`` wrote to ``folder``: ``before.laz``, ``after.laz`` and ``truth.json``."""
    truth = Truth.read(folder / "truth.json")
    clouds = Pair(*(_read(folder / f"{name}.laz") for name in ("before", "after")))
    xyz = clouds.map(lambda cloud: np.column_stack([cloud.x, cloud.y, cloud.z]))
    frame = LocalFrame.about(np.min([side.min(axis=0, initial=np.inf) for side in xyz], axis=0))

    def annotated(cloud: Any, points: FloatArray) -> Annotated:
        truth_id = np.asarray(cloud["TruthId"]).astype(np.int64)
        change = truth_change_of(cloud, truth_id, truth)
        place = points if cloud is clouds.after else transform_points(truth.T_after_before, points)
        return Annotated(Survey(frame.to_local(points), frame), truth_id, change, place)

    return Block(folder.name, clouds.join(xyz, annotated), truth)


def scene_of(surveys: Pair[Survey], parameters: Parameters) -> Scene:
    """Both surveys fused, registered and with heights above ground, as our own method does it."""
    p = resolve(parameters, surveys)
    fused = fuse_epochs(surveys, p)
    clouds = into_frame(fused, register_epochs(fused, p))
    return Scene(clouds, model_ground(clouds, p).map(lambda ground: ground.height))


def judged_points(block: Block, marks: Pair[Marks]) -> JudgedPoints:
    """Annotated raw points of both epochs with the marks on them, in the order of the surveys."""
    change = np.concatenate([side.change for side in marks])
    return JudgedPoints(
        xyz=np.concatenate([epoch.xyz for epoch in block.epochs]),
        epoch=np.repeat(np.array([0, 1], np.uint8), [len(epoch.xyz) for epoch in block.epochs]),
        change=change,
        object=np.concatenate([side.object for side in marks]),
        classification=np.zeros(len(change), np.uint8),
        truth_id=np.concatenate([epoch.truth_id for epoch in block.epochs]),
        truth_change=np.concatenate([epoch.truth_change for epoch in block.epochs]),
    )


def _read(path: Path) -> Any:
    import laspy

    if not path.is_file():
        raise InputError(f"There is no {path}.", "Give folders that `loda-pdal bench simulate` wrote.", "not-a-block")
    cloud = laspy.read(path)
    if "TruthId" not in set(cloud.point_format.dimension_names):
        raise InputError(
            f"{path} carries no TruthId.", "Give folders that `loda-pdal bench simulate` wrote.", "not-a-block"
        )
    return cloud
