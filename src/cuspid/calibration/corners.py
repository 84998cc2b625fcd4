"""Where the corners of a board lie in an image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from cuspid.board import Board
from cuspid.camera import OPENCV_PIXEL_OFFSET

LEAST_CORNERS = 6
"""A view of fewer tells nothing."""


@dataclass(frozen=True, eq=False)
class BoardView:
    """Corners of the board in one image."""

    corner: Int[np.ndarray, "n"]
    """Their numbers on the board."""
    pixels: Float[np.ndarray, "n 2"]
    """Where they lie, px."""

    def renumbered(self, order: Int[np.ndarray, "k"]) -> BoardView:
        """The same view under another numbering of the corners (``Board.orders``)."""
        return BoardView(order[self.corner], self.pixels)


Views = Mapping[tuple[str, str], BoardView]
"""Of the board, by camera and instant."""


def find_corners(gray: UInt8[np.ndarray, "h w"], board: Board) -> BoardView | None:
    """The corners of the board in an image, to a fraction of a pixel; None where too few are found.

    A plain chessboard must be seen whole (A. Duda, U. Frese, BMVC 2018); of a ChArUco board any part may
    (S. Garrido-Jurado et al., Pattern Recognition 47, 2014).
    """
    image = 255 - gray if board.inverted else gray
    found = _charuco(image, board) if board.kind == "charuco" else _chessboard(image, board)
    if found is None or len(found.corner) < LEAST_CORNERS or _on_a_line(board.corners[found.corner, :2]):
        return None
    return found


def _charuco(image: UInt8[np.ndarray, "h w"], board: Board) -> BoardView | None:
    pixels, corner, _, _ = cv2.aruco.CharucoDetector(board.opencv).detectBoard(image)
    if corner is None:
        return None
    return BoardView(corner.ravel().astype(np.int64), pixels.reshape(-1, 2) + OPENCV_PIXEL_OFFSET)


def _chessboard(image: UInt8[np.ndarray, "h w"], board: Board) -> BoardView | None:
    size = (board.columns - 1, board.rows - 1)
    found, pixels = cv2.findChessboardCornersSB(image, size)
    if not found:
        return None
    return BoardView(np.arange(size[0] * size[1]), pixels.reshape(-1, 2) + OPENCV_PIXEL_OFFSET)


def _on_a_line(points: Float[np.ndarray, "n 2"]) -> bool:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] < 0.1 * spread[0])
