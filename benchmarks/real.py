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
import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from real_baselines import BASELINES
from real_judging import measured
from real_runs import kept, run
from real_sets import SETS, offered
from run import conditions

from cuspid.storage import read_json, write_json

HERE = Path(__file__).parent


def row(name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """All that is known of one set."""
    each, folder = SETS[name], arguments.work / name
    ran = None if arguments.again else kept(folder / "run.json", each)
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
        took = kept(folder / "took.json", each)
        if took is None:
            shutil.rmtree(folder, ignore_errors=True)
            took = {**make(offered(each, arguments.data, folder / "given"), folder / "out"), "set": asdict(each)}
            write_json(folder / "took.json", took)
        shown = None if pictures is None else pictures.with_name(f"{name}-{method}")
        found = measured(each, arguments.data, folder / "out", shown)
        results[method] = {**took, **found}
    return results


def asked() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--only", nargs="*", help="names of sets, or beginnings of names; default: all")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "real.json")
    parser.add_argument("--work", type=Path, default=Path("build/real"))
    parser.add_argument("--pictures", type=Path, help="where pictures of the meshes go, for people to look at")
    parser.add_argument("--timeout", type=float, default=300, help="seconds after which a run is ended")
    parser.add_argument("--again", action="store_true", help="run anew what has been run")
    parser.add_argument("--no-baselines", action="store_true", help="without OpenCV's and COLMAP's ways")
    return parser.parse_args()


def is_asked(name: str, word: str) -> bool:
    """Whether a set is meant: by its name or, where a word is none, by its beginning."""
    return name == word or (word not in SETS and name.startswith(word))


def main() -> None:
    """Run and measure what is asked for, and write the figures after each set."""
    arguments = asked()
    chosen = [name for name in SETS if not arguments.only or any(is_asked(name, word) for word in arguments.only)]
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
