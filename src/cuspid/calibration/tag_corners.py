"""Where the corners of the tags of an AprilGrid lie in an image."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree

from cuspid.model.board import Board
from cuspid.model.board.tags import TagGrid, tag_dictionary

_WINDOWS_PX = (3, 43, 4)
"""Sides of the windows in which brightness is compared: the smallest, the largest, and the step between them."""
_LEAST_APART = 0.02
"""Distance of two outlines that are not the same, as a share of their length: the dark squares touch the tags."""
_WINDOW_SHARE, _WINDOW_PX = 0.15, (2, 10)
"""Half the side of the window in which a corner is refined: as a share of the shortest side of its tag, less than its
border is wide; and its limits."""
_REACH = 0.1
"""How far a corner may move when it is refined, as a share of the side of its tag, or else two windows."""
_AROUND, _FAR = 16, 2.0
"""Corners around a tag from which it is foretold where it is, and how far away they may be, in distances of tags."""
_CELL_PX, _WRONG = 6, 3
"""Side of a bit of a tag that is looked at, and bits of it that may be wrong."""
RIGHT, ABOVE = (1, 0), (0, -1)
"""Directions on the board."""
_NEAR, _SO_MANY = 0.4, 0.9
"""Distance of a tag from where it would be, in sides of one; and the share of the tags that must be there."""
_LEAST_CONTRAST_DN = 10.0
_NEIGHBOURS, _LEAST_NEIGHBOURS, _OFF_USUAL, _OFF_PX = 15, 7, 4.0, 0.2
"""Corners around one that tell where it is, at most and at least; a corner that is farther from there than some times
the usual, and some pixels, is left out."""
_RAYS, _RING_SHARE, _RING_PX = 16, 0.12, (2.0, 6.0)
"""Places around a corner at which brightness is compared to both sides of it, and how far from it: as a share of the
side of its tag, and limits."""
_ODD_USUAL, _ODD_SHARE = 2.0, 0.08
"""Difference of the two sides, as a share of the contrast: in usual ones, and added to that."""
_BORDER_PX = 2.0
"""A corner nearer to the border of the image is not used."""

Outline = Float[np.ndarray, "4 2"]


def find_tag_corners(
    image: UInt8[np.ndarray, "h w"], board: Board
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n 2"]] | None:
    """Numbers of the corners of the tags of a board that an image shows, and where they lie to a fraction of a pixel
    (OpenCV's coordinates); None without any. Tags of other ids, and those that are seen twice, are left out.

    The detector is OpenCV's (S. Garrido-Jurado et al., Pattern Recognition 47, 2014, for the tags of E. Olson, ICRA
    2011). What it misses, as the outline of a tag touches the dark squares, is looked for where tags next to it
    foretell it.
    """
    grid = board.tags
    outlines = {tag: each for tag, each in detect_tags(image, grid.border_bits).items() if tag in set(grid.ids.flat)}
    if not outlines or layout_agreement(outlines, grid) < _SO_MANY:
        return None
    found = {tag: each for tag, outline in outlines.items() if (each := _refine_tag(image, outline)) is not None}
    new = found
    while new:
        new = dict(_find_predicted_tags(image, board, found, new))
        found |= new
    if not found:
        return None
    corner = grid.corners_of(np.array(list(found))).ravel()
    pixels = np.concatenate(list(found.values()))
    near = _fits_neighbours(grid.corners[corner], pixels) & _are_saddles(image, np.stack(list(found.values())))
    size = np.array(image.shape[::-1]) - 1
    kept = near & ((pixels > _BORDER_PX) & (pixels < size - _BORDER_PX)).all(axis=1)
    return corner[kept], pixels[kept]


def detect_tags(image: UInt8[np.ndarray, "h w"], border_bits: int) -> dict[int, Outline]:
    """The outlines of all tags of the family that are seen once, by id: clockwise from the bottom right corner."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    parameters.minMarkerDistanceRate = _LEAST_APART
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax, parameters.adaptiveThreshWinSizeStep = (
        _WINDOWS_PX
    )
    found, ids, _ = cv2.aruco.ArucoDetector(tag_dictionary(), parameters).detectMarkers(image)
    if ids is None:
        return {}
    numbers, times = np.unique(ids, return_counts=True)
    once = set(numbers[times == 1].tolist())
    return {
        tag: outline[0].astype(np.float64)
        for tag, outline in zip(ids.ravel().tolist(), found, strict=True)
        if tag in once
    }


def layout_agreement(outlines: Mapping[int, Outline], grid: TagGrid) -> float:
    """Share of the tags beside and above others in an image that are so on the grid, which fewer are where it has other
    columns or begins with another id; 1 where none are."""
    pitch, agree = grid.pitch_mm / grid.tag_mm, list[bool]()
    for tag in outlines:
        right, above = (tag_beside(outlines, tag, step, pitch) for step in (RIGHT, ABOVE))
        if right is not None:
            agree.append(right == tag + 1 and (right - grid.first_id) % grid.columns != 0)
        if above is not None:
            agree.append(above == tag + grid.columns)
    return sum(agree) / len(agree) if agree else 1.0


def tag_beside(outlines: Mapping[int, Outline], tag: int, step: tuple[int, int], pitch: float) -> int | None:
    """The tag whose middle is seen where, by its outline, the next one after a tag is, in a direction on the board
    (across, down); None where none is. ``pitch``: distance of tags, in sides of one."""
    square = np.array([[1, 1], [0, 1], [0, 0], [1, 0]], dtype=np.float32)
    in_tag = cv2.getPerspectiveTransform(outlines[tag].astype(np.float32), square)
    others = [each for each in outlines if each != tag]
    if not others:
        return None
    middles = np.stack([outlines[each].mean(axis=0) for each in others])
    away = np.linalg.norm(cv2.perspectiveTransform(middles[None], in_tag)[0] - 0.5 - pitch * np.array(step), axis=1)
    return others[int(np.argmin(away))] if away.min() < _NEAR else None


