"""When the rows of an image are exposed, and how the handpiece moves meanwhile.

Time is counted in frames. A camera exposes the middle row of a frame ``delay_frames`` after the instant of the frame,
and where its shutter rolls, a row at the height y of its image ``readout * (y / height - 1/2)`` after that.

The handpiece is taken to move from one frame to the next as it does on average from the one before to the one after,
by a constant motion (a screw): v, a rotation vector (rad) and a shift (mm), acts on the left of ``rig_from_world``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3

_REACH = 2.0
"""How many frames away a neighbour may be for the motion to be known from it."""


@dataclass(frozen=True, kw_only=True)
class Shutter:
    """When a camera exposes the rows of its images; by default all of them at the instant of the frame."""

    delay_frames: float = 0.0
    """How long after the instant of a frame it exposes the middle row, in frames."""
    delay_sigma_frames: float = 0.0
    """Standard deviation of that; 0 if it is exact."""
    readout: float = 0.0
    """Time from the first row to the last one, as a share of that from one frame to the next; negative if the last one
    comes first, 0 if all are exposed at once."""
    readout_sigma: float = 0.0
    """Standard deviation of that; 0 if it is exact."""

    @property
    def is_plain(self) -> bool:
        """Whether all rows are known to be exposed at the instant of the frame."""
        return self == PLAIN

    @property
    def is_known(self) -> bool:
        """Whether nothing of it is uncertain."""
        return not (self.delay_sigma_frames or self.readout_sigma)

    def later(self, delay_frames: float, readout: float) -> Shutter:
        """The shutter with its delay and readout increased by so much."""
        return replace(self, delay_frames=self.delay_frames + delay_frames, readout=self.readout + readout)

    def late(self, heights: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """How many frames after the instant of its frame a row is exposed, by its height in the image as a share of
        that, from 0 at the top."""
        return np.asarray(self.delay_frames + self.readout * (heights - 0.5))


PLAIN = Shutter()
"""All rows at the instant of the frame."""


def frame_numbers(names: Iterable[str]) -> dict[str, int] | None:
    """The number of each frame, from its name: frames follow each other at equal times. None unless all have different
    ones."""
    frames = list(names)
    if not all(name.isascii() and name.isdigit() for name in frames):
        return None
    number = {name: int(name) for name in frames}
    return number if len(set(number.values())) == len(number) else None


def film_times(names: Sequence[str]) -> tuple[float, ...] | None:
    """When the frames of a film were taken, in frames; None where their names do not give them, or they are not in
    order."""
    number = frame_numbers(names)
    times = () if number is None else tuple(map(float, number.values()))
    return times if len(times) > 1 and all(before < after for before, after in pairwise(times)) else None


def motions(poses: Sequence[Rigid3], times: Sequence[float] | None) -> Float[np.ndarray, "f 6"]:
    """How the handpiece moves in a frame at each pose, given their times in order; 0 where no neighbour is near enough,
    and everywhere without times."""
    found = np.zeros((len(poses), 6))
    if times is None:
        return found
    for k, (pose, time) in enumerate(zip(poses, times, strict=True)):
        beside = [j for j in (k - 1, k + 1) if 0 <= j < len(poses) and 0 < abs(times[j] - time) <= _REACH]
        if not beside:
            continue
        first, last = min(*beside, k), max(*beside, k)
        in_world = poses[first].inverse() @ poses[last]
        turn, shift = screw_of(in_world)
        turn, shift = (pose.rotate(each) / (times[last] - times[first]) for each in (turn, shift))
        found[k] = np.concatenate([turn, shift - np.cross(turn, pose.translation)])
    return found


def screw_of(motion: Rigid3) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """The turn and the shift of which a motion of much less than a radian is the exponential."""
    turn, shift = motion.rotation_vector, motion.translation
    across = np.cross(turn, shift)
    return turn, shift - across / 2 + np.cross(turn, across) / 12


def displace_points(
    points: Float[np.ndarray, "n 3"], motion: Float[np.ndarray, "6"], late: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3"]:
    """Points of the rig where they are so many frames later, to first order."""
    return np.asarray(points + late[:, None] * (np.cross(motion[:3], points) + motion[3:]))
