"""Why a board is not found in images that show it: what would have to be said of it, or done to them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float32, Int, UInt8

from cuspid.calibration.circle_centres import recognize_grid
from cuspid.calibration.corners import find_corners
from cuspid.calibration.lattice import find_lattice
from cuspid.calibration.marker_layout import Outlines, board_by_markers
from cuspid.calibration.tag_corners import ABOVE, detect_tags, layout_agreement, tag_beside
from cuspid.model.board import Board, BoardSet, Target
from cuspid.runtime.errors import InputError

MOST_TRIED = 6
"""Images in which a cause is looked for."""
_DICTIONARIES = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000")
_FEWEST_MARKERS = 4

Gray = UInt8[np.ndarray, "h w"]


def cause_of_absence(images: Sequence[Gray], board: Target) -> str | None:
    """What makes the board be found in most of some images in which it is not as it stands, and what to change; None
    where nothing does."""
    if isinstance(board, BoardSet):
        causes = [(number, _verify_board(images, each)) for number, each in enumerate(board.boards, 1)]
        alone = next((f"board {number}: {cause}" for number, cause in causes if cause is not None), None)
        return _other_ids(images, board) or alone
    return _verify_board(images, board) or _other_ids(images, board) or _other_markers(images, board)


def _verify_board(images: Sequence[Gray], board: Board) -> str | None:
    """What makes one board be found in most of the images."""
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


def is_part_of_a_larger_one(images: Sequence[Gray], board: Target) -> bool:
    """Whether most of some images that show a chessboard show one with a square more each way, of which it is found
    anywhere: the corners were counted, not the squares."""
    if isinstance(board, BoardSet) or board.kind != "chessboard" or not images:
        return False
    larger = _possible(board, columns=board.columns + 1, rows=board.rows + 1)
    if larger is None:
        return False
    return sum(find_corners(image, larger) is not None for image in images) > len(images) / 2


def _others(board: Board, images: Sequence[Gray]) -> Iterator[tuple[str, Board, bool]]:
    """Other boards that may have been meant, the likeliest first, and whether the images are mirrored."""
    if board.kind == "charuco" and board.rows % 2 == 0:
        old, yes = ("new", "--no-legacy") if board.legacy else ("old", "--legacy")
        yield f"the board has the {old} layout of OpenCV: give {yes}", replace(board, legacy=not board.legacy), False
    if board.kind != "circles":
        yield "the images are mirrored: turn them over (or the print is: print it again)", board, True
    if board.has_markers:
        yield from _other_first_ids(board, images)
    if board.kind == "aprilgrid":
        yield from _other_tags(board, images)
    light = "--no-inverted" if board.inverted else "--inverted"
    yield f"light and dark are swapped: give {light}", replace(board, inverted=not board.inverted), False
    if board.has_circles or board.kind == "aprilgrid":
        yield from _other_grids(board, images)
        return
    if board.kind == "charuco":
        yield from _by_markers(board, images)
        for dictionary in _DICTIONARIES:
            if dictionary[:3] != board.dictionary[:3]:
                marked = _possible(board, dictionary=dictionary)
                if marked is not None:
                    yield f"its markers are of another family: give --dictionary {dictionary}", marked, False
        yield "it has no markers: give --kind chessboard", replace(board, kind="chessboard", terraces=1), False
    else:
        for columns, rows, why in (*_visible_sizes(board, images), *_sizes(board)):
            sized = _possible(board, columns=columns, rows=rows)
            if sized is not None:
                yield f"{why}: give --columns {columns} --rows {rows}", sized, False
        yield "it has markers: give --kind charuco", replace(board, kind="charuco"), False
    yield from _other_grids(board, images)


def _visible_sizes(board: Board, images: Sequence[Gray]) -> Iterator[tuple[int, int, str]]:
    """Numbers of squares of the chessboard that most images show, whatever they are said to be."""
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


def _by_markers(board: Board, images: Sequence[Gray]) -> Iterator[tuple[str, Board, bool]]:
    """The ChArUco board whose markers the images show, where it has other numbers of squares."""
    found = board_by_markers(_markers_seen(images, board), board)
    if found is None or found == board:
        return
    squares = found.columns, found.rows
    told = (why for columns, rows, why in _sizes(board) if (columns, rows) == squares)
    why = next(told, f"its markers are those of a board of {squares[0]} x {squares[1]} squares")
    yield f"{why}: give {_options_of(found, board)}", found, False


def _options_of(found: Board, board: Board) -> str:
    """How the numbers of squares of a ChArUco board are given, and its layout if another one was said."""
    layout = "" if found.legacy == board.legacy else " --legacy" if found.legacy else " --no-legacy"
    return f"--columns {found.columns} --rows {found.rows}{layout}"


def _possible(board: Board, **changes: object) -> Board | None:
    try:
        return replace(board, **changes)  # type: ignore[arg-type]
    except InputError:
        return None


def _other_first_ids(board: Board, images: Sequence[Gray]) -> Iterator[tuple[str, Board, bool]]:
    """The first id with which the board has all that are seen. Those at its beginning may be hidden: of tags it is the
    one with which they lie best beside each other, of other markers the least that is seen."""
    ids = _ids_seen(images, board)
    if not ids:
        return
    others = [_possible(board, first_id=first) for first in range(ids[0], max(ids[-1] - board.markers, -1), -1)]
    able = [each for each in others if each is not None]
    if board.kind == "aprilgrid":
        seen = [detect_tags(_undo_inversion(image, board), board.border_bits) for image in images]
        able.sort(key=lambda each: -sum(layout_agreement(outlines, each.tags) for outlines in seen))
    if able and able[0] != board:
        first = able[0].first_id
        found = f"{ids[0]}-{ids[-1]} found, this board has {board.ids_told}"
        yield f"the ids of its markers begin at {first}: give --first-id {first} ({found})", able[0], False


def _ids_seen(images: Sequence[Gray], board: Board) -> list[int]:
    """The ids of the markers of a board's family in some images, in order; none where they are few."""
    ids = sorted(set().union(*_markers_seen(images, board)))
    return ids if len(ids) >= _FEWEST_MARKERS else []


