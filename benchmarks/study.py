"""Measure whether a study of scanners finds known errors again, and how fast it is.

    python benchmarks/study.py JAWS --work FOLDER [--out benchmarks/results/study.json] [--part NAME ...]

JAWS holds meshes of real jaws (half of those below were looked at only when all was done). Parts: ``errors`` (scale,
bends, noise, a dent, holes, other triangles, cut borders; each moved at random), ``one_end`` (aligned at one end of a
bent arch, read at the other), ``coverage`` (intervals of 200 simulated studies), ``bodies`` (scan bodies with noise and
a third missing), ``cloudcompare`` (distances beside CloudCompare's), ``speed`` (120 scans of 300 000 faces).
What each part found is kept in the work folder.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from cloudcompare import distances_by_cloudcompare
from jaxtyping import Float
from run import conditions
from study_cases import bent, errors, fields, near_curve, signed_twist

from cuspid import storage
from cuspid.anatomy.orientation import find_occlusal_frame
from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.scan_bodies import fit_body
from cuspid.geometry import Rigid3
from cuspid.model.arch_curve import arch_curve
from cuspid.model.facing import facing_outwards
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.studies.scanners.files import ScanFile
from cuspid.studies.scanners.inference import compare_scanners, mean_estimate, precision_estimate
from cuspid.studies.scanners.scan import StudyOptions, measure_file
from cuspid.studies.scanners.specimen import Specimen, load_specimen
from cuspid.studies.scanners.study import Intake, prepare, specimen_of
from cuspid.studies.scanners.summary import compare_scan, find_common, scan_row

JAWS = {
    "teeth3ds/0140W3ND_lower.ply": True,
    "iosseg/023_upper.ply": False,
    "iosseg/001_lower.ply": True,
    "landmarked/HC_LOWER.ply": False,
    "teeth3ds/014996KX_upper_qem_downsample.ply": True,
    "teeth3ds/gt_KBN31K7D_upper.ply": False,
    "landmarked/AE_UPPER.ply": True,
    "teeth3ds/Q5GSR6N2_lower.ply": False,
}
"""Whether the jaw was looked at while the code was written."""
STUDIES, LARGE_FACES, SPEED_SCANS = 200, 300_000, 120
LEAST_PIECE = 500
"""Places on a piece that is aligned or read."""


def random_motion(rng: np.random.Generator) -> Rigid3:
    """Any rotation, and a shift of some centimetres."""
    return Rigid3.from_quaternion(rng.normal(size=4), rng.normal(0, 40, 3))


def reference_of(path: Path) -> Mesh:
    """The surface near the arch of a jaw, in its occlusal frame."""
    mesh, _ = facing_outwards(storage.read_mesh(path))
    upright = mesh.transformed(find_occlusal_frame(mesh).occlusal_from_mesh)
    return near_curve(upright, arch_curve(Jaw(mesh=upright)).points)


# --- known errors -----------------------------------------------------------------------------------------------------


def known_errors(jaws: Path, work: Path, count: int) -> list[dict[str, Any]]:
    """A row for each jaw and error: what came back beside what was put in."""
    folder = work / "errors"
    truths = {}
    for number, (name, looked_at) in enumerate(islice(JAWS.items(), count)):
        stem = Path(name).stem
        reference = folder / "reference" / f"{stem}.ply"
        if not reference.exists():
            storage.write_mesh(reference, reference_of(jaws / name))
        specimen = load_specimen(stem, reference)
        mesh = storage.read_mesh(reference).transformed(specimen.occlusal_from_file)
        rng = np.random.default_rng(number)
        for error, case in errors(mesh, specimen.curve, rng).items():
            truths[stem, error] = (case, looked_at)
            file = folder / "errors" / stem / f"{error}.ply"
            if not file.exists():
                storage.write_mesh(file, case.scan.transformed(random_motion(rng)))
    options, out = StudyOptions(), work / "errors-out"
    prepared = prepare(folder, out, options, Intake())
    rows = []
    for scan in prepared.scans:
        case, looked_at = truths[scan.specimen, scan.scan]
        specimen = specimen_of(out, scan.specimen)
        common = find_common(specimen, [scan], out / "scans", options)
        found = compare_scan(scan, out / "scans", specimen, common, options)
        row = scan_row(found, common)
        rows.append(
            {
                "jaw": scan.specimen,
                "looked_at": looked_at,
                "error": scan.scan,
                "mean_abs_um": row["mean_abs_um"],
                "true_mean_abs_um": case.truth.mean_abs_um,
                "rms_um": row["rms_um"],
                "true_rms_um": case.truth.rms_um,
                "amplitudes": prepared.records[scan.key]["deformation"]["amplitudes"],
                "true_amplitudes": case.truth.amplitudes,
                "remainder_um": row["remainder_um"],
                "spans_off_um": spans_off_um(specimen, scan.scan, prepared.records[scan.key]["spans"]),
                **({} if case.dent is None else dent_found(specimen, common.places, found.place_um, case.dent)),
            }
        )
    lost = [str(each) for each in prepared.remarks if each.left_out]
    return [*rows, *({"lost": each} for each in lost)]


def spans_off_um(specimen: Specimen, error: str, told: list[Mapping[str, Any]]) -> float | None:
    """Largest difference of a span error from that of the displaced surface itself; None where it is not smooth."""
    smooth = fields(specimen.curve)
    name = error.partition(",")[0]
    if name not in smooth or "noise" in error:
        return None
    moved = smooth[name][1](specimen.places.points)
    middles = {
        specimen.piece_name(piece): [
            each[specimen.piece == piece].mean(axis=0) for each in (specimen.places.points, moved)
        ]
        for piece in specimen.pieces
    }
    off = []
    for span in told:
        (one, one_moved), (other, other_moved) = middles[span["first"]], middles[span["second"]]
        true_um = 1000 * (np.linalg.norm(one_moved - other_moved) - np.linalg.norm(one - other))
        off.append(abs(span["error_um"] - true_um))
    return float(max(off))


def dent_found(
    specimen: Specimen,
    places: np.ndarray,
    place_um: Float[np.ndarray, "p"],
    at: Float[np.ndarray, "3"],
) -> dict[str, float]:
    """Where the deepest place is, and how deep."""
    deepest = int(np.nanargmin(np.where(places, place_um, np.nan)))
    return {
        "dent_off_mm": float(np.linalg.norm(specimen.places.points[deepest] - at)),
        "dent_um": float(place_um[deepest]),
    }


# --- aligned at one end, read at the other ----------------------------------------------------------------------------


def at_one_end(work: Path, count: int) -> list[dict[str, Any]]:
    """How far the last piece of a bent arch lies off, aligned on the first piece; the truth is that of two rigid pieces
    of a chain of links."""
    rows = []
    for name, looked_at in islice(JAWS.items(), count):
        stem = Path(name).stem
        reference = work / "errors" / "reference" / f"{stem}.ply"
        specimen = load_specimen(stem, reference)
        mesh = specimen.mesh
        sizes = [piece for piece in specimen.pieces if np.sum(specimen.piece == piece) > LEAST_PIECE]
        first, last = sizes[0], sizes[-1]
        nearest = specimen.places.points[specimen.piece == first]
        on_first = np.zeros(len(mesh.faces), dtype=bool)
        on_first[specimen.places.faces[specimen.piece == first]] = True
        aligned = replace(specimen, area_faces=on_first)
        for mode in ("spread", "lift", "twist"):
            um = signed_twist(specimen.curve, 100) if mode == "twist" else 100.0
            moved = bent(mesh.vertices, specimen.curve, mode, um)
            file = work / "one-end" / f"{stem} {mode}.ply"
            rng = np.random.default_rng(1)
            storage.write_mesh(file, Mesh(moved, mesh.faces).transformed(random_motion(rng)))
            scan = ScanFile(scanner="s", specimen=stem, scan=mode, path=file)
            told = measure_file(scan, aligned, StudyOptions(align="area")).record
            far = next(each for each in told["shifts"] if each["label"] == specimen.piece_name(last))
            there = specimen.places.points[specimen.piece == last]
            clamp = rigid_between(nearest, bent(nearest, specimen.curve, mode, um)).inverse()
            off = clamp.apply(bent(there, specimen.curve, mode, um)) - there
            rows.append(
                {
                    "jaw": stem,
                    "looked_at": looked_at,
                    "mode": mode,
                    "shift_um": far["shift_um"],
                    "true_shift_um": float(1000 * np.linalg.norm(off.mean(axis=0))),
                }
            )
    return rows


def rigid_between(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]) -> Rigid3:
    """The motion that lays points on others with the smallest sum of squares (Kabsch)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return Rigid3(rotation, target.mean(axis=0) - rotation @ source.mean(axis=0))


