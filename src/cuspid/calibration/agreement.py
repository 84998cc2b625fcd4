"""What the most instants agree on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cuspid.geometry import Rigid3

_AGREE_DEG, _AGREE_SHARE = 5.0, 0.1
"""Motions, from two instants, that may be the same: largest rotation between them, and largest distance as a share of
that of the board."""


def consensus_motion(candidates: Sequence[Sequence[Rigid3]], distance_mm: float) -> tuple[Rigid3, int]:
    """Of the motions that each instant leaves open, the one that the most instants agree with, and how many do."""

    def support(candidate: Rigid3) -> tuple[int, float]:
        nearest = [min(motion_difference(each, candidate) for each in options) for options in candidates]
        agreeing = [turn for turn, shift in nearest if turn < _AGREE_DEG and shift < _AGREE_SHARE * distance_mm]
        return len(agreeing), -float(np.median([turn for turn, _ in nearest]))

    best = max((each for options in candidates for each in options), key=support)
    return best, support(best)[0]


def motion_difference(one: Rigid3, other: Rigid3) -> tuple[float, float]:
    """The turn between two motions, degrees, and the distance, mm."""
    between = one @ other.inverse()
    return between.angle_deg, float(np.linalg.norm(one.translation - other.translation))
