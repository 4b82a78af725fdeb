"""What registration found: the move between the epochs, its uncertainty, and whether to trust it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.transform import IDENTITY, invert, rotation_angle


@dataclass(frozen=True)
class Registration:
    """Rigid move of the before epoch onto the after epoch (paper, equation 1), in local metres.

    The analysis runs in the frame of the *reference* epoch, which is chosen by what the clouds hold and not by which
    is older: so swapping the epochs swaps the labels exactly. Results are moved into the after frame at the end.

    Attributes
    ----------
    T_after_before : (4, 4) float64
        Moves before-points onto the after cloud.
    reference : str
        ``before`` or ``after``: the epoch that stood still.
    covariance : (6, 6) float64
        Of the twist (tx, ty, tz, rx, ry, rz), m and rad, applied about ``centre`` in the reference frame.
    centre : (3,) float64, m
        Where the rotation of the twist pivots.
    vertical : (4, 4) float64
        Rotation that makes the common vertical axis z, applied to both epochs after registration.
    converged : bool
        Whether the pose may be trusted; ``message`` says why not.
    iterations : tuple of int
        ICP iterations per pyramid level.
    n_pairs, rmse_m, overlap
        Pairs kept at the end, their robust residual (m), and the share of points that found a partner.
    """

    T_after_before: FloatArray
    reference: str
    covariance: FloatArray
    centre: FloatArray
    converged: bool
    iterations: tuple[int, ...] = ()
    n_pairs: int = 0
    rmse_m: float = float("nan")
    overlap: float = float("nan")
    message: str = ""
    vertical: FloatArray = field(default_factory=lambda: IDENTITY.copy())

    @property
    def T_frame_before(self) -> FloatArray:  # noqa: N802
        """Moves before-points into the analysis frame, (4, 4)."""
        return self.vertical @ (IDENTITY if self.reference == "before" else self.T_after_before)

    @property
    def T_frame_after(self) -> FloatArray:  # noqa: N802
        """Moves after-points into the analysis frame, (4, 4)."""
        return self.vertical @ (IDENTITY if self.reference == "after" else invert(self.T_after_before))

    @property
    def T_after_frame(self) -> FloatArray:  # noqa: N802
        """Moves points of the analysis frame into the after frame, (4, 4)."""
        return invert(self.T_frame_after)

    @property
    def covariance_in_frame(self) -> FloatArray:
        """`covariance` turned into the analysis frame, (6, 6)."""
        R = np.kron(np.eye(2), self.vertical[:3, :3])
        return np.asarray(R @ self.covariance @ R.T)

    @property
    def centre_in_frame(self) -> FloatArray:
        """`centre` in the analysis frame, (3,) m."""
        return np.asarray(self.vertical[:3, :3] @ self.centre)

    @property
    def shift_m(self) -> FloatArray:
        """How far the centre moves, before to after, (3,) m."""
        moved = self.T_after_before[:3, :3] @ self.centre + self.T_after_before[:3, 3]
        return np.asarray(moved - self.centre)

    @property
    def rotation_deg(self) -> float:
        """Angle of the rotation, before to after, degrees."""
        return float(np.degrees(rotation_angle(self.T_after_before)))

    def with_vertical(self, rotation: FloatArray) -> Registration:
        """The same with ``rotation`` (3, 3) as the turn to the common vertical axis."""
        vertical = np.eye(4)
        vertical[:3, :3] = rotation
        return replace(self, vertical=vertical)
