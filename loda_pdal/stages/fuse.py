"""Raw points to one point per voxel (paper, section 4.1: the fused map).

A fused point is the mean of the raw points in its voxel. Local coordinates are whole multiples of `LOCAL_GRID`, so the
sums are exact and the result does not depend on the order of the points.
"""

from __future__ import annotations

import math

import numpy as np

from loda_pdal.kernels.parallel import run_ranges
from loda_pdal.kernels.voxels import fill_table, number_distinct, voxel_key_range
from loda_pdal.model.cloud import FloatArray, Int64Array, IntArray, VoxelCloud
from loda_pdal.model.errors import InputError
from loda_pdal.params import FuseParams


def fuse_points(xyz: FloatArray, params: FuseParams) -> VoxelCloud:
    """One mean point per occupied voxel, sorted by voxel (x first, then y, then z).

    Parameters
    ----------
    xyz : (n, 3) float64, m
        Raw points in local coordinates.
    params : FuseParams
        Edge of the voxels; voxel edges lie on its multiples.

    Returns
    -------
    VoxelCloud
        Means, raw points per voxel, and the voxel of every raw point.
    """
    voxel_idx, n_voxels = voxel_of_point(xyz, params.leaf_m)
    n_raw = np.bincount(voxel_idx, minlength=n_voxels).astype(np.int32)
    return VoxelCloud(mean_of_voxels(xyz, voxel_idx, n_voxels), n_raw, voxel_idx)


def downsample(xyz: FloatArray, leaf_m: float) -> FloatArray:
    """Mean point (v, 3) of each occupied voxel of ``leaf_m`` (m) of a cloud (n, 3), in voxel order."""
    return mean_of_voxels(xyz, *voxel_of_point(xyz, leaf_m))


def mean_of_voxels(xyz: FloatArray, voxel_idx: IntArray, n_voxels: int) -> FloatArray:
    """Mean point (v, 3) of the points (n, 3) of each voxel, given the voxel of each point (n,)."""
    count = np.bincount(voxel_idx, minlength=n_voxels)
    mean = np.empty((n_voxels, 3))
    for axis in range(3):
        mean[:, axis] = np.bincount(voxel_idx, weights=xyz[:, axis], minlength=n_voxels) / count
    return mean


def voxel_of_point(xyz: FloatArray, leaf_m: float) -> tuple[IntArray, int]:
    """Voxel of each point (n,), numbered in the order of the occupied voxels, and how many are occupied."""
    if len(xyz) == 0:
        return np.zeros(0, dtype=np.int32), 0
    number, distinct = _numbered(_voxel_keys(xyz, leaf_m))
    rank = np.empty(len(distinct), dtype=np.int32)
    rank[np.argsort(distinct)] = np.arange(len(distinct), dtype=np.int32)
    return rank[number], len(distinct)


def _numbered(key: Int64Array) -> tuple[IntArray, Int64Array]:
    """Number of each key (n,) in the order of appearance, and the distinct keys in that order."""
    number = np.empty(len(key), dtype=np.int32)
    size = 1 << 16
    distinct = np.empty(0, dtype=np.int64)
    reached = n_distinct = 0
    while reached < len(key):
        size *= 4
        table = np.full(size, -1, dtype=np.int32)
        distinct = np.append(distinct, np.empty(size // 2 - len(distinct), dtype=np.int64))
        fill_table(table, distinct, n_distinct)
        reached, n_distinct = number_distinct(key, reached, table, distinct, n_distinct, number)
    return number, distinct[:n_distinct]


def _voxel_keys(xyz: FloatArray, leaf_m: float) -> Int64Array:
    low = np.array([np.floor(xyz[:, axis].min() / leaf_m) for axis in range(3)], dtype=np.int64)
    high = np.array([np.floor(xyz[:, axis].max() / leaf_m) for axis in range(3)], dtype=np.int64)
    n_x, n_y, n_z = (int(n) for n in high - low + 1)
    if math.log2(n_x) + math.log2(n_y) + math.log2(n_z) > 62:
        extent = " x ".join(f"{n * leaf_m:.3g}" for n in (n_x, n_y, n_z))
        raise InputError(
            f"The survey spans {extent} m, too far for voxels of {leaf_m} m.",
            "Remove stray points far from the rest, or raise fuse.leaf_m.",
            "extent-absurd",
        )
    key = np.empty(len(xyz), dtype=np.int64)
    run_ranges(voxel_key_range, len(xyz), np.ascontiguousarray(xyz), float(leaf_m), low, n_y, n_z, key)
    return key
