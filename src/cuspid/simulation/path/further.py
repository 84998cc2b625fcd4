"""Further passes over the parts of the crowns that the first ones leave unseen.

For each roll, a pass along the whole path is tried, and the stretch is kept on which it adds most in excess of the cost
of its frames (the maximum-sum subarray). The best of all is added, and so on until none is worthwhile. A steep pass
shares too little surface with the upright one to be located against it, so it goes only where another further pass,
rolled less to the same side, lies between them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece
from cuspid.model.room import Room
from cuspid.simulation.path.coverage import CrownPoints
from cuspid.simulation.path.detour import lifted_from_rig
from cuspid.simulation.path.legs import Leg, SteadyPath, steady_path

_ROLLS_DEG = (-90.0, -60.0, -45.0, -30.0, 30.0, 45.0, 60.0, 90.0)
_STEEP_DEG = 60.0
"""A pass that is rolled farther is steep."""
_STATION_MM = 1.5
_WORTH = 2e-4
"""Share of the crown surface that a millimetre of path must add."""
_ARM_MM = 16.0
"""A further pass costs as much as this length of path for each radian of its roll: the turns to it and back."""
_ROUND_MM = 2.0
"""A pass begins and ends this far before and after where it is wanted."""
_MOST = 6
_LIFTS_MM = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A pass along the whole path and what two cameras see from its places."""

    roll_deg: float
    lengths_mm: Float[np.ndarray, "s"]
    seen: Bool[np.ndarray, "s n"]

    def best_stretch(self, unseen: Bool[np.ndarray, "n"], legs: Sequence[Leg]) -> tuple[float, float, float]:
        """First and last place of the stretch that pays most, and what it adds beyond its cost, as a share of all.

        ``legs`` are the further passes so far.
        """
        new = self.seen & unseen
        added = np.flatnonzero(new.any(axis=0))
        # A point counts at the middle of the places that see it.
        at = np.array([np.median(np.flatnonzero(new[:, point])) for point in added], dtype=int)
        gain = np.bincount(at, minlength=len(self.lengths_mm)) / len(unseen) - _WORTH * _STATION_MM
        gain[~self._shared_places(legs)] = -1.0  # no stretch gains as much as that
        first, last = _largest_sum(gain)
        net = float(gain[first : last + 1].sum()) - _WORTH * _ARM_MM * abs(np.deg2rad(self.roll_deg))
        return float(self.lengths_mm[first]), float(self.lengths_mm[last]), net

    def _shared_places(self, legs: Sequence[Leg]) -> Bool[np.ndarray, "s"]:
        """Places where the pass shares enough surface with others."""
        if abs(self.roll_deg) <= _STEEP_DEG:
            return np.ones(len(self.lengths_mm), bool)
        between = [_ends(leg) for leg in legs if 0 < leg.roll_deg / self.roll_deg < 1]
        return np.array([any(low <= at <= high for low, high in between) for at in self.lengths_mm])


def _largest_sum(values: Float[np.ndarray, "n"]) -> tuple[int, int]:
    """First and last index of the contiguous values with the largest sum (Kadane)."""
    sums = np.concatenate([[0.0], np.cumsum(values)])
    lowest = np.minimum.accumulate(sums[:-1])
    last = int(np.argmax(sums[1:] - lowest))
    return int(np.argmin(sums[: last + 1])), last


def further_legs(mesh: Mesh, room: Room, crowns: CrownPoints, handpiece: Handpiece, steady: SteadyPath) -> SteadyPath:
    """The path with the further passes that are worthwhile."""
    unseen = np.asarray(~points_seen_from(crowns, handpiece, list(_stations(steady))).any(axis=0))
    trials = [_trial(mesh, room, crowns, handpiece, steady, roll) for roll in _ROLLS_DEG]
    legs = list[Leg]()
    while len(legs) < _MOST:
        stretches = [trial.best_stretch(unseen, legs) for trial in trials]
        best = int(np.argmax([net for *_, net in stretches]))
        start, end, net = stretches[best]
        if net <= 0:
            break
        low, high = (start - _ROUND_MM, end + _ROUND_MM)
        legs.append(Leg(roll_deg=trials[best].roll_deg, start_mm=low, end_mm=high))
        within = (trials[best].lengths_mm >= low) & (trials[best].lengths_mm <= high)
        unseen &= ~trials[best].seen[within].any(axis=0)
    return steady_path(mesh, steady.curve, tuple(_interleave_legs(steady.legs, legs))) if legs else steady


