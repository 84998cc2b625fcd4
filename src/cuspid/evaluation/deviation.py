"""Trueness of a scan, by the usual measures, in both directions. Positive is outside the reference.

Accuracy: signed distances from points on the scan, uniform by area, to the reference. Completeness: from points on the
reference, uniform by area, to the scan. What is evaluated:

- Of the reference, the faces of the ``scannable`` mask, which the pipeline sets where at least two cameras could see.
  Without a mask, all of it except what ``min_openness`` and ``crop_mm`` exclude.
- Of the scan, every point, except
  (a) a point whose closest reference face is not evaluated and that lies within ``margin_mm`` of it: the scan has
      surface where nothing could be measured, but where surface is. A point farther off is an error and is evaluated;
  (b) without a mask, a point whose closest point lies on an open border of the reference: the scan may simply show
      more. With a mask the reference is all there was to see, and a point is left out only if it lies past the border,
      farther sideways than up or down, and within ``margin_mm``, as where a scan frays at its rim.

In addition there are figures for everything scanned (all points except those of (b)), and the completeness of all
crown surface that is open to some direction (:mod:`cuspid.evaluation.crown`).

The distance of a point is always that to the closest surface, whether this is evaluated or not. ``Trueness.notes``
states how much was left out by each rule.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.evaluation.crown import OpenCrown, crown_completeness, within_pct
from cuspid.evaluation.distance import ClosestPoints, SignedDistance
from cuspid.evaluation.registration import Alignment, RegistrationOptions, best_scale, register
from cuspid.evaluation.teeth import CANINES, LEAST_SAMPLES, MOLARS, distance_error_um, drift_um, find_teeth
from cuspid.geometry import Rigid3
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.trueness import DeviationStatistics, Trueness
from cuspid.model.visibility import openness
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import SHARE, Options, Range

_LEAST_TOOTH_PCT = 30.0
"""Share of a tooth's surface that must lie within 200 um of the scan for its position to be evaluated."""


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions(Options):
    """How a scan is compared with its reference."""

    align: bool = True
    """Align the scan rigidly first, from any pose; turn off if it is already in the frame of the reference."""
    registration: RegistrationOptions = field(default_factory=RegistrationOptions)
    """How it is aligned."""
    samples: Annotated[int, Range(100, 20_000_000)] = 200_000
    """Sample points on each of the two surfaces, uniform by area."""
    margin_mm: Annotated[float, Range(0, 1000)] = 0.5
    """A point of the scan over surface that is not evaluated is left out only if it lies within this distance."""
    crop_mm: Annotated[float | None, Range(0.001, 1000)] = None
    """Reference surface farther than this from the scan is considered not scanned; default: everything is evaluated."""
    min_openness: Annotated[float, SHARE] = 0.0
    """Without a mask: share of the directions above the occlusal plane that must be free for a face to be evaluated.
    0.05 excludes the hidden insides and the base of a model; 0 evaluates everything."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Rules:
    """What is evaluated; see the top of the module."""

    faces: Bool[np.ndarray, "f"]
    """Faces of the reference that are evaluated."""
    margin_mm: float
    """Limit of both rules."""
    reference_is_all: bool
    """The scan cannot rightly show anything else: the strict form of rule (b)."""
    note: str
    """How the faces were chosen."""

    def unscannable(self, closest: ClosestPoints) -> Bool[np.ndarray, "n"]:
        """Points that rule (a) leaves out."""
        return ~self.faces[closest.faces] & (np.abs(closest.signed_mm) <= self.margin_mm)

    def past_border(self, closest: ClosestPoints) -> Bool[np.ndarray, "n"]:
        """Points that rule (b) leaves out."""
        if not self.reference_is_all:
            return closest.on_border
        return closest.past_border & (np.abs(closest.signed_mm) <= self.margin_mm)

    def is_evaluated(self, closest: ClosestPoints) -> Bool[np.ndarray, "n"]:
        """Points that are evaluated."""
        return ~(self.unscannable(closest) | self.past_border(closest))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Samples:
    """Points that count, from one of the two surfaces."""

    points: Float[np.ndarray, "n 3"]
    """In the frame of the reference, mm."""
    signed_mm: Float[np.ndarray, "n"]
    """Distances to the other surface, positive where the scan lies outside the reference."""
    labels: Int[np.ndarray, "n"]
    """FDI numbers of the reference faces to which they belong, 0 for gum or unknown."""
    left_out: str
    """What is not evaluated, for people."""

    def within_pct_by_tooth(self) -> dict[int, dict[str, float]]:
        """Shares within some um, of each tooth that has samples."""
        teeth = (int(label) for label in np.unique(self.labels) if label != GUM)
        return {fdi: within_pct(self.signed_mm[self.labels == fdi]) for fdi in teeth}


def evaluate(
    scan: Mesh,
    reference: Jaw,
    options: EvaluationOptions,
    *,
    scannable: Bool[np.ndarray, "f"] | None = None,
    crown: OpenCrown | None = None,
    sigma_um: Float[np.ndarray, "v"] | None = None,
    rng: np.random.Generator | None = None,
) -> Trueness:
    """Compare a scan in any pose with a reference, of which the faces in ``scannable`` are evaluated (None: see the
    module).

    ``crown``: the open crown surface of the reference, whose completeness is evaluated too. ``sigma_um``: the standard
    deviation that the scan predicts for each of its vertices, along its normal. ``rng`` draws the samples; without it
    they are the same each time. Raises InputError where the two do not belong together or nothing is left to compare.
    """
    rng = rng or np.random.default_rng(0)
    surface = SignedDistance(reference.mesh)
    rules = _rules(reference.mesh, scannable, options)
    alignment = _align(scan, surface, options, rng)
    aligned = scan.transformed(alignment.reference_from_scan)
    labels = reference.face_labels if reference.face_labels is not None else np.full(len(reference.mesh.faces), GUM)
    deviation_um = _deviation_um(aligned, surface, rules)
    from_scan, everything = _samples_of_scan(aligned, surface, labels, rules, options, rng)
    from_reference, counted_pct = _samples_of_reference(aligned, reference.mesh, labels, rules, options, rng)
    completeness_by_tooth = from_reference.within_pct_by_tooth()
    centroids = {
        fdi: reference.mesh.centroid((labels == fdi) & rules.faces)
        for fdi, within in completeness_by_tooth.items()
        if within["200"] >= _LEAST_TOOTH_PCT
    }
    teeth = find_teeth(from_scan.points, from_scan.labels, centroids, surface, options.registration)
    return Trueness(
        accuracy=statistics(from_scan.signed_mm),
        everything=everything,
        completeness=statistics(from_reference.signed_mm),
        completeness_pct=within_pct(from_reference.signed_mm),
        scannable_pct=counted_pct,
        per_tooth={
            fdi: statistics(from_scan.signed_mm[from_scan.labels == fdi])
            for fdi in completeness_by_tooth
            if np.sum(from_scan.labels == fdi) >= LEAST_SAMPLES
        },
        per_tooth_completeness_pct=completeness_by_tooth,
        crown=None if crown is None else crown_completeness(aligned, crown, scannable, options.samples, rng),
        scale_error_ppm=1e6 * (alignment.scale - 1),
        inter_molar_error_um=distance_error_um(teeth, MOLARS),
        inter_canine_error_um=distance_error_um(teeth, CANINES),
        drift_um=drift_um(teeth, surface),
        reference_from_scan=alignment.reference_from_scan,
        deviation_um=deviation_um,
        within_sigmas_pct=None if sigma_um is None else _within_sigmas_pct(deviation_um, sigma_um),
        notes=(*alignment.notes, rules.note, from_scan.left_out, from_reference.left_out),
    )


def _within_sigmas_pct(deviation_um: Float[np.ndarray, "v"], sigma_um: Float[np.ndarray, "v"]) -> dict[str, float]:
    known = np.isfinite(deviation_um)
    return {str(k): 100 * float(np.mean(np.abs(deviation_um[known]) <= k * sigma_um[known])) for k in (1, 2)}


def statistics(signed_mm: Float[np.ndarray, "n"]) -> DeviationStatistics:
    """Statistics of signed distances (mm) that are uniform by area. Raises InputError where there are none."""
    if len(signed_mm) == 0:
        raise InputError("evaluation: no surface is left to compare; check the scannable mask and --crop-mm")
    signed_um = 1000 * signed_mm
    absolute_um = np.abs(signed_um)
    p10, p90 = np.percentile(signed_um, [10, 90])
    return DeviationStatistics(
        count=len(signed_um),
        mean_abs_um=float(absolute_um.mean()),
        std_abs_um=float(absolute_um.std()),
        signed_mean_um=float(signed_um.mean()),
        std_um=float(signed_um.std()),
        rms_um=float(np.sqrt(np.mean(signed_um**2))),
        half_p90_p10_um=float((p90 - p10) / 2),
        p95_um=float(np.percentile(absolute_um, 95)),
        min_um=float(absolute_um.min()),
        max_um=float(absolute_um.max()),
    )


def _rules(reference: Mesh, scannable: Bool[np.ndarray, "f"] | None, options: EvaluationOptions) -> _Rules:
    if scannable is not None and len(scannable) != len(reference.faces):
        raise InputError(
            f"evaluation: the scannable mask has {len(scannable)} faces, the reference {len(reference.faces)}; "
            "give the reference that it was made for"
        )
    if scannable is not None:
        faces, note = scannable, "the faces that at least two cameras could see"
    elif options.min_openness > 0:
        faces = openness(reference, reference.face_centres, reference.face_normals) >= options.min_openness
        note = f"the faces seen from {options.min_openness:.0%} of the directions above the occlusal plane"
    else:
        faces = np.ones(len(reference.faces), dtype=bool)
        note = "all of it, including hidden insides and the base (--min-openness and --crop-mm exclude them)"
    return _Rules(
        faces=faces,
        margin_mm=options.margin_mm,
        reference_is_all=scannable is not None,
        note=f"evaluated part of the reference: {note}",
    )


def _align(scan: Mesh, surface: SignedDistance, options: EvaluationOptions, rng: np.random.Generator) -> Alignment:
    if options.align:
        return register(scan, surface, options.registration, rng=rng)
    points, _ = scan.sample(options.registration.samples, rng)
    scale = best_scale(points, surface, Rigid3.identity(), options.registration)
    notes = ("alignment: none, the scan was assumed to be in the frame of the reference",)
    return Alignment(reference_from_scan=Rigid3.identity(), scale=scale, rms_um=0.0, overlap=1.0, notes=notes)


def _deviation_um(aligned: Mesh, surface: SignedDistance, rules: _Rules) -> Float[np.ndarray, "v"]:
    """Of each vertex, NaN where it is not evaluated."""
    closest = surface.closest_points(aligned.vertices)
    return np.where(rules.is_evaluated(closest), 1000 * closest.signed_mm, np.nan)


def _samples_of_scan(
    aligned: Mesh,
    surface: SignedDistance,
    labels: Int[np.ndarray, "f"],
    rules: _Rules,
    options: EvaluationOptions,
    rng: np.random.Generator,
) -> tuple[_Samples, DeviationStatistics]:
    """The samples, and the statistics of everything that was scanned."""
    points, _ = aligned.sample(options.samples, rng)
    closest = surface.closest_points(points)
    evaluated = rules.is_evaluated(closest)
    past_border = rules.past_border(closest)
    over, past = 100 * rules.unscannable(closest).mean(), 100 * past_border.mean()
    limit = f" by at most {rules.margin_mm:g} mm" if rules.reference_is_all else ""
    samples = _Samples(
        points=points[evaluated],
        signed_mm=closest.signed_mm[evaluated],
        labels=labels[closest.faces[evaluated]],
        left_out=f"left out of the scan: {over:.1f} % within {rules.margin_mm:g} mm of reference surface that "
        f"is not evaluated, {past:.1f} % past an open border of the reference{limit}",
    )
    return samples, statistics(closest.signed_mm[~past_border])


def _samples_of_reference(
    aligned: Mesh,
    reference: Mesh,
    labels: Int[np.ndarray, "f"],
    rules: _Rules,
    options: EvaluationOptions,
    rng: np.random.Generator,
) -> tuple[_Samples, float]:
    """The samples, and the share of the reference that they stand for, in per cent."""
    indices = np.flatnonzero(rules.faces)
    area_pct = 100 * reference.face_areas[indices].sum() / reference.face_areas.sum()
    if not area_pct > 0:
        raise InputError(
            "evaluation: no face of the reference is left to evaluate; check the scannable mask and --min-openness"
        )
    asked = reference if rules.faces.all() else Mesh(reference.vertices, reference.faces[indices])
    points, picks = asked.sample(options.samples, rng)
    faces = indices[picks]
    distances, _, positions = aligned.closest(points)
    signs = np.where(np.sum((positions - points) * reference.face_normals[faces], axis=1) < 0, -1.0, 1.0)
    near = distances <= (np.inf if options.crop_mm is None else options.crop_mm)
    cropped = "none" if options.crop_mm is None else f"all more than {options.crop_mm:g} mm from the scan"
    samples = _Samples(
        points=points[near],
        signed_mm=(signs * distances)[near],
        labels=labels[faces[near]],
        left_out=f"part of the reference regarded as not scanned: {cropped}",
    )
    return samples, float(area_pct * near.mean())
