"""A reconstruction with noisy observations, and the same as COLMAP's model without a rig."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from builders import folder_capture
from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.capture import Capture
from cuspid.model.reconstruction import Reconstruction, Tracks
from cuspid.model.rig import Handpiece, MountedCamera, Rig


def make_rig() -> Rig:
    """Three cameras; the rig frame is not that of any of them."""
    camera = Camera.from_field_of_view(400, 400, 62.0)
    camera = camera.with_parameters(camera.parameters + [0, 1, 2, -1, -0.08, 0.02, 1e-3, 0])
    places = {"a": [0.3, 0.2, -0.1], "b": [1.4, 0, 0], "c": [0.5, 1.2, 0]}
    turn = Rigid3.from_rotation_vector(np.array([0.1, -0.05, 0.2]), np.zeros(3))
    return Rig({n: MountedCamera(camera, turn @ Rigid3(np.eye(3), -np.array(x))) for n, x in places.items()})


def make_found(frames: int = 4) -> Reconstruction:
    """A reconstruction with noisy observations."""
    rig, rng = make_rig(), np.random.default_rng(0)
    path = {
        f"{k:05d}": Rigid3.from_rotation_vector(np.array([0.03, -0.02, 0.05]) * k, np.array([-0.6, 0.1, 0]) * k)
        for k in range(frames)
    }
    points = np.column_stack([rng.uniform(-2, 3, (120, 2)), rng.uniform(4.5, 5.5, 120)])
    rows = []
    for f, pose in enumerate(path.values()):
        for c, mounted in enumerate(rig.cameras.values()):
            pixels = mounted.camera.project((mounted.cam_from_rig @ pose).apply(points))
            pixels = pixels + rng.normal(0, 0.2, pixels.shape)
            rows += [(p, f, c, *pixels[p]) for p in np.flatnonzero(mounted.camera.contains(pixels))]
    table = np.array(rng.permutation(rows))
    table = table[np.bincount(table[:, 0].astype(int), minlength=120)[table[:, 0].astype(int)] >= 2]
    index = table[:, :3].astype(np.int64)
    tracks = Tracks(
        points=points,
        colors=rng.integers(0, 256, (120, 3)).astype(np.uint8),
        point_index=index[:, 0],
        frame_index=index[:, 1],
        camera_index=index[:, 2],
        pixels=table[:, 3:],
    )
    return Reconstruction(rig=rig, rig_from_world=path, tracks=tracks)


def make_capture(folder: Path, found: Reconstruction) -> Capture:
    """The capture that the reconstruction is of; its images are not needed."""
    return folder_capture(folder, Handpiece(rig=found.rig), found.frames)


def without_rig(found: Reconstruction, *, units_per_mm: float = 1.0, noise_mm: float = 0.0) -> pycolmap.Reconstruction:
    """Each image posed by itself, in another unit and world, as COLMAP gives it without the rig."""
    rng, model = np.random.default_rng(1), pycolmap.Reconstruction()
    old_from_new = Rigid3.from_rotation_vector(np.array([0.3, 1.0, -0.4]), np.array([5.0, 2, 1]))
    for c, mounted in enumerate(found.rig.cameras.values()):
        camera = pycolmap.Camera(
            camera_id=c + 1, model="OPENCV", width=400, height=400, params=mounted.camera.parameters
        )
        model.add_camera_with_trivial_rig(camera)
    for f, (name, pose) in enumerate(found.rig_from_world.items()):
        for c, (camera_name, mounted) in enumerate(found.rig.cameras.items()):
            cam = mounted.cam_from_rig @ pose @ old_from_new
            cam = Rigid3(cam.rotation, units_per_mm * (cam.translation + rng.normal(0, noise_mm, 3)))
            image = pycolmap.Image(f"{camera_name}/{name}.png", np.zeros((0, 2)), c + 1, 3 * f + c + 1)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(cam.matrix[:3]))
    return model


def write_colmap(model: pycolmap.Reconstruction, folder: Path) -> Path:
    """A model on disk."""
    folder.mkdir()
    model.write(folder)
    return folder
