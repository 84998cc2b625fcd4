"""The same object scanned again and again in simulation: trueness and precision together.

Between the scans the hand and the sensor noise differ; jaw, texture and handpiece stay as they are (the conditions of
repeatability of ISO 5725-1), unless the texture is asked to be new, as powder is that is sprayed again. First each scan
is a case of a grid, then each pair of scans is. A finished scan is kept as a mesh in the frame of the reference.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool

from cuspid import storage
from cuspid.evaluation.repeatability import PairOptions, Spread, compare_pair, spread
from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece
from cuspid.model.trueness import STATISTICS, GroundTruth
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.scan import SimulationOptions
from cuspid.runtime.errors import CuspidError, ReconstructionError
from cuspid.runtime.options import Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.simulation.path.scan import plan_scan_path
from cuspid.studies.grid import Case, Outcome, Value, run_grid
from cuspid.studies.trial import TrialOptions, run_trial

TRUENESS = ("mean_abs_um", "signed_mean_um", "std_um", "p95_um", "complete_50_um_pct")
"""Figures of a scan of which the spread is reported."""
PRECISION = ("mean_abs_um", "rms_um", "p95_um", "common_pct")
"""The same of a pair."""


@dataclass(frozen=True, kw_only=True)
class RepeatOptions(Options):
    """How a scan is repeated."""

    scans: Annotated[int, Range(2, 10_000)] = 5
    """Number of scans."""
    new_texture: bool = False
    """Give each scan a new texture too, like powder that is sprayed on again; off: the object stays the same."""
    farthest_mm: Annotated[float, Range(0.0001, 1000)] = 0.5
    """Two scans do not show the same surface where they are farther apart than this."""
    pair_samples: Annotated[int, Range(100, 20_000_000)] = 100_000
    """Sample points on each scan of a pair."""

    @property
    def pairs(self) -> PairOptions:
        """How scans are compared with each other."""
        return PairOptions(samples=self.pair_samples, farthest_mm=self.farthest_mm)


@dataclass(frozen=True, eq=False, kw_only=True)
class Repetition:
    """What repeated scans have in common."""

    scans: tuple[Outcome, ...]
    """Each scan."""
    pairs: tuple[Outcome, ...]
    """Each pair of those that succeeded."""
    spread: Spread | None
    """How they agree at each place of the reference; None where fewer than two succeeded."""

    @property
    def trueness_um(self) -> dict[str, float]:
        """Mean absolute deviation of each scan that succeeded."""
        done = (outcome for outcome in self.scans if outcome.failure is None)
        return {outcome.case.name: float(outcome.figures["mean_abs_um"] or 0.0) for outcome in done}

    @property
    def summary(self) -> dict[str, Any]:
        """``repeat.json``: the spread of the figures, of the places, and the pairs."""
        done = [outcome.figures for outcome in self.scans if outcome.failure is None]
        paired = [outcome for outcome in self.pairs if outcome.failure is None]
        return {
            "scans": len(done),
            "trueness": figures_spread(done, TRUENESS),
            "precision": figures_spread([pair.figures for pair in paired], PRECISION),
            "spread": None if self.spread is None else _spread_summary(self.spread),
            "pairs": [{**pair.case.parameters, **pair.figures} for pair in paired],
            "failures": {each.case.name: each.failure for each in (*self.scans, *self.pairs) if each.failure},
        }


def _spread_summary(found: Spread) -> dict[str, float]:
    return {
        "repeatability_sd_um": found.repeatability_sd_um,
        "repeatability_limit_um": found.repeatability_limit_um,
        "median_sd_um": found.median_sd_um,
        "bias_rms_um": found.bias_rms_um,
        "common_pct": found.common_pct,
    }


def figures_spread(rows: Sequence[Mapping[str, Value]], names: Sequence[str]) -> dict[str, dict[str, float | None]]:
    """Mean, standard deviation (n - 1; None of one), smallest and largest of each figure; empty without rows."""
    if not rows:
        return {}
    columns = {name: np.array([row[name] for row in rows], dtype=np.float64) for name in names}
    return {
        name: {
            "mean": float(values.mean()),
            "sd": float(values.std(ddof=1)) if len(values) > 1 else None,
            "min": float(values.min()),
            "max": float(values.max()),
        }
        for name, values in columns.items()
    }


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
) -> Repetition:
    """Scan a jaw several times and compare the scans with it and with each other; goes on where it stopped.

    Raises InputError where the jaw has no such tooth, and what :func:`cuspid.studies.grid.run_grid` raises.
    """
    plan_scan_path(jaw, handpiece, trial.simulation.path, np.random.default_rng([trial.simulation.seed, 1]))
    if not (folder / "reference.json").exists():
        storage.write_handpiece(folder / "handpiece.json", handpiece)
        storage.write_jaw(folder / "reference.ply", jaw)
    run = partial(run_grid, workers=workers, cluster=cluster, retry_failed=retry_failed, progress=progress)
    work = partial(scan_again, folder=folder.resolve(), options=options, trial=trial)
    scans = run(scan_cases(options, trial), work, folder, stage="scans")
    names = [outcome.case.name for outcome in scans if outcome.failure is None]
    compare = partial(compare_scans, folder=folder.resolve(), options=options)
    pairs = run(pair_cases(names), compare, folder / "pairs", stage="pairs")
    found = _spread_of(folder, names, options) if len(names) > 1 else None
    return Repetition(scans=scans, pairs=pairs, spread=found)


def scan_cases(options: RepeatOptions, trial: TrialOptions) -> tuple[Case, ...]:
    """Each scan has its own hand; the first one that of a single scan."""
    first = trial.simulation.seed
    return tuple(Case(name=f"scan-{k}", parameters={"seed": first + k}) for k in range(options.scans))


def pair_cases(names: Sequence[str]) -> tuple[Case, ...]:
    """All pairs."""
    return tuple(
        Case(name=f"{first}_{second}", parameters={"first": first, "second": second})
        for first, second in combinations(names, 2)
    )


def scan_again(*, seed: int, folder: Path, options: RepeatOptions, trial: TrialOptions) -> dict[str, Value]:
    """One scan and its figures. The mesh is kept in ``folder/scans``, in the frame of the reference."""
    jaw = storage.read_jaw(folder / "reference.ply")
    handpiece = storage.read_handpiece(folder / "handpiece.json")
    name = f"scan-{seed - trial.simulation.seed}"
    scratch = folder / "scans" / name
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
    _keep(folder, name, done.mesh, done.trueness.reference_from_scan, done.trueness.deviation_um, done.scannable)
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


def _keep(
    folder: Path,
    name: str,
    mesh: Mesh,
    reference_from_scan: Rigid3,
    deviation_um: np.ndarray,
    scannable: Bool[np.ndarray, "f"],
) -> None:
    """The aligned mesh with its deviations, and which faces of the reference could be seen."""
    storage.write_bytes(folder / "scans" / f"{name}.scannable", np.packbits(scannable).tobytes())
    aligned = mesh.transformed(reference_from_scan)
    storage.write_mesh(folder / "scans" / f"{name}.ply", aligned, values={"deviation_um": deviation_um})


def _evaluated_part(folder: Path, name: str) -> Mesh:
    """The part of a scan that is evaluated: where the reference could be seen."""
    file = storage.read_mesh_file(folder / "scans" / f"{name}.ply")
    evaluated = np.isfinite(file.vertex_values["deviation_um"])[file.mesh.faces].all(axis=1)
    if not evaluated.any():
        raise ReconstructionError(f"{name}: no part of the scan can be evaluated; see its row in results.csv")
    return file.mesh.submesh(evaluated)


def compare_scans(*, first: str, second: str, folder: Path, options: RepeatOptions) -> dict[str, Value]:
    """The distances of two scans after one is laid on the other."""
    scans = _evaluated_part(folder, first), _evaluated_part(folder, second)
    found = compare_pair(*scans, options.pairs, rng=np.random.default_rng(0))
    return {name: getattr(found.deviation, name) for name in STATISTICS} | {"common_pct": found.common_pct}


def _spread_of(folder: Path, names: Sequence[str], options: RepeatOptions) -> Spread:
    """Where all scans could see the reference."""
    reference = storage.read_jaw(folder / "reference.ply").mesh
    asked = np.ones(len(reference.faces), dtype=bool)
    for name in names:
        bits = np.frombuffer((folder / "scans" / f"{name}.scannable").read_bytes(), dtype=np.uint8)
        asked &= np.unpackbits(bits, count=len(reference.faces)).astype(bool)
    scans = [storage.read_mesh(folder / "scans" / f"{name}.ply") for name in names]
    return spread(reference, asked, scans, options.pairs, rng=np.random.default_rng(0))
