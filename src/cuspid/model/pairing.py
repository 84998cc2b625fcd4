"""Which views are matched with each other, at what distance, and what they resolve.

A *reference* view is matched with its own *sources*: the best few by the angle under which both see a point, and by how
much of what the one sees the other sees too. For the cameras of a rig, this follows from their calibration; for located
views of anything, from the sparse points that they share (:func:`rank_by_points`).
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int

from cuspid.geometry import unit
from cuspid.geometry.graph import parts_of
from cuspid.model.rig import Handpiece, Rig
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import SHARE, Options, Range

_ROUNDING_DEG = 1e-5
_BEST_DEG = 8.0, 20.0
"""Angles between two lines of sight from and up to which nothing is lost: less gives less depth, more another picture
of the same surface."""
_FALL_DEG = 15.0
"""Beyond, what a source is worth falls as a Gaussian function of this standard deviation."""
_LEAST_WORTH = 1e-3
"""What is worth less is no source, even if there is no other: lines of sight that meet at 75 degrees, say."""
_LEAST_SHARED = 12
"""Number of sparse points that two views must share to be matched."""
_SHARED_ENOUGH = 150
"""Number of shared points from which on more of them tell no more."""
_CONVERGING_DEG = 10.0
"""Axes that converge less than this may meet far behind what the cameras were mounted for."""
_SHARED = 0.6
"""Share of what a camera sees, at the distance that it was mounted for, that its best partner sees too: 0.45 to 0.8 in
the designs that come with cuspid."""


@dataclass(frozen=True, kw_only=True)
class PairingOptions(Options):
    """When two cameras see the same surface, from about the same side."""

    min_overlap: Annotated[float, SHARE] = 0.4
    """Share (0 to 1) of what either camera sees at the working distance that the other must see too."""
    max_angle_deg: Annotated[float, Range(0, 180)] = 60.0
    """Largest angle between their optical axes."""
    max_sources: Annotated[int, Range(1, 100)] = 6
    """Each view is matched with no more than this many others, the best ones."""
    min_share: Annotated[float, SHARE] = 0.15
    """A view is not matched with those whose weight is less than this share (0 to 1) of the best one's: 20 degrees
    apart is best, 33 degrees have 0.7 of that weight, 40 degrees 0.4 and 50 degrees 0.1."""


def angle_weight(angle_deg: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Weight (0 to 1) of a source whose lines of sight meet at an angle: a soft choice of 8 to 20 degrees."""
    least, most = _BEST_DEG
    fall = np.exp(-0.5 * (np.maximum(angle_deg - most, 0) / _FALL_DEG) ** 2)
    return np.asarray(np.minimum(angle_deg / least, 1) * fall)


def rank_sources(
    rig: Rig, distance_mm: float, options: PairingOptions = PairingOptions()
) -> Mapping[str, tuple[str, ...]]:
    """For each camera the others that it is matched with, best first, for a surface at the given distance."""
    names, weights = rig.names, np.zeros((len(rig.names),) * 2)
    for one, other in combinations(range(len(names)), 2):
        pair = names[one], names[other]
        if rig.angle_deg(*pair) > options.max_angle_deg + _ROUNDING_DEG:
            continue
        shared = _view_overlap(rig, pair, distance_mm)
        if shared >= options.min_overlap:
            angles = np.array([rig.meeting_deg(*pair, distance_mm), rig.meeting_deg(*pair[::-1], distance_mm)])
            weights[one, other], weights[other, one] = shared * angle_weight(angles)
    return {name: tuple(names[k] for k in _best(row, options)) for name, row in zip(names, weights, strict=True)}


def rank_by_points(
    centres: Float[np.ndarray, "v 3"],
    points: Float[np.ndarray, "p 3"],
    sightings: Int[np.ndarray, "s 2"],
    options: PairingOptions = PairingOptions(),
) -> tuple[tuple[int, ...], ...]:
    """For each view the others that it is matched with, best first, by the points that both see.

    ``centres`` are the projection centres of the views, ``sightings`` pairs of a view and a point that it sees.
    """
    sees = np.zeros((len(centres), len(points)), dtype=bool)
    sees[sightings[:, 0], sightings[:, 1]] = True
    ranked = []
    for reference in range(len(centres)):
        weights = np.zeros(len(centres))
        mine = np.flatnonzero(sees[reference])
        towards = unit(centres[reference] - points[mine])
        for other in np.flatnonzero(sees[:, mine].sum(axis=1) >= _LEAST_SHARED) if len(mine) else ():
            both = sees[other, mine]
            cosine = np.einsum("ni,ni->n", towards[both], unit(centres[other] - points[mine[both]]))
            angle_deg = np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))
            # The median angle, since most points of a view are seen again at its best side only.
            enough = min(1.0, np.sqrt(both.sum() / min(_SHARED_ENOUGH, len(mine))))
            weights[other] = enough * angle_weight(np.array(np.median(angle_deg)))
        weights[reference] = 0
        ranked.append(_best(weights, options))
    return tuple(ranked)


def _best(weights: Float[np.ndarray, "v"], options: PairingOptions) -> tuple[int, ...]:
    """Indices of the views that are worth enough, best first."""
    order = np.argsort(-weights, kind="stable")[: options.max_sources]
    least = max(options.min_share * weights.max(initial=0.0), _LEAST_WORTH)
    return tuple(int(k) for k in order if weights[k] >= least)


def stereo_pairs(
    rig: Rig, distance_mm: float, options: PairingOptions = PairingOptions()
) -> tuple[tuple[str, str], ...]:
    """Pairs of cameras of which one is matched with the other, for a surface at the given distance."""
    sources = rank_sources(rig, distance_mm, options)
    return tuple(
        (first, second)
        for first, second in combinations(rig.names, 2)
        if second in sources[first] or first in sources[second]
    )


