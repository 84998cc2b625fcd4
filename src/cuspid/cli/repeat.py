"""Trueness and precision of repeated scans."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console
from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional, arg

from cuspid import storage
from cuspid.cli.report import report
from cuspid.cli.shared import Flat, Probe, Source, console, load_probe, load_source, show_progress, suited
from cuspid.model.trueness import METRICS
from cuspid.pipeline.scan import ReconstructionOptions, SimulationOptions
from cuspid.report.figures.repeat import save_repeat_picture
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import WORKERS
from cuspid.studies.grid import check_workers
from cuspid.studies.repetition import RepeatOptions, Repetition, repeat_scans
from cuspid.studies.trial import TrialOptions


def repeat(
    jaw: Annotated[Path | None, Positional, arg(metavar="[JAW]")] = None,
    *,
    out: Path,
    options: Annotated[RepeatOptions, Flat] = RepeatOptions(),
    source: Annotated[Source, Flat] = Source(),
    probe: Annotated[Probe, Flat] = Probe(),
    simulation: Annotated[SimulationOptions, Flat, OmitArgPrefixes] = SimulationOptions(),
    reconstruction: ReconstructionOptions = ReconstructionOptions(),
    workers: Annotated[int | None, WORKERS] = None,
    cluster: str | None = None,
    retry_failed: bool = False,
) -> None:
    """Scan the same jaw several times, each with new hand motion and noise: trueness and precision (ISO 5725) together.

    A killed run resumes with the same command; with a larger --scans, further scans are added to the existing ones.

    Args:
        jaw: Mesh of a jaw (STL, PLY, OBJ, OFF); default: the built-in phantom.
        out: Folder for scans/ (each mesh, in the frame of the reference), repeat.json, results.csv, and a report.
        workers: Processes on this machine, one core each (default: one for each core).
        cluster: Address of a Dask scheduler, tcp://host:port, whose workers can access the folder too.
        retry_failed: Repeat scans that failed before.
    """
    check_workers(workers, "repeat")
    probe = suited(probe, simulation.texture)
    trial = TrialOptions(simulation=simulation, reconstruction=reconstruction)
    kept = {
        "new_texture": options.new_texture,
        "farthest_mm": options.farthest_mm,
        "pair_samples": options.pair_samples,
    }
    settings = {"repeat": kept, "trial": trial, "source": source, "probe": probe}
    given = {"jaw": jaw, "handpiece": probe.handpiece}
    hashes = {name: storage.hash_file(path) for name, path in given.items() if path is not None}
    with storage.claimed_folder(out, "repeat", settings, hashes):
        handpiece, scanned = load_probe(probe), load_source(jaw, source)
        with show_progress() as progress:
            found = repeat_scans(
                scanned,
                handpiece,
                out,
                options,
                trial,
                workers=workers,
                cluster=cluster,
                retry_failed=retry_failed,
                progress=progress,
            )
        _save(out, found)
    report(out)


def _save(out: Path, found: Repetition) -> None:
    summary = found.summary
    storage.write_json(out / "repeat.json", summary)
    for name, reason in summary["failures"].items():
        console.print(f"failed: {name}: {reason}", highlight=False)
    if found.spread is None:
        raise InputError(f"repeat: {summary['scans']} of {len(found.scans)} scans succeeded; at least two are needed")
    reference = storage.read_jaw(out / "reference.ply").mesh
    values = {"mean_deviation_um": found.spread.mean_um, "sd_um": found.spread.sd_um}
    storage.write_mesh(out / "repeat.ply", reference, values=values)
    save_repeat_picture(
        out / "repeat.png",
        reference,
        found.spread.mean_um,
        found.spread.sd_um,
        found.trueness_um,
        {(pair["first"], pair["second"]): pair["mean_abs_um"] for pair in summary["pairs"]},
    )
    _print(summary)


_COMMON = "surface in common, %"


def _print(summary: Mapping[str, Any]) -> None:
    pairs = len(summary["pairs"])
    for name, title in (
        ("trueness", f"Trueness: {summary['scans']} scans to the reference"),
        ("precision", f"Precision: {pairs} pair{'s' if pairs != 1 else ''} of scans"),
    ):
        table = Table(title=title, title_justify="left")
        for column in ("figure", "mean", "SD", "smallest", "largest"):
            table.add_column(column, justify="left" if column == "figure" else "right")
        for figure, cells in summary[name].items():
            values = (cells[each] for each in ("mean", "sd", "min", "max"))
            title = METRICS[figure].title if figure in METRICS else _COMMON
            table.add_row(title, *("-" if value is None else f"{value:.2f}" for value in values))
        Console().print(table)
    found = summary["spread"]
    console.print(
        f"at a place of the reference: repeatability SD {found['repeatability_sd_um']:.2f} µm (limit "
        f"{found['repeatability_limit_um']:.2f} µm; at the median place {found['median_sd_um']:.2f} µm), "
        f"systematic part {found['bias_rms_um']:.2f} µm RMS; on {found['common_pct']:.1f} % of what could be seen",
        highlight=False,
    )
