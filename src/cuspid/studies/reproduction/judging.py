"""From results to verdicts: for every item of the catalogue what we find beside what the thesis states.

Results are what the runs wrote, by name. Nothing is computed here but what follows from them, and no verdict is given
but by a rule of :mod:`cuspid.studies.reproduction.rules`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from cuspid.anatomy.arch import PRINTED_TABLE
from cuspid.errors import InputError
from cuspid.studies.reproduction.catalogue import ITEMS, TABLE_3_2, Item, TruenessRow
from cuspid.studies.reproduction.rules import (
    AtLeast,
    AtMost,
    Comparison,
    Equals,
    Exceeds,
    Figure,
    Holds,
    LessIsBetter,
    Rule,
    Verdict,
    least_favourable,
)

Result = Mapping[str, Any]
Results = Mapping[str, Result]
Table = tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]
"""Headings, and rows of cells."""

CHECKED = "thesis_checks"
"""Name of the results of what is computed in seconds."""
PANORAMA = "panorama/"
"""How the names of results of panoramas begin; then follow subject and method."""
SUBJECTS = 10
"""Of Fig 4.4."""
EXACT = 1e-9
"""What differs by no more agrees to rounding."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What we find of an item."""

    item: Item
    """Which one."""
    comparisons: tuple[Comparison, ...] = ()
    """Figures beside each other."""
    notes: tuple[str, ...] = ()
    """What else is to be known: conditions, figures that the thesis has no counterpart of."""
    table: Table | None = None
    """Such figures in rows."""

    @property
    def verdict(self) -> Verdict:
        """The least favourable of its figures."""
        return "not known" if self.item.lost else least_favourable(each.verdict for each in self.comparisons)

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of the results that have not been run."""
        return tuple(dict.fromkeys(each.source for each in self.comparisons if each.verdict == "not run"))


def judge(results: Results, items: Sequence[Item] = ITEMS) -> tuple[Finding, ...]:
    """The finding of each item. Raises InputError where a result lacks a field."""
    return tuple(_FINDERS[item.id](item, results) if item.id in _FINDERS else Finding(item=item) for item in items)


def compare(
    results: Results,
    source: str,
    ours: Callable[[Result], Figure | None],
    *,
    quantity: str,
    printed: str,
    rule: Rule,
    unit: str = "",
    because: str = "",
    shown: Callable[[Result], str] = lambda result: "",
) -> Comparison:
    """A figure of a result beside the thesis; not run where there is no such result.

    Raises InputError where the result has no such field.
    """
    result = results.get(source)
    try:
        found = None if result is None else ours(result)
        words = "" if result is None or found is None else shown(result)
    except (KeyError, TypeError, IndexError, AttributeError, StopIteration) as error:
        raise InputError(f"results {source}.json: not what is expected there ({error!r}); run it again") from error
    return Comparison(
        quantity=quantity,
        unit=unit,
        printed=printed,
        ours=found,
        rule=rule,
        because=because,
        shown=words,
        source=source,
        quick=bool(result and result.get("quick")),
    )


def _check(results: Results, check: str, *names: str, **fields: Any) -> Comparison:
    """A figure, or the ends of an interval, of a check."""

    def ours(result: Result) -> Figure:
        values = tuple(result[check][name] for name in names)
        return values[0] if len(values) == 1 else values

    return compare(results, CHECKED, ours, **fields)


def _exact(results: Results, check: str, name: str, quantity: str, unit: str = "", limit: float = EXACT) -> Comparison:
    """A residual that should vanish."""
    return _check(results, check, name, quantity=quantity, unit=unit, printed="the formula", rule=AtMost(limit=limit))


# --- Chapter 1 --------------------------------------------------------------------------------------------------------


def _fig_1_3(item: Item, results: Results) -> Finding:
    row = compare(
        results,
        CHECKED,
        lambda found: found["stereo_matches"]["enamel_right"] / found["stereo_matches"]["artificial_right"],
        quantity="right matches on enamel, as a share of those on the artificial texture",
        printed="few",
        rule=AtMost(limit=0.25),
        shown=lambda found: (
            f"{found['stereo_matches']['enamel_right'] / found['stereo_matches']['artificial_right']:.3f} "
            f"({found['stereo_matches']['enamel_right']:.0f} of {found['stereo_matches']['enamel_matches']:.0f} "
            "matches "
            f"are right on enamel, {found['stereo_matches']['artificial_right']:.0f} of "
            f"{found['stereo_matches']['artificial_matches']:.0f} on the texture)"
        ),
    )
    notes = (
        "SIFT matches of the two cameras 2.5 mm apart over tooth 46, 5 mm away; right within 2 px of the epipolar "
        "line.",
    )
    return Finding(item=item, comparisons=(row,), notes=notes)


# --- Chapter 2 --------------------------------------------------------------------------------------------------------

_RIEDER = "the model solves the angle from the opening, of which the thesis takes Rieder's; its 26 deg are of 93 others"


def _fig_2_1(item: Item, results: Results) -> Finding:
    rows = [
        _check(
            results,
            "radius",
            f"median_turn_{sex}_deg",
            quantity=f"angle at maximal opening, median of {sex}",
            unit="deg",
            printed="26 ± 7",
            rule=Equals(thesis=26.0, within=7.0),
            because=_RIEDER,
        )
        for sex in ("men", "women")
    ]
    return Finding(item=item, comparisons=tuple(rows))


def _fig_2_2(item: Item, results: Results) -> Finding:
    row = compare(
        results,
        "populations",
        lambda found: max(group["max_abs_asked_minus_measured_mm"] for group in found["groups"].values()),
        quantity="dimensions of phantoms, asked for against measured, largest difference",
        unit="mm",
        printed="definitions",
        rule=AtMost(limit=0.05),
    )
    return Finding(item=item, comparisons=(row,))


def _fig_2_3(item: Item, results: Results) -> Finding:
    row = _check(
        results,
        "landmarks",
        "landmarks",
        quantity="landmarks of a jaw of 14 teeth",
        printed="72",
        rule=Equals(thesis=72.0, within=0.0),
    )
    return Finding(item=item, comparisons=(row,), notes=("Which points they are is lost; the scheme is ours.",))


def _fig_2_5(item: Item, results: Results) -> Finding:
    row = _exact(
        results,
        "sagittal_model",
        "residual_mm",
        "gap and opening of the sagittal model against points turned one by one, 100 mouths",
        "mm",
    )
    return Finding(item=item, comparisons=(row,), notes=("The numbers are compared in Eq 2.1 to 2.4.",))


def _fig_2_6(item: Item, results: Results) -> Finding:
    rows = [
        _check(
            results,
            "gap",
            f"fits_{sex}_pct",
            quantity=f"{sex} whose gap at the second molar holds 7 mm of handpiece and 5 mm of distance",
            unit="%",
            printed="about 5 mm are left",
            rule=AtLeast(limit=95.0),
        )
        for sex in ("women", "men")
    ]
    return Finding(item=item, comparisons=tuple(rows), notes=("Openings of 894 adults (docs/mouth.md).",))


def _eq_2_1(item: Item, results: Results) -> Finding:
    same = _check(
        results,
        "radius",
        "least_mm",
        "largest_mm",
        quantity="r from the printed inputs",
        unit="mm",
        printed="77.7 to 134",
        rule=Equals(thesis=(77.7, 134.0), within=1.0),
    )
    model = _check(
        results,
        "radius",
        "model_turn_at_35_mm_deg",
        "model_turn_at_60_mm_deg",
        quantity="angle for openings of 35 and 60 mm, r = 90 mm",
        unit="deg",
        printed="25.8 for both (0.45 rad)",
        rule=Equals(thesis=(25.8, 25.8), within=1.0),
        because="opening and angle belong together: who opens wider turns farther. Dividing the extreme openings by "
        "the mean angle makes r vary instead",
    )
    return Finding(item=item, comparisons=(same, model))


def _eq_2_2(item: Item, results: Results) -> Finding:
    same = _check(
        results,
        "ramus_angle",
        "least_deg",
        "largest_deg",
        quantity="arcsin(RH / r) from the printed inputs",
        unit="deg",
        printed="21 to 39",
        rule=Equals(thesis=(21.0, 39.0), within=1.0),
    )
    model = "{:.1f} deg is the angle of our model: the ramus goes from condyle to gonion, below the occlusal plane."
    notes = (model.format(results[CHECKED]["ramus_angle"]["model_deg"]),) if CHECKED in results else ()
    return Finding(item=item, comparisons=(same,), notes=notes)


def _eq_2_3(item: Item, results: Results) -> Finding:
    rows = [
        _check(
            results,
            "hinge_distance",
            f"distance_{end}_mm",
            quantity=f"distance from the axis to the second molar, r = {radius:g} mm, Lower-14",
            unit="mm",
            printed=f"{printed:.1f} by its formula",
            rule=Equals(thesis=printed, within=1.0),
            because="the formula gives a projection; the distance is d² = r² + f² - 2 r f cos(alpha)",
        )
        for end, radius, printed in (("least", 77.7, 38.1), ("largest", 134.0, 86.4))
    ]
    return Finding(item=item, comparisons=tuple(rows))


def _eq_2_4(item: Item, results: Results) -> Finding:
    thesis = Equals(thesis=(12.0, 26.6), within=1.0)
    inputs = _check(
        results,
        "gap",
        "least_mm",
        "largest_mm",
        quantity="L from the printed inputs, all rows of Table 2.1",
        unit="mm",
        printed="12 to 26.6",
        rule=thesis,
        because="the printed range does not follow from the printed inputs: 77.78 - 51.23 = 26.55 and 0.45 x 26.55 = "
        "11.95 look like d and L of one case with cos(alpha) left out",
    )
    model = _check(
        results,
        "gap",
        "model_at_35_mm",
        "model_at_60_mm",
        quantity="L of the sagittal model for openings of 35 and 60 mm",
        unit="mm",
        printed="12 to 26.6",
        rule=thesis,
        because="the jaw turns about condyles that slide, and the occlusal plane lies below them",
    )
    note = "12 mm is sound as a conservative gap for a handpiece, though not for the reason that is given (Fig 2.6)."
    return Finding(item=item, comparisons=(inputs, model), notes=(note,))


_SE = 3.0
"""Means that are so many standard errors apart differ; with a dozen rows, two happen by chance."""
_COPY = "the printed column f repeats column b to 0.06 mm and is very likely a copy of it"


def _table_2_1(item: Item, results: Results) -> Finding:
    rows = [
        *(
            _drawn(results, group, name)
            for group, printed in PRINTED_TABLE.items()
            for name in printed
            if name != "f" or group.endswith("14")
        ),
        *(_scanned(results, group, name) for group in _scanned_groups(results) for name in "abcf"),
    ]
    notes = [
        "The CT models are not public. Populations of phantoms are drawn from the distributions of a, b and c, "
        "made, and "
        "measured by landmarks: that shows that the tools measure what the table defines, not that people are so. f is "
        "drawn from other sources (docs/phantom.md), for the column cannot be trusted.",
    ]
    if "measure" in results:
        notes.append(
            "Real intra-oral scans (public, no CT; landmarks estimated from tooth labels) count as people: rows "
            "`scans`."
        )
    return Finding(item=item, comparisons=tuple(rows), notes=tuple(notes))


def _drawn(results: Results, group: str, name: str) -> Comparison:
    mean, sd = PRINTED_TABLE[group][name]
    entry = group.lower()

    def count(found: Result) -> int:
        return int(found["groups"][entry]["jaws"])

    found = results.get("populations")
    jaws = count(found) if found is not None and entry in found.get("groups", {}) else 16
    return compare(
        results,
        "populations",
        lambda result: result["groups"][entry][name]["measured"]["mean_mm"],
        quantity=f"{name}, {group}, phantoms",
        unit="mm",
        printed=f"{mean:.2f} ± {sd:.2f}",
        rule=Equals(thesis=mean, within=round(_SE * sd / np.sqrt(jaws), 2)),
        because=_COPY if name == "f" else "drawn jaws that cannot stand are drawn again",
        shown=lambda result: _mean_sd(result["groups"][entry][name]["measured"], "mean_mm", "sd_mm"),
    )


def _scanned_groups(results: Results) -> list[str]:
    groups = results.get("measure", {}).get("real", {}).get("groups", [])
    return [group["group"] for group in groups if group["group"] in PRINTED_TABLE and group["jaws"] > 1]


def _scanned(results: Results, group: str, name: str) -> Comparison:
    mean, sd = PRINTED_TABLE[group][name]
    entry = next(each for each in results["measure"]["real"]["groups"] if each["group"] == group)
    count, ours = entry[f"{name}_n"], entry[f"{name}_sd_mm"]
    error = np.hypot((ours or 0.0) / np.sqrt(max(count, 1)), sd / np.sqrt(_CT_MODELS[group]))
    return compare(
        results,
        "measure",
        lambda result: entry[f"{name}_mean_mm"],
        quantity=f"{name}, {group}, {count} scans",
        unit="mm",
        printed=f"{mean:.2f} ± {sd:.2f}",
        rule=Equals(thesis=mean, within=round(float(_SE * error), 2)),
        because=_COPY if name == "f" else "other people, few of them",
        shown=lambda result: _mean_sd(entry, f"{name}_mean_mm", f"{name}_sd_mm"),
    )


_CT_MODELS = MappingProxyType({"Lower-14": 90, "Upper-14": 259, "Lower-12": 39, "Upper-12": 44})
"""How many jaws the thesis measured."""


def _mean_sd(entry: Result, mean: str, sd: str) -> str:
    return f"{entry[mean]:.2f}" + ("" if entry[sd] is None else f" ± {entry[sd]:.2f}")


# --- Chapter 3: cameras -----------------------------------------------------------------------------------------------


def _only(*rows: Callable[[Results], Comparison], notes: tuple[str, ...] = ()) -> Callable[[Item, Results], Finding]:
    """A finder of rows that need no item."""
    return lambda item, results: Finding(item=item, comparisons=tuple(row(results) for row in rows), notes=notes)


def _residual(
    check: str, name: str, quantity: str, unit: str = "", limit: float = EXACT
) -> Callable[[Results], Comparison]:
    return lambda results: _exact(results, check, name, quantity, unit, limit)


def _parameters(results: Results) -> Comparison:
    return _check(
        results,
        "projection_matrices",
        "parameters",
        quantity="free parameters of P (rank of its derivative by 12 numbers)",
        printed="11",
        rule=Equals(thesis=11.0, within=0.0),
    )


def _foreshortening(kind: str, thesis: float) -> Callable[[Results], Comparison]:
    return lambda results: _check(
        results,
        "projections",
        f"{kind}_ratio",
        quantity=f"image of a length at 5 mm over that at 10 mm, {kind}",
        printed="larger" if thesis > 1 else "the same",
        rule=Equals(thesis=thesis, within=EXACT),
    )


def _noise_growth(results: Results) -> Comparison:
    return _check(
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


def _smaller_baseline(results: Results) -> Comparison:
    names = ("1", "1.5", "2.5", "4")
    return _check(
        results,
        "baseline_bound",
        "smaller_is_more_accurate",
        quantity="a smaller baseline is more accurate, by Eq 3.9 that it is derived from",
        printed="yes",
        rule=Holds(text="reproduced: the bound grows with the baseline from 1 to 4 mm; else it differs"),
        because="with constant noise the bound falls as the baseline grows. What speaks for a small one is matching "
        "with "
        "upright windows, and that near the tooth both cameras see more in common (docs/precision.md)",
        shown=lambda found: (
            "no: RMS "
            + " / ".join(f"{found['baseline_bound'][f'rms_{name}_mm_um']:.1f}" for name in names)
            + " µm at "
            + " / ".join(names)
            + " mm (5 mm away, parallel, 0.5 px)"
        ),
    )


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


_TERMS = {"complete_50_um_pct": ("completeness within 50 µm", "%", 1), "mean_abs_um": ("mean deviation", "µm", -1)}
_SWEEP_BECAUSE = {
    "complete_50_um_pct": "at 5 mm parallel cameras share less of the surface the farther they stand apart",
    "mean_abs_um": "a longer baseline measures what it sees more precisely",
}


def _behind(results: Results, surface: str, term: str) -> Comparison:
    """How far the thesis' pair is behind the best one, in standard errors."""
    title, unit, sign = _TERMS[term]

    def ours(found: Result) -> float | None:
        swept = found["surfaces"].get(surface)
        if swept is None or swept.get("thesis") is None or swept["best"][term]["noise"] is None:
            return None
        best, thesis = swept["best"][term], swept["thesis"]
        error = best["noise"] * np.sqrt(2 / best["seeds"])
        return float(sign * (best["value"] - thesis[term]) / max(error, EXACT))

    def shown(found: Result) -> str:
        best, thesis = found["surfaces"][surface]["best"][term], found["surfaces"][surface]["thesis"]
        place = "{:g} mm, {:g}°"
        return (
            f"{ours(found):.1f}: {thesis[term]:.2f} {unit} at {place.format(*thesis['setting'])}; best "
            f"{best['value']:.2f} {unit} at {place.format(*best['setting'])}"
        )

    return compare(
        results,
        "camera_sweep",
        ours,
        quantity=f"{surface}: {title} of its pair, standard errors behind the best pair",
        printed="the best" if surface in ("occlusal", "incisal") else "suitable",
        rule=AtMost(limit=2.0),
        because=_SWEEP_BECAUSE[term],
        shown=shown,
    )


