"""Perspective shape from shading with the light at the camera (thesis 4.1): one image to depth and normals.

Frame: the camera's (+X right, +Y down, looking along +Z). A pixel p is seen along the ray d = K^-1 p = (X, Y, 1), and
the surface point is P = s d, with the depth s (thesis: s p = B P + b, in the camera frame b = 0). Its normal is
N = r x q / |r x q| with r = dP/dx and q = dP/dy.

With the light at the camera, a Lambertian surface and the inverse square law, the irradiance is
E = rho cos(theta) / |P|^2. In v = log |P| and its slopes a = f dv/dx, b = f dv/dy, the cross product gives
1 / cos^2(theta) = 1 + |d|^2 (a^2 + b^2 + (X a + Y b)^2), so that every pixel has the equation

    F(v) = 1 / cos(theta) - (rho / E) exp(-2 v) = 0.

Slopes are differences towards the nearer neighbours (Rouy and Tourin 1992), F is expanded to first order in the pixel's
own v (Taylor), and all pixels step at once (Jacobi), as Tsai and Shah (1994) do for parallel light:
v <- v - F / F'. With such differences F' > 0 everywhere; with those of Tsai and Shah it vanishes along a line through
the point where the surface faces the light. rho only shifts v: depth is relative, and normals do not depend on it.

The thesis points to Abdelrahim et al. (BMVC 2011, doi:10.5244/C.25.41) for details that our copy of it does not hold;
the falloff of the light and the choice of differences are ours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from cuspid.model.camera import Camera
from cuspid.runtime.kernels import kernel
from cuspid.runtime.options import Options, Range

_COARSEST_PX = 60
"""The iteration starts on an image whose shorter side has at least this many px, and doubles it."""


@dataclass(frozen=True, kw_only=True)
class ShadingOptions(Options):
    """Shape from shading of one image."""

    iterations: Annotated[int, Range(1, 100_000)] = 40
    """Jacobi iterations at each size of the image."""
    smoothing_px: Annotated[float, Range(0.01, 1000)] = 1.5
    """Standard deviation in px of the Gaussian filter that is first applied to the image."""
    gamma: Annotated[float, Range(0.01, 100)] = 2.2
    """Linear light is the grey level to this power."""
    dark: Annotated[int, Range(1, 254)] = 20
    """Darker grey levels carry no information."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Shape:
    """What shading tells of one image."""

    depth: Float[np.ndarray, "h w"]
    """s along +Z in units of the median distance, NaN where it is dark. float32."""
    normals: Float[np.ndarray, "h w 3"]
    """Unit vectors out of the surface in the camera frame; (0, 0, -1) where it is dark. float32."""
    known: Bool[np.ndarray, "h w"]
    """Where there was light."""


