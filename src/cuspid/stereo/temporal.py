"""Temporal stereo: depth from two frames, once the motion is known, from each camera and itself a moment later.

It reaches surface that only one camera of a group sees within a frame: the strips at the borders of what the group
sees in common, for example cusps between the occlusal and the buccal view. It relies on the motion, which is less
certain than the rig, so it gets little weight where depth from a single frame is available.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from jaxtyping import UInt8

from cuspid.geometry import Rigid3
from cuspid.options import SHARE, Options, Range
from cuspid.pairing import resolved_mm, stereo_pairs
from cuspid.reconstruction import DepthMap
from cuspid.rig import Handpiece, MountedCamera, Rig
from cuspid.stereo.matching import DepthEstimator, StereoOptions


@dataclass(frozen=True, kw_only=True)
class TemporalOptions(Options):
    """Temporal stereo of consecutive frames."""

    enabled: bool = True
    """Whether to use it at all."""
    left_share: Annotated[float | None, SHARE] = None
    """Cameras are matched with themselves where that fills holes, until the sparse points that depth within the frames
    leaves without a surface, and that could still be filled, are no more than this share (0 to 1) of all points. 0:
    wherever a camera moved enough. Default: 0.005, for a draft 0.03."""
    small_holes: bool | None = None
    """Also fill holes in the surface that are too small for sparse points to reveal. Default: yes, but not for a
    draft."""
    confidence_share: Annotated[float, SHARE] = 0.05
    """Confidence relative to that of depth from a single frame."""
    least_baseline_share: Annotated[float, Range(0, 10)] = 0.08
    """Smallest movement of a camera relative to the working distance."""
    largest_turn_deg: Annotated[float, Range(0, 180)] = 20.0
    """Largest rotation of the handpiece between the frames."""
    stereo: StereoOptions = field(default_factory=StereoOptions)
    """Matching and checks, as within a frame."""


def measure_temporal(
    handpiece: Handpiece,
    images: Mapping[str, UInt8[np.ndarray, "h w *c"]],
    next_images: Mapping[str, UInt8[np.ndarray, "h w *c"]],
    next_from_rig: Rigid3,
    frame: str,
    options: TemporalOptions | None = None,
) -> tuple[DepthMap, ...]:
    """Depth maps of each camera that moved enough, at its pose at ``frame`` and a moment later.

    ``next_from_rig`` moves points from the rig frame at ``frame`` to that at the next frame. All depth maps are given
    in the rig frame at ``frame``; those of the moved cameras have ``+`` after the camera's name.
    """
    options = options or TemporalOptions()
    resolution_mm, found = resolved_mm(handpiece), list[DepthMap]()
    for name in handpiece.rig.names:
        if name not in images or name not in next_images:
            continue
        pair = moving_pair(handpiece, name, next_from_rig, options)
        if pair is not None:
            both = {name: images[name], f"{name}+": next_images[name]}
            estimator = DepthEstimator(pair, options.stereo, resolution_mm=resolution_mm)
            found += estimator.measure(both, frame)
    return tuple(
        replace(depth_map, confidence=(options.confidence_share * depth_map.confidence).astype(np.float32))
        for depth_map in found
    )


def moving_pair(handpiece: Handpiece, name: str, next_from_rig: Rigid3, options: TemporalOptions) -> Handpiece | None:
    """A handpiece of one camera and the same camera at the next frame; None where they are no stereo pair."""
    mounted = handpiece.rig[name]
    moved = MountedCamera(mounted.camera, mounted.cam_from_rig @ next_from_rig)
    shift = mounted.cam_from_rig.rotate(moved.centre_in_rig - mounted.centre_in_rig)
    sideways = float(np.linalg.norm(shift[:2]))
    if next_from_rig.angle_deg > options.largest_turn_deg or sideways < abs(shift[2]):
        return None
    if sideways < options.least_baseline_share * handpiece.working_distance_mm:
        return None
    rig = Rig({name: mounted, f"{name}+": moved})
    if not stereo_pairs(rig, handpiece.working_distance_mm, options.stereo.pairing):
        return None
    return replace(handpiece.with_cameras(rig), lights={}, lightings=())
