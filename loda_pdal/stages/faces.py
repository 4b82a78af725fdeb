"""Does a wall, fence or hoarding still stand where it stood (beyond the paper, which asks for height and volume alone).

One for the other in the same line has the same overlap, and often the same height. But what stands fixed does not step
aside: where its upright faces lie elsewhere, all to one side and by more than can be missed, another one was put there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loda_pdal.kernels.neighbours import nearest
from loda_pdal.model.cloud import BoolArray, FloatArray, IntArray
from loda_pdal.model.groups import Groups
from loda_pdal.model.pair import Pair
from loda_pdal.stages.cues import Surface
from loda_pdal.stages.vehicles import Aloft, lifted

_REACH_M = 0.35
"""Faces farther apart are not compared: they belong to different sides of a thing, or to different things."""

_UPRIGHT = 0.5
"""Normals of upright faces are no steeper than this."""

_ALIGNED = 0.8
"""Cosine between the normals of faces that are compared, and between them and the axis that they mostly face."""

_MIN_FACES = 50


def face_offset(surfaces: Pair[Surface], is_asked: BoolArray) -> FloatArray:
    """How far the upright faces of objects lie apart in the two epochs, (n,) m.

    The median over all points of both epochs of the offset from the other epoch's surface, along the axis that the
    object mostly faces; 0 where the faces did not move as one (a quarter of them by less than half of that), NaN where
    not asked for or too few faces.

    Parameters
    ----------
    surfaces : Pair of Surface
        Points with their objects.
    is_asked : (n,) bool
        Objects that are compared, present in both epochs.
    """
    n = len(is_asked)
    if not is_asked.any():
        return np.full(n, np.nan)
    before, after = lifted(surfaces, is_asked)
    forth, back = _offsets(before, after), _offsets(after, before)
    owner = np.concatenate([forth.owner, back.owner])
    normal = np.concatenate([forth.normal, back.normal])
    offset = np.concatenate([forth.offset, -back.offset])
    axis = _main_axis(normal, Groups(owner, n))
    along = np.sum(normal * axis[owner], axis=1)
    offset = offset * np.sign(along)
    faces = Groups(np.where(np.abs(along) > _ALIGNED, owner, -1), n)
    median = faces.median(offset)
    least = faces.quantile(offset * np.sign(median)[owner], 0.25)
    moved = np.where(least > np.abs(median) / 2, np.abs(median), 0.0)
    return np.where(faces.counts >= _MIN_FACES, moved, np.nan)


class _Faces(NamedTuple):
    """Upright faces of one epoch: the object (k,), the horizontal normal (k, 2) that both epochs share, and how far the
    other epoch's face lies along it (k,) m."""

    owner: IntArray
    normal: FloatArray
    offset: FloatArray


def _offsets(side: Aloft, other: Aloft) -> _Faces:
    """The faces of one epoch that have one of the other epoch beside them."""
    found, _ = nearest(other.xyz, side.xyz, _REACH_M)
    theirs = other.normals[found] if len(other.xyz) else np.zeros_like(side.normals)
    theirs = np.where(np.sum(side.normals * theirs, axis=1, keepdims=True) < 0, -theirs, theirs)
    mean = side.normals + theirs
    length = np.linalg.norm(mean, axis=1)
    is_face = np.flatnonzero((found >= 0) & (length > 2 * _ALIGNED) & (np.abs(mean[:, 2]) < _UPRIGHT * length))
    normal = mean[is_face] / length[is_face, None]
    offset = np.sum(normal * (other.xyz[found[is_face]] - side.xyz[is_face]), axis=1)
    return _Faces(side.owner[is_face], normal[:, :2], offset)


def _main_axis(normal: FloatArray, groups: Groups) -> FloatArray:
    """The horizontal direction (n, 2) that the normals (k, 2) of each group mostly lie along, to one fixed side."""
    scatter = groups.sum(normal[:, :, None] * normal[:, None, :])
    axis = np.linalg.eigh(scatter)[1][:, :, 1]
    leading = np.take_along_axis(axis, np.argmax(np.abs(axis), axis=1)[:, None], axis=1)
    return np.where(leading < 0, -axis, axis)
