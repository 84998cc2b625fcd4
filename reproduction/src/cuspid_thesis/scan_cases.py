"""Scans that are measured as a user would see them: every stage is a run of the command line, timed from outside.

The benchmarks and the reproduction of the thesis have these cases in common, and the form of their results: one JSON a
case, with the commands, the options, the times, the errors and what they depend on.
"""

from __future__ import annotations

import ctypes
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import IO

import cuspid
from cuspid.cli.verbs import RENAMED
from cuspid.runtime.errors import CuspidError
from cuspid.runtime.workers import usable_cores
from cuspid.storage.files import open_to_append

PACKAGES = ("cuspid", "numpy", "numba", "opencv-contrib-python-headless", "pycolmap", "embreex", "libigl")
"""Whose versions are kept with every result."""
PREPARED = (46, 45, 42, 36, 35)
"""Teeth (FDI) of the thesis' reference model (Fig 3.20), in the order B, C, D, F, E of its Table 3.2: cracked, crown,
full-contour crown, and two inlays."""
WITH_MARGIN = (45, 42, 36, 35)
"""Those of them that have a margin."""
ONE_PASS = ("--passes", "turns")
"""Whole arches are measured in one pass, as the thesis scans them."""
_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None
_PR_SET_PDEATHSIG = 1
_STAGES = ("depth", "depth-across", "motion")


def run_program(*command: str, log: IO[bytes] | None = None) -> tuple[int, dict[str, float]]:
    """Run a program; its exit status, wall seconds, CPU seconds and peak memory in GiB. It writes to ``log``, or where
    this process does."""
    begin = time.perf_counter()
    process = subprocess.Popen(command, stdout=log, stderr=log, preexec_fn=_end_with_parent)
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - begin
    return os.waitstatus_to_exitcode(status), {
        "wall_s": round(seconds, 1),
        "cpu_s": round(usage.ru_utime + usage.ru_stime, 1),
        "peak_gib": round(usage.ru_maxrss / 2**20, 2),
    }


def _end_with_parent() -> None:
    """A killed run cannot tell its programs; on Linux the kernel does (prctl)."""
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def run_timed(*arguments: str, log: Path | None = None) -> dict[str, float]:
    """Run ``cuspid``; wall seconds, CPU seconds and peak memory in GiB. Its output is added to ``log``, if given.

    Raises CuspidError where it fails.
    """
    command = (sys.executable, "-m", "cuspid", *arguments)
    if log is None:
        status, figures = run_program(*command)
    else:
        log.parent.mkdir(parents=True, exist_ok=True)
        with open_to_append(log) as stream:
            status, figures = run_program(*command, log=stream)
    if status:
        raise CuspidError(f"cuspid {arguments[0]} failed with status {status}{'' if log is None else _last_words(log)}")
    return figures


def _last_words(log: Path) -> str:
    """What a program that failed said last."""
    lines = log.read_text(errors="replace").splitlines()
    said = next((line.strip() for line in reversed(lines) if line.strip()), "nothing")
    return f": {said.removeprefix('cuspid: ')} (full log: {log})"


def commit() -> str | None:
    """The commit of the code, marked where the work tree differs from it; None for an installed package."""
    describe = ("describe", "--always", "--dirty", "--abbrev=12")
    try:
        found = subprocess.run(
            ["git", "-C", str(Path(cuspid.__file__).parent), *describe], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return found.stdout.strip()


def conditions() -> dict[str, object]:
    """What a figure depends on besides the code; the load is that of the minutes before."""
    package = Path(cuspid.__file__).parent
    return {
        "commit": commit(),
        "load": [round(each, 2) for each in os.getloadavg()],
        "compiled": any(package.rglob("*.nbi")),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in PACKAGES},
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
    }


def with_todays_verb(command: str) -> str:
    """A command of a result that is older than its verb's name."""
    program, verb, *rest = command.split(" ")
    return " ".join([program, RENAMED.get(verb, verb) if program == "cuspid" else verb, *rest])


@dataclass(frozen=True, kw_only=True)
class ScanCase:
    """One scan that is measured."""

    seed: int = 0
    """Of texture, hand and noise."""
    jaw: str | None = None
    """Name of the jaw file in the work folder, or a path; None for the built-in phantom."""
    make: tuple[str, ...] = ()
    """The command that makes that jaw, without --out."""
    simulate: tuple[str, ...] = ()
    """More arguments of ``cuspid simulate``."""


