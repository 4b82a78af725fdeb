"""What a run answers: objects with labels, changed ground, and per-point values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from loda_pdal.model.cloud import ByteArray, Float32Array, FloatArray, IntArray
from loda_pdal.model.dimensions import (
    CHANGE,
    CLASSIFICATION,
    CONFIDENCE,
    HEIGHT,
    INSTANCE,
    LOD95,
    OBJECT,
    SUPERPOINT,
    Dimension,
)
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.pair import Pair
from loda_pdal.model.registration import Registration
from loda_pdal.model.survey import Survey
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
    """What was found for every raw point of one epoch, in input order; names and units as in `dimensions`.

    Points share what was found for their voxel, and have a height of their own. Nothing is spread over the points
    before it is asked for: part by part (`of_part`), or one dimension of all points (the properties, (n,) each).

    Attributes
    ----------
    survey : Survey
        The points.
    voxel_idx : (n,) int32
        Voxel of each point; -1 for noise.
    of_voxel : (m + 1,) structured array of `FOUND`
        Per voxel; the last is for noise. Heights are not filled in.
    height_of : callable
        Heights (k,) above ground, m, of local coordinates (k, 3).
    """

    survey: Survey
    voxel_idx: IntArray
    of_voxel: npt.NDArray[Any]
    height_of: Callable[[FloatArray], FloatArray]

    def __len__(self) -> int:
        return len(self.voxel_idx)

    def of_part(self, start: int, xyz: FloatArray) -> npt.NDArray[Any]:
        """Structured array (k,) of `FOUND` for the points from number ``start`` on, at ``xyz`` (k, 3), local m."""
        found = np.take(self.of_voxel, self.voxel_idx[start : start + len(xyz)])
        found[HEIGHT.name] = self.height_of(xyz)
        return found

    @property
    def height(self) -> FloatArray:
        """Worked out from all points, each time."""
        return np.concatenate([np.empty(0), *(self.height_of(xyz) for xyz in self.survey.parts())])

    @property
    def classification(self) -> ByteArray:
        return self._spread(CLASSIFICATION)

    @property
    def lod95(self) -> Float32Array:
        return self._spread(LOD95)

    @property
    def superpoint(self) -> UIntArray:
        return self._spread(SUPERPOINT)

    @property
    def instance(self) -> UIntArray:
        return self._spread(INSTANCE)

    @property
    def object(self) -> UIntArray:
        return self._spread(OBJECT)

    @property
    def change(self) -> ByteArray:
        return self._spread(CHANGE)

    @property
    def confidence(self) -> Float32Array:
        return self._spread(CONFIDENCE)

    def _spread(self, dimension: Dimension) -> npt.NDArray[Any]:
        return np.ascontiguousarray(self.of_voxel[dimension.name])[self.voxel_idx]


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
