"""Keypoints, and images, of a rig on a known path."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from builders import folder_capture, image_path, mottled
from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.capture import Capture
from cuspid.model.reconstruction import Reconstruction
from cuspid.model.rig import Handpiece, MountedCamera, Rig
from cuspid.motion.frontend.features import DESCRIPTOR_NORM, Features

SIGMA_PX = 0.2
Keypoints = dict[tuple[str, str], Features]


def make_handpiece() -> Handpiece:
    """Three cameras side by side and one that looks from the side, not paired with them."""
    camera = Camera.from_field_of_view(400, 400, 62.0)
    camera = camera.with_parameters(camera.parameters + [0, 0, 2, -1, -0.08, 0.02, 1e-3, 0])
    places = {"a": [0.0, 0, 0], "b": [1.4, 0, 0], "c": [0.5, 1.2, 0]}
    cameras = {name: MountedCamera(camera, Rigid3(np.eye(3), -np.array(x))) for name, x in places.items()}
    aside = Rigid3.from_rotation_vector(np.array([0, 1.1, 0]), np.array([0, 0, 5.0])) @ Rigid3(
        np.eye(3), np.array([0, 0, -5.0])
    )
    return Handpiece(rig=Rig({**cameras, "side": MountedCamera(camera, aside)}))


def make_path(count: int) -> dict[str, Rigid3]:
    """A turning walk; the first pose is the identity."""
    return {
        f"{k:05d}": Rigid3.from_rotation_vector(np.array([0.01 * k, -0.02 * k, 0.04 * k]), np.array([-0.7 * k, 0, 0]))
        for k in range(count)
    }


def words(rng: np.random.Generator, count: int) -> np.ndarray:
    """Random descriptors, as floats."""
    raw = rng.gamma(0.4, size=(count, 128))
    return DESCRIPTOR_NORM * np.sqrt(raw / raw.sum(axis=1, keepdims=True))


def see(
    handpiece: Handpiece,
    path: dict[str, Rigid3],
    *,
    seed: int = 0,
    points: int = 900,
    length_mm: float = 9.0,
    scale: float = 1.0,
) -> Keypoints:
    """Keypoints of a wavy surface (``scale`` times as far, and as large): noisy places and descriptors, in random
    order."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform([-4, -4], [length_mm, 5], (points, 2))
    surface = scale * np.column_stack([xy, 5 + 0.5 * np.sin(1.3 * xy[:, 0]) * np.cos(xy[:, 1])])
    dictionary, seen = words(rng, points), {}
    for frame, pose in path.items():
        for name, mounted in handpiece.rig.cameras.items():
            pixels = mounted.camera.project((mounted.cam_from_rig @ pose).apply(surface))
            inside = rng.permutation(np.flatnonzero(mounted.camera.contains(pixels)))
            noisy = dictionary[inside] + rng.normal(0, 4, (len(inside), 128))
            seen[frame, name] = Features(
                pixels=pixels[inside] + rng.normal(0, SIGMA_PX, (len(inside), 2)),
                descriptors=np.clip(np.rint(noisy), 0, 255).astype(np.uint8),
                colors=np.full((len(inside), 3), 200, np.uint8),
            )
    return seen


def blanked(seen: Keypoints, frame: str, keep: int = 0) -> Keypoints:
    """The same with few keypoints left in one frame."""
    return {
        key: Features(pixels=f.pixels[:keep], descriptors=f.descriptors[:keep], colors=f.colors[:keep])
        if key[0] == frame
        else f
        for key, f in seen.items()
    }


def errors(found: Reconstruction, path: dict[str, Rigid3]) -> np.ndarray:
    """(frames, 6) small motions on the left of the true poses, with the world in the first located frame."""
    world = path[found.frames[0]].inverse()
    motions = [found.rig_from_world[name] @ (path[name] @ world).inverse() for name in found.frames]
    return np.array([[*motion.rotation_vector, *motion.translation] for motion in motions])


def wrongly_calibrated(truth: Handpiece) -> Handpiece:
    """The same with its cameras somewhat elsewhere, and how much that may be."""
    sigma, rng = np.array([2e-3] * 3 + [0.01] * 3), np.random.default_rng(2)
    given = {}
    for name, mounted in truth.rig.cameras.items():
        motion = rng.normal(0, sigma)
        moved = Rigid3.from_rotation_vector(motion[:3], motion[3:]) @ mounted.cam_from_rig
        given[name] = replace(mounted, cam_from_rig=moved, covariance=np.diag(sigma**2))
    return replace(truth, rig=Rig(given))


def photograph(camera: Camera, cam_from_world: Rigid3, texture: np.ndarray, px_per_mm: float) -> np.ndarray:
    """The plane z = 5 of the world with a texture centred at its origin, through an ideal camera, four rays a pixel."""
    grid = (np.stack(np.meshgrid(np.arange(2 * camera.width), np.arange(2 * camera.height)), -1) + 0.5) / 2
    world_from_cam = cam_from_world.inverse()
    rays, centre = world_from_cam.rotate(camera.rays(grid)), world_from_cam.translation
    on_plane = centre + rays * ((5 - centre[2]) / rays[..., 2:])
    place = (on_plane[..., :2] * px_per_mm + np.array(texture.shape[::-1]) / 2 - 0.5).astype(np.float32)
    fine = cv2.remap(texture, place[..., 0], place[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def make_capture(folder: Path, rig: Rig, path: dict[str, Rigid3]) -> Capture:
    """Images of a speckled plane on disk."""
    rng = np.random.default_rng(0)
    texture = mottled(rng, 1600)
    capture = folder_capture(folder, Handpiece(rig=rig), path)
    for frame, pose in path.items():
        for name, mounted in rig.cameras.items():
            gray = photograph(mounted.camera, mounted.cam_from_rig @ pose, texture, 80.0)
            noisy = np.clip(np.rint(gray + rng.normal(0, 1.5, gray.shape)), 0, 255).astype(np.uint8)
            file = image_path(capture, frame, name)
            file.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(file), cv2.merge([noisy] * 3))
    return capture


OUT, STEP_MM = 13, 1.2


def there_and_back() -> dict[str, Rigid3]:
    """A walk, and the same way back a little aside."""
    travel = [*(STEP_MM * k for k in range(OUT)), *(STEP_MM * k + 0.2 for k in reversed(range(OUT)))]
    return {
        f"{k:05d}": Rigid3.from_rotation_vector(
            np.array([0.0, 0, 0.02 * (k >= OUT)]), np.array([-x, 0.1 * (k >= OUT), 0])
        )
        for k, x in enumerate(travel)
    }


def without_far_sight() -> Handpiece:
    """Without the camera from the side, that sees one place from the whole way and so ties its ends already."""
    handpiece = make_handpiece()
    return replace(handpiece, rig=Rig({name: handpiece.rig[name] for name in "abc"}))
