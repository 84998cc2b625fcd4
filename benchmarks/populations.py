"""Measure whether populations of phantoms have the dimensions they are drawn from, and how long a phantom takes.

python benchmarks/populations.py --out benchmarks/results/populations.json [--count 24]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from run import conditions

from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid_thesis.samples import measure_populations

EDGE_MM = 0.28
"""Edge of the faces for the timing: about 200 000 faces."""


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
    result = {"groups": measure_populations(options.count), "build": timing(), **conditions()}
    options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