def scan_cases(jaw: Path | None = None) -> dict[str, ScanCase]:
    """Three seeds of a molar, the arch, a user's own arch, the sphere arch, the thesis' reference model, and its teeth
    with margins from all sides."""
    table = {
        f"molar-seed{seed}": ScanCase(seed=seed, simulate=("--tooth", "46", "--jaw-seed", str(seed)))
        for seed in range(3)
    }
    table["arch"] = ScanCase(simulate=ONE_PASS)
    if jaw is not None:
        table["real-arch"] = ScanCase(jaw=str(jaw.resolve()), simulate=ONE_PASS)
    table["spheres"] = ScanCase(jaw="spheres.ply", make=("jaw", "phantom", "--spheres"), simulate=ONE_PASS)
    prepared = prepared_cases()
    return table | prepared | {f"all-round-{tooth}": _all_round(prepared[f"prepared-{tooth}"]) for tooth in WITH_MARGIN}


def _all_round(case: ScanCase) -> ScanCase:
    """The same, with further passes where two cameras would see little."""
    return replace(case, simulate=(*case.simulate, "--passes", "auto"))


def prepared_cases() -> dict[str, ScanCase]:
    """The rows of the thesis' Table 3.2: five prepared teeth, and the complete arch."""
    make = ("jaw", "prepare", "--preset", "thesis-reference")
    teeth = {
        f"prepared-{tooth}": ScanCase(jaw="thesis-reference.ply", make=make, simulate=("--tooth", str(tooth)))
        for tooth in PREPARED
    }
    return {**teeth, "prepared-arch": ScanCase(jaw="thesis-reference.ply", make=make, simulate=ONE_PASS)}


def measure_scan(
    name: str, case: ScanCase, work: Path, *, motion: str = "rig", afresh: bool = True, log: Path | None = None
) -> dict[str, object]:
    """Simulate once, then time images to mesh, then evaluate.

    ``afresh``: what was reconstructed before is thrown away, so that the time is that of the whole. Otherwise a scan
    that was interrupted goes on, and its time is then not known.
    """
    folder = work / name
    work.mkdir(parents=True, exist_ok=True)
    jaw = [] if case.jaw is None else [str(work / case.jaw)]
    if case.make and not Path(jaw[0]).exists():
        run_timed(*case.make, "--out", jaw[0], log=log)
    shared = [*jaw, *case.simulate, "--seed", str(case.seed)]
    run_timed("simulate", *shared, "--out", str(folder), log=log)
    if afresh:
        forget(folder)
    whole = not any((folder / stage).exists() for stage in _STAGES)
    reconstruct = ["reconstruct", str(folder / "capture"), "--out", str(folder), "--motion", motion]
    reconstructed = run_timed(*reconstruct, log=log)
    run_timed("evaluate", str(folder / "mesh.ply"), str(folder / "truth"), "--out", str(folder), log=log)
    return {
        "case": name,
        "seed": case.seed,
        "commands": [
            *([f"cuspid {' '.join(case.make)} --out {case.jaw}"] if case.make else []),
            f"cuspid simulate {' '.join(Path(argument).name for argument in shared)} --out {name}",
            f"cuspid reconstruct {name}/capture --out {name} --motion {motion}",
        ],
        "threads": usable_cores(),
        "images": len(list((folder / "capture" / "images").glob("*/*.png"))),
        "options": json.loads((folder / "run.json").read_text(encoding="utf-8")),
        "images_to_mesh": reconstructed if whole else None,
        "reconstruction": json.loads((folder / "motion" / "reconstruction.json").read_text(encoding="utf-8"))["log"],
        **{
            part: json.loads((folder / f"{part}.json").read_text(encoding="utf-8"))
            for part in ("trueness", "spheres", "margins")
            if (folder / f"{part}.json").exists()
        },
        **conditions(),
    }


def forget(folder: Path) -> None:
    """Throw away what was reconstructed of a scan; its images stay."""
    for stage in _STAGES:
        shutil.rmtree(folder / stage, ignore_errors=True)
    (folder / "mesh.ply").unlink(missing_ok=True)
