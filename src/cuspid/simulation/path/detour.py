"""How a path is changed where the body of the handpiece does not fit.

Along the path there are *stations*. Where the steady handpiece does not fit, and a little before and after, each
station has candidates: the handpiece is lifted, shifted towards the cheek or the tongue, rolled, pitched (about the
axis across the arch) and yawed, all about the place that it looks at. Of those that fit, the cheapest chain is chosen:
the cost of a candidate is how far it is off the steady pose and what two cameras then miss of the crowns nearby, and
that of a step is how far apart its candidates are (Viterbi's shortest path). Elsewhere the path is unchanged, to the
last bit. Where the drift of the hand would still make it touch, it is lifted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise, product

import numpy as np
from jaxtyping import Float
from scipy.ndimage import binary_dilation, gaussian_filter1d, label, maximum_filter1d

from cuspid.errors import InputError
from cuspid.geometry import Rigid3
from cuspid.rig import Handpiece
from cuspid.room import Room
from cuspid.simulation.path.coverage import CrownPoints

PoseAt = Callable[[float], Rigid3]
"""``rig_from_world`` at a given travel."""

_SHIFTS_MM, _LIFTS_MM = (-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0), (0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 13.0)
_ROLLS_DEG = (-30.0, -20.0, -10.0, 0.0, 10.0, 20.0, 30.0)
_TILTS_DEG = ((0.0, 0.0), (12.0, 0.0), (-12.0, 0.0), (0.0, 12.0), (0.0, -12.0))
"""Pitch and yaw of the candidates."""
_UNITS = np.array([1.0, 1.0, *np.deg2rad([12.0, 12.0, 12.0])])
"""A shift, a lift and a rotation of equal cost."""
_OFF, _MISSED, _APART = 0.05, 10.0, 0.5
"""Cost of being off by one unit, of missing all that there is to see, and of one unit between neighbours (squares)."""
_KEPT = 150
"""Number of candidates per station from which the shortest path chooses."""
_STATION_MM = 1.0
_EASE = 4
"""Number of stations before and after those where the steady handpiece does not fit that may also be changed."""
_BESIDE_MM = 3.0
"""What a station must see lies this near to it along the arch ..."""
_REACH_MM = 9.0
"""... and this near to it in space."""
_HIGHEST_MM, _RISE_MM, _SPARE_MM = 30.0, 0.1, 0.05
"""Maximum height to which a hand lifts, the step, and the margin beyond what is needed."""
_SLOPE_MM = 4.0
"""Length of travel over which it lifts."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Detour:
    """Changes to a path: shift towards the cheek and lift in mm; roll, pitch and yaw in rad, about what is looked
    at."""

    travel_mm: Float[np.ndarray, "n"]
    changes: Float[np.ndarray, "n 5"]

    @property
    def largest(self) -> Float[np.ndarray, "5"]:
        """Largest amount of each."""
        return np.abs(self.changes).max(axis=0)

    def at(self, travel_mm: float) -> Rigid3:
        """``changed_rig_from_rig``."""
        return _changed(np.array([np.interp(travel_mm, self.travel_mm, column) for column in self.changes.T]))


def _changed(change: Float[np.ndarray, "5"]) -> Rigid3:
    return Rigid3.from_rotation_vector(change[2:], np.array([0.0, *change[:2]])).inverse()


_CANDIDATES = np.array(
    [
        (shift, lift, *np.deg2rad([roll, pitch, yaw]))
        for shift, lift, roll, (pitch, yaw) in product(_SHIFTS_MM, _LIFTS_MM, _ROLLS_DEG, _TILTS_DEG)
    ]
)


def plan_detour(
    room: Room,
    crowns: CrownPoints,
    handpiece: Handpiece,
    steady: PoseAt,
    span_mm: tuple[float, float],
) -> Detour:
    """The changes that make a steady handpiece fit everywhere."""
    travel = np.linspace(*span_mm, max(2, 1 + round((span_mm[1] - span_mm[0]) / _STATION_MM)))
    poses = [steady(float(at)) for at in travel]
    blocked = np.array([not room.fits(pose, [Rigid3.identity()])[0] for pose in poses])
    changes = np.zeros((len(travel), 5))
    stretches, count = label(binary_dilation(blocked, iterations=_EASE))
    for number in range(1, count + 1):
        inside = np.flatnonzero(stretches == number)
        fitting = [_fitting(room, crowns, handpiece, poses[index]) for index in inside]
        anchored = bool(inside[0] > 0), bool(inside[-1] < len(travel) - 1)
        changes[inside] = _shortest(fitting, anchored)
    return Detour(travel_mm=travel, changes=changes)


