"""Sections 1.2 and 3.1 to 3.4: projections, epipolar geometry, precision of a pair of cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from types import MappingProxyType

import numpy as np

from cuspid.thesis.catalogue import Item
from cuspid.thesis.findings import (
    CHECKED,
    EXACT,
    Finder,
    Finding,
    Result,
    Results,
    compare,
    of_check,
    only,
    vanishes,
    vanishing,
)
from cuspid.thesis.rules import AtLeast, AtMost, Comparison, Equals, Holds


def _fig_1_3(item: Item, results: Results) -> Finding:
    row = compare(
        results,
        CHECKED,
        lambda found: found["stereo_matches"]["enamel_right"] / found["stereo_matches"]["artificial_right"],
        quantity="right matches on enamel, as a share of those on the artificial texture",
        printed="few",
        rule=AtMost(limit=0.25),
        shown=lambda found: (
            "{enamel_right:.0f} of {enamel_matches:.0f} matches are right on enamel, {artificial_right:.0f} of "
            "{artificial_matches:.0f} on the texture".format(**found["stereo_matches"])
        ),
    )
    notes = (
        "SIFT matches of the two cameras 2.5 mm apart over tooth 46, 5 mm away; right within 2 px of the epipolar "
        "line.",
    )
    return Finding(item=item, comparisons=(row,), notes=notes)


def _parameters(results: Results) -> Comparison:
    return of_check(
        results,
        "projection_matrices",
        "parameters",
        quantity="free parameters of P (rank of its derivative by 12 numbers)",
        printed="11",
        rule=Equals(thesis=11.0, within=0.0),
    )


def _foreshortening(kind: str, thesis: float) -> Callable[[Results], Comparison]:
    return lambda results: of_check(
        results,
        "projections",
        f"{kind}_ratio",
        quantity=f"image of a length at 5 mm over that at 10 mm, {kind}",
        printed="larger" if thesis > 1 else "the same",
        rule=Equals(thesis=thesis, within=EXACT),
    )


def _noise_growth(results: Results) -> Comparison:
    return of_check(
        results,
        "occlusion",
        "wide_upright_noise_growth",
        quantity="noise of matching with upright windows, over that without deformation",
        printed="windows do not show the same surface",
        rule=AtLeast(limit=2.0),
        shown=lambda found: (
            f"{found['occlusion']['wide_upright_noise_growth']:.1f} times; with windows that turn with the surface "
            f"{found['occlusion']['wide_slanted_noise_growth']:.1f} times"
        ),
    )


_BASELINES = ("1", "1.5", "2.5", "4")
"""In mm, as in the names of the figures."""


def _by_baseline(found: Result, check: str, name: str) -> list[float]:
    return [found[check][name.format(f"{baseline}_mm")] for baseline in _BASELINES]


def _smaller_baseline(
    check: str, name: str, quantity: str, unit: str, sign: int, because: str = ""
) -> Callable[[Results], Comparison]:
    """Whether a smaller baseline is the better one by a figure, of which less (1) or more (-1) is better."""

    def ours(found: Result) -> bool:
        values = [sign * value for value in _by_baseline(found, check, name)]
        return all(small < large for small, large in pairwise(values))

    return lambda results: compare(
        results,
        CHECKED,
        ours,
        quantity=f"a smaller baseline is better: {quantity}",
        unit=unit,
        printed="a smaller baseline is more accurate",
        rule=Holds(text="reproduced: the smaller of any two of the baselines is the better one; else it differs"),
        because=because,
        shown=lambda found: (
            " / ".join(f"{value:.1f}" for value in _by_baseline(found, check, name))
            + f" at {' / '.join(_BASELINES)} mm"
        ),
    )


_BASELINE_ROWS = (
    _smaller_baseline(
        "baseline_bound",
        "rms_{}_um",
        "the bound of Eq 3.9, noise of 0.5 px",
        "µm",
        1,
        "with constant noise the bound falls as the baseline grows, with the printed exponents, too",
    ),
    _smaller_baseline("baseline_terms", "seen_{}_pct", "share of the surface that both cameras see", "%", -1),
    _smaller_baseline("baseline_terms", "upright_noise_growth_{}", "noise of matching, upright windows", "times", 1),
    _smaller_baseline("baseline_terms", "slanted_noise_growth_{}", "noise of matching, slanted windows", "times", 1),
    _smaller_baseline(
        "baseline_terms",
        "upright_expected_{}_um",
        "expected error of what is seen, upright windows",
        "µm",
        1,
        "bound and noise weigh each other out (docs/precision.md)",
    ),
    _smaller_baseline(
        "baseline_terms",
        "slanted_expected_{}_um",
        "expected error of what is seen, slanted windows",
        "µm",
        1,
        "the bound gains more than matching loses",
    ),
)
"""The terms apart."""


_STUDIED = MappingProxyType({"baseline_mm": (1.0, 4.0), "angle_deg": (10.0, 40.0), "distance_mm": (3.0, 13.0)})
"""Ranges of the thesis' setting."""


def _studied(name: str) -> Callable[[Results], Comparison]:
    """Whether our study of pairs covers a range."""
    low, high = _STUDIED[name]

    def ours(found: Result) -> bool:
        least, most = found["pair_grid"][f"least_{name}"], found["pair_grid"][f"largest_{name}"]
        return bool(least <= low and most >= high)

    return lambda results: compare(
        results,
        CHECKED,
        ours,
        quantity=f"{name.split('_')[0]} of the pairs that are studied",
        unit=name.split("_")[1],
        printed=f"{low:g} to {high:g}",
        rule=Holds(text="reproduced: the range of ours holds that of the thesis; else it differs"),
        shown=lambda found: f"{found['pair_grid'][f'least_{name}']:g} to {found['pair_grid'][f'largest_{name}']:g}",
    )