def _fig_3_13(item: Item, results: Results) -> Finding:
    rows = [
        _check(
            results,
            "surfaces",
            "surfaces",
            quantity="of the eight surfaces, how many we have by the same name",
            printed="8",
            rule=Equals(thesis=8.0, within=0.0),
        ),
        *(_suits(results, surface) for surface in ("buccal", "lingual")),
    ]
    return Finding(item=item, comparisons=tuple(rows))


def _suits(results: Results, surface: str) -> Comparison:
    return compare(
        results,
        "camera_sweep",
        lambda found: (
            None
            if (found["surfaces"].get(surface) or {}).get("thesis") is None
            else found["surfaces"][surface]["thesis"]["mean_abs_um"]
        ),
        quantity=f"{surface} surface with 2.5 mm, parallel: mean deviation, against the best tooth of Table 3.2",
        unit="µm",
        printed="suitable",
        rule=AtMost(limit=min(row.mean_um for row in TABLE_3_2)),
        shown=lambda found: "{mean_abs_um:.2f}; {complete_50_um_pct:.0f} % of the surface in one pass".format(
            **found["surfaces"][surface]["thesis"]
        ),
    )


def _fig_3_14(item: Item, results: Results) -> Finding:
    rows = [_behind(results, surface, term) for surface in ("occlusal", "incisal") for term in _TERMS]
    notes = (
        "Every setting is a whole simulated scan of one pass (docs/sweep.md); the best settings and the thesis' are "
        "repeated with other seeds, which gives the standard error.",
    )
    return Finding(item=item, comparisons=tuple(rows), notes=notes)


