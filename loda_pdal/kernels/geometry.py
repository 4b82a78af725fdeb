"""Small closed problems of geometry that several kernels solve in their inner loops."""

from __future__ import annotations

import math

from loda_pdal.kernels.compiled import inner, kernel

_MAX_SWEEPS = 12
_TOLERANCE = 1e-16


@inner
def _turn(pp: float, qq: float, pq: float) -> tuple[float, float, float]:
    """Tangent, cosine and sine of the rotation that makes the element ``pq`` of a symmetric matrix zero."""
    theta = (qq - pp) / (2.0 * pq)
    tangent = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1.0))
    cosine = 1.0 / math.sqrt(tangent * tangent + 1.0)
    return tangent, cosine, tangent * cosine


@kernel
def eigen_symmetric_3x3(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float, float, float, float]:
    """Eigenvalues of a symmetric 3x3 matrix and the eigenvector of the smallest (cyclic Jacobi).

    Parameters
    ----------
    xx, xy, xz, yy, yz, zz : float64
        The upper triangle; of a covariance matrix in m^2, say.

    Returns
    -------
    large, middle, small : float64
        The eigenvalues in descending order, the unit of the matrix. Rounding can make the smallest of a flat
        covariance slightly negative.
    nx, ny, nz : float64
        Unit eigenvector of ``small``: the normal of the best plane. It points up; where it is level its y is
        positive, and failing that its x: so that equal matrices have equal normals.
    """
    # The eigenvectors are the columns (a, b, c) of the product of all rotations.
    ax, ay, az = 1.0, 0.0, 0.0
    bx, by, bz = 0.0, 1.0, 0.0
    cx, cy, cz = 0.0, 0.0, 1.0
    for _ in range(_MAX_SWEEPS):
        if abs(xy) + abs(xz) + abs(yz) <= _TOLERANCE * (abs(xx) + abs(yy) + abs(zz)):
            break
        if xy != 0.0:
            t, c, s = _turn(xx, yy, xy)
            xx, yy, xy = xx - t * xy, yy + t * xy, 0.0
            xz, yz = c * xz - s * yz, s * xz + c * yz
            ax, bx = c * ax - s * bx, s * ax + c * bx
            ay, by = c * ay - s * by, s * ay + c * by
            az, bz = c * az - s * bz, s * az + c * bz
        if xz != 0.0:
            t, c, s = _turn(xx, zz, xz)
            xx, zz, xz = xx - t * xz, zz + t * xz, 0.0
            xy, yz = c * xy - s * yz, s * xy + c * yz
            ax, cx = c * ax - s * cx, s * ax + c * cx
            ay, cy = c * ay - s * cy, s * ay + c * cy
            az, cz = c * az - s * cz, s * az + c * cz
        if yz != 0.0:
            t, c, s = _turn(yy, zz, yz)
            yy, zz, yz = yy - t * yz, zz + t * yz, 0.0
            xy, xz = c * xy - s * xz, s * xy + c * xz
            bx, cx = c * bx - s * cx, s * bx + c * cx
            by, cy = c * by - s * cy, s * by + c * cy
            bz, cz = c * bz - s * cz, s * bz + c * cz
    nx, ny, nz = cx, cy, cz
    if xx < yy:
        xx, yy = yy, xx
        ax, ay, az, bx, by, bz = bx, by, bz, ax, ay, az
    if yy < zz:  # the smallest of all three is now yy
        yy, zz = zz, yy
        nx, ny, nz = bx, by, bz
    if xx < yy:
        xx, yy = yy, xx
    if nz < 0.0 or (nz == 0.0 and (ny < 0.0 or (ny == 0.0 and nx < 0.0))):
        nx, ny, nz = -nx, -ny, -nz
    return xx, yy, zz, nx, ny, nz
