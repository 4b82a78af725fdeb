"""Does a wall, fence or hoarding still stand where it stood (beyond the paper, which asks for height and volume alone).

One for the other in the same line has the same overlap, and often the same height. But what stands fixed does not step
aside: where nearly all of its upright faces lie elsewhere, by more than can be missed, another one was put there.
"""

from __future__ import annotations

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
"""Half the length of the sum of two normals of faces that are compared."""

_MIN_FACES = 100


def face_offset(surfaces: Pair[Surface], is_asked: BoolArray) -> FloatArray:
    """How far the upright faces of objects lie apart in the two epochs, (n,) m.

    The median over the points of both epochs of the distance from the other epoch's face along their common normal, or
    twice the lower quartile if that is less: most of the thing is where it was. NaN where not asked for, or too few.

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
    forth, back = _apart(before, after), _apart(after, before)
    faces = Groups(np.concatenate([forth[0], back[0]]), n)
    apart = np.concatenate([forth[1], back[1]])
    offset = np.fmin(faces.median(apart), 2 * faces.quantile(apart, 0.25))
    return np.where(faces.counts >= _MIN_FACES, offset, np.nan)


def _apart(side: Aloft, other: Aloft) -> tuple[IntArray, FloatArray]:
    """Object (k,) of the upright faces of one epoch that have one of the other epoch beside them, and how far that lies
    from them along both normals' mean (k,) m."""
    if len(other.xyz) == 0:
        return np.zeros(0, np.int32), np.zeros(0)
    found, _ = nearest(other.xyz, side.xyz, _REACH_M)
    theirs = other.normals[found]
    theirs = np.where(np.sum(side.normals * theirs, axis=1, keepdims=True) < 0, -theirs, theirs)
    mean = (side.normals + theirs) / 2
    length = np.linalg.norm(mean, axis=1)
    is_face = (found >= 0) & (length > _ALIGNED) & (np.abs(mean[:, 2]) < _UPRIGHT * length)
    across = np.abs(np.sum(mean * (other.xyz[found] - side.xyz), axis=1))
    return side.owner[is_face], across[is_face] / length[is_face]
