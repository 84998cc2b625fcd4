"""Projection of points, its derivatives, and its inverse, compiled: the only place that knows the formulas of the
models (:mod:`cuspid.geometry.cameras.models`)."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float

from cuspid.geometry.cameras.models import GRID
from cuspid.runtime.kernels import kernel

_OPENCV, _FULL_OPENCV, _OPENCV_FISHEYE, _SPLINED = 0, 1, 2, 4
_REACH, _CONTROL = 8, 9
"""Where the parameters of a splined lens have its reach and the first of its control points."""
_STEPS, _SETTLED = 30, 1e-14
"""Of Newton's method for the inverse; and the step, in units of the ideal image, below which it ends."""
_FARTHEST, _NEAR = 0.5, 0.1
"""Length of a step at most, as a share of the distance from the axis, or in units of the ideal image."""
_WRONG = 1e-9
"""Where what was found projects farther from the pixel than this, in the same units, there is no inverse."""
_INSIDE = 0.99
"""Share of the radius at which the model folds that the search goes back to."""
_ON_AXIS = 1e-6
"""Tangent of an angle from the axis below which an equidistant lens is expanded about it."""


@kernel
@no_type_check
def _radial(model, k, r2):
    """Radial factor, its derivative by r^2, and what its numerator is divided by."""
    if model == _OPENCV:
        return 1 + k[4] * r2 + k[5] * r2 * r2, k[4] + 2 * k[5] * r2, 1.0
    if model == _FULL_OPENCV:
        numerator = 1 + r2 * (k[4] + r2 * (k[5] + r2 * k[8]))
        denominator = 1 + r2 * (k[9] + r2 * (k[10] + r2 * k[11]))
        radial = numerator / denominator
        by_r2 = k[4] + r2 * (2 * k[5] + r2 * 3 * k[8])
        return radial, (by_r2 - radial * (k[9] + r2 * (2 * k[10] + r2 * 3 * k[11]))) / denominator, denominator
    third, fourth = (k[6], k[7]) if model in (_OPENCV_FISHEYE, _SPLINED) else (k[8], k[9])
    factor = 1 + r2 * (k[4] + r2 * (k[5] + r2 * (third + r2 * fourth)))
    return factor, k[4] + r2 * (2 * k[5] + r2 * (3 * third + r2 * 4 * fourth)), 1.0


@kernel
@no_type_check
def _decentering(model, k):
    """p1, p2, s1, s2."""
    if model in (_OPENCV_FISHEYE, _SPLINED):
        return 0.0, 0.0, 0.0, 0.0
    if model <= _FULL_OPENCV:
        return k[6], k[7], 0.0, 0.0
    return k[6], k[7], k[10], k[11]


@kernel
@no_type_check
def _ideal(model, x, y, z):
    """Where an ideal lens shows a point; of a perspective one only with z > 0."""
    if model <= _FULL_OPENCV:
        return x / z, y / z
    side = np.hypot(x, y)
    if side <= _ON_AXIS * z:
        return x / z, y / z
    share = np.arctan2(side, z) / side
    return share * x, share * y


@kernel
@no_type_check
def _cell(at, reach):
    """The first control point about a place along one side of the grid (the others follow), and how far it is beyond
    the second one, in their distances."""
    place = (at + reach) * (GRID - 3) / (2 * reach)
    first = np.floor(place)
    return int(first), place - first


@kernel
@no_type_check
def _weight(point, s):
    """Of one of the four control points about a place, for the cubic B-spline, and its derivative by the place."""
    if point == 0:
        return (1 - s) ** 3 / 6, -((1 - s) ** 2) / 2
    if point == 1:
        return (3 * s**3 - 6 * s**2 + 4) / 6, (3 * s**2 - 4 * s) / 2
    if point == 2:
        return (-3 * s**3 + 3 * s**2 + 3 * s + 1) / 6, (-3 * s**2 + 2 * s + 1) / 2
    return s**3 / 6, s**2 / 2


