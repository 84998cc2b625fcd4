"""Section 3.6: Table 3.2, and the margins of its teeth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from cuspid_thesis.catalogue import TABLE_3_2, Row, TruenessRow
from cuspid_thesis.page_format import Table
from cuspid_thesis.results import Result, Results, value_at
from cuspid_thesis.rules import Equals, LessIsBetter

_FIELDS: Mapping[str, str] = MappingProxyType(
    {"max": "max_um", "mean": "mean_abs_um", "SD": "std_abs_um", "RMS": "rms_um"}
)
"""Of our results, by statistics."""


def trueness(results: Results, parts: str, statistics: Sequence[str]) -> tuple[Row, ...]:
    """Statistics of parts of Table 3.2."""
    return tuple(_statistic(row, each) for row in TABLE_3_2 if row.part in parts for each in statistics)


def _statistic(row: TruenessRow, statistic: str) -> Row:
    rms_um = float(np.hypot(row.mean_um, row.std_um))
    printed = {"max": row.max_um, "mean": row.mean_um, "SD": row.std_um, "RMS": rms_um}[statistic]
    because = "the worst of all points of the scan; the thesis measured at few points" if statistic == "max" else ""
    return Row(
        quantity=f"{row.part}, {row.what}: {statistic}",
        unit="µm",
        thesis=f"{printed:.0f}",
        source=(row.result,),
        ours=(f"{row.path}.{_FIELDS[statistic]}",),
        rule=LessIsBetter(thesis=printed),
        because=because,
    )


def images(results: Results) -> tuple[Row, ...]:
    """How many images were taken of the parts of Table 3.2, where the results tell."""
    return tuple(_images(row) for row in TABLE_3_2 if "images" in results.get(row.result, {}))


def _images(row: TruenessRow) -> Row:
    thesis = 1200.0 if row.tooth is None else 120.0
    return Row(
        quantity=f"{row.part}: images",
        thesis=f"{thesis:g}",
        source=(row.result,),
        ours=("images",),
        rule=Equals(thesis=thesis, within=0.1 * thesis),
        because="as many as our path needs for an overlap of more than 75 %",
    )


def trueness_table(results: Results) -> Table | None:
    """All statistics of Table 3.2, ours and the thesis'."""
    head = ("part", "FDI", "min", "max", "mean", "SD", "RMS", "P95", "within 50 µm, %", "thesis: min/max/mean/SD")
    rows = tuple(_trueness_cells(row, results[row.result]) for row in TABLE_3_2 if row.result in results)
    return (head, rows) if rows else None


def _trueness_cells(row: TruenessRow, result: Result) -> tuple[str, ...]:
    found = value_at(result, row.path)
    within = "completeness_pct" if row.tooth is None else f"per_tooth_completeness_pct.{row.tooth}"
    columns = ("min_um", "max_um", "mean_abs_um", "std_abs_um", "rms_um", "p95_um")
    printed = "/".join(f"{value:g}" for value in (row.min_um, row.max_um, row.mean_um, row.std_um))
    figures = (*(found[name] for name in columns), value_at(result, f"trueness.{within}.50"))
    return (row.part, str(row.tooth or "all"), *(f"{value:.1f}" for value in figures), printed)


def margins_table(results: Results) -> Table | None:
    """How well the edges of the preparations were found."""
    head = ("scan", "margin of", "evaluated, %", "found, %", "mean distance, µm", "P95, µm")
    rows = tuple(
        _margin_cells(name, tooth, margin)
        for name, result in sorted(results.items())
        for tooth, margin in result.get("margins", {}).items()
        if name in (f"prepared-{tooth}", "prepared-arch")
    )
    return (head, rows) if rows else None


def _margin_cells(name: str, tooth: str, margin: Result) -> tuple[str, ...]:
    found = margin["scan"]
    figures = (margin["evaluated_pct"], found["found_pct"], found["mean_um"], found["p95_um"])
    return (name, tooth, *("-" if value is None else f"{value:.1f}" for value in figures))
