"""One bundle adjustment of rig poses and points and, where the calibration has a prior, of the calibration too.

A point X of the world is seen by camera c at frame f as ``project(c, cam_from_rig[c] @ rig_from_world[f] @ X)``.
Unknowns and how a step changes them:

- a pose, by a small motion on the left (rotation vector rad, translation mm); the first frame stays: it is the world;
- a point, by a displacement (mm);
- the calibration of a camera, by 14 whitened numbers z of prior N(0, 1): cam_from_rig = exp(L_e z_e) prior and
  parameters = prior + L_i z_i, where L L^T is the covariance of the prior. Without one L = 0: the calibration is held.

Levenberg-Marquardt on the Huber loss of the residuals in units of their standard deviation. The points are eliminated
(Schur complement); what remains is a dense system of 6 unknowns a frame and 14 a camera. The sums run over a fixed
number of parts in a fixed order, so the result does not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from cuspid.epipolar import skew
from cuspid.errors import ReconstructionError
from cuspid.geometry import Rigid3
from cuspid.reconstruction import Reconstruction, Tracks
from cuspid.rig import MountedCamera, Rig

_POSE = 6
_CALIBRATION = 14
_COLUMNS = 3 + _POSE + _CALIBRATION
_PARTS = 4
_NEAREST_MM = 1e-3
_LEAST_SIGMA_PX = 1e-6


@dataclass(frozen=True, kw_only=True)
class AdjustmentOptions:
    """How the bundle adjustment weighs and rejects observations and when it stops."""

    sigma_px: float = 0.4
    """Standard deviation of a keypoint to start with, px; the adjustment estimates it anew in each round."""
    huber_sigmas: float = 2.0
    """Residual length, in standard deviations, beyond which an observation counts less."""
    outlier_sigmas: float = 4.0
    """Residual length, in standard deviations, beyond which an observation is dropped after a round."""
    start_px: float = 20.0
    """Residual length beyond which an observation is dropped before the first round, px."""
    rounds: int = 3
    """Number of times that the minimum is sought, with outliers dropped in between."""
    iterations: int = 30
    """Most steps in a round."""
    tolerance_sigmas: float = 0.02
    """A round ends when a step moves the unknowns by less than this share of their standard deviations."""
    minimum_angle_deg: float = 1.0
    """Points whose rays meet at less than this angle are dropped."""


class _State(NamedTuple):
    """Values of all unknowns."""

    frame_rotation: np.ndarray
    frame_translation: np.ndarray
    camera_rotation: np.ndarray
    camera_translation: np.ndarray
    intrinsics: np.ndarray
    points: np.ndarray
    whitened: np.ndarray
    """(cameras, 14): z of each camera, zero at the prior."""
    basis: np.ndarray
    """(cameras, 14, 14): derivative of (motion on the left of cam_from_rig, parameters) with respect to z."""


class _Observations(NamedTuple):
    """Observations sorted by point."""

    pixels: np.ndarray
    frame: np.ndarray
    camera: np.ndarray
    start: np.ndarray
    """(points + 1): the observations of point p are start[p] to start[p + 1]."""


class _Weighting(NamedTuple):
    """What a residual counts for, and which unknowns there are."""

    sigma_px: float
    huber_sigmas: float
    calibrated: bool


class _System(NamedTuple):
    """Reduced normal equations: ``matrix @ step = -gradient``, before damping of ``diagonal``."""

    matrix: np.ndarray
    gradient: np.ndarray
    diagonal: np.ndarray


# --- one observation ---------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
@no_type_check
def _camera_jacobian(k, x, y, z, pixel, by_point, by_parameters):
    """Projection of a point in the camera frame, and its derivatives (2x3 and 2x8)."""
    fx, fy, k1, k2, p1, p2 = k[0], k[1], k[4], k[5], k[6], k[7]
    u, v = x / z, y / z
    r2 = u * u + v * v
    radial, slope = 1 + k1 * r2 + k2 * r2 * r2, k1 + 2 * k2 * r2
    xd = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    yd = v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v)
    pixel[0], pixel[1] = fx * xd + k[2], fy * yd + k[3]
    cross = 2 * u * v * slope + 2 * p1 * u + 2 * p2 * v
    xu = radial + 2 * u * u * slope + 2 * p1 * v + 6 * p2 * u
    yv = radial + 2 * v * v * slope + 2 * p2 * u + 6 * p1 * v
    by_point[0, 0], by_point[0, 1] = fx * xu / z, fx * cross / z
    by_point[1, 0], by_point[1, 1] = fy * cross / z, fy * yv / z
    by_point[0, 2] = -(by_point[0, 0] * u + by_point[0, 1] * v)
    by_point[1, 2] = -(by_point[1, 0] * u + by_point[1, 1] * v)
    by_parameters[:] = 0
    by_parameters[0, 0], by_parameters[1, 1] = xd, yd
    by_parameters[0, 2], by_parameters[1, 3] = 1, 1
    by_parameters[0, 4], by_parameters[1, 4] = fx * u * r2, fy * v * r2
    by_parameters[0, 5], by_parameters[1, 5] = fx * u * r2 * r2, fy * v * r2 * r2
    by_parameters[0, 6], by_parameters[1, 6] = fx * 2 * u * v, fy * (r2 + 2 * v * v)
    by_parameters[0, 7], by_parameters[1, 7] = fx * (r2 + 2 * u * u), fy * 2 * u * v


@njit(cache=True, nogil=True)
@no_type_check
def _move(rotation, translation, x, out):
    """out = rotation @ x + translation."""
    for i in range(3):
        out[i] = rotation[i, 0] * x[0] + rotation[i, 1] * x[1] + rotation[i, 2] * x[2] + translation[i]


@njit(cache=True, nogil=True)
@no_type_check
def _times(a, b, out):
    """out (2xn) = a (2x3) @ b (3xn)."""
    for i in range(2):
        for j in range(b.shape[1]):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@njit(cache=True, nogil=True)
@no_type_check
def _times_motion(a, x, out):
    """out (2x6): a (2x3) times the derivative [-[x]_x, I] of x under a small motion on its left."""
    for i in range(2):
        out[i, 0] = a[i, 2] * x[1] - a[i, 1] * x[2]
        out[i, 1] = a[i, 0] * x[2] - a[i, 2] * x[0]
        out[i, 2] = a[i, 1] * x[0] - a[i, 0] * x[1]
        out[i, 3], out[i, 4], out[i, 5] = a[i, 0], a[i, 1], a[i, 2]


@njit(cache=True, nogil=True)
@no_type_check
def _linearise(state, point, frame, camera, calibrated, scratch, pixel, jacobian):
    """Projected pixel and its derivatives (2x23) by point, pose and whitened calibration. False behind the camera."""
    x_in_rig, x_in_cam, by_cam, by_rig, raw = scratch
    _move(state.frame_rotation[frame], state.frame_translation[frame], state.points[point], x_in_rig)
    _move(state.camera_rotation[camera], state.camera_translation[camera], x_in_rig, x_in_cam)
    if x_in_cam[2] < _NEAREST_MM:
        return False
    x, y, z = x_in_cam
    _camera_jacobian(state.intrinsics[camera], x, y, z, pixel, by_cam, raw[:, _POSE:])
    _times(by_cam, state.camera_rotation[camera], by_rig)
    _times(by_rig, state.frame_rotation[frame], jacobian[:, :3])
    _times_motion(by_rig, x_in_rig, jacobian[:, 3 : 3 + _POSE])
    if calibrated:
        _times_motion(by_cam, x_in_cam, raw[:, :_POSE])
        for i in range(2):
            for j in range(_CALIBRATION):
                total = 0.0
                for k in range(_CALIBRATION):
                    total += raw[i, k] * state.basis[camera, k, j]
                jacobian[i, 3 + _POSE + j] = total
    return True


@njit(cache=True, nogil=True)
@no_type_check
def _scratch():
    """Working memory of :func:`_linearise`."""
    return np.zeros(3), np.zeros(3), np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, _CALIBRATION))


@njit(cache=True, nogil=True)
@no_type_check
def _residuals(state, observations, out):
    """Projected minus observed pixel for each observation; NaN behind the camera."""
    x_in_rig, x_in_cam, by_cam, _, raw = _scratch()
    for point in range(observations.start.shape[0] - 1):
        for o in range(observations.start[point], observations.start[point + 1]):
            frame, camera = observations.frame[o], observations.camera[o]
            _move(state.frame_rotation[frame], state.frame_translation[frame], state.points[point], x_in_rig)
            _move(state.camera_rotation[camera], state.camera_translation[camera], x_in_rig, x_in_cam)
            out[o] = np.nan
            if x_in_cam[2] >= _NEAREST_MM:
                x, y, z = x_in_cam
                _camera_jacobian(state.intrinsics[camera], x, y, z, out[o], by_cam, raw[:, _POSE:])
                out[o] -= observations.pixels[o]


# --- normal equations --------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
@no_type_check
def _weigh(state, observations, weighting, point, o, scratch, residual, jacobian):
    """Residual and Jacobian of an observation, scaled by the root of its weight. False behind the camera."""
    frame, camera = observations.frame[o], observations.camera[o]
    if not _linearise(state, point, frame, camera, weighting.calibrated, scratch, residual, jacobian):
        return False
    residual -= observations.pixels[o]
    scale = 1 / weighting.sigma_px
    length = np.hypot(residual[0], residual[1]) * scale
    if length > weighting.huber_sigmas:
        scale *= np.sqrt(weighting.huber_sigmas / length)
    residual *= scale
    jacobian *= scale
    return True


@njit(cache=True, nogil=True)
@no_type_check
def _slot(offsets, count, offset, coupling):
    """Where a block of unknowns stands among the blocks of the present point; a new one starts at zero."""
    for slot in range(count):
        if offsets[slot] == offset:
            return slot, count
    offsets[count] = offset
    coupling[count] = 0
    return count, count + 1


@njit(cache=True, nogil=True)
@no_type_check
def _add_block(matrix, row, column, left, right):
    """matrix[row:, column:] += left^T right for 2xn factors."""
    for i in range(left.shape[1]):
        for j in range(right.shape[1]):
            matrix[row + i, column + j] += left[0, i] * right[0, j] + left[1, i] * right[1, j]


@njit(cache=True, nogil=True)
@no_type_check
def _add_gradient(system, offset, by_block, residual):
    """Add J^T r and the diagonal of J^T J of one block of unknowns."""
    for i in range(by_block.shape[1]):
        system.gradient[offset + i] += by_block[0, i] * residual[0] + by_block[1, i] * residual[1]
        system.diagonal[offset + i] += by_block[0, i] ** 2 + by_block[1, i] ** 2


@njit(cache=True, nogil=True)
@no_type_check
def _add_observation(system, blocks, jacobian, residual, pose_at, camera_at):
    """Add an observation to the direct part of the system and to the coupling of its blocks with the point."""
    offsets, widths, coupling, count = blocks
    by_point = jacobian[:, :3]
    by_pose, by_calibration = jacobian[:, 3 : 3 + _POSE], jacobian[:, 3 + _POSE :]
    if pose_at >= 0:
        _add_block(system.matrix, pose_at, pose_at, by_pose, by_pose)
        _add_gradient(system, pose_at, by_pose, residual)
        slot, count = _slot(offsets, count, pose_at, coupling)
        widths[slot] = _POSE
        _add_block(coupling[slot], 0, 0, by_pose, by_point)
    if camera_at >= 0:
        _add_block(system.matrix, camera_at, camera_at, by_calibration, by_calibration)
        _add_gradient(system, camera_at, by_calibration, residual)
        slot, count = _slot(offsets, count, camera_at, coupling)
        widths[slot] = _CALIBRATION
        _add_block(coupling[slot], 0, 0, by_calibration, by_point)
        if pose_at >= 0:
            _add_block(system.matrix, camera_at, pose_at, by_calibration, by_pose)
    return count


@njit(cache=True, nogil=True)
@no_type_check
def _eliminate(system, offsets, widths, coupling, count, inverse, point_gradient):
    """Subtract what the blocks share through the present point: W V^-1 W^T and W V^-1 g. Lower triangle only."""
    for a in range(count):
        for i in range(widths[a]):
            row = offsets[a] + i
            w0, w1, w2 = coupling[a, i, 0], coupling[a, i, 1], coupling[a, i, 2]
            y0 = w0 * inverse[0, 0] + w1 * inverse[1, 0] + w2 * inverse[2, 0]
            y1 = w0 * inverse[0, 1] + w1 * inverse[1, 1] + w2 * inverse[2, 1]
            y2 = w0 * inverse[0, 2] + w1 * inverse[1, 2] + w2 * inverse[2, 2]
            system.gradient[row] -= y0 * point_gradient[0] + y1 * point_gradient[1] + y2 * point_gradient[2]
            for b in range(count):
                if offsets[b] > offsets[a]:
                    continue
                for j in range(widths[b]):
                    system.matrix[row, offsets[b] + j] -= (
                        y0 * coupling[b, j, 0] + y1 * coupling[b, j, 1] + y2 * coupling[b, j, 2]
                    )


@njit(cache=True, nogil=True)
@no_type_check
def _point_inverse(hessian, damping, inverse):
    """Inverse of a point's 3x3 block with damping; zero where the point is not determined."""
    a, b, c = hessian[0, 0] * (1 + damping), hessian[0, 1], hessian[0, 2]
    d, e, f = hessian[1, 1] * (1 + damping), hessian[1, 2], hessian[2, 2] * (1 + damping)
    determinant = a * (d * f - e * e) - b * (b * f - e * c) + c * (b * e - d * c)
    inverse[:] = 0
    if determinant <= 1e-12 * a * d * f:
        return
    inverse[0, 0], inverse[1, 1] = (d * f - e * e) / determinant, (a * f - c * c) / determinant
    inverse[2, 2] = (a * d - b * b) / determinant
    inverse[0, 1] = inverse[1, 0] = (c * e - b * f) / determinant
    inverse[0, 2] = inverse[2, 0] = (b * e - c * d) / determinant
    inverse[1, 2] = inverse[2, 1] = (b * c - a * e) / determinant


