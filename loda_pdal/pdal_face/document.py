"""Pipeline files: the JSON that PDAL reads, with its rules of which stage feeds which, and overrides of options."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from loda_pdal.model.errors import PipelineError


@dataclass(frozen=True)
class Stage:
    """One stage of a pipeline.

    Attributes
    ----------
    type : str
        ``readers.las`` and so on; empty where the file leaves it to the filename.
    tag : str
        Its name in the file; empty where it has none.
    inputs : tuple of int
        Positions of the stages that feed it.
    options : dict
        All else.
    """

    type: str
    tag: str
    inputs: tuple[int, ...]
    options: dict[str, Any]

    @property
    def title(self) -> str:
        """How messages name the stage."""
        return f"{self.type} ({self.tag})" if self.tag else self.type


def read_stages(
    path: Path, overrides: Mapping[str, str] | None = None, document: dict[str, Any] | None = None
) -> list[Stage]:
    """Stages of a pipeline file in its order, with overrides applied.

    Parameters
    ----------
    path : Path
        JSON, an array or an object with the key ``pipeline``.
    overrides : mapping, optional
        ``{"stage.TAG.option": value}`` or ``{"readers.las.option": value}``, as PDAL takes them after ``--``.
    document : dict, optional
        What the file holds, where it is known already; ``path`` then only names it.
    """
    stages = _connected(_entries(_document(path) if document is None else document, path), path)
    for key, value in (overrides or {}).items():
        stages = _overridden(stages, key, value)
    return stages


def to_document(stages: list[Stage]) -> dict[str, Any]:
    """The pipeline of these stages, every input named."""
    taken = {stage.tag for stage in stages}
    tags = [stage.tag or _free_tag(position, taken) for position, stage in enumerate(stages)]
    entries: list[dict[str, Any]] = []
    for tag, stage in zip(tags, stages, strict=True):
        inputs = {"inputs": [tags[i] for i in stage.inputs]} if stage.inputs else {}
        entries.append({"type": stage.type, "tag": tag, **inputs, **stage.options})
    return {"pipeline": entries}


def _free_tag(position: int, taken: set[str]) -> str:
    tag = f"stage_{position}"
    while tag in taken:
        tag += "_"
    return tag


def _document(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise PipelineError(
            f"{path}: cannot be read ({error.strerror or error}).", "Check the path.", "pipeline-unreadable"
        ) from error
    except ValueError as error:
        raise PipelineError(
            f"{path}: is not valid JSON ({error}).", "Correct the file.", "pipeline-unreadable"
        ) from error


def _entries(document: Any, path: Path) -> list[dict[str, Any]]:
    entries = document.get("pipeline") if isinstance(document, dict) else document
    if not isinstance(entries, list) or not entries:
        raise PipelineError(f"{path}: holds no list of stages.", 'Write {"pipeline": [...]}.', "pipeline-unreadable")
    return [_entry(entry, path, last=position == len(entries) - 1) for position, entry in enumerate(entries)]


def _entry(given: Any, path: Path, *, last: bool) -> dict[str, Any]:
    """One stage with its type: a bare filename is a reader, or the writer at the end."""
    if not isinstance(given, (str, dict)):
        raise PipelineError(
            f"{path}: {given!r} is no stage.", "Write a stage as an object with a type.", "pipeline-unreadable"
        )
    entry: dict[str, Any] = {"filename": given} if isinstance(given, str) else given
    if not entry.get("type"):
        is_las = str(entry.get("filename", "")).lower().endswith((".las", ".laz"))
        if not is_las:
            raise PipelineError(
                f"{path}: a stage has no type: {json.dumps(entry)[:80]}.", "Give it a type.", "pipeline-unreadable"
            )
        entry = {**entry, "type": "writers.las" if last else "readers.las"}
    return entry


def _connected(entries: list[dict[str, Any]], path: Path) -> list[Stage]:
    """PDAL's rule: a filter or writer without ``inputs`` takes the stage before it and all readers since then."""
    stages: list[Stage] = []
    tags: dict[str, int] = {}
    waiting: list[int] = []
    for position, entry in enumerate(entries):
        options = {key: value for key, value in entry.items() if key not in ("type", "tag", "inputs")}
        kind, tag = str(entry["type"]), str(entry.get("tag", ""))
        named = entry.get("inputs", [])
        named = [named] if isinstance(named, str) else named
        unknown = [name for name in named if name not in tags]
        if unknown:
            raise PipelineError(
                f"{path}: {kind} names the input {unknown[0]!r}, which no stage before it has as tag.",
                f"Tags before it: {', '.join(tags) or 'none'}.",
                "pipeline-inputs",
            )
        is_reader = kind.startswith("readers.")
        if is_reader and named:
            raise PipelineError(f"{path}: {kind} is a reader and takes no inputs.", "Remove them.", "pipeline-inputs")
        inputs = [] if is_reader else [tags[name] for name in named] or waiting
        if not is_reader and not inputs:
            raise PipelineError(f"{path}: nothing feeds {kind}.", "Put a reader before it.", "pipeline-inputs")
        if tag in tags:
            raise PipelineError(f"{path}: two stages have the tag {tag!r}.", "Rename one.", "pipeline-inputs")
        stages.append(Stage(kind, tag, tuple(inputs), options))
        if tag:
            tags[tag] = position
        waiting = [*waiting, position] if is_reader else [position]
    return stages


def _overridden(stages: list[Stage], key: str, value: str) -> list[Stage]:
    """The stages with the option that ``key`` names set to ``value``, where ``key`` is as PDAL takes it."""
    owner, _, option = key.rpartition(".")
    if owner.startswith("stage."):
        chosen = [stage for stage in stages if stage.tag == owner.removeprefix("stage.")]
        known = ", ".join(stage.tag for stage in stages if stage.tag)
    else:
        chosen = [stage for stage in stages if stage.type == owner]
        known = ", ".join(dict.fromkeys(stage.type for stage in stages))
    if not option or not chosen:
        raise PipelineError(
            f"--{key} names no stage of this pipeline.",
            f"Write --stage.TAG.option=value or --TYPE.option=value; here are {known}.",
            "pipeline-override",
        )
    return [replace(s, options={**s.options, option: value}) if s in chosen else s for s in stages]
