"""Spheres fitted to a scan, and all distances between them: accuracy without a best fit to the reference.

The scan stays in its own frame. A rough alignment only determines which points belong to which sphere; the spheres are
fitted to these points alone, and distances between their centres do not depend on where the scan lies. Terms are those
of VDI/VDE 2634 parts 2 and 3, without any claim to follow their procedure:

- sphere-spacing error SD: measured minus nominal distance between two centres;
- probing error of size PS: diameter of the fitted sphere (least squares, radius free) minus the nominal one;
- probing error of form PF: range of the points' radial distances from the fitted sphere.

Points of a sphere are the vertices of the scan, weighted by the surface that they represent, within ``band_mm`` of the
nominal radius and within ``polar_deg`` of the occlusal direction, both about the fitted centre. The selection is
repeated until it no longer changes, so that it depends on the rough alignment only through the occlusal direction. The
fit is plain least squares of the radial distances over the points within ``outlier_sigmas`` robust standard deviations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.spatial import KDTree

from cuspid.geometry import Rigid3, read_only
from cuspid.model.jaw import Jaw, Sphere
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range

_ROUNDS = 30
"""Number of selections of points after which a sphere that has not settled is given up."""
_FREE_ROUNDS = 10
"""Number of selections after which points that once belonged to a sphere stay with it, because a few at the rim may
alternate."""
_SETTLED_MM = 1e-5
"""A sphere has settled when a new selection of points moves it by less than this."""
_LEAST_SIGMA_MM = 1e-4
"""Robust standard deviation below which nothing is an outlier."""
_DIRECTIONS = 400
"""Number of directions over the whole sphere at which coverage is evaluated."""
_COVERED_DEG = 8.0
"""A direction is covered if a point lies this near; neighbouring directions are 10 deg apart."""
_SIGMA_OF_MAD = 1.4826
_SIDES = (("3", "4"), ("1", "2"))
"""FDI quadrants that face each other, lower and upper."""


@dataclass(frozen=True, kw_only=True)
class SphereOptions(Options):
    """Which points of a scan belong to a sphere, and when it counts as measured."""

    band_mm: Annotated[float, Range(0.0001, 100)] = 0.5
    """Points nearer than this to the surface of the sphere belong to it; must exceed the errors of the scan."""
    polar_deg: Annotated[float, Range(1, 180)] = 100.0
    """Points within this angle of the occlusal direction belong to it; the rest is too near to the base."""
    outlier_sigmas: Annotated[float, Range(0.01, 1000)] = 5.0
    """Points farther than this from the fitted sphere, in robust standard deviations, are left out of the fit."""
    min_points: Annotated[int, Range(4, 10_000_000)] = 200
    """A sphere with fewer points is not measured."""
    min_coverage_pct: Annotated[float, Range(0, 100)] = 50.0
    """A sphere is not measured if its points cover less than this of the cap within ``polar_deg``."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SphereMeasurement:
    """A sphere that was found in the scan."""

    centre: Float[np.ndarray, "3"]
    """Centre in the frame of the scan, mm."""
    size_error_um: float
    """Measured minus nominal diameter (PS)."""
    form_range_um: float
    """Range of the radial distances of the fitted points (PF), without outliers."""
    form_95_um: float
    """Range of the middle 95 % (by area) of the radial distances of all points, including outliers."""
    form_rms_um: float
    """Root mean square (by area) of the radial distances of the fitted points."""
    points: int
    """Number of vertices, including outliers."""
    outliers_pct: float
    """Share of them that were left out of the fit."""
    coverage_pct: float
    """Share of the cap within ``polar_deg`` where the scan has points."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", read_only(np.asarray(self.centre, dtype=np.float64)))


@dataclass(frozen=True, kw_only=True)
class SphereSpacing:
    """The distance between two spheres."""

    first: str
    """Label of the first sphere."""
    second: str
    """Label of the second sphere."""
    nominal_mm: float
    """Distance in the reference."""
    error_um: float
    """Measured minus nominal distance (SD)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SphereReport:
    """What the spheres say about a scan."""

    spheres: Mapping[str, SphereMeasurement]
    """Measured spheres, by label."""
    not_measured: Mapping[str, str]
    """For spheres that the scan does not show well enough, the reason, by label."""
    spacings: tuple[SphereSpacing, ...]
    """All pairs of measured spheres, the shortest nominal distance first."""
    spacing_max_um: float
    """Largest absolute sphere-spacing error."""
    spacing_rms_um: float
    """Root mean square of the sphere-spacing errors of all pairs."""
    scale_ppm: float
    """Error proportional to distance that fits all pairs best: a line through zero, least squares."""
    spacing_rms_without_scale_um: float
    """Root mean square of the residuals from that line: errors of shape."""
    inter_canine_um: float | None
    """Error of the distance between the canines; None if one was not measured."""
    inter_first_molar_um: float | None
    """Error of the distance between the first molars."""
    inter_second_molar_um: float | None
    """Error of the distance between the second molars."""
    cross_arch_um: Mapping[str, float]
    """Errors of the distances between a canine and the first molar of the other side, as "33-46"."""
    notes: tuple[str, ...]
    """How it was measured, as human-readable lines."""

    @property
    def named_um(self) -> dict[str, float]:
        """Errors of the named distances across the arch, by "<label>-<label>"."""
        pairs = {f"{one}{position}-{other}{position}" for one, other in _SIDES for position in (3, 6, 7)}
        named = {f"{each.first}-{each.second}": each.error_um for each in self.spacings}
        return {name: error for name, error in named.items() if name in pairs} | dict(self.cross_arch_um)


