"""Which images are usable: not blurred, dark, burnt out, damaged, or duplicates of the previous one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8, UInt16
from scipy.ndimage import median_filter

from cuspid.runtime.options import SHARE, Options, Range

_LOOKED_AT_PX = 640
"""Longer side of the reduced image that is judged; it has less noise, and still shows any blur that matters."""
_BURNT_DN = 250
"""Grey value of 255 from which a pixel counts as white."""


@dataclass(frozen=True, kw_only=True)
class QualityOptions(Options):
    """Which images are left out."""

    blurred_below: Annotated[float, SHARE] = 0.4
    """An image is blurred below this share of the usual sharpness of the frames around it (0: never)."""
    dark_below_dn: Annotated[float, Range(0, 255)] = 20.0
    """An image is dark if its brightest twentieth does not reach this grey value of 255 (0: never)."""
    burnt_above: Annotated[float, SHARE] = 0.3
    """An image is burnt out if more than this share of it is white (1: never)."""
    same_below_dn: Annotated[float, Range(0, 255)] = 0.1
    """An image is a duplicate if its mean difference from the previous frame, of 255, is below this (0: never)."""
    window_frames: Annotated[int, Range(3, 1001)] = 51
    """Number of frames that determine the usual sharpness."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Looks:
    """Measures of each frame of a camera; NaN where it could not be read."""

    time_s: Float[np.ndarray, "n"]
    """Time of capture; NaN where the file does not state it."""
    level_dn: Float[np.ndarray, "n"]
    """Mean grey value of 255."""
    bright_dn: Float[np.ndarray, "n"]
    """Grey value that the brightest twentieth of the image exceeds."""
    burnt: Float[np.ndarray, "n"]
    """Share of white pixels."""
    sharpness: Float[np.ndarray, "n"]
    """Standard deviation of the Laplacian over the mean grey value."""
    change_dn: Float[np.ndarray, "n"]
    """Mean difference from the previous frame; NaN if there is none."""
    peak: Float[np.ndarray, "n"]
    """Largest stored value."""

    @property
    def readable(self) -> Bool[np.ndarray, "n"]:
        """Whether a frame could be read."""
        return np.isfinite(self.level_dn)


def shrink_to_grey(image: UInt8[np.ndarray, "h w *c"] | UInt16[np.ndarray, "h w *c"]) -> Float32[np.ndarray, "a b"]:
    """An image, RGB or grey, in the form in which it is judged: small, with grey values up to 255."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    scale = min(1.0, _LOOKED_AT_PX / max(grey.shape))
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else grey
    return small.astype(np.float32) / (257 if grey.dtype == np.uint16 else 1)


def measure_quality(
    shown: Float32[np.ndarray, "a b"], before: Float32[np.ndarray, "a b"] | None
) -> tuple[float, float, float, float, float]:
    """Level, brightness, burnt-out share, sharpness and change of an image, as in :class:`Looks`; from
    :func:`shrink_to_grey`."""
    level = float(shown.mean())
    edges = cv2.Laplacian(cv2.GaussianBlur(shown, (0, 0), 1.0), cv2.CV_32F)
    change = float(np.abs(shown - before).mean()) if before is not None else np.nan
    return (
        level,
        float(np.percentile(shown, 95)),
        float((shown >= _BURNT_DN).mean()),
        float(edges.std()) / max(level, 1.0),
        change,
    )


def faults(looks: Looks, options: QualityOptions) -> dict[int, str]:
    """What is wrong with the unusable frames, by number."""
    usual = _median_sharpness(looks, options)
    found = {}
    for number in range(len(looks.level_dn)):
        share = looks.sharpness[number] / usual[number] if usual[number] > 0 else 1.0
        if not looks.readable[number]:
            found[number] = "damaged: it cannot be read completely"
        elif looks.bright_dn[number] < options.dark_below_dn:
            found[number] = f"dark: 95 % of it is below {looks.bright_dn[number]:.0f} of 255"
        elif looks.burnt[number] > options.burnt_above:
            found[number] = f"burnt: {100 * looks.burnt[number]:.0f} % of it is white"
        elif looks.change_dn[number] < options.same_below_dn:
            found[number] = f"duplicate: {looks.change_dn[number]:.2f} of 255 from the frame before"
        elif share < options.blurred_below:
            found[number] = f"blurred: {share:.2f} of the sharpness of the frames around it"
    return found


def _median_sharpness(looks: Looks, options: QualityOptions) -> Float[np.ndarray, "n"]:
    """Running median over the frames that are neither dark nor burnt; 0 where there are none."""
    use = looks.readable & (looks.bright_dn >= options.dark_below_dn) & (looks.burnt <= options.burnt_above)
    usual = np.zeros(len(use))
    if use.any():
        usual[use] = median_filter(looks.sharpness[use], min(options.window_frames, int(use.sum())), mode="nearest")
    return usual
