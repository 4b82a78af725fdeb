"""Instances within each class (paper, section 4.2), and what the preset does beyond it (METHOD 1.8, 1.9)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loda_pdal.kernels.clusters import components, count_until, dbscan, linked
from loda_pdal.kernels.neighbours import nearest
from loda_pdal.model.boxes import upright_boxes
from loda_pdal.model.cloud import BoolArray, ByteArray, FloatArray, IntArray
from loda_pdal.model.grid import Lattice
from loda_pdal.model.groups import Groups, consecutive, count_cells, favourites
from loda_pdal.model.labels import ObjectClass
from loda_pdal.params import InstanceParams, SemanticParams
from loda_pdal.stages.crowns import Crowns
from loda_pdal.stages.parked import vehicle_sized
from loda_pdal.stages.semantics import Semantics, fit_planes, voxel_volume


@dataclass(frozen=True)
class Instances:
    """Instances of one epoch.

    Attributes
    ----------
    instance : (m,) int32
        Instance of each voxel, 1 to ``len(object_class)``; 0 none (ground, and fragments too small to stand alone).
    object_class : (o,) uint8
        `ObjectClass` code of instance ``i + 1``.
    classification : (m,) uint8
        Classes of the voxels after instances were judged as wholes.
    """

    instance: IntArray
    object_class: ByteArray
    classification: ByteArray

    def __len__(self) -> int:
        return len(self.object_class)


def form_instances(
    xyz: FloatArray,
    n_raw: IntArray,
    height: FloatArray,
    semantics: Semantics,
    crowns: Crowns | None,
    params: InstanceParams,
    rules: SemanticParams,
) -> Instances:
    """Buildings from planar patches, vegetation by density-adaptive clustering, mobile objects by DBSCAN in plan.

    Parameters
    ----------
    xyz : (m, 3) float64, m
        Fused points.
    n_raw : (m,) int32
        Raw points in each.
    height : (m,) float64, m
        Height above ground.
    semantics : Semantics
        Classes and planes of the segments.
    crowns : Crowns or None
        Where touching crowns part; None where they stay together.

    References
    ----------
    Paper, section 4.2, last paragraph.
    """
    classification = semantics.classification.copy()
    label = np.full(len(xyz), -1, dtype=np.int32)  # of this class so far
    if params.join_by_footprint:
        buildings = _buildings_by_contact(xyz, height, semantics, classification, params, rules)
    else:
        buildings = _buildings_by_patches(xyz, n_raw, semantics, params)
    buildings = with_whole_bodies(buildings, semantics.vehicle)
    classification[buildings >= 0] = ObjectClass.BUILDING
    classification[(buildings < 0) & (classification == ObjectClass.BUILDING)] = ObjectClass.OTHER
    is_vehicle = (buildings < 0) & (semantics.vehicle >= 0)
    classification[is_vehicle] = ObjectClass.MOBILE
    classification[semantics.is_solid & (classification == ObjectClass.VEGETATION)] = ObjectClass.OTHER

    if params.join_by_footprint:
        _judge_clusters(xyz, height, classification, ~is_vehicle, params, rules)
    vegetation = _vegetation(xyz, n_raw, height, classification == ObjectClass.VEGETATION, crowns, params)
    if rules.vehicle_roughness > 0:  # what was looked for and not found is no vehicle
        mobile = np.where(is_vehicle, semantics.vehicle, -1).astype(np.int32)
    else:
        is_mobile = classification == ObjectClass.MOBILE
        is_mobile &= ~_near_ground_edge(xyz, height, classification, params)
        mobile = _mobile(xyz, n_raw, is_mobile, params)
    other = _other(xyz, n_raw, classification, (vegetation >= 0) | (mobile >= 0), params)

    classes: list[ByteArray] = []
    n_so_far = 0
    for part, code in (
        (buildings, ObjectClass.BUILDING),
        (vegetation, ObjectClass.VEGETATION),
        (mobile, ObjectClass.MOBILE),
        (other, ObjectClass.OTHER),
    ):
        numbered, n = consecutive(part)
        label = np.where(numbered >= 0, numbered + n_so_far, label)
        classes.append(np.full(n, code, dtype=np.uint8))
        n_so_far += n
    object_class = np.concatenate(classes)
    if params.annex_gap_m > 0:
        label, object_class = _with_annexes(xyz, height, label, object_class, params, rules)
    is_member = label >= 0
    classification[is_member] = object_class[label[is_member]]
    return Instances((label + 1).astype(np.int32), object_class, classification)


def euclidean_clusters(xyz: FloatArray, radius_m: float, reach_m: FloatArray | None = None) -> IntArray:
    """Clusters (m,) of points linked within ``radius_m``, or within both points' own ``reach_m`` where that is more.

    Numbered from 0 in the order of their first point.
    """
    return consecutive(linked(xyz, radius_m, reach_m))[0]


def _buildings_by_contact(
    xyz: FloatArray,
    height: FloatArray,
    semantics: Semantics,
    classification: ByteArray,
    params: InstanceParams,
    rules: SemanticParams,
) -> IntArray:
    """Building of each voxel, -1 none: planar parts that touch over one footprint, with the pieces they hold."""
    is_building = classification == ObjectClass.BUILDING
    held = _held_by_buildings(height, semantics, classification, rules)
    members = np.flatnonzero(is_building | held[semantics.segment] & (classification != ObjectClass.GROUND))
    label = np.full(len(xyz), -1, dtype=np.int32)
    label[members] = euclidean_clusters(xyz[members], params.building_gap_m)
    if params.roof_step_m > 0:
        cell_m = params.building_gap_m / 2
        label[members] = split_at_steps(
            xyz[members], label[members], cell_m, params.roof_step_m, params.roof_least_m2 / cell_m**2
        )
    return _without_small(label, params.building_min_voxels)


def with_whole_bodies(buildings: IntArray, vehicle: IntArray) -> IntArray:
    """Building of each voxel (m,) once bodies of a vehicle's size that a building holds a good share of are its own: a
    porch is as high as a storey and hangs on to the house there, and one body is one thing.

    ``vehicle`` (m,) is the body of each voxel, -1 none.
    """
    is_of_both = (buildings >= 0) & (vehicle >= 0)
    if not is_of_both.any():
        return buildings
    n = int(vehicle.max()) + 1
    is_held = Groups(vehicle, n).share(buildings >= 0) >= _HELD_SHARE
    body, house, _ = favourites(vehicle[is_of_both], buildings[is_of_both])
    host = np.full(n + 1, -1, dtype=np.int32)
    host[body[is_held[body]]] = house[is_held[body]]
    return np.where(buildings < 0, host[vehicle], buildings)


_HELD_SHARE = 0.2
"""Share of a body that a building holds, from which on it holds all of it."""


def _with_annexes(
    xyz: FloatArray,
    height: FloatArray,
    label: IntArray,
    object_class: ByteArray,
    params: InstanceParams,
    rules: SemanticParams,
) -> tuple[IntArray, ByteArray]:
    """Instances (m,) and their classes after low extensions joined the buildings they stand against.

    From the air the wall above an annex is hardly seen: its roof hangs metres below that of the house, and only in plan
    do the two touch.
    """
    n = len(object_class)
    if n == 0:
        return label, object_class
    groups = Groups(label, n)
    cell_m = params.building_gap_m / 2
    area = count_cells(xyz[:, :2], label, n, cell_m) * cell_m**2
    is_small = np.isin(object_class, (ObjectClass.MOBILE, ObjectClass.OTHER, ObjectClass.BUILDING))
    is_small &= area < params.roof_least_m2
    is_small &= np.nan_to_num(groups.quantile(height, 0.5)) > rules.roof_height_m
    house = np.flatnonzero((object_class == ObjectClass.BUILDING)[label] & (label >= 0) & ~is_small[label])
    annex = np.flatnonzero((label >= 0) & is_small[label])
    if len(house) == 0 or len(annex) == 0:
        return label, object_class
    plan = np.column_stack([xyz[:, :2], np.zeros(len(xyz))])
    found, _ = nearest(plan[house], plan[annex], params.annex_gap_m)
    is_beside = found >= 0
    own, host, contact = favourites(label[annex[is_beside]], label[house[found[is_beside]]])
    is_enough = contact >= _LEAST_CONTACTS
    goal = np.arange(n, dtype=np.int32)
    goal[own[is_enough]] = host[is_enough]
    kept = np.flatnonzero(goal == np.arange(n))
    number = np.full(n + 1, -1, dtype=np.int32)
    number[kept] = np.arange(len(kept), dtype=np.int32)
    return number[np.append(goal, n)[label]], object_class[kept]


_LEAST_CONTACTS = 3
"""Points of an annex that must lie beside its house."""


def split_at_steps(xyz: FloatArray, label: IntArray, cell_m: float, step_m: float, least_cells: float) -> IntArray:
    """Buildings (m,) cut where their roofs step: a row of houses is one building only where one roof covers it.

    Parameters
    ----------
    xyz : (m, 3) float64, m
        Points of buildings.
    label : (m,) int32
        What touches, 0 to n - 1.
    cell_m : float
        Edge of the columns whose highest points are compared with those of the eight columns around.
    step_m : float
        Neighbouring columns that differ by less are one roof.
    least_cells : float
        Roofs of fewer columns join the neighbour with which they share the longest border, however high it stands:
        dormers, chimneys, annexes, and walls beside a roof.
    """
    if len(xyz) == 0:
        return label
    rows = np.column_stack([label.astype(np.int64), np.floor(xyz[:, :2] / cell_m).astype(np.int64)])
    lattice = Lattice.around(rows)
    key, column = np.unique(lattice.keys(rows), return_inverse=True)
    column = column.ravel()
    cell = np.zeros((len(key), 3), dtype=np.int64)
    cell[column] = rows
    top = np.full(len(key), -np.inf)
    np.maximum.at(top, column, xyz[:, 2])
    beside = []
    for step in ((0, 1, 0), (0, 0, 1), (0, 1, 1), (0, 1, -1)):
        found = lattice.find(key, cell + np.array(step))
        here = np.flatnonzero(found >= 0)
        beside.append(np.column_stack([here, found[here]]))
    border = np.concatenate(beside)
    is_level = np.abs(top[border[:, 0]] - top[border[:, 1]]) < step_m
    roof = components(border[is_level], len(key))
    while True:
        n = int(roof.max()) + 1
        size = np.bincount(roof, minlength=n)
        a, b = roof[border[roof[border[:, 0]] != roof[border[:, 1]]]].T
        own, other, _ = favourites(np.concatenate([a, b]), np.concatenate([b, a]))
        is_small = size[own] < least_cells
        if not is_small.any():
            return consecutive(roof[column])[0]
        roof = components(np.column_stack([own, other])[is_small], n)[roof]


def _held_by_buildings(
    height: FloatArray, semantics: Semantics, classification: ByteArray, rules: SemanticParams
) -> BoolArray:
    """Segments (s,) of other classes that belong to the buildings they touch.

    Pieces that reach as high as a building does and are linked to one through such pieces (window bays, dormers,
    corners), and fragments that touch buildings more than everything else but the ground (frames, sills, gutters).
    """
    groups = Groups(semantics.segment, len(semantics.plane_group))
    code = _segment_classes(semantics, classification)
    is_building = code == ObjectClass.BUILDING
    is_free = np.isin(code, (ObjectClass.OTHER, ObjectClass.MOBILE))
    is_high = is_free & (np.nan_to_num(groups.quantile(height, 0.95)) > rules.building_top_m)
    a, b = semantics.adjacency[:, 0], semantics.adjacency[:, 1]
    is_linked = (is_building | is_high)[a] & (is_building | is_high)[b]
    linked = components(semantics.adjacency[is_linked], groups.n)
    has_building = np.zeros(groups.n, np.bool_)
    has_building[linked[is_building]] = True
    is_held = is_building | (is_high & has_building[linked])
    touch = np.zeros((2, groups.n))
    for own, other in ((a, b), (b, a)):
        touch[0] += np.bincount(own, weights=semantics.contact * is_held[other], minlength=groups.n)
        touch[1] += np.bincount(
            own, weights=semantics.contact * (code[other] != ObjectClass.GROUND), minlength=groups.n
        )
    is_fragment = (is_free | (code == ObjectClass.VEGETATION)) & (groups.counts < _FRAGMENT_VOXELS)
    return np.asarray(is_held | (is_fragment & (touch[0] > 0.6 * touch[1]) & (touch[1] > 0)))


_FRAGMENT_VOXELS = 200
"""Larger pieces than this are no fragments of a building, however much they touch it."""


def _segment_classes(semantics: Semantics, classification: ByteArray) -> ByteArray:
    """Class of each segment (s,), its voxels near the ground left aside."""
    code = np.full(len(semantics.plane_group), ObjectClass.GROUND, dtype=np.uint8)
    is_raised = classification != ObjectClass.GROUND
    code[semantics.segment[is_raised]] = classification[is_raised]
    return code


def _buildings_by_patches(xyz: FloatArray, n_raw: IntArray, semantics: Semantics, params: InstanceParams) -> IntArray:
    """Building of each voxel by the paper's rule: merged planar patches, small ones absorbed or dropped."""
    patch = np.where(semantics.classification == ObjectClass.BUILDING, semantics.plane_group[semantics.segment], -1)
    patch, n_patches = consecutive(patch)
    if n_patches == 0:
        return patch
    groups = Groups(patch, n_patches)
    planes = fit_planes(xyz, groups)
    building = np.arange(n_patches, dtype=np.int32)
    if params.merge_patches:
        pairs = _patch_pairs(patch, semantics)
        boxes = upright_boxes(xyz, patch, n_patches)
        a, b = pairs[:, 0], pairs[:, 1]
        is_parallel = np.abs(np.sum(planes.normal[a] * planes.normal[b], axis=1)) >= np.cos(
            np.radians(params.patch_angle_deg)
        )
        building = components(pairs[is_parallel & (boxes.footprint_overlap(a, b) > params.patch_iou)], n_patches)
    points = groups.sum(n_raw)
    total = np.bincount(building, weights=points, minlength=n_patches)
    is_large = total[building] >= params.patch_min_points
    host = _absorbing_patch(planes.centroid, planes, is_large, params.absorb_distance_m)
    building = np.where(is_large, building, np.where(host >= 0, building[np.maximum(host, 0)], -1))
    return np.where(patch >= 0, building[np.maximum(patch, 0)], -1).astype(np.int32)


