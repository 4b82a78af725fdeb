"""The embedded runner: our pipelines without PDAL.

It reads the same JSON and does what PDAL does with readers.las, filters.python with an entry of loda_pdal,
filters.merge, filters.ferry, filters.assign with plain numbers, and writers.las. Anything else is refused by name
before a point is read. The ``source`` text of a stage is never executed: it must be, to the letter, the one line that
names the entry.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from loda_pdal.model.errors import PipelineError
from loda_pdal.pdal_face.document import Stage
from loda_pdal.pdal_face.table import Table, merge_tables, read_table, write_table

Progress = Callable[[int, int, str], None]

_SOURCE = re.compile(
    r"\s*import\s+loda_pdal\.pdal_face\.entry\s+as\s+(?P<module>[A-Za-z_]\w*)\s*[;\n]\s*"
    r"(?P<function>[A-Za-z_]\w*)\s*=\s*(?P=module)\.bind\(\s*(?P<quote>['\"])(?P<name>\w+)(?P=quote)\s*,\s*globals\(\)\s*\)\s*"
)
_ASSIGNED = re.compile(r"\s*(?P<name>\w+)\s*(?:\[:\])?\s*=\s*(?P<value>[-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*")
_FERRIED = re.compile(r"\s*(?P<source>\w*)\s*=>\s*(?P<target>\w+)\s*")
_ADDED = re.compile(r"\s*(?P<name>\w+)\s*(?:=\s*(?P<type>\w+))?\s*")
_TYPES = {"double": "float64", "float": "float32", "float64": "float64", "float32": "float32"} | {
    f"{sign}int{bits}": f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}
_WRITER_DEFAULTS = {"minor_version": "4", "dataformat_id": "6", "scale": "0.01", "offset": "0"}


@dataclass(frozen=True)
class Prepared:
    """A stage that was checked: the tables of its inputs go in, its own come out."""

    stage: Stage
    work: Callable[[list[Table]], list[Table]]
    output: Path | None = None


def prepare(stages: list[Stage]) -> list[Prepared]:
    """Every stage checked as far as that is possible without reading points; `PipelineError` names what cannot run."""
    unknown = [stage for stage in stages if stage.type not in _PREPARERS]
    if unknown:
        raise PipelineError(
            f"The embedded runner does not know {', '.join(dict.fromkeys(stage.type for stage in unknown))}.",
            f"Install PDAL with its Python plugin (docs/pdal.md), or use only {', '.join(_PREPARERS)}.",
            "stage-unsupported",
        )
    prepared = [_PREPARERS[stage.type](stage) for stage in stages]
    if not any(p.output for p in prepared):
        raise PipelineError("The pipeline has no writer.", "End it with writers.las.", "pipeline-inputs")
    return prepared


def execute(prepared: list[Prepared], progress: Progress | None = None) -> list[Path]:
    """Run checked stages in order; the files that were written."""
    tables: dict[int, list[Table]] = {}
    readers_left = [sum(position in p.stage.inputs for p in prepared) for position in range(len(prepared))]
    for position, this in enumerate(prepared):
        if progress:
            progress(position, len(prepared), this.stage.title)
        given = [table for i in this.stage.inputs for table in tables[i]]
        for i in this.stage.inputs:
            readers_left[i] -= 1
            if not readers_left[i]:
                del tables[i]
        tables[position] = this.work(given)
    if progress:
        progress(len(prepared), len(prepared), "done")
    return [p.output for p in prepared if p.output]


def _check_options(stage: Stage, known: tuple[str, ...]) -> None:
    unknown = [name for name in stage.options if name not in known]
    if unknown:
        raise PipelineError(
            f"{stage.title}: the embedded runner does not know the option {unknown[0]!r}.",
            f"It knows {', '.join(known)}; with PDAL installed all options work.",
            "option-unsupported",
        )


def _filename(stage: Stage) -> Path:
    name = stage.options.get("filename")
    if not isinstance(name, str) or not name:
        raise PipelineError(
            f"{stage.title} has no filename.", f"Give --stage.{stage.tag or 'TAG'}.filename=FILE.", "filename-missing"
        )
    return Path(name)


def _prepare_reader(stage: Stage) -> Prepared:
    _check_options(stage, ("filename",))
    path = _filename(stage)
    if not path.is_file():
        raise PipelineError(f"{stage.title}: {path} does not exist.", "Check the path.", "input-missing")
    return Prepared(stage, lambda tables: [read_table(path)])


def _prepare_merge(stage: Stage) -> Prepared:
    _check_options(stage, ())
    return Prepared(stage, lambda tables: [merge_tables(tables)])


def _prepare_python(stage: Stage) -> Prepared:
    _check_options(stage, ("source", "module", "function", "add_dimension", "pdalargs"))
    match = _SOURCE.fullmatch(_text(stage.options.get("source", "")))
    if not match or match["function"] != stage.options.get("function"):
        raise PipelineError(
            f"{stage.title}: the embedded runner runs the entries of loda_pdal only.",
            'Write "source": "import loda_pdal.pdal_face.entry as e; run = e.bind(\'NAME\', globals())" and '
            '"function": "run", or install PDAL to run Python of your own.',
            "stage-unsupported",
        )
    if not stage.options.get("module"):
        raise PipelineError(f"{stage.title} has no module.", f'Add "module": "loda_{match["name"]}".', "module-missing")
    from loda_pdal.pdal_face import entry

    name, added = match["name"], _added_dimensions(stage)
    entry.check(name, stage.options.get("pdalargs"))

    def work(tables: list[Table]) -> list[Table]:
        return [_called(entry.bind, name, added, stage.options.get("pdalargs"), table) for table in tables]

    return Prepared(stage, work)


def _called(bind: Any, name: str, added: dict[str, str], arguments: Any, table: Table) -> Table:
    """The table after one call of an entry, as PDAL makes it."""
    columns = dict(table.columns)
    for dimension, kind in added.items():
        columns.setdefault(dimension, np.zeros(len(table), dtype=kind))
    metadata = {"children": [{"name": key, "value": text} for key, text in table.notes.items()]}
    script = {"pdalargs": arguments, "spatialreference": table.crs_wkt or "", "metadata": metadata}
    outs: dict[str, Any] = {}
    bind(name, script)(columns, outs)
    left = script.get("out_metadata")
    notes = {**table.notes, left["name"]: left["value"]} if isinstance(left, dict) else table.notes
    return Table({**columns, **outs}, table.crs_wkt, notes)


def _added_dimensions(stage: Stage) -> dict[str, str]:
    """Name and NumPy type of each ``add_dimension``."""
    given = stage.options.get("add_dimension", [])
    added = {}
    for text in [given] if isinstance(given, str) else given:
        match = _ADDED.fullmatch(str(text))
        kind = _TYPES.get((match["type"] or "double").lower().removesuffix("_t")) if match else None
        if not match or not kind:
            raise PipelineError(
                f"{stage.title}: add_dimension {text!r} is not NAME=TYPE.", "For example LoD95=float.", "option-invalid"
            )
        added[match["name"]] = kind
    return added


def _text(value: Any) -> str:
    """PDAL takes a list of lines for a text."""
    return "\n".join(str(line) for line in value) if isinstance(value, list) else str(value)


def _prepare_ferry(stage: Stage) -> Prepared:
    _check_options(stage, ("dimensions",))
    given = stage.options.get("dimensions", "")
    moves = [_FERRIED.fullmatch(part) for part in (given if isinstance(given, list) else str(given).split(","))]

    def ferried(table: Table) -> Table:
        columns = dict(table.columns)
        for move in moves:
            assert move is not None
            source = columns[move["source"]] if move["source"] else np.zeros(len(table))
            kind = columns[move["target"]].dtype if move["target"] in columns else np.float64
            columns[move["target"]] = source.astype(kind)
        return replace(table, columns=columns)

    if not all(moves):
        raise PipelineError(f"{stage.title}: {given!r} is not A=>B.", "For example =>Epoch.", "option-invalid")
    return Prepared(stage, lambda tables: [ferried(table) for table in tables])


def _prepare_assign(stage: Stage) -> Prepared:
    _check_options(stage, ("value", "assignment"))
    given = stage.options.get("value", stage.options.get("assignment", ""))
    parts = [_ASSIGNED.fullmatch(str(part)) for part in (given if isinstance(given, list) else str(given).split(","))]

    def assigned(table: Table) -> Table:
        columns = dict(table.columns)
        for part in parts:
            assert part is not None
            kind = columns[part["name"]].dtype if part["name"] in columns else np.dtype(np.float64)
            columns[part["name"]] = np.full(len(table), float(part["value"])).astype(kind)
        return replace(table, columns=columns)

    if not all(parts):
        raise PipelineError(
            f"{stage.title}: the embedded runner assigns numbers only, not {given!r}.",
            "Write NAME = number, or install PDAL.",
            "option-unsupported",
        )
    return Prepared(stage, lambda tables: [assigned(table) for table in tables])


def _prepare_writer(stage: Stage) -> Prepared:
    axes = tuple(f"{what}_{axis}" for what in ("scale", "offset") for axis in "xyz")
    _check_options(stage, ("filename", "extra_dims", "minor_version", "dataformat_id", "compression", "forward", *axes))
    path = _filename(stage)
    if path.suffix.lower() not in (".las", ".laz"):
        raise PipelineError(f"{stage.title}: {path} is not a .las or .laz file.", "Change the name.", "option-invalid")
    if not path.parent.is_dir():
        raise PipelineError(f"{stage.title}: there is no folder {path.parent}.", "Make it first.", "output-unwritable")
    extra = stage.options.get("extra_dims", "")
    if extra not in ("", "all"):
        raise PipelineError(
            f"{stage.title}: the embedded runner writes all extra dimensions or none, not {extra!r}.",
            'Set "extra_dims": "all".',
            "option-unsupported",
        )

    def number(option: str) -> float:
        text = stage.options.get(option, _WRITER_DEFAULTS[option.split("_")[0] if option in axes else option])
        try:
            return float(text)
        except (TypeError, ValueError):
            raise PipelineError(
                f"{stage.title}: {option} is {text!r}, not a number.", "Give a number.", "option-invalid"
            ) from None

    scale_x, scale_y, scale_z = (number(f"scale_{axis}") for axis in "xyz")
    offset_x, offset_y, offset_z = (
        None if stage.options.get(f"offset_{axis}") == "auto" else number(f"offset_{axis}") for axis in "xyz"
    )
    point_format, minor_version = int(number("dataformat_id")), int(number("minor_version"))

    def work(tables: list[Table]) -> list[Table]:
        whole = merge_tables(tables)
        write_table(
            whole,
            path,
            point_format=point_format,
            minor_version=minor_version,
            scale=(scale_x, scale_y, scale_z),
            offset=(offset_x, offset_y, offset_z),
            with_extra=extra == "all",
        )
        return [whole]

    return Prepared(stage, work, path)


_PREPARERS: dict[str, Callable[[Stage], Prepared]] = {
    "readers.las": _prepare_reader,
    "filters.python": _prepare_python,
    "filters.merge": _prepare_merge,
    "filters.ferry": _prepare_ferry,
    "filters.assign": _prepare_assign,
    "writers.las": _prepare_writer,
}
