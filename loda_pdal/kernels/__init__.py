"""Numba loops: no validation, no logging, no paths.

Compiled kernels are cached in the user's cache folder, so that every process finds them again
(``NUMBA_CACHE_DIR`` is respected where the user set it). A folder that cannot be written is replaced by one of the
user's own under the temporary folder. `loda_pdal.warmup` compiles everything that is not there yet.
"""

from __future__ import annotations

import hashlib
import os
import stat
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path


def cache_folder() -> Path:
    """Folder of the compiled kernels; it may not exist yet where the user named it."""
    chosen = os.environ.get("NUMBA_CACHE_DIR") or getattr(_loaded_numba_config(), "CACHE_DIR", "")
    return Path(chosen) if chosen else _writable_folder()


def is_cache_warm() -> bool:
    """Whether every kernel of this version is compiled, for this Python, numba and processor (`mark_cache_warm`)."""
    return _marker().is_file()


def mark_cache_warm() -> None:
    """Remember that nothing is left to compile; forgotten as soon as a kernel, Python, numba or processor changes."""
    marker = _marker()
    try:
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.write_text("Everything that loda-pdal compiles is here.\n", encoding="utf-8")
    except OSError:  # then it is not remembered: the next run looks through the kernels again
        return


def _marker() -> Path:
    """A file whose name is what compiled kernels depend on."""
    from llvmlite import binding

    here = Path(__file__).parent
    sources = [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in sorted(here.glob("*.py"))]
    machine = (binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten())
    key = repr((sources, sys.version, version("numba"), version("llvmlite"), machine))
    return cache_folder() / f"loda-pdal-{hashlib.sha256(key.encode()).hexdigest()[:16]}.warm"


def _loaded_numba_config() -> object:
    return getattr(sys.modules.get("numba"), "config", None)


def _writable_folder() -> Path:
    """The user's cache folder, else one under the temporary folder that only this user can write."""
    try:
        base = os.environ.get("XDG_CACHE_HOME")
        folder = (Path(base) if base else Path.home() / ".cache") / "loda-pdal" / "numba"
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except (OSError, RuntimeError):  # read-only or full disk; no home at all
        return _temporary_folder()


def _temporary_folder() -> Path:
    """A folder that is ours alone: cached kernels are code, nobody else may put files there."""
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
    folder = Path(tempfile.gettempdir()) / f"loda-pdal-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        is_ours = not hasattr(os, "getuid") or found.st_uid == os.getuid()
        if stat.S_ISDIR(found.st_mode) and is_ours and (os.name == "nt" or not found.st_mode & 0o022):
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="loda-pdal-"))


def _use_cache_folder() -> None:
    folder = str(cache_folder())
    config = _loaded_numba_config()
    if config is None:
        os.environ["NUMBA_CACHE_DIR"] = folder
    else:  # imported before us: it has read its environment, and would drop its other settings if that changed now
        config.CACHE_DIR = folder  # type: ignore[attr-defined]


_use_cache_folder()
