"""``cuspid`` with a clock about each stage of a reconstruction, for ``qualities.py``.

    python benchmarks/staged.py TIMES.json reconstruct CAPTURE --out OUT

Motion times its own stages; of the others, each is a function of :mod:`cuspid.pipeline.scan`. What is left, the start
of the program, reading and pictures, is told as one. With each goes the peak of memory until its end.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

BEGIN = time.perf_counter()
FUNCTIONS = {
    "locate": "motion",
    "measure_enough_depth": "depth",
    "find_holes": "holes",
    "measure_depth_across": "depth across frames",
    "fuse": "fusion and cleaning",
}
"""Of the pipeline, and the stages that they are."""


def main() -> None:
    """Run, and write wall seconds and peak memory (GiB, up to its end) of each stage."""
    times, *arguments = sys.argv[1:]
    from cuspid.__main__ import main as cuspid
    from cuspid.pipeline import scan as pipeline

    stages: dict[str, dict[str, float]] = {}
    for name, stage in FUNCTIONS.items():
        setattr(pipeline, name, watched(getattr(pipeline, name), stage, stages))
    sys.argv = ["cuspid", *arguments]
    try:
        cuspid()
    finally:
        rest = time.perf_counter() - BEGIN - sum(each["wall_s"] for each in stages.values())
        stages["the rest"] = {"wall_s": rest, "peak_gib": peak_gib()}
        Path(times).write_text(json.dumps(stages))


def watched(work: Callable[..., Any], stage: str, stages: dict[str, dict[str, float]]) -> Callable[..., Any]:
    """The same function, which tells ``stages`` what it took."""

    @wraps(work)
    def run(*arguments: Any, **named: Any) -> Any:
        begin = time.perf_counter()
        try:
            return work(*arguments, **named)
        finally:
            before = stages.get(stage, {"wall_s": 0.0})["wall_s"]
            stages[stage] = {"wall_s": before + time.perf_counter() - begin, "peak_gib": peak_gib()}

    return run


def peak_gib() -> float:
    """Of this process until now."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


if __name__ == "__main__":
    main()
