"""Voxel keys, one integer per point that sorts points by voxel (x first, then y, then z), and their distinct values."""

from __future__ import annotations

from typing import Any

import numpy as np

from loda_pdal.kernels.compiled import inner, kernel


@kernel
def voxel_key_range(start: int, stop: int, xyz: Any, leaf: float, low: Any, n_y: int, n_z: int, key: Any) -> None:
    """Keys of points [start, stop).

    Parameters
    ----------
    xyz : (n, 3) float64, m
    leaf : float, m
        Edge of a voxel; voxel (i, j, k) starts at (i, j, k) * leaf.
    low : (3,) int64
        Lowest voxel along each axis.
    n_y, n_z : int
        Voxels along y and z.
    key : (n,) int64
        Filled with ((i - low_x) * n_y + j - low_y) * n_z + k - low_z.
    """
    for p in range(start, stop):
        i = int(np.floor(xyz[p, 0] / leaf)) - low[0]
        j = int(np.floor(xyz[p, 1] / leaf)) - low[1]
        k = int(np.floor(xyz[p, 2] / leaf)) - low[2]
        key[p] = (i * n_y + j) * n_z + k


@kernel
def number_distinct(key: Any, first: int, table: Any, distinct: Any, n_distinct: int, number: Any) -> tuple[int, int]:
    """Number distinct keys in the order in which they appear, until the hash table is half full.

    Parameters
    ----------
    key : (n,) int64
    first : int
        Keys before this are numbered already.
    table : (a power of two,) int32
        Number of the key in each slot, -1 where free; holds what ``distinct`` holds.
    distinct : (at least half of the table,) int64
        The distinct keys found; the first ``n_distinct`` are given.
    number : (n,) int32
        Filled with the number of each key.

    Returns
    -------
    reached, n_distinct : int
        The first key that is not numbered yet, n at the end; and how many distinct keys there are so far.
    """
    for p in range(first, len(key)):
        slot = _slot_of(key[p], table, distinct)
        if table[slot] < 0:
            if 2 * (n_distinct + 1) > len(table):
                return p, n_distinct
            table[slot] = n_distinct
            distinct[n_distinct] = key[p]
            n_distinct += 1
        number[p] = table[slot]
    return len(key), n_distinct


@kernel
def add_points(number: Any, xyz: Any, total: Any, count: Any) -> None:
    """Add points to the sums of their voxels.

    Parameters
    ----------
    number : (n,) int32
        Voxel of each point.
    xyz : (n, 3) float64, m
    total : (m, 3) float64, m
        Sums of the coordinates of each voxel.
    count : (m,) int32
        Points of each voxel.
    """
    for p in range(len(number)):
        v = number[p]
        total[v, 0] += xyz[p, 0]
        total[v, 1] += xyz[p, 1]
        total[v, 2] += xyz[p, 2]
        count[v] += 1


@kernel
def fill_table(table: Any, distinct: Any, n_distinct: int) -> None:
    """Enter the first ``n_distinct`` of ``distinct`` into an empty hash table."""
    for d in range(n_distinct):
        table[_slot_of(distinct[d], table, distinct)] = d


@inner
def _slot_of(key: int, table: Any, distinct: Any) -> int:
    """The slot that holds the key, or the free slot where it belongs."""
    mask = len(table) - 1
    mixed = (key ^ (key >> 29)) * 0x2545F4914F6CDD1D
    slot = (mixed ^ (mixed >> 32)) & mask
    while table[slot] >= 0 and distinct[table[slot]] != key:
        slot = (slot + 1) & mask
    return slot
