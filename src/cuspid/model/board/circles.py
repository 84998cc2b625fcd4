"""Grids of circles: square ones, and those whose rows are shifted by half a step, as OpenCV has them.

Frame: as in :mod:`cuspid.model.board.boards`; around the outer circles there is as much paper as from the middle of one
to the next.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

_SAME = 1e-6
"""Distance, in steps, of places that are the same."""


def circle_centres(columns: int, rows: int, *, shifted: bool) -> Float[np.ndarray, "n 2"]:
    """The centres of circles, in steps, numbered along the rows; ``shifted``: every second row by half the distance of
    two circles, which is then two steps."""
    column, row = np.meshgrid(np.arange(columns), np.arange(rows))
    across = 2 * column + row % 2 if shifted else column
    return 1.0 + np.stack([across, row], axis=-1).reshape(-1, 2).astype(np.float64)


def grid_size(columns: int, rows: int, *, shifted: bool) -> tuple[float, float]:
    """Width and height, in steps, with the paper around."""
    return float(2 * columns + 1 if shifted else columns + 1), float(rows + 1)


def turned_orders(centres: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "k n"]:
    """Numberings of points that they have after quarter turns after which they lie where they lay, the usual one
    first."""
    middle = (centres.min(axis=0) + centres.max(axis=0)) / 2
    away, tree = centres - middle, cKDTree(centres - middle)
    orders = []
    for quarter in range(4):
        cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
        distance, number = tree.query(away @ np.array([[cos, sin], [-sin, cos]], dtype=np.float64))
        if distance.max() < _SAME:
            orders.append(number.astype(np.int64))
    return np.stack(orders)


def in_circles(
    points: Float[np.ndarray, "n 2"], centres: Float[np.ndarray, "m 2"], radius: float
) -> Bool[np.ndarray, "n"]:
    """Whether points lie in circles."""
    known = np.isfinite(points).all(axis=1)
    inside = np.zeros(len(points), dtype=bool)
    inside[known] = cKDTree(centres).query(points[known], distance_upper_bound=radius)[0] <= radius
    return inside
