"""Locate the frames of one simulated capture by cuspid and by COLMAP's own mapper, in one run, on the same images.

    python benchmarks/compare_motion.py SCAN/ [--methods rig colmap colmap-rig] [--out benchmarks/results]

SCAN is a folder that ``cuspid simulate`` wrote. COLMAP runs as a user would run it: pycolmap's defaults, sequential
matching, every camera a sequence of its own. The truth only evaluates the result.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from run import conditions

from cuspid import storage
from cuspid.geometry import Rigid3, best_similarity
from cuspid.motion.location import MotionOptions
from cuspid.motion.stage import MotionMethod, locate


def position_errors_um(found: Mapping[str, Rigid3], true: Mapping[str, Rigid3]) -> np.ndarray:
    """Distances between handpiece positions after the best rigid alignment of the paths (Kabsch)."""
    names = [name for name in true if name in found]
    a = np.stack([found[name].inverse().translation for name in names])
    b = np.stack([true[name].inverse().translation for name in names])
    _, rotation, _ = best_similarity(a, b)
    return 1000 * np.linalg.norm((a - a.mean(0)) @ rotation.T - (b - b.mean(0)), axis=1)


def compare(scan: Path, method: MotionMethod) -> dict[str, object]:
    """One row of the table."""
    capture, truth = storage.read_capture(scan / "capture"), storage.read_truth(scan / "truth")
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        found = locate(capture, Path(folder), MotionOptions(), method)
        seconds = time.perf_counter() - begin
    return {
        "capture": scan.name,
        "method": method,
        "models": found.log.get("models", 1),
        "frames": len(capture.frames),
        "images": len(capture.frames) * len(capture.handpiece.rig.names),
        "located": len(found.frames),
        "seconds": round(seconds, 1),
        "log": dict(found.log),
        "position_error_um": float(np.median(position_errors_um(found.rig_from_world, truth.rig_from_world))),
    }


def main() -> None:
    """Compare, print, and keep the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("--methods", nargs="+", default=["rig", "colmap", "colmap-rig"])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    rows = []
    for method in options.methods:
        rows.append(compare(options.scan, method))
        print(rows[-1], flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"rows": rows, **conditions()}, indent=1)
    (options.out / f"motion-{options.scan.name}.json").write_text(text + "\n")


if __name__ == "__main__":
    main()
