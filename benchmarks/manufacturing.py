"""Scan with handpieces that are not what their files say: held as drawn, and refined within their tolerances.

    python benchmarks/manufacturing.py [--jaw JAW | --arch] [--tooth T] [--cross-sweep] [--seeds 0 1 2]
                                       [--only fine usual] [--size half] [--held]
                                       [--work FOLDER] [--out benchmarks/results/manufacturing.json]

Twelve cameras, artificial texture, the molar 46 of the phantom, its whole arch, or a jaw of your own (all of it in one
pass unless a tooth is given, with a sweep across if asked for). The images are made once, with the drawn handpiece; the
file of each case is that of another one that was built to the tolerances. Finished scans are kept in the work folder
and not run again.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from run import conditions

from cuspid import storage
from cuspid.anatomy.jaw_files import load_jaw
from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.evaluation.trajectory import trajectory_error
from cuspid.geometry import Rigid3, best_similarity
from cuspid.handpiece.designs import DesignOptions, twelve_cameras
from cuspid.model.capture import Capture
from cuspid.model.reconstruction import Reconstruction
from cuspid.model.rig import Rig
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.scan import ReconstructionOptions, SimulationOptions
from cuspid.simulation.manufacturing import ManufacturingOptions, sample_built, with_tolerances
from cuspid.simulation.path.scan import ScanPathOptions
from cuspid.storage import write_json
from cuspid.studies.grid import Case, Value, run_grid
from cuspid_thesis.scan_cases import commit

HERE = Path(__file__).parent
LENSES = ManufacturingOptions(manufacturing_focal_pct=0.3, manufacturing_centre_px=1.0, manufacturing_k1=0.01)
CALIBRATIONS: dict[str, Literal["fixed", "refined"]] = {"held": "fixed", "refined": "refined"}
TOLERANCES = {
    "none": ManufacturingOptions(),
    "fine": ManufacturingOptions(manufacturing_um=3.0, manufacturing_deg=0.02),
    "usual": replace(LENSES, manufacturing_um=10.0, manufacturing_deg=0.05),
    "rough": replace(LENSES, manufacturing_um=30.0, manufacturing_deg=0.2),
}


def judge(*, tolerances: str, seed: int, scan: Path, held: bool) -> dict[str, Value]:
    """The figures of one handpiece: the images are those of the drawn one, the file is that of one that was built."""
    capture = storage.read_capture(scan / "capture")
    manufacturing = replace(TOLERANCES[tolerances], manufacturing_seed=seed)
    off = with_tolerances(sample_built(capture.handpiece, manufacturing), manufacturing)
    exact = tolerances == "none"
    figures: dict[str, Value] = {"commit": commit()}
    with tempfile.TemporaryDirectory(prefix="cuspid-built-") as folder:
        for how, calibration in CALIBRATIONS.items():
            if how == ("held" if exact else "refined") or (held and not exact):
                rigs = replace(capture, handpiece=off), capture.handpiece.rig
                figures |= scanned(how, *rigs, scan, Path(folder), calibration)
    return figures | {"peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6}


def scanned(
    how: str, capture: Capture, drawn: Rig, scan: Path, folder: Path, calibration: Literal["fixed", "refined"]
) -> dict[str, Value]:
    """The figures of a scan, each with ``how`` before its name; ``drawn`` took the images. Keypoints are found once for
    all handpieces."""
    (scan / "features").mkdir(exist_ok=True)
    (folder / how / "motion").mkdir(parents=True)
    (folder / how / "motion" / "cache").symlink_to((scan / "features").resolve())
    options = ReconstructionOptions(calibration=calibration)
    begin, begin_cpu = time.perf_counter(), time.process_time()
    reconstruction = pipeline.find_poses(capture, folder / how, options)
    mesh, sigma_um = pipeline.surface(capture, reconstruction, folder / how, options)
    took, took_cpu = time.perf_counter() - begin, time.process_time() - begin_cpu
    reference = pipeline.load_reference(scan / "truth")
    found = pipeline.evaluate(mesh, reference, sigma_um=sigma_um)
    true = storage.read_poses(scan / "truth" / "poses.json")
    trajectory = trajectory_error(reconstruction.rig_from_world, true, found.reference_from_scan)
    scaled = replace(mesh, vertices=mesh.vertices / (1 + found.scale_error_ppm / 1e6))
    similar = pipeline.evaluate(scaled, reference)
    expected, within = reconstruction.expectation, found.within_sigmas_pct
    figures: dict[str, Value] = {
        "mean_um": found.accuracy.mean_abs_um,
        "p95_um": found.accuracy.p95_um,
        "complete_50_um_pct": found.completeness_pct["50"],
        "scale_ppm": found.scale_error_ppm,
        "inter_molar_um": found.inter_molar_error_um,
        "trajectory_um": trajectory.ape_um.rmse,
        "similar_mean_um": similar.accuracy.mean_abs_um,
        "similar_trajectory_um": shape_error_um(reconstruction, true, drawn),
        "adjustments_s": reconstruction.log["adjustment_s"],
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


def shape_error_um(found: Reconstruction, true: Mapping[str, Rigid3], drawn: Rig) -> float:
    """Of the places of the handpiece, RMS, after the best similarity. Where its file has the origin no image tells: the
    place is that of the true origin, as the cameras that were found lie about it."""
    cameras = [np.array([each.centre_in_rig for each in rig.cameras.values()]) for rig in (drawn, found.rig)]
    _, _, origin = best_similarity(*cameras)
    places = [
        np.array([poses[name].inverse().apply(at) for name in found.frames])
        for poses, at in ((found.rig_from_world, origin), (true, np.zeros(3)))
    ]
    scale, rotation, shift = best_similarity(*places)
    return float(1000 * np.sqrt(np.mean(np.sum((scale * places[0] @ rotation.T + shift - places[1]) ** 2, axis=1))))


def asked() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("build/manufacturing"))
    parser.add_argument("--out", type=Path, default=HERE / "results" / "manufacturing.json")
    parser.add_argument("--jaw", type=Path, default=None)
    parser.add_argument("--arch", action="store_true", help="all of the phantom")
    parser.add_argument("--cross-sweep", action="store_true")
    parser.add_argument("--tooth", type=int, default=None)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--only", nargs="*", choices=list(TOLERANCES), default=list(TOLERANCES))
    parser.add_argument("--held", action="store_true", help="also with the files taken as exact")
    parser.add_argument("--size", choices=("half", "full"), default="full", help="of the images: 250 or 500 px")
    return parser.parse_args()


def main() -> None:
    """Scan with what is asked for and write the figures."""
    arguments = asked()
    own = arguments.jaw is not None
    jaw = load_jaw(arguments.jaw)[0] if own else build_phantom(PhantomOptions())
    tooth = arguments.tooth if own or arguments.arch else 46
    path = ScanPathOptions(tooth=tooth, passes="turns", cross_sweep=arguments.cross_sweep)
    swept = "-swept" * path.cross_sweep
    what = f"{arguments.jaw.stem if own else 'phantom'}-{path.tooth or 'arch'}{swept}-{arguments.size}"
    px = 500 if arguments.size == "full" else 250
    scan, drawn = arguments.work / what, twelve_cameras(DesignOptions(width_px=px, height_px=px))
    pipeline.simulate(jaw, drawn, scan, SimulationOptions(path=path))
    outcomes = run_grid(
        [
            Case(name=f"{each}-seed{seed}", parameters={"tolerances": each, "seed": seed})
            for each in arguments.only
            for seed in (arguments.seeds if each != "none" else arguments.seeds[:1])
        ],
        partial(judge, scan=scan, held=arguments.held),
        scan,
        workers=1,
        progress=lambda stage, done, total: print(f"{stage}: {done} of {total}", flush=True),
    )
    scans = {each.case.name: {**each.figures, "failure": each.failure} for each in outcomes}
    write_json(arguments.out, {"what": what, "tolerances": TOLERANCES, "scans": scans, **conditions()})


if __name__ == "__main__":
    main()
