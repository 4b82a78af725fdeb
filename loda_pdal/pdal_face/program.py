"""The `pdal` program: finding one whose Python plugin can run our stages."""

from __future__ import annotations

import functools
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

_PROBE = json.dumps(
    {
        "pipeline": [
            {"type": "readers.faux", "mode": "constant", "count": 1, "bounds": "([0, 1], [0, 1], [0, 1])"},
            {
                "type": "filters.python",
                "source": "import loda_pdal.pdal_face\ndef probe(ins, outs):\n    return True\n",
                "module": "loda_probe",
                "function": "probe",
            },
            {"type": "writers.null"},
        ]
    }
)
_PROBE_SECONDS = 120


@functools.cache
def find_pdal() -> Path | None:
    """The `pdal` program whose filters.python can import loda_pdal, or None.

    Looked for in this order: the environment variable ``LODA_PDAL``, beside the running interpreter, on PATH.
    """
    for candidate in candidates():
        if not why_unusable(candidate):
            return candidate
    return None


@functools.cache
def pdal_version(program: Path) -> tuple[int, ...]:
    """Version of a `pdal` program, e.g. (2, 2, 0); empty where it does not say."""
    said = subprocess.run([str(program), "--version"], capture_output=True, text=True, check=False).stdout
    found = re.search(r"pdal (\d+)\.(\d+)\.(\d+)", said)
    return tuple(int(number) for number in found.groups()) if found else ()


def candidates() -> list[Path]:
    """The `pdal` programs that are looked at, usable or not."""
    named = os.environ.get("LODA_PDAL")
    if named:
        return [Path(named)]
    beside = shutil.which("pdal", path=str(Path(sys.executable).parent))
    on_path = shutil.which("pdal")
    return [Path(found) for found in dict.fromkeys((beside, on_path)) if found]


def why_unusable(program: Path) -> str:
    """Why `program` cannot run our stages, in PDAL's words; empty if it can."""
    try:
        done = subprocess.run(
            [str(program), "pipeline", "--stdin"],
            input=_PROBE,
            capture_output=True,
            text=True,
            timeout=_PROBE_SECONDS,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    if done.returncode == 0:
        return ""
    said = (done.stderr + done.stdout).strip()
    return f"it ended with code {done.returncode}" + (f" and said: {said}" if said else "")
