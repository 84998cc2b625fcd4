"""The runs that make the results, each in a process of its own; each result is a file at once: a killed run goes on.

Names of results are those of the benchmarks (benchmarks/results). Under the folder of a reproduction there are

    results/<name>.json         under the conditions of the thesis
    results-quick/<name>.json   reduced: fewer jaws, settings, pixels; never in the place of the others
    images/                     pictures that came along
    work/                       scans and films, and what the programs wrote on the screen
"""

from __future__ import annotations

import csv
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np

from cuspid import storage
from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.anatomy.phantom.population import GroupName, draw_population
from cuspid.anatomy.shape.boxed import box_crowns
from cuspid.handpiece.designs import twelve_cameras
from cuspid.report.figures.drawing import save_picture
from cuspid.runtime.errors import CuspidError, InputError
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import usable_cores
from cuspid.studies.camera_pair import CameraPairOptions
from cuspid.studies.camera_sweep import SweepOptions
from cuspid.studies.grid import Case, Value, run_grid
from cuspid_thesis.catalogue import Item
from cuspid_thesis.checks import CHECKS
from cuspid_thesis.computed.panoramas import EXAMINED, SUBJECTS, UNEXAMINED, panoramas
from cuspid_thesis.judging import judge
from cuspid_thesis.results import CHECKED, PANORAMA, Result, Results
from cuspid_thesis.samples import (
    MEAN_EDGE_MM,
    best_camera_pairs,
    find_mean_shape,
    measure_populations,
    path_over,
    surfaces_seen,
)
from cuspid_thesis.scan_cases import conditions, measure_scan, prepared_cases, run_timed

