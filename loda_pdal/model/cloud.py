"""Point clouds in local coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
Float32Array: TypeAlias = npt.NDArray[np.float32]
IntArray: TypeAlias = npt.NDArray[np.int32]
Int64Array: TypeAlias = npt.NDArray[np.int64]
ByteArray: TypeAlias = npt.NDArray[np.uint8]
BoolArray: TypeAlias = npt.NDArray[np.bool_]

LOCAL_GRID = 2.0**-16
"""Local coordinates are whole multiples of this (15 micrometres): sums of them are exact in float64, so that
means do not depend on the order of the points, and a shift of the whole map changes nothing."""

ORIGIN_STEP = 1000
"""The common local origin of both epochs is a multiple of this many metres: every grid edge divides it."""


def to_local_grid(xyz: FloatArray) -> FloatArray:
    """Round local coordinates, (n, 3) in metres, to whole multiples of `LOCAL_GRID`."""
    rounded: FloatArray = xyz / LOCAL_GRID
    np.rint(rounded, out=rounded)
    rounded *= LOCAL_GRID
    return rounded


@dataclass(frozen=True)
class VoxelCloud:
    """One epoch, fused: one point per occupied voxel of the finest pyramid level, in cell order.

    Attributes
    ----------
    xyz : (m, 3) float64, m
        Mean of the raw points of each voxel, in local coordinates.
    n_raw : (m,) int32
        How many raw points each voxel holds.
    voxel_idx : (n,) int32
        Voxel of each raw point; -1 where the point was taken out as noise.
    """

    xyz: FloatArray
    n_raw: IntArray
    voxel_idx: IntArray

    def __len__(self) -> int:
        return len(self.xyz)

    def moved(self, xyz: FloatArray) -> VoxelCloud:
        """The same voxels at other coordinates."""
        return VoxelCloud(xyz, self.n_raw, self.voxel_idx)

    def subset(self, is_kept: BoolArray) -> VoxelCloud:
        """The voxels where ``is_kept``, (m,) bool; raw points of the others get voxel -1."""
        new_idx = np.full(len(self) + 1, -1, dtype=np.int32)  # the last is for points without a voxel, -1
        new_idx[:-1][is_kept] = np.arange(np.count_nonzero(is_kept), dtype=np.int32)
        return VoxelCloud(self.xyz[is_kept], self.n_raw[is_kept], new_idx[self.voxel_idx])
