"""Look-ups of voxels beside others, by sorted keys."""

from __future__ import annotations

import numpy as np

from loda_pdal.kernels.compiled import kernel


@kernel
def find_shifted(keys, shift):  # type: ignore[no-untyped-def]
    """Place (k,) int32 of each key plus ``shift`` among the ascending distinct ``keys`` (k,) int64; -1 where none."""
    place = np.empty(len(keys), dtype=np.int32)
    j = 0
    for i in range(len(keys)):
        while j < len(keys) and keys[j] < keys[i] + shift:
            j += 1
        place[i] = j if j < len(keys) and keys[j] == keys[i] + shift else -1
    return place


@kernel
def spread(keys, shift):  # type: ignore[no-untyped-def]
    """Ascending distinct keys, each plus and minus ``shift``, and these themselves: ascending and distinct again."""
    n = len(keys)
    result = np.empty(3 * n, dtype=np.int64)
    size = a = b = c = 0
    while c < n:  # the lowest of what is next in each of three ascending rows
        key = keys[c] + shift
        if b < n:
            key = min(key, keys[b])
        if a < n:
            key = min(key, keys[a] - shift)
        result[size] = key
        size += 1
        a += a < n and keys[a] - shift == key
        b += b < n and keys[b] == key
        c += keys[c] + shift == key
    return result[:size]
