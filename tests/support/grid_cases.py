"""Functions that the tests of the grid run in other processes."""

import multiprocessing
import os
import signal
import sys
import time
from pathlib import Path

from cuspid.runtime.errors import ReconstructionError
from cuspid.studies.grid import Case, run_grid


def square(x: int) -> dict[str, float]:
    return {"square_mm2": float(x * x)}


def square_unless(x: int) -> dict[str, float]:
    """Refuses 2, is killed by 3, breaks on 0, and is slow with 5."""
    if x == 2:
        raise ReconstructionError("no surface: the images need texture")
    if x == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    if x == 5:
        time.sleep(1.0)
    return {"square_mm2": x * x * x / x}


def starts_a_child(x: int) -> dict[str, float]:
    """As a pipeline does that finds more than one core."""
    cores = os.sched_getaffinity(0)
    if len(cores) > 1:
        multiprocessing.get_context("fork").Process(target=print).start()
    time.sleep(0.3)
    return {"core": float(min(cores))}


def leaves_a_mark(x: int, folder: str) -> dict[str, float]:
    with (Path(folder) / "calls").open("a") as stream:
        stream.write(f"{x}\n")
    return {"y": float(x)}


def is_killed_once(x: int, folder: str) -> dict[str, float]:
    """Takes its worker along the first time that x is 2."""
    first = Path(folder) / "first"
    if x == 2 and not first.exists():
        first.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return {"y": float(10 * x)}


def takes_long(folder: str) -> dict[str, float]:
    mark = Path(folder) / "process"
    mark.with_suffix(".new").write_text(str(os.getpid()))
    mark.with_suffix(".new").rename(mark)
    time.sleep(120)
    return {}


if __name__ == "__main__":
    run_grid([Case(name="long", parameters={"folder": sys.argv[1]})], takes_long, Path(sys.argv[1]), workers=1)
