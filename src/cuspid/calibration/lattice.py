"""A plain chessboard that is bent by a strong lens, or of which glare hides a part: saddles that continue each other.

Where four squares meet, brightness is a saddle: its Hessian has a negative determinant, the two directions in which it
does not curve are those of the edges, and the diagonal along which it rises is that of the bright squares, which
changes from each corner to the next. From a corner the lattice is grown to where the step before leads, so that only
the next step needs to be straight. It is the board if it is as large as it; some of its corners may be missing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree

from cuspid.geometry import unit
from cuspid.model.board import Board

_SIGMA_PX = 1.2
"""Standard deviation of the blur before derivatives are taken."""
_MOST, _SEEDS = 400, 25
"""Saddles that are looked at, strongest first; and those from which a lattice is begun."""
_WEAKEST, _LEAST_ROUND = 0.12, 0.25
"""Response of a saddle relative to the strong ones, and its lesser curvature relative to the greater, at least."""
_RING_PX, _LEAST_GAP = 2.5, 0.3
"""Brightness is compared so far from a corner; the darker of the bright squares is brighter than the brighter of the
dark ones by this share of all contrast."""
_NEAREST_PX, _FARTHEST = 3.0, 0.25
"""Distance of neighbouring corners: at least, and at most as a share of the image."""
_ASIDE = 0.35
"""A corner lies so near to where the step before leads, as a share of that step."""
_TURNED = 0.5
"""Sine of the angle between the bright diagonals of neighbouring corners, at least."""
_ENOUGH = 0.6
"""Share of the corners that must be found."""
_EXPLAINED = 0.8
"""Share of the saddles within a lattice that are its own, at least."""
_WINDOW = 0.35
"""Half the side of the window in which a corner is refined, as a share of the distance of corners."""
_EVENED_SHARE, _DARK_DN, _DARK_SHARE = 0.04, 8.0, 0.15
"""Standard deviation of the mean around a pixel, as a share of the image; what counts as black: at least this, and this
share of what is bright."""
_STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))

Cell = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Saddles:
    """Saddle points of an image, strongest first."""

    pixels: Float[np.ndarray, "n 2"]
    """OpenCV's coordinates: the centre of the first pixel is (0, 0)."""
    axes: Float[np.ndarray, "n 2 2"]
    """Unit vectors along the two edges."""
    bright: Float[np.ndarray, "n 2"]
    """Unit vectors along the diagonal of the bright squares."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """Corners that continue each other."""

    cells: Int[np.ndarray, "n 2"]
    """Column and row of each, from 0 on, in axes that turn as those of the image do."""
    saddles: Saddles
    """Their saddles, in the same order."""
    image: UInt8[np.ndarray, "h w"]
    """In which they were found."""

    @property
    def size(self) -> tuple[int, int]:
        """Number of columns and rows, the greater first."""
        greater, lesser = sorted((self.cells.max(axis=0) + 1).tolist(), reverse=True)
        return greater, lesser

    def number_corners(self, board: Board) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n 2"]] | None:
        """Numbers of the corners on a board that is as large, and where they lie to a fraction of a pixel (OpenCV's
        coordinates); None where the colours of its squares are others."""
        columns, rows, place = board.columns - 1, board.rows - 1, self.cells
        for _ in range(4):
            if tuple(place.max(axis=0) + 1) == (columns, rows) and _is_coloured_so(place, self.saddles, board):
                return place[:, 1] * columns + place[:, 0], _refine_corners(self.image, self.saddles.pixels)
            place = np.stack([place[:, 1].max() - place[:, 1], place[:, 0]], axis=1)  # a quarter turn
        return None


def find_lattice(image: UInt8[np.ndarray, "h w"]) -> Lattice | None:
    """The largest lattice in an image, without what stands out of its rectangle; None where there is none of 2 x 2."""
    even = _equalize_contrast(image)
    saddles = find_saddles(even)
    if not len(saddles.pixels):
        return None
    tree = cKDTree(saddles.pixels)
    tried, best = np.zeros(len(saddles.pixels), dtype=bool), dict[Cell, int]()
    for seed in range(min(_SEEDS, len(tried))):
        if not tried[seed]:
            cells = _grow_lattice(saddles, tree, seed, _FARTHEST * max(image.shape))
            tried[list(cells.values())] = True
            best = max(best, cells, key=len)
    place, chosen = np.array(list(best)), np.array(list(best.values()))
    kept = _within_rectangle(place)
    place, chosen = place[kept], chosen[kept]
    if len(place) < 4 or np.ptp(place, axis=0).min() < 1 or not _explains(saddles.pixels, chosen):
        return None
    own = Saddles(saddles.pixels[chosen], saddles.axes[chosen], saddles.bright[chosen])
    return Lattice(place - place.min(axis=0), own, image)


def is_as_large(lattice: Lattice, board: Board) -> bool:
    """Whether a lattice reaches from border to border of a board, and has enough of its corners."""
    corners = board.columns - 1, board.rows - 1
    return lattice.size == (max(corners), min(corners)) and len(lattice.cells) >= _ENOUGH * corners[0] * corners[1]


def is_larger(lattice: Lattice, board: Board) -> bool:
    """Whether a lattice, of which enough is there, is larger than a board."""
    (columns, rows), (greater, lesser) = lattice.size, sorted((board.columns - 1, board.rows - 1), reverse=True)
    over = columns >= greater and rows >= lesser and (columns, rows) != (greater, lesser)
    return over and len(lattice.cells) >= _ENOUGH * columns * rows


def _equalize_contrast(image: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """Relative to the mean around each pixel, as a lamp close by lights places differently; what is almost black stays
    so."""
    values = image.astype(np.float32)
    black = max(_DARK_DN, _DARK_SHARE * float(np.percentile(image, 99)))
    around = np.maximum(cv2.GaussianBlur(values, (0, 0), _EVENED_SHARE * max(image.shape)), black)
    return np.clip(128 * values / around, 0, 255).astype(np.uint8)


def _explains(pixels: Float[np.ndarray, "n 2"], chosen: Int[np.ndarray, "k"]) -> bool:
    """Whether a lattice has most of the saddles that lie within it: among many some continue each other by chance."""
    hull = cv2.convexHull(pixels[chosen].astype(np.float32))
    inside = sum(cv2.pointPolygonTest(hull, tuple(each), measureDist=False) >= 0 for each in pixels.tolist())
    return len(chosen) > _EXPLAINED * inside


def _within_rectangle(place: Int[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
    """Without the lines of cells at the border of a lattice of which less than a half is there."""
    kept = np.ones(len(place), dtype=bool)
    while kept.any():
        inside = place[kept]
        low, high = inside.min(axis=0), inside.max(axis=0)
        lines = [
            (float(np.sum(inside[:, axis] == at)) / (high[1 - axis] - low[1 - axis] + 1), axis, at)
            for axis in (0, 1)
            for at in (low[axis], high[axis])
        ]
        share, axis, at = min(lines)
        if share >= 0.5:
            break
        kept &= place[:, axis] != at
    return kept


def find_saddles(image: UInt8[np.ndarray, "h w"]) -> Saddles:
    """Where brightness is a saddle."""
    values = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _SIGMA_PX)
    ix, iy = (cv2.Sobel(values, cv2.CV_32F, *by, ksize=3) / 8 for by in _STEPS[:2])
    ixx, ixy = (cv2.Sobel(ix, cv2.CV_32F, *by, ksize=3) / 8 for by in _STEPS[:2])
    iyy = cv2.Sobel(iy, cv2.CV_32F, *_STEPS[1], ksize=3) / 8
    response = ixy * ixy - ixx * iyy
    peak = (response == cv2.dilate(response, np.ones((5, 5), np.uint8))) & (response > 0)
    row, column = np.nonzero(peak)
    strength = response[row, column]
    order = np.argsort(-strength, kind="stable")[:_MOST]
    if len(order):
        order = order[strength[order] > _WEAKEST * np.median(strength[order[:_SEEDS]])]
    if not len(order):
        return Saddles(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 2)))
    row, column = row[order], column[order]
    hessian = np.stack([[ixx[row, column], ixy[row, column]], [ixy[row, column], iyy[row, column]]]).transpose(2, 0, 1)
    hessian = hessian.astype(np.float64)
    gradient = np.stack([ix[row, column], iy[row, column]], axis=1).astype(np.float64)
    shift = -np.linalg.solve(hessian, gradient[..., None])[..., 0]
    curvature, vectors = np.linalg.eigh(hessian)
    round_ = np.abs(curvature).min(axis=1) > _LEAST_ROUND * np.abs(curvature).max(axis=1)
    row, column, shift, curvature, vectors = (each[round_] for each in (row, column, shift, curvature, vectors))
    falls, rises = vectors[:, :, 0], vectors[:, :, 1]
    # d^T H d = 0 for d = sqrt(l2) falls +- sqrt(-l1) rises
    along = np.sqrt(np.maximum(curvature[:, 1:], 0)) * falls
    across = np.sqrt(np.maximum(-curvature[:, :1], 0)) * rises
    axes = np.stack([along + across, along - across], axis=1)
    axes /= np.maximum(np.linalg.norm(axes, axis=2, keepdims=True), 1e-12)
    pixels = np.stack([column, row], axis=1) + np.clip(shift, -1.5, 1.5)
    four = _have_four_squares(values, pixels, falls, rises)
    return Saddles(pixels[four], axes[four], rises[four])


def _have_four_squares(
    values: Float[np.ndarray, "h w"],
    pixels: Float[np.ndarray, "n 2"],
    falls: Float[np.ndarray, "n 2"],
    rises: Float[np.ndarray, "n 2"],
) -> Bool[np.ndarray, "n"]:
    """Whether there are two dark and two bright squares about each saddle: on the border of a board there is one dark
    one only."""
    around = np.stack([pixels + sign * _RING_PX * each for each in (falls, rises) for sign in (1, -1)])
    if not len(pixels):
        return np.zeros(0, dtype=bool)
    x, y = np.moveaxis(around.astype(np.float32), -1, 0)
    dark_1, dark_2, bright_1, bright_2 = cv2.remap(values, x, y, cv2.INTER_LINEAR)
    least, most = np.minimum(bright_1, bright_2), np.maximum(dark_1, dark_2)
    spread = np.maximum(bright_1, bright_2) - np.minimum(dark_1, dark_2)
    return np.asarray(least - most > _LEAST_GAP * spread)


def _grow_lattice(saddles: Saddles, tree: cKDTree, seed: int, farthest_px: float) -> dict[Cell, int]:
    """The lattice about a saddle, by cell."""
    first, second = saddles.axes[seed]
    second = second if _cross(first, second) > 0 else -second
    cells, used = {(0, 0): seed}, {seed}
    for step, direction in zip(_STEPS, (first, second, -first, -second), strict=True):
        found = _next_saddle(saddles, tree, seed, direction, farthest_px)
        if found is not None and found not in used:
            cells[step] = found
            used.add(found)
    growing = True
    while growing:
        growing = False
        for cell, place in openings(cells, saddles.pixels):
            step = place - saddles.pixels[cells[cell[1]]]
            near = [
                each
                for each in tree.query_ball_point(place, _ASIDE * float(np.linalg.norm(step)))
                if each not in used and _alternate(saddles, each, cells[cell[1]])
            ]
            if near and cell[0] not in cells:
                best = min(near, key=lambda each: float(np.linalg.norm(saddles.pixels[each] - place)))
                cells[cell[0]] = best
                used.add(best)
                growing = True
    return cells


Opening = tuple[tuple[Cell, Cell], Float[np.ndarray, "2"]]
"""An empty cell with the one before it, and where its corner would be."""


def openings(cells: dict[Cell, int], pixels: Float[np.ndarray, "n 2"]) -> Iterator[Opening]:
    """The empty cells beside two that follow each other, of a lattice of some points, by cell."""
    for (i, j), here in list(cells.items()):
        for di, dj in _STEPS:
            before, after = (i - di, j - dj), (i + di, j + dj)
            if before in cells and after not in cells:
                yield (after, (i, j)), 2 * pixels[here] - pixels[cells[before]]
        for di, dj in _STEPS:  # as far as beside it
            for ei, ej in ((-dj, di), (dj, -di)):
                beside, beyond = (i + ei, j + ej), (i + ei + di, j + ej + dj)
                after = (i + di, j + dj)
                if after not in cells and beside in cells and beyond in cells:
                    step = pixels[cells[beyond]] - pixels[cells[beside]]
                    yield (after, (i, j)), pixels[here] + step


def _next_saddle(
    saddles: Saddles, tree: cKDTree, here: int, direction: Float[np.ndarray, "2"], farthest_px: float
) -> int | None:
    """The nearest saddle in a direction whose bright squares are the other ones."""
    near = np.array(tree.query_ball_point(saddles.pixels[here], farthest_px), dtype=np.int64)
    away = saddles.pixels[near] - saddles.pixels[here]
    length = np.linalg.norm(away, axis=1)
    ahead = (length > _NEAREST_PX) & (away @ direction > 0.94 * length)
    chosen = [each for each in near[ahead][np.argsort(length[ahead])].tolist() if _alternate(saddles, here, each)]
    return chosen[0] if chosen else None


def _alternate(saddles: Saddles, one: int, other: int) -> bool:
    """Whether the bright squares of two saddles lie along different diagonals."""
    return abs(_cross(saddles.bright[one], saddles.bright[other])) > _TURNED


def _cross(one: Float[np.ndarray, "2"], other: Float[np.ndarray, "2"]) -> float:
    return float(one[0] * other[1] - one[1] * other[0])


def _is_coloured_so(place: Int[np.ndarray, "n 2"], saddles: Saddles, board: Board) -> bool:
    """Whether most corners have their bright squares where the board has."""
    at = {(column, row): number for number, (column, row) in enumerate(place.tolist())}
    dark = board.is_dark(board.square_mm * (place + 0.5))  # of the square before the corner, along both axes
    votes = 0
    for (column, row), number in at.items():
        right, below = at.get((column + 1, row)), at.get((column, row + 1))
        if right is None or below is None:
            continue
        along, down = unit(saddles.pixels[[right, below]] - saddles.pixels[number])
        before, beside = unit(np.stack([along + down, along - down])) @ saddles.bright[number]
        votes += 1 if (abs(before) > abs(beside)) != dark[number] else -1
    return votes > 0


def _refine_corners(image: UInt8[np.ndarray, "h w"], pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """To a fraction of a pixel, in windows that hold no other corner."""
    spacing = float(np.median(cKDTree(pixels).query(pixels, k=2)[0][:, 1]))
    half = int(np.clip(_WINDOW * spacing, 2, 11))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    start = pixels.astype(np.float32)[:, None].copy()
    found = cv2.cornerSubPix(image, start, (half, half), (-1, -1), stop)[:, 0]
    moved = np.linalg.norm(found - pixels, axis=1)
    return np.where((moved < half)[:, None], found, pixels).astype(np.float64)
