"""One adjustment of the cameras, the poses of the board, and its bending.

A corner X of the board is seen by camera c at instant i at ``project(c, cam_from_rig[c] @ rig_from_board[i] @ X)``.
Unknowns and how a step changes them: for each camera, the parameters of its lens by addition, and its pose by a
small motion (rotation vector rad, translation mm) on the left of ``cam_from_rig``; the pose of the board at each
instant, by one on the left of ``rig_from_board``; and three parameters of a board that is not quite flat: out of its
plane by b1 u^2 + b2 u v + b3 v^2 mm at the distances u and v, in units of half its diagonal, from its middle. A board
with terraces is a solid body and not bent: there b1 is how much higher than given each step is, and b2 and b3 are 0.
Of several boards that are fixed to one another, each is bent in its own way, and the places of all but the first are
unknown too: X is then ``body_from_board @`` the corner on its board, and ``rig_from_board`` moves the body.

Cameras that do not expose together see a board that moves where it was at other moments. A corner in a view is then at
``sum_k w_k(t) rig_from_board[k] @ X``: the polynomial (Lagrange) through its places at successive instants k about
the time t at which it was exposed, in frames: the number of the frame of its view, a delay of the camera and one of
the view, and where the shutter rolls ``readout * (y / height - 1/2)`` for a corner at the height y of the image; delays
and readouts are unknown. :mod:`cuspid.calibration.timing` chooses the instants.

The rig frame is that of the first camera; for the covariance it is defined by all cameras together (inner constraints,
Triggs et al. 2000, section 9.2), so that no camera counts as exact.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from cuspid.calibration.board_shape import BoardShape, nodes_of
from cuspid.calibration.corners import BoardView, Views
from cuspid.calibration.equations import (
    Layout,
    between_motions,
    gradient_of,
    matrix_of,
    motion_equations,
    without_motions,
)
from cuspid.calibration.scatter import covariance_of, influences
from cuspid.geometry import Rigid3
from cuspid.model.board import Board, Target
from cuspid.model.camera import Camera
from cuspid.model.epipolar import skew
from cuspid.model.rig import MountedCamera
from cuspid.runtime.errors import ReconstructionError

_PLACE, _BENDING = 6, 3
_LENSES, _CAMERAS, _BOARDS, _BENDINGS, _SHAPES, _MOUNTS, _CAMERA_DELAYS, _READOUTS, _VIEW_DELAYS = range(9)
"""Kinds of unknowns, in order."""
_RADIAL_SIGMA, _SIDEWAYS_SIGMA = 0.5, 0.01
"""Standard deviation of radial, and of tangential and prism parameters about 0, for lenses as they are made: it matters
only where the images do not decide. Radial terms beyond the second may do as much at the corner of the image."""
_CONTROL_PX = 1.0
"""Standard deviation of what a control point of a splined lens shifts places by."""
_CENTRE_SHARE = 0.05
"""Standard deviation of the principal point about the image centre, as a share of the image width."""
_BENDING_SHARE = 0.01
"""Standard deviation of the bending, as a share of half the diagonal of the board."""
_MOUNT_SIGMA = 1e3
"""Standard deviation of a turn (rad) and a shift (mm) of a board on the body, which is to hold none."""
_CAMERA_DELAY_SIGMA = 3.0
"""Standard deviation of the delay of a camera, in frames."""
_VIEW_DELAY_SIGMA = 1 / np.sqrt(12)
"""Standard deviation of the delay of a view from that of its camera, in frames: a camera that runs freely may expose at
any moment of a frame."""
_READOUT_SIGMA = 1.0
"""Standard deviation of the readout of a camera about 0, in frames: it ends before the next one begins."""
_KNEE = 2.5
"""Residuals beyond this, in standard deviations, have less weight (Huber)."""
_STEPS, _SETTLED = 100, 0.01
"""Maximum number of steps; and the decrease of the cost, in squared standard deviations, below which iteration ends."""
_MOST_DAMPING = 1e8
"""Largest damping of a step, as a share of the diagonal of the normal equations."""
_LEAST_SIGMA_PX = 1e-6
_Key = TypeVar("_Key")
_TELLINGS, _ALIKE = 6, 0.1
"""Maximum number of times that the unevenness of a board, and how loosely views hang together, are estimated anew; and
the change, as a share, below which they stay."""
_TIGHT, _LOOSEST = 0.1, 100.0
"""In standard deviations of a corner, what no view is taken to be off from others by less, or by more, than."""
_LOOSE_ROUNDS = 8


@dataclass(frozen=True, eq=False, kw_only=True)
class Timing:
    """When each view was taken, and each row of it, of cameras that do not expose all rows together."""

    frame: Mapping[str, int]
    """Number of the frame of each instant: frames follow each other at equal times."""
    near: Mapping[tuple[str, str], tuple[str, ...]]
    """By camera and instant of a view, the instant nearest to when it was taken, and up to four beside that."""
    by_camera: Mapping[str, float]
    """How many frames after an instant each camera exposes."""
    by_view: Mapping[tuple[str, str], float]
    """How many frames later still it did so in each view."""
    readout: Mapping[str, float] = field(default_factory=dict)
    """How many frames after the first row of an image each camera exposes the last one; of none, all at once."""
    together: bool = False
    """Whether the cameras expose together, their middle rows that is, so that there are no delays."""

    def delay(self, camera: str, instant: str) -> float:
        """How many frames after an instant a camera exposed."""
        return self.by_camera[camera] + self.by_view[camera, instant]

    def time(self, camera: str, instant: str) -> float:
        """When a view was taken, in frames."""
        return self.frame[instant] + self.delay(camera, instant)

    def later(
        self, cameras: Float[np.ndarray, "c"], readouts: Float[np.ndarray, "r"], views: Float[np.ndarray, "v"]
    ) -> Timing:
        """The timing with delays and readouts increased by so many frames."""
        return replace(
            self,
            by_camera=_longer(self.by_camera, cameras),
            readout=_longer(self.readout, readouts),
            by_view=_longer(self.by_view, views),
        )


def _longer(frames: Mapping[_Key, float], by: Float[np.ndarray, "n"]) -> dict[_Key, float]:
    return dict(zip(frames, np.add([*frames.values()], by).tolist(), strict=True))


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardScene:
    """Cameras, and the poses of the board."""

    cameras: Mapping[str, Camera]
    """Cameras by name; the frame of the first one is the rig frame."""
    cam_from_rig: Mapping[str, Rigid3]
    """Poses of the cameras."""
    rig_from_board: Mapping[str, Rigid3]
    """Pose of the board at each instant."""
    bending_mm: Float[np.ndarray, "k"]
    """Deviation from the plane, of u^2, u v and v^2; with terraces, how much higher than given each step is, and
    zeros. Of several boards, one after the other."""
    body_from_board: Mapping[int, Rigid3] = field(default_factory=dict)
    """Places of boards on a body that several of them are fixed to, by their numbers; the others carry its frame."""
    shape: BoardShape | None = None
    """Where the corners lie on a board that is not printed and mounted evenly; None if they lie as given, and for
    several boards."""
    timing: Timing | None = None
    """When each view was taken; None if all cameras expose together."""
    loose_px: float = 0.0
    """Standard deviation by which a view may show the board elsewhere than those of the other cameras at that instant
    do; 0 if they show it at the same place."""

    def rig_from_view(self, camera: str, instant: str) -> Rigid3:
        """The pose of the board when a view was taken."""
        if self.timing is None:
            return self.rig_from_board[instant]
        near = self.timing.near[camera, instant]
        frames = np.array([[self.timing.frame[each] for each in near]], dtype=np.float64)
        weights, _ = interpolation(frames, np.array([self.timing.time(camera, instant)]))
        blend = np.einsum("k,kij->ij", weights[0], np.stack([self.rig_from_board[each].matrix for each in near]))
        u, _, vt = np.linalg.svd(blend[:3, :3])
        return Rigid3(u @ vt, blend[:3, 3])


@dataclass(frozen=True, eq=False, kw_only=True)
class Adjusted:
    """Result of an adjustment."""

    scene: BoardScene
    """The best scene."""
    sigma_px: float
    """Standard deviation of one coordinate of a corner, besides what the board was elsewhere by in its view."""
    residuals: Mapping[tuple[str, str], Float[np.ndarray, "n 2"]]
    """Observed minus projected, px, by camera and instant."""
    settled: bool
    """Whether the search for the minimum converged."""
    equations: _Equations | None
    """From which the covariance follows; None where the cameras were held."""

    @property
    def covariance(self) -> Float[np.ndarray, "k k"]:
        """Covariance of the cameras, if the corners err independently: the parameters of each in order, then the motion
        of each, then their readouts, where there are any."""
        return self._uncertainty[0]

    @property
    def influence(self) -> Float[np.ndarray, "i k"]:
        """How much each instant moves the parameters (:mod:`cuspid.calibration.scatter`)."""
        return self._uncertainty[1]

    @cached_property
    def _uncertainty(self) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "i k"]]:
        if self.equations is None:
            return np.zeros((0, 0)), np.zeros((0, 0))
        return _camera_covariance(self.scene, self.equations)


@dataclass(frozen=True, eq=False)
class _Observations:
    """All corners that were seen, as arrays."""

    camera: Int[np.ndarray, "n"]
    view: Int[np.ndarray, "n"]
    near: Int[np.ndarray, "v k"]
    """By view, the instants about its time; the last one several times where there are fewer than elsewhere."""
    frames: Float[np.ndarray, "v k"]
    """The numbers of their frames; NaN for repeated ones."""
    points: Float[np.ndarray, "n 3"]
    """On the board as it is given, mm."""
    basis: Float[np.ndarray, "n b"]
    """What each number of the bending lifts them by."""
    board: Int[np.ndarray, "n"]
    """Which board they are on."""
    nodes: Int[np.ndarray, "n m"]
    """The nodes of the unevenness about each, and"""
    shares: Float[np.ndarray, "n m"]
    """by how much it follows them."""
    pixels: Float[np.ndarray, "n 2"]
    rows: Float[np.ndarray, "n"]
    """How far below the middle of the image each was seen, as a share of its height."""
    keys: tuple[tuple[str, str], ...]
    starts: Int[np.ndarray, "s"]

    @staticmethod
    def of(views: Views, board: Target, scene: BoardScene) -> _Observations:
        """In the order of the views."""
        keys, cameras, instants = tuple(views), list(scene.cameras), list(scene.rig_from_board)
        counts = [len(views[key].corner) for key in keys]
        corner = np.concatenate([views[key].corner for key in keys])
        heights = [scene.cameras[camera].height for camera, _ in keys]
        points, number = board.corners[corner], board.board_of(corner)
        nodes, shares = nodes_of(board)
        near = [(instant,) if scene.timing is None else scene.timing.near[camera, instant] for camera, instant in keys]
        most = max(len(each) for each in near)
        frame = dict.fromkeys(instants, 0) if scene.timing is None else scene.timing.frame
        return _Observations(
            camera=np.repeat([cameras.index(camera) for camera, _ in keys], counts),
            view=np.repeat(np.arange(len(keys)), counts),
            near=np.array([[instants.index(each[min(k, len(each) - 1)]) for k in range(most)] for each in near]),
            frames=np.array([[*(float(frame[k]) for k in each), *[np.nan] * (most - len(each))] for each in near]),
            points=points,
            basis=_bases(board, points, number),
            board=number,
            nodes=nodes[corner],
            shares=shares[corner],
            pixels=np.concatenate([views[key].pixels for key in keys]),
            rows=np.concatenate(
                [views[key].pixels[:, 1] / height - 0.5 for key, height in zip(keys, heights, strict=True)]
            ),
            keys=keys,
            starts=np.cumsum([0, *counts]),
        )

    def weights(self, scene: BoardScene) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k"]]:
        """For each corner, of the instants about its view, and their derivatives by its time."""
        timing = scene.timing
        times = self.frames[:, 0] if timing is None else np.array([timing.time(*key) for key in self.keys])
        if timing is None or not timing.readout:
            weights, slopes = interpolation(self.frames, times)
            return weights[self.view], slopes[self.view]
        readouts = np.array([timing.readout[name] for name in scene.cameras])
        return interpolation(self.frames[self.view], times[self.view] + readouts[self.camera] * self.rows)


def interpolation(
    frames: Float[np.ndarray, "v k"], times: Float[np.ndarray, "v"]
) -> tuple[Float[np.ndarray, "v k"], Float[np.ndarray, "v k"]]:
    """Weights of values at some frames for the polynomial through them, and their derivatives by the time (Lagrange);
    frames that are NaN have none."""
    weights, slopes = np.ones_like(frames), np.zeros_like(frames)
    for other in range(frames.shape[1]):
        gap = frames - frames[:, other, None]
        factor = np.isfinite(gap) & (gap != 0)
        ahead = (times - frames[:, other])[:, None] / np.where(factor, gap, 1.0)
        slopes = np.where(factor, slopes * ahead + weights / np.where(factor, gap, 1.0), slopes)
        weights = np.where(factor, weights * ahead, weights)
    used = np.isfinite(frames)
    return np.where(used, weights, 0.0), np.where(used, slopes, 0.0)


def _basis(board: Board, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """What each number of the bending lifts places on a board by, mm along +Z."""
    if board.terraces > 1:
        return np.asarray(points[:, 2:] / board.step_mm * [1.0, 0.0, 0.0])
    u, v = bending_coordinates(board, points).T
    return np.stack([u * u, u * v, v * v], axis=1)


def _bases(board: Target, points: Float[np.ndarray, "n 3"], number: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n b"]:
    """The same of places on several boards, each with numbers of its own."""
    own = [np.where((number == k)[:, None], _basis(each, points), 0.0) for k, each in enumerate(board.boards)]
    return np.concatenate(own, axis=1)


def bend_points(
    board: Board, points: Float[np.ndarray, "n 3"], bending_mm: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3"]:
    """Points of the board as it is given, moved to where they are on the bent one, mm."""
    return points + (_basis(board, points) @ bending_mm)[:, None] * [0.0, 0.0, 1.0]


def bending_coordinates(board: Board, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """u and v of points on a board."""
    size = np.array(board.size_mm)
    return np.asarray((points[:, :2] - size / 2) / (np.linalg.norm(size) / 2))


def select_instants(scene: BoardScene, instants: set[str]) -> BoardScene:
    """The scene with the board at these instants only."""
    kept = {name: pose for name, pose in scene.rig_from_board.items() if name in instants}
    return replace(scene, rig_from_board=kept)


# --- one step ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Projection:
    """Where a scene puts the corners."""

    in_cam: Float[np.ndarray, "n 3"]
    raw: Float[np.ndarray, "n 2"]
    """Residuals, px; NaN behind a camera."""
    by_view: Float[np.ndarray, "n 2 6"] | None
    """Derivatives by a motion of the board in each view, where the scene is loose, and"""
    of_motions: tuple[Float[np.ndarray, "v 6 6"], Float[np.ndarray, "v 6"]] | None
    """the normal equations of these motions, each corner with the weight 1."""

    @property
    def is_whole(self) -> bool:
        """Whether all corners lie before the cameras."""
        return bool(np.isfinite(self.raw).all())


def _project(scene: BoardScene, seen: _Observations) -> _Projection:
    points = _bend_points(scene, seen)
    in_rig = np.einsum("nk,nkj->nj", seen.weights(scene)[0], _at_instants(scene, seen, points))
    in_cam = _move_points(list(scene.cam_from_rig.values()), seen.camera, in_rig)
    image = np.empty_like(seen.pixels)
    for number, camera in enumerate(scene.cameras.values()):
        image[seen.camera == number] = camera.project(in_cam[seen.camera == number])
    raw = seen.pixels - image
    if not (scene.loose_px > 0 and np.isfinite(raw).all()):
        return _Projection(in_cam, raw, None, None)
    by_view = _view_derivatives(scene, seen, in_cam)
    return _Projection(in_cam, raw, by_view, motion_equations(raw, by_view, np.ones(len(raw)), seen.starts))


def _bend_points(scene: BoardScene, seen: _Observations) -> Float[np.ndarray, "n 3"]:
    """On the body."""
    flat = seen.points if scene.shape is None else seen.points + scene.shape.interpolate(seen.nodes, seen.shares)
    points = np.asarray(flat + (seen.basis @ scene.bending_mm)[:, None] * [0.0, 0.0, 1.0])
    return _move_points(_board_mounts(scene, seen), seen.board, points) if scene.body_from_board else points


def _board_mounts(scene: BoardScene, seen: _Observations) -> list[Rigid3]:
    """Of each board that is seen, by number."""
    return [scene.body_from_board.get(number, Rigid3.identity()) for number in range(int(seen.board.max()) + 1)]


def _at_instants(
    scene: BoardScene, seen: _Observations, points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n k 3"]:
    """Points of the board in the rig, at the instants about their views."""
    boards = list(scene.rig_from_board.values())
    return np.stack([_move_points(boards, which[seen.view], points) for which in seen.near.T], axis=1)


def _move_points(
    motions: Sequence[Rigid3], which: Int[np.ndarray, "n"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    rotations = np.stack([motion.rotation for motion in motions])[which]
    translations = np.stack([motion.translation for motion in motions])[which]
    return np.asarray(np.einsum("nij,nj->ni", rotations, points) + translations)


def _derivatives(
    scene: BoardScene, seen: _Observations, in_cam: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 2 w"]:
    """Derivatives of the projections by the unknowns in :func:`_columns`."""
    by_point, by_parameters = _camera_derivatives(scene, seen, in_cam)
    turn = np.stack([place.rotation for place in scene.cam_from_rig.values()])[seen.camera]
    by_rig = by_point @ turn
    weights, slopes = seen.weights(scene)
    places = _at_instants(scene, seen, _bend_points(scene, seen))
    turns = np.stack([pose.rotation for pose in scene.rig_from_board.values()])[seen.near[seen.view]]
    by_body = by_rig @ np.einsum("nk,nkjm->njm", weights, turns)
    normals = np.stack([mount.rotation[:, 2] for mount in _board_mounts(scene, seen)])[seen.board]
    by_bending = np.einsum("nij,nj->ni", by_body, normals)[:, :, None] * seen.basis[:, None]
    blocks = [by_parameters, _motion_derivatives(by_point, in_cam), by_bending]
    if scene.shape is not None:
        blocks += [by_body * share[:, None, None] for share in seen.shares.T]
    blocks += [weights[:, k, None, None] * _motion_derivatives(by_rig, places[:, k]) for k in range(places.shape[1])]
    if scene.body_from_board:
        _, mounted = _mount_of(scene, seen)
        blocks.append(mounted[:, None, None] * _motion_derivatives(by_body, _bend_points(scene, seen)))
    if scene.timing is not None:
        by_time = np.einsum("nij,nk,nkj->ni", by_rig, slopes, places)[:, :, None]
        blocks += [by_time, by_time]
        if scene.timing.readout:
            blocks.append(by_time * seen.rows[:, None, None])
    return np.concatenate(blocks, axis=2)


def _columns(scene: BoardScene, seen: _Observations) -> Int[np.ndarray, "n w"]:
    """Of each corner, the unknowns that it has to do with, in the order of :func:`_sizes`."""
    which = [
        (_LENSES, seen.camera, _numbers(scene)),
        (_CAMERAS, seen.camera, _PLACE),
        (_BENDINGS, 0 * seen.camera, len(scene.bending_mm)),
    ]
    if scene.shape is not None:
        which += [(_SHAPES, node, 3) for node in seen.nodes.T]
    which += [(_BOARDS, instant, _PLACE) for instant in seen.near[seen.view].T]
    if scene.body_from_board:
        which.append((_MOUNTS, _mount_of(scene, seen)[0], _PLACE))
    if scene.timing is not None:
        which += [(_CAMERA_DELAYS, seen.camera, 1), (_VIEW_DELAYS, seen.view, 1)]
        if scene.timing.readout:
            which.append((_READOUTS, seen.camera, 1))
    first = np.cumsum([0, *_sizes(scene)])
    return np.concatenate(
        [first[kind] + size * index[:, None] + np.arange(size) for kind, index, size in which], axis=1
    )


def _mount_of(scene: BoardScene, seen: _Observations) -> tuple[Int[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Which of the mounts moves each corner (0 where none does), and whether one does."""
    numbers = list(scene.body_from_board)
    place = np.array([numbers.index(k) if k in numbers else -1 for k in range(int(seen.board.max()) + 1)])[seen.board]
    return np.maximum(place, 0), place >= 0


