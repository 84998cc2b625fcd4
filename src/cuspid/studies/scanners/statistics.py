"""Derives the statements about scanners from the tables of a study."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Float

from cuspid.studies.scanners.files import COLUMNS
from cuspid.studies.scanners.inference import (
    Agreement,
    Comparison,
    bland_altman,
    compare_scanners,
    correct_p_values,
    mean_estimate,
    precision_estimate,
    scans_for_precision,
    scans_needed,
)
from cuspid.studies.scanners.summary import Row, Tables

FACTOR_FIGURES = ("mean_abs_um", "signed_mean_um", "rms_um", "p95_um", "complete_pct", "spans_rms_um", "scale_ppm")
"""Figures in the table of each factor."""
TESTED = (
    "mean_abs_um",
    "signed_mean_um",
    "from_mean_rms_um",
    "spans_rms_um",
    "scale_ppm",
    "spread_um",
    "lift_um",
    "twist_um",
)
"""Figures in which scanners are compared."""
KINDS = ("bodies", "spheres", "landmarks", "teeth", "stations")
"""Of the spans, the better ones first."""
_RATIOS = (2.0, 1.5, 1.25)
_DIFFERENCES_UM = (2.0, 5.0, 10.0, 20.0, 50.0)
_MOST_AGREEMENTS = 6
_ACROSS: Mapping[str, tuple[frozenset[str], ...]] = {
    "inter-canine": (frozenset({"43", "33"}), frozenset({"13", "23"})),
    "inter-molar": (frozenset({"46", "36"}), frozenset({"16", "26"})),
}


def summary(tables: Tables, *, seed: int, plan_um: float | None = None) -> dict[str, Any]:
    """All that ``study.json`` says of the figures. Raises MissingDependencyError without statsmodels."""
    rng = np.random.default_rng([seed, 3])
    comparisons = _comparisons(tables.scans, rng)
    return {
        "scanners": scanners(tables, rng),
        "factors": factors(tables.scans, rng),
        "spans": spans(tables.spans),
        "parts": parts(tables),
        "comparisons": [asdict(each) for each in comparisons],
        "agreements": [asdict(each) for each in agreements(tables.spans)],
        "plan": plan(tables.scans, comparisons, plan_um),
    }


def _column(rows: Iterable[Row], figure: str) -> Float[np.ndarray, "n"]:
    return np.array([np.nan if row.get(figure) is None else row[figure] for row in rows], dtype=np.float64)


def _group_rows(rows: Sequence[Row], *columns: str) -> dict[tuple[Any, ...], list[Row]]:
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row.get(column) for column in columns), []).append(row)
    return groups


def _estimate(rows: Sequence[Row], figure: str, rng: np.random.Generator) -> dict[str, Any] | None:
    """Mean over specimens with its interval, SD within specimens, median and quartiles over scans."""
    groups = [_column(each, figure) for each in _group_rows(rows, "specimen").values()]
    if not all(np.isfinite(group).all() for group in groups):
        return None
    values = np.concatenate(groups)
    freedom = len(values) - len(groups)
    within = float(np.sqrt(sum(np.sum((group - group.mean()) ** 2) for group in groups) / freedom)) if freedom else None
    quartiles = np.percentile(values, [25, 50, 75])
    return {
        **asdict(mean_estimate(groups, rng)),
        "scans": len(values),
        "sd": within,
        "min": float(values.min()),
        "q1": float(quartiles[0]),
        "median": float(quartiles[1]),
        "q3": float(quartiles[2]),
        "max": float(values.max()),
    }


def scanners(tables: Tables, rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """Trueness, precision and modes of each scanner."""
    found = {}
    for (scanner,), rows in _group_rows(tables.scans, "scanner").items():
        estimates = {
            figure: _estimate(rows, figure, rng) for figure in (*FACTOR_FIGURES, *_MODE_COLUMNS, "from_mean_rms_um")
        }
        found[scanner] = {
            "scans": len(rows),
            "specimens": len(_group_rows(rows, "specimen")),
            "trueness": estimates,
            "precision": {
                figure: _precision(tables, scanner, figure) for figure in ("mean_abs_um", "rms_um", "p95_um")
            },
            "repeatability_sd_um": _pooled_sd(tables.groups, scanner),
        }
    return found


_MODE_COLUMNS = ("similarity_scale_ppm", "spread_um", "lift_um", "twist_um", "modes_rms_um", "remainder_um")


def _precision(tables: Tables, scanner: str, figure: str) -> dict[str, Any] | None:
    rows = [row for row in tables.pairs if row["scanner"] == scanner]
    if not rows:
        return None
    if rows[0]["first"] == "mean of the group":  # not pairs: no scan is in two rows
        groups = [_column(each, figure) for each in _group_rows(rows, "specimen").values()]
        found = mean_estimate(groups, np.random.default_rng(0))
    else:
        found = precision_estimate(pair_matrices(rows, figure))
    return {**asdict(found), "pairs": len(rows)}


def pair_matrices(rows: Sequence[Row], figure: str) -> list[Float[np.ndarray, "n n"]]:
    """The figure of all pairs of a scanner, a symmetric matrix for each specimen."""
    matrices = []
    for each in _group_rows(rows, "specimen").values():
        names = list(dict.fromkeys(name for row in each for name in (row["first"], row["second"])))
        matrix = np.zeros((len(names), len(names)))
        for row in each:
            a, b = names.index(row["first"]), names.index(row["second"])
            matrix[a, b] = matrix[b, a] = row[figure]
        matrices.append(matrix)
    return matrices


def _pooled_sd(groups: Sequence[Row], scanner: str) -> float | None:
    known = [row for row in groups if row["scanner"] == scanner and row["repeatability_sd_um"] is not None]
    freedom = sum(row["scans"] - 1 for row in known)
    return (
        float(np.sqrt(sum((row["scans"] - 1) * row["repeatability_sd_um"] ** 2 for row in known) / freedom))
        if known
        else None
    )


def factors(scans: Sequence[Row], rng: np.random.Generator) -> dict[str, dict[str, dict[str, Any]]]:
    """Figures by the levels of each factor that has several."""
    known = {name for row in scans[:1] for name in row}
    figure_names = {name for name in known if name.endswith(("_um", "_pct", "_ppm"))} | {
        "faces",
        "unit",
        "file",
        "sha256",
    }
    named = ["scanner", "specimen", "operator", *sorted(known - figure_names - set(COLUMNS))]
    found = {}
    for factor in named:
        levels = {str(level): rows for (level,), rows in _group_rows(scans, factor).items() if level is not None}
        if len(levels) > 1 or factor == "scanner":
            found[factor] = {
                level: {figure: _estimate(rows, figure, rng) for figure in FACTOR_FIGURES}
                for level, rows in levels.items()
            }
    return found


# --- spans ------------------------------------------------------------------------------------------------------------


def spans(rows: Sequence[Row]) -> list[Row]:
    """Errors of distances of each scanner, by kind: all of them, and those that have a name."""
    found = []
    for (kind, scanner), each in sorted(
        _group_rows(rows, "kind", "scanner").items(), key=lambda item: KINDS.index(item[0][0])
    ):
        found.append(_spans_row(kind, scanner, "all pairs", each))
        for name, pairs in _ACROSS.items():
            across = [row for row in each if frozenset({row["first"], row["second"]}) in pairs]
            if across:
                found.append(_spans_row(kind, scanner, name, across))
    return found


def _spans_row(kind: str, scanner: str, name: str, rows: Sequence[Row]) -> Row:
    error, nominal = _column(rows, "error_um"), _column(rows, "nominal_mm")
    angles = _column(rows, "angle_error_deg")
    angles = angles[np.isfinite(angles)]
    return {
        "kind": kind,
        "scanner": scanner,
        "distances": name,
        "count": len(rows),
        "from_mm": float(nominal.min()),
        "to_mm": float(nominal.max()),
        "mean_um": float(error.mean()),
        "mean_abs_um": float(np.abs(error).mean()),
        "rms_um": float(np.sqrt(np.mean(error**2))),
        "slope_ppm": float(1000 * nominal @ error / max(float(nominal @ nominal), 1e-300)),
        "angle_deg": float(np.abs(angles).mean()) if len(angles) else None,
    }


def parts(tables: Tables) -> list[Row]:
    """Positions and axes of spheres and scan bodies: trueness over scans, precision over pairs of scans."""
    found = []
    for (kind, scanner), rows in _group_rows(tables.shifts, "kind", "scanner").items():
        if kind not in ("bodies", "spheres"):
            continue
        axes = _column(rows, "axis_deg")
        precise = [_pair_distances_um(each) for each in _group_rows(rows, "specimen", "label").values()]
        precise = [each for each in precise if len(each)]
        found.append(
            {
                "kind": kind,
                "scanner": scanner,
                "count": len(rows),
                "position_um": float(_column(rows, "shift_um").mean()),
                "axis_deg": float(axes.mean()) if np.isfinite(axes).all() else None,
                "precision_um": float(np.concatenate(precise).mean()) if precise else None,
            }
        )
    return found


def _pair_distances_um(rows: Sequence[Row]) -> Float[np.ndarray, "n"]:
    at = np.array([[row[f"shift_{axis}_um"] for axis in "xyz"] for row in rows])
    return np.array([np.linalg.norm(at[a] - at[b]) for a, b in combinations(range(len(at)), 2)])


def agreements(rows: Sequence[Row]) -> list[Agreement]:
    """Each pair of scanners on the same distances, means of their repeats."""
    if not rows:
        return []
    kind = min({row["kind"] for row in rows}, key=KINDS.index)
    means: dict[str, dict[tuple[Any, ...], float]] = {}
    for (scanner, *place), each in _group_rows(
        [row for row in rows if row["kind"] == kind], "scanner", "specimen", "first", "second"
    ).items():
        means.setdefault(scanner, {})[tuple(place)] = float(_column(each, "error_um").mean())
    found = []
    for one, other in combinations(means, 2):
        both = [place for place in means[one] if place in means[other]]
        errors = [np.array([means[name][place] for place in both]) for name in (one, other)]
        found.append(bland_altman(one, other, *errors))
    return [each for each in found if each is not None][:_MOST_AGREEMENTS]


# --- tests and the next study -----------------------------------------------------------------------------------------


def _comparisons(scans: Sequence[Row], rng: np.random.Generator) -> tuple[Comparison, ...]:
    scanner, specimen = ([str(row[column]) for row in scans] for column in ("scanner", "specimen"))
    operator = [row.get("operator") for row in scans]
    found = [compare_scanners(figure, _column(scans, figure), scanner, specimen, operator, rng) for figure in TESTED]
    return correct_p_values([each for each in found if each is not None])


def plan(scans: Sequence[Row], comparisons: Sequence[Comparison], asked_um: float | None) -> dict[str, Any] | None:
    """Sample sizes of the next study from the scatter of this one; None where no scan was repeated."""
    groups = [_column(each, "mean_abs_um") for each in _group_rows(scans, "scanner", "specimen").values()]
    freedom = sum(len(group) - 1 for group in groups)
    if not freedom:
        return None
    sd_um = float(np.sqrt(sum(np.sum((group - group.mean()) ** 2) for group in groups) / freedom))
    count = len(_group_rows(scans, "scanner"))
    pairs = max(1, count * (count - 1) // 2)
    differences = sorted({*_DIFFERENCES_UM, *([] if asked_um is None else [asked_um])})
    return {
        "figure": "mean_abs_um",
        "sd_um": sd_um,
        "freedom": freedom,
        "pairs": pairs,
        "asked_um": asked_um,
        "scans": {f"{each:g}": scans_needed(sd_um, each, pairs) if sd_um > 0 else 2 for each in differences},
        "precision": {f"{ratio:g}": scans_for_precision(ratio) for ratio in _RATIOS},
    }
