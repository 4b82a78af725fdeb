"""Options that several commands share, and what they mean together."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from loda_pdal.cli import stopping
from loda_pdal.cli.progress import KINDS, Reporter
from loda_pdal.params import AUTO, Parameters

if TYPE_CHECKING:
    from loda_pdal.warmup import Compiled

F = TypeVar("F", bound=Callable[..., Any])


_MADE_FOR = {
    "street": "vehicle LiDAR",
    "aerial": "airborne LiDAR",
    "paper": "the paper to the letter",
    AUTO: "street or aerial, whichever the surveys look like",
}


def parameters(*presets: str) -> Callable[[F], F]:
    """``--preset`` (one of ``presets``), ``--params`` and ``--set``, handed on as ``preset``, ``params_file`` and
    ``settings``."""
    made_for = "; ".join(f"{name}: {_MADE_FOR[name]}" for name in presets)
    left_out = AUTO if AUTO in presets else "street"
    chosen = (
        click.option(
            "--set",
            "settings",
            metavar="STAGE.KEY=VALUE",
            multiple=True,
            help="Set one parameter; may be given more than once, wins over --params.",
        ),
        click.option(
            "--params",
            "params_file",
            metavar="FILE",
            type=click.Path(path_type=Path),
            help="TOML or JSON with parameters, over the preset.",
        ),
        click.option(
            "--preset",
            type=click.Choice(presets),
            help=f"Where to start from; {left_out} if left out. {made_for}.",
        ),
    )

    def decorated(command: F) -> F:
        for option in chosen:
            command = option(command)
        return command

    return decorated


def chosen_parameters(
    preset: str | None, params_file: Path | None, settings: Sequence[str], suits: str = "street"
) -> Parameters:
    """Parameters as the three options choose them; `ParameterError` for what is unknown or out of range.

    ``suits`` names the preset that the surveys look like: it stands in where no option chooses one.
    """
    chosen = Parameters.chosen(preset, params_file, suits)
    for setting in settings:
        chosen = chosen.with_setting(setting)
    return chosen


def use_threads(n: int | None) -> None:
    """Let kernels run in ``n`` threads, here and in programs that we start; None leaves the choice to them."""
    if n is not None:
        os.environ["LODA_THREADS"] = str(n)


def compile_kernels(reporter: Reporter) -> Compiled | None:
    """Compile the kernels and say so; None, at once, where that has been done."""
    from loda_pdal.kernels import is_cache_warm

    if is_cache_warm():
        return None
    from loda_pdal import warmup

    reporter.info(warmup.NOTICE)
    with tempfile.TemporaryDirectory(prefix="loda-pdal-") as folder:
        stopping.before_stopping(lambda: shutil.rmtree(folder, ignore_errors=True))
        return warmup.compile_kernels(Path(folder), reporter.progress)


as_json = click.option("--json", "as_json", is_flag=True, help="Write the result as JSON to stdout.")

overwrite = click.option("--overwrite", is_flag=True, help="Replace what is there.")

threads = click.option(
    "--threads", type=click.IntRange(min=1), metavar="N", help="Threads to use; all processors if left out."
)

epsg = click.option("--epsg", type=click.IntRange(min=1), metavar="N", help="CRS of both surveys, whatever they say.")

assume_same_crs = click.option(
    "--assume-same-crs", is_flag=True, help="Go on although the surveys name different CRS, or none."
)

progress = click.option(
    "--progress",
    "progress_kind",
    type=click.Choice(KINDS),
    default="auto",
    show_default=True,
    help="A bar on stderr (plain lines where that is no terminal), or one JSON object a line on stdout.",
)
