"""Check the bound: against triangulation with noise, and against the closed form; draw it over a molar.

    python benchmarks/precision.py [--out benchmarks/results/precision.json] [--pictures docs/images]

*Monte-Carlo*: points of several rigs, triangulated 20 000 times with normal noise; the scatter against the bound, for
constant noise and for noise that grows, for several seeds. *Closed form*: pairs with any turn of the cameras and points
in their plane. *Molar*: bounds of the designs over a lower second molar, at one position with noise of 0.5 px.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from run import conditions

from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.anatomy.surfaces import named_surfaces
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import essential_four, twelve_cameras
from cuspid.handpiece.precision import (
    NoiseModel,
    bound_covariance,
    bound_rms_um,
    fisher_information,
    noise_px,
    planar_pair_bound,
    precision_map,
    triangulate,
)
from cuspid.handpiece.presets import PRESETS
from cuspid.model.camera import Camera
from cuspid.model.jaw import Jaw
from cuspid.model.rig import Handpiece, MountedCamera
from cuspid.report.figures.precision import save_ellipsoids_picture, save_precision_picture
from cuspid.simulation.path.scan import ScanPathOptions, plan_scan_path
from cuspid.storage import write_json
from cuspid.studies.camera_pair import camera_pair

CAMERA = Camera.from_field_of_view(512, 512, 62.0)
TRIALS = 20_000
SEEDS = (0, 1)
TOOTH = 47
NOISE: Mapping[str, NoiseModel] = {
    "constant": NoiseModel(),
    "convergence": NoiseModel(sigma_px=0.1, convergence_deg=15.0),
    "deformation": NoiseModel(sigma_px=0.05, deformation=0.1),
    "blur": NoiseModel(sigma_px=0.1, blur_px=1.0),
}
FOUR, TWELVE = essential_four().rig, twelve_cameras().rig
RIGS: Mapping[str, tuple[MountedCamera, ...]] = {
    "pair 1 mm": tuple(camera_pair(1.0, 0.0, CAMERA).cameras.values()),
    "pair 2.5 mm": tuple(camera_pair(2.5, 0.0, CAMERA).cameras.values()),
    "pair 4 mm, 30 deg": tuple(camera_pair(4.0, 30.0, CAMERA).cameras.values()),
    "four": tuple(FOUR.cameras.values()),
    "twelve": tuple(TWELVE.cameras.values()),
}


def points_of(rig: str) -> tuple[np.ndarray, np.ndarray]:
    """Points in the frame of a rig and normals towards its cameras."""
    pair = rig.startswith("pair")
    points = np.array([[0.0, 0.0, 5.0], [0.7, -0.5, 8.0]] if pair else [[0.0, 0.0, 0.0], [1.0, 0.8, -1.0]])
    normals = np.array([[0.0, 0.0, -1.0], [0.5, 0.3, -0.8]] if pair else [[0.1, 0.0, 1.0], [0.4, 0.3, 0.9]])
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def monte_carlo() -> list[dict[str, object]]:
    """One row for each rig, noise, point and seed."""
    rows: list[dict[str, object]] = []
    for rig, cameras in RIGS.items():
        points, normals = points_of(rig)
        for noise, model in NOISE.items():
            for index in range(len(points)):
                for seed in SEEDS:
                    ratio = scatter(cameras, points[[index]], normals[[index]], model, np.random.default_rng(seed))
                    rows.append({"rig": rig, "noise": noise, "point": index, "seed": seed, **ratio})
    return rows


def scatter(
    cameras: tuple[MountedCamera, ...],
    point: np.ndarray,
    normal: np.ndarray,
    model: NoiseModel,
    rng: np.random.Generator,
) -> dict[str, float]:
    """The scatter of triangulated points over the bound: RMS, and in the direction where they differ most."""
    optics, everyone = PRESETS["thesis"], np.ones((len(cameras), 1), dtype=bool)
    sigma = noise_px(cameras, point, model, everyone, optics=optics, normals=normal)
    information = fisher_information(cameras, point, model, optics=optics, normals=normal)
    bound = bound_covariance(information)[0]
    true_px = np.stack([mounted.camera.project(mounted.cam_from_rig.apply(point)) for mounted in cameras])
    images = true_px + sigma[..., None] * rng.standard_normal((len(cameras), TRIALS, 2))
    many, deviations = np.repeat(point, TRIALS, axis=0), np.repeat(sigma, TRIALS, axis=1)
    errors = triangulate(cameras, images, many, deviations, iterations=3) - point
    found = errors.T @ errors / TRIALS
    spread = np.sqrt(np.linalg.eigvals(np.linalg.solve(bound, found)).real)
    rms = float(np.sqrt(np.trace(found) / np.trace(bound)))
    worst = float(spread[np.abs(spread - 1).argmax()])
    return {"bound_um": float(bound_rms_um(information)[0]), "rms_ratio": rms, "worst_axis_ratio": worst}


def closed_form(count: int = 500) -> float:
    """Largest relative difference between the numeric bound and the corrected Eq 3.9."""
    rng, worst = np.random.default_rng(0), 0.0
    for _ in range(count):
        baseline, first, second, x, z = rng.uniform([0.5, -20, -20, -2, 3], [5, 20, 20, 2, 13])
        cameras = tuple(
            MountedCamera(CAMERA, turned(at, yaw)) for at, yaw in ((-baseline / 2, first), (baseline / 2, second))
        )
        point = np.array([[x, 0.0, z]])
        numeric = float(np.trace(bound_covariance(fisher_information(cameras, point, NoiseModel()))[0]))
        depths = tuple(float(mounted.cam_from_rig.apply(point)[0, 2]) for mounted in cameras)
        ranges = tuple(float(np.linalg.norm(point - mounted.centre_in_rig)) for mounted in cameras)
        closed = planar_pair_bound(
            float(CAMERA.focal_px[0]), 0.5, (depths[0], depths[1]), (ranges[0], ranges[1]), baseline, z
        )
        worst = max(worst, abs(numeric / closed - 1))
    return worst


def turned(x_mm: float, yaw_deg: float) -> Rigid3:
    """``cam_from_rig`` of a camera at (x, 0, 0), turned about +Y."""
    rotation = Rigid3.from_rotation_vector(np.array([0.0, np.deg2rad(yaw_deg), 0.0]), np.zeros(3)).rotation
    return Rigid3(rotation, -rotation @ np.array([x_mm, 0.0, 0.0]))


def over_the_molar(jaw: Jaw, pictures: Path) -> list[dict[str, object]]:
    """RMS and median of the bound over each surface of the molar, and pictures."""
    tooth = jaw.tooth_faces(TOOTH)
    surfaces = {name: mask & tooth for name, mask in named_surfaces(jaw).items() if (mask & tooth).any()}
    rows: list[dict[str, object]] = []
    shown: dict[str, np.ndarray] = {}
    for name, handpiece in (("four", essential_four()), ("twelve", twelve_cameras())):
        pose = over_the_middle(jaw, handpiece)
        found = precision_map(jaw.mesh, handpiece, pose)
        shown[name] = found.rms_um[tooth]
        across = found.normal_um(jaw.mesh.face_normals)
        for surface, mask in surfaces.items():
            seen = mask & (found.cameras_at_once >= 2)
            share = float(100 * jaw.mesh.face_areas[seen].sum() / jaw.mesh.face_areas[mask].sum())
            row = {"design": name, "surface": surface, "seen_by_2_pct": share}
            figures = {"rms_um": np.median(found.rms_um[seen]), "normal_um": np.median(across[seen])} if share else {}
            rows.append({**row, **{f"median_{key}": float(value) for key, value in figures.items()}})
        if name == "four":
            save_ellipsoids(jaw, tooth, found.covariance[tooth], pictures)
    views = {"occlusal": (-90.0, 89.0), "from the cheek": (0.0, 25.0), "from the tongue": (180.0, 25.0)}
    side = 1 if jaw.mesh.face_centres[tooth, 0].mean() > 0 else -1
    views = {
        view: (azimuth if side > 0 or view == "occlusal" else 180 - azimuth, up)
        for view, (azimuth, up) in views.items()
    }
    save_precision_picture(
        pictures / "precision-molar.png",
        jaw.mesh.submesh(tooth),
        shown,
        views=views,
        limits_um=(8.0, 60.0),
        title="Bound over a lower second molar, one position, noise 0.5 px",
    )
    return rows


def over_the_middle(jaw: Jaw, handpiece: Handpiece) -> Rigid3:
    """The position of a path over the molar that is nearest to its middle, held without shaking."""
    options = ScanPathOptions(tooth=TOOTH, jitter_mm=0.0, jitter_deg=0.0)
    poses = plan_scan_path(jaw, handpiece, options, np.random.default_rng(0)).rig_from_world.values()
    middle = jaw.mesh.face_centres[jaw.tooth_faces(TOOTH)].mean(axis=0)
    return min(poses, key=lambda pose: abs(float(pose.apply(middle)[0])))


def save_ellipsoids(jaw: Jaw, tooth: np.ndarray, covariance: np.ndarray, pictures: Path) -> None:
    """Ellipsoids of some faces of the molar, seen from behind along the arch."""
    seen = np.flatnonzero(np.isfinite(covariance[:, 0, 0]))
    picked = np.random.default_rng(0).choice(seen, 60, replace=False)
    save_ellipsoids_picture(
        pictures / "precision-ellipsoids.png",
        jaw.mesh.submesh(tooth),
        covariance,
        picked=picked,
        angles_deg=(-90.0, 15.0),
        title="Error ellipsoids, four cameras, noise 0.5 px",
    )


def main() -> None:
    """Run all and write one JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/precision.json"))
    parser.add_argument("--pictures", type=Path, default=Path("docs/images"))
    arguments = parser.parse_args()
    rows = monte_carlo()
    rms, axis = (
        np.abs(np.array([row[name] for row in rows], dtype=float) - 1) for name in ("rms_ratio", "worst_axis_ratio")
    )
    parallel = {
        f"{baseline:g}": float(
            bound_rms_um(
                fisher_information(
                    tuple(camera_pair(baseline, 0.0, CAMERA).cameras.values()), np.array([[0.0, 0.0, 5.0]])
                )
            )[0]
        )
        for baseline in (1.0, 1.5, 2.5, 4.0)
    }
    summary = {
        "monte_carlo": {
            "cases": len(rows),
            "trials": TRIALS,
            "worst_rms_pct": float(100 * rms.max()),
            "worst_axis_pct": float(100 * axis.max()),
        },
        "closed_form_worst": closed_form(),
        "parallel_pair_at_5_mm_um": parallel,
        "molar": over_the_molar(build_phantom(PhantomOptions(edge_mm=0.25)), arguments.pictures),
    }
    write_json(arguments.out, {"load_average": os.getloadavg()[0], **summary, "rows": rows, **conditions()})
    print(json.dumps(summary, indent=1))


if __name__ == "__main__":
    main()
