"""Writing the results of a run: all of them, or none.

Everything is first written into a staging folder inside the output folder and renamed at the end, run.json last: a
folder with a run.json holds one whole result. A run that dies leaves the old result as it was, and a staging folder
that the next run removes.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import shutil
import sqlite3
import tempfile
import textwrap
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from loda_pdal.io.copc import write_copc
from loda_pdal.io.geopackage import write_geopackage
from loda_pdal.io.las_writer import write_cloud
from loda_pdal.io.plain import to_json
from loda_pdal.io.raster import write_lod_raster
from loda_pdal.io.report import write_report
from loda_pdal.io.reviews import read_reviews
from loda_pdal.io.run_json import run_document
from loda_pdal.io.transform import write_transform
from loda_pdal.model.errors import OutputError
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import ChangeResult
from loda_pdal.model.survey import Survey

logger = logging.getLogger(__name__)

CLOUD_FORMATS = ("laz", "las", "copc")

CLOUDS = ("changes.laz", "changes.las", "changes.copc.laz")
OUTPUTS = ("changes.gpkg", *CLOUDS, "lod95.tif", "transform.json", "report.html", "run.json")
"""Names that belong to a run; none of them may be there before one, unless overwriting was asked for."""

_COMPANIONS = ("changes.gpkg-wal", "changes.gpkg-shm", "changes.gpkg-journal", "lod95.tif.aux.xml", "lod95.tif.ovr")
"""What other programs leave beside an old result; it would spoil a new one."""

_STAGING = ".loda-staging-"
_FULL_DISK = (errno.ENOSPC, errno.EDQUOT)

_staged: set[Path] = set()
_placing = threading.Lock()


def abandon_outputs(patience_s: float = 1.5) -> None:
    """Remove what this process has staged: for a process that is about to end at once, from any thread.

    A result that is being put in place is waited for, ``patience_s`` at most; none can begin to be put in place later.
    """
    _placing.acquire(timeout=patience_s)
    for staging in list(_staged):
        for _ in range(3):  # another thread may be creating files there still
            shutil.rmtree(staging, ignore_errors=True)
        with suppress(OSError):  # an output folder with nothing in it goes too, any other stays
            staging.parent.rmdir()


def check_output_folder(folder: str | Path, overwrite: bool = False, inputs: Iterable[str | Path] = ()) -> None:
    """`OutputError` where the results of a run could not be written to ``folder``, or would replace its own ``inputs``.

    Meant to be called before the work begins; creates nothing.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file, not a folder.", "Name another output folder.", "output-not-folder")
    taken = {Path(path).resolve() for path in inputs} & {(folder / name).resolve() for name in OUTPUTS}
    if taken:
        raise OutputError(
            f"{min(taken)}: the result would replace this input.", "Name another output folder.", "output-is-input"
        )
    present = [name for name in OUTPUTS if (folder / name).exists()]
    if present and not overwrite:
        raise OutputError(
            f"{folder}: holds {', '.join(present)} already.",
            "Give --overwrite to replace them, or name another output folder.",
            "output-exists",
        )
    try:
        with tempfile.TemporaryFile(dir=_nearest_folder(folder)):
            pass
    except OSError as error:
        raise _output_error(folder, error) from error


