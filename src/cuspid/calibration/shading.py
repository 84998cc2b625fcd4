"""The response of the cameras to light, and the lights themselves, in one adjustment.

A patch of a board shows a grey value y, of which ``gamma_c log(y / 255)`` is a sum of logarithms of linear light: a
level common to all, the loss by ink, ``log g_c + a_c r^2 + b_c r^4`` of the camera (:class:`cuspid.model.rig.Sensor`),
``log E(X)`` of the lights that are on (:meth:`cuspid.model.rig.Light.irradiance`), and a polynomial in the place (u, v)
on the board at this instant, by which the light differs from that: a diffuse (Lambertian) surface looks equally bright
from all sides, so all cameras share it. If no lights are known, it alone is the light, of degree 4 and free. If they
are, it is of degree 2 and small, and how small is estimated with the rest (D. J. C. MacKay, Neural Computation 4,
1992): it absorbs errors of the poses of the board, which all patches of an instant share.

Unknowns are deviations from what was given: of each camera (log g, a, b, log gamma), kind by kind; level, ink; of each
light its position (mm, in the rig) and the logarithm of its power. A prior with mean 0 decides what the images leave
open. The mean of the logarithms of the gains is 0, and so is that of the powers, because the level is free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.model.rig import Light

PER_CAMERA, PER_LIGHT = 4, 4
_COMMON = 2
KNOWN_DEGREE, UNKNOWN_DEGREE = 2, 4
"""Degree of the polynomial of the light at an instant, if the lamps are known and if not."""
_KNEE = 2.5
"""Residuals beyond this, in standard deviations, have less weight (Huber)."""
_STEPS, _SETTLED, _STEADY = 60, 0.01, 0.03
"""Maximum number of steps; the decrease of the cost below which iteration ends; and the change of a deviation, as a
share of it."""
_UNKNOWN, _DOUBTED = 10.0, 0.1
"""Standard deviation of the terms of a light that is not known, and the initial one of a light that is (logarithm of
light)."""
_STEADIEST = 1e-3
"""Minimum standard deviation of the light at an instant: no lamp is steadier."""
_LEAST = 1e-4
"""Standard deviation of what is held fixed."""
_DIMMEST = 1e-12


@dataclass(frozen=True, eq=False, kw_only=True)
class Samples:
    """Patches of all images, instant after instant, as arrays."""

    camera: Int[np.ndarray, "n"]
    starts: Int[np.ndarray, "k"]
    """Where the patches of each instant begin, and where the last ones end."""
    value: Float[np.ndarray, "n"]
    """Logarithm of the grey value, as a share of full scale."""
    sigma: Float[np.ndarray, "n"]
    """Standard deviation of that value due to noise."""
    dark: Bool[np.ndarray, "n"]
    terms: Float[np.ndarray, "n 2"]
    """Terms of the falloff: r^2 and r^4."""
    basis: Float[np.ndarray, "n t"]
    """Terms of the light at an instant (:func:`polynomials`)."""
    points: Float[np.ndarray, "n 3"]
    """Positions in the rig frame, mm."""
    normals: Float[np.ndarray, "n 3"]
    """Normals of the board there."""
    lit: tuple[tuple[int, ...], ...]
    """The lights that are on at each instant."""

    @property
    def parts(self) -> list[slice]:
        """The patches of each instant."""
        return [slice(a, b) for a, b in zip(self.starts[:-1], self.starts[1:], strict=True)]


@dataclass(frozen=True, eq=False, kw_only=True)
class Given:
    """What was known beforehand."""

    gamma: Float[np.ndarray, "c"]
    """Gamma of each camera."""
    lights: tuple[Light, ...]
    """Empty if the light is not known."""
    precision: Float[np.ndarray, "g g"]
    """Precision matrix of the prior of the unknowns."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Shading:
    """Result of the adjustment."""

    unknowns: Float[np.ndarray, "g"]
    covariance: Float[np.ndarray, "g g"]
    extra: Float[np.ndarray, "i t"]
    """Terms of the light at each instant."""
    extra_sigma: Float[np.ndarray, "d"]
    """Standard deviations of its terms of degree 0, 1, ... over all instants."""
    residuals: Float[np.ndarray, "n"]
    """Residuals of the values."""
    scale: float
    """Standard deviation of the residuals relative to what noise would make it."""
    settled: bool


def polynomials(places: Float[np.ndarray, "n 2"], degree: int) -> Float[np.ndarray, "n t"]:
    """1, u, v, u^2, u v, v^2, ... of places up to a degree."""
    u, v = places.T
    return np.stack([u ** (d - k) * v**k for d in range(degree + 1) for k in range(d + 1)], axis=1)


def _degrees(terms: int) -> Int[np.ndarray, "t"]:
    """Of so many terms of :func:`polynomials`."""
    return np.repeat(np.arange(terms), np.arange(1, terms + 1))[:terms]


def camera_columns(camera: int, cameras: int) -> Int[np.ndarray, "4"]:
    """Indices of the unknowns of a camera."""
    return camera + cameras * np.arange(PER_CAMERA)


