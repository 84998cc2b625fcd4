"""Rehearse the calibration of a handpiece with a flat board and with terraces: what is stated, and what is true.

    python benchmarks/targets.py [--seeds 0 1 2] [--instants 24] [--pixels 300] [--work FOLDER]
                                 [--out benchmarks/results/targets.json]

The six cameras, built within tolerances, another handpiece for each seed. Boards are shown tilted by up to 40 degrees,
and by up to 15, where a probe leaves no room for more. From the same images of terraces there are three calibrations:
with steps that are known to 1 um (``known``), with steps that are 10 um off and known to as much (``off``), and with
such steps that are trusted to 1 um (``trusted``). Finished calibrations are kept in the work folder and not run again.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from run import conditions

from cuspid.calibration.calibrate import RigCalibration, calibrate_rig
from cuspid.calibration.corners import Views, find_corners
from cuspid.handpiece.designs import DesignOptions, six_cameras
from cuspid.model.board import Board
from cuspid.model.rig import Handpiece, Rig
from cuspid.runtime.image_files import read_image
from cuspid.simulation.board_images import PhotographOptions, take_photographs
from cuspid.simulation.manufacturing import ManufacturingOptions, sample_built
from cuspid.storage import write_json
from cuspid.studies.grid import Case, Value, run_grid

HERE = Path(__file__).parent
FLAT = Board(columns=9, rows=7, square_mm=0.7)
BOARDS = {"flat": FLAT, "terraces": replace(FLAT, terraces=3, step_mm=1.0)}
TILTS_DEG = (40.0, 15.0)
TOLERANCES = ManufacturingOptions(
    manufacturing_um=10.0,
    manufacturing_deg=0.05,
    manufacturing_focal_pct=0.3,
    manufacturing_centre_px=1.0,
    manufacturing_k1=0.01,
)
STEPS = {"known": (1.0, 1.0), "off": (1.01, 10.0), "trusted": (1.01, 1.0)}
"""What is said of steps of 1 mm: height in mm, standard deviation in um."""


def judge(*, board: str, tilt_deg: float, seed: int, instants: int, pixels: int) -> dict[str, Value]:
    """The figures of one handpiece before one board."""
    true = sample_built(
        six_cameras(DesignOptions(width_px=pixels, height_px=pixels)), replace(TOLERANCES, manufacturing_seed=seed)
    )
    shown = PhotographOptions(instants=instants, max_tilt_deg=tilt_deg, supersampling=2, seed=seed)
    with TemporaryDirectory(prefix="cuspid-target-") as folder:
        take_photographs(true, BOARDS[board], Path(folder), shown)
        views = views_in(Path(folder) / "images", BOARDS[board])
    steps = {} if board == "flat" else STEPS
    said = {
        name: replace(BOARDS[board], step_mm=step_mm, step_sigma_um=sigma_um)
        for name, (step_mm, sigma_um) in steps.items()
    } or {"flat": FLAT}
    return {
        f"{name}_{figure}": value
        for name, each in said.items()
        for figure, value in errors(calibrated(views, true, each), true.rig).items()
    }


def views_in(images: Path, board: Board) -> Views:
    """The board in the images of each camera."""
    found = {
        (path.parent.name, path.stem): find_corners(cv2.cvtColor(read_image(path), cv2.COLOR_RGB2GRAY), board)
        for path in sorted(images.glob("*/*.png"))
    }
    return {key: view for key, view in found.items() if view is not None}


def calibrated(views: Views, handpiece: Handpiece, board: Board) -> RigCalibration:
    """The cameras of a handpiece from what they saw."""
    sizes = {name: (each.camera.width, each.camera.height) for name, each in handpiece.rig.cameras.items()}
    return calibrate_rig(views, sizes, board)


def errors(found: RigCalibration, true: Rig) -> dict[str, Value]:
    """Root mean squares over the cameras: of focal lengths in per mille, of distances between cameras in um."""
    focal = {name: each.camera.focal_px for name, each in true.cameras.items()}
    known = [np.sqrt(np.diag(np.array(found.rig[name].camera.covariance))[:2]) / each for name, each in focal.items()]
    off = [found.rig[name].camera.focal_px / each - 1 for name, each in focal.items()]
    return {
        "corners": sum(each.corners for each in found.cameras.values()),
        "sigma_px": found.sigma_px,
        "focal_sigma_permille": 1000 * rms(known),
        "focal_error_permille": 1000 * rms(off),
        "place_error_um": 1000 * rms(distances_mm(found.rig) - distances_mm(true)),
    }


def distances_mm(rig: Rig) -> np.ndarray:
    """Between each two cameras."""
    centres = np.array([rig[name].centre_in_rig for name in sorted(rig.names)])
    one, other = np.triu_indices(len(centres), 1)
    return np.asarray(np.linalg.norm(centres[one] - centres[other], axis=1))


def rms(values: object) -> float:
    """Root mean square of all numbers."""
    return float(np.sqrt(np.mean(np.square(np.asarray(values)))))


def asked() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("build/targets"))
    parser.add_argument("--out", type=Path, default=HERE / "results" / "targets.json")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--instants", type=int, default=24)
    parser.add_argument("--pixels", type=int, default=300)
    return parser.parse_args()


def main() -> None:
    """Calibrate with what is asked for and write the figures."""
    arguments = asked()
    outcomes = run_grid(
        [
            Case(name=f"{board}-{tilt:g}deg-seed{seed}", parameters={"board": board, "tilt_deg": tilt, "seed": seed})
            for tilt in TILTS_DEG
            for board in BOARDS
            for seed in arguments.seeds
        ],
        partial(judge, instants=arguments.instants, pixels=arguments.pixels),
        arguments.work / f"{arguments.instants}-{arguments.pixels}",
        workers=1,
        progress=lambda stage, done, total: print(f"{stage}: {done} of {total}", flush=True),
    )
    found = {each.case.name: {**each.figures, "failure": each.failure} for each in outcomes}
    options = {
        "instants": arguments.instants,
        "pixels": arguments.pixels,
        "tolerances": TOLERANCES,
        "boards": BOARDS,
        "steps": STEPS,
    }
    write_json(arguments.out, {**options, "calibrations": found, **conditions()})


if __name__ == "__main__":
    main()
