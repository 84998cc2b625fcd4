"""The section of the page of results on studies of scanners."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from anatomy_sections import mark, markdown_table

Result = Mapping[str, Any]
GLOBAL_SHARE, GLOBAL_UM = 0.02, 0.5
"""A global figure is off by less than one of these."""
SPANS_UM, MODES_SHARE, END_SHARE = 1.0, 0.05, 0.03
LEAST_PCT, MOST_PCT = 90.0, 98.0
APART_UM, BODY_UM, BODY_DEG = 0.5, 3.0, 0.03
MINUTES, GIB = 12.0, 3.0
DENT_MM = 2.5
_SMALL = {"scale": 25.0, "spread": 4.0, "lift": 4.0, "twist": 4.0}
"""Floor of the bar of a mode (ppm, um): noise alone has some, and so have finite turns, to second order."""
_NO_MODES = "smoothed"


def study(result: Result) -> str:
    """What a study of scanners finds of known errors."""
    rows = [row for row in result["errors"] if "lost" not in row]
    lost = [row["lost"] for row in result["errors"] if "lost" in row]
    looked, unseen = ([row for row in rows if row["looked_at"] is seen] for seen in (True, False))
    jaws = len({row["jaw"] for row in rows})
    return "\n".join(
        [
            f"Real jaws ({jaws}, half of them looked at only when all was done) with errors that other code put in, "
            "each moved at random, through the files and the flow of `cuspid study scanners`. Largest difference from "
            "the truth over the jaws; the truth of mean |d| and RMS is what plain least squares leave of the "
            "displacements. "
            f"Bars: global figures within {GLOBAL_SHARE:.0%} or {GLOBAL_UM:g} um, spans within {SPANS_UM:g} um, modes "
            f"within {MODES_SHARE:.0%} or {_SMALL['scale']:g} ppm (0.6 um at 25 mm) and {_SMALL['lift']:g} um, which "
            "noise of 10 um on these coarse meshes takes for itself. Smoothing shrinks crowns, which is no mode. "
            "`python benchmarks/study.py`.",
            "",
            markdown_table(("error", "jaws", "mean abs. um", "RMS um", "modes", "spans um"), _errors(looked, unseen)),
            "",
            *([f"Lost: {'; '.join(lost)}.", ""] if lost else []),
            _dents(rows),
            "",
            "Aligned at one end of a bent arch (100 um at its ends, the middle held), read at the other end; truth: "
            f"two rigid pieces of a chain of links. Bar: {END_SHARE:.0%}.",
            "",
            markdown_table(("bend", "jaws", "shift found um", "largest error %"), _ends(result["one_end"])),
            "",
            f"Intervals at 95 % over simulated studies of three scanners, of unequal, known variances. Bar: "
            f"{LEAST_PCT:g} to {MOST_PCT:g} % hold the truth.",
            "",
            markdown_table(
                ("scans", "specimens", "mean %", "precision of pairs %", "differences %"),
                [
                    (row["scans"], row["specimens"], *(_within(row[f"{name}_pct"]) for name in _COVERED))
                    for row in result["coverage"]
                ],
            ),
            "",
            _bodies(result["bodies"]),
            "",
            f"Distances of {len(result['cloudcompare'])} scans beside CloudCompare's: RMS apart at most "
            f"{mark(max(row['apart_rms_um'] for row in result['cloudcompare']), APART_UM)} um (bar {APART_UM:g} um), "
            f"means apart at most {_means_apart(result['cloudcompare']):.3f} um.",
            "",
            _speed(result["speed"]) if "speed" in result else "Time and memory of many scans: not measured.",
        ]
    )


_COVERED = ("mean", "precision", "difference")


def _errors(looked: Sequence[Result], unseen: Sequence[Result]) -> list[tuple[object, ...]]:
    names = dict.fromkeys(row["error"] for row in (*looked, *unseen))
    return [
        (name, which, *_cells([row for row in rows if row["error"] == name]))
        for name in names
        for which, rows in (("looked at", looked), ("held out", unseen))
        if any(row["error"] == name for row in rows)
    ]


def _cells(rows: Sequence[Result]) -> tuple[str, ...]:
    spans = [row["spans_off_um"] for row in rows if row["spans_off_um"] is not None]
    modes = [_modes_off(row) for row in rows if row["error"] != _NO_MODES] or [0.0]
    told = f"{max(modes):.2f} of the bar" if rows[0]["error"] != _NO_MODES else ""
    return (
        _global(rows, "mean_abs_um"),
        _global(rows, "rms_um"),
        told if max(modes) <= 1 else f"**{told}** (missed)",
        mark(max(spans), SPANS_UM) if spans else "",
    )


def _global(rows: Sequence[Result], figure: str) -> str:
    worst = max(rows, key=lambda row: _share_of_bar(row, figure))
    off, true = worst[figure] - worst[f"true_{figure}"], worst[f"true_{figure}"]
    told = f"{off:+.2f} of {true:.1f}"
    return told if _share_of_bar(worst, figure) <= 1 else f"**{told}** (missed)"


def _share_of_bar(row: Result, figure: str) -> float:
    bar = max(GLOBAL_SHARE * row[f"true_{figure}"], GLOBAL_UM)
    return float(abs(row[figure] - row[f"true_{figure}"]) / bar)


def _modes_off(row: Result) -> float:
    """Largest error of a mode, as a share of its bar."""
    found, true = row["amplitudes"], row["true_amplitudes"]
    return max(abs(found[mode] - true[mode]) / max(MODES_SHARE * abs(true[mode]), _SMALL[mode]) for mode in found)


def _dents(rows: Sequence[Result]) -> str:
    dents = [row for row in rows if "dent_um" in row]
    off = max(row["dent_off_mm"] for row in dents)
    return (
        f"The dent, 100 um deep and {DENT_MM:g} mm in radius: the deepest place is found {off:.2f} mm from its middle "
        f"at most, {min(-row['dent_um'] for row in dents):.0f} to {max(-row['dent_um'] for row in dents):.0f} um deep."
    )


def _ends(rows: Sequence[Result]) -> list[tuple[object, ...]]:
    found: list[tuple[object, ...]] = []
    for mode in dict.fromkeys(row["mode"] for row in rows):
        for which, seen in (("looked at", True), ("held out", False)):
            here = [row for row in rows if row["mode"] == mode and row["looked_at"] is seen]
            shifts = [row["shift_um"] for row in here]
            off = max(abs(row["shift_um"] / row["true_shift_um"] - 1) for row in here)
            found.append((mode, which, f"{min(shifts):.0f} to {max(shifts):.0f}", mark(100 * off, 100 * END_SHARE)))
    return found


def _within(value: float) -> str:
    return f"{value:.1f}" if LEAST_PCT <= value <= MOST_PCT else f"**{value:.1f}** (missed)"


def _bodies(found: Result) -> str:
    axis = f"{found['axis_rms_deg']:.4f}" if found["axis_rms_deg"] <= BODY_DEG else f"**{found['axis_rms_deg']:.4f}**"
    return (
        f"{found['bodies']} scan bodies with noise of 10 um, a third missing and gum around the foot: position "
        f"{mark(found['position_rms_um'], BODY_UM)} um RMS (bar {BODY_UM:g} um, largest "
        f"{found['position_max_um']:.1f}), axis {axis} deg RMS (bar {BODY_DEG:g}); {found['lost']} not found."
    )


def _means_apart(rows: Sequence[Result]) -> float:
    return float(np.max([abs(row["mean_um"] - row["cloudcompare_mean_um"]) for row in rows]))


def _speed(found: Result) -> str:
    minutes = found["wall_s"] / 60
    return (
        f"{found['scans']} scans of {found['faces']:,} faces took {mark(minutes, MINUTES)} min (bar {MINUTES:g}), "
        f"{found['cpu_s']:.0f} s of CPU, on {found['cores']} cores (load {found['load']:.1f}), and at most "
        f"{mark(found['all_processes_gib'], GIB)} GiB in all processes together (bar {GIB:g} GiB); "
        f"measured at commit {found['commit']}."
    )