@kernel
@no_type_check
def _shift(k, u, v):
    """By how much the grid of a splined lens shifts a place, then the derivatives of this by u and v: of the first by
    both, then of the second."""
    x = y = xu = xv = yu = yv = 0.0
    per = (GRID - 3) / (2 * k[_REACH])
    # What lies far out must not become a whole number that is none.
    if not abs(u) < 4 * k[_REACH] or not abs(v) < 4 * k[_REACH]:
        return x, y, xu, xv, yu, yv
    column, s = _cell(u, k[_REACH])
    row, t = _cell(v, k[_REACH])
    for b in range(4):
        for a in range(4):
            if 0 <= row + b < GRID and 0 <= column + a < GRID:
                wu, du = _weight(a, s)
                wv, dv = _weight(b, t)
                one = _CONTROL + (row + b) * GRID + column + a
                other = one + GRID * GRID
                x, xu, xv = x + wu * wv * k[one], xu + per * du * wv * k[one], xv + per * wu * dv * k[one]
                y, yu, yv = y + wu * wv * k[other], yu + per * du * wv * k[other], yv + per * wu * dv * k[other]
    return x, y, xu, xv, yu, yv


@kernel
@no_type_check
def distort(model, k, u, v):
    """Where a lens shows a place of the ideal one, before focal length and principal point."""
    r2 = u * u + v * v
    radial, _, _ = _radial(model, k, r2)
    if model == _SPLINED:
        x, y, _, _, _, _ = _shift(k, u, v)
        return u * radial + x, v * radial + y
    p1, p2, s1, s2 = _decentering(model, k)
    return (
        u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + s1 * r2,
        v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v) + s2 * r2,
    )


@kernel
@no_type_check
def _ideal_derivatives(model, k, u, v):
    """Derivatives of :func:`distort` by u and v: of the first by both, then of the second."""
    r2 = u * u + v * v
    radial, slope, _ = _radial(model, k, r2)
    if model == _SPLINED:
        _, _, xu, xv, yu, yv = _shift(k, u, v)
        cross = 2 * u * v * slope
        return radial + 2 * u * u * slope + xu, cross + xv, cross + yu, radial + 2 * v * v * slope + yv
    p1, p2, s1, s2 = _decentering(model, k)
    cross = 2 * u * v * slope + 2 * p1 * u + 2 * p2 * v
    return (
        radial + 2 * u * u * slope + 2 * p1 * v + 6 * p2 * u + 2 * s1 * u,
        cross + 2 * s1 * v,
        cross + 2 * s2 * u,
        radial + 2 * v * v * slope + 2 * p2 * u + 6 * p1 * v + 2 * s2 * v,
    )


@kernel
@no_type_check
def _control_derivatives(k, u, v, by_parameters, at):
    """Derivatives by the reach and the control points of a splined lens."""
    _, _, xu, xv, yu, yv = _shift(k, u, v)
    by_parameters[0, at + _REACH] = -k[0] * (xu * u + xv * v) / k[_REACH]
    by_parameters[1, at + _REACH] = -k[1] * (yu * u + yv * v) / k[_REACH]
    if not abs(u) < 4 * k[_REACH] or not abs(v) < 4 * k[_REACH]:
        return
    column, s = _cell(u, k[_REACH])
    row, t = _cell(v, k[_REACH])
    for b in range(4):
        for a in range(4):
            if 0 <= row + b < GRID and 0 <= column + a < GRID:
                weight = _weight(a, s)[0] * _weight(b, t)[0]
                control = _CONTROL + (row + b) * GRID + column + a
                by_parameters[0, at + control] = weight * k[0]
                by_parameters[1, at + control + GRID * GRID] = weight * k[1]


@kernel
@no_type_check
def _pixel(model, k, u, v):
    """Pixel of a place of the ideal lens."""
    xd, yd = distort(model, k, u, v)
    return k[0] * xd + k[2], k[1] * yd + k[3]


@kernel
@no_type_check
def project(model, k, x, y, z):
    """Pixel of a point in the camera frame; before a perspective camera z must be positive."""
    u, v = _ideal(model, x, y, z)
    return _pixel(model, k, u, v)