def _patch_pairs(patch: IntArray, semantics: Semantics) -> np.ndarray:
    """Pairs of patches whose superpoints touch, (e, 2)."""
    of_segment = np.full(len(semantics.plane_group), -1, dtype=np.int64)
    is_member = patch >= 0
    of_segment[semantics.segment[is_member]] = patch[is_member]
    pairs = of_segment[semantics.adjacency]
    return np.asarray(pairs[(pairs >= 0).all(axis=1) & (pairs[:, 0] != pairs[:, 1])])


def _absorbing_patch(centroid: FloatArray, planes, is_large: BoolArray, distance_m: float) -> IntArray:  # type: ignore[no-untyped-def]
    """Nearest large patch of each patch whose plane passes within ``distance_m`` of its centroid, -1 none."""
    host = np.full(len(centroid), -1, dtype=np.int32)
    large = np.flatnonzero(is_large)
    if len(large) == 0:
        return host
    for i in np.flatnonzero(~is_large):
        offset = np.abs(np.sum((centroid[i] - planes.centroid[large]) * planes.normal[large], axis=1))
        reach = np.linalg.norm(centroid[i] - planes.centroid[large], axis=1)
        reach[offset >= distance_m] = np.inf
        if np.isfinite(reach.min()):
            host[i] = large[np.argmin(reach)]
    return host


