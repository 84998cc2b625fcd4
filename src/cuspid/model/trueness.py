"""The ground truth, and how far a scan is from it.

Deviations follow the terms of ISO 5725 and are in micrometres throughout.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int16, UInt8

from cuspid.geometry import Rigid3, read_only
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.rig import Handpiece
from cuspid.runtime.display import Displayed


@dataclass(frozen=True, eq=False, kw_only=True)
class GroundTruth:
    """What only the simulator knows. The reconstruction never sees it. The world frame is the jaw's occlusal frame."""

    jaw: Jaw
    """What was scanned."""
    handpiece: Handpiece
    """The handpiece as it was built (the capture may hold a nominal one)."""
    rig_from_world: Mapping[str, Rigid3]
    """Pose of the handpiece for each frame."""

    def __repr__(self) -> str:
        return f"GroundTruth({len(self.rig_from_world)} poses, {self.jaw})"


NOTHING = -1
"""The label of a pixel that shows nothing."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ReferenceRender:
    """A reference render: one image of a jaw from above, as a panorama should show it. Columns run along +X, rows along
    -Y.

    Pixel (u, v), with the centre of the first one at (0.5, 0.5), shows x = (u - u0) s, y = (v0 - v) s of the occlusal
    frame, where (u0, v0) is ``origin_px`` and s is ``mm_per_px``; a camera at a finite height shows points above or
    below the occlusal plane displaced.
    """

    image: UInt8[np.ndarray, "h w 3"]
    """RGB; black where there is nothing."""
    labels: Int16[np.ndarray, "h w"]
    """FDI number of the tooth at each pixel, 0 for gum, `NOTHING` for none."""
    height_mm: Float[np.ndarray, "h w"]
    """Height (z) of the surface at each pixel, NaN for none; float32."""
    mm_per_px: float
    """Millimetres per pixel, in the occlusal plane."""
    origin_px: Float[np.ndarray, "2"]
    """Pixel of the origin of the occlusal frame."""
    camera_height_mm: float | None = None
    """Height of the camera above the occlusal plane; None for an orthographic view."""

    def __post_init__(self) -> None:
        for name in ("image", "labels", "height_mm", "origin_px"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def teeth(self) -> Bool[np.ndarray, "h w"]:
        """Pixels that show teeth; the whole surface if the jaw has no labels."""
        on_teeth = self.labels > GUM
        return on_teeth if on_teeth.any() else self.labels != NOTHING

    def points_at(self, where: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "n 3"]:
        """The points of the surface that the given pixels show, in mm."""
        rows, columns = np.nonzero(where)
        z = self.height_mm[where].astype(np.float64)
        plane = (np.column_stack([columns, rows]) + 0.5 - self.origin_px) * [1, -1] * self.mm_per_px
        return np.column_stack([plane / self._perspective_factor(z)[:, None], z])

    def on_plane(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Where points appear on the occlusal plane, mm."""
        return points[:, :2] * self._perspective_factor(points[:, 2])[:, None]

    def _perspective_factor(self, z: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """How much farther out than it is a point of that height is seen on the occlusal plane."""
        return np.ones_like(z) if self.camera_height_mm is None else self.camera_height_mm / (self.camera_height_mm - z)


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


@dataclass(frozen=True, kw_only=True)
class CrownCompleteness:
    """How much of the crown surface that is open to some direction the scan covers, whether or not a camera could see
    it."""

    completeness_pct: Mapping[str, float]
    """Share of the open crown surface of the evaluated teeth within 50, 100, 200 um of the scan, keys "50", ..."""
    open_mm2: float
    """Area of that surface."""
    teeth: tuple[int, ...]
    """FDI numbers of the teeth evaluated in ``completeness_pct``: those that the scan was meant for."""
    per_tooth_pct: Mapping[int, Mapping[str, float]]
    """As ``completeness_pct``, by FDI number, for each tooth with any surface in reach."""
    estimated: bool
    """Whether crowns were separated from gum by shape, for lack of tooth labels; there are then no figures per
    tooth."""
    note: str
    """What is evaluated, in one human-readable line."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Trueness(Displayed):
    """Result of an evaluation."""

    accuracy: DeviationStatistics
    """Scan to reference, where the reference is evaluated (what two cameras could see, if that is known)."""
    everything: DeviationStatistics
    """Scan to reference, for everything that was scanned except what lies past an open border of the reference."""
    completeness: DeviationStatistics
    """Reference to scan."""
    completeness_pct: Mapping[str, float]
    """Share of the scannable reference surface within 50, 100, 200 um of the scan, keys "50", "100", "200"."""
    scannable_pct: float
    """Share of the reference surface that was scannable."""
    per_tooth: Mapping[int, DeviationStatistics]
    """Scan to reference, by FDI number."""
    per_tooth_completeness_pct: Mapping[int, Mapping[str, float]]
    """As ``completeness_pct``, by FDI number."""
    crown: CrownCompleteness | None
    """For all open crown surface; None if no crown was in reach or none is known."""
    scale_error_ppm: float
    """Scale of the best similarity, minus one; reported separately and never applied."""
    inter_molar_error_um: float | None
    """Error of the distance between the first molars (otherwise the second), or None without labels for both."""
    inter_canine_error_um: float | None
    """Error of the distance between the canines, or None."""
    drift_um: Mapping[int, float]
    """Mean distance error of each tooth when the scan is aligned on the first tooth alone, by FDI number."""
    reference_from_scan: Rigid3
    """The rigid alignment that was found."""
    deviation_um: Float[np.ndarray, "v"]
    """Signed deviation of each vertex of the scan; NaN where the vertex is not evaluated."""
    within_sigmas_pct: Mapping[str, float] | None = None
    """Share of the evaluated vertices within 1 and 2 of the standard deviations that the scan itself predicted, keys
    "1" and "2" (68 and 95 if all errors are random and accounted for); None if it predicted none."""
    notes: tuple[str, ...] = field(default=())
    """What a reader should know, for example how the scannable surface was determined."""

    def __repr__(self) -> str:
        return (
            f"Trueness(mean |d| {self.accuracy.mean_abs_um:.1f} um, P95 {self.accuracy.p95_um:.1f} um, "
            f"{self.completeness_pct['50']:.1f} % within 50 um, {len(self.deviation_um):,} vertices)"
        )


class Metric(NamedTuple):
    """A figure of an evaluation: how it is read, and what people see of it."""

    heading: str
    """Of a column."""
    unit: Literal["µm", "%", "ppm"]
    """Of its values."""
    about: str
    """What it is."""
    better: Literal[-1, 0, 1]
    """Whether less (-1) or more (1) is better, or nearer to zero (0)."""
    of: Callable[[Trueness], float | None]
    """The value of an evaluation; None where there is none."""
    is_statistic: bool = False
    """Whether it is one of :class:`DeviationStatistics`, which every region has."""

    @property
    def title(self) -> str:
        """The heading with the unit."""
        return f"{self.heading}, {self.unit}"

    @property
    def label(self) -> str:
        """What it is, as the label of an axis."""
        return f"{self.about} / {self.unit}"


def _statistic(name: str) -> Callable[[Trueness], float | None]:
    return lambda trueness: getattr(trueness.accuracy, name)


METRICS: Mapping[str, Metric] = MappingProxyType(
    {
        "mean_abs_um": Metric("mean |d|", "µm", "mean absolute deviation", -1, _statistic("mean_abs_um"), True),
        "signed_mean_um": Metric("signed mean", "µm", "mean deviation", 0, _statistic("signed_mean_um"), True),
        "std_um": Metric("SD", "µm", "standard deviation", -1, _statistic("std_um"), True),
        "rms_um": Metric("RMS", "µm", "root mean square deviation", -1, _statistic("rms_um"), True),
        "p95_um": Metric("P95", "µm", "95 % deviate by less", -1, _statistic("p95_um"), True),
        "max_um": Metric("max", "µm", "largest deviation", -1, _statistic("max_um"), True),
        "complete_50_um_pct": Metric(
            "within 50 µm", "%", "surface within 50 µm", 1, lambda trueness: trueness.completeness_pct["50"]
        ),
        "complete_100_um_pct": Metric(
            "within 100 µm", "%", "surface within 100 µm", 1, lambda trueness: trueness.completeness_pct["100"]
        ),
        "crown_50_um_pct": Metric(
            "of open crown",
            "%",
            "open crown surface within 50 µm",
            1,
            lambda trueness: None if trueness.crown is None else trueness.crown.completeness_pct["50"],
        ),
        "scannable_pct": Metric(
            "scannable", "%", "share of the reference that could be seen", 1, lambda trueness: trueness.scannable_pct
        ),
        "scale_error_ppm": Metric("scale error", "ppm", "scale error", 0, lambda trueness: trueness.scale_error_ppm),
        "inter_molar_error_um": Metric(
            "inter-molar error", "µm", "inter-molar error", 0, lambda trueness: trueness.inter_molar_error_um
        ),
        "inter_canine_error_um": Metric(
            "inter-canine error", "µm", "inter-canine error", 0, lambda trueness: trueness.inter_canine_error_um
        ),
    }
)
"""The figures by name. What the command line, the pages and the studies show of an evaluation comes from here."""
STATISTICS: tuple[str, ...] = tuple(name for name, metric in METRICS.items() if metric.is_statistic)
"""Those that every region has, in the order in which they are shown."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MarginSection:
    """Scan and reference in the plane across the line at one place; coordinates are (lateral, outward), mm."""

    place_mm: Float[np.ndarray, "3"]
    """The place on the line, in the frame of the reference: the origin of the coordinates."""
    reference: Float[np.ndarray, "m 2"]
    """The section of the reference, its outside to the right."""
    reference_edge: Float[np.ndarray, "2"]
    """The edge that was found in it."""
    scan: Float[np.ndarray, "k 2"] | None
    """The section of the scan; None where it has no surface there."""
    scan_edge: Float[np.ndarray, "2"] | None
    """The edge that was found in it, if any."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CutMargin:
    """A margin, cut at places along its line."""

    line: Float[np.ndarray, "n 3"]
    """The true line."""
    stations: int
    """Number of places along it, those that are not evaluated included."""
    sections: tuple[MarginSection, ...]
    """Those that are evaluated, in their order along the line; at least one."""
