"""What a lens and a sensor make of a distance: footprint, sampling, sharpness, overlap of two views.

A thin lens of focal length f and aperture f/N, focused at the distance Z0 (both from the lens), draws a point at Z as a
disc of diameter c = (f / N) f |Z - Z0| / (Z (Z0 - f)) on the sensor (Ray, *Applied Photographic Optics*, 3rd ed. 2002).
Diffraction alone draws it as an Airy disc of diameter 2.44 lambda N (1 + m), m the magnification. Millimetres, but for
what says otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from cuspid.model.camera import Camera
from cuspid.model.rig import Handpiece
from cuspid.runtime.errors import InputError

GREEN_UM = 0.55
"""Wavelength for which diffraction is given."""


Projection = Literal["rectilinear", "equidistant"]
"""How a lens maps the angle from its axis to the radius in the image: r = f tan(angle) or r = f angle."""


def horizontal_from_diagonal_deg(
    diagonal_deg: float, width_px: int, height_px: int, projection: Projection = "rectilinear"
) -> float:
    """Full horizontal angle of view of a lens of which the diagonal one is published."""
    if not (0 < diagonal_deg < 180 and width_px > 0 and height_px > 0):
        raise InputError(
            f"optics: the diagonal angle of view must be between 0 and 180 deg and the image size positive, not "
            f"{diagonal_deg:g} deg and {width_px} x {height_px} px"
        )
    share = width_px / float(np.hypot(width_px, height_px))
    if projection == "equidistant":
        return diagonal_deg * share
    return float(np.rad2deg(2 * np.arctan(share * np.tan(np.deg2rad(diagonal_deg) / 2))))


@dataclass(frozen=True, kw_only=True)
class Optics:
    """A miniature camera: sensor, angle of view and aperture."""

    name: str
    """Product, or what it stands for."""
    width_px: int
    """Image width."""
    height_px: int
    """Image height."""
    pixel_um: float
    """Pitch of the pixels."""
    field_of_view_deg: float
    """Full horizontal angle of view."""
    f_number: float
    """Focal length over the diameter of the entrance pupil."""
    focus_mm: float = 5.0
    """Distance that is imaged sharply."""
    source: str = ""
    """Where the figures are published, and which of them are inferred."""

    def __post_init__(self) -> None:
        sizes = (self.width_px, self.height_px, self.pixel_um, self.f_number, self.focus_mm)
        if min(sizes) <= 0 or not 0 < self.field_of_view_deg < 180:
            raise InputError(
                f"optics {self.name}: sizes, f-number and focus must be positive and the angle of view "
                "between 0 and 180 deg"
            )
        if self.focus_mm <= self.focal_mm:
            raise InputError(
                f"optics {self.name}: focused at {self.focus_mm} mm, which is within its focal length of "
                f"{self.focal_mm:.2f} mm"
            )

    @property
    def sensor_width_mm(self) -> float:
        """Width of the active area."""
        return self.width_px * self.pixel_um / 1000

    @property
    def focal_px(self) -> float:
        """Focal length in px of the ideal pinhole with this angle of view."""
        return float(self.width_px / (2 * np.tan(np.deg2rad(self.field_of_view_deg) / 2)))

    @property
    def focal_mm(self) -> float:
        """Focal length."""
        return self.focal_px * self.pixel_um / 1000

    @property
    def aperture_mm(self) -> float:
        """Diameter of the entrance pupil."""
        return self.focal_mm / self.f_number

    @property
    def camera(self) -> Camera:
        """The ideal pinhole camera with this angle of view."""
        return Camera.from_field_of_view(self.width_px, self.height_px, self.field_of_view_deg)

    def footprint_mm(self, distance_mm: float) -> tuple[float, float]:
        """Width and height of the plane at a distance that fills the image."""
        return self.width_px * distance_mm / self.focal_px, self.height_px * distance_mm / self.focal_px

    def um_per_px(self, distance_mm: float) -> float:
        """Size of a pixel on a plane at a distance."""
        return 1000 * distance_mm / self.focal_px

    def blur_px(self, distance_mm: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"] | float:
        """Diameter of the disc that a point at a distance is drawn as, in px, without diffraction."""
        defocus = np.abs(np.asarray(distance_mm) - self.focus_mm) / distance_mm
        return self.aperture_mm * self.focal_px * defocus / (self.focus_mm - self.focal_mm)

    def depth_of_field_mm(self, blur_px: float) -> tuple[float, float]:
        """Nearest and farthest distance drawn with a blur disc of at most so many px; the far one may be infinite."""
        if blur_px <= 0:
            raise InputError(f"optics {self.name}: the blur disc must be larger than 0 px, not {blur_px}")
        share = blur_px * (self.focus_mm - self.focal_mm) / (self.aperture_mm * self.focal_px)
        far = self.focus_mm / (1 - share) if share < 1 else np.inf
        return self.focus_mm / (1 + share), float(far)

    def diffraction_px(self, distance_mm: float) -> float:
        """Diameter of the Airy disc in px for green light, at the working f-number N (1 + m) for a distance."""
        if distance_mm <= self.focal_mm:
            raise InputError(
                f"optics {self.name}: cannot image anything at {distance_mm} mm, which is within its focal length of "
                f"{self.focal_mm:.2f} mm"
            )
        magnification = self.focal_mm / (distance_mm - self.focal_mm)
        return 2.44 * GREEN_UM * self.f_number * (1 + magnification) / self.pixel_um

    def parallel_overlap(self, baseline_mm: float, distance_mm: float) -> float:
        """Share (0 to 1) of the footprint at a distance that two parallel cameras share, along their baseline."""
        return max(0.0, 1 - baseline_mm / self.footprint_mm(distance_mm)[0])


def in_focus(handpiece: Handpiece, optics: Optics, blur_px: float) -> Handpiece:
    """The handpiece with the depth range in which its lenses draw a point no wider than ``blur_px``.

    Raises InputError where the working distance lies outside that range.
    """
    return replace(handpiece, depth_range_mm=optics.depth_of_field_mm(blur_px))
