"""The trajectory of a steady hand: passes along the arch, each with its roll, and the turns between them.

A handpiece with few cameras is also rolled about the tangent of the arch (thesis 3.5.3), to scan a cross-section from
several sides. ``hold`` is the rig frame of a handpiece held upright, which sinks where teeth are missing; a roll is
positive when the cameras turn towards the cheek. *Travel* is the length along the trajectory, passes and turns, in mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d, maximum_filter

from cuspid.geometry import Rigid3
from cuspid.model.arch_curve import NEAR_MM, ArchCurve
from cuspid.model.mesh import Mesh
from cuspid.simulation.path.cross import Crossing

_SIDE_DEG, _SIDE_MM = 60.0, (4.5, 2.5)
"""At this roll, a handpiece looks at this place: across from the middle of the crown, and down from the cusp tips."""
_TURN_RADIUS_MM = 8.0
"""A turn by an angle has the length of an arc with this radius: about that of the cameras around the crown."""
_STATION_MM = 1.0
"""Spacing of the places at which the room beside the teeth is measured."""
_PATCH_MM = 1.5
"""Half the side of the patch of rays that measures it."""
_FAR_MM = 8.0
"""Distance from which these rays start, from the place that the handpiece looks at; they end as far behind it."""
_LIFT_MM = 3.0
"""Maximum correction of the nominal crown."""
_GAP_MM = 2.0
"""A surface this far below the cusp tips is still seen well; if it is lower, the handpiece follows it down."""
_GAP_PATCH_MM = 3.0
"""Half the width, across the arch, of the strip in which that surface is searched for."""
_GAP_NEAR_MM = 5.0
"""The handpiece stays up while a tooth is nearer than half of this."""


@dataclass(frozen=True, kw_only=True)
class Leg:
    """One pass along the arch or a stretch of it."""

    roll_deg: float
    """Roll; positive towards the cheek."""
    start_mm: float
    """Where it begins on the arch curve."""
    end_mm: float
    """Where it ends; before the start if the pass runs backwards."""

    @property
    def length_mm(self) -> float:
        """Length of the stretch."""
        return abs(self.end_mm - self.start_mm)


@dataclass(frozen=True, eq=False, kw_only=True)
class SteadyPath:
    """The passes of a steady hand and the turns between them."""

    curve: ArchCurve
    legs: tuple[Leg, ...]
    """Legs in order; from the end of each, the handpiece goes straight to the start of the next."""
    travel_mm: Float[np.ndarray, "k"]
    """Travel at the start and the end of each leg."""
    stations_mm: Float[np.ndarray, "s"]
    """Places on the curve at which the room was measured."""
    rolls_deg: Float[np.ndarray, "r"]
    """The rolls, ascending, for which it was measured."""
    lifts_mm: Float[np.ndarray, "r s"]
    """How far the surface there lies outside the nominal crown."""
    sinks_mm: Float[np.ndarray, "s"]
    """How far the handpiece sinks there because teeth are missing."""
    crossing: Crossing | None = None
    """A sweep from one side to the other after the last leg; it begins where that ends."""

    @property
    def span_mm(self) -> tuple[float, float]:
        """First and last travel."""
        return float(self.travel_mm[0]), self.legs_end_mm + (self.crossing.length_mm if self.crossing else 0.0)

    @property
    def legs_end_mm(self) -> float:
        """Travel at the end of the last leg."""
        return float(self.travel_mm[-1])

    def place(self, travel_mm: float) -> tuple[float, float]:
        """Position on the curve in mm and roll in degrees."""
        lengths = [at for leg in self.legs for at in (leg.start_mm, leg.end_mm)]
        rolls = [leg.roll_deg for leg in self.legs for _ in range(2)]
        return float(np.interp(travel_mm, self.travel_mm, lengths)), float(np.interp(travel_mm, self.travel_mm, rolls))

    def rig_from_world(self, travel_mm: float) -> Rigid3:
        """The handpiece without the drift of a hand."""
        if self.crossing is not None and travel_mm > self.legs_end_mm:
            return self.crossing.pose_at(travel_mm - self.legs_end_mm)
        length, roll = self.place(travel_mm)
        sink = float(np.interp(length, self.stations_mm, self.sinks_mm))
        hold_from_world = _hold_from_world(self.curve, length, sink)
        if self.legs == (Leg(roll_deg=0.0, start_mm=self.legs[0].start_mm, end_mm=self.legs[0].end_mm),):
            return hold_from_world
        at_rolls = [np.interp(length, self.stations_mm, lifts) for lifts in self.lifts_mm]
        return _rig_from_hold(roll, float(np.interp(roll, self.rolls_deg, at_rolls))) @ hold_from_world


def there_and_back(rolls_deg: Sequence[float], start_mm: float, end_mm: float) -> tuple[Leg, ...]:
    """A leg for each roll over the same stretch, alternately there and back."""
    ends = [(start_mm, end_mm) if number % 2 == 0 else (end_mm, start_mm) for number in range(len(rolls_deg))]
    return tuple(
        Leg(roll_deg=roll, start_mm=start, end_mm=end) for roll, (start, end) in zip(rolls_deg, ends, strict=True)
    )


def steady_path(mesh: Mesh, curve: ArchCurve, legs: tuple[Leg, ...]) -> SteadyPath:
    """The trajectory along all legs; a rolled handpiece follows the surface where it protrudes or recedes."""
    low, high = (pick(at for leg in legs for at in (leg.start_mm, leg.end_mm)) for pick in (min, max))
    stations = np.linspace(low, high, max(2, round((high - low) / _STATION_MM)))
    rolls = np.unique([leg.roll_deg for leg in legs])
    sinks = _sinks(mesh, curve, stations)
    holds = [_hold_from_world(curve, float(at), float(sink)) for at, sink in zip(stations, sinks, strict=True)]
    return SteadyPath(
        curve=curve,
        legs=legs,
        travel_mm=_travel(legs),
        stations_mm=stations,
        rolls_deg=rolls,
        lifts_mm=np.array([_lifts(mesh, holds, float(roll)) for roll in rolls]),
        sinks_mm=sinks,
    )


def _travel(legs: tuple[Leg, ...]) -> Float[np.ndarray, "k"]:
    """Begins where the first leg does on the curve."""
    at = [legs[0].start_mm, legs[0].end_mm]
    for before, leg in pairwise(legs):
        turn = np.deg2rad(abs(leg.roll_deg - before.roll_deg)) * _TURN_RADIUS_MM
        at.append(at[-1] + float(np.hypot(turn, leg.start_mm - before.end_mm)))
        at.append(at[-1] + leg.length_mm)
    return np.array(at)


def _hold_from_world(curve: ArchCurve, length_mm: float, sink_mm: float) -> Rigid3:
    return Rigid3(np.eye(3), np.array([0, 0, sink_mm])) @ curve.rig_from_world(length_mm)


def _rig_from_hold(roll_deg: float, lift_mm: float) -> Rigid3:
    """A handpiece that looks square at the place of a rounded crown whose normal is rolled by an angle.

    The crown is an ellipse across the arch; at `_SIDE_DEG` its place is that of `_SIDE_MM`, where the side groups of
    the twelve cameras look.
    """
    roll, side = np.deg2rad([roll_deg, _SIDE_DEG])
    outward = np.array([0, np.sin(roll), np.cos(roll)])
    across = _SIDE_MM[0] * np.sin(roll) / np.sin(side)
    down = _SIDE_MM[1] * (1 - np.cos(roll)) / (1 - np.cos(side))
    rotation = np.stack([[1.0, 0, 0], np.cross(outward, [1.0, 0, 0]), outward])
    return Rigid3(rotation, -rotation @ (np.array([0, across, -down]) + lift_mm * outward))


def _lifts(mesh: Mesh, hold_from_world: Sequence[Rigid3], roll_deg: float) -> Float[np.ndarray, "s"]:
    """How far a rolled handpiece must move out, or in (negative), for its working distance to be kept.

    Rays on a patch square before it find the surface. What stands out most nearby counts, so that the handpiece does
    not dive behind the last crown; then smoothed along the arch, for a hand does not follow each crown.
    """
    if roll_deg == 0:
        return np.zeros(len(hold_from_world))
    ticks = np.linspace(-_PATCH_MM, _PATCH_MM, 5)
    patch = np.stack(np.meshgrid(ticks, ticks, _FAR_MM), axis=-1).reshape(-1, 3)
    lifts = np.zeros(len(hold_from_world))
    for index, hold in enumerate(hold_from_world):
        world_from_rig = (_rig_from_hold(roll_deg, 0.0) @ hold).inverse()
        hits = mesh.cast(world_from_rig.apply(patch), np.broadcast_to(-world_from_rig.rotation[:, 2], patch.shape))
        heights = _FAR_MM - hits.distances[hits.distances < 2 * _FAR_MM]
        lifts[index] = np.median(heights) if len(heights) else 0.0
    return np.asarray(np.clip(_follow_heights(lifts, NEAR_MM), -_LIFT_MM, _LIFT_MM))


def _sinks(mesh: Mesh, curve: ArchCurve, stations_mm: Float[np.ndarray, "s"]) -> Float[np.ndarray, "s"]:
    """How far an upright handpiece sinks between two teeth, so that what lies there instead of teeth is in focus."""
    along, across = np.linspace(-_PATCH_MM, _PATCH_MM, 5), np.linspace(-_GAP_PATCH_MM, _GAP_PATCH_MM, 9)
    strip = np.stack(np.meshgrid(along, across, _FAR_MM), axis=-1).reshape(-1, 3)
    heights = np.zeros(len(stations_mm))
    for index, length in enumerate(stations_mm):
        world_from_hold = curve.rig_from_world(float(length)).inverse()
        down = np.broadcast_to(-world_from_hold.rotation[:, 2], strip.shape)
        highest = _FAR_MM - float(mesh.cast(world_from_hold.apply(strip), down).distances.min())
        heights[index] = highest if np.isfinite(highest) else 0.0
    between = np.logical_and(*(_accumulate_any(heights > -_GAP_MM, order) for order in (1, -1)))
    heights[~between] = 0.0
    return np.asarray(np.maximum(-_follow_heights(heights, _GAP_NEAR_MM) - _GAP_MM, 0.0))


def _accumulate_any(which: Bool[np.ndarray, "s"], order: int) -> Bool[np.ndarray, "s"]:
    """Where one is true before, or, of order -1, behind."""
    return np.asarray(np.logical_or.accumulate(which[::order])[::order])


def _follow_heights(heights_mm: Float[np.ndarray, "s"], near_mm: float) -> Float[np.ndarray, "s"]:
    """Heights at the stations as a hand follows them: what stands out most nearby, smoothly."""
    highest = maximum_filter(heights_mm, size=round(near_mm / _STATION_MM), mode="nearest")
    return np.asarray(gaussian_filter1d(highest, near_mm / 2 / _STATION_MM, mode="nearest"))
