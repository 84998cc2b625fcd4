"""Section 3.5: the best pairs over the surfaces, the designs, the mean shape and its boxes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from cuspid.thesis.catalogue import TABLE_3_2, Item
from cuspid.thesis.findings import (
    EXACT,
    Finder,
    Finding,
    Result,
    Results,
    Table,
    compare,
    counted,
    of_check,
    only,
    vanishing,
)
from cuspid.thesis.rules import AtLeast, AtMost, Comparison, Equals, Holds

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
        quantity=f"{surface}, {title}: how far its pair is behind the best one, in standard errors",
        printed="the best" if surface in ("occlusal", "incisal") else "suitable",
        rule=AtMost(limit=2.0),
        because=_SWEEP_BECAUSE[term],
        shown=shown,
    )


def _fig_3_13(item: Item, results: Results) -> Finding:
    rows = [
        of_check(
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
        "fewer cameras that `cuspid design` found: docs/six-or-twelve.md."
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


FINDERS: Mapping[str, Finder] = MappingProxyType(
    {
        "fig-3.13": _fig_3_13,
        "fig-3.14": _fig_3_14,
        "fig-3.15": only(
            counted("designs", "twelve_cameras", "cameras", 12.0),
            counted("designs", "twelve_groups", "groups", 3.0),
            *map(_group_sees, ("occlusal", "buccal", "lingual")),
            notes=("Angles and places of the side groups are lost; ours are inferred (docs/designs.md).",),
        ),
        "fig-3.16": _fig_3_16,
        "fig-3.17": only(vanishing("box_sizes", "largest_difference_mm", "sizes of crowns and boxes", "mm", 0.01)),
        "fig-3.18": only(
            counted("designs", "six_cameras", "cameras", 6.0),
            counted("designs", "six_outer_distance_mm", "distance of the outer two", 2.0, "mm"),
            _three_turns,
            _five_turns,
        ),
        "fig-3.19": only(_six_not_four, notes=("Completeness and error of all designs: docs/six-or-twelve.md.",)),
        "table-3.1": _table_3_1,
    }
)
"""By item."""
