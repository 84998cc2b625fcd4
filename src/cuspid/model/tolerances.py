"""How far a built handpiece may differ from its file: as the file says, as is assumed if it says nothing, or not at
all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float

from cuspid.model.camera import Camera
from cuspid.model.rig import Handpiece, MountedCamera, Rig
from cuspid.runtime.options import Options, Range

_NOMINAL_PLACE = 0.006
"""Position of a camera, as a share of the working distance: 30 um at 5 mm."""


@dataclass(frozen=True, kw_only=True)
class Tolerances:
    """Standard deviations of a built handpiece from the drawn one, independent for each camera."""

    place_mm: float = 0.0
    """Position of a camera, each axis."""
    turn_deg: float = 0.0
    """Rotation of a camera, about each axis."""
    focal_share: float = 0.0
    """Focal length, as a share of it; the same for fx and fy."""
    centre_px: float = 0.0
    """Principal point, each axis."""
    k1: float = 0.0
    """First term of the radial distortion."""

    @property
    def motion_sigma(self) -> Float[np.ndarray, "6"]:
        """Standard deviations of a small motion on the left of ``cam_from_rig``: rad, mm."""
        return np.repeat([np.deg2rad(self.turn_deg), self.place_mm], 3)

    def lens_factor(self, camera: Camera) -> Float[np.ndarray, "n 4"]:
        """Change of the camera parameters for a unit deviation of (focal length, cx, cy, k1)."""
        factor = np.zeros((len(camera.parameters), 4))
        factor[:2, 0] = self.focal_share * camera.focal_px
        factor[2, 1] = factor[3, 2] = self.centre_px
        factor[4, 3] = self.k1
        return factor

    def fill(self, handpiece: Handpiece) -> Handpiece:
        """The handpiece with these as the covariances of everything that has none."""
        return with_cameras(handpiece, self._fill_tolerances)

    def _fill_tolerances(self, mounted: MountedCamera) -> MountedCamera:
        if mounted.camera.covariance is None:
            lens = self.lens_factor(mounted.camera)
            mounted = replace(mounted, camera=replace(mounted.camera, covariance=lens @ lens.T))
        return mounted if mounted.covariance is not None else replace(mounted, covariance=np.diag(self.motion_sigma**2))


EXACT = Tolerances()


@dataclass(frozen=True, kw_only=True)
class NominalOptions(Options):
    """How far a camera may be from what its file says, if the file does not state it (standard deviations)."""

    place_um: Annotated[float | None, Range(0, 10_000_000)] = None
    """Position of a camera, each axis; default: 0.6 % of the working distance, 30 um at 5 mm."""
    turn_deg: Annotated[float, Range(0, 10)] = 0.2
    """Rotation of a camera, about each axis."""
    focal_pct: Annotated[float, Range(0, 20)] = 0.3
    """Focal length, per cent."""
    centre_px: Annotated[float, Range(0, 1000)] = 1.0
    """Principal point, each axis."""
    k1: Annotated[float, Range(0, 1)] = 0.01
    """First term of the radial distortion."""

    def for_handpiece(self, handpiece: Handpiece) -> Tolerances:
        """The tolerances for a handpiece."""
        share = _NOMINAL_PLACE * handpiece.working_distance_mm
        return Tolerances(
            place_mm=share if self.place_um is None else self.place_um / 1000,
            turn_deg=self.turn_deg,
            focal_share=self.focal_pct / 100,
            centre_px=self.centre_px,
            k1=self.k1,
        )


def is_nominal(handpiece: Handpiece) -> bool:
    """Whether the uncertainty of some parameter of the handpiece is not stated."""
    cameras = handpiece.rig.cameras.values()
    return any(each.covariance is None or each.camera.covariance is None for each in cameras)


def without_covariances(handpiece: Handpiece) -> Handpiece:
    """The handpiece without covariances: as if it were built exactly as its file says."""

    def exact(each: MountedCamera) -> MountedCamera:
        shutter = replace(each.shutter, delay_sigma_frames=0.0, readout_sigma=0.0)
        return replace(each, camera=replace(each.camera, covariance=None), covariance=None, shutter=shutter)

    return with_cameras(handpiece, exact)


def with_cameras(handpiece: Handpiece, change: Callable[[MountedCamera], MountedCamera]) -> Handpiece:
    """The handpiece with every camera changed."""
    return replace(handpiece, rig=Rig({name: change(mounted) for name, mounted in handpiece.rig.cameras.items()}))
