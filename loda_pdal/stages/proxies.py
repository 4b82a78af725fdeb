"""Objects by geometry alone: connected occupancy above the ground (paper, section 4.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loda_pdal.kernels.clusters import components
from loda_pdal.kernels.shifted import find_shifted, spread
from loda_pdal.model.cloud import BoolArray, FloatArray, Int64Array, IntArray
from loda_pdal.params import ProxyParams
from loda_pdal.stages.association import Descriptors, describe


@dataclass(frozen=True)
class Proxies:
    """Proxies of one epoch.

    Attributes
    ----------
    proxy : (m,) int32
        Proxy of each fused point, 1 to ``len(descriptors)``; 0 none.
    descriptors : Descriptors
        Of proxy ``i + 1`` at index i; ``n_voxels`` counts occupied voxels before closing.
    """

    proxy: IntArray
    descriptors: Descriptors

    def __len__(self) -> int:
        return len(self.descriptors)


def build_proxies(
    xyz: FloatArray, height: FloatArray, is_ground: BoolArray, params: ProxyParams, boxes_kind: str
) -> Proxies:
    """Connected pieces of the closed occupancy of what stands on the ground.

    Parameters
    ----------
    xyz : (m, 3) float64, m
        Fused points, z up.
    height : (m,) float64, m
        Height above ground; NaN where it is not known, which leaves the point in.
    is_ground : (m,) bool
        Ground points, which are left out.
    params : ProxyParams
        Voxel edge, lowest height, closing steps, and the smallest proxy in voxels after closing.
    boxes_kind : str
        ``upright`` or ``pca``.

    Notes
    -----
    Only occupied voxels are stored, as sorted keys: memory follows the surface and not the extent.

    References
    ----------
    Paper, section 4.1, paragraph before the association.
    """
    is_used = ~is_ground & ~(height < params.min_height_m)
    cells = np.floor(xyz[is_used] / params.voxel_m).astype(np.int64)
    component = voxel_components(cells, params.closing_voxels, params.min_voxels)
    proxy = np.zeros(len(xyz), dtype=np.int32)
    proxy[is_used] = component + 1
    n = int(proxy.max(initial=0))
    return Proxies(proxy, describe(xyz, height, proxy, n, params.histogram_bins, params.voxel_m, boxes_kind))


def voxel_components(cells: Int64Array, closing_voxels: int, min_voxels: int) -> IntArray:
    """Connected piece of each cell after morphological closing.

    Parameters
    ----------
    cells : (m, 3) int64
        Occupied cells; duplicates are allowed.
    closing_voxels : int
        Dilations, and as many erosions, with the 3 x 3 x 3 cube.
    min_voxels : int
        Pieces with fewer cells, after closing, are none.

    Returns
    -------
    (m,) int32
        Piece of each row of ``cells``, numbered by its lowest cell (x, then y, then z); -1 none.
    """
    if len(cells) == 0:
        return np.zeros(0, dtype=np.int32)
    margin = closing_voxels + 1
    low = np.array([column.min() for column in cells.T]) - margin
    span = np.array([column.max() for column in cells.T]) - low + margin + 1
    strides = np.array([span[1] * span[2], span[2], 1], dtype=np.int64)
    key = (cells - low) @ strides
    closed = _closed(_distinct(key), strides, closing_voxels)
    piece = _connected(closed, strides)
    is_large = np.bincount(piece) >= min_voxels
    number = np.where(is_large, np.cumsum(is_large) - 1, -1).astype(np.int32)
    return np.asarray(number[piece[np.searchsorted(closed, key)]], dtype=np.int32)


def _closed(keys: Int64Array, strides: Int64Array, steps: int) -> Int64Array:
    """Sorted keys after ``steps`` dilations and as many erosions; the cube is taken apart into its three axes."""
    for _ in range(steps):
        for stride in strides:
            keys = spread(keys, stride)
    for _ in range(steps):
        for stride in strides:
            keys = keys[(find_shifted(keys, -stride) >= 0) & (find_shifted(keys, stride) >= 0)]
    return keys


def _distinct(keys: Int64Array) -> Int64Array:
    """Distinct keys, ascending; a stable sort is quick on a few ascending runs."""
    ordered = np.sort(keys, kind="stable")
    return np.asarray(ordered[np.concatenate([[True], ordered[1:] != ordered[:-1]])])


def _connected(keys: Int64Array, strides: Int64Array) -> IntArray:
    """Connected piece of each of the sorted keys, over faces, edges and corners, numbered by its lowest key."""
    own, other = [], []
    for offset in _HALF_OF_26:
        place = find_shifted(keys, np.dot(offset, strides))
        own.append(np.flatnonzero(place >= 0).astype(np.int32))
        other.append(place[own[-1]])
    return components(np.column_stack([np.concatenate(own), np.concatenate(other)]), len(keys))


_HALF_OF_26 = [(dx, dy, dz) for dx in (-1, 0, 1) for dy in (-1, 0, 1) for dz in (-1, 0, 1) if (dx, dy, dz) > (0, 0, 0)]
"""One of each two opposite neighbours of a voxel."""
