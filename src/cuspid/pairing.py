"""Which cameras of a rig are matched with each other: a choice, made on the measures of :class:`cuspid.rig.Rig`."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from cuspid.errors import InputError
from cuspid.graph import parts_of
from cuspid.rig import Rig

_ROUNDING_DEG = 1e-5


@dataclass(frozen=True, kw_only=True)
class PairingOptions:
    """When two cameras see the same surface, from about the same side."""

    minimum_overlap: float = 0.4
    """Share (0 to 1) of what either sees at the working distance that the other must see, too."""
    maximum_angle_deg: float = 30.0
    """Largest angle between their optical axes."""

    def __post_init__(self) -> None:
        if not (0 <= self.minimum_overlap <= 1 and 0 <= self.maximum_angle_deg <= 180):
            raise InputError("pairing: the overlap must lie between 0 and 1, the angle between 0 and 180 deg")


def stereo_pairs(
    rig: Rig, distance_mm: float, options: PairingOptions = PairingOptions()
) -> tuple[tuple[str, str], ...]:
    """Pairs of cameras that depth is measured from, where the surface is so far away."""
    return tuple(
        (first, second)
        for first, second in combinations(rig.names, 2)
        if rig.angle_deg(first, second) <= options.maximum_angle_deg + _ROUNDING_DEG
        and min(rig.overlap(first, second, distance_mm), rig.overlap(second, first, distance_mm))
        >= options.minimum_overlap
    )


def camera_groups(
    rig: Rig, distance_mm: float, options: PairingOptions = PairingOptions()
) -> tuple[tuple[str, ...], ...]:
    """Cameras that are joined by stereo pairs, in the order of the rig; a lone camera is a group of one."""
    number = {name: index for index, name in enumerate(rig.names)}
    pairs = [(number[first], number[second]) for first, second in stereo_pairs(rig, distance_mm, options)]
    part = parts_of(np.array(pairs, dtype=np.int64).reshape(-1, 2), len(number)).tolist()
    return tuple(tuple(name for name in rig.names if part[number[name]] == each) for each in dict.fromkeys(part))
