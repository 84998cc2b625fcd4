"""Semi-global optimisation (H. Hirschmueller, IEEE Trans. PAMI 30, 2008): one of many labels for each cell of a grid,
cheap in itself and like those of its neighbours. The labels are in order: planes of a sweep, say, from far to near."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Float32

from cuspid.runtime.kernels import kernel

_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))


@kernel
@no_type_check
def _add_path(cost, total, down, right, small, large):
    """Add the least costs of paths in one direction to their sum over the directions."""
    rows, columns, depth = cost.shape
    paths = np.zeros((2, columns, depth), np.float32)  # of this row of cells and of the one before
    for i in range(rows):
        y = i if down >= 0 else rows - 1 - i
        for j in range(columns):
            x = j if right >= 0 else columns - 1 - j
            v, u = y - down, x - right
            path = paths[i % 2, x]
            if v < 0 or v >= rows or u < 0 or u >= columns:
                for d in range(depth):
                    path[d] = cost[y, x, d]
            else:
                before = paths[i % 2 if down == 0 else 1 - i % 2, u]
                least = before.min()
                for d in range(depth):
                    best = min(before[d], least + large)
                    if d > 0:
                        best = min(best, before[d - 1] + small)
                    if d < depth - 1:
                        best = min(best, before[d + 1] + small)
                    path[d] = cost[y, x, d] + best - least
            for d in range(depth):
                total[y, x, d] += path[d]


def semi_global(cost: Float32[np.ndarray, "r c d"], small: float, large: float) -> Float[np.ndarray, "r c"]:
    """Label of each cell, with fractions, by optimisation along eight directions. ``cost`` is that of each label there;
    ``small`` and ``large`` are the penalties for a label that differs from its neighbour's by one, and by more."""
    total = np.zeros_like(cost)
    for down, right in _DIRECTIONS:
        _add_path(cost, total, down, right, np.float32(small), np.float32(large))
    best = np.clip(total.argmin(axis=2), 1, cost.shape[2] - 2)
    below, here, above = (np.take_along_axis(total, (best + step)[..., None], axis=2)[..., 0] for step in (-1, 0, 1))
    bend = np.maximum(below + above - 2 * here, 1e-6)
    return np.asarray(best + np.clip((below - above) / (2 * bend), -0.5, 0.5), dtype=np.float64)
