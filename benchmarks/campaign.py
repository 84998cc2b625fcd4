"""Measure anew what no longer holds, one benchmark after the other, at one commit: the current one unless told.

    python benchmarks/campaign.py [--release] [--commit C] [--list] [--only NAME ...] [--hours H] [--work FOLDER]
                                  [--jaws FOLDER] [--pairs FOLDER] [--ball FOLDER] [--photographs FOLDER]
                                  [--boards FOLDER]

The commit is checked out into the work folder, so that work can go on meanwhile. Each result goes to
benchmarks/results as soon as it is there; a campaign that was stopped goes on with what does not hold by then
(:mod:`freshness`), and finished parts of most benchmarks are kept in the work folder. ``--release`` leaves the
experiments out. Nothing is begun after ``--hours``. Scans of your own (``--jaws``), rectified photographs of two
cameras (``--pairs``), photographs of a glossy ball (``--ball``), sets of real photographs (``--photographs``) and real
views of boards (``--boards``) are not part of the project: without them, the benchmarks that need them are left out.
Then make the page (``python benchmarks/page.py``). Pictures for the documentation stay in the work folder.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from freshness import ROOT, changes, maker_of

RESULTS = ROOT / "benchmarks" / "results"
GIVEN = ("jaws", "pairs", "ball", "photographs", "boards")
"""What is not part of the project."""


@dataclass(frozen=True)
class Benchmark:
    """A command, and the result that it writes."""

    name: str
    """Of the result: a file in benchmarks/results, without its ending."""
    command: str
    """Script and options; ``{out}`` is the file, ``{folder}`` its folder, ``{work}`` a folder of its own, and
    ``{jaws}``, ``{pairs}``, ``{ball}``, ``{photographs}`` and ``{boards}`` are what the user gives."""

    def needs(self, given: Mapping[str, Path]) -> list[str]:
        """Options that must be given, but were not."""
        return [f"--{what}" for what in GIVEN if f"{{{what}}}" in self.command and what not in given]

    @property
    def holds(self) -> bool:
        """Whether there is a result, and nothing that made it has changed."""
        file = RESULTS / f"{self.name}.json"
        return file.exists() and not changes(self.name, json.loads(file.read_text()))


def case(name: str, options: str = "") -> Benchmark:
    """One of ``run.py``."""
    return Benchmark(name, f"run.py --case {name} --work {{work}} --out {{folder}} {options}")


BENCHMARKS = (
    *(case(f"molar-seed{seed}") for seed in range(3)),
    case("arch"),
    case("real-arch", "--jaw {jaws}/fullarch_upper_137k.ply"),
    *(case(f"prepared-{tooth}") for tooth in (35, 36, 42, 45, 46)),
    case("prepared-arch"),
    *(case(f"all-round-{tooth}") for tooth in (35, 36, 42, 45)),
    case("spheres"),
    Benchmark("fuzz", "fuzz.py --processes 2 --out {out}"),
    Benchmark("kill", "kill.py --work {work} --out {out}"),
    Benchmark("large", "large.py --work {work} --out {out}"),
    Benchmark("mutation", "mutation.py --work {work} --out {out}"),
    Benchmark("precision", "precision.py --pictures {work} --out {out}"),
    Benchmark("visibility", "visibility.py --out {out}"),
    Benchmark("mouth", "mouth.py --out {out}"),
    Benchmark("measure", "measure_jaws.py --jaws {jaws}/iosseg --out {out}"),
    Benchmark("landmarks", "landmarks.py --data {jaws}/landmarked --out {out}"),
    Benchmark("orientation", "orientation.py {jaws} --out {out}"),
    Benchmark("populations", "populations.py --out {out}"),
    Benchmark("camera_pair", "camera_pair.py --pictures {work} --out {out}"),
    Benchmark("targets", "targets.py --work {work} --out {out}"),
    Benchmark("calibrations", "calibrations.py {boards} --out {out}"),
    Benchmark("rolling", "rolling.py {boards} --work {work} --out {out}"),
    Benchmark("mean_shape", "mean_shape.py --work {work} --out {out}"),
    Benchmark("grid", "grid.py --out {out}"),
    Benchmark("study", "study.py {jaws} --work {work} --out {out}"),
    Benchmark("stereo_pairs", "stereo_pairs.py {pairs} --out {out}"),
    Benchmark("real_gloss", "real_gloss.py {ball} --out {out}"),
    Benchmark("real", "real.py --data {photographs} --work {work} --out {out}"),
    Benchmark("cast", "cast.py {jaws}/fullarch_upper_137k.ply --work {work} --out {out}"),
    Benchmark("any_rig", "any_rig.py --work {work} --out {out}"),
    Benchmark("qualities", "qualities.py {jaws}/fullarch_upper_137k.ply --work {work} --out {out}"),
    Benchmark("live", "live.py phantom {jaws}/fullarch_upper_137k.ply --work {work} --out {out}"),
    Benchmark("expectations", "expectations.py --work {work} --out {out}"),
    Benchmark("enamel", "enamel.py {jaws} --work {work} --out {out}"),
    Benchmark("plain_frames", "plain_frames.py {jaws} --work {work} --out {out}"),
    Benchmark("jaws_plan", "jaws.py {jaws} --plan --work {work} --out {out}"),
    Benchmark("jaws_half", "jaws.py {jaws} --size half --work {work} --out {out}"),
    Benchmark(
        "manufacturing_arch",
        "manufacturing.py --jaw {jaws}/fullarch_upper_137k.ply --work {work} --out {out}",
    ),
    Benchmark(
        "manufacturing_swept",
        "manufacturing.py --jaw {jaws}/fullarch_upper_137k.ply --cross-sweep --work {work} --out {out}",
    ),
    Benchmark("manufacturing_phantom", "manufacturing.py --arch --work {work} --out {out}"),
    Benchmark("design_comparison", "design_comparison.py --work {work} --pictures {work} --out {out}"),
)
"""What matters most comes first."""


def measured(benchmark: Benchmark, work: Path, given: Mapping[str, Path]) -> bool:
    """Whether the benchmark came to its end; its result is then among the others. ``work`` is that of the commit."""
    checkout, own, folder = work / "checkout", work / benchmark.name, work / "results"
    out = folder / f"{benchmark.name}.json"
    out.unlink(missing_ok=True)
    own.mkdir(exist_ok=True)
    folder.mkdir(exist_ok=True)
    script, *options = benchmark.command.format(out=out, folder=folder, work=own, **given).split()
    begin = time.monotonic()
    paths = os.pathsep.join(str(checkout / each) for each in ("src", "benchmarks"))
    with (work / f"{benchmark.name}.log").open("w") as log:
        status = subprocess.run(
            [sys.executable, checkout / "benchmarks" / script, *options],
            cwd=checkout,
            env={**os.environ, "PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "1"},
            stdout=log,
            stderr=subprocess.STDOUT,
            check=False,
        ).returncode
    if status or not out.exists():
        return False
    result = {**json.loads(out.read_text()), "campaign_min": round((time.monotonic() - begin) / 60, 1)}
    (RESULTS / out.name).write_text(json.dumps(result, indent=1) + "\n")
    return True


def checked_out(work: Path, commit: str) -> Path:
    """The work folder of a commit, with a clean copy of it."""
    own = work / commit[:12]
    if not (own / "checkout").exists():
        own.mkdir(parents=True, exist_ok=True)
        subprocess.run(["git", "clone", "--quiet", ROOT, own / "checkout"], check=True)
    subprocess.run(["git", "checkout", "--quiet", "--detach", commit], cwd=own / "checkout", check=True)
    compile_all(own)
    return own


def compile_all(work: Path) -> None:
    """Scan a tooth with the code of a work folder, unless that was done: the first scan compiles for a minute, and is
    not one of those that are measured."""
    scan, environment = work / "compiled", {**os.environ, "PYTHONPATH": str(work / "checkout" / "src")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    if not (scan / "report.html").exists():
        command = [sys.executable, "-m", "cuspid", "run", "--tooth", "46", "--out", str(scan)]
        subprocess.run(command, env=environment, stdout=subprocess.DEVNULL, check=True)


def asked_for(only: list[str] | None, given: Mapping[str, Path], *, release: bool) -> Iterator[Benchmark]:
    """What does not hold and can be measured; says what is left out."""
    for benchmark in BENCHMARKS:
        if only is not None and not any(fnmatch(benchmark.name, each) for each in only):
            continue
        if release and not maker_of(benchmark.name).release:
            continue
        if benchmark.holds:
            print(f"{benchmark.name}: holds")
        elif missing := benchmark.needs(given):
            print(f"{benchmark.name}: left out, needs {', '.join(missing)}")
        else:
            yield benchmark


def main() -> None:
    """Measure, and say how it went."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--release", action="store_true", help="only what is measured for each release")
    parser.add_argument("--commit", default="HEAD")
    parser.add_argument("--list", action="store_true", help="say what would be measured, and end")
    parser.add_argument("--only", nargs="*", help="names of results; * and ? stand for any characters")
    parser.add_argument("--hours", type=float, default=float("inf"))
    parser.add_argument("--work", type=Path, default=ROOT / "build" / "campaign")
    for what in GIVEN:
        parser.add_argument(f"--{what}", type=Path)
    arguments = parser.parse_args()
    given = {each: getattr(arguments, each).resolve() for each in GIVEN if getattr(arguments, each) is not None}
    named = ["git", "rev-parse", f"{arguments.commit}^{{commit}}"]
    commit = subprocess.run(named, cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()
    begin = time.monotonic()
    wanted = list(asked_for(arguments.only, given, release=arguments.release))
    if arguments.list:
        print("\n".join(f"{each.name}: would be measured" for each in wanted))
        return
    work = checked_out(arguments.work.resolve(), commit)
    for benchmark in wanted:
        start = time.monotonic()
        if start - begin > 3600 * arguments.hours:
            print(f"{benchmark.name}: not begun, the time is over")
            continue
        done = measured(benchmark, work, given)
        how = "" if done else f", failed, see {work / benchmark.name}.log"
        print(f"{benchmark.name}: {(time.monotonic() - start) / 60:.1f} min{how}", flush=True)


if __name__ == "__main__":
    main()
