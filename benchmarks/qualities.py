"""Time, memory and trueness of each ``--quality`` over a whole arch, on one core and on more, and time of each stage.

    python benchmarks/qualities.py [JAW] [--work build/qualities] [--quality standard ...] [--cores 1 2 ...]

JAW is a mesh of a whole arch; without it the built-in phantom. It is scanned once, in one pass of 100 frames or more;
then every quality reconstructs all of it on all cores that this process may use, and on one of them (but fine, which
would take half an hour there), or on the numbers of cores that are asked for. Nothing else should run meanwhile. The
first run compiles, and is not counted. The file of results is written after each run.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import get_args

from run import conditions, run_program, run_timed

from cuspid.pipeline.scan import Quality
from cuspid.runtime.workers import core_numbers
from cuspid_thesis.scan_cases import ONE_PASS

HERE = Path(__file__).parent
Known = dict[str, dict[str, object]]
"""The trueness of meshes by the SHA-256 of their file."""


@contextmanager
def only(cores: list[int]) -> Iterator[None]:
    """This process, and those that it starts, run on these cores."""
    before = core_numbers()
    os.sched_setaffinity(0, cores)
    yield
    os.sched_setaffinity(0, before)


def measured(scan: Path, quality: str, cores: list[int], log: Path, known: Known) -> dict[str, object]:
    """The figures of one reconstruction, from the images to the mesh. What is known of equal meshes is not found again,
    and this one is added."""
    out, stages = scan.parent / f"{quality}-{len(cores)}", scan.parent / "stages.json"
    shutil.rmtree(out, ignore_errors=True)
    arguments = ["reconstruct", str(scan / "capture"), "--quality", quality, "--out", str(out)]
    with only(cores), log.open("ab") as stream:
        status, took = run_program(sys.executable, str(HERE / "staged.py"), str(stages), *arguments, log=stream)
    if status:
        raise SystemExit(f"cuspid {' '.join(arguments)}: status {status}, see {log}")
    digest = sha256((out / "mesh.ply").read_bytes()).hexdigest()
    if digest not in known:
        run_timed("evaluate", str(out / "mesh.ply"), str(scan / "truth"), "--out", str(out), log=log)
        known[digest] = json.loads((out / "trueness.json").read_text())
    row = {
        "quality": quality,
        "cores": len(cores),
        **took,
        "stages": json.loads(stages.read_text()),
        "motion_s": json.loads((out / "motion" / "reconstruction.json").read_text())["log"],
        "trueness": known[digest],
        "mesh_sha256": digest,
    }
    shutil.rmtree(out)
    return row


def main() -> None:
    """Scan, measure, and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("jaw", nargs="?", type=Path)
    parser.add_argument("--work", type=Path, default=Path("build/qualities"))
    parser.add_argument("--out", type=Path, default=HERE / "results" / "qualities.json")
    parser.add_argument("--quality", nargs="+", choices=get_args(Quality), default=get_args(Quality))
    parser.add_argument("--cores", nargs="+", type=int, help="numbers of cores; default: all and one")
    options = parser.parse_args()
    cores, known = core_numbers(), Known()
    if options.cores and not all(1 <= count <= len(cores) for count in options.cores):
        parser.error(f"--cores: this process may use 1 to {len(cores)}")
    scan, log = options.work / "scan", options.work / "log.txt"
    options.work.mkdir(parents=True, exist_ok=True)
    jaw = [] if options.jaw is None else [str(options.jaw)]
    run_timed("simulate", *jaw, *ONE_PASS, "--out", str(scan), log=log)
    measured(scan, "draft", cores, log, known)
    begun = conditions()  # the load before, not that of the runs
    images = len(list((scan / "capture" / "images").rglob("*.png")))
    rows: list[dict[str, object]] = []
    for quality in options.quality:
        for count in options.cores or (sorted({len(cores), 1}, reverse=True) if quality != "fine" else [len(cores)]):
            rows.append(measured(scan, quality, cores[:count], log, known))
            print({name: rows[-1][name] for name in ("quality", "cores", "wall_s", "cpu_s", "peak_gib")}, flush=True)
            jaw_name = "phantom" if options.jaw is None else options.jaw.stem
            found = {"jaw": jaw_name, "images": images, "rows": rows, **begun}
            options.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