def _count(check: str, name: str, quantity: str, thesis: float, unit: str = "") -> Callable[[Results], Comparison]:
    return lambda results: _check(
        results,
        check,
        name,
        quantity=quantity,
        unit=unit,
        printed=f"{thesis:g}",
        rule=Equals(thesis=thesis, within=EXACT),
    )


def _group_sees(surface: str) -> Callable[[Results], Comparison]:
    return lambda results: compare(
        results,
        "visibility",
        lambda found: next(
            row["seen_by_2_pct"] for row in found["surfaces"]["twelve-cameras"] if row["surface"] == surface
        ),
        quantity=f"{surface} surfaces of the arch that two of the twelve cameras see at once",
        unit="%",
        printed="a group for each main surface",
        rule=AtLeast(limit=90.0),
        because="crowded and steep places are hidden",
    )


def _fig_3_16(item: Item, results: Results) -> Finding:
    row = compare(
        results,
        "mean_shape",
        lambda found: (
            float(found["population"]["first_00"]["rounds"])
            if found["population"]["first_00"]["converged"]
            else float("inf")
        ),
        quantity="iterations until the mean does not change",
        printed="a few",
        rule=AtMost(limit=5.0),
        shown=lambda found: "{rounds}".format(**found["population"]["first_00"]),
    )
    count = results["mean_shape"]["population"]["count"] if "mean_shape" in results else None
    made = "" if count is None else f" Ours is the mean of {count} phantoms drawn from Table 2.1."
    return Finding(
        item=item,
        comparisons=(row,),
        notes=(f"The thesis' mean is of CT models that are not public.{made}",),
    )


