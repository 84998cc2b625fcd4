"""What a study says in words: the methods paragraph for a paper, and what the standards ask to be stated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cuspid
from cuspid.evaluation.alignments import CONSEQUENCES
from cuspid.studies.scanners.scan import StudyOptions

_REGIONS = {
    "all": "All surface that all scans of a specimen show",
    "crowns": "The crowns, as far as all scans of a specimen show them,",
    "area": "The reference area, as far as all scans of a specimen show it,",
}
_PRECISION = {
    "pairs": "all pairs of repeats of a scanner on a specimen: the differences of their deviations at the same places "
    "of the reference, after the rigid motion that lessens them most",
    "meshes": "all pairs of repeats of a scanner on a specimen, mesh to mesh in both directions after a best fit of "
    "one to the other",
    "mean": "the deviations of each repeat from the mean surface of its scanner on a specimen, which contains it",
}
ANCHORS = (
    ("photogrammetry, implants", "17-30", "", "0.17-0.34", "Jain 2024"),
    ("intra-oral scanners, six implants, edentulous arch", "55-72", "38-49", "", "Jain 2024"),
)
"""Published figures to compare scan bodies with: what, trueness um, precision um, axis deg, source."""


def methods(options: StudyOptions, summary: Mapping[str, Any]) -> str:
    """A paragraph with every setting in it."""
    align = options.align
    registration, search = options.registration, options.registration.search
    teeth = f" (teeth {', '.join(map(str, options.align_teeth))}, FDI)" if options.align_teeth else ""
    counts = summary["counts"]
    lines = [
        f"{counts['scans']} scans of {counts['specimens']} specimens by {counts['scanners']} scanners were compared "
        f"with the reference mesh of each specimen with cuspid {cuspid.__version__}.",
        f"Alignment: {align}{teeth}; rigid, never scaled. {_capital(CONSEQUENCES[align])}.",
    ]
    if align != "none":
        lines.append(
            f"Starting poses were searched exhaustively ({search.anchors} anchors on {search.targets} targets in steps "
            f"of {search.turn_step_deg:g} deg, after a search of fewer where that left a doubt); the fit minimised "
            f"point-to-surface distances of {registration.samples} samples "
            "by Gauss-Newton with Tukey's biweight (six robust standard deviations), "
            f"until no sample moved by more than {registration.tolerance_um:g} um."
        )
    if align == "best-fit":
        lines.append("The fit was made anew on the surface that all scans of a specimen show.")
    lines.append(
        f"{_REGIONS[options.region]} was evaluated, at 60000 places of the reference and {options.samples} samples of "
        f"each scan, uniform by area (seed {options.seed}); surface farther than {options.max_distance_mm:g} mm from "
        "the other one counted as not shown. Deviations are signed closest-point distances, positive outside the "
        "reference; figures without a prefix are from scan to reference."
    )
    lines.append(
        f"Scans with less than {options.min_overlap:.0%} overlap were taken for other specimens, and those that show "
        f"less than {options.min_share:.0%} of what the median scan shows for partial ones; both were left out and "
        "are listed."
    )
    lines.append(
        "Trueness and precision are named as in ISO 5725-1. Trueness: the deviations from the reference. Precision, "
        f"under repeatability conditions: {_PRECISION[options.precision]}."
    )
    lines.append(
        "Deformation of the arch: scale, in-plane bend (spread), out-of-plane bend (lift) and torsion (twist) of a bar "
        "along the arch curve, fitted together with a rigid motion to the crowns; amplitudes are the root mean square "
        "displacement of its ends with the middle held."
    )
    lines.append(
        "Intervals are at 95 %: of means by bootstrap within specimens, widened as Student's t; of precision by the "
        "jackknife of scans on the logarithm. Scanners were compared by a mixed model (scanner fixed; specimen and "
        "operator random; REML, F with residual degrees of freedom), or by Kruskal-Wallis on values centred by "
        "specimen where residuals were not normal (Shapiro-Wilk) or variances unequal (Brown-Forsythe); pairs and "
        "figures were corrected by Holm (statsmodels, SciPy). They hold for the specimens of this study."
    )
    return " ".join(lines)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def checklist(options: StudyOptions, summary: Mapping[str, Any]) -> Sequence[Mapping[str, str]]:
    """What ISO 12836, ISO 20896-1 and ISO/TR 20896-2 ask reports on scanners to state, and whether this one does."""
    counts = summary["counts"]
    known = "stated above"
    return [
        {"item": item, "stated": stated}
        for item, stated in (
            ("test objects, their material and their surface", "not known to cuspid: add it"),
            ("reference: how it was measured, and its uncertainty", "not known to cuspid: add it"),
            ("scanner, its software and version, and calibration", "names alone are known: add it"),
            ("scan strategy, powder, light, temperature and humidity", "not known to cuspid: add it"),
            ("operators", known if counts["operators"] else "not given (column operator of a manifest)"),
            ("number of repeats", f"{counts['fewest']} to {counts['most']} for each scanner and specimen"),
            ("alignment and evaluated region", f"{options.align}; {options.region}"),
            ("trueness as distances and angles of the test object", known if counts["spans"] else "not measured"),
            ("trueness and precision as ISO 5725-1 names them", known),
            ("software of the evaluation and its settings", f"cuspid {cuspid.__version__}; methods paragraph"),
            ("scans that were left out, and why", f"{counts['left_out']} left out, listed above"),
        )
    ]
