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
from importlib.metadata import version
from pathlib import Path

PACKAGES = ("cuspid", "numpy", "numba", "opencv-contrib-python-headless", "pycolmap", "embreex", "libigl")


def run_timed(*arguments: str) -> dict[str, float]:
    """Run ``cuspid``; wall seconds, CPU seconds and peak memory in GiB."""
    begin = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "cuspid", *arguments])
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - begin
    if status:
        raise SystemExit(f"cuspid {' '.join(arguments)} failed with status {os.waitstatus_to_exitcode(status)}")
    return {
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


def measure(name: str, seed: int, simulate: list[str], work: Path, motion: str = "rig") -> dict[str, object]:
    """Simulate once, then time images to mesh, then evaluate."""
    folder = work / name
    shared = [*simulate, "--seed", str(seed)]
    run_timed("simulate", *shared, "--out", str(folder))
    for stage in ("depth", "depth-between", "motion"):
        shutil.rmtree(folder / stage, ignore_errors=True)
    (folder / "mesh.ply").unlink(missing_ok=True)
    reconstruct = ["reconstruct", str(folder / "capture"), "--out", str(folder), "--motion", motion]
    reconstructed = run_timed(*reconstruct)
    run_timed("evaluate", str(folder / "mesh.ply"), str(folder / "truth"), "--out", str(folder))
    return {
        "case": name,
        "seed": seed,
        "commands": [
            f"cuspid simulate {' '.join(Path(argument).name for argument in shared)} --out {name}",
            f"cuspid reconstruct {name}/capture --out {name} --motion {motion}",
        ],
        "threads": os.cpu_count(),
        "options": json.loads((folder / "run.json").read_text()),
        "images_to_mesh": reconstructed,
        "reconstruction": json.loads((folder / "motion" / "reconstruction.json").read_text())["log"],
        "trueness": json.loads((folder / "trueness.json").read_text()),
        **conditions(),
    }


def cases(jaw: Path | None) -> dict[str, tuple[int, list[str]]]:
    """The cases of the bars: three seeds of a molar, the arch, and a user's own arch."""
    table: dict[str, tuple[int, list[str]]] = {
        f"molar-seed{seed}": (seed, ["--tooth", "46", "--jaw-seed", str(seed)]) for seed in range(3)
    }
    table["arch"] = (0, [])
    if jaw is not None:
        table["real-arch"] = (0, [str(jaw)])
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
    for name, (seed, simulate) in cases(options.jaw).items():
        path = options.out / f"{name}.json"
        if path.exists() or (options.case and not any(name.startswith(case) for case in options.case)):
            continue
        result = measure(name, seed, simulate, options.work)
        path.write_text(json.dumps(result, indent=1) + "\n")
        print(f"{name}: {result['images_to_mesh']}")


if __name__ == "__main__":
    main()
