"""Connected components of numbered items that are joined in pairs."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Int
from scipy.sparse import coo_array

from cuspid.runtime.kernels import kernel


def graph_of(pairs: Int[np.ndarray, "p 2"], count: int) -> coo_array:
    """Adjacency matrix (count, count) of the given pairs."""
    return coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))


def parts_of(pairs: Int[np.ndarray, "p 2"], count: int) -> Int[np.ndarray, "n"]:
    """The component number of each of ``count`` items; no pair joins two components. They are numbered in the order of
    their first items."""
    part = np.empty(count, dtype=np.int64)
    _join(np.ascontiguousarray(pairs, dtype=np.int64), part)
    return part


@kernel
@no_type_check
def _join(pairs, part):
    """Fill in the components: first the tree of each item, whose root is its first item, then their numbers."""
    for item in range(len(part)):
        part[item] = item
    for row in range(len(pairs)):
        one, other = pairs[row, 0], pairs[row, 1]
        while part[one] != one:
            part[one] = part[part[one]]
            one = part[one]
        while part[other] != other:
            part[other] = part[part[other]]
            other = part[other]
        part[max(one, other)] = min(one, other)
    found = 0
    for item in range(len(part)):
        if part[item] == item:
            part[item] = found
            found += 1
        else:
            part[item] = part[part[item]]
