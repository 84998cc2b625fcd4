"""The trajectory of a camera over an arch, seen from above: without tremor, and how far it goes before it turns back.

Places are (x, y) in the occlusal plane, mm.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from cuspid.geometry import lengths_along

STEP_MM = 0.25
"""Spacing of the points of an even curve."""
_TREMOR_FRAMES = 3.0
"""Standard deviation of the Gaussian filter over the camera's path, in frames."""
_SHORT_MM = 3.0
"""Bends that are shorter than this (standard deviation of a Gaussian) do not count where it turns back."""
_ARM_MM, _FOLDED = 8.0, 0.35
"""It turns back where places so far before and behind are nearer to each other than this share of the path between
them. Over the front teeth of an arch they are farther apart than 0.8 of it."""


def frames_before_return(centres: Float[np.ndarray, "f 2"]) -> int:
    """Number of frames until the camera first turns back; all if it never does."""
    lengths = lengths_along(smooth(centres, _TREMOR_FRAMES * STEP_MM))
    curve = resample_evenly(drop_reversals(centres))
    arm = round(_ARM_MM / STEP_MM)
    if len(curve) <= 2 * arm:
        return len(centres)
    steady = smooth(curve, _SHORT_MM)
    folded = np.linalg.norm(steady[2 * arm :] - steady[: -2 * arm], axis=1) / (2 * _ARM_MM) < _FOLDED
    if not folded.any():
        return len(centres)
    first = int(folded.argmax())
    last = first + int(np.argmin(np.append(folded[first:], False)))
    turn_mm = (first + last - 1) / 2 * STEP_MM + _ARM_MM
    share = turn_mm / (STEP_MM * (len(curve) - 1))
    return max(2, int(np.searchsorted(lengths, share * lengths[-1])))


def drop_reversals(path: Float[np.ndarray, "f 2"]) -> Float[np.ndarray, "n 2"]:
    """A shaky path without its steps back: its smoothed places, each at least a millimetre from the last."""
    steady = smooth(path, _TREMOR_FRAMES * STEP_MM)
    kept = [steady[0]]
    for place in steady[1:]:
        if np.linalg.norm(place - kept[-1]) >= 1.0:
            kept.append(place)
    if len(kept) == 1:
        kept.append(steady[-1] + [STEP_MM, 0])
    return np.array(kept)


def resample_evenly(curve: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """The same curve, sampled every `STEP_MM`."""
    lengths = lengths_along(curve)
    at = np.arange(0, lengths[-1] + STEP_MM / 2, STEP_MM)
    return np.stack([np.interp(at, lengths, curve[:, axis]) for axis in range(2)], axis=1)


def smooth(curve: Float[np.ndarray, "n 2"], sigma_mm: float) -> Float[np.ndarray, "n 2"]:
    """A curve without short bends; its ends are extrapolated straight instead of shrinking."""
    pad = min(len(curve) - 1, int(4 * sigma_mm / STEP_MM))
    if pad < 2:
        return curve
    head, tail = 2 * curve[0] - curve[pad:0:-1], 2 * curve[-1] - curve[-2 : -pad - 2 : -1]
    longer = np.concatenate([head, curve, tail])
    return np.asarray(gaussian_filter1d(longer, sigma_mm / STEP_MM, axis=0)[pad : pad + len(curve)])
