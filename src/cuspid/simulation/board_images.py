"""Simulated photographs of a board with a handpiece: to rehearse a calibration, and to test one against the truth.

The board is held in front of one camera after the other, at about its working distance, tilted and rotated at random,
and all cameras photograph it at once. The light is even, which suffices for corners, or comes from the lights of the
handpiece: point lights, on a diffuse (Lambertian) surface, without shadows. Nothing is blurred.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial.transform import Rotation

from cuspid.geometry import Rigid3
from cuspid.model.board import Board
from cuspid.model.camera import Camera
from cuspid.model.rig import Handpiece, Light
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import SEED, Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.simulation.raycast import pixel_rays
from cuspid.simulation.sensor import record
from cuspid.storage.captures import write_image
from cuspid.storage.files import hash_file
from cuspid.storage.handpieces import write_handpiece
from cuspid.storage.stages import Stage

_LIGHT, _DARK = 0.75, 0.03
"""Linear light of paper and of ink; full scale is 1."""
_BRIGHT_PERCENTILE = 98.0
"""Percentile of the light on the corners of the board, over all images of an exposure, above which they may burn
out."""
_NEAR, _FAR = 0.9, 1.3
"""Distance of the board, in working distances."""
_HIGHEST = 0.5
"""Maximum height of the terraces, in working distances."""
_ASIDE = 0.15
"""Standard deviation of the distance of the board's middle from the axis of the camera, in working distances."""


@dataclass(frozen=True, kw_only=True)
class PhotographOptions(Options):
    """How a board is shown to a handpiece."""

    instants: Annotated[int, Range(1, 10_000)] = 36
    """Number of times that the board is shown."""
    max_tilt_deg: Annotated[float, Range(0, 70)] = 40.0
    """Maximum tilt of the board from facing the camera."""
    supersampling: Annotated[int, Range(1, 16)] = 3
    """Rays per pixel along each side."""
    lit: Literal["evenly", "together", "one-by-one"] = "evenly"
    """How the board is lit: by even light, by all lights of the handpiece together, or by one after the other, whose
    names are then appended to those of the images."""
    seed: Annotated[int, SEED] = 0
    """Seed of the poses of the board and of the sensor noise."""


def board_poses(handpiece: Handpiece, board: Board, options: PhotographOptions) -> list[Rigid3]:
    """``rig_from_board`` at each instant."""
    rng = np.random.default_rng([options.seed, 4])
    cameras = list(handpiece.rig.cameras.values())
    return [
        cameras[k % len(cameras)].cam_from_rig.inverse() @ _any_pose(handpiece.working_distance_mm, board, options, rng)
        for k in range(options.instants)
    ]


def _any_pose(distance_mm: float, board: Board, options: PhotographOptions, rng: np.random.Generator) -> Rigid3:
    """``cam_from_board`` of a board before a camera."""
    towards, turn = rng.uniform(-np.pi, np.pi, 2)
    tilt = np.deg2rad(options.max_tilt_deg) * np.sqrt(rng.uniform())
    axis = np.array([np.cos(towards), np.sin(towards), 0])
    rotation = (Rotation.from_rotvec(tilt * axis) * Rotation.from_euler("z", turn)).as_matrix()
    middle = distance_mm * np.array([*rng.normal(0, _ASIDE, 2), rng.uniform(_NEAR, _FAR)])
    return Rigid3(rotation, middle - rotation @ np.array([*board.size_mm, -board.height_mm]) / 2)


def take_photographs(
    handpiece: Handpiece, board: Board, folder: Path, options: PhotographOptions, *, progress: Progress = silent
) -> None:
    """Photograph a board: ``folder/truth/handpiece.json`` and ``folder/images/<camera>/<instant>.png``.

    Existing images are kept; a run that is resumed gives the same bits as one that was not interrupted. Raises
    InputError for terraces that would reach the cameras.
    """
    if board.height_mm > _HIGHEST * handpiece.working_distance_mm:
        raise InputError(
            f"board: the last terrace is {board.height_mm:g} mm above the first, which is too close to the cameras at "
            f"a working distance of {handpiece.working_distance_mm:g} mm; make --step-mm smaller"
        )
    truth = folder / "truth" / "handpiece.json"
    write_handpiece(truth, handpiece)
    stage = Stage("photographs", folder, [board, options], (__name__,))
    key = stage.key({"handpiece": hash_file(truth)})
    shots, names = _shots(handpiece, board, options), handpiece.rig.names
    rays = {name: pixel_rays(each.camera, options.supersampling) for name, each in handpiece.rig.cameras.items()}
    gain = _gain(handpiece, board, shots)
    for k, shot in enumerate(shots):
        for index, (name, mounted) in enumerate(handpiece.rig.cameras.items()):
            file = folder / "images" / name / f"{shot.name}.png"
            if not stage.has(key, [file]):
                cam_from_board = mounted.cam_from_rig @ shot.rig_from_board
                light = board_light(board, mounted.camera, rays[name], cam_from_board, shot.lights)
                rng = np.random.default_rng([options.seed, 5, k, index])
                write_image(file, record(light, gain, handpiece, name, rng))
                stage.record(key, [file])
            progress("photographs", k * len(names) + index + 1, options.instants * len(names))