def _judge_clusters(
    xyz: FloatArray,
    height: FloatArray,
    classification: ByteArray,
    is_asked: BoolArray,
    params: InstanceParams,
    rules: SemanticParams,
) -> None:
    """Give connected vegetation, mobile and other points one class where they clearly are one thing (in place).

    A vehicle's glass and wheels are no superpoints of their own class, and a hedge has smooth patches. So what is
    connected and fits a vehicle's box is judged as a whole; larger clusters (a car under a tree) are taken apart into
    green and other pieces first, and what then is no vehicle but hangs on vegetation is its trunk or twigs.
    """
    is_loose = np.isin(classification, (ObjectClass.VEGETATION, ObjectClass.MOBILE, ObjectClass.OTHER))
    loose = np.flatnonzero(is_loose & is_asked)
    if len(loose) == 0:
        return
    cluster = euclidean_clusters(xyz[loose], params.building_gap_m)
    judged, fits = _judge(xyz[loose], height[loose], classification[loose], cluster, rules)
    code = np.where(fits[cluster], judged[cluster], classification[loose]).astype(np.uint8)

    rest = np.flatnonzero(~fits[cluster] & (code != ObjectClass.VEGETATION))
    green = loose[code == ObjectClass.VEGETATION]
    if len(rest):
        piece = euclidean_clusters(xyz[loose[rest]], params.building_gap_m)
        judged, fits = _judge(xyz[loose[rest]], height[loose[rest]], code[rest], piece, rules)
        is_vehicle = fits & (judged == ObjectClass.MOBILE)
        n_near = np.zeros(len(judged))
        if len(green):
            found, _ = nearest(xyz[green], xyz[loose[rest]], params.building_gap_m)
            n_near = Groups(piece, len(judged)).sum(found >= 0)
        is_twig = ~is_vehicle & (n_near > 0) & (np.bincount(piece, minlength=len(judged)) <= params.twig_voxels)
        code[rest] = np.select(
            [is_vehicle[piece], is_twig[piece]], [ObjectClass.MOBILE, ObjectClass.VEGETATION], ObjectClass.OTHER
        )
    classification[loose] = code


