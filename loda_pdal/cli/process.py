"""How a process of ours takes memory and threads; to be settled before NumPy is loaded."""

from __future__ import annotations

import ctypes
import os
import sys
from contextlib import suppress

_M_ARENA_MAX = -8


def settle() -> None:
    """One heap for all threads, and no threads for products of small matrices.

    The C library otherwise keeps what each thread frees apart from the others (a sixth of the memory of a run), and
    OpenBLAS wakes its threads for a rotation of three numbers. What the user set in the environment stays.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if sys.platform == "linux" and "MALLOC_ARENA_MAX" not in os.environ:
        with suppress(OSError, AttributeError):  # not the GNU C library
            ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1)
