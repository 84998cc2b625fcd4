"""Which handpiece gives more: designs compared with each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.console import Console
from rich.table import Table

from cuspid import storage
from cuspid.anatomy.mouth import MouthOptions, room_mm, study_mouths
from cuspid.cli.report import report
from cuspid.cli.shared import Flat, console, show_progress
from cuspid.pipeline.scan import ReconstructionOptions, SimulationOptions
from cuspid.report.figures.comparison import Curve, save_comparison_picture, save_surface_shares_picture
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import WORKERS, Range
from cuspid.simulation.appearance import Preset
from cuspid.simulation.path.scan import ScanPathOptions
from cuspid.studies.design_comparison import (
    GIVES,
    NEEDS,
    ComparisonOptions,
    Outlines,
    Row,
    compare_designs,
    comparison_rows,
    enough_turns,
    markdown,
    number,
    section_outlines,
    surface_shares,
    table_cells,
)
from cuspid.studies.grid import Outcome, check_workers
from cuspid.studies.trial import TrialOptions

CASE_OPTIONS = ("edge_mm", "image_scale", "min_openness", "samples", "thickness_mm")
"""Options that a scan depends on: if they change, its results cannot be kept."""


def compare(
    *,
    out: Path,
    options: Annotated[ComparisonOptions, Flat] = ComparisonOptions(),
    texture: Preset = "artificial",
    supersampling: Annotated[int, Range(1, 16)] = 1,
    reconstruction: ReconstructionOptions = ReconstructionOptions(),
    workers: Annotated[int | None, WORKERS] = None,
    cluster: str | None = None,
) -> None:
    """Compare handpieces on the same teeth, by default twelve cameras with six that are turned: size, images, time,
    error and completeness.

    Args:
        out: Folder for results.csv, comparison.json, comparison.md and pictures. A killed run resumes when the same
            command is given again; further designs, turns, teeth or seeds are added to the existing results.
        texture: Surface of the teeth.
        supersampling: Rays per pixel along each side; 2 takes twice as long.
        reconstruction: How images become a mesh.
        workers: Processes on this machine, one core each (default: one for each core).
        cluster: Address of a Dask scheduler, tcp://host:port, whose workers can access the folder too.
    """
    check_workers(workers, "compare")
    simulation = SimulationOptions(texture=texture, supersampling=supersampling)
    trial = TrialOptions(simulation=simulation, reconstruction=reconstruction)
    settings = {
        "trial": trial,
        **{name: getattr(options, name) for name in CASE_OPTIONS},
    }
    with storage.claimed_folder(out, "compare", settings, {}), show_progress() as progress:
        outcomes = compare_designs(
            out,
            options,
            trial,
            workers=workers,
            cluster=cluster,
            progress=progress,
        )
    _save(out, outcomes, options)


def _save(out: Path, outcomes: Sequence[Outcome], options: ComparisonOptions) -> None:
    rows = comparison_rows(outcomes, options)
    failures = {outcome.case.name: outcome.failure for outcome in outcomes if outcome.failure is not None}
    enough = enough_turns(rows, options)
    storage.write_json(
        out / "comparison.json", {"options": options, "rows": rows, "enough_turns": enough, "failures": failures}
    )
    storage.write_bytes(out / "comparison.md", markdown(rows).encode())
    if rows:
        save_pictures(out, rows, options)
        _print_tables(rows)
    for where, turns in enough.items():
        console.print(f"{where}: completeness stops growing at {turns} turns")
    for name, reason in failures.items():
        console.print(f"  failed: {name}: {reason}", highlight=False)
    if rows:
        report(out)
    else:
        raise InputError(f"compare: none of the {len(failures)} scans succeeded; the reasons are listed above")


def save_pictures(out: Path, rows: Sequence[Row], options: ComparisonOptions) -> None:
    """Write comparison.png and surfaces.png."""
    panels: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        panels.setdefault(f"{row['jaw']}, tooth {row['tooth']}", {}).setdefault(str(row["design"]), []).append(row)
    mouth = MouthOptions()
    room = room_mm(study_mouths(mouth)[1]["women"], mouth)
    save_comparison_picture(
        out / "comparison.png",
        _sections(out, rows, options.thickness_mm),
        {name: {design: _curve(found) for design, found in designs.items()} for name, designs in panels.items()},
        float(np.quantile(room[:, -1], 0.05)),
        title="Handpieces over a tooth; dashed: room at the second molar that 95 % of women have",
    )
    shares = {
        name: {_label(row): surface_shares(row) for found in designs.values() for row in found}
        for name, designs in panels.items()
    }
    save_surface_shares_picture(out / "surfaces.png", shares, title="Reconstructed within 50 µm, % of the open surface")


def _sections(out: Path, rows: Sequence[Row], thickness_mm: float) -> Mapping[str, Outlines]:
    """Of each design with its largest number of turns, over the first tooth."""
    most = {str(row["design"]): row for row in sorted(rows, key=lambda row: number(row, "turns"))}
    found: dict[str, Outlines] = {}
    for design, row in sorted(most.items(), key=lambda item: -number(item[1], "cameras")):
        jaw = storage.read_jaw(out / "jaws" / f"{row['jaw']}.ply")
        handpiece = storage.read_handpiece(out / "handpieces" / f"{design}.json")
        path = replace(ScanPathOptions(), tooth=int(number(row, "tooth")), turns=int(number(row, "turns")))
        found[design] = section_outlines(jaw, handpiece, path, thickness_mm)
    return found


def _curve(rows: Sequence[Row]) -> Curve:
    columns = ("turns", "images", "tooth_within_50_um_pct", "tooth_mean_abs_um")
    turns, images, complete, error = zip(*([number(row, c) for c in columns] for row in rows), strict=True)
    return Curve(turns=tuple(map(int, turns)), images=images, complete_pct=complete, error_um=error)


def _label(row: Row) -> str:
    return f"{row['design']}, {row['turns']} turn{'s' if row['turns'] != 1 else ''}"


def _print_tables(rows: Sequence[Row]) -> None:
    for title, columns in (("What each needs", NEEDS), ("What each gives, means over the seeds", GIVES)):
        table = Table(title=title, title_justify="left", padding=(0, 0, 0, 1))
        headings, lines = table_cells(rows, columns)
        for heading in headings:
            word = heading in ("jaw", "design")
            table.add_column(heading, justify="left" if word else "right", min_width=6 if word else 4)
        for line in lines:
            table.add_row(*line)
        Console().print(table)