READ_ONLY = ("measure", "design_comparison_full_size")
"""Results that the page shows and no run here makes: they need data that is not public, or hours."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """What a run is asked for."""

    name: str
    """Of the run."""
    folder: Path
    """Of the reproduction."""
    quick: bool
    """Whether the reduced version is asked for."""
    wanted: tuple[str, ...]
    """Results that are not there yet."""

    @property
    def work(self) -> Path:
        """Where scans and films are kept."""
        return self.folder / "work" / (f"{self.name}-quick" if self.quick else self.name)

    @property
    def log(self) -> Path:
        """What the programs write on the screen."""
        return self.folder / "work" / f"{self.name}.log"

    def keep(self, picture: Path, name: str) -> None:
        """Keep a picture for the page, where it was made."""
        if picture.exists():
            storage.write_bytes(self.folder / "images" / name, picture.read_bytes())


@dataclass(frozen=True, kw_only=True)
class Run:
    """How some results are made."""

    makes: tuple[str, ...]
    """Names of the results."""
    make: Callable[[Task], Iterator[tuple[str, Result]]]
    """Yields those that are wanted, one by one."""
    minutes: float
    """About how long it takes on one core; the longest begin first."""
    quick: Literal["reduced", "same", "none"] = "reduced"
    """What --quick makes of it: less, all the same, or nothing."""
    quick_makes: tuple[str, ...] | None = None
    """The results that --quick asks for, where they are fewer."""


# --- What is run ------------------------------------------------------------------------------------------------------


def _checks(task: Task) -> Iterator[tuple[str, Result]]:
    yield CHECKED, {name: check() for name, check in CHECKS.items()}


def _populations(task: Task) -> Iterator[tuple[str, Result]]:
    yield "populations", {"groups": measure_populations(4 if task.quick else 24)}


def _visibility(task: Task) -> Iterator[tuple[str, Result]]:
    jaw = build_phantom(PhantomOptions(edge_mm=0.5 if task.quick else 0.29))
    yield "visibility", {"surfaces": surfaces_seen(jaw, path_over(jaw, twelve_cameras(), None))}


def _mean_shape(task: Task) -> Iterator[tuple[str, Result]]:
    count, edge_mm = (4, 0.6) if task.quick else (40, MEAN_EDGE_MM)
    result, mean = find_mean_shape(task.work, count, edge_mm)
    (task.folder / "images").mkdir(parents=True, exist_ok=True)
    save_picture(task.folder / "images" / "shape-mean.png", mean.mesh, title=f"Mean of {count} phantoms")
    title = f"Mean of {count} phantoms, with a box for each tooth"
    save_picture(task.folder / "images" / "shape-boxed.png", box_crowns(mean).mesh, title=title)
    yield "mean_shape", result


def _camera_pair(task: Task) -> Iterator[tuple[str, Result]]:
    options = CameraPairOptions()
    if task.quick:
        options = CameraPairOptions(
            facing=("occlusal",),
            baselines_mm=(1.0, 2.5, 4.0),
            axis_angles_deg=(0.0, 10.0, 20.0, 40.0),
            distances_mm=(3.0, 5.0, 7.0, 9.0, 13.0),
        )
    jaw = build_phantom(PhantomOptions(edge_mm=0.5 if task.quick else 0.3))
    yield "camera_pair", best_camera_pairs(jaw, options)


SWEPT: Mapping[str, int] = MappingProxyType({"occlusal": 2, "incisal": 2, "buccal": 1, "lingual": 1})
"""Surfaces over which pairs are tried, and how often the best settings are repeated."""
_QUICK_SWEEP = (
    *("--baseline-mm", "1", "1.5", "2.5", "4", "--angle-deg", "0", "9", "--image-px", "256"),
    *("--path-mm", "3", "--frames", "4", "--contenders", "1"),
)
_SWEEP_COLUMNS = (
    "seen_pct",
    "points",
    "mean_abs_um",
    "std_um",
    "p95_um",
    "complete_10_um_pct",
    "complete_50_um_pct",
    "cpu_s",
)


def _camera_sweep(task: Task) -> Iterator[tuple[str, Result]]:
    found = {}
    for surface, repeats in SWEPT.items():
        if task.quick and surface not in ("occlusal", "incisal"):
            continue
        arguments = sweep_arguments(surface, 1 if task.quick else repeats) + (_QUICK_SWEEP if task.quick else ())
        out = task.work / surface
        run_timed(*arguments, "--out", str(out), "--workers", str(usable_cores()), log=task.log)
        found[surface] = sweep_result(out, arguments)
        task.keep(out / "sweep.png", f"sweep-{surface}.png")
    yield "camera_sweep", {"surfaces": found}


def sweep_arguments(surface: str, repeats: int) -> tuple[str, ...]:
    """Of ``cuspid``, without folder and workers."""
    tooth = str(SweepOptions(surface=surface).chosen_tooth)
    return ("study", "sweep", "--surface", surface, "--tooth", tooth, "--repeats", str(repeats))


def sweep_result(out: Path, arguments: Sequence[str]) -> dict[str, object]:
    """What came of a finished sweep in a folder."""
    with (out / "results.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    return {
        "command": f"cuspid {' '.join(arguments)} --out {out.name}",
        "settings": storage.read_json(out / "run.json")["sweep"]["settings"]["options"],
        "cases": len(rows),
        "failed": sum(bool(row["failure"]) for row in rows),
        "cases_cpu_s": round(sum(float(row["cpu_s"]) for row in rows if not row["failure"]), 1),
        **storage.read_json(out / "sweep.json"),
        "rows": [_compact(row) for row in rows],
    }


def _compact(row: Mapping[str, str]) -> dict[str, object]:
    """Setting, seed and the main figures of a case."""
    setting = {name: float(row[name]) for name in ("baseline_mm", "angle_deg", "seed")}
    if row["failure"]:
        return {**setting, "failure": row["failure"]}
    return {**setting, **{name: round(float(row[name]), 2) for name in _SWEEP_COLUMNS}}


def _design_comparison(task: Task) -> Iterator[tuple[str, Result]]:
    less = ("--jaws", "phantom", "--turns", "1", "3", "--image-scale", "0.3", "--edge-mm", "0.4")
    all_of_it = ("--jaws", "phantom", "boxed-mean", "--turns", "1", "3", "5", "--image-scale", "0.5")
    arguments = (
        "study",
        "compare",
        "--designs",
        "twelve",
        "six",
        "four",
        "--tooth",
        "46",
        *(less if task.quick else all_of_it),
    )
    run_timed(*arguments, "--out", str(task.work), "--workers", str(usable_cores()), log=task.log)
    task.keep(task.work / "comparison.png", "design-comparison.png")
    found = storage.read_json(task.work / "comparison.json")
    yield "design_comparison", {"command": f"cuspid {' '.join(arguments)} --out comparison", **found}


_QUICK_TEETH = ("prepared-46", "prepared-45", "prepared-36")
"""A crack, a crown and an inlay."""


def _run_prepared(task: Task) -> Iterator[tuple[str, Result]]:
    for name in task.wanted:
        case = prepared_cases()[name]
        if task.quick:
            case = replace(case, simulate=(*case.simulate, "--supersampling", "1"))
        yield name, measure_scan(name, case, task.work, afresh=False, log=task.log)
        task.keep(task.work / "thesis-reference.teeth.png", "preparation-thesis-reference.png")
        task.keep(task.work / name / "deviation.png", f"{name}.png")


# --- Panoramas --------------------------------------------------------------------------------------------------------

SUBJECT_NUMBERS: tuple[tuple[GroupName, int], ...] = (
    *(("lower-14", 0), ("lower-14", 1), ("upper-14", 0), ("upper-14", 1), ("lower-12", 0)),
    *(("lower-14", 2), ("lower-14", 3), ("upper-14", 2), ("upper-14", 3), ("upper-12", 0)),
)
"""The ten subjects: phantoms of the population by group and number; their place is the seed of the film."""
METHODS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "ortho": ("--method", "ortho"),
        EXAMINED: ("--method", "thesis"),
        UNEXAMINED: ("--method", "thesis", "--no-examination"),
    }
)
"""Arguments of ``cuspid pano stitch`` by the names of the methods."""
EDGE_MM = 0.25
"""Edge of the subjects' faces."""


