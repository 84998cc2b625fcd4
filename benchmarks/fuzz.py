"""Damage small inputs in thousands of ways and see how readers and verbs take it (tests/fuzzing.py).

    python benchmarks/fuzz.py [--cases 10000] [--first 0] [--only report]

Prints what is wrong and writes benchmarks/results/fuzz.json: cases of each scenario, and all that is wrong, with the
seed that shows it again (``--only SCENARIO --first SEED --cases 1``).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from run import conditions

from cuspid.storage import write_json

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests"))

from fuzzing import SCENARIOS, Fuzzer  # noqa: E402


def main() -> None:
    """Run the cases in turns over the scenarios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--only", default="", help="scenarios with this in their name")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "fuzz.json")
    arguments = parser.parse_args()
    names = [name for name in SCENARIOS if arguments.only in name]
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
    write_json(arguments.out, {"cases": done, "slowest_s": slowest, "wrong": wrong, **conditions()})


if __name__ == "__main__":
    main()
