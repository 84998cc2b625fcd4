"""A relief of stones with a board beside it, photographed by one camera from many places."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from boards import looking_at
from cuspid.geometry import Rigid3
from cuspid.model.board import Board
from cuspid.model.camera import Camera
from synthetic_scene import cast_depth, height_field, textured

BOARD = Board(columns=7, rows=5, square_mm=3.0)
BOARD_PLACE_MM = np.array([-10.5, 5.5])
WIDE = Camera(
    width=480,
    height=360,
    focal_px=np.array([560.0, 560.0]),
    principal_point_px=np.array([240.0, 180.0]),
    distortion=np.array([-0.06, 0.0, 0.0, 0.0]),
)


def relief(x, y):
    """Depth of the relief, mm; flat where the board lies."""
    bumps = 1.5 * np.sin(x / 2.3) * np.cos(y / 1.9) + np.cos(x / 5.1 + y / 3.7)
    return np.where(y > BOARD_PLACE_MM[1] - 1, 0.0, bumps * np.clip((BOARD_PLACE_MM[1] - 1 - y) / 2, 0, 1))


@dataclass(frozen=True, eq=False)
class Scene:
    """Photographs in memory and where they were taken."""

    camera: Camera
    poses: dict[str, Rigid3]
    images: dict[str, np.ndarray]
    depths: dict[str, np.ndarray]

    def write(self, folder: Path, names: dict[str, str] | None = None) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        for name, image in self.images.items():
            Image.fromarray(image).save(folder / f"{names[name] if names else name}.png", compress_level=1)
        return folder


def places(count: int, distance_mm: float = 40.0) -> dict[str, Rigid3]:
    """Poses around the relief, turned in all ways about the axis."""
    rng = np.random.default_rng(3)
    poses = {}
    for k in range(count):
        angle = 2 * np.pi * k / count
        out = np.array([np.sin(angle), np.cos(angle)]) * 14 * (1 + 0.3 * (k % 2))
        centre = np.array([*out, -distance_mm - 3 * np.sin(3 * angle)])
        poses[f"IMG_{k:02d}"] = looking_at(np.array([0.0, 3.0, 0.0]), centre, rng.uniform(-180, 180))
    return poses


@cache
def scene(count: int = 8) -> Scene:
    """The relief with its board, as the camera sees it from all around."""
    mesh = height_field(relief, 17.0, 200)
    poses, images, depths = places(count), {}, {}
    for k, (name, pose) in enumerate(poses.items()):
        gray, depth = _render(mesh, WIDE, pose)
        noisy = gray + np.random.default_rng(k).normal(size=gray.shape) * 1.0
        images[name] = np.repeat(np.clip(np.rint(noisy), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        depths[name] = depth
    return Scene(WIDE, poses, images, depths)


def _render(mesh, camera: Camera, pose: Rigid3) -> tuple[np.ndarray, np.ndarray]:
    fine = camera.resized(2 * camera.width, 2 * camera.height)
    depth = cast_depth(mesh, camera, pose)
    between = cv2.resize(depth, (fine.width, fine.height), interpolation=cv2.INTER_LINEAR)
    points = pose.inverse().apply(fine.rays(fine.pixel_centres()) * np.nan_to_num(between)[..., None])
    gray = painted(points.reshape(-1, 3)).reshape(between.shape)
    gray[~np.isfinite(between)] = 0
    return cv2.resize(gray, (camera.width, camera.height), interpolation=cv2.INTER_AREA), depth


def painted(points: np.ndarray) -> np.ndarray:
    """Grey of places of the relief, with the board printed on its flat part."""
    gray = np.clip(textured(points, 1.2, 0.7), 0, 255)
    on_board = points[:, :2] - BOARD_PLACE_MM
    margin = 0.6 * BOARD.square_mm
    inside = ((on_board > -margin) & (on_board < np.array(BOARD.size_mm) + margin)).all(axis=1)
    gray[inside] = np.where(BOARD.is_dark(on_board[inside]), 20.0, 235.0)
    return gray
