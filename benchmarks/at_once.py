"""Begin two runs with different settings at once in one folder, often: one works, the other says so, never a mixture.

    python benchmarks/at_once.py [--pairs 100]

Each pair photographs a board with other instants; what lies in the folder must be what one of them makes alone.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

from cuspid import storage
from cuspid.handpiece.designs import DESIGNS

INSTANTS = (1, 2)
BOARD = ("--columns", "6", "--rows", "5", "--square-mm", "1", "--supersampling", "1")


def begun(handpiece: Path, out: Path, instants: int) -> subprocess.Popen[bytes]:
    """A run, which goes on."""
    command = [sys.executable, "-m", "cuspid", "photograph", str(handpiece), *BOARD, "--out", str(out)]
    return subprocess.Popen([*command, "--instants", str(instants)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


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
        storage.write_handpiece(handpiece, DESIGNS["two"]())
        alone = {}
        for instants in INSTANTS:
            begun(handpiece, Path(made) / str(instants), instants).communicate()
            alone[instants] = contents(Path(made) / str(instants))
        for number in range(pairs):
            out = Path(made) / f"pair-{number}"
            runs = {instants: begun(handpiece, out, instants) for instants in INSTANTS}
            said = {instants: run.communicate()[1].decode() for instants, run in runs.items()}
            worked = [instants for instants, run in runs.items() if run.returncode == 0]
            refused = [said[instants] for instants in INSTANTS if instants not in worked]
            if len(worked) != 1 or contents(out) != alone[worked[0]]:
                ends["mixed"] += 1
                print(f"pair {number}: {[run.returncode for run in runs.values()]}: {said}", flush=True)
            elif "another run" in refused[0]:
                ends["told that another run works there"] += 1
            else:
                ends["told that the folder is another run's"] += 1
    print(dict(ends))
    raise SystemExit(bool(ends["mixed"]))


if __name__ == "__main__":
    main()
