"""Points that a rig observes on a known path, to be adjusted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.reconstruction import Reconstruction, Tracks
from cuspid.model.rig import MountedCamera, Rig

SIGMA_PX = 0.3
EXTRINSIC_SIGMA = np.array([2e-3, 2e-3, 2e-3, 0.02, 0.02, 0.02])
PARAMETER_SIGMA = np.array([2.0, 2.0, 2.0, 2.0, 5e-3, 2e-3, 1e-3, 1e-3])


@dataclass(frozen=True)
class Scene:
    """What truly was, with the world in the first frame."""

    rig: Rig
    rig_from_world: dict[str, Rigid3]
    tracks: Tracks


def make_camera() -> Camera:
    """A small camera with a noticeable distortion."""
    camera = Camera.from_field_of_view(500, 500, 62.0)
    return camera.with_parameters(np.array([416.0, 415, 251, 248, -0.12, 0.03, 2e-3, -1e-3]))


def make_rig() -> Rig:
    """Four cameras that look at a patch from above and one from each side."""
    above = [Rigid3(np.eye(3), -np.array([x, y, 0.0])) for x in (-1.2, 1.2) for y in (-1.0, 1.0)]
    sides = [
        Rigid3.from_rotation_vector(np.array([0, sign * 0.7, 0]), np.array([0, 0, 5.0]))
        @ Rigid3(np.eye(3), np.array([0, 0, -5.0]))
        for sign in (-1, 1)
    ]
    return Rig({f"c{k}": MountedCamera(make_camera(), pose) for k, pose in enumerate(above + sides)})


def make_path(frames: int) -> dict[str, Rigid3]:
    """A gently turning walk over the surface; the first pose is the identity."""
    return {
        f"{k:05d}": Rigid3.from_rotation_vector(
            np.array([0.02 * np.sin(k), 0.015 * k, 0.03 * k]), np.array([-0.6 * k, 0.1 * k, 0.05 * k])
        )
        for k in range(frames)
    }


def observe(rig: Rig, path: dict[str, Rigid3], points: np.ndarray) -> Tracks:
    """Noise-free observations of points by all cameras at all frames."""
    rows = []
    for f, pose in enumerate(path.values()):
        for c, mounted in enumerate(rig.cameras.values()):
            pixels = mounted.camera.project((mounted.cam_from_rig @ pose).apply(points))
            seen = np.flatnonzero(mounted.camera.contains(pixels))
            rows += [(p, f, c, *pixels[p]) for p in seen]
    table = np.array(rows)
    index = table[:, :3].astype(np.int64)
    colors = np.zeros((len(points), 3), np.uint8)
    return Tracks(
        points=points,
        colors=colors,
        point_index=index[:, 0],
        frame_index=index[:, 1],
        camera_index=index[:, 2],
        pixels=table[:, 3:],
    )


def make_scene(*, rig: Rig | None = None, frames: int = 6, points: int = 250) -> Scene:
    """A wavy patch of surface five millimetres below the cameras."""
    rig, path = rig or make_rig(), make_path(frames)
    rng = np.random.default_rng(1)
    xy = rng.uniform([-3, -3], [6, 3], (points, 2))
    surface = np.column_stack([xy, 5 + 0.6 * np.sin(xy[:, 0] * 1.5) * np.cos(xy[:, 1])])
    return Scene(rig, path, observe(rig, path, surface))


def disturbed(scene: Scene, rng: np.random.Generator, *, rig: Rig | None = None) -> Reconstruction:
    """Noisy observations and a rough start."""
    tracks = replace(
        scene.tracks,
        points=scene.tracks.points + rng.normal(0, 0.03, scene.tracks.points.shape),
        pixels=scene.tracks.pixels + rng.normal(0, SIGMA_PX, scene.tracks.pixels.shape),
    )
    path = {
        name: pose if k == 0 else Rigid3.from_rotation_vector(rng.normal(0, 3e-3, 3), rng.normal(0, 0.02, 3)) @ pose
        for k, (name, pose) in enumerate(scene.rig_from_world.items())
    }
    return Reconstruction(rig=rig or scene.rig, rig_from_world=path, tracks=tracks)


def pose_errors(found: Reconstruction, truth: dict[str, Rigid3]) -> np.ndarray:
    """(frames, 6): small motion on the left from the true pose to the found one."""
    motions = [found.rig_from_world[name] @ true.inverse() for name, true in truth.items()]
    return np.array([[*motion.rotation_vector, *motion.translation] for motion in motions])
