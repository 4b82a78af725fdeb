"""Between full map coordinates and the local metres in which everything is computed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loda_pdal.model.cloud import ORIGIN_STEP, FloatArray, to_local_grid


@dataclass(frozen=True)
class LocalFrame:
    """The local origin that both epochs share, and the units of the map.

    Attributes
    ----------
    origin : (int, int, int)
        Full map coordinates of the local origin, in map units; whole multiples of `ORIGIN_STEP` (0 in z).
    unit_xy_m, unit_z_m : float
        Metres per horizontal and per vertical map unit (1 for metres).
    crs_wkt : str or None
        Coordinate reference system of the after epoch; None where unknown.
    """

    origin: tuple[int, int, int]
    unit_xy_m: float = 1.0
    unit_z_m: float = 1.0
    crs_wkt: str | None = None

    @classmethod
    def about(cls, low: FloatArray) -> LocalFrame:
        """The frame of points in metres whose lowest coordinates are ``low`` (3,); about 0 where there are none."""
        x, y = (np.floor(low[:2] / ORIGIN_STEP) * ORIGIN_STEP).tolist() if np.isfinite(low).all() else (0, 0)
        return cls((int(x), int(y), 0))

    @property
    def scale(self) -> FloatArray:
        """Metres per map unit along x, y, z, (3,)."""
        return np.array([self.unit_xy_m, self.unit_xy_m, self.unit_z_m])

    def to_local(self, xyz: FloatArray) -> FloatArray:
        """Local metres (n, 3), on the local grid, of full map coordinates (n, 3)."""
        local = xyz - np.array(self.origin, dtype=float)
        local *= self.scale
        return to_local_grid(local)

    def to_map(self, xyz: FloatArray) -> FloatArray:
        """Full map coordinates (n, 3) of local metres (n, 3)."""
        full: FloatArray = xyz / self.scale + np.array(self.origin, dtype=float)
        return full

    def transform_to_map(self, T_local: FloatArray) -> FloatArray:
        """The transform (4, 4) of full map coordinates that does what ``T_local`` does to local metres."""
        into = np.eye(4)
        into[:3, :3] = np.diag(self.scale)
        into[:3, 3] = -self.scale * np.array(self.origin, dtype=float)
        full: FloatArray = np.linalg.inv(into) @ T_local @ into
        return full
