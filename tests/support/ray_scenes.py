"""A camera with a lamp before flat squares, to be rendered."""

from __future__ import annotations

import numpy as np

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece, Light, Lighting, MountedCamera, Rig, Sensor

CAMERA = Camera.from_field_of_view(120, 100, 62.0)
FACING = Rigid3(np.eye(3), np.zeros(3))
"""The camera looks along +Z of the world."""


def quad(centre: tuple[float, float, float], half: float) -> tuple[np.ndarray, np.ndarray]:
    """A square across Z that faces -Z."""
    x, y, z = centre
    corners = np.array(
        [[x - half, y - half, z], [x + half, y - half, z], [x + half, y + half, z], [x - half, y + half, z]]
    )
    return corners, np.array([[0, 2, 1], [0, 3, 2]])


def jaw_of(*quads: tuple[np.ndarray, np.ndarray], labels: list[int] | None = None) -> Jaw:
    vertices = np.concatenate([corners for corners, _ in quads])
    faces = np.concatenate([triangles + 4 * k for k, (_, triangles) in enumerate(quads)])
    face_labels = None if labels is None else np.repeat(labels, 2)
    return Jaw(mesh=Mesh(vertices, faces), face_labels=face_labels)


def probe(*lights: Light, camera: Camera = CAMERA, sensor: Sensor | None = None) -> Handpiece:
    named = {f"led{k}": light for k, light in enumerate(lights)}
    return Handpiece(
        rig=Rig({"a": MountedCamera(camera, FACING)}),
        lights=named,
        lightings=(Lighting(name="all", lights=tuple(named)),),
        sensor=sensor or Sensor(noise_dn=0.0),
    )


def led(x: float = 0.0, y: float = 0.0, z: float = 0.0, **other: float) -> Light:
    return Light(position_mm=np.array([x, y, z]), direction=np.array([0, 0, 1.0]), **other)
