"""One trial: a jaw is scanned in simulation, reconstructed and compared with itself; a row of figures for a study."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from cuspid.evaluation.deviation import EvaluationOptions, evaluate
from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.registration import fit
from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import Reconstruction
from cuspid.model.rig import Handpiece
from cuspid.model.trueness import METRICS, GroundTruth, Trueness
from cuspid.model.visibility import VisibilityOptions
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.scan import ReconstructionOptions, SimulationOptions
from cuspid.runtime.errors import ReconstructionError

Shoot = Callable[[Path], tuple[Capture, GroundTruth]]
"""Writes images to a folder."""


@dataclass(frozen=True, kw_only=True)
class TrialOptions:
    """How each scan of a study is made and evaluated."""

    simulation: SimulationOptions = field(default_factory=SimulationOptions)
    """How the images are made."""
    reconstruction: ReconstructionOptions = field(default_factory=ReconstructionOptions)
    """How the images become a mesh."""
    evaluation: EvaluationOptions = field(default_factory=EvaluationOptions)
    """How the mesh is compared with the jaw."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Trial:
    """What came of it."""

    capture: Capture
    """The images."""
    truth: GroundTruth
    """What the simulator knew."""
    reconstruction: Reconstruction
    """Poses that were found."""
    mesh: Mesh
    """The surface, in the frame of the reconstruction."""
    scannable: Bool[np.ndarray, "f"]
    """The faces of the jaw that at least two cameras could see."""
    trueness: Trueness
    """Mesh against jaw, where it was scannable, or on the faces that were asked for."""
    simulation_s: float
    """Wall time to the images."""
    reconstruction_s: float
    """Wall time from the images to the mesh."""
    reconstruction_cpu_s: float
    """CPU time of this process for the same."""

    @property
    def points(self) -> int:
        """Vertices of the mesh."""
        return len(self.mesh.vertices)

    @property
    def figures(self) -> dict[str, float | int]:
        """The row: units in the names."""
        frames = len(self.capture.frames)
        return {
            "frames": frames,
            "located_frames": len(self.reconstruction.frames),
            "images": frames * len(self.truth.handpiece.rig.names),
            "points": self.points,
            **{name: value for name, metric in METRICS.items() if (value := metric.of(self.trueness)) is not None},
            "simulation_s": self.simulation_s,
            "reconstruction_s": self.reconstruction_s,
            "reconstruction_cpu_s": self.reconstruction_cpu_s,
        }


def scan(jaw: Jaw, handpiece: Handpiece, folder: Path, options: TrialOptions) -> Trial:
    """Scan a jaw along the path that the options plan. Raises what the stages of the pipeline raise."""
    return run_trial(lambda out: pipeline.simulate(jaw, handpiece, out, options.simulation), folder, options)


def run_trial(
    shoot: Shoot,
    folder: Path,
    options: TrialOptions,
    *,
    evaluated: Bool[np.ndarray, "f"] | None = None,
    start_from_truth: bool = False,
) -> Trial:
    """Images to mesh to trueness, on the faces of the jaw in ``evaluated`` (None: those that were scannable).

    With ``start_from_truth`` the mesh is aligned from the true pose of its first frame on, which saves the search over
    all poses (some ten seconds). Raises what the stages raise, ReconstructionError where no surface is left.
    """
    begin = time.perf_counter()
    capture, truth = shoot(folder)
    shot, shot_cpu = time.perf_counter(), time.process_time()
    reconstruction, mesh = pipeline.reconstruct(capture, folder, options.reconstruction)
    reconstructed, reconstructed_cpu = time.perf_counter(), time.process_time()
    if not len(mesh.faces):
        raise ReconstructionError("no surface is left after cleaning")
    scannable = pipeline.scannable(truth, VisibilityOptions())
    start = _true_start(reconstruction, truth) if start_from_truth else None
    return Trial(
        capture=capture,
        truth=truth,
        reconstruction=reconstruction,
        mesh=mesh,
        scannable=scannable,
        trueness=_compare(mesh, truth.jaw, scannable if evaluated is None else evaluated, start, options.evaluation),
        simulation_s=shot - begin,
        reconstruction_s=reconstructed - shot,
        reconstruction_cpu_s=reconstructed_cpu - shot_cpu,
    )


def _true_start(reconstruction: Reconstruction, truth: GroundTruth) -> Rigid3:
    """``world_from_scan`` by the first frame that was located."""
    name, rig_from_scan = next(iter(reconstruction.rig_from_world.items()))
    return truth.rig_from_world[name].inverse() @ rig_from_scan


def _compare(
    mesh: Mesh, jaw: Jaw, evaluated: Bool[np.ndarray, "f"], start: Rigid3 | None, options: EvaluationOptions
) -> Trueness:
    """Trueness of a mesh whose pose is to be found, or is near ``start``."""
    if start is None or not options.align:
        return evaluate(mesh, jaw, options, scannable=evaluated)
    points, _ = mesh.sample(options.registration.samples, np.random.default_rng(0))
    aligned = fit(points, SignedDistance(jaw.mesh), start, options.registration).reference_from_scan
    moved = mesh.transformed(aligned)
    found = evaluate(moved, jaw, replace(options, align=False), scannable=evaluated)
    return replace(found, reference_from_scan=aligned)