def subjects() -> dict[str, PhantomOptions]:
    """The subjects by name."""
    most = {group: max(number for each, number in SUBJECT_NUMBERS if each == group) for group, _ in SUBJECT_NUMBERS}
    drawn = {
        group: draw_population(group, number + 1, np.random.default_rng(0), PhantomOptions(edge_mm=EDGE_MM))
        for group, number in most.items()
    }
    return {f"{group}-{number}": drawn[group][number] for group, number in SUBJECT_NUMBERS}


SUBJECT_NAMES = tuple(f"{group}-{number}" for group, number in SUBJECT_NUMBERS)
_QUICK_SUBJECTS = ("lower-14-0", "upper-14-0")
"""Those of --quick; the first with all methods."""


def _panoramas(task: Task) -> Iterator[tuple[str, Result]]:
    subject = task.name.removeprefix("panorama-")
    seed = SUBJECT_NAMES.index(subject)
    jaw, film = task.work / "jaw.ply", task.work / "film"
    if not jaw.with_suffix(".json").exists():
        storage.write_jaw(jaw, build_phantom(subjects()[subject]))
    numbers = ("--seed", str(seed), "--supersampling", "1")
    run_timed("pano", "film", str(jaw), "--out", str(film), *numbers, log=task.log)
    for name in task.wanted:
        method = name.removeprefix(f"{PANORAMA}{subject}-")
        yield name, _stitch(task, film, subject, method)


def _stitch(task: Task, film: Path, subject: str, method: str) -> dict[str, object]:
    """A panorama of a film, evaluated; in parts, the largest one. What cannot be stitched is a result, too."""
    out, score = task.work / method, task.work / f"{method}-score"
    command = " ".join(("cuspid", "pano", "stitch", "film/capture", *METHODS[method], "--out", method))
    common = {"subject": subject, "method": method, "command": command}
    try:
        figures = run_timed("pano", "stitch", str(film / "capture"), *METHODS[method], "--out", str(out), log=task.log)
    except CuspidError as error:
        return {**common, "failure": str(error), "score": None}
    made = out / "part-1" if (out / "part-1").is_dir() else out
    run_timed("pano", "evaluate", str(made), str(film / "truth"), "--out", str(score), log=task.log)
    found = storage.read_json(score / "score.json")
    task.keep(score / "score.png", f"panorama-{subject}-{method}.png")
    return {**common, "frames_to_panorama": figures, "failure": found.get("failure"), "score": found}


def _panorama_run(subject: str) -> Run:
    names = tuple(f"{PANORAMA}{subject}-{method}" for method in METHODS)
    return Run(
        makes=names,
        make=_panoramas,
        minutes=8.0,
        quick="same" if subject in _QUICK_SUBJECTS else "none",
        quick_makes=names if subject == _QUICK_SUBJECTS[0] else names[:1],
    )


RUNS: Mapping[str, Run] = MappingProxyType(
    {
        "prepared-arch": Run(makes=("prepared-arch",), make=_run_prepared, minutes=35.0, quick="none"),
        "prepared-teeth": Run(
            makes=tuple(name for name in prepared_cases() if name != "prepared-arch"),
            make=_run_prepared,
            minutes=25.0,
            quick_makes=_QUICK_TEETH,
        ),
        **{f"panorama-{name}": _panorama_run(name) for name in SUBJECT_NAMES},
        "camera_sweep": Run(makes=("camera_sweep",), make=_camera_sweep, minutes=30.0),
        "design_comparison": Run(makes=("design_comparison",), make=_design_comparison, minutes=15.0),
        "mean_shape": Run(makes=("mean_shape",), make=_mean_shape, minutes=9.0),
        "populations": Run(makes=("populations",), make=_populations, minutes=3.0),
        "camera_pair": Run(makes=("camera_pair",), make=_camera_pair, minutes=0.6),
        "visibility": Run(makes=("visibility",), make=_visibility, minutes=0.4),
        CHECKED: Run(makes=(CHECKED,), make=_checks, minutes=0.4, quick="same"),
    }
)
"""All runs by name."""
ALL_RESULTS = tuple(name for run in RUNS.values() for name in run.makes)


