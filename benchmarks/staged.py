"""``cuspid`` with a clock about each stage of a reconstruction, for ``qualities.py``.

    python benchmarks/staged.py TIMES.json reconstruct CAPTURE --out OUT

Motion times its own stages; of the others, each is a function of :mod:`cuspid.pipeline`. What is left, the start of the
program and reading and writing, is told as one.
"""

from __future__ import annotations

import json
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
    "measure_temporal_depth": "temporal depth",
    "fuse": "fusion and cleaning",
}
"""Of the pipeline, and the stages that they are."""


def main() -> None:
    """Run, and write the wall seconds of each stage."""
    times, *arguments = sys.argv[1:]
    from cuspid import pipeline
    from cuspid.__main__ import main as cuspid

    walls: dict[str, float] = {}
    for name, stage in FUNCTIONS.items():
        setattr(pipeline, name, clocked(getattr(pipeline, name), stage, walls))
    sys.argv = ["cuspid", *arguments]
    try:
        cuspid()
    finally:
        walls["the rest"] = time.perf_counter() - BEGIN - sum(walls.values())
        Path(times).write_text(json.dumps(walls))


def clocked(work: Callable[..., Any], stage: str, walls: dict[str, float]) -> Callable[..., Any]:
    """The same function, whose wall seconds are added to ``walls``."""

    @wraps(work)
    def run(*arguments: Any, **named: Any) -> Any:
        begin = time.perf_counter()
        try:
            return work(*arguments, **named)
        finally:
            walls[stage] = walls.get(stage, 0.0) + time.perf_counter() - begin

    return run


if __name__ == "__main__":
    main()
