"""Urb3DCD: its scene folders and its point-wise protocol (de Gelis et al. 2021 and 2023; paper, section 5).

A scene folder holds ``pointCloud0.ply`` and ``pointCloud1.ply``, the earlier and the later cloud. Their vertices have
``x``, ``y``, ``z`` and ``label_ch``, one of seven classes; those of the later cloud count. What is gone is labelled on
the ground that took its place. All points of all scenes make one confusion matrix.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from scipy.spatial import cKDTree

from loda_pdal.benchmark.baselines.compare import OURS, UNTRAINED
from loda_pdal.benchmark.baselines.scene import Marks, read_block, scene_of
from loda_pdal.benchmark.baselines.tuned import TUNED
from loda_pdal.benchmark.metrics import markdown_table
from loda_pdal.io.ply import read_ply, write_ply
from loda_pdal.kernels.parallel import thread_count
from loda_pdal.model.cloud import ByteArray, FloatArray, Int64Array
from loda_pdal.model.errors import InputError, OutputError
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import PointLabels
from loda_pdal.model.survey import Survey
from loda_pdal.model.transform import transform_points
from loda_pdal.params import Parameters
from loda_pdal.pipeline import detect_changes
from loda_pdal.stages.footprints import footprints

FILES = Pair("pointCloud0.ply", "pointCloud1.ply")
ELEMENTS = ("params", "Urb3DSimul")
"""Names of the vertex element in version 2 and in version 1."""

LABEL = "label_ch"

OUTLINE_SPACINGS = 1.5
MIN_OUTLINE_M = 0.5
"""Points of one surface lie no farther apart than so many point spacings, or than this: what is gone is outlined on
cells of that edge."""


class UrbClass(IntEnum):
    """Classes of Urb3DCD version 2."""

    UNCHANGED = 0
    NEW_BUILDING = 1
    DEMOLISHED = 2
    NEW_VEGETATION = 3
    VEGETATION_GROWTH = 4
    MISSING_VEGETATION = 5
    MOBILE = 6

    @property
    def title(self) -> str:
        """As it is written in tables."""
        return self.name.replace("_", " ").capitalize()


def _table(rows: dict[ObjectClass, dict[ChangeLabel, UrbClass]]) -> ByteArray:
    table = np.zeros((256, len(ChangeLabel)), dtype=np.uint8)
    for object_class, row in rows.items():
        for label, urb_class in row.items():
            table[object_class, label] = urb_class
    return table


_MOBILE_HERE = dict.fromkeys((ChangeLabel.ADDED, ChangeLabel.INCREASED, ChangeLabel.DECREASED), UrbClass.MOBILE)
_MOBILE_GONE = {ChangeLabel.REMOVED: UrbClass.MOBILE}

HERE = _table(
    {
        ObjectClass.BUILDING: {
            ChangeLabel.ADDED: UrbClass.NEW_BUILDING,
            ChangeLabel.INCREASED: UrbClass.NEW_BUILDING,
            ChangeLabel.DECREASED: UrbClass.DEMOLISHED,
        },
        ObjectClass.VEGETATION: {
            ChangeLabel.ADDED: UrbClass.NEW_VEGETATION,
            ChangeLabel.INCREASED: UrbClass.VEGETATION_GROWTH,
        },
        ObjectClass.MOBILE: _MOBILE_HERE,
        ObjectClass.OTHER: _MOBILE_HERE,
    }
)
"""Class of a point that stands in the later cloud, by object class and change. Vegetation that was cut back has none of
the seven and is unchanged; `ObjectClass.OTHER` (furniture) has none either and counts as mobile."""

GONE = _table(
    {
        ObjectClass.BUILDING: dict.fromkeys((ChangeLabel.REMOVED, ChangeLabel.DECREASED), UrbClass.DEMOLISHED),
        ObjectClass.VEGETATION: {ChangeLabel.REMOVED: UrbClass.MISSING_VEGETATION},
        ObjectClass.MOBILE: _MOBILE_GONE,
        ObjectClass.OTHER: _MOBILE_GONE,
    }
)
"""Class of the ground below a point that stood in the earlier cloud only."""


class Known(NamedTuple):
    """What is known about points of one epoch: ``xyz`` (k, 3) m in the frame of the later cloud, and per point its
    `ObjectClass` code, `ChangeLabel` and object (0 none), (k,) each."""

    xyz: FloatArray
    object_class: ByteArray
    change: ByteArray
    object: Int64Array


@dataclass(frozen=True)
class UrbScene:
    """One scene: both clouds (n, 3), m, and the `UrbClass` of each point of the later one, (n,)."""

    name: str
    clouds: Pair[FloatArray]
    label: ByteArray


@dataclass(frozen=True)
class UrbScores:
    """Point-wise scores of one method.

    Attributes
    ----------
    confusion : (7, 7) int64
        Rows are truth, columns prediction, in the order of `UrbClass`.
    """

    confusion: Int64Array

    @staticmethod
    def of(truth: ByteArray, predicted: ByteArray) -> UrbScores:
        """Scores of predicted classes (n,)."""
        n = len(UrbClass)
        keys = truth.astype(np.int64) * n + predicted
        return UrbScores(np.bincount(keys, minlength=n * n).reshape(n, n))

    @property
    def recall(self) -> FloatArray:
        """Per class, (7,); NaN for a class without points."""
        return _ratio(np.diag(self.confusion), self.confusion.sum(axis=1))

    @property
    def iou(self) -> FloatArray:
        """Per class, (7,); NaN for a class neither true nor predicted anywhere."""
        union = self.confusion.sum(axis=0) + self.confusion.sum(axis=1) - np.diag(self.confusion)
        return _ratio(np.diag(self.confusion), union)

    @property
    def mean_accuracy(self) -> float:
        """mAcc: mean recall over the classes that are present."""
        return _mean(self.recall)

    @property
    def mean_iou_of_change(self) -> float:
        """mIoU_ch: plain mean of IoU over the six classes of change that occur."""
        return _mean(self.iou[1:])

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; None where undefined."""
        return {
            "n": int(self.confusion.sum()),
            "macc": _plain(self.mean_accuracy),
            "miou_ch": _plain(self.mean_iou_of_change),
            "iou": {c.title: _plain(float(self.iou[c])) for c in UrbClass},
            "recall": {c.title: _plain(float(self.recall[c])) for c in UrbClass},
            "confusion": self.confusion.tolist(),
        }


