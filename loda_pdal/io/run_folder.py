"""The run folder: what separate stages of one run hand to each other besides the points.

    manifest.json     which run this is: its key, parameters, frame, point counts, and the stages done so far
    STAGE.npz         the result of a stage, see `loda_pdal.io.packing`

A run is one set of points with one set of parameters. Results of another run are never mixed in: where the key differs,
the folder is emptied of its own files and begun anew.
"""

from __future__ import annotations

import json
import logging
import zipfile
from pathlib import Path
from typing import Any

from loda_pdal.io.packing import load_packed, save_packed
from loda_pdal.model.errors import OutputError

FORMAT = 1
"""Version of the layout above."""

_MANIFEST = "manifest.json"
_UNREADABLE = (OSError, EOFError, ValueError, KeyError, TypeError, AttributeError, ImportError, zipfile.BadZipFile)
_log = logging.getLogger(__name__)


class RunFolder:
    """Results of the stages of one run, by the name of the stage.

    Parameters
    ----------
    path : Path
        The folder; made where it does not exist.
    key : str
        Tells runs apart: a digest of all that the results depend on.
    about : dict
        What the manifest says about the run; anything JSON can hold.
    """

    def __init__(self, path: Path, key: str, about: dict[str, Any]) -> None:
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
            for leftover in path.glob(".*.npz.part"):
                leftover.unlink(missing_ok=True)
            found = self._read_manifest()
            if found is None or found.get("key") != key or found.get("format") != FORMAT:
                self._remove_results(found or {})
                found = {"format": FORMAT, "key": key, **about, "stages": {}}
                self._write_manifest(found)
        except OSError as error:
            raise OutputError(
                f"{path}: cannot be used as run folder ({error.strerror or error}).",
                "Name a folder that can be written in.",
                "run-folder-unwritable",
            ) from error
        self._manifest = found

    @property
    def stages(self) -> list[str]:
        """Names of the stages whose results are here, in the order in which they were saved."""
        return list(self._manifest["stages"])

    def load(self, stage: str) -> Any:
        """Result of a stage; `KeyError` where it is not here or cannot be read."""
        if stage not in self._manifest["stages"]:
            raise KeyError(stage)
        try:
            return load_packed(self._file(stage))
        except _UNREADABLE as error:
            _log.warning("%s is unreadable (%s) and will be made again", self._file(stage), error)
            raise KeyError(stage) from error

    def save(self, stage: str, result: Any, seconds: float) -> None:
        """Keep the result of a stage and how long it took."""
        part = self.path / f".{stage}.npz.part"
        try:
            save_packed(part, result)
            part.replace(self._file(stage))
            self._manifest["stages"][stage] = {"file": self._file(stage).name, "seconds": round(seconds, 3)}
            self._write_manifest(self._manifest)
        except OSError as error:
            part.unlink(missing_ok=True)
            raise OutputError(
                f"{self.path}: the result of {stage} could not be written ({error.strerror or error}).",
                "Make room there, or name another run folder.",
                "run-folder-unwritable",
            ) from error

    def _file(self, stage: str) -> Path:
        return self.path / f"{stage}.npz"

    def _read_manifest(self) -> dict[str, Any] | None:
        try:
            found = json.loads((self.path / _MANIFEST).read_text(encoding="utf-8"))
        except (FileNotFoundError, ValueError):
            return None
        return found if isinstance(found, dict) and isinstance(found.get("stages"), dict) else None

    def _write_manifest(self, manifest: dict[str, Any]) -> None:
        part = self.path / f".{_MANIFEST}.part"
        part.write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
        part.replace(self.path / _MANIFEST)

    def _remove_results(self, manifest: dict[str, Any]) -> None:
        for stage in manifest.get("stages", {}):
            self._file(Path(stage).name).unlink(missing_ok=True)
