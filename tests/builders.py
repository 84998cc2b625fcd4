"""Small values that several tests need."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import trimesh

from cuspid import storage
from cuspid.camera import Camera
from cuspid.capture import Capture, Frame, ImageFolder
from cuspid.geometry import Rigid3
from cuspid.mesh import Mesh
from cuspid.rig import Handpiece, Light, Lighting, MountedCamera, Rig

CAMERA = Camera.from_field_of_view(16, 12, 62.0)


def box_mesh() -> Mesh:
    box = trimesh.creation.box((60, 40, 10))
    return Mesh(np.asarray(box.vertices), np.asarray(box.faces))


def handpiece(*names: str) -> Handpiece:
    rig = Rig({name: MountedCamera(CAMERA, Rigid3(np.eye(3), np.array([-k, 0, 0.0]))) for k, name in enumerate(names)})
    return Handpiece(
        rig=rig,
        lights={"led": Light(position_mm=np.array([1.0, 2, 3]), direction=np.array([0, 0, 1.0]), power=2.0)},
        lightings=(Lighting(name="all", lights=("led",)),),
    )


def folder_capture(folder: Path, handpiece: Handpiece, stems: Iterable[str]) -> Capture:
    """A capture whose images are to lie in a folder, every camera with one of every frame."""
    lighting = handpiece.lightings[0].name if handpiece.lightings else None
    frames = tuple(Frame(name=stem, cameras=handpiece.rig.names, lighting=lighting) for stem in stems)
    return Capture(handpiece=handpiece, frames=frames, source=ImageFolder(folder))


def image_path(capture: Capture, frame: str, camera: str) -> Path:
    """Where an image of such a capture lies."""
    assert isinstance(capture.source, ImageFolder)
    return capture.source.path(frame, camera)


def make_capture(
    folder: Path, names: tuple[str, ...] = ("a", "b"), stems: tuple[str, ...] = ("00000", "00001")
) -> Capture:
    capture = folder_capture(folder, handpiece(*names), stems)
    rng = np.random.default_rng(0)
    for name in names:
        for stem in stems:
            storage.write_image(image_path(capture, stem, name), rng.integers(0, 255, (12, 16, 3), dtype=np.uint8))
    storage.write_capture(folder, capture)
    return capture