@njit(cache=True, nogil=True)
@no_type_check
def _offsets_of(observations, weighting, o, frames):
    """Where the pose and the calibration of an observation stand in the system; -1 where they are held."""
    frame, camera = observations.frame[o], observations.camera[o]
    calibration_at = _POSE * (frames - 1) + _CALIBRATION * camera
    return _POSE * (frame - 1) if frame > 0 else -1, calibration_at if weighting.calibrated else -1


@njit(cache=True, nogil=True)
@no_type_check
def _accumulate(state, observations, weighting, damping, first, last, system):
    """Add the points ``first`` to ``last`` to the reduced normal equations."""
    frames, longest = state.frame_rotation.shape[0], np.diff(observations.start).max()
    scratch, residual, jacobian = _scratch(), np.zeros(2), np.zeros((2, _COLUMNS))
    offsets, widths = np.zeros(2 * longest, np.int64), np.zeros(2 * longest, np.int64)
    coupling = np.zeros((2 * longest, _CALIBRATION, 3))
    hessian, gradient, inverse = np.zeros((3, 3)), np.zeros((3, 1)), np.zeros((3, 3))
    for point in range(first, last):
        hessian[:], gradient[:] = 0, 0
        count = 0
        for o in range(observations.start[point], observations.start[point + 1]):
            if _weigh(state, observations, weighting, point, o, scratch, residual, jacobian):
                pose_at, camera_at = _offsets_of(observations, weighting, o, frames)
                _add_block(hessian, 0, 0, jacobian[:, :3], jacobian[:, :3])
                _add_block(gradient, 0, 0, jacobian[:, :3], residual.reshape(2, 1))
                blocks = (offsets, widths, coupling, count)
                count = _add_observation(system, blocks, jacobian, residual, pose_at, camera_at)
        _point_inverse(hessian, damping, inverse)
        _eliminate(system, offsets, widths, coupling, count, inverse, gradient[:, 0])


