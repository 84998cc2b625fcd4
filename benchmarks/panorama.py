"""Measure panoramas of ten subjects filmed by a shaky hand, by cuspid's methods and by OpenCV's Stitcher.

    python benchmarks/panorama.py --out benchmarks/results/panorama [--jaws FILE_OR_FOLDER ...] [--work FOLDER]
        [--subject lower-14-0 ...] [--films-only]
        [--method ortho cusps callipers return s-shape cross natural natural-return pair thesis
                  thesis-unexamined opencv-panorama opencv-scans]

Subjects are phantoms of the population, and jaws of your own, whose coarse faces are subdivided (Loop) first; the
subdivided mesh is then the reference. All are filmed in 120 frames with full shake and the texture ``enamel``, for the
method ``pair`` by two cameras, for ``return``, ``s-shape`` and ``cross`` on another way over the arch (``cross`` needs
surface between its sides), for ``natural`` with the texture of that name, for ``natural-return`` with both.
``callipers`` is told the width of the true arch over its teeth, read to half a millimetre; ``cusps`` scales the
panorama of ``ortho``, which is to be made before, by the distance between two cusps of the first molars, read to half a
millimetre, each clicked on 0.1 mm (one standard deviation) beside it. One JSON a subject and method goes to the results
folder; what is there already is not made again.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from collections.abc import Callable, Mapping
from itertools import product
from pathlib import Path

import igl
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from run import conditions, run_program, run_timed

from cuspid import storage
from cuspid.anatomy.jaw_files import jaw_files, load_jaw
from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.anatomy.phantom.population import GroupName, draw_population
from cuspid.evaluation.panorama import PanoramaEvaluationOptions, TracedPixels, trace_pixels
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.mesh import Mesh, edges_of

PHANTOMS: tuple[tuple[GroupName, int], ...] = (
    ("lower-14", 3),
    ("upper-14", 3),
    ("lower-12", 2),
    ("upper-12", 2),
)
"""Groups of the population and how many jaws of each."""
EDGE_MM = 0.25
"""Edge of the phantoms' faces, and about that to which other jaws are subdivided."""
FEWEST_FRAMES_PCT = PanoramaEvaluationOptions().min_frames_pct
CLICK_MM, TRACED = 0.1, 300_000
"""How far beside a cusp one clicks (one standard deviation), and of how many pixels the cusps are those of."""
SUPERSAMPLING = 1
"""Rays through a pixel along each side."""


def phantoms() -> dict[str, PhantomOptions]:
    """The phantoms by name."""
    drawn = {
        group: draw_population(group, count, np.random.default_rng(0), PhantomOptions(edge_mm=EDGE_MM))
        for group, count in PHANTOMS
    }
    return {f"{group}-{number}": jaw for group, jaws in drawn.items() for number, jaw in enumerate(jaws)}


def real_jaw(path: Path) -> Jaw:
    """A user's jaw with smooth faces, labelled where its file tells the teeth."""
    jaw, _ = load_jaw(path, arch="lower" if "lower" in path.stem else "upper")
    smooth, labels = subdivided(jaw.mesh), jaw.face_labels
    if labels is not None:
        labels = labels[jaw.mesh.closest(smooth.face_centres)[1]]
    return Jaw(mesh=smooth, face_labels=labels, arch=jaw.arch)


def subdivided(mesh: Mesh) -> Mesh:
    """The Loop surface, refined until its edges are as short as the phantoms' are."""
    edges = np.linalg.norm(np.diff(mesh.vertices[mesh.faces], axis=1), axis=2)
    rounds = max(0, round(float(np.log2(np.median(edges) / EDGE_MM))))
    if rounds == 0:
        return mesh
    # trimesh's subdivision throws the open edge of a scan up to 10 mm outwards; libigl's ends the process where more
    # than two faces meet at an edge.
    _, edge, sharing = np.unique(np.sort(edges_of(mesh.faces), axis=1), axis=0, return_inverse=True, return_counts=True)
    clean = mesh.submesh(np.asarray((sharing[edge].reshape(-1, 3) <= 2).all(axis=1)))
    return Mesh(*igl.loop(clean.vertices, clean.faces, rounds))


