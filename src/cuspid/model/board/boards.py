"""Boards with known corners, flat or in terraces: what cameras are calibrated from.

Frame: ``board``: +X along a row of squares, +Y down the columns, +Z into the board; the origin is its top left corner.
Corners are where four squares meet, the corners of the tags of an AprilGrid, or the centres of circles, numbered along
the rows as OpenCV does. Terraces are runs of whole columns that rise towards the cameras, along +X; seen from straight
above, the squares are those of the flat board.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.model.board.circles import circle_centres, grid_size, in_circles, turned_orders
from cuspid.model.board.tags import FAMILY, TagGrid, tag_dictionary
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range
from cuspid.runtime.workers import computed_once

Dictionary = Literal[
    "4X4_50", "4X4_100", "4X4_250", "4X4_1000", "5X5_50", "5X5_100", "5X5_250", "5X5_1000",
    "6X6_50", "6X6_100", "6X6_250", "6X6_1000", "7X7_50", "7X7_100", "7X7_250", "7X7_1000",
]  # fmt: skip
"""OpenCV's predefined families of markers: bits and number of markers."""
BoardKind = Literal["charuco", "chessboard", "aprilgrid", "circles", "asymmetric-circles"]


@dataclass(frozen=True, kw_only=True)
class BoardPattern(Options):
    """What is printed on a board, whatever its size."""

    kind: BoardKind = "charuco"
    """Squares with markers (charuco), which identify the corners, so that the board may be seen in part, or without
    (chessboard); Kalibr's tags (aprilgrid), which may be seen in part, too; dots in a square grid (circles) or in rows
    that are shifted by half a step (asymmetric-circles)."""
    columns: Annotated[int, Range(2, 100)] = 8
    """Squares, tags or circles in a row."""
    rows: Annotated[int, Range(2, 100)] = 11
    """Squares, tags or circles in a column."""
    marker_share: Annotated[float, Range(0.1, 0.95)] = 0.75
    """Side of a marker, as a share (0 to 1) of the side of its square."""
    dictionary: Dictionary = "4X4_1000"
    """Family of the markers of a ChArUco board; those of an AprilGrid are AprilTags of the family 36h11."""
    spacing_share: Annotated[float, Range(0.05, 1.0)] = 0.3
    """Gap between the tags of an AprilGrid, as a share of their side (Kalibr's tagSpacing)."""
    border_bits: Annotated[int, Range(1, 2)] = 2
    """Width of the dark border of the tags of an AprilGrid, in bits; Kalibr prints 2."""
    circle_share: Annotated[float, Range(0.1, 0.95)] = 0.5
    """Diameter of a circle, as a share of the distance to the nearest one."""
    first_id: Annotated[int, Range(0, 999)] = 0
    """Id of the first marker or tag (that of an AprilGrid is at the bottom left); the others follow."""
    legacy: bool = False
    """Layout of OpenCV before 4.6 for boards with an even number of rows: a marker in the first corner."""
    inverted: bool = False
    """Light and dark are swapped."""