def _interleave_legs(first: Sequence[Leg], further: Sequence[Leg]) -> Iterator[Leg]:
    """All legs in order: further ones over a stretch are gone through on the way, or at the end where that is shorter.

    On the way means when the last of the first legs has come to the end of the stretch; it goes on from there.
    """
    *before, base = first
    yield from before
    at, left = base.start_mm, list(further)
    for stretch in _stretches(further) if base.end_mm > base.start_mm else ():
        high = max(_ends(leg)[1] for leg in stretch)
        back = high - min(_ends(leg)[0] for leg in stretch) if len(stretch) % 2 else 0.0
        if at < high < base.end_mm - back:
            coming = replace(base, start_mm=at, end_mm=high)
            yield from (coming, *_order_passes(coming, stretch))
            at, left = high, [leg for leg in left if leg not in stretch]
    last = replace(base, start_mm=at)
    yield from (last, *_order_passes(last, left))


def _ends(leg: Leg) -> tuple[float, float]:
    return min(leg.start_mm, leg.end_mm), max(leg.start_mm, leg.end_mm)


def _stretches(legs: Sequence[Leg]) -> list[list[Leg]]:
    """Legs that overlap together, in the order of the arch."""
    found = list[list[Leg]]()
    for leg in sorted(legs, key=_ends):
        if found and _ends(leg)[0] < max(_ends(each)[1] for each in found[-1]):
            found[-1].append(leg)
        else:
            found.append([leg])
    return found


def _order_passes(last: Leg, legs: Sequence[Leg]) -> Iterator[Leg]:
    """From the end of each pass to the nearest end of one that is left."""
    left = list(legs)
    while left:
        candidates = [leg for each in left for leg in (each, _reverse_pass(each))]
        following = min(
            candidates, key=lambda leg: abs(leg.start_mm - last.end_mm) + abs(leg.roll_deg - last.roll_deg) / 10
        )
        left = [each for each in left if each not in (following, _reverse_pass(following))]
        yield following
        last = following


def _reverse_pass(leg: Leg) -> Leg:
    return replace(leg, start_mm=leg.end_mm, end_mm=leg.start_mm)


def _trial(
    mesh: Mesh,
    room: Room,
    crowns: CrownPoints,
    handpiece: Handpiece,
    steady: SteadyPath,
    roll_deg: float,
) -> _Trial:
    first = steady.legs[0]
    low, high = sorted((first.start_mm, first.end_mm))
    path = steady_path(mesh, steady.curve, (Leg(roll_deg=roll_deg, start_mm=low, end_mm=high),))
    poses = [_lift_to_fit(room, pose) for pose in _stations(path)]
    seen = points_seen_from(crowns, handpiece, [pose or Rigid3.identity() for pose in poses])
    seen[[pose is None for pose in poses]] = False
    return _Trial(roll_deg, np.linspace(low, high, len(poses)), seen)


def _stations(path: SteadyPath) -> Iterator[Rigid3]:
    low, high = path.span_mm
    for at in np.linspace(low, high, max(2, 1 + round((high - low) / _STATION_MM))):
        yield path.rig_from_world(float(at))


def _lift_to_fit(room: Room, pose: Rigid3) -> Rigid3 | None:
    """The pose, lifted by as little as is needed to fit; None where none of the lifts does."""
    lifts = [lifted_from_rig(lift) for lift in _LIFTS_MM]
    fits = room.fits(pose, lifts)
    return lifts[int(np.argmax(fits))] @ pose if fits.any() else None


def points_seen_from(crowns: CrownPoints, handpiece: Handpiece, poses: Sequence[Rigid3]) -> Bool[np.ndarray, "p n"]:
    """Whether two cameras see each point of the crowns from each pose."""
    return crowns.seen_by_two(np.arange(len(crowns.points)), handpiece, Rigid3.identity(), poses)