@njit(cache=True, nogil=True)
@no_type_check
def _substitute(state, observations, weighting, damping, step, first, last, moved):
    """Back-substitution: the points ``first`` to ``last`` after the reduced unknowns have made their step."""
    frames = state.frame_rotation.shape[0]
    scratch, residual, jacobian = _scratch(), np.zeros(2), np.zeros((2, _COLUMNS))
    hessian, gradient, inverse = np.zeros((3, 3)), np.zeros((3, 1)), np.zeros((3, 3))
    for point in range(first, last):
        hessian[:], gradient[:] = 0, 0
        for o in range(observations.start[point], observations.start[point + 1]):
            if not _weigh(state, observations, weighting, point, o, scratch, residual, jacobian):
                continue
            pose_at, camera_at = _offsets_of(observations, weighting, o, frames)
            for i in range(2):
                if pose_at >= 0:
                    residual[i] += np.dot(jacobian[i, 3 : 3 + _POSE], step[pose_at : pose_at + _POSE])
                if camera_at >= 0:
                    residual[i] += np.dot(jacobian[i, 3 + _POSE :], step[camera_at : camera_at + _CALIBRATION])
            _add_block(hessian, 0, 0, jacobian[:, :3], jacobian[:, :3])
            _add_block(gradient, 0, 0, jacobian[:, :3], residual.reshape(2, 1))
        _point_inverse(hessian, damping, inverse)
        for i in range(3):
            moved[point, i] = state.points[point, i] - (
                inverse[i, 0] * gradient[0, 0] + inverse[i, 1] * gradient[1, 0] + inverse[i, 2] * gradient[2, 0]
            )


