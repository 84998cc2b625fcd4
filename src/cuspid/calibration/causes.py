"""Why a board is not found in images that show it: what would have to be said of it, or done to them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import UInt8

from cuspid.board import Board
from cuspid.calibration.corners import find_corners
from cuspid.calibration.lattice import find_lattice
from cuspid.errors import InputError

MOST_TRIED = 6
"""Images in which a cause is looked for."""
_DICTIONARIES = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000")
_FEWEST_MARKERS = 4

Gray = UInt8[np.ndarray, "h w"]


def cause_of_absence(images: Sequence[Gray], board: Board) -> str | None:
    """What makes the board be found in most of some images in which it is not as it stands, and what to change; None
    where nothing does."""
    best: tuple[int, str] = (0, "")
    for told, other, mirrored in _others(board, images):
        shown = [np.ascontiguousarray(image[:, ::-1]) if mirrored else image for image in images]
        found = sum(find_corners(image, other) is not None for image in shown)
        if found > best[0]:
            best = found, told
        if found == len(images):
            break
    count, told = best
    return f"{told} (then {count} of {len(images)} show it)" if count > len(images) / 2 else None


def is_part_of_a_larger_one(images: Sequence[Gray], board: Board) -> bool:
    """Whether most of some images that show a chessboard show one with a square more each way, of which it is found
    anywhere: the corners were counted, not the squares."""
    larger = _possible(board, columns=board.columns + 1, rows=board.rows + 1)
    if larger is None or not images or board.kind != "chessboard":
        return False
    return sum(find_corners(image, larger) is not None for image in images) > len(images) / 2


def _others(board: Board, images: Sequence[Gray]) -> Iterator[tuple[str, Board, bool]]:
    """Other boards that may have been meant, the likeliest first, and whether the images are mirrored."""
    if board.kind == "charuco":
        if board.rows % 2 == 0:
            old, yes = ("new", "--no-legacy") if board.legacy else ("old", "--legacy")
            yield (
                f"the board has the {old} layout of OpenCV: give {yes}",
                replace(board, legacy=not board.legacy),
                False,
            )
        yield "the images are mirrored: turn them over (or the print is: print it anew)", board, True
        first = _first_id(board, images)
        if first is not None and first != board.first_id:
            with_id = _possible(board, first_id=first)
            if with_id is not None:
                yield f"the ids of its markers begin at {first}: give --first-id {first}", with_id, False
    light = "--no-inverted" if board.inverted else "--inverted"
    yield f"light and dark are swapped: give {light}", replace(board, inverted=not board.inverted), False
    for columns, rows, why in (*_seen_sizes(board, images), *_sizes(board)):
        sized = _possible(board, columns=columns, rows=rows)
        if sized is not None:
            yield f"{why}: give --columns {columns} --rows {rows}", sized, False
    if board.kind == "charuco":
        for dictionary in _DICTIONARIES:
            if dictionary[:3] != board.dictionary[:3]:
                marked = _possible(board, dictionary=dictionary)
                if marked is not None:
                    yield f"its markers are of another family: give --dictionary {dictionary}", marked, False
        yield "it has no markers: give --kind chessboard", replace(board, kind="chessboard", terraces=1), False
    else:
        yield "it has markers: give --kind charuco", replace(board, kind="charuco"), False


def _seen_sizes(board: Board, images: Sequence[Gray]) -> Iterator[tuple[int, int, str]]:
    """Numbers of squares of the chessboard that most images show, whatever it is said to be."""
    if board.kind != "chessboard":
        return
    found = [each.size for each in (find_lattice(image) for image in images) if each is not None]
    if not found:
        return
    (columns, rows), count = Counter(found).most_common(1)[0]
    if count <= len(images) / 2 or (columns, rows) == (board.columns - 1, board.rows - 1):
        return
    why = f"the images show a chessboard of {columns + 1} x {rows + 1} squares"
    yield (columns + 1, rows + 1, why) if board.columns >= board.rows else (rows + 1, columns + 1, why)


def _sizes(board: Board) -> Iterator[tuple[int, int, str]]:
    """Numbers of squares that may have been meant."""
    columns, rows = board.columns, board.rows
    if columns != rows:
        yield rows, columns, "columns and rows are swapped"
    yield columns + 1, rows + 1, "its corners were counted, not its squares"
    if columns != rows:
        yield rows + 1, columns + 1, "its corners were counted, not its squares, and columns and rows are swapped"
    if board.kind == "charuco":  # a smaller chessboard is found in any other one
        yield columns - 1, rows - 1, "it has a square less each way"


def _possible(board: Board, **changes: object) -> Board | None:
    try:
        return replace(board, **changes)  # type: ignore[arg-type]
    except InputError:
        return None


def _first_id(board: Board, images: Sequence[Gray]) -> int | None:
    """The id at which the markers in some images begin, if they are of its family but not its own."""
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.family}")))
    seen = [detector.detectMarkers(255 - image if board.inverted else image)[1] for image in images]
    ids = np.concatenate([np.zeros(0, np.int64), *(each.ravel() for each in seen if each is not None)])
    numbers, counts = np.unique(ids, return_counts=True)
    numbers = numbers[counts >= min(2, len(images))]
    if len(numbers) < _FEWEST_MARKERS or np.ptp(numbers) >= board.markers:
        return None
    return int(numbers.min())