def light_columns(light: int, cameras: int) -> Int[np.ndarray, "4"]:
    """Indices of the unknowns of a light."""
    return PER_CAMERA * cameras + _COMMON + PER_LIGHT * light + np.arange(PER_LIGHT)


def common_columns(cameras: int) -> Int[np.ndarray, "2"]:
    """Indices of the level and the ink."""
    return PER_CAMERA * cameras + np.arange(_COMMON)


def prior(
    cameras: int, light_covariances: Sequence[Float[np.ndarray, "4 4"]], falloff_sigma: float, gamma_sigma: float
) -> Float[np.ndarray, "g g"]:
    """Precision matrix of the prior: gains and powers are free except for their mean; the gammas deviate together, and
    each individually by as much."""
    size = PER_CAMERA * cameras + _COMMON + PER_LIGHT * len(light_covariances)
    precision = np.zeros((size, size))
    every = np.arange(cameras)
    precision[np.ix_(every, every)] = _LEAST**-2.0
    precision[cameras + np.arange(2 * cameras), cameras + np.arange(2 * cameras)] = falloff_sigma**-2.0
    common = common_columns(cameras)
    precision[common, common] = _UNKNOWN**-2.0
    gammas = np.ix_(3 * cameras + every, 3 * cameras + every)
    alike, apart = np.full((cameras, cameras), 1 / cameras), np.eye(cameras) - 1 / cameras
    precision[gammas] = (alike / cameras + apart) / max(gamma_sigma, _LEAST) ** 2
    columns = [light_columns(k, cameras) for k in range(len(light_covariances))]
    for own, covariance in zip(columns, light_covariances, strict=True):
        precision[np.ix_(own, own)] = np.linalg.inv(covariance)
    powers = [own[-1] for own in columns]
    precision[np.ix_(powers, powers)] += _LEAST**-2.0
    return precision


# --- model -------------------------------------------------------------------------------------------------------


