"""The points of a LAS, LAZ or COPC file, decompressed part by part and never held as a whole."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from laspy import DecompressionSelection
from laspy.errors import LaspyException
from lazrs import LazrsError

from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.errors import InputError
from loda_pdal.model.survey import PART

KEPT_BYTES = 64_000_000
"""A file whose points take no more than this is decompressed once and kept."""

_UNREADABLE = (LaspyException, LazrsError, ValueError, EOFError, struct.error, OverflowError, MemoryError, IndexError)


class LasFile:
    """The points of one file, in its order, as often as they are asked for.

    A run goes through them several times; `InputError` where the file was changed in between.

    Parameters
    ----------
    path : Path
    n_points : int
        What the header promises; a file that holds another number is damaged.

    Attributes
    ----------
    header : laspy.LasHeader
    """

    def __init__(self, path: Path, n_points: int) -> None:
        self.path = path
        self._n = n_points
        self._state = self._current_state()
        with reading(path), laspy.open(path) as reader:
            self.header = reader.header
        self._kept: list[Any] = []

    def __len__(self) -> int:
        return self._n

    @property
    def n_bytes(self) -> int:
        """Size of the file."""
        return self._state[0]

    def records(self) -> Iterator[Any]:
        """laspy's records of at most `PART` points each, with all dimensions."""
        if self._kept:
            yield from self._kept
            return
        kept: list[Any] = []
        for record in self._decompressed(DecompressionSelection.all()):
            if self._is_small:
                kept.append(record)
            yield record
        self._kept = kept

    def coordinates(self) -> Iterator[FloatArray]:
        """Full map coordinates (k, 3), part by part."""
        only_xyz = DecompressionSelection.base().decompress_z()
        return map(self.map_coordinates, self.records() if self._is_small else self._decompressed(only_xyz))

    def gps_times(self) -> Iterator[FloatArray]:
        """GPS times (k,) s, part by part; the points must have them."""
        only_time = DecompressionSelection.base() | DecompressionSelection.GPS_TIME
        for record in self.records() if self._is_small else self._decompressed(only_time):
            yield np.asarray(record["gps_time"], dtype=np.float64)

    def map_coordinates(self, record: Any) -> FloatArray:
        """Full map coordinates (k, 3) of one of the `records`; `InputError` where they are not finite."""
        xyz = map_coordinates(record, self.header.scales, self.header.offsets)
        if not np.all(np.isfinite(xyz)):
            raise InputError(
                f"{self.path}: holds coordinates that are not finite.",
                "Repair the scale and offset of the header, or write the file again from its source.",
                "input-not-finite",
            )
        return xyz

    def sha256(self) -> str:
        """Checksum of the file, hexadecimal."""
        with reading(self.path), self.path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        self._check_unchanged()
        return digest

    @property
    def _is_small(self) -> bool:
        return bool(self._n * self.header.point_format.size <= KEPT_BYTES)

    def _decompressed(self, selection: DecompressionSelection) -> Iterator[Any]:
        self._check_unchanged()
        n_read = 0
        with reading(self.path), laspy.open(self.path, decompression_selection=selection) as reader:
            for record in reader.chunk_iterator(PART):
                n_read += len(record)
                yield record
        if n_read != self._n:
            raise broken(self.path, f"the header promises {self._n} points, {n_read} could be read")
        self._check_unchanged()

    def _check_unchanged(self) -> None:
        if self._current_state() != self._state:
            raise InputError(
                f"{self.path}: was changed while the run was reading it.",
                "Start again when nothing writes to the surveys any more.",
                "input-changed",
            )

    def _current_state(self) -> tuple[int, int, int]:
        with reading(self.path):
            found = self.path.stat()
        return found.st_size, found.st_mtime_ns, found.st_ino


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turns what goes wrong while a file is read into an `InputError`."""
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        raise unreadable(path, error) from error
    except _UNREADABLE as error:
        raise broken(path, str(error)) from error


def unreadable(path: Path, error: OSError) -> InputError:
    """The error of a file that the system does not hand out."""
    return InputError(
        f"{path}: cannot be read ({error.strerror or error}).", "Check the file's permissions.", "input-unreadable"
    )


def broken(path: Path, reason: str) -> InputError:
    """The error of a file that is damaged."""
    return InputError(
        f"{path}: is damaged or cut off ({reason or 'unexpected end'}).",
        "Copy or download it again, and check it with `pdal info`.",
        "input-truncated",
    )


def map_coordinates(points: Any, scale: Any, offset: Any) -> FloatArray:
    """Full map coordinates (n, 3) of laspy points: stored integers times scale plus offset; not checked."""
    xyz = np.empty((len(points), 3))
    with np.errstate(over="ignore"):
        for column, axis in enumerate("XYZ"):
            np.multiply(points[axis], float(scale[column]), out=xyz[:, column])
        xyz += np.asarray(offset, dtype=np.float64)
    return xyz