@kernel
@no_type_check
def point_jacobian(model, k, x, y, z, by_point):
    """Projection of a point in the camera frame, and its derivatives by the point (2x3).

    ``k`` is (fx, fy, cx, cy, ...); before a perspective camera z must be positive.
    """
    fx, fy = k[0], k[1]
    u, v = _ideal(model, x, y, z)
    xu, xv, yu, yv = _ideal_derivatives(model, k, u, v)
    if model <= _FULL_OPENCV:
        by_point[0, 0], by_point[0, 1] = fx * xu / z, fx * xv / z
        by_point[1, 0], by_point[1, 1] = fy * yu / z, fy * yv / z
        by_point[0, 2] = -(by_point[0, 0] * u + by_point[0, 1] * v)
        by_point[1, 2] = -(by_point[1, 0] * u + by_point[1, 1] * v)
    else:
        # (u, v) = s (x, y) with s the angle from the axis over the distance from it.
        side2 = x * x + y * y
        away2 = side2 + z * z
        if side2 <= (_ON_AXIS * z) ** 2:
            s, c = 1 / z, -2 / (3 * z * z * z)
        else:
            side = np.sqrt(side2)
            s = np.arctan2(side, z) / side
            c = (z / away2 - s) / side2
        ux, uy, vy = s + c * x * x, c * x * y, s + c * y * y
        by_point[0, 0], by_point[0, 1] = fx * (xu * ux + xv * uy), fx * (xu * uy + xv * vy)
        by_point[1, 0], by_point[1, 1] = fy * (yu * ux + yv * uy), fy * (yu * uy + yv * vy)
        by_point[0, 2] = -fx * (xu * x + xv * y) / away2
        by_point[1, 2] = -fy * (yu * x + yv * y) / away2
    return _pixel(model, k, u, v)


@kernel
@no_type_check
def parameter_jacobian(model, k, x, y, z, by_parameters, at):
    """Derivatives of the projection of a point by the parameters, in the columns of ``by_parameters`` from ``at`` on;
    zero beyond those of the model."""
    fx, fy = k[0], k[1]
    u, v = _ideal(model, x, y, z)
    for column in range(at, at + len(k)):
        by_parameters[0, column] = by_parameters[1, column] = 0.0
    by_parameters[0, at], by_parameters[1, at + 1] = distort(model, k, u, v)
    by_parameters[0, at + 2], by_parameters[1, at + 3] = 1.0, 1.0
    r2 = u * u + v * v
    radial, _, divided = _radial(model, k, r2)
    a, b = fx * u * r2 / divided, fy * v * r2 / divided
    by_parameters[0, at + 4], by_parameters[1, at + 4] = a, b
    by_parameters[0, at + 5], by_parameters[1, at + 5] = a * r2, b * r2
    if model in (_OPENCV_FISHEYE, _SPLINED):
        by_parameters[0, at + 6], by_parameters[1, at + 6] = a * r2 * r2, b * r2 * r2
        by_parameters[0, at + 7], by_parameters[1, at + 7] = a * r2 * r2 * r2, b * r2 * r2 * r2
        if model == _SPLINED:
            _control_derivatives(k, u, v, by_parameters, at)
        return
    by_parameters[0, at + 6], by_parameters[1, at + 6] = fx * 2 * u * v, fy * (r2 + 2 * v * v)
    by_parameters[0, at + 7], by_parameters[1, at + 7] = fx * (r2 + 2 * u * u), fy * 2 * u * v
    if model == _OPENCV:
        return
    by_parameters[0, at + 8], by_parameters[1, at + 8] = a * r2 * r2, b * r2 * r2
    if model == _FULL_OPENCV:
        for power in range(3):
            by_parameters[0, at + 9 + power], by_parameters[1, at + 9 + power] = -radial * a, -radial * b
            a, b = a * r2, b * r2
        return
    by_parameters[0, at + 9], by_parameters[1, at + 9] = a * r2 * r2 * r2, b * r2 * r2 * r2
    by_parameters[0, at + 10], by_parameters[1, at + 11] = fx * r2, fy * r2


@kernel
@no_type_check
def _project_points(model, k, limit, points, out):
    for n in range(points.shape[0]):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        out[n, 0] = out[n, 1] = np.nan
        if model <= _FULL_OPENCV and not z > 0:
            continue
        u, v = _ideal(model, x, y, z)
        if u * u + v * v <= limit * limit:
            out[n, 0], out[n, 1] = _pixel(model, k, u, v)


