"""The examination of frames (thesis 4.1.1): does a homography between consecutive frames look like a hand's motion?

Frames: ``fixed_from_moving`` maps pixels of the moving frame to those of the fixed one. The moving frame's corners are
warped by it; then its inner angles, the shift of its centre and its scale are held against limits.

The thesis asks for "both ratio of the scale and translation together ... not less than 0.85 and not more than 5 %",
which cannot be meant as printed (the translation may be 10 % by the test before). It is read as: the scale lies between
0.85 and 1 / 0.85.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float

from cuspid.runtime.options import Options, Range


@dataclass(frozen=True, kw_only=True)
class ExaminationOptions(Options):
    """What the homography between consecutive frames may do; the defaults are those of the thesis."""

    min_angle_deg: Annotated[float, Range(0, 90)] = 80.0
    """Smallest inner angle at a warped corner."""
    max_angle_deg: Annotated[float, Range(90, 180)] = 110.0
    """Largest inner angle at a warped corner."""
    max_translation: Annotated[float, Range(0.001, 100)] = 0.10
    """Largest shift of the frame's centre, as a share (0 to 1) of the fixed frame's width and of its height."""
    min_scale: Annotated[float, Range(0.001, 0.999)] = 0.85
    """Smallest scale (square root of the ratio of areas); the largest is 1 over this."""


def frame_corners(size: tuple[int, int]) -> Float[np.ndarray, "4 2"]:
    """Corners of a frame of a width and height in px, around it from the upper left one."""
    width, height = size
    return np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])


def warp(homographies: Float[np.ndarray, "*n 3 3"], points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Points under homographies of positive determinant; NaN at and beyond the horizon."""
    moved = np.einsum("...ij,...j->...i", homographies[..., :2], points) + homographies[..., 2]
    scale = moved[..., 2:]
    return np.asarray(moved[..., :2] / np.where(scale > 0, scale, np.nan))


def inner_angles_deg(corners: Float[np.ndarray, "4 2"]) -> Float[np.ndarray, "4"]:
    """Inner angles of a quadrilateral in the order of :func:`frame_corners`, 0 to 360; 270 where it is dented."""
    after, before = np.roll(corners, -1, axis=0) - corners, np.roll(corners, 1, axis=0) - corners
    angle = np.arctan2(before[:, 1], before[:, 0]) - np.arctan2(after[:, 1], after[:, 0])
    return np.asarray(np.rad2deg(angle) % 360)


def area(corners: Float[np.ndarray, "4 2"]) -> float:
    """Area of a quadrilateral in the order of :func:`frame_corners`; negative where it is turned over."""
    x, y = corners.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def scale_of(corners: Float[np.ndarray, "4 2"], size: tuple[int, int]) -> float:
    """Root of the area relative to a frame's; 0 where it is turned over or beyond the horizon (NaN)."""
    covered = area(corners)
    return float(np.sqrt(covered / (size[0] * size[1]))) if covered > 0 else 0.0


def examine(
    fixed_from_moving: Float[np.ndarray, "3 3"], size: tuple[int, int], options: ExaminationOptions
) -> tuple[str, ...]:
    """Why the moving frame must not be used, one named reason for each test that it fails; empty where it passes."""
    corners = warp(np.broadcast_to(fixed_from_moving, (4, 3, 3)), frame_corners(size))
    if not np.isfinite(corners).all():
        return ("corner angle: a corner lies beyond the horizon",)
    centre = warp(fixed_from_moving, np.array(size) / 2)
    tests = (
        _test_angles(inner_angles_deg(corners), options),
        _test_translation(np.abs(centre - np.array(size) / 2) / size, options),
        _test_scale(scale_of(corners, size), options),
    )
    return tuple(reason for reason in tests if reason)


def _test_angles(angles: Float[np.ndarray, "4"], options: ExaminationOptions) -> str | None:
    low, high = options.min_angle_deg, options.max_angle_deg
    worst = angles[np.argmax(np.maximum(low - angles, angles - high))]
    return None if low <= worst <= high else f"corner angle: {worst:.0f} deg, not {low:g} to {high:g}"


def _test_translation(shares: Float[np.ndarray, "2"], options: ExaminationOptions) -> str | None:
    most = options.max_translation
    if shares.max() <= most:
        return None
    side = ("width", "height")[int(np.argmax(shares))]
    return f"translation: {100 * shares.max():.1f} % of the {side}, more than {100 * most:g} %"


def _test_scale(scale: float, options: ExaminationOptions) -> str | None:
    low = options.min_scale
    return None if low <= scale <= 1 / low else f"scale: {scale:.2f}, not {low:g} to {1 / low:.2f}"
