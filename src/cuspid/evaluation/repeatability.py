"""Precision of repeated scans of one object: how well they agree with each other, whatever the truth is.

Terms of ISO 5725-1: *trueness* is how near the mean of many results lies to the reference, *precision* how near the
results lie to one another; here under repeatability conditions (the same object, handpiece and software). Two views:

- *All pairs*, the usual one in dentistry (for example Schimmel et al. 2021, doi:10.1007/s00784-020-03486-z: 45 pairs of
  10 scans): each scan is aligned with each other scan and their distances are measured, here in both directions. No
  reference is needed.
- *At each place* of the reference, with d_k the deviation of scan k there along the normal, positive outside: the
  mean over the scans is the systematic part, their standard deviation s the random one. Over the surface,
  s_r = sqrt(mean s^2) is the repeatability standard deviation and 2.8 s_r the repeatability limit (ISO 5725-6), which
  the difference of two scans at one place exceeds in 5 % of cases. The mean of n scans still contains s_r^2 / n of
  the random part, which is subtracted from the systematic one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float

from cuspid.evaluation.deviation import statistics
from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.registration import RegistrationOptions, refine
from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from cuspid.model.trueness import DeviationStatistics
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range

LIMIT_FACTOR = 2.8
"""Repeatability limit over repeatability standard deviation: 1.96 sqrt(2), rounded as in ISO 5725-6."""


@dataclass(frozen=True, kw_only=True)
class PairOptions(Options):
    """How scans are compared with each other."""

    align: bool = True
    """Align the two scans first; turn off if they are already in a common frame."""
    registration: RegistrationOptions = field(default_factory=RegistrationOptions)
    """How they are aligned."""
    samples: Annotated[int, Range(100, 20_000_000)] = 100_000
    """Sample points on each surface, uniform by area."""
    max_distance_mm: Annotated[float, Range(0.0001, 1000)] = 0.5
    """A point farther than this from the other scan counts as surface that the other one does not show."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PairDeviation:
    """Two scans of the same object."""

    deviation: DeviationStatistics
    """Signed distances in both directions; positive where the second lies outside the first."""
    common_pct: float
    """Share of their surfaces that both scans show."""


def compare_pair(first: Mesh, second: Mesh, options: PairOptions, *, rng: np.random.Generator) -> PairDeviation:
    """Distances between two scans that are already nearly aligned.

    What lies past the border of the other scan, or far from it, is not evaluated. Raises InputError where they have no
    surface in common.
    """
    surface = SignedDistance(first)
    if options.align:
        points, _ = second.sample(options.registration.samples, rng)
        second = second.transformed(refine(points, surface, Rigid3.identity(), options.registration))
    onto_first, first_common = _signed_distances(second, surface, options, rng)
    onto_second, second_common = _signed_distances(first, SignedDistance(second), options, rng)
    common = np.concatenate([first_common, second_common])
    if not common.any():
        raise InputError("repeatability: two scans have no surface in common; check that both show the same teeth")
    signed_mm = np.concatenate([onto_first[first_common], -onto_second[second_common]])
    return PairDeviation(deviation=statistics(signed_mm), common_pct=float(100 * common.mean()))


def _signed_distances(
    scan: Mesh, surface: SignedDistance, options: PairOptions, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Signed distances of points of a scan from a surface, and which of them the surface has, too."""
    closest = surface.closest_points(scan.sample(options.samples, rng)[0])
    return closest.signed_mm, ~closest.on_border & (np.abs(closest.signed_mm) <= options.max_distance_mm)
