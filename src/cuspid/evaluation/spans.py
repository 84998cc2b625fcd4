"""Distances and angles between points of a scan against those of the reference: accuracy without a best fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3


@dataclass(frozen=True, kw_only=True)
class Span:
    """The distance between two points, and the angle between their axes."""

    kind: str
    """What the points are: teeth, stations, landmarks, spheres, bodies."""
    first: str
    """Label of the first point."""
    second: str
    """Label of the second point."""
    nominal_mm: float
    """Distance in the reference."""
    error_um: float
    """Measured minus nominal distance."""
    angle_error_deg: float | None = None
    """Angle between how the second lies to the first in the scan and in the reference; None for points without
    axes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Station:
    """Something that was found in a scan, and where it is in the reference."""

    nominal: Rigid3
    """``reference_from_part``; without axes of its own, the rotation is the identity."""
    measured: Rigid3
    """``scan_from_part``, in the frame of the scan as it was aligned."""
    has_axes: bool = True
    """Whether the rotations mean something."""
    axis: tuple[float, float, float] | None = None
    """The one direction of the part that has a meaning, in its own frame; None where all have."""


def spans(kind: str, stations: Mapping[str, Station]) -> tuple[Span, ...]:
    """All pairs of stations, the shortest first."""
    found = [_span(kind, one, other, stations[one], stations[other]) for one, other in combinations(stations, 2)]
    return tuple(sorted(found, key=lambda span: span.nominal_mm))


def _span(kind: str, first: str, second: str, one: Station, other: Station) -> Span:
    nominal = float(np.linalg.norm(one.nominal.translation - other.nominal.translation))
    measured = float(np.linalg.norm(one.measured.translation - other.measured.translation))
    return Span(
        kind=kind,
        first=first,
        second=second,
        nominal_mm=nominal,
        error_um=1000 * (measured - nominal),
        angle_error_deg=_angle_deg(one, other) if one.has_axes and other.has_axes else None,
    )


def _angle_deg(one: Station, other: Station) -> float:
    if one.axis is None or other.axis is None:
        measured = one.measured.rotation.T @ other.measured.rotation
        nominal = one.nominal.rotation.T @ other.nominal.rotation
        return Rigid3(nominal.T @ measured, np.zeros(3)).angle_deg
    angles = [
        angle_between_deg(
            getattr(one, name).rotate(np.array(one.axis)), getattr(other, name).rotate(np.array(other.axis))
        )
        for name in ("measured", "nominal")
    ]
    return float(angles[0] - angles[1])


def angle_between_deg(one: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"]) -> float:
    """Angle between two directions, accurate for small ones, too."""
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other)))


def slope_ppm(found: Sequence[Span]) -> float:
    """Error proportional to distance that fits all spans best: a line through zero, least squares."""
    nominal, error = np.array([each.nominal_mm for each in found]), np.array([each.error_um for each in found])
    return float(1000 * nominal @ error / max(float(nominal @ nominal), 1e-300))
