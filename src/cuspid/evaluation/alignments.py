"""The alignments that the dental field uses, and what each means for the figures that follow.

All are rigid; the scale is never changed. A best fit spreads an error of the whole arch over it, so that much of it is
not seen in the deviations; where only a part is aligned, the error shows at full size at the other end.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

import numpy as np
from jaxtyping import Float

from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.registration import RegistrationOptions, refine
from cuspid.geometry import Rigid3, best_similarity
from cuspid.runtime.errors import InputError

AlignmentKind = Literal["best-fit", "area", "crowns", "landmarks", "spheres", "bodies", "none"]
"""What a scan is aligned by."""
CONSEQUENCES: Mapping[AlignmentKind, str] = MappingProxyType(
    {
        "best-fit": "global best fit over what all scans of a specimen show: errors of the whole arch are spread over "
        "it and look smaller than they are; read spans, modes, or an alignment on a part beside it",
        "area": "best fit on a reference area alone: what lies away from it shows the errors that add up along the "
        "arch, at full size; the figures depend on which area was chosen and how well it was scanned",
        "crowns": "best fit on the crowns alone: gum and base have no part in it; errors of the whole arch are spread "
        "over the crowns",
        "landmarks": "best fit of landmarks set by people: their scatter, mostly 0.1 mm or more, is part of all "
        "deviations",
        "spheres": "best fit of the centres of spheres: surfaces that bear no sphere have no part in it",
        "bodies": "best fit of the places of the scan bodies: teeth and gum have no part in it",
        "none": "no alignment: the files are taken to be in one frame, and any motion between them counts as error",
    }
)
"""What to bear in mind, for people."""
_REACH_MM = 2.0
"""Samples within this of the area may belong to it."""
_LEAST_SAMPLES = 200


def align_on_area(
    points: Float[np.ndarray, "n 3"], surface: SignedDistance, reference_from_scan: Rigid3, options: RegistrationOptions
) -> Rigid3:
    """Fit a scan to a part of its reference, from an alignment of the whole that is good to about a millimetre.

    ``points`` are samples of the scan, ``surface`` is that of the area. Raises InputError where they hardly show it.
    """
    near = np.abs(surface.closest_points(reference_from_scan.apply(points)).signed_mm) < _REACH_MM
    if near.sum() < _LEAST_SAMPLES:
        raise InputError(f"alignment: the scan hardly shows the reference area ({near.sum()} of {len(points)} samples)")
    return refine(points[near], surface, reference_from_scan, options)


def align_points(
    measured: Mapping[str, Float[np.ndarray, "3"]], nominal: Mapping[str, Float[np.ndarray, "3"]], what: str
) -> Rigid3:
    """The motion that lays points on their nominal places with the smallest sum of squared distances.

    Raises InputError for fewer than three common points, or points on one line.
    """
    names = [name for name in nominal if name in measured]
    source = np.array([measured[name] for name in names]).reshape(-1, 3)
    target = np.array([nominal[name] for name in names]).reshape(-1, 3)
    spread = np.linalg.svd(target - target.mean(axis=0), compute_uv=False) if len(names) > 2 else np.zeros(3)
    if spread[1] <= 1e-3 * spread[0]:
        raise InputError(f"alignment: {len(names)} {what} in common, or all on one line; three others are needed")
    _, rotation, _ = best_similarity(source, target, np.ones(len(names)))
    return Rigid3(rotation, target.mean(axis=0) - rotation @ source.mean(axis=0))
