"""Classes of superpoints by rules (paper, section 4.2), with roofs and the class `other` (METHOD 1.8, 1.9)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loda_pdal.kernels.clusters import components, smooth_pieces
from loda_pdal.kernels.contacts import contact_keys
from loda_pdal.kernels.neighbours import knn
from loda_pdal.model.boxes import upright_boxes
from loda_pdal.model.cloud import BoolArray, ByteArray, FloatArray, Int64Array, IntArray
from loda_pdal.model.groups import Groups, consecutive, count_cells
from loda_pdal.model.labels import ObjectClass
from loda_pdal.params import SemanticParams
from loda_pdal.stages.features import Features
from loda_pdal.stages.parked import parked_vehicles

_LINEARITY, _PLANARITY, _SPHERICITY, _VERTICAL, _HEIGHT = range(5)

_FLAT = 0.05
"""Largest median sphericity of a roof; plants begin far above it."""

_LEVEL = 0.7
"""Smallest |n.z| of the plane through a roof of several levels."""


@dataclass(frozen=True)
class Planes:
    """Planes through groups of points.

    Attributes
    ----------
    centroid, normal : (n, 3) float64
        Centroid (m) and unit normal; z of the normal is not negative.
    rmse : (n,) float64, m
        Root mean square distance of the points to the plane.
    """

    centroid: FloatArray
    normal: FloatArray
    rmse: FloatArray


@dataclass(frozen=True)
class Semantics:
    """Classes of one epoch.

    Attributes
    ----------
    classification : (m,) uint8
        `ObjectClass` code of each voxel.
    segment : (m,) int32
        The piece of a superpoint that was classified as one: the superpoint itself, or one of its planes.
    vehicle : (m,) int32
        Vehicle that each voxel belongs to, -1 none (`parked_vehicles`).
    is_solid : (m,) bool
        Whether a voxel lies low and smooth: no foliage, whatever its superpoint.
    plane_group : (s,) int32
        Segments with one number lie in one plane after merging coplanar neighbours; -1 where not planar.
    adjacency : (e, 2) int64
        Pairs of segments that touch, first smaller than second.
    contact : (e,) int64
        In how many neighbour relations of voxels they touch.
    """

    classification: ByteArray
    segment: IntArray
    vehicle: IntArray
    is_solid: BoolArray
    plane_group: IntArray
    adjacency: Int64Array
    contact: Int64Array


def classify(
    xyz: FloatArray,
    leaf_m: float,
    features: Features,
    superpoint: IntArray,
    n_superpoints: int,
    params: SemanticParams,
) -> Semantics:
    """Class of every superpoint: ground, building, vegetation, mobile, in this priority; what is left is `other`.

    Parameters
    ----------
    xyz : (m, 3) float64, m
        Fused points.
    leaf_m : float
        Edge of the voxels they were fused in, m.
    features : Features
        Of the same points; the last column is the height above ground.
    superpoint : (m,) int32
        Superpoint of each point, 0 to ``n_superpoints - 1``.

    References
    ----------
    Paper, section 4.2, paragraph after equation 4.
    """
    values = features.values
    if params.split_angle_deg > 0:
        superpoint, n_superpoints = split_at_edges(xyz, leaf_m, features, superpoint, n_superpoints, params)
    groups = Groups(superpoint, n_superpoints)
    height = groups.median(values[:, _HEIGHT])
    adjacency, contact = touching(xyz, superpoint, 2.5 * leaf_m)

    is_ground = _ground(groups, values, params)
    is_planar = ~is_ground & (groups.median(values[:, _PLANARITY]) > params.building_planarity)
    planes = fit_planes(xyz, groups.only(is_planar))
    is_planar &= planes.rmse < params.building_rmse_m
    plane_group = _coplanar(planes, is_planar, adjacency, params.merge_angle_deg, 2 * params.building_rmse_m)
    is_building = _building(xyz, leaf_m, groups, values[:, _HEIGHT], height, planes, plane_group, params)
    if params.stepped_roof_m2 > 0:
        is_building |= _stepped_roof(xyz, leaf_m, groups, values, height, params) & ~is_planar & ~is_ground
    is_round = groups.median(values[:, _SPHERICITY]) > params.vegetation_sphericity
    is_vegetation = is_round & (height > params.vegetation_height_m) & ~(is_ground | is_building)
    azimuth_spread = _azimuth_spread(features.normals, groups.only(is_vegetation))
    is_vegetation &= azimuth_spread > np.radians(params.vegetation_azimuth_deg)
    is_mobile = _mobile(xyz, groups.only(~(is_ground | is_building | is_vegetation)), params)

    rules = (is_ground, is_building, is_vegetation, is_mobile)
    codes = (ObjectClass.GROUND, ObjectClass.BUILDING, ObjectClass.VEGETATION, ObjectClass.MOBILE)
    class_of = np.select(rules, codes, default=ObjectClass.OTHER).astype(np.uint8)
    classification = class_of[superpoint] if n_superpoints else np.zeros(0, np.uint8)
    if params.points_near_ground_are_ground:
        is_low = np.abs(values[:, _HEIGHT]) < params.ground_distance_m
        classification = np.where(is_low, np.uint8(ObjectClass.GROUND), classification)
    is_loose = (classification != ObjectClass.GROUND) & (classification != ObjectClass.BUILDING)
    vehicle, is_solid = parked_vehicles(xyz, values[:, _HEIGHT].astype(np.float64), features.normals, is_loose, params)
    return Semantics(classification, superpoint, vehicle, is_solid, plane_group, adjacency, contact)


def split_at_edges(
    xyz: FloatArray,
    leaf_m: float,
    features: Features,
    superpoint: IntArray,
    n_superpoints: int,
    params: SemanticParams,
) -> tuple[IntArray, int]:
    """Superpoints (m,) with those that run around a corner split into their planes, and how many there are.

    The paper's features know how steep a surface is but not where it faces, so one superpoint may hold two walls of a
    house; the plane through both fits neither. A planar superpoint with a bad plane is cut where neighbouring normals
    differ by more than ``split_angle_deg``.
    """
    groups = Groups(superpoint, n_superpoints)
    is_bent = groups.median(features.values[:, _PLANARITY]) > 0.8 * params.building_planarity
    is_bent &= fit_planes(xyz, groups.only(is_bent)).rmse >= params.building_rmse_m
    members = np.flatnonzero(is_bent[superpoint]) if n_superpoints else np.zeros(0, np.int64)
    if len(members) == 0:
        return superpoint, n_superpoints
    neighbour, _ = knn(xyz[members], 9, 2.5 * leaf_m)
    least_cosine = np.cos(np.radians(params.split_angle_deg))
    piece = smooth_pieces(neighbour, features.normals[members], superpoint[members], least_cosine)
    label = superpoint.astype(np.int64)
    label[members] = n_superpoints + piece
    return consecutive(label)


def fit_planes(xyz: FloatArray, groups: Groups) -> Planes:
    """Least-squares plane of each group of points (m, 3)."""
    eigenvalues, eigenvectors = np.linalg.eigh(groups.covariance(xyz))
    normal = eigenvectors[:, :, 0]
    normal = np.where(normal[:, 2:] < 0, -normal, normal)
    return Planes(np.nan_to_num(groups.mean(xyz)), normal, np.sqrt(np.maximum(eigenvalues[:, 0], 0.0)))


def touching(xyz: FloatArray, labels: IntArray, reach_m: float) -> tuple[Int64Array, Int64Array]:
    """Pairs of different labels among each point's eight nearest neighbours, and how often each pair occurs."""
    if len(xyz) == 0:
        return np.zeros((0, 2), np.int64), np.zeros(0, np.int64)
    neighbour, _ = knn(xyz, 9, reach_m)
    n = int(labels.max()) + 1
    key, contact = np.unique(contact_keys(neighbour, labels, n), return_counts=True)
    return np.column_stack(np.divmod(key, max(n, 1))), contact.astype(np.int64)


