"""The panorama unrolled along the arch: a straight strip in which lengths along the arch are true.

The arch curve runs through the middle of the crowns. Across it the strip shows what the occlusal view shows, over the
same number of millimetres; a pixel belongs to the occlusal zone as long as the surface stays near the ridge of its
cross-section, and to the buccal or lingual zone beyond.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Float

from cuspid.geometry import unit
from cuspid.model.camera import OPENCV_PIXEL_OFFSET
from cuspid.model.panorama import ZONES, Panorama, Strip
from cuspid.model.sparse_model import SparseModel
from cuspid.runtime.options import Options, Range
from cuspid.stitching.height_map import HeightMap
from cuspid.stitching.trajectory import STEP_MM, drop_reversals, frames_before_return, resample_evenly, smooth


@dataclass(frozen=True, kw_only=True)
class StripOptions(Options):
    """The unrolled strip."""

    half_width_mm: Annotated[float, Range(0.1, 100)] = 8.0
    """How far the strip extends to either side of the arch curve."""
    smoothing_mm: Annotated[float, Range(0.01, 1000)] = 5.0
    """Standard deviation of the Gaussian filter along the arch curve."""
    occlusal_mm: Annotated[float, Range(0, 100)] = 2.5
    """The occlusal zone ends where the surface lies this far below the ridge of the cross-section."""


_LEAST_MM = 5.0
"""A shorter trajectory is not unrolled."""


def arch_curve(motion: SparseModel, surface: HeightMap, options: StripOptions) -> Float[np.ndarray, "n 2"] | None:
    """World (x, y) of the middle of the crowns, every `STEP_MM`, in the order in which the camera went, until it turned
    back; None where it hardly moved."""
    centres = np.array([pose.inverse().translation[:2] for pose in motion.cam_from_world.values()])
    curve = resample_evenly(
        smooth(resample_evenly(drop_reversals(centres[: frames_before_return(centres)])), options.smoothing_mm)
    )
    if STEP_MM * len(curve) < _LEAST_MM:
        return None
    across = np.arange(-options.half_width_mm, options.half_width_mm + STEP_MM, STEP_MM)
    for _ in range(2):
        normals = outward_normals(curve)
        places = curve[:, None] + across[:, None] * normals[:, None]
        heights = surface.interpolate(places)
        weight = np.clip(heights - (heights.max(axis=1, keepdims=True) - options.occlusal_mm), 0, None)
        middle = (weight * across).sum(axis=1) / weight.sum(axis=1)
        curve = resample_evenly(smooth(curve + middle[:, None] * normals, options.smoothing_mm))
    return _longer(curve, options.half_width_mm)


def _longer(curve: Float[np.ndarray, "n 2"], by_mm: float) -> Float[np.ndarray, "m 2"]:
    """The curve, straight on beyond its ends: the camera sees farther than it goes."""
    steps = STEP_MM * np.arange(1, round(by_mm / STEP_MM) + 1)[:, None]
    head, tail = (unit(curve[a] - curve[b]) for a, b in ((0, min(8, len(curve) - 1)), (-1, max(-9, -len(curve)))))
    return np.concatenate([curve[0] + steps[::-1] * head, curve, curve[-1] + steps * tail])


def outward_normals(curve: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Unit normals towards the cheek: away from the inside of the bend."""
    tangents = np.gradient(curve, axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-9)
    normals = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
    inwards = np.sum(normals * (curve.mean(axis=0) - curve)) > 0
    return -normals if inwards else normals


def unroll(
    panorama: Panorama, motion: SparseModel, surface: HeightMap, mm_per_px: float, options: StripOptions
) -> Strip | None:
    """The strip of a panorama at the panorama's own resolution; None where the camera hardly moved.

    ``mm_per_px`` is the size of the panorama's pixels in the lengths of the motion.
    """
    curve = arch_curve(motion, surface, options)
    if curve is None:
        return None
    columns = int(STEP_MM * (len(curve) - 1) / mm_per_px)
    at = np.linspace(0, len(curve) - 1, columns)
    line = np.stack([np.interp(at, np.arange(len(curve)), curve[:, axis]) for axis in range(2)], axis=1)
    normals = np.stack(
        [np.interp(at, np.arange(len(curve)), outward_normals(curve)[:, axis]) for axis in range(2)], axis=1
    )
    half = int(options.half_width_mm / mm_per_px)
    across = mm_per_px * np.arange(half, -half - 1, -1)
    places = line + across[:, None, None] * normals
    where = (places * [1, -1] / mm_per_px + panorama.origin_px - OPENCV_PIXEL_OFFSET).astype(np.float32)
    image = cv2.remap(panorama.image, where, None, cv2.INTER_LINEAR)
    covered = cv2.remap(panorama.covered.astype(np.uint8), where, None, cv2.INTER_NEAREST) > 0
    image[~covered] = 0
    zones = np.where(covered, zones_of(surface.interpolate(places), half, options), -1).astype(np.int16)
    shown = np.flatnonzero(covered[half])
    if not len(shown):
        return None
    ends = slice(int(shown[0]), int(shown[-1]) + 1)
    return Strip(
        image=np.asarray(image, dtype=np.uint8)[:, ends],
        covered=covered[:, ends],
        zone=zones[:, ends],
        curve=(line if panorama.mm_per_px else line / mm_per_px)[ends],
        mm_per_px=panorama.mm_per_px,
    )


def zones_of(heights: Float[np.ndarray, "r c"], half: int, options: StripOptions) -> Float[np.ndarray, "r c"]:
    """Zone of each pixel of a strip, an index into `ZONES`, from the heights of its cross-sections; ``half`` is the row
    of the arch curve."""
    rows = np.arange(len(heights))[:, None]
    near = heights > heights.max(axis=0) - options.occlusal_mm
    first = np.where(near.any(axis=0), near.argmax(axis=0), half)
    last = np.where(near.any(axis=0), len(heights) - 1 - near[::-1].argmax(axis=0), half)
    buccal, lingual = ZONES.index("buccal"), ZONES.index("lingual")
    return np.where(rows < first, buccal, np.where(rows > last, lingual, ZONES.index("occlusal"))).astype(np.float64)