def _judge(
    xyz: FloatArray, height: FloatArray, classification: ByteArray, cluster: IntArray, rules: SemanticParams
) -> tuple[ByteArray, BoolArray]:
    """Class of each cluster seen as a whole, and whether it fits a vehicle's box, (n,) each."""
    n = int(cluster.max()) + 1
    groups = Groups(cluster, n)
    lowest, highest = groups.extremes(height)
    is_within, is_body = vehicle_sized(xyz, cluster, lowest, rules, highest)
    low, high = groups.extremes(xyz[:, 2])
    fits = is_within & (high - low < rules.mobile_height_m)
    fits &= voxel_volume(xyz, cluster, n, 0.5) < rules.mobile_volume_m3
    is_body &= rules.vehicle_roughness == 0
    is_green = groups.share(classification == ObjectClass.VEGETATION) >= 0.5
    judged = np.select([is_green, is_body], [ObjectClass.VEGETATION, ObjectClass.MOBILE], ObjectClass.OTHER).astype(
        np.uint8
    )
    return judged, fits


def _vegetation(
    xyz: FloatArray,
    n_raw: IntArray,
    height: FloatArray,
    is_vegetation: BoolArray,
    crowns: Crowns | None,
    params: InstanceParams,
) -> IntArray:
    """Vegetation instance of each voxel, -1 none: Euclidean clusters, touching crowns split where the preset does."""
    label = np.full(len(xyz), -1, dtype=np.int32)
    members = np.flatnonzero(is_vegetation)
    if len(members) == 0:
        return label
    points = xyz[members]
    if params.is_density_adaptive:
        sphere_m3 = 4.0 / 3.0 * np.pi
        enough = sphere_m3 * (params.cluster_density_factor / params.cluster_radius_m) ** 3  # for the least reach
        density = count_until(points, 1.0, int(enough) + 1) / sphere_m3
        reach = np.maximum(params.cluster_radius_m, params.cluster_density_factor / np.cbrt(density))
        cluster = euclidean_clusters(points, params.cluster_radius_m, reach)
    else:
        cluster = euclidean_clusters(points, params.cluster_radius_m)
    if crowns is not None:
        cluster = crowns.split(points, height[members], cluster)
    label[members] = cluster
    label = _without_small(label, params.vegetation_min_voxels)
    return _without_small(label, params.vegetation_min_points, n_raw)


