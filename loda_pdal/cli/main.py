"""``loda-pdal``: one command, verbs in modules that load when they are used; errors become one line and an exit code.

Results go to stdout, everything else to stderr. Exit codes: 0, 1 (an error that the message explains), 2 (usage).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any, NoReturn

import click

import loda_pdal
from loda_pdal.cli import process, stopping, verbosity
from loda_pdal.model.errors import LodaError

COMMANDS = {
    "detect": "loda_pdal.cli.detect:detect",
    "pipeline": "loda_pdal.cli.pipeline:pipeline",
    "info": "loda_pdal.cli.info:info",
    "params": "loda_pdal.cli.params:params",
    "report": "loda_pdal.cli.report:report",
    "warmup": "loda_pdal.cli.warmup:warmup",
    "bench": "loda_pdal.benchmark.commands:bench",
}


class LazyGroup(click.Group):
    """A group whose commands are imported when they are needed."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module, _, name = COMMANDS[cmd_name].partition(":")
        command: click.Command = getattr(import_module(module), name)
        return command


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(loda_pdal.__version__, prog_name="loda-pdal", message="%(prog)s %(version)s")
@verbosity.options
def cli() -> None:
    """Object-level change detection between two LiDAR surveys, with an explicit limit of detection."""


def run(arguments: Sequence[str]) -> int:
    """Run the command line ``arguments`` and return its exit code, whatever happens."""
    try:
        returned: Any = cli.main(args=list(arguments), prog_name="loda-pdal", standalone_mode=False)
        sys.stdout.flush()
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        return _failed("stopped.", 130)
    except LodaError as error:
        return _failed(str(error))
    except BrokenPipeError:  # whoever read our stdout has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except MemoryError:
        return _failed("the memory is used up. Cut the surveys into tiles, or run where there is more memory.")
    except OSError as error:
        return _failed(f"{error.filename or 'input or output'}: {error.strerror or error}.")
    except Exception as error:
        verbosity.show_traceback(always=True)
        return _failed(f"this is a defect of loda-pdal, please report it: {type(error).__name__}: {error}", traced=True)
    finally:
        verbosity.reset()
    return returned if isinstance(returned, int) else 0


def _failed(message: str, code: int = 1, traced: bool = False) -> int:
    stopping.settle()
    if not traced:
        verbosity.show_traceback()
    print(f"loda-pdal: {message}", file=sys.stderr)
    return code


def main() -> NoReturn:
    """Entry point of the program: never returns."""
    process.settle()
    stopping.on_signals()
    sys.exit(run(sys.argv[1:]))