def _model(
    samples: Samples, given: Given, unknowns: Float[np.ndarray, "g"], extra: Float[np.ndarray, "i t"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n g"], Float[np.ndarray, "n t"]]:
    """The values, and their derivatives by the unknowns and by the light of their instant."""
    cameras, rows = len(given.gamma), np.arange(len(samples.value))
    by = np.zeros((len(rows), len(unknowns)))
    by[rows, samples.camera] = 1
    by[rows, cameras + samples.camera], by[rows, 2 * cameras + samples.camera] = samples.terms.T
    level, ink = common_columns(cameras)
    by[:, level], by[:, ink] = 1, samples.dark
    linear = by @ unknowns
    if given.lights:
        first = PER_CAMERA * cameras + _COMMON
        shade, by[:, first:] = _lamplight(samples, given.lights, unknowns[first:].reshape(-1, PER_LIGHT))
        linear = by[:, :first] @ unknowns[:first] + shade
    for part, own in zip(samples.parts, extra, strict=True):
        linear[part] += samples.basis[part] @ own
    gamma = (given.gamma * np.exp(unknowns[3 * cameras : 4 * cameras]))[samples.camera]
    value = linear / gamma
    by /= gamma[:, None]
    by[rows, 3 * cameras + samples.camera] = -value
    return value, by, samples.basis / gamma[:, None]


def _lamplight(
    samples: Samples, lights: Sequence[Light], changes: Float[np.ndarray, "l 4"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n m"]]:
    """Logarithm of the light of the lamps, and its derivatives by their places and the logarithms of their powers."""
    total, by = np.zeros(len(samples.value)), np.zeros((len(samples.value), PER_LIGHT * len(lights)))
    for part, on in zip(samples.parts, samples.lit, strict=True):
        for k in on:
            own = slice(PER_LIGHT * k, PER_LIGHT * (k + 1))
            light, by[part, own] = _one_lamp(lights[k], changes[k], samples.points[part], samples.normals[part])
            by[part, own] *= light[:, None]
            total[part] += light
    total = np.maximum(total, _DIMMEST)
    return np.log(total), by / total[:, None]


def _one_lamp(
    light: Light, change: Float[np.ndarray, "4"], points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 4"]]:
    """Light of a lamp that is off by a change, and the derivatives of its logarithm."""
    moved = Light(
        position_mm=light.position_mm + change[:3],
        direction=light.direction,
        power=light.power * float(np.exp(change[3])),
        lobe_exponent=light.lobe_exponent,
    )
    towards = moved.position_mm - points
    squared = (towards**2).sum(axis=1)
    leaving, arriving = -(towards @ moved.direction), (towards * normals).sum(axis=1)
    reached = (leaving > 0) & (arriving > 0)
    by = np.zeros((len(points), PER_LIGHT))
    by[:, 3] = 1
    m = moved.lobe_exponent
    with np.errstate(divide="ignore", invalid="ignore"):
        place = -m * moved.direction / leaving[:, None] + normals / arriving[:, None]
        by[:, :3] = np.where(reached[:, None], place - (3 + m) * towards / squared[:, None], 0)
    return moved.irradiance(points, normals), by


# --- adjustment --------------------------------------------------------------------------------------------------


def adjust_shading(
    samples: Samples,
    given: Given,
    *,
    held: Float[np.ndarray, "g"] | None = None,
    extra_sigma: Float[np.ndarray, "d"] | None = None,
) -> Shading:
    """The unknowns that best explain the brightness of the patches (Gauss-Newton on the Huber loss).

    Values in ``held`` are kept fixed (NaN where they are free). How far the light at an instant deviates from that of
    the lamps is estimated, unless it is given; if no lamps are known, it is unconstrained.
    """
    start = np.zeros(len(given.precision)) if held is None else np.nan_to_num(held)
    free = np.flatnonzero(np.ones(len(start), dtype=bool) if held is None else np.isnan(held))
    learn = bool(given.lights) and extra_sigma is None
    terms = samples.basis.shape[1]
    sigma = extra_sigma
    if sigma is None:
        sigma = np.full(_degrees(terms)[-1] + 1, _DOUBTED if given.lights else _UNKNOWN)
    unknowns, extra = start, np.zeros((len(samples.lit), terms))
    settled, steps = False, 0
    while not settled and steps < _STEPS:
        steps += 1
        normal = _normal(samples, given, unknowns, extra, sigma, free)
        unknowns = unknowns.copy()
        unknowns[free] += normal.step
        extra = extra + normal.extra_step
        before = sigma
        if learn:
            sigma = _degree_sigmas(extra, normal.extra_variance, sigma)
        steady = bool(np.all(np.abs(np.log(sigma / before)) < _STEADY))
        settled = float(normal.step @ normal.gradient) < _SETTLED and steady
    normal = _normal(samples, given, unknowns, extra, sigma, free)
    covariance = np.zeros_like(given.precision)
    covariance[np.ix_(free, free)] = normal.inverse
    return Shading(
        unknowns=unknowns,
        covariance=covariance,
        extra=extra,
        extra_sigma=sigma,
        residuals=samples.value - _model(samples, given, unknowns, extra)[0],
        scale=normal.scale,
        settled=settled,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Normal:
    """Normal equations without the light of the instants, and what they say."""

    gradient: Float[np.ndarray, "f"]
    inverse: Float[np.ndarray, "f f"]
    step: Float[np.ndarray, "f"]
    extra_step: Float[np.ndarray, "i t"]
    extra_variance: Float[np.ndarray, "i t"]
    scale: float


def _normal(
    samples: Samples,
    given: Given,
    unknowns: Float[np.ndarray, "g"],
    extra: Float[np.ndarray, "i t"],
    sigma: Float[np.ndarray, "d"],
    free: Int[np.ndarray, "f"],
) -> _Normal:
    value, by, by_extra = _model(samples, given, unknowns, extra)
    off = (samples.value - value) / samples.sigma
    scale = max(float(np.median(np.abs(off))) * 1.4826, _LEAST)
    weight = np.sqrt(np.minimum(1, _KNEE / np.maximum(np.abs(off) / scale, _DIMMEST))) / scale
    off, rows = weight * off, weight / samples.sigma
    by, by_extra = by[:, free] * rows[:, None], by_extra * rows[:, None]
    matrix = given.precision[np.ix_(free, free)].copy()
    gradient = -(given.precision @ unknowns)[free]
    hold = sigma[_degrees(extra.shape[1])] ** -2.0
    blocks = []
    for part, own in zip(samples.parts, extra, strict=True):
        inner = np.linalg.inv(by_extra[part].T @ by_extra[part] + np.diag(hold))
        cross = by_extra[part].T @ by[part]
        pull = by_extra[part].T @ off[part] - hold * own
        matrix += by[part].T @ by[part] - cross.T @ inner @ cross
        gradient += by[part].T @ off[part] - cross.T @ inner @ pull
        blocks.append((inner, inner @ cross, inner @ pull))
    inverse = np.linalg.inv(matrix)
    step = inverse @ gradient
    return _Normal(
        gradient=gradient,
        inverse=inverse,
        step=step,
        extra_step=np.stack([pull - cross @ step for _, cross, pull in blocks]),
        extra_variance=np.stack([np.diag(inner + cross @ inverse @ cross.T) for inner, cross, _ in blocks]),
        scale=scale,
    )


def _degree_sigmas(
    extra: Float[np.ndarray, "i t"], variance: Float[np.ndarray, "i t"], before: Float[np.ndarray, "d"]
) -> Float[np.ndarray, "d"]:
    """Standard deviations of the terms of each degree: the squares of the terms over how many of them the images tell
    (a step of MacKay's)."""
    squares, degrees = (extra**2).mean(axis=0), _degrees(extra.shape[1])
    information = 1 - variance.mean(axis=0) / before[degrees] ** 2
    found = [
        squares[degrees == d].mean() / max(information[degrees == d].mean(), _DIMMEST) for d in range(degrees[-1] + 1)
    ]
    return np.asarray(np.clip(np.sqrt(found), _STEADIEST, _UNKNOWN))
