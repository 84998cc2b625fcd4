"""Section 3.6: the reference model and Table 3.2."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from cuspid.thesis.catalogue import TABLE_3_2, Item, TruenessRow
from cuspid.thesis.findings import (
    Finder,
    Finding,
    Result,
    Results,
    Table,
    compare,
    of_check,
    only,
)
from cuspid.thesis.rules import Comparison, Equals, Holds, LessIsBetter


def trueness_of(result: Result, row: TruenessRow) -> Result:
    """Of a result of a row of Table 3.2: of its tooth, or of the whole scan."""
    found: Result = (
        result["trueness"]["accuracy"] if row.tooth is None else result["trueness"]["per_tooth"][str(row.tooth)]
    )
    return found


def _trueness_row(results: Results, row: TruenessRow, statistic: str) -> Comparison:
    field, printed = {
        "max": ("max_um", row.max_um),
        "mean": ("mean_abs_um", row.mean_um),
        "SD": ("std_abs_um", row.std_um),
        "RMS": ("rms_um", float(np.hypot(row.mean_um, row.std_um))),
    }[statistic]
    because = "of all points of the scan the worst one; the thesis measured at few points" if statistic == "max" else ""
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
    rows = [_trueness_row(results, row, each) for row in TABLE_3_2 for each in ("max", "mean", "SD")]
    rows += [_images_row(results, row) for row in TABLE_3_2 if "images" in results.get(row.result, {})]
    notes = [
        "As in the thesis: twelve cameras 5 mm from the teeth, 500 x 500 px, 62 deg, artificial texture, more than 75 "
        "% overlap, simulated images, rigid alignment. Not as there: our jaw is the phantom with preparations of our "
        "own, images are traced by Embree with noise of 1.5 DN (the thesis has Blender), and the reconstruction knows "
        "the rig, which is not said of the thesis' structure from motion.",
        "Ours are absolute deviations of all points of the scan on the tooth (A: of the whole scan) where two cameras "
        "could see the reference; the thesis has line distances at few points. The smallest one is in the table, but "
        "not judged: of many points one is always right.",
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
    return of_check(
        results,
        "preparations",
        "as_in_the_text",
        quantity="kinds of preparation by tooth",
        printed="46 crack, 45 crown, 42 full-contour crown, 35 and 36 MOD inlays",
        rule=Holds(text="reproduced: each tooth has the kind that the text names; else it differs"),
        shown=lambda found: found["preparations"]["teeth"],
    )


def _fig_1_2(item: Item, results: Results) -> Finding:
    head = ("scan", "margin of", "judged, %", "found, %", "mean distance, µm", "P95, µm")
    rows = tuple(
        _margin_row(name, tooth, margin)
        for name, result in sorted(results.items())
        for tooth, margin in result.get("margins", {}).items()
        if name in (f"prepared-{tooth}", "prepared-arch")
    )
    note = "Of ours: how far the edge of a preparation in the scan is from the true margin (docs/preparations.md)."
    return Finding(item=item, notes=(note,) if rows else (), table=(head, rows) if rows else None)


def _margin_row(name: str, tooth: str, margin: Result) -> tuple[str, ...]:
    found = margin["scan"]
    figures = (margin["judged_pct"], found["found_pct"], found["mean_um"], found["p95_um"])
    return (name, tooth, *("-" if value is None else f"{value:.1f}" for value in figures))


FINDERS: Mapping[str, Finder] = MappingProxyType(
    {
        "fig-1.2": _fig_1_2,
        "fig-3.20": only(_as_prepared, notes=("Measures of the preparations are lost; ours are textbook ones.",)),
        "fig-3.21": _fig_3_21,
        "fig-3.22": _fig_3_22,
        "table-3.2": _table_3_2,
    }
)
"""By item."""
