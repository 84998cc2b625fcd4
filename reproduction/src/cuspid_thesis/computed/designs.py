"""Section 3.5: the best pairs over the surfaces, the designs, the mean shape."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from cuspid_thesis.page_format import Table
from cuspid_thesis.results import Result, Results

COMPARISONS = ("design_comparison_full_size", "design_comparison")
"""Results of the designs, the better ones first."""
_WITHIN = "tooth_within_50_um_pct"
_MORE_IS_BETTER = {"complete_50_um_pct": 1, "mean_abs_um": -1}
_COLUMNS = {
    "cameras": ("cameras", 0),
    "frames": ("positions", 0),
    "images": ("images", 0),
    "swept_width_mm": ("width, mm", 1),
    "height_mm": ("height, mm", 1),
    "tooth_mean_abs_um": ("mean, µm", 2),
    "tooth_p95_um": ("P95, µm", 1),
    _WITHIN: ("tooth within 50 µm, %", 1),
}

Row = Mapping[str, Any]


def thesis_pair(result: Result, surface: str) -> Mapping[str, Any] | None:
    """Mean deviation with the pair of the thesis over a surface."""
    found = (result["surfaces"].get(surface) or {}).get("thesis")
    return None if found is None else {"ours": found["mean_abs_um"], **found}


def behind_the_best_pair(result: Result, surface: str, term: str) -> Mapping[str, Any] | None:
    """By how many standard errors the thesis' pair is behind the best one over a surface."""
    swept = result["surfaces"].get(surface)
    if swept is None or swept.get("thesis") is None or swept["best"][term]["noise"] is None:
        return None
    best, thesis = swept["best"][term], swept["thesis"]
    error = best["noise"] * np.sqrt(2 / best["seeds"])
    behind = _MORE_IS_BETTER[term] * (best["value"] - thesis[term])
    return {
        "ours": float(behind / max(error, 1e-9)),
        "thesis": thesis[term],
        "thesis_pair": _pair(thesis),
        "best": best["value"],
        "best_pair": _pair(best),
    }


def _pair(found: Row) -> str:
    return "{:g} mm, {:g}°".format(*found["setting"])


def seen_by_two_pct(result: Result, surface: str) -> Mapping[str, float]:
    """Share of a surface of the arch that two of the twelve cameras see at once."""
    rows = result["surfaces"]["twelve-cameras"]
    return {"ours": next(row["seen_by_2_pct"] for row in rows if row["surface"] == surface)}


def rounds_until_still(result: Result) -> Mapping[str, float]:
    """Rounds until the mean shape stands still, infinitely many where it does not."""
    found = result["population"]["first_00"]
    return {"ours": float(found["rounds"]) if found["converged"] else float("inf")}


def gain_pct(result: Result, before: Row, after: Row) -> Mapping[str, Any] | None:
    """By how many points the design and turns after reconstruct more of the tooth than those before."""
    jaw = "boxed-mean" if any(row["jaw"] == "boxed-mean" for row in result["rows"]) else "phantom"
    one, other = (_of_molar(result, {**each, "jaw": jaw}) for each in (before, after))
    if one is None or other is None:
        return None
    return {"ours": float(other[_WITHIN] - one[_WITHIN]), "before": one[_WITHIN], "after": other[_WITHIN], "jaw": jaw}


def less_with_twelve(result: Result, column: str) -> Mapping[str, Any] | None:
    """Whether a figure of the twelve cameras is smaller than that of the six with three turns."""
    rows = (
        _of_molar(result, {"design": name, "turns": n, "jaw": "phantom"}) for name, n in (("twelve", 1), ("six", 3))
    )
    twelve, six = (None if row is None else row.get(column) for row in rows)
    return None if twelve is None or six is None else {"ours": twelve < six, "twelve": float(twelve), "six": float(six)}


def _of_molar(result: Result, place: Row) -> Row | None:
    """The row of the comparison of designs, of first molar 46, that agrees with a place."""
    wanted = {"tooth": 46, **place}.items()
    return next((row for row in result["rows"] if all(row[name] == value for name, value in wanted)), None)


def designs_table(results: Results) -> Table | None:
    """Size, effort and error of each design over the molar of the phantom."""
    found = next((results[name] for name in COMPARISONS if name in results), None)
    if found is None:
        return None
    chosen = [row for row in found["rows"] if row["jaw"] == "phantom" and row["tooth"] == 46]
    rows = tuple((str(row["design"]), str(row["turns"]), *_cells(row)) for row in chosen)
    return (("design", "turns", *(head for head, _ in _COLUMNS.values())), rows)


def _cells(row: Row) -> list[str]:
    return ["-" if row.get(name) is None else f"{row[name]:.{digits}f}" for name, (_, digits) in _COLUMNS.items()]
