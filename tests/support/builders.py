"""Small values that several tests need."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from cuspid import storage
from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.capture import Capture, Frame, ImageFolder
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece, Light, Lighting, MountedCamera, Rig

CAMERA = Camera.from_field_of_view(16, 12, 62.0)
THESIS_CAMERA = Camera.from_field_of_view(500, 500, 62.0)


def box_mesh() -> Mesh:
    box = trimesh.creation.box((60, 40, 10))
    return Mesh(np.asarray(box.vertices), np.asarray(box.faces))


def sphere(radius_mm: float, subdivisions: int = 4) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions, radius_mm)
    return Mesh(np.asarray(ball.vertices), np.asarray(ball.faces))


def plate(z_mm: float, half_width_mm: float, cells: int = 20) -> Mesh:
    """A square plate of small triangles that faces -Z, towards a camera at the origin."""
    ticks = np.linspace(-half_width_mm, half_width_mm, cells + 1)
    x, y = np.meshgrid(ticks, ticks)
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, -1)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel(), index[1:, :-1].ravel()
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, z_mm)], axis=1)
    return Mesh(vertices, np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)]))


def moved(mesh: Mesh, shift_mm: tuple[float, float, float]) -> Mesh:
    return replace(mesh, vertices=mesh.vertices + shift_mm)


def joined(*meshes: Mesh) -> Mesh:
    """As one mesh, with colours where all have them."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    colors = [mesh.colors for mesh in meshes if mesh.colors is not None]
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        np.concatenate(colors) if len(colors) == len(meshes) else None,
    )


def rig_of(**cam_from_rig: Rigid3) -> Rig:
    """The thesis' cameras in given places."""
    return Rig({name: MountedCamera(THESIS_CAMERA, transform) for name, transform in cam_from_rig.items()})


def shifted(x: float, y: float = 0.0) -> Rigid3:
    """A camera beside the origin that looks along +Z."""
    return Rigid3(np.eye(3), np.array([-x, -y, 0.0]))


def any_pose(seed: int, reach_mm: float) -> Rigid3:
    rng = np.random.default_rng(seed)
    return Rigid3(Rotation.random(rng=rng).as_matrix(), reach_mm * rng.normal(size=3))


def mottled(rng: np.random.Generator, size_px: int, scales_px: tuple[float, ...] = (2.0, 5.0, 12.0)) -> np.ndarray:
    """A square picture of speckle of several sizes, grey levels 30 to 225."""
    noise = (rng.normal(size=(size_px, size_px)) for _ in scales_px)
    layers = [cv2.GaussianBlur(each, (0, 0), scale) * scale for each, scale in zip(noise, scales_px, strict=True)]
    return cv2.normalize(sum(layers), None, 30, 225, cv2.NORM_MINMAX).astype(np.float32)


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


def write_frames(folder: Path, frames: Iterable[np.ndarray]) -> Path:
    for number, frame in enumerate(frames):
        storage.write_image(folder / f"{number:03d}.png", np.ascontiguousarray(frame))
    return folder


@dataclass(frozen=True)
class SavedImages:
    """A sink of rendered images, that processes may be given."""

    folder: Path

    def __call__(self, frame: str, camera: str, image: np.ndarray) -> None:
        np.save(self.folder / f"{frame}-{camera}.npy", image)


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


Images = Mapping[tuple[str, str], np.ndarray]


@dataclass(frozen=True, eq=False)
class InMemory:
    """Images by (frame, camera). An :class:`cuspid.model.capture.ImageSource`."""

    images: Images
    suffix: str = ".png"

    def read(self, frame: str, camera: str) -> np.ndarray:
        return self.images[frame, camera]

    def size(self, frame: str, camera: str) -> tuple[int, int]:
        height, width = self.images[frame, camera].shape[:2]
        return width, height

    def mask(self, frame: str, camera: str) -> np.ndarray | None:
        return None

    def digest(self, frame: str, camera: str) -> str:
        return hashlib.sha256(self.images[frame, camera].tobytes()).hexdigest()

    def where(self, frame: str, camera: str) -> str:
        return f"{camera} of {frame}"


def times(handpiece: Handpiece, factor: float) -> Handpiece:
    """The handpiece with all lengths multiplied."""
    cameras = {
        name: replace(
            mounted,
            cam_from_rig=Rigid3(mounted.cam_from_rig.rotation, factor * mounted.cam_from_rig.translation),
            covariance=None if mounted.covariance is None else mounted.covariance * np.outer(*[_units(factor)] * 2),
        )
        for name, mounted in handpiece.rig.cameras.items()
    }
    near, far = handpiece.depth_range_mm
    return replace(
        handpiece,
        rig=Rig(cameras),
        working_distance_mm=factor * handpiece.working_distance_mm,
        depth_range_mm=(factor * near, factor * far),
    )


def _units(factor: float) -> np.ndarray:
    return np.repeat([1.0, factor], 3)