def _in_parts(work: Callable[[int, int], Any], count: int) -> list[Any]:
    """``work(first, last)`` on each of a fixed number of ranges, in threads; results in the order of the ranges."""
    edges = np.linspace(0, count, _PARTS + 1).astype(int).tolist()
    with ThreadPoolExecutor(_PARTS) as pool:
        return list(pool.map(work, edges[:-1], edges[1:]))


def _normal_equations(state: _State, observations: _Observations, weighting: _Weighting, damping: float) -> _System:
    """Reduced normal equations of all observations and of the prior of the calibration."""
    size = _POSE * (len(state.frame_rotation) - 1)
    total = size + (state.whitened.size if weighting.calibrated else 0)

    def part(first: int, last: int) -> _System:
        system = _System(np.zeros((total, total)), np.zeros(total), np.zeros(total))
        _accumulate(state, observations, weighting, damping, first, last, system)
        return system

    parts = _in_parts(part, len(state.points))
    matrix, gradient, diagonal = (sum(terms[1:], terms[0]) for terms in zip(*parts, strict=True))
    if weighting.calibrated:
        prior = np.arange(size, total)
        matrix[prior, prior] += 1
        diagonal[prior] += 1
        gradient[prior] += state.whitened.ravel()
    return _System(matrix, gradient, diagonal)


