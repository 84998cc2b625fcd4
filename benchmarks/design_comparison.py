"""Six cameras that are turned against twelve, and both against handpieces that were found with fewer cameras.

    python benchmarks/design_comparison.py [--work FOLDER] [--workers 1] [--report] [--full-size]

Every scan is one tooth. All scans have images of half the size of the thesis' (250 x 250 px), which take a quarter of
the time; ``--full-size`` repeats the most important ones with its 500 x 500 px and writes a JSON of its own. A killed
run goes on where it stopped; ``--report`` writes the results of what is done without scanning.

The found handpieces are in benchmarks/designs, made from the briefs beside them by

    cuspid jaw phantom --edge-mm 0.5 --out jaw.ply
    cuspid rig design benchmarks/designs/ten-found.toml --jaw jaw.ply --out ten-found --noise.sigma-px 0.048
        --noise.convergence-deg None --noise.deformation 0.52
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from run import conditions

from cuspid.cli.comparison import save_pictures
from cuspid.pipeline.scan import SimulationOptions
from cuspid.storage import write_json
from cuspid.studies.design_comparison import (
    ComparisonOptions,
    Row,
    comparison_rows,
    enough_turns,
    markdown,
    prepare_comparison,
    scan_case,
)
from cuspid.studies.grid import Case, Outcome, run_grid
from cuspid.studies.trial import TrialOptions

FOUND = ("ten-found", "eight-found", "six-found")
STILL = ("twelve", "ten-found", "eight-found")
SCALE = 0.5
"""Of the images, unless all of their pixels are asked for: four times as fast."""
OPTIONS = ComparisonOptions(
    designs=("twelve", "six", "four", *(f"benchmarks/designs/{name}.json" for name in FOUND)),
    turned=("four", "six", "six-found"),
    turns=(1, 3, 5, 7),
    jaws=("phantom", "boxed-mean", "thesis-reference"),
    tooth=(46, 41, 36),
)
TRIAL = TrialOptions(simulation=SimulationOptions(supersampling=1))


def scans(jaw: str, tooth: int, designs: Mapping[str, Sequence[int]], seed: int = 0) -> list[Case]:
    """Designs with their numbers of turns, on one tooth."""
    return [
        Case(
            name=f"{jaw}_{tooth}_{design}_{number}_{seed}",
            parameters={"jaw": jaw, "tooth": tooth, "design": design, "turns": number, "seed": seed},
        )
        for design, turns in designs.items()
        for number in turns
    ]


ONCE = dict.fromkeys(STILL, (1,))
CASES: tuple[Case, ...] = (
    *scans("phantom", 46, {**ONCE, "six": (1, 3), "six-found": (3,)}),
    *scans("boxed-mean", 46, {**ONCE, "six": (1, 3), "four": (3,)}),
    *scans("phantom", 46, {"six": (5,)}),
    *scans("thesis-reference", 36, {**ONCE, "six": (3,)}),
    *scans("phantom", 46, ONCE, seed=1),
    *scans("boxed-mean", 46, {"six": (5,)}),
    *scans("phantom", 41, {**ONCE, "six": (3,)}),
    *scans("phantom", 46, ONCE, seed=2),
    *scans("boxed-mean", 46, {"four": (5,), "six": (7,)}),
    *scans("thesis-reference", 36, {"six": (1, 5)}),
    *scans("phantom", 41, {"six": (1, 5), "six-found": (3,)}),
    *scans("phantom", 46, {"four": (1, 3, 5)}),
    *scans("phantom", 46, {"six": (3,)}, seed=1),
    *scans("phantom", 46, {"six": (3,)}, seed=2),
    *scans("phantom", 41, ONCE, seed=1),
    *scans("phantom", 41, ONCE, seed=2),
)
"""In the order in which they are run: what matters most first."""
FULL_SIZE: tuple[Case, ...] = (
    *scans("phantom", 46, {**ONCE, "six": (3,)}),
    *scans("boxed-mean", 46, {"twelve": (1,), "six": (3,)}),
)
"""With the thesis' own images."""


def summary(
    options: ComparisonOptions, cases: Sequence[Case], outcomes: Sequence[Outcome], rows: Sequence[Row]
) -> dict[str, object]:
    """Each scan, and means over the seeds."""
    return {
        "options": options,
        "trial": TRIAL,
        "enough_turns": enough_turns(rows, options),
        "not_run": len(cases) - len(outcomes),
        "rows": rows,
        "scans": {each.case.name: each.failure or each.figures for each in outcomes},
        **conditions(),
    }


def main() -> None:
    """Scan what is left, then write one JSON and the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--work", type=Path, default=Path("build/design-comparison"))
    parser.add_argument("--pictures", type=Path, default=Path("docs/images"))
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--report", action="store_true", help="only write what is done")
    parser.add_argument("--full-size", action="store_true", help="images of 500 x 500 px, few scans")
    arguments = parser.parse_args()
    wanted, scale, name = (
        (FULL_SIZE, 1.0, "design_comparison_full_size") if arguments.full_size else (CASES, SCALE, "design_comparison")
    )
    folder, options = (arguments.work / name).resolve(), replace(OPTIONS, image_scale=scale)
    prepare_comparison(folder, options)
    cases = [case for case in wanted if not arguments.report or (folder / "cases" / f"{case.name}.json").exists()]
    work = partial(scan_case, folder=folder, options=options, trial=TRIAL)
    outcomes = run_grid(
        cases,
        work,
        folder,
        workers=arguments.workers,
        progress=lambda stage, done, total: print(f"{done} of {total} scans"),
    )
    rows = comparison_rows(outcomes, options)
    write_json(arguments.out / f"{name}.json", summary(options, wanted, outcomes, rows))
    save_pictures(folder, rows, options)
    if not arguments.full_size:
        for picture in ("comparison", "surfaces"):
            (arguments.pictures / f"design-{picture}.png").write_bytes((folder / f"{picture}.png").read_bytes())
    print(markdown(rows))


if __name__ == "__main__":
    main()