def _sizes(scene: BoardScene) -> tuple[int, ...]:
    """How many numbers there are of each kind of unknowns."""
    cameras, instants = len(scene.cameras), len(scene.rig_from_board)
    timing = scene.timing
    times = (0, 0, 0) if timing is None else (cameras, len(timing.readout), len(timing.by_view))
    shape = 0 if scene.shape is None else scene.shape.offsets_mm.size
    mounts = _PLACE * len(scene.body_from_board)
    return _numbers(scene) * cameras, _PLACE * cameras, _PLACE * instants, len(scene.bending_mm), shape, mounts, *times


def _numbers(scene: BoardScene) -> int:
    """How many parameters a camera has, at most: those of a smaller model are followed by some that mean nothing."""
    return max(len(camera.parameters) for camera in scene.cameras.values())


def _camera_derivatives(
    scene: BoardScene, seen: _Observations, in_cam: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 2 3"], Float[np.ndarray, "n 2 k"]]:
    """Derivatives of the pixels by the points in the cameras, and by the parameters of these."""
    by_point = np.empty((len(in_cam), 2, 3))
    by_parameters = np.zeros((len(in_cam), 2, _numbers(scene)))
    for number, camera in enumerate(scene.cameras.values()):
        own, count = seen.camera == number, len(camera.parameters)
        by_point[own], by_parameters[own, :, :count] = camera.projection_derivatives(in_cam[own])
    return by_point, by_parameters


def _motion_derivatives(
    by_point: Float[np.ndarray, "n 2 3"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 2 6"]:
    """Derivative by a small motion (rotation vector, translation) of the points."""
    turning = np.cross(points[:, None], by_point)
    return np.concatenate([turning, by_point], axis=2)


# --- minimisation ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Free:
    """Which of the unknowns may move, and the prior that holds them."""

    columns: Int[np.ndarray, "k"]
    prior: Float[np.ndarray, "k k"]
    """Inverse of their covariance, before any image."""
    of_instants: Int[np.ndarray, "p"]
    """Which of the free ones belong to single instants."""
    layout: Layout
    """Which of them each corner has to do with."""

    @staticmethod
    def of(scene: BoardScene, seen: _Observations, board: Target, *, only_boards: bool) -> _Free:
        """All but the place of the first camera, which is the rig, and what a board with terraces has no use of; or
        the places of the board alone, and the delays of the views."""
        sizes = _sizes(scene)
        lenses, places, boards, _, shape, mounts, cameras, readouts, views = sizes
        precision = np.concatenate(
            [
                *(_lens_precision(camera, _numbers(scene)) for camera in scene.cameras.values()),
                np.zeros(places + boards),
                np.repeat([_bending_sigma_mm(each) ** -2.0 for each in board.boards], _BENDING),
                np.zeros(shape),
                np.full(mounts, _MOUNT_SIGMA**-2.0),
                np.full(cameras, _CAMERA_DELAY_SIGMA**-2.0),
                np.full(readouts, _READOUT_SIGMA**-2.0),
                np.full(views, _VIEW_DELAY_SIGMA**-2.0),
            ]
        )
        free, kind = np.ones(len(precision), dtype=bool), np.repeat(np.arange(len(sizes)), sizes)
        if only_boards:
            free = np.isin(kind, (_BOARDS, _VIEW_DELAYS))
        free[lenses : lenses + _PLACE] = False
        for k, camera in enumerate(scene.cameras.values()):
            if camera.lens.splined:
                free[_numbers(scene) * k + camera.parameter_names.index("reach")] = False
        if board.terraces > 1:
            free[np.flatnonzero(kind == _BENDINGS)[1:]] = False
        if scene.timing is not None:
            free[len(free) - views :] = ~_first_of_instants(scene.timing.by_view)
            if scene.timing.together:
                free[np.isin(kind, (_CAMERA_DELAYS, _VIEW_DELAYS))] = False
        columns = np.flatnonzero(free)
        prior, of_shape = np.diag(precision[columns]), np.flatnonzero(kind[columns] == _SHAPES)
        if scene.shape is not None and len(of_shape):
            assert isinstance(board, Board)
            prior[np.ix_(of_shape, of_shape)] = scene.shape.precision(board)
        of_instants = np.flatnonzero(np.isin(kind[columns], (_BOARDS, _VIEW_DELAYS)))
        number = np.full(len(free), -1)
        number[columns] = np.arange(len(columns))
        layout = Layout.of(number[_columns(scene, seen)], seen.starts, len(columns))
        return _Free(columns, prior, of_instants, layout)


def _first_of_instants(views: Iterable[tuple[str, str]]) -> Bool[np.ndarray, "v"]:
    """Which views are the first ones of their instants: these set the times of their poses of the board."""
    instants = [instant for _, instant in views]
    return np.array([instant not in instants[:k] for k, instant in enumerate(instants)])


def _bending_sigma_mm(board: Board) -> float:
    """Standard deviation of the numbers of the bending."""
    if board.terraces > 1:
        return board.step_sigma_um / 1000
    return _BENDING_SHARE * float(np.linalg.norm(board.size_mm)) / 2


def adjust_board(
    start: BoardScene, views: Views, board: Target, *, only_boards: bool = False, keep_scales: bool = False
) -> Adjusted:
    """The scene that best explains the observed corners, and its uncertainty (Levenberg-Marquardt on the Huber loss;
    its scale is found from the residuals). With ``only_boards``, cameras and board are held fixed; with
    ``keep_scales``, how uneven the board and how loose the views are.

    Raises ReconstructionError where the images leave something undetermined, or a corner lies behind a camera.
    """
    seen = _Observations.of(views, board, start)
    free = _Free.of(start, seen, board, only_boards=only_boards)
    scene, settled = _minimize(start, seen, free)
    estimate_priors = not (only_boards or keep_scales) and (scene.shape is not None or scene.loose_px > 0)
    for _ in range(_TELLINGS if estimate_priors else 0):
        before, scene = scene, _update_priors(scene, seen, free, board)
        if _priors_converged(before, scene):
            break
        free = _Free.of(scene, seen, board, only_boards=only_boards)
        scene, settled = _minimize(scene, seen, free)
    projection = _project(scene, seen)
    pieces = np.split(projection.raw, seen.starts[1:-1])
    sigma_px = _scale(_project_out_motions(scene, seen, projection, None)[0])
    return Adjusted(
        scene=scene,
        sigma_px=sigma_px,
        residuals=dict(zip(seen.keys, pieces, strict=True)),
        settled=settled,
        equations=None if only_boards else _Equations.of(scene, seen, projection, sigma_px, free),
    )


def unevenness_score(found: Adjusted, views: Views, board: Board) -> float:
    """Score test of an even board: the mean square, over the coordinates of its corners, of how hard the residuals pull
    at each, in standard deviations; about 1 if all lie as given."""
    scene = replace(found.scene, shape=BoardShape.even(board))
    seen = _Observations.of(views, board, scene)
    free = _Free.of(scene, seen, board, only_boards=False)
    of_shape = _mask_of_kind(scene, free, _SHAPES)
    rows = _weigh_equations(scene, seen, _project(scene, seen), found.sigma_px, free)
    information = np.diag(matrix_of(rows.values, free.layout))[of_shape]
    pull = rows.pull[of_shape]
    return float(np.mean(pull[information > 0] ** 2 / information[information > 0]))


def views_in_front(scene: BoardScene, views: Views, board: Target) -> dict[tuple[str, str], BoardView]:
    """The views of which every corner lies in front of the camera."""
    seen = _Observations.of(views, board, scene)
    residuals = np.split(_project(scene, seen).raw, seen.starts[1:-1])
    return {key: views[key] for key, each in zip(seen.keys, residuals, strict=True) if np.isfinite(each).all()}


def views_at_middle_rows(scene: BoardScene, views: Views, board: Target) -> dict[tuple[str, str], BoardView]:
    """Views with their corners where they would have been seen if all rows were exposed with the middle one."""
    if scene.timing is None or not scene.timing.readout:
        return dict(views)
    at_once = replace(scene, timing=replace(scene.timing, readout={}))
    seen = _Observations.of(views, board, scene)
    late = np.split(_project(scene, seen).raw - _project(at_once, seen).raw, seen.starts[1:-1])
    return {key: view.shifted(each) for (key, view), each in zip(views.items(), late, strict=True)}


def _minimize(scene: BoardScene, seen: _Observations, free: _Free) -> tuple[BoardScene, bool]:
    """The best scene, and whether another step would not have been worth it."""
    projection = _project(scene, seen)
    if not projection.is_whole:
        raise ReconstructionError("calibration: a corner of the board lies behind a camera that saw it")
    damping, settled, steps = 1e-4, False, 0
    here = _Slope.of(scene, seen, projection, free)
    while not settled and steps < _STEPS and damping < _MOST_DAMPING:
        steps += 1
        step = _solve(here.matrix + damping * np.diag(np.diag(here.matrix)), here.gradient)
        candidate = _apply_step(scene, free, step)
        after = None if candidate is None else _project(candidate, seen)
        if candidate is None or after is None or not _cost(candidate, seen, after, here.sigma_px, free) <= here.cost:
            damping *= 10
            continue
        settled = float(step @ here.gradient) < _SETTLED
        scene, damping = candidate, max(damping / 10, 1e-12)
        here = here if settled else _Slope.of(scene, seen, after, free)
    return scene, settled


@dataclass(frozen=True, eq=False)
class _Slope:
    """What a step from a scene follows from."""

    sigma_px: float
    cost: float
    matrix: Float[np.ndarray, "k k"]
    """Of the normal equations."""
    gradient: Float[np.ndarray, "k"]

    @staticmethod
    def of(scene: BoardScene, seen: _Observations, projection: _Projection, free: _Free) -> _Slope:
        """Given where it puts the corners."""
        sigma_px = _scale(_project_out_motions(scene, seen, projection, None)[0])
        apart = _project_out_motions(scene, seen, projection, sigma_px)
        cost = _cost_of(scene, *apart, sigma_px, free)
        return _Slope(
            sigma_px, cost, *_normal(scene, _weigh_equations(scene, seen, projection, sigma_px, free, apart), free)
        )


def _project_out_motions(
    scene: BoardScene,
    seen: _Observations,
    projection: _Projection,
    sigma_px: float | None,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "v 6"]]:
    """The residuals without what the board was elsewhere by in each view, and that, px; by a standard deviation of a
    coordinate, or by what it is found to be."""
    motions, residuals, by_view = np.zeros((len(seen.keys), _PLACE)), projection.raw, projection.by_view
    if by_view is None or projection.of_motions is None:
        return residuals, motions
    for _ in range(_LOOSE_ROUNDS):
        sigma, before = _scale(residuals) if sigma_px is None else sigma_px, motions
        odd = 1 - sigma**2 * _weights(residuals, sigma)
        less, pull = motion_equations(projection.raw, by_view, odd, seen.starts)
        matrix, right = (projection.of_motions[0] - less) / sigma**2, (projection.of_motions[1] - pull) / sigma**2
        matrix += np.eye(_PLACE) / scene.loose_px**2
        motions = np.linalg.solve(matrix, right[:, :, None])[:, :, 0]
        if np.array_equal(motions, before):
            break
        residuals = without_motions(projection.raw, by_view, seen.starts, motions)
    return residuals, motions


def _sum_by_view(seen: _Observations, values: Float[np.ndarray, "n *k"]) -> Float[np.ndarray, "v *k"]:
    """Sums over the corners of each view."""
    return np.asarray(np.add.reduceat(values, seen.starts[:-1], axis=0))


def _view_derivatives(
    scene: BoardScene, seen: _Observations, in_cam: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 2 6"]:
    """Derivatives by a motion of the board in each view, about its middle, whose numbers are what the corners move by,
    px."""
    by_point, _ = _camera_derivatives(scene, seen, in_cam)
    counts = np.diff(seen.starts)
    middle = _sum_by_view(seen, in_cam) / counts[:, None]
    away = in_cam - middle[seen.view]
    size = np.sqrt(_sum_by_view(seen, np.sum(away**2, axis=1)) / counts)
    focal = np.array([camera.focal_px.mean() for camera in scene.cameras.values()])[seen.camera]
    px = (np.linalg.norm(middle, axis=1)[seen.view] / focal)[:, None, None]
    return np.asarray(
        px * np.concatenate([np.cross(away[:, None], by_point) / size[seen.view][:, None, None], by_point], 2)
    )


def _weights(residuals: Float[np.ndarray, "n 2"], sigma_px: float) -> Float[np.ndarray, "n"]:
    """Of the squares of residuals, by the Huber loss."""
    lengths = np.linalg.norm(residuals, axis=1) / sigma_px
    return np.asarray(np.minimum(1, _KNEE / np.maximum(lengths, 1e-12)) / sigma_px**2)


def _scale(residuals: Float[np.ndarray, "n 2"]) -> float:
    """Standard deviation of a coordinate, from the median of the lengths (Rayleigh)."""
    return max(float(np.median(np.linalg.norm(residuals, axis=1)) / np.sqrt(2 * np.log(2))), _LEAST_SIGMA_PX)


def _cost(
    scene: BoardScene,
    seen: _Observations,
    projection: _Projection,
    sigma_px: float,
    free: _Free,
) -> float:
    """Huber loss of the residuals, and the prior; infinite where a corner lies behind a camera."""
    return _cost_of(scene, *_project_out_motions(scene, seen, projection, sigma_px), sigma_px, free)


def _cost_of(
    scene: BoardScene,
    residuals: Float[np.ndarray, "n 2"],
    motions: Float[np.ndarray, "v 6"],
    sigma_px: float,
    free: _Free,
) -> float:
    lengths = np.linalg.norm(residuals, axis=1) / sigma_px
    if not np.isfinite(lengths).all():
        return np.inf
    loss = np.where(lengths <= _KNEE, lengths**2, 2 * _KNEE * lengths - _KNEE**2)
    offset = _prior_offset(scene)[free.columns]
    moved = float(np.sum(motions**2)) / scene.loose_px**2 if scene.loose_px else 0.0
    return float(loss.sum() + offset @ free.prior @ offset) + moved


def _lens_precision(camera: Camera, numbers: int) -> Float[np.ndarray, "n"]:
    """Of the prior of so many parameters of a camera."""
    centre = np.full(2, _CENTRE_SHARE * camera.width)
    corner = min(float(np.linalg.norm([camera.width, camera.height]) / 2 / camera.focal_px.mean()), 1.0)
    sigma = np.full(len(camera.distortion), _SIDEWAYS_SIGMA)
    for terms in (camera.lens.numerator, camera.lens.denominator):
        for order, place in enumerate(terms):
            sigma[place] = _RADIAL_SIGMA / corner ** (2 * max(order - 1, 0))
    if camera.lens.splined:
        sigma[-2 * camera.lens.splined**2 :] = _CONTROL_PX / camera.focal_px.mean()
    known = np.concatenate([[0.0, 0.0], centre**-2.0, sigma**-2.0])
    return np.pad(known, (0, numbers - len(known)), constant_values=1.0)


def _prior_offset(scene: BoardScene) -> Float[np.ndarray, "k"]:
    """How far all unknowns are from where the prior holds them; 0 where it does not."""
    lenses = [
        np.pad(
            np.concatenate(
                [[0, 0], camera.principal_point_px - [camera.width / 2, camera.height / 2], camera.distortion]
            ),
            (0, _numbers(scene) - len(camera.parameters)),
        )
        for camera in scene.cameras.values()
    ]
    places = np.zeros(_PLACE * (len(scene.cameras) + len(scene.rig_from_board)))
    timing = scene.timing
    times = [] if timing is None else [*timing.by_camera.values(), *timing.readout.values(), *timing.by_view.values()]
    mounts = np.zeros(_PLACE * len(scene.body_from_board))
    shape = np.zeros(0) if scene.shape is None else scene.shape.offsets_mm.ravel()
    return np.concatenate([*lenses, places, scene.bending_mm, shape, mounts, times])


def _normal(scene: BoardScene, rows: _Rows, free: _Free) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "k"]]:
    """Of the free unknowns: the matrix of the normal equations, and the gradient."""
    return rows.matrix + free.prior, rows.pull - free.prior @ _prior_offset(scene)[free.columns]


@dataclass(frozen=True, eq=False)
class _Rows:
    """Equations of standard deviation 1, and what the board was elsewhere by in each view, px."""

    layout: Layout
    values: Float[np.ndarray, "n 2 w"]
    """Derivatives by the unknowns that each corner has to do with."""
    residuals: Float[np.ndarray, "n 2"]
    by_motion: Float[np.ndarray, "n 2 6"] | None
    """Derivatives by the motion of the board in its view; None where there is none."""
    motions: Float[np.ndarray, "v 6"]
    spread: Float[np.ndarray, "v 6 6"]
    """Covariance of the motions, were all else known; zeros where there are none."""
    between: Float[np.ndarray, "t 6"]
    """Of the unknowns of each view and its motion, in the matrix of the normal equations."""

    @cached_property
    def matrix(self) -> Float[np.ndarray, "k k"]:
        """Of the normal equations of the unknowns, which the motions follow."""
        if self.by_motion is None:
            return matrix_of(self.values, self.layout)
        return matrix_of(self.values, self.layout, self.between, self.spread)

    @property
    def pull(self) -> Float[np.ndarray, "k"]:
        """Product of the transposed derivatives with the residuals."""
        return gradient_of(self.values, self.residuals, self.layout)

    def follow(self, view: int) -> tuple[Int[np.ndarray, "u"], Float[np.ndarray, "6 u"]]:
        """Unknowns that a view has to do with, and by how much its motion follows each."""
        own = slice(self.layout.first[view], self.layout.first[view + 1])
        return self.layout.unknowns[own], self.spread[view] @ self.between[own].T


def _weigh_equations(
    scene: BoardScene,
    seen: _Observations,
    projection: _Projection,
    sigma_px: float,
    free: _Free,
    apart: tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "v 6"]] | None = None,
) -> _Rows:
    """``apart``, if it is known: what :func:`_project_out_motions` returns."""
    residuals, motions = apart or _project_out_motions(scene, seen, projection, sigma_px)
    weights = np.sqrt(_weights(residuals, sigma_px))[:, None]
    values, weighed = _derivatives(scene, seen, projection.in_cam) * weights[:, :, None], residuals * weights
    if projection.by_view is None:
        spread, between = np.zeros((len(seen.keys), _PLACE, _PLACE)), np.zeros((len(free.layout.unknowns), _PLACE))
        return _Rows(free.layout, values, weighed, None, motions, spread, between)
    by_motion = projection.by_view * weights[:, :, None]
    matrix, _ = motion_equations(weighed, by_motion, np.ones(len(weighed)), seen.starts)
    spread = np.asarray(np.linalg.inv(matrix + np.eye(_PLACE) / scene.loose_px**2))
    between = between_motions(values, by_motion, free.layout)
    return _Rows(free.layout, values, weighed, by_motion, motions, spread, between)