# --- states ------------------------------------------------------------------------------------------------------


def covariance_factor(covariance: Float[np.ndarray, "n n"] | None, size: int) -> Float[np.ndarray, "n n"]:
    """L with L L^T = covariance, which may be singular (what has no variance is held); zero for None."""
    if covariance is None:
        return np.zeros((size, size))
    scale = np.sqrt(np.diag(covariance))
    unit = np.where(scale > 0, scale, 1)
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    return scale[:, None] * vectors * np.sqrt(np.clip(values, 0, None))


def left_jacobian(rotation_vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """J with exp(w + dw) = exp(J dw) exp(w) to first order."""
    angle, cross = float(np.linalg.norm(rotation_vector)), skew(rotation_vector)
    if angle < 1e-4:
        return np.eye(3) + cross / 2 + cross @ cross / 6
    first, second = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.eye(3) + first * cross + second * cross @ cross


@dataclass(frozen=True, eq=False)
class _Prior:
    """The given calibration and how far it may move."""

    rig: Rig
    extrinsic_factor: Float[np.ndarray, "c 6 6"]
    parameter_factor: Float[np.ndarray, "c 8 8"]

    @staticmethod
    def of(rig: Rig) -> _Prior:
        """From the covariances that the rig carries."""
        mounted = rig.cameras.values()
        return _Prior(
            rig,
            np.stack([covariance_factor(m.covariance, 6) for m in mounted]),
            np.stack([covariance_factor(m.camera.covariance, 8) for m in mounted]),
        )

    @property
    def is_free(self) -> bool:
        """Whether anything of the calibration may move."""
        return bool(np.any(self.extrinsic_factor) or np.any(self.parameter_factor))

    def camera_at(self, index: int, whitened: Float[np.ndarray, "14"]) -> MountedCamera:
        """A camera whose calibration is ``whitened`` standard deviations from the given one."""
        mounted = self.rig.cameras[self.rig.names[index]]
        motion = self.extrinsic_factor[index] @ whitened[:6]
        shift = self.parameter_factor[index] @ whitened[6:]
        moved = Rigid3.from_rotation_vector(motion[:3], motion[3:]) @ mounted.cam_from_rig
        camera = mounted.camera.with_parameters(mounted.camera.parameters + shift)
        return replace(mounted, camera=camera, cam_from_rig=moved)

    def basis_at(self, index: int, whitened: Float[np.ndarray, "14"]) -> Float[np.ndarray, "14 14"]:
        """Derivative of (motion on the left of cam_from_rig, parameters) with respect to ``whitened``."""
        motion = self.extrinsic_factor[index] @ whitened[:6]
        turn = left_jacobian(motion[:3])
        on_the_left = np.block([[turn, np.zeros((3, 3))], [skew(motion[3:]) @ turn, np.eye(3)]])
        basis = np.zeros((_CALIBRATION, _CALIBRATION))
        basis[:6, :6] = on_the_left @ self.extrinsic_factor[index]
        basis[6:, 6:] = self.parameter_factor[index]
        return basis


def _with_calibration(state: _State, prior: _Prior, whitened: Float[np.ndarray, "c 14"]) -> _State:
    """The state with another calibration."""
    cameras = [prior.camera_at(index, z) for index, z in enumerate(whitened)]
    return state._replace(
        camera_rotation=np.stack([m.cam_from_rig.rotation for m in cameras]),
        camera_translation=np.stack([m.cam_from_rig.translation for m in cameras]),
        intrinsics=np.stack([m.camera.parameters for m in cameras]),
        whitened=whitened,
        basis=np.stack([prior.basis_at(index, z) for index, z in enumerate(whitened)]),
    )


def _initial_state(reconstruction: Reconstruction, points: Float[np.ndarray, "p 3"], prior: _Prior) -> _State:
    """The reconstruction as arrays."""
    poses = reconstruction.rig_from_world.values()
    cameras = len(reconstruction.rig.names)
    empty = np.zeros(0)
    state = _State(
        frame_rotation=np.stack([pose.rotation for pose in poses]),
        frame_translation=np.stack([pose.translation for pose in poses]),
        camera_rotation=empty,
        camera_translation=empty,
        intrinsics=empty,
        points=np.ascontiguousarray(points),
        whitened=empty,
        basis=empty,
    )
    return _with_calibration(state, prior, np.zeros((cameras, _CALIBRATION)))


def _moved(
    state: _State, observations: _Observations, weighting: _Weighting, prior: _Prior, damping: float, step: Any
) -> _State:
    """The state after a step of the reduced unknowns and the back-substitution of the points."""
    points = np.empty_like(state.points)

    def part(first: int, last: int) -> None:
        _substitute(state, observations, weighting, damping, step, first, last, points)

    _in_parts(part, len(points))
    size = _POSE * (len(state.frame_rotation) - 1)
    motions = np.vstack([np.zeros((1, _POSE)), step[:size].reshape(-1, _POSE)])
    turns = Rotation.from_rotvec(motions[:, :3]).as_matrix()
    moved = state._replace(
        frame_rotation=turns @ state.frame_rotation,
        frame_translation=np.einsum("fij,fj->fi", turns, state.frame_translation) + motions[:, 3:],
        points=points,
    )
    if not weighting.calibrated:
        return moved
    return _with_calibration(moved, prior, state.whitened + step[size:].reshape(state.whitened.shape))


# --- minimisation ------------------------------------------------------------------------------------------------


def _residual_vectors(state: _State, observations: _Observations) -> Float[np.ndarray, "o 2"]:
    """Projected minus observed pixels; NaN behind the camera."""
    residuals = np.empty_like(observations.pixels)
    _residuals(state, observations, residuals)
    return residuals


def _cost(state: _State, observations: _Observations, weighting: _Weighting) -> float:
    """Huber loss of the residuals plus the prior; infinite if a point went behind a camera."""
    lengths = np.linalg.norm(_residual_vectors(state, observations), axis=1) / weighting.sigma_px
    if not np.all(np.isfinite(lengths)):
        return np.inf
    knee = weighting.huber_sigmas
    loss = np.where(lengths <= knee, lengths**2, 2 * knee * lengths - knee**2)
    return float(np.sum(loss) + np.sum(state.whitened**2))


def _solve_damped(system: _System, damping: float) -> Float[np.ndarray, "n"] | None:
    """The damped step, or None where the system is not positive definite."""
    matrix = system.matrix.copy()
    on_diagonal = np.arange(len(matrix))
    matrix[on_diagonal, on_diagonal] += damping * system.diagonal + 1e-12
    try:
        return np.asarray(cho_solve(cho_factor(matrix, lower=True), -system.gradient))
    except LinAlgError:
        return None


def _minimise(
    state: _State,
    observations: _Observations,
    weighting: _Weighting,
    prior: _Prior,
    options: AdjustmentOptions,
) -> _State:
    """Levenberg-Marquardt from ``state`` to the minimum of the cost."""
    damping, cost = 1e-4, _cost(state, observations, weighting)
    for _ in range(options.iterations):
        system = _normal_equations(state, observations, weighting, damping)
        step = _solve_damped(system, damping)
        candidate = state if step is None else _moved(state, observations, weighting, prior, damping, step)
        lower = np.inf if step is None else _cost(candidate, observations, weighting)
        if lower <= cost:
            state, cost, damping = candidate, lower, max(damping / 10, 1e-9)
        elif damping > 1e6:
            break
        else:
            damping *= 10
        if step is not None and -step @ system.gradient <= len(step) * options.tolerance_sigmas**2:
            break
    return state


def _sigma_px(state: _State, observations: _Observations, weighting: _Weighting, unknowns: int) -> float:
    """Standard deviation (px) that an observation counts for in the estimate.

    For a robust loss the covariance of the estimate is a / b^2 (J^T J)^-1, with a the variance of the influence
    psi(r) = w(r) r and b its mean slope (Huber, Robust Statistics, 1981, section 7.6); so sigma^2 = a / b^2.
    """
    lengths = np.linalg.norm(_residual_vectors(state, observations), axis=1) / weighting.sigma_px
    beyond = lengths > weighting.huber_sigmas
    influence = np.minimum(lengths, weighting.huber_sigmas)
    variance = np.sum(influence**2) / max(2 * len(lengths) - unknowns, 1)
    slope = np.mean(np.where(beyond, weighting.huber_sigmas / (2 * np.maximum(lengths, 1e-300)), 1.0))
    return max(float(weighting.sigma_px * np.sqrt(variance) / slope), _LEAST_SIGMA_PX)


# --- observations ------------------------------------------------------------------------------------------------


def _largest_angles_deg(state: _State, observations: _Observations) -> Float[np.ndarray, "p"]:
    """For each point the angle between the first ray and the one farthest from it."""
    counts = np.diff(observations.start)
    point = np.repeat(np.arange(len(counts)), counts)
    rig_from_cam = np.swapaxes(state.camera_rotation, 1, 2)
    centre_in_rig = -np.einsum("cij,cj->ci", rig_from_cam, state.camera_translation)[observations.camera]
    offset = centre_in_rig - state.frame_translation[observations.frame]
    centres = np.einsum("oji,oj->oi", state.frame_rotation[observations.frame], offset)
    rays = state.points[point] - centres
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    chord = np.linalg.norm(rays - rays[observations.start[:-1]][point], axis=1)
    return np.rad2deg(2 * np.arcsin(np.clip(np.maximum.reduceat(chord, observations.start[:-1]) / 2, 0, 1)))


def _good(
    state: _State, observations: _Observations, limit_px: float, minimum_angle_deg: float
) -> Bool[np.ndarray, "o"]:
    """Observations to keep: before the camera, near the projection, of points with two of them and enough angle."""
    counts = np.diff(observations.start)
    point = np.repeat(np.arange(len(counts)), counts)
    lengths = np.linalg.norm(_residual_vectors(state, observations), axis=1)
    near = np.isfinite(lengths) & (lengths <= limit_px)
    seen = np.bincount(point, weights=near, minlength=len(counts)) >= 2
    wide = _largest_angles_deg(state, observations) >= minimum_angle_deg
    return near & (seen & wide)[point]


def _sorted_by_point(tracks: Tracks, keep: Bool[np.ndarray, "o"]) -> tuple[_Observations, Int[np.ndarray, "p"]]:
    """The kept observations sorted by point, and the indices of the points that still have any."""
    order = np.flatnonzero(keep)
    order = order[np.argsort(tracks.point_index[order], kind="stable")]
    points, counts = np.unique(tracks.point_index[order], return_counts=True)
    return (
        _Observations(
            pixels=np.ascontiguousarray(tracks.pixels[order]),
            frame=np.ascontiguousarray(tracks.frame_index[order]),
            camera=np.ascontiguousarray(tracks.camera_index[order]),
            start=np.concatenate([[0], np.cumsum(counts)]),
        ),
        points,
    )


def _select(
    state: _State, observations: _Observations, colors: Any, keep: Bool[np.ndarray, "o"]
) -> tuple[_State, _Observations, Any]:
    """State, observations and colours without what is not kept."""
    kept, points = _sorted_by_point(_as_tracks(state, observations, colors), keep)
    return state._replace(points=state.points[points]), kept, colors[points]


def _as_tracks(state: _State, observations: _Observations, colors: Any) -> Tracks:
    """Points and observations as a value for others."""
    counts = np.diff(observations.start)
    return Tracks(
        points=state.points,
        colors=colors,
        point_index=np.repeat(np.arange(len(counts)), counts),
        frame_index=observations.frame,
        camera_index=observations.camera,
        pixels=observations.pixels,
    )


def calibration_sigma_px(rig: Rig, distance_mm: float) -> float:
    """How far (px, one standard deviation, worst camera) the rig's covariance moves points at a distance; 0 if held."""
    prior, sigma = _Prior.of(rig), 0.0
    if not prior.is_free:
        return sigma
    for index, mounted in enumerate(rig.cameras.values()):
        corners = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1]]) * [mounted.camera.width, mounted.camera.height]
        in_rig = mounted.cam_from_rig.inverse().apply(distance_mm * mounted.camera.rays(corners))
        moved = [prior.camera_at(index, unit) for unit in np.eye(_CALIBRATION)]
        shifts = np.stack([m.camera.project(m.cam_from_rig.apply(in_rig)) - corners for m in moved])
        sigma = max(sigma, float(np.sqrt(np.sum(shifts**2, axis=(0, 2)).max())))
    return sigma


