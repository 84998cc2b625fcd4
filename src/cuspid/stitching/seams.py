"""Which frame each cell of the panorama is taken from: one that sees it well, with few and unseen seams.

The choice minimises  sum_c cost(c, l_c) + sum_{c, d} V(c, d)  over neighbouring cells c, d, with V = 0 within a frame
and V = seam + jump |colour(c, l_c) - colour(d, l_d)| across a seam; by iterated conditional modes (Besag 1986).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int, Int16

from cuspid.runtime.options import Options, Range

_ROUNDS = 10


@dataclass(frozen=True, kw_only=True)
class SeamOptions(Options):
    """What makes a frame a good choice for a place, and what seams cost."""

    candidates: Annotated[int, Range(1, 1000)] = 4
    """Number of best frames that are kept for each cell."""
    oblique: Annotated[float, Range(0, 1_000_000)] = 1.0
    """Cost of looking at 45 degrees instead of straight down; it grows with the square of the tangent."""
    glare: Annotated[float, Range(0, 1_000_000)] = 2.0
    """Cost of a place that is burnt out by a highlight or too dark."""
    border_px: Annotated[float, Range(0.01, 10_000)] = 20.0
    """Distance from the border of a frame over which the border's cost falls to a third."""
    border: Annotated[float, Range(0, 1_000_000)] = 0.1
    """Cost at the border of a frame."""
    seam: Annotated[float, Range(0, 1_000_000)] = 0.02
    """Cost of a seam along the side of a cell."""
    jump: Annotated[float, Range(0, 1_000_000)] = 0.002
    """Cost of each grey level of colour difference across a seam."""

    def cost(
        self, tangent2: Float[np.ndarray, "r c"], border_px: Float[np.ndarray, "r c"], glare: Float[np.ndarray, "r c"]
    ) -> Float[np.ndarray, "r c"]:
        """Cost of a frame in each cell, from the squared tangent of its obliquity, the distance to its border and the
        share of the cell that is burnt out or dark."""
        near = np.exp(-np.maximum(border_px, 0) / self.border_px)
        return np.asarray(self.oblique * tangent2 + self.border * near + self.glare * np.minimum(glare, 1))


def choose(
    cost: Float[np.ndarray, "k r c"],
    frame: Int16[np.ndarray, "k r c"],
    color: Float[np.ndarray, "k r c 3"],
    options: SeamOptions,
) -> Int[np.ndarray, "r c"]:
    """Frame of each cell among its candidates; -1 where there is none."""
    chosen = np.zeros(cost.shape[1:], dtype=np.int64)
    rows, columns = np.indices(chosen.shape)
    even = (rows + columns) % 2 == 0
    for round_number in range(2 * _ROUNDS):
        label = np.take_along_axis(frame, chosen[None], axis=0)[0]
        shown = np.take_along_axis(color, chosen[None, ..., None], axis=0)[0]
        energy = cost.copy()
        for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
            energy += _seam(
                frame,
                color,
                _shift(label, axis, step, -2.0),
                _shift(shown, axis, step, 0.0),
                options,
            )
        better = np.argmin(energy, axis=0)
        chosen = np.where(even == (round_number % 2 == 0), better, chosen)
    label = np.take_along_axis(frame, chosen[None], axis=0)[0].astype(np.int64)
    return np.where(np.isfinite(cost[0]), label, -1)


def _shift(array: np.ndarray, axis: int, step: int, beyond: float) -> np.ndarray:
    """What the neighbour of each cell has; ``beyond`` outside."""
    moved = np.roll(array, step, axis=axis)
    edge: list[slice | int] = [slice(None)] * array.ndim
    edge[axis] = 0 if step > 0 else -1
    moved[tuple(edge)] = beyond
    return moved


def _seam(
    frame: Int16[np.ndarray, "k r c"],
    color: Float[np.ndarray, "k r c 3"],
    neighbour: Int16[np.ndarray, "r c"],
    shown: Float[np.ndarray, "r c 3"],
    options: SeamOptions,
) -> Float[np.ndarray, "k r c"]:
    """What a seam to one neighbour would cost each candidate."""
    jump = np.abs(color - shown).mean(axis=-1)
    apart = (frame != neighbour) & (neighbour >= 0)
    return np.where(apart, options.seam + options.jump * jump, 0.0)
