"""Sections of docs/benchmarks.md on handpieces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from anatomy_sections import mark, markdown_table

Result = Mapping[str, Any]


def visibility(result: Result) -> str:
    """How long it takes to ask what a design sees."""
    rows = [
        (
            name,
            f"{result[name]['faces']:,}",
            f"{result[name]['cameras']} x {result[name]['positions']}",
            mark(result[name]["survey"]["wall_s"], 60 if name == "arch" else 2),
            result[name]["scannable"]["wall_s"],
        )
        for name in ("arch", "molar")
    ]
    head = ("surface", "faces", "cameras x positions", "survey, s (bar 60, molar 2)", "scannable faces, s")
    return markdown_table(head, rows)


def precision(result: Result) -> str:
    """The bound against Monte-Carlo and its closed form."""
    found = result["monte_carlo"]
    rows = [
        (f"Monte-Carlo, RMS, worst of {found['cases']} cases", f"{mark(found['worst_rms_pct'], 3)} %", "3 %"),
        ("the same in the worst direction", f"{mark(found['worst_axis_pct'], 3)} %", "3 %"),
        ("closed form, relative", f"{result['closed_form_worst']:.1e}", "1e-9"),
    ]
    pair = ", ".join(f"{value:.1f}" for value in result["parallel_pair_at_5_mm_um"].values())
    baselines = ", ".join(result["parallel_pair_at_5_mm_um"])
    return "\n".join(
        [
            markdown_table(("difference from the bound", "found", "bar"), rows),
            "",
            f"Parallel pair at 5 mm, 512 px, 62 deg, 0.5 px: baselines of {baselines} mm give {pair} um.",
        ]
    )


def camera_pair(result: Result) -> str:
    """The best pair of cameras by distance, over the occlusal surface of a second molar."""
    head = ("matcher", "distance mm", "baseline mm", "axis angle deg", "seen by both %", "expected RMS um")
    rows = [
        (
            matcher,
            f"{best['distance_mm']:g}",
            f"{best['baseline_mm']:g}",
            f"{best['axis_angle_deg']:g}",
            f"{best['seen_pct']:.0f}",
            f"{best['expected_rms_um']:.1f}",
        )
        for matcher, rows_of in result["best_within_budget"].items()
        for best in rows_of
        if best["facing"] == "occlusal"
    ]
    return "\n".join(
        [
            f"{result['cases']} pairs, {result['cpu_s']} CPU-s; the largest share of the surface within 10 um, by "
            "distance (whether a smaller baseline is more accurate: docs/precision.md):",
            "",
            markdown_table(head, rows),
        ]
    )
