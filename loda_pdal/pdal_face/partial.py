"""Files that get their name when they are whole."""

from __future__ import annotations

from pathlib import Path

_unfinished: set[Path] = set()


class PartialFile:
    """A file under a temporary name beside its own.

    Parameters
    ----------
    path : Path
        The name it gets at the end. The temporary one, ``part``, keeps its ending, from which writers tell LAZ.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.part = path.with_name(f".part-{path.name}")
        _unfinished.add(self.part)

    def finish(self) -> None:
        """The file is whole: give it its name."""
        self.part.replace(self.path)
        _unfinished.discard(self.part)

    def discard(self) -> None:
        """Remove it, if it was not finished."""
        if self.part in _unfinished:
            self.part.unlink(missing_ok=True)
            _unfinished.discard(self.part)


def discard_partial_files() -> None:
    """Remove all that are not finished, because the process is about to end."""
    for part in _unfinished.copy():
        part.unlink(missing_ok=True)
