"""How much of what an image shows is shown again by the next image of the same camera."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece

_LEAST_SURFACE = 0.1
"""An image with surface on a smaller share of it is not evaluated."""


def image_overlap(
    mesh: Mesh, handpiece: Handpiece, rig_from_world: Sequence[Rigid3], grid: int = 24
) -> Float[np.ndarray, "n c"]:
    """Share of the surface in each camera's image that its next image also sees: in its field of view, not occluded.

    The surface in an image is what lies within the depth range of the lens. It is sampled on a grid of rays over the
    image, so the share is one of the image's area. NaN if fewer than a tenth of the rays hit it.
    """
    rays = _ray_grids(handpiece, grid)
    steps = [_step_overlap(mesh, handpiece, rays, now, following) for now, following in pairwise(rig_from_world)]
    return np.array(steps).reshape(-1, len(rays))


def _ray_grids(handpiece: Handpiece, grid: int) -> Float[np.ndarray, "c n 3"]:
    """Rays of each camera, in its frame."""
    ticks = (np.arange(grid) + 0.5) / grid
    places = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    cameras = [mounted.camera for mounted in handpiece.rig.cameras.values()]
    return np.stack([camera.rays(places * [camera.width, camera.height]) for camera in cameras])


def _step_overlap(
    mesh: Mesh, handpiece: Handpiece, rays: Float[np.ndarray, "c n 3"], now: Rigid3, following: Rigid3
) -> Float[np.ndarray, "c"]:
    mounted = list(handpiece.rig.cameras.values())
    here, there = ([(each.cam_from_rig @ pose).inverse() for each in mounted] for pose in (now, following))
    directions = np.concatenate([pose.rotate(own) for pose, own in zip(here, rays, strict=True)])
    hits = mesh.cast(_eyes(here, rays), directions)
    near, far = handpiece.depth_range_mm
    hit = (hits.distances >= near) & (hits.distances <= far)
    points = np.where(
        hit[:, None], _eyes(here, rays) + np.where(hit, hits.distances, 0.0)[:, None] * directions, np.nan
    )
    again = hit.copy()
    again[hit] = ~mesh.occluded(points[hit], _eyes(there, rays)[hit])
    inside = [
        each.camera.contains(each.camera.project(pose.inverse().apply(own)))
        for each, pose, own in zip(mounted, there, points.reshape(rays.shape), strict=True)
    ]
    return _shares((again & np.concatenate(inside)).reshape(rays.shape[:2]), hit.reshape(rays.shape[:2]))


def _eyes(world_from_cam: Sequence[Rigid3], rays: Float[np.ndarray, "c n 3"]) -> Float[np.ndarray, "r 3"]:
    return np.repeat([pose.translation for pose in world_from_cam], rays.shape[1], axis=0)


def _shares(again: Bool[np.ndarray, "c n"], surface: Bool[np.ndarray, "c n"]) -> Float[np.ndarray, "c"]:
    counts = surface.sum(axis=1)
    return np.where(counts >= _LEAST_SURFACE * surface.shape[1], again.sum(axis=1) / np.maximum(counts, 1), np.nan)


def frame_overlap(overlap: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n"]:
    """Mean over the cameras of each frame; an image without surface loses none."""
    return np.asarray(1 - np.nan_to_num(1 - overlap).mean(axis=1))