def evaluate_spheres(
    scan: Mesh, reference: Jaw, reference_from_scan: Rigid3, options: SphereOptions = SphereOptions()
) -> SphereReport:
    """Find the spheres of a reference in a scan and compare all distances between them.

    ``reference_from_scan`` is a rough alignment, good to about ``band_mm``; it only selects points. Raises InputError
    where the reference has no spheres or the scan shows fewer than two of them.
    """
    if not reference.spheres:
        raise InputError("spheres: the reference has no spheres; give that of 'cuspid jaw phantom --spheres'")
    scan_from_reference = reference_from_scan.inverse()
    weights = scan.vertex_areas
    spheres: dict[str, SphereMeasurement] = {}
    not_measured: dict[str, str] = {}
    for label, nominal in reference.spheres.items():
        found = _measure(scan.vertices, weights, nominal, scan_from_reference, options)
        if isinstance(found, str):
            not_measured[label] = found
        else:
            spheres[label] = found
    if len(spheres) < 2:
        reasons = "; ".join(f"{label}: {reason}" for label, reason in not_measured.items())
        raise InputError(f"spheres: {len(spheres)} of {len(reference.spheres)} measured; two are needed ({reasons})")
    return _report(spheres, not_measured, reference.spheres, options)


# --- one sphere ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Fit:
    """A sphere through points."""

    centre: Float[np.ndarray, "3"]
    radius: float
    residuals: Float[np.ndarray, "n"]
    """Radial distances of the points, outliers included, mm."""
    used: Bool[np.ndarray, "n"]
    """Points that are no outliers."""


def fit_sphere(
    points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, "n"], outlier_sigmas: float = np.inf
) -> tuple[Float[np.ndarray, "3"], float]:
    """Centre (mm) and radius (mm) of the sphere with the smallest weighted sum of squared orthogonal distances."""
    fit = _fit(points, weights, outlier_sigmas)
    return fit.centre, fit.radius


def _fit(points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, "n"], outlier_sigmas: float) -> _Fit:
    """Robust to begin with, to tell the outliers; then least squares over the rest."""
    start = _algebraic(points, weights)
    sigma = max(_SIGMA_OF_MAD * np.median(np.abs(_radial(start, points))), _LEAST_SIGMA_MM)
    robust = _orthogonal(start, points, weights, loss="soft_l1", f_scale=sigma)
    residuals = _radial(robust, points)
    sigma = max(_SIGMA_OF_MAD * np.median(np.abs(residuals)), _LEAST_SIGMA_MM)
    used = np.abs(residuals) <= outlier_sigmas * sigma
    final = _orthogonal(robust, points[used], weights[used])
    return _Fit(final[:3], float(final[3]), _radial(final, points), used)


