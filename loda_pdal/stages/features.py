"""Shape of the neighbourhood of each point: eigenvalue features (paper, section 4.2, equation 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loda_pdal.kernels.blocks import run_columns
from loda_pdal.kernels.cells import block_edge, build_cells
from loda_pdal.kernels.features import shape_features
from loda_pdal.model.cloud import BoolArray, Float32Array, FloatArray
from loda_pdal.params import FeatureParams

FEATURE_NAMES = ("linearity", "planarity", "sphericity", "abs_normal_z", "height")
"""Columns of `Features.values`: the paper's L, P, S, |n.z| and z_g."""

NO_SHAPE = (1 / 3, 1 / 3, 1 / 3, 0.5)
"""The first four columns where there are too few neighbours: no shape is preferred, and no class rule is met."""


@dataclass(frozen=True)
class Features:
    """Features of one epoch's points, not standardised.

    Attributes
    ----------
    values : (m, 5) float32
        Linearity, planarity and sphericity (each 0 to 1, their sum is 1), absolute vertical component of the
        normal (0 to 1), and height above ground (m; 0 where there is no ground). The first four are `NO_SHAPE`
        where not valid.
    normals : (m, 3) float32
        Unit normals, z not negative; zero where not valid.
    is_valid : (m,) bool
        Whether there were neighbours enough.
    """

    values: Float32Array
    normals: Float32Array
    is_valid: BoolArray

    def __len__(self) -> int:
        return len(self.values)


def eigen_features(xyz: FloatArray, height: FloatArray, params: FeatureParams) -> Features:
    """Linearity, planarity, sphericity, verticality and height of each point.

    Parameters
    ----------
    xyz : (m, 3) float64, m
        Fused points.
    height : (m,) float64, m
        Height above ground; NaN where there is no ground model.
    params : FeatureParams
        Radius of the neighbourhood, in which all points count, and how many there must be.

    References
    ----------
    Paper, section 4.2, equation 3.
    """
    m = len(xyz)
    values = np.empty((m, len(FEATURE_NAMES)), dtype=np.float32)
    values[:, :4] = NO_SHAPE
    values[:, 4] = np.nan_to_num(height, nan=0.0)
    normals = np.zeros((m, 3), dtype=np.float32)
    is_valid = np.zeros(m, dtype=np.bool_)
    if m:
        cells = build_cells(xyz, max(params.radius_m, block_edge(xyz)))
        run_columns(shape_features, cells, params.radius_m, params.min_neighbours, values, normals, is_valid)
    return Features(values, normals, is_valid)
