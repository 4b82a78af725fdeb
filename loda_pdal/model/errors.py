"""Errors that a user can act on.

    LodaError
      InputError (ValueError)        a survey that cannot be used: unreadable, empty, wrong CRS, no overlap
      ParameterError (ValueError)    an unknown parameter or a value out of its range
      OutputError (OSError)          a result that cannot be written, or that exists already
      MemoryLimitError (MemoryError) a run that would exceed the memory allowed
      PipelineError (RuntimeError)   a PDAL pipeline or stage that cannot run as asked

Each carries ``code`` (stable, for machines), the message (what was found) and ``remedy`` (what to do).
"""

from __future__ import annotations


class LodaError(Exception):
    """Base of all errors that loda-pdal raises on purpose.

    Parameters
    ----------
    message : str
        What was found and where, in one sentence.
    remedy : str
        What the user can do about it, in one sentence.
    code : str
        Short stable name, e.g. ``crs-missing``.
    """

    def __init__(self, message: str, remedy: str = "", code: str = "error") -> None:
        super().__init__(message)
        self.message = message
        self.remedy = remedy
        self.code = code

    def __str__(self) -> str:
        return f"{self.message} {self.remedy}".strip()


class InputError(LodaError, ValueError):
    """A survey that cannot be used as it is."""


class ParameterError(LodaError, ValueError):
    """An unknown parameter, or a value out of its range."""


class OutputError(LodaError, OSError):
    """A result that cannot be written, or that exists already."""


class MemoryLimitError(LodaError, MemoryError):
    """A run that would need more memory than allowed."""


class PipelineError(LodaError, RuntimeError):
    """A PDAL pipeline, or a stage of one, that cannot run as asked."""