@kernel
@no_type_check
def _derivatives(model, k, points, by_point, by_parameters):
    for n in range(points.shape[0]):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if model <= _FULL_OPENCV and not z > 0:
            by_point[n], by_parameters[n] = np.nan, np.nan
        else:
            point_jacobian(model, k, x, y, z, by_point[n])
            parameter_jacobian(model, k, x, y, z, by_parameters[n], 0)


@kernel
@no_type_check
def _invert_distortion(model, k, limit, a, b):
    """The place of the ideal lens that is shown at (a, b), by Newton's method; NaN where there is none."""
    u, v = a, b
    for _ in range(_STEPS):
        # What lies beyond the fold would lead to a place on the wrong side of it.
        length = np.hypot(u, v)
        if length > limit:
            u, v = _INSIDE * u * limit / length, _INSIDE * v * limit / length
        xd, yd = distort(model, k, u, v)
        xu, xv, yu, yv = _ideal_derivatives(model, k, u, v)
        determinant = xu * yv - xv * yu
        step_u, step_v = (yv * (xd - a) - xv * (yd - b)) / determinant, (xu * (yd - b) - yu * (xd - a)) / determinant
        if not np.isfinite(step_u + step_v):
            break
        # Beside the fold the slope is nearly 0, and a whole step leads far past the place.
        share = min(1.0, max(_FARTHEST * np.hypot(u, v), _NEAR) / max(np.hypot(step_u, step_v), _NEAR))
        u, v = u - share * step_u, v - share * step_v
        if abs(step_u) + abs(step_v) < _SETTLED:
            break
    xd, yd = distort(model, k, u, v)
    if not abs(xd - a) + abs(yd - b) < _WRONG or np.hypot(u, v) > limit:
        return np.nan, np.nan
    return u, v


@kernel
@no_type_check
def _directions(model, k, limit, pixels, out):
    straight = not np.any(k[4:])
    for n in range(pixels.shape[0]):
        u, v = (pixels[n, 0] - k[2]) / k[0], (pixels[n, 1] - k[3]) / k[1]
        if not straight:
            u, v = _invert_distortion(model, k, limit, u, v)
        if model <= _FULL_OPENCV:
            out[n, 0], out[n, 1], out[n, 2] = u, v, 1.0
            continue
        angle = np.hypot(u, v)
        if not angle <= limit:
            out[n] = np.nan
            continue
        share = np.sin(angle) / angle if angle > 0 else 1.0
        out[n, 0], out[n, 1], out[n, 2] = share * u, share * v, np.cos(angle)


def _flat(values: Float[np.ndarray, "*n d"]) -> Float[np.ndarray, "m d"]:
    return np.ascontiguousarray(values, dtype=np.float64).reshape(-1, values.shape[-1])


def project_points(
    model: int, parameters: Float[np.ndarray, "k"], limit: float, points: Float[np.ndarray, "*n 3"]
) -> Float[np.ndarray, "*n 2"]:
    """Pixels of points in the camera frame; NaN behind a perspective camera, and beyond the ideal radius ``limit``."""
    out = np.empty((*points.shape[:-1], 2))
    _project_points(model, parameters, limit, _flat(points), out.reshape(-1, 2))
    return out


def projection_derivatives(
    model: int, parameters: Float[np.ndarray, "k"], points: Float[np.ndarray, "*n 3"]
) -> tuple[Float[np.ndarray, "*n 2 3"], Float[np.ndarray, "*n 2 k"]]:
    """Derivatives of the pixels by points in the camera frame, and by the parameters; NaN behind a perspective
    camera."""
    count = len(parameters)
    by_point, by_parameters = np.empty((*points.shape[:-1], 2, 3)), np.empty((*points.shape[:-1], 2, count))
    _derivatives(model, parameters, _flat(points), by_point.reshape(-1, 2, 3), by_parameters.reshape(-1, 2, count))
    return by_point, by_parameters


def directions_through(
    model: int, parameters: Float[np.ndarray, "k"], limit: float, pixels: Float[np.ndarray, "*n 2"]
) -> Float[np.ndarray, "*n 3"]:
    """Directions in the camera frame through pixels: with Z = 1 of a perspective lens, of unit length of an equidistant
    one; NaN where the lens shows nothing."""
    out = np.empty((*pixels.shape[:-1], 3))
    _directions(model, parameters, limit, _flat(pixels), out.reshape(-1, 3))
    return out
