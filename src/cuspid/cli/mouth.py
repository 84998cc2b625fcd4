"""How much room there is in the mouth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from cuspid import storage
from cuspid.anatomy.mouth import (
    OPENINGS,
    PRINTED_GAP_MM,
    MouthOptions,
    MouthReport,
    fit_curve,
    sagittal_view,
    study_mouths,
)
from cuspid.cli.shared import Flat, console
from cuspid.report.figures.mouth import TOOTH_NAMES, save_fit_picture, save_gap_picture, save_sagittal_picture
from cuspid.runtime.errors import InputError


def mouth(*, out: Path, handpiece: Path | None = None, options: Annotated[MouthOptions, Flat] = MouthOptions()) -> None:
    """Find how much room there is between the jaws, and how many people a handpiece fits at each tooth.

    Args:
        out: Folder for mouth.json and the pictures: the sagittal plane, whom a handpiece fits, the gap at the molars.
        handpiece: A handpiece.json with a body, whose thickness and working distance are used instead of those given.
    """
    inputs = {} if handpiece is None else {"handpiece": storage.hash_file(handpiece)}
    if handpiece is not None:
        options = _read_handpiece_size(options, handpiece)
    with storage.claimed_folder(out, "mouth", {"mouth": options}, inputs, replace=True):
        report, people = study_mouths(options)
        storage.write_json(out / "mouth.json", report)
        opening = OPENINGS[options.study]["women"]
        view = sagittal_view(opening, options)
        save_sagittal_picture(
            out / "sagittal.png",
            view.closed_mm,
            view.opened_mm,
            view.condyle_mm,
            view.arcs_mm,
            options.thickness_mm,
            options.working_distance_mm,
            title=f"The mean mouth of women, opened {options.held * opening.mean:.1f} mm",
        )
        needed, shares = fit_curve(people, options)
        save_fit_picture(
            out / "fit.png",
            needed,
            {str(sex): share for sex, share in shares.items()},
            options.total_mm,
            title="Whom a handpiece fits",
        )
        at_molars: dict[str, Float[np.ndarray, "n"]] = {sex: group.gap_mm[:, 6] for sex, group in people.items()}
        save_gap_picture(out / "gap.png", at_molars, PRINTED_GAP_MM, title="Gap L at the second molars")
    _print_fit(report)
    _print_thesis(report)


def _read_handpiece_size(options: MouthOptions, path: Path) -> MouthOptions:
    device = storage.read_handpiece(path)
    if device.body is None:
        raise InputError(
            f"{path}: its body is not known; give --thickness-mm and --working-distance-mm, or add a body to it"
        )
    console.print(f"{path}: {device.thickness_mm:.1f} mm thick, {device.working_distance_mm:g} mm over the teeth")
    return replace(options, thickness_mm=device.thickness_mm, working_distance_mm=device.working_distance_mm)


def _print_fit(report: MouthReport) -> None:
    table = Table(title=f"Gap L in mm, and who has room for {report.needed_mm:g} mm", title_justify="left")
    table.add_column("tooth", no_wrap=True)
    for sex in report.groups:
        table.add_column(f"{sex}: median (5-95 %)", justify="right")
        table.add_column("fits, %", justify="right")
    for position, name in enumerate(TOOTH_NAMES, start=1):
        cells = []
        for group in report.groups.values():
            gap = group.gap_mm[position]
            cells += [f"{gap['p50']:.1f} ({gap['p5']:.1f}-{gap['p95']:.1f})", f"{group.fit_pct[position]:.1f}"]
        table.add_row(name, *cells)
    Console().print(table)


def _print_thesis(report: MouthReport) -> None:
    table = Table(title="What the thesis prints, and what comes out", title_justify="left", show_lines=True)
    for column in ("quantity", "printed", "recomputed", "why they differ"):
        table.add_column(column)
    for line in report.thesis:
        table.add_row(line.what, line.printed, line.recomputed, line.reason)
    Console().print(table)
    for assumption in report.assumptions:
        console.print(f"assumed: {assumption}", highlight=False)