@dataclass(frozen=True, kw_only=True)
class Board(BoardPattern):
    """A ChArUco board (a chessboard with a marker in each light square), a plain chessboard, an AprilGrid (tags with
    dark squares between their corners) or a grid of dark circles."""

    square_mm: Annotated[float, Range(0.001, 10_000)] = 1.0
    """Side of a square, side of a tag, or distance of neighbouring circles (of asymmetric ones half the distance in a
    row, as in OpenCV), as measured on the printed board."""
    terraces: Annotated[int, Range(1, 50)] = 1
    """Number of flat pieces of whole columns, each higher than the one before; 1 is a flat board."""
    step_mm: Annotated[float, Range(0.001, 10_000)] = 1.0
    """How much higher each terrace is than the one before, towards the cameras, as measured on the body."""
    step_sigma_um: Annotated[float, Range(0.001, 10_000)] = 10.0
    """Standard deviation of that step, common to all steps."""

    def __post_init__(self) -> None:
        super().__post_init__()
        named = FAMILY if self.kind == "aprilgrid" else self.dictionary
        there = len(tag_dictionary().bytesList) if self.kind == "aprilgrid" else int(self.dictionary.split("_")[1])
        needed = self.first_id + self.markers
        if self.has_markers and there < needed:
            raise InputError(f"board: {needed} markers are needed, but the dictionary {named} has {there}")
        if self.kind in ("charuco", "chessboard") and min(self.columns, self.rows) < 3:
            raise InputError(f"board: a {self.kind} needs at least 3 x 3 squares, not {self.columns} x {self.rows}")
        if self.terraces > 1 and self.kind != "charuco":
            what = "grid of circles" if self.has_circles else self.kind
            raise InputError(f"board: a {what} must be flat; terraces need the kind charuco")
        if self.terraces > 1 and 2 * self.terraces > self.columns:
            raise InputError(
                f"board: {self.terraces} terraces need at least {2 * self.terraces} columns, but it has {self.columns}"
            )

    @property
    def has_markers(self) -> bool:
        """Whether markers identify its corners, so that it may be seen in part."""
        return self.kind in ("charuco", "aprilgrid")

    @property
    def has_circles(self) -> bool:
        """Whether its corners are the centres of circles."""
        return self.kind in ("circles", "asymmetric-circles")

    @property
    def circle_mm(self) -> float:
        """Diameter of its circles."""
        nearest = np.sqrt(2) if self.kind == "asymmetric-circles" else 1.0
        return float(self.circle_share * nearest * self.square_mm)

    @property
    def markers(self) -> int:
        """Number of markers that a board of this size has."""
        if self.kind == "aprilgrid":
            return self.columns * self.rows
        return self.columns * self.rows // 2 if self.kind == "charuco" else 0

    @property
    def ids(self) -> range:
        """Ids of its markers."""
        return range(self.first_id, self.first_id + self.markers)

    @property
    def ids_told(self) -> str:
        """The first and the last of them, in words."""
        return f"{self.ids[0]}-{self.ids[-1]}" if self.ids else "none"

    @property
    def boards(self) -> tuple[Board, ...]:
        """Itself: one board, as :class:`cuspid.model.board.BoardSet` has several."""
        return (self,)

    def board_of(self, corner: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
        """The board that each corner is on: this one."""
        return np.zeros_like(corner)

    @property
    def family(self) -> str:
        """The largest dictionary of its markers' kind, which begins with those of the smaller ones."""
        return FAMILY if self.kind == "aprilgrid" else f"{self.dictionary.split('_')[0]}_1000"

    @computed_once
    def tags(self) -> TagGrid:
        """Its tags, of an AprilGrid."""
        return TagGrid(
            columns=self.columns,
            rows=self.rows,
            tag_mm=self.square_mm,
            gap_mm=self.spacing_share * self.square_mm,
            border_bits=self.border_bits,
            first_id=self.first_id,
        )

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of the squares, seen from straight above; of circles with the paper around."""
        if self.kind == "aprilgrid":
            return self.tags.size_mm
        across, down = float(self.columns), float(self.rows)
        if self.has_circles:
            across, down = grid_size(self.columns, self.rows, shifted=self._is_shifted)
        return across * self.square_mm, down * self.square_mm

    @property
    def corners(self) -> Float[np.ndarray, "n 3"]:
        """The points where four squares meet, the corners of tags, or the centres of circles, mm."""
        if self.kind == "aprilgrid":
            return np.pad(self.tags.corners, ((0, 0), (0, 1)))
        if self.has_circles:
            return np.pad(self._circles_mm, ((0, 0), (0, 1)))
        column, row = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        places = self.square_mm * np.stack([column, row, 0.0 * row], axis=-1).reshape(-1, 3)
        places[:, 2] -= self.step_mm * self._terrace_of(column.ravel())
        return places

    @property
    def _circles_mm(self) -> Float[np.ndarray, "n 2"]:
        return self.square_mm * circle_centres(self.columns, self.rows, shifted=self._is_shifted)

    @property
    def _is_shifted(self) -> bool:
        return self.kind == "asymmetric-circles"

    @property
    def saddles(self) -> Bool[np.ndarray, "n"]:
        """Whether each corner can be seen: at the edge of a step, four squares do not meet."""
        if self.terraces == 1:
            return np.ones(len(self.corners), dtype=bool)
        column = np.tile(np.arange(1, self.columns), self.rows - 1)
        return self._terrace_of(column) == self._terrace_of(column - 1)

    @property
    def height_mm(self) -> float:
        """Height of the last terrace above the first."""
        return (self.terraces - 1) * self.step_mm

    @property
    def edges_mm(self) -> Float[np.ndarray, "n"]:
        """Where each terrace begins along X, and where the last one ends."""
        return self.square_mm * -(-np.arange(self.terraces + 1) * self.columns // self.terraces)

    def terrace_at(self, x_mm: Float[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
        """The terrace at places along X; the first and the last extend beyond the board."""
        return self._terrace_of(np.clip(np.floor(x_mm / self.square_mm), 0, self.columns - 1).astype(np.int64))

    def _terrace_of(self, column: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
        return column * self.terraces // self.columns

    @computed_once
    def orders(self) -> Int[np.ndarray, "k n"]:
        """The numberings of the corners that an image of the board cannot distinguish, the usual one first: rotated by
        half a turn if it has no markers, by quarter turns if it is also square."""
        if self.has_circles:
            return turned_orders(self._circles_mm / self.square_mm)
        if self.has_markers:
            return np.arange(len(self.corners))[None]
        usual = np.arange((self.columns - 1) * (self.rows - 1)).reshape(self.rows - 1, self.columns - 1)
        turns = 4 if self.columns == self.rows else 2
        return np.stack([np.rot90(usual, k * (4 // turns)).ravel() for k in range(turns)])

    @computed_once
    def opencv(self) -> cv2.aruco.CharucoBoard:
        """The same ChArUco board as an OpenCV object. Raises InputError for another kind."""
        if self.kind != "charuco":
            raise InputError(f"board: a board of the kind {self.kind} is not a ChArUco board")
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
        side = self.marker_share * self.square_mm
        ids = self.first_id + np.arange(self.markers, dtype=np.int32)
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_mm, side, markers, ids)
        board.setLegacyPattern(self.legacy)
        return board

    @computed_once
    def dark(self) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
        """The printed squares, seen from straight above: top left corner (mm) and side of each. Circles are none."""
        if self.kind == "aprilgrid":
            return self.tags.dark(self._tag_bits)
        if self.has_circles:
            return np.zeros((0, 2)), np.zeros(0)
        row, column = np.indices((self.rows, self.columns))
        corners = np.argwhere((row + column) % 2 == self._first_dark)[:, ::-1]
        places, sides = [corners * self.square_mm], [np.full(len(corners), self.square_mm)]
        if self.kind == "charuco":
            row, column, down, across = np.nonzero(~self._bits)
            bit, margin = self.marker_share / self._bits.shape[-1], (1 - self.marker_share) / 2
            corners = np.stack([column + margin + bit * across, row + margin + bit * down], axis=-1)
            places.append(corners * self.square_mm)
            sides.append(np.full(len(corners), bit * self.square_mm))
        return np.concatenate(places), np.concatenate(sides)

    def is_dark(self, points: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
        """Whether the board is dark at some places, mm, seen from straight above; beyond its border it is as between
        the squares."""
        if self.kind == "aprilgrid":
            return self.tags.is_dark(points, self._tag_bits) ^ self.inverted
        if self.has_circles:
            return in_circles(points, self._circles_mm, self.circle_mm / 2) ^ self.inverted
        squares = points / self.square_mm
        column, row = np.floor(squares).astype(np.int64).T
        inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        dark = inside & ((row + column) % 2 == self._first_dark)
        if self.kind == "charuco":
            light = np.flatnonzero(inside & ~dark)
            dark[light] = self._in_marker(squares[light] % 1, row[light], column[light])
        return dark ^ self.inverted

    def _in_marker(
        self, within: Float[np.ndarray, "n 2"], row: Int[np.ndarray, "n"], column: Int[np.ndarray, "n"]
    ) -> Bool[np.ndarray, "n"]:
        """Whether a place in a square (0 to 1) is on a dark bit of its marker."""
        count = self._bits.shape[-1]
        place = np.floor(((within - 0.5) / self.marker_share + 0.5) * count).astype(np.int64)
        across, down = np.clip(place, 0, count - 1).T
        return ((place >= 0) & (place < count)).all(axis=1) & ~self._bits[row, column, down, across]

    def tag_bits(self, tag: int) -> Bool[np.ndarray, "b b"]:
        """The light bits of a tag of an AprilGrid, with its dark border."""
        row, column = np.argwhere(self.tags.ids == tag)[0]
        return np.asarray(self._tag_bits[row, column])

    @computed_once
    def _tag_bits(self) -> Bool[np.ndarray, "rows columns b b"]:
        """The light bits of the tags of an AprilGrid, with their dark borders."""
        return self.tags.light_bits()

    @computed_once
    def _bits(self) -> Bool[np.ndarray, "rows columns b b"]:
        """The light bits of the marker in each square, with its dark border; all light where there is none."""
        dictionary = self.opencv.getDictionary()
        count = dictionary.markerSize + 2
        bits = np.ones((self.rows, self.columns, count, count), dtype=bool)
        for number, corners in zip(self.opencv.getIds(), self.opencv.getObjPoints(), strict=True):
            column, row = (np.asarray(corners)[0, :2] // self.square_mm).astype(int)
            bits[row, column] = cv2.aruco.generateImageMarker(dictionary, int(number), count) > 0
        return bits

    @property
    def _first_dark(self) -> int:
        """0 where the first square is dark, 1 where it holds a marker."""
        return int(self.kind == "charuco" and self.legacy and self.rows % 2 == 0)
