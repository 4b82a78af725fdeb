"""Cells as sorted keys against a dictionary."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from loda_pdal.model.grid import Lattice
from loda_pdal.model.groups import unique_rows


@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(1, 4))
def test_cells_are_found_where_they_stand(seed: int, n: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    known = unique_rows(rng.integers(-4, 5, (n, d)))
    lattice = Lattice.around(known)
    keys = lattice.keys(known)
    assert np.all(np.diff(keys) > 0)
    assert np.array_equal(lattice.cells(keys), known)
    asked = rng.integers(-9, 10, (200, d))  # also outside of the lattice
    place_of = {tuple(cell): place for place, cell in enumerate(known.tolist())}
    expected = [place_of.get(tuple(cell), -1) for cell in asked.tolist()]
    assert lattice.find(keys, asked).tolist() == expected
    assert (lattice.find(keys[:0], asked) == -1).all()


def test_only_small_lattices_have_keys() -> None:
    assert Lattice.around(np.array([[0, 0, 0], [10**6, 10**6, 10**6]])).has_keys
    assert not Lattice.around(np.array([[0, 0, 0], [10**7, 10**7, 10**7]])).has_keys
