"""Where the corners of a board lie in an image."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from cuspid.calibration.circle_centres import find_circles
from cuspid.calibration.lattice import find_lattice, is_as_large, is_larger
from cuspid.calibration.tag_corners import find_tag_corners
from cuspid.model.board import Board, BoardKind, BoardSet, Target
from cuspid.model.camera import OPENCV_PIXEL_OFFSET

LEAST_CORNERS = 6
"""Minimum number of corners in a usable view."""


_LEAST_SQUARES, _ALIKE = 3, 0.3
"""Squares of which a line shows whether they alternate, and the contrast of a line as a share of that of all."""


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

    def shifted(self, shift_px: Float[np.ndarray, "n 2"]) -> BoardView:
        """The same view with its corners elsewhere."""
        return BoardView(self.corner, self.pixels + shift_px)


Views = Mapping[tuple[str, str], BoardView]
"""Views of the board, by camera and instant."""


def find_corners(gray: UInt8[np.ndarray, "h w"], target: Target) -> BoardView | None:
    """The corners of the board, or of all boards of a set, in an image, to a fraction of a pixel; None if too few are
    found.

    A plain chessboard must be seen from border to border (A. Duda, U. Frese, BMVC 2018; where it is bent by a strong
    lens or partly hidden by glare, :mod:`cuspid.calibration.lattice`); of a ChArUco board any part may be seen
    (S. Garrido-Jurado et al., Pattern Recognition 47, 2014). Each corner is searched for where the two markers beside
    it predict it, so that steps elsewhere do not matter. Tags are those of :mod:`cuspid.calibration.tag_corners`,
    circles those of :mod:`cuspid.calibration.circle_centres`.
    """
    if isinstance(target, BoardSet):
        found = [find_corners(gray, each) for each in target.boards]
        shown = [(view, start) for view, start in zip(found, target.starts, strict=False) if view is not None]
        return _unite_views([BoardView(view.corner + start, view.pixels) for view, start in shown])
    return _find_on_board(gray, target)


def _unite_views(views: list[BoardView]) -> BoardView | None:
    """The corners of several boards in one image."""
    if not views:
        return None
    return BoardView(np.concatenate([view.corner for view in views]), np.concatenate([view.pixels for view in views]))


def split_by_board(view: BoardView, target: Target) -> list[BoardView]:
    """The parts of a view that show a board each."""
    number = target.board_of(view.corner)
    return [BoardView(view.corner[number == k], view.pixels[number == k]) for k in np.unique(number)]


def _find_on_board(gray: UInt8[np.ndarray, "h w"], board: Board) -> BoardView | None:
    image = 255 - gray if board.inverted else gray
    found = _FINDERS[board.kind](image, board)
    return found if found is not None and _determines_pose(found, board) else None


def pieces(view: BoardView, board: Target) -> list[BoardView]:
    """The flat parts of a view, terrace by terrace or board by board, each of which determines a pose by itself."""
    if isinstance(board, BoardSet):
        return split_by_board(view, board)
    terrace = board.terrace_at(board.corners[view.corner, 0])
    parts = [BoardView(view.corner[terrace == k], view.pixels[terrace == k]) for k in range(board.terraces)]
    return [part for part in parts if _determines_pose(part, board)]


def _determines_pose(view: BoardView, board: Board) -> bool:
    """Whether it has enough corners, and these do not lie on a line."""
    return len(view.corner) >= LEAST_CORNERS and not _is_collinear(board.corners[view.corner, :2])


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
        return _verify_chessboard(image, pixels, size)
    lattice = find_lattice(image)
    if lattice is None or not is_as_large(lattice, board):
        # Of a larger chessboard it would find a part.
        return None if lattice is not None and is_larger(lattice, board) else _search_exhaustively(image, size)
    return _view(lattice.number_corners(board))


def _search_exhaustively(image: UInt8[np.ndarray, "h w"], size: tuple[int, int]) -> BoardView | None:
    """With the one flag of OpenCV's that does not find boards where there are none."""
    found, pixels = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_EXHAUSTIVE)
    return _verify_chessboard(image, pixels, size) if found else None


def _tags(image: UInt8[np.ndarray, "h w"], board: Board) -> BoardView | None:
    return _view(find_tag_corners(image, board))


def _circles(image: UInt8[np.ndarray, "h w"], board: Board) -> BoardView | None:
    return _view(find_circles(image, board))


def _view(found: tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n 2"]] | None) -> BoardView | None:
    """Of numbers of corners, and where they lie in OpenCV's coordinates."""
    return None if found is None else BoardView(found[0], found[1] + OPENCV_PIXEL_OFFSET)


def _verify_chessboard(
    image: UInt8[np.ndarray, "h w"], pixels: Float32[np.ndarray, "n 1 2"], size: tuple[int, int]
) -> BoardView | None:
    """What OpenCV has found; None where it is not a board."""
    if not _alternates_beyond(image, pixels.reshape(size[1], size[0], 2)):
        return None
    return BoardView(np.arange(size[0] * size[1]), pixels.reshape(-1, 2) + OPENCV_PIXEL_OFFSET)


def _alternates_beyond(image: UInt8[np.ndarray, "h w"], grid: Float32[np.ndarray, "r c 2"]) -> bool:
    """Whether the squares around the corners alternate as those between them do. Of a board that is cut off, OpenCV
    takes the ends of the outer squares for a row of corners, beyond which all is white."""
    for axis in (0, 1):  # places where the corners around them would be
        ends = [2 * grid.take([k], axis) - grid.take([k + step], axis) for k, step in ((0, 1), (-1, -1))]
        grid = np.concatenate([ends[0], grid, ends[1]], axis=axis)
    middles = ((grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1] + grid[:-1, :-1]) / 4).astype(np.float32)
    smooth = cv2.blur(image, (3, 3)).astype(np.float32)
    level = cv2.remap(smooth, middles, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=-1.0)
    height, width = image.shape
    seen = ((middles >= 0) & (middles <= [width - 1, height - 1])).all(axis=2)
    rows, columns = np.indices(seen.shape)
    sign = np.where((rows + columns) % 2, 1.0, -1.0)

    def contrast(line: tuple[int | slice, int | slice]) -> float | None:
        there = seen[line]
        if there.sum() < _LEAST_SQUARES:
            return None
        values = level[line][there]
        return float(np.mean((values - values.mean()) * sign[line][there]))

    within = contrast((slice(1, -1), slice(1, -1)))
    around = [contrast(line) for line in ((0, slice(None)), (-1, slice(None)), (slice(None), 0), (slice(None), -1))]
    return within is None or all(each is None or each * np.sign(within) > _ALIKE * abs(within) for each in around)


def _is_collinear(points: Float[np.ndarray, "n 2"]) -> bool:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] < 0.1 * spread[0])


_FINDERS: Mapping[BoardKind, Callable[[UInt8[np.ndarray, "h w"], Board], BoardView | None]] = {
    "charuco": _charuco,
    "chessboard": _chessboard,
    "aprilgrid": _tags,
    "circles": _circles,
    "asymmetric-circles": _circles,
}