def _fitting(
    room: Room, crowns: CrownPoints, handpiece: Handpiece, pose: Rigid3
) -> tuple[Float[np.ndarray, "k 5"], Float[np.ndarray, "k"]]:
    """The best candidates at a station that fit, and what each costs by itself."""
    fits = room.fits(pose, _motions())
    if not fits.any():
        raise InputError(
            f"scan path: the handpiece does not fit over the jaw even when lifted by {max(_LIFTS_MM):g} mm; check that "
            "the jaw is in its occlusal frame and that the body of the handpiece is not too large"
        )
    candidates = _CANDIDATES[fits]
    motions = [motion for motion, fit in zip(_motions(), fits, strict=True) if fit]
    costs = _OFF * np.sum((candidates / _UNITS) ** 2, axis=1) + _MISSED * _missed(crowns, handpiece, pose, motions)
    best = np.argsort(costs, kind="stable")[:_KEPT]
    return candidates[best], costs[best]


@cache
def _motions() -> list[Rigid3]:
    """Those of the candidates; 2,000 take a while to make, and few paths need them."""
    return [_changed(candidate) for candidate in _CANDIDATES]


def _missed(crowns: CrownPoints, handpiece: Handpiece, pose: Rigid3, motions: list[Rigid3]) -> Float[np.ndarray, "k"]:
    """Share of the crowns beside a station that no two cameras see, from each of several poses about it."""
    near = crowns.within(pose.inverse().translation[None], _REACH_MM)
    near = near[np.abs(pose.apply(crowns.points[near])[:, 0]) < _BESIDE_MM]
    if len(near) == 0:
        return np.zeros(len(motions))
    seen = crowns.cameras_at(near, handpiece, [motion @ pose for motion in motions]) >= 2
    return np.asarray(1 - seen.mean(axis=1))


def _shortest(
    stations: list[tuple[Float[np.ndarray, "_ 5"], Float[np.ndarray, "_"]]], anchored: tuple[bool, bool]
) -> Float[np.ndarray, "n 5"]:
    """One candidate of each station, the cheapest chain; it begins and ends unchanged where it is anchored."""
    unchanged = (np.zeros((1, 5)), np.zeros(1))
    chain = [*[unchanged] * anchored[0], *stations, *[unchanged] * anchored[1]]
    total, came_from = chain[0][1], []
    for (before, _), (after, cost) in pairwise(chain):
        step = _APART * np.sum(((after[:, None] - before[None]) / _UNITS) ** 2, axis=2) + total
        came_from.append(step.argmin(axis=1))
        total = step.min(axis=1) + cost
    index = int(total.argmin())
    chosen = [chain[-1][0][index]]
    for (candidates, _), back in zip(chain[-2::-1], came_from[::-1], strict=True):
        index = int(back[index])
        chosen.append(candidates[index])
    chosen = chosen[::-1]
    return np.array(chosen[anchored[0] : len(chosen) - anchored[1]])


def lifted(room: Room, pose_at: PoseAt, span_mm: tuple[float, float]) -> PoseAt:
    """The path of a hand that lifts the handpiece where it would touch. Raises InputError where that does not help."""
    travel = np.linspace(*span_mm, max(2, 1 + round(2 * (span_mm[1] - span_mm[0]) / _STATION_MM)))
    reach = round(_SLOPE_MM / (travel[1] - travel[0]))
    lifts = lifts_needed(room, [pose_at(float(at)) for at in travel], reach)
    if not lifts.any():
        return pose_at
    return lambda at: up(float(np.interp(at, travel, lifts))) @ pose_at(at)


def up(lift_mm: float) -> Rigid3:
    """``lifted_rig_from_rig``: away from what the handpiece looks at."""
    return Rigid3(np.eye(3), np.array([0, 0, -lift_mm]))


def lifts_needed(room: Room, rig_from_world: Sequence[Rigid3], reach: int) -> Float[np.ndarray, "n"]:
    """How much each of consecutive poses must be lifted to fit, mm, rising and falling over ``reach`` poses.

    Raises InputError where lifting does not help.
    """
    needed = np.array([_lift(room, pose) for pose in rig_from_world])
    if not needed.any():
        return needed
    return np.asarray(gaussian_filter1d(maximum_filter1d(needed, 2 * reach + 1), reach / 3, mode="nearest"))


def _lift(room: Room, pose: Rigid3) -> float:
    """By how much a handpiece must be lifted to fit, mm."""
    if room.fits(pose, [Rigid3.identity()])[0]:
        return 0.0
    heights = np.arange(_RISE_MM, _HIGHEST_MM, _RISE_MM)
    fits = room.fits(pose, [up(float(height)) for height in heights])
    if not fits.any():
        raise InputError(f"scan path: the handpiece does not fit over the jaw even when lifted by {_HIGHEST_MM:g} mm")
    return float(heights[np.argmax(fits)]) + _SPARE_MM
