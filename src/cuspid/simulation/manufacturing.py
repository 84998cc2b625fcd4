"""A handpiece as it was built, beside the one that was drawn: no camera sits where it should, no lens is as it should.

The images are those of the built one; what a user has is the drawn one, and the tolerances that it was built to.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from cuspid.geometry import Rigid3
from cuspid.options import SEED, Options, Range
from cuspid.rig import Handpiece, MountedCamera
from cuspid.tolerances import Tolerances, with_cameras


@dataclass(frozen=True, kw_only=True)
class ManufacturingOptions(Options):
    """Standard deviations of what a built handpiece is off from the drawn one, each camera for itself; 0 for a perfect
    one."""

    manufacturing_um: Annotated[float, Range(0, 10_000)] = 0.0
    """Place of a camera, each axis."""
    manufacturing_deg: Annotated[float, Range(0, 10)] = 0.0
    """Turn of a camera, about each axis."""
    manufacturing_focal_pct: Annotated[float, Range(0, 20)] = 0.0
    """Focal length."""
    manufacturing_centre_px: Annotated[float, Range(0, 1000)] = 0.0
    """Principal point, each axis."""
    manufacturing_k1: Annotated[float, Range(0, 1)] = 0.0
    """First term of the radial distortion."""
    manufacturing_seed: Annotated[int, SEED] = 0
    """Which of the handpieces that were built."""

    @property
    def tolerances(self) -> Tolerances:
        """The same as a value."""
        return Tolerances(
            place_mm=self.manufacturing_um / 1000,
            turn_deg=self.manufacturing_deg,
            focal_share=self.manufacturing_focal_pct / 100,
            centre_px=self.manufacturing_centre_px,
            k1=self.manufacturing_k1,
        )


def built(drawn: Handpiece, options: ManufacturingOptions) -> Handpiece:
    """One of the handpieces that are built to tolerances; the drawn one where there are none."""
    rng = np.random.default_rng([options.manufacturing_seed, 3])
    return with_cameras(drawn, lambda mounted: _off(mounted, options.tolerances, rng))


def told(drawn: Handpiece, options: ManufacturingOptions) -> Handpiece:
    """The drawn handpiece with the tolerances as covariances; where there are none it keeps its own, or is exact."""
    return options.tolerances.fill(with_cameras(drawn, lambda mounted: _open(mounted, options.tolerances)))


def _off(mounted: MountedCamera, tolerances: Tolerances, rng: np.random.Generator) -> MountedCamera:
    motion = tolerances.motion_sigma * rng.standard_normal(6)
    shift = tolerances.lens_factor(mounted.camera) @ rng.standard_normal(4)
    if not (motion.any() or shift.any()):
        return mounted
    place = Rigid3.from_rotation_vector(motion[:3], motion[3:]) @ mounted.cam_from_rig
    camera = replace(mounted.camera.with_parameters(mounted.camera.parameters + shift), covariance=None)
    return MountedCamera(camera, place)


def _open(mounted: MountedCamera, tolerances: Tolerances) -> MountedCamera:
    """Without the covariances that tolerances take the place of."""
    if tolerances.lens_factor(mounted.camera).any():
        mounted = replace(mounted, camera=replace(mounted.camera, covariance=None))
    return replace(mounted, covariance=None) if tolerances.motion_sigma.any() else mounted
