"""``loda-pdal params``: every parameter with its value, unit, range and the paper's symbol."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

import loda_pdal
from loda_pdal.cli import options, verbosity
from loda_pdal.model.errors import OutputError
from loda_pdal.params import AUTO, PRESETS, Parameters


@click.command(short_help="Print or write all parameters.")
@options.parameters(*PRESETS)
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="FILE", help="Write there; .json gives JSON.")
@options.overwrite
@options.as_json
@verbosity.options
def params(
    preset: str | None,
    params_file: Path | None,
    settings: tuple[str, ...],
    output: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Print the parameters as a run would use them, as TOML that --params reads back."""
    chosen = options.chosen_parameters(preset, params_file, settings)
    if output is None:
        click.echo(json.dumps(_described(chosen), indent=2) if as_json else chosen.to_toml().rstrip())
        return
    is_json = as_json or output.suffix.lower() == ".json"
    _write(output, json.dumps(chosen.to_dict(), indent=2) + "\n" if is_json else chosen.to_toml(), overwrite)
    click.echo(str(output))


def _described(chosen: Parameters) -> dict[str, Any]:
    """The parameters with all that is known of them, for front ends."""
    stages: dict[str, dict[str, Any]] = {}
    for entry in chosen.describe():
        stage = stages.setdefault(entry.stage, {"name": entry.stage, "doc": entry.stage_doc, "parameters": []})
        values = entry._asdict()
        stage["parameters"].append({key: values[key] for key in values if key not in ("stage", "stage_doc")})
    return {
        "version": loda_pdal.__version__,
        "preset_names": [*PRESETS, AUTO],
        "presets": {name: Parameters.preset(name).to_dict() for name in PRESETS},
        "name": chosen.name,
        "adapts_to_spacing": chosen.adapts_to_spacing,
        "stages": list(stages.values()),
    }


def _write(path: Path, text: str, overwrite: bool) -> None:
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: is there already.", "Give --overwrite, or another name.", "output-exists")
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror or error}).", "Check the folder.", "output-unwritable"
        ) from error