def read_scene(folder: Path) -> UrbScene:
    """The scene in ``folder``."""
    columns = FILES.map(lambda name: read_ply(folder / name, ELEMENTS))
    for name, found in zip(FILES, columns, strict=True):
        missing = [c for c in ("x", "y", "z") if c not in found]
        missing += [LABEL] if name == FILES.after and LABEL not in found else []
        if missing:
            raise InputError(f"{folder / name} has no {', '.join(missing)}.", "Give an Urb3DCD scene.", "not-urb3dcd")
    label = np.rint(columns.after[LABEL]).astype(np.int64)
    if len(label) and not 0 <= label.min() <= label.max() < len(UrbClass):
        raise InputError(
            f"{LABEL} of {folder / FILES.after} runs from {label.min()} to {label.max()}, not 0 to 6.",
            "Give a scene of Urb3DCD version 2.",
            "not-urb3dcd",
        )
    xyz = columns.map(lambda found: np.column_stack([found[c] for c in ("x", "y", "z")]).astype(np.float64))
    return UrbScene(folder.name, xyz, label.astype(np.uint8))


def write_scene(scene: UrbScene, folder: Path, *, overwrite: bool = False) -> Pair[Path]:
    """Write a scene as version 2 does: single precision, element ``params``; the earlier cloud has label 0."""
    paths = FILES.map(lambda name: folder / name)
    if any(path.exists() for path in paths) and not overwrite:
        raise OutputError(
            f"{folder} already holds a scene.", "Choose another folder, or add --overwrite.", "output-exists"
        )
    folder.mkdir(parents=True, exist_ok=True)
    labels = Pair(np.zeros(len(scene.clouds.before), dtype=np.uint8), scene.label)
    for path, xyz, label in zip(paths, scene.clouds, labels, strict=True):
        x, y, z = xyz.astype(np.float32).T
        write_ply(path, ELEMENTS[0], {"x": x, "y": y, "z": z, LABEL: label.astype(np.float32)})
    return paths


def scene_of_block(folder: Path) -> UrbScene:
    """A simulated block as a scene: registered by its true move, about its lowest corner, classes from its truth."""
    block = read_block(folder)
    frame = block.epochs.after.survey.frame
    of_instance = np.full(max(block.truth.by_id, default=0) + 1, ObjectClass.GROUND, dtype=np.uint8)
    for i in block.truth.instances:
        of_instance[i.instance_id] = i.object_class
    moved = frame.to_local(transform_points(block.truth.T_after_before, frame.to_map(block.surveys.before.xyz)))
    xyz = Pair(moved, block.surveys.after.xyz)
    known = xyz.join(block.epochs, lambda points, e: Known(points, of_instance[e.truth_id], e.truth_change, e.truth_id))
    corner = np.floor(np.min([points.min(axis=0, initial=np.inf) for points in xyz], axis=0))
    return UrbScene(folder.name, xyz.map(lambda points: points - corner), classes_of(known))


def classes_of(known: Pair[Known]) -> ByteArray:
    """`UrbClass` of every point of the later cloud, (n,): of what stands there, and on the ground of what is gone."""
    before, after = known
    classes = HERE[after.object_class, after.change]
    gone = GONE[before.object_class, before.change]
    for urb_class in np.unique(gone[gone > 0]):
        is_gone = gone == urb_class
        ids, number = np.unique(before.object[is_gone], return_inverse=True)
        xy = before.xyz[is_gone, :2]
        outlines = footprints(xy, (number + 1).astype(np.int32), len(ids), _cell_m(before.xyz))
        ground = np.flatnonzero((after.object_class == ObjectClass.GROUND) & (classes == UrbClass.UNCHANGED))
        places = shapely.points(after.xyz[ground, :2])
        covered = shapely.STRtree(places).query(np.array(outlines), predicate="contains")[1]
        classes[ground[covered]] = urb_class
    return np.asarray(classes)