def film(name: str, source: PhantomOptions | Path, folder: Path, seed: int, made: str) -> None:
    """Make the subject and a film of it, unless they are there."""
    jaw = folder / "jaw.ply"
    if not jaw.with_suffix(".json").exists():
        storage.write_jaw(jaw, build_phantom(source) if isinstance(source, PhantomOptions) else real_jaw(source))
    if not (folder / made / "truth" / "shot" / "view.json").exists():
        timed = run_timed(*film_command(jaw, folder / made, seed, *FILMS[made]))
        print(f"{name}: {made} in {timed['wall_s']} s", flush=True)


FILMS: Mapping[str, tuple[str, ...]] = {
    "film": (),
    "film-pair": ("--camera.cameras", "2"),
    "film-return": ("--path", "return"),
    "film-s-shape": ("--path", "s-shape"),
    "film-cross": ("--path", "cross"),
    "film-natural": ("--texture", "natural"),
    "film-natural-return": ("--texture", "natural", "--path", "return"),
}
"""Films of a subject, and by which options."""


def film_of(method: str) -> str:
    """The film that a method takes."""
    own = f"film-{method}"
    return own if own in FILMS else "film"


def film_command(jaw: Path, out: Path, seed: int, *options: str) -> list[str]:
    """The arguments that film a subject."""
    numbers = ("--seed", str(seed), "--supersampling", str(SUPERSAMPLING))
    return ["pano", "film", str(jaw), "--out", str(out), *numbers, *options]


def measure(name: str, method: str, folder: Path, limit_s: int) -> dict[str, object]:
    """Stitch a film by a method through its command line, and evaluate the panorama."""
    out, filmed = folder / method, folder / film_of(method)
    command = METHODS[method](filmed / "capture", out, limit_s)
    status, figures = run_program(*command)
    score, failure = None, given_up(status, limit_s) if status else unmade(out)
    if failure is None:
        made = out if (out / "panorama.json").exists() else first_part(out)
        run_timed("pano", "evaluate", str(made), str(filmed / "truth"), "--out", str(folder / f"{method}-score"))
        score = json.loads((folder / f"{method}-score" / "score.json").read_text())
    placed = out / "result.json"
    return {
        "subject": name,
        "method": method,
        "command": " ".join([Path(command[0]).name, *(Path(part).name for part in command[1:])]),
        "frames_to_panorama": figures,
        "load_before": round(os.getloadavg()[0], 1),
        "failure": failure or (score or {}).get("failure"),
        "opencv": json.loads(placed.read_text()) if placed.exists() else None,
        "score": score,
        **conditions(),
    }


def given_up(status: int, limit_s: int) -> str:
    """Why a program ended without a result."""
    return f"given up after {limit_s} s of CPU" if status == -signal.SIGXCPU else f"ended with status {status}"


def unmade(out: Path) -> str | None:
    """Why there is no panorama of OpenCV's to evaluate, or None."""
    if not (out / "result.json").exists():
        return None
    result = json.loads((out / "result.json").read_text())
    if result["status"] != "ok":
        return str(result["status"])
    placed, frames = len(result["placed"]), result["frames"]
    return f"only {placed} of {frames} frames are placed" if 100 * placed < FEWEST_FRAMES_PCT * frames else None


def first_part(out: Path) -> Path:
    """Of a panorama in parts the first and largest; of another program's, its picture."""
    return out / "part-1" if (out / "part-1").is_dir() else out / "panorama.png"


def stitched(*options: str) -> Callable[[Path, Path, int], list[str]]:
    """The command of a method of cuspid."""
    return lambda capture, out, _: [*CUSPID, "pano", "stitch", str(capture), "--method", *options, "--out", str(out)]


def measured_across(capture: Path, out: Path, limit_s: int) -> list[str]:
    """The command of one who has measured the width of the arch."""
    return [*stitched("ortho")(capture, out, limit_s), "--scale.width-mm", f"{calliper_mm(capture.parents[1])}"]


def calliper_mm(folder: Path) -> float:
    """Greatest width of a subject over its teeth, as callipers tell it."""
    jaw = storage.read_jaw(folder / "jaw.ply")
    teeth = jaw.mesh.faces if jaw.face_labels is None else jaw.mesh.faces[jaw.face_labels != GUM]
    return round(2 * float(np.ptp(jaw.mesh.vertices[teeth, 0]))) / 2


