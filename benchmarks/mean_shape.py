"""Measure the mean shape: time and memory, independence of the first sample, and the error against a known mean.

    python benchmarks/mean_shape.py [--out benchmarks/results/mean_shape.json] [--work FOLDER] [--count 40]

Phantoms are made once and kept in the work folder. *Population*: drawn from the lower jaws of
Table 2.1; the mean is found twice, each time in a process of its own, from two different first samples, and the two
means are compared. *Known mean*: one
phantom, meshed anew for every sample and deformed by three smooth fields whose weights sum to zero, so that the phantom
itself is the mean.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from run import conditions
from scipy.linalg import subspace_angles

from cuspid import storage
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.anatomy.shape.mean import MeanShapeOptions, mean_shape, vertex_areas
from cuspid.geometry import best_similarity
from cuspid.model.jaw import GUM, Jaw, Landmark
from cuspid.model.mesh import Mesh
from cuspid.runtime.workers import usable_cores
from cuspid.storage import read_shape_model, write_shape_model
from cuspid_thesis.samples import MEAN_GROUP, iteration, make_phantom, make_population

KNOWN = 6
"""Samples with a known mean."""


def run_timed(folder: Path, first: str, out: Path) -> dict[str, float]:
    """The mean shape of a folder of jaws in a process of its own, from reading the jaws to the written model."""
    begin = time.perf_counter()
    process = subprocess.Popen([sys.executable, __file__, "--model", first, str(folder), str(out)])
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"the mean shape from {first} failed with status {os.waitstatus_to_exitcode(status)}")
    return {
        "wall_s": round(time.perf_counter() - begin, 1),
        "cpu_s": round(usage.ru_utime + usage.ru_stime, 1),
        "peak_gib": round(usage.ru_maxrss / 2**20, 2),
    }


def find_model(first: str, folder: Path, out: Path) -> None:
    """What is timed."""
    jaws = {path.stem: storage.read_jaw(path) for path in sorted(folder.glob("*.ply"))}
    write_shape_model(out, mean_shape(jaws, MeanShapeOptions(first=first)))


def quantiles_um(distances_mm: np.ndarray) -> dict[str, float]:
    """Median, 95th percentile and largest."""
    values = np.percentile(1e3 * distances_mm, [50, 95, 100])
    return dict(zip(("median_um", "p95_um", "max_um"), values.round(2).tolist(), strict=True))


def surface_distances(one: Jaw, other: Jaw) -> dict[str, dict[str, float]]:
    """Distances from the vertices of one surface to the other: all, on teeth, on gum."""
    distances = other.mesh.closest(one.mesh.vertices)[0]
    on_tooth = np.zeros(len(distances), dtype=bool)
    on_tooth[one.mesh.faces[np.asarray(one.face_labels) != GUM]] = True
    return {
        "all": quantiles_um(distances),
        "teeth": quantiles_um(distances[on_tooth]),
        "gum": quantiles_um(distances[~on_tooth]),
    }


def landmark_distance_um(one: Jaw, other: Jaw) -> float:
    """Largest distance between landmarks with the same label."""
    apart = [np.linalg.norm(point.position - other.landmarks[label].position) for label, point in one.landmarks.items()]
    return float(1e3 * np.max(apart))


def widths_mm(jaw: Jaw) -> tuple[float, float, float]:
    """Arch dimensions a, b and c by the landmarks of a lower jaw."""

    def wide(position: int, point: str) -> float:
        ends = [jaw.landmarks[f"{quadrant + position}.{point}"].position for quadrant in (30, 40)]
        return float(np.linalg.norm(ends[1] - ends[0]))

    return wide(3, "cusp_tip"), wide(6, "buccal_groove"), wide(7, "buccal_groove")


def population(work: Path, count: int, edge_mm: float) -> dict[str, object]:
    """Two means of one population of phantoms."""
    folder = work / f"population-{edge_mm:g}-{count}"
    widths = np.array([widths_mm(jaw) for jaw in make_population(folder, count, edge_mm).values()])
    result: dict[str, object] = {"group": MEAN_GROUP, "count": len(widths), "edge_mm": edge_mm}
    models = {}
    for first in ("00", "01"):
        out = work / f"model-{edge_mm:g}-{count}-{first}"
        timing = run_timed(folder, first, out)
        models[first] = read_shape_model(out)
        result[f"first_{first}"] = {**timing, **iteration(models[first])}
        print(first, timing, flush=True)
    one, other = models["00"].mean, models["01"].mean
    result["a_b_c_mm"] = {"mean_of_the_jaws": widths.mean(axis=0).tolist(), "of_the_mean_jaw": widths_mm(one)}
    result["landmarks_apart_um"] = landmark_distance_um(one, other)
    result["surfaces_apart"] = {"00_to_01": surface_distances(one, other), "01_to_00": surface_distances(other, one)}
    return result


# A known mean


def rigid_fields(points: np.ndarray) -> np.ndarray:
    """The six infinitesimal rigid motions of points (p, 3), as columns (3 p, 6)."""
    turns = [np.cross(axis, points) for axis in np.eye(3)]
    moves = [np.broadcast_to(axis, points.shape) for axis in np.eye(3)]
    return np.stack([*turns, *moves]).reshape(6, -1).T


def known_fields(points: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """Displacement fields (3, p, 3), mm: width, length, a ripple as short as a tooth; not rigid at the landmarks."""

    def raw(places: np.ndarray) -> np.ndarray:
        x, y, z = places.T / 25.0
        wide = np.stack([x, 0.3 * x**2, 0.4 * np.cos(2 * x)], axis=1)
        long = np.stack([0.5 * np.sin(3 * y), -y * np.abs(y), 0.5 * np.sin(2 * y + z)], axis=1)
        ripple = np.stack([0 * x, 0.5 * np.sin(40 * z), np.sin(30 * x) * np.cos(30 * y)], axis=1)
        return np.stack([0.7 * wide, 0.4 * long, 0.15 * ripple]).reshape(3, -1).T

    part = np.linalg.lstsq(rigid_fields(landmarks), raw(landmarks), rcond=None)[0]
    return np.asarray((raw(points) - rigid_fields(points) @ part).T.reshape(3, -1, 3))


def deformed(jaw: Jaw, weights: np.ndarray, landmarks: Mapping[str, Landmark]) -> Jaw:
    """A jaw moved by the known fields with the given weights (3,)."""
    places = np.stack([point.position for point in landmarks.values()])
    at_landmarks = places + np.einsum("k,kpd->pd", weights, known_fields(places, places))
    vertices = jaw.mesh.vertices + np.einsum("k,kpd->pd", weights, known_fields(jaw.mesh.vertices, places))
    moved = {label: Landmark(place) for label, place in zip(landmarks, at_landmarks, strict=True)}
    return replace(jaw, mesh=Mesh(vertices, jaw.mesh.faces), landmarks=moved)


def known_mean(work: Path, edge_mm: float) -> dict[str, object]:
    """The error of the mean and of the modes where both are known."""
    base = make_phantom(work / f"base-{edge_mm:g}.ply", PhantomOptions(edge_mm=edge_mm))
    weights = np.random.default_rng(0).standard_normal((KNOWN, 3))
    weights -= weights.mean(axis=0)
    jaws = {}
    for number in range(KNOWN):
        edge = edge_mm * (1 + 0.03 * (number + 1))
        meshed = make_phantom(work / f"base-{edge:g}.ply", PhantomOptions(edge_mm=edge))
        jaws[f"{number:02d}"] = deformed(meshed, weights[number], base.landmarks)
    meshing = surface_distances(meshed, base)
    model = mean_shape(jaws)
    mean = _onto_landmarks(model.mean, base)
    places = np.stack([point.position for point in base.landmarks.values()])
    known = _along_normals(mean.mesh, known_fields(mean.mesh.vertices, places))
    found = _along_normals(mean.mesh, model.modes[:3])
    return {
        "count": KNOWN,
        "edge_mm": edge_mm,
        **iteration(model),
        "samples_to_known_mean": surface_distances(jaws["00"], base),
        "another_meshing_to_known_mean": meshing,
        "mean_to_known_mean": surface_distances(mean, base),
        "known_mean_to_mean": surface_distances(base, mean),
        "largest_angle_between_modes_deg": np.rad2deg(subspace_angles(known, found)).round(2).tolist(),
    }


def _onto_landmarks(jaw: Jaw, reference: Jaw) -> Jaw:
    """The jaw, moved rigidly so that its landmarks lie best on the reference's."""
    labels = sorted(jaw.landmarks)
    own, other = (np.stack([one.landmarks[label].position for label in labels]) for one in (jaw, reference))
    _, turn, _ = best_similarity(own, other)
    vertices = (jaw.mesh.vertices - own.mean(axis=0)) @ turn.T + other.mean(axis=0)
    return replace(jaw, mesh=Mesh(vertices, jaw.mesh.faces))


def _along_normals(mesh: Mesh, fields: np.ndarray) -> np.ndarray:
    """What of displacement fields changes the surface, weighted by area, as columns."""
    weights = np.sqrt(vertex_areas(mesh) / mesh.face_areas.sum())
    return np.asarray(np.einsum("kvd,vd,v->vk", fields, mesh.vertex_normals, weights))


def main() -> None:
    """Measure and keep the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/mean_shape.json"))
    parser.add_argument("--work", type=Path, default=Path("build/benchmarks/mean-shape"))
    parser.add_argument("--count", type=int, default=40, help="phantoms of the population")
    parser.add_argument("--edge-mm", type=float, default=0.28, help="0.28 gives some 200 000 faces")
    parser.add_argument("--model", nargs=3, metavar=("FIRST", "FOLDER", "OUT"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.model:
        first, folder, out = options.model
        find_model(first, Path(folder), Path(out))
        return
    result = {
        "population": population(options.work, options.count, options.edge_mm),
        "known_mean": known_mean(options.work, options.edge_mm),
        "threads": usable_cores(),
        **conditions(),
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
