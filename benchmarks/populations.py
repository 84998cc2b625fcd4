"""Measure whether populations of phantoms have the dimensions they are drawn from, and how long a phantom takes.

python benchmarks/populations.py --out benchmarks/results/populations.json [--count 24]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from run import conditions

from cuspid.anatomy.phantom import PhantomOptions, build_phantom, phantom_landmarks
from cuspid.anatomy.population import GROUPS, Group, GroupName, draw_and_count
from cuspid.errors import InputError
from cuspid.jaw import Landmark

EDGE_MM = 0.28
"""Edge of the faces for the timing: about 200 000 faces."""


def measured(landmarks: dict[str, Landmark], group: Group) -> list[float]:
    """a, b, c and f of a jaw by its landmarks, mm."""
    negative, positive = (30, 40) if group.arch == "lower" else (10, 20)

    def ends(position: int, point: str) -> np.ndarray:
        return np.array([landmarks[f"{quadrant + position}.{point}"].position for quadrant in (negative, positive)])

    pairs = [ends(3, "cusp_tip"), ends(6, "buccal_groove"), ends(7, "buccal_groove")]
    widths = [float(np.linalg.norm(pair[1] - pair[0])) for pair in pairs]
    return [*widths, float(np.linalg.norm(pairs[2].mean(axis=0) - landmarks["papilla"].position))]


def summary(values: np.ndarray) -> dict[str, float]:
    """Mean and SD, mm."""
    return {"mean_mm": round(float(values.mean()), 3), "sd_mm": round(float(values.std(ddof=1)), 3)}


def measure_group(name: GroupName, count: int, seed: int) -> dict[str, object]:
    """Draw, place and measure one group."""
    group = GROUPS[name]
    jaws, redrawn = draw_and_count(name, count, np.random.default_rng(seed))
    asked, found, failed = [], [], []
    begin = time.process_time()
    for jaw in jaws:
        try:
            found.append(measured(phantom_landmarks(jaw), group))
            asked.append([jaw.inter_canine_mm, jaw.inter_first_molar_mm, jaw.inter_second_molar_mm, jaw.arch_length_mm])
        except InputError as error:
            failed.append(str(error))
    seconds = (time.process_time() - begin) / count
    got, drawn = np.array(found), np.array(asked, dtype=float)
    sources = (group.inter_canine, group.inter_first_molar, group.inter_second_molar, group.arch_length)
    table = {letter: spread for letter, spread in zip("abcf", sources, strict=True) if spread is not None}
    return {
        "jaws": count,
        "drawn_again": redrawn,
        "share_drawn_again": round(redrawn / (redrawn + count), 3),
        "refused": failed,
        "max_abs_asked_minus_measured_mm": round(float(np.nanmax(np.abs(got - drawn))), 4),
        "place_and_landmarks_cpu_s": round(seconds, 2),
        **{
            letter: {
                "source": {"mean_mm": spread.mean_mm, "sd_mm": spread.sd_mm},
                "measured": summary(got[:, k]),
                "z_of_mean": round(float((got[:, k].mean() - spread.mean_mm) / (spread.sd_mm / np.sqrt(len(got)))), 2),
                "sd_ratio": round(float(got[:, k].std(ddof=1) / spread.sd_mm), 3),
            }
            for k, (letter, spread) in enumerate(table.items())
        },
        **({} if "f" in table else {"f": {"measured": summary(got[:, 3])}}),
    }


def timing() -> dict[str, float | int]:
    """CPU and wall seconds of one phantom at `EDGE_MM`."""
    cpu, wall = time.process_time(), time.perf_counter()
    jaw = build_phantom(PhantomOptions(edge_mm=EDGE_MM))
    return {
        "edge_mm": EDGE_MM,
        "faces": len(jaw.mesh.faces),
        "cpu_s": round(time.process_time() - cpu, 1),
        "wall_s": round(time.perf_counter() - wall, 1),
    }


def main() -> None:
    """Measure all four groups."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/populations.json"))
    parser.add_argument("--count", type=int, default=24)
    options = parser.parse_args()
    groups = {}
    for seed, name in enumerate(GROUPS):
        groups[name] = measure_group(name, options.count, seed)
        print(name, json.dumps(groups[name]))
    result = {"groups": groups, "build": timing(), **conditions()}
    options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
