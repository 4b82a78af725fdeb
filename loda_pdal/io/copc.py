"""Cloud-Optimised Point Clouds: a LAZ file whose chunks are the nodes of an octree, for viewers such as QGIS.

COPC 1.0 (https://copc.io) is LAZ 1.4 of point format 6, 7 or 8 with one chunk per node, a first record that says where
the octree lies, and a last record that lists its nodes. Any reader of LAZ reads it, node after node: the order of the
points is given up.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import lazrs
import numpy as np
import numpy.typing as npt
from laspy.vlrs.known import LasZipVlr

from loda_pdal.model.cloud import FloatArray, Int64Array
from loda_pdal.model.errors import OutputError

SUFFIX = ".copc.laz"
POINT_FORMATS = (6, 7, 8)

CELLS_PER_NODE = 128
"""A node shows at most one point per cell of its cube, so many cells along an edge."""
LARGEST_LEAF = 20_000
"""A node with no more points than this has no children."""

_DEEPEST = 14  # cells of that level still fit three times into 63 bits
_NODES_AT_ONCE = 64
_ENTRY = struct.Struct("<4iQ2i")
_EVLR_HEADER = struct.Struct("<H16sHQ32s")
_INFO_BYTES = 160


@dataclass(frozen=True)
class _Octree:
    """Nodes in the order of the file: ``keys`` (k, 4) level, x, y, z; ``counts`` (k,); ``order`` (n,) of the points."""

    keys: Int64Array
    counts: Int64Array
    order: Int64Array
    corner: FloatArray
    size: float


def write_copc(source: Path, target: Path) -> None:
    """Write the points of a LAS or LAZ file as COPC, with their dimensions, CRS, scale and offset.

    Parameters
    ----------
    source : Path
        LAS 1.4 with a point format of 6 to 8; is read whole.
    target : Path
        Ends in ``.copc.laz``; replaced where it exists. May be the source itself.
    """
    las = laspy.read(source)
    if las.header.point_format.id not in POINT_FORMATS:
        raise OutputError(
            f"{source.name}: point format {las.header.point_format.id} cannot be written as COPC.",
            "COPC holds point formats 6 to 8; write laz instead.",
            "cloud-format",
        )
    tree = _octree(np.column_stack([las.x, las.y, las.z]))
    compression = lazrs.LazVlr.new_for_compression(
        las.header.point_format.id, las.header.point_format.num_extra_bytes, use_variable_size_chunks=True
    )
    header = _header(las.header, compression)
    with target.open("wb") as file:
        header.write_to(file)
        compressor = lazrs.ParLasZipCompressor(file, compression)
        for chunks in _chunks(las.points.array, tree):
            compressor.compress_chunks(chunks)
        compressor.done()
        nodes_at = _append_hierarchy(file, header, compression, tree, target)
        info = next(vlr for vlr in header.vlrs if vlr.user_id == "copc")
        info.record_data = _info(tree, np.asarray(las.gps_time), nodes_at)
        header.start_of_first_evlr, header.number_of_evlrs = nodes_at - _EVLR_HEADER.size, 1
        file.seek(0)
        header.write_to(file, ensure_same_size=True)


def _octree(xyz: FloatArray) -> _Octree:
    """Every point in the coarsest node that has a free cell for it; what is left in a small node stays there."""
    n = len(xyz)
    corner = xyz.min(axis=0) if n else np.zeros(3)
    size = max(float((xyz.max(axis=0) - corner).max()) if n else 0.0, 1e-3) * (1 + 1e-9)
    share = (xyz - corner) / size
    level, node = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    left = np.random.default_rng(0).permutation(n)  # no cell prefers a scan line
    for depth in range(_DEEPEST + 1):
        if not len(left):
            break
        codes = _codes(share[left], 2**depth)
        _, at, counts = np.unique(codes, return_inverse=True, return_counts=True)
        is_taken = counts[at] <= LARGEST_LEAF
        if depth == _DEEPEST:
            is_taken[:] = True
        crowded = np.flatnonzero(~is_taken)
        _, first = np.unique(_codes(share[left[crowded]], CELLS_PER_NODE * 2**depth), return_index=True)
        is_taken[crowded[first]] = True
        level[left[is_taken]], node[left[is_taken]] = depth, codes[is_taken]
        left = left[~is_taken]
    order = np.lexsort((node, level))
    starts = np.flatnonzero(np.r_[True, (np.diff(level[order]) != 0) | (np.diff(node[order]) != 0)]) if n else order
    first_of_node = order[starts]
    code = node[first_of_node]
    axes = [(code >> shift) & 0x1FFFFF for shift in (42, 21, 0)]
    keys = np.column_stack([level[first_of_node], *axes]).astype(np.int64)
    return _Octree(keys, np.diff(np.r_[starts, n]), order, corner, size)


def _codes(share: FloatArray, cells: int) -> Int64Array:
    """One number per point for the cell that holds it, of so many along each edge of the cube."""
    x, y, z = np.clip((share * cells).astype(np.int64), 0, cells - 1).T
    return np.asarray((x << 42) | (y << 21) | z)


def _chunks(points: npt.NDArray[Any], tree: _Octree) -> Iterator[list[bytes]]:
    """The stored points of some nodes at a time."""
    stops = np.cumsum(tree.counts)
    starts = stops - tree.counts
    for first in range(0, len(stops), _NODES_AT_ONCE):
        some = slice(first, first + _NODES_AT_ONCE)
        yield [points[tree.order[start:stop]].tobytes() for start, stop in zip(starts[some], stops[some], strict=True)]


def _header(source: Any, compression: Any) -> Any:
    """The source's header with the records that COPC wants: its own first, that of the compression last."""
    info = laspy.VLR("copc", 1, "COPC info", bytes(_INFO_BYTES))
    others = [vlr for vlr in source.vlrs if vlr.user_id not in ("copc", "laszip encoded")]
    source.vlrs = [info, *others, LasZipVlr(compression.record_data())]
    source.are_points_compressed = True
    source.evlrs = None
    return source


def _append_hierarchy(file: Any, header: Any, compression: Any, tree: _Octree, path: Path) -> int:
    """Append the record of all nodes, one page; returns where its data begin."""
    file.flush()
    with path.open("rb") as written:
        written.seek(header.offset_to_point_data)
        sizes = [n_bytes for _, n_bytes in lazrs.read_chunk_table(written, compression)][: len(tree.keys)]
    begin = header.offset_to_point_data + 8 + np.cumsum(sizes, dtype=np.int64) - np.array(sizes, dtype=np.int64)
    page = b"".join(
        _ENTRY.pack(*(int(v) for v in key), int(start), int(n_bytes), int(count))
        for key, start, n_bytes, count in zip(tree.keys, begin, sizes, tree.counts, strict=True)
    )
    file.seek(0, 2)
    file.write(_EVLR_HEADER.pack(0, b"copc", 1000, len(page), b"EPT hierarchy"))
    nodes_at = file.tell()
    file.write(page)
    return int(nodes_at)


def _info(tree: _Octree, gps_time: FloatArray, nodes_at: int) -> bytes:
    half = tree.size / 2
    times = (float(gps_time.min()), float(gps_time.max())) if len(gps_time) else (0.0, 0.0)
    page_bytes = len(tree.keys) * _ENTRY.size
    numbers = struct.pack(
        "<5d2Q2d", *(tree.corner + half), half, tree.size / CELLS_PER_NODE, nodes_at, page_bytes, *times
    )
    return numbers.ljust(_INFO_BYTES, b"\0")
