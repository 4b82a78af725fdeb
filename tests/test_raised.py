"""What one survey calls ground shows a thing where it lies well above the other survey's ground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.pair import Pair
from loda_pdal.pipeline import Ground, is_raised


@dataclass(frozen=True)
class Level:
    """A ground model at one height, unknown where x is negative."""

    z: float

    def height_at(self, xy: FloatArray) -> FloatArray:
        return np.where(xy[:, 0] < 0, np.nan, self.z)


def test_the_lower_ground_counts_where_one_model_climbs_over_a_thing() -> None:
    def ground(before: float, after: float) -> Pair[Ground]:
        return Pair(before, after).map(lambda z: Ground(cast(Any, Level(z)), np.zeros(0)))

    xyz = np.array([[1.0, 0, 0.1], [1.0, 0, 0.4], [1.0, 0, 0.8], [-1.0, 0, 0.8]])
    assert is_raised(xyz, ground(0.0, 0.7), 0.3).tolist() == [False, True, True, False]
    assert is_raised(xyz, ground(0.7, 0.0), 0.3).tolist() == [False, True, True, False]
    assert is_raised(xyz, ground(0.7, 0.7), 0.3).tolist() == [False] * 4
    assert not is_raised(xyz, ground(0.0, 0.7), 0.0).any()