def _radial(sphere: Float[np.ndarray, "4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    return np.linalg.norm(points - sphere[:3], axis=1) - sphere[3]


def _algebraic(points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, "n"]) -> Float[np.ndarray, "4"]:
    """Centre and radius by linear least squares of |x|^2 = 2 x.c + (r^2 - |c|^2)."""
    mean = points.mean(axis=0)
    centred, root = points - mean, np.sqrt(weights)[:, None]
    design = np.column_stack([2 * centred, np.ones(len(points))])
    solution, *_ = np.linalg.lstsq(design * root, np.sum(centred**2, axis=1) * root[:, 0], rcond=None)
    radius = np.sqrt(max(solution[3] + solution[:3] @ solution[:3], 0))
    return np.append(solution[:3] + mean, radius)


def _orthogonal(
    start: Float[np.ndarray, "4"],
    points: Float[np.ndarray, "n 3"],
    weights: Float[np.ndarray, "n"],
    loss: str = "linear",
    f_scale: float = 1.0,
) -> Float[np.ndarray, "4"]:
    """Centre and radius by least squares of the radial distances, each weighted by its surface."""
    root = np.sqrt(weights / weights.mean())

    def jacobian(sphere: Float[np.ndarray, "4"]) -> Float[np.ndarray, "n 4"]:
        outwards = points - sphere[:3]
        outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
        return -root[:, None] * np.column_stack([outwards, np.ones(len(points))])

    return least_squares(
        lambda sphere: root * _radial(sphere, points),
        start,
        jac=jacobian,
        method="trf",
        loss=loss,
        f_scale=f_scale,
        x_scale="jac",
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-14,
    ).x


def _measure(
    vertices: Float[np.ndarray, "v 3"],
    areas: Float[np.ndarray, "v"],
    nominal: Sphere,
    scan_from_reference: Rigid3,
    options: SphereOptions,
) -> SphereMeasurement | str:
    """The sphere, or why it was not measured."""
    occlusal = scan_from_reference.rotate(np.array([0.0, 0.0, 1.0]))
    centre = scan_from_reference.apply(nominal.centre)
    near = np.linalg.norm(vertices - centre, axis=1) < nominal.radius_mm + 3 * options.band_mm
    points, weights = vertices[near], areas[near]
    chosen = np.zeros(len(points), dtype=bool)
    for round_ in range(_ROUNDS):
        chosen &= round_ >= _FREE_ROUNDS
        chosen |= _belongs(points, centre, nominal.radius_mm, occlusal, options)
        if chosen.sum() < options.min_points:
            return f"only {chosen.sum()} points; at least {options.min_points} are needed"
        fit = _fit(points[chosen], weights[chosen], options.outlier_sigmas)
        moved = np.linalg.norm(fit.centre - centre)
        centre = fit.centre
        if moved < _SETTLED_MM:
            break
    else:
        return f"the selection of its points did not settle in {_ROUNDS} rounds"
    if abs(fit.radius - nominal.radius_mm) > options.band_mm:
        return f"the fitted radius is {fit.radius:.2f} mm, nominal {nominal.radius_mm:g} mm"
    coverage = _coverage_pct(points[chosen] - centre, occlusal, options.polar_deg)
    if coverage < options.min_coverage_pct:
        return f"only {coverage:.0f} % of its cap has points; at least {options.min_coverage_pct:g} % is needed"
    return _measurement(fit, weights[chosen], nominal, coverage)


def _belongs(
    points: Float[np.ndarray, "n 3"],
    centre: Float[np.ndarray, "3"],
    radius_mm: float,
    occlusal: Float[np.ndarray, "3"],
    options: SphereOptions,
) -> Bool[np.ndarray, "n"]:
    """Points in a shell about the centre, within the polar angle."""
    outwards = points - centre
    distance = np.linalg.norm(outwards, axis=1)
    high = outwards @ occlusal >= distance * np.cos(np.deg2rad(options.polar_deg))
    return (np.abs(distance - radius_mm) < options.band_mm) & high


def _coverage_pct(outwards: Float[np.ndarray, "n 3"], occlusal: Float[np.ndarray, "3"], polar_deg: float) -> float:
    """Share of the directions within the polar angle near which there is a point."""
    steps = np.arange(_DIRECTIONS) + 0.5
    z, azimuth = 1 - 2 * steps / _DIRECTIONS, steps * np.pi * (3 - np.sqrt(5))
    directions = np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=1)
    directions = directions[directions @ occlusal >= np.cos(np.deg2rad(polar_deg))]
    gaps, _ = KDTree(outwards / np.linalg.norm(outwards, axis=1, keepdims=True)).query(directions)
    return float(100 * np.mean(gaps <= 2 * np.sin(np.deg2rad(_COVERED_DEG) / 2)))


