"""A second opinion on distances: CloudCompare's, beside cuspid's, from the same points to the same surface.

    python benchmarks/cloudcompare.py POINTS MESH [POINTS MESH ...] [--out FILE.json]

POINTS is a cloud or a mesh, of which the vertices count; each is compared with the MESH after it, both as they lie (no
alignment). CloudCompare must be installed (Debian's package ``cloudcompare``); it is run without a display. It computes
in float32, so that some 0.01 um of difference are rounding at the size of a jaw.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from cuspid.model.mesh import Mesh
from cuspid.storage import write_json

PROGRAMS = ("CloudCompare", "cloudcompare.CloudCompare")


def distances_by_cloudcompare(points: Float[np.ndarray, "n 3"], mesh: Mesh) -> Float[np.ndarray, "n"]:
    """Unsigned distances of points from a mesh, in their unit, as CloudCompare finds them (cloud to mesh)."""
    program = next((found for name in PROGRAMS if (found := shutil.which(name))), None)
    if program is None:
        raise SystemExit("CloudCompare is not installed (Debian: apt-get install cloudcompare)")
    with tempfile.TemporaryDirectory() as folder:
        cloud, surface, result = (Path(folder) / name for name in ("points.ply", "mesh.ply", "distances.asc"))
        trimesh.PointCloud(points).export(cloud)
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(surface)
        asked = ["-SILENT", "-AUTO_SAVE", "OFF", "-O", str(cloud), "-O", str(surface), "-C2M_DIST"]
        saved = ["-C_EXPORT_FMT", "ASC", "-PREC", "9", "-SAVE_CLOUDS", "FILE", str(result)]
        environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
        subprocess.run([program, *asked, *saved], check=True, capture_output=True, env=environment)
        table = np.loadtxt(result, comments="//", ndmin=2)
    if len(table) != len(points):
        raise SystemExit(f"CloudCompare returned {len(table)} distances of {len(points)} points")
    return np.abs(table[:, -1])


def row(points_file: Path, mesh_file: Path) -> dict[str, Any]:
    """Both opinions on one pair, um of the files' own millimetres."""
    points = np.asarray(trimesh.load(points_file, process=False).vertices, dtype=np.float64)
    loaded = trimesh.load(mesh_file, process=False)
    mesh = Mesh(np.asarray(loaded.vertices, dtype=np.float64), np.asarray(loaded.faces))
    ours, theirs = mesh.closest(points)[0], distances_by_cloudcompare(points, mesh)
    apart = 1000 * np.abs(ours - theirs)
    return {
        "points": points_file.name,
        "mesh": mesh_file.name,
        "count": len(points),
        "mean_um": 1000 * float(ours.mean()),
        "cloudcompare_mean_um": 1000 * float(theirs.mean()),
        "p95_um": 1000 * float(np.quantile(ours, 0.95)),
        "cloudcompare_p95_um": 1000 * float(np.quantile(theirs, 0.95)),
        "apart_rms_um": float(np.sqrt(np.mean(apart**2))),
        "apart_p99_um": float(np.quantile(apart, 0.99)),
        "apart_max_um": float(apart.max()),
    }


def main() -> None:
    """Compare the pairs that are given, a line each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="+", type=Path, metavar="POINTS MESH")
    parser.add_argument("--out", type=Path, help="JSON of all figures")
    arguments = parser.parse_args()
    if len(arguments.pairs) % 2:
        parser.error("files come in pairs: POINTS MESH")
    rows = []
    for points, mesh in zip(arguments.pairs[::2], arguments.pairs[1::2], strict=True):
        rows.append(row(points, mesh))
        print("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{v}" for k, v in rows[-1].items()), flush=True)
    if arguments.out is not None:
        write_json(arguments.out, {"pairs": rows})


if __name__ == "__main__":
    main()
