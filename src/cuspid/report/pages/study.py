"""The page of a study: its pictures, what it found, and all of its cases in a table that can be sorted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from cuspid.model.trueness import METRICS
from cuspid.report.pages.page import number, picture_uri, provenance, render_page
from cuspid.runtime.errors import InputError
from cuspid.storage import StudyResult

_MOST_FACES = 120_000

Table = dict[str, Any]
Tile = tuple[str, str, str]

_UNITS = {"um": "µm", "mm": "mm", "pct": "%", "deg": "°", "s": "s", "ppm": "ppm", "mb": "MB", "mm2": "mm²", "px": "px"}
_WORDS = {"std": "SD", "rms": "RMS", "p95": "P95", "um": "µm"}
_TITLES = {
    "sweep": "Baseline and angle of a pair",
    "compare": "Handpieces compared",
}
_WHEN = ("simulation_s", "reconstruction_s", "reconstruction_cpu_s", "cpu_s")


def study_page(result: StudyResult) -> str:
    """The HTML of a study. Raises InputError where none of its cases is done."""
    if not result.rows and result.summary is None:
        raise InputError(f"{result.name}: nothing to report; no case of the study is done yet")
    summary = result.summary or {}
    failures = {row["case"]: row["failure"] for row in result.rows if row.get("failure")}
    return render_page(
        "study.html.j2",
        title=_TITLES[result.verb],
        name=result.name,
        missing=result.missing,
        lead=_lead(result.verb, summary, len(result.rows), len(failures)),
        tables=_TABLES[result.verb](summary) if summary else [],
        notes=_notes(result.verb, summary),
        pictures=[(caption, picture_uri(path)) for caption, path in result.pictures.items()],
        all_rows=_all_rows(result.rows),
        failures=failures,
        made=provenance(result.run),
    )


def heading(column: str) -> str:
    """The name of a column for people: words, and the unit at the end."""
    if column in METRICS:
        return METRICS[column].title
    *words, last = column.split("_")
    if last not in _UNITS or not words:
        return column.replace("_", " ")
    label = " ".join(_WORDS.get(word, word) for word in words).replace("mean abs", "mean |d|")
    return f"{label}, {_UNITS[last]}"


def _all_rows(rows: Sequence[Mapping[str, str]]) -> Table | None:
    """The columns in which cases differ; one that is the same for all tells nothing."""
    if not rows:
        return None
    names = list(dict.fromkeys(name for row in rows for name in row))
    shown = [name for name in names if name not in ("failure", *_WHEN)]
    columns = [name for name in shown if name == "case" or len({row.get(name) for row in rows}) > 1]
    return {
        "heads": [heading(name) for name in columns],
        "rows": [[_short(row.get(name, "")) for name in columns] for row in rows],
    }


def _short(cell: str | None) -> str:
    """A number with four digits that count."""
    try:
        value = float(cell or "")
    except ValueError:
        return cell or ""
    return cell or "" if value == int(value) else f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"


def _lead(verb: str, summary: Mapping[str, Any], cases: int, failed: int) -> list[Tile]:
    tiles: list[Tile] = [("cases", str(cases), f"{failed} failed" if failed else "")]
    if verb == "sweep" and summary:
        tiles += [("surface", str(summary["surface"]), ""), ("tooth", str(summary["tooth"]), "")]
        tiles += [("the pair lies", str(summary["direction"]), "the arch")]
    return tiles


# --- what was found ---------------------------------------------------------------------------------------------------

_TERMS = {
    "complete_50_um_pct": "most surface within 50 µm",
    "complete_10_um_pct": "most surface within 10 µm",
    "points": "most points",
    "mean_abs_um": "smallest mean deviation",
}


def _sweep_tables(summary: Mapping[str, Any]) -> list[Table]:
    rows = [
        [
            _TERMS.get(term, heading(term)),
            _setting(found["setting"]),
            _figure(term, found["value"]),
            "not repeated" if found["noise"] is None else _figure(term, found["noise"]),
            "; ".join(map(_setting, found["level"])) or "none",
        ]
        for term, found in summary["best"].items()
    ]
    heads = ["best by", "baseline, angle", "value", "noise", "level with it"]
    caption = "Level: settings whose difference from the best one is within the noise of repeated scans."
    tables: list[Table] = [{"title": "Best settings", "caption": caption, "heads": heads, "rows": rows}]
    if summary.get("thesis"):
        thesis = summary["thesis"]
        terms = [term for term in _TERMS if term in thesis]
        tables.append(
            {
                "title": "The setting of the thesis",
                "caption": None,
                "heads": ["baseline, angle", *map(heading, terms)],
                "rows": [[_setting(thesis["setting"]), *(_figure(term, thesis[term]) for term in terms)]],
            }
        )
    return tables


def _figure(term: str, value: float | int) -> str:
    return number(value, 0 if term == "points" else 2)


def _setting(pair: Sequence[float | int]) -> str:
    return f"{pair[0]:g} mm, {pair[1]:g}°"


_NEEDS = ("cameras", "swept_width_mm", "height_mm", "frames", "images", "data_mb", "reconstruction_cpu_s")
_GIVES = (
    "tooth_mean_abs_um",
    "tooth_p95_um",
    "complete_50_um_pct",
    "tooth_seen_pct",
    "tooth_within_50_um_pct",
    "tooth_within_100_um_pct",
)


def _compare_tables(summary: Mapping[str, Any]) -> list[Table]:
    keys = ("design", "turns", "jaw", "tooth")

    def table(title: str, columns: Sequence[str]) -> Table:
        there = [name for name in columns if any(row.get(name) is not None for row in summary["rows"])]
        names = [[str(row[key]) for key in keys] for row in summary["rows"]]
        figures = [_column([row.get(name) for row in summary["rows"]]) for name in there]
        rows = [[*name, *cells] for name, *cells in zip(names, *figures, strict=True)]
        return {"title": title, "caption": None, "heads": [*keys, *map(heading, there)], "rows": rows}

    return [table("What each needs", _NEEDS), table("What each gives, means over the seeds", _GIVES)]


def _column(values: Sequence[float | int | None]) -> list[str]:
    """With two decimals, but counts as they are."""
    whole = all(value is None or value == int(value) for value in values)
    return [number(value, 0 if whole else 2) for value in values]


_TABLES: Mapping[str, Callable[[Mapping[str, Any]], list[Table]]] = {
    "sweep": _sweep_tables,
    "compare": _compare_tables,
}


def _notes(verb: str, summary: Mapping[str, Any]) -> list[str]:
    if verb == "compare":
        return [
            f"{where}: completeness stops growing at {n} turns" for where, n in summary.get("enough_turns", {}).items()
        ]
    return list(summary.get("notes", ()))
