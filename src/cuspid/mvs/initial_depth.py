"""An initial depth for each pixel: semi-global matching of rectified pairs at half resolution, checked both ways.

A *pair matcher* is any function from two rectified images and a range of disparities to the disparity of the first
image's pixels; :func:`semi_global` is one. Matching by something other than grey values can take its place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from cuspid.model.pairing import angle_weight
from cuspid.model.rig import Rig
from cuspid.mvs.rectification import RectifiedPair
from cuspid.runtime.options import Options, Range

PairMatcher = Callable[
    [UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h w"], tuple[float, float]], Float[np.ndarray, "h w"]
]
"""Rectified first and second image, lowest and highest disparity in px (positive: content lies farther left in the
second image) to the disparity at each pixel of the first, NaN where unknown. float32."""


@dataclass(frozen=True, kw_only=True)
class SemiGlobalOptions(Options):
    """Semi-global matching (OpenCV's StereoSGBM)."""

    block_px: Annotated[int, Range(1, 101)] = 5
    """Side of the matched block."""
    small_jump_penalty: Annotated[int, Range(0, 10_000)] = 8
    """Penalty for a disparity change of 1 px between neighbours, per pixel of the block."""
    large_jump_penalty: Annotated[int, Range(0, 10_000)] = 32
    """Penalty for a larger change, per pixel of the block."""
    uniqueness_percent: Annotated[int, Range(0, 100)] = 5
    """Margin by which the best cost must beat the second best."""
    left_right_tolerance_px: Annotated[float, Range(0, 1000)] = 1.0
    """Largest difference between the disparities from the two matching directions."""


def semi_global(
    first: UInt8[np.ndarray, "h w"],
    second: UInt8[np.ndarray, "h w"],
    disparities: tuple[float, float],
    options: SemiGlobalOptions = SemiGlobalOptions(),
) -> Float[np.ndarray, "h w"]:
    """A :class:`PairMatcher`: semi-global matching in both directions; disparities are kept where the two agree."""
    forward = _semi_global_one_way(first, second, disparities, options)
    backward = _semi_global_one_way(second[:, ::-1], first[:, ::-1], disparities, options)[:, ::-1]
    columns = np.arange(first.shape[1])
    target = np.rint(columns - np.nan_to_num(forward)).astype(int).clip(0, first.shape[1] - 1)
    difference = np.abs(np.take_along_axis(backward, target, axis=1) - forward)
    return np.where(difference <= options.left_right_tolerance_px, forward, np.nan).astype(np.float32)


def _semi_global_one_way(
    first: UInt8[np.ndarray, "h w"],
    second: UInt8[np.ndarray, "h w"],
    disparities: tuple[float, float],
    options: SemiGlobalOptions,
) -> Float[np.ndarray, "h w"]:
    lowest = int(np.floor(disparities[0]))
    count = 16 * int(np.ceil((disparities[1] - lowest + 1) / 16))
    matcher = cv2.StereoSGBM.create(
        minDisparity=lowest,
        numDisparities=count,
        blockSize=options.block_px,
        P1=options.small_jump_penalty * options.block_px**2,
        P2=options.large_jump_penalty * options.block_px**2,
        uniquenessRatio=options.uniqueness_percent,
        mode=cv2.StereoSGBM_MODE_SGBM_3WAY,
    )
    # OpenCV gives no answer in the leftmost columns, as wide as the largest disparity: widen the images by these.
    pad = lowest + count
    wide = [cv2.copyMakeBorder(image, 0, 0, pad, 0, cv2.BORDER_CONSTANT) for image in (first, second)]
    disparity = matcher.compute(*wide)[:, pad:].astype(np.float32) / 16
    known = (disparity >= lowest) & (np.arange(first.shape[1]) - disparity >= 0)
    return np.where(known, disparity, np.nan).astype(np.float32)


def initial_pairs(rig: Rig, sources: Mapping[str, Sequence[str]], distance_mm: float) -> Mapping[str, tuple[str, str]]:
    """For each view that has sources, the pair with the source that suits an initial match best: with a wide baseline,
    as long as both images look alike."""
    return {
        name: (name, max(others, key=lambda other: _suits(rig, name, other, distance_mm)))
        for name, others in sources.items()
        if others
    }


def _suits(rig: Rig, name: str, other: str, distance_mm: float) -> float:
    angle_deg = rig.meeting_deg(name, other, distance_mm)
    alike = float(angle_weight(np.array(angle_deg))) * rig.overlap(name, other, distance_mm)
    return float(np.sin(np.deg2rad(angle_deg))) * alike


def initial_points(
    pair: RectifiedPair,
    images: Mapping[str, UInt8[np.ndarray, "h w"]],
    matcher: PairMatcher,
    depth_range_mm: tuple[float, float],
) -> Float[np.ndarray, "n 3"]:
    """Points in the rig frame, mm, that a pair matcher finds within the depth range."""
    near, far = depth_range_mm
    first, second = pair.resample(images[pair.names[0]], images[pair.names[1]])
    low, high = pair.disparity(far), pair.disparity(near)
    start, end = _shared_columns(first, second, (low, high))
    if start >= end:
        return np.zeros((0, 3))
    # Nothing is matched where only one of the images shows anything, nor at disparities below the lowest one.
    shift = int(np.floor(low))
    found = matcher(first[:, start:end].copy(), _shift_right(second, shift)[:, start:end], (low - shift, high - shift))
    rows, columns = np.nonzero(np.isfinite(found))
    depth = pair.disparity(1.0) / (found[rows, columns].astype(np.float64) + shift)
    rays = pair.camera.rays(np.stack([columns + start, rows], axis=-1) + 0.5)
    return pair.first_from_rig.inverse().apply(rays * depth[:, None])


def _shared_columns(
    first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"], disparities: tuple[float, float]
) -> tuple[int, int]:
    """Columns of the first image, from and up to which it shows something that the second may show, too."""
    here, there = (np.flatnonzero(image.any(axis=0)) for image in (first, second))
    if not len(here) or not len(there):
        return 0, 0
    low, high = int(np.floor(disparities[0])), int(np.ceil(disparities[1]))
    return max(int(here[0]), int(there[0]) + low), min(int(here[-1]), int(there[-1]) + high) + 1


def _shift_right(image: UInt8[np.ndarray, "h w"], columns: int) -> UInt8[np.ndarray, "h w"]:
    """The image so many columns to the right, black where it shows nothing."""
    moved = np.zeros_like(image)
    width = image.shape[1]
    if abs(columns) < width:
        moved[:, max(columns, 0) : width + min(columns, 0)] = image[:, max(-columns, 0) : width - max(columns, 0)]
    return moved
