"""The limit of detection as a sparse 3D grid that can be asked anywhere."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from loda_pdal.kernels.lod_pooling import limit_range
from loda_pdal.kernels.parallel import run_ranges
from loda_pdal.model.cloud import BoolArray, Float32Array, FloatArray, IntArray
from loda_pdal.model.transform import transform_points

Z_95 = 1.96
"""Two-sided 95 % of the normal distribution."""


@dataclass(frozen=True)
class LodGrid:
    """LoD95 along the local surface normal in the occupied cells (paper, equation 2).

    Attributes
    ----------
    cells : (c, 3) int32
        Cell indices, lexicographically sorted, unique; a cell's centre is ``(cells + 0.5) * cell_m`` in the
        analysis frame.
    cell_m : float
        Edge of a cell, m.
    lod95 : (c,) float32, m
        Detection limit; the low-observability value where the cell is not valid.
    normal : (c, 3) float32
        Unit normal of the pooled points; zero where the cell is not valid.
    n_before, n_after : (c,) int32
        Pooled points of each epoch.
    is_valid : (c,) bool
        Whether both epochs have enough points and a plane.
    displacement : (c,) float32, m
        Difference of the two epochs' mean offsets along ``normal``, after minus before; NaN where not valid.
    low_observability_m : float
        The value where nothing is valid, m.
    drift : (3, 3) float64, m2
        Covariance of what the epochs disagree by beyond noise and pose: trajectories drift.
    pose : (6, 6) float64
        Covariance of the twist (tx, ty, tz, rx, ry, rz) left between the epochs, m and rad.
    centre : (3,) float64, m
        Where the twist turns.
    """

    cells: IntArray
    cell_m: float
    lod95: Float32Array
    normal: Float32Array
    n_before: IntArray
    n_after: IntArray
    is_valid: BoolArray
    displacement: Float32Array
    low_observability_m: float
    drift: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    pose: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    centre: FloatArray = field(default_factory=lambda: np.zeros(3))

    @property
    def centres(self) -> FloatArray:
        """Cell centres, (c, 3) m, in the analysis frame."""
        return np.asarray((self.cells + 0.5) * self.cell_m, dtype=np.float64)

    def centres_after(self, T_after_frame: FloatArray) -> FloatArray:
        """Cell centres, (c, 3) m, in the after frame."""
        return transform_points(T_after_frame, self.centres)

    def at(self, xyz: FloatArray) -> FloatArray:
        """LoD95 (k,) m at points (k, 3) of the analysis frame, linear between valid neighbouring cell centres.

        Where none of the eight neighbours is valid the answer is ``low_observability_m``.
        """
        if len(self.cells) == 0 or len(xyz) == 0:
            return np.full(len(xyz), self.low_observability_m)
        result = np.empty(len(xyz))
        run_ranges(
            limit_range,
            len(xyz),
            np.ascontiguousarray(xyz, dtype=np.float64),
            self.cells,
            float(self.cell_m),
            self.lod95,
            self.is_valid,
            float(self.low_observability_m),
            result,
        )
        return result

    def limit_of(self, variance: FloatArray, xyz: FloatArray, normal: FloatArray) -> FloatArray:
        """LoD95 (k,) m of displacements along unit normals (k, 3) at points (k, 3), whose noise has the variance (k,).

        The limit of what is not a cell, a raster tile for one: the same pose and drift, and a noise of its own.
        """
        jacobian = pose_jacobian(xyz, normal, self.centre)
        return Z_95 * np.sqrt(variance + along(jacobian, self.pose) + along(normal, self.drift))


def pose_jacobian(xyz: FloatArray, normal: FloatArray, centre: FloatArray) -> FloatArray:
    """Displacement along ``normal`` (k, 3) at points (k, 3) per twist about ``centre``: (k, 6).

    n' [I, -[p - c]x] (METHOD 1.4).
    """
    return np.hstack([normal, np.cross(xyz - centre, normal)])


def along(direction: FloatArray, covariance: FloatArray) -> FloatArray:
    """Variance (k,) along the rows of ``direction`` (k, d) of what has the covariance (d, d)."""
    return np.asarray(np.einsum("ki,ij,kj->k", direction, covariance, direction))
