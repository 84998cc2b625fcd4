"""Which depths to believe: agreement between the cameras of a group, speckle, and a weight per pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.camera import Camera
from cuspid.geometry import Rigid3


@dataclass(frozen=True, kw_only=True)
class ConfidenceOptions:
    """What is kept of the measured depth and how it is weighted."""

    agreement_mm: float = 0.03
    """Depths of two cameras agree within this, or within three standard deviations where that is more."""
    largest_sigma_mm: float = 0.01
    """A depth with a larger standard deviation is dropped."""
    best_sigma_mm: float = 0.002
    """Standard deviation that has confidence 1; the confidence falls with its inverse square."""
    speckle_px: int = 100
    """Connected pieces of fewer depth pixels are dropped."""
    speckle_jump_mm: float = 0.06
    """Neighbours that differ by more than this are not connected."""


@dataclass(frozen=True, eq=False)
class Measured:
    """Depth of one camera on its grid, before the checks."""

    camera: Camera
    """Pinhole of the grid."""
    cam_from_rig: Rigid3
    """Its place."""
    depth_mm: Float[np.ndarray, "h w"]
    """NaN where unknown."""
    sigma_mm: Float[np.ndarray, "h w"]
    """Standard deviation as the refinement estimates it."""


def sample_inverse_depth(
    depth_mm: Float[np.ndarray, "h w"], pixels: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n"]:
    """Inverse depth (exact for planes) between pixel centres; NaN where a neighbour is unknown or it is outside."""
    height, width = depth_mm.shape
    place = np.nan_to_num(pixels - 0.5, nan=-1.0)
    base = np.floor(place).astype(int)
    inside = np.all((base >= 0) & (base < [width - 1, height - 1]), axis=1)
    column, row = np.where(inside[:, None], base, 0).T
    fx, fy = (place - base).T
    inverse = 1 / depth_mm
    top = (1 - fx) * inverse[row, column] + fx * inverse[row, column + 1]
    bottom = (1 - fx) * inverse[row + 1, column] + fx * inverse[row + 1, column + 1]
    return np.where(inside, (1 - fy) * top + fy * bottom, np.nan)


def agreement(measured: Sequence[Measured], index: int, options: ConfidenceOptions) -> Int[np.ndarray, "h w"]:
    """For each pixel of one camera: cameras whose depth agrees, minus cameras that look through the point."""
    one = measured[index]
    votes = np.zeros(one.depth_mm.shape, dtype=np.int64)
    known = np.isfinite(one.depth_mm)
    rays = one.camera.rays(one.camera.pixel_centres()[known])
    in_rig = one.cam_from_rig.inverse().apply(rays * one.depth_mm[known, None].astype(np.float64))
    tolerance = np.maximum(options.agreement_mm, 3 * one.sigma_mm[known])
    for other in (*measured[:index], *measured[index + 1 :]):
        in_other = other.cam_from_rig.apply(in_rig)
        with np.errstate(invalid="ignore"):
            behind = 1 / sample_inverse_depth(other.depth_mm, other.camera.project(in_other)) - in_other[:, 2]
        votes[known] += (np.abs(behind) <= tolerance).astype(int) - (behind > 3 * tolerance).astype(int)
    return votes


def without_speckle(depth_mm: Float[np.ndarray, "h w"], options: ConfidenceOptions) -> Bool[np.ndarray, "h w"]:
    """True where a known depth belongs to a connected piece that is large enough."""
    known = np.isfinite(depth_mm)
    # cv2.filterSpeckles connects 16-bit values: count tenths of the jump, which leaves room for 200 mm.
    levels = np.where(known, np.nan_to_num(depth_mm) / options.speckle_jump_mm * 10, -1e4)
    levels = levels.clip(-1e4, 3e4).astype(np.int16)
    cv2.filterSpeckles(levels, -10000, options.speckle_px, 10)
    return known & (levels != -10000)


def confidence(
    sigma_mm: Float[np.ndarray, "h w"], keep: Bool[np.ndarray, "h w"], options: ConfidenceOptions
) -> Float[np.ndarray, "h w"]:
    """Inverse variance relative to the best pixels, at most 1; 0 where a depth is not kept."""
    weight = np.minimum(1, (options.best_sigma_mm / np.maximum(sigma_mm, 1e-9)) ** 2)
    return np.where(keep, weight, 0).astype(np.float32)