def camera_groups(
    rig: Rig, distance_mm: float, options: PairingOptions = PairingOptions()
) -> tuple[tuple[str, ...], ...]:
    """Cameras that are joined by stereo pairs, in the order of the rig; a lone camera is a group of one."""
    number = {name: index for index, name in enumerate(rig.names)}
    pairs = [(number[first], number[second]) for first, second in stereo_pairs(rig, distance_mm, options)]
    part = parts_of(np.array(pairs, dtype=np.int64).reshape(-1, 2), len(number)).tolist()
    return tuple(tuple(name for name in rig.names if part[number[name]] == each) for each in dict.fromkeys(part))


def guess_working_distance_mm(rig: Rig) -> tuple[float, str]:
    """The distance from the surface that a rig was probably made for, and what it was derived from.

    If no two of its cameras are roughly parallel, it is where the axes of the pairs meet (median); otherwise, where a
    camera begins to share enough with its best partner (median; within a factor of two for the designs that come with
    cuspid). Raises InputError if no two of the cameras can be a pair.
    """
    limit_deg = PairingOptions.max_angle_deg
    pairs = [pair for pair in combinations(rig.names, 2) if rig.angle_deg(*pair) <= limit_deg]
    if not pairs:
        raise InputError("the working distance cannot be inferred from the cameras: no two of them look the same way")
    if min(rig.angle_deg(*pair) for pair in pairs) >= _CONVERGING_DEG:
        distance_mm, source = float(np.median([_axes_meet_mm(rig, *pair) for pair in pairs])), "where their axes meet"
    else:
        distance_mm, source = _least_shared_distance_mm(rig, pairs), "their baselines"
    if not 0 < distance_mm < np.inf:
        raise InputError(
            "the working distance cannot be inferred from the cameras: no two of them look at the same place"
        )
    return distance_mm, source


def _axes_meet_mm(rig: Rig, first: str, second: str) -> float:
    """How far in front of two cameras their axes come nearest to each other, on average; negative behind them."""
    one, other = rig[first], rig[second]
    axes = np.stack([one.axis_in_rig, -other.axis_in_rig], axis=1)
    along = np.linalg.lstsq(axes, other.centre_in_rig - one.centre_in_rig, rcond=None)[0]
    return float(along.mean())


def _least_shared_distance_mm(rig: Rig, pairs: Sequence[tuple[str, str]]) -> float:
    """From what distance on a camera shares enough of what it sees with its best partner; infinite if from none on."""
    paired = [name for name in rig.names if any(name in pair for pair in pairs)]

    def usual_share(distance_mm: float) -> float:
        shares = {pair: _view_overlap(rig, pair, distance_mm) for pair in pairs}
        return float(np.median([max(share for pair, share in shares.items() if name in pair) for name in paired]))

    baselines = [float(np.linalg.norm(rig[one].centre_in_rig - rig[other].centre_in_rig)) for one, other in pairs]
    distances = np.append(np.median(baselines) * np.geomspace(0.1, 100.0, 1000), np.inf)
    return float(distances[bisect_left(distances[:-1].tolist(), _SHARED, key=usual_share)])


def _view_overlap(rig: Rig, pair: tuple[str, str], distance_mm: float) -> float:
    """What either camera of a pair sees at a distance that the other sees, too (0 to 1)."""
    first, second = pair
    return min(rig.overlap(first, second, distance_mm), rig.overlap(second, first, distance_mm))


def require_stereo(handpiece: Handpiece, options: PairingOptions) -> None:
    """Raise InputError where no two cameras see the same surface."""
    if not stereo_pairs(handpiece.rig, handpiece.working_distance_mm, options):
        raise InputError(
            f"handpiece {handpiece.name}: no two cameras see the same surface at {handpiece.working_distance_mm} mm; "
            "check the calibration and the working distance"
        )


def depth_step_mm(handpiece: Handpiece) -> float:
    """Change of depth at the working distance that shifts a point by 1 px in the stereo pair with the widest baseline,
    mm; infinite where no two cameras see the same surface."""
    pairs = stereo_pairs(handpiece.rig, handpiece.working_distance_mm)
    parallax = max((_parallax_px_mm(handpiece.rig, *pair) for pair in pairs), default=0.0)
    return handpiece.working_distance_mm**2 / parallax if parallax > 0 else float("inf")


def _parallax_px_mm(rig: Rig, first: str, second: str) -> float:
    """Focal length times the sideways distance of the second camera from the first."""
    sideways = rig[first].cam_from_rig.apply(rig[second].centre_in_rig)[:2]
    return float(rig[first].camera.focal_px.mean() * np.linalg.norm(sideways))


def resolved_mm(handpiece: Handpiece) -> float:
    """The detail that the images resolve at the working distance, mm: the unit of all limits that are lengths.

    It is the footprint of a pixel or, where the cameras stand so close together that depth is less certain than that,
    the depth of half a pixel of disparity; 12 um for the built-in handpieces.
    """
    half_step = depth_step_mm(handpiece) / 2
    return max(handpiece.footprint_mm, half_step) if np.isfinite(half_step) else handpiece.footprint_mm


_DEPTH_SHARE = 0.25
"""Depths scatter by about 0.05 px of disparity, and hardly ever by more than this share of half a pixel."""


def detail_mm(handpiece: Handpiece) -> float:
    """The detail of a surface that the depth maps of a handpiece show together, mm: the unit of lengths where they are
    fused.

    It is the footprint of a pixel, or the uncertainty of a depth where that is more, because the cameras stand very
    close together; 12 um for the built-in handpieces.
    """
    return max(handpiece.footprint_mm, _DEPTH_SHARE * resolved_mm(handpiece))
