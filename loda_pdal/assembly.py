"""From voxels back to what is answered: raw points, outlines and records, in the after frame."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import shapely

from loda_pdal.model import dimensions as dims
from loda_pdal.model.cloud import ByteArray, Float32Array, FloatArray, IntArray, VoxelCloud
from loda_pdal.model.groups import Groups
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import GroundChangeRecord, InstanceRecord, ObjectRecord, PointLabels
from loda_pdal.model.survey import Survey
from loda_pdal.model.transform import transform_points
from loda_pdal.stages.changes import Changes
from loda_pdal.stages.confidence import ground_confidence
from loda_pdal.stages.footprints import footprints
from loda_pdal.stages.ground import GroundModel
from loda_pdal.stages.ground_changes import GroundChanges
from loda_pdal.stages.instances import Instances
from loda_pdal.stages.semantics import voxel_volume


def object_records(
    xyz_after_frame: Pair[FloatArray], instances: Pair[Instances], changes: Changes, resolution_m: float
) -> list[ObjectRecord]:
    """One record per object, numbered from 1; unknown figures are None."""
    n = len(changes)
    outline = _outlines(xyz_after_frame, changes.owner, n, resolution_m)
    instance = instances.join(changes.owner, lambda side, owner: _most_common(owner, side.instance, n))
    e = changes.evidence
    present = e.n_voxels.map(lambda count: count > 0)
    extent = _vertical_extent(xyz_after_frame, changes.owner, n)
    records = []
    for i in range(n):
        is_before, is_after = bool(present.before[i]), bool(present.after[i])
        is_pair = is_before and is_after
        records.append(
            ObjectRecord(
                object_id=i + 1,
                label=ChangeLabel(int(changes.label[i])),
                object_class=ObjectClass(int(changes.object_class[i])),
                footprint=outline[i],
                reason=changes.reason[i],
                parent_id=int(changes.parent[i]) + 1 if changes.parent[i] >= 0 else None,
                instance_before=_id(instance.before[i]),
                instance_after=_id(instance.after[i]),
                confidence=_known(changes.confidence[i]),
                confidence_raw=_known(changes.confidence_raw[i]),
                observability=_known(e.observability[i]),
                height_before_m=_known(e.height.before[i], is_before),
                height_after_m=_known(e.height.after[i], is_after),
                dh_m=_known(e.dh[i], is_pair),
                volume_before_m3=_known(e.volume.before[i], is_before),
                volume_after_m3=_known(e.volume.after[i], is_after),
                dv_m3=_known(e.dv[i], is_pair),
                dv_ratio=_known(e.dv_ratio[i], is_pair),
                iou_3d=_known(e.iou[i], is_pair),
                shift_m=_known(e.shift[i], is_pair),
                d_perp_m=_known(e.d_perp[i], is_pair),
                lod95_m=_known(e.lod95[i]),
                points_before=int(e.n_points.before[i]) if is_before else None,
                points_after=int(e.n_points.after[i]) if is_after else None,
                z_min_m=_known(extent[0][i]),
                z_max_m=_known(extent[1][i]),
            )
        )
    return records


def instance_records(
    cloud: VoxelCloud,
    xyz_after_frame: FloatArray,
    height: FloatArray,
    instances: Instances,
    owner: IntArray,
    resolution_m: float,
    voxel_m: float,
) -> list[InstanceRecord]:
    """One record per instance of one epoch."""
    n = len(instances)
    label = (instances.instance - 1).astype(np.int32)
    groups = Groups(label, n)
    outline = footprints(xyz_after_frame[:, :2], instances.instance, n, resolution_m)
    points = groups.sum(cloud.n_raw)
    top = groups.quantile(height, 0.95)
    low, high = groups.minimum(xyz_after_frame[:, 2]), groups.maximum(xyz_after_frame[:, 2])
    volume = voxel_volume(xyz_after_frame, label, n, voxel_m)
    of_object = _most_common(label, (owner + 1).astype(np.int32), n)
    return [
        InstanceRecord(
            instance_id=i + 1,
            object_class=ObjectClass(int(instances.object_class[i])),
            footprint=outline[i],
            n_points=int(points[i]),
            height_m=_known(top[i]),
            volume_m3=float(volume[i]),
            z_min_m=float(low[i]),
            z_max_m=float(high[i]),
            object_id=_id(of_object[i]),
        )
        for i in range(n)
    ]


def point_labels(
    survey: Survey,
    T_frame: FloatArray,
    cloud: VoxelCloud,
    ground: GroundModel,
    lod: LodGrid,
    superpoint: IntArray,
    instances: Instances,
    owner: IntArray,
    changes: Changes,
    ground_changes: GroundChanges,
    min_dz_m: float,
) -> PointLabels:
    """Values of the raw points of one epoch; outliers are noise and nothing else."""
    change, confidence = _voxel_changes(cloud, instances, owner, changes, ground_changes, min_dz_m)
    of_voxel = np.empty(len(cloud) + 1, dtype=dims.FOUND)
    for dimension, values, of_noise in (
        (dims.CLASSIFICATION, instances.classification, ObjectClass.NOISE),
        (dims.HEIGHT, math.nan, math.nan),
        (dims.LOD95, lod.at(cloud.xyz), dims.LOD95.unknown),
        (dims.SUPERPOINT, superpoint + 1, dims.SUPERPOINT.unknown),
        (dims.INSTANCE, instances.instance, dims.INSTANCE.unknown),
        (dims.OBJECT, owner + 1, dims.OBJECT.unknown),
        (dims.CHANGE, change, dims.CHANGE.unknown),
        (dims.CONFIDENCE, confidence, dims.CONFIDENCE.unknown),
    ):
        of_voxel[dimension.name][:-1] = values
        of_voxel[dimension.name][-1] = of_noise
    return PointLabels(survey, cloud.voxel_idx, of_voxel, partial(height_of_points, T_frame, ground))


def height_of_points(T_frame: FloatArray, ground: GroundModel, xyz: FloatArray) -> FloatArray:
    """Height above ground (n,), m, of points (n, 3), local m, that ``T_frame`` moves into the ground model's frame."""
    moved = transform_points(T_frame, xyz)
    return np.asarray(moved[:, 2] - ground.height_at(moved[:, :2]))


