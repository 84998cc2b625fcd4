"""A tiny renderer for the tests of stereo and surface: a height field with a solid texture, seen by a small rig."""

from __future__ import annotations

import numpy as np

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import DepthMap
from cuspid.model.rig import Handpiece, MountedCamera, Rig

DIAMOND_MM = {"west": (-1.25, 0.0), "east": (1.25, 0.0), "north": (0.0, -0.75), "south": (0.0, 0.75)}


def diamond(size_px: int = 160, distortion: tuple[float, ...] = (0, 0, 0, 0), turn_rad: float = 0.0) -> Handpiece:
    """Four cameras looking along +Z of the rig from a plane, each turned a little in its own way by ``turn_rad``."""
    camera = Camera(
        width=size_px,
        height=size_px,
        focal_px=np.full(2, size_px * 0.832),
        principal_point_px=np.full(2, size_px / 2),
        distortion=np.array(distortion, dtype=float),
    )
    turns = np.random.default_rng(5).normal(size=(len(DIAMOND_MM), 3)) * turn_rad
    mounted = {}
    for (name, (x, y)), turn in zip(DIAMOND_MM.items(), turns, strict=True):
        rotation = Rigid3.from_rotation_vector(turn, np.zeros(3))
        mounted[name] = MountedCamera(camera, rotation @ Rigid3(np.eye(3), np.array([-x, -y, 0.0])))
    return Handpiece(rig=Rig(mounted), depth_range_mm=(3.5, 7.0))


def height_field(depth_mm, half_width_mm: float = 4.0, count: int = 300) -> Mesh:
    """Surface z = depth_mm(x, y) whose outside looks at the cameras (towards -Z)."""
    axis = np.linspace(-half_width_mm, half_width_mm, count)
    x, y = np.meshgrid(axis, axis)
    vertices = np.stack([x, y, depth_mm(x, y)], axis=-1).reshape(-1, 3)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    right, below, across = corner + 1, corner + count, corner + count + 1
    return Mesh(vertices, np.concatenate([np.stack([corner, below, right], 1), np.stack([right, below, across], 1)]))


def speckle(points: np.ndarray, cell_mm: float) -> np.ndarray:
    """Smooth solid noise (0 to 1) from hashed lattice values, trilinear with a smooth step."""
    scaled = points / cell_mm
    base = np.floor(scaled).astype(np.int64)
    blend = scaled - base
    blend = blend * blend * (3 - 2 * blend)
    total = np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        x, y, z = (base + corner).T
        hashed = (x * 73856093 ^ y * 19349663 ^ z * 83492791) & 0xFFFFFFFF
        hashed = (hashed * 2654435761 & 0xFFFFFFFF) ^ (hashed >> 15)
        hashed = (hashed * 2246822519 & 0xFFFFFFFF) >> 8
        total += np.prod(np.where(corner, blend, 1 - blend), axis=1) * (hashed & 0xFFFF) / 0xFFFF
    return total


def textured(points: np.ndarray, contrast: float = 1.0, cell_mm: float = 0.12) -> np.ndarray:
    """Grey values 0 to 255 of points on the surface."""
    pattern = 0.6 * speckle(points, cell_mm) + 0.4 * speckle(points + 7.7, cell_mm * 2.3) - 0.5
    return 128 + 200 * contrast * pattern


def cast_depth(mesh: Mesh, camera: Camera, cam_from_world: Rigid3) -> np.ndarray:
    """Z of the surface at each pixel centre, NaN where nothing is seen."""
    world_from_cam = cam_from_world.inverse()
    rays = camera.rays(camera.pixel_centres().reshape(-1, 2))
    hits = mesh.cast(np.broadcast_to(world_from_cam.translation, rays.shape), world_from_cam.rotate(rays))
    return np.where(np.isfinite(hits.distances), hits.distances, np.nan).reshape(camera.height, camera.width)


def render(
    mesh: Mesh,
    mounted: MountedCamera,
    rig_from_world: Rigid3,
    rng: np.random.Generator,
    *,
    contrast: float = 1.0,
    noise_dn: float = 1.5,
    cell_mm: float = 0.12,
    supersampling: int = 2,
) -> np.ndarray:
    """RGB image of the mesh with a solid texture, box-filtered, with Gaussian noise; black where nothing is seen."""
    camera = mounted.camera
    world_from_cam = (mounted.cam_from_rig @ rig_from_world).inverse()
    offsets = (np.arange(supersampling) + 0.5) / supersampling - 0.5
    gray = np.zeros((camera.height, camera.width))
    for shift in np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2):
        rays = world_from_cam.rotate(camera.rays(camera.pixel_centres().reshape(-1, 2) + shift))
        hits = mesh.cast(np.broadcast_to(world_from_cam.translation, rays.shape), rays)
        seen = hits.faces >= 0
        points = world_from_cam.translation + rays[seen] * hits.distances[seen, None]
        gray.ravel()[seen] += textured(points, contrast, cell_mm) / supersampling**2
    noisy = gray + rng.normal(size=gray.shape) * noise_dn
    return np.repeat(np.clip(np.round(noisy), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def true_depth_map(mesh: Mesh, mounted: MountedCamera, rig_from_world: Rigid3, frame: str, name: str) -> DepthMap:
    """The depth map that a perfect stereo would measure."""
    depth = cast_depth(mesh, mounted.camera, mounted.cam_from_rig @ rig_from_world)
    return DepthMap(
        frame=frame,
        camera_name=name,
        camera=mounted.camera,
        cam_from_rig=mounted.cam_from_rig,
        depth_mm=depth.astype(np.float32),
        confidence=np.isfinite(depth).astype(np.float32),
        color=np.full((*depth.shape, 3), 200, dtype=np.uint8),
    )
