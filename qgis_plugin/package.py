"""Packs the plugin: ``python qgis_plugin/package.py`` writes ``dist/loda_change-VERSION.zip``.

The parameters of the engine beside it (``loda-pdal params --json``) are written into the plugin first, so that it knows
them before an engine is installed.
"""

from __future__ import annotations

import configparser
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PLUGIN = ROOT / "qgis_plugin" / "loda_change"
_LEFT_OUT = {"__pycache__"}
_MOMENT = (1980, 1, 1, 0, 0, 0)  # the same files give the same zip


def engine_parameters() -> str:
    """What the engine of this checkout says of its parameters."""
    command = [sys.executable, "-m", "loda_pdal", "params", "--json"]
    return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, encoding="utf-8").stdout


def metadata() -> configparser.SectionProxy:
    """The plugin's metadata.txt."""
    parser = configparser.ConfigParser(interpolation=None)
    parser.read(PLUGIN / "metadata.txt", encoding="utf-8")
    return parser["general"]


def pack(folder: Path) -> Path:
    """Write the zip into ``folder`` and return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{PLUGIN.name}-{metadata()['version']}.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(PLUGIN.rglob("*")):
            parts = file.relative_to(PLUGIN.parent).parts
            if file.is_file() and not _LEFT_OUT & set(parts) and not file.name.startswith("."):
                entry = zipfile.ZipInfo("/".join(parts), _MOMENT)
                entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
                archive.writestr(entry, file.read_bytes())
    return path


def main() -> None:
    """Refresh the parameters, pack, and say where."""
    (PLUGIN / "parameters.json").write_text(engine_parameters(), encoding="utf-8")
    print(pack(ROOT / "dist").relative_to(ROOT))


if __name__ == "__main__":
    main()
