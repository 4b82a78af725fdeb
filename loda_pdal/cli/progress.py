"""How a run reports while it works: a bar on a terminal, plain lines elsewhere, or one JSON object a line.

JSON events, one a line on stdout::

    {"event": "progress", "stage", "done", "total"}
    {"event": "info", "message"}          {"event": "warning", "message"}
    {"event": "error", "code", "message", "remedy"}
    {"event": "result", "outputs": {name: path}, "summary": {...}}
"""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import click

from loda_pdal.cli import stopping, verbosity
from loda_pdal.model.errors import LodaError

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

KINDS = ("auto", "bar", "json", "none")


class Reporter:
    """Says nothing but notes and warnings; the other kinds say more.

    A context manager around the whole run: inside it, warnings that the library logs go through the reporter, and
    whatever else is printed goes to stderr, because stdout is for results and events.
    """

    def __enter__(self) -> Reporter:
        self._handler = LogToReporter(self)
        logging.getLogger("loda_pdal").addHandler(self._handler)
        self._stdout, sys.stdout = sys.stdout, sys.stderr
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        logging.getLogger("loda_pdal").removeHandler(self._handler)
        stopping.settle()
        sys.stdout = self._stdout
        if error is not None:
            self.failure(error)
        self.close()

    def progress(self, done: int, total: int, text: str) -> None:
        """``done`` of ``total`` steps are over; ``text`` names the one that begins."""

    def info(self, message: str) -> None:
        """Something the user should know."""
        if verbosity.level() >= 0:
            self._line(message)

    def warning(self, message: str) -> None:
        """Something the user must know before trusting the result."""
        if verbosity.level() >= 0:
            self._line(f"Warning: {message}")

    def result(self, outputs: Mapping[str, Path], summary: Mapping[str, Any]) -> None:
        """The run is over and its files are there."""

    def failure(self, error: BaseException) -> None:
        """The run ends with an error, which the command line itself puts on stderr."""

    def close(self) -> None:
        """Nothing more will be said."""

    def _line(self, text: str) -> None:
        click.echo(text, err=True)


class LineReporter(Reporter):
    """One line per step, for logs; within a step one every few seconds."""

    EVERY_S = 5.0

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._text, self._last = "", 0.0

    def progress(self, done: int, total: int, text: str) -> None:
        now = time.perf_counter()
        if text == self._text and now - self._last < self.EVERY_S:
            return
        self._text, self._last = text, now
        self._line(f"[{done:>{len(str(total))}}/{total}] {time.perf_counter() - self._start:6.1f} s  {text}")


class BarReporter(Reporter):
    """A bar with the time it has taken, for terminals."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        self._bar: Progress = Progress(
            SpinnerColumn(),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.description}"),
            console=Console(stderr=True),
            transient=True,
        )
        self._task: TaskID = self._bar.add_task("starting", total=None)
        self._bar.start()

    def progress(self, done: int, total: int, text: str) -> None:
        self._bar.update(self._task, completed=done, total=total, description=text)

    def close(self) -> None:
        self._bar.stop()

    def _line(self, text: str) -> None:
        self._bar.console.print(text, markup=False, highlight=False)


class JsonReporter(Reporter):
    """One JSON object a line on stdout, for front ends."""

    def progress(self, done: int, total: int, text: str) -> None:
        self._event("progress", stage=text, done=done, total=total)

    def info(self, message: str) -> None:
        self._event("info", message=message)

    def warning(self, message: str) -> None:
        self._event("warning", message=message)

    def result(self, outputs: Mapping[str, Path], summary: Mapping[str, Any]) -> None:
        from loda_pdal.io.plain import to_plain

        self._event("result", outputs=to_plain(outputs), summary=to_plain(summary))

    def failure(self, error: BaseException) -> None:
        if isinstance(error, LodaError):
            self._event("error", code=error.code, message=error.message, remedy=error.remedy)
        elif not isinstance(error, BrokenPipeError):  # then nobody listens
            self._event("error", code="internal", message=f"{type(error).__name__}: {error}", remedy="")

    def _event(self, event: str, **values: Any) -> None:
        line = json.dumps({"event": event, **values}, ensure_ascii=False, allow_nan=False)
        print(line, file=self._stdout, flush=True)


class LogToReporter(logging.Handler):
    """Sends what the library logs as warning or worse to a reporter."""

    def __init__(self, reporter: Reporter) -> None:
        super().__init__(logging.WARNING)
        self._reporter = reporter

    def emit(self, record: logging.LogRecord) -> None:
        self._reporter.warning(record.getMessage())


def reporter_for(kind: str) -> Reporter:
    """The reporter that ``--progress`` asks for."""
    if kind == "json":
        return JsonReporter()
    if kind == "none" or verbosity.level() < 0:
        return Reporter()
    if kind == "bar" or sys.stderr.isatty():
        return BarReporter()
    return LineReporter()