# --- Chapter 3: designs -----------------------------------------------------------------------------------------------

Row = Mapping[str, Any]


def _design_row(found: Result, design: str, turns: int, jaw: str | None = None) -> Row | None:
    """Of the comparison of designs, first molar 46."""
    place = {"design": design, "turns": turns, "tooth": 46, "jaw": jaw or _hardest_jaw(found)}
    rows = (row for row in found["rows"] if all(row[name] == value for name, value in place.items()))
    return next(rows, None)


def _hardest_jaw(found: Result) -> str:
    """The boxes, where they were scanned."""
    return "boxed-mean" if any(row["jaw"] == "boxed-mean" for row in found["rows"]) else "phantom"


_WITHIN = "tooth_within_50_um_pct"


def _gain(results: Results, first: tuple[str, int], second: tuple[str, int], **fields: Any) -> Comparison:
    """By how many points the second design and turns reconstruct more of the tooth than the first."""

    def pair(found: Result) -> tuple[Row, Row] | None:
        one, other = _design_row(found, *first), _design_row(found, *second)
        return None if one is None or other is None else (one, other)

    def ours(found: Result) -> float | None:
        rows = pair(found)
        return None if rows is None else float(rows[1][_WITHIN] - rows[0][_WITHIN])

    def shown(found: Result) -> str:
        one, other = pair(found) or ({}, {})
        return f"{ours(found):+.1f} ({one[_WITHIN]:.1f} to {other[_WITHIN]:.1f} %, {_hardest_jaw(found)})"

    return compare(results, "design_comparison", ours, unit="points", shown=shown, **fields)


def _three_turns(results: Results) -> Comparison:
    return _gain(
        results,
        ("six", 1),
        ("six", 3),
        quantity="what three turns of the six reconstruct more of the tooth than one",
        printed="at least three turns",
        rule=AtLeast(limit=5.0),
    )


def _five_turns(results: Results) -> Comparison:
    return _gain(
        results,
        ("six", 3),
        ("six", 5),
        quantity="what five turns reconstruct more than three",
        printed="three are enough",
        rule=AtMost(limit=0.5),
    )


