"""Scan one molar with many rigs: more or fewer cameras, nearer or farther, with smaller or larger images.

    python benchmarks/any_rig.py [--work FOLDER] [--out benchmarks/results/any_rig.json] [--only two four] [--quick]

Each rig is simulated, reconstructed and evaluated without options of its own. Finished scans are kept in the work
folder and not run again.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

from run import conditions

from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.handpiece.designs import DESIGNS, DesignOptions
from cuspid.model.jaw import Jaw
from cuspid.model.rig import Handpiece
from cuspid.pipeline.scan import SimulationOptions
from cuspid.simulation.path.scan import ScanPathOptions
from cuspid.storage import read_handpiece, write_json
from cuspid.studies.grid import Case, Value, run_grid
from cuspid.studies.trial import TrialOptions, scan

HERE = Path(__file__).parent
TOOTH = 46
CAMERAS = ("two", "four", "six", "eight", "ten", "twelve")
DISTANCES_MM = (5.0, 8.0, 12.0, 20.0)
SIZES_PX = ((320, 240), (500, 500), (640, 480), (1280, 960))
USUAL = DesignOptions()


def case(cameras: str, options: DesignOptions = USUAL) -> Case:
    """One rig; ``eight`` and ``ten`` are those that a search found (benchmarks/designs)."""
    distance_mm, width_px, height_px = options.working_distance_mm, options.width_px, options.height_px
    return Case(
        name=f"{cameras}_{distance_mm:g}mm_{width_px}x{height_px}",
        parameters={
            "cameras": cameras,
            "working_distance_mm": distance_mm,
            "width_px": width_px,
            "height_px": height_px,
        },
    )


def cases() -> dict[str, list[Case]]:
    """The rows of each table; the usual twelve stand in all of them."""
    return {
        "cameras": [case(each) for each in CAMERAS],
        "working distance": [case("twelve", replace(USUAL, working_distance_mm=each)) for each in DISTANCES_MM],
        "images": [case("twelve", replace(USUAL, width_px=width, height_px=height)) for width, height in SIZES_PX],
    }


def rig(cameras: str, working_distance_mm: float, width_px: int, height_px: int) -> Handpiece:
    """The handpiece of a case."""
    if cameras not in DESIGNS:
        return read_handpiece(HERE / "designs" / f"{cameras}-found.json")
    options = DesignOptions(width_px=width_px, height_px=height_px, working_distance_mm=working_distance_mm)
    return DESIGNS[cameras](options)


def evaluate_rig(
    *, cameras: str, working_distance_mm: float, width_px: int, height_px: int, jaw: Jaw, options: TrialOptions
) -> dict[str, Value]:
    """The figures of one scan."""
    handpiece = rig(cameras, working_distance_mm, width_px, height_px)
    with tempfile.TemporaryDirectory(prefix="cuspid-any-rig-") as folder:
        trial = scan(jaw, handpiece, Path(folder), options)
    areas, tooth = jaw.mesh.face_areas, jaw.tooth_faces(TOOTH)
    return {
        "true_distance_mm": handpiece.working_distance_mm,
        "tooth_seen_pct": float(100 * areas[tooth & trial.scannable].sum() / areas[tooth].sum()),
        **trial.figures,
    }


def asked() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("build/any-rig"))
    parser.add_argument("--out", type=Path, default=HERE / "results" / "any_rig.json")
    parser.add_argument("--only", nargs="*", help="names of cases or their beginnings; default: all")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="a coarser jaw and one ray through a pixel")
    return parser.parse_args()


def main() -> None:
    """Scan with what is asked for and write the figures."""
    arguments = asked()
    jaw = build_phantom(PhantomOptions(edge_mm=0.4) if arguments.quick else PhantomOptions())
    simulation = SimulationOptions(path=ScanPathOptions(tooth=TOOTH), supersampling=1 if arguments.quick else 2)
    options, tables = TrialOptions(simulation=simulation), cases()
    every = {each.name: each for table in tables.values() for each in table}
    chosen = [each for each in every.values() if not arguments.only or each.name.startswith(tuple(arguments.only))]
    outcomes = run_grid(
        chosen,
        partial(evaluate_rig, jaw=jaw, options=options),
        arguments.work / ("quick" if arguments.quick else "full"),
        workers=arguments.workers,
        progress=lambda stage, done, total: print(f"{stage}: {done} of {total}", flush=True),
    )
    result = {
        "tooth": TOOTH,
        "quick": arguments.quick,
        "tables": {title: [each.name for each in table] for title, table in tables.items()},
        "scans": {
            each.case.name: {**each.case.parameters, **each.figures, "failure": each.failure} for each in outcomes
        },
        **conditions(),
    }
    write_json(arguments.out, result)


if __name__ == "__main__":
    main()
