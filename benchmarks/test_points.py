"""What is done to single clouds: fusing, neighbours, outliers, normals, features, and the partition."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks import libraries as other
from benchmarks.conftest import Measure
from loda_pdal.kernels.neighbours import knn
from loda_pdal.kernels.partition import symmetric_arcs
from loda_pdal.params import Parameters
from loda_pdal.stages.features import eigen_features
from loda_pdal.stages.fuse import fuse_points
from loda_pdal.stages.normals import estimate_normals
from loda_pdal.stages.outliers import find_outliers
from loda_pdal.stages.superpoints import superpoints

P = Parameters()
OUTLIERS = replace(P.outliers, keep_voxels=0)  # the rule that libraries have: no cluster stays
K = P.superpoints.k
OURS = "loda-pdal"


@pytest.mark.parametrize("library", [OURS, "Open3D (with trace)", "Open3D (means only)"])
def test_fuse(library: str, raw: Any, measure: Measure) -> None:
    ways: dict[str, Callable[[], Any]] = {
        OURS: lambda: fuse_points(raw, P.fuse).xyz,
        "Open3D (with trace)": lambda: other.fuse_open3d(raw, P.fuse.leaf_m),
        "Open3D (means only)": lambda: other.fuse_open3d_untraced(raw, P.fuse.leaf_m),
    }
    found = measure("fuse to 0.25 m", library, ways[library], points=len(raw))
    assert np.isclose(len(found), len(fuse_points(raw, P.fuse).xyz), rtol=0.1)  # the grids begin at different places


@pytest.mark.parametrize("library", [OURS, "scipy", "pgeof", "small_gicp", "Open3D"])
def test_nearest_neighbours(library: str, after: Any, threads: int, measure: Measure) -> None:
    ways: dict[str, Callable[[], Any]] = {
        OURS: lambda: knn(after, K + 1)[::-1],
        "scipy": lambda: other.knn_scipy(after, K, threads),
        "pgeof": lambda: other.knn_pgeof(after, K),
        "small_gicp": lambda: other.knn_small_gicp(after, K, threads),
        "Open3D": lambda: other.knn_open3d(after, K),
    }
    farthest = measure(f"{K} nearest neighbours", library, ways[library], points=len(after))[0][:, -1]
    expected = knn(after, K + 1).distance[:, -1]
    if library in ("pgeof", "small_gicp", "Open3D"):
        farthest = np.sqrt(farthest)
    assert np.allclose(farthest, expected, atol=1e-4)


@pytest.mark.parametrize("library", [OURS, "scipy", "pgeof + scipy", "small_gicp + scipy"])
def test_neighbour_graph(library: str, after: Any, threads: int, measure: Measure) -> None:
    ways: dict[str, Callable[[], Any]] = {
        OURS: lambda: symmetric_arcs(knn(after, K, includes_self=False).idx)[1],
        "scipy": lambda: other.symmetric_scipy(other.knn_scipy(after, K, threads)[1][:, 1:]).indices,
        "pgeof + scipy": lambda: other.symmetric_scipy(other.knn_pgeof(after, K)[1][:, 1:]).indices,
        "small_gicp + scipy": lambda: other.symmetric_scipy(other.knn_small_gicp(after, K, threads)[1][:, 1:]).indices,
    }
    heads = measure(f"symmetric graph of {K} neighbours", library, ways[library], points=len(after))
    expected = len(symmetric_arcs(knn(after, K, includes_self=False).idx)[1])
    assert np.isclose(len(heads), expected, rtol=1e-3)  # equally near neighbours are chosen differently


@pytest.mark.parametrize("library", [OURS, "scipy", "Open3D"])
def test_outliers(library: str, after: Any, threads: int, measure: Measure) -> None:
    ways: dict[str, Callable[[], Any]] = {
        OURS: lambda: find_outliers(after, OUTLIERS),
        "scipy": lambda: other.outliers_scipy(after, OUTLIERS, threads),
        "Open3D": lambda: other.outliers_open3d(after, OUTLIERS),
    }
    found = measure("statistical outliers", library, ways[library], points=len(after))
    assert np.mean(found != find_outliers(after, OUTLIERS)) < 1e-4


@pytest.mark.parametrize("library", [OURS, "Open3D (no roughness)"])
def test_normals(library: str, after: Any, measure: Measure) -> None:
    ours = estimate_normals(after, P.normals)
    ways: dict[str, Callable[[], Any]] = {
        OURS: lambda: estimate_normals(after, P.normals).normals,
        "Open3D (no roughness)": lambda: other.normals_open3d(after, P.normals),
    }
    found = measure("normals", library, ways[library], points=len(after))
    cosine = np.abs(np.sum(found[ours.is_valid] * ours.normals[ours.is_valid], axis=1))
    assert np.quantile(cosine, 0.01) > 0.99


@pytest.mark.parametrize("library", [OURS, "jakteristics", "pgeof"])
def test_features(library: str, after: Any, threads: int, measure: Measure) -> None:
    height = np.zeros(len(after))
    ours = eigen_features(after, height, P.features)
    ways: dict[str, Callable[[], Any]] = {
        OURS: lambda: eigen_features(after, height, P.features).values[:, :4],
        "jakteristics": lambda: other.features_jakteristics(after, P.features, threads),
        "pgeof": lambda: other.features_pgeof(after, P.features),
    }
    found = measure("eigenvalue features", library, ways[library], points=len(after))
    expected = ours.values[:, :4].astype(np.float64)
    if library == "pgeof":  # of standard deviations, the roots of the eigenvalues
        large, middle, small = 1.0, np.sqrt(1 - expected[:, 0]), np.sqrt(expected[:, 2])
        expected[:, :3] = np.column_stack([large - middle, middle - small, small])
    assert np.quantile(np.abs(found - expected)[ours.is_valid], 0.99, axis=0).max() < 0.01


def test_partition(after: Any, measure: Measure) -> None:
    """Alone: no library of a permissive licence minimises this energy. tests/ compares it with the true minimum."""
    features = eigen_features(after, np.zeros(len(after)), P.features)
    found = measure("partition", OURS, lambda: superpoints(after, features, P.superpoints), points=len(after))
    assert 0 < found.n < len(after)
