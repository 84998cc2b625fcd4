"""Where a surface does not look as bright as its shade alone, seen from one camera: mirror reflections of the lights,
and light that does not leave it at grazing angles.

The mirror image of a light lies behind the surface, at another place for each camera, so that it pulls the depth of
what is compared. Crossed polarisers leave a few percent of it, spread over a spot that is as wide as the surface is
rough: some digital numbers, as much as the shade changes over many pixels. Where the spots lie follows from the places
of the lights and a first depth; how bright they are, from a common model of gloss with the values of a wet surface.
They are taken off, and what is left of a spot (its strength may be another, and the first depth is wrong where it was
pulled) decides how far to trust the comparison.

Light that is scattered below a clear surface leaves it the less the more oblique it is (Fresnel): of wet enamel 5 %
less at 60 degrees, 25 % at 77. That is known well enough to be made up for.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, no_type_check

import cv2
import numpy as np
from jaxtyping import Float, Float32

from cuspid.geometry import unit
from cuspid.geometry.gloss import coat, transmittance
from cuspid.model.camera import Camera
from cuspid.model.rig import Light
from cuspid.runtime.kernels import kernel

_REFLECTANCE, _ROUGHNESS, _ALBEDO = 0.05, 0.12, 0.5
"""Of a wet tooth: Fresnel reflectance at normal incidence (refractive index 1.6), GGX roughness, share of the light
that it scatters back."""
_MIDDLE, _WIDE, _LEAST_PX = 0.065, 0.18, 3
"""Sides, in focal lengths (0.3 and 0.9 mm at 5 mm), of the windows over which the slope of a surface is averaged, and
the least one in px of the depth map. The first follows its shape; the second looks past the pit that a reflection made
in it."""
STRENGTH, _PLACE = 0.15, 0.5
"""What a spot is uncertain by: a share of it, and a share of what it is brighter by seen past a pit."""
_LEAST_SHARE = 0.2
"""Share of a window whose depth must be known."""
_GRAZING, _OBLIQUE = 0.05, 0.2
"""Cosines of the angle to the normal, below which gloss, and light that is lost, are not told apart further: the normal
is not known well enough."""


class Glare(NamedTuple):
    """How the pixels of a depth map differ from the shade of their surface."""

    mirrored: Float32[np.ndarray, "h w 3"]
    """Mirror reflections as a share of the shade, channel by channel; 0 where the surface is not known."""
    uncertain: Float32[np.ndarray, "h w 3"]
    """What they are uncertain by."""
    leaving: Float32[np.ndarray, "h w"]
    """Share of the scattered light that leaves the surface towards the camera, relative to that along the normal; 1
    where that is not known."""


def estimate_glare(
    grid: Camera,
    depth_mm: Float[np.ndarray, "h w"],
    lights: Sequence[Light],
    exit_index: float,
) -> Glare:
    """What a first depth implies for each pixel of its grid, with lights in the frame of its camera and the refractive
    index of the surface."""
    rays = grid.rays(grid.pixel_centres().reshape(-1, 2)).reshape(grid.height, grid.width, 3)
    spots, share = np.zeros((2, *rays.shape), np.float32), np.ones(depth_mm.shape, np.float32)
    for spot, window in zip(spots, (_WIDE, _MIDDLE), strict=True):
        inverse, slopes = _smooth_depth(1 / depth_mm, max(_LEAST_PX, round(window * float(grid.focal_px.mean()))))
        # The plane 1 / Z = a x + b y + c, with x = X / Z and y = Y / Z, has the normal (a, b, c).
        across = slopes * grid.focal_px
        normals = -unit(np.dstack([across, inverse - (across * rays[..., :2]).sum(axis=-1)]))
        known = np.isfinite(normals).all(axis=-1)
        points = rays[known] / inverse[known, None]
        spot[known] = mirror_reflections(points, normals[known], lights)
        share[known] = _transmittances(-(normals[known] * unit(points)).sum(axis=-1), exit_index)
    past_pits, spot = spots
    return Glare(spot, STRENGTH * spot + _PLACE * np.maximum(past_pits - spot, 0), share)


def _smooth_depth(
    inverse_depth: Float[np.ndarray, "h w"], window: int
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w 2"]]:
    """Inverse depth, filled in where it is unknown, and its mean change to the next pixel to the right and below; NaN
    where too little is known."""
    changes = [np.diff(inverse_depth, axis=axis, append=np.nan) for axis in (1, 0)]
    mean, *slopes = (_mean_of_known(each, window) for each in (inverse_depth, *changes))
    return np.where(np.isfinite(inverse_depth), inverse_depth, mean), np.dstack(slopes)


def _mean_of_known(values: Float[np.ndarray, "h w"], window: int) -> Float[np.ndarray, "h w"]:
    known = np.isfinite(values)
    weight = cv2.blur(known.astype(np.float64), (window, window))
    total = cv2.blur(np.where(known, values, 0.0), (window, window))
    return np.where(weight > _LEAST_SHARE, total / np.maximum(weight, _LEAST_SHARE), np.nan)


def mirror_reflections(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], lights: Sequence[Light]
) -> Float[np.ndarray, "n 3"]:
    """Mirror reflections as a share of the shade, channel by channel, of points (mm) with unit normals that a camera at
    the origin sees; 0 where no light shines."""
    towards_camera = -unit(points)
    shade, mirror = np.zeros((2, len(points), 3))
    for light in lights:
        towards_light = unit(light.position_mm - points)
        half = unit(towards_light + towards_camera)
        cosines = [(a * b).sum(axis=-1) for a, b in ((normals, towards_light), (normals, towards_camera))]
        cosines += [(half * each).sum(axis=-1) for each in (normals, towards_camera)]
        irradiance = light.irradiance(points, normals)[:, None] * light.colour
        shade += _ALBEDO * irradiance
        mirror += light.glare * _gloss(*cosines)[:, None] * irradiance
    return np.divide(mirror, shade, out=np.zeros_like(shade), where=shade > 0)


@kernel(fastmath=True)
@no_type_check
def _gloss(falling, facing, halfway, grazing):
    """pi times the reflectance, from the cosines of :func:`cuspid.geometry.gloss.coat`."""
    out = np.empty_like(facing)
    for i in range(len(out)):
        nl = max(falling[i], _GRAZING)
        out[i] = coat(nl, max(facing[i], _GRAZING), halfway[i], grazing[i], _REFLECTANCE, _ROUGHNESS)[0] / nl
    return out


@kernel(fastmath=True)
@no_type_check
def _transmittances(facing, index):
    out = np.empty_like(facing)
    for i in range(len(out)):
        out[i] = transmittance(max(facing[i], _OBLIQUE), index)
    return out
