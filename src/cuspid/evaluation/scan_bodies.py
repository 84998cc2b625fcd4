"""Scan bodies: the mesh of a library fitted to each place where a scan shows one, with six degrees of freedom.

The library's own frame is that of the implant: its origin is the position and its +Z the axis, as the maker drew them.
A fit begins at a rough place, upright and in turns about the axis; points of the scan are taken ever nearer to the
body, so that gum and a neighbour that merges with it have no part in it, and what is missing of it is not missed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float

from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.registration import RegistrationOptions, refine
from cuspid.geometry import Rigid3, axes_about
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range

_TURNS, _TILT_DEG = 12, 15.0
"""Starts about the axis, and how far some of them are tilted to either side."""
_NARROWER_MM = (1.0, 0.4, 0.15)
"""Points of the scan farther than this from the body have no part in the fit, round by round."""
_ROUGH, _MOST_POINTS = 500, 8_000
_TRUNCATED_MM = 0.3
_COVERED_MM = 0.15
"""Surface of the body is found where the scan is this near."""


@dataclass(frozen=True, kw_only=True)
class BodyOptions(Options):
    """When a scan body counts as found."""

    min_points: Annotated[int, Range(10, 1_000_000)] = 200
    """Samples of the scan on the body, at least."""
    max_rms_um: Annotated[float, Range(0.1, 10_000)] = 120.0
    """Root mean square distance of these from it, at most."""
    min_coverage_pct: Annotated[float, Range(0, 100)] = 15.0
    """Share of the whole surface of the body, its hidden bottom included, that must be found."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyFit:
    """A scan body that was found."""

    scan_from_body: Rigid3
    """From the frame of the library."""
    rms_um: float
    """Root mean square distance of the points that were used."""
    points: int
    """Number of them."""
    coverage_pct: float
    """Share of the library's surface that the scan shows."""


def fit_body(
    scan: Mesh,
    library: SignedDistance,
    centre: Float[np.ndarray, "3"],
    up: Float[np.ndarray, "3"],
    options: BodyOptions = BodyOptions(),
) -> BodyFit:
    """Fit a library body to a scan, from a rough place of its middle (good to a millimetre or two) and the direction
    that its axis roughly has. Raises InputError where the scan shows none there.
    """
    points = _nearby(scan, library.mesh, centre)
    if len(points) < options.min_points:
        raise InputError(f"only {len(points)} points of the scan lie there; at least {options.min_points} are needed")
    start = _best_start(points, library, centre, up)
    body_from_scan = start
    for reach_mm in _NARROWER_MM:
        near = points[np.abs(library.closest_points(body_from_scan.apply(points)).signed_mm) < reach_mm]
        if len(near) < options.min_points:
            raise InputError(f"only {len(near)} points of the scan lie on the body; {options.min_points} are needed")
        body_from_scan = refine(near, library, body_from_scan, RegistrationOptions())
    return _verify_fit(scan, library, body_from_scan, near, options)


def _nearby(scan: Mesh, body: Mesh, centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 3"]:
    """Samples of the scan where the body may be."""
    reach_mm = 0.5 * float(np.linalg.norm(np.ptp(body.bounds, axis=0))) + 2.0
    around = np.linalg.norm(scan.face_centres - centre, axis=1) < reach_mm
    if not around.any():
        return np.empty((0, 3))
    part = scan.submesh(around)
    return part.sample(min(_MOST_POINTS, 4 * len(part.vertices)), np.random.default_rng(0))[0]


def _best_start(
    points: Float[np.ndarray, "n 3"],
    library: SignedDistance,
    centre: Float[np.ndarray, "3"],
    up: Float[np.ndarray, "3"],
) -> Rigid3:
    """``body_from_scan`` of the start from which a few points come to lie nearest to the body."""
    few = points[:: max(1, len(points) // _ROUGH)]
    brief = RegistrationOptions(tolerance_um=5.0, iterations=15)
    middle = library.mesh.bounds.mean(axis=0)
    poses = []
    for axes in _axes_to_try(up):
        start = Rigid3(axes, middle - axes @ centre)
        near = few[np.abs(library.closest_points(start.apply(few)).signed_mm) < 2 * _NARROWER_MM[0]]
        if len(near) >= 20:
            poses.append(refine(near, library, start, brief))
    if not poses:
        raise InputError("the scan shows no body there")
    return min(poses, key=lambda pose: _misfit_mm(few, library, pose))


def _axes_to_try(up: Float[np.ndarray, "3"]) -> list[Float[np.ndarray, "3 3"]]:
    """Axes of the body in the scan, as rows."""
    upright = axes_about(np.asarray(up, dtype=np.float64) / np.linalg.norm(up))
    tilts = [np.zeros(2), *(np.deg2rad(_TILT_DEG) * np.array(way) for way in ((1, 0), (-1, 0), (0, 1), (0, -1)))]
    found = []
    for turn in np.arange(_TURNS) * 2 * np.pi / _TURNS:
        about = Rigid3.from_rotation_vector(np.array([0.0, 0.0, turn]), np.zeros(3)).rotation
        for tilt in tilts if turn == 0 else tilts[:1]:
            leaning = Rigid3.from_rotation_vector(np.array([*tilt, 0.0]), np.zeros(3)).rotation
            found.append(about @ leaning @ upright)
    return found


def _misfit_mm(points: Float[np.ndarray, "n 3"], library: SignedDistance, pose: Rigid3) -> float:
    return float(np.minimum(np.abs(library.closest_points(pose.apply(points)).signed_mm), _TRUNCATED_MM).mean())


def _verify_fit(
    scan: Mesh, library: SignedDistance, body_from_scan: Rigid3, near: Float[np.ndarray, "n 3"], options: BodyOptions
) -> BodyFit:
    signed_mm = library.closest_points(body_from_scan.apply(near)).signed_mm
    rms_um = 1000 * float(np.sqrt(np.mean(signed_mm**2)))
    scan_from_body = body_from_scan.inverse()
    places, _ = library.mesh.sample(2000, np.random.default_rng(0))
    coverage = 100 * float(np.mean(scan.closest(scan_from_body.apply(places))[0] < _COVERED_MM))
    if rms_um > options.max_rms_um or coverage < options.min_coverage_pct:
        raise InputError(
            f"what the scan shows there is no such body ({rms_um:.0f} um RMS, {coverage:.0f} % of it found); check the "
            "place and the library file"
        )
    return BodyFit(scan_from_body=scan_from_body, rms_um=rms_um, points=len(near), coverage_pct=coverage)
