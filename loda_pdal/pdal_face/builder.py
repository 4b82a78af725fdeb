"""Pipelines in Python: the same documents as ``pipelines/*.json``, with your own files and choices.

    document = pipeline("change", before="2015.laz", after="2019.laz", output="changes.las", arguments={"run": "work"})
    Path("mine.json").write_text(to_json(document))

``python -m loda_pdal.pdal_face.builder FOLDER`` writes the files of ``pipelines/``.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from loda_pdal.model.dimensions import (
    CHANGE,
    CLASSIFICATION,
    CONFIDENCE,
    EPOCH,
    HEIGHT,
    INSTANCE,
    LOD95,
    OBJECT,
    SUPERPOINT,
    Dimension,
)
from loda_pdal.pdal_face.adapter import pdal_type

WRITES: dict[str, tuple[Dimension, ...]] = {
    "before": (EPOCH,),
    "after": (EPOCH,),
    "register": (),
    "ground": (HEIGHT,),
    "lod": (LOD95,),
    "proxies": (),
    "superpoints": (SUPERPOINT,),
    "semantics": (CLASSIFICATION,),
    "instances": (CLASSIFICATION, INSTANCE),
    "objects": (),
    "changes": (),
    "ground_changes": (),
    "result": (CLASSIFICATION, HEIGHT, LOD95, SUPERPOINT, INSTANCE, OBJECT, CHANGE, CONFIDENCE),
    "move": (),
}
"""The dimensions that each entry writes; ``move`` changes X, Y and Z."""

CHAINS: dict[str, tuple[str, ...]] = {
    "change": (
        "register",
        "ground",
        "lod",
        "proxies",
        "superpoints",
        "semantics",
        "instances",
        "objects",
        "changes",
        "ground_changes",
        "result",
        "move",
    ),
    "register": ("register", "move"),
    "lod": ("register", "lod", "move"),
    "segment": ("register", "ground", "superpoints", "semantics", "instances"),
    "change_only": ("objects", "changes", "ground_changes", "result", "move"),
}
"""Entries of each pipeline file, in order, after both epochs were merged."""

ADDED_BY_LAS = {CLASSIFICATION.name}
"""Dimensions that every LAS file has: no stage needs to add them."""


def python_stage(name: str, arguments: Mapping[str, Any] | None = None, **options: Any) -> dict[str, Any]:
    """One ``filters.python`` stage that calls the entry ``name``; ``options`` go into the stage as they are."""
    stage: dict[str, Any] = {"type": "filters.python", "tag": name, **options}
    stage |= {
        "source": f"import loda_pdal.pdal_face.entry as e; run = e.bind('{name}', globals())",
        "module": f"loda_{name}",
        "function": "run",
    }
    added = [f"{d.name}={pdal_type(d.dtype)}" for d in WRITES[name] if d.name not in ADDED_BY_LAS]
    if added:
        stage["add_dimension"] = added
    if arguments:
        stage["pdalargs"] = dict(arguments)
    return stage


def pipeline(
    chain: str | Sequence[str],
    *,
    before: str = "before.laz",
    after: str = "after.laz",
    output: str = "changes.las",
    arguments: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """A whole pipeline: two surveys in, one cloud with both epochs out.

    Parameters
    ----------
    chain : str or sequence of str
        Name of a chain of `CHAINS`, or entries of your own choice in order.
    before, after, output : str
        LAS or LAZ files.
    arguments : mapping, optional
        ``pdalargs`` of every stage; see docs/pdal.md. ``{"run": "loda_run"}`` if left out.
    """
    names = CHAINS[chain] if isinstance(chain, str) else chain
    arguments = {"run": "loda_run"} if arguments is None else arguments
    stages: list[dict[str, Any]] = [
        {"type": "readers.las", "tag": "before", "filename": before},
        python_stage("before") | {"tag": "epoch_before", "inputs": ["before"]},
        {"type": "readers.las", "tag": "after", "filename": after},
        python_stage("after") | {"tag": "epoch_after", "inputs": ["after"]},
        {"type": "filters.merge", "tag": "epochs", "inputs": ["epoch_before", "epoch_after"]},
        *(python_stage(name, arguments) for name in names),
        {
            "type": "writers.las",
            "tag": "output",
            "filename": output,
            "minor_version": 4,
            "dataformat_id": 6,
            "extra_dims": "all",
            **{f"scale_{axis}": 0.001 for axis in "xyz"},
            **{f"offset_{axis}": "auto" for axis in "xyz"},
        },
    ]
    return {"pipeline": stages}


def to_json(document: Mapping[str, Any]) -> str:
    """A pipeline as text, one line per option."""
    text = json.dumps(document, indent=2)
    return re.sub(r"\[\s+([^\[\]{}]+?)\s+\]", lambda found: "[" + re.sub(r"\s*\n\s*", " ", found[1]) + "]", text) + "\n"


def main(folder: str) -> None:
    """Write every chain to ``FOLDER/NAME.json``."""
    for name in CHAINS:
        Path(folder, f"{name}.json").write_text(to_json(pipeline(name)), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