def _near_ground_edge(
    xyz: FloatArray, height: FloatArray, classification: ByteArray, params: InstanceParams
) -> BoolArray:
    """Mobile points (m,) that lie beyond the ground mask eroded by ``ground_erosion_m``: kerb and facade foot.

    Only points low enough to be part of a kerb are taken; a vehicle's own shadow in the ground does not erode it.
    """
    is_candidate = (classification == ObjectClass.MOBILE) & (height < 2 * params.ground_erosion_m)
    wall = np.flatnonzero(classification == ObjectClass.BUILDING)
    result = np.zeros(len(xyz), np.bool_)
    candidates = np.flatnonzero(is_candidate)
    if len(candidates) == 0 or len(wall) == 0 or params.ground_erosion_m == 0:
        return result
    plan = np.column_stack([xyz[:, :2], np.zeros(len(xyz))])
    found, _ = nearest(plan[wall], plan[candidates], params.ground_erosion_m)
    result[candidates] = found >= 0
    return result


def _mobile(xyz: FloatArray, n_raw: IntArray, is_mobile: BoolArray, params: InstanceParams) -> IntArray:
    """Mobile instance of each voxel, -1 none: DBSCAN in plan, core size counted in raw points."""
    label = np.full(len(xyz), -1, dtype=np.int32)
    members = np.flatnonzero(is_mobile)
    if len(members):
        plan = np.column_stack([xyz[members, :2], np.zeros(len(members))])
        label[members] = consecutive(dbscan(plan, n_raw[members], params.mobile_eps_m, params.mobile_min_points))[0]
    return _without_small(label, params.mobile_min_voxels)


