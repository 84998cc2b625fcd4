"""Files that describe boards: Kalibr's targets (https://github.com/ethz-asl/kalibr/wiki/calibration-targets), and the
options of a board by name, of one or of several (``boards``)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from cuspid.model.board import Board
from cuspid.runtime.errors import InputError
from cuspid.runtime.inputs import read_text
from cuspid.runtime.options import check
from cuspid.runtime.values import number, quote, whole
from cuspid.storage.calibrations.documents import parse
from cuspid.storage.files import reading

_MM_PER_M = 1000.0
_MOST = 100
_LARGEST_M = 10.0


def read_boards(path: Path) -> tuple[Board, ...]:
    """The boards of a YAML, JSON or TOML file, in its order. Raises InputError for one that describes none."""
    with reading(path):
        value = parse(read_text(path)).value
        several = value.get("boards") if isinstance(value, Mapping) else None
        listed = several if isinstance(several, list) else [value]
        if not 0 < len(listed) <= _MOST:
            raise InputError(f"boards: {len(listed)} of them; it must be 1 to {_MOST}")
        return tuple(map(_board, listed))


def _board(value: Any) -> Board:
    if not isinstance(value, Mapping):
        raise InputError(f"a board is {quote(value)}; it must be Kalibr's target_type and so on, or options by name")
    if "target_type" not in value:
        return _board_from_options(value)
    kind = value["target_type"]
    if kind not in _KALIBR:
        raise InputError(f"target_type is {quote(kind)}; it must be one of {', '.join(_KALIBR)}")
    return _KALIBR[kind](value)


def _board_from_options(value: Mapping[str, Any]) -> Board:
    """Raises InputError for names that are none of a board's options."""
    known = {each.name: each.type for each in fields(Board)}
    given = {str(key).replace("-", "_"): each for key, each in value.items()}
    strange = [name for name in given if name not in known]
    if strange or not given:
        raise InputError(
            f"{', '.join(map(quote, strange)) or 'nothing'} is not an option of a board; options are {', '.join(known)}"
        )
    if "square_mm" not in given:
        raise InputError("square_mm is missing: the side of a square in mm")
    for name, each in given.items():
        if name in _SWITCHES and not isinstance(each, bool):
            raise InputError(f"{name} is {quote(each)}; it must be true or false")
        if name in _WHOLE:
            given[name] = whole(name, each, 0, 10**6)
        elif name not in (*_SWITCHES, *_WORDS):
            given[name] = number(name, each, 0, 1e6)
    check("board", Board, given)
    return Board(**given)


_SWITCHES = ("legacy", "inverted")
_WORDS = ("kind", "dictionary")
_WHOLE = ("columns", "rows", "border_bits", "first_id", "terraces")


def _aprilgrid(value: Mapping[str, Any]) -> Board:
    columns, rows = _count(value, "tagCols"), _count(value, "tagRows")
    return Board(
        kind="aprilgrid",
        columns=columns,
        rows=rows,
        square_mm=_length_mm(value, "tagSize"),
        spacing_share=number("tagSpacing", value["tagSpacing"], 0.05, 1.0),
        first_id=whole("codeOffset", value.get("codeOffset", 0), 0, 586),
    )


def _checkerboard(value: Mapping[str, Any]) -> Board:
    """Kalibr counts corners."""
    across, down = _length_mm(value, "colSpacingMeters"), _length_mm(value, "rowSpacingMeters")
    if across != down:
        raise InputError(f"its squares are {across:g} x {down:g} mm; they must be squares")
    columns, rows = _count(value, "targetCols") + 1, _count(value, "targetRows") + 1
    return Board(kind="chessboard", columns=columns, rows=rows, square_mm=across)


def _circlegrid(value: Mapping[str, Any]) -> Board:
    shifted = value["asymmetricGrid"]
    if not isinstance(shifted, bool):
        raise InputError(f"asymmetricGrid is {quote(shifted)}; it must be true or false")
    return Board(
        kind="asymmetric-circles" if shifted else "circles",
        columns=_count(value, "targetCols"),
        rows=_count(value, "targetRows"),
        square_mm=_length_mm(value, "spacingMeters"),
        circle_share=number("circle_share", value.get("circle_share", Board.circle_share), 0.1, 0.95),
    )


_KALIBR: Mapping[str, Callable[[Mapping[str, Any]], Board]] = {
    "aprilgrid": _aprilgrid,
    "checkerboard": _checkerboard,
    "circlegrid": _circlegrid,
}


def _count(value: Mapping[str, Any], key: str) -> int:
    return whole(key, value[key], 2, 100)


def _length_mm(value: Mapping[str, Any], key: str) -> float:
    """Kalibr's are metres."""
    return _MM_PER_M * number(key, value[key], 1e-6, _LARGEST_M)
