"""Local planes: normals and roughness (paper, section 4.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loda_pdal.kernels.blocks import run_columns
from loda_pdal.kernels.cells import block_edge, build_cells, to_cell_frame
from loda_pdal.kernels.planes import plane_range
from loda_pdal.model.cloud import BoolArray, Float32Array, FloatArray
from loda_pdal.params import NormalParams


@dataclass(frozen=True)
class Normals:
    """The plane at each point of a cloud.

    Attributes
    ----------
    normals : (m, 3) float32
        Unit normals that point up (where level: to positive y, then x); zero where there is no plane.
    is_valid : (m,) bool
        Whether the neighbourhood makes a plane: enough points, not a line, not nearly isotropic.
    roughness : (m,) float32, m
        Robust standard deviation of the signed distances to the plane; NaN where there is no plane.
    """

    normals: Float32Array
    is_valid: BoolArray
    roughness: Float32Array


def estimate_normals(xyz: FloatArray, params: NormalParams) -> Normals:
    """Plane by PCA of at most ``max_neighbours`` nearest points within ``radius_m``, and its roughness by the MAD.

    Parameters
    ----------
    xyz : (m, 3) float64, m
    params : NormalParams

    Returns
    -------
    Normals

    References
    ----------
    Paper, section 4.1: normals within 0.75 m and 30 neighbours, near-isotropic ones rejected; sigma_r of equation 1.
    """
    normals = np.zeros((len(xyz), 3), dtype=np.float32)
    roughness = np.full(len(xyz), np.nan, dtype=np.float32)
    if len(xyz):
        cells = build_cells(xyz, block_edge(xyz))
        run_columns(
            plane_range,
            cells,
            to_cell_frame(cells, xyz),
            params.radius_m,
            params.max_neighbours,
            params.min_neighbours,
            params.max_isotropy,
            normals,
            roughness,
        )
    return Normals(normals, ~np.isnan(roughness), roughness)