@dataclass(frozen=True, eq=False)
class _Equations:
    """The equations at the minimum."""

    seen: _Observations
    free: _Free
    rows: _Rows
    matrix: Float[np.ndarray, "k k"]
    """Of the normal equations, with what the prior tells."""

    @staticmethod
    def of(scene: BoardScene, seen: _Observations, projection: _Projection, sigma_px: float, free: _Free) -> _Equations:
        """Raises ReconstructionError where the images leave something undetermined."""
        rows = _weigh_equations(scene, seen, projection, sigma_px, free)
        matrix = rows.matrix + free.prior
        _solve(matrix, np.zeros(len(matrix)))
        return _Equations(seen, free, rows, matrix)


def _independent(
    rows: _Rows, seen: _Observations, loose_px: float
) -> Iterator[tuple[Float[np.ndarray, "m k"], Float[np.ndarray, "m"]]]:
    """Of each instant, equations that err independently of those of others, the motions in its views eliminated."""
    instants = seen.near[:, 0]
    for instant in np.unique(instants):
        jacobians, residuals = [], []
        for view in np.flatnonzero(instants == instant).tolist():
            part = slice(seen.starts[view], seen.starts[view + 1])
            jacobian = rows.layout.rows_of(view, rows.values)
            jacobians.append(jacobian)
            residuals.append(rows.residuals[part].ravel())
            if rows.by_motion is not None:
                unknowns, of_view = rows.follow(view)
                jacobian[:, unknowns] -= rows.by_motion[part].reshape(-1, _PLACE) @ of_view
                follow = np.zeros((_PLACE, rows.layout.count))
                follow[:, unknowns] = of_view / loose_px
                jacobians.append(follow)
                residuals.append(rows.motions[view] / loose_px)
        yield np.concatenate(jacobians), np.concatenate(residuals)


