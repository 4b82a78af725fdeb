"""Bodies under roofs: what an airborne survey shows of a building is its top, what changes is its volume."""

from __future__ import annotations

import numpy as np

from loda_pdal.stages.filling import fill_columns


def _roof(x0: float, height: float, owner: int, step: float = 0.4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.arange(x0, x0 + 8, step) + 0.1, np.arange(0, 6, step) + 0.1)
    xyz = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 10.0 + height)])
    return xyz, np.full(len(xyz), height), np.full(len(xyz), owner, dtype=np.int32)


def test_a_roof_becomes_a_body_down_to_the_ground() -> None:
    xyz, height, owner = _roof(0.0, 5.0, 2)
    found = fill_columns(xyz, height, owner, np.ones(len(xyz), bool), 1.0)
    assert len(found.xyz) == 8 * 6 * 5  # one point per m3
    assert (owner[found.under] == 2).all()
    levels, counts = np.unique(found.xyz[:, 2], return_counts=True)
    np.testing.assert_allclose(levels, [10.0, 11.0, 12.0, 13.0, 14.0])
    assert (counts == 48).all()


def test_columns_of_two_owners_are_filled_apart_and_order_does_not_matter() -> None:
    parts = [_roof(0.0, 5.0, 0), _roof(7.0, 3.0, 1)]  # they overlap by one column of cells
    xyz, height, owner = (np.concatenate(values) for values in zip(*parts, strict=True))
    found = fill_columns(xyz, height, owner, np.ones(len(xyz), bool), 1.0)
    assert np.bincount(owner[found.under]).tolist() == [48 * 5, 48 * 3]
    mixed = np.random.default_rng(0).permutation(len(xyz))
    other = fill_columns(xyz[mixed], height[mixed], owner[mixed], np.ones(len(xyz), bool), 1.0)
    np.testing.assert_array_equal(np.unique(found.xyz, axis=0), np.unique(other.xyz, axis=0))


def test_what_is_no_roof_has_no_owner_or_no_ground_stays_as_it_is() -> None:
    xyz, height, owner = _roof(0.0, 5.0, 0)
    is_roof = np.ones(len(xyz), bool)
    assert len(fill_columns(xyz, height, owner, ~is_roof, 1.0).under) == 0
    assert len(fill_columns(xyz, height, np.full(len(xyz), -1), is_roof, 1.0).under) == 0
    assert len(fill_columns(xyz, np.full(len(xyz), np.nan), owner, is_roof, 1.0).under) == 0
    assert len(fill_columns(np.zeros((0, 3)), np.zeros(0), np.zeros(0, int), np.zeros(0, bool), 1.0).under) == 0
