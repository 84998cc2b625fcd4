"""The theoretical study of a pair of cameras over a lower second molar (thesis 3.4), and the matching noise in it.

    python benchmarks/camera_pair.py [--out benchmarks/results/camera_pair.json] [--pictures docs/images]

*Matching*: noise of both matchers on rendered pairs 5 mm from the phantom, the law fitted to it, and, as a check, the
law that the package holds against other baselines, another distance and another texture than it was fitted to. *Study*:
baseline, axis angle and distance for the occlusal, buccal and lingual surface with that law.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from run import conditions

from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.model.jaw import Jaw
from cuspid.report.figures.precision import Panel, save_best_picture, save_maps_picture, save_noise_picture
from cuspid.storage import write_json
from cuspid.studies.camera_pair import (
    MATCHING,
    CameraPairOptions,
    Matcher,
    Row,
    best_pairs,
    study_camera_pair,
    table,
)
from cuspid.studies.matching_noise import MatchingNoiseOptions, MatchingSamples, bin_samples, fit_noise, sample_matching

EDGE_MM = 0.3
EDGES = (0.0, 0.03, 0.06, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.3)
"""Bins of the deformation."""
FITTED_SHARE_PCT = 95.0
"""Only bins with as many matches are fitted: elsewhere the limit of 1 px cuts the errors off."""
FITTED = MatchingNoiseOptions(baselines_mm=(0.5, 1.0, 2.0, 3.0, 4.0))
CHECKED = MatchingNoiseOptions(baselines_mm=(1.5, 3.5), distance_mm=7.0, seed=1)
COLUMNS = ("bound_centre_um", "bound_rms_um", "seen_pct", "noise_growth", "expected_rms_um", "within_budget_pct")


def matching(jaw: Jaw, pictures: Path) -> dict[str, object]:
    """Bins, fits and their check for each matcher, and a picture."""
    fitted = sample_matching(jaw, FITTED, np.random.default_rng(0))
    checked = sample_matching(jaw, CHECKED, np.random.default_rng(1))
    bins = {str(name): bin_samples(samples, EDGES) for name, samples in fitted.items()}
    laws = {str(name): (law.noise.sigma_px, law.noise.deformation or np.inf) for name, law in MATCHING.items()}
    save_noise_picture(
        pictures / "camera-pair-noise.png",
        bins,
        laws,
        title="Noise of matching on rendered pairs of the textured molar",
    )
    found: dict[str, object] = {}
    for name in MATCHING:
        rows = bins[name]
        fit = fit_noise([row for row in rows if row["matched_pct"] >= FITTED_SHARE_PCT])
        found[name] = {
            "fitted_sigma_px": fit.sigma_px,
            "fitted_doubling": fit.doubling,
            "held_sigma_px": laws[name][0],
            "held_doubling": laws[name][1],
            "check": against_law(checked[name], laws[name]),
            "bins": rows,
            "by_convergence": bin_samples(fitted[name], (0, 8, 15, 28, 40, 50), "convergence_deg"),
        }
    return found


def against_law(samples: MatchingSamples, law: tuple[float, float]) -> list[dict[str, float]]:
    """Measured over expected noise of samples that the law was not fitted to, by bins."""
    sigma_px, doubling = law
    rows = [row for row in bin_samples(samples, EDGES) if row["matched_pct"] >= FITTED_SHARE_PCT]
    expected = [sigma_px * float(np.hypot(1, (row["low"] + row["high"]) / 2 / doubling)) for row in rows]
    return [
        {"low": row["low"], "high": row["high"], "measured_over_law": row["sigma_px"] / value}
        for row, value in zip(rows, expected, strict=True)
    ]


def study(jaw: Jaw) -> tuple[dict[Matcher, tuple[Row, ...]], float]:
    """Rows for each matcher, and CPU seconds for one of them."""
    start = time.process_time()
    rows = {matcher: study_camera_pair(jaw, CameraPairOptions(matcher=matcher)) for matcher in MATCHING}
    return rows, (time.process_time() - start) / len(rows)


def draw(rows: dict[Matcher, tuple[Row, ...]], pictures: Path) -> None:
    """Maps of the terms apart and together, and the best baseline."""
    for surface in ("occlusal", "buccal"):
        save_terms(rows, surface, pictures)
    curves = {
        f"{matcher} window: {surface}": {
            f"{angle:g}°": curve([row for row in found if row["axis_angle_deg"] == angle], surface)
            for angle in (0.0, 10.0, 20.0, 30.0, 40.0)
        }
        for matcher, found in rows.items()
        for surface in ("occlusal", "buccal")
    }
    save_best_picture(
        pictures / "camera-pair-best.png",
        curves,
        title="Baseline with the largest share of the surface within 10 µm, by the angle of the axes",
    )


def save_terms(rows: dict[Matcher, tuple[Row, ...]], surface: str, pictures: Path) -> None:
    """The terms for parallel axes, and the angle that both cameras see most with."""

    def panel(title: str, unit: str, column: str, matcher: Matcher = "slanted") -> Panel:
        values = table(rows[matcher], surface, column, axis_angle_deg=0.0)[2]
        return Panel(title=title, unit=unit, values=values, best="most" if unit == "%" else "least")

    panels = (
        panel("bound at the middle, constant noise", "µm", "bound_centre_um"),
        panel("seen by both", "%", "seen_pct"),
        panel("noise growth, upright window", "", "noise_growth", "upright"),
        panel("expected RMS, slanted window", "µm", "expected_rms_um"),
        panel("expected RMS, upright window", "µm", "expected_rms_um", "upright"),
        panel("noise growth, slanted window", "", "noise_growth"),
        panel("within 10 µm, slanted window", "%", "within_budget_pct"),
        panel("within 10 µm, upright window", "%", "within_budget_pct", "upright"),
    )
    best = best_angles(rows["slanted"], surface)
    baselines, distances, _ = table(rows["slanted"], surface, "seen_pct", axis_angle_deg=0.0)
    save_maps_picture(
        pictures / f"camera-pair-{surface}.png",
        (*panels, Panel(title="axis angle with most seen by both", unit="deg", values=best, best="none")),
        baselines,
        distances,
        title=f"Pair over the {surface} surface of a lower second molar, parallel axes (framed: best of the distance)",
    )


def best_angles(rows: Sequence[Row], surface: str) -> np.ndarray:
    """For each baseline and distance the axis angle with which both cameras see most."""
    options = CameraPairOptions()
    stack = np.stack([table(rows, surface, "seen_pct", axis_angle_deg=angle)[2] for angle in options.axis_angles_deg])
    return np.array(options.axis_angles_deg)[stack.argmax(axis=0)]


def curve(rows: Sequence[Row], surface: str) -> tuple[np.ndarray, np.ndarray]:
    """Distances and the baselines that are best there by the share within the budget, where it is above 1 %."""
    best = [row for row in best_pairs(rows) if row["facing"] == surface and float(row["within_budget_pct"] or 0) > 1]
    return np.array([row["distance_mm"] for row in best]), np.array([row["baseline_mm"] for row in best])


def rounded(values: np.ndarray) -> list[str]:
    """A table as one line for each baseline."""
    return [" ".join(f"{value:.2f}" for value in line) for line in values]


def main() -> None:
    """Run all and write one JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/camera_pair.json"))
    parser.add_argument("--pictures", type=Path, default=Path("docs/images"))
    arguments = parser.parse_args()
    jaw = build_phantom(PhantomOptions(edge_mm=EDGE_MM))
    noise = matching(jaw, arguments.pictures)
    rows, cpu_s = study(jaw)
    draw(rows, arguments.pictures)
    tables = {
        matcher: {
            surface: {
                f"{angle:g}_deg": {
                    column: rounded(table(found, surface, column, axis_angle_deg=angle)[2]) for column in COLUMNS
                }
                for angle in (0.0, 20.0)
            }
            for surface in ("occlusal", "buccal", "lingual")
        }
        for matcher, found in rows.items()
    }
    sides = [
        {name: row[name] for name in ("surface", "distance_mm", "seen_pct", "expected_rms_um")}
        for row in rows["slanted"]
        if row["facing"] == "occlusal"
        and row["baseline_mm"] == 2.5
        and row["axis_angle_deg"] == 0
        and row["distance_mm"] in (5.0, 9.0, 13.0)
    ]
    result = {
        "load_average": os.getloadavg()[0],
        "matching": noise,
        "cases": len(rows["slanted"]) // 5,
        "cpu_s": round(cpu_s, 1),
        "best_within_budget": {matcher: best_pairs(found) for matcher, found in rows.items()},
        "sides_seen_from_above": sides,
        "tables_baseline_down_distance_right": tables,
        **conditions(),
    }
    write_json(arguments.out, result)
    print(json.dumps({"matching": noise, "cpu_s": cpu_s}, indent=1))


if __name__ == "__main__":
    main()
