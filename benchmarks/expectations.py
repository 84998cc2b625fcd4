"""Whether scans are known as well as they say: surface, scale and poses beside the truth (docs/expected.md).

    python benchmarks/expectations.py [--only molar short] [--seeds 0 1] [--add] [--work FOLDER] [--workers 1]
                                      [--out benchmarks/results/expectations.json]
    python benchmarks/expectations.py --finished NAME=FOLDER NAME=FOLDER,WORK --only --add

Scans teeth of the phantom, each seed another jaw, texture and hand; exact calibration, artificial texture, default
options. Scans that are finished are kept in the work folder and not run again. ``--finished`` takes scans of your own:
a folder with ``truth``, and, in it or in a work folder, what ``cuspid reconstruct`` wrote; it is only read.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from run import conditions

from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import DESIGNS, DesignOptions
from cuspid.model.reconstruction import Expectation, Reconstruction
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.scan import ReconstructionOptions, SimulationOptions
from cuspid.runtime.errors import InputError
from cuspid.simulation.path.scan import ScanPathOptions
from cuspid.storage import SIGMA, read_json, read_mesh_file, read_poses, read_reconstruction, write_json
from cuspid.studies.grid import Case, Value, run_grid
from cuspid_thesis.scan_cases import commit

HERE = Path(__file__).parent


@dataclass(frozen=True, kw_only=True)
class Scan:
    """What is scanned, and with what."""

    cameras: str
    """Name of the design."""
    pixels: int
    """Width and height of the images."""
    tooth: int
    """FDI number."""
    frames: int | None = None
    """Positions of the handpiece; None for those that a tooth takes."""
    length_mm: float | None = None
    """Length of the path; None for that over a tooth."""


SCANS: Mapping[str, Scan] = {
    "molar-twelve-500": Scan(cameras="twelve", pixels=500, tooth=46),
    "molar-six-250": Scan(cameras="six", pixels=250, tooth=46),
    "premolar-six-250": Scan(cameras="six", pixels=250, tooth=44),
    "incisor-twelve-250": Scan(cameras="twelve", pixels=250, tooth=41),
    "short-six-250": Scan(cameras="six", pixels=250, tooth=46, frames=6, length_mm=3.0),
    "short-four-160": Scan(cameras="four", pixels=160, tooth=46, frames=6, length_mm=3.0),
}
"""By name; *short* ones see a part of a tooth, from near the same place."""


def judge(
    *, cameras: str, pixels: int, tooth: int, frames: int | None, length_mm: float | None, seed: int
) -> dict[str, Value]:
    """The figures of one scan of the phantom."""
    handpiece = DESIGNS[cameras](DesignOptions(width_px=pixels, height_px=pixels))
    path = ScanPathOptions(tooth=tooth, frames=frames, length_mm=length_mm)
    jaw, options = build_phantom(PhantomOptions(seed=seed)), SimulationOptions(path=path, seed=seed)
    with tempfile.TemporaryDirectory(prefix="cuspid-expected-") as folder:
        capture, _ = pipeline.simulate(jaw, handpiece, Path(folder), options)
        pipeline.reconstruct(capture, Path(folder), ReconstructionOptions())
        return measured(Path(folder) / "truth", Path(folder))


def measured(truth: Path, work: Path) -> dict[str, Value]:
    """The figures of a finished scan. Raises InputError where it does not say what to expect of it."""
    found, file = read_reconstruction(work / "motion"), read_mesh_file(work / "mesh.ply")
    expected, sigma_um = found.expectation, file.vertex_values.get(SIGMA)
    if expected is None or sigma_um is None:
        raise InputError(f"{work}: it does not say what to expect of it; run cuspid reconstruct again")
    known = pipeline.load_reference(truth)
    trueness = pipeline.evaluate(file.mesh, known)
    return {
        "commit": commit(),
        **of_surface(trueness.deviation_um, sigma_um),
        **of_lengths(trueness.scale_error_ppm, expected),
        **of_poses(found, read_poses(truth / "poses.json")),
    }


def of_surface(deviation_um: Float[np.ndarray, "v"], sigma_um: Float[np.ndarray, "v"]) -> dict[str, Value]:
    """Deviations of the vertices (NaN: not evaluated) beside their standard deviations."""
    known = np.isfinite(deviation_um)
    sigmas = np.abs(deviation_um[known]) / sigma_um[known]
    within = {f"within_{k}_sigma_pct": float(100 * np.mean(sigmas <= k)) for k in (1, 2, 3)}
    return {"rms_um": rms(deviation_um[known]), "median_sigma_um": float(np.median(sigma_um[known])), **within}


def of_lengths(scale_error_ppm: float, expected: Expectation) -> dict[str, Value]:
    """Scale and length."""
    return {
        "scale_error_ppm": scale_error_ppm,
        "scale_sigma_ppm": expected.scale_sigma_ppm,
        "span_mm": expected.span_mm,
        "span_sigma_um": expected.span_sigma_um,
    }


def of_poses(found: Reconstruction, true: Mapping[str, Rigid3]) -> dict[str, Value]:
    """Errors of the poses, seen from the first frame, in their standard deviations (root mean square of all numbers)
    and of the places in um, with what is stated of them."""
    first, *others = found.rig_from_world
    if found.pose_covariance is None or not others:
        return {"frames": len(found.frames), "rotation_z": None, "place_z": None}
    moved = [true[name] @ true[first].inverse() @ found.rig_from_world[name].inverse() for name in others]
    off = np.array([[*each.rotation_vector, *each.translation] for each in moved])
    variance = np.diagonal(found.pose_covariance[1:], axis1=1, axis2=2)
    normalised = off / np.sqrt(variance)
    return {
        "frames": len(found.frames),
        "rotation_z": rms(normalised[:, :3]),
        "place_z": rms(normalised[:, 3:]),
        "place_error_um": 1000 * np.sqrt(3) * rms(off[:, 3:]),
        "place_sigma_um": 1000 * float(np.sqrt(3 * variance[:, 3:].mean())),
    }


def rms(values: Float[np.ndarray, "..."]) -> float:
    """Root mean square of all numbers."""
    return float(np.sqrt(np.mean(values**2)))


def cases(seeds: list[int]) -> list[Case]:
    """Every scan with every seed."""
    return [
        Case(name=f"{name}-seed{seed}", parameters={**asdict(scan), "seed": seed})
        for name, scan in SCANS.items()
        for seed in seeds
    ]


def finished(asked_for: str) -> tuple[str, dict[str, Value]]:
    """Name and figures of a scan that is given as ``NAME=FOLDER`` or ``NAME=FOLDER,WORK``."""
    name, _, folders = asked_for.partition("=")
    folder, _, work = folders.partition(",")
    return name, {**measured(Path(folder) / "truth", Path(work or folder)), "failure": None}


def asked() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("build/expectations"))
    parser.add_argument("--out", type=Path, default=HERE / "results" / "expectations.json")
    parser.add_argument("--only", nargs="*", help="beginnings of names; without any: none; default: all")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1])
    parser.add_argument("--finished", nargs="*", default=[], metavar="NAME=FOLDER[,WORK]")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--add", action="store_true", help="to what the result file holds of other scans")
    return parser.parse_args()


def main() -> None:
    """Scan what is asked for and write the figures."""
    arguments = asked()
    every = cases(arguments.seeds)
    chosen = [each for each in every if arguments.only is None or each.name.startswith(tuple(arguments.only))]
    outcomes = run_grid(
        chosen,
        judge,
        arguments.work,
        workers=arguments.workers,
        progress=lambda stage, done, total: print(f"{stage}: {done} of {total}", flush=True),
    )
    before = read_json(arguments.out)["scans"] if arguments.add and arguments.out.exists() else {}
    scans = before | {each.case.name: {**each.figures, "failure": each.failure} for each in outcomes}
    scans |= dict(finished(each) for each in arguments.finished)
    write_json(arguments.out, {"scans": scans, **conditions()})


if __name__ == "__main__":
    main()
