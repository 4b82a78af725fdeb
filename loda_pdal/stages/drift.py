"""What two surveys disagree by beyond noise and pose, measured where nothing changed.

Trajectories drift while they are surveyed. What one rigid move leaves between two epochs is therefore neither in the
noise of a cell nor in the pose covariance, though it is often the largest part of the disagreement. It is measured on
the cells of the LoD grid themselves: most surfaces do not change, so two thirds of the cells lie within one standard
deviation when that is right. Changed cells in the scene make the limit wider, never narrower.
"""

from __future__ import annotations

import numpy as np

from loda_pdal.model.cloud import FloatArray

ONE_SIGMA = 0.6827
"""Share of a normal distribution within one standard deviation."""

BETTER_SHARE = 0.7
"""Of the cells, this share, the better measured one, is asked: in the others noise hides the drift."""

SURFACE_NOISE_M = 0.10
"""A cell that is rougher holds no surface but leaves or clutter, which moves and grows."""

LEVEL, UPRIGHT = 0.3, 0.95
"""Normals less upright than the first are a facade's; more upright than the second, they measure drift in height."""

MIN_CELLS = 60
"""Fewer cells say nothing about the drift along an axis."""

LARGEST_TWIST = 12.6
"""A twist is in keeping with its covariance up to this squared Mahalanobis length (95 % of chi-square, 6 degrees)."""

TUKEY = 4.685
"""Residuals beyond this many standard deviations have no weight in the twist."""


def rigid_part(
    displacement: FloatArray, variance: FloatArray, jacobian: FloatArray, covariance: FloatArray
) -> FloatArray:
    """The part of the displacements (c,), m, that a move makes which the pose covariance allows.

    Parameters
    ----------
    displacement, variance : (c,) float64, m and m2
        Along the normal, and the variance of its noise.
    jacobian : (c, 6) float64
        Displacement per twist.
    covariance : (6, 6) float64
        Of the twist. One that fits but is too long for it is shortened.
    """
    values, vectors = np.linalg.eigh(covariance)
    response = np.einsum("ci,ij->cj", jacobian, vectors * np.sqrt(np.maximum(values, 0.0)))
    twist = np.zeros(6)  # in standard deviations
    if len(displacement) < MIN_CELLS:
        return np.zeros(len(displacement))
    for _ in range(10):
        residual = displacement - np.einsum("ci,i->c", response, twist)
        spread = np.quantile(residual**2, ONE_SIGMA) + variance + np.finfo(float).tiny
        weight = np.maximum(1.0 - residual**2 / (TUKEY**2 * spread), 0.0) ** 2 / spread
        normal_matrix = np.einsum("ci,c,cj->ij", response, weight, response) + np.eye(6)
        twist = np.linalg.solve(normal_matrix, np.einsum("ci,c,c->i", response, weight, displacement))
    twist *= min(1.0, np.sqrt(LARGEST_TWIST / max(float(twist @ twist), 1e-12)))
    return np.asarray(np.einsum("ci,i->c", response, twist))


def drift_covariance(
    displacement: FloatArray, variance: FloatArray, normal: FloatArray, max_drift_m: float
) -> FloatArray:
    """Covariance (3, 3), m2, that makes displacements along normals as large as they should be.

    It has three axes: height, and the two directions in plan that most facades face, because along a street the drift
    is not what it is across. Along each, it is the variance with which two thirds of the displacements lie within one
    standard deviation.

    Parameters
    ----------
    displacement, variance : (c,) float64, m and m2
        Along the normal and without the rigid part; the variance that is known already.
    normal : (c, 3) float64
        Unit normals.
    max_drift_m : float, m
        A larger standard deviation is not believed to be drift.
    """
    axes = _facade_axes(normal)
    along = np.square(np.einsum("ci,ai->ca", normal, axes))
    is_upright = along[:, 2] > UPRIGHT**2
    is_first = along[:, 0] >= along[:, 1]
    groups = (~is_upright & is_first, ~is_upright & ~is_first, is_upright)
    drift = np.zeros(3)
    for axis in (2, 0, 1, 2, 0, 1):  # slopes see the drift of two axes
        is_in = groups[axis]
        others = np.where(np.arange(3) == axis, 0.0, drift)
        known = variance[is_in] + np.einsum("ca,a->c", along[is_in], others)
        share = along[is_in, axis]
        drift[axis] = min(_missing_variance(displacement[is_in] ** 2 / share, known / share), max_drift_m**2)
    return np.asarray(axes.T @ np.diag(drift) @ axes)


def _facade_axes(normal: FloatArray) -> FloatArray:
    """Two level axes at right angles that level normals (c, 3) follow best, and z, as rows (3, 3)."""
    level = normal[np.abs(normal[:, 2]) < LEVEL]
    azimuth = np.arctan2(level[:, 1], level[:, 0])
    turn = np.arctan2(np.sin(4 * azimuth).sum(), np.cos(4 * azimuth).sum()) / 4
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _missing_variance(square: FloatArray, known: FloatArray) -> float:
    """What to add to the ``known`` variances (c,) so that two thirds of ``square`` (c,) are below them."""
    if len(square) < MIN_CELLS:
        return 0.0
    is_better = known <= np.quantile(known, BETTER_SHARE)
    square, known = square[is_better], known[is_better] + np.finfo(float).tiny
    low, high = 0.0, float(np.quantile(square, ONE_SIGMA))
    for _ in range(40):
        middle = 0.5 * (low + high)
        is_too_small = np.quantile(square / (known + middle), ONE_SIGMA) > 1.0
        low, high = (middle, high) if is_too_small else (low, middle)
    return low
