"""Trueness and precision of repeated scans of our own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from cuspid import storage
from cuspid.cli.report import report
from cuspid.cli.shared import Flat, Probe, Source, console, load_probe, load_source, show_progress, suit_lights
from cuspid.cli.study import require_packages, save_study
from cuspid.pipeline.scan import ReconstructionOptions, SimulationOptions
from cuspid.runtime.options import WORKERS
from cuspid.studies.grid import check_workers
from cuspid.studies.repetition import MANIFEST, RepeatOptions, repeat_scans
from cuspid.studies.scanners.scan import StudyOptions
from cuspid.studies.scanners.study import Intake, compare, prepare
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
    study: StudyOptions = StudyOptions(),
    workers: Annotated[int | None, WORKERS] = None,
    cluster: str | None = None,
    retry_failed: bool = False,
) -> None:
    """Scan the same jaw several times, each with new hand motion and noise: trueness and precision (ISO 5725) together.

    The scans are compared as cuspid study scanners compares those of any scanner. A killed run resumes with the same
    command; with a larger --scans, further scans are added to the existing ones.

    Args:
        jaw: Mesh of a jaw (STL, PLY, OBJ, OFF); default: the built-in phantom.
        out: Folder for meshes/ (what is evaluated of each scan, in the frame of the reference), results.csv (a row for
            each), scans.csv (a manifest for cuspid study scanners), and all that a study writes: report.html, figures/,
            tables/, study.json.
        workers: Processes on this machine, one core each (default: one for each core).
        cluster: Address of a Dask scheduler, tcp://host:port, whose workers can access the folder too.
        retry_failed: Repeat scans that failed before.
    """
    check_workers(workers, "repeat")
    require_packages("repeat")
    probe = suit_lights(probe, simulation.texture)
    trial = TrialOptions(simulation=simulation, reconstruction=reconstruction)
    kept = {"new_texture": options.new_texture}
    settings = {"repeat": kept, "study": study, "trial": trial, "source": source, "probe": probe}
    given = {"jaw": jaw, "handpiece": probe.handpiece}
    hashes = {name: storage.hash_file(path) for name, path in given.items() if path is not None}
    with storage.claimed_folder(out, "repeat", settings, hashes):
        handpiece, scanned = load_probe(probe), load_source(jaw, source)
        with show_progress() as progress:
            outcomes = repeat_scans(
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
            prepared = prepare(
                out / MANIFEST, out, study, Intake(), workers=workers, cluster=cluster, progress=progress
            )
            found = compare(prepared, out, study, progress)
        for outcome in outcomes:
            if outcome.failure is not None:
                console.print(f"failed: {outcome.case.name}: {outcome.failure}", highlight=False)
        save_study(out, found, study)
    report(out)
