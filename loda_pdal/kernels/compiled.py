"""How kernels are compiled: without the GIL, once, kept in the cache folder.

Compiling is what the first run waits for, so nothing is compiled that nobody calls: no kernel gets an entry for C, and
an inner one none for Python either.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

Loop = Callable[..., Any]


def kernel(loop: Loop) -> Any:
    """A function that Python and other kernels call. Divisions by zero follow IEEE 754, those of integers are a bug."""
    return _compiled(loop)


def inner(loop: Loop) -> Any:
    """A function that only kernels call: it cannot be called from Python."""
    return _compiled(loop, no_cpython_wrapper=True)


def inlined(loop: Loop) -> Any:
    """An inner function whose statements stand in those that call it."""
    return _compiled(loop, no_cpython_wrapper=True, inline="always")


def _compiled(loop: Loop, **options: Any) -> Any:
    return njit(loop, nogil=True, cache=True, error_model="numpy", no_cfunc_wrapper=True, **options)
