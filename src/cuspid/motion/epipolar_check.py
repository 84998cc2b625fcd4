"""Whether the images of one instant contradict the calibration: how far matches lie from their epipolar lines.

A single instant does not determine how far apart the cameras are, and hardly their convergence; what it would change
there are errors of its matches and of the lens model. So it should only be asked to refine a calibration that it
contradicts.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture
from cuspid.model.epipolar import epipolar_residuals, skew
from cuspid.model.pairing import stereo_pairs
from cuspid.motion.frontend.features import detect_all
from cuspid.motion.frontend.odometry import search_range_mm
from cuspid.motion.frontend.pairs import IndexedFeatures, match_guided
from cuspid.motion.frontend.pictures import Pictures
from cuspid.motion.location import MotionOptions, index_frame
from cuspid.runtime.progress import Progress, silent

_REACH_PX, _LEAST_MATCHES = 8.0, 10
"""Matches are sought within this distance of their epipolar lines, and a pair tells something from so many on."""
_MOST_SPREAD_PX = 2.0
"""Half of the matches of a pair lie within this, or most of them are wrong: those lie anywhere within reach."""


def epipolar_offset_px(
    capture: Capture, options: MotionOptions, *, cache: Path | None = None, progress: Progress = silent
) -> float | None:
    """Median distance of the matches of a pair of cameras from their epipolar lines, the largest over the pairs and
    frames; None where no pair has enough matches."""
    handpiece, frames = capture.handpiece, [frame.name for frame in capture.frames]
    features = detect_all(Pictures(capture, max_bytes=0), options.sought, progress=progress, cache=cache)
    pairs = stereo_pairs(handpiece.rig, handpiece.working_distance_mm, options.pairing)
    within, offsets = replace(options.within, tolerance_px=_REACH_PX), list[float]()
    for views in (index_frame(handpiece.rig, features, name) for name in frames):
        for first, second in (pair for pair in pairs if all(name in views for name in pair)):
            a, b = views[first], views[second]
            b_from_a = handpiece.rig[second].cam_from_rig @ handpiece.rig[first].cam_from_rig.inverse()
            bounds = search_range_mm(handpiece, a), search_range_mm(handpiece, b)
            matches = match_guided(a, b, b_from_a, *bounds, within)
            if len(matches) < _LEAST_MATCHES:
                continue
            low, middle, high = np.percentile(_residuals_px(a, b, b_from_a, matches), [25, 50, 75])
            if high - low < _MOST_SPREAD_PX:
                offsets.append(abs(float(middle)))
    return max(offsets, default=None)


def _residuals_px(
    a: IndexedFeatures, b: IndexedFeatures, b_from_a: Rigid3, matches: Int[np.ndarray, "k 2"]
) -> Float[np.ndarray, "n"]:
    essential = skew(b_from_a.translation) @ b_from_a.rotation
    return b.focal_px * epipolar_residuals(essential, a.ideal[matches[:, 0]], b.ideal[matches[:, 1]])
