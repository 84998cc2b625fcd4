"""Measure accuracy and speed as a user would see them: every stage is a run of the command line.

    python benchmarks/run.py --out benchmarks/results [--case molar arch] [--jaw JAW.ply] [--work FOLDER]

One JSON per run goes to the results folder; ``benchmarks/page.py`` makes docs/benchmarks.md from them. A case that has
its JSON already is not run again; delete the file to repeat it.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

PACKAGES = ("cuspid", "numpy", "numba", "opencv-contrib-python-headless", "pycolmap", "embreex", "libigl")


def run_timed(*arguments: str) -> dict[str, float]:
    """Run ``cuspid``; wall seconds, CPU seconds and peak memory in GiB."""
    status, figures = timed(sys.executable, "-m", "cuspid", *arguments)
    if status:
        raise SystemExit(f"cuspid {' '.join(arguments)} failed with status {status}")
    return figures


def timed(*command: str) -> tuple[int, dict[str, float]]:
    """Run a program; its exit status, wall seconds, CPU seconds and peak memory in GiB."""
    begin = time.perf_counter()
    process = subprocess.Popen(command)
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - begin
    return os.waitstatus_to_exitcode(status), {
        "wall_s": round(seconds, 1),
        "cpu_s": round(usage.ru_utime + usage.ru_stime, 1),
        "peak_gib": round(usage.ru_maxrss / 2**20, 2),
    }


def commit() -> str:
    """The commit that is measured, marked where the work tree differs from it."""
    description = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--abbrev=12"], capture_output=True, text=True, check=True
    )
    return description.stdout.strip()


def conditions() -> dict[str, object]:
    """What a figure depends on besides the code."""
    return {
        "commit": commit(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in PACKAGES},
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
    }


@dataclass(frozen=True, kw_only=True)
class Case:
    """One scan that is measured."""

    seed: int = 0
    """Of texture, hand and noise."""
    jaw: str | None = None
    """Name of the jaw file in the work folder, or a path; None for the built-in phantom."""
    make: tuple[str, ...] = ()
    """The command that makes that jaw, without --out."""
    simulate: tuple[str, ...] = ()
    """More arguments of ``cuspid simulate``."""


def measure(name: str, case: Case, work: Path, motion: str = "rig") -> dict[str, object]:
    """Simulate once, then time images to mesh, then evaluate."""
    folder = work / name
    work.mkdir(parents=True, exist_ok=True)
    jaw = [] if case.jaw is None else [str(work / case.jaw)]
    if case.make and not Path(jaw[0]).exists():
        run_timed(*case.make, "--out", jaw[0])
    shared = [*jaw, *case.simulate, "--seed", str(case.seed)]
    run_timed("simulate", *shared, "--out", str(folder))
    for stage in ("depth", "depth-between", "motion"):
        shutil.rmtree(folder / stage, ignore_errors=True)
    (folder / "mesh.ply").unlink(missing_ok=True)
    reconstruct = ["reconstruct", str(folder / "capture"), "--out", str(folder), "--motion", motion]
    reconstructed = run_timed(*reconstruct)
    run_timed("evaluate", str(folder / "mesh.ply"), str(folder / "truth"), "--out", str(folder))
    return {
        "case": name,
        "seed": case.seed,
        "commands": [
            *([f"cuspid {' '.join(case.make)} --out {case.jaw}"] if case.make else []),
            f"cuspid simulate {' '.join(Path(argument).name for argument in shared)} --out {name}",
            f"cuspid reconstruct {name}/capture --out {name} --motion {motion}",
        ],
        "threads": os.cpu_count(),
        "options": json.loads((folder / "run.json").read_text()),
        "images_to_mesh": reconstructed,
        "reconstruction": json.loads((folder / "motion" / "reconstruction.json").read_text())["log"],
        **{
            part: json.loads((folder / f"{part}.json").read_text())
            for part in ("trueness", "spheres", "margins")
            if (folder / f"{part}.json").exists()
        },
        **conditions(),
    }


PREPARED = (46, 45, 42, 36, 35)
"""Teeth of the thesis' reference model (Fig. 3.20), in the order B to F of its Table 3.2: cracked, crown, full-contour
crown, and two inlays (F and E)."""


def cases(jaw: Path | None) -> dict[str, Case]:
    """Three seeds of a molar, the arch, a user's own arch, the sphere arch, and the thesis' reference model."""
    table = {
        f"molar-seed{seed}": Case(seed=seed, simulate=("--tooth", "46", "--jaw-seed", str(seed))) for seed in range(3)
    }
    table["arch"] = Case()
    if jaw is not None:
        table["real-arch"] = Case(jaw=str(jaw.resolve()))
    table["spheres"] = Case(jaw="spheres.ply", make=("phantom", "--spheres"))
    prepare = ("prepare", "--preset", "thesis-reference")
    for tooth in PREPARED:
        table[f"prepared-{tooth}"] = Case(jaw="thesis-reference.ply", make=prepare, simulate=("--tooth", str(tooth)))
    table["prepared-arch"] = Case(jaw="thesis-reference.ply", make=prepare)
    return table


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--work", type=Path, default=Path("build/benchmarks"))
    parser.add_argument("--case", nargs="*", help="names or beginnings of names; default: all")
    parser.add_argument("--jaw", type=Path, help="a real full-arch scan for the case real-arch")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name, case in cases(options.jaw).items():
        path = options.out / f"{name}.json"
        if path.exists() or (options.case and not any(name.startswith(asked) for asked in options.case)):
            continue
        result = measure(name, case, options.work)
        path.write_text(json.dumps(result, indent=1) + "\n")
        print(f"{name}: {result['images_to_mesh']}")


if __name__ == "__main__":
    main()