@dataclass(frozen=True, eq=False)
class _Shot:
    """An instant."""

    name: str
    rig_from_board: Rigid3
    lights: tuple[Light, ...]
    """In the frame of the board; none where light is even."""


def _shots(handpiece: Handpiece, board: Board, options: PhotographOptions) -> list[_Shot]:
    """Raises InputError where the handpiece has no lights to shine."""
    if options.lit != "evenly" and not handpiece.lights:
        raise InputError(f"handpiece {handpiece.name}: it has no lights; use --lit evenly")
    digits, lights = len(str(options.instants - 1)), list(handpiece.lights)
    shots = []
    for k, pose in enumerate(board_poses(handpiece, board, options)):
        name, on = f"{k:0{digits}d}", lights if options.lit == "together" else []
        if options.lit == "one-by-one":  # each light meets each camera, whatever numbers there are of both
            on = [lights[(k + k // len(lights)) % len(lights)]]
            name = f"{name}-{on[0]}"
        board_from_rig = pose.inverse()
        shots.append(_Shot(name, pose, tuple(handpiece.lights[each].in_frame(board_from_rig) for each in on)))
    return shots


def _gain(handpiece: Handpiece, board: Board, shots: Sequence[_Shot]) -> float:
    """The exposure, one for all images: with it the board is about as bright as in even light."""
    if not shots[0].lights:
        return 1.0
    levels = [_irradiance(shot.lights, board.corners).mean(axis=1) for shot in shots]
    return float(1 / np.percentile(levels, _BRIGHT_PERCENTILE))


def _irradiance(lights: Sequence[Light], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Linear RGB light on places of a board, of lights in its frame."""
    facing = np.broadcast_to([0.0, 0.0, -1.0], points.shape)
    return np.sum([np.outer(each.irradiance(points, facing), each.colour) for each in lights], axis=0)


def board_light(
    board: Board,
    camera: Camera,
    rays_in_cam: Float[np.ndarray, "n 3"],
    cam_from_board: Rigid3,
    lights: Sequence[Light] = (),
) -> Float[np.ndarray, "h w 3"]:
    """Linear light of each pixel that looks at a board, lit evenly or by lights in its frame; paper where it looks past
    it or at its back, which lights do not reach. Risers are as between the squares. The rays of a pixel are
    consecutive (:func:`cuspid.simulation.raycast.pixel_rays`)."""
    rays = rays_in_cam @ cam_from_board.rotation
    eye = cam_from_board.inverse().translation
    reach, on_terrace = _first_hits(board, eye, rays)
    before = (reach > 0) & np.isfinite(reach)
    dark = before & board.inverted
    printed = before & on_terrace
    dark[printed] = board.is_dark(eye[:2] + reach[printed, None] * rays[printed, :2])
    ink = dark.reshape(camera.height, camera.width, -1).mean(axis=2)
    light = np.repeat((_LIGHT + (_DARK - _LIGHT) * ink)[..., None], 3, axis=2)
    if not lights:
        return light
    samples = len(rays) // ink.size
    middle = np.arange(samples // 2, len(rays), samples)
    reached = middle[before[middle]]
    shade = np.zeros((ink.size, 3))
    shade[before[middle]] = _irradiance(lights, eye + reach[reached, None] * rays[reached])
    return light * shade.reshape(light.shape)


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


# --- a board that moves ----------------------------------------------------------------------------------------------


class BoardFilm:
    """What the cameras of a handpiece see of a board that is moved from one pose to the next and held there in between:
    half of the time it is still. Light is even, and nothing is smeared."""

    def __init__(
        self, handpiece: Handpiece, board: Board, options: PhotographOptions, pose_s: float, seed: int = 0
    ) -> None:
        """A board that takes the poses of :func:`board_poses`, one after the other and over again."""
        self._handpiece, self._board, self._pose_s, self._seed = handpiece, board, pose_s, seed
        self._poses = board_poses(handpiece, board, options)
        self._rays = {
            name: pixel_rays(each.camera, options.supersampling) for name, each in handpiece.rig.cameras.items()
        }

    def rig_from_board(self, time_s: float) -> Rigid3:
        """Where the board is at a moment."""
        whole, share = divmod(time_s / self._pose_s, 1.0)
        here, there = (self._poses[(int(whole) + k) % len(self._poses)] for k in (0, 1))
        ease = np.clip(2 * share - 1, 0, 1)
        ease = ease * ease * (3 - 2 * ease)
        turn = Rotation.from_matrix(here.rotation.T @ there.rotation).as_rotvec()
        rotation = here.rotation @ Rotation.from_rotvec(ease * turn).as_matrix()
        middle = np.array([*self._board.size_mm, -self._board.height_mm]) / 2
        path = [pose.apply(middle[None])[0] for pose in (here, there)]
        return Rigid3(rotation, path[0] + ease * (path[1] - path[0]) - rotation @ middle)

    def image(self, camera: str, time_s: float) -> UInt8[np.ndarray, "h w 3"]:
        """What a camera takes at a moment."""
        mounted = self._handpiece.rig[camera]
        cam_from_board = mounted.cam_from_rig @ self.rig_from_board(time_s)
        light = board_light(self._board, mounted.camera, self._rays[camera], cam_from_board)
        rng = np.random.default_rng([self._seed, 6, round(1e6 * time_s), *camera.encode()])
        return record(light, 1.0, self._handpiece, camera, rng)
