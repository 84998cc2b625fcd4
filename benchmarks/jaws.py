"""Scan real jaws and parts of them, each without options of its own.

    python benchmarks/jaws.py FOLDER [--work build/jaws] [--size half] [--passes auto] [--only 001 quadrant] [--plan]
                              [--seeds 1] [--add]

FOLDER holds meshes of jaws, ``lower`` or ``upper`` in their names; those of fewer than 30,000 faces are also scanned
after two Loop subdivisions, for their facets are larger than teeth are smooth. Quadrants, single teeth and jaws with
gaps are cut from labelled ones, with 3 mm of what is around them, turned at random and without their labels; where
teeth are taken out of an arch the gum around them stays, as in a mouth. ``--plan`` only plans the paths, for so many
seeds of the hand, and tells how near the body comes to the jaw. Finished scans are kept in the work folder and not run
again; ``--add`` keeps those of the result file, too, each with the commit that it is of.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import trimesh
from run import conditions
from scipy.spatial.transform import Rotation

from cuspid.anatomy.jaw_files import load_jaw
from cuspid.evaluation.trajectory import trajectory_error
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import DesignOptions, twelve_cameras
from cuspid.model.jaw import ARCHES, GUM, Arch, Jaw
from cuspid.model.mesh import Mesh, edges_of
from cuspid.model.rig import Handpiece
from cuspid.model.room import Room
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.scan import ReconstructionOptions, SimulationOptions
from cuspid.simulation.path.scan import ScanPathOptions, plan_scan_path
from cuspid.storage import read_json, read_poses, write_json
from cuspid.studies.grid import Case, Value, Work, run_grid
from cuspid_thesis.scan_cases import commit

HERE = Path(__file__).parent
COARSE = 30_000
PARTS: dict[str, tuple[str, tuple[int, ...]]] = {
    "quadrant": ("fullarch_upper_137k", tuple(range(11, 19))),
    "quadrant-2": ("001_lower", tuple(range(41, 49))),
    "quadrant-3": ("005_upper", tuple(range(21, 29))),
    "quadrant-4": ("010_lower", tuple(range(31, 39))),
    "quadrant-5": ("029_upper", tuple(range(11, 19))),
    "molar": ("014_lower", (46,)),
    "premolar": ("034_upper", (15,)),
    "incisor": ("067_lower", (31,)),
    "gaps": ("023_lower", tuple(t for q in (3, 4) for t in range(10 * q + 1, 10 * q + 9) if t not in (46, 34, 35))),
    "gaps-2": ("048_upper", tuple(t for q in (1, 2) for t in range(10 * q + 1, 10 * q + 9) if t not in (16, 24, 25))),
}
"""From which jaw, and which teeth."""


def arch_of(path: Path) -> Arch | None:
    """As the name says."""
    return next((each for each in ARCHES if each in path.stem), None)


def face_count(path: Path) -> int:
    """As the header of a PLY file says."""
    header = path.read_bytes()[:2000].split(b"end_header")[0].decode()
    return int(header.split("element face")[1].split()[0])


def cases(files: dict[str, Path]) -> Iterator[Case]:
    """Every jaw, the coarse ones again after subdivision, and the parts."""
    for name, path in files.items():
        yield Case(name=name, parameters={"file": str(path), "part": "", "smooth": False})
        if face_count(path) < COARSE:
            yield Case(name=f"{name}-smooth", parameters={"file": str(path), "part": "", "smooth": True})
    for part, (name, _) in PARTS.items():
        if name in files:
            yield Case(name=f"{part}-{name}", parameters={"file": str(files[name]), "part": part, "smooth": True})


def jaw_of(file: str, part: str, smooth: bool) -> Jaw:
    """The jaw of a case; a part as a user would bring it, in any pose and without labels."""
    jaw, _ = load_jaw(Path(file), arch=arch_of(Path(file)))
    if smooth and len(jaw.mesh.faces) < COARSE:
        jaw = subdivided(jaw)
    if not part:
        return jaw
    with tempfile.TemporaryDirectory(prefix="cuspid-part-") as folder:
        path = Path(folder) / f"{part}.ply"
        cut = cut_out(jaw, PARTS[part][1], gaps=part.startswith("gaps"))
        trimesh.Trimesh(cut.vertices, cut.faces, process=False).export(path)
        return load_jaw(path, arch=jaw.arch)[0]


def subdivided(jaw: Jaw) -> Jaw:
    """After two Loop subdivisions; faces take the label of the nearest one before."""
    clean = _manifold(jaw.mesh)
    mesh = Mesh(*trimesh.remesh.subdivide_loop(clean.vertices, clean.faces, iterations=2))
    if jaw.face_labels is None:
        return replace(jaw, mesh=mesh)
    _, nearest, _ = jaw.mesh.closest(mesh.face_centres)
    return replace(jaw, mesh=mesh, face_labels=jaw.face_labels[nearest])


def _manifold(mesh: Mesh) -> Mesh:
    """Without the faces on edges that more than two share, which cannot be subdivided, and without lone vertices."""
    edges = np.sort(edges_of(mesh.faces), axis=1)
    _, edge, sharing = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    alone = np.asarray(sharing[edge.ravel()] <= 2).reshape(-1, 3)
    return mesh.submesh(np.asarray(alone.all(axis=1)))


def cut_out(jaw: Jaw, teeth: tuple[int, ...], *, gaps: bool, turned: bool = True) -> Mesh:
    """Teeth with 3 mm of gum, also around teeth that are taken out where these leave gaps, in any pose unless told."""
    if jaw.face_labels is None:
        raise SystemExit("parts are cut from labelled jaws")
    wanted = np.isin(jaw.face_labels, teeth)
    around = jaw.face_labels != GUM if gaps else wanted
    distance, _, _ = jaw.mesh.submesh(around).closest(jaw.mesh.face_centres)
    part = jaw.mesh.submesh(wanted | ((jaw.face_labels == GUM) & (distance < 3.0)))
    if not turned:
        return part
    rng = np.random.default_rng(len(teeth))
    return part.transformed(Rigid3(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 50, 3)))


def judge(
    *, file: str, part: str, smooth: bool, pixels: int, passes: str, plan_only: bool, seeds: int, scans: Path
) -> dict[str, Value]:
    """The figures of one jaw. A scan that was cut short goes on where it stopped; a finished one is not kept."""
    jaw = jaw_of(file, part, smooth)
    handpiece = twelve_cameras(DesignOptions(width_px=pixels, height_px=pixels))
    path_options = ScanPathOptions(passes="auto" if passes == "auto" else "turns")
    begin, begin_cpu = time.perf_counter(), time.process_time()
    path = plan_scan_path(jaw, handpiece, path_options, np.random.default_rng([0, 1]))
    took, took_cpu = time.perf_counter() - begin, time.process_time() - begin_cpu
    others = (
        plan_scan_path(jaw, handpiece, path_options, np.random.default_rng([seed, 1])) for seed in range(1, seeds)
    )
    room = Room(jaw.mesh, handpiece.solid, path_options.clearance_mm)
    planned: dict[str, Value] = {
        "commit": commit(),
        "faces": len(jaw.mesh.faces),
        "frames": len(path.rig_from_world),
        "plan_s": took,
        "plan_cpu_s": took_cpu,
        "clearance_mm": min(
            room.clearance(pose)[0] for each in (path, *others) for pose in each.rig_from_world.values()
        ),
        "seeds": seeds,
        "minimum_overlap_pct": 100 * path.min_overlap,
        "seen_pct": 100 * path.seen[GUM],
    }
    if plan_only:
        return planned
    folder = scans / "-".join([Path(file).stem, part or "whole", "smooth" if smooth else "as-it-is"])
    figures = planned | scanned(jaw, handpiece, folder, SimulationOptions(path=path_options))
    shutil.rmtree(folder)
    return figures


def scanned(
    jaw: Jaw,
    handpiece: Handpiece,
    folder: Path,
    options: SimulationOptions,
    how: ReconstructionOptions = ReconstructionOptions(),
) -> dict[str, Value]:
    """The figures of a scan; without times if parts of it are from an earlier run."""
    capture, _ = pipeline.simulate(jaw, handpiece, folder, options)
    whole = not any((folder / each).exists() for each in ("motion", "depth"))
    begin, begin_cpu = time.perf_counter(), time.process_time()
    reconstruction, mesh = pipeline.reconstruct(capture, folder, how)
    took, took_cpu = time.perf_counter() - begin, time.process_time() - begin_cpu
    reference = pipeline.load_reference(folder / "truth")
    found = pipeline.evaluate(mesh, reference)
    crown = found.crown
    trajectory = trajectory_error(
        reconstruction.rig_from_world, read_poses(folder / "truth" / "poses.json"), found.reference_from_scan
    )
    return {
        "images": len(list((folder / "capture" / "images").rglob("*.png"))),
        "located": len(reconstruction.frames),
        "trajectory_um": trajectory.ape_um.rmse,
        "notes": "; ".join(reconstruction.notes),
        "mean_um": found.accuracy.mean_abs_um,
        "p95_um": found.accuracy.p95_um,
        "everything_mean_um": None if found.everything is None else found.everything.mean_abs_um,
        "seen_complete_50_um_pct": found.completeness_pct["50"],
        "crown_complete_50_um_pct": None if crown is None else crown.completeness_pct["50"],
        "scale_ppm": found.scale_error_ppm,
        "inter_molar_um": found.inter_molar_error_um,
        "reconstruction_s": took if whole else None,
        "reconstruction_cpu_s": took_cpu if whole else None,
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        "path_crowns_seen": read_json(folder / "truth" / "path.json")["crowns_seen"].get("all"),
    }


def is_asked(name: str, words: list[str], known: list[Case]) -> bool:
    """Whether a case is one of those asked for, by its name or, where a word names none, by a part of it."""
    names = {each.name for each in known}
    return any(word == name or (word not in names and word in name) for word in words)


def parser_of(description: str | None, work: Path, out: Path | None) -> argparse.ArgumentParser:
    """Of a benchmark that scans the jaws of a folder, by case."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--work", type=Path, default=work)
    parser.add_argument("--out", type=Path, default=out)
    parser.add_argument("--only", nargs="*", help="names of cases or parts of them; default: all")
    parser.add_argument("--add", action="store_true", help="to what the result file holds of other cases")
    return parser


