"""Damage small inputs in thousands of ways and see how readers and verbs take it (tests/support/fuzzing.py).

    OPENBLAS_NUM_THREADS=1 python benchmarks/fuzz.py [--cases 10000] [--first 0] [--only report] [--but live] [--add]
                                                     [--processes 2]

The scenarios take turns, those of many seconds a case (``SLOW``) in every twelfth round. Prints what is wrong and
writes benchmarks/results/fuzz.json: cases of each scenario, and all that is wrong, with the seed that shows it again
(``--only SCENARIO --first SEED --cases 1``). More threads of BLAS wait for one another where the machine has other
work, and their waiting would count as work.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import count
from pathlib import Path
from typing import Any

from run import conditions

from cuspid.runtime.workers import end_with_parent
from cuspid.storage import read_json, write_json

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests" / "support"))

from fuzzing import SCENARIOS, Fuzzer  # noqa: E402

SLOW = (
    *("exchanged cameras", "strange files beside", "reconstruct", "live", "resume", "photographs", "stitch"),
    *("study of scanners", "study by a table", "mean shape", "visibility", "film", "design", "face directions"),
    *("little memory", "full output", "cameras at one place"),
)
"""Scenarios of several seconds a case: whole scans, and processes of their own."""
SLOW_EVERY = 12
"""Rounds."""

Turn = tuple[str, int]


def turns(names: Sequence[str], cases: int, first: int) -> list[Turn]:
    """Scenarios and seeds, in rounds over the scenarios."""
    chosen: list[Turn] = []
    slow_only = all(name in SLOW for name in names)
    for number in count():
        for name in names:
            if len(chosen) == cases:
                return chosen
            if slow_only or name not in SLOW or number % SLOW_EVERY == 0:
                chosen.append((name, first + number))
    raise AssertionError


def run_turns(chosen: Sequence[Turn]) -> dict[str, Any]:
    """Cases done, seconds of the slowest, and what is wrong."""
    done: dict[str, int] = {}
    slowest: dict[str, float] = {}
    wrong: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="cuspid-fuzz-") as folder:
        fuzzer = Fuzzer(Path(folder))
        for name, seed in chosen:
            begin = time.perf_counter()
            what, found = fuzzer.case(name, seed)
            slowest[name] = max(slowest.get(name, 0.0), time.perf_counter() - begin)
            done[name] = done.get(name, 0) + 1
            if found is not None:
                wrong.append({"scenario": name, "seed": seed, "input": what, "wrong": found})
                print(f"{name}, seed {seed}, {what}: {found}", flush=True)
    return {"cases": done, "slowest_s": slowest, "wrong": wrong}


def main() -> None:
    """Run the cases in turns over the scenarios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--only", default="", help="scenarios with this in their name")
    parser.add_argument("--but", nargs="*", default=(), help="none of the scenarios with one of these in their name")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--out", type=Path, default=HERE / "results" / "fuzz.json")
    parser.add_argument("--add", action="store_true", help="to what the file holds of other seeds at this commit")
    arguments = parser.parse_args()
    names = [name for name in SCENARIOS if arguments.only in name and not any(word in name for word in arguments.but)]
    chosen = turns(names, arguments.cases, arguments.first)
    shares = [chosen[k :: arguments.processes] for k in range(arguments.processes)]
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(arguments.processes, spawn, end_with_parent) as pool:  # workers may have workers
        parts = list(pool.map(run_turns, shares))
    ran = {"seeds": [[arguments.first, chosen[-1][1]]], **conditions()}
    found = together([{**ran, **part} for part in parts]) | {"seeds": ran["seeds"]}
    print(f"{sum(found['cases'].values())} cases, {len(found['wrong'])} wrong")
    write_json(arguments.out, together([read_json(arguments.out), found]) if arguments.add else found)


def together(results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Results of several runs as one. Raises SystemExit where they are of different commits."""
    if len(commits := sorted({each["commit"] for each in results})) > 1:
        raise SystemExit(f"the results are of commits {' and '.join(commits)}: run all anew")
    names = list(dict.fromkeys(name for each in results for name in each["cases"]))
    return {
        **results[-1],
        "cases": {name: sum(each["cases"].get(name, 0) for each in results) for name in names},
        "slowest_s": {name: max(each["slowest_s"].get(name, 0.0) for each in results) for name in names},
        "seeds": [seeds for each in results for seeds in each["seeds"]],
        "wrong": [wrong for each in results for wrong in each["wrong"]],
    }


if __name__ == "__main__":
    main()