def residuals_px(reconstruction: Reconstruction) -> Float[np.ndarray, "o 2"]:
    """Projected minus observed pixel for each observation of the tracks; NaN behind the camera."""
    tracks = reconstruction.tracks
    if tracks is None:
        return np.zeros((0, 2))
    observations, points = _sorted_by_point(tracks, np.ones(len(tracks.point_index), dtype=bool))
    state = _initial_state(reconstruction, tracks.points[points], _Prior.of(reconstruction.rig))
    residuals = np.empty_like(observations.pixels)
    residuals[np.argsort(tracks.point_index, kind="stable")] = _residual_vectors(state, observations)
    return residuals


# --- the adjustment ----------------------------------------------------------------------------------------------


def _posterior(
    state: _State, observations: _Observations, weighting: _Weighting
) -> tuple[Float[np.ndarray, "f 6 6"], Float[np.ndarray, "c 14 14"] | None]:
    """Covariance of each pose and of each camera's calibration (motion on the left, parameters)."""
    system = _normal_equations(state, observations, weighting._replace(huber_sigmas=np.inf), 0.0)
    inverse = cho_solve(cho_factor(system.matrix, lower=True), np.eye(len(system.matrix)))
    poses = np.zeros((len(state.frame_rotation), _POSE, _POSE))
    for frame in range(1, len(poses)):
        at = slice(_POSE * (frame - 1), _POSE * frame)
        poses[frame] = inverse[at, at]
    if not weighting.calibrated:
        return poses, None
    start = _POSE * (len(poses) - 1)
    starts = range(start, len(inverse), _CALIBRATION)
    whitened = np.stack([inverse[at : at + _CALIBRATION, at : at + _CALIBRATION] for at in starts])
    return poses, state.basis @ whitened @ np.swapaxes(state.basis, 1, 2)