def write_outputs(
    result: ChangeResult,
    surveys: Pair[Survey],
    folder: str | Path,
    *,
    overwrite: bool = False,
    keep_frames: bool = False,
    run_info: Mapping[str, Any] | None = None,
    cloud_format: str = "laz",
    with_cloud: bool = True,
) -> dict[str, Path]:
    """Write all results of a run.

    Parameters
    ----------
    result : ChangeResult
        What was found.
    surveys : Pair of Survey
        What it was found in; gives the points and dimensions of the output cloud.
    folder : str or Path
        Made where it does not exist.
    overwrite : bool
        Replace an earlier result; its reviews are kept (see `loda_pdal.io.reviews`).
    keep_frames : bool
        Leave before-points where their own survey has them, instead of moving them onto the after epoch.
    run_info : mapping, optional
        What a face knows of the run, for run.json and the report.
    cloud_format : str
        ``laz``, ``las`` or ``copc`` (for viewers; does not keep the order of the points).
    with_cloud : bool
        Write the point cloud; without it for a face that writes its points itself.

    Returns
    -------
    dict of str to Path
        ``changes`` (GeoPackage), ``cloud`` (unless left out), ``lod95``, ``transform``, ``report`` and ``run``.
    """
    folder = Path(folder)
    if cloud_format not in CLOUD_FORMATS:
        raise OutputError(
            f"Point clouds are not written as {cloud_format!r}.",
            f"Use {', '.join(CLOUD_FORMATS)}.",
            "cloud-format",
        )
    check_output_folder(folder, overwrite)
    names = {
        "changes": "changes.gpkg",
        "cloud": "changes.copc.laz" if cloud_format == "copc" else f"changes.{cloud_format}",
        "lod95": "lod95.tif",
        "transform": "transform.json",
        "report": "report.html",
        "run": "run.json",
    }
    if not with_cloud:
        del names["cloud"]
    frame, registration = surveys.after.frame, result.registration
    with _explained(folder), _locked(folder), _staging_folder(folder) as staging:
        run = run_document(result, surveys, run_info) | {"keep_frames": keep_frames}
        T_after_before = registration.T_after_before
        if with_cloud:
            plain = staging / ("changes.las" if cloud_format == "copc" else names["cloud"])
            write_cloud(plain, surveys, result.points, T_after_before, keep_frames=keep_frames)
            if cloud_format == "copc":
                write_copc(plain, staging / names["cloud"])
        earlier = read_reviews(folder / names["changes"], frame.crs_wkt)
        reviews = write_geopackage(staging / names["changes"], result, frame, run, earlier)
        write_lod_raster(staging / names["lod95"], result.lod, registration.T_after_frame, frame)
        write_transform(staging / names["transform"], registration, frame)
        write_report(staging / names["report"], result, surveys, run, reviews)
        (staging / names["run"]).write_text(to_json(run), encoding="utf-8")
        for name in names.values():
            _flush(staging / name)
        kept = () if with_cloud else CLOUDS
        with _placing:
            _put_in_place(staging, folder, list(names.values()), kept)
    return {key: folder / name for key, name in names.items()}


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Makes the folder and holds its lock: one run at a time writes here, and staging folders left here are dead.

    Where a network file system knows no such lock, nothing is locked and nothing is cleaned up.
    """
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    lock = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OutputError(
                f"{folder}: another run is writing here.", "Wait for it, or name another folder.", "output-busy"
            ) from error
        except OSError:
            logger.debug("%s cannot be locked", folder)
        else:
            for leftover in sorted(folder.glob(_STAGING + "*")):
                shutil.rmtree(leftover, ignore_errors=True)
        yield
    except BaseException:
        if is_new:
            with suppress(OSError):  # not empty: then it stays
                folder.rmdir()
        raise
    finally:
        os.close(lock)


@contextmanager
def _staging_folder(folder: Path) -> Iterator[Path]:
    """A folder for this run alone, removed whatever happens."""
    staging = Path(tempfile.mkdtemp(prefix=_STAGING, dir=folder))
    _staged.add(staging)
    try:
        yield staging
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        _staged.discard(staging)


def _put_in_place(staging: Path, folder: Path, names: list[str], kept: tuple[str, ...] = ()) -> None:
    """Rename the staged files to their names, run.json last; an error on the way puts the old result back.

    Of the old result everything goes, also what the new one has no match for, but for the names ``kept``.
    """
    old = staging / "old"
    old.mkdir()
    moved_away: list[str] = []
    moved_in: list[str] = []
    try:
        for name in (*reversed(OUTPUTS), *_COMPANIONS):  # run.json first: without it nothing passes for a whole result
            if name not in kept and (folder / name).exists():
                (folder / name).replace(old / name)
                moved_away.append(name)
        for name in names:
            (staging / name).replace(folder / name)
            moved_in.append(name)
    except BaseException:
        for name in moved_in:
            (folder / name).unlink(missing_ok=True)
        for name in reversed(moved_away):
            (old / name).replace(folder / name)
        raise


def _flush(path: Path) -> None:
    """Wait until the disk holds the file."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def _nearest_folder(folder: Path) -> Path:
    """The folder itself, or the nearest one above it that exists."""
    absolute = folder.absolute()
    return next((parent for parent in (absolute, *absolute.parents) if parent.exists()), Path(os.sep))


@contextmanager
def _explained(folder: Path) -> Iterator[None]:
    """Turns what the writing libraries raise into an `OutputError`."""
    from laspy.errors import LaspyException
    from lazrs import LazrsError
    from pyogrio.errors import DataLayerError, DataSourceError, FeatureError, FieldError, GeometryError

    libraries = (DataLayerError, DataSourceError, FeatureError, FieldError, GeometryError)
    try:
        yield
    except OutputError:
        raise
    except (OSError, sqlite3.Error, LaspyException, LazrsError, *libraries) as error:
        raise _output_error(folder, error) from error


def _output_error(folder: Path, error: Exception) -> OutputError:
    if getattr(error, "errno", None) in _FULL_DISK or "disk is full" in str(error) or "No space left" in str(error):
        return OutputError(
            f"{folder}: the disk is full; nothing was written.", "Free some space, or name another folder.", "disk-full"
        )
    reason = getattr(error, "strerror", None) or textwrap.shorten(str(error), 160)
    return OutputError(
        f"{folder}: cannot be written ({reason}).",
        "Check the folder's permissions and the free space.",
        "output-unwritable",
    )
