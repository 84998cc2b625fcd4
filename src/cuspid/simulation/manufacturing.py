"""A handpiece as built, as opposed to the one that was drawn: no camera and no lens is exactly as it should be.

The images are those of the built one; a user has the drawn one, and the tolerances to which it was built.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from cuspid.geometry import Rigid3
from cuspid.model.rig import Handpiece, Light, MountedCamera, Sensor
from cuspid.model.tolerances import Tolerances, with_cameras
from cuspid.runtime.options import SEED, Options, Range

_DARKEST = 0.95
"""Maximum loss of light in a corner."""


@dataclass(frozen=True, kw_only=True)
class ManufacturingOptions(Options):
    """Standard deviations of the built handpiece from the drawn one, independent for each camera; 0 for a perfect
    one."""

    manufacturing_um: Annotated[float, Range(0, 10_000)] = 0.0
    """Position of a camera, each axis."""
    manufacturing_deg: Annotated[float, Range(0, 10)] = 0.0
    """Rotation of a camera, about each axis."""
    manufacturing_focal_pct: Annotated[float, Range(0, 20)] = 0.0
    """Focal length."""
    manufacturing_centre_px: Annotated[float, Range(0, 1000)] = 0.0
    """Principal point, each axis."""
    manufacturing_k1: Annotated[float, Range(0, 1)] = 0.0
    """First term of the radial distortion."""
    manufacturing_gain_pct: Annotated[float, Range(0, 50)] = 0.0
    """Brightness of the images of a camera."""
    manufacturing_falloff_pct: Annotated[float, Range(0, 80)] = 0.0
    """Not a deviation: average loss of light in the corners of an image; each lens has 0.5 to 1.5 times that."""
    manufacturing_gamma_pct: Annotated[float, Range(0, 20)] = 0.0
    """Encoding exponent of a camera."""
    manufacturing_led_um: Annotated[float, Range(0, 10_000)] = 0.0
    """Position of a light, each axis."""
    manufacturing_led_power_pct: Annotated[float, Range(0, 50)] = 0.0
    """Power of a light."""
    manufacturing_seed: Annotated[int, SEED] = 0
    """Seed that selects one of the handpieces that could be built."""

    @property
    def tolerances(self) -> Tolerances:
        """The tolerances of the cameras."""
        return Tolerances(
            place_mm=self.manufacturing_um / 1000,
            turn_deg=self.manufacturing_deg,
            focal_share=self.manufacturing_focal_pct / 100,
            centre_px=self.manufacturing_centre_px,
            k1=self.manufacturing_k1,
        )


def sample_built(drawn: Handpiece, options: ManufacturingOptions) -> Handpiece:
    """One of the handpieces that are built to the tolerances; the drawn one if there are none."""
    rng = np.random.default_rng([options.manufacturing_seed, 3])
    placed = with_cameras(drawn, lambda mounted: _draw_error(mounted, options.tolerances, rng))
    return _vary_lights(_vary_sensors(placed, options), options)


def _vary_sensors(drawn: Handpiece, options: ManufacturingOptions) -> Handpiece:
    """With a sensor of its own for each camera, where they are not all alike."""
    if not (options.manufacturing_gain_pct or options.manufacturing_falloff_pct or options.manufacturing_gamma_pct):
        return drawn
    rng = np.random.default_rng([options.manufacturing_seed, 6])
    return replace(drawn, sensors={name: _sensor(drawn.sensor_of(name), options, rng) for name in drawn.rig.names})


def _sensor(drawn: Sensor, options: ManufacturingOptions, rng: np.random.Generator) -> Sensor:
    gain, gamma = rng.standard_normal(2)
    loss, curved = rng.uniform([0.5, -0.3], [1.5, 0.3])
    at_corner = np.log1p(-min(_DARKEST, loss * options.manufacturing_falloff_pct / 100))
    return replace(
        drawn,
        gain=drawn.gain * float(np.exp(gain * options.manufacturing_gain_pct / 100)),
        gamma=drawn.gamma * float(np.exp(gamma * options.manufacturing_gamma_pct / 100)),
        falloff=(float((1 - curved) * at_corner), float(curved * at_corner)),
        covariance=None,
    )


def _vary_lights(drawn: Handpiece, options: ManufacturingOptions) -> Handpiece:
    """With lights that are not quite where, and not quite as bright as, they were drawn."""
    if not (options.manufacturing_led_um or options.manufacturing_led_power_pct):
        return drawn
    rng = np.random.default_rng([options.manufacturing_seed, 7])
    return replace(drawn, lights={name: _light(light, options, rng) for name, light in drawn.lights.items()})


def _light(drawn: Light, options: ManufacturingOptions, rng: np.random.Generator) -> Light:
    shift, brighter = rng.standard_normal(3), rng.standard_normal()
    return replace(
        drawn,
        position_mm=drawn.position_mm + shift * options.manufacturing_led_um / 1000,
        power=drawn.power * float(np.exp(brighter * options.manufacturing_led_power_pct / 100)),
        covariance=None,
    )


def with_tolerances(drawn: Handpiece, options: ManufacturingOptions) -> Handpiece:
    """The drawn handpiece with the tolerances as covariances; without tolerances it keeps its own covariances, or is
    exact."""
    return options.tolerances.fill(with_cameras(drawn, lambda mounted: _open(mounted, options.tolerances)))


def _draw_error(mounted: MountedCamera, tolerances: Tolerances, rng: np.random.Generator) -> MountedCamera:
    motion = tolerances.motion_sigma * rng.standard_normal(6)
    shift = tolerances.lens_factor(mounted.camera) @ rng.standard_normal(4)
    if not (motion.any() or shift.any()):
        return mounted
    place = Rigid3.from_rotation_vector(motion[:3], motion[3:]) @ mounted.cam_from_rig
    camera = replace(mounted.camera.with_parameters(mounted.camera.parameters + shift), covariance=None)
    return replace(mounted, camera=camera, cam_from_rig=place, covariance=None)


def _open(mounted: MountedCamera, tolerances: Tolerances) -> MountedCamera:
    """Without the covariances that tolerances take the place of."""
    if tolerances.lens_factor(mounted.camera).any():
        mounted = replace(mounted, camera=replace(mounted.camera, covariance=None))
    return replace(mounted, covariance=None) if tolerances.motion_sigma.any() else mounted
