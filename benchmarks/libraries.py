"""Each library's way to do what one of our stages does, with the parameters of that stage (preset street).

Building trees and converting arrays is part of the work, ours as theirs. Results are arrays, so that tests can check
that all do the same.
"""

from __future__ import annotations

import logging
from typing import Any

import jakteristics
import numpy as np
import open3d as o3d
import pgeof
import py4dgeo
import small_gicp
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from loda_pdal.model.transform import IDENTITY
from loda_pdal.params import FeatureParams, IcpParams, LodParams, NormalParams, OutlierParams

logging.getLogger("py4dgeo").handlers.clear()  # they would leave a log file wherever one is
registration = o3d.pipelines.registration


def open3d_cloud(xyz: Any) -> Any:
    """Points (m, 3) as Open3D holds them."""
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz))


# --- k nearest neighbours of every point: squared or plain distances, ascending; the point itself comes first


def knn_scipy(xyz: Any, k: int, threads: int) -> Any:
    """Distances (m, k + 1) and neighbours, by scipy's tree in parallel."""
    return cKDTree(xyz).query(xyz, k + 1, workers=threads)


def knn_pgeof(xyz: Any, k: int) -> Any:
    """Squared distances and neighbours, by pgeof (nanoflann), float32."""
    local = np.asarray(xyz - np.round(xyz.mean(axis=0)), dtype=np.float32)
    idx, sq_distance = pgeof.knn_search(local, local, k + 1)
    return sq_distance, idx


def knn_small_gicp(xyz: Any, k: int, threads: int) -> Any:
    """Squared distances and neighbours, by small_gicp."""
    idx, sq_distance = small_gicp.KdTree(xyz, threads).batch_knn_search(xyz, k + 1, threads)
    return sq_distance, idx


def knn_open3d(xyz: Any, k: int) -> Any:
    """Squared distances and neighbours, by Open3D's tensor search (nanoflann), float32."""
    local = o3d.core.Tensor(np.asarray(xyz - np.round(xyz.mean(axis=0)), dtype=np.float32))
    search = o3d.core.nns.NearestNeighborSearch(local)
    search.knn_index()
    idx, sq_distance = search.knn_search(local, k + 1)
    return sq_distance.numpy(), idx.numpy()


def symmetric_scipy(idx: Any) -> Any:
    """Graph that joins i and j where either lists the other (idx is (m, k)), as a sparse matrix in compressed rows."""
    m, k = idx.shape
    tails = np.repeat(np.arange(m, dtype=np.int32), k)
    one_way = coo_array((np.ones(m * k, np.int8), (tails, idx.ravel().astype(np.int32))), shape=(m, m)).tocsr()
    return one_way.maximum(one_way.T.tocsr())


# --- statistical outliers, (m,) bool


def outliers_open3d(xyz: Any, params: OutlierParams) -> Any:
    """By Open3D; it counts a point among its own neighbours, so it is asked for one more."""
    _, kept = open3d_cloud(xyz).remove_statistical_outlier(params.k + 1, params.std_multiplier)
    is_outlier = np.ones(len(xyz), np.bool_)
    is_outlier[np.asarray(kept)] = False
    return is_outlier


def outliers_scipy(xyz: Any, params: OutlierParams, threads: int) -> Any:
    """By scipy's tree and numpy."""
    distance = knn_scipy(xyz, params.k, threads)[0][:, 1:].mean(axis=1)
    return distance > distance.mean() + params.std_multiplier * distance.std(ddof=1)


# --- fusing, normals, features


def fuse_open3d(xyz: Any, leaf_m: float) -> Any:
    """Mean point of every voxel, in any order. Ours also says which voxel each point is in."""
    low = np.floor(xyz.min(axis=0) / leaf_m) * leaf_m
    high = xyz.max(axis=0) + leaf_m
    cloud, _, _ = open3d_cloud(xyz).voxel_down_sample_and_trace(leaf_m, low, high)
    return np.asarray(cloud.points)


