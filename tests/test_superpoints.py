"""Superpoints: the energy against its definition and its true minimum, the laws of the partition, known surfaces."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference.partition import cut_pursuit, edges_of, energy, graph_of, least_energy, quantised
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from loda_pdal.benchmark.simulate import SimulationOptions, simulate_block
from loda_pdal.kernels import partition as kernels
from loda_pdal.kernels.parallel import set_threads
from loda_pdal.model.cloud import to_local_grid
from loda_pdal.params import FeatureParams, FuseParams, SuperpointParams
from loda_pdal.stages import partition
from loda_pdal.stages.features import Features, eigen_features
from loda_pdal.stages.fuse import fuse_points
from loda_pdal.stages.partition import Graph, minimise_energy, regrouped, single_voxels
from loda_pdal.stages.superpoints import absorb_small, standardised, superpoints, voxel_graph

PARAMS = SuperpointParams()


def random_problem(seed: int, n: int, n_edges: int) -> tuple[Graph, np.ndarray]:
    """A random graph whose features form a few noisy groups."""
    rng = np.random.default_rng(seed)
    pairs = np.sort(rng.integers(0, n, (n_edges, 2)), axis=1)
    pairs = np.unique(pairs[pairs[:, 0] < pairs[:, 1]], axis=0)
    features = quantised(rng.normal(size=(3, 5))[rng.integers(0, 3, n)] + rng.normal(0, 0.3, (n, 5)))
    return Graph(*graph_of(n, pairs, quantised(rng.uniform(0, 3, len(pairs))))), features


def scene(seed: int = 0) -> tuple[np.ndarray, Features, np.ndarray]:
    """Floor, wall and bush at the spacing of fused voxels, in cell order, with what each point belongs to."""
    rng = np.random.default_rng(seed)
    steps = np.arange(0, 6, 0.25)
    u, v = (grid.ravel() for grid in np.meshgrid(steps, steps))
    floor = np.column_stack([u, v, 0 * u])
    wall = np.column_stack([u, 0 * u + 6.25, v + 0.5])
    bush = rng.normal(size=(400, 3)) * 0.5 + [3.0, 2.5, 2.5]
    xyz = np.concatenate([floor, wall, bush])
    xyz += rng.uniform(-1, 1, xyz.shape) * [0.08, 0.08, 0.004]
    truth = np.repeat([0, 1, 2], [len(floor), len(wall), len(bush)])
    order = np.lexsort(np.floor(xyz / 0.25).T[::-1])
    return xyz[order], eigen_features(xyz[order], xyz[order, 2], FeatureParams()), truth[order]


@pytest.fixture(scope="module")
def street() -> list[np.ndarray]:
    """Raw points (n, 3) of both surveys of a short simulated street."""
    block = simulate_block(3, SimulationOptions(length_m=30.0, width_m=40.0, density=0.25, lanes=(0.0,)))
    return [to_local_grid(side.xyz) for side in block.surveys]


def fused(raw: np.ndarray) -> tuple[np.ndarray, Features]:
    """Fused points of a survey and their features, with heights above the lowest point."""
    xyz = fuse_points(raw, FuseParams()).xyz
    return xyz, eigen_features(xyz, xyz[:, 2] - xyz[:, 2].min(), FeatureParams())


def is_connected_partition(graph: Graph, labels: np.ndarray) -> bool:
    edges, _ = edges_of(*graph)
    inside = edges[labels[edges[:, 0]] == labels[edges[:, 1]]]
    joined = coo_array((np.ones(len(inside)), inside.T), shape=(len(labels), len(labels)))
    return connected_components(joined, directed=False)[0] == labels.max() + 1


@pytest.mark.parametrize(("beta", "least_solved", "largest_excess"), [(0.8, 58, 0.03), (10.0, 50, 0.15)])
def test_small_problems_are_nearly_always_solved_exactly(beta: float, least_solved: int, largest_excess: float) -> None:
    excess = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        xyz = rng.uniform(0, 1, (8, 3))
        groups = rng.normal(size=(3, 5))[(3 * xyz[:, 0]).astype(int)]
        features = Features(
            (groups + rng.normal(0, 0.5, (8, 5))).astype(np.float32), np.zeros((8, 3), np.float32), np.ones(8, np.bool_)
        )
        standard = standardised(features)
        graph = voxel_graph(xyz, standard, replace(PARAMS, k=4, beta=beta))
        edges, weights = edges_of(*graph)
        least = least_energy(standard, edges, weights)
        excess.append(minimise_energy(graph, standard).regions.energy / least - 1)
    assert min(excess) > -1e-12
    assert np.count_nonzero(np.array(excess) < 1e-9) >= least_solved
    assert max(excess) < largest_excess


@pytest.mark.parametrize("seed", range(4))
def test_the_energy_of_a_scene_is_at_most_that_of_cut_pursuit(seed: int) -> None:
    xyz, features, _ = scene(seed)
    standard = standardised(features)
    graph = voxel_graph(xyz, standard, PARAMS)
    edges, weights = edges_of(*graph)
    by_cuts = energy(cut_pursuit(standard, edges, weights), standard, edges, weights)
    assert minimise_energy(graph, standard).regions.energy <= by_cuts


def test_the_energy_of_a_simulated_street_is_at_most_that_of_cut_pursuit(street: list[np.ndarray]) -> None:
    for raw in street:
        xyz, features = fused(raw)
        piece = slice(3000)  # a strip across the street
        standard = standardised(Features(features.values[piece], features.normals[piece], features.is_valid[piece]))
        graph = voxel_graph(xyz[piece], standard, PARAMS)
        edges, weights = edges_of(*graph)
        by_cuts = energy(cut_pursuit(standard, edges, weights), standard, edges, weights)
        assert minimise_energy(graph, standard).regions.energy <= by_cuts


def test_cut_pursuit_finds_the_minimum_where_one_cut_does() -> None:
    """The reference itself: two halves of a chain, told apart by a weak edge, and noise that no cut should follow."""
    rng = np.random.default_rng(2)
    features = quantised(np.repeat([0.0, 2.0], 4)[:, None] + rng.normal(0, 0.1, (8, 5)))
    edges = np.column_stack([np.arange(7), np.arange(1, 8)])
    weights = quantised(np.array([3.0, 3, 3, 0.5, 3, 3, 3])).astype(float)
    labels = cut_pursuit(features, edges, weights)
    assert labels.tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    assert energy(labels, features, edges, weights) == pytest.approx(least_energy(features, edges, weights))


@given(st.integers(0, 2**32 - 1), st.integers(2, 120), st.floats(0.5, 6))
def test_the_energy_is_exact_falls_and_belongs_to_connected_regions(seed: int, n: int, degree: float) -> None:
    graph, features = random_problem(seed, n, int(degree * n))
    edges, weights = edges_of(*graph)
    found = minimise_energy(graph, features)
    labels = found.regions.labels
    assert found.energies[0] == energy(np.arange(n), features, edges, weights)
    assert found.energies[-1] == found.regions.energy == energy(labels, features, edges, weights)
    assert np.all(np.diff(found.energies) <= 0)
    assert is_connected_partition(graph, labels)
    for region in range(len(found.regions)):
        inside = np.sort(features[labels == region], axis=0)
        assert np.array_equal(found.regions.medians[region], inside[(len(inside) - 1) // 2])


def test_beta_zero_cuts_everything_and_huge_weights_nothing() -> None:
    graph, features = random_problem(5, 40, 120)
    free = minimise_energy(graph._replace(weights=np.zeros_like(graph.weights)), features)
    assert len(free.regions) == 40
    assert free.regions.energy == 0
    tied = minimise_energy(graph._replace(weights=np.full_like(graph.weights, 200.0)), features)
    n_pieces = kernels.connected_labels(graph.first_arc, graph.heads, np.zeros(40, dtype=np.int32))[1]
    assert len(tied.regions) == n_pieces


def test_tiles_side_by_side_have_the_energy_of_one_times_their_number() -> None:
    xyz, features, _ = scene()
    standard = standardised(features)
    graph = voxel_graph(xyz, standard, PARAMS)
    n, n_arcs = len(xyz), len(graph.heads)
    tiled = Graph(
        np.concatenate([graph.first_arc[:-1] + k * n_arcs for k in range(3)] + [[3 * n_arcs]]).astype(np.int32),
        np.concatenate([graph.heads + k * n for k in range(3)]).astype(np.int32),
        np.tile(graph.weights, 3),
    )
    one, three = minimise_energy(graph, standard), minimise_energy(tiled, np.tile(standard, (3, 1)))
    assert three.energies == tuple(3 * value for value in one.energies)
    for k in range(3):
        expected = one.regions.labels + k * len(one.regions)
        assert np.array_equal(three.regions.labels[k * n : (k + 1) * n], expected)


@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(1, 8))
def test_contraction_is_a_matrix_product(seed: int, n: int, n_labels: int) -> None:
    graph, _ = random_problem(seed, n, 3 * n)
    labels = np.random.default_rng(seed).integers(0, n_labels, n).astype(np.int32)
    first_arc, heads, weights = kernels.contract(*graph, labels, np.empty(n_labels))
    tails = np.repeat(np.arange(n_labels), np.diff(first_arc))
    found = np.zeros((n_labels, n_labels))
    found[tails, heads] = weights
    assert len(np.unique(tails * n_labels + heads)) == len(heads)
    dense = np.zeros((n, n))
    dense[np.repeat(np.arange(n), np.diff(graph.first_arc)), graph.heads] = graph.weights
    member = labels[:, None] == np.arange(n_labels)
    assert np.array_equal(found, np.where(np.eye(n_labels), 0, member.T @ dense @ member))


@given(st.integers(0, 2**32 - 1), st.integers(2, 60), st.integers(1, 20), st.booleans())
def test_after_a_sweep_no_node_wants_to_move(seed: int, n: int, n_labels: int, opens_regions: bool) -> None:
    graph, features = random_problem(seed, n, 3 * n)
    rng = np.random.default_rng(seed)
    group = kernels.connected_labels(graph.first_arc, graph.heads, rng.integers(0, 3, n).astype(np.int32))[0]
    nodes = regrouped(single_voxels(graph, features), group, group.max() + 1, features)
    used, labels = np.unique(rng.integers(0, n_labels, len(nodes)), return_inverse=True)
    labels = labels.astype(np.int32)
    medians = quantised(rng.normal(size=(len(nodes), 5)))
    kernels.move_nodes(
        *nodes.graph,
        features,
        nodes.order,
        nodes.start,
        nodes.medians,
        nodes.deviations,
        labels,
        medians,
        len(used),
        1,
        opens_regions,
    )
    for node in range(len(nodes)):
        arcs = slice(nodes.graph.first_arc[node], nodes.graph.first_arc[node + 1])
        inside = features[group == node].astype(float)

        def cost(label: int, inside: np.ndarray = inside, arcs: slice = arcs) -> float:
            shared = nodes.graph.weights[arcs][labels[nodes.graph.heads[arcs]] == label]
            return float(np.abs(inside - medians[label]).sum() - shared.sum())

        assert all(cost(labels[node]) <= cost(label) for label in labels[nodes.graph.heads[arcs]])


@given(st.integers(0, 2**32 - 1), st.integers(2, 120), st.floats(0.5, 6))
def test_partners_that_are_kept_are_those_that_would_be_found_again(seed: int, n: int, degree: float) -> None:
    graph, features = random_problem(seed, n, int(degree * n))

    def find_all(*args: np.ndarray) -> None:
        kernels.find_partners(*args[:6], np.ones_like(args[6]), *args[7:])

    kept = minimise_energy(graph, features)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(partition, "find_partners", find_all)
        assert np.array_equal(minimise_energy(graph, features).regions.labels, kept.regions.labels)


@given(st.integers(0, 2**32 - 1), st.integers(1, 80), st.integers(1, 4))
def test_connected_labels_are_connected_components(seed: int, n: int, n_labels: int) -> None:
    graph, _ = random_problem(seed, n, n)
    labels = np.random.default_rng(seed).integers(0, n_labels, n).astype(np.int32)
    edges, _ = edges_of(*graph)
    inside = edges[labels[edges[:, 0]] == labels[edges[:, 1]]]
    joined = coo_array((np.ones(len(inside)), inside.T), shape=(n, n))
    expected = connected_components(joined, directed=False)  # numbered by the first node, as ours
    found = kernels.connected_labels(graph.first_arc, graph.heads, labels)
    assert found[1] == expected[0]
    assert np.array_equal(found[0], expected[1])


@given(st.integers(0, 2**32 - 1), st.integers(1, 300), st.booleans())
def test_ranks_are_those_of_sorted_values(seed: int, n: int, has_ties: bool) -> None:
    rng = np.random.default_rng(seed)
    values = (rng.integers(0, 4, n) if has_ties else rng.exponential(size=n)).astype(np.float32)
    rank = int(rng.integers(0, n))
    bits = np.int32(kernels.rank_bits(values.view(np.int32), rank))
    assert bits.view(np.float32) == np.sort(values)[rank]


def test_the_graph_joins_nearest_neighbours_within_reach() -> None:
    rng = np.random.default_rng(8)
    xyz = rng.uniform(0, 5, (300, 3))
    standard = quantised(rng.normal(size=(300, 5)))
    params = replace(PARAMS, k=6, max_edge_m=0.7)
    graph = voxel_graph(xyz, standard, params)
    distance = np.linalg.norm(xyz[:, None] - xyz, axis=2)
    np.fill_diagonal(distance, np.inf)
    nearest = np.argsort(distance, axis=1)[:, :6]
    expected = {
        (min(i, j), max(i, j)) for i in range(300) for j in nearest[i].tolist() if distance[i, j] <= params.max_edge_m
    }
    edges, weights = edges_of(*graph)
    assert {(i, j) for i, j in edges.tolist()} == expected
    assert len(edges) == len(expected) < 300 * 6
    assert len(graph.heads) == 2 * len(edges)
    between = np.linalg.norm(standard[edges[:, 0]].astype(float) - standard[edges[:, 1]], axis=1)
    sigma = np.sort(between)[(len(between) - 1) // 2]
    assert weights == pytest.approx(params.beta * np.exp(-((between / sigma) ** 2)), abs=2e-5)


def test_surfaces_become_superpoints() -> None:
    xyz, features, truth = scene()
    found = superpoints(xyz, features, PARAMS)
    counts = np.zeros((found.n, 3), dtype=int)
    np.add.at(counts, (found.labels, truth), 1)
    assert counts.max(axis=1).sum() > 0.985 * len(xyz)  # hardly any superpoint mixes surfaces
    share = np.sort(counts, axis=0)[::-1] / np.bincount(truth)
    assert share[0, 0] > 0.7  # most of the floor is one superpoint
    assert share[:4, 1].sum() > 0.7  # and the wall a few, one above the other: height is a feature
    graph = voxel_graph(xyz, standardised(features), PARAMS)
    assert is_connected_partition(graph, found.labels)
    edges, weights = edges_of(*graph)
    assert found.energy == energy(found.labels, standardised(features), edges, weights)
    assert found.energy > found.energy_before_absorbing
    assert found.n_absorbed > 0
    assert np.bincount(found.labels).min() >= PARAMS.absorb_below
    _, first = np.unique(found.labels, return_index=True)
    assert np.all(np.diff(first) > 0)  # numbered by the lowest point


def test_nothing_is_absorbed_where_nothing_is_too_small() -> None:
    xyz, features, _ = scene()
    found = superpoints(xyz, features, replace(PARAMS, absorb_below=1))
    assert found.n_absorbed == 0
    assert found.energy == found.energy_before_absorbing


def test_a_small_region_joins_where_it_shares_most_weight_and_joins_no_two_large_ones() -> None:
    # four voxels | one voxel | four voxels, and a lonely one: the small one is tied more to the right
    edges = np.array([[0, 1], [1, 2], [2, 3], [3, 4], [4, 5], [5, 6], [6, 7], [7, 8]])
    weights = quantised(np.array([3.0, 3, 3, 0.25, 0.5, 3, 3, 3]))
    features = quantised(np.array([0.0, 0, 0, 0, 5, 9, 9, 9, 9, 50])[:, None].repeat(5, axis=1))
    graph = Graph(*graph_of(10, edges, weights))
    group = np.array([0, 0, 0, 0, 1, 2, 2, 2, 2, 3], dtype=np.int32)
    regions = regrouped(single_voxels(graph, features), group, 4, features)
    assert regions.energy == 0.75
    absorbed = absorb_small(regions, features, 3)
    assert absorbed.labels.tolist() == [0, 0, 0, 0, 1, 1, 1, 1, 1, 2]
    assert absorbed.energy == 0.25 + 5 * 4
    even = Graph(*graph_of(10, edges, np.where(weights < 1, np.float32(0.5), weights)))
    tie = absorb_small(regrouped(single_voxels(even, features), group, 4, features), features, 3)
    assert tie.labels.tolist() == [0, 0, 0, 0, 1, 1, 1, 1, 1, 2]  # equal weights: 9 is nearer to 5 than 0 is


def test_components_are_what_hangs_together_apart_from_the_ground() -> None:
    xyz, features, truth = scene()
    found = superpoints(xyz, features, replace(PARAMS, method="components", absorb_below=1))
    is_floor = truth == 0
    assert found.n_rounds == 0
    assert len(np.unique(found.labels[is_floor])) == 1
    assert not np.isin(found.labels[~is_floor], found.labels[is_floor]).any()
    graph = voxel_graph(xyz, standardised(features), PARAMS)
    edges, weights = edges_of(*graph)
    assert found.energy == energy(found.labels, standardised(features), edges, weights)


def test_superpoints_do_not_depend_on_place_or_threads() -> None:
    xyz, features, _ = scene(2)
    expected = superpoints(xyz, features, PARAMS)
    assert np.array_equal(superpoints(xyz + np.array([1e6, 1e6, 0]), features, PARAMS).labels, expected.labels)
    try:
        set_threads(1)
        assert np.array_equal(superpoints(xyz, features, PARAMS).labels, expected.labels)
    finally:
        set_threads(None)


def test_superpoints_of_two_surveys_at_once_in_any_order_of_the_points(street: list[np.ndarray]) -> None:
    expected = [superpoints(*fused(raw), PARAMS) for raw in street]
    shuffled = [np.random.default_rng(0).permutation(raw) for raw in street]
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda raw: superpoints(*fused(raw), PARAMS), shuffled))
    for one, other in zip(expected, found, strict=True):
        assert np.array_equal(one.labels, other.labels)
        assert (one.energy, one.n_absorbed) == (other.energy, other.n_absorbed)


def test_standardised_features_have_no_mean_and_unit_spread() -> None:
    rng = np.random.default_rng(0)
    values = (rng.normal(size=(500, 5)) * [1, 2, 3, 0, 5] + 7).astype(np.float32)
    is_valid = rng.random(500) < 0.9
    found = standardised(Features(values, np.zeros((500, 3), dtype=np.float32), is_valid))
    assert found[is_valid].mean(axis=0) == pytest.approx(0, abs=1e-4)
    assert found[is_valid].std(axis=0) == pytest.approx([1, 1, 1, 0, 1], abs=1e-4)


@pytest.mark.parametrize("n", [0, 1, 2])
@pytest.mark.parametrize("method", ["partition", "components"])
def test_hardly_any_points(n: int, method: str) -> None:
    xyz = np.array([[0.0, 0, 0], [40.0, 0, 0]])[:n]
    found = superpoints(xyz, eigen_features(xyz, np.zeros(n), FeatureParams()), replace(PARAMS, method=method))
    assert found.labels.tolist() == list(range(n))  # far apart: no edge, nothing to join
    assert found.labels.dtype == np.int32
    assert (found.n, found.energy, found.n_absorbed) == (n, 0.0, 0)


def test_equal_features_make_one_superpoint() -> None:
    xyz = np.column_stack([np.arange(50) * 0.25, np.zeros(50), np.zeros(50)])
    features = Features(np.ones((50, 5), np.float32), np.zeros((50, 3), np.float32), np.ones(50, np.bool_))
    found = superpoints(xyz, features, PARAMS)
    assert (found.n, found.energy) == (1, 0.0)
