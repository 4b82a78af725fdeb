"""Rigid transforms of 3D points, as 4x4 matrices that read right to left: ``T_after_before @ p_before``."""

from __future__ import annotations

import numpy as np

from loda_pdal.model.cloud import FloatArray

IDENTITY = np.eye(4)

_BLOCK = 1 << 14
"""Points that are multiplied at a time: BLAS puts more of them on threads that take longer to start than to work."""


def transform_points(T: FloatArray, xyz: FloatArray) -> FloatArray:
    """Points (n, 3) moved by the rigid transform ``T`` (4, 4); same unit as ``xyz``."""
    moved = np.empty((len(xyz), 3))
    for start in range(0, len(xyz), _BLOCK):
        block = moved[start : start + _BLOCK]
        np.matmul(xyz[start : start + _BLOCK], T[:3, :3].T, out=block)
        block += T[:3, 3]
    return moved


def rotate(T: FloatArray, vectors: FloatArray) -> FloatArray:
    """Directions (n, 3) turned by the rotation part of ``T`` (4, 4)."""
    turned: FloatArray = vectors @ T[:3, :3].T
    return turned


def invert(T: FloatArray) -> FloatArray:
    """Inverse of a rigid transform (4, 4)."""
    inverse = np.eye(4)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse


def exp_se3(twist: FloatArray) -> FloatArray:
    """Rigid transform of a twist ``(tx, ty, tz, rx, ry, rz)``, m and rad: rotate by r, then shift by t."""
    T = np.eye(4)
    T[:3, :3] = rotation_matrix(twist[3:])
    T[:3, 3] = twist[:3]
    return T


def rotation_matrix(rotation_vector: FloatArray) -> FloatArray:
    """Rotation matrix (3, 3) of a rotation vector (3,), rad (Rodrigues)."""
    angle = float(np.linalg.norm(rotation_vector))
    x, y, z = rotation_vector
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-9:
        return np.asarray(np.eye(3) + K + 0.5 * K @ K)
    return np.asarray(np.eye(3) + np.sin(angle) / angle * K + (1 - np.cos(angle)) / angle**2 * K @ K)


def rotation_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """Smallest rotation matrix (3, 3) that turns unit vector ``a`` onto unit vector ``b``."""
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-15:
        return np.eye(3)
    return rotation_matrix(axis / sine * np.arctan2(sine, cosine))


def rotation_angle(T: FloatArray) -> float:
    """Angle of the rotation part of ``T`` (3, 3) or (4, 4), rad."""
    R = T[:3, :3]
    sine = 0.5 * np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.arctan2(sine, 0.5 * (np.trace(R) - 1.0)))
