"""Damage small inputs in thousands of ways and see how readers and verbs take it (tests/support/fuzzing.py).

    OPENBLAS_NUM_THREADS=1 python benchmarks/fuzz.py [--cases 10000] [--first 0] [--only report] [--but live] [--add]

Prints what is wrong and writes benchmarks/results/fuzz.json: cases of each scenario, and all that is wrong, with the
seed that shows it again (``--only SCENARIO --first SEED --cases 1``). More threads of BLAS wait for one another where
the machine has other work, and their waiting would count as work.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from run import conditions

from cuspid.storage import read_json, write_json

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests" / "support"))

from fuzzing import SCENARIOS, Fuzzer  # noqa: E402


def main() -> None:
    """Run the cases in turns over the scenarios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--only", default="", help="scenarios with this in their name")
    parser.add_argument("--but", nargs="*", default=(), help="none of the scenarios with one of these in their name")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "fuzz.json")
    parser.add_argument("--add", action="store_true", help="to what the file holds of other seeds at this commit")
    arguments = parser.parse_args()
    left_out = {name for name in SCENARIOS for word in arguments.but if word in name}
    names = [name for name in SCENARIOS if arguments.only in name and name not in left_out]
    last = arguments.first + (arguments.cases - 1) // len(names)
    done, wrong, slowest = dict.fromkeys(names, 0), [], dict.fromkeys(names, 0.0)
    with tempfile.TemporaryDirectory(prefix="cuspid-fuzz-") as folder:
        fuzzer = Fuzzer(Path(folder))
        for number in range(arguments.cases):
            name, seed = names[number % len(names)], arguments.first + number // len(names)
            begin = time.perf_counter()
            what, found = fuzzer.case(name, seed)
            slowest[name] = max(slowest[name], time.perf_counter() - begin)
            done[name] += 1
            if found is not None:
                wrong.append({"scenario": name, "seed": seed, "input": what, "wrong": found})
                print(f"{name}, seed {seed}, {what}: {found}", flush=True)
    print(f"{sum(done.values())} cases, {len(wrong)} wrong")
    found = {"cases": done, "slowest_s": slowest, "seeds": [[arguments.first, last]], "wrong": wrong, **conditions()}
    write_json(arguments.out, together(read_json(arguments.out), found) if arguments.add else found)


def together(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """Results of two runs. Raises SystemExit where they are of two commits."""
    if one["commit"] != other["commit"]:
        raise SystemExit(f"the results so far are of commit {one['commit']}, these of {other['commit']}: run all anew")
    names = {**one["cases"], **other["cases"]}
    return {
        **other,
        "cases": {name: one["cases"].get(name, 0) + other["cases"].get(name, 0) for name in names},
        "slowest_s": {name: max(one["slowest_s"].get(name, 0), other["slowest_s"].get(name, 0)) for name in names},
        "seeds": one["seeds"] + other["seeds"],
        "wrong": one["wrong"] + other["wrong"],
    }


if __name__ == "__main__":
    main()
