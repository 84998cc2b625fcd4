"""A panorama: the occlusal view of an arch, composed of the frames of one hand-held camera.

Frames: the world is the occlusal frame (XY the occlusal plane, +Z out of the gum towards the viewer); the picture looks
down on it, columns run along +X and rows along -Y. Pixels are COLMAP's: the centre of the first pixel is (0.5, 0.5).
Pixel (u, v) shows the world's column x = (u - u0) s, y = (v0 - v) s, where (u0, v0) is ``origin_px`` and s is
``mm_per_px``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int16, UInt8

from cuspid.geometry import read_only
from cuspid.runtime.display import Displayed


@dataclass(frozen=True, kw_only=True)
class FrameUse:
    """What became of one frame of the sequence."""

    name: str
    """File stem, or the number in the video."""
    used: bool
    """Whether it has a place in the panorama."""
    reason: str | None = None
    """Why it is not used, in one human-readable line; None if it is used."""
    inliers: int | None = None
    """Number of matched points that agree with its place; None if that was not determined."""
    overlap: float | None = None
    """Share (0 to 1) of what it sees that the previous used frame also sees; None where that is not known."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Panorama(Displayed):
    """One picture of an arch (or of a part of it), and where each of its pixels was seen."""

    image: UInt8[np.ndarray, "h w 3"]
    """RGB; black where nothing was seen."""
    covered: Bool[np.ndarray, "h w"]
    """Where something was seen."""
    frame_index: Int16[np.ndarray, "h w"]
    """Index into ``frames`` of the frame that contributes most to each pixel, -1 for none."""
    frame_pixel: Float[np.ndarray, "h w 2"]
    """Place of each pixel in that frame: px of the (distorted) frame, COLMAP's origin; NaN for none. float32."""
    frames: tuple[FrameUse, ...]
    """Every frame of the sequence, in order."""
    method: str
    """How it was made: ``ortho``, ``thesis`` or the name of a baseline."""
    origin_px: Float[np.ndarray, "2"]
    """Pixel (u0, v0) of the world's origin; may lie outside the picture."""
    mm_per_px: float | None = None
    """Millimetres per pixel, in the occlusal plane; None where the scale is unknown."""
    height_mm: Float[np.ndarray, "h w"] | None = None
    """World Z of the surface at each pixel, in mm (in px where the scale is unknown), NaN for none. float32."""
    part: int = 1
    """Number of this part, from 1, where the sequence broke."""
    parts: int = 1
    """Number of parts; 1 means that everything that could be placed is in one piece."""
    notes: tuple[str, ...] = ()
    """What a user must know about it, one line each."""

    def __post_init__(self) -> None:
        for name in ("image", "covered", "frame_index", "frame_pixel", "height_mm", "origin_px"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, read_only(getattr(self, name)))

    def __repr__(self) -> str:
        height, width = self.covered.shape
        size = "no scale" if self.size_mm is None else f"{self.size_mm[0]:.1f} x {self.size_mm[1]:.1f} mm"
        used = sum(frame.used for frame in self.frames)
        part = f", part {self.part} of {self.parts}" if self.parts > 1 else ""
        return f"Panorama({width} x {height} px, {size}, {used} of {len(self.frames)} frames, {self.method}{part})"

    @property
    def size_mm(self) -> tuple[float, float] | None:
        """Width and height in mm, or None without a scale."""
        if self.mm_per_px is None:
            return None
        height, width = self.covered.shape
        return width * self.mm_per_px, height * self.mm_per_px

    def world_from_pixels(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """World (x, y) of pixels, in mm (in px of the panorama where the scale is unknown)."""
        return (pixels - self.origin_px) * [1, -1] * (self.mm_per_px or 1.0)

    def pixels_from_world(self, world: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Inverse of :meth:`world_from_pixels`."""
        return world / (self.mm_per_px or 1.0) * [1, -1] + self.origin_px


@dataclass(frozen=True, eq=False, kw_only=True)
class Strip:
    """A panorama unrolled along the arch curve: columns run along it, rows across, the cheek's side at the top."""

    image: UInt8[np.ndarray, "h w 3"]
    """RGB; black where nothing was seen."""
    covered: Bool[np.ndarray, "h w"]
    """Where something was seen."""
    zone: Int16[np.ndarray, "h w"]
    """What each pixel shows: an index into `ZONES`, -1 for none."""
    curve: Float[np.ndarray, "w 2"]
    """World (x, y) of the arch curve at each column, mm (px of the panorama where the scale is unknown)."""
    mm_per_px: float | None
    """Millimetres per pixel along the curve and across it; None where the scale is unknown."""

    def __post_init__(self) -> None:
        for name in ("image", "covered", "zone", "curve"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


ZONES = ("buccal", "occlusal", "lingual")
"""Sides of the teeth, as :class:`Strip` names them."""
