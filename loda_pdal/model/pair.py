"""Two of a kind, one per epoch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from loda_pdal.kernels.parallel import thread_count

T = TypeVar("T")
U = TypeVar("U")
V = TypeVar("V")


@dataclass(frozen=True)
class Pair(Generic[T]):
    """The same thing for both epochs, told apart by name and never by position."""

    before: T
    after: T

    def __iter__(self) -> Iterator[T]:
        yield self.before
        yield self.after

    def map(self, function: Callable[[T], U]) -> Pair[U]:
        """``Pair(function(before), function(after))``."""
        return Pair(function(self.before), function(self.after))

    def join(self, other: Pair[U], function: Callable[[T, U], V]) -> Pair[V]:
        """Both epochs of two pairs at a time: ``Pair(function(before, other.before), ...)``."""
        return Pair(function(self.before, other.before), function(self.after, other.after))

    @property
    def swapped(self) -> Pair[T]:
        """The pair with its epochs exchanged."""
        return Pair(self.after, self.before)


def at_once(function: Callable[..., U], *pairs: Pair[Any]) -> Pair[U]:
    """``Pair(function(before, ...), function(after, ...))`` with both calls running at once, in two threads.

    One after the other where only one thread is wanted. An error of the before epoch is raised first.
    """
    before, after = (tuple(getattr(pair, epoch) for pair in pairs) for epoch in ("before", "after"))
    if thread_count() == 1:
        return Pair(function(*before), function(*after))
    pool = ThreadPoolExecutor(2)
    try:
        calls = Pair(pool.submit(function, *before), pool.submit(function, *after))
        return calls.map(lambda call: call.result())
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
