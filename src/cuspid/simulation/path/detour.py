"""How a path is changed where the body of the handpiece does not fit.

Along the path there are *stations*. Where the steady handpiece does not fit, and a little before and after, each
station has candidates: the handpiece is lifted, shifted towards the cheek or the tongue, rolled, pitched (about the
axis across the arch) and yawed, all about the place that it looks at. Of those that fit, the cheapest chain is chosen:
the cost of a candidate is how far it is off the steady pose and what two cameras then miss of the crowns nearby, and
that of a step is how far apart its candidates are (Viterbi's shortest path). Elsewhere the path is unchanged, to the
last bit. Where none of the candidates fits, the handpiece goes straight out of the gum, where it fits in the end.

Where the drift of the hand would still make it touch, it is lifted. Frames that do not fit all the same, as between
stations, are repaired: the least changes, as smooth as those of a detour.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise, product

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation, gaussian_filter1d, label, maximum_filter1d

from cuspid.geometry import Rigid3
from cuspid.model.rig import Handpiece
from cuspid.model.room import FAR_MM, Room
from cuspid.runtime.workers import map_in_threads
from cuspid.simulation.path.coverage import CrownPoints

PoseAt = Callable[[float], Rigid3]
"""``rig_from_world`` at a given travel."""

_SHIFTS_MM, _LIFTS_MM = (-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0), (0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 13.0)
_ROLLS_DEG, _TILT_DEG = (-30.0, -20.0, -10.0, 0.0, 10.0, 20.0, 30.0), 12.0
"""Of the candidates; those that are tilted are pitched or yawed by the same angle."""
_FINE_SHIFTS_MM, _FINE_LIFTS_MM = (-0.4, -0.2, -0.1, 0.0, 0.1, 0.2, 0.4), (0.0, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8)
_FINE_ROLLS_DEG, _FINE_TILT_DEG = (-5.0, -2.0, 0.0, 2.0, 5.0), 3.0
"""Of those that a repair has besides."""
_UNITS = np.array([1.0, 1.0, 1.0, *np.deg2rad([12.0, 12.0, 12.0])])
"""A shift, a lift and a rotation of equal cost."""
_OFF, _MISSED, _APART = 0.05, 10.0, 0.5
"""Cost of being off by one unit, of missing all that there is to see, and of one unit between neighbours (squares)."""
_KEPT = 150
"""Number of candidates per station from which the shortest path chooses."""
_AT_ONCE = 256
"""Candidates that are looked at together, those nearest to the steady pose first."""
_SHARES, _NEEDED = np.arange(0.1, 1.0, 0.1), 20
"""Parts of what a frame needs of which its neighbours have the choice, and for how many frames at most."""
_OUT = 12
"""Number of heights at which a handpiece that fits nowhere else is tried, up to where it fits."""
_STATION_MM = 1.0
_EASE = 4
"""Number of stations before and after those where the steady handpiece does not fit that may also be changed."""
_BESIDE_MM = 3.0
"""What a station must see lies this near to it along the arch ..."""
_REACH_MM = 9.0
"""... and this near to it in space."""
_HEIGHTS_MM, _SPARE_MM = np.arange(0.1, 30.0, 0.1), 0.05
"""Heights to which a hand lifts, and the margin beyond what is needed."""
_SLOPE_MM = 4.0
"""Length of travel over which it lifts."""
_MARGIN_MM = 0.01
"""What is changed keeps this much more distance than it must."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Detour:
    """Changes to a path: shift along the arch, towards the cheek and lift in mm; roll, pitch and yaw in rad, about what
    is looked at."""

    travel_mm: Float[np.ndarray, "n"]
    changes: Float[np.ndarray, "n 6"]

    @property
    def largest(self) -> Float[np.ndarray, "6"]:
        """Largest amount of each."""
        return np.abs(self.changes).max(axis=0)

    def changed_from_rig(self, travel_mm: float) -> Rigid3:
        """``changed_rig_from_rig``."""
        return _motion(np.array([np.interp(travel_mm, self.travel_mm, column) for column in self.changes.T]))


def _motion(change: Float[np.ndarray, "6"]) -> Rigid3:
    return Rigid3.from_rotation_vector(change[3:], change[:3]).inverse()


@dataclass(frozen=True, eq=False)
class _Candidates:
    """Changes from which a station chooses."""

    changes: Float[np.ndarray, "k 6"]
    """Those nearest to no change first."""
    motions: Sequence[Rigid3]

    @staticmethod
    def of(changes: Float[np.ndarray, "k 6"]) -> _Candidates:
        """Sorted."""
        ordered = changes[np.argsort(_deviation_cost(changes), kind="stable")]
        return _Candidates(ordered, [_motion(change) for change in ordered])


