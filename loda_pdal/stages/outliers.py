"""Statistical outlier removal (paper, section 4.1)."""

from __future__ import annotations

import numpy as np

from loda_pdal.kernels.clusters import linked
from loda_pdal.kernels.neighbours import mean_distances, nearest
from loda_pdal.model.cloud import BoolArray, FloatArray, VoxelCloud
from loda_pdal.model.groups import Groups
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
    ``keep_voxels``, what hangs together stays, over wider gaps where little but such points is near: crowns at the far
    end of a street.

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
        lonely, dense = np.flatnonzero(is_outlier), np.flatnonzero(~is_outlier)
        is_kept = _of_large_clusters(xyz[lonely], params.keep_gap_m, params.keep_voxels)
        if params.thin_gap_m > params.keep_gap_m:
            is_apart = nearest(xyz[dense], xyz[lonely], params.thin_gap_m)[0] < 0
            is_kept |= _of_thin_things(xyz[lonely], is_apart, params)
        is_outlier[lonely[is_kept]] = False
    return is_outlier


def _of_large_clusters(xyz: FloatArray, gap_m: float, least: int) -> BoolArray:
    """Which points (k, 3) hang together in clusters of at least so many."""
    cluster = Groups(linked(xyz, gap_m), len(xyz))
    return np.asarray((cluster.counts >= least)[cluster.labels])


def _of_thin_things(xyz: FloatArray, is_apart: BoolArray, params: OutlierParams) -> BoolArray:
    """Which points (k, 3) hang together over wider gaps, where some are apart from all that is sampled densely.

    Only what is no plane: how much of a far wall or roof is seen depends on the way that was taken.
    """
    if len(xyz) == 0:
        return np.zeros(0, np.bool_)
    cluster = Groups(linked(xyz, params.thin_gap_m), len(xyz))
    variance = np.linalg.eigvalsh(cluster.covariance(xyz))[:, 0]
    is_kept = (cluster.counts >= params.keep_voxels) & (cluster.share(is_apart) > _SOME_APART)
    return np.asarray((is_kept & (variance > _THICK_M**2))[cluster.labels])


_SOME_APART = 0.2
"""Share of a thinly sampled thing that lies apart from all that is sampled densely."""

_THICK_M = 0.3
"""Standard deviation of a thing across the plane through it, from which on it is no wall."""


def mean_neighbour_distance(xyz: FloatArray, k: int) -> FloatArray:
    """Mean distance (m,) float64, m, to the k nearest other points, or to all others where there are fewer than k."""
    k = min(k, len(xyz) - 1)
    return mean_distances(xyz, k) if k > 0 else np.zeros(len(xyz))