# --- intervals --------------------------------------------------------------------------------------------------------


def coverage(studies: int = STUDIES) -> list[dict[str, Any]]:
    """Share of simulated studies whose 95 % intervals hold the truth: means, precision of pairs, and differences of
    scanners, for scanners of known variance."""
    return [
        {"scans": scans, "specimens": specimens, **_covered(scans, specimens, studies)}
        for scans, specimens in ((5, 1), (10, 1), (5, 3), (10, 3))
    ]


def _covered(scans: int, specimens: int, studies: int) -> dict[str, Any]:
    """Scans are smooth random fields and noise over places, about a field of their scanner; specimens shift all."""
    rng = np.random.default_rng([scans, specimens])
    places, modes = 400, 4
    shapes = rng.normal(size=(modes, places))
    spread = {"A": 3.0, "B": 6.0, "C": 9.0}
    bias = {name: rng.normal(0, 8, places) for name in spread}
    truths = {name: _truths(bias[name], shapes, sd) for name, sd in spread.items()}
    held: dict[str, list[bool]] = {"mean": [], "precision": [], "difference": []}
    for _ in range(studies):
        values, names, of = [], [], []
        offsets = rng.normal(0, 2, specimens)
        for name, sd in spread.items():
            groups, pairs = [], []
            for specimen in range(specimens):
                drawn = bias[name] + sd * (rng.normal(size=(scans, modes)) @ shapes) / np.sqrt(modes)
                drawn = drawn + rng.normal(0, sd / 2, (scans, places))
                groups.append(np.abs(drawn).mean(axis=1))
                pairs.append(np.abs(drawn[:, None] - drawn[None]).mean(axis=2))
                values += list(groups[-1] + offsets[specimen])
                names += [name] * scans
                of += [str(specimen)] * scans
            mean, precision = mean_estimate(groups, rng), precision_estimate(pairs)
            held["mean"].append(_holds(mean.low, truths[name][0], mean.high))
            held["precision"].append(_holds(precision.low, truths[name][1], precision.high))
        found = compare_scanners("f", np.array(values), names, of, [None] * len(names), rng)
        for pair in found.contrasts if found is not None else ():
            true = truths[pair.first][0] - truths[pair.second][0]
            held["difference"].append(_holds(pair.difference.low, true, pair.difference.high))
    return {f"{name}_pct": float(100 * np.mean(each)) for name, each in held.items()}