def _deviation_cost(changes: Float[np.ndarray, "k 6"]) -> Float[np.ndarray, "k"]:
    """What it costs to be off the steady pose."""
    return np.asarray(_OFF * np.sum((changes / _UNITS) ** 2, axis=1))


def _grid(
    shifts_mm: Sequence[float], lifts_mm: Sequence[float], rolls_deg: Sequence[float], tilt_deg: float
) -> Float[np.ndarray, "k 6"]:
    tilts = ((0.0, 0.0), (tilt_deg, 0.0), (-tilt_deg, 0.0), (0.0, tilt_deg), (0.0, -tilt_deg))
    every = product(shifts_mm, lifts_mm, rolls_deg, tilts)
    return np.array([(0.0, shift, lift, *np.deg2rad([roll, *tilt])) for shift, lift, roll, tilt in every])


@cache
def _coarse() -> _Candidates:
    """2,000 motions take a while to make, and few paths need them."""
    return _Candidates.of(_grid(_SHIFTS_MM, _LIFTS_MM, _ROLLS_DEG, _TILT_DEG))


@cache
def _fine() -> _Candidates:
    """Those of a repair."""
    fine = _grid(_FINE_SHIFTS_MM, _FINE_LIFTS_MM, _FINE_ROLLS_DEG, _FINE_TILT_DEG)
    return _Candidates.of(np.concatenate([fine, _coarse().changes]))


_Choice = tuple[Float[np.ndarray, "_ 6"], Float[np.ndarray, "_"]]
"""Some candidates of a station, and what each costs by itself."""


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
    blocked, choose = ~room.fits_at(poses), partial(_fitting_changes, room, crowns, handpiece)
    return Detour(travel_mm=travel, changes=_changes(poses, blocked, choose))


def repair_path(room: Room, rig_from_world: Sequence[Rigid3]) -> list[Rigid3]:
    """Consecutive frames, those that do not fit and some before and after them changed by as little as is needed."""
    blocked = ~room.fits_at(rig_from_world)
    if not blocked.any():
        return list(rig_from_world)
    roomy = replace(room, clearance_mm=room.clearance_mm + _MARGIN_MM)
    needed = np.array(
        [_least_changes(roomy, rig_from_world[index])[0][0] for index in np.flatnonzero(blocked).tolist()]
    )
    parts = np.multiply.outer(_SHARES, needed[np.linspace(0, len(needed) - 1, min(len(needed), _NEEDED)).astype(int)])
    changes = _changes(rig_from_world, blocked, partial(_eased_changes, roomy, parts.reshape(-1, 6)))
    return [
        _motion(change) @ pose if change.any() else pose for change, pose in zip(changes, rig_from_world, strict=True)
    ]


def _changes(
    poses: Sequence[Rigid3], blocked: Bool[np.ndarray, "n"], choose: Callable[[Rigid3], _Choice]
) -> Float[np.ndarray, "n 6"]:
    """Smooth changes to the poses that are blocked and those near to them; none to the others."""
    changes = np.zeros((len(poses), 6))
    stretches, count = label(binary_dilation(blocked, iterations=_EASE))
    for number in range(1, count + 1):
        inside = np.flatnonzero(stretches == number)
        choices = map_in_threads(choose, [poses[index] for index in inside.tolist()])
        anchored = bool(inside[0] > 0), bool(inside[-1] < len(poses) - 1)
        changes[inside] = _shortest(choices, anchored)
    return changes


def _fitting_changes(room: Room, crowns: CrownPoints, handpiece: Handpiece, pose: Rigid3) -> _Choice:
    """The best candidates at a station that fit."""
    near = crowns.within(pose.inverse().translation[None], _REACH_MM)
    near = near[np.abs(pose.apply(crowns.points[near])[:, 0]) < _BESIDE_MM]
    return _best(room, pose, _coarse(), partial(_coverage_cost, crowns, near, handpiece, pose))


def _least_changes(room: Room, pose: Rigid3) -> _Choice:
    """Those that change a frame least."""
    return _best(room, pose, _fine(), lambda motions: np.zeros(len(motions)))


def _eased_changes(room: Room, parts: Float[np.ndarray, "k 6"], pose: Rigid3) -> _Choice:
    """Those, and parts of what frames nearby need, so that there is a smooth way to it."""
    changes, costs = _least_changes(room, pose)
    fits = room.fits(pose, [_motion(part) for part in parts])
    return np.concatenate([changes, parts[fits]]), np.concatenate([costs, _deviation_cost(parts[fits])])


