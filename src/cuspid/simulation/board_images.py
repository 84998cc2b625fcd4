"""Photographs of a board with a handpiece, in simulation: to rehearse a calibration, and to try one against the truth.

The board lies before one camera after the other, at about its working distance, tilted and turned at random, and all
cameras take it at once. Light is even: no shading, no blur.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from cuspid.board import Board
from cuspid.camera import Camera
from cuspid.errors import InputError
from cuspid.geometry import Rigid3
from cuspid.options import SEED, Options, Range
from cuspid.progress import Progress, silent
from cuspid.rig import Handpiece
from cuspid.simulation.raycast import pixel_rays
from cuspid.simulation.sensor import expose
from cuspid.storage.captures import write_image
from cuspid.storage.files import hash_file
from cuspid.storage.handpieces import write_handpiece
from cuspid.storage.stages import Stage

_LIGHT, _DARK = 0.75, 0.03
"""Linear light of paper and of ink; full scale is 1."""
_NEAR, _FAR = 0.9, 1.3
"""Distance of the board, in working distances."""
_HIGHEST = 0.5
"""Height of the terraces at most, in working distances."""
_ASIDE = 0.15
"""How far the middle of the board is from the axis of the camera, in working distances (standard deviation)."""


@dataclass(frozen=True, kw_only=True)
class PhotographOptions(Options):
    """How a board is shown to a handpiece."""

    instants: Annotated[int, Range(1, 10_000)] = 36
    """How many times."""
    most_tilt_deg: Annotated[float, Range(0, 70)] = 40.0
    """Of the board, from facing the camera."""
    supersampling: Annotated[int, Range(1, 16)] = 3
    """Rays through a pixel along each side."""
    seed: Annotated[int, SEED] = 0
    """Chooses how the board is held, and the sensor noise."""


def board_poses(handpiece: Handpiece, board: Board, options: PhotographOptions) -> list[Rigid3]:
    """``rig_from_board`` at each instant."""
    rng = np.random.default_rng([options.seed, 4])
    cameras = list(handpiece.rig.cameras.values())
    return [
        cameras[k % len(cameras)].cam_from_rig.inverse() @ _held(handpiece.working_distance_mm, board, options, rng)
        for k in range(options.instants)
    ]


def _held(distance_mm: float, board: Board, options: PhotographOptions, rng: np.random.Generator) -> Rigid3:
    """``cam_from_board`` of a board before a camera."""
    towards, turn = rng.uniform(-np.pi, np.pi, 2)
    tilt = np.deg2rad(options.most_tilt_deg) * np.sqrt(rng.uniform())
    axis = np.array([np.cos(towards), np.sin(towards), 0])
    rotation = (Rotation.from_rotvec(tilt * axis) * Rotation.from_euler("z", turn)).as_matrix()
    middle = distance_mm * np.array([*rng.normal(0, _ASIDE, 2), rng.uniform(_NEAR, _FAR)])
    return Rigid3(rotation, middle - rotation @ np.array([*board.size_mm, -board.height_mm]) / 2)


def take_photographs(
    handpiece: Handpiece, board: Board, folder: Path, options: PhotographOptions, *, progress: Progress = silent
) -> None:
    """Photograph a board: ``folder/truth/handpiece.json`` and ``folder/images/<camera>/<instant>.png``.

    Images that are there already are kept; a run that goes on gives the same bits as one that was not interrupted.
    Raises InputError for terraces that would reach the cameras.
    """
    if board.height_mm > _HIGHEST * handpiece.working_distance_mm:
        raise InputError(
            f"board: the last terrace is {board.height_mm:g} mm over the first, which is too near the cameras at a "
            f"working distance of {handpiece.working_distance_mm:g} mm; make --step-mm smaller"
        )
    truth = folder / "truth" / "handpiece.json"
    write_handpiece(truth, handpiece)
    stage = Stage("photographs", folder, [board, options], ("simulation",))
    key = stage.key({"handpiece": hash_file(truth)})
    digits, names = len(str(options.instants - 1)), handpiece.rig.names
    rays = {name: pixel_rays(each.camera, options.supersampling) for name, each in handpiece.rig.cameras.items()}
    for k, rig_from_board in enumerate(board_poses(handpiece, board, options)):
        for index, (name, mounted) in enumerate(handpiece.rig.cameras.items()):
            file = folder / "images" / name / f"{k:0{digits}d}.png"
            if not stage.has(key, [file]):
                light = board_light(board, mounted.camera, rays[name], mounted.cam_from_rig @ rig_from_board)
                rng = np.random.default_rng([options.seed, 5, k, index])
                write_image(file, expose(light, 1.0, handpiece.sensor, rng))
                stage.record(key, [file])
            progress("photographs", k * len(names) + index + 1, options.instants * len(names))


def board_light(
    board: Board, camera: Camera, rays_in_cam: Float[np.ndarray, "n 3"], cam_from_board: Rigid3
) -> Float[np.ndarray, "h w 3"]:
    """Linear light of each pixel that looks at a board; paper where it looks past it or at its back. Risers are as
    between the squares. The rays of a pixel follow each other (:func:`cuspid.simulation.raycast.pixel_rays`)."""
    rays = rays_in_cam @ cam_from_board.rotation
    eye = cam_from_board.inverse().translation
    reach, on_terrace = _first_hits(board, eye, rays)
    before = (reach > 0) & np.isfinite(reach)
    dark = before & board.inverted
    before &= on_terrace
    dark[before] = board.is_dark(eye[:2] + reach[before, None] * rays[before, :2])
    ink = dark.reshape(camera.height, camera.width, -1).mean(axis=2)
    return np.repeat((_LIGHT + (_DARK - _LIGHT) * ink)[..., None], 3, axis=2)


def _first_hits(
    board: Board, eye: Float[np.ndarray, "3"], rays: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """How far along each ray it enters the body, in lengths of the ray and infinite where it does not; and whether that
    is through the top of a terrace. The body is as wide as you like: it goes on beside the squares."""
    nearest, on_terrace = np.full(len(rays), np.inf), np.zeros(len(rays), dtype=bool)
    edges = np.array([-np.inf, *board.edges_mm[1:-1], np.inf])
    with np.errstate(divide="ignore", invalid="ignore"):
        for k in range(board.terraces):
            top = (-k * board.step_mm - eye[2]) / rays[:, 2]
            sides = (edges[k : k + 2, None] - eye[0]) / rays[:, 0]
            enters = np.maximum(top, sides.min(axis=0))
            leaves = sides.max(axis=0)
            hit = (rays[:, 2] > 0) & (leaves > 0) & (enters <= leaves) & (enters < nearest)
            nearest[hit], on_terrace[hit] = enters[hit], (enters == top)[hit]
    return nearest, on_terrace