def _truths(bias: Float[np.ndarray, "p"], shapes: Float[np.ndarray, "m p"], sd: float) -> tuple[float, float]:
    """Expected mean |d|, and expected mean |d| of a pair, in closed form: at each place deviations are normal."""
    variance = sd**2 * (np.sum(shapes**2, axis=0) / len(shapes) + 0.25)
    s = np.sqrt(variance)
    folded = s * np.sqrt(2 / np.pi) * np.exp(-(bias**2) / (2 * variance)) + bias * _erf(bias / (s * np.sqrt(2)))
    return float(folded.mean()), float(np.mean(2 * s / np.sqrt(np.pi)))


def _erf(x: Float[np.ndarray, "p"]) -> Float[np.ndarray, "p"]:
    from scipy.special import erf

    return np.asarray(erf(x))


def _holds(low: float | None, value: float, high: float | None) -> bool:
    return low is not None and high is not None and low <= value <= high


# --- scan bodies ------------------------------------------------------------------------------------------------------


def library_body(edge_mm: float) -> Mesh:
    """A cylinder with a bevelled flat, 9 mm high, as the bodies of most makers; finely meshed."""
    from manifold3d import Manifold

    bar = Manifold.cylinder(9.0, 2.2, 1.8, 96)
    flat = Manifold.cube([4.0, 6.0, 4.0]).translate([1.2, -3.0, 5.5])
    made = (bar - flat).refine_to_length(edge_mm).to_mesh()
    return Mesh(np.asarray(made.vert_properties[:, :3], dtype=np.float64), np.asarray(made.tri_verts, dtype=np.int64))