# --- What is there, and what is missing -------------------------------------------------------------------------------


def read_results(folder: Path, quick: bool = False) -> dict[str, Result]:
    """Those results in a folder that the page knows of, by name.

    Raises InputError where a file is not what a run has written.
    """
    found: dict[str, Result] = {}
    for path in sorted([*folder.glob("*.json"), *(folder / PANORAMA).glob("*.json")]):
        name = path.relative_to(folder).with_suffix("").as_posix()
        if name in (*ALL_RESULTS, *READ_ONLY) or name.startswith(PANORAMA):
            result = storage.read_json(path)
            if not isinstance(result, dict) or (name.startswith(PANORAMA) and "method" not in result):
                raise InputError(f"{path}: it does not hold the results of a run; delete it")
            found[name] = {**result, "quick": True} if quick else result
    return found


def gather(folder: Path, given: Path | None) -> dict[str, Result]:
    """All results: reduced ones only where there are no others. Raises InputError where ``given`` holds none."""
    if given is not None and not given.is_dir():
        raise InputError(f"--results {given}: no such folder")
    others = {} if given is None else read_results(given)
    if given is not None and not others:
        raise InputError(f"--results {given}: there are no results in it; give a folder like benchmarks/results")
    return {**read_results(folder / "results-quick", quick=True), **others, **read_results(folder / "results")}


def needed_results(items: Sequence[Item]) -> tuple[str, ...]:
    """Names of the results that items are judged by."""
    patterns = dict.fromkeys(each.source for finding in judge({}, items) for each in finding.comparisons)
    return tuple(name for name in ALL_RESULTS if any(fnmatch(name, pattern) for pattern in patterns))


def missing(items: Sequence[Item], results: Results, quick: bool) -> dict[str, tuple[str, ...]]:
    """By run: what it has to make. A reduced result is enough for --quick only."""
    there = {name for name, result in results.items() if quick or not result.get("quick")}
    for method in METHODS:
        if len(panoramas(results, method)) >= SUBJECTS:  # of whatever subjects
            there |= {name for name in ALL_RESULTS if fnmatch(name, f"{PANORAMA}*-{method}")}
    left = set(needed_results(items)) - there
    found = {}
    for name, run in RUNS.items():
        asked = run.makes if not quick else () if run.quick == "none" else run.quick_makes or run.makes
        wanted = tuple(each for each in asked if each in left)
        if wanted:
            found[name] = wanted
    return found


def run_missing(
    folder: Path,
    wanted: Mapping[str, tuple[str, ...]],
    *,
    quick: bool,
    workers: int | None = None,
    progress: Progress = silent,
) -> dict[str, str]:
    """Run what is missing; for each run that failed the reason, in one line. See :func:`run_grid`."""
    records = folder / "work" / "runs"
    shutil.rmtree(records, ignore_errors=True)  # What is done is told by the results; what failed is tried again.
    cases = [Case(name=name, parameters={"run": name}) for name in sorted(wanted, key=lambda each: -RUNS[each].minutes)]
    outcomes = run_grid(
        cases,
        partial(run_one, folder=folder.resolve(), wanted=dict(wanted), quick=quick),
        records,
        workers=workers,
        stage="runs",
        progress=progress,
    )
    return {outcome.case.name: outcome.failure for outcome in outcomes if outcome.failure is not None}


def run_one(*, run: str, folder: Path, wanted: Mapping[str, tuple[str, ...]], quick: bool) -> dict[str, Value]:
    """Make the results of a run that are missing; each is written as soon as it is there."""
    reduced = quick and RUNS[run].quick == "reduced"
    target = folder / ("results-quick" if reduced else "results")
    wall, cpu = time.perf_counter(), _cpu_s()
    task = Task(name=run, folder=folder, quick=reduced, wanted=wanted[run])
    for name, result in RUNS[run].make(task):
        storage.write_json(target / f"{name}.json", {**result, **conditions()})
    return {"wall_s": round(time.perf_counter() - wall, 1), "cpu_s": round(_cpu_s() - cpu, 1)}


def _cpu_s() -> float:
    """CPU seconds of this process and of the programs that it has run."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system
