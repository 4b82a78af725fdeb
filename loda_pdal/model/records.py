"""What a run answers: objects with labels, changed ground, and per-point values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from loda_pdal.model.cloud import ByteArray, Float32Array, FloatArray
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.pair import Pair
from loda_pdal.model.registration import Registration
from loda_pdal.params import Parameters

UIntArray = npt.NDArray[np.uint32]


@dataclass(frozen=True)
class ObjectRecord:
    """One object over both epochs: a matched pair, or an object that only one survey shows.

    Heights in m above the ground of their epoch, volumes in m3 of occupied voxels; None where unknown, never 0.
    ``footprint`` is a valid shapely MultiPolygon in local metres of the after frame.
    """

    object_id: int
    label: ChangeLabel
    object_class: ObjectClass
    footprint: Any
    reason: str
    parent_id: int | None = None
    instance_before: int | None = None
    instance_after: int | None = None
    confidence: float | None = None
    confidence_raw: float | None = None
    observability: float | None = None
    height_before_m: float | None = None
    height_after_m: float | None = None
    dh_m: float | None = None
    volume_before_m3: float | None = None
    volume_after_m3: float | None = None
    dv_m3: float | None = None
    dv_ratio: float | None = None
    iou_3d: float | None = None
    shift_m: float | None = None
    d_perp_m: float | None = None
    lod95_m: float | None = None
    points_before: int | None = None
    points_after: int | None = None
    z_min_m: float | None = None
    z_max_m: float | None = None


@dataclass(frozen=True)
class GroundChangeRecord:
    """One connected piece of changed ground; ``footprint`` as in `ObjectRecord`."""

    ground_change_id: int
    label: ChangeLabel
    footprint: Any
    dz_m: float
    lod95_m: float
    area_m2: float
    volume_m3: float
    reason: str


@dataclass(frozen=True)
class InstanceRecord:
    """One segmented instance of one epoch; ``object_id`` is the object it belongs to."""

    instance_id: int
    object_class: ObjectClass
    footprint: Any
    n_points: int
    height_m: float | None
    volume_m3: float
    z_min_m: float
    z_max_m: float
    object_id: int | None


@dataclass(frozen=True)
class PointLabels:
    """Values of every raw point of one epoch, in input order, (n,) each; names and units as in `dimensions`."""

    classification: ByteArray
    height: FloatArray
    lod95: Float32Array
    superpoint: UIntArray
    instance: UIntArray
    object: UIntArray
    change: ByteArray
    confidence: Float32Array


@dataclass(frozen=True)
class StageCost:
    """What one stage took."""

    stage: str
    seconds: float
    peak_rss_mb: float


@dataclass(frozen=True)
class ChangeResult:
    """Everything a run found, in local metres (see `LocalFrame` for map coordinates).

    Attributes
    ----------
    objects : list of ObjectRecord
        All objects, by object_id.
    points : Pair of PointLabels
        Per raw point of each epoch.
    clouds : Pair of (m, 3) float64
        The fused points of each epoch in the after frame, with `object_of_voxel` (m,) uint32 beside them: for pictures.
    """

    objects: list[ObjectRecord]
    ground_changes: list[GroundChangeRecord]
    instances: Pair[list[InstanceRecord]]
    points: Pair[PointLabels]
    registration: Registration
    lod: LodGrid
    clouds: Pair[FloatArray]
    object_of_voxel: Pair[UIntArray]
    block: Any
    parameters: Parameters
    has_ground: bool
    warnings: list[str] = field(default_factory=list)
    costs: list[StageCost] = field(default_factory=list)

    @property
    def changes(self) -> list[ObjectRecord]:
        """Objects whose label is not Unchanged; Undetermined ones included."""
        return [o for o in self.objects if o.label != ChangeLabel.UNCHANGED]