def _six_not_four(results: Results) -> Comparison:
    return _gain(
        results,
        ("four", 3),
        ("six", 3),
        quantity="what the six reconstruct more of the tooth than the essential four, three turns",
        printed="two more cameras are needed",
        rule=AtLeast(limit=5.0),
    )


def _table_3_1(item: Item, results: Results) -> Finding:
    source = "design_comparison_full_size" if "design_comparison_full_size" in results else "design_comparison"
    rows = tuple(
        _twelve_less(results, source, column, quantity, unit)
        for column, quantity, unit in (
            ("images", "images", ""),
            ("frames", "positions of the handpiece, and so capture time", ""),
            ("tooth_mean_abs_um", "mean deviation on the tooth", "µm"),
        )
    )
    notes = [
        "A molar of the phantom, twelve cameras moved and six with three turns. More of it, also with handpieces of "
        "fewer "
        "cameras that `cuspid design` found: docs/six-or-twelve.md."
    ]
    return Finding(item=item, comparisons=rows, notes=tuple(notes), table=_designs_table(results.get(source)))


def _twelve_less(results: Results, source: str, column: str, quantity: str, unit: str) -> Comparison:
    def pair(found: Result) -> tuple[float, float] | None:
        rows = (_design_row(found, "twelve", 1, "phantom"), _design_row(found, "six", 3, "phantom"))
        values = [None if row is None else row.get(column) for row in rows]
        return None if values[0] is None or values[1] is None else (float(values[0]), float(values[1]))

    def ours(found: Result) -> bool | None:
        values = pair(found)
        return None if values is None else values[0] < values[1]

    def shown(found: Result) -> str:
        twelve, six = pair(found) or (float("nan"), float("nan"))
        return f"{twelve:.3g} against {six:.3g}"

    return compare(
        results,
        source,
        ours,
        quantity=f"{quantity}: fewer with twelve than with six"
        if not unit
        else f"{quantity}: less with twelve than six",
        unit=unit,
        printed="yes",
        rule=Holds(text="reproduced: the figure of the twelve is the smaller one; else it differs"),
        because="each turn adds positions that see the same places again",
        shown=shown,
    )


def _designs_table(found: Result | None) -> Table | None:
    if found is None:
        return None
    columns = {
        "cameras": ("cameras", 0),
        "frames": ("positions", 0),
        "images": ("images", 0),
        "swept_width_mm": ("width, mm", 1),
        "height_mm": ("height, mm", 1),
        "tooth_mean_abs_um": ("mean, µm", 2),
        "tooth_p95_um": ("P95, µm", 1),
        _WITHIN: ("tooth within 50 µm, %", 1),
    }
    chosen = [row for row in found["rows"] if row["jaw"] == "phantom" and row["tooth"] == 46]
    rows = tuple(
        (
            str(row["design"]),
            str(row["turns"]),
            *("-" if row.get(name) is None else f"{row[name]:.{digits}f}" for name, (_, digits) in columns.items()),
        )
        for row in chosen
    )
    return (("design", "turns", *(head for head, _ in columns.values())), rows)


# --- Chapter 3: trueness ----------------------------------------------------------------------------------------------


def trueness_of(result: Result, row: TruenessRow) -> Result:
    """Of a result of a row of Table 3.2: of its tooth, or of the whole scan."""
    found: Result = (
        result["trueness"]["accuracy"] if row.tooth is None else result["trueness"]["per_tooth"][str(row.tooth)]
    )
    return found


def _trueness_row(results: Results, row: TruenessRow, statistic: str) -> Comparison:
    field, printed = {
        "min": ("min_um", row.min_um),
        "max": ("max_um", row.max_um),
        "mean": ("mean_abs_um", row.mean_um),
        "SD": ("std_abs_um", row.std_um),
        "RMS": ("rms_um", float(np.hypot(row.mean_um, row.std_um))),
    }[statistic]
    because = {
        "max": "the largest of all points of the scan; the thesis measured at few points",
        "min": "",
    }.get(statistic, "")
    return compare(
        results,
        row.result,
        lambda result: float(trueness_of(result, row)[field]),
        quantity=f"{row.part}, {row.what}: {statistic}",
        unit="µm",
        printed=f"{printed:.0f}",
        rule=LessIsBetter(thesis=printed),
        because=because,
    )


def _images_row(results: Results, row: TruenessRow) -> Comparison:
    thesis = 1200.0 if row.tooth is None else 120.0
    return compare(
        results,
        row.result,
        lambda result: float(result["images"]),
        quantity=f"{row.part}: images",
        printed=f"{thesis:g}",
        rule=Equals(thesis=thesis, within=0.1 * thesis),
        because="as many as an overlap of more than 75 % needs on our path",
    )


def _table_3_2(item: Item, results: Results) -> Finding:
    rows = [_trueness_row(results, row, each) for row in TABLE_3_2 for each in ("min", "max", "mean", "SD")]
    rows += [_images_row(results, row) for row in TABLE_3_2 if "images" in results.get(row.result, {})]
    notes = [
        "Twelve cameras, artificial texture, noise 1.5 DN, exactly known rig. Ours are absolute deviations of all "
        "points "
        "of the scan on the tooth (A: of the whole scan) where two cameras could see the reference, aligned "
        "rigidly; the "
        "thesis has lines at few points. A smallest deviation says nothing: of many points one is right.",
        "The printed figures cannot be of many points: the SD of " + _impossible(results),
    ]
    return Finding(item=item, comparisons=tuple(rows), notes=tuple(notes), table=_trueness_table(results))


def _impossible(results: Results) -> str:
    excess = {
        row.part: row.std_um - float(np.sqrt((row.max_um - row.mean_um) * (row.mean_um - row.min_um)))
        for row in TABLE_3_2
    }
    parts = [f"{part} by {value:.1f} µm" for part, value in excess.items() if value > 0]
    return (
        f"{' and of '.join(parts)} exceeds the most that numbers with that smallest, largest and mean value can have "
        "(Bhatia and Davis, Am. Math. Monthly 107, 2000)."
    )


