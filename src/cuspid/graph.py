"""Connected components of numbered items that are joined in pairs."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def graph_of(pairs: Int[np.ndarray, "p 2"], count: int) -> coo_array:
    """Adjacency matrix (count, count) of the given pairs."""
    return coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))


def parts_of(pairs: Int[np.ndarray, "p 2"], count: int) -> Int[np.ndarray, "n"]:
    """The component number of each of ``count`` items; no pair joins two components."""
    return np.asarray(connected_components(graph_of(pairs, count), directed=False)[1], dtype=np.int64)
