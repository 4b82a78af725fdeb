"""What every baseline consists of, so that all are run, timed and tuned by the same lines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any

from loda_pdal.benchmark.baselines.scene import Marks, Scene
from loda_pdal.model.pair import Pair


@dataclass(frozen=True)
class Baseline:
    """One method: what it measures on a scene, and how it decides on that.

    Attributes
    ----------
    name : str
    measure : callable
        ``measure(scene, params)``: the slow part, on which few parameters have a bearing.
    decide : callable
        ``decide(scene, measured, params)``: the answer on the fused points of both epochs.
    grid : dict
        Values of each parameter that the search tries.
    measured_by : tuple of str
        Parameters that `measure` looks at.
    needs : str
        Library that is not among the dependencies of loda-pdal; empty for none.
    """

    name: str
    measure: Callable[[Scene, Any], Any]
    decide: Callable[[Scene, Any, Any], Pair[Marks]]
    grid: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    measured_by: tuple[str, ...] = ()
    needs: str = ""

    @property
    def is_installed(self) -> bool:
        """Whether the library that it needs is there."""
        return not self.needs or find_spec(self.needs) is not None
