"""Begin two runs with different settings at once in one folder, often: one works, the other says so, never a mixture.

    python benchmarks/at_once.py [--pairs 100]

Each pair photographs a board with other instants; what lies in the folder must be what one of them makes alone.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections import Counter
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path

from cuspid import cli, storage
from cuspid.cli.calibration import photograph  # noqa: F401 - imported once, not in each run
from cuspid.handpiece.designs import DESIGNS, DesignOptions

INSTANTS = (1, 2)
BOARD = ("--columns", "6", "--rows", "5", "--square-mm", "1", "--supersampling", "1")


def begun(handpiece: Path, out: Path, instants: int, said: Path) -> BaseProcess:
    """A run, which goes on; what it prints goes to a file."""
    arguments = ["rig", "photograph", str(handpiece), *BOARD, "--instants", str(instants), "--out", str(out)]
    process = get_context("fork").Process(target=_run, args=(arguments, said))  # all is imported already
    process.start()
    return process


def _run(arguments: list[str], said: Path) -> None:
    stream = os.open(said, os.O_WRONLY | os.O_CREAT)
    os.dup2(stream, 1)
    os.dup2(stream, 2)
    cli.main(arguments)


def contents(folder: Path) -> dict[str, str]:
    """SHA-256 of all files."""
    return {str(each.relative_to(folder)): storage.hash_file(each) for each in folder.rglob("*") if each.is_file()}


def main() -> None:
    """Count how the pairs end. Raises SystemExit where one mixes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=100)
    pairs, ends = parser.parse_args().pairs, Counter[str]()
    with tempfile.TemporaryDirectory(prefix="cuspid-at-once-") as made:
        handpiece = Path(made) / "handpiece.json"
        storage.write_handpiece(handpiece, DESIGNS["two"](DesignOptions()))
        alone, said = {}, {instants: Path(made) / f"said-{instants}.txt" for instants in INSTANTS}
        for instants in INSTANTS:
            begun(handpiece, Path(made) / str(instants), instants, said[instants]).join()
            alone[instants] = contents(Path(made) / str(instants))
        for number in range(pairs):
            out = Path(made) / f"pair-{number}"
            for file in said.values():
                file.unlink(missing_ok=True)
            runs = {instants: begun(handpiece, out, instants, said[instants]) for instants in INSTANTS}
            for run in runs.values():
                run.join()
            worked = [instants for instants, run in runs.items() if run.exitcode == 0]
            refused = [said[instants].read_text() for instants in INSTANTS if instants not in worked]
            if len(worked) != 1 or contents(out) != alone[worked[0]]:
                ends["mixed"] += 1
                print(f"pair {number}: {[run.exitcode for run in runs.values()]}: {refused}", flush=True)
            elif "another run" in refused[0]:
                ends["told that another run works there"] += 1
            else:
                ends["told that the folder is another run's"] += 1
    print(dict(ends))
    raise SystemExit(bool(ends["mixed"]))


if __name__ == "__main__":
    main()
