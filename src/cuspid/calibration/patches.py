"""Grey values of paper and ink in an image of a board whose pose is known, in windows well inside uniform areas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from cuspid.calibration.bundle import bend_points
from cuspid.geometry import Rigid3
from cuspid.model.board import Board
from cuspid.model.camera import Camera
from cuspid.runtime.image_files import Pixels
from cuspid.runtime.options import Options, Range

BRIGHTEST_DN, DARKEST_DN = 245.0, 8.0
"""Beyond these levels, a mean may have been clipped."""
_CELLS = 32
"""Number of cells along each side of a square, among which places are searched for."""
_APART = 4
"""Minimum number of cells between two places."""
_HALF_CELL = 0.75
"""Distance from the middle of a cell to its corners, rounded up."""
_LEAST_CELLS = 1.0
"""Minimum clearance of a place, in cells."""
_WINDOW = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), axis=-1).reshape(-1, 2)
"""Rows and columns of a window relative to its middle."""
VALUES = 3 * len(_WINDOW)
"""Number of values that are averaged: three channels of a window."""
_PLANE = np.column_stack([np.ones(len(_WINDOW)), _WINDOW])
_OFF_PLANE = np.eye(len(_WINDOW)) - _PLANE @ np.linalg.pinv(_PLANE)
"""Subtracts from a window the plane that fits it best."""
FREEDOM = 3 * (len(_WINDOW) - _PLANE.shape[1])
"""Degrees of freedom of the variance of a patch."""


@dataclass(frozen=True, kw_only=True)
class PatchOptions(Options):
    """Where grey values are measured."""

    clear_px: Annotated[float, Range(2, 100)] = 3.0
    """Minimum distance from the middle of a patch to where paper and ink meet; larger if images are blurred."""
    patches: Annotated[int, Range(6, 10_000)] = 60
    """Maximum number of patches per image, of paper and ink together."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Places:
    """Places on the board with uniform surroundings."""

    points: Float[np.ndarray, "n 2"]
    """Positions, seen from straight above, mm."""
    clearance_mm: Float[np.ndarray, "n"]
    """Distance to where paper and ink meet, or to an edge."""
    dark: Bool[np.ndarray, "n"]
    """Whether it is ink."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Patches:
    """Windows of 3 x 3 pixels that see only paper or only ink."""

    pixels: Float[np.ndarray, "n 2"]
    """Centres of the windows, px."""
    points: Float[np.ndarray, "n 3"]
    """What they see, in the frame of the board, mm."""
    dark: Bool[np.ndarray, "n"]
    """Whether that is ink."""
    level_dn: Float[np.ndarray, "n"]
    """Mean of the pixels and channels."""
    variance_dn2: Float[np.ndarray, "n"]
    """Variance of one pixel in one channel, about the plane that fits the window best."""

    @property
    def usable(self) -> Bool[np.ndarray, "n"]:
        """Which patches are neither burnt out nor black."""
        return (self.level_dn < BRIGHTEST_DN) & (self.level_dn > DARKEST_DN)

    def take(self, chosen: Bool[np.ndarray, "n"] | Int[np.ndarray, "m"]) -> Patches:
        """A selection of them."""
        return Patches(**{each.name: getattr(self, each.name)[chosen] for each in fields(self)})


def join_patches(parts: Sequence[Patches]) -> Patches:
    """All patches of several sets, in order."""
    return Patches(**{each.name: np.concatenate([getattr(p, each.name) for p in parts]) for each in fields(Patches)})


def clear_places(board: Board) -> Places:
    """The centres of uniform areas: the cells of a fine grid with the largest clearance, none next to another."""
    dark = _cells(board)
    far = np.where(dark, _distance_to_edge(dark), _distance_to_edge(~dark))
    far = np.minimum(far, _distance_to_step(board, far.shape[1])[None])
    ridge = far + 1e-3 * np.random.default_rng(0).random(far.shape, dtype=np.float32)  # one of a row that is all alike
    size = 2 * _APART + 1
    clear = (ridge == cv2.dilate(ridge, np.ones((size, size), np.uint8))) & (far > _LEAST_CELLS)
    row, column = np.nonzero(clear)
    cell_mm = board.square_mm / _CELLS
    return Places(
        points=cell_mm * (np.stack([column, row], axis=1) + 0.5),
        clearance_mm=cell_mm * far[clear].astype(np.float64),
        dark=dark[clear],
    )


def _cells(board: Board) -> Bool[np.ndarray, "h w"]:
    across, down = (np.arange(round(_CELLS * size / board.square_mm)) + 0.5 for size in board.size_mm)
    points = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2) * (board.square_mm / _CELLS)
    return board.is_dark(points).reshape(len(down), len(across))


def _distance_to_edge(inside: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Distance of each cell that is inside to those that are not, the border of the board included; in cells."""
    framed = np.pad(inside.astype(np.uint8), 1)
    found = cv2.distanceTransform(framed, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    return np.asarray(np.maximum(found - _HALF_CELL, 0))


def _distance_to_step(board: Board, columns: int) -> Float[np.ndarray, "w"]:
    """Distance of each column of cells to the next edge of a step, of those in front of a riser to where that hides
    nothing in a view of 45 degrees; in cells."""
    x = (np.arange(columns) + 0.5) * (board.square_mm / _CELLS)
    nearest = np.full(len(x), np.inf)
    for edge in board.edges_mm[1:-1]:
        gap = np.where(x < edge, edge - board.step_mm - x, x - edge)
        nearest = np.minimum(nearest, np.where(x < edge, np.maximum(gap, 0), gap))
    return np.asarray(nearest * (_CELLS / board.square_mm), dtype=np.float32)


def patches_of(
    image: Pixels,
    camera: Camera,
    cam_from_board: Rigid3,
    board: Board,
    bending_mm: Float[np.ndarray, "3"],
    corner: Int[np.ndarray, "k"],
    places: Places,
    options: PatchOptions,
) -> Patches:
    """The patches of an image around the corners that were found in it."""
    points = points_on_board(board, places.points, bending_mm)
    pixels = camera.project(cam_from_board.apply(points))
    inside = camera.contains(pixels, options.clear_px) & _is_beside_corner(board, corner, places.points)
    scale = _smallest_scale(camera, cam_from_board, points, places.clearance_mm)
    chosen = np.flatnonzero(inside & (places.clearance_mm * scale >= options.clear_px))
    chosen = _spread_samples(chosen, places.dark, options.patches // 2)
    level, variance = _grey(image, pixels[chosen])
    return Patches(
        pixels=np.floor(pixels[chosen]) + 0.5,
        points=points[chosen],
        dark=places.dark[chosen],
        level_dn=level,
        variance_dn2=variance,
    )


def points_on_board(
    board: Board, places: Float[np.ndarray, "n 2"], bending_mm: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3"]:
    """Places seen from straight above, in the frame of the board, mm."""
    return bend_points(board, np.column_stack([places, -board.step_mm * board.terrace_at(places[:, 0])]), bending_mm)


def _is_beside_corner(
    board: Board, corner: Int[np.ndarray, "k"], places: Float[np.ndarray, "n 2"]
) -> Bool[np.ndarray, "n"]:
    """Whether a place lies in one of the squares that meet in a corner that was seen: nothing hides these."""
    away, _ = cKDTree(board.corners[corner, :2]).query(places, p=np.inf)
    return np.asarray(away < board.square_mm)


def _smallest_scale(
    camera: Camera, cam_from_board: Rigid3, points: Float[np.ndarray, "n 3"], step_mm: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Pixels that a millimetre of the board takes in the direction in which it takes fewest."""
    steps = [camera.project(cam_from_board.apply(points + step_mm[:, None] * axis)) for axis in np.eye(3)[:2]]
    here = camera.project(cam_from_board.apply(points))
    x, y = ((there - here) / step_mm[:, None] for there in steps)
    squares, area = (x**2 + y**2).sum(axis=1), np.abs(x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0])
    return np.asarray(np.sqrt(np.maximum(squares - np.sqrt(np.maximum(squares**2 - 4 * area**2, 0)), 0) / 2))


def _spread_samples(chosen: Int[np.ndarray, "n"], dark: Bool[np.ndarray, "m"], most: int) -> Int[np.ndarray, "k"]:
    """So many of paper and of ink at most, spread over all."""
    tones = [chosen[dark[chosen] == tone] for tone in (False, True)]
    return np.concatenate(
        [each[np.unique(np.linspace(0, len(each) - 1, most).astype(int))] for each in tones if len(each)] or [chosen]
    )


def _grey(image: Pixels, pixels: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Mean and variance of the windows at places in an image."""
    column, row = np.floor(pixels).astype(np.int64).T
    windows = image[row[:, None] + _WINDOW[:, 0], column[:, None] + _WINDOW[:, 1]].astype(np.float64)
    left = np.einsum("vw,nwc->nvc", _OFF_PLANE, windows)
    return windows.mean(axis=(1, 2)), (left**2).sum(axis=(1, 2)) / FREEDOM
