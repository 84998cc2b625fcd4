"""Measure accuracy and speed as a user would see them: every stage is a run of the command line.

    python benchmarks/run.py --out benchmarks/results [--case molar arch] [--jaw JAW.ply] [--work FOLDER]

One JSON per run goes to the results folder; ``benchmarks/page.py`` makes docs/benchmarks.md from them. A case that has
its JSON already is not run again; delete the file to repeat it.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from cuspid.runtime.errors import CuspidError
from cuspid_thesis.scan_cases import conditions, measure_scan, run_program, run_timed, scan_cases

__all__ = ["conditions", "run_program", "run_timed"]  # Other benchmarks take them from here.


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--work", type=Path, default=Path("build/benchmarks"))
    parser.add_argument("--case", nargs="*", help="names or beginnings of names; default: all")
    parser.add_argument("--jaw", type=Path, help="a real full-arch scan for the case real-arch")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name, case in scan_cases(options.jaw).items():
        path = options.out / f"{name}.json"
        if path.exists() or (options.case and not any(name.startswith(asked) for asked in options.case)):
            continue
        try:
            result = measure_scan(name, case, options.work)
        except CuspidError as error:
            raise SystemExit(str(error)) from error
        path.write_text(json.dumps(result, indent=1) + "\n")
        print(f"{name}: {result['images_to_mesh']}")


if __name__ == "__main__":
    main()
