"""Baseline: difference of two normalised surface models, cut at a threshold and cleaned by an opening.

The oldest way to find changes in airborne LiDAR (after Murakami et al. 1999), here with the regions labelled by what
stands there before and after.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from loda_pdal.benchmark.baselines.baseline import Baseline
from loda_pdal.benchmark.baselines.columns import Columns, connected, label_of_regions, marks_in_columns
from loda_pdal.benchmark.baselines.scene import Marks, Scene
from loda_pdal.model.pair import Pair


@dataclass(frozen=True)
class NdsmParams:
    """Choices of the baseline.

    Attributes
    ----------
    threshold_m : float, m
        Tops that differ by more have changed.
    opening : int
        Edge of the square window of the opening, cells; 1 opens nothing.
    min_cells : int
        Smaller regions are dropped.
    standing_m : float, m
        Where the median top is lower than this, nothing stands.
    """

    threshold_m: float = 1.0
    opening: int = 2
    min_cells: int = 4
    standing_m: float = 0.7


def measure(scene: Scene, params: NdsmParams) -> Columns:
    """Both surface models; the parameters have no part in them."""
    return Columns.of(scene)


def decide(scene: Scene, columns: Columns, params: NdsmParams) -> Pair[Marks]:
    """Regions in which the top rose or sank, with all points of their columns."""
    difference = np.nan_to_num(columns.difference)
    window = np.ones((params.opening, params.opening), dtype=bool)
    region = np.zeros(columns.shape, dtype=np.int64)
    for is_changed in (difference > params.threshold_m, difference < -params.threshold_m):
        found = connected(ndimage.binary_opening(is_changed, window), params.min_cells)
        region = np.where(found > 0, found + region.max(initial=0), region)
    cell = np.flatnonzero(region)
    label = label_of_regions(columns, region.ravel()[cell], cell, params.standing_m)
    return marks_in_columns(scene, columns, region, label)


BASELINE = Baseline(
    "nDSM difference",
    measure,
    decide,
    {
        "threshold_m": (0.2, 0.3, 0.5, 0.8, 1.2),
        "opening": (1, 2, 3),
        "min_cells": (1, 4, 8),
        "standing_m": (0.5, 0.7, 1.0),
    },
)
