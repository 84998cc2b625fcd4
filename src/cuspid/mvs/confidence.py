"""Which depths to trust: agreement between the cameras of a group, speckle, and a weight per pixel.

Limits that are lengths are given in *resolutions*: what the handpiece resolves
(:func:`cuspid.model.pairing.resolved_mm`, 12 um for the built-in ones) at the working distance. At other depths the
resolution scales with the square of the depth, as does the depth step of a pixel of disparity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.geometry import Rigid3
from cuspid.geometry.graph import parts_of
from cuspid.model.camera import Camera
from cuspid.runtime.options import Options, Range

GRADIENT_LIMIT = 2 / 3
"""Largest change of disparity of one surface, px per px of one of the images: a disparity gradient of 1 (P. Burt,
B. Julesz, Science 208, 1980), which is measured between the two images."""
_SMOOTH_CONFIDENCE = 0.03
"""Of half a pixel of disparity beside a twelfth of one."""
_TINY = float(np.finfo(np.float32).tiny)


@dataclass(frozen=True, kw_only=True)
class ConfidenceOptions(Options):
    """What is kept of the measured depth and how it is weighted."""

    pair_agreement: Annotated[float, Range(0, 100)] = 0.9
    """Largest difference, in resolutions, between depths that agree, where only two cameras look and no third one can
    contradict them."""
    agreement: Annotated[float, Range(0.01, 1000)] = 2.5
    """Largest difference, in resolutions (0.03 mm at 12 um), between the depths of two cameras that agree, where three
    or more look; or some standard deviations if that is more."""
    agreement_sigmas: Annotated[float, Range(0, 100)] = 3.0
    """How many standard deviations."""
    smooth_sigmas: Annotated[float, Range(0, 100)] = 2.0
    """Depths of smooth surfaces agree within so many standard deviations, that is, within a pixel of disparity."""
    max_sigma: Annotated[float, Range(0.001, 1000)] = 5 / 6
    """A depth with a larger standard deviation, in resolutions (0.01 mm at 12 um), is dropped."""
    best_sigma: Annotated[float, Range(0.0001, 100)] = 1 / 6
    """Standard deviation, in resolutions at the working distance (0.002 mm at 12 um), that gives confidence 1; the
    confidence falls with its inverse square."""
    border_px: Annotated[int, Range(0, 1000)] = 2
    """Where only two cameras look, pixels this close to the border of a surface in front of another one are dropped, as
    no third camera looks past it."""
    border_jump: Annotated[float, Range(0, 1000)] = 2.0
    """How far behind, in resolutions, the other surface must lie at least to count as another one."""
    speckle_px: Annotated[int, Range(0, 1_000_000)] = 100
    """Connected pieces of fewer depths are dropped, where every third pixel has one; of depths that are farther apart,
    pieces that are as small in pixels of the image."""
    speckle_jump: Annotated[float, Range(0.01, 10_000)] = 5.0
    """Neighbours that differ by more resolutions (0.06 mm at 12 um), scaled with their depth, and not as a slope does,
    are not connected."""


@dataclass(frozen=True)
class Resolution:
    """What a handpiece resolves, and where."""

    mm: float
    """At the working distance."""
    working_distance_mm: float
    """The distance at which that holds."""

    def depth_step_mm(self, depth_mm: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Change of depth, in mm, that shifts the images as much as one resolution does at the working distance."""
        return self.mm * (depth_mm / self.working_distance_mm) ** 2


@dataclass(frozen=True, eq=False)
class Measured:
    """Depth of one camera on its grid, before the checks."""

    camera: Camera
    """Pinhole camera of the grid."""
    cam_from_rig: Rigid3
    """Its pose in the rig."""
    depth_mm: Float[np.ndarray, "h w"]
    """NaN where unknown."""
    sigma_mm: Float[np.ndarray, "h w"]
    """Standard deviation estimated by the refinement."""
    begun: Bool[np.ndarray, "h w"] | None = None
    """Where there was an initial depth, if that is known."""
    planes: Float[np.ndarray, "h w 6"] | None = None
    """The planes that the depths are of (:mod:`cuspid.mvs.refinement`), if they were measured by texture."""
    smooth: Bool[np.ndarray, "h w"] | None = None
    """Where a depth is that of a smooth surface instead (:mod:`cuspid.mvs.regularised`)."""