def _refine_tag(image: UInt8[np.ndarray, "h w"], outline: Outline) -> Outline | None:
    """The corners of a tag, each where the edges around it meet; None where one of them goes astray."""
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    side = float(np.linalg.norm(outline - np.roll(outline, 1, axis=0), axis=1).min())
    half = int(np.clip(_WINDOW_SHARE * side, *_WINDOW_PX))
    start = outline.astype(np.float32)[:, None]
    found = cv2.cornerSubPix(image, start.copy(), (half, half), (-1, -1), stop)[:, 0].astype(np.float64)
    moved = np.linalg.norm(found - outline, axis=1)
    return found if (moved < max(2.0 * half, _REACH * side)).all() else None


def _find_predicted_tags(
    image: UInt8[np.ndarray, "h w"], board: Board, found: dict[int, Outline], new: dict[int, Outline]
) -> Iterator[tuple[int, Outline]]:
    """Tags beside some new ones, by what has been found around them, if the image shows their bits there."""
    grid = board.tags
    places = grid.corners[grid.corners_of(np.array(list(found))).ravel()]
    pixels, tree = np.concatenate(list(found.values())), cKDTree(places)
    beside = {int(each) for tag in new for each in grid.neighbours(tag)} - set(found)
    for tag in sorted(beside):
        own = grid.corners[grid.corners_of(np.array([tag]))[0]]
        far, near = tree.query(own.mean(axis=0), k=min(_AROUND, len(places)))
        near = near[far < _FAR * grid.pitch_mm]
        if len(near) < 4:
            continue
        homography, _ = cv2.findHomography(places[near], pixels[near])
        if homography is None:
            continue
        predicted = cv2.perspectiveTransform(own[None], homography)[0]
        if not _is_inside(predicted, image):
            continue
        exact = _refine_tag(image, predicted)
        if exact is not None and _is_inside(exact, image) and _shows(image, exact, board.tag_bits(tag)):
            yield tag, exact


def _is_inside(outline: Outline, image: UInt8[np.ndarray, "h w"]) -> bool:
    size = np.array(image.shape[::-1]) - 1
    return bool(((outline > _BORDER_PX) & (outline < size - _BORDER_PX)).all())


def _shows(image: UInt8[np.ndarray, "h w"], outline: Outline, light_bits: Bool[np.ndarray, "b b"]) -> bool:
    """Whether a tag has its bits where its outline says, but for a few."""
    count = len(light_bits)
    side = _CELL_PX * count
    # Clockwise from the bottom right: as the corners of a tag are numbered.
    square = np.array([[side, side], [0, side], [0, 0], [side, 0]], dtype=np.float32) - 0.5
    upright = cv2.getPerspectiveTransform(outline.astype(np.float32), square)
    seen = cv2.warpPerspective(image, upright, (side, side), flags=cv2.INTER_LINEAR)
    level = seen.reshape(count, _CELL_PX, count, _CELL_PX)[:, 1:-1, :, 1:-1].mean(axis=(1, 3))
    dark, light = level[~light_bits].mean(), level[light_bits].mean()
    wrong = ((level > (dark + light) / 2) != light_bits).sum()
    return bool(light - dark > _LEAST_CONTRAST_DN and wrong <= _WRONG)


def _are_saddles(image: UInt8[np.ndarray, "h w"], outlines: Float[np.ndarray, "m 4 2"]) -> Bool[np.ndarray, "n"]:
    """Whether the image is about as much the same to both sides of each corner as is usual: where it is not, another
    edge, or a shadow, has drawn the corner away."""
    sides = np.linalg.norm(outlines - np.roll(outlines, 1, axis=1), axis=2).min(axis=1)
    angle = 2 * np.pi * np.arange(_RAYS) / _RAYS
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    reach = np.clip(_RING_SHARE * sides, *_RING_PX)[:, None, None, None] * np.array([0.5, 1.0])[:, None, None]
    places = (outlines[:, :, None, None] + (reach * ring)[:, None]).reshape(-1, 2 * _RAYS, 2).astype(np.float32)
    smooth = cv2.GaussianBlur(image, (3, 3), 0).astype(np.float32)
    level = cv2.remap(smooth, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    level = level.reshape(len(level), 2, _RAYS)
    apart = np.abs(level - np.roll(level, _RAYS // 2, axis=2)).mean(axis=(1, 2))
    share = apart / np.maximum(np.ptp(level, axis=(1, 2)), 1.0)
    return np.asarray(share <= _ODD_USUAL * np.median(share) + _ODD_SHARE)


def _fits_neighbours(places: Float[np.ndarray, "n 2"], pixels: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
    """Whether each corner lies where the homography of those next to it on the board has it, to some times what is
    usual: at the border of an image, or of a shadow, some do not."""
    count = min(_NEIGHBOURS, len(places) - 1)
    if count < _LEAST_NEIGHBOURS:
        return np.ones(len(places), dtype=bool)
    off = np.empty(len(places))
    for k, near in enumerate(cKDTree(places).query(places, k=count + 1)[1][:, 1:]):
        homography, _ = cv2.findHomography(places[near], pixels[near], cv2.LMEDS)
        if homography is None:
            off[k] = np.inf
            continue
        predicted = cv2.perspectiveTransform(places[k].reshape(1, 1, 2), homography)
        off[k] = np.linalg.norm(predicted - pixels[k])
    return np.asarray(off <= _OFF_USUAL * np.median(off) + _OFF_PX)
