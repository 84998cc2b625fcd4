"""Rigid registration of a scan with a reference, from any pose, for a part of the arch as well as for all of it.

A search over all poses (:mod:`cuspid.evaluation.search`), then Gauss-Newton on exact closest-point distances with
Tukey's weights, to convergence. The scale is never changed: that of the best similarity is reported separately.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float

from cuspid.evaluation.distance import ClosestPoints, SignedDistance
from cuspid.evaluation.search import SearchOptions, find_poses
from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range

_NARROWEST_MM, _WIDEST_MM = 1e-3, 2.0
"""Bounds of the distance at which a sample loses its weight."""
_LEAST_OVERLAP = 0.25
_POOR_MM = 0.06
"""Mean distance above which it is asked whether the scan is mirrored."""
_FAR_BETTER = 0.5
"""Share of the mean distance that is left of a mirrored scan when it is mirrored back, at most."""
_FEW = 2000
"""Number of samples that suffice to tell good poses from bad ones."""


@dataclass(frozen=True, kw_only=True)
class RegistrationOptions(Options):
    """How a scan is aligned with its reference."""

    search: SearchOptions = field(default_factory=SearchOptions)
    """How densely poses are sampled."""
    samples: Annotated[int, Range(100, 10_000_000)] = 60_000
    """Points of the scan, uniform by area, that the alignment is based on."""
    outlier_mm: Annotated[float, Range(0.0001, 100)] = 0.3
    """Samples nearer than this count as overlap. The weights in the fit follow from the errors: samples farther off
    than six robust standard deviations have none."""
    tolerance_um: Annotated[float, Range(1e-06, 1000)] = 0.01
    """The alignment has converged when no sample moves more than this in a step."""
    iterations: Annotated[int, Range(1, 100_000)] = 100
    """Maximum number of steps."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Alignment:
    """Result of a registration."""

    reference_from_scan: Rigid3
    """The rigid motion that was found."""
    scale: float
    """Size of the scan relative to the reference, by the best similarity. Never applied."""
    rms_um: float
    """Weighted RMS distance where the two surfaces overlap."""
    overlap: float
    """Share of the smaller surface that lies within ``outlier_mm`` of the larger one."""
    mirrored: bool = False
    """Whether the mirror image of the scan fits far better."""
    notes: tuple[str, ...] = ()
    """Why the alignment is doubtful; empty if it is not."""


def register(
    scan: Mesh, surface: SignedDistance, options: RegistrationOptions, *, rng: np.random.Generator
) -> Alignment:
    """Align a scan in any pose with a reference surface; the smaller of the two is fitted to the larger one.

    Raises InputError where no pose brings a quarter of the smaller surface near the larger one.
    """
    if scan.face_areas.sum() > 1.5 * surface.mesh.face_areas.sum():
        swapped = _lay(surface.mesh, SignedDistance(scan), options, rng)
        return replace(swapped, reference_from_scan=swapped.reference_from_scan.inverse(), scale=1 / swapped.scale)
    return _lay(scan, surface, options, rng)