def sample_inverse_depth(
    depth_mm: Float[np.ndarray, "h w"], pixels: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n"]:
    """Inverse depth (exact for planes) between pixel centres, from those of the four neighbours that are known; NaN
    outside, and where the known ones have less than a quarter of the weight."""
    height, width = depth_mm.shape
    place = np.nan_to_num(pixels - 0.5, nan=-1.0)
    base = np.floor(place).astype(int)
    inside = np.all((base >= 0) & (base < [width - 1, height - 1]), axis=1)
    column, row = np.where(inside[:, None], base, 0).T
    fx, fy = (place - base).T
    inverse = 1 / depth_mm
    total, weight = np.zeros(len(pixels)), np.zeros(len(pixels))
    for down, share_y in ((0, 1 - fy), (1, fy)):
        for right, share_x in ((0, 1 - fx), (1, fx)):
            corner = inverse[row + down, column + right]
            known = np.isfinite(corner)
            total += np.where(known, share_x * share_y * corner, 0)
            weight += np.where(known, share_x * share_y, 0)
    return np.where(inside & (weight >= 0.25), total / np.maximum(weight, 0.25), np.nan)


def agreement(
    one: Measured, others: Sequence[Measured], resolution: Resolution, options: ConfidenceOptions
) -> Int[np.ndarray, "h w"]:
    """For each pixel of one camera: number of others whose depth agrees, minus those that see through the point."""
    votes = np.zeros(one.depth_mm.shape, dtype=np.int64)
    known = np.isfinite(one.depth_mm)
    rays = one.camera.rays(one.camera.pixel_centres()[known])
    in_rig = one.cam_from_rig.inverse().apply(rays * one.depth_mm[known, None].astype(np.float64))
    tolerance = _tolerance_mm(one, 1 + len(others), resolution, options)[known]
    for other in others:
        in_other = other.cam_from_rig.apply(in_rig)
        pixels = other.camera.project(in_other)
        with np.errstate(invalid="ignore"):
            behind = 1 / sample_inverse_depth(other.depth_mm, pixels) - in_other[:, 2]
        within = np.maximum(tolerance, _smooth_tolerance_mm(other, pixels, options))
        votes[known] += (np.abs(behind) <= within).astype(int) - (behind > 3 * within).astype(int)
    return votes


def _smooth_tolerance_mm(
    other: Measured, pixels: Float[np.ndarray, "n 2"], options: ConfidenceOptions
) -> Float[np.ndarray, "n"]:
    """How far off the depths of a smooth surface may be at some places of its view; 0 where there is another depth."""
    if other.smooth is None:
        return np.zeros(len(pixels))
    inside = other.camera.contains(pixels, 1e-6)
    column, row = np.where(inside[:, None], pixels, 0).astype(np.int64).T
    smooth = inside & other.smooth[row, column]
    return np.where(smooth, options.smooth_sigmas * np.nan_to_num(other.sigma_mm[row, column]), 0.0)


def _tolerance_mm(
    one: Measured, cameras: int, resolution: Resolution, options: ConfidenceOptions
) -> Float[np.ndarray, "h w"]:
    """How far from each other the depths of two of so many cameras may be."""
    if cameras == 2:
        usual = options.pair_agreement * resolution.depth_step_mm(one.depth_mm)
    else:
        usual = np.maximum(
            options.agreement * resolution.depth_step_mm(one.depth_mm), options.agreement_sigmas * one.sigma_mm
        )
    return usual if one.smooth is None else np.where(one.smooth, options.smooth_sigmas * one.sigma_mm, usual)


def occlusion_borders(
    one: Measured, other: Measured, radius: int, resolution: Resolution, options: ConfidenceOptions
) -> Bool[np.ndarray, "h w"]:
    """True for pixels of one of two cameras where there is another surface behind within ``radius`` pixels of the grid:
    a window there sees mostly the nearer one, whose depth extends past its border.

    Another surface is what lies farther behind than the disparity gradient limit lets one surface fall, and what is
    not the slope of a steep surface, which rises on one side as it falls on the other.
    """
    sideways = (one.cam_from_rig @ other.cam_from_rig.inverse()).translation[:2]
    gradient_limit = GRADIENT_LIMIT / max(float(one.camera.focal_px.mean() * np.linalg.norm(sideways)), _TINY)
    least = options.border_jump * resolution.mm / resolution.working_distance_mm**2
    inverse = 1 / one.depth_mm
    near = np.zeros(inverse.shape, dtype=bool)
    for down, right in _disc(radius):
        falls, rises = inverse - _shift_values(inverse, down, right), _shift_values(inverse, -down, -right) - inverse
        limit = np.maximum(least, gradient_limit * np.hypot(down, right))
        with np.errstate(invalid="ignore"):
            near |= (falls > limit) & ~(rises > falls / 2)
    return near


def _disc(radius: int) -> list[tuple[int, int]]:
    """Offsets of the pixels within a radius, without the middle."""
    span = range(-radius, radius + 1)
    return [(down, right) for down in span for right in span if 0 < down**2 + right**2 <= radius**2]


def _shift_values(values: Float[np.ndarray, "h w"], down: int, right: int) -> Float[np.ndarray, "h w"]:
    """At each pixel the value of the one so many rows below and columns to the right; NaN where there is none."""
    height, width = values.shape
    padded = np.pad(values, ((abs(down),) * 2, (abs(right),) * 2), constant_values=np.nan)
    top, left = abs(down) + down, abs(right) + right
    return padded[top : top + height, left : left + width]


def is_certain(one: Measured, resolution: Resolution, options: ConfidenceOptions) -> Bool[np.ndarray, "h w"]:
    """True where the standard deviation of the depth is small enough; that of a smooth surface is known to be large."""
    sure = np.asarray(one.sigma_mm <= options.max_sigma * resolution.depth_step_mm(one.depth_mm))
    return sure if one.smooth is None else sure | one.smooth


def reject_speckle(
    depth_mm: Float[np.ndarray, "h w"],
    resolution: Resolution,
    options: ConfidenceOptions,
    smooth: Bool[np.ndarray, "h w"] | None = None,
) -> Bool[np.ndarray, "h w"]:
    """True where a known depth belongs to a connected piece that is large enough. Neighbours are connected if they
    differ by little, or by as much as one of them does from its neighbour on the other side: a surface that falls away
    from the camera is one piece, however steep. That is not for what was made ``smooth``, which falls from one thing to
    another one behind."""
    known = np.isfinite(depth_mm)
    jump = options.speckle_jump * resolution.mm / resolution.working_distance_mm
    level = np.log(depth_mm)
    steep = np.ones(depth_mm.shape, dtype=bool) if smooth is None else ~smooth
    number = np.arange(depth_mm.size).reshape(depth_mm.shape)
    joined = [
        np.stack([of[:, :-1][connected], of[:, 1:][connected]], axis=1)
        for of, levels, may in ((number, level, steep), (number.T, level.T, steep.T))
        for connected in [_continues(np.diff(levels, axis=1), jump, may)]
    ]
    part = parts_of(np.concatenate(joined), depth_mm.size)
    return known & (np.bincount(part)[part] >= options.speckle_px).reshape(depth_mm.shape)


def _continues(step: Float[np.ndarray, "h s"], jump: float, steep: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h s"]:
    """Whether steps along rows are small or, where they may be ``steep``, go on as the one before or the one behind;
    not where they are NaN."""
    with np.errstate(invalid="ignore"):
        alike = np.abs(np.diff(step, axis=1)) <= jump
        found = np.abs(step) <= jump
    alike &= steep[:, :-2] & steep[:, 1:-1] & steep[:, 2:]
    found[:, 1:] |= alike
    found[:, :-1] |= alike
    return found


def confidence(
    one: Measured, keep: Bool[np.ndarray, "h w"], resolution: Resolution, options: ConfidenceOptions
) -> Float[np.ndarray, "h w"]:
    """Inverse variance relative to the best pixels, at most 1; 0 where a depth is not kept. Smooth surfaces have so
    little that they fill what nothing else does."""
    best_mm = options.best_sigma * resolution.mm
    weight = (best_mm / np.maximum(one.sigma_mm, best_mm)) ** 2
    if one.smooth is not None:
        weight = np.where(one.smooth, _SMOOTH_CONFIDENCE, weight)
    return np.where(keep, weight, 0).astype(np.float32)
