"""What of a surface the cameras of a handpiece could see: the rule for what counts as scannable.

A face is seen by a camera if its centre lies in the image and in the depth range of the lens, if nothing is in the way,
and if the line of sight meets it from the front no flatter than the largest incidence. It is scannable if, at one
position of the handpiece at least, enough cameras see it at once.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from cuspid.camera import Camera
from cuspid.geometry import Rigid3
from cuspid.mesh import Mesh
from cuspid.rig import Handpiece


@dataclass(frozen=True, kw_only=True)
class VisibilityOptions:
    """When a face counts as seen."""

    maximum_incidence_deg: float = 75.0
    """Largest angle between the line of sight and the face's normal."""
    cameras: int = 2
    """How many cameras must see a face at once."""


def scannable_faces(
    mesh: Mesh, handpiece: Handpiece, rig_from_world: Iterable[Rigid3], options: VisibilityOptions
) -> Bool[np.ndarray, "f"]:
    """The faces that enough cameras see at once from at least one pose. The world is the frame of the mesh."""
    return visible_counts(mesh, handpiece, rig_from_world, options) >= options.cameras


def visible_counts(
    mesh: Mesh, handpiece: Handpiece, rig_from_world: Iterable[Rigid3], options: VisibilityOptions
) -> Int[np.ndarray, "f"]:
    """For each face: the largest number of cameras that see it at once."""
    most = np.zeros(len(mesh.faces), dtype=np.int64)
    for pose in rig_from_world:
        count = np.zeros_like(most)
        for mounted in handpiece.rig.cameras.values():
            cam_from_world = mounted.cam_from_rig @ pose
            count[visible_faces(mesh, mounted.camera, cam_from_world, handpiece.depth_range_mm, options)] += 1
        np.maximum(most, count, out=most)
    return most


def visible_faces(
    mesh: Mesh,
    camera: Camera,
    cam_from_world: Rigid3,
    depth_range_mm: tuple[float, float],
    options: VisibilityOptions,
) -> Int[np.ndarray, "n"]:
    """Indices of the faces that one camera sees."""
    minimum_cosine = float(np.cos(np.deg2rad(options.maximum_incidence_deg)))
    rotation, translation = cam_from_world.rotation, cam_from_world.translation
    low, high = _view_bounds(camera)
    faces = np.flatnonzero(
        _candidates(
            mesh.face_centres, mesh.face_normals, rotation, translation, low, high, depth_range_mm, minimum_cosine
        )
    )
    centres = mesh.face_centres[faces]
    in_image = camera.contains(camera.project(cam_from_world.apply(centres)))
    faces, centres = faces[in_image], centres[in_image]
    eye = np.broadcast_to(cam_from_world.inverse().translation, centres.shape)
    return np.asarray(faces[~mesh.occluded(centres, eye)])


def _view_bounds(camera: Camera) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Smallest and largest x/z and y/z of the rays through the border of the image."""
    ticks = np.linspace(0, 1, 20)
    border = np.array([[t, s] for t in ticks for s in ticks if t in (0, 1) or s in (0, 1)])
    rays = camera.rays(border * [camera.width, camera.height])[:, :2]
    return rays.min(axis=0), rays.max(axis=0)


@njit(cache=True, nogil=True)
@no_type_check
def _candidates(centres, normals, rotation, translation, low, high, depth_range, minimum_cosine):
    """True for the faces whose centre lies in the box of view and that face the camera steeply enough."""
    found = np.zeros(len(centres), dtype=np.bool_)
    eye = -(rotation.T @ translation)
    for i in range(len(centres)):
        x, y, z = centres[i, 0] - eye[0], centres[i, 1] - eye[1], centres[i, 2] - eye[2]
        depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
        if depth < depth_range[0] or depth > depth_range[1]:
            continue
        u = (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z) / depth
        v = (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z) / depth
        if u < low[0] or u > high[0] or v < low[1] or v > high[1]:
            continue
        facing = -(normals[i, 0] * x + normals[i, 1] * y + normals[i, 2] * z)
        found[i] = facing >= minimum_cosine * np.sqrt(x * x + y * y + z * z)
    return found