def _solve(matrix: Float[np.ndarray, "k k"], right: Float[np.ndarray, "k *m"]) -> Float[np.ndarray, "k *m"]:
    """Raises ReconstructionError where the matrix is singular to rounding."""
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    try:
        factor = cho_factor(matrix * scale[:, None] * scale, lower=True)
    except (np.linalg.LinAlgError, ValueError) as error:  # not positive, or not finite
        raise ReconstructionError(
            "calibration: the images do not determine all parameters; show the board from more sides, "
            "tilted by 20 to 50 degrees"
        ) from error
    return np.asarray((scale * cho_solve(factor, (scale * right.T).T).T).T)


def _apply_step(scene: BoardScene, free: _Free, step: Float[np.ndarray, "k"]) -> BoardScene | None:
    """None where a camera would be turned inside out."""
    sizes = _sizes(scene)
    whole = np.zeros(sum(sizes))
    whole[free.columns] = step
    lenses, places, boards, bending, shape, mounts, cameras, readouts, views = np.split(whole, np.cumsum(sizes)[:-1])
    parameters = [
        camera.parameters + shift[: len(camera.parameters)]
        for camera, shift in zip(scene.cameras.values(), lenses.reshape(-1, _numbers(scene)), strict=True)
    ]
    if not all(np.all(each[:2] > 0) for each in parameters):
        return None
    return BoardScene(
        cameras={
            name: camera.with_parameters(each)
            for (name, camera), each in zip(scene.cameras.items(), parameters, strict=True)
        },
        cam_from_rig=_apply_motions(scene.cam_from_rig, places),
        rig_from_board=_apply_motions(scene.rig_from_board, boards),
        bending_mm=scene.bending_mm + bending,
        body_from_board=_apply_motions(scene.body_from_board, mounts),
        shape=scene.shape and scene.shape.with_step(shape),
        timing=scene.timing and scene.timing.later(cameras, readouts, views),
        loose_px=scene.loose_px,
    )


