"""What no image determines of a rig whose calibration is free: its own frame and its scale.

If a similarity is applied to the rig frame, that is to every camera of the rig, every pose and every point, no pixel
moves: seven directions in which the prior of the calibration alone decides. They move everything at once, so a
damped step of the adjustment hardly follows them; here the minimum of the prior along them is found separately.

Notation: ``new = scale turn old + shift`` in the rig frame; a small motion (rotation vector, translation) acts on the
left of ``cam_from_rig``, and z are the whitened parameters of :mod:`cuspid.motion.bundle.adjustment`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import null_space, qr
from scipy.spatial.transform import Rotation

from cuspid.model.epipolar import skew
from cuspid.motion.bundle.normal_equations import State

PLACE = 6
"""Number of parameters of a camera's pose in the rig, the first of its whitened ones."""
_HELD = 1e-6
"""A direction of a camera's pose is held fixed if its standard deviation is less than this share of those of its
parts."""

_SMALL = 1e-5
"""Step of a difference."""


class Gauge(NamedTuple):
    """A similarity of the rig frame."""

    turn: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]
    scale: float

    @staticmethod
    def of(step: Float[np.ndarray, "7"]) -> Gauge:
        """From a rotation vector (rad), a shift (mm) and the logarithm of the scale."""
        return Gauge(Rotation.from_rotvec(step[:3]).as_matrix(), step[3:6], float(np.exp(step[6])))


def best_gauge(state: State) -> Gauge:
    """The similarity that most reduces the prior cost of the cameras' poses, to first order; it moves no pose in a
    direction in which it is held fixed."""
    free, whitened = _free_similarities(state)
    along = np.linalg.lstsq(whitened.reshape(-1, 7) @ free, -state.whitened[:, :PLACE].ravel(), rcond=None)[0]
    return Gauge.of(free @ along)


def gauge_basis(state: State) -> tuple[Float[np.ndarray, "k k"], int]:
    """A basis of the steps of the reduced unknowns (poses and z), and how many of its last vectors are the similarities
    that the prior allows, to first order. The others are single unknowns, of which those are left out that a similarity
    can best replace."""
    free, whitened = _free_similarities(state)
    calibration = np.zeros((*state.whitened.shape, 7))
    calibration[:, :PLACE] = whitened
    poses = np.stack([_pose_steps(state, unit) for unit in np.eye(7)], axis=-1)
    along = np.concatenate([poses.reshape(-1, 7), calibration.reshape(-1, 7)]) @ free
    start, count = poses[..., 0].size, free.shape[1]
    replaced = start + qr(along[start:].T, mode="r", pivoting=True)[1][:count]
    single = np.delete(np.eye(len(along)), replaced, axis=1)
    return np.concatenate([single, along / np.linalg.norm(along[start:], axis=0)], axis=1), count


def _free_similarities(state: State) -> tuple[Float[np.ndarray, "7 m"], Float[np.ndarray, "c 6 7"]]:
    """The similarities that move no camera in a direction in which it is held fixed; and how all seven kinds move the
    z of the cameras' poses."""
    motions = np.stack(
        [
            _motion_by_gauge(turn, place)
            for turn, place in zip(state.camera_rotation, state.camera_translation, strict=True)
        ]
    )
    inverses, held = zip(*(_split(basis[:PLACE, :PLACE]) for basis in state.basis), strict=True)
    held_rows = np.concatenate([rows @ motion for rows, motion in zip(held, motions, strict=True)])
    free = null_space(held_rows, rcond=1e-9) if len(held_rows) else np.eye(7)
    return free, np.stack(inverses) @ motions


def _pose_steps(state: State, direction: Float[np.ndarray, "7"]) -> Float[np.ndarray, "f 6"]:
    """Small motions on the left of all poses but the first, per unit of a similarity."""
    ahead, back = (transform_world(state, Gauge.of(sign * _SMALL * direction)) for sign in (1, -1))
    turn = ahead.frame_rotation @ np.swapaxes(back.frame_rotation, 1, 2)
    shift = ahead.frame_translation - np.einsum("fij,fj->fi", turn, back.frame_translation)
    steps = np.concatenate([Rotation.from_matrix(turn).as_rotvec(), shift], axis=1) / (2 * _SMALL)
    return np.asarray(steps[1:])


def _motion_by_gauge(turn: Float[np.ndarray, "3 3"], place: Float[np.ndarray, "3"]) -> Float[np.ndarray, "6 7"]:
    """Small motion of ``cam_from_rig`` by a small gauge (rotation vector, shift, logarithm of the scale)."""
    motion = np.zeros((PLACE, 7))
    motion[:3, :3], motion[3:, :3] = -turn, -skew(place) @ turn
    motion[3:, 3:6], motion[3:, 6] = -turn, place
    return motion


def _split(basis: Float[np.ndarray, "6 6"]) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "k 6"]]:
    """From a small motion to z, and rows that vanish for the motions that the prior allows."""
    length = np.linalg.norm(basis, axis=1)
    unit = np.where(length > 0, length, 1.0)
    left, values, right = np.linalg.svd(basis / unit[:, None])
    allowed = values > _HELD
    inverse = right.T @ np.diag(np.where(allowed, 1 / np.where(allowed, values, 1.0), 0.0)) @ left.T
    return inverse / unit, left.T[~allowed] / unit


def transform_world(state: State, gauge: Gauge) -> State:
    """Poses and points of a state after a gauge change, with the first frame where it was; the caller moves the
    cameras."""
    rotation = gauge.turn @ state.frame_rotation
    translation = gauge.scale * state.frame_translation @ gauge.turn.T + gauge.shift
    # The world is redefined so that the first pose stays: new_from_old = before^-1 after.
    before, place = state.frame_rotation[0], state.frame_translation[0]
    world_turn, world_shift = before.T @ rotation[0], before.T @ (translation[0] - place)
    # Rounding would grow threefold in each step: what is not quite a rotation is not quite undone by its transpose.
    rotation = Rotation.from_matrix(rotation @ world_turn.T).as_matrix()
    turning = state.motions[:, :3] @ gauge.turn.T
    moving = gauge.scale * state.motions[:, 3:] @ gauge.turn.T - np.cross(turning, gauge.shift)
    return state._replace(
        frame_rotation=rotation,
        frame_translation=translation - rotation @ world_shift,
        motions=np.concatenate([turning, moving], axis=1),
        points=gauge.scale * state.points @ world_turn.T + world_shift,
    )


def transform_mounts(state: State, gauge: Gauge) -> tuple[Float[np.ndarray, "c 3 3"], Float[np.ndarray, "c 3"]]:
    """Rotations and translations of ``cam_from_rig`` after a gauge change."""
    rotation = state.camera_rotation @ gauge.turn.T
    return rotation, gauge.scale * state.camera_translation - rotation @ gauge.shift