def _trueness_table(results: Results) -> Table | None:
    head = ("part", "FDI", "min", "max", "mean", "SD", "RMS", "P95", "within 50 µm, %", "thesis: min/max/mean/SD")
    rows = []
    for row in TABLE_3_2:
        result = results.get(row.result)
        if result is not None:
            found = trueness_of(result, row)
            trueness = result["trueness"]
            shares = (
                trueness["completeness_pct"]
                if row.tooth is None
                else trueness["per_tooth_completeness_pct"][str(row.tooth)]
            )
            columns = ("min_um", "max_um", "mean_abs_um", "std_abs_um", "rms_um", "p95_um")
            figures = [f"{found[name]:.1f}" for name in columns]
            printed = "/".join(f"{value:g}" for value in (row.min_um, row.max_um, row.mean_um, row.std_um))
            rows.append((row.part, str(row.tooth or "all"), *figures, f"{shares['50']:.1f}", printed))
    return (head, tuple(rows)) if rows else None


def _fig_3_21(item: Item, results: Results) -> Finding:
    rows = tuple(_trueness_row(results, row, "RMS") for row in TABLE_3_2 if row.tooth is not None)
    return Finding(item=item, comparisons=rows)


def _fig_3_22(item: Item, results: Results) -> Finding:
    rows = tuple(_trueness_row(results, row, "RMS") for row in TABLE_3_2 if row.tooth is None)
    return Finding(item=item, comparisons=rows)


def _as_prepared(results: Results) -> Comparison:
    return _check(
        results,
        "preparations",
        "as_in_the_text",
        quantity="kinds of preparation by tooth",
        printed="46 crack, 45 crown, 42 full-contour crown, 35 and 36 MOD inlays",
        rule=Holds(text="reproduced: each tooth has the kind that the text names; else it differs"),
        shown=lambda found: found["preparations"]["teeth"],
    )


# --- Chapter 3: equations ---------------------------------------------------------------------------------------------


def _printed_exponents(results: Results) -> Comparison:
    return _check(
        results,
        "closed_form",
        "printed_ratio_1_mm",
        "printed_ratio_4_mm",
        quantity="bound with the printed exponents over the true one, 1 and 4 mm, 5 mm away",
        printed="1 and 1",
        rule=Equals(thesis=(1.0, 1.0), within=0.01),
        because="the exponents of the depths are 4; 1 does not even have the unit of a length",
    )


def _likelihood(results: Results) -> Comparison:
    return _exact(
        results,
        "likelihood",
        "relative_difference",
        "scatter of the likelihood's slope against the Fisher matrix, 200,000 draws",
        limit=0.01,
    )


# --- Chapter 4 --------------------------------------------------------------------------------------------------------


def _fig_4_1(item: Item, results: Results) -> Finding:
    def more(one: str, other: str, claim: str, because: str) -> Comparison:
        return compare(
            results,
            CHECKED,
            lambda found: (
                found["normal_map_features"][f"{one}_matches"] > found["normal_map_features"][f"{other}_matches"]
            ),
            quantity=claim,
            printed="yes",
            rule=Holds(
                text="reproduced: more matches between consecutive frames agree with a homography; else it differs"
            ),
            because=because,
            shown=lambda found: "{:.0f} against {:.0f} matches".format(
                *(found["normal_map_features"][f"{name}_matches"] for name in (one, other))
            ),
        )

    rows = (
        _exact(results, "normals", "residual", "normal map against the normals that it is made of", limit=1e-6),
        more("kaze_normal_map", "sift_normal_map", "on normal maps KAZE finds more than SIFT", ""),
        more(
            "kaze_normal_map",
            "kaze_grey",
            "KAZE finds more on normal maps than on the frames",
            "the frames of our enamel have highlights and shading on which KAZE finds even more; they move with the "
            "light, "
            "so more matches need not be better ones",
        ),
        more("kaze_normal_map", "sift_grey", "KAZE on normal maps finds more than SIFT on the frames", ""),
    )
    return Finding(item=item, comparisons=rows, notes=("Three pairs of frames of a film over plain enamel.",))


def _fig_4_2(item: Item, results: Results) -> Finding:
    row = compare(
        results,
        CHECKED,
        lambda found: found["free_path"]["unrestricted_height_sd_mm"] > found["free_path"]["restricted_height_sd_mm"],
        quantity="height of the camera over the occlusal plane varies more on the unrestricted path",
        unit="mm",
        printed="yes",
        rule=Holds(text="reproduced: the SD of the height is the larger one; else it differs"),
        shown=lambda found: "SD {unrestricted_height_sd_mm:.2f} against {restricted_height_sd_mm:.2f}".format(
            **found["free_path"]
        ),
    )
    note = "How far the thesis' camera strayed is not told; our hand is in docs/panorama-evaluation.md."
    return Finding(item=item, comparisons=(row,), notes=(note,))


def _fig_4_3(item: Item, results: Results) -> Finding:
    expected = {
        "translation": ("translation",),
        "shearing": ("corner angle",),
        "scale_and_translation": ("translation", "scale"),
        "small_motion": ("",),
    }
    rows = tuple(_refused(results, name, tests) for name, tests in expected.items())
    note = (
        "Limits: corner angles of 80 to 110 deg, translation of 10 % of the frame. The third, 'ratio of the scale and "
        "translation together ... not less than 0.85 and not more than 5 %', contradicts the second and is read as "
        "a scale "
        "between 0.85 and 1/0.85."
    )
    return Finding(item=item, comparisons=rows, notes=(note,))