def shape_from_shading(image: UInt8[np.ndarray, "h w 3"], camera: Camera, options: ShadingOptions) -> Shape:
    """Depth and normals of an RGB image of a camera without distortion."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), options.smoothing_px)
    return shape_of_light(
        (smooth / np.float32(255)) ** np.float32(options.gamma), grey >= options.dark, camera, options.iterations
    )


def shape_of_light(
    light: Float[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"], camera: Camera, iterations: int
) -> Shape:
    """Depth and normals from linear light, in any unit, where it is known."""
    floor = np.float32(1e-6) * light.max(initial=np.float32(1e-6))
    target = -np.log(np.maximum(light.astype(np.float32), floor))
    if known.any():
        target = target - np.median(target[known])
    distance = np.where(known, _solve(target, known, camera, iterations), np.float32(np.nan))
    x, y = _rays(camera)
    depth = distance - np.float32(0.5) * np.log(1 + x * x + y * y)
    return Shape(depth=np.exp(depth), normals=_normals(depth, known, camera), known=known)


def _rays(camera: Camera) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """X and Y of the ray (X, Y, 1) through each pixel."""
    rays = camera.rays(camera.pixel_centres()).astype(np.float32)
    return rays[..., 0].copy(), rays[..., 1].copy()


def _halve(camera: Camera) -> Camera:
    """The same view in half as many pixels, rounded down."""
    return replace(
        camera,
        width=camera.width // 2,
        height=camera.height // 2,
        focal_px=camera.focal_px / 2,
        principal_point_px=camera.principal_point_px / 2,
    )


def _solve(
    target: Float[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"], camera: Camera, iterations: int
) -> Float[np.ndarray, "h w"]:
    """log |P| for log(rho / E): first on a smaller image, then here."""
    start = target / 2
    if min(target.shape) >= 2 * _COARSEST_PX:
        small = _halve(camera)
        size = (small.width, small.height)
        share = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        mean = cv2.resize(np.where(known, target, 0), size, interpolation=cv2.INTER_AREA) / np.maximum(share, 1e-6)
        coarse = _solve(mean, share > 0.5, small, iterations)
        start = cv2.resize(coarse, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
        start = np.minimum(start, target / 2)
    values = np.where(known, start, np.float32(np.inf)).astype(np.float32)
    x, y = _rays(camera)
    focal = camera.focal_px.astype(np.float32)
    other = values.copy()
    for _ in range(iterations):
        _jacobi(values, target, x, y, focal[0], focal[1], other)
        values, other = other, values
    return np.where(known, values, target / 2).astype(np.float32)


@kernel
@no_type_check
def _jacobi(v, target, x, y, fx, fy, out):
    """One Newton step of every pixel with its neighbours held; v is infinite where it is not known."""
    height, width = v.shape
    infinite, zero, half, two = np.float32(np.inf), np.float32(0), np.float32(0.5), np.float32(2)
    for i in range(height):
        for j in range(width):
            here = v[i, j]
            if here == infinite:
                continue
            west = v[i, j - 1] if j > 0 else infinite
            east = v[i, j + 1] if j < width - 1 else infinite
            north = v[i - 1, j] if i > 0 else infinite
            south = v[i + 1, j] if i < height - 1 else infinite
            nearest_x, nearest_y = min(west, east), min(north, south)
            # The slopes, and what they gain as the pixel's own v grows.
            turn_x = fx if west <= east else -fx
            turn_y = fy if north <= south else -fy
            rise_x, rise_y = max(here - nearest_x, zero), max(here - nearest_y, zero)
            a, b = rise_x * turn_x, rise_y * turn_y
            da = turn_x if rise_x > zero else zero
            db = turn_y if rise_y > zero else zero
            along = x[i, j] * a + y[i, j] * b
            ray2 = np.float32(1) + x[i, j] * x[i, j] + y[i, j] * y[i, j]
            tangent2 = ray2 * (a * a + b * b + along * along)
            slope = two * ray2 * ((a + x[i, j] * along) * da + (b + y[i, j] * along) * db)
            secant, falloff = np.sqrt(np.float32(1) + tangent2), np.exp(target[i, j] - two * here)
            residual = secant - falloff
            gain = half * max(slope, zero) / secant + two * falloff
            # Below its nearest neighbour a pixel has no slope: there the equation is 2 v = target.
            lowest = min(nearest_x, nearest_y, half * target[i, j])
            out[i, j] = max(here - residual / gain, lowest)


def _normals(
    depth: Float[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"], camera: Camera
) -> Float[np.ndarray, "h w 3"]:
    """r x q / |r x q| towards the camera, for the logarithm of the depth: (a, b, -(1 + X a + Y b)) with its slopes."""
    x, y = _rays(camera)
    fx, fy = camera.focal_px.astype(np.float32)
    a, b = fx * _slope(depth, 1), fy * _slope(depth, 0)
    vectors = np.stack([a, b, -(1 + x * a + y * b)], axis=-1)
    vectors[~known] = (0, 0, -1)
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True), dtype=np.float32)


def _slope(values: Float[np.ndarray, "h w"], axis: int) -> Float[np.ndarray, "h w"]:
    """Central difference for each px; one-sided beside NaN and at the border, 0 where there is no neighbour."""
    step = np.diff(values, axis=axis)
    both = [np.concatenate(pair, axis) for pair in _pad(step, axis)]
    count = sum(np.isfinite(each) for each in both)
    total = sum(np.nan_to_num(each) for each in both)
    return np.asarray(total / np.maximum(count, 1), dtype=np.float32)


def _pad(step: Float[np.ndarray, "h w"], axis: int) -> list[list[np.ndarray]]:
    """The differences before and after each pixel, NaN beyond the border."""
    border = np.full_like(np.take(step, [0], axis=axis), np.nan)
    return [[border, step], [step, border]]
