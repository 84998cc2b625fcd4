"""Cameras over a board, what they see of it, and photographs of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from cuspid import storage
from cuspid.calibration.bundle import BoardScene, bending_coordinates, interpolation
from cuspid.calibration.corners import BoardView
from cuspid.geometry import Rigid3
from cuspid.model.board import Board
from cuspid.model.camera import Camera
from cuspid.simulation.board_images import board_light
from cuspid.simulation.raycast import pixel_rays

BOARD = Board(columns=9, rows=7, square_mm=2.0)
SIZE = (640, 480)


def looking_at(middle: np.ndarray, centre: np.ndarray, roll_deg: float) -> Rigid3:
    """``cam_from_world`` of a camera at a place that looks at another."""
    forward = (middle - centre) / np.linalg.norm(middle - centre)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    turn = Rotation.from_rotvec(np.deg2rad(roll_deg) * np.array([0, 0, 1.0])).as_matrix()
    rotation = turn @ np.stack([right, np.cross(forward, right), forward])
    return Rigid3(rotation, -rotation @ centre)


def pose_before(board: Board, away_mm: float, tilt_deg: float, *, roll_deg: float = 20.0) -> Rigid3:
    """``cam_from_board`` of a board whose middle lies on the axis of a camera."""
    tilt = np.deg2rad(tilt_deg)
    centre = away_mm * np.array([np.sin(tilt), 0.3 * np.sin(tilt), -np.cos(tilt)])
    middle = np.array([*board.size_mm, 0.0]) / 2
    return looking_at(middle, middle + centre, roll_deg)


def photograph(board: Board, camera: Camera, cam_from_board: Rigid3, times: int = 4, seed: int = 0) -> np.ndarray:
    """Blurred a little, with noise."""
    light = board_light(board, camera, pixel_rays(camera, times), cam_from_board)[..., 0]
    blurred = cv2.GaussianBlur(20.0 + 250.0 * light, (0, 0), 0.6)
    return np.clip(blurred + np.random.default_rng(seed).normal(0, 2, blurred.shape), 0, 255).astype(np.uint8)


def scene(seed: int, board: Board = BOARD, cameras: int = 3, instants: int = 16, scale: float = 1.0) -> BoardScene:
    """Cameras side by side over a board that is turned and tilted before them."""
    rng = np.random.default_rng(seed)
    lenses, places = {}, {}
    for k in range(cameras):
        lenses[f"cam{k}"] = Camera(
            width=SIZE[0],
            height=SIZE[1],
            focal_px=rng.uniform(480, 560) * np.array([1.0, rng.uniform(0.99, 1.01)]),
            principal_point_px=np.array(SIZE) / 2 + rng.normal(0, 8, 2),
            distortion=rng.normal(0, [0.1, 0.05, 0.002, 0.002]),
        )
        centre = np.array([4.0 * k, rng.normal(0, 1), rng.normal(0, 1)])
        places[f"cam{k}"] = looking_at(np.array([2.0 * (cameras - 1), 0, 24.0]), centre, rng.normal(0, 5))
    first = places["cam0"]
    poses = {}
    for i in range(instants):
        tilt = Rotation.from_euler("xyz", rng.uniform(-40, 40, 3), degrees=True).as_matrix()
        middle = np.array([2.0 * (cameras - 1), 0, 24.0]) + rng.normal(0, [2, 2, 3])
        in_world = Rigid3(tilt, middle - tilt @ np.array([*board.size_mm, 0]) / 2)
        poses[f"{i:02d}"] = first @ in_world
    return BoardScene(
        cameras=lenses,
        cam_from_rig={name: scaled(place @ first.inverse(), scale) for name, place in places.items()},
        rig_from_board={name: scaled(pose, scale) for name, pose in poses.items()},
        bending_mm=scale * np.array([0.05, -0.03, 0.04]),
    )


LENSES_OF = {
    "OPENCV": (520.0, (-0.1, 0.03, 1e-3, -1e-3)),
    "FULL_OPENCV": (340.0, (-0.3, 0.14, 1e-3, -1e-3, -0.05, 0.0, 0.0, 0.0)),
    "OPENCV_FISHEYE": (300.0, (-0.03, 0.01, -0.004, 5e-4)),
    "THIN_PRISM_FISHEYE": (300.0, (-0.03, 0.01, 2e-3, -2e-3, -0.004, 5e-4, 0.02, -0.015)),
}
"""Focal length in px and distortion of a lens of each model, the last ones of 120 degrees across the image."""


def before_lens(model: str, seed: int, instants: int = 16) -> BoardScene:
    """One camera with a lens of a model, and a board that is held all over its image."""
    rng = np.random.default_rng(seed)
    focal, distortion = LENSES_OF[model]
    camera = Camera(
        width=SIZE[0],
        height=SIZE[1],
        focal_px=np.array([focal, 1.003 * focal]),
        principal_point_px=np.array([325.0, 236.0]),
        distortion=np.array(distortion),
        model=model,
    )
    poses = {}
    for i in range(instants):
        turn = Rotation.from_euler("xyz", rng.uniform(-40, 40, 3), degrees=True).as_matrix()
        away = rng.uniform(9, 20)
        middle = away * np.array([*rng.uniform(-1, 1, 2) * [264, 192] / focal, 1.0])
        poses[f"{i:02d}"] = Rigid3(turn, middle - turn @ np.array([*BOARD.size_mm, 0]) / 2)
    return BoardScene(
        cameras={"cam": camera},
        cam_from_rig={"cam": Rigid3.identity()},
        rig_from_board=poses,
        bending_mm=np.zeros(3),
    )


def moving(seed: int, instants: int = 28) -> BoardScene:
    """Cameras over a board that is moved by hand, filmed."""
    still = scene(seed, instants=1)
    poses = {f"{i:05d}": moving_pose(i) for i in range(instants)}
    return replace(still, rig_from_board=poses)


def moving_pose(time: float) -> Rigid3:
    """Pose of the board of :func:`moving` so many frames after the first."""
    phase = 2 * np.pi * time / np.array([41.0, 53.0, 67.0])
    tilt = Rotation.from_euler("xyz", [35, 35, 25] * np.sin(phase), degrees=True).as_matrix()
    middle = np.array([4.0, 0, 24.0]) + [2, 2, 3] * np.cos(phase[::-1])
    in_world = Rigid3(tilt, middle - tilt @ np.array([*BOARD.size_mm, 0]) / 2)
    return looking_at(np.array([4.0, 0, 24.0]), np.zeros(3), 0.0) @ in_world


def rolling_views(
    truth: BoardScene, readouts: dict[str, float], delays: dict[str, float], noise_px: float, rng: np.random.Generator
) -> dict[tuple[str, str], BoardView]:
    """What cameras see of the board of :func:`moving` whose rows are exposed one after the other."""
    u, v = bending_coordinates(BOARD, BOARD.corners).T
    bent = BOARD.corners + np.outer(np.stack([u * u, u * v, v * v], 1) @ truth.bending_mm, [0, 0, 1.0])
    views = {}
    for camera, lens in truth.cameras.items():
        for instant in truth.rig_from_board:
            middle, late = int(instant) + delays.get(camera, 0.0), readouts[camera]
            pixels = np.stack(
                [
                    lens.project((truth.cam_from_rig[camera] @ moving_pose(middle + share * late)).apply(bent))
                    for share in (-0.5, 0.0, 0.5)
                ]
            )
            share, at = np.zeros(len(bent)), pixels[1]
            for _ in range(6):  # the row depends on the time, and the time on the row
                weights = interpolation(np.tile([-0.5, 0.0, 0.5], (len(share), 1)), share)[0]
                at = np.einsum("nk,knj->nj", weights, pixels)
                share = at[:, 1] / lens.height - 0.5
            seen = np.flatnonzero(lens.contains(at))
            if len(seen) >= 12:
                views[camera, instant] = BoardView(seen, at[seen] + rng.normal(0, noise_px, (len(seen), 2)))
    return views


def scaled(pose: Rigid3, scale: float) -> Rigid3:
    return Rigid3(pose.rotation, scale * pose.translation)


def undistorted(camera: Camera) -> Camera:
    return replace(camera, distortion=np.zeros(4))


def views_of(
    truth: BoardScene, board: Board, noise_px: float, rng: np.random.Generator
) -> dict[tuple[str, str], BoardView]:
    """What the cameras see of the board, with noise; corners beyond the image are missing,
    and those on the edge of a step."""
    u, v = bending_coordinates(board, board.corners).T
    bent = board.corners + np.outer(np.stack([u * u, u * v, v * v], 1) @ truth.bending_mm, [0, 0, 1.0])
    views = {}
    for camera, lens in truth.cameras.items():
        for instant, pose in truth.rig_from_board.items():
            pixels = lens.project((truth.cam_from_rig[camera] @ pose).apply(bent))
            seen = np.flatnonzero(lens.contains(pixels) & board.saddles)
            if len(seen) >= 12 and (board.kind == "charuco" or len(seen) == len(bent)):
                views[camera, instant] = BoardView(seen, pixels[seen] + rng.normal(0, noise_px, (len(seen), 2)))
    return views


def options(board: Board) -> list[object]:
    given = ["--kind", board.kind, "--columns", board.columns, "--rows", board.rows, "--square-mm", board.square_mm]
    shares = ["--first-id", board.first_id, "--circle-share", board.circle_share]
    return given + shares + ["--inverted"] * board.inverted


def photographs(folder: Path, truth: BoardScene, board: Board) -> None:
    """The board as the cameras see it, without distortion."""
    px_per_mm = 40.0
    across, down = np.rint(np.array(board.size_mm) * px_per_mm).astype(int)
    picture = np.full((down, across), 230, np.uint8)
    for (x, y), side in zip(*(px_per_mm * each for each in board.dark), strict=True):
        picture[round(y) : round(y + side), round(x) : round(x + side)] = 25
    finer = np.array([[4, 0, 1.5], [0, 4, 1.5], [0, 0, 1.0]])
    picture = cv2.copyMakeBorder(picture, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=230)
    for name, camera in truth.cameras.items():
        size = (camera.width, camera.height)
        for instant, pose in truth.rig_from_board.items():
            cam_from_board = truth.cam_from_rig[name] @ pose
            plane = np.column_stack([cam_from_board.rotation[:, :2] / px_per_mm, cam_from_board.translation])
            to_board = np.array([[1, 0, 0.5 - 40], [0, 1, 0.5 - 40], [0, 0, 1.0]])
            homography = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]]) @ camera.matrix @ plane @ to_board
            fine = cv2.warpPerspective(
                picture, finer @ homography, (4 * camera.width, 4 * camera.height), borderValue=128
            )
            image = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
            storage.write_image(folder / name / f"{instant}.png", np.repeat(image[..., None], 3, axis=2))
