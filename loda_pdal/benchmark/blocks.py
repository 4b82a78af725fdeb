"""Blocks of a city: a fixed grid, which blocks are fit for use, and a split that never changes (paper, section 3)."""

from __future__ import annotations

import hashlib

import numpy as np

from loda_pdal.model.cloud import FloatArray, Int64Array
from loda_pdal.model.pair import Pair

BLOCK_M = 120.0
"""Edge of a block, aligned to the projected grid."""

FILL_CELL_M = 0.5
MIN_FILL = 0.40
MAX_CENTROID_OFFSET_M = 0.5

SPLITS = (("train", 0.60), ("validation", 0.70), ("test", 1.00))
"""Splits with the upper end of their share of the hash range: 60, 10 and 30 %."""

SEEN = frozenset(f"seed {n}" for n in (1, 2, 3, 4, 5, 6, 7, 8, 12, 14, 15, 16, 21, 31, 32, 40, 101, 102, 103))
"""Blocks that were looked at during development: never test, whatever their hash."""


def block_of(xy: FloatArray) -> Int64Array:
    """Index (ix, iy) of the block that each place belongs to, (n, 2); ``xy`` (n, 2) in map metres. Blocks are
    half-open, so every place has one."""
    return np.asarray(np.floor(np.asarray(xy, dtype=float) / BLOCK_M), dtype=np.int64)


def split_of_block(ix: int, iy: int) -> str:
    """``train``, ``validation`` or ``test``: decided by the block's index alone, on any machine, for ever."""
    return split_of_name(f"block {ix} {iy}")


def split_of_name(name: str) -> str:
    """Split of anything that has a name (a simulated block: ``seed 7``).

    Blocks that were looked at while the method was made belong to training, wherever the hash would put them.
    """
    if name in SEEN:
        return "train"
    share = hash_share(name)
    return next(split for split, end in SPLITS if share < end or end == 1.0)


def hash_share(name: str) -> float:
    """Where the hash of a name lies between 0 and 1: the same on any machine, for ever."""
    digest = hashlib.sha256(name.encode("utf-8")).digest()
    return int.from_bytes(digest[:8], "big") / 2.0**64


def fill_share(xy: FloatArray) -> float:
    """Share of a block's 0.5 m plan cells that hold points; ``xy`` (n, 2) are its points off the ground."""
    if not len(xy):
        return 0.0
    cells = np.unique(np.floor(np.asarray(xy) / FILL_CELL_M).astype(np.int64), axis=0)
    return len(cells) / (BLOCK_M / FILL_CELL_M) ** 2


def is_kept(off_ground_xyz: Pair[FloatArray]) -> bool:
    """Whether a block is fit for use: both epochs fill it well enough after ground removal, and their centroids agree
    after registration; (n, 3) map metres of each."""
    if any(fill_share(xyz[:, :2]) < MIN_FILL for xyz in off_ground_xyz):
        return False
    offset = off_ground_xyz.before.mean(axis=0) - off_ground_xyz.after.mean(axis=0)
    return float(np.linalg.norm(offset)) < MAX_CENTROID_OFFSET_M