def pieces_only(known: Pair[Known]) -> Pair[Known]:
    """What is known, but of buildings that grew or shrank only the points that the other epoch has nothing beside.

    Our label says that a house changed, and a house that got an annex is labelled as a whole; these classes ask whether
    something changed at a point, and its roof is what it was.
    """

    def of_epoch(own: Known, other: Known) -> Known:
        is_partly = np.isin(own.change, (ChangeLabel.INCREASED, ChangeLabel.DECREASED))
        asked = np.flatnonzero(is_partly & (own.object_class == ObjectClass.BUILDING))
        change = own.change.copy()
        if len(asked) and len(other.xyz):
            apart, _ = cKDTree(other.xyz).query(own.xyz[asked], workers=thread_count())
            change[asked[apart <= _cell_m(other.xyz)]] = ChangeLabel.UNCHANGED
        return own._replace(change=change)

    return known.join(known.swapped, of_epoch)


def _cell_m(xyz: FloatArray) -> float:
    """How far apart, m, the points (n, 3) of one surface lie at most, with few exceptions."""
    return max(MIN_OUTLINE_M, OUTLINE_SPACINGS * Survey(xyz).extent.spacing_m)


def run_scenes(
    folders: Sequence[Path], *, preset: str = "aerial", say: Callable[[str], None] = lambda text: None
) -> dict[str, UrbScores]:
    """Our method and the baselines that need no training on scene folders, all points in one confusion matrix each.

    The baselines only say what changed: what a thing is, they take from our classification.
    """
    total: dict[str, Int64Array] = {}
    for folder in folders:
        scene = read_scene(folder)
        surveys = _surveys(scene)
        start = time.perf_counter()
        for name, known in _answers(surveys, preset):
            say(f"{scene.name}: {name}, {time.perf_counter() - start:.1f} s")
            predicted = _on_cloud(known.after.xyz, classes_of(known), surveys.after.xyz)
            confusion = UrbScores.of(scene.label, predicted).confusion
            total[name] = total.get(name, np.zeros_like(confusion)) + confusion
            start = time.perf_counter()
    return {name: UrbScores(confusion) for name, confusion in total.items()}


def _answers(surveys: Pair[Survey], preset: str) -> Iterator[tuple[str, Pair[Known]]]:
    """Name and answer of every method, one after the other."""
    parameters = Parameters.preset(preset)
    result = detect_changes(surveys.before, surveys.after, parameters)
    moved = transform_points(result.registration.T_after_before, surveys.before.xyz)
    labelled = Pair(moved, surveys.after.xyz).join(result.points, _Labelled)

    ours = result.points.map(lambda labels: Marks(labels.change, labels.object.astype(np.int64)))
    yield OURS, pieces_only(labelled.join(ours, _known))
    scene = scene_of(surveys, parameters)
    for method in (m for m in UNTRAINED if m.is_installed):
        params = TUNED[preset][method.name]
        marks = scene.on_points(method.decide(scene, method.measure(scene, params), params))
        yield method.name, labelled.join(marks, _known)


class _Labelled(NamedTuple):
    """Points of one epoch (n, 3) in the frame of the later cloud, m, and what our method says about them."""

    xyz: FloatArray
    labels: PointLabels


def _known(points: _Labelled, marks: Marks) -> Known:
    """Changes as marked, of things as we classify them; without noise."""
    object_class = points.labels.classification
    is_known = object_class != ObjectClass.NOISE
    return Known(points.xyz[is_known], object_class[is_known], marks.change[is_known], marks.object[is_known])


def to_markdown(scores: dict[str, UrbScores]) -> str:
    """One row per method, in per cent: mAcc, mIoU_ch, and the IoU of every class."""
    header = ["method", "points", "mAcc", "mIoU_ch", *(c.title for c in UrbClass)]
    rows = [
        [
            name,
            int(s.confusion.sum()),
            _plain(s.mean_accuracy),
            _plain(s.mean_iou_of_change),
            *(_plain(float(s.iou[c])) for c in UrbClass),
        ]
        for name, s in scores.items()
    ]
    return markdown_table(header, rows)


def _surveys(scene: UrbScene) -> Pair[Survey]:
    """Both clouds as a reader would give them."""
    frame = LocalFrame.about(np.min([xyz.min(axis=0, initial=np.inf) for xyz in scene.clouds], axis=0))
    return scene.clouds.map(lambda xyz: Survey(frame.to_local(xyz), frame, path=scene.name))


def _on_cloud(xyz: FloatArray, classes: ByteArray, queries: FloatArray) -> ByteArray:
    """Class of the nearest point to each query; unchanged where there are no points."""
    if len(xyz) == 0:
        return np.zeros(len(queries), dtype=np.uint8)
    return np.asarray(classes[cKDTree(xyz).query(queries, workers=thread_count())[1]])


def _ratio(part: Int64Array, whole: Int64Array) -> FloatArray:
    return np.where(whole > 0, part / np.maximum(whole, 1), np.nan)


def _mean(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def _plain(value: float) -> float | None:
    return value if np.isfinite(value) else None
