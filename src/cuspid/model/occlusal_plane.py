"""The occlusal plane from the tips of the crowns: one rule for meshes and for panoramas.

Frames: the surface is seen from about above the crowns, +Z towards the eye, on a regular grid over X and Y.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter

from cuspid.geometry import Rigid3, unit

_TOOTH_MM = 8.0
"""About the width of a tooth: a tip is the highest point within a square of this side."""
_SQUARES_MM = (6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0)
"""Squares of which each has its own highest points, and so a plane: their mean depends less on single teeth."""
_CROWN_MM = 3.0
"""A point belongs to the top of a crown if it lies less than this below the tip near it."""
SPEE_MM = 5.0
"""Tips lie within this below the plane on which the jaw would rest."""
_TIP_SD_MM = 1.0
"""How far tips stand off their plane."""
_ROUNDS = 4
"""The tips are looked for anew from where they lie level."""


def crown_tops(
    heights: Float[np.ndarray, "h w"], spacing_mm: float, below_mm: float = _CROWN_MM, off_plane_mm: float = SPEE_MM
) -> Bool[np.ndarray, "h w"]:
    """Where the tops of the crowns are, so far below a tip; heights that are not known are NaN."""
    summits = _summits(heights, spacing_mm, _TOOTH_MM)
    return np.asarray((heights > summits - below_mm) & _on_plane(summits, heights, off_plane_mm))


def crown_tips(
    heights: Float[np.ndarray, "h w"], spacing_mm: float, square_mm: float = _TOOTH_MM, off_plane_mm: float = SPEE_MM
) -> Bool[np.ndarray, "h w"]:
    """Where the highest points of their surroundings are: tips of the cusps, and edges."""
    summits = _summits(heights, spacing_mm, square_mm)
    return np.asarray((heights == summits) & _on_plane(summits, heights, off_plane_mm))


def level_crowns(
    seen: Callable[[Rigid3], Float[np.ndarray, "h w 3"]],
    spacing_mm: float,
    tilt_sd_deg: float,
    off_plane_mm: float = SPEE_MM,
) -> Rigid3:
    """The turn about the origin that lays the tips of the crowns level: the mean over squares of several sizes.

    ``seen`` gives the surface as it is seen after a turn, on a grid of this spacing, NaN where it is not known. It is
    about upright before: within ``tilt_sd_deg`` (standard deviation), which counts where tips are few or close. What
    stands higher or lower than most by more than ``off_plane_mm`` is no tip.
    """
    turn = Rigid3.identity()
    for _ in range(_ROUNDS):
        points, back = seen(turn), turn.inverse()
        tips = (points[crown_tips(points[..., 2], spacing_mm, square, off_plane_mm)] for square in _SQUARES_MM)
        turn = upright(np.mean([_up_from_tips(back.apply(each), tilt_sd_deg) for each in tips], axis=0))
    return turn


def upright(up: Float[np.ndarray, "3"]) -> Rigid3:
    """The short turn about the origin by which the direction ``up``, which may have any length, becomes +Z."""
    axis = np.cross(up, [0, 0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12 * float(np.linalg.norm(up)):
        return Rigid3.identity()
    return Rigid3.from_rotation_vector(axis / sine * np.arctan2(sine, up[2]), np.zeros(3))


def _up_from_tips(tips: Float[np.ndarray, "n 3"], tilt_sd_deg: float) -> Float[np.ndarray, "3"]:
    """Normal of the plane that lies best on the tips; +Z where they are fewer than three."""
    if len(tips) < 3:
        return np.array([0, 0, 1.0])
    centred = tips - tips.mean(axis=0)
    prior = (_TIP_SD_MM / np.deg2rad(tilt_sd_deg)) ** 2 * np.eye(2)
    a, b = np.linalg.solve(centred[:, :2].T @ centred[:, :2] + prior, centred[:, :2].T @ centred[:, 2])
    return unit(np.array([-a, -b, 1.0]))


def _summits(heights: Float[np.ndarray, "h w"], spacing_mm: float, square_mm: float) -> Float[np.ndarray, "h w"]:
    """The highest height in the square around each place; minus infinity where none is known."""
    seen = np.where(np.isfinite(heights), heights, -np.inf)
    return np.asarray(maximum_filter(seen, max(1, round(square_mm / spacing_mm))))


def _on_plane(
    summits: Float[np.ndarray, "h w"], heights: Float[np.ndarray, "h w"], off_plane_mm: float
) -> Bool[np.ndarray, "h w"]:
    """Whether summits are about as high as the tips are; flaps of gum may rise higher."""
    known = heights[np.isfinite(heights)]
    return np.asarray(np.abs(summits - (np.percentile(known, 95) if len(known) else np.nan)) < off_plane_mm)