def _refused(results: Results, name: str, tests: tuple[str, ...]) -> Comparison:
    return compare(
        results,
        CHECKED,
        lambda found: tuple(found["rejections"][name].split("; ")) == tests,
        quantity=f"tests that refuse a frame with {name.replace('_', ' ')}",
        printed=", ".join(tests) or "none",
        rule=Holds(text="reproduced: refused by these tests and by no other; else it differs"),
        shown=lambda found: found["rejections"][name].replace(";", ",") or "none",
    )


def panoramas(results: Results, method: str) -> dict[str, Result]:
    """By subject."""
    end = f"-{method}"
    found = {
        name.removeprefix(PANORAMA): result
        for name, result in results.items()
        if name.startswith(PANORAMA) and result.get("method") == method
    }
    return {name.removesuffix(end): result for name, result in sorted(found.items())}


def canvas_ssim(result: Result) -> float:
    """SSIM over the whole canvas as it is, the thesis' measure; 0 where there is no panorama."""
    score = result.get("score")
    picture = None if score is None or result.get("failure") else score.get("picture")
    return 0.0 if picture is None else float(picture["ssim_full"])


_OURS = {"ortho": "our default method", "thesis": "the thesis' method"}


def _fig_4_4(item: Item, results: Results) -> Finding:
    rows = [row for method in _OURS for row in (_least_ssim(results, method), _subjects(results, method))]
    notes = [
        "The thesis' measure, SSIM over the whole canvas, is nearly empty: see what a constant grey in the outline "
        "of the "
        "jaw scores. SSIM and ZNCC on the teeth, the share of the teeth that is shown and the geometric error say more "
        "(docs/panorama-evaluation.md).",
        "Subjects are filmed by a shaky hand over plain enamel, 120 frames; a panorama in parts counts with its "
        "largest "
        "part, one that failed with 0.",
    ]
    return Finding(item=item, comparisons=tuple(rows), notes=tuple(notes), table=_panorama_table(results))


def _least_ssim(results: Results, method: str) -> Comparison:
    found = panoramas(results, method)
    scores = {name: canvas_ssim(result) for name, result in found.items()}
    failed = [name for name, result in found.items() if result.get("failure")]
    return Comparison(
        quantity=f"least SSIM (canvas) of the subjects, {_OURS[method]}",
        printed="more than 0.70",
        ours=min(scores.values()) if scores else None,
        rule=Exceeds(thesis=0.70),
        because=f"no panorama of {', '.join(failed)}" if failed else "",
        shown=f"{min(scores.values()):.2f} (median {np.median(list(scores.values())):.2f})" if scores else "",
        source=f"{PANORAMA}*-{method}",
        quick=any(result.get("quick") for result in found.values()),
    )


def _subjects(results: Results, method: str) -> Comparison:
    found = panoramas(results, method)
    full = len(found) >= SUBJECTS
    return Comparison(
        quantity=f"subjects, {_OURS[method]}",
        printed=f"{SUBJECTS}",
        ours=float(len(found)) if full else None,
        rule=AtLeast(limit=SUBJECTS),
        shown=f"{len(found)}" if found else "",
        source=f"{PANORAMA}*-{method}",
    )


def _panorama_table(results: Results) -> Table | None:
    head = (
        "subject",
        "method",
        "SSIM canvas",
        "grey outline scores",
        "SSIM teeth, fitted",
        "ZNCC teeth",
        "teeth shown, %",
        "error median, mm",
        "P95, mm",
    )
    rows = [
        _panorama_row(name.removeprefix(PANORAMA).removesuffix(f"-{result['method']}"), result)
        for name, result in sorted(results.items())
        if name.startswith(PANORAMA)
    ]
    return (head, tuple(rows)) if rows else None


def _panorama_row(subject: str, result: Result) -> tuple[str, ...]:
    score = result.get("score") or {}
    method = f"{result['method']}{' (quick)' if result.get('quick') else ''}"
    picture, geometry = score.get("picture"), score.get("geometry")
    if result.get("failure") or picture is None:
        return (subject, method, f"failed: {result.get('failure')}", *("-",) * 6)
    grey = score["trivial"]["grey jaw"]["ssim_full"]
    errors = ("-", "-") if geometry is None else (f"{geometry['median_mm']:.2f}", f"{geometry['p95_mm']:.2f}")
    return (
        subject,
        method,
        f"{picture['ssim_full']:.2f}",
        f"{grey:.2f}",
        f"{picture['ssim_teeth_fitted']:.2f}",
        f"{picture['zncc']:.2f}",
        f"{score['coverage_pct']:.0f}",
        *errors,
    )


WITHOUT = "thesis-unexamined"
"""Method of Fig 4.5 (d)."""
_STITCHERS = ("opencv-scans", "opencv-panorama")


def _fig_4_5(item: Item, results: Results) -> Finding:
    rows = (
        _examined_better(results, "SSIM (canvas)", lambda result: canvas_ssim(result), 1),
        _examined_better(results, "median error, mm", _median_error_mm, -1),
        _beats_stitcher(results),
    )
    note = "Means over the subjects for which both were run; our films, which are not the thesis'."
    return Finding(item=item, comparisons=rows, notes=(note,))


def _median_error_mm(result: Result) -> float:
    geometry = (result.get("score") or {}).get("geometry")
    return float("nan") if geometry is None else float(geometry["median_mm"])


