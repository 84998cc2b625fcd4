"""The trajectory of a camera that a shaky hand moves over the teeth, unrestricted (thesis chapter 4, Fig. 4.2).

The steady trajectory is the arch curve of :mod:`cuspid.model.arch_curve`, from the first crown to the last, or goes on
from there so that places are seen again, or swings to either side. The hand adds a random shift, tilt and rotation to
it, and moves at a random speed. Each of these is smooth noise over the frames: a slow drift and a quick tremor, both
Gaussian and together of the given standard deviation, and never beyond `REACH` of it, because whoever holds the camera
watches the picture. The camera is shifted and rotated about the place on the teeth that it looks at, in the rig frame:
X along the arch, Y towards the cheek, Z out of the gum.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from cuspid.geometry import Rigid3
from cuspid.model.arch_curve import ArchCurve, arch_curve
from cuspid.model.jaw import Jaw
from cuspid.model.rig import Handpiece
from cuspid.model.room import Room, room_about
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import SHARE, Options, Range
from cuspid.simulation.path.cross import plan_crossing
from cuspid.simulation.path.detour import ease_lifts, least_lifts, lifted_from_rig, repair_path

_LOG = logging.getLogger("cuspid")

REACH = 2.5
"""Maximum distance of the hand from where it should be, in standard deviations."""
_SWING_DEG, _SWING_MM = 20.0, 20.0
"""Greatest roll of an S-shaped path to either side, and the length of the arch on which it goes there and back: that of
two molars."""

PathShape = Literal["arch", "return", "s-shape", "cross"]
Steady = Callable[[float], Rigid3]
"""``rig_from_world`` of a steady hand after a travel in mm."""


@dataclass(frozen=True, kw_only=True)
class FreePathOptions(Options):
    """How a hand moves a camera over the arch; the defaults are a full shake."""

    path: PathShape = "arch"
    """From the first crown to the last (arch); then back again (return), or straight across to the other side (cross);
    or to the last crown, swung towards cheek and tongue in turn (s-shape)."""
    frames: Annotated[int, Range(2, 100_000)] = 120
    """Frames of the whole film."""
    shake: Annotated[float, Range(0, 20)] = 1.0
    """Factor for all standard deviations below: 1 is a full shake, 0 a steady hand at constant speed."""
    position_mm: Annotated[float, Range(0, 100)] = 1.0
    """Standard deviation of the shift along and across the arch."""
    distance_mm: Annotated[float, Range(0, 100)] = 1.5
    """Standard deviation of the distance to the teeth."""
    tilt_deg: Annotated[float, Range(0, 90)] = 6.0
    """Standard deviation of the tilt along and across the arch."""
    turn_deg: Annotated[float, Range(0, 180)] = 8.0
    """Standard deviation of the rotation about the viewing axis."""
    speed: Annotated[float, Range(0, 0.95)] = 0.35
    """Standard deviation of the logarithm of the speed."""
    drift_frames: Annotated[float, Range(0.1, 10_000)] = 6.0
    """Number of frames over which the drift changes (standard deviation of its Gaussian filter)."""
    tremor_frames: Annotated[float, Range(0.1, 10_000)] = 1.0
    """Number of frames over which the tremor changes, likewise."""
    tremor: Annotated[float, SHARE] = 0.15
    """Share of the standard deviation that is tremor."""
    clearance_mm: Annotated[float, Range(0, 100)] = 2.0
    """Minimum distance of camera and lights from the jaw; the hand lifts them where they would come nearer."""


def plan_free_path(
    jaw: Jaw, handpiece: Handpiece, options: FreePathOptions, rng: np.random.Generator
) -> Mapping[str, Rigid3]:
    """``rig_from_world`` by frame name. Where the camera would come too near to the jaw, the hand lifts it, or goes
    around where that does not help.

    Raises InputError where nothing lies between the sides that it is to cross.
    """
    if options.clearance_mm >= handpiece.depth_range_mm[1]:
        raise InputError(
            f"free path: at --clearance-mm {options.clearance_mm:g} nothing is in focus; the camera is sharp only up "
            f"to {handpiece.depth_range_mm[1]:g} mm"
        )
    room, reach = room_about(jaw.mesh, handpiece, options.clearance_mm), round(options.drift_frames)
    length_mm, steady = _steady(jaw, room, handpiece, options.path)
    noise = hand_noise(options, 7, rng)
    speeds = np.exp(options.shake * options.speed * noise[:, 6])
    along = np.cumsum(speeds) - speeds[0]
    spreads = [
        *np.deg2rad([options.tilt_deg] * 2 + [options.turn_deg]),
        *[options.position_mm] * 2,
        options.distance_mm,
    ]
    motions = options.shake * np.array(spreads) * noise[:, :6]
    poses = [
        Rigid3.from_rotation_vector(motion[:3], motion[3:]) @ steady(float(travel))
        for motion, travel in zip(motions, along / along[-1] * length_mm, strict=True)
    ]
    lifts = ease_lifts(least_lifts(room, poses), reach)
    if lifts.any():
        _LOG.info(f"free path: the hand lifts the camera by up to {lifts.max():.1f} mm where it would come too close")
    poses = repair_path(room, [lifted_from_rig(lift) @ pose for lift, pose in zip(lifts.tolist(), poses, strict=True)])
    return {f"{index:05d}": pose for index, pose in enumerate(poses)}


def _steady(jaw: Jaw, room: Room, handpiece: Handpiece, shape: PathShape) -> tuple[float, Steady]:
    """The length of a path in mm and its poses."""
    curve = arch_curve(jaw)
    length = float(curve.lengths_mm[-1])

    def there_and_back(travel_mm: float) -> Rigid3:
        return curve.rig_from_world(length - abs(length - travel_mm))

    def swung(travel_mm: float) -> Rigid3:
        roll = np.deg2rad(_SWING_DEG) * np.sin(2 * np.pi * travel_mm / _SWING_MM)
        return Rigid3.from_rotation_vector(np.array([roll, 0.0, 0.0]), np.zeros(3)) @ curve.rig_from_world(travel_mm)

    match shape:
        case "arch":
            return length, curve.rig_from_world
        case "return":
            return 2 * length, there_and_back
        case "s-shape":
            return length, swung
        case "cross":
            return _plan_across(jaw, room, handpiece, curve, there_and_back)


def _plan_across(
    jaw: Jaw, room: Room, handpiece: Handpiece, curve: ArchCurve, there_and_back: Steady
) -> tuple[float, Steady]:
    """Along the arch, back to where there is surface all the way to the other side, and over it."""
    length = float(curve.lengths_mm[-1])
    crossing = plan_crossing(jaw.mesh, room, handpiece, curve, length)
    if crossing is None:
        raise InputError(
            "free path: --path cross: there is no surface between the sides of the arch that the camera sees in focus "
            "all the way; choose return or s-shape"
        )
    begins = 2 * length - crossing.start_mm
    crossing = crossing.preceded_by(curve.rig_from_world(crossing.start_mm))

    def pose_at(travel_mm: float) -> Rigid3:
        return there_and_back(travel_mm) if travel_mm <= begins else crossing.pose_at(travel_mm - begins)

    return begins + crossing.length_mm, pose_at


def hand_noise(options: FreePathOptions, channels: int, rng: np.random.Generator) -> Float[np.ndarray, "f c"]:
    """Independent smooth noise of unit standard deviation, limited to `REACH`: a drift and a tremor."""
    drift = _smooth_noise(options.frames, channels, options.drift_frames, rng)
    tremor = _smooth_noise(options.frames, channels, options.tremor_frames, rng)
    both = np.sqrt(1 - options.tremor**2) * drift + options.tremor * tremor
    return np.asarray(REACH * np.tanh(both / REACH))


def _smooth_noise(
    frames: int, channels: int, sigma_frames: float, rng: np.random.Generator
) -> Float[np.ndarray, "f c"]:
    """White noise behind a Gaussian filter, divided by the filter's own gain: its variance is 1 in expectation."""
    padding = int(np.ceil(4 * sigma_frames))
    impulse = np.zeros(2 * padding + 1)
    impulse[padding] = 1
    gain = np.linalg.norm(gaussian_filter1d(impulse, sigma_frames))
    white = rng.standard_normal((frames + 2 * padding, channels))
    return np.asarray(gaussian_filter1d(white, sigma_frames, axis=0)[padding : padding + frames] / gain)
