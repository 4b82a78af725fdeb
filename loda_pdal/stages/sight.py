"""Lines of sight: what a survey saw empty, and what was hidden from it, by the rays of its returns (METHOD 2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from loda_pdal.kernels.parallel import run_ranges
from loda_pdal.kernels.sight import crossed_range
from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array, IntArray, VoxelCloud
from loda_pdal.model.grid import Lattice, cells_of
from loda_pdal.model.survey import Survey
from loda_pdal.model.transform import transform_points
from loda_pdal.params import ObservabilityParams


class Shown(NamedTuple):
    """What the rays of a survey say about voxels, (c,) bool each; neither where no ray comes near.

    ``is_shown``: a return lies in the voxel, or rays passed through it on to a return behind. ``is_hidden``: returns
    lie in front of it, and hardly a ray passed.
    """

    is_shown: BoolArray
    is_hidden: BoolArray

    def corrected(self, is_covered: BoolArray) -> BoolArray:
        """Whether the survey saw each voxel (c,), given whether it has returns in the columns."""
        return (is_covered | self.is_shown) & ~self.is_hidden


@dataclass(frozen=True)
class Sight:
    """Rays of one epoch, one for each fused point and stretch of the trajectory that it was measured from.

    Attributes
    ----------
    sensor : (r, 3) float64, m
        Mean position of the sensor.
    point : (r,) int32
        The fused point that the ray ends at.
    xyz : (m, 3) float64, m
        All fused points.
    params : ObservabilityParams
    """

    sensor: FloatArray
    point: IntArray
    xyz: FloatArray
    params: ObservabilityParams

    def __len__(self) -> int:
        return len(self.sensor)

    def moved(self, T: FloatArray) -> Sight:
        """The same rays after the move ``T`` (4, 4)."""
        return replace(self, sensor=transform_points(T, self.sensor), xyz=transform_points(T, self.xyz))

    def of(self, cell: Int64Array, voxel_m: float) -> Shown:
        """What the rays say about voxels ``cell`` (c, 3) of a lattice of ``voxel_m``, lexicographically sorted."""
        if len(cell) == 0:
            return Shown(np.zeros(0, np.bool_), np.zeros(0, np.bool_))
        lattice, p = Lattice.around(cell), self.params
        passed, hidden = np.zeros(len(cell), dtype=np.int32), np.zeros(len(cell), dtype=np.int32)
        rays = self.sensor, self.xyz[self.point], p.ray_margin_m, p.shadow_from_m, p.shadow_to_m
        run_ranges(
            crossed_range,
            int(lattice.span[0]),
            *rays,
            voxel_m,
            np.ascontiguousarray(cell),
            lattice.low,
            lattice.span,
            passed,
            hidden,
            min_size=8,
        )
        is_hit = np.zeros(len(cell) + 1, np.bool_)
        is_hit[lattice.find(lattice.keys(cell), cells_of(self.xyz, voxel_m))] = True  # the last: in none of them
        is_shown = is_hit[:-1] | (passed >= p.min_rays)
        return Shown(is_shown, ~is_shown & (hidden > 0))


def lines_of_sight(survey: Survey, cloud: VoxelCloud, params: ObservabilityParams) -> Sight | None:
    """The rays of one survey in its local frame; None without a trajectory, or where it is not to be used.

    Parameters
    ----------
    survey : Survey
        Read once more, for its GPS times.
    cloud : VoxelCloud
        Its fused points, in the local frame.
    """
    if survey.trajectory is None or params.method == "coverage" or not params.is_enabled:
        return None
    found, start = _Rays(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0)), 0
    waiting: list[_Rays] = []
    for time in survey.gps_times():
        voxel = cloud.voxel_idx[start : start + len(time)]
        start += len(time)
        sensor = survey.trajectory.at(time)
        is_used = sensor.is_known & (voxel >= 0)
        station = np.floor(sensor.along[is_used] / params.station_m).astype(np.int64)
        key = (voxel[is_used].astype(np.int64) << 32) | station
        waiting.append(_merged([_Rays(key, sensor.xyz[is_used], np.ones(len(key)))]))
        if sum(len(rays.key) for rays in waiting) > len(found.key):  # then each ray is merged a few times only
            found, waiting = _merged([found, *waiting]), []
    found = _merged([found, *waiting])
    point = (found.key >> 32).astype(np.int32)
    return Sight(found.total / found.n[:, None], point, cloud.xyz, params)


class _Rays(NamedTuple):
    """Distinct keys (r,) of fused point and station, ascending; the sum (r, 3) m of the positions, and how many."""

    key: Int64Array
    total: FloatArray
    n: FloatArray


def _merged(parts: list[_Rays]) -> _Rays:
    """Rays of equal keys as one; positions are on the local grid, so that sums are exact."""
    key, which = np.unique(np.concatenate([rays.key for rays in parts]), return_inverse=True)
    total = np.concatenate([rays.total for rays in parts])
    sums = [np.bincount(which, weights=column, minlength=len(key)) for column in total.T]
    n = np.bincount(which, weights=np.concatenate([rays.n for rays in parts]), minlength=len(key))
    return _Rays(key, np.column_stack(sums), np.asarray(n, dtype=np.float64))