def _best(
    room: Room,
    pose: Rigid3,
    candidates: _Candidates,
    missed: Callable[[Sequence[Rigid3]], Float[np.ndarray, "k"]],
) -> _Choice:
    """Of the candidates that fit those that cost least. They are looked at in the order of what it costs to be off the
    pose, until that alone is too much."""
    off = _deviation_cost(candidates.changes)
    found, costs = np.empty(0, dtype=int), np.empty(0)
    for first in range(0, len(off), _AT_ONCE):
        if len(costs) >= _KEPT and off[first] > np.partition(costs, _KEPT - 1)[_KEPT - 1]:
            break
        some = slice(first, first + _AT_ONCE)
        fitting = first + np.flatnonzero(room.fits(pose, candidates.motions[some]))
        if len(fitting):
            found = np.concatenate([found, fitting])
            motions = [candidates.motions[index] for index in fitting.tolist()]
            costs = np.concatenate([costs, off[fitting] + missed(motions)])
    if not len(found):
        return _outwards(room, pose)
    best = np.argsort(costs, kind="stable")[:_KEPT]
    return candidates.changes[found[best]], costs[best]


def _outwards(room: Room, pose: Rigid3) -> _Choice:
    """Straight out of the gum, up to where nothing of the jaw is."""
    world_from_rig = pose.inverse()
    corners = np.concatenate([world_from_rig.apply(box.corners) for box in room.body.parts.values()])
    out_mm = room.mesh.bounds[1, 2] + room.clearance_mm + 2 * FAR_MM - corners[:, 2].min()
    heights = np.linspace(0, out_mm, _OUT + 1)[1:, None]
    changes = np.concatenate([heights * pose.rotation[:, 2], np.zeros((_OUT, 3))], axis=1)
    fits = room.fits(pose, [_motion(change) for change in changes])
    return changes[fits], _deviation_cost(changes[fits])


def _coverage_cost(
    crowns: CrownPoints, near: Int[np.ndarray, "n"], handpiece: Handpiece, pose: Rigid3, motions: Sequence[Rigid3]
) -> Float[np.ndarray, "k"]:
    """What it costs that two cameras do not see some points of the crowns, from each of several poses about a pose."""
    if len(near) == 0:
        return np.zeros(len(motions))
    return np.asarray(_MISSED * (1 - crowns.seen_by_two(near, handpiece, pose, motions).mean(axis=1)))


def _shortest(stations: Sequence[_Choice], anchored: tuple[bool, bool]) -> Float[np.ndarray, "n 6"]:
    """One candidate of each station, the cheapest chain; it begins and ends unchanged where it is anchored."""
    unchanged = (np.zeros((1, 6)), np.zeros(1))
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


def lift_path(room: Room, pose_at: PoseAt, span_mm: tuple[float, float]) -> PoseAt:
    """The path of a hand that lifts the handpiece where it would touch, as far as that helps."""
    travel = np.linspace(*span_mm, max(2, 1 + round(2 * (span_mm[1] - span_mm[0]) / _STATION_MM)))
    reach = round(_SLOPE_MM / (travel[1] - travel[0]))
    lifts = ease_lifts(least_lifts(room, [pose_at(float(at)) for at in travel]), reach)
    if not lifts.any():
        return pose_at
    return lambda at: lifted_from_rig(float(np.interp(at, travel, lifts))) @ pose_at(at)


def lifted_from_rig(lift_mm: float) -> Rigid3:
    """``lifted_rig_from_rig``: away from what the handpiece looks at."""
    return Rigid3(np.eye(3), np.array([0, 0, -lift_mm]))


def least_lifts(room: Room, rig_from_world: Sequence[Rigid3]) -> Float[np.ndarray, "n"]:
    """How much each pose must be lifted to fit, mm; infinite where that does not help."""
    lifts = np.zeros(len(rig_from_world))
    for index in np.flatnonzero(~room.fits_at(rig_from_world)).tolist():
        fits = room.fits(rig_from_world[index], [lifted_from_rig(float(height)) for height in _HEIGHTS_MM])
        lifts[index] = _HEIGHTS_MM[np.argmax(fits)] + _SPARE_MM if fits.any() else np.inf
    return lifts


def ease_lifts(lifts_mm: Float[np.ndarray, "n"], reach: int) -> Float[np.ndarray, "n"]:
    """Lifts of consecutive poses, rising and falling over ``reach`` poses; none for those that do not help."""
    helpful = np.where(np.isfinite(lifts_mm), lifts_mm, 0.0)
    if not helpful.any():
        return helpful
    return np.asarray(gaussian_filter1d(maximum_filter1d(helpful, 2 * reach + 1), reach / 3, mode="nearest"))
