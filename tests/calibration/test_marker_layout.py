"""The numbers of squares of a ChArUco board follow from its markers, or none are told."""

from dataclasses import replace

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from cuspid.calibration.marker_layout import Outlines, board_by_markers
from cuspid.model.board import Board


def shown(board: Board, seed: int, share: float) -> Outlines:
    """The outlines of a share of the markers of a board, seen obliquely."""
    rng = np.random.default_rng(seed)
    corners = np.array([[0, 0], [640, 0], [640, 480], [0, 480]])
    seen = corners + rng.uniform(-60, 60, (4, 2))
    homography = cv2.getPerspectiveTransform(
        (corners / [640, 480] * board.size_mm).astype(np.float32), seen.astype(np.float32)
    )
    ids = board.opencv.getIds().ravel()
    kept = rng.permutation(len(ids))[: round(share * len(ids))]
    outlines = np.array(board.opencv.getObjPoints())[kept][:, :, :2].astype(np.float64)
    pixels = cv2.perspectiveTransform(outlines.reshape(1, -1, 2), homography).reshape(-1, 4, 2)
    return dict(zip(ids[kept].tolist(), pixels + rng.normal(0, 0.3, pixels.shape), strict=True))


@settings(max_examples=25)
@given(
    size=st.tuples(st.integers(5, 14), st.integers(5, 14)),
    said=st.tuples(st.integers(3, 20), st.integers(3, 20)),
    legacy=st.booleans(),
    first_id=st.sampled_from([0, 100]),
    share=st.floats(0.8, 1.0),
    seed=st.integers(0, 2**16),
)
def test_markers_tell_the_size_of_their_board(
    size: tuple[int, int], said: tuple[int, int], legacy: bool, first_id: int, share: float, seed: int
) -> None:
    board = Board(columns=size[0], rows=size[1], legacy=legacy, first_id=first_id)
    views = [shown(board, seed + k, share) for k in range(3)]
    found = board_by_markers(views, replace(board, columns=said[0], rows=said[1]))
    assert found is not None
    assert found.columns == board.columns
    assert board.rows - 1 <= found.rows <= board.rows  # the markers of the last row may all be hidden
    assert found.legacy == legacy or board.rows % 2 == 1


def test_no_size_is_told_by_what_fits_several() -> None:
    board = Board(columns=8, rows=8)
    whole = shown(board, 0, 1.0)
    two_rows = {number: whole[number] for number in range(9, 15)}
    assert board_by_markers([two_rows], board) is None
    assert board_by_markers([{number: whole[number] for number in range(5)}], board) is None
    assert board_by_markers([{number + 40: each for number, each in whole.items()}], board) is None
    scattered = dict(zip(whole, np.random.default_rng(0).permutation(list(whole.values())), strict=True))
    assert board_by_markers([scattered], board) is None
    assert board_by_markers([whole], board) == board
