"""Reconstruct real photographs by default options, and measure what comes out, beside OpenCV's and COLMAP's ways.

    python benchmarks/real.py --data FOLDER [--only NAME ...] [--out benchmarks/results/real.json] [--work FOLDER]
                              [--pictures FOLDER] [--timeout S] [--no-baselines]

FOLDER holds sets of photographs that are not part of the project (:mod:`real_sets`). ``cuspid reconstruct`` is run as a
user would run it, as a program of the same Python and the same paths of modules as this one, so that its exit status,
tracebacks, warnings, time and memory are those that a user meets. Finished runs are kept in the work folder and only
measured anew; with ``--again`` they are run anew. Baselines are kept there, too. ``--only`` adds to what the result
file holds of other sets.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from real_baselines import BASELINES
from real_judging import measured
from real_sets import SETS, Set, offered
from run import conditions

from cuspid.storage import read_json, write_json
from cuspid.studies.scan_cases import commit, timed

HERE = Path(__file__).parent
TIMED_OUT = 124
_WARNING = re.compile(rb"^.*\.py:\d+: \w*Warning: .*$", re.MULTILINE)


def run(each: Set, data: Path, folder: Path, timeout_s: float) -> dict[str, Any]:
    """Reconstruct a set into ``folder/out``, with the log and the record of the run beside it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    given, out, log = offered(each, data, folder / "given"), folder / "out", folder / "log.txt"
    command = [sys.executable, "-m", "cuspid", "reconstruct", str(given), "--out", str(out), *each.arguments]
    with log.open("wb") as stream:
        status, took = timed("timeout", "-k", "20", str(timeout_s), *command, log=stream)
    record = {**told(status, log.read_bytes()), **took, "timeout_s": timeout_s, "commit": commit()}
    write_json(folder / "run.json", record)
    return record


def told(status: int, log: bytes) -> dict[str, Any]:
    """What a run said: how it ended, and in its last line why."""
    lines = [line.strip() for line in log.decode(errors="replace").splitlines() if line.strip()]
    timed_out, traceback = status == TIMED_OUT, b"Traceback (most recent call last)" in log
    return {
        "status": "timed out" if timed_out else "traceback" if traceback else "refused" if status else "done",
        "exit_code": status,
        "traceback": traceback,
        "warnings": len(_WARNING.findall(log)),
        "last_line": "" if not lines else _last(lines),
    }


def _last(lines: list[str]) -> str:
    """The last message of the program, whole where it was wrapped over some lines."""
    begin = next((k for k in reversed(range(len(lines))) if lines[k].startswith("cuspid: ")), len(lines) - 1)
    return " ".join(lines[begin:])[:400]


def row(name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """All that is known of one set."""
    each, folder = SETS[name], arguments.work / name
    record = folder / "run.json"
    ran = read_json(record) if record.exists() and not arguments.again else None
    ran = run(each, arguments.data, folder, arguments.timeout) if ran is None else ran
    pictures = None if arguments.pictures is None else arguments.pictures / name
    found = measured(each, arguments.data, folder / "out", pictures)
    others = {} if arguments.no_baselines else baselines(name, arguments, pictures)
    return {"kind": each.kind, "commit": ran["commit"], "run": ran, "found": found, "baselines": others}


def baselines(name: str, arguments: argparse.Namespace, pictures: Path | None) -> dict[str, Any]:
    """What others make of the same photographs, kept from an earlier run where there is one."""
    each, results = SETS[name], dict[str, Any]()
    for method, make in BASELINES[each.kind].items():
        folder = arguments.work / "baselines" / f"{name}-{method}"
        if not (folder / "took.json").exists():
            shutil.rmtree(folder, ignore_errors=True)
            given = offered(each, arguments.data, folder / "given")
            took = make(given, folder / "out")
            write_json(folder / "took.json", took)
        shown = None if pictures is None else pictures.with_name(f"{name}-{method}")
        found = measured(each, arguments.data, folder / "out", shown)
        results[method] = {**read_json(folder / "took.json"), **found}
    return results


def asked() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--only", nargs="*", help="names of sets or their beginnings; default: all")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "real.json")
    parser.add_argument("--work", type=Path, default=Path("build/real"))
    parser.add_argument("--pictures", type=Path, help="where pictures of the meshes go, for people to look at")
    parser.add_argument("--timeout", type=float, default=300, help="seconds after which a run is ended")
    parser.add_argument("--again", action="store_true", help="run anew what has been run")
    parser.add_argument("--no-baselines", action="store_true", help="without OpenCV's and COLMAP's ways")
    return parser.parse_args()


def main() -> None:
    """Run and measure what is asked for, and write the figures after each set."""
    arguments = asked()
    chosen = [name for name in SETS if not arguments.only or name.startswith(tuple(arguments.only))]
    before: Mapping[str, Any] = read_json(arguments.out)["scans"] if arguments.only and arguments.out.exists() else {}
    rows = dict(before)
    for name in chosen:
        rows[name] = row(name, arguments)
        ran = rows[name]["run"]
        print(f"{name}: {ran['status']}, {ran['wall_s']} s, {rows[name]['found'].get('measures')}", flush=True)
        scans = {each: rows[each] for each in SETS if each in rows}
        write_json(arguments.out, {"scans": scans, "sets": {n: asdict(SETS[n]) for n in scans}, **conditions()})


if __name__ == "__main__":
    main()
