"""Where the circles of a board lie in an image, and how far the middle of what is seen of a circle is from where its
centre is.

A circle is seen as an ellipse, whose middle is not where its centre is projected to, where it is seen obliquely or
through a lens that bends it (J. Heikkilae, IEEE PAMI 22, 2000). What is measured is the centroid of the dark area; what
it is off follows from the outline of the circle, projected by the camera, once that is known about.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial import cKDTree

from cuspid.calibration.lattice import Cell, openings
from cuspid.geometry import Rigid3
from cuspid.model.board import Board, BoardKind
from cuspid.model.camera import Camera

_WINDOWS = (0.04, 0.12)
"""Sides of the windows in which brightness is compared, as shares of the larger side of the image."""
_CONTRAST_DN = 4.0
"""What is dark is darker by this than the mean around it."""
_LEAST_PX2, _LARGEST = 16.0, 0.05
"""Area of a blob: at least, and at most as a share of the image."""
_ROUND, _COARSE = 0.025, 1.5
"""Difference of the area of a blob from that of the ellipse with the same moments, as a share, at most (a square has
0.045), and how much that grows with one over its area in px."""
_LEAST_AXIS = 0.2
"""Lesser axis of a blob, as a share of the greater, at least."""
_MOST, _FEWEST = 2000, 9
"""Blobs that are looked at, and those that can be a board."""
_SEEDS, _NEIGHBOURS = 40, 10
"""Blobs from which a lattice is begun, and those around one among which the next ones in it are sought."""
_ASIDE, _ALIKE, _ASKEW = 0.3, 2.5, 0.3
"""A blob lies so near to where the step before leads, as a share of that step; ratio of the areas of neighbours; sine
of the angle between the two directions."""
_ENOUGH, _STRAY = 0.6, 0.1
"""Share of the circles that must be found, and of those of a lattice that may be none."""
_RING = 1.5
"""Radius up to which paper is looked at around a circle, in those of the circle, at most: half way to the next one."""
_FROM_BORDER_PX = 1.5
"""Distance of a circle from the border of the image, at least: one that is cut off has another middle."""
_OUTLINE = 72
"""Places on the outline of a circle."""
_ROUNDS = 3
_CORE, _LARGE_PX = 0.5, 4.0
"""Share of a radius within which it is as dark as the ink, in circles of this radius and more."""
_CROSS = 5
"""Circles that tell how large the grid is about one of them: itself and its neighbours."""


@dataclass(frozen=True, eq=False)
class _Blobs:
    """Dark areas that are ellipses."""

    pixels: Float[np.ndarray, "n 2"]
    """Middles, OpenCV's coordinates."""
    spread: Float[np.ndarray, "n 2 2"]
    """Covariance of the places in each: a quarter of the squares of the half axes."""


def find_circles(
    image: UInt8[np.ndarray, "h w"], board: Board
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n 2"]] | None:
    """Numbers of the circles of a board that is seen from border to border, and the centroids of what is seen of them
    (OpenCV's coordinates); None where there is no such board. Some circles may be hidden."""
    found = _measure_circles(image, board)
    return None if found is None else found[:2]


def measure_circle_share(image: UInt8[np.ndarray, "h w"], board: Board) -> float | None:
    """Diameter of the circles that an image shows, as a share of the distance to the nearest one, by the area of each
    and how large the grid is there; None where it does not show the board, or they are small."""
    found = _measure_circles(image, board)
    if found is None or np.isnan(found[2]).all():
        return None
    numbers, pixels, areas = found
    places = board.corners[numbers, :2]
    shares = []
    for near, area in zip(cKDTree(places).query(places, k=_CROSS)[1], areas, strict=True):
        design = np.pad(places[near], ((0, 0), (0, 1)), constant_values=1.0)
        linear = np.linalg.lstsq(design, pixels[near], rcond=None)[0][:2]
        shares.append(np.sqrt(area / (np.pi / 4 * board.circle_mm**2 * abs(np.linalg.det(linear)))))
    return float(board.circle_share * np.nanmedian(shares))


def _measure_circles(
    image: UInt8[np.ndarray, "h w"], board: Board
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]] | None:
    """Numbers, centroids and areas (px) of circles."""
    blobs = _find_blobs(image)
    found = _number_circles(_largest_lattice(blobs), board)
    if found is None:
        return None
    numbers, chosen = found
    gap = cKDTree(blobs.pixels[chosen]).query(blobs.pixels[chosen], k=2)[0][:, 1]
    exact = np.stack(
        [_centroid(image, blobs.pixels[k], blobs.spread[k], far) for k, far in zip(chosen, gap, strict=True)]
    )
    known = np.isfinite(exact[:, :2]).all(axis=1)
    return numbers[known], exact[known, :2], exact[known, 2]


