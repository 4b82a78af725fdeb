"""Results as files and back: nested dataclasses, arrays and shapes in one ``.npz`` without pickle.

The arrays of a value are stored as they are; everything around them is a JSON tree beside them in the same file.
Only dataclasses, named tuples and enums of this package can be rebuilt, so that a file from elsewhere runs no code.
"""

from __future__ import annotations

import enum
import json
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

_PACKAGE = "loda_pdal"
_TREE = "tree"


def save_packed(path: Path, value: Any) -> None:
    """Write ``value`` to ``path``: numbers, text, None, lists, tuples, dictionaries, arrays, shapes, dataclasses."""
    packer = _Packer()
    tree = json.dumps(packer.pack(value), separators=(",", ":")).encode()
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **{_TREE: np.frombuffer(tree, dtype=np.uint8)}, **packer.arrays)


def load_packed(path: Path) -> Any:
    """The value that `save_packed` wrote; ``ValueError`` where the file is not one of its own."""
    with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
        if _TREE not in stored:
            raise ValueError(f"{path}: was not written by loda-pdal")
        arrays = {name: stored[name] for name in stored.files}
    return _unpack(json.loads(arrays[_TREE].tobytes()), arrays)


class _Packer:
    """Turns a value into a JSON tree and the arrays it refers to; the same array twice is stored once."""

    def __init__(self) -> None:
        self.arrays: dict[str, npt.NDArray[Any]] = {}
        self._names: dict[int, str] = {}

    def pack(self, value: Any) -> Any:
        if isinstance(value, enum.Enum):
            return {"$": "enum", "type": _type_name(type(value)), "name": value.name}
        if value is None or (isinstance(value, (bool, int, float, str)) and not isinstance(value, np.generic)):
            return value
        if isinstance(value, (np.ndarray, np.generic)):
            return self._pack_array(np.asarray(value))
        if isinstance(value, shapely.Geometry):
            return {"$": "shape", "wkb": shapely.to_wkb(value, hex=True)}
        if is_dataclass(value) and not isinstance(value, type):
            kept = {item.name: self.pack(getattr(value, item.name)) for item in fields(value) if item.init}
            return {"$": "data", "type": _type_name(type(value)), "fields": kept}
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            kept = {name: self.pack(getattr(value, name)) for name in value._fields}
            return {"$": "data", "type": _type_name(type(value)), "fields": kept}
        if isinstance(value, list):
            return [self.pack(item) for item in value]
        if isinstance(value, tuple):
            return {"$": "tuple", "items": [self.pack(item) for item in value]}
        if isinstance(value, dict):
            return {"$": "dict", "items": [[self.pack(key), self.pack(item)] for key, item in value.items()]}
        raise TypeError(f"cannot store a {type(value).__module__}.{type(value).__qualname__}")

    def _pack_array(self, array: npt.NDArray[Any]) -> Any:
        if array.dtype == object:
            if array.ndim == 1 and all(item is None or isinstance(item, shapely.Geometry) for item in array):
                return {"$": "shapes", "wkb": [None if g is None else shapely.to_wkb(g, hex=True) for g in array]}
            raise TypeError("cannot store an array of objects that are not shapes")
        if id(array) not in self._names:
            name = f"a{len(self.arrays)}"
            self._names[id(array)] = name
            self.arrays[name] = array
        return {"$": "array", "name": self._names[id(array)]}


def _type_name(cls: type) -> str:
    if cls.__module__.partition(".")[0] != _PACKAGE:
        raise TypeError(f"cannot store a {cls.__module__}.{cls.__qualname__}")
    return f"{cls.__module__}:{cls.__qualname__}"


def _type_of(name: str) -> Any:
    """The dataclass, named tuple or enum of this package with that name."""
    module, _, qualname = name.partition(":")
    if module.partition(".")[0] != _PACKAGE:
        raise ValueError(f"{name} is not a type of {_PACKAGE}")
    found: Any = import_module(module)
    for part in qualname.split("."):
        found = getattr(found, part)
    is_ours = isinstance(found, type) and found.__module__ == module
    if not is_ours or not (is_dataclass(found) or hasattr(found, "_fields") or issubclass(found, enum.Enum)):
        raise ValueError(f"{name} is not a type that a file may name")
    return found


def _unpack(tree: Any, arrays: dict[str, npt.NDArray[Any]]) -> Any:
    if isinstance(tree, list):
        return [_unpack(item, arrays) for item in tree]
    if not isinstance(tree, dict):
        return tree
    match tree["$"]:
        case "array":
            array = arrays[tree["name"]]
            return array if array.ndim else array[()]
        case "tuple":
            return tuple(_unpack(item, arrays) for item in tree["items"])
        case "dict":
            return {_unpack(key, arrays): _unpack(item, arrays) for key, item in tree["items"]}
        case "shape":
            return shapely.from_wkb(tree["wkb"])
        case "shapes":
            shapes = np.empty(len(tree["wkb"]), dtype=object)
            shapes[:] = [None if text is None else shapely.from_wkb(text) for text in tree["wkb"]]
            return shapes
        case "enum":
            return _type_of(tree["type"])[tree["name"]]
        case "data":
            return _type_of(tree["type"])(**{name: _unpack(item, arrays) for name, item in tree["fields"].items()})
        case other:
            raise ValueError(f"unknown mark {other!r}")
