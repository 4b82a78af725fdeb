"""``-v`` and ``-q``: accepted before and after the verb, and where log messages go."""

from __future__ import annotations

import logging
import sys
import traceback
from collections.abc import Callable
from typing import Any, TypeVar

import click

F = TypeVar("F", bound=Callable[..., Any])

_level = 0
_log_lines = logging.StreamHandler()
_log_lines.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s"))


def level() -> int:
    """1 after ``-v``, -1 after ``-q``, else 0."""
    return _level


def options(command: F) -> F:
    """Adds ``-v/--verbose`` and ``-q/--quiet`` to a command."""
    command = click.option(
        "-q", "--quiet", is_flag=True, expose_value=False, callback=_quiet, help="No progress, no warnings."
    )(command)
    return click.option(
        "-v",
        "--verbose",
        is_flag=True,
        expose_value=False,
        callback=_verbose,
        help="Log in detail; traceback on error.",
    )(command)


def reset() -> None:
    """Forget what an earlier command line asked for."""
    global _level
    _level = 0
    logging.getLogger("loda_pdal").removeHandler(_log_lines)


def show_traceback(always: bool = False) -> None:
    """The traceback of the error at hand, if the user asked for detail."""
    if always or _level > 0:
        traceback.print_exc(file=sys.stderr)


def _verbose(ctx: click.Context, option: click.Parameter, is_given: bool) -> None:
    _keep(1 if is_given else 0)


def _quiet(ctx: click.Context, option: click.Parameter, is_given: bool) -> None:
    _keep(-1 if is_given else 0)


def _keep(chosen: int) -> None:
    """Keep the level; what was given before the verb holds after it."""
    global _level
    _level = chosen or _level
    log = logging.getLogger("loda_pdal")
    log.setLevel(logging.DEBUG if _level > 0 else logging.WARNING)
    if _level > 0:
        log.addHandler(_log_lines)