def recognize_grid(image: UInt8[np.ndarray, "h w"]) -> tuple[BoardKind, int, int] | None:
    """The kind of grid of circles that an image shows, its columns and its rows, the greater number first where it has
    both; None where it shows none."""
    cells = _largest_lattice(_find_blobs(image))
    best: tuple[float, BoardKind, int, int] = (0.0, "circles", 0, 0)
    for turn in _TURNS:
        place = np.array(list(cells)).reshape(-1, 2) @ turn.T
        if not len(place):
            return None
        columns, rows = (np.ptp(place, axis=0) + 1).tolist()
        best = max(best, (len(place) / (columns * rows), "circles", max(columns, rows), min(columns, rows)))
        x, y = place[:, 0] - place[:, 1], place[:, 0] + place[:, 1]
        x, y = x - x.min(), y - y.min()
        columns, rows = int(np.ptp(x[y % 2 == 0]) // 2 + 1), int(y.max() + 1)
        if np.ptp(x) + 1 == 2 * columns and ((x + y) % 2 == 0).all():
            best = max(best, (len(place) / (columns * rows), "asymmetric-circles", columns, rows))
    share, kind, columns, rows = best
    return (kind, columns, rows) if share > 1 - _STRAY and min(columns, rows) > 2 else None


# --- which circle is which ---------------------------------------------------------------------------------------


def _largest_lattice(blobs: _Blobs) -> dict[Cell, int]:
    """Blobs that continue each other in two directions, by cell; the cells run as the image does, not mirrored."""
    best = dict[Cell, int]()
    if len(blobs.pixels) < _FEWEST:
        return best
    tree = cKDTree(blobs.pixels)
    tried = np.zeros(len(blobs.pixels), dtype=bool)
    order = np.argsort(np.linalg.norm(blobs.pixels - np.median(blobs.pixels, axis=0), axis=1))
    for seed in order[:_SEEDS].tolist():
        start = {} if tried[seed] else _cross_at(blobs, tree, seed)
        if start:
            cells = _fill_lattice(blobs, tree, _grow_lattice(blobs, tree, start))
            tried[list(cells.values())] = True
            best = max(best, cells, key=len)
    return best


def _cross_at(blobs: _Blobs, tree: cKDTree, seed: int) -> dict[Cell, int]:
    """A blob with those to both sides of it in the two directions in which the next ones are nearest; nothing where
    there are none."""
    here = blobs.pixels[seed]
    pairs: list[tuple[Float[np.ndarray, "2"], int, int]] = []
    for ahead in tree.query(here, k=min(_NEIGHBOURS + 1, len(blobs.pixels)))[1][1:].tolist():
        step = blobs.pixels[ahead] - here
        behind = _nearest(blobs, tree, here - step, float(np.linalg.norm(step)), seed)
        if behind is None or not _is_alike(blobs, ahead, seed):
            continue
        if all(abs(_sine(step, other)) > _ASKEW for other, _, _ in pairs):
            pairs.append((step, ahead, behind))
        if len(pairs) == 2:
            (first, right, left), (second, below, above) = pairs
            if _sine(first, second) < 0:
                below, above = above, below
            return {(0, 0): seed, (1, 0): right, (-1, 0): left, (0, 1): below, (0, -1): above}
    return {}


def _grow_lattice(blobs: _Blobs, tree: cKDTree, cells: dict[Cell, int]) -> dict[Cell, int]:
    """A lattice with all that continues it."""
    cells, used, growing = dict(cells), set(cells.values()), True
    while growing:
        growing = False
        for (cell, before), place in openings(cells, blobs.pixels):
            step = float(np.linalg.norm(place - blobs.pixels[cells[before]]))
            found = _nearest(blobs, tree, place, step, cells[before])
            if found is not None and found not in used and cell not in cells:
                cells[cell] = found
                used.add(found)
                growing = True
    return cells


def _fill_lattice(blobs: _Blobs, tree: cKDTree, cells: dict[Cell, int]) -> dict[Cell, int]:
    """A lattice with what lies beyond hidden circles, where the affine map of the cells next to it has it."""
    cells, found = dict(cells), True
    while found:
        places, pixels = np.array(list(cells)), blobs.pixels[list(cells.values())]
        used, found = set(cells.values()), False
        for cell in _empty_neighbours(cells):
            near = np.argsort(np.linalg.norm(places - cell, axis=1), kind="stable")[:_NEIGHBOURS]
            design = np.pad(places[near].astype(np.float64), ((0, 0), (0, 1)), constant_values=1.0)
            if np.linalg.matrix_rank(design) < 3:
                continue
            affine = np.linalg.lstsq(design, pixels[near], rcond=None)[0]
            step_px = float(np.linalg.norm(affine[:2], axis=1).min())
            blob = _nearest(blobs, tree, np.array([*cell, 1.0]) @ affine, step_px, cells[_to_cell(places[near[0]])])
            if blob is not None and blob not in used:
                cells[cell] = blob
                used.add(blob)
                found = True
    return cells


def _empty_neighbours(cells: dict[Cell, int]) -> list[Cell]:
    """The empty cells beside those of a lattice."""
    beside = {(i + di, j + dj) for i, j in cells for di in (-1, 0, 1) for dj in (-1, 0, 1)}
    return sorted(beside - set(cells))


def _to_cell(place: Int[np.ndarray, "2"]) -> Cell:
    return int(place[0]), int(place[1])


def _nearest(blobs: _Blobs, tree: cKDTree, place: Float[np.ndarray, "2"], step_px: float, like: int) -> int | None:
    """The blob nearest to where one should be; None if it is too far, or of another size than one beside it."""
    away, found = tree.query(place, distance_upper_bound=_ASIDE * step_px)
    return int(found) if np.isfinite(away) and _is_alike(blobs, int(found), like) else None


def _is_alike(blobs: _Blobs, one: int, other: int) -> bool:
    """Whether two blobs are about as large as each other."""
    ratio = np.linalg.det(blobs.spread[one]) / np.linalg.det(blobs.spread[other])
    return bool(_ALIKE**-2 < ratio < _ALIKE**2)


def _sine(one: Float[np.ndarray, "2"], other: Float[np.ndarray, "2"]) -> float:
    """Of the angle from a direction to another."""
    return float((one[0] * other[1] - one[1] * other[0]) / (np.linalg.norm(one) * np.linalg.norm(other)))


def _number_circles(cells: dict[Cell, int], board: Board) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]] | None:
    """Numbers of the circles of a lattice that reaches from border to border of the board, and the blobs that they are,
    whatever the two directions in which the lattice has grown; None where it is none of the board."""
    if len(cells) < _ENOUGH * len(board.corners):
        return None
    number = {cell: k for k, cell in enumerate(_cells_of(board))}
    own, place = np.array(list(number)), np.array(list(cells))
    low, high = own.min(axis=0), own.max(axis=0)
    best: dict[int, int] = {}
    for turn in _TURNS:
        turned = place @ turn.T
        turned += low - turned.min(axis=0)
        if (turned.max(axis=0) != high).any():
            continue
        found = {
            number[cell]: blob
            for cell, blob in zip(map(tuple, turned.tolist()), cells.values(), strict=True)
            if cell in number
        }
        best = max(best, found, key=len)
    if len(best) < max(_ENOUGH * len(number), (1 - _STRAY) * len(cells)):
        return None
    return np.array(list(best)), np.array(list(best.values()))


