"""The move between the epochs: first pose by NDT, then ICP (paper, section 4.1).

One epoch stands still, chosen by what the clouds hold and not by which is older: so swapping the epochs gives exactly
the inverse.
"""

from __future__ import annotations

import numpy as np

from loda_pdal.kernels.neighbours import nearest
from loda_pdal.model.cloud import FloatArray, VoxelCloud
from loda_pdal.model.pair import Pair, at_once
from loda_pdal.model.registration import Registration
from loda_pdal.model.transform import IDENTITY, invert, transform_points
from loda_pdal.params import Parameters
from loda_pdal.stages.fuse import downsample
from loda_pdal.stages.icp import FinePose, Surface, fine_pose
from loda_pdal.stages.ndt import coarse_pose

MISFIT_LEAF_M = 1.0
"""Source points are thinned to this before two poses are compared."""

MISFIT_LIMIT_M = 2.0
"""Points farther than this from the other cloud count as this far: they have no partner in any pose."""

MIN_GAIN = 0.05
"""A pose replaces a simpler one only where it lowers the misfit by this share; sliding along a surface changes it by
up to half of that, as the voxel grids come and go into step."""


def register(clouds: Pair[VoxelCloud], parameters: Parameters) -> Registration:
    """Rigid move of the before epoch onto the after epoch, with its uncertainty.

    Parameters
    ----------
    clouds : Pair of VoxelCloud
        Both epochs, fused, in one local frame.
    parameters : Parameters
        Of which ``ndt``, ``icp`` and ``normals`` are used.

    Returns
    -------
    Registration
        Where it is not ``converged``, ``message`` says why, and the pose is the better one of what was found and of
        leaving the clouds as they are.
    """
    reference = choose_reference(clouds)
    source, target = (
        (clouds.before.xyz, clouds.after.xyz) if reference == "after" else (clouds.after.xyz, clouds.before.xyz)
    )
    pose = _find_pose(source, target, parameters)
    T = pose.T_target_source
    if not pose.converged:
        T = better_pose(source, target, IDENTITY.copy(), T)
    return Registration(
        T_after_before=invert(invert(T)) if reference == "after" else invert(T),  # so that a swap rounds alike
        reference=reference,
        covariance=pose.covariance,
        centre=pose.centre,
        converged=pose.converged,
        iterations=pose.iterations,
        n_pairs=pose.n_pairs,
        rmse_m=pose.rmse_m,
        overlap=pose.overlap,
        message=pose.message,
    )


def _find_pose(source_xyz: FloatArray, target_xyz: FloatArray, parameters: Parameters) -> FinePose:
    """ICP from the first pose; where that fails, ICP from where the clouds are, unless that is clearly worse."""
    start = IDENTITY.copy()
    first = start
    if parameters.ndt.is_enabled:
        coarse = coarse_pose(source_xyz, target_xyz, parameters.ndt)
        first = better_pose(source_xyz, target_xyz, start, coarse.T_target_source)
    source, target = at_once(lambda xyz: Surface.of(xyz, parameters.normals), Pair(source_xyz, target_xyz))
    pose = fine_pose(source, target, first, parameters.icp, parameters.normals)
    if pose.converged or first is start:
        return pose
    alone = fine_pose(source, target, start, parameters.icp, parameters.normals)
    T = better_pose(source_xyz, target_xyz, alone.T_target_source, pose.T_target_source)
    return alone if alone.converged or T is alone.T_target_source else pose


def choose_reference(clouds: Pair[VoxelCloud]) -> str:
    """The epoch that stands still: the one with more voxels, else the one with the larger coordinate sums."""
    before, after = clouds.map(len)
    if before != after:
        return "before" if before > after else "after"
    sums = clouds.map(lambda cloud: tuple(cloud.xyz.sum(axis=0)))
    return "before" if sums.before > sums.after else "after"


def better_pose(
    source_xyz: FloatArray, target_xyz: FloatArray, T_simple: FloatArray, T_found: FloatArray
) -> FloatArray:
    """``T_found`` where it lays the source (m, 3) clearly better on the target (n, 3) than ``T_simple``, else that.

    What counts is the mean distance of the source points to the target, each at most `MISFIT_LIMIT_M`.
    """
    if len(source_xyz) == 0 or len(target_xyz) == 0:
        return T_simple
    points = downsample(source_xyz, MISFIT_LEAF_M)
    moved = np.vstack([transform_points(T, points) for T in (T_simple, T_found)])
    _, distance = nearest(target_xyz, moved, MISFIT_LIMIT_M)
    simple, found = np.minimum(distance, MISFIT_LIMIT_M).reshape(2, -1).mean(axis=1, dtype=np.float64)
    return T_found if found < (1 - MIN_GAIN) * simple else T_simple