def _apply_motions(poses: Mapping[_Key, Rigid3], motions: Float[np.ndarray, "k"]) -> dict[_Key, Rigid3]:
    turns = Rotation.from_rotvec(motions.reshape(-1, _PLACE)[:, :3]).as_matrix()
    shifts = motions.reshape(-1, _PLACE)[:, 3:]
    return {
        name: Rigid3(turn, shift) @ pose for (name, pose), turn, shift in zip(poses.items(), turns, shifts, strict=True)
    }


# --- how well it is known ----------------------------------------------------------------------------------------


def _update_priors(scene: BoardScene, seen: _Observations, free: _Free, board: Target) -> BoardScene:
    """The scene with a board as uneven, and views as loose, as the images tell (D. MacKay, Neural Computation 4, 1992,
    equation 3.14)."""
    projection = _project(scene, seen)
    sigma_px = _scale(_project_out_motions(scene, seen, projection, None)[0])
    rows = _weigh_equations(scene, seen, projection, sigma_px, free)
    inverse = _solve(rows.matrix + free.prior, np.eye(len(free.columns)))
    of_shape = _mask_of_kind(scene, free, _SHAPES)
    if scene.shape is not None and of_shape.any():
        assert isinstance(board, Board)
        variances = np.diag(inverse)[of_shape].reshape(-1, 3)
        scene = replace(scene, shape=scene.shape.as_uneven(variances, board))
    if scene.loose_px:
        unsure = np.trace(rows.spread, axis1=1, axis2=2).sum()
        for view in range(len(seen.keys)):
            unknowns, follow = rows.follow(view)
            unsure += np.sum((follow @ inverse[np.ix_(unknowns, unknowns)]) * follow)
        dof = rows.motions.size - unsure / scene.loose_px**2
        loose_px = float(np.sqrt(np.sum(rows.motions**2) / max(dof, 1e-3)))
        scene = replace(scene, loose_px=float(np.clip(loose_px, _TIGHT * sigma_px, _LOOSEST * sigma_px)))
    return scene


