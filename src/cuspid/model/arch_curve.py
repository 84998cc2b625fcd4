"""The arch of a jaw, or of a part of one: a line through the middle of the crowns at the height of their cusp tips."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import make_smoothing_spline
from scipy.ndimage import maximum_filter
from scipy.spatial import KDTree

from cuspid.geometry import Rigid3, freeze, lengths_along, read_only
from cuspid.model.jaw import GUM, Jaw
from cuspid.runtime.errors import InputError
from cuspid.runtime.workers import computed_once

_GRID_MM = 0.25
"""Spacing of the height map in which the arch is found."""
_CROWN_TOP_MM = 4.0
"""A point belongs to a crown if it lies less than this below the highest point near it ..."""
NEAR_MM = 8.0
"""... where near means within a square of this side, about a tooth."""
_ARCH_DROP_MM = 5.0
"""Crowns end less than this below the highest ones (the curve of Spee and short teeth take up to 3 mm)."""
_ROUND_MM = 3.0
"""Length of the rounded ends of the arch, where a cut across it does not show the middle of a crown."""
_SAMPLE_MM = 0.1
"""Spacing of the samples of the curve."""
_LEAST_CUTS = 5
"""Minimum number of cuts across the arch for a spline."""
_ARC_DEG, _SHORT_MM = 110.0, 30.0
"""Crowns that span a smaller arc of their circle, or lie within a square of this side, form only a part of an arch."""
_WAVELENGTH_MM = 35.0
"""Bends of the arch with this wavelength are halved: the path follows the arch, but not a single crooked tooth."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ArchCurve:
    """A line through the middle of the crowns at the height of their cusp tips, finely sampled."""

    points: Float[np.ndarray, "n 3"]
    """Positions in the occlusal frame, mm; clockwise seen from +Z."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", read_only(self.points))

    @computed_once
    def lengths_mm(self) -> Float[np.ndarray, "n"]:
        """Length of the curve up to each sample."""
        return freeze(lengths_along(self.points))

    @computed_once
    def _tangents(self) -> Float[np.ndarray, "n 3"]:
        return freeze(np.gradient(self.points, self.lengths_mm, axis=0))

    def span_of(self, points: Float[np.ndarray, "m 3"]) -> tuple[float, float]:
        """The stretch of the curve (mm from its start) beside which most of the points lie."""
        nearest = np.argmin(np.linalg.norm(points[:, None, :2] - self.points[None, ::5, :2], axis=2), axis=1)
        first, last = np.percentile(self.lengths_mm[::5][nearest], [2, 98])
        return float(first), float(last)

    def place(self, length_mm: float) -> Float[np.ndarray, "3"]:
        """The point of the curve at a length from its start; beyond the ends, the end points."""
        return np.array([np.interp(length_mm, self.lengths_mm, self.points[:, axis]) for axis in range(3)])

    def rig_from_world(self, length_mm: float) -> Rigid3:
        """A handpiece held upright over a point of the curve; straight on beyond its ends."""
        lengths = self.lengths_mm
        at = np.clip(length_mm, 0, lengths[-1])
        tangent = np.array([np.interp(at, lengths, self._tangents[:, axis]) for axis in range(3)])
        tangent /= np.linalg.norm(tangent)
        place = np.array([np.interp(at, lengths, self.points[:, axis]) for axis in range(3)])
        buccal = np.cross([0, 0, 1.0], tangent)
        buccal /= np.linalg.norm(buccal)
        axes = np.stack([tangent, buccal, np.cross(tangent, buccal)])
        return Rigid3(axes, -axes @ (place + (length_mm - at) * tangent))


def arch_curve(jaw: Jaw) -> ArchCurve:
    """The arch of a jaw in its occlusal frame, from the mesh; labels, if there are any, exclude the gum."""
    crowns = _crown_tops(jaw)
    curves = [_center_on_crowns(rough, crowns) for rough in _rough_curves(crowns)]
    return ArchCurve(points=min(curves, key=lambda points: max(_farthest_mm(points, crowns), NEAR_MM)))


def _center_on_crowns(points: Float[np.ndarray, "m 3"], crowns: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 3"]:
    for _ in range(3):
        points = _centred_curve(points, crowns)
    return points


def _farthest_mm(points: Float[np.ndarray, "m 3"], crowns: Float[np.ndarray, "n 3"]) -> float:
    """How far crowns lie beside a curve, but for 2 % of them."""
    return float(np.percentile(KDTree(points[:, :2]).query(crowns[:, :2])[0], 98))


def _rough_curves(crowns: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "m 3"], ...]:
    """The arch as seen from the centre of the circle through it, and a line along it, as for a part that hardly bends.

    Four or five teeth in a row are wide enough for a circle to go through them anywhere: what fits is seen afterwards.
    """
    centre = _circle_centre(crowns[:, :2])
    offset = crowns[:, :2] - centre
    middle = np.arctan2(*offset.mean(axis=0)[::-1])
    # Angles grow clockwise and are zero at the middle of the arch, so that the cut lies behind the mouth.
    angle = -np.angle(np.exp(1j * (np.arctan2(offset[:, 1], offset[:, 0]) - middle)))
    straight = _straight_curve(crowns, centre)
    is_short = np.ptp(crowns[:, :2], axis=0).max() < _SHORT_MM  # any circle may go through two or three teeth
    if is_short or np.ptp(np.percentile(angle, [1, 99])) < np.deg2rad(_ARC_DEG):
        return (straight,)
    radius = np.linalg.norm(offset, axis=1)
    along = angle * np.median(radius)
    at, middles = _middles(along, radius, crowns[:, 2])
    fine, smooth = _smooth(at, middles)
    turn = middle - fine / np.median(radius)
    bent = np.column_stack([centre + smooth[:, :1] * np.stack([np.cos(turn), np.sin(turn)], axis=1), smooth[:, 1]])
    return bent, straight


def _straight_curve(crowns: Float[np.ndarray, "n 3"], centre: Float[np.ndarray, "2"]) -> Float[np.ndarray, "m 3"]:
    """A line along the crowns; clockwise about the centre of their circle, which lies on the side of the tongue."""
    middle = crowns[:, :2].mean(axis=0)
    tangent = np.linalg.svd(crowns[:, :2] - middle, full_matrices=False)[2][0]
    normal = np.array([-tangent[1], tangent[0]])
    if normal @ (middle - centre) < 0:
        tangent, normal = -tangent, -normal
    offset = crowns[:, :2] - middle
    at, middles = _middles(offset @ tangent, offset @ normal, crowns[:, 2])
    fine, smooth = _smooth(at, middles)
    return np.column_stack([middle + fine[:, None] * tangent + smooth[:, :1] * normal, smooth[:, 1]])


def _centred_curve(points: Float[np.ndarray, "m 3"], crowns: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 3"]:
    """A curve moved sideways to the middle of the crowns and lengthened or shortened to where they end."""
    line = _extend_line(points, NEAR_MM)
    lengths = lengths_along(line[:, :2])
    tangents = np.gradient(line[:, :2], lengths, axis=0)
    normals = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
    _, nearest = KDTree(line[:, :2]).query(crowns[:, :2])
    sideways = np.sum((crowns[:, :2] - line[nearest, :2]) * normals[nearest], axis=1)
    at, middles = _middles(lengths[nearest], sideways, crowns[:, 2])
    short = _inner(at).sum() < _LEAST_CUTS
    if short:
        at, middles = _smooth(at, middles)
    base = np.column_stack([np.interp(at, lengths, line[:, axis]) for axis in (0, 1)])
    normal = np.column_stack([np.interp(at, lengths, normals[:, axis]) for axis in (0, 1)])
    centred = np.column_stack([base + middles[:, :1] * normal, middles[:, 1]])
    return centred if short else _smooth(at, centred)[1]


def _extend_line(points: Float[np.ndarray, "m 3"], by_mm: float) -> Float[np.ndarray, "k 3"]:
    """A line with straight pieces added at both ends."""
    reach = np.arange(1, round(by_mm / _SAMPLE_MM) + 1)[:, None] * _SAMPLE_MM
    start, end = points[0] - points[10], points[-1] - points[-11]
    before = points[0] + reach[::-1] * start / np.linalg.norm(start)
    after = points[-1] + reach * end / np.linalg.norm(end)
    return np.concatenate([before, points, after])


def _crown_tops(jaw: Jaw) -> Float[np.ndarray, "n 3"]:
    """Points of the surface seen from above that lie near the top of a crown."""
    (low_x, low_y, _), (high_x, high_y, top) = jaw.mesh.bounds
    x, y = np.meshgrid(np.arange(low_x, high_x, _GRID_MM), np.arange(low_y, high_y, _GRID_MM))
    above = np.stack([x.ravel(), y.ravel(), np.full(x.size, top + 1)], axis=1)
    hits = jaw.mesh.cast(above, np.broadcast_to([0, 0, -1.0], above.shape))
    height = (top + 1 - hits.distances).reshape(x.shape)
    if jaw.face_labels is not None:
        height[(jaw.face_labels[hits.faces] == GUM).reshape(x.shape)] = -np.inf
    crown = _is_crown(height)
    if crown.sum() < 100:
        raise InputError(
            "scan path: no crowns found on the jaw; check that it is in its occlusal frame (+Z out of the gum), in mm"
        )
    return np.stack([x[crown], y[crown], height[crown]], axis=1)


def _is_crown(height: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    nearby = maximum_filter(height, size=round(NEAR_MM / _GRID_MM), mode="nearest")
    seen = np.isfinite(height)
    if not seen.any():
        return seen
    highest = np.percentile(nearby[seen], 95)
    return seen & (height > nearby - _CROWN_TOP_MM) & (height > highest - _ARCH_DROP_MM)


def _circle_centre(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2"]:
    """Centre of the least-squares circle (Kasa), from which the arch is seen one tooth after the other."""
    mean = points.mean(axis=0)
    centred = points - mean
    solution, *_ = np.linalg.lstsq(
        np.column_stack([2 * centred, np.ones(len(points))]), np.sum(centred**2, axis=1), rcond=None
    )
    return np.asarray(mean + solution[:2])


def _middles(
    along: Float[np.ndarray, "n"], sideways: Float[np.ndarray, "n"], height: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m 2"]]:
    """For each millimetre along the arch: where it is, the middle between the crowns' sides, their height."""
    bins = np.floor(along - along.min()).astype(int)
    cuts = np.zeros((bins.max() + 1, 3))
    for index in np.unique(bins):
        inside = bins == index
        cuts[index] = *np.percentile(sideways[inside], [3, 97]), np.percentile(height[inside], 95)
    counted = np.unique(bins)
    at = along.min() + counted + 0.5
    return at, np.column_stack([cuts[counted, :2].mean(axis=1), cuts[counted, 2]])


def _inner(at: Float[np.ndarray, "m"]) -> Bool[np.ndarray, "m"]:
    """Which cuts do not lie in the rounded ends."""
    return (at >= at[0] + _ROUND_MM) & (at <= at[-1] - _ROUND_MM)


def _smooth(
    at: Float[np.ndarray, "m"], values: Float[np.ndarray, "m d"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n d"]]:
    """Smoothing spline through values given about every millimetre, finely sampled.

    The rounded ends of the last crowns say nothing of the middle: they are left out and the spline goes on straight.
    What is hardly longer than they are has one middle.
    """
    inner = _inner(at)
    fine = np.linspace(at[0], at[-1], max(50, round(np.ptp(at) / _SAMPLE_MM)))
    if inner.sum() < _LEAST_CUTS:
        return fine, np.tile(np.median(values, axis=0), (len(fine), 1))
    stiffness = (_WAVELENGTH_MM / (2 * np.pi)) ** 4
    splines = [make_smoothing_spline(at[inner], column[inner], lam=stiffness) for column in values.T]
    return fine, np.stack([spline(fine) for spline in splines], axis=1)
