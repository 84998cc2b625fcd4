"""What the most instants agree on: where a camera is from another, and how much later it began."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.distance import cdist

from cuspid.calibration.instants import numbers_in
from cuspid.geometry import Rigid3
from cuspid.storage.sequences import name_order

_AGREE_DEG, _AGREE_SHARE = 5.0, 0.1
"""Motions, from two instants, that may be the same: largest rotation between them, and largest distance as a share of
that of the board."""
_FEWEST, _OVERLAP = 5, 0.4
"""Instants that two cameras share if one began later: at least, and at least as a share of those of either."""

Poses = Mapping[str, Sequence[Rigid3]]
"""``cam_from_board`` under each numbering of the corners, by instant."""


def consensus_motion(candidates: Sequence[Sequence[Rigid3]], distance_mm: float) -> tuple[Rigid3, int, float]:
    """The motion that most instants support, out of the candidates of each instant, how many support it, and the median
    deviation of the instants, degrees."""
    motions = [each for options in candidates for each in options]
    instant = np.repeat(np.arange(len(candidates)), [len(options) for options in candidates])
    turns, shifts = (
        cdist(values, values)
        for values in (np.stack([m.rotation.ravel() for m in motions]), np.stack([m.translation for m in motions]))
    )
    turns = 2 * np.rad2deg(np.arcsin(np.minimum(turns / np.sqrt(8), 1.0)))  # |A - B| = sqrt(8) sin(angle / 2)
    agree, off = np.zeros(len(motions), dtype=np.int64), np.zeros((len(motions), len(candidates)))
    for k in range(len(candidates)):
        own = np.flatnonzero(instant == k)
        nearest = own[np.argmin(turns[:, own], axis=1)], np.arange(len(motions))
        off[:, k] = turns[nearest]
        agree += (off[:, k] < _AGREE_DEG) & (shifts[nearest] < _AGREE_SHARE * distance_mm)
    median = np.median(off, axis=1)
    best = int(np.lexsort((median, -agree))[0])
    return motions[best], int(agree[best]), float(median[best])


def started_later(new: Poses, known: Poses, distance_mm: float) -> tuple[int, int, int] | None:
    """How many instants later than another camera one began whose images are numbered as if both had begun together
    (negative if it began earlier), in how many instants both saw the board then, and how many of these agree; None
    where no other beginning lets most of them agree on where the camera is."""
    names = sorted({*new, *known}, key=name_order)
    found = numbers_in(names)
    number = {name: found[k][0] if found and len(found[0]) == 1 else k for k, name in enumerate(names)}
    news, knowns = ({number[name]: poses for name, poses in each.items()} for each in (new, known))
    fewest = max(_FEWEST, _OVERLAP * min(len(news), len(knowns)))
    fits: list[tuple[float, int, int, int]] = []
    for late, count in Counter(there - here for here in news for there in knowns).items():
        if late == 0 or count < fewest:
            continue
        both = [k for k in news if k + late in knowns]
        candidates = [[pose @ knowns[k + late][0].inverse() for pose in news[k]] for k in both]
        _, agreeing, off_deg = consensus_motion(candidates, distance_mm)
        if 2 * agreeing >= count:
            fits.append((off_deg, late, count, agreeing))
    return min(fits)[1:] if fits else None


def disagreement_between(
    cameras: tuple[str, str], poses: tuple[Poses, Poses], agreeing: int, count: int, distance_mm: float
) -> str:
    """Why most instants do not agree on where one camera is relative to another."""
    (new, known), later = cameras, started_later(*poses, distance_mm)
    if later is None:
        return (
            f"calibration: only {agreeing} of {count} instants agree on the pose of {new} relative to {known}; check "
            "that they were triggered together, and that images with the same name belong together"
        )
    late, first, other = (later[0], new, known) if later[0] > 0 else (-later[0], known, new)
    return (
        f"calibration: only {agreeing} of {count} instants agree on the pose of {new} relative to {known}, but "
        f"{later[2]} of {later[1]} do if {first} began {late} instant{'s' * (late > 1)} later than {other}: number the "
        f"images of {first} {late} higher, or leave out the first {late} of the others"
    )


def motion_difference(one: Rigid3, other: Rigid3) -> tuple[float, float]:
    """Rotation (degrees) and distance (mm) between two motions."""
    between = one @ other.inverse()
    return between.angle_deg, float(np.linalg.norm(one.translation - other.translation))
