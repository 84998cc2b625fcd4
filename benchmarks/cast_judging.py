"""A reconstruction of photographs of the simulated cast, held against the cast."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from real_judging import found_poses, mesh_of
from real_measures import pose_difference

from cuspid.anatomy.crowns import crowns_of
from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.registration import RegistrationOptions, best_scale, refine
from cuspid.geometry import Rigid3, best_similarity
from cuspid.model.camera import Camera
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.storage import read_jaw, read_json, read_poses
from cuspid.storage.handpieces import camera_from_json

LEAST_PHOTOGRAPHS, STEEPEST_DEG = 3, 75.0
"""A face counts as visible that so many photographs show, at a smaller angle to its normal."""
NEAR_MM = 2.0
"""Of the crowns, what of the scan is compared with them."""
COMPLETE_MM = 0.1
NO_SCALE = 0.05
"""A model that is larger or smaller by more than this share is taken for one without a scale."""
_SAMPLES = 100_000


def judged(out: Path, truth: Path) -> dict[str, Any]:
    """Scale, poses and the crowns that the photographs show; as far as there is anything."""
    known, found, mesh = read_poses(truth / "poses.json"), found_poses(out), mesh_of(out)
    difference = pose_difference(found, known)
    figures: dict[str, Any] = {"photographs": len(known), "located": len(found), "faces": 0}
    if difference is None:
        return figures
    figures |= {"poses": asdict(difference), "scale_error_pct": 100 * (1 / difference.scale - 1)}
    figures["scaled"] = abs(1 / difference.scale - 1) <= NO_SCALE
    if mesh is None:
        return figures
    jaw = read_jaw(truth / "jaw.ply")
    camera = camera_from_json(read_json(truth / "camera.json"))
    wanted = crown_faces(jaw) & visible_faces(jaw.mesh, camera, known)
    laid = laid_on(mesh, found, known, with_scale=not figures["scaled"])
    return {**figures, "faces": len(mesh.faces), **crown_figures(laid, jaw.mesh, wanted)}


def crown_faces(jaw: Jaw) -> Bool[np.ndarray, "f"]:
    """As the labels say, or as it looks."""
    return crowns_of(jaw).faces


def visible_faces(mesh: Mesh, camera: Camera, cam_from_world: Mapping[str, Rigid3]) -> Bool[np.ndarray, "f"]:
    """Faces whose middle several photographs show."""
    count = np.zeros(len(mesh.faces), dtype=int)
    middle = mesh.face_centres + 0.005 * mesh.face_normals
    for pose in cam_from_world.values():
        eye = pose.inverse().translation
        towards = eye - middle
        cosine = np.einsum("fd,fd->f", towards, mesh.face_normals) / np.linalg.norm(towards, axis=1)
        chosen = np.flatnonzero(
            (cosine > np.cos(np.deg2rad(STEEPEST_DEG))) & camera.contains(camera.project(pose.apply(middle)))
        )
        hidden = mesh.occluded(middle[chosen], np.broadcast_to(eye, (len(chosen), 3)))
        count[chosen[~hidden]] += 1
    return count >= LEAST_PHOTOGRAPHS


def laid_on(mesh: Mesh, found: Mapping[str, Rigid3], known: Mapping[str, Rigid3], *, with_scale: bool) -> Mesh:
    """A mesh in the frame of the true poses, by the centres of the cameras; its scale is kept unless it has none."""
    names = [name for name in known if name in found]
    ours, theirs = (np.array([poses[name].inverse().translation for name in names]) for poses in (found, known))
    scale, rotation, _ = best_similarity(ours, theirs)
    scale = scale if with_scale else 1.0
    places = scale * (mesh.vertices - ours.mean(axis=0)) @ rotation.T + theirs.mean(axis=0)
    return Mesh(places, mesh.faces)


def crown_figures(scan: Mesh, reference: Mesh, wanted: Bool[np.ndarray, "f"]) -> dict[str, float]:
    """Deviation of a scan nearby, um, from those faces of a reference, after the best rigid motion, and how much of
    them it has (%). What lies nearest to other faces does not count."""
    near = scan.submesh(scan.face_areas > 0)
    near = near.submesh(reference.submesh(wanted).closest(near.face_centres)[0] <= NEAR_MM)
    if not len(near.faces):
        return {"crowns_complete_pct": 0.0}
    surface, options = SignedDistance(reference), RegistrationOptions()
    points = near.sample(_SAMPLES, np.random.default_rng(0))[0]
    few = points[wanted[reference.closest(points)[1]]][::4]
    pose = refine(few, surface, Rigid3.identity(), options)
    distances, faces, _ = reference.closest(pose.apply(points))
    deviation_um = 1000 * distances[wanted[faces] & (distances <= NEAR_MM)]
    there = reference.submesh(wanted).sample(_SAMPLES, np.random.default_rng(1))[0]
    left = near.closest(pose.inverse().apply(there))[0]
    return {
        "mean_abs_um": float(deviation_um.mean()),
        "p95_um": float(np.percentile(deviation_um, 95)),
        "within_100_um_pct": 100 * float(np.mean(deviation_um <= 100)),
        "crowns_complete_pct": 100 * float(np.mean(left <= COMPLETE_MM)),
        "surface_scale_error_pct": 100 * (best_scale(few, surface, pose, options) - 1),
    }
