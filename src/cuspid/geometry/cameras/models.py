"""The camera models, and where they hold.

Parameters are (fx, fy, cx, cy) and those of the lens, in COLMAP's order. A model takes the direction of a point to a
place (u, v) of an *ideal* lens: (x / z, y / z) of a perspective one, or the angle from the axis, in rad, times the unit
vector sideways of an equidistant one. The lens then distorts that place: radially by a factor that is a polynomial of
r^2 = u^2 + v^2 (or a ratio of two), tangentially by p1 and p2 (D. C. Brown, Photogramm. Eng. 32, 1966), and by thin
prisms (s1, s2) (J. Weng et al., IEEE Trans. PAMI 14, 1992).

A splined lens shifts that place besides, by what a grid of control points says: a uniform cubic B-spline of (u, v), of
which those within ``reach`` of the axis, each way, are covered by the grid; farther out it fades away (after the
splined model of D. Kogan's mrcal, whose base is stereographic). COLMAP has no such model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class LensModel:
    """How a lens maps directions to the image."""

    code: int
    """What the compiled kernels call it."""
    names: tuple[str, ...]
    """Of the parameters of its distortion, in COLMAP's order."""
    numerator: tuple[int, ...]
    """Which of these are the coefficients of r^2, r^4, ... of the radial factor."""
    denominator: tuple[int, ...] = ()
    """Which are those of what it is divided by."""
    is_equidistant: bool = False
    """Whether the ideal lens is equidistant instead of perspective."""
    splined: int = 0
    """Number of control points along each side of the grid that shifts places; 0 where there is none."""

    @property
    def said(self) -> str:
        """The names of its parameters, in words."""
        if not self.splined:
            return ", ".join(self.names)
        points = 2 * self.splined**2
        return f"{', '.join(self.names[:-points])} and {self.splined} x {self.splined} control points of x, then of y"


GRID = 11
"""Number of control points along each side of the grid of a splined lens."""
_CONTROL = tuple(f"{axis}{row}_{column}" for axis in "xy" for row in range(GRID) for column in range(GRID))

MODELS: Mapping[str, LensModel] = {
    "OPENCV": LensModel(0, ("k1", "k2", "p1", "p2"), (0, 1)),
    "FULL_OPENCV": LensModel(1, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), (0, 1, 4), (5, 6, 7)),
    "OPENCV_FISHEYE": LensModel(2, ("k1", "k2", "k3", "k4"), (0, 1, 2, 3), is_equidistant=True),
    "THIN_PRISM_FISHEYE": LensModel(
        3, ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"), (0, 1, 4, 5), is_equidistant=True
    ),
    "SPLINED_FISHEYE": LensModel(
        4, ("k1", "k2", "k3", "k4", "reach", *_CONTROL), (0, 1, 2, 3), is_equidistant=True, splined=GRID
    ),
}
LENSES = tuple(name for name, model in MODELS.items() if not model.splined)
"""The models that COLMAP has."""


_NOTHING = 1e-12
"""Coefficients of a polynomial of r^2 that are smaller show only where no lens does."""


def fold_radius(model: LensModel, distortion: Float[np.ndarray, "k"]) -> float:
    """Ideal radius up to which the distorted one grows with it: from there on the model folds the image back onto
    itself, and means nothing. Infinite for a perspective lens that never folds; at most pi for an equidistant one.

    The grid of a splined lens must change more slowly from place to place than its base: within the radius where it
    does, the derivative of the whole is positive definite, so that no two places are shown at one."""
    # d(r N / D) / dr = (D (N + 2 r^2 N') - 2 r^2 N D') / D^2, with N and D by powers of r^2
    numerator, denominator = (np.array([1.0, *distortion[list(each)]]) for each in (model.numerator, model.denominator))
    odd, even = 1 + 2 * np.arange(len(numerator)), 2 * np.arange(len(denominator))
    slope = np.convolve(denominator, odd * numerator) - np.convolve(numerator, even * denominator)
    spline = _steepest_shift(model, distortion)
    slope[0] -= spline
    sideways = np.array([numerator[0] - spline, *numerator[1:]])
    if slope[0] <= 0:
        return 0.0
    limits = (slope, denominator, sideways) if model.splined else (slope, denominator)
    roots = np.concatenate([np.roots(_drop_negligible(each)[::-1]) for each in limits])
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
    first = float(np.sqrt(real.min())) if len(real) else np.inf
    return min(first, np.pi) if model.is_equidistant else first


def _steepest_shift(model: LensModel, distortion: Float[np.ndarray, "k"]) -> float:
    """More than any derivative of the shift by the grid of a splined lens has as its spectral norm: the derivative of a
    B-spline is a mean of the differences of neighbouring control points, which are 0 outside of the grid."""
    if not model.splined:
        return 0.0
    reach, points = distortion[-2 * model.splined**2 - 1], distortion[-2 * model.splined**2 :]
    grid = np.pad(points.reshape(2, model.splined, model.splined), ((0, 0), (1, 1), (1, 1)))
    steps = [np.abs(np.diff(each, axis=axis)).max() for each in grid for axis in (0, 1)]
    return float(np.linalg.norm(steps) * (model.splined - 3) / (2 * reach))


def _drop_negligible(coefficients: Float[np.ndarray, "n"]) -> Float[np.ndarray, "m"]:
    """Without the highest ones where they are nothing."""
    some = np.flatnonzero(np.abs(coefficients) > _NOTHING)
    return coefficients[: some[-1] + 1]