def _ground(groups: Groups, values: np.ndarray, params: SemanticParams) -> BoolArray:
    distance = groups.median(np.abs(values[:, _HEIGHT]))
    is_horizontal = groups.share(values[:, _VERTICAL] > params.ground_horizontal) >= params.ground_share
    return np.asarray((distance < params.ground_distance_m) & is_horizontal)


def _coplanar(
    planes: Planes, is_planar: BoolArray, adjacency: Int64Array, angle_deg: float, distance_m: float
) -> IntArray:
    """Number of the merged plane of each planar superpoint, -1 for the others."""
    a, b = adjacency[:, 0], adjacency[:, 1]
    is_parallel = np.abs(np.sum(planes.normal[a] * planes.normal[b], axis=1)) > np.cos(np.radians(angle_deg))
    offset = planes.centroid[b] - planes.centroid[a]
    gap = np.maximum(
        np.abs(np.sum(planes.normal[a] * offset, axis=1)), np.abs(np.sum(planes.normal[b] * offset, axis=1))
    )
    is_merged = is_planar[a] & is_planar[b] & is_parallel & (gap < distance_m)
    return np.where(is_planar, components(adjacency[is_merged], len(is_planar)), -1).astype(np.int32)


def _building(
    xyz: FloatArray,
    leaf_m: float,
    groups: Groups,
    point_height: np.ndarray,
    height: FloatArray,
    planes: Planes,
    plane_group: IntArray,
    params: SemanticParams,
) -> BoolArray:
    """Superpoints in large enough facade planes, and in roof planes where the preset has roofs."""
    if not (plane_group >= 0).any():
        return np.zeros(len(plane_group), np.bool_)
    merged = Groups(plane_group[groups.labels], groups.n)
    area = support_area(xyz, merged, fit_planes(xyz, merged), 2 * leaf_m)[np.maximum(plane_group, 0)]
    top = np.nan_to_num(merged.quantile(point_height, 0.95))[np.maximum(plane_group, 0)]
    is_vertical = np.abs(planes.normal[:, 2]) < params.building_vertical
    is_facade = is_vertical & (area > params.building_area_m2) & (top > params.building_top_m)
    is_roof = ~is_vertical & (area > params.roof_area_m2) & (height > params.roof_height_m) & params.has_roofs
    return np.asarray((plane_group >= 0) & (is_facade | is_roof))