def scan_bodies(count: int = 60, edge_mm: float = 0.25) -> dict[str, Any]:
    """Errors of bodies at known poses, of which a third is missing, with noise of 10 um and gum around the foot."""
    rng = np.random.default_rng(4)
    body = library_body(edge_mm)
    library = SignedDistance(body)
    offsets, axes, lost = [], [], 0
    for _ in range(count):
        pose = Rigid3.from_quaternion(rng.normal(size=4), rng.normal(0, 20, 3))
        scan = _scanned_body(body, pose, rng)
        centre = pose.apply(body.bounds.mean(axis=0)) + rng.normal(0, 0.5, 3)
        up = pose.rotate(np.array([0.0, 0.0, 1.0])) + rng.normal(0, 0.1, 3)
        try:
            found = fit_body(scan, library, centre, up).scan_from_body
        except Exception:
            lost += 1
            continue
        offsets.append(1000 * (found.translation - pose.translation))
        one, other = (each.rotation[:, 2] for each in (found, pose))
        axes.append(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other)))
    return {
        "bodies": count,
        "lost": lost,
        "position_rms_um": float(np.sqrt(np.mean(np.sum(np.square(offsets), axis=1)))),
        "axis_rms_deg": float(np.sqrt(np.mean(np.square(axes)))),
        "position_max_um": float(np.linalg.norm(offsets, axis=1).max()),
    }


def _scanned_body(body: Mesh, pose: Rigid3, rng: np.random.Generator) -> Mesh:
    """What stands 2 mm out of a wavy gum, without a third on one side."""
    noisy = Mesh(body.vertices + rng.normal(0, 0.01, len(body.vertices))[:, None] * body.vertex_normals, body.faces)
    high = noisy.face_centres[:, 2] > 2.0
    turn = rng.uniform(0, 2 * np.pi)
    side = noisy.face_centres[:, :2] @ [np.cos(turn), np.sin(turn)]
    areas = noisy.face_areas * high
    order = np.argsort(side)
    missing = np.zeros(len(side), dtype=bool)
    missing[order[np.cumsum(areas[order]) < areas.sum() / 3]] = True
    kept = noisy.submesh(high & ~missing)
    grid = np.linspace(-8, 8, 60)
    x, y = (each.ravel() for each in np.meshgrid(grid, grid))
    gum = trimesh.Trimesh(*_plane(x, y, 2.0 + 0.3 * np.sin(x) * np.cos(y), 60), process=False)
    outside = np.linalg.norm(gum.triangles_center[:, :2], axis=1) > 2.0
    return Mesh(
        pose.apply(np.concatenate([kept.vertices, gum.vertices])),
        np.concatenate([kept.faces, gum.faces[outside] + len(kept.vertices)]),
    )