def scaled_by_cusps(capture: Path, out: Path, limit_s: int) -> list[str]:
    """The command of one who has measured between the highest cusps of the first molars, and clicks on them."""
    folder = capture.parents[1]
    panorama = storage.read_panorama(folder / "ortho")
    traced = trace_pixels(panorama, storage.read_truth(folder / "film" / "truth"), TRACED)
    shown = [cusp(traced, tooth) for tooth in molars(traced)]
    true_mm = np.linalg.norm(np.diff(traced.true_mm[shown], axis=0))
    pixels = panorama.pixels_from_world(traced.placed[shown])
    beside_px = CLICK_MM / panorama.mm_per_px * np.random.default_rng(len(traced.labels)).normal(size=(2, 2))  # type: ignore[operator]
    measured = (*(f"{each:.0f}" for each in (pixels + beside_px).ravel()), f"{round(2 * true_mm) / 2}")
    return [*CUSPID, "pano", "rescale", str(folder / "ortho"), "--distance", *measured, "--out", str(out)]


def molars(traced: TracedPixels) -> tuple[int, int]:
    """The first molars of both sides, otherwise the second, of the jaw that is shown."""
    there = set(traced.labels.tolist())
    pairs = ((quadrant + tooth, quadrant + 10 + tooth) for tooth in (6, 7) for quadrant in (10, 30))
    return next(pair for pair in pairs if there.issuperset(pair))


def cusp(traced: TracedPixels, tooth: int) -> int:
    """The highest of the pixels that show a tooth."""
    return int(np.argmax(np.where(traced.labels == tooth, traced.true_mm[:, 2], -np.inf)))


def opencv(mode: str) -> Callable[[Path, Path, int], list[str]]:
    """The command of a mode of OpenCV's Stitcher."""
    script = str(Path(__file__).with_name("opencv_stitcher.py"))
    return lambda capture, out, limit_s: [
        *(sys.executable, script, str(capture), "--mode", mode, "--out", str(out), "--cpu-s", str(limit_s))
    ]


CUSPID = (sys.executable, "-m", "cuspid")
METHODS: Mapping[str, Callable[[Path, Path, int], list[str]]] = {
    "ortho": stitched("ortho"),
    "cusps": scaled_by_cusps,
    "callipers": measured_across,
    **dict.fromkeys(("pair", "return", "s-shape", "cross", "natural", "natural-return"), stitched("ortho")),
    "thesis": stitched("thesis"),
    "thesis-unexamined": stitched("thesis", "--no-examination"),
    "opencv-panorama": opencv("panorama"),
    "opencv-scans": opencv("scans"),
}


def named_jaws(given: list[Path]) -> dict[str, Path]:
    """The jaws of files and folders by name."""
    return {path.stem: path for each in given for path in jaw_files(each)}


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/panorama"))
    parser.add_argument("--work", type=Path, default=Path("build/panorama"))
    parser.add_argument("--jaws", type=Path, nargs="*", default=[], help="files or folders of your own jaws")
    parser.add_argument("--subject", nargs="*", help="names; default: all")
    parser.add_argument("--method", nargs="*", choices=METHODS, default=["ortho"], help="in this order")
    parser.add_argument("--films-only", action="store_true")
    parser.add_argument("--cpu-s", type=int, default=180, help="after which OpenCV's Stitcher is given up")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    subjects: Mapping[str, PhantomOptions | Path] = {**phantoms(), **named_jaws(options.jaws)}
    wanted = [name for name in subjects if not options.subject or name in options.subject]
    for name, made in product(wanted, sorted({film_of(method) for method in options.method})):
        film(name, subjects[name], options.work / name, list(subjects).index(name), made)
    for method, name in product([] if options.films_only else options.method, wanted):
        path = options.out / f"{name}-{method}.json"
        if not path.exists():
            result = measure(name, method, options.work / name, options.cpu_s)
            storage.write_json(path, result)
            print(f"{name}, {method}: {result['failure'] or 'made'} {result['frames_to_panorama']}", flush=True)


if __name__ == "__main__":
    main()
