"""``loda-pdal pipeline``: run a PDAL pipeline of our stages, with PDAL or without it."""

from __future__ import annotations

import json
from pathlib import Path

import click

from loda_pdal.cli import options, stopping, verbosity
from loda_pdal.cli.progress import reporter_for


@click.command(
    short_help="Run a PDAL pipeline of our stages.",
    context_settings={"ignore_unknown_options": True, "allow_extra_args": True},
)
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--engine",
    type=click.Choice(("auto", "pdal", "embedded")),
    default="auto",
    show_default=True,
    help="PDAL where its Python plugin can run our stages, else our own runner.",
)
@options.threads
@options.as_json
@options.progress
@click.option("--validate", is_flag=True, help="Check everything, compute nothing.")
@verbosity.options
@click.pass_context
def pipeline(
    ctx: click.Context,
    file: Path,
    engine: str,
    threads: int | None,
    as_json: bool,
    progress_kind: str,
    validate: bool,
) -> None:
    """Run the PDAL pipeline FILE, or one of ours by its name: change, register, lod, segment, change_only.

    Options of its stages are set as PDAL takes them: --stage.TAG.option=value or --readers.las.option=value.
    """
    overrides = _overrides(ctx.args)
    with reporter_for(progress_kind) as reporter:
        if progress_kind == "json":
            stopping.when_parent_dies()
        from loda_pdal.kernels import is_cache_warm
        from loda_pdal.pdal_face import run_pipeline, stop_pdal

        stopping.before_stopping(stop_pdal)
        options.use_threads(threads)
        if not validate and not is_cache_warm():
            run_pipeline(file, overrides, engine=engine, validate=True)  # what is wrong with it, before a long wait
            options.compile_kernels(reporter)
        done = run_pipeline(file, overrides, engine=engine, validate=validate, progress=reporter.progress)
        if done.is_validated_only:
            reporter.info("Everything is in order; nothing was computed.")
        reporter.result({path.name: path for path in done.outputs}, {"engine": done.engine})
    if progress_kind == "json" or (done.is_validated_only and not as_json):
        return
    if as_json:
        values = {"engine": done.engine, "validated": validate, "outputs": [str(path) for path in done.outputs]}
        click.echo(json.dumps(values, indent=2))
    else:
        click.echo("\n".join(str(path) for path in done.outputs))


def _overrides(arguments: list[str]) -> dict[str, str]:
    """``--stage.TAG.option=value`` as ``{"stage.TAG.option": value}``; anything else is a usage error."""
    found = {}
    for argument in arguments:
        key, equals, value = argument.removeprefix("--").partition("=")
        if not argument.startswith("--") or not equals or "." not in key:
            raise click.UsageError(f"No such option: {argument}")
        found[key] = value
    return found