def _stepped_roof(
    xyz: FloatArray, leaf_m: float, groups: Groups, values: np.ndarray, height: FloatArray, params: SemanticParams
) -> BoolArray:
    """Level superpoints (n,) that are flat all over but lie in no one plane: the roofs of a row, each a little higher
    than the next."""
    is_flat = groups.median(values[:, _PLANARITY]) > params.building_planarity
    is_flat &= groups.median(values[:, _SPHERICITY]) < _FLAT
    is_flat &= height > params.roof_height_m
    is_flat &= np.abs(fit_planes(xyz, groups.only(is_flat)).normal[:, 2]) > _LEVEL
    area = count_cells(xyz[:, :2], groups.labels, groups.n, 2 * leaf_m) * (2 * leaf_m) ** 2
    return np.asarray(is_flat & (area > params.stepped_roof_m2))


def support_area(xyz: FloatArray, groups: Groups, planes: Planes, cell_m: float) -> FloatArray:
    """Area (n,) m2 of each group's points in its plane: occupied cells of ``cell_m`` in plane coordinates."""
    helper = np.where(np.abs(planes.normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    u = np.cross(helper, planes.normal)
    u /= np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-12)
    v = np.cross(planes.normal, u)
    point = groups.order
    label = groups.labels[point].astype(np.int64)
    centred = xyz[point] - planes.centroid[label]
    in_plane = np.column_stack([np.sum(centred * u[label], axis=1), np.sum(centred * v[label], axis=1)])
    return count_cells(in_plane, label, groups.n, cell_m) * cell_m**2


def _azimuth_spread(normals: np.ndarray, groups: Groups) -> FloatArray:
    """Spread of normal azimuths per superpoint, rad: 5th to 95th percentile of the axis angle about its mean axis."""
    east, north = (normals[groups.order, axis] for axis in (0, 1))
    doubled = 2.0 * np.arctan2(north.astype(np.float64), east.astype(np.float64))
    has_azimuth = np.hypot(east, north) > 0.05
    sorted_groups = Groups(groups.labels[groups.order], groups.n)
    mean = np.arctan2(
        sorted_groups.sum(np.where(has_azimuth, np.sin(doubled), 0)),
        sorted_groups.sum(np.where(has_azimuth, np.cos(doubled), 0)),
    )
    about = doubled - np.repeat(mean, groups.counts)
    wrapped = np.where(has_azimuth, np.arctan2(np.sin(about), np.cos(about)) / 2.0, np.nan)
    return np.nan_to_num(sorted_groups.quantile(wrapped, 0.95) - sorted_groups.quantile(wrapped, 0.05))


def _mobile(xyz: FloatArray, groups: Groups, params: SemanticParams) -> BoolArray:
    """Superpoints that fit into a vehicle's box."""
    size = upright_boxes(xyz, groups.labels, groups.n).size
    length, width, height = np.maximum(size[:, 0], size[:, 1]), np.minimum(size[:, 0], size[:, 1]), size[:, 2]
    fits = (length < params.mobile_length_m) & (width < params.mobile_width_m) & (height < params.mobile_height_m)
    volume = voxel_volume(xyz, groups.only(fits).labels, groups.n, 0.5)
    return np.asarray(fits & (volume < params.mobile_volume_m3))


def voxel_volume(xyz: FloatArray, labels: IntArray, n: int, voxel_m: float) -> FloatArray:
    """Volume (n,) m3 of the voxels that each group's points occupy."""
    return count_cells(xyz, labels, n, voxel_m) * voxel_m**3
