"""PLY point clouds: one element of a file as named columns, ascii or binary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from loda_pdal.model.errors import InputError

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float"}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


@dataclass(frozen=True)
class _Element:
    """One element as the header announces it; ``columns`` is None where a property is a list."""

    name: str
    n: int
    columns: list[tuple[str, str]] | None


def read_ply(path: Path, names: Sequence[str]) -> dict[str, npt.NDArray[Any]]:
    """Columns (n,) of the first element with one of the given names, by property; in their own types.

    Raises
    ------
    InputError
        Where the file is not a PLY file, has no such element, is cut short, or has list properties up to that element.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error}.", "Check the path.", "ply-unreadable") from error
    encoding, elements, start = _header(path, content)
    order = _BYTE_ORDERS[encoding]
    n_bytes = n_values = 0  # of the elements before
    for element in elements:
        if element.columns is None:
            raise _damaged(path, f"its element {element.name} has list properties, before any of {', '.join(names)}")
        kind = np.dtype([(name, order + code) for name, code in element.columns])
        if element.name not in names:
            n_bytes, n_values = n_bytes + element.n * kind.itemsize, n_values + element.n * len(element.columns)
        elif encoding == "ascii":
            return _ascii(path, content[start:].split()[n_values:], element, kind)
        elif len(content) < start + n_bytes + element.n * kind.itemsize:
            raise _damaged(path, f"it ends before its {element.n} points do")
        else:
            table = np.frombuffer(content, kind, element.n, start + n_bytes)
            return {name: table[name].astype(kind[name].newbyteorder("=")) for name, _ in element.columns}
    found = ", ".join(element.name for element in elements) or "none"
    raise _damaged(path, f"it has no element {' or '.join(names)}, only: {found}")


def write_ply(path: Path, element: str, columns: Mapping[str, npt.NDArray[Any]]) -> None:
    """One element, binary little endian; columns (n,) in the types they have (float64 as double)."""
    kind = np.dtype([(name, values.dtype.newbyteorder("<")) for name, values in columns.items()])
    n = len(next(iter(columns.values()), ()))
    table = np.empty(n, dtype=kind)
    for name, values in columns.items():
        table[name] = values
    names = [f"property {_NAMES.get(kind[name].str[1:], 'double')} {name}" for name in columns]
    header = ["ply", "format binary_little_endian 1.0", f"element {element} {n}", *names, "end_header", ""]
    path.write_bytes("\n".join(header).encode("ascii") + table.tobytes())


def _header(path: Path, content: bytes) -> tuple[str, list[_Element], int]:
    """Encoding, elements, and where the data begin."""
    end = content.find(b"end_header")
    if not content.startswith(b"ply") or end < 0:
        raise _damaged(path, "it does not begin with a PLY header")
    start = content.find(b"\n", end) + 1 or len(content)
    encoding, elements = "", list[_Element]()
    for line in content[:end].decode("ascii", errors="replace").splitlines():
        match line.split():
            case ["format", word, *_]:
                encoding = word
            case ["element", name, count] if count.isdigit():
                elements.append(_Element(name, int(count), []))
            case ["property", "list", *_] if elements:
                elements[-1] = _Element(elements[-1].name, elements[-1].n, None)
            case ["property", word, name] if elements and word in _TYPES:
                columns = elements[-1].columns
                if columns is not None:
                    columns.append((name, _TYPES[word]))
            case ["property" | "element", *_]:
                raise _damaged(path, f"its header says {line.strip()!r}")
    if encoding not in _BYTE_ORDERS:
        raise _damaged(path, f"its format is {encoding!r}, none of {', '.join(_BYTE_ORDERS)}")
    return encoding, elements, start


def _ascii(path: Path, values: list[bytes], element: _Element, kind: np.dtype[Any]) -> dict[str, Any]:
    """Columns of the element that begins with the first of the values."""
    names = list(kind.names or ())
    try:
        table = np.array(values[: element.n * len(names)], dtype=np.float64).reshape(element.n, len(names))
    except ValueError as error:
        raise _damaged(path, f"it does not hold {element.n} points of {len(names)} numbers") from error
    return {name: table[:, i].astype(kind[name]) for i, name in enumerate(names)}


def _damaged(path: Path, what: str) -> InputError:
    return InputError(f"{path} cannot be read: {what}.", "Give an undamaged PLY file of points.", "ply-damaged")
