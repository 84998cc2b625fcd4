"""Where the corners of a board lie that was not printed and mounted evenly.

Each corner may be off from where it was given, in the plane of the board and out of it, with one standard deviation for
either, estimated from the images (empirical Bayes; D. MacKay, Neural Computation 4, 1992, equation 3.14). It is the
same in all images, so an adjustment takes it for the lens unless it is asked about both. A change of the size of the
whole board cannot be distinguished from a change of distance, so the size stays as given.

Of a board of many corners, nodes of a coarser grid are moved, and the corners between them follow (bilinear).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeGuard

import numpy as np
from jaxtyping import Float, Int

from cuspid.model.board import Board, Target

_MOST_NODES = 14
"""Along each side of a board."""
_FLAT, _FIRST = 3e-4, (0.002, 0.005)
"""Unevenness as a share of a square below which there is none; and that from which the search for it begins, in the
plane of the board and out of it."""
_STRETCH = 0.01
"""Standard deviation of how much longer a board is along than across, and of how much it is sheared: printers feed
paper faster or slower than they should."""
_STIFFNESS = 1e3
"""How much more precisely than by the unevenness the size of the board is known, as a ratio of variances."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardShape:
    """Places of the nodes of a board."""

    offsets_mm: Float[np.ndarray, "s 3"]
    """From where they were given."""
    sigma_mm: tuple[float, float]
    """Their standard deviations: of a coordinate in the plane of the board, and out of it."""

    @staticmethod
    def even(board: Board) -> BoardShape:
        """As given."""
        return BoardShape(
            offsets_mm=np.zeros((int(np.prod(_grid(board))), 3)),
            sigma_mm=(_FIRST[0] * board.square_mm, _FIRST[1] * board.square_mm),
        )

    def is_even(self, board: Board) -> bool:
        """Whether its corners lie as given, as far as matters."""
        return max(self.sigma_mm) <= _FLAT * board.square_mm

    def interpolate(self, nodes: Int[np.ndarray, "n m"], shares: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n 3"]:
        """Offsets of corners, mm, by their nodes (:func:`nodes_of`)."""
        return np.asarray(np.einsum("nm,nmj->nj", shares, self.offsets_mm[nodes]))

    def with_step(self, step_mm: Float[np.ndarray, "k"]) -> BoardShape:
        """The board with its nodes displaced by a step."""
        return replace(self, offsets_mm=self.offsets_mm + step_mm.reshape(-1, 3))

    def precision(self, board: Board) -> Float[np.ndarray, "k k"]:
        """Inverse of the covariance of the offsets before any image."""
        across, out = self.sigma_mm
        each = np.tile([across**-2.0, across**-2.0, out**-2.0], len(self.offsets_mm))
        size, *stretches = _affine(board)
        length = np.linalg.norm(size)
        known = np.diag(each) + _STIFFNESS / across**2 * np.outer(size, size) / length**2
        for mode in stretches:
            weaker = (_STRETCH * length) ** -2.0 - across**-2.0
            known += min(weaker, 0.0) * np.outer(mode, mode) / length**2
        return np.asarray(known)

    def as_uneven(self, variance_mm2: Float[np.ndarray, "s 3"], board: Board) -> BoardShape:
        """The board with standard deviations estimated from its offsets and their variances."""
        modes = np.stack([mode / np.linalg.norm(mode) for mode in _affine(board)])
        flat = self.offsets_mm.ravel()
        offsets = (flat - modes.T @ (modes @ flat)).reshape(-1, 3)
        sigma = []
        for axes, was in zip((slice(0, 2), slice(2, 3)), self.sigma_mm, strict=True):
            dof = variance_mm2[:, axes].size - variance_mm2[:, axes].sum() / was**2
            seen = np.sum(offsets[:, axes] ** 2) / max(float(dof), 1e-3)
            sigma.append(max(float(np.sqrt(seen)), _FLAT * board.square_mm))
        return replace(self, sigma_mm=(sigma[0], sigma[1]))


def is_grid_of_corners(board: Target) -> TypeGuard[Board]:
    """Whether its unevenness can be estimated: one flat board with the corners of squares."""
    return isinstance(board, Board) and board.kind in ("charuco", "chessboard") and board.terraces == 1


def nodes_of(board: Target) -> tuple[Int[np.ndarray, "n m"], Float[np.ndarray, "n m"]]:
    """The nodes about each corner of a board, and by how much it follows each of them; none for others than a grid of
    corners."""
    if not is_grid_of_corners(board):
        return np.zeros((len(board.corners), 0), dtype=np.int64), np.zeros((len(board.corners), 0))
    corners, nodes = (board.columns - 1, board.rows - 1), _grid(board)
    if corners == nodes:
        return np.arange(corners[0] * corners[1])[:, None], np.ones((corners[0] * corners[1], 1))
    before, beyond = zip(*(_interpolation_shares(n, k) for n, k in zip(corners, nodes, strict=True)), strict=True)
    index, share = [], []
    for down in (0, 1):
        for right in (0, 1):
            across, along = before[0] + right, before[1] + down
            index.append((along[:, None] * nodes[0] + across).ravel())
            weights = [np.abs(1 - step - part) for step, part in zip((right, down), beyond, strict=True)]
            share.append(np.outer(weights[1], weights[0]).ravel())
    return np.stack(index, axis=1), np.stack(share, axis=1)


def _interpolation_shares(corners: int, nodes: int) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Of the corners along a side, the node before each, and what share of the way to the next one it lies at."""
    place = np.linspace(0, nodes - 1, corners)
    before = np.minimum(place.astype(np.int64), nodes - 2)
    return before, place - before


def _grid(board: Board) -> tuple[int, int]:
    """Number of nodes along and across."""
    return min(board.columns - 1, _MOST_NODES), min(board.rows - 1, _MOST_NODES)


def _affine(board: Board) -> Float[np.ndarray, "3 k"]:
    """Offsets of the nodes of a board that is larger as a whole, longer along than across, and sheared."""
    columns, rows = _grid(board)
    across = np.linspace(1, board.columns - 1, columns) * board.square_mm
    down = np.linspace(1, board.rows - 1, rows) * board.square_mm
    x, y = ((each - each.mean()).ravel() for each in np.meshgrid(across, down))
    modes = [np.stack([*each, 0 * x], axis=1).ravel() for each in ((x, y), (x, -y), (y, x))]
    return np.asarray(np.stack(modes))
