"""Scan with handpieces that are not what their files say: held as drawn, and refined within their tolerances.

    python benchmarks/manufacturing.py [--jaw JAW --tooth T] [--seeds 0 1 2] [--only fine usual] [--size half]
                                       [--work FOLDER] [--out benchmarks/results/manufacturing.json]

Twelve cameras, artificial texture, the molar 46 of the phantom, or a jaw of your own (all of it in one pass unless a
tooth is given). Each handpiece of a row is another one that was built to the same tolerances. Finished scans are kept
in the work folder and not run again.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

from run import conditions

from cuspid import pipeline
from cuspid.anatomy.jaw_files import load_jaw
from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.capture import Capture
from cuspid.evaluation.deviation import EvaluationOptions
from cuspid.evaluation.trajectory import trajectory_error
from cuspid.handpiece.designs import DesignOptions, twelve_cameras
from cuspid.jaw import Jaw
from cuspid.pipeline import ReconstructionOptions, SimulationOptions
from cuspid.simulation.manufacturing import ManufacturingOptions
from cuspid.simulation.path.scan import ScanPathOptions
from cuspid.storage import read_poses, write_json
from cuspid.studies.grid import Case, Value, run_grid
from cuspid.studies.scan_cases import commit

HERE = Path(__file__).parent
LENSES = ManufacturingOptions(manufacturing_focal_pct=0.3, manufacturing_centre_px=1.0, manufacturing_k1=0.01)
TOLERANCES = {
    "none": ManufacturingOptions(),
    "fine": ManufacturingOptions(manufacturing_um=3.0, manufacturing_deg=0.02),
    "usual": replace(LENSES, manufacturing_um=10.0, manufacturing_deg=0.05),
    "rough": replace(LENSES, manufacturing_um=30.0, manufacturing_deg=0.2),
}


def judge(*, tolerances: str, seed: int, jaw: Jaw, path: ScanPathOptions, pixels: int) -> dict[str, Value]:
    """The figures of one handpiece, held and refined."""
    manufacturing = replace(TOLERANCES[tolerances], manufacturing_seed=seed)
    options = SimulationOptions(path=path, manufacturing=manufacturing, seed=seed)
    handpiece = twelve_cameras(DesignOptions(width_px=pixels, height_px=pixels))
    figures: dict[str, Value] = {"commit": commit()}
    with tempfile.TemporaryDirectory(prefix="cuspid-built-") as folder:
        capture, _ = pipeline.simulate(jaw, handpiece, Path(folder), options)
        figures |= scanned("held", capture, Path(folder), ReconstructionOptions(calibration="fixed"))
        if tolerances != "none":
            figures |= scanned("refined", capture, Path(folder), ReconstructionOptions())
    return figures | {"peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6}


def scanned(how: str, capture: Capture, folder: Path, options: ReconstructionOptions) -> dict[str, Value]:
    """The figures of a scan, each with ``how`` before its name."""
    begin, begin_cpu = time.perf_counter(), time.process_time()
    reconstruction = pipeline.find_poses(capture, folder / how, options)
    mesh, sigma_um = pipeline.surface(capture, reconstruction, folder / how, options)
    took, took_cpu = time.perf_counter() - begin, time.process_time() - begin_cpu
    reference = pipeline.load_reference(folder / "truth")
    found = pipeline.evaluate(
        mesh,
        reference.jaw,
        EvaluationOptions(),
        scannable=reference.scannable,
        crown=reference.crown,
        sigma_um=sigma_um,
    )
    trajectory = trajectory_error(
        reconstruction.rig_from_world, read_poses(folder / "truth" / "poses.json"), found.reference_from_scan
    )
    expected, within = reconstruction.expectation, found.within_sigmas_pct
    figures: dict[str, Value] = {
        "mean_um": found.accuracy.mean_abs_um,
        "p95_um": found.accuracy.p95_um,
        "complete_50_um_pct": found.completeness_pct["50"],
        "scale_ppm": found.scale_error_ppm,
        "inter_molar_um": found.inter_molar_error_um,
        "trajectory_um": trajectory.ape_um.rmse,
        "located": len(reconstruction.frames),
        "notes": "; ".join(reconstruction.notes),
        "scale_sigma_ppm": None if expected is None else expected.scale_sigma_ppm,
        "span_sigma_um": None if expected is None else expected.span_sigma_um,
        "within_sigma_pct": None if within is None else within["1"],
        "within_2_sigmas_pct": None if within is None else within["2"],
        "reconstruction_s": took,
        "reconstruction_cpu_s": took_cpu,
    }
    return {f"{how}_{name}": value for name, value in figures.items()}


def asked() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("build/manufacturing"))
    parser.add_argument("--out", type=Path, default=HERE / "results" / "manufacturing.json")
    parser.add_argument("--jaw", type=Path, default=None)
    parser.add_argument("--tooth", type=int, default=None)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--only", nargs="*", choices=list(TOLERANCES), default=list(TOLERANCES))
    parser.add_argument("--size", choices=("half", "full"), default="full", help="of the images: 250 or 500 px")
    return parser.parse_args()


def main() -> None:
    """Scan with what is asked for and write the figures."""
    arguments = asked()
    own = arguments.jaw is not None
    jaw = load_jaw(arguments.jaw)[0] if own else build_phantom(PhantomOptions())
    path = ScanPathOptions(tooth=arguments.tooth if own else 46, passes="turns")
    what = f"{arguments.jaw.stem if own else 'phantom'}-{path.tooth or 'arch'}-{arguments.size}"
    outcomes = run_grid(
        [
            Case(name=f"{each}-seed{seed}", parameters={"tolerances": each, "seed": seed})
            for each in arguments.only
            for seed in arguments.seeds
        ],
        partial(judge, jaw=jaw, path=path, pixels=500 if arguments.size == "full" else 250),
        arguments.work / what,
        workers=1,
        progress=lambda stage, done, total: print(f"{stage}: {done} of {total}", flush=True),
    )
    scans = {each.case.name: {**each.figures, "failure": each.failure} for each in outcomes}
    write_json(arguments.out, {"what": what, "tolerances": TOLERANCES, "scans": scans, **conditions()})


if __name__ == "__main__":
    main()
