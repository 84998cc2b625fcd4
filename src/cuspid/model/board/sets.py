"""Several boards that are fixed to one another, nobody knows how: what a rig is calibrated from where no camera sees
all that another one sees. The ids of its markers identify each.

Corners are numbered from board to board, each in the frame of its own board.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.model.board.boards import Board
from cuspid.runtime.errors import InputError
from cuspid.runtime.workers import computed_once


@dataclass(frozen=True, kw_only=True)
class BoardSet:
    """Two boards or more, whose markers have different ids."""

    boards: tuple[Board, ...]
    """The boards; the first one that is seen carries the frame of all."""

    def __post_init__(self) -> None:
        for number, board in enumerate(self.boards, 1):
            if not board.has_markers:
                raise InputError(
                    f"boards: number {number} is a {board.kind}, which cannot be distinguished from the others; "
                    f"several boards "
                    "need markers (charuco, aprilgrid)"
                )
            if board.terraces > 1:
                raise InputError(f"boards: number {number} has terraces; of several boards each must be flat")
        for (one, first), (other, second) in combinations(enumerate(self.boards, 1), 2):
            both = sorted(set(first.ids) & set(second.ids)) if first.family == second.family else []
            if both:
                raise InputError(
                    f"boards: numbers {one} and {other} both have the id {both[0]} ({first.ids_told} and "
                    f"{second.ids_told}); print one of them with ids of its own (--first-id)"
                )

    @property
    def has_circles(self) -> bool:
        """Circles do not identify a board."""
        return False

    @property
    def terraces(self) -> int:
        """All of them are flat."""
        return 1

    @property
    def square_mm(self) -> float:
        """Side of a square of the first one."""
        return self.boards[0].square_mm

    @computed_once
    def corners(self) -> Float[np.ndarray, "n 3"]:
        """Corners of all, each in the frame of its own board, mm."""
        return np.concatenate([board.corners for board in self.boards])

    @computed_once
    def starts(self) -> Int[np.ndarray, "k"]:
        """Number of the first corner of each board, and of the first one that none has."""
        return np.cumsum([0, *(len(board.corners) for board in self.boards)])

    @computed_once
    def orders(self) -> Int[np.ndarray, "1 n"]:
        """Markers identify all corners."""
        return np.arange(len(self.corners))[None]

    @property
    def saddles(self) -> Bool[np.ndarray, "n"]:
        """All corners can be seen."""
        return np.ones(len(self.corners), dtype=bool)

    def board_of(self, corner: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
        """The board that each corner is on, from 0."""
        return np.asarray(np.searchsorted(self.starts, corner, side="right") - 1)


Target = Board | BoardSet
"""What cameras are calibrated from."""
