"""What ``filters.python`` stages call: one entry per stage of the method.

    "source": "import loda_pdal.pdal_face.entry as e; run = e.bind('lod', globals())",
    "module": "loda_lod", "function": "run"

Every entry takes both epochs in one view, told apart by Epoch, and writes the dimensions that
`loda_pdal.pdal_face.builder.WRITES` lists. What it needs from earlier stages comes from the run folder, and is computed
where it is not there: entries work alone and in any order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from loda_pdal.model import dimensions as dims
from loda_pdal.model.errors import PipelineError
from loda_pdal.pdal_face import run as steps
from loda_pdal.pdal_face.adapter import Call, Entry, arguments_of, entry_of
from loda_pdal.pdal_face.run import Arguments, Run, Values


def bind(name: str, script: dict[str, Any]) -> Entry:
    """The function that PDAL calls for the entry ``name``.

    Parameters
    ----------
    name : str
        One of `ENTRIES`.
    script : dict
        ``globals()`` of the stage's own ``source``: PDAL leaves pdalargs and metadata there and nowhere else.
    """
    return entry_of(name, _entry(name), script)


def check(name: str, pdalargs: Any) -> None:
    """`LodaError` where the entry or its arguments cannot work, whatever the points."""
    _entry(name)
    Arguments.parse(arguments_of(name, pdalargs))


def _entry(name: str) -> Callable[[Call], None]:
    if name not in ENTRIES:
        raise PipelineError(f"There is no stage {name!r}.", f"Stages: {', '.join(ENTRIES)}.", "stage-unknown")
    return ENTRIES[name]


def _epoch(name: str, number: int) -> Callable[[Call], None]:
    """Marks all points as one epoch and notes their CRS."""

    def work(call: Call) -> None:
        call.points.write_dimension(dims.EPOCH, np.full(len(call.points), number, dtype=np.uint8))
        if call.crs_wkt:
            call.leave(name, call.crs_wkt)

    return work


def _step(
    name: str, values: Callable[[Run], Values] | None = None, file: Callable[[Run], None] | None = None
) -> Callable[[Call], None]:
    """Makes sure that a step is done, and writes what it says of every point and to a file of its own."""

    def work(call: Call) -> None:
        run = Run(call)
        run[name]
        if values:
            run.write(values(run))
        if file:
            file(run)

    return work


def _result(call: Call) -> None:
    run = Run(call)
    run.write(steps.result_values(run))


def _move(call: Call) -> None:
    Run(call).move_before()


ENTRIES: dict[str, Callable[[Call], None]] = {
    "before": _epoch("before", 0),
    "after": _epoch("after", 1),
    "register": _step("register", file=Run.write_transform),
    "ground": _step("ground", steps.heights),
    "lod": _step("lod", steps.limits, Run.write_lod_raster),
    "proxies": _step("proxies"),
    "superpoints": _step("superpoints", steps.superpoint_numbers),
    "semantics": _step("semantics", steps.classes),
    "instances": _step("instances", steps.instance_numbers),
    "objects": _step("objects"),
    "changes": _step("changes"),
    "ground_changes": _step("ground_changes"),
    "result": _result,
    "move": _move,
}
"""Entries by name, in the order of the method."""
