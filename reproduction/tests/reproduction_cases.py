"""Runs that take no time, or wait: the processes of the grid import this file, too, where it is the program."""

import sys
from pathlib import Path

from cuspid_thesis import runs
from cuspid_thesis.catalogue import BY_ID
from cuspid_thesis.runs import Run, gather, missing, run_missing
from cuspid_thesis.scan_cases import run_program

ITEMS = (BY_ID["fig-2.2"], BY_ID["fig-3.15"])
POPULATIONS = {"groups": {"lower-14": {"max_abs_asked_minus_measured_mm": 0.001}}}
SEEN = [{"surface": name, "seen_by_2_pct": 99.0} for name in ("occlusal", "buccal", "lingual")]


def at_once(task):
    with (task.folder / "calls").open("a") as stream:
        stream.write("populations\n")
    yield "populations", POPULATIONS


PROGRAM = """
import os, sys, time
from pathlib import Path
folder = Path(sys.argv[1])
(folder / "new").write_text(str(os.getpid()))
(folder / "new").rename(folder / "waiting")
while not (folder / "go").exists():
    time.sleep(0.02)
"""


def waits(task):
    run_program(sys.executable, "-c", PROGRAM, str(task.folder))
    yield "visibility", {"surfaces": {"twelve-cameras": SEEN}}


def fails(task):
    yield "visibility", {"surfaces": 1 / 0}


def table(second):
    return {
        "populations": Run(makes=("populations",), make=at_once, minutes=2.0),
        "visibility": Run(makes=("visibility",), make=second, minutes=1.0),
    }


runs.RUNS = table(fails if len(sys.argv) > 2 and sys.argv[2] == "fails" else waits)

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    wanted = missing(ITEMS, gather(folder, None), quick=False)
    wanted = {name: names for name, names in wanted.items() if name in runs.RUNS}
    print(run_missing(folder, wanted, quick=False, workers=1))
