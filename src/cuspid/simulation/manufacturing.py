"""A handpiece as it was built, beside the one that was drawn: no camera sits where it should, no lens is as it should.

The images are those of the built one; what a user has is the drawn one, and the tolerances that it was built to.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float

from cuspid.camera import Camera
from cuspid.geometry import Rigid3
from cuspid.options import SEED, Options, Range
from cuspid.rig import Handpiece, MountedCamera, Rig


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


def built(drawn: Handpiece, options: ManufacturingOptions) -> Handpiece:
    """One of the handpieces that are built to tolerances; the drawn one where there are none."""
    rng = np.random.default_rng([options.manufacturing_seed, 3])
    return _with_cameras(drawn, lambda mounted: _off(mounted, options, rng))


def with_tolerances(drawn: Handpiece, options: ManufacturingOptions) -> Handpiece:
    """The drawn handpiece with the tolerances as covariances; what has none keeps what it had."""
    return _with_cameras(drawn, lambda mounted: _tolerated(mounted, options))


def _with_cameras(handpiece: Handpiece, change: Callable[[MountedCamera], MountedCamera]) -> Handpiece:
    cameras = {name: change(mounted) for name, mounted in handpiece.rig.cameras.items()}
    return replace(handpiece, rig=Rig(cameras))


def _off(mounted: MountedCamera, options: ManufacturingOptions, rng: np.random.Generator) -> MountedCamera:
    motion = _place_sigma(options) * rng.standard_normal(6)
    shift = _lens_factor(mounted.camera, options) @ rng.standard_normal(4)
    if not (motion.any() or shift.any()):
        return mounted
    place = Rigid3.from_rotation_vector(motion[:3], motion[3:]) @ mounted.cam_from_rig
    camera = replace(mounted.camera.with_parameters(mounted.camera.parameters + shift), covariance=None)
    return MountedCamera(camera, place)


def _tolerated(mounted: MountedCamera, options: ManufacturingOptions) -> MountedCamera:
    place, lens = _place_sigma(options), _lens_factor(mounted.camera, options)
    if lens.any():
        mounted = replace(mounted, camera=replace(mounted.camera, covariance=lens @ lens.T))
    return replace(mounted, covariance=np.diag(place**2)) if place.any() else mounted


def _place_sigma(options: ManufacturingOptions) -> Float[np.ndarray, "6"]:
    """Of a small motion on the left of ``cam_from_rig``: rad, mm."""
    return np.repeat([np.deg2rad(options.manufacturing_deg), options.manufacturing_um / 1000], 3)


def _lens_factor(camera: Camera, options: ManufacturingOptions) -> Float[np.ndarray, "8 4"]:
    """What (focal length, cx, cy, k1) of unit deviation make of the parameters: both focal lengths go together."""
    factor = np.zeros((8, 4))
    factor[:2, 0] = options.manufacturing_focal_pct / 100 * camera.focal_px
    factor[2, 1] = factor[3, 2] = options.manufacturing_centre_px
    factor[4, 3] = options.manufacturing_k1
    return factor