def _other(
    xyz: FloatArray, n_raw: IntArray, classification: ByteArray, is_taken: BoolArray, params: InstanceParams
) -> IntArray:
    """Instance of what has no other class (poles, walls, fences), -1 none: connected points.

    A bollard beside the way is hit often, and yet not large: a few fused points with many raw ones are a thing too.
    """
    label = np.full(len(xyz), -1, dtype=np.int32)
    leftover = np.isin(classification, (ObjectClass.OTHER, ObjectClass.MOBILE, ObjectClass.VEGETATION)) & ~is_taken
    members = np.flatnonzero(leftover)
    if len(members):
        label[members] = euclidean_clusters(xyz[members], params.building_gap_m)
    large = _without_small(label, params.other_min_voxels)
    if params.other_min_points == 0:
        return large
    dense = _without_small(_without_small(label, _LEAST_DENSE), params.other_min_points, n_raw)
    return np.fmax(large, dense)


_LEAST_DENSE = 3
"""Fused points, one above the other, of a thing that many raw points show."""


def _without_small(label: IntArray, least: int, weight: IntArray | None = None) -> IntArray:
    """The labels with those of less than ``least`` points (or total weight) set to -1."""
    is_member = label >= 0
    if not is_member.any():
        return label
    total = np.bincount(label[is_member], weights=None if weight is None else weight[is_member])
    is_kept = is_member & (total[np.maximum(label, 0)] >= least)
    return np.where(is_kept, label, -1).astype(np.int32)