def _examined_better(results: Results, what: str, figure: Callable[[Result], float], sign: int) -> Comparison:
    examined, plain = panoramas(results, "thesis"), panoramas(results, WITHOUT)
    pairs = np.array([[figure(examined[name]), figure(plain[name])] for name in examined if name in plain])
    pairs = pairs.reshape(-1, 2)[np.isfinite(pairs.reshape(-1, 2)).all(axis=1)]
    means = pairs.mean(axis=0) if len(pairs) else None
    return Comparison(
        quantity=f"{what}: better with the examination than without, the thesis' method",
        printed="much better",
        ours=None if means is None else bool(sign * (means[0] - means[1]) > 0),
        rule=Holds(text="reproduced: the mean over the subjects is the better one; else it differs"),
        because="errors add up along the chain of homographies, which the examination cannot help; frames that it "
        "leaves out break the panorama (docs/panorama-thesis.md)",
        shown="" if means is None else f"{means[0]:.2f} with, {means[1]:.2f} without, {len(pairs)} subject(s)",
        source=f"{PANORAMA}*-{WITHOUT}",
        quick=any(result.get("quick") for result in plain.values()),
    )


def _beats_stitcher(results: Results) -> Comparison:
    ours = panoramas(results, "ortho")
    others = {method: panoramas(results, method) for method in _STITCHERS}
    pairs = [
        (canvas_ssim(ours[name]), max(canvas_ssim(found[name]) for found in others.values() if name in found))
        for name in ours
        if any(name in found for found in others.values())
    ]
    won = sum(one > other for one, other in pairs)
    return Comparison(
        quantity="subjects for which our default method has a larger SSIM (canvas) than OpenCV's Stitcher (the "
        "better mode)",
        printed="outperforms automatic stitching",
        ours=won == len(pairs) if pairs else None,
        rule=Holds(text="reproduced: for all subjects; else it differs"),
        shown=f"{won} of {len(pairs)}" if pairs else "",
        source=f"{PANORAMA}*-{_STITCHERS[0]}",
    )


# --- All --------------------------------------------------------------------------------------------------------------

_FINDERS: Mapping[str, Callable[[Item, Results], Finding]] = MappingProxyType(
    {
        "fig-1.3": _fig_1_3,
        "fig-2.1": _fig_2_1,
        "fig-2.2": _fig_2_2,
        "fig-2.3": _fig_2_3,
        "fig-2.5": _fig_2_5,
        "fig-2.6": _fig_2_6,
        "fig-3.1": _only(_residual("projections", "residual_px", "x = f X / Z against the camera", "px")),
        "fig-3.2": _only(_parameters),
        "fig-3.3": _only(_foreshortening("perspective", 2.0), _foreshortening("orthographic", 1.0)),
        "fig-3.4": _only(_residual("epipolar", "line_residual_px", "distance of x' from l', 20 random pairs", "px")),
        "fig-3.5": _only(_residual("epipolar", "plane_residual", "F through a plane against F by the projections")),
        "fig-3.6": _only(
            _residual("pair_parameters", "residual_mm_deg", "baseline and angle of pairs made with them", "mm, deg")
        ),
        "fig-3.7": _only(_noise_growth),
        "fig-3.8": _only(
            _residual("closed_form", "relative_residual", "the setting's closed form against Fisher's matrix")
        ),
        "fig-3.9": _only(*map(_studied, ("baseline_mm", "angle_deg", "distance_mm"))),
        "fig-3.10": _only(_smaller_baseline, _closer_needs_angle),
        "fig-3.13": _fig_3_13,
        "fig-3.14": _fig_3_14,
        "fig-3.15": _only(
            _count("designs", "twelve_cameras", "cameras", 12.0),
            _count("designs", "twelve_groups", "groups", 3.0),
            *map(_group_sees, ("occlusal", "buccal", "lingual")),
            notes=("Angles and places of the side groups are lost; ours are inferred (docs/designs.md).",),
        ),
        "fig-3.16": _fig_3_16,
        "fig-3.17": _only(_residual("box_sizes", "largest_difference_mm", "sizes of crowns and boxes", "mm", 0.01)),
        "fig-3.18": _only(
            _count("designs", "six_cameras", "cameras", 6.0),
            _count("designs", "six_outer_distance_mm", "distance of the outer two", 2.0, "mm"),
            _three_turns,
            _five_turns,
        ),
        "fig-3.19": _only(_six_not_four, notes=("Completeness and error of all designs: docs/six-or-twelve.md.",)),
        "fig-3.20": _only(_as_prepared, notes=("Measures of the preparations are lost; ours are textbook ones.",)),
        "fig-3.21": _fig_3_21,
        "fig-3.22": _fig_3_22,
        "fig-4.1": _fig_4_1,
        "fig-4.2": _fig_4_2,
        "fig-4.3": _fig_4_3,
        "fig-4.4": _fig_4_4,
        "fig-4.5": _fig_4_5,
        "table-2.1": _table_2_1,
        "table-3.1": _table_3_1,
        "table-3.2": _table_3_2,
        "eq-2.1": _eq_2_1,
        "eq-2.2": _eq_2_2,
        "eq-2.3": _eq_2_3,
        "eq-2.4": _eq_2_4,
        "eq-3.1": _only(_residual("projections", "residual_px", "x = f X / Z against the camera", "px")),
        "eq-3.2": _only(_residual("projection_matrices", "residual_px", "K [R | t] X against the camera", "px")),
        "eq-3.3": _only(_residual("epipolar", "line_residual_px", "distance of x' from the line of x", "px")),
        "eq-3.4": _only(_residual("epipolar", "plane_residual", "[e']x H against F by the projections, norm 1")),
        "eq-3.5": _only(_residual("epipolar", "line_residual_px", "x' from l' = F x, F = [e']x P' P+", "px")),
        "eq-3.6": _only(_residual("epipolar", "constraint_residual_px", "x'T F x as a distance", "px")),
        "eq-3.7": _only(_residual("projection_matrices", "residual_px", "K [R | t] X against the camera", "px")),
        "eq-3.8": _only(_likelihood),
        "eq-3.9": _only(
            _residual(
                "closed_form", "relative_residual", "closed form, exponents 4, against Fisher's matrix, relative"
            ),
            _printed_exponents,
        ),
    }
)
