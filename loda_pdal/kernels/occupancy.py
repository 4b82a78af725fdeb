"""Whose the occupied voxels are, and what the objects show in the columns of the voxels.

Points are sorted by slot, two for each voxel: ``2 v`` holds the points that the before epoch has in voxel v,
``2 v + 1`` those of the after epoch; voxels are sorted by column. Objects are numbered 0 to n - 1, -1 is none.
"""

from __future__ import annotations

import numpy as np

from loda_pdal.kernels.compiled import kernel


@kernel
def holder_range(start, stop, starts, owner, n_raw, n, holder, n_held):  # type: ignore[no-untyped-def]
    """Object that has each slot [start, stop): the one with most raw points in it, the lowest of several.

    Parameters
    ----------
    starts : (s + 1,) int64
        First point of each slot.
    owner, n_raw : (k,) int32
        Object of each point, and its raw points.
    n : int
        Number of objects.
    holder : (s,) int32
        Filled; -1 where no point has an object.
    n_held : (s,) float64
        Filled with the raw points of the holder.
    """
    total = np.zeros(n, dtype=np.int64)
    for slot in range(start, stop):
        for p in range(starts[slot], starts[slot + 1]):
            if owner[p] >= 0:
                total[owner[p]] += n_raw[p]
        best, most = -1, 0
        for p in range(starts[slot], starts[slot + 1]):
            o = owner[p]
            if o >= 0 and (best < 0 or total[o] > most or (total[o] == most and o < best)):
                best, most = o, total[o]
        for p in range(starts[slot], starts[slot + 1]):
            if owner[p] >= 0:
                total[owner[p]] = 0
        holder[slot], n_held[slot] = best, most


@kernel
def column_top_range(start, stop, columns, starts, owner, z, is_counted, n, column_owner, top):  # type: ignore[no-untyped-def]
    """Highest point that each object has in each of the columns [start, stop), by epoch.

    Parameters
    ----------
    columns : (b + 1,) int64
        First voxel of each column.
    starts, owner : see `holder_range`
    z : (k,) float64, m
    is_counted : (k,) bool
        Other points do not count.
    n : int
        Number of objects.
    column_owner : (k,) int32, top : (k, 2) float64, m
        One entry for each object in each column, in the places of the column's points; all else stays as it is.
        ``top`` is NaN in the epoch in which the object has no point there.
    """
    entry = np.empty(n, dtype=np.int64)
    for owned in range(n):
        entry[owned] = -1
    for column in range(start, stop):
        first = starts[2 * columns[column]]
        last = first
        for slot in range(2 * columns[column], 2 * columns[column + 1]):
            epoch = slot & 1
            for p in range(starts[slot], starts[slot + 1]):
                if owner[p] < 0 or not is_counted[p]:
                    continue
                if entry[owner[p]] < 0:
                    entry[owner[p]] = last
                    column_owner[last] = owner[p]
                    top[last, 0] = top[last, 1] = np.nan
                    last += 1
                e = entry[owner[p]]
                if not z[p] <= top[e, epoch]:
                    top[e, epoch] = z[p]
        for e in range(first, last):
            entry[column_owner[e]] = -1


@kernel
def shared_column_range(start, stop, columns, holder, n, is_shared):  # type: ignore[no-untyped-def]
    """Which slots of the columns [start, stop) belong to an object that holds voxels of the column in both epochs.

    Parameters
    ----------
    columns : (b + 1,) int64
        First voxel of each column.
    holder : (c, 2) int32
        Object that has each voxel before and after.
    n : int
        Number of objects.
    is_shared : (c, 2) bool
        Filled.
    """
    is_in = np.empty((n + 1, 2), dtype=np.bool_)  # the last is none
    for owned in range(n + 1):
        is_in[owned, 0] = is_in[owned, 1] = False
    for column in range(start, stop):
        for epoch in range(2):
            for v in range(columns[column], columns[column + 1]):
                is_in[holder[v, epoch], epoch] = True
        is_in[n, 0] = is_in[n, 1] = False
        for epoch in range(2):
            for v in range(columns[column], columns[column + 1]):
                is_shared[v, epoch] = is_in[holder[v, epoch], 0] and is_in[holder[v, epoch], 1]
        for epoch in range(2):
            for v in range(columns[column], columns[column + 1]):
                is_in[holder[v, epoch]] = False
