"""What is true, and how far a scan is from it.

Deviations are measured as the field does (ISO 5725), in micrometres throughout.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.jaw import Jaw
from cuspid.rig import Handpiece


@dataclass(frozen=True, eq=False, kw_only=True)
class GroundTruth:
    """What only the simulator knows. Reconstruction never sees it. The world frame is the jaw's occlusal frame."""

    jaw: Jaw
    """What was scanned."""
    handpiece: Handpiece
    """The handpiece as it really was (the capture may hold a nominal one)."""
    rig_from_world: Mapping[str, Rigid3]
    """Pose of the handpiece for each frame."""


@dataclass(frozen=True, kw_only=True)
class DeviationStatistics:
    """Signed distances of one region in one direction, area-weighted."""

    count: int
    """Number of sample points."""
    mean_abs_um: float
    """Mean absolute deviation."""
    std_abs_um: float
    """Standard deviation of the absolute deviations, as in Table 3.2 of the thesis."""
    signed_mean_um: float
    """Mean; positive where the scan lies outside the reference."""
    std_um: float
    """Standard deviation of the signed deviations."""
    rms_um: float
    """Root mean square."""
    half_p90_p10_um: float
    """(P90 - P10) / 2 of the signed deviations."""
    p95_um: float
    """95th percentile of the absolute deviations."""
    min_um: float
    """Smallest absolute deviation."""
    max_um: float
    """Largest absolute deviation."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Trueness:
    """Result of an evaluation."""

    accuracy: DeviationStatistics
    """Scan to reference."""
    completeness: DeviationStatistics
    """Reference to scan."""
    completeness_pct: Mapping[str, float]
    """Share of the scannable reference surface within 50, 100, 200 um of the scan, keys "50", "100", "200"."""
    scannable_pct: float
    """Share of the reference surface that counted as scannable."""
    per_tooth: Mapping[int, DeviationStatistics]
    """Scan to reference, by FDI number."""
    per_tooth_completeness_pct: Mapping[int, Mapping[str, float]]
    """As ``completeness_pct``, by FDI number."""
    scale_error_ppm: float
    """Best similarity's scale minus one, reported apart and never applied."""
    inter_molar_error_um: float | None
    """Error of the distance between the first molars (else second), or None without labels for both."""
    inter_canine_error_um: float | None
    """Error of the distance between the canines, or None."""
    drift_um: Mapping[int, float]
    """Mean distance error of each tooth when the scan is aligned on the first tooth alone, by FDI number."""
    reference_from_scan: Rigid3
    """The rigid alignment that was found."""
    deviation_um: Float[np.ndarray, "v"]
    """Signed deviation of each vertex of the scan; NaN where the vertex does not count."""
    notes: tuple[str, ...] = field(default=())
    """What a reader should know, for example how the scannable surface was chosen."""
