"""Where the corners of a board lie in an image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from cuspid.board import Board
from cuspid.calibration.lattice import find_lattice, is_as_large, is_larger
from cuspid.camera import OPENCV_PIXEL_OFFSET

LEAST_CORNERS = 6
"""Minimum number of corners in a usable view."""


@dataclass(frozen=True, eq=False)
class BoardView:
    """Corners of the board in one image."""

    corner: Int[np.ndarray, "n"]
    """Their numbers on the board."""
    pixels: Float[np.ndarray, "n 2"]
    """Positions in the image, px."""

    def renumbered(self, order: Int[np.ndarray, "k"]) -> BoardView:
        """The same view under another numbering of the corners (``Board.orders``)."""
        return BoardView(order[self.corner], self.pixels)


Views = Mapping[tuple[str, str], BoardView]
"""Views of the board, by camera and instant."""


def find_corners(gray: UInt8[np.ndarray, "h w"], board: Board) -> BoardView | None:
    """The corners of the board in an image, to a fraction of a pixel; None if too few are found.

    A plain chessboard must be seen from border to border (A. Duda, U. Frese, BMVC 2018; where it is bent by a strong
    lens or partly hidden by glare, :mod:`cuspid.calibration.lattice`); of a ChArUco board any part may be seen
    (S. Garrido-Jurado et al., Pattern Recognition 47, 2014). Each corner is searched for where the two markers beside
    it predict it, so that steps elsewhere do not matter.
    """
    image = 255 - gray if board.inverted else gray
    found = _charuco(image, board) if board.kind == "charuco" else _chessboard(image, board)
    return found if found is not None and _tells(found, board) else None


def pieces(view: BoardView, board: Board) -> list[BoardView]:
    """The flat parts of a view, terrace by terrace, of which each tells something by itself."""
    terrace = board.terrace_at(board.corners[view.corner, 0])
    parts = [BoardView(view.corner[terrace == k], view.pixels[terrace == k]) for k in range(board.terraces)]
    return [part for part in parts if _tells(part, board)]


def _tells(view: BoardView, board: Board) -> bool:
    """Whether it has enough corners, and these do not lie on a line."""
    return len(view.corner) >= LEAST_CORNERS and not _on_a_line(board.corners[view.corner, :2])


def _charuco(image: UInt8[np.ndarray, "h w"], board: Board) -> BoardView | None:
    parameters = cv2.aruco.CharucoParameters()
    parameters.checkMarkers = board.terraces == 1  # it takes the markers beyond a step for wrong ones
    pixels, corner, _, _ = cv2.aruco.CharucoDetector(board.opencv, parameters).detectBoard(image)
    if corner is None:
        return None
    seen = board.saddles[corner.ravel()]
    return BoardView(corner.ravel()[seen].astype(np.int64), pixels.reshape(-1, 2)[seen] + OPENCV_PIXEL_OFFSET)


def _chessboard(image: UInt8[np.ndarray, "h w"], board: Board) -> BoardView | None:
    size = (board.columns - 1, board.rows - 1)
    found, pixels = cv2.findChessboardCornersSB(image, size)
    if found:
        return BoardView(np.arange(size[0] * size[1]), pixels.reshape(-1, 2) + OPENCV_PIXEL_OFFSET)
    lattice = find_lattice(image)
    if lattice is None or not is_as_large(lattice, board):
        # Of a larger chessboard it would find a part.
        return None if lattice is not None and is_larger(lattice, board) else _exhaustively(image, size)
    numbered = lattice.numbered(board)
    return None if numbered is None else BoardView(numbered[0], numbered[1] + OPENCV_PIXEL_OFFSET)


def _exhaustively(image: UInt8[np.ndarray, "h w"], size: tuple[int, int]) -> BoardView | None:
    """With the one flag of OpenCV's that does not find boards where there are none."""
    found, pixels = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_EXHAUSTIVE)
    return BoardView(np.arange(size[0] * size[1]), pixels.reshape(-1, 2) + OPENCV_PIXEL_OFFSET) if found else None


def _on_a_line(points: Float[np.ndarray, "n 2"]) -> bool:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] < 0.1 * spread[0])