def ground_records(ground_changes: GroundChanges, T_after_frame: FloatArray) -> list[GroundChangeRecord]:
    """One record per connected piece of changed ground."""
    return [
        GroundChangeRecord(
            ground_change_id=i + 1,
            label=region.label,
            footprint=_moved(region.footprint, T_after_frame),
            dz_m=region.dz_m,
            lod95_m=region.lod95_m,
            area_m2=region.area_m2,
            volume_m3=region.volume_m3,
            reason=f"ground {'up' if region.dz_m > 0 else 'down'} {abs(region.dz_m):.2f} m "
            f"over {region.area_m2:.0f} m2, detection limit {region.lod95_m:.2f} m",
        )
        for i, region in enumerate(ground_changes.regions)
    ]


def outline_of(xyz_after_frame: Pair[FloatArray]) -> shapely.Polygon:
    """Convex hull of both epochs in plan: the extent processed."""
    plan = np.concatenate([side[:, :2] for side in xyz_after_frame])
    hull = shapely.convex_hull(shapely.linestrings(plan) if len(plan) > 1 else shapely.MultiPoint(plan))
    return hull if isinstance(hull, shapely.Polygon) else hull.buffer(0.5)


def _voxel_changes(
    cloud: VoxelCloud,
    instances: Instances,
    owner: IntArray,
    changes: Changes,
    ground_changes: GroundChanges,
    min_dz_m: float,
) -> tuple[ByteArray, Float32Array]:
    """Label and confidence of each voxel: its object's, or on the ground its tile's."""
    label = np.append(changes.label, np.uint8(ChangeLabel.UNDETERMINED))[owner]
    confidence = np.append(changes.confidence, np.nan)[owner]
    is_ground = (instances.classification == ObjectClass.GROUND) & (owner < 0)
    tile = ground_changes.tile_at(cloud.xyz[is_ground, :2])
    label[is_ground] = np.append(ground_changes.label, np.uint8(ChangeLabel.UNDETERMINED))[tile]
    confidence[is_ground] = np.append(ground_confidence(ground_changes, min_dz_m), np.nan)[tile]
    return label.astype(np.uint8), confidence.astype(np.float32)


def spread(cloud: VoxelCloud, values: np.ndarray, unknown: float, dtype: str) -> np.ndarray:
    """Values of the voxels on the raw points; ``unknown`` where the point was noise."""
    table = np.append(np.asarray(values).astype(dtype), np.array([unknown]).astype(dtype))
    return np.asarray(table[cloud.voxel_idx])


def _outlines(xyz: Pair[FloatArray], owner: Pair[IntArray], n: int, resolution_m: float) -> list[shapely.MultiPolygon]:
    plan = np.concatenate([side[:, :2] for side in xyz])
    return footprints(plan, np.concatenate(list(owner)) + 1, n, resolution_m)


def _vertical_extent(xyz: Pair[FloatArray], owner: Pair[IntArray], n: int) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest point (n,) of each object over both epochs."""
    groups = Groups(np.concatenate(list(owner)), n)
    z = np.concatenate([side[:, 2] for side in xyz])
    return groups.minimum(z), groups.maximum(z)


def _most_common(group: IntArray, value: IntArray, n: int) -> IntArray:
    """Most common positive value per group (n,), the lowest of several; 0 where there is none."""
    is_in = (group >= 0) & (value > 0)
    result = np.zeros(n, dtype=np.int32)
    if is_in.any():
        base = int(value.max()) + 1
        key, count = np.unique(group[is_in].astype(np.int64) * base + value[is_in], return_counts=True)
        order = np.lexsort((-key, count))  # the last written wins: most common, then lowest
        result[key[order] // base] = key[order] % base
    return result


def _moved(outline: shapely.MultiPolygon, T: FloatArray) -> shapely.MultiPolygon:
    """Outline turned and shifted in plan; the tilt of a registration does not matter over an outline."""
    return shapely.transform(outline, lambda xy: xy @ T[:2, :2].T + T[:2, 3])


def _known(value: float, is_known: bool = True) -> float | None:
    return float(value) if is_known and math.isfinite(value) else None


def _id(value: int) -> int | None:
    return int(value) if value > 0 else None
