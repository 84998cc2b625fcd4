"""Experiments that consist of many complete scans."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.console import Console
from rich.table import Table
from tyro.conf import Positional

from cuspid import storage
from cuspid.cli.report import report
from cuspid.cli.shared import Flat, Source, console, load_source, show_progress
from cuspid.model.trueness import METRICS
from cuspid.report.figures.sweep import SweepMap, save_sweep_picture
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import WORKERS
from cuspid.studies.camera_sweep import TERMS, Best, Setting, SweepOptions, Term, best_setting, values_of
from cuspid.studies.camera_sweep import sweep as run_sweep
from cuspid.studies.grid import Outcome

_TITLES: dict[Term, tuple[str, int]] = {
    "complete_50_um_pct": (METRICS["complete_50_um_pct"].label, 1),
    "complete_10_um_pct": ("surface within 10 µm / %", 1),
    "points": ("points on the surface", 0),
    "mean_abs_um": (METRICS["mean_abs_um"].label, 2),
}
_LISTED = 4
"""Number of equally good settings that are printed; sweep.json lists all."""


def sweep(
    jaw: Annotated[Path | None, Positional] = None,
    *,
    out: Path,
    source: Annotated[Source, Flat] = Source(),
    options: Annotated[SweepOptions, Flat] = SweepOptions(),
    workers: Annotated[int | None, WORKERS] = None,
    cluster: str | None = None,
    retry_failed: bool = False,
) -> None:
    """Find the best baseline and angle of a camera pair for one surface of a tooth, by scanning with each setting.

    Each setting is a complete scan: rendered, reconstructed and evaluated on that surface. The best ones are repeated
    with other textures, hand motions and noise, to find out which are equally good. A killed sweep resumes with the
    same command.

    Args:
        jaw: Mesh of a jaw with tooth labels; default: the built-in phantom.
        out: Folder for results.csv (a row for each scan), sweep.json (the best settings) and sweep.png (maps).
        workers: Processes on this machine, one core each (default: one for each core).
        cluster: Address of a Dask scheduler, tcp://host:port, whose workers are used instead.
        retry_failed: Repeat scans that failed before.
    """
    inputs = {} if jaw is None else {"jaw": storage.hash_file(jaw)}
    with storage.claimed_folder(out, "sweep", {"options": options, "source": source}, inputs):
        scanned = load_source(jaw, source)
        with show_progress() as progress:
            outcomes = run_sweep(
                scanned,
                out,
                options,
                workers=workers,
                cluster=cluster,
                retry_failed=retry_failed,
                progress=progress,
            )
        _save(out, outcomes, options)


def _save(out: Path, outcomes: Sequence[Outcome], options: SweepOptions) -> None:
    best = {term: found for term in TERMS if (found := best_setting(outcomes, term)) is not None}
    failures = {outcome.case.name: outcome.failure for outcome in outcomes if outcome.failure is not None}
    summary = {"surface": options.surface, "tooth": options.chosen_tooth, "direction": options.chosen_direction}
    at_thesis = None if options.thesis is None else {"setting": options.thesis, **_means(outcomes, options.thesis)}
    storage.write_json(out / "sweep.json", {**summary, "best": best, "thesis": at_thesis, "failures": failures})
    for name, reason in failures.items():
        console.print(f"failed: {name}: {reason}", highlight=False)
    if not best:
        raise InputError(f"sweep: all {len(failures)} scans failed; the reasons are listed above and in {out}")
    save_maps(out / "sweep.png", outcomes, options)
    _print(outcomes, best, options)
    report(out)


def save_maps(path: Path, outcomes: Sequence[Outcome], options: SweepOptions) -> None:
    """Write sweep.png: the terms over baseline and angle, for the first seed, which all settings have in common."""
    maps = []
    for term, sign in TERMS.items():
        found, (title, digits) = best_setting(outcomes, term), _TITLES[term]
        first = {setting: each[0] for setting, each in values_of(outcomes, term).items() if 0 in each}
        maps.append(
            SweepMap(
                title=title,
                values=first,
                best=None if found is None else found.setting,
                level=() if found is None else found.level,
                less_is_better=sign < 0,
                digits=digits,
            )
        )
    title = f"Pair {options.chosen_direction} the arch, {options.surface} surface of tooth {options.chosen_tooth}, "
    save_sweep_picture(
        path,
        maps,
        options.baseline_mm,
        options.angle_deg,
        thesis=options.thesis,
        title=f"{title}{options.distance_mm:g} mm away",
    )


def _means(outcomes: Sequence[Outcome], setting: Setting) -> dict[str, float]:
    """The terms of a setting, over its seeds; empty where it failed."""
    values = {term: values_of(outcomes, term).get(setting) for term in TERMS}
    return {term: float(np.mean(list(found.values()))) for term, found in values.items() if found}


def _print(outcomes: Sequence[Outcome], best: dict[Term, Best], options: SweepOptions) -> None:
    table = Table(title=f"{options.surface} surface of tooth {options.chosen_tooth}", title_justify="left")
    for column in ("best by", "baseline, angle", *(title for title, _ in _TITLES.values()), "level with it"):
        table.add_column(column, no_wrap=column == "baseline, angle")
    for term, found in best.items():
        table.add_row(_TITLES[term][0], *_cells(outcomes, found.setting), _level(found))
    if options.thesis is not None:
        table.add_row("the thesis", *_cells(outcomes, options.thesis), "")
    Console().print(table)


def _cells(outcomes: Sequence[Outcome], setting: Setting) -> list[str]:
    means = _means(outcomes, setting)
    figures = [f"{means[term]:,.{digits}f}" if term in means else "failed" for term, (_, digits) in _TITLES.items()]
    return [_name(setting), *figures]


def _name(setting: Setting) -> str:
    return f"{setting[0]:g} mm, {setting[1]:g}°"


def _level(found: Best) -> str:
    if found.noise is None:
        return "unknown: nothing was repeated"
    if len(found.level) > _LISTED:
        return f"{len(found.level)} others"
    return "; ".join(map(_name, found.level)) or "none"
