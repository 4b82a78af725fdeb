"""Components, pieces and clusters against definitions on small clouds."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from loda_pdal.kernels.clusters import components, count_until, dbscan, smooth_pieces
from loda_pdal.kernels.contacts import contact_keys


def flooded(links: np.ndarray) -> list[int]:
    """Lowest node of the component of each node, from a matrix of links."""
    reached = links | links.T | np.eye(len(links), dtype=bool)
    for _ in links:
        reached = reached @ reached
    return reached.argmax(axis=1).tolist()


@given(st.integers(0, 2**32 - 1), st.integers(1, 20), st.integers(0, 30))
def test_components_are_numbered_by_their_lowest_node(seed: int, n: int, n_pairs: int) -> None:
    pairs = np.random.default_rng(seed).integers(0, n, (n_pairs, 2))
    links = np.zeros((n, n), dtype=bool)
    links[pairs[:, 0], pairs[:, 1]] = True
    lowest = flooded(links)
    assert components(pairs, n).tolist() == [sorted(set(lowest)).index(node) for node in lowest]
    assert components(pairs[:0], 0).tolist() == []


def test_pieces_end_at_edges_and_at_other_labels() -> None:
    line = np.array([[i - 1, i + 1 if i < 5 else -1] for i in range(6)], dtype=np.int32)
    up, east = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]
    normals = np.array([up, up, east, east, [-1.0, 0.0, 0.0], east], dtype=np.float32)
    labels = np.array([0, 0, 0, 0, 0, 1], dtype=np.int32)
    assert smooth_pieces(line, normals, labels, np.cos(np.radians(12))).tolist() == [0, 0, 2, 2, 2, 5]


@given(st.integers(0, 2**32 - 1), st.integers(1, 30))
def test_contacts_are_counted_one_by_one(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    neighbour = rng.integers(-1, n, (n, 4)).astype(np.int32)
    labels = rng.integers(-1, 5, n).astype(np.int32)
    expected = [
        5 * min(labels[i], labels[j]) + max(labels[i], labels[j])
        for i in range(n)
        for j in neighbour[i]
        if j >= 0 and labels[i] >= 0 and labels[j] >= 0 and labels[i] != labels[j]
    ]
    assert contact_keys(neighbour, labels, 5).tolist() == expected


@given(st.integers(0, 2**32 - 1), st.integers(1, 80), st.integers(1, 30))
def test_counting_stops_behind_enough(seed: int, n: int, enough: int) -> None:
    xyz = np.random.default_rng(seed).uniform(0, 2, (n, 3))
    counts = np.sum(np.linalg.norm(xyz[:, None] - xyz[None], axis=2) <= 0.7, axis=1)
    found = count_until(xyz, 0.7, enough)
    assert np.array_equal(np.minimum(found, enough), np.minimum(counts, enough))
    assert (found <= counts).all()


def test_dbscan_counts_weights_and_gives_border_points_to_the_nearest_core() -> None:
    x = np.array([0.0, 0.1, 0.2, 0.8, 5.0, 9.0])
    points = np.column_stack([x, np.zeros(6), np.zeros(6)])
    weight = np.array([1, 1, 1, 1, 1, 3], dtype=np.int32)
    assert dbscan(points, weight, 0.7, 3).tolist() == [0, 0, 0, 0, -1, 5]
    order = np.array([3, 5, 0, 4, 2, 1])
    assert dbscan(points[order], weight[order], 0.7, 3).tolist() == [2, 1, 2, -1, 2, 2]
    assert dbscan(points[:0], weight[:0], 0.7, 3).tolist() == []


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 12))
def test_dbscan_agrees_with_its_definition(seed: int, n: int, least_weight: int) -> None:
    rng = np.random.default_rng(seed)
    xyz, weight = rng.uniform(0, 2, (n, 3)), rng.integers(1, 4, n).astype(np.int32)
    gap = np.linalg.norm(xyz[:, None] - xyz[None], axis=2)
    is_core = (gap <= 0.5) @ weight >= least_weight
    lowest = flooded((gap <= 0.5) & is_core[:, None] & is_core[None])
    expected = []
    for i in range(n):
        to_core = np.where(is_core, gap[i], np.inf)
        host = i if is_core[i] else int(to_core.argmin())
        expected.append(lowest[host] if to_core[host] <= 0.5 else -1)
    assert dbscan(xyz, weight, 0.5, least_weight).tolist() == expected
