"""Kalibr's AprilGrid: tags in a grid, with dark squares between their corners, so that four dark areas meet at none of
them by chance but at each of them two (https://github.com/ethz-asl/kalibr/wiki/calibration-targets).

Frame: as in :mod:`cuspid.model.board.boards`; the origin is the outer corner of the dark square at the top left. Tags
are numbered from the bottom left, along the rows; their corners from the top left, along the rows, two to each tag.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

FAMILY = "APRILTAG_36h11"
"""OpenCV's name of the family."""
_TURNS = 2
"""Quarter turns from a tag as OpenCV draws it to one as Kalibr (and the authors of AprilTag) print it."""


def tag_dictionary() -> cv2.aruco.Dictionary:
    """All tags of the family."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{FAMILY}"))


@dataclass(frozen=True, kw_only=True)
class TagGrid:
    """Tags of one size."""

    columns: int
    """Tags in a row."""
    rows: int
    """Tags in a column."""
    tag_mm: float
    """Side of a tag with its dark border."""
    gap_mm: float
    """Distance between two tags."""
    border_bits: int
    """Width of the dark border of a tag."""
    first_id: int
    """Id of the tag at the bottom left."""

    @property
    def pitch_mm(self) -> float:
        """From a tag to the next."""
        return self.tag_mm + self.gap_mm

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height, with the outer dark squares."""
        return self.columns * self.pitch_mm + self.gap_mm, self.rows * self.pitch_mm + self.gap_mm

    @property
    def corners(self) -> Float[np.ndarray, "n 2"]:
        """The corners of the tags, mm."""
        across, down = (
            self.gap_mm + (np.arange(count)[:, None] * self.pitch_mm + [0.0, self.tag_mm]).ravel()
            for count in (self.columns, self.rows)
        )
        return np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)

    def corners_of(self, ids: Int[np.ndarray, "m"]) -> Int[np.ndarray, "m 4"]:
        """Numbers of the corners of some tags of the grid, in the order in which OpenCV's detector has them: clockwise
        from the one at the bottom right, for its tags are turned by half a turn."""
        index = ids - self.first_id
        row, column = self.rows - 1 - index // self.columns, index % self.columns
        top_left = 2 * row * 2 * self.columns + 2 * column
        below = 2 * self.columns
        return np.stack([top_left + below + 1, top_left + below, top_left, top_left + 1], axis=1)

    @property
    def ids(self) -> Int[np.ndarray, "rows columns"]:
        """Id of the tag at each place, from the top left."""
        return self.first_id + np.arange(self.rows * self.columns).reshape(self.rows, self.columns)[::-1]

    def neighbours(self, tag: int) -> Int[np.ndarray, "m"]:
        """Ids of a tag and of those around it."""
        row, column = np.argwhere(self.ids == tag)[0]
        return self.ids[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].ravel()

    def light_bits(self) -> Bool[np.ndarray, "rows columns b b"]:
        """The light bits of each tag, with its border."""
        family = tag_dictionary()
        side = family.markerSize + 2 * self.border_bits
        drawn = [
            np.rot90(cv2.aruco.generateImageMarker(family, number, side, borderBits=self.border_bits), _TURNS)
            for number in self.ids.ravel().tolist()
        ]
        return np.reshape(drawn, (self.rows, self.columns, side, side)) > 0

    def is_dark(
        self, points: Float[np.ndarray, "n 2"], light_bits: Bool[np.ndarray, "rows columns b b"]
    ) -> Bool[np.ndarray, "n"]:
        """Whether the print is dark at some places."""
        inside = ((points >= 0) & (points < self.size_mm)).all(axis=1)
        cell = np.floor((points - self.gap_mm) / self.pitch_mm).astype(np.int64)
        within = points - self.gap_mm - cell * self.pitch_mm
        beyond = within >= self.tag_mm
        column, row = cell.T
        tagged = inside & ~beyond.any(axis=1) & (cell >= 0).all(axis=1) & (column < self.columns) & (row < self.rows)
        dark = np.asarray(inside & beyond.all(axis=1))
        count = light_bits.shape[-1]
        across, down = np.clip(np.floor(within[tagged] / self.tag_mm * count).astype(np.int64), 0, count - 1).T
        dark[tagged] = ~light_bits[row[tagged], column[tagged], down, across]
        return dark

    def dark(
        self, light_bits: Bool[np.ndarray, "rows columns b b"]
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
        """The printed squares: top left corner and side of each."""
        row, column, down, across = np.nonzero(~light_bits)
        bit_mm = self.tag_mm / light_bits.shape[-1]
        bits = np.stack([column * self.pitch_mm + bit_mm * across, row * self.pitch_mm + bit_mm * down], axis=-1)
        square = np.stack(np.meshgrid(np.arange(self.columns + 1), np.arange(self.rows + 1)), axis=-1).reshape(-1, 2)
        places = np.concatenate([self.gap_mm + bits, self.pitch_mm * square])
        return places, np.repeat([bit_mm, self.gap_mm], [len(bits), len(square)])