def _adjusted_rig(state: _State, prior: _Prior, covariance: Float[np.ndarray, "c 14 14"] | None) -> Rig:
    """The rig with the refined calibration and what is still uncertain of it; what was held stays as given."""
    if covariance is None:
        return prior.rig
    cameras = {}
    for index, name in enumerate(prior.rig.names):
        mounted = prior.camera_at(index, state.whitened[index])
        if mounted.camera.covariance is not None:
            camera = replace(mounted.camera, covariance=covariance[index, 6:, 6:])
            mounted = replace(mounted, camera=camera)
        if mounted.covariance is not None:
            mounted = replace(mounted, covariance=covariance[index, :6, :6])
        cameras[name] = mounted
    return Rig(cameras)


def adjust(reconstruction: Reconstruction, options: AdjustmentOptions | None = None) -> Reconstruction:
    """Refine poses, points and free calibration together; the tracks come back without outliers.

    The covariance of the poses is relative to the first frame, that of the calibration replaces its prior. Raises
    ReconstructionError where the observations do not determine every pose.
    """
    options = options or AdjustmentOptions()
    tracks = reconstruction.tracks
    if tracks is None or len(tracks.point_index) == 0:
        raise ReconstructionError("adjustment: no tracks to adjust; more texture or more overlap is needed")
    prior = _Prior.of(reconstruction.rig)
    observations, points = _sorted_by_point(tracks, np.ones(len(tracks.point_index), dtype=bool))
    state, colors = _initial_state(reconstruction, tracks.points[points], prior), tracks.colors[points]
    sigma_px, limit_px = options.sigma_px, options.start_px
    for _ in range(options.rounds):
        keep = _good(state, observations, limit_px, options.minimum_angle_deg)
        if not keep.any():
            raise ReconstructionError("adjustment: no point is consistent; check the handpiece's calibration")
        state, observations, colors = _select(state, observations, colors, keep)
        weighting = _Weighting(sigma_px, options.huber_sigmas, prior.is_free)
        state = _minimise(state, observations, weighting, prior, options)
        unknowns = state.points.size + _POSE * (len(state.frame_rotation) - 1)
        sigma_px = _sigma_px(state, observations, weighting, unknowns)
        limit_px = options.outlier_sigmas * sigma_px
    return _result(reconstruction, state, observations, colors, prior, sigma_px)


def _result(
    reconstruction: Reconstruction,
    state: _State,
    observations: _Observations,
    colors: Any,
    prior: _Prior,
    sigma_px: float,
) -> Reconstruction:
    """The adjusted reconstruction with its covariances."""
    try:
        poses, calibration = _posterior(state, observations, _Weighting(sigma_px, np.inf, prior.is_free))
    except LinAlgError as error:
        raise ReconstructionError(
            "adjustment: the tracks do not tie every frame to the others; more overlap is needed"
        ) from error
    motions = zip(state.frame_rotation, state.frame_translation, strict=True)
    residuals = _residual_vectors(state, observations)
    return replace(
        reconstruction,
        rig=_adjusted_rig(state, prior, calibration),
        rig_from_world={
            name: Rigid3(rotation, translation)
            for name, (rotation, translation) in zip(reconstruction.frames, motions, strict=True)
        },
        tracks=_as_tracks(state, observations, colors),
        pose_covariance=poses,
        reprojection_rms_px=float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)))),
        log={**reconstruction.log, "observation_sigma_px": sigma_px, "observations": len(residuals)},
    )