def _plane(x: np.ndarray, y: np.ndarray, z: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    corner = np.arange(side * side).reshape(side, side)[:-1, :-1].ravel()
    one = np.stack([corner, corner + 1, corner + side], axis=1)
    other = np.stack([corner + 1, corner + side + 1, corner + side], axis=1)
    return np.stack([x, y, z], axis=1), np.concatenate([one, other])


# --- CloudCompare -----------------------------------------------------------------------------------------------------


def beside_cloudcompare(work: Path) -> list[dict[str, Any]]:
    """Deviations of ten scans from their references, as they were aligned: cuspid's and CloudCompare's."""
    folder, out = work / "errors", work / "errors-out"
    prepared = prepare(folder, out, StudyOptions(), Intake())
    wanted = ("mixed, noise 10 um", "lift +200 um", "dent 100 um")
    chosen = [scan for scan in prepared.scans if scan.scan in wanted][:10]
    rows = []
    for scan in chosen:
        specimen = specimen_of(out, scan.specimen)
        pose = Rigid3.from_matrix(np.array(prepared.records[scan.key]["reference_from_scan"]))
        mesh = storage.read_mesh(scan.path).transformed(pose @ specimen.occlusal_from_file)
        points, _ = mesh.sample(20_000, np.random.default_rng(0))
        closest = SignedDistance(specimen.mesh).closest_points(points)
        ours = 1000 * np.abs(closest.signed_mm)
        theirs = 1000 * distances_by_cloudcompare(points, specimen.mesh)
        rows.append(
            {
                "scan": scan.name,
                "mean_um": float(ours.mean()),
                "cloudcompare_mean_um": float(theirs.mean()),
                "apart_rms_um": float(np.sqrt(np.mean((ours - theirs) ** 2))),
                "apart_max_um": float(np.abs(ours - theirs).max()),
            }
        )
    return rows


# --- speed ------------------------------------------------------------------------------------------------------------


def speed(jaws: Path, work: Path) -> dict[str, Any]:
    """Time and memory of `SPEED_SCANS` scans of `LARGE_FACES` faces by the command line, from nothing to the page."""
    folder, out = work / "speed", work / "speed-out"
    fine = reference_of(jaws / next(iter(JAWS)))
    while len(fine.faces) < LARGE_FACES:
        fine = Mesh(*map(np.asarray, trimesh.remesh.subdivide(fine.vertices, fine.faces)))
    fine = fine.simplified(LARGE_FACES)
    storage.write_mesh(folder / "reference" / "jaw.stl", fine)
    rng = np.random.default_rng(0)
    for scanner in ("A", "B"):
        for k in range(SPEED_SCANS // 2):
            noisy = Mesh(fine.vertices + rng.normal(0, 0.008, fine.vertices.shape), fine.faces)
            storage.write_mesh(folder / scanner / "jaw" / f"{k}.stl", noisy.transformed(random_motion(rng)))
    subprocess.run(["rm", "-rf", str(out)], check=True)
    begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "cuspid", "study", "scanners", str(folder), "--out", str(out)]
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    most_kib = 0
    while running.poll() is None:
        most_kib = max(most_kib, memory_kib(running.pid))
        time.sleep(0.2)
    if running.returncode:
        raise SystemExit(f"{' '.join(command)} ended with status {running.returncode}")
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    wall_s = time.perf_counter() - begin
    return {
        "scans": SPEED_SCANS,
        "faces": len(fine.faces),
        "wall_s": wall_s,
        "cpu_s": used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime,
        "all_processes_gib": most_kib / 2**20,
        "cores": len(os.sched_getaffinity(0)),
        "load": os.getloadavg()[1],
        "commit": conditions()["commit"],
    }


def memory_kib(pid: int) -> int:
    """Memory of a process and of all that it started, what they share counted once (Linux)."""
    home = Path("/proc") / str(pid)
    try:
        told = (home / "smaps_rollup").read_text()
        children = [int(child) for task in home.glob("task/*/children") for child in task.read_text().split()]
    except OSError:  # it has ended
        return 0
    own = int(told.partition("Pss:")[2].split()[0]) if "Pss:" in told else 0
    return own + sum(map(memory_kib, children))


def main() -> None:
    """Measure the parts that are asked for, or all; those that were measured before are kept."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("jaws", type=Path)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/study.json"))
    parser.add_argument("--part", nargs="+")
    parser.add_argument(
        "--count", type=int, default=len(JAWS), help="so many of the jaws, looked at and held out in turn"
    )
    options = parser.parse_args()
    parts: dict[str, Callable[[], Any]] = {
        "errors": lambda: known_errors(options.jaws, options.work, options.count),
        "one_end": lambda: at_one_end(options.work, options.count),
        "coverage": coverage,
        "bodies": scan_bodies,
        "cloudcompare": lambda: beside_cloudcompare(options.work),
        "speed": lambda: speed(options.jaws, options.work),
    }
    found = {}
    for name, measure in parts.items():
        kept = options.work / f"{name}.json"
        if (options.part is None and not kept.exists()) or (options.part is not None and name in options.part):
            storage.write_json(kept, measure())
        if kept.exists():
            found[name] = json.loads(kept.read_text())
    if parts.keys() - found.keys() <= {"speed"}:  # which a busy machine does not tell
        options.out.write_text(json.dumps({**found, **conditions()}, indent=1) + "\n")


if __name__ == "__main__":
    main()