def _markers_seen(images: Sequence[Gray], board: Board) -> list[Outlines]:
    """By image, the markers of a board's family, but for those that are seen too seldom to be trusted."""
    if board.kind == "aprilgrid":
        found: list[Outlines] = [detect_tags(_undo_inversion(image, board), board.border_bits) for image in images]
    else:
        detector = cv2.aruco.ArucoDetector(_dictionary(board.family))
        found = [_outlines(*detector.detectMarkers(_undo_inversion(image, board))[:2]) for image in images]
    counts = Counter(number for outlines in found for number in outlines)
    trusted = {number for number, count in counts.items() if count >= min(2, len(images))}
    return [{number: each for number, each in outlines.items() if number in trusted} for outlines in found]


def _outlines(corners: Sequence[Float32[np.ndarray, "1 4 2"]], ids: Int[np.ndarray, "n 1"] | None) -> Outlines:
    """What OpenCV's detector has found."""
    numbers = [] if ids is None else ids.ravel().tolist()
    return {number: each[0].astype(np.float64) for number, each in zip(numbers, corners, strict=True)}


def _undo_inversion(image: Gray, board: Board) -> Gray:
    return 255 - image if board.inverted else image


def _dictionary(family: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{family}"))


def _other_ids(images: Sequence[Gray], target: Target) -> str | None:
    """Where images show markers with ids that are none of a board's, or of several: which, and which it has."""
    advice = []
    for family, board in {board.family: board for board in target.boards if board.has_markers}.items():
        own = {each for one in target.boards if one.family == family for each in one.ids}
        strange = [each for each in _ids_seen(images, board) if each not in own]
        if len(strange) >= _FEWEST_MARKERS:
            has = " and ".join(one.ids_told for one in target.boards if one.family == family)
            what = "these boards have" if len(target.boards) > 1 else "this board has"
            advice.append(f"markers of the family {family} with the ids {strange[0]}-{strange[-1]} found, {what} {has}")
    return "; ".join(advice) or None


def _other_markers(images: Sequence[Gray], board: Board) -> str | None:
    """Where images show markers of another kind of board: which."""
    families = [family for family in _DICTIONARIES if board.kind != "charuco" or family[:3] != board.dictionary[:3]]
    for other in (
        *(Board(kind="charuco", dictionary=family, inverted=board.inverted) for family in families),  # type: ignore[arg-type]
        *(Board(kind="aprilgrid", border_bits=bits, inverted=board.inverted) for bits in (2, 1)),
    ):
        ids = [] if other.family == board.family and board.has_markers else _ids_seen(images, other)
        if ids:
            charuco = other.kind == "charuco"
            found = board_by_markers(_markers_seen(images, other), other) if charuco else None
            family = f" --dictionary {other.dictionary}" if charuco else ""
            size = f" {_options_of(found, other)}, with" if found else ", with its --columns, --rows and"
            return (
                f"the images show markers of the family {other.family} (ids {ids[0]}-{ids[-1]}): give --kind "
                f"{other.kind}{family}{size} its --square-mm"
            )
    return None


def _other_tags(board: Board, images: Sequence[Gray]) -> Iterator[tuple[str, Board, bool]]:
    """Other borders of tags, and other numbers of them in a row, which is by how much the ids of tags above others are
    greater."""
    bits = 3 - board.border_bits
    yield f"its tags have borders of {bits} bits: give --border-bits {bits}", replace(board, border_bits=bits), False
    pitch, steps = 1 + board.spacing_share, list[int]()
    ids = set[int]()
    for image in images:
        outlines = detect_tags(_undo_inversion(image, board), board.border_bits)
        above = {tag: tag_beside(outlines, tag, ABOVE, pitch) for tag in outlines}
        steps += [other - tag for tag, other in above.items() if other is not None]
        ids |= set(outlines)
    if not steps or not ids:
        return
    columns = Counter(steps).most_common(1)[0][0]
    rows = -(-(max(ids) + 1 - board.first_id) // max(columns, 1))
    sized = _possible(board, columns=columns, rows=max(rows, 2)) if columns > 1 else None
    if sized is not None:
        yield f"there are {columns} tags in a row: give --columns {columns} --rows {rows}", sized, False


def _other_grids(board: Board, images: Sequence[Gray]) -> Iterator[tuple[str, Board, bool]]:
    """The grid of circles, or the chessboard, that most images show."""
    shown = [_undo_inversion(image, board) for image in images]
    grids = Counter(each for each in map(recognize_grid, shown) if each is not None)
    squares = Counter(each.size for each in map(find_lattice, images) if each is not None)
    for (kind, columns, rows), count in grids.most_common(1):
        other = _possible(board, kind=kind, columns=columns, rows=rows)
        if other is not None and other != board and count > len(images) / 2:
            yield (
                f"the images show a grid of {columns} x {rows} circles: give --kind {kind} --columns {columns} "
                f"--rows {rows}",
                other,
                False,
            )
    for (columns, rows), count in squares.most_common(1):
        other = _possible(board, kind="chessboard", columns=columns + 1, rows=rows + 1)
        if other is not None and count > len(images) / 2:
            yield (
                f"the images show a chessboard of {columns + 1} x {rows + 1} squares: give --kind chessboard --columns "
                f"{columns + 1} --rows {rows + 1}",
                other,
                False,
            )
