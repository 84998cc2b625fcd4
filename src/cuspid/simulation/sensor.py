"""Converts linear light to the digital numbers of an 8-bit RGB image: falloff, gain, gamma, noise, rounding."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

from cuspid.model.rig import Handpiece, Sensor


def expose(
    radiance: Float[np.ndarray, "h w 3"], gain: float, sensor: Sensor, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """The image that the sensor records. ``gain`` times the linear radiance of 1 is full scale."""
    signal = np.clip(gain * radiance, 0, 1).astype(np.float32)
    level = np.float32(255) * signal ** np.float32(1 / sensor.gamma)
    noisy = level + sensor.noise_sd_dn(level) * rng.standard_normal(level.shape, dtype=np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def record(
    radiance: Float[np.ndarray, "h w 3"], gain: float, handpiece: Handpiece, name: str, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """The image that a camera of a handpiece records, including its own gain and the falloff of its lens."""
    sensor, camera = handpiece.sensor_of(name), handpiece.rig[name].camera
    if sensor.gain != 1 or any(sensor.falloff):
        radiance = radiance * sensor.relative_response(camera, camera.pixel_centres())[..., None]
    return expose(radiance, gain, sensor, rng)
