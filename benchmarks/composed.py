"""Our pipeline with a library's function wherever there is one: the pipeline that one would compose today.

Exchanged: fusing, outliers and registration (Open3D), features (jakteristics), limit of detection (py4dgeo's M3C2),
neighbours (scipy), clusters (scipy, scikit-learn), voxel proxies (scipy.ndimage). The same code in both: ground
model, partition, class rules, association, change rules and outlines, for which there is no library. Left out of the
composed one, for there is nothing to exchange them with: first pose (NDT), block covariance of the pose, drift.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import jakteristics
import numpy as np
import open3d as o3d
import py4dgeo
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from sklearn.cluster import DBSCAN

from benchmarks import libraries as other
from loda_pdal.kernels import clusters, neighbours
from loda_pdal.model.cloud import VoxelCloud
from loda_pdal.model.grid import cells_of
from loda_pdal.model.groups import consecutive
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.pair import Pair
from loda_pdal.model.registration import Registration
from loda_pdal.params import FeatureParams, FuseParams, LodParams, OutlierParams, Parameters
from loda_pdal.stages import features, fuse, lod, outliers, proxies, registration

Exchange = dict[Callable[..., Any], Callable[..., Any]]


@contextmanager
def composed(threads: int) -> Iterator[None]:
    """Within it, `detect_changes` runs on the libraries: each of our functions is exchanged wherever it is used."""
    modules = [module for name, module in list(sys.modules.items()) if name.startswith("loda_pdal.")]
    py4dgeo.set_num_threads(threads)
    with ExitStack() as stack:
        for ours, theirs in exchanged(threads).items():
            for module in modules:
                for name, value in list(vars(module).items()):
                    if value is ours:
                        stack.enter_context(mock.patch.object(module, name, theirs))
        yield


def exchanged(threads: int) -> Exchange:
    """Our functions and what stands in for them."""

    def knn(
        xyz: Any, k: int, max_distance: float = np.inf, queries: Any = None, *, includes_self: bool = True
    ) -> neighbours.NeighbourTable:
        is_self_left_out = queries is None and not includes_self
        asked = xyz if queries is None else queries
        distance, idx = cKDTree(xyz).query(
            asked, np.arange(1, k + 1) + is_self_left_out, distance_upper_bound=max_distance, workers=threads
        )
        idx = np.where(np.isfinite(distance), idx, -1).astype(np.int32)
        return neighbours.NeighbourTable(idx, distance.astype(np.float32))

    def nearest(xyz: Any, queries: Any, max_distance: float = np.inf) -> tuple[Any, Any]:
        found = knn(xyz, 1, max_distance, queries)
        return found.idx[:, 0], found.distance[:, 0]

    def eigen_features(xyz: Any, height: Any, params: FeatureParams) -> features.Features:
        names = ["linearity", "planarity", "sphericity", "nz", "nx", "ny"]
        found = jakteristics.compute_features(
            xyz, params.radius_m, num_threads=threads, feature_names=names, max_k_neighbors=1000
        )
        is_valid = np.isfinite(found).all(axis=1)
        values = np.empty((len(xyz), 5), np.float32)
        values[:, :4] = np.where(is_valid[:, None], np.abs(found[:, :4]), features.NO_SHAPE)
        values[:, 4] = np.nan_to_num(height)
        normals = np.where(is_valid[:, None], found[:, [4, 5, 3]] * np.where(found[:, 3:4] < 0, -1, 1), 0)
        return features.Features(values, normals.astype(np.float32), is_valid)

    def level_of_detection(before: Any, after: Any, covariance: Any, centre: Any, params: LodParams) -> LodGrid:
        cells = np.unique(cells_of(np.vstack([before, after]), params.cell_m), axis=0)
        sigma = float(np.sqrt(np.trace(covariance[:3, :3]) / 3))
        core = (cells + 0.5) * params.cell_m
        distance, limit, n, normal = other.m3c2_py4dgeo(before, after, core, params, sigma, threads)
        is_valid = np.isfinite(limit) & (n.min(axis=1) >= params.min_points)
        return LodGrid(
            cells.astype(np.int32),
            params.cell_m,
            np.where(is_valid, limit, params.low_observability_m).astype(np.float32),
            np.where(is_valid[:, None], normal, 0).astype(np.float32),
            n[:, 0].astype(np.int32),
            n[:, 1].astype(np.int32),
            is_valid,
            np.where(is_valid, distance, np.nan).astype(np.float32),
            params.low_observability_m,
        )

    return {
        fuse.fuse_survey: lambda survey, params: fuse_points(survey.xyz, params),
        outliers.remove_outliers: remove_outliers,
        registration.register: register,
        lod.level_of_detection: level_of_detection,
        features.eigen_features: eigen_features,
        neighbours.knn: knn,
        neighbours.nearest: nearest,
        clusters.linked: linked,
        clusters.dbscan: dbscan,
        proxies.voxel_components: voxel_components,
    }


def fuse_points(xyz: Any, params: FuseParams) -> VoxelCloud:
    """Mean of each voxel, and the voxel of each point, by Open3D."""
    low = np.floor(xyz.min(axis=0) / params.leaf_m) * params.leaf_m
    cloud, _, traces = other.open3d_cloud(xyz).voxel_down_sample_and_trace(
        params.leaf_m, low, xyz.max(axis=0) + params.leaf_m
    )
    mean = np.asarray(cloud.points)
    order = np.lexsort(np.floor(mean / params.leaf_m).T[::-1])
    members = [np.asarray(trace) for trace in traces]
    n_raw = np.array([len(m) for m in members], dtype=np.int32)[order]
    voxel_idx = np.empty(len(xyz), dtype=np.int32)
    voxel_idx[np.concatenate([members[i] for i in order])] = np.repeat(np.arange(len(order), dtype=np.int32), n_raw)
    return VoxelCloud(mean[order], n_raw, voxel_idx)


def remove_outliers(cloud: VoxelCloud, params: OutlierParams) -> VoxelCloud:
    """Statistical outliers by Open3D."""
    return cloud.subset(~other.outliers_open3d(cloud.xyz, params))


def register(clouds: Pair[VoxelCloud], parameters: Parameters) -> Registration:
    """Pyramid of robust ICP and the inverse of its information matrix, by Open3D."""
    source, target = clouds.before.xyz, clouds.after.xyz
    centre = target.mean(axis=0)
    T = other.icp_open3d(source - centre, target - centre, parameters.icp, parameters.normals)
    information = o3d.pipelines.registration.get_information_matrix_from_point_clouds(
        other.open3d_cloud(source - centre), other.open3d_cloud(target - centre), parameters.icp.radii_m[-1], T
    )
    turn_first = np.linalg.inv(information) * parameters.icp.sigma0_m**2
    order = [3, 4, 5, 0, 1, 2]  # Open3D puts the turn before the shift
    moved = np.array(T)
    moved[:3, 3] += centre - moved[:3, :3] @ centre
    return Registration(moved, "after", turn_first[np.ix_(order, order)], centre, True)


def linked(xyz: Any, radius: float, reach: Any = None) -> Any:
    """Lowest index of each point's cluster, by scipy: all pairs, then connected components."""
    pairs = cKDTree(xyz).query_pairs(radius, output_type="ndarray")
    if reach is not None:
        far = np.flatnonzero(reach > radius)
        if len(far):
            more = far[cKDTree(xyz[far]).query_pairs(reach.max(), output_type="ndarray")]
            distance = np.linalg.norm(xyz[more[:, 0]] - xyz[more[:, 1]], axis=1)
            pairs = np.vstack([pairs, more[distance <= np.minimum(reach[more[:, 0]], reach[more[:, 1]])]])
    graph = coo_array((np.ones(len(pairs), np.int8), pairs.T), shape=(len(xyz),) * 2)
    component = connected_components(graph, directed=False)[1]
    return np.unique(component, return_index=True)[1][component].astype(np.int32)


def dbscan(xyz: Any, weight: Any, eps_m: float, min_weight: int) -> Any:
    """By scikit-learn, cores counted in raw points."""
    found = DBSCAN(eps=eps_m, min_samples=min_weight).fit(xyz, sample_weight=weight)
    return found.labels_.astype(np.int32)


def voxel_components(cells: Any, closing_voxels: int, min_voxels: int) -> Any:
    """Closing and connected components on a dense grid, by scipy.ndimage."""
    if len(cells) == 0:
        return np.zeros(0, dtype=np.int32)
    low = cells.min(axis=0) - closing_voxels - 1
    grid = np.zeros(cells.max(axis=0) - low + closing_voxels + 2, np.bool_)
    grid[tuple((cells - low).T)] = True
    cube = np.ones((3, 3, 3), np.bool_)
    label, _ = ndimage.label(ndimage.binary_closing(grid, cube, closing_voxels), cube)
    size = np.bincount(label.ravel())
    label[size[label] < min_voxels] = 0
    piece = label[tuple((cells - low).T)]
    return consecutive(np.where(piece > 0, piece, -1))[0].astype(np.int32)