def _lay(scan: Mesh, surface: SignedDistance, options: RegistrationOptions, rng: np.random.Generator) -> Alignment:
    found = _search(scan, surface, options, rng)
    mirrored = _mirror_note(scan, surface, found, options)
    if found.overlap < _LEAST_OVERLAP:
        reason = mirrored or ("; check that both show the same teeth, in the same unit",)
        raise InputError(
            f"registration: at best {found.overlap:.0%} of the scan lies close to the reference{reason[0]}"
        )
    alignment = fit(scan.sample(options.samples, rng)[0], surface, found.best, options)
    notes = tuple(f"alignment: doubtful{note}" for note in mirrored)
    return replace(
        alignment,
        mirrored=bool(mirrored),
        notes=(*notes, *_doubt_notes(alignment), *_rivals(found.poses, found.misfits_mm, found.few)),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Search:
    """Poses that were found, by a few points of the scan."""

    few: Float[np.ndarray, "n 3"]
    poses: list[Rigid3]
    misfits_mm: Float[np.ndarray, "k"]
    """Truncated mean distance of each pose."""
    overlap: float
    """Of the best one."""

    @property
    def best(self) -> Rigid3:
        """The pose with the smallest misfit."""
        return self.poses[int(np.argmin(self.misfits_mm))]


def _search(scan: Mesh, surface: SignedDistance, options: RegistrationOptions, rng: np.random.Generator) -> _Search:
    few, _ = scan.sample(_FEW, rng)
    brief = replace(options, tolerance_um=1.0, iterations=25)
    starts = find_poses(scan, surface.mesh, options.search, rng=rng)
    poses = [refine(few, surface, start, brief) for start in starts]
    misfits_mm = np.array([_truncated_mean_mm(few, surface, pose) for pose in poses])
    best = poses[int(np.argmin(misfits_mm))]
    overlap = _overlap(surface.closest_points(best.apply(few)), options.outlier_mm)
    return _Search(few=few, poses=poses, misfits_mm=misfits_mm, overlap=overlap)


def _mirror_note(scan: Mesh, surface: SignedDistance, found: _Search, options: RegistrationOptions) -> tuple[str, ...]:
    """What is said where the mirror image of a scan that fits badly fits far better: no motion mends that."""
    misfit_mm = float(found.misfits_mm.min())
    if misfit_mm < _POOR_MM and found.overlap > _LEAST_OVERLAP:
        return ()
    image = Mesh(scan.vertices * [-1.0, 1.0, 1.0], scan.faces[:, ::-1])
    mirrored = _search(image, surface, options, np.random.default_rng(0))
    mirrored_mm = float(mirrored.misfits_mm.min())
    if mirrored_mm > _FAR_BETTER * misfit_mm or mirrored.overlap < max(found.overlap, 2 * _LEAST_OVERLAP):
        return ()
    return (
        f", the scan is a mirror image of the reference: mirrored it lies {1000 * mirrored_mm:.0f} instead of "
        f"{1000 * misfit_mm:.0f} um from it (mean); mirror one of the two files",
    )


def fit(
    points: Float[np.ndarray, "n 3"], surface: SignedDistance, start: Rigid3, options: RegistrationOptions
) -> Alignment:
    """Align points of a scan with a surface, starting from a pose nearby."""
    pose = refine(points, surface, start, options)
    closest = surface.closest_points(pose.apply(points))
    weights = _weights(closest)
    return Alignment(
        reference_from_scan=pose,
        scale=best_scale(points, surface, pose, options),
        rms_um=float(1000 * np.sqrt(np.sum(weights * closest.signed_mm**2) / max(weights.sum(), 1e-300))),
        overlap=_overlap(closest, options.outlier_mm),
    )


def refine(
    points: Float[np.ndarray, "n 3"], surface: SignedDistance, start: Rigid3, options: RegistrationOptions
) -> Rigid3:
    """``reference_from_scan`` with the smallest weighted sum of squared distances, starting from a pose nearby."""
    pose = start
    for _ in range(options.iterations):
        moved = pose.apply(points)
        closest = surface.closest_points(moved)
        centre = moved.mean(axis=0)
        step = _gauss_newton(moved - centre, closest, _weights(closest))
        motion = _motion_about(centre, step)
        pose = motion @ pose
        if np.abs(motion.apply(moved) - moved).max() < options.tolerance_um / 1000:
            break
    return pose


def best_scale(
    points: Float[np.ndarray, "n 3"], surface: SignedDistance, reference_from_scan: Rigid3, options: RegistrationOptions
) -> float:
    """Scale of the scan that the best similarity near an alignment would remove."""
    moved, shrinking = reference_from_scan.apply(points), 1.0
    for _ in range(options.iterations):
        closest = surface.closest_points(moved)
        centre = moved.mean(axis=0)
        step = _gauss_newton(moved - centre, closest, _weights(closest), with_scale=True)
        before = moved
        moved = _motion_about(centre, step[:6]).apply(centre + (1 + step[6]) * (moved - centre))
        shrinking *= 1 + step[6]
        if np.abs(moved - before).max() < options.tolerance_um / 1000:
            break
    return float(1 / shrinking)


def locate_place(
    points: Float[np.ndarray, "n 3"],
    surface: SignedDistance,
    reference_from_scan: Rigid3,
    place: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "3"]:
    """Where a place of the reference lies in a scan, by the similarity next to a rigid alignment of points around it.

    Where a piece of surface has grown, what is open of it would shift a rigid fit by a share of its growth.
    """
    moved = reference_from_scan.apply(points)
    closest, centre = surface.closest_points(moved), moved.mean(axis=0)
    step = _gauss_newton(moved - centre, closest, _weights(closest), with_scale=True)
    offset = np.cross(step[:3], place - centre) + step[3:6] + step[6] * (place - centre)
    return reference_from_scan.inverse().apply(place - offset)


def _motion_about(centre: Float[np.ndarray, "3"], step: Float[np.ndarray, "6"]) -> Rigid3:
    """The motion that turns about a centre and shifts."""
    turn = Rigid3.from_rotation_vector(step[:3], np.zeros(3))
    return Rigid3(turn.rotation, centre - turn.rotate(centre) + step[3:])


def _gauss_newton(
    centred: Float[np.ndarray, "n 3"],
    closest: ClosestPoints,
    weights: Float[np.ndarray, "n"],
    *,
    with_scale: bool = False,
) -> Float[np.ndarray, "p"]:
    """(turn in rad, shift in mm, and the relative growth if asked for) that lessens the distances most."""
    columns = [np.cross(centred, closest.directions), closest.directions]
    if with_scale:
        columns.append(np.sum(centred * closest.directions, axis=1, keepdims=True))
    jacobian = np.concatenate(columns, axis=1)
    hessian = jacobian.T @ (weights[:, None] * jacobian)
    # What the surface leaves free (a plane slides, a sphere turns) stays where it is.
    step = np.linalg.lstsq(hessian, -jacobian.T @ (weights * closest.signed_mm), rcond=1e-9)[0]
    return np.asarray(step)


def _weights(closest: ClosestPoints) -> Float[np.ndarray, "n"]:
    """:func:`biweights`, and none at the border of the reference."""
    return biweights(closest.signed_mm, ~closest.on_border)


def biweights(signed_mm: Float[np.ndarray, "n"], inside: Bool[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Tukey's biweight of distances, wide enough to leave normal errors nearly their full weight; none where they are
    not ``inside``. It is as wide as the errors ask for and no wider: errors far beyond the usual ones mostly lie on one
    side, as where a wall flares out at the border of a scan, and a few per cent of them would shift, turn and swell
    all."""
    distances = np.abs(signed_mm)
    if not inside.any():
        return np.zeros_like(distances)
    sigma = 1.4826 * np.median(distances[inside])
    cutoff = np.clip(6 * sigma, _NARROWEST_MM, _WIDEST_MM)
    return np.asarray(np.where(inside & (distances < cutoff), (1 - (distances / cutoff) ** 2) ** 2, 0.0))


def _overlap(closest: ClosestPoints, near_mm: float) -> float:
    return float(np.mean(~closest.on_border & (np.abs(closest.signed_mm) < near_mm)))


def _truncated_mean_mm(points: Float[np.ndarray, "n 3"], surface: SignedDistance, pose: Rigid3) -> float:
    closest = surface.closest_points(pose.apply(points))
    return float(np.where(closest.on_border, 0.5, np.minimum(np.abs(closest.signed_mm), 0.5)).mean())


def _doubt_notes(alignment: Alignment) -> tuple[str, ...]:
    notes = []
    if alignment.overlap < 0.6:
        notes.append(f"alignment: doubtful, only {alignment.overlap:.0%} of the scan lies close to the reference")
    if alignment.rms_um > 150:
        notes.append(f"alignment: doubtful, the surfaces differ by {alignment.rms_um:.0f} um RMS where they meet")
    return tuple(notes)


def _rivals(poses: list[Rigid3], scores: Float[np.ndarray, "k"], probes: Float[np.ndarray, "n 3"]) -> tuple[str, ...]:
    """A note where a quite different pose fits almost as well."""
    order = np.argsort(scores, kind="stable")
    best = poses[order[0]]
    for k in order[1:]:
        apart_mm = float(np.linalg.norm(poses[k].apply(probes) - best.apply(probes), axis=1).mean())
        if apart_mm > 0.5 and scores[k] < 1.25 * scores[order[0]] + 1e-3:
            return (f"alignment: doubtful, another pose {apart_mm:.1f} mm away fits almost as well",)
    return ()
