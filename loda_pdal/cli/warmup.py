"""``loda-pdal warmup``: compile the kernels now, so that no run has to wait for it."""

from __future__ import annotations

import json

import click

from loda_pdal.cli import options, verbosity
from loda_pdal.cli.progress import reporter_for


@click.command(short_help="Compile the kernels now, once.")
@options.threads
@options.as_json
@options.progress
@verbosity.options
def warmup(threads: int | None, as_json: bool, progress_kind: str) -> None:
    """Compile what the first run would else compile, and keep it in the user's cache folder; NUMBA_CACHE_DIR names
    another. To be done again after an update of loda-pdal, numba or Python; -v logs the seconds of each kernel."""
    with reporter_for(progress_kind) as reporter:
        options.use_threads(threads)
        done = options.compile_kernels(reporter)
        from loda_pdal.kernels import cache_folder

        n, seconds = done or (0, 0.0)
        values = {"compiled": n, "seconds": seconds, "folder": str(cache_folder())}
        reporter.result({}, values)
    if progress_kind == "json":
        return
    if as_json:
        click.echo(json.dumps(values, indent=2))
    elif done is None:
        click.echo(f"Nothing to do: the kernels are compiled, in {values['folder']}.")
    else:
        click.echo(f"{n} kernels compiled in {seconds:.1f} s, kept in {values['folder']}.")
