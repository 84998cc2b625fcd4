"""How well the teeth of a scan are placed relative to each other.

The scanned surface of each tooth is aligned with its reference by a separate rigid motion, ``reference_from_scan`` of
that tooth alone. The effect of these motions on the centroids of the teeth gives the errors of the distances across the
arch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.registration import RegistrationOptions, refine
from cuspid.geometry import Rigid3

ARCH_ORDER = (*range(48, 40, -1), *range(31, 39), *range(18, 10, -1), *range(21, 29))
"""FDI numbers along the lower and the upper arch."""
MOLARS = ((46, 36), (16, 26), (47, 37), (17, 27))
"""Pairs of molars for the inter-molar distance; the first pair that was scanned is used."""
CANINES = ((43, 33), (13, 23))
LEAST_SAMPLES = 300
"""Number of samples of a tooth below which it is not evaluated."""
_MOST_SAMPLES = 10_000


@dataclass(frozen=True, eq=False, kw_only=True)
class ScannedTooth:
    """The surface of one tooth in the scan."""

    points: Float[np.ndarray, "n 3"]
    """Samples of the aligned scan on this tooth, mm."""
    reference_from_scan: Rigid3
    """The rigid motion that best aligns them with the reference; the identity if the tooth is placed correctly."""
    centroid: Float[np.ndarray, "3"]
    """Centroid of the tooth in the reference, mm."""

    @property
    def scanned_centroid(self) -> Float[np.ndarray, "3"]:
        """Position of the centroid in the aligned scan."""
        return self.reference_from_scan.inverse().apply(self.centroid)


def find_teeth(
    points: Float[np.ndarray, "n 3"],
    labels: Int[np.ndarray, "n"],
    centroids: Mapping[int, Float[np.ndarray, "3"]],
    surface: SignedDistance,
    options: RegistrationOptions,
    *,
    order: Sequence[int] = ARCH_ORDER,
) -> dict[int, ScannedTooth]:
    """Teeth with enough samples in an aligned scan, in order along the arch.

    ``labels`` are the FDI numbers of the samples; ``centroids`` are those of the teeth that may be evaluated. Other
    pieces of surface are found likewise where their numbers are given as the ``order``.
    """
    teeth = {}
    for fdi in (tooth for tooth in order if tooth in centroids):
        on_tooth = points[labels == fdi]
        if len(on_tooth) >= LEAST_SAMPLES:
            few = on_tooth[:: max(1, len(on_tooth) // _MOST_SAMPLES)]
            motion = refine(few, surface, Rigid3.identity(), options)
            teeth[fdi] = ScannedTooth(points=on_tooth, reference_from_scan=motion, centroid=centroids[fdi])
    return teeth


def distance_error_um(teeth: Mapping[int, ScannedTooth], pairs: tuple[tuple[int, int], ...]) -> float | None:
    """Error of the distance between the centroids of the first pair that was scanned; positive if too wide."""
    for right, left in pairs:
        if right in teeth and left in teeth:
            a, b = teeth[right], teeth[left]
            scanned = np.linalg.norm(a.scanned_centroid - b.scanned_centroid)
            return float(1000 * (scanned - np.linalg.norm(a.centroid - b.centroid)))
    return None


def drift_um(teeth: Mapping[int, ScannedTooth], surface: SignedDistance) -> dict[int, float]:
    """Mean absolute distance of each tooth when the scan is aligned on the first tooth alone."""
    if not teeth:
        return {}
    anchor = next(iter(teeth.values())).reference_from_scan
    return {
        fdi: float(1000 * np.abs(surface.closest_points(anchor.apply(tooth.points)).signed_mm).mean())
        for fdi, tooth in teeth.items()
    }
