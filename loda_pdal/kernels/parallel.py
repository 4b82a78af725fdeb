"""Index ranges on a pool of threads.

Kernels release the interpreter lock and write only what belongs to their range, so results do not depend on the number
of threads. (Numba's own thread layers abort in embedded interpreters and after a fork; see docs/architecture.md.)
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

LARGEST_RANGE = 1 << 16
"""Ranges are no longer than this: a run that is interrupted ends after the ranges in hand."""

_chosen_threads: int | None = None


def set_threads(n: int | None) -> None:
    """Use ``n`` threads from now on; None goes back to ``LODA_THREADS`` or the processors of this process."""
    global _chosen_threads
    if n is not None and n < 1:
        raise ValueError(f"the number of threads must be at least 1, not {n}")
    _chosen_threads = n


def thread_count() -> int:
    """Number of threads that `run_ranges` uses."""
    if _chosen_threads is not None:
        return _chosen_threads
    asked = os.environ.get("LODA_THREADS", "")
    if asked.isdigit() and int(asked) >= 1:
        return int(asked)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_ranges(function: Callable[..., Any], n: int, *args: Any, min_size: int = 1024) -> None:
    """Call ``function(start, stop, *args)`` for ranges that cover ``[0, n)`` once.

    Parameters
    ----------
    function : callable
        A nogil kernel. It must write only to what belongs to its own range.
    n : int
        Length of the index; nothing is called for 0.
    *args
        Handed on to every call.
    min_size : int
        Shortest range worth a thread; 1 for items that are long work each.
    """
    n_threads = min(thread_count(), -(-n // max(min_size, 1)))
    size = min(max(-(-n // (4 * max(n_threads, 1))), min_size, 1), LARGEST_RANGE)
    starts = range(0, n, size)
    if n_threads <= 1:
        for start in starts:
            function(start, min(start + size, n), *args)
        return
    with ThreadPoolExecutor(n_threads) as pool:
        calls = [pool.submit(function, start, min(start + size, n), *args) for start in starts]
        try:
            for call in calls:
                call.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
