"""Chapter 2: dimensions of arches, asked for, drawn and scanned, beside Table 2.1."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from cuspid.anatomy.landmarks.dimensions import PRINTED_TABLE
from cuspid_thesis.catalogue import Row
from cuspid_thesis.results import Result, Results
from cuspid_thesis.rules import Equals

_SE = 3.0
"""Means that are so many standard errors apart differ; with a dozen rows, two happen by chance."""
_COPY = "the printed column f repeats column b to within 0.06 mm and is very likely a copy of it"
_CT_MODELS = MappingProxyType({"Lower-14": 90, "Upper-14": 259, "Lower-12": 39, "Upper-12": 44})
"""How many jaws the thesis measured."""


def largest_miss_mm(result: Result) -> Mapping[str, float]:
    """Largest difference between dimensions that were asked for and measured, over all groups."""
    return {"ours": max(group["max_abs_asked_minus_measured_mm"] for group in result["groups"].values())}


def phantoms_drawn(results: Results) -> tuple[Row, ...]:
    """Means of drawn phantoms beside Table 2.1. f of twelve teeth has no source of its own, and is left out."""
    drawn = results.get("populations", {}).get("groups", {})
    return tuple(
        _row_of_draws(group, name, drawn[group.lower()]["jaws"] if group.lower() in drawn else 16)
        for group, printed in PRINTED_TABLE.items()
        for name in printed
        if name != "f" or group.endswith("14")
    )


def _row_of_draws(group: str, name: str, jaws: int) -> Row:
    error = PRINTED_TABLE[group][name][1] / np.sqrt(jaws)
    path = f"groups.{group.lower()}.{name}.measured"
    because = "impossible draws are rejected and drawn again"
    shown = f"{{{path}.mean_mm:.2f}} ± {{{path}.sd_mm:.2f}}"
    return _row(group, name, "phantoms", "populations", f"{path}.mean_mm", shown, error, because)


def jaws_scanned(results: Results) -> tuple[Row, ...]:
    """Means of scanned jaws beside Table 2.1, of groups with more than one."""
    groups = results.get("measure", {}).get("real", {}).get("groups", [])
    return tuple(
        _row_of_scans(f"real.groups.{number}", entry, name)
        for number, entry in enumerate(groups)
        if entry["group"] in PRINTED_TABLE and entry["jaws"] > 1
        for name in "abcf"
    )


def _row_of_scans(path: str, entry: Mapping[str, Any], name: str) -> Row:
    group, count, sd = entry["group"], entry[f"{name}_n"], entry[f"{name}_sd_mm"]
    printed_sd = PRINTED_TABLE[group][name][1]
    error = np.hypot((sd or 0.0) / np.sqrt(max(count, 1)), printed_sd / np.sqrt(_CT_MODELS[group]))
    shown = f"{{{path}.{name}_mean_mm:.2f}}" + ("" if sd is None else f" ± {{{path}.{name}_sd_mm:.2f}}")
    because = "different people, and few of them"
    return _row(group, name, f"{count} scans", "measure", f"{path}.{name}_mean_mm", shown, float(error), because)


def _row(group: str, name: str, of: str, source: str, path: str, shown: str, error_mm: float, because: str) -> Row:
    mean, sd = PRINTED_TABLE[group][name]
    return Row(
        quantity=f"{name}, {group}, {of}",
        unit="mm",
        thesis=f"{mean:.2f} ± {sd:.2f}",
        source=(source,),
        ours=(path,),
        rule=Equals(thesis=mean, within=round(float(_SE * error_mm), 2), meaning=f"{_SE:g} standard errors"),
        shown=shown,
        because=_COPY if name == "f" else because,
    )
