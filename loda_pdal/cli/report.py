"""``loda-pdal report``: the report of a finished run once more, for example after a review in QGIS."""

from __future__ import annotations

from pathlib import Path

import click

from loda_pdal.cli import verbosity


@click.command(short_help="Write the report of a run anew.")
@click.argument("folder", type=click.Path(path_type=Path))
@verbosity.options
def report(folder: Path) -> None:
    """Write report.html anew from the other files of a run in FOLDER, reviews in changes.gpkg included."""
    from loda_pdal.io.report_folder import rebuild_report

    click.echo(str(rebuild_report(folder)))
