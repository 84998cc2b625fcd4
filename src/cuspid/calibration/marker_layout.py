"""How many squares a ChArUco board has, by the ids of its markers and where they lie.

Ids run along the rows, so that only with the right number of columns does one homography map all middles of markers to
where an image shows them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, Int

from cuspid.model.board import Board
from cuspid.runtime.errors import InputError

_FEWEST = 6
"""Markers in an image that tell a layout from others: four fit any."""
_OFF, _CLEARLY = 0.3, 2.0
"""Distance of the markers from where a layout has them, RMS in sides of a marker, at most; and how many times farther
off they must be with any other number of columns."""
_COLUMNS = range(3, 101)

Outlines = Mapping[int, Float[np.ndarray, "4 2"]]
"""By id, the corners of a marker in an image."""


def board_by_markers(shown: Sequence[Outlines], board: Board) -> Board | None:
    """The ChArUco board with as many squares, and with the layout, as its markers show; of rows the fewest that have
    all of them. None where no layout fits, or more than one, or the first rows are never seen."""
    shown = [outlines for outlines in shown if len(outlines) >= _FEWEST]
    ids = sorted({number for outlines in shown for number in outlines})
    if not ids or ids[0] < board.first_id:
        return None
    tried = [(_distance(shown, each), each) for each in _with_markers_to(board, ids[-1])]
    if not tried:
        return None
    off, best = min(tried, key=lambda each: each[0])
    rival = min((other for other, each in tried if each.columns != best.columns), default=np.inf)
    clear = off < _OFF and rival > _CLEARLY * off and ids[0] - board.first_id < best.columns
    return best if clear else None


def _with_markers_to(board: Board, last: int) -> Iterator[Board]:
    """Boards of any number of columns, in both layouts, with rows up to that of a marker."""
    count = last + 1 - board.first_id
    for columns in _COLUMNS:
        rows = max(-(-2 * count // columns), 3)
        for legacy in (board.legacy, not board.legacy)[: 1 + (rows % 2 == 0)]:
            with suppress(InputError):  # more than 100 rows, or markers than there are
                yield replace(board, columns=columns, rows=rows, legacy=legacy)


def _distance(shown: Sequence[Outlines], board: Board) -> float:
    """How far markers are from where a board has them, RMS in their sides; the median over the images."""
    distances = []
    for outlines in shown:
        places = _middles(np.array(list(outlines)) - board.first_id, board)
        seen = np.stack([outline.mean(axis=0) for outline in outlines.values()])
        homography, _ = cv2.findHomography(places, seen)
        if homography is None:
            return np.inf
        there = cv2.perspectiveTransform(places[None], homography)[0]
        area = np.median([cv2.contourArea(outline.astype(np.float32)) for outline in outlines.values()])
        distances.append(np.sqrt(np.mean(np.sum((there - seen) ** 2, axis=1)) / area))
    return float(np.median(distances))


def _middles(number: Int[np.ndarray, "n"], board: Board) -> Float[np.ndarray, "n 2"]:
    """The middles of markers of a board, by their number on it, in squares. Two rows have as many as there are
    columns; in every second square, from the first one or the second."""
    begins = int(not (board.legacy and board.rows % 2 == 0))  # with a dark square
    pair, place = np.divmod(number, board.columns)
    above = (board.columns + 1 - begins) // 2
    below = place >= above
    column = 2 * (place - above * below) + (begins ^ below)
    return 0.5 + np.stack([column, 2 * pair + below], axis=1)
