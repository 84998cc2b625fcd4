"""Measure arches: phantoms whose dimensions are known, and a folder of labelled real jaws.

    python benchmarks/measure_jaws.py --jaws FOLDER --out benchmarks/results/measure.json

The phantoms tell how far the dimensions by given and by estimated landmarks are from the known ones; for the real jaws
(named ``<subject>_lower`` or ``<subject>_upper``) the dimensions, the group table, and what table 2.1 of the thesis
makes implausible are kept. The uncertainties in use come from phantoms of seeds 100 to 103; the seeds here are others.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from run import conditions

from cuspid.anatomy.jaw_files import load_jaw
from cuspid.anatomy.landmarks.dimensions import (
    DIMENSIONS,
    ArchDimensions,
    arch_dimensions,
    group_rows,
    implausible,
    jaw_rows,
    survey,
)
from cuspid.anatomy.landmarks.estimation import with_estimates
from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.anatomy.teeth.dentition import ARCH_FORMS
from cuspid.model.jaw import Arch, Jaw

SEEDS = range(6)
ARCHES: tuple[Arch, ...] = ("lower", "upper")


def values(dimensions: ArchDimensions) -> dict[str, float]:
    """Lengths by name, mm."""
    return {name: round(found.value_mm, 3) for name in DIMENSIONS if (found := dimensions[name]) is not None}


def sigmas(dimensions: ArchDimensions) -> dict[str, float]:
    """Uncertainties by name, mm."""
    return {name: round(found.sigma_mm or 0, 3) for name in DIMENSIONS if (found := dimensions[name]) is not None}


def measure_phantom(arch: Arch, seed: int, edge_mm: float) -> dict[str, object]:
    """What is known of a phantom, and its dimensions by given and by estimated landmarks."""
    jaw = build_phantom(PhantomOptions(arch=arch, seed=seed, edge_mm=edge_mm))
    estimated = with_estimates(replace(jaw, landmarks={}))
    form = ARCH_FORMS[arch]
    given, found = arch_dimensions(jaw.landmarks, arch), arch_dimensions(estimated.landmarks, arch)
    scaled = np.array(
        [
            (point.position - jaw.landmarks[label].position) / point.estimated_sigma_mm
            for label, point in estimated.landmarks.items()
        ]
    )
    errors = [np.linalg.norm(p.position - jaw.landmarks[k].position) for k, p in estimated.landmarks.items()]
    known = (form.inter_canine_mm, form.inter_first_molar_mm, form.inter_second_molar_mm)
    return {
        "arch": arch,
        "seed": seed,
        "asked_mm": dict(zip("abc", known, strict=True)),
        "given_mm": values(given),
        "estimated_mm": values(found),
        "sigma_mm": sigmas(found),
        "landmarks": len(estimated.landmarks),
        "landmark_error_median_mm": round(float(np.median(errors)), 3),
        "landmark_error_p95_mm": round(float(np.percentile(errors, 95)), 3),
        "within_2_sigma_pct": round(100 * float(np.mean(np.abs(scaled) < 2)), 1),
    }


def summary(phantoms: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Largest deviations over the phantoms, mm: given from asked for, estimated from given."""
    table: dict[str, dict[str, float]] = {}
    for arch in ARCHES:
        rows = [row for row in phantoms if row["arch"] == arch]
        asked = {k: max(abs(row["given_mm"][k] - row["asked_mm"][k]) for row in rows) for k in "abc"}
        estimated = {k: [row["estimated_mm"][k] - row["given_mm"][k] for row in rows] for k in "abcf"}
        table[arch] = {
            **{f"{k}_given_worst_mm": round(worst, 3) for k, worst in asked.items()},
            **{f"{k}_estimated_worst_mm": round(max(map(abs, errors)), 3) for k, errors in estimated.items()},
            **{f"{k}_estimated_bias_mm": round(float(np.mean(errors)), 3) for k, errors in estimated.items()},
        }
    return table


def load(path: Path) -> tuple[Jaw, tuple[str, ...]]:
    """A real jaw with estimated landmarks."""
    arch: Arch = "upper" if path.stem.endswith("upper") else "lower"
    jaw, notes = load_jaw(path, arch=arch)
    return with_estimates(jaw), notes


def measure_folder(folder: Path) -> dict[str, object]:
    """The dimensions of every jaw of a folder."""
    found = survey({path.stem: partial(load, path) for path in sorted(folder.glob("*.ply"))})
    return {
        "jaws": jaw_rows(found),
        "groups": group_rows(found),
        "beyond_3_sd_of_table_2_1": {jaw.name: flags for jaw in found.jaws if (flags := implausible(jaw))},
        "failures": dict(found.failures),
    }


def rounded(value: object) -> object:
    """Lengths to a micrometre."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    return round(value, 3) if isinstance(value, float) else value


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jaws", type=Path, help="folder of jaws, <subject>_lower.ply, <subject>_upper.ply")
    parser.add_argument("--edge-mm", type=float, default=0.5, help="edge length of the phantoms")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/measure.json"))
    options = parser.parse_args()
    real = measure_folder(options.jaws) if options.jaws else None
    phantoms = [measure_phantom(arch, seed, options.edge_mm) for arch in ARCHES for seed in SEEDS]
    result = {
        "case": "measure",
        "phantom_edge_mm": options.edge_mm,
        "phantom_summary": summary(phantoms),
        "phantoms": phantoms,
        "real": real,
        **conditions(),
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(rounded(result), indent=1) + "\n")
    print(json.dumps(result["phantom_summary"], indent=1))


if __name__ == "__main__":
    main()