def _priors_converged(one: BoardScene, other: BoardScene) -> bool:
    """Whether a board is as uneven, and views as loose, as before."""
    before, after = ([each.loose_px, *(each.shape.sigma_mm if each.shape else ())] for each in (one, other))
    return bool(np.allclose(before, after, rtol=_ALIKE, atol=0))


def _camera_covariance(
    scene: BoardScene, known: _Equations
) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, "i m"]]:
    """Of the parameters and the motions of all cameras, in the frame in which these sum up to nothing, and of their
    readouts: as the scatter of the corners gives it, and by how much each instant moves them."""
    free, matrix = known.free, known.matrix
    sizes = _sizes(scene)
    kind = np.repeat(np.arange(len(sizes)), sizes)
    size = sizes[_LENSES] + sizes[_CAMERAS] + sizes[_READOUTS]
    place = np.full(len(kind), -1)  # of each unknown in the covariance
    place[np.isin(kind, (_LENSES, _CAMERAS, _READOUTS))] = np.arange(size)
    shown = np.flatnonzero(place[free.columns] >= 0)
    whole, among = np.zeros((size, size)), place[free.columns[shown]]
    whole[np.ix_(among, among)] = _solve(matrix, np.eye(len(matrix))[:, shown])[shown]
    project = np.eye(size)
    places = slice(sizes[_LENSES], sizes[_LENSES] + sizes[_CAMERAS])
    project[places, places] = _common_motion_projector(scene)
    common, moved = influences(matrix, _independent(known.rows, known.seen, scene.loose_px), free.of_instants)
    by_instant = np.zeros((len(moved), size))
    of_cameras = place[free.columns[common]] >= 0
    by_instant[:, place[free.columns[common[of_cameras]]]] = moved[:, of_cameras]
    return np.asarray(project @ whole @ project.T), by_instant @ project.T


