"""How an arch is deformed as a whole: scale, spread, lift and twist, and what is left.

The arch is taken for a bent bar along its curve c(s), s from the middle, with the tangent t(s) and +Z out of the gum.
Errors of stitching add up along it: cross-sections turn by an angle that grows with s, and what lies beyond is carried
along (Euler and Bernoulli's kinematics of bars). With the middle fixed, a place x beside c(s) moves by

    u(x) = integral_0^s theta x t ds' + theta(s) x (x - c(s)).

- *spread*: theta = k s Z. The horseshoe opens in its plane (positive: the ends move apart).
- *lift*: theta = -k Z x (c(s) - c(0)). Both ends rise out of the gum's side (positive), by k r^2 / 2 at a distance r
  from the middle.
- *twist*: theta = k (c(s) - c(0)), the torsion of the bar. One end rises (positive: the first end of the curve, which
  runs clockwise seen from +Z), the other one sinks.
- *scale*: u = e (x - c(0)), in all directions.

Amplitudes of the first three are in um at the ends of the curve: the root mean square of how far the two ends move
while the middle is fixed. All are fitted together with a rigid motion, by Gauss-Newton on exact closest-point distances
with Tukey's weights; the reference is bent until it lies on the scan.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.places import Places
from cuspid.evaluation.registration import biweights
from cuspid.model.arch_curve import ArchCurve

MODES = ("scale", "spread", "lift", "twist")
"""In the order of tables. Scale is in ppm, the others in um at the ends."""
BESIDE_MM = 12.0
"""Places farther beside the curve have no part in the fit: a palate or a base says little of the arch."""
_ROUNDS, _SETTLED_UM = 20, 0.01
_LEAST_PLACES = 300
_LEAST_SHARE = 0.5
_STRAIGHTENINGS = 3


@dataclass(frozen=True, eq=False, kw_only=True)
class Deformation:
    """How a scan deforms the arch of its reference."""

    amplitudes: Mapping[str, float]
    """Of each of `MODES`: ppm, and um at the ends."""
    rms_um: Mapping[str, float]
    """Root mean square of what each mode alone contributes to the deviations, after the best rigid motion."""
    before_um: float
    """Root mean square of the deviations where they are fitted, after the best rigid motion."""
    remainder_um: float
    """What is left of it without the modes."""


def mode_fields(curve: ArchCurve, points: Float[np.ndarray, "n 3"]) -> dict[str, Float[np.ndarray, "n 3"]]:
    """The displacement (mm) of points by each mode: scale by one ppm, the others by 1 um at the ends."""
    line, lengths = curve.points, curve.lengths_mm
    middle = int(np.searchsorted(lengths, lengths[-1] / 2))
    along, from_middle = lengths - lengths[middle], line - line[middle]
    up = np.array([0.0, 0.0, 1.0])
    turns = {
        "spread": along[:, None] * up,
        "lift": -np.cross(up, from_middle),
        "twist": from_middle,
    }
    nearest = KDTree(line[:, :2]).query(points[:, :2])[1]
    fields = {"scale": 1e-6 * (points - line[middle])}
    for name, turn in turns.items():
        moves = _integral(np.cross(turn, np.gradient(line, lengths, axis=0)), lengths, middle)
        at_ends = float(np.sqrt(np.mean(np.sum(moves[[0, -1]] ** 2, axis=1))))
        sign = -1.0 if name == "twist" and moves[0, 2] < 0 else 1.0
        field = moves[nearest] + np.cross(turn[nearest], points - line[nearest])
        fields[name] = sign * 1e-3 / at_ends * field
    return fields


def bend(
    curve: ArchCurve, amplitudes: Mapping[str, float], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Where modes of some amplitudes move points (mm) of the reference."""
    fields = mode_fields(curve, points)
    return np.asarray(points + sum(amplitude * fields[name] for name, amplitude in amplitudes.items()))


