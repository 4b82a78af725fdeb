"""Where points of different labels are neighbours."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from loda_pdal.kernels.compiled import kernel

Array = npt.NDArray[Any]


@kernel
def contact_keys(neighbour: Array, labels: Array, n: int) -> Array:
    """One key for each neighbour relation between two labels.

    Parameters
    ----------
    neighbour : (m, k) int32
        Neighbours of each point, -1 padded.
    labels : (m,) int32
        Label of each point, less than ``n``; points with a negative label have no contacts.

    Returns
    -------
    (c,) int64
        ``n * a + b`` with labels a < b, as often as a point of one has a neighbour of the other.
    """
    n_contacts = 0
    for i in range(len(neighbour)):
        for j in neighbour[i]:
            n_contacts += j >= 0 and labels[i] >= 0 and labels[j] >= 0 and labels[i] != labels[j]
    keys = np.empty(n_contacts, dtype=np.int64)
    c = 0
    for i in range(len(neighbour)):
        for j in neighbour[i]:
            if j >= 0 and labels[i] >= 0 and labels[j] >= 0 and labels[i] != labels[j]:
                keys[c] = np.int64(n) * min(labels[i], labels[j]) + max(labels[i], labels[j])
                c += 1
    return keys
