"""Which voxels a ray crosses, one ray and one voxel at a time."""

from __future__ import annotations

import numpy as np

from loda_pdal.model.cloud import FloatArray, Int64Array, IntArray


def crossed(
    origin: FloatArray, target: FloatArray, margin: float, near: float, far: float, edge: float, cell: Int64Array
) -> tuple[IntArray, IntArray]:
    """Rays that pass each voxel (c, 3), and those that go down and whose return keeps them from it, (c,) each."""
    passed, hidden = np.zeros(len(cell), np.int32), np.zeros(len(cell), np.int32)
    for o, end in zip(origin, target, strict=True):
        length = float(np.linalg.norm(end - o))
        if length <= margin:
            continue
        d = (end - o) / length
        for v, (low, high) in enumerate(zip(cell * edge, (cell + 1) * edge, strict=True)):
            enter, leave = 0.0, length + far
            for axis in range(3):
                if d[axis] != 0:
                    at = sorted(((low[axis] - o[axis]) / d[axis], (high[axis] - o[axis]) / d[axis]))
                    enter, leave = max(enter, at[0]), min(leave, at[1])
                elif not low[axis] <= o[axis] < high[axis]:
                    leave = -1.0
            if enter < leave:
                passed[v] += leave <= length - margin
                hidden[v] += enter >= length + near and d[2] < 0
    return passed, hidden