def figures_of(known: list[Case], how: Work, work: Path, out: Path, arguments: argparse.Namespace) -> dict[str, Value]:
    """By the names of the cases that are asked for, in the order of all; with ``--add`` also of those in ``out``."""
    chosen = [each for each in known if arguments.only is None or is_asked(each.name, arguments.only, known)]
    outcomes = run_grid(
        chosen,
        how,
        work,
        workers=1,
        progress=lambda stage, done, total: print(f"{stage}: {done} of {total}", flush=True),
    )
    before = read_json(out)["scans"] if arguments.add and out.exists() else {}
    scans = before | {each.case.name: {**each.figures, "failure": each.failure} for each in outcomes}
    return {each.name: scans[each.name] for each in known if each.name in scans}


def main() -> None:
    """Scan what is asked for and write the figures."""
    parser = parser_of(__doc__, Path("build/jaws"), None)
    parser.add_argument("--size", choices=("half", "full"), default="half", help="of the images: 250 or 500 px")
    parser.add_argument("--passes", choices=("turns", "auto"), default="turns")
    parser.add_argument("--plan", action="store_true", help="only plan the paths")
    parser.add_argument("--seeds", type=int, default=1, help="of the hand, for --plan")
    arguments = parser.parse_args()
    auto = ["auto"] if arguments.passes == "auto" else []
    kind = "_".join(["plan" if arguments.plan else arguments.size, *auto])
    pixels = 500 if arguments.size == "full" else 250
    known = list(cases({path.stem: path for path in sorted(arguments.folder.rglob("*.ply"))}))
    work, out = arguments.work / kind, arguments.out or HERE / "results" / f"jaws_{kind}.json"
    seeds = arguments.seeds if arguments.plan else 1
    how = partial(
        judge,
        pixels=pixels,
        passes=arguments.passes,
        plan_only=arguments.plan,
        seeds=seeds,
        scans=work / "unfinished",
    )
    scans = figures_of(known, how, work, out, arguments)
    write_json(out, {"kind": kind, "cases": len(known), "scans": scans, **conditions()})


if __name__ == "__main__":
    main()