def common_free(scene: BoardScene, motions: Sequence[Float[np.ndarray, "6"]]) -> Float[np.ndarray, "c 6"]:
    """Small motions of the cameras without the part that is common to the rig as a whole."""
    return np.asarray((_common_motion_projector(scene) @ np.concatenate(motions)).reshape(-1, _PLACE))


def _common_motion_projector(scene: BoardScene) -> Float[np.ndarray, "m m"]:
    """Takes from motions of the cameras that of the rig as a whole which is nearest to them."""
    places = list(scene.cam_from_rig.values())
    common = np.concatenate([_adjoint(place) for place in places])
    lengths = np.linalg.norm([place.translation for place in places], axis=1).mean() or 1.0
    weights = np.tile([lengths, lengths, lengths, 1, 1, 1], len(places))[:, None]  # a turn by the arc that it makes
    return np.asarray(np.eye(len(common)) - common @ np.linalg.pinv(weights * common) * weights.T)


def _adjoint(target_from_source: Rigid3) -> Float[np.ndarray, "6 6"]:
    """A small motion in the source, as one of the target."""
    turn = target_from_source.rotation
    return np.block([[turn, np.zeros((3, 3))], [skew(target_from_source.translation) @ turn, turn]])


def readout_score(scene: BoardScene, views: Views, board: Target) -> float:
    """How far a first step from the readouts of a scene would change one of them, in its standard deviations by how
    much the instants disagree."""
    seen = _Observations.of(views, board, scene)
    free, projection, count = _Free.of(scene, seen, board, only_boards=False), _project(scene, seen), len(scene.cameras)
    sigma_px = _scale(_project_out_motions(scene, seen, projection, None)[0])
    known = _Equations.of(scene, seen, projection, sigma_px, free)
    by_corners, moved = _camera_covariance(scene, known)
    sigmas = np.sqrt(np.diag(covariance_of(by_corners[-count:, -count:], moved[:, -count:])))
    _, gradient = _normal(scene, known.rows, free)
    return float(np.max(np.abs(_solve(known.matrix, gradient)[_mask_of_kind(scene, free, _READOUTS)]) / sigmas))


