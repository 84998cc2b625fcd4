"""The same object scanned again and again in simulation, for a study of its scans as of any scanner's.

Between the scans the hand and the sensor noise differ; jaw, texture and handpiece stay as they are (the conditions of
repeatability of ISO 5725-1), unless the texture is asked to be new, as powder is that is sprayed again. Each scan is a
case of a grid. What is evaluated of it is kept as a mesh in the frame of the reference, and a manifest lists all of
them for :mod:`cuspid.studies.scanners`.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np

from cuspid import storage
from cuspid.model.capture import Capture
from cuspid.model.jaw import Jaw
from cuspid.model.rig import Handpiece
from cuspid.model.trueness import GroundTruth
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.scan import SimulationOptions
from cuspid.runtime.errors import CuspidError, InputError, ReconstructionError
from cuspid.runtime.options import Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.simulation.path.scan import plan_scan_path
from cuspid.studies.grid import Case, Outcome, Value, run_grid
from cuspid.studies.trial import Trial, TrialOptions, run_trial

MANIFEST = "scans.csv"
"""Lists the meshes for a study of scanners."""
_SCANNER, _SPECIMEN = "cuspid", "jaw"
_MARGIN_MM = 2.0
"""The part of the jaw that scans are compared with reaches so far past the first of them."""


@dataclass(frozen=True, kw_only=True)
class RepeatOptions(Options):
    """How a scan is repeated."""

    scans: Annotated[int, Range(2, 10_000)] = 5
    """Number of scans."""
    new_texture: bool = False
    """Give each scan a new texture too, like powder that is sprayed on again; off: the object stays the same."""


def repeat_scans(
    jaw: Jaw,
    handpiece: Handpiece,
    folder: Path,
    options: RepeatOptions,
    trial: TrialOptions,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    retry_failed: bool = False,
    progress: Progress = silent,
) -> tuple[Outcome, ...]:
    """Scan a jaw several times and list the meshes in ``scans.csv``; goes on where it stopped.

    Raises InputError where the jaw has no such tooth or fewer than two scans succeed, and what
    :func:`cuspid.studies.grid.run_grid` raises.
    """
    plan_scan_path(jaw, handpiece, trial.simulation.path, np.random.default_rng([trial.simulation.seed, 1]))
    if not (folder / "jaw.json").exists():
        storage.write_handpiece(folder / "handpiece.json", handpiece)
        storage.write_jaw(folder / "jaw.ply", jaw)
    outcomes = run_grid(
        scan_cases(options, trial),
        partial(scan_again, folder=folder.resolve(), options=options, trial=trial),
        folder,
        workers=workers,
        cluster=cluster,
        retry_failed=retry_failed,
        stage="scans",
        progress=progress,
    )
    list_scans(jaw, outcomes, folder)
    return outcomes


def list_scans(jaw: Jaw, outcomes: Sequence[Outcome], folder: Path) -> None:
    """Write ``scans.csv`` and ``reference.ply``, the part of the jaw around the first scan: places spread over all of
    the jaw would hardly fall on one tooth. Raises InputError where fewer than two scans succeeded."""
    names = [outcome.case.name for outcome in outcomes if outcome.failure is None]
    if len(names) < 2:
        reasons = "; ".join(dict.fromkeys(outcome.failure for outcome in outcomes if outcome.failure is not None))
        raise InputError(
            f"repeat: {len(names)} of {len(outcomes)} scans succeeded; at least two are needed ({reasons})"
        )
    storage.write_jaw(folder / "reference.ply", _crop_to(jaw, storage.read_mesh(folder / _mesh_file(names[0])).bounds))
    rows = [
        {
            "scanner": _SCANNER,
            "specimen": _SPECIMEN,
            "scan": name,
            "file": _mesh_file(name),
            "reference": "reference.ply",
        }
        for name in names
    ]
    storage.write_table(folder / MANIFEST, rows)


def _mesh_file(name: str) -> str:
    return f"meshes/{name}.ply"


def _crop_to(jaw: Jaw, bounds: np.ndarray) -> Jaw:
    """The faces of a jaw in a box with a margin."""
    centres = jaw.mesh.face_centres
    near = ((centres > bounds[0] - _MARGIN_MM) & (centres < bounds[1] + _MARGIN_MM)).all(axis=1)
    labels = None if jaw.face_labels is None else jaw.face_labels[near]
    return replace(jaw, mesh=jaw.mesh.submesh(near), face_labels=labels)


def scan_cases(options: RepeatOptions, trial: TrialOptions) -> tuple[Case, ...]:
    """Each scan has its own hand; the first one that of a single scan."""
    first = trial.simulation.seed
    return tuple(Case(name=f"scan-{k}", parameters={"seed": first + k}) for k in range(options.scans))


def scan_again(*, seed: int, folder: Path, options: RepeatOptions, trial: TrialOptions) -> dict[str, Value]:
    """One scan and its figures. What is evaluated of it is kept in ``folder/meshes``, in the frame of the reference."""
    jaw = storage.read_jaw(folder / "jaw.ply")
    handpiece = storage.read_handpiece(folder / "handpiece.json")
    name = f"scan-{seed - trial.simulation.seed}"
    scratch = folder / "meshes" / name
    try:
        done = run_trial(
            lambda out: shoot_again(jaw, handpiece, out, options, trial.simulation, seed=seed),
            scratch,
            trial,
            start_from_truth=True,
        )
    except CuspidError:
        shutil.rmtree(scratch, ignore_errors=True)
        raise
    _keep(folder / _mesh_file(name), done)
    shutil.rmtree(scratch)
    return dict(done.figures)


def shoot_again(
    jaw: Jaw, handpiece: Handpiece, folder: Path, options: RepeatOptions, simulation: SimulationOptions, *, seed: int
) -> tuple[Capture, GroundTruth]:
    """The images of one scan: the hand and the noise of this seed, the texture of the first one unless it is new."""
    path = plan_scan_path(jaw, handpiece, simulation.path, np.random.default_rng([seed, 1]))
    # The noise of an image follows the name of its frame, the texture the seed alone.
    poses = {f"{seed:03d}-{frame}": pose for frame, pose in path.rig_from_world.items()}
    render = simulation if not options.new_texture else replace(simulation, seed=seed)
    return pipeline.take_images(jaw, handpiece, poses, folder, render)


def _keep(path: Path, done: Trial) -> None:
    """The part of a scan that is evaluated: where the reference could be seen."""
    evaluated = np.isfinite(done.trueness.deviation_um)[done.mesh.faces].all(axis=1)
    if not evaluated.any():
        raise ReconstructionError("no part of the scan can be evaluated")
    storage.write_mesh(path, done.mesh.submesh(evaluated).transformed(done.trueness.reference_from_scan))
