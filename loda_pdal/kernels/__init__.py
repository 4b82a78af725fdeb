"""Numba loops: no validation, no logging, no paths.

Compiled kernels are cached in the user's cache folder, so that every process finds them again
(``NUMBA_CACHE_DIR`` is respected where the user set it).
"""

from __future__ import annotations

import os
from pathlib import Path

if "NUMBA_CACHE_DIR" not in os.environ:
    _cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "loda-pdal" / "numba"
    os.environ["NUMBA_CACHE_DIR"] = str(_cache)
