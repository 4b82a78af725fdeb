"""A wall that one survey shows lower: its roof came down, or the view of it ended there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.stages.cues import Surface
from tests.test_changes import decide, labels, surface

Top = Callable[[FloatArray], FloatArray]


def front(top: Top, angle_deg: float = 0.0) -> Surface:
    """The front of a row, 30 m long, as high as ``top`` says along it, on level ground; turned about its corner."""
    x, z = (side.ravel() for side in np.meshgrid(np.arange(0.125, 30, 0.25), np.arange(0.125, 12, 0.25)))
    is_wall = z < top(x)
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    xyz = np.column_stack([x * c, x * s, z])[is_wall]
    return surface((0, (xyz, np.tile([s, -c, 0.0], (len(xyz), 1)))))


def level(top_m: float) -> Top:
    return lambda x: np.full(len(x), top_m)


def view(x: FloatArray) -> FloatArray:
    """How far up a sensor 8 m before the wall looks: 22 degrees."""
    return 2.0 + np.tan(np.deg2rad(22.0)) * np.hypot(8.0, x - 12.0)


def behind_a_crown(x: FloatArray) -> FloatArray:
    """A level roof of which a crown hides a piece."""
    return np.where(np.abs(x - 15.0) < 3.0, 9.0 - np.sqrt(np.maximum(9.0 - (x - 15.0) ** 2, 0.0)), 9.0)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0])
@pytest.mark.parametrize("seen", [view, behind_a_crown])
def test_a_wall_that_a_view_ends_on_stays(seen: Top, angle_deg: float) -> None:
    whole, part = front(level(9.0), angle_deg), front(lambda x: np.minimum(seen(x), 9.0), angle_deg)
    for before, after in ((whole, part), (part, whole)):
        assert set(labels(decide(before, after, ObjectClass.BUILDING))) == {ChangeLabel.UNCHANGED}


def storey(x: FloatArray) -> FloatArray:
    return np.where(np.abs(x - 15.0) < 4.0, 6.0, 9.0)


def gable(x: FloatArray) -> FloatArray:
    return np.where(np.abs(x - 15.0) < 4.0, 5.0 + (4.0 - np.abs(x - 15.0)), 4.0)


@pytest.mark.parametrize(
    ("lower", "higher"),
    [
        (storey, level(9.0)),
        (level(6.0), lambda x: 15.0 - storey(x)),
        (gable, lambda x: gable(x) + 3.0 * (gable(x) > 4)),
    ],
    ids=["a storey between others", "a storey above others", "a gable"],
)
def test_a_roof_that_was_raised_or_lowered_is_told(lower: Top, higher: Top) -> None:
    assert ChangeLabel.INCREASED in labels(decide(front(lower), front(higher), ObjectClass.BUILDING))
    assert ChangeLabel.DECREASED in labels(decide(front(higher), front(lower), ObjectClass.BUILDING))
