"""All we know about filters.python: what PDAL hands to a stage and what it takes back.

PDAL copies the columns of a point view into NumPy arrays, calls ``function(ins, outs)``, and copies raw memory back
from ``outs``. So an output must be a contiguous array of exactly the dimension's type with one value per point; PDAL
checks the type's size and kind at most, and never the strides. Only names that the view has can be written. `Points`
keeps these rules in one place; a stage that breaks one gets a `PipelineError` instead of wrong values in a file.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.dimensions import Dimension
from loda_pdal.model.errors import PipelineError

Columns = Mapping[str, npt.NDArray[Any]]
Entry = Callable[[Any, Any], bool]


@dataclass(frozen=True)
class Points:
    """The points of one call.

    Attributes
    ----------
    stage : str
        Name of the stage, for messages.
    ins : mapping of str to (n,) array
        Every dimension of the view; valid during the call only.
    outs : dict of str to (n,) array
        What PDAL copies back.
    """

    stage: str
    ins: Columns
    outs: dict[str, npt.NDArray[Any]]

    def __len__(self) -> int:
        return len(self.ins["X"])

    def column(self, name: str) -> npt.NDArray[Any]:
        """A copy of one dimension, (n,), in its own type."""
        if name not in self.ins:
            raise PipelineError(
                f"Stage {self.stage} needs the dimension {name}, which these points do not have.",
                f"Put the stage that makes {name} before it; the points have: {', '.join(self.ins)}.",
                "dimension-missing",
            )
        return np.array(self.ins[name])

    @property
    def xyz(self) -> FloatArray:
        """Full map coordinates, (n, 3) float64."""
        return np.column_stack([self.ins[axis] for axis in "XYZ"])

    def write(self, name: str, values: npt.NDArray[Any]) -> None:
        """Hand one dimension, (n,), back to PDAL in the view's own type."""
        if name not in self.ins:
            raise PipelineError(
                f"Stage {self.stage} writes the dimension {name}, which these points do not have.",
                f'Add "add_dimension": {json.dumps(_added(name, values))} to the stage.',
                "dimension-missing",
            )
        wanted = self.ins[name].dtype
        if values.shape != (len(self),):
            raise PipelineError(
                f"Stage {self.stage} has {values.shape} values of {name} for {len(self)} points.", "", "stage-output"
            )
        if values.dtype != wanted:
            values = self._converted(name, values, wanted)
        self.outs[name] = np.ascontiguousarray(values)

    def write_dimension(self, dimension: Dimension, values: npt.NDArray[Any]) -> None:
        """Hand one of our dimensions, (n,), back to PDAL."""
        self.write(dimension.name, values.astype(dimension.dtype, copy=False))

    def _converted(self, name: str, values: npt.NDArray[Any], wanted: np.dtype[Any]) -> npt.NDArray[Any]:
        """``values`` in the view's type, if none of them changes by that beyond rounding of floats."""
        with np.errstate(invalid="ignore", over="ignore"):
            converted = values.astype(wanted)
        is_exact = np.array_equal(converted.astype(values.dtype), values, equal_nan=values.dtype.kind == "f")
        if not is_exact and not (wanted.kind == "f" and values.dtype.kind == "f"):
            raise PipelineError(
                f"Stage {self.stage} cannot write {name} as {wanted}: it would lose values of type {values.dtype}.",
                f'Let the stage add it: "add_dimension": {json.dumps(_added(name, values))}.',
                "dimension-type",
            )
        return converted


def _added(name: str, values: npt.NDArray[Any]) -> str:
    return f"{name}={pdal_type(values.dtype)}"


def pdal_type(dtype: npt.DTypeLike) -> str:
    """PDAL's name of a NumPy type, as ``add_dimension`` takes it: ``uint8``, ``float``, ``double``."""
    name = np.dtype(dtype).name
    return {"float32": "float", "float64": "double"}.get(name, name)


@dataclass(frozen=True)
class Call:
    """Everything a stage is called with.

    Attributes
    ----------
    points : Points
        The view.
    arguments : dict
        The stage's ``pdalargs``.
    crs_wkt : str or None
        CRS of the view; None where it has none.
    notes : dict of str to str
        What earlier stages left for later ones with `Call.leave`.
    """

    points: Points
    arguments: dict[str, Any]
    crs_wkt: str | None
    notes: dict[str, str]
    script: dict[str, Any]

    def leave(self, name: str, text: str) -> None:
        """Leave a text for later stages: it travels in PDAL's metadata, and ``--metadata`` writes it out."""
        self.script["out_metadata"] = {"name": _NOTE + name, "value": text, "type": "string"}


_NOTE = "loda_"


def entry_of(stage: str, work: Callable[[Call], None], script: dict[str, Any]) -> Entry:
    """The function with exactly two plain arguments that PDAL calls.

    Parameters
    ----------
    stage : str
        Name of the stage, for messages.
    work : callable
        What the stage does.
    script : dict
        Globals of the stage's own little module, in which PDAL sets pdalargs, metadata and spatialreference just
        before the call, and nowhere else.
    """

    def run(ins: Any, outs: Any) -> bool:
        if len(ins["X"]) > 0:
            work(
                Call(
                    Points(stage, ins, outs),
                    arguments_of(stage, script.get("pdalargs")),
                    _crs_wkt(script.get("spatialreference")),
                    dict(_notes(script.get("metadata"))),
                    script,
                )
            )
        return True

    return run


def arguments_of(stage: str, given: Any) -> dict[str, Any]:
    """``pdalargs`` as a dictionary, whichever way PDAL spells it."""
    if isinstance(given, str) and given.strip():
        try:
            given = json.loads(given)
        except ValueError as error:
            raise PipelineError(
                f"pdalargs of stage {stage} is not valid JSON ({error}).",
                'Write it as {"run": "FOLDER"}.',
                "pdalargs-invalid",
            ) from error
    if given is None or given == "":
        return {}
    if not isinstance(given, dict):
        raise PipelineError(
            f"pdalargs of stage {stage} is {given!r}, not a table of names and values.",
            'Write it as {"run": "FOLDER"}.',
            "pdalargs-invalid",
        )
    return given


def _crs_wkt(given: Any) -> str | None:
    """WKT of PDAL's ``spatialreference``: a dictionary in PDAL 2, text in older and embedded runs."""
    if isinstance(given, dict):
        srs = given.get("srs", given)
        given = next((srs[key] for key in ("compoundwkt", "wkt", "horizontal") if srs.get(key)), None)
    return given or None


def _notes(metadata: Any) -> list[tuple[str, str]]:
    """All notes in PDAL's metadata tree, however deep, as (name, text)."""
    if not isinstance(metadata, dict):
        return []
    name = str(metadata.get("name", ""))
    own = [(name.removeprefix(_NOTE), str(metadata.get("value", "")))] if name.startswith(_NOTE) else []
    children = metadata.get("children", [])
    below = children.values() if isinstance(children, dict) else children
    return own + [note for child in below for note in _notes(child)]