def fuse_open3d_untraced(xyz: Any, leaf_m: float) -> Any:
    """The same without knowing which points made a voxel, on a grid of Open3D's own choice."""
    return np.asarray(open3d_cloud(xyz).voxel_down_sample(leaf_m).points)


def normals_open3d(xyz: Any, params: NormalParams) -> Any:
    """Normals only; ours are rejected where there is no plane, and come with the roughness."""
    cloud = open3d_cloud(xyz)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(params.radius_m, params.max_neighbours))
    return np.asarray(cloud.normals)


def features_jakteristics(xyz: Any, params: FeatureParams, threads: int) -> Any:
    """Linearity, planarity, sphericity and |n.z|, (m, 4)."""
    names = ["linearity", "planarity", "sphericity", "verticality"]
    found = jakteristics.compute_features(
        xyz, params.radius_m, num_threads=threads, feature_names=names, max_k_neighbors=1000
    )
    found[:, 3] = 1 - found[:, 3]
    return found


def features_pgeof(xyz: Any, params: FeatureParams) -> Any:
    """The same by pgeof; it caps the neighbours, here at more than there are."""
    ids = pgeof.EFeatureID
    local = np.asarray(xyz - np.round(xyz.mean(axis=0)), dtype=np.float32)
    found = pgeof.compute_features_selected(
        local, params.radius_m, 1000, [ids.Linearity, ids.Planarity, ids.Scattering, ids.Normal_z]
    )
    found[:, 3] = np.abs(found[:, 3])
    return found


# --- registration: (4, 4) that moves the source onto the target


def icp_open3d(
    source: Any, target: Any, params: IcpParams, normals: NormalParams, is_stopped: bool = True, start: Any = IDENTITY
) -> Any:
    """Point to plane with Tukey's loss, by Open3D, level by level; normals of the target only, for it needs no others.

    Without ``is_stopped`` all iterations are made.
    """
    clouds = [open3d_cloud(xyz) for xyz in (source, target)]
    clouds[1].estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(normals.radius_m, normals.max_neighbours))
    method = registration.TransformationEstimationPointToPlane(registration.TukeyLoss(params.tukey_m))
    relative = 1e-6 if is_stopped else 0.0
    T = start
    for leaf_m, radius_m, n in zip(params.leaves_m, params.radii_m, params.max_iterations, strict=True):
        thinned = [cloud.voxel_down_sample(leaf_m) if leaf_m > params.leaves_m[-1] else cloud for cloud in clouds]
        criteria = registration.ICPConvergenceCriteria(relative, relative, n)
        T = registration.registration_icp(*thinned, radius_m, T, method, criteria).transformation
    return T


def icp_small_gicp(source: Any, target: Any, kind: str, params: IcpParams, threads: int) -> Any:
    """The last level by small_gicp (``PLANE_ICP`` or ``GICP``), which has no robust loss, with its own normals or
    covariances of both clouds; all iterations are made."""
    found = small_gicp.align(
        target,
        source,
        registration_type=kind,
        downsampling_resolution=params.leaves_m[-1],
        max_correspondence_distance=params.radii_m[-1],
        num_threads=threads,
        max_iterations=params.max_iterations[-1],
        rotation_epsilon=0.0,
        translation_epsilon=0.0,
    )
    return found.T_target_source


# --- limit of detection


def m3c2_py4dgeo(before: Any, after: Any, core: Any, params: LodParams, registration_error: float, threads: int) -> Any:
    """Distances, limits of detection, counts (c, 2) and normals at core points (c, 3), by M3C2 with cylinders as wide
    as our spheres; normals from the before epoch."""
    py4dgeo.set_num_threads(threads)
    epochs = tuple(py4dgeo.Epoch(np.ascontiguousarray(xyz)) for xyz in (before, after))
    method = py4dgeo.M3C2(
        epochs=epochs,
        corepoints=np.ascontiguousarray(core),
        normal_radii=(params.radius_m,),
        cyl_radius=params.radius_m,
        max_distance=params.radius_m,
        registration_error=registration_error,
    )
    distance, found = method.run()
    counts = np.column_stack([found["num_samples1"], found["num_samples2"]])
    return distance, found["lodetection"], counts, method.directions()
