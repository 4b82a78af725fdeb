"""Statistical outlier removal (paper, section 4.1)."""

from __future__ import annotations

import numpy as np

from loda_pdal.kernels.clusters import linked
from loda_pdal.kernels.neighbours import mean_distances
from loda_pdal.model.cloud import BoolArray, FloatArray, VoxelCloud
from loda_pdal.params import OutlierParams


def remove_outliers(cloud: VoxelCloud, params: OutlierParams) -> VoxelCloud:
    """The voxels that are not statistical outliers; raw points of the others get voxel -1.

    Parameters
    ----------
    cloud : VoxelCloud
        One epoch, fused.
    params : OutlierParams
        Neighbours and threshold; nothing is removed where it is not enabled.
    """
    if not params.is_enabled or len(cloud) == 0:
        return cloud
    return cloud.subset(~find_outliers(cloud.xyz, params))


def find_outliers(xyz: FloatArray, params: OutlierParams) -> BoolArray:
    """Points whose mean distance to their k nearest neighbours exceeds mean + multiplier * standard deviation.

    The neighbours of a thin pole lie along one line, and a wall far from the scanner is sampled thinly: with
    ``keep_voxels``, what hangs together stays.

    Parameters
    ----------
    xyz : (m, 3) float64, m
    params : OutlierParams

    Returns
    -------
    (m,) bool
        Mean and (sample) standard deviation are sums in ascending order, so the order of the points does not matter.
    """
    distance = mean_neighbour_distance(xyz, params.k)
    if len(distance) < 2:
        return np.zeros(len(distance), dtype=np.bool_)
    ascending = np.sort(distance)
    is_outlier = np.asarray(distance > ascending.mean() + params.std_multiplier * ascending.std(ddof=1))
    if params.keep_voxels > 0:
        lonely = np.flatnonzero(is_outlier)
        cluster = linked(xyz[lonely], params.keep_gap_m)
        is_outlier[lonely] = np.bincount(cluster, minlength=len(lonely))[cluster] < params.keep_voxels
    return is_outlier


def mean_neighbour_distance(xyz: FloatArray, k: int) -> FloatArray:
    """Mean distance (m,) float64, m, to the k nearest other points, or to all others where there are fewer than k."""
    k = min(k, len(xyz) - 1)
    return mean_distances(xyz, k) if k > 0 else np.zeros(len(xyz))
