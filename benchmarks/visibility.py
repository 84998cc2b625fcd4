"""Measure how long it takes to tell what a handpiece sees, and what the designs see of each surface.

    python benchmarks/visibility.py [--out benchmarks/results/visibility.json]

*Arch*: a phantom of about 200 000 faces, twelve cameras, the whole scan path of 100 positions. *Molar*: the second
molar of the same jaw at 5 mm, ten positions. One process that starts no threads. *Preparation* is what is done once for
a mesh: normals and Embree's tree (with one position); compiling is not timed.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

from run import conditions

from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.anatomy.surfaces import named_surfaces
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import twelve_cameras
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece
from cuspid.model.visibility import (
    VisibilityOptions,
    scannable_faces,
    survey_visibility,
    visible_counts,
)
from cuspid.storage import write_json
from cuspid_thesis.samples import path_over, surfaces_seen

EDGE_MM = 0.29
"""Edges that give the phantom about 200 000 faces."""
TOOTH = 47
"""The second molar."""


def timed(work: Callable[[], object]) -> dict[str, float]:
    """Wall and CPU seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return {"wall_s": round(time.perf_counter() - wall, 2), "cpu_s": round(time.process_time() - cpu, 2)}


def measure(jaw: Jaw, handpiece: Handpiece, poses: tuple[Rigid3, ...]) -> dict[str, object]:
    """Times of the three questions."""
    options = VisibilityOptions()
    return {
        "faces": len(jaw.mesh.faces),
        "cameras": len(handpiece.rig.names),
        "positions": len(poses),
        "scannable": timed(lambda: scannable_faces(jaw.mesh, handpiece, poses, options)),
        "counts": timed(lambda: visible_counts(jaw.mesh, handpiece, poses, options)),
        "survey": timed(lambda: survey_visibility(jaw.mesh, handpiece, poses, options)),
    }


def main() -> None:
    """Run all and write one JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/visibility.json"))
    out = parser.parse_args().out
    jaw, handpiece = build_phantom(PhantomOptions(edge_mm=EDGE_MM)), twelve_cameras()
    arch, molar = path_over(jaw, handpiece, None), path_over(jaw, handpiece, TOOTH)
    survey_visibility(jaw.mesh, handpiece, molar[:1], VisibilityOptions())
    fresh = Mesh(jaw.mesh.vertices, jaw.mesh.faces)
    result = {
        "load_average": os.getloadavg()[0],
        "preparation": timed(lambda: visible_counts(fresh, handpiece, molar[:1], VisibilityOptions())),
        "naming": timed(lambda: named_surfaces(jaw)),
        "arch": measure(jaw, handpiece, arch),
        "molar": measure(jaw, handpiece, molar),
        "surfaces": surfaces_seen(jaw, arch),
        **conditions(),
    }
    write_json(out, result)
    print(json.dumps({name: result[name] for name in ("preparation", "naming", "arch", "molar")}, indent=1))


if __name__ == "__main__":
    main()