def _closer_needs_angle(results: Results) -> Comparison:
    def rows(found: Result) -> list[tuple[float, float]]:
        best = found["best_within_budget"]["slanted"]
        return [(row["distance_mm"], row["axis_angle_deg"]) for row in best if row["facing"] == "occlusal"]

    return compare(
        results,
        "camera_pair",
        lambda found: _rank_correlation(rows(found)),
        quantity="rank correlation of distance and best angle, occlusal surface",
        printed="a smaller distance needs a larger angle",
        rule=AtMost(limit=-0.5),
        shown=lambda found: (
            f"{_rank_correlation(rows(found)):.2f} ("
            + ", ".join(f"{distance:g} mm: {angle:g}°" for distance, angle in rows(found))
            + ")"
        ),
    )


def _rank_correlation(pairs: Sequence[tuple[float, float]]) -> float:
    """Spearman's; 0 where one of the two does not vary."""
    ranks = np.array([_ranks(np.array(column)) for column in zip(*pairs, strict=True)])
    return 0.0 if np.ptp(ranks, axis=1).min() == 0 else float(np.corrcoef(ranks)[0, 1])


def _ranks(values: np.ndarray) -> np.ndarray:
    """Mean rank among equal ones."""
    return np.array([(values < value).sum() + (values == value).sum() / 2 for value in values])


def _not_orthographic(results: Results) -> Comparison:
    return of_check(
        results,
        "projections",
        "perspective_ratio",
        quantity="image of a length at 5 mm over that at 10 mm by the printed formula",
        printed="orthographic, which means 1",
        rule=Equals(thesis=1.0, within=EXACT),
        because="the print has the perspective formula under orthographic projection, whose own is x = s X, y = s Y",
    )


def _printed_exponents(results: Results) -> Comparison:
    return of_check(
        results,
        "closed_form",
        "printed_ratio_1_mm",
        "printed_ratio_4_mm",
        quantity="bound with the printed exponents over the true one, 1 and 4 mm, 5 mm away",
        printed="1 and 1",
        rule=Equals(thesis=(1.0, 1.0), within=0.01),
        because="the exponents of the depths are 4; with 1 the two terms have not even the same unit",
    )


def _likelihood(results: Results) -> Comparison:
    return vanishes(
        results,
        "likelihood",
        "relative_difference",
        "scatter of the likelihood's slope against the Fisher matrix, 200,000 draws",
        limit=0.01,
        printed="exp(-|| x - K(R X + t ||²) / 2 sigma²",
    )


_MATRIX = ("projection_matrices", "residual_px", "K [R | t] X against the camera", "px")
_SKEW = "Used with [e']x, the matrix of the cross product with e', which the print leaves out."

FINDERS: Mapping[str, Finder] = MappingProxyType(
    {
        "fig-1.3": _fig_1_3,
        "fig-3.1": only(vanishing("projections", "residual_px", "x = f X / Z against the camera", "px")),
        "fig-3.2": only(_parameters),
        "fig-3.3": only(_foreshortening("perspective", 2.0), _foreshortening("orthographic", 1.0)),
        "fig-3.4": only(vanishing("epipolar", "line_residual_px", "distance of x' from l', 20 random pairs", "px")),
        "fig-3.5": only(vanishing("epipolar", "plane_residual", "F through a plane against F by the projections")),
        "fig-3.6": only(
            vanishing("pair_parameters", "residual_mm_deg", "baseline and angle of pairs made with them", "mm, deg")
        ),
        "fig-3.7": only(_noise_growth),
        "fig-3.8": only(
            vanishing("closed_form", "relative_residual", "the setting's closed form against Fisher's matrix")
        ),
        "fig-3.9": only(*map(_studied, ("baseline_mm", "angle_deg", "distance_mm"))),
        "fig-3.10": only(
            *_BASELINE_ROWS,
            _closer_needs_angle,
            notes=(
                "Parallel pair, 5 mm from the occlusal surface of a second molar. The claim holds for what both "
                "cameras see and for matching, not for the bound that it is derived from. Slanted windows turn with "
                "the surface, upright ones are only shifted.",
            ),
        ),
        "eq-3.1": only(
            vanishing("projections", "residual_px", "x = f X / Z against a perspective camera", "px"), _not_orthographic
        ),
        "eq-3.2": only(
            vanishing(*_MATRIX, printed="P = K [R | T]"),
        ),
        "eq-3.3": only(
            vanishing("epipolar", "line_residual_px", "distance of x' from the line of x", "px", printed="x ⇒ l'")
        ),
        "eq-3.4": only(
            vanishing(
                "epipolar",
                "plane_residual",
                "[e']x H against F by the projections, norm 1",
                printed="l' = e' × H × x = x F",
            ),
            notes=(_SKEW,),
        ),
        "eq-3.5": only(
            vanishing(
                "epipolar", "line_residual_px", "x' from l' = F x, F = [e']x P' P+", "px", printed="F = e' × P' × P+"
            ),
            notes=(_SKEW,),
        ),
        "eq-3.6": only(
            vanishing("epipolar", "constraint_residual_px", "x'T F x as a distance", "px", printed="x' F x = 0"),
            notes=("Used with x' transposed: as printed two columns would be multiplied.",),
        ),
        "eq-3.7": only(vanishing(*_MATRIX, printed="x = P X = K [R | t] X")),
        "eq-3.8": only(
            _likelihood,
            notes=("Used with the projection pi: || x - pi(K (R X + t)) ||²; a bracket and pi are lost in the print.",),
        ),
        "eq-3.9": only(
            vanishing(
                "closed_form", "relative_residual", "closed form, exponents 4, against Fisher's matrix, relative"
            ),
            _printed_exponents,
        ),
    }
)
"""By item."""
