"""The practical study of a pair of cameras (thesis 3.5.1): `cuspid study sweep` for each surface, beside
thesis and theory.

    python benchmarks/camera_sweep.py [--surface occlusal incisal ...] [--work build/sweeps] [--workers 2]

Each surface is a run of the command line in its own folder; what is finished there is not run again. The results go to
benchmarks/results/camera_sweep.json, the maps to docs/images. Surfaces that are not asked for keep their results.
"""

from __future__ import annotations

import argparse
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from run import conditions, run_timed

from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.model.jaw import Jaw
from cuspid.storage import read_json, write_json
from cuspid.studies.camera_pair import CameraPairOptions, Row, Term, best_pairs, study_camera_pair
from cuspid.studies.camera_sweep import SweepOptions
from cuspid_thesis.runs import SWEPT, sweep_arguments, sweep_result

SURFACES = ("occlusal", "incisal", "buccal", "lingual", "labial")
IN_THEORY = ("occlusal", "buccal", "lingual")
"""Surfaces that the theoretical study faces."""


def measure(surface: str, work: Path, workers: int) -> dict[str, object]:
    """Run or finish the sweep of a surface, and what came of it."""
    out = work / surface
    before = len(list((out / "cases").glob("*.json"))) if out.exists() else 0
    arguments = sweep_arguments(surface, SWEPT.get(surface, 1))
    load = os.getloadavg()[0]
    timed = run_timed(*arguments, "--out", str(out), "--workers", str(workers))
    shutil.copy(out / "sweep.png", Path("docs/images") / f"sweep-{surface}.png")
    record = work / f"{surface}.run.json"
    if before == 0:  # only a sweep that was run in one go says how long it takes
        write_json(record, {**timed, "workers": workers, "load_before": load, "load_after": os.getloadavg()[0]})
    run = read_json(record) if record.exists() else None
    return {**sweep_result(out, arguments), "run": run}


def theory(jaw: Jaw, surface: str) -> dict[str, object]:
    """The same grid in the theoretical study, of one position of a steady pair: the best, and the thesis' setting."""
    options = SweepOptions(surface=surface)
    rows = study_camera_pair(
        jaw,
        CameraPairOptions(
            tooth=options.chosen_tooth,
            facing=(surface,),
            direction=options.chosen_direction,
            baselines_mm=options.baseline_mm,
            axis_angles_deg=options.angle_deg,
            distances_mm=(options.distance_mm,),
        ),
    )
    terms: Sequence[Term] = ("seen_pct", "expected_rms_um", "within_budget_pct")
    at_thesis = next(
        row
        for row in rows
        if row["surface"] == surface and (row["baseline_mm"], row["axis_angle_deg"]) == options.thesis
    )
    return {"best": {term: brief(best_pairs(rows, term)[0]) for term in terms}, "thesis": brief(at_thesis)}


def brief(row: Row) -> Row:
    """Setting and terms."""
    names = ("baseline_mm", "axis_angle_deg", "seen_pct", "expected_rms_um", "within_budget_pct")
    return {name: row[name] for name in names}


def main() -> None:
    """Run what is asked for and add it to the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--surface", nargs="*", default=SURFACES, choices=SURFACES)
    parser.add_argument("--work", type=Path, default=Path("build/sweeps"))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/camera_sweep.json"))
    arguments = parser.parse_args()
    found = read_json(arguments.out)["surfaces"] if arguments.out.exists() else {}
    jaw = build_phantom(PhantomOptions())
    for surface in arguments.surface:
        found[surface] = measure(surface, arguments.work, arguments.workers)
        if surface in IN_THEORY:
            found[surface]["theory"] = theory(jaw, surface)
        write_json(arguments.out, {"surfaces": found, **conditions()})


if __name__ == "__main__":
    main()