def straighten(
    curve: ArchCurve, amplitudes: Mapping[str, float], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Where points were before modes moved them: the inverse of :func:`bend`, by iteration on a contraction, as the
    modes turn by some mrad at most."""
    before = points
    for _ in range(_STRAIGHTENINGS):
        before = before + points - bend(curve, amplitudes, before)
    return before


def fit_deformation(places: Places, curve: ArchCurve, scan: SignedDistance) -> Deformation | None:
    """The modes of an aligned scan, fitted to places that it shows; None where these are too few, or beside less than
    half of the arch, which they would describe by extrapolation.

    ``curve`` and ``places`` are those of the reference, in its occlusal frame.
    """
    beside_mm, nearest = KDTree(curve.points[:, :2]).query(places.points[:, :2])
    beside = beside_mm <= BESIDE_MM
    used = places.chosen(beside)
    if len(used.points) < _LEAST_PLACES:
        return None
    first_mm, last_mm = np.percentile(curve.lengths_mm[nearest[beside]], [2, 98])
    if last_mm - first_mm < _LEAST_SHARE * curve.lengths_mm[-1]:
        return None
    fields = mode_fields(curve, used.points)
    rigid = _rigid_fields(used.points)
    before, _ = _fit(used, rigid, scan)
    every = np.concatenate([rigid, np.stack([1e3 * fields[name] for name in MODES], axis=1)], axis=1)
    left, solution = _fit(used, every, scan)
    amplitudes = 1e3 * solution[6:]
    normal_rigid = np.einsum("nmk,nk->nm", rigid, used.normals)
    alone = {
        name: amplitude * _residual(normal_rigid, np.sum(1e3 * fields[name] * used.normals, axis=1))
        for name, amplitude in zip(MODES, amplitudes, strict=True)
    }
    return Deformation(
        amplitudes=dict(zip(MODES, map(float, amplitudes), strict=True)),
        rms_um={name: float(np.sqrt(np.mean(each**2))) for name, each in alone.items()},
        before_um=before,
        remainder_um=left,
    )


def _fit(
    places: Places, fields: Float[np.ndarray, "n m 3"], scan: SignedDistance
) -> tuple[float, Float[np.ndarray, "m"]]:
    """Root mean square (um, weighted) of what fields leave, and the amplitude of each."""
    solution = np.zeros(fields.shape[1])
    for _ in range(_ROUNDS):
        closest = scan.closest_points(places.points + np.einsum("nmk,m->nk", fields, solution))
        weights = biweights(closest.signed_mm, ~closest.on_border)
        jacobian = np.einsum("nmk,nk->nm", fields, closest.directions)
        hessian = jacobian.T @ (weights[:, None] * jacobian)
        size = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
        gradient = -(jacobian.T @ (weights * closest.signed_mm)) / size
        step = np.linalg.lstsq(hessian / np.outer(size, size), gradient, rcond=1e-9)[0] / size
        solution = solution + step
        if 1000 * np.abs(np.einsum("nmk,m->nk", fields, step)).max() < _SETTLED_UM:
            break
    squares = float(np.sum(weights * closest.signed_mm**2) / max(weights.sum(), 1e-300))
    return 1000 * float(np.sqrt(squares)), solution


def _rigid_fields(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 6 3"]:
    """Turns by 1 mrad about the axes through the middle, and shifts by 1 mm along them."""
    centred = 1e-3 * (points - points.mean(axis=0))
    turns = [np.cross(axis, centred) for axis in np.eye(3)]
    return np.stack([*turns, *(np.broadcast_to(axis, points.shape) for axis in np.eye(3))], axis=1)


def _residual(columns: Float[np.ndarray, "n m"], values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """What the columns cannot explain of values."""
    return np.asarray(values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0])


def _integral(
    rates: Float[np.ndarray, "n 3"], lengths: Float[np.ndarray, "n"], middle: int
) -> Float[np.ndarray, "n 3"]:
    """Trapezoidal integral over the length, zero at the middle."""
    steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(lengths)[:, None]
    summed = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return summed - summed[middle]
