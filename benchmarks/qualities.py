"""Time, memory and trueness of each ``--quality`` over a whole arch, on one core and on two, and time of each stage.

    python benchmarks/qualities.py [JAW] [--work build/qualities]

JAW is a mesh of a whole arch; without it the built-in phantom. It is scanned once, in one pass of 100 frames or more;
then every quality reconstructs all of it on all cores that this process may use, and on one of them (but fine, which
would take half an hour there). Nothing else should run meanwhile. The first run compiles, and is not counted.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import get_args

from run import conditions, run_timed, timed

from cuspid.pipeline import Quality
from cuspid.studies.scan_cases import ONE_PASS
from cuspid.workers import core_numbers

HERE = Path(__file__).parent


@contextmanager
def only(cores: list[int]) -> Iterator[None]:
    """This process, and those that it starts, run on these cores."""
    before = core_numbers()
    os.sched_setaffinity(0, cores)
    yield
    os.sched_setaffinity(0, before)


def measured(scan: Path, quality: str, cores: list[int], log: Path) -> dict[str, object]:
    """The figures of one reconstruction, from the images to the mesh."""
    out, stages = scan.parent / f"{quality}-{len(cores)}", scan.parent / "stages.json"
    shutil.rmtree(out, ignore_errors=True)
    arguments = ["reconstruct", str(scan / "capture"), "--quality", quality, "--out", str(out)]
    with only(cores), log.open("ab") as stream:
        status, took = timed(sys.executable, str(HERE / "staged.py"), str(stages), *arguments, log=stream)
    if status:
        raise SystemExit(f"cuspid {' '.join(arguments)}: status {status}, see {log}")
    run_timed("evaluate", str(out / "mesh.ply"), str(scan / "truth"), "--out", str(out), log=log)
    row = {
        "quality": quality,
        "cores": len(cores),
        **took,
        "stages": json.loads(stages.read_text()),
        "motion_s": json.loads((out / "motion" / "reconstruction.json").read_text())["log"],
        "trueness": json.loads((out / "trueness.json").read_text()),
    }
    shutil.rmtree(out)
    return row


def main() -> None:
    """Scan, measure, and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("jaw", nargs="?", type=Path)
    parser.add_argument("--work", type=Path, default=Path("build/qualities"))
    parser.add_argument("--out", type=Path, default=HERE / "results" / "qualities.json")
    options = parser.parse_args()
    scan, log = options.work / "scan", options.work / "log.txt"
    options.work.mkdir(parents=True, exist_ok=True)
    jaw = [] if options.jaw is None else [str(options.jaw)]
    run_timed("simulate", *jaw, *ONE_PASS, "--out", str(scan), log=log)
    cores = core_numbers()
    measured(scan, "draft", cores, log)
    begun = conditions()  # the load before, not that of the runs
    rows = []
    for quality in get_args(Quality):
        for some in (cores, cores[:1]) if len(cores) > 1 and quality != "fine" else (cores,):
            rows.append(measured(scan, quality, some, log))
            print({name: rows[-1][name] for name in ("quality", "cores", "wall_s", "cpu_s", "peak_gib")}, flush=True)
    images = len(list((scan / "capture" / "images").rglob("*.png")))
    found = {"jaw": "phantom" if options.jaw is None else options.jaw.stem, "images": images, "rows": rows, **begun}
    options.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