def _mask_of_kind(scene: BoardScene, free: _Free, kind: int) -> Bool[np.ndarray, "k"]:
    """Which of the free unknowns are of a kind."""
    sizes = _sizes(scene)
    return np.asarray(np.repeat(np.arange(len(sizes)), sizes)[free.columns] == kind)


def readout_sigmas(found: Adjusted) -> dict[str, float]:
    """Standard deviations of the readouts of the cameras, by how much the instants disagree."""
    timing = found.scene.timing
    if timing is None or not timing.readout:
        return {}
    part = slice(-len(timing.readout), None)
    covariance = covariance_of(found.covariance[part, part], found.influence[:, part])
    return dict(zip(timing.readout, np.sqrt(np.diag(covariance)).tolist(), strict=True))


def mounted_cameras(found: Adjusted) -> dict[str, MountedCamera]:
    """The cameras with their covariances, by how much the instants disagree."""
    count, numbers, mounted = len(found.scene.cameras), _numbers(found.scene), {}

    def covariance_block(part: slice) -> Float[np.ndarray, "n n"]:
        return _symmetric(covariance_of(found.covariance[part, part], found.influence[:, part]))

    for index, (name, camera) in enumerate(found.scene.cameras.items()):
        lens = slice(numbers * index, numbers * index + len(camera.parameters))
        first = numbers * count + _PLACE * index
        place = slice(first, first + _PLACE)
        mounted[name] = MountedCamera(
            replace(camera, covariance=covariance_block(lens)), found.scene.cam_from_rig[name], covariance_block(place)
        )
    return mounted


def _symmetric(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    return (matrix + matrix.T) / 2