def _cells_of(board: Board) -> list[Cell]:
    """Of the circles of a board, in order, along its rows and columns, or the diagonals where rows are shifted."""
    places = np.rint(board.corners[:, :2] / board.square_mm).astype(np.int64)
    if board.kind == "asymmetric-circles":
        x, y = places.T
        places = np.stack([(x + y) // 2, (y - x) // 2], axis=1)
    return [(int(i), int(j)) for i, j in places]


_TURNS = [np.array([[a, b], [c, d]]) for a, b, c, d in product(range(-2, 3), repeat=4) if a * d - b * c == 1]
"""From the directions in which a lattice has grown to others that it has, without mirroring it."""


# --- where it is -------------------------------------------------------------------------------------------------


def _find_blobs(image: UInt8[np.ndarray, "h w"]) -> _Blobs:
    """Without those that lie in a greater one, or are the same as another."""
    pixels, spread = np.zeros((0, 2)), np.zeros((0, 2, 2))
    for share in _WINDOWS:
        side = 2 * int(share * max(image.shape) / 2) + 3
        smooth = cv2.GaussianBlur(image, (3, 3), 0)
        dark = cv2.adaptiveThreshold(smooth, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, side, _CONTRAST_DN)
        contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        found = [each for each in map(_ellipse, contours) if each is not None]
        found = [each for each in found if each[2] < _LARGEST * image.size and _is_at(dark, each[0])][:_MOST]
        for middle, moments, area in sorted(found, key=lambda each: -each[2]):
            if not len(pixels) or np.linalg.norm(pixels - middle, axis=1).min() > np.sqrt(area / np.pi) / 2:
                pixels, spread = np.vstack([pixels, middle]), np.concatenate([spread, moments[None]])
    return _Blobs(pixels, spread)


def _is_at(mask: UInt8[np.ndarray, "h w"], place: Float[np.ndarray, "2"]) -> bool:
    column, row = np.rint(place).astype(int)
    return bool(mask[row, column])


def _ellipse(
    contour: Int[np.ndarray, "n 1 2"],
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"], float] | None:
    """Middle, covariance and area of what is within a contour, if it is an ellipse."""
    if len(contour) < 8:
        return None
    moments = cv2.moments(contour)
    area = moments["m00"]
    if area < _LEAST_PX2:
        return None
    spread = np.array([[moments["mu20"], moments["mu11"]], [moments["mu11"], moments["mu02"]]]) / area
    least, most = np.linalg.eigvalsh(spread)
    if least < _LEAST_AXIS**2 * most or abs(area / (4 * np.pi * np.sqrt(least * most)) - 1) > _ROUND + _COARSE / area:
        return None
    return np.array([moments["m10"], moments["m01"]]) / area, spread, float(area)


def _centroid(
    image: UInt8[np.ndarray, "h w"], middle: Float[np.ndarray, "2"], spread: Float[np.ndarray, "2 2"], gap_px: float
) -> Float[np.ndarray, "3"]:
    """Where the centroid of a blob is, and its area; NaN where not all of it is seen, or too little paper around it,
    and for the area of a small one."""
    reach = 2 * np.sqrt(np.diag(spread)) + _FROM_BORDER_PX
    if (middle < reach).any() or (middle > np.array(image.shape[::-1]) - 1 - reach).any():
        return np.full(3, np.nan)
    longest = 2 * float(np.sqrt(np.linalg.eigvalsh(spread)[1]))
    ring = max(min(_RING, (gap_px - longest) / longest), 1.0) + 2.0 / longest
    for _ in range(_ROUNDS):
        low = np.maximum(np.floor(middle - ring * longest).astype(int), 0)
        high = np.minimum(np.ceil(middle + ring * longest).astype(int) + 1, image.shape[::-1])
        column, row = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        places = np.stack([column, row], axis=-1).reshape(-1, 2).astype(np.float64)
        values = image[low[1] : high[1], low[0] : high[0]].ravel().astype(np.float64)
        away = places - middle
        radius = np.sqrt(np.einsum("ni,ij,nj->n", away, np.linalg.inv(spread), away)) / 2
        paper = (radius < ring) & (radius > 1 + 1.5 / longest)
        if paper.sum() < 8:
            return np.full(3, np.nan)
        ground = np.column_stack([np.ones(len(away)), away])
        plane = np.linalg.lstsq(ground[paper], values[paper], rcond=None)[0]
        inside = radius < ring
        darker = (ground[inside] @ plane) - values[inside]
        shift = darker @ away[inside] / darker.sum()
        middle = middle + shift
    contrast = plane[0] - np.median(values[radius < _CORE]) if longest > _LARGE_PX else np.nan
    return np.array([*middle, darker.sum() / contrast])


def centre_shifts(
    camera: Camera, cam_from_board: Rigid3, board: Board, corner: Int[np.ndarray, "n"]
) -> Float[np.ndarray, "n 2"]:
    """How far the centroids of what a camera sees of some circles lie from where their centres are projected to, px;
    zeros where it does not show all of a circle."""
    angle = 2 * np.pi * np.arange(_OUTLINE) / _OUTLINE
    # A polygon of the area of the circle.
    radius = board.circle_mm / 2 * np.sqrt(2 * np.pi / _OUTLINE / np.sin(2 * np.pi / _OUTLINE))
    rim = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    centres = board.corners[corner]
    outlines = camera.project(cam_from_board.apply((centres[:, None] + rim).reshape(-1, 3))).reshape(-1, _OUTLINE, 2)
    at = camera.project(cam_from_board.apply(centres))
    return np.asarray(np.nan_to_num(_centroids(outlines - at[:, None])))


def _centroids(polygons: Float[np.ndarray, "n k 2"]) -> Float[np.ndarray, "n 2"]:
    """Of the areas of polygons."""
    after = np.roll(polygons, -1, axis=1)
    cross = polygons[..., 0] * after[..., 1] - polygons[..., 1] * after[..., 0]
    moment = ((polygons + after) * cross[..., None]).sum(axis=1)
    return np.asarray(moment / (3 * cross.sum(axis=1)[:, None]))
