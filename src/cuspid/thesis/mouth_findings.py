"""Chapter 2: the mouth, and dimensions of arches."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from cuspid.anatomy.landmarks.dimensions import PRINTED_TABLE
from cuspid.thesis.catalogue import Item
from cuspid.thesis.findings import (
    CHECKED,
    Finder,
    Finding,
    Result,
    Results,
    compare,
    of_check,
    vanishes,
)
from cuspid.thesis.rules import AtLeast, AtMost, Comparison, Equals

_RIEDER = "the model solves the angle from the opening, of which the thesis takes Rieder's; its 26 deg are of 93 others"


def _fig_2_1(item: Item, results: Results) -> Finding:
    rows = [
        of_check(
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
    row = of_check(
        results,
        "landmarks",
        "landmarks",
        quantity="landmarks of a jaw of 14 teeth",
        printed="72",
        rule=Equals(thesis=72.0, within=0.0),
    )
    return Finding(item=item, comparisons=(row,), notes=("Which points they are is lost; the scheme is ours.",))


def _fig_2_5(item: Item, results: Results) -> Finding:
    row = vanishes(
        results,
        "sagittal_model",
        "residual_mm",
        "gap and opening of the sagittal model against points turned one by one, 100 mouths",
        "mm",
    )
    return Finding(item=item, comparisons=(row,), notes=("The numbers are compared in Eq 2.1 to 2.4.",))


def _fig_2_6(item: Item, results: Results) -> Finding:
    rows = [
        of_check(
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
    same = of_check(
        results,
        "radius",
        "least_mm",
        "largest_mm",
        quantity="r from the printed inputs",
        unit="mm",
        printed="77.7 to 134",
        rule=Equals(thesis=(77.7, 134.0), within=1.0),
    )
    model = of_check(
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
    same = of_check(
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
    return Finding(item=item, comparisons=(same,), notes=("Printed as a sine, meant as its inverse.", *notes))


def _eq_2_3(item: Item, results: Results) -> Finding:
    rows = [
        of_check(
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
    inputs = of_check(
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
    model = of_check(
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


_MEANING = f"{_SE:g} standard errors"
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
        "The CT models are not public. Populations of phantoms are drawn from the distributions of a, b and c, made, "
        "and measured by landmarks: that shows that the tools measure what the table defines, not that people are so. "
        "f is drawn from other sources (docs/phantom.md), for the column cannot be trusted.",
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
        rule=Equals(thesis=mean, within=round(_SE * sd / np.sqrt(jaws), 2), meaning=_MEANING),
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
        rule=Equals(thesis=mean, within=round(float(_SE * error), 2), meaning=_MEANING),
        because=_COPY if name == "f" else "other people, few of them",
        shown=lambda result: _mean_sd(entry, f"{name}_mean_mm", f"{name}_sd_mm"),
    )


_CT_MODELS = MappingProxyType({"Lower-14": 90, "Upper-14": 259, "Lower-12": 39, "Upper-12": 44})
"""How many jaws the thesis measured."""


def _mean_sd(entry: Result, mean: str, sd: str) -> str:
    return f"{entry[mean]:.2f}" + ("" if entry[sd] is None else f" ± {entry[sd]:.2f}")


FINDERS: Mapping[str, Finder] = MappingProxyType(
    {
        "fig-2.1": _fig_2_1,
        "fig-2.2": _fig_2_2,
        "fig-2.3": _fig_2_3,
        "fig-2.5": _fig_2_5,
        "fig-2.6": _fig_2_6,
        "table-2.1": _table_2_1,
        "eq-2.1": _eq_2_1,
        "eq-2.2": _eq_2_2,
        "eq-2.3": _eq_2_3,
        "eq-2.4": _eq_2_4,
    }
)
"""By item."""