def _measurement(fit: _Fit, weights: Float[np.ndarray, "n"], nominal: Sphere, coverage_pct: float) -> SphereMeasurement:
    used = 1000 * fit.residuals[fit.used]
    order = np.argsort(fit.residuals)
    share = np.cumsum(weights[order]) / weights.sum()
    low, high = np.interp([0.025, 0.975], share, 1000 * fit.residuals[order])
    return SphereMeasurement(
        centre=fit.centre,
        size_error_um=2000 * (fit.radius - nominal.radius_mm),
        form_range_um=float(np.ptp(used)),
        form_95_um=float(high - low),
        form_rms_um=float(np.sqrt(np.average(used**2, weights=weights[fit.used]))),
        points=len(fit.residuals),
        outliers_pct=float(100 * np.mean(~fit.used)),
        coverage_pct=coverage_pct,
    )


# --- all spheres --------------------------------------------------------------------------------------------------


def _report(
    spheres: Mapping[str, SphereMeasurement],
    not_measured: Mapping[str, str],
    nominal: Mapping[str, Sphere],
    options: SphereOptions,
) -> SphereReport:
    spacings = sorted(
        (_spacing(first, second, spheres, nominal) for first, second in combinations(spheres, 2)),
        key=lambda spacing: spacing.nominal_mm,
    )
    distance = np.array([spacing.nominal_mm for spacing in spacings])
    error = np.array([spacing.error_um for spacing in spacings])
    slope = distance @ error / (distance @ distance)
    error_um = {frozenset((spacing.first, spacing.second)): spacing.error_um for spacing in spacings}
    crossing = [(f"{one}3", f"{other}6") for sides in _SIDES for one, other in (sides, sides[::-1])]
    return SphereReport(
        spheres=spheres,
        not_measured=not_measured,
        spacings=tuple(spacings),
        spacing_max_um=float(np.abs(error).max()),
        spacing_rms_um=float(np.sqrt(np.mean(error**2))),
        scale_ppm=float(1000 * slope),
        spacing_rms_without_scale_um=float(np.sqrt(np.mean((error - slope * distance) ** 2))),
        inter_canine_um=_span_error(error_um, 3),
        inter_first_molar_um=_span_error(error_um, 6),
        inter_second_molar_um=_span_error(error_um, 7),
        cross_arch_um={f"{a}-{b}": error_um[pair] for a, b in crossing if (pair := frozenset((a, b))) in error_um},
        notes=_notes(options),
    )


def _spacing(
    first: str, second: str, spheres: Mapping[str, SphereMeasurement], nominal: Mapping[str, Sphere]
) -> SphereSpacing:
    expected = float(np.linalg.norm(nominal[first].centre - nominal[second].centre))
    measured = float(np.linalg.norm(spheres[first].centre - spheres[second].centre))
    return SphereSpacing(first=first, second=second, nominal_mm=expected, error_um=1000 * (measured - expected))


def _span_error(error_um: Mapping[frozenset[str], float], position: int) -> float | None:
    """Error of the distance between the two spheres at a tooth position."""
    pairs = (frozenset((f"{one}{position}", f"{other}{position}")) for one, other in _SIDES)
    return next((error_um[pair] for pair in pairs if pair in error_um), None)


def _notes(options: SphereOptions) -> tuple[str, ...]:
    return (
        f"spheres: least squares with free radius over vertices within {options.polar_deg:g} deg of the occlusal "
        f"direction, those beyond {options.outlier_sigmas:g} robust standard deviations left out",
        "spacing: measured minus nominal distance between two centres; independent of the alignment",
    )
