"""The single table of the point dimensions that loda-pdal writes (names follow PDAL's CamelCase)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Dimension(NamedTuple):
    """One per-point dimension: its name, NumPy dtype, value where unknown, and meaning."""

    name: str
    dtype: str
    unknown: float
    meaning: str


EPOCH = Dimension("Epoch", "uint8", 0, "0 before, 1 after")
CLASSIFICATION = Dimension("Classification", "uint8", 1, "ASPRS; 64 mobile, 65 other non-ground")
HEIGHT = Dimension("HeightAboveGround", "float64", float("nan"), "m above the ground model of its epoch")
LOD95 = Dimension("LoD95", "float32", float("nan"), "m, detection limit along the local normal")
SUPERPOINT = Dimension("Superpoint", "uint32", 0, "superpoint, unique within an epoch; 0 none")
INSTANCE = Dimension("InstanceId", "uint32", 0, "instance, unique within an epoch; 0 none")
OBJECT = Dimension("ObjectId", "uint32", 0, "object over both epochs; 0 none")
CHANGE = Dimension("ChangeClass", "uint8", 0, "0 undetermined, 1 unchanged, 2 added, 3 removed, 4 inc., 5 dec.")
CONFIDENCE = Dimension("ChangeConfidence", "float32", float("nan"), "0 to 1; NaN where ChangeClass is 0")

DIMENSIONS = (EPOCH, CLASSIFICATION, HEIGHT, LOD95, SUPERPOINT, INSTANCE, OBJECT, CHANGE, CONFIDENCE)
EXTRA_DIMENSIONS = tuple(d for d in DIMENSIONS if d is not CLASSIFICATION)
"""Those that are no standard LAS field and travel as extra bytes."""

FOUND = np.dtype([(d.name, d.dtype) for d in DIMENSIONS if d is not EPOCH])
"""What a run finds for a point, as one record of an array."""
