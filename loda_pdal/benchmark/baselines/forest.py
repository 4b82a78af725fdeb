"""Baseline: a random forest on the columns of both surface models (the paper's "DSM RF"), trained on other blocks.

The paper names the classifier (Breiman 2001) and the raster (nDSM of 0.5 m), not its features. These are the usual
ones: what stands in a cell in either epoch, the difference of the tops, and how that looks around the cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from loda_pdal.benchmark.baselines.baseline import Baseline
from loda_pdal.benchmark.baselines.columns import Columns, connected, marks_in_columns
from loda_pdal.benchmark.baselines.scene import Block, Marks, Scene
from loda_pdal.kernels.parallel import thread_count
from loda_pdal.model.cloud import FloatArray, Int64Array
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.pair import Pair

NAME = "DSM random forest"
GRID = {"min_probability": (0.2, 0.3, 0.4, 0.5, 0.6), "min_cells": (1, 4, 8)}

N_TREES = 100
MIN_LEAF = 5
SEED = 0

_N_CODES = len(ChangeLabel)


@dataclass(frozen=True)
class ForestParams:
    """Choices of the baseline.

    Attributes
    ----------
    min_probability : float
        Cells that are more probably changed than this, have changed.
    min_cells : int
        Smaller regions are dropped.
    """

    min_probability: float = 0.5
    min_cells: int = 4


class Measured(NamedTuple):
    """Probability of each `ChangeLabel` in each cell, (nx, ny, 6), 0 off the objects; and the scene's columns."""

    probability: FloatArray
    columns: Columns


def baseline(training: Sequence[tuple[Block, Scene]]) -> Baseline:
    """The baseline, its forest trained on other blocks, and their scenes, than it will be asked about."""
    from sklearn.ensemble import RandomForestClassifier

    trees = RandomForestClassifier(
        N_TREES, min_samples_leaf=MIN_LEAF, class_weight="balanced_subsample", random_state=SEED, n_jobs=thread_count()
    )
    features, labels = zip(*(_samples(*known) for known in training), strict=True)
    trees.fit(np.concatenate(features), np.concatenate(labels))

    def measure(scene: Scene, params: ForestParams) -> Measured:
        columns = Columns.of(scene)
        cells = _object_cells(scene, columns)
        probability = np.zeros((*columns.shape, _N_CODES))
        if len(cells):
            found = np.zeros((len(cells), _N_CODES))
            found[:, trees.classes_] = trees.predict_proba(_features(scene, columns)[cells])
            probability.reshape(-1, _N_CODES)[cells] = found
        return Measured(probability, columns)

    return Baseline(NAME, measure, decide, GRID)


def is_installed() -> bool:
    """Whether scikit-learn is there."""
    return find_spec("sklearn") is not None


def decide(scene: Scene, measured: Measured, params: ForestParams) -> Pair[Marks]:
    """Regions of cells with the same most probable change, with all points of their columns."""
    change = measured.probability.copy()
    change[..., ChangeLabel.UNCHANGED] = 0.0
    is_changed = change.sum(axis=2) > params.min_probability
    best = np.where(is_changed, change.argmax(axis=2), 0)
    region = np.zeros(best.shape, dtype=np.int64)
    label = [np.array([ChangeLabel.UNCHANGED], dtype=np.uint8)]
    for code in range(ChangeLabel.ADDED, _N_CODES):
        found = connected(best == code, params.min_cells)
        region = np.where(found > 0, found + region.max(initial=0), region)
        label.append(np.full(int(found.max(initial=0)), code, dtype=np.uint8))
    return marks_in_columns(scene, measured.columns, region, np.concatenate(label))


def _samples(block: Block, scene: Scene) -> tuple[FloatArray, Int64Array]:
    """Features and labels of the cells that hold annotated instances."""
    columns = Columns.of(scene)
    label = _labels(block, scene, columns)
    cells = np.flatnonzero(label)
    return _features(scene, columns)[cells], label[cells]


def _object_cells(scene: Scene, columns: Columns) -> Int64Array:
    """Flat cells that hold points off the ground in either epoch."""
    parts = columns.cell.join(scene.is_off_ground, lambda cell, is_off_ground: cell[is_off_ground])
    return np.unique(np.concatenate(list(parts)))


def _features(scene: Scene, columns: Columns) -> FloatArray:
    """Features of every cell, (nx * ny, f)."""
    layers: list[Any] = []
    for cell, height, is_off_ground, top in zip(
        columns.cell, scene.height, scene.is_off_ground, columns.top, strict=True
    ):
        layers += [top, ndimage.maximum_filter(np.nan_to_num(top), 5), *_profile(cell, height, is_off_ground, columns)]
    difference = columns.difference
    known = np.nan_to_num(difference)
    layers += [difference]
    for size in (3, 5, 9):
        mean = ndimage.uniform_filter(known, size)
        spread = np.sqrt(np.maximum(ndimage.uniform_filter(known**2, size) - mean**2, 0.0))
        layers += [mean, spread, ndimage.minimum_filter(known, size), ndimage.maximum_filter(known, size)]
    return np.asarray(np.nan_to_num(np.stack([np.ravel(layer) for layer in layers], axis=1), nan=-1.0))


def _profile(cell: Int64Array, height: FloatArray, is_off_ground: Any, columns: Columns) -> list[FloatArray]:
    """Points off the ground in each cell: how many, mean height, its spread; and how many points on the ground."""
    n_cells = columns.shape[0] * columns.shape[1]
    own, h = cell[is_off_ground], height[is_off_ground]
    n = np.bincount(own, minlength=n_cells)
    mean = np.bincount(own, h, n_cells) / np.maximum(n, 1)
    spread = np.sqrt(np.maximum(np.bincount(own, h**2, n_cells) / np.maximum(n, 1) - mean**2, 0.0))
    n_ground = np.bincount(cell[~is_off_ground], minlength=n_cells)
    return [n.astype(float), mean, spread, n_ground.astype(float)]


def _labels(block: Block, scene: Scene, columns: Columns) -> Int64Array:
    """Label of the instances that most points off the ground in each flat cell belong to; 0 where there are none."""
    of_instance = np.zeros(max(block.truth.by_id, default=0) + 1, dtype=np.int64)
    for i in block.truth.instances:
        of_instance[i.instance_id] = i.label if i.is_evaluated else ChangeLabel.UNDETERMINED
    votes = np.zeros(columns.shape[0] * columns.shape[1] * _N_CODES)
    for cloud, cell, is_off_ground, epoch in zip(
        scene.clouds, columns.cell, scene.is_off_ground, block.epochs, strict=True
    ):
        label = of_instance[epoch.truth_id]
        is_counted = np.append(is_off_ground, False)[cloud.voxel_idx] & (label > 0)
        key = cell[cloud.voxel_idx[is_counted]] * _N_CODES + label[is_counted]
        votes += np.bincount(key, minlength=len(votes))
    return np.asarray(votes.reshape(-1, _N_CODES).argmax(axis=1))
