"""Derivatives of the observations, and the normal equations with the points eliminated (Schur complement).

Notation as in :mod:`cuspid.motion.bundle.adjustment`. With V the 3x3 block of a point, W its coupling with the other
unknowns and H their direct part, the reduced system is H - W V^-1 W^T.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from cuspid.geometry.cameras import MODELS, parameter_jacobian, point_jacobian, project
from cuspid.runtime.kernels import kernel
from cuspid.runtime.workers import map_slices

POSE = 6
"""Unknowns of a frame."""
_PARTS = 4
"""Fixed, because the order of a sum shows in its last bits: the result must not depend on the number of cores."""
_FEW = 1000
"""Number of points below which threads are not worthwhile."""
_FLATTEST = 1e-3
"""Depth of a point, as a share of its distance from the axis, above which it counts as in front of the camera."""
_FARTHEST_BACK = 2.0
"""The same for an equidistant lens, behind the camera."""
_LAST_PERSPECTIVE = MODELS["FULL_OPENCV"].code
_SETTLING = 4
"""Maximum number of steps of a point after the rest has moved."""


class State(NamedTuple):
    """Values of all unknowns."""

    frame_rotation: np.ndarray
    frame_translation: np.ndarray
    camera_rotation: np.ndarray
    camera_translation: np.ndarray
    models: np.ndarray
    """Code of the model of each camera's lens."""
    intrinsics: np.ndarray
    """(cameras, n): parameters, with zeros after those of models that have fewer."""
    shutters: np.ndarray
    """(cameras, 3): delay and readout in frames, and the height of the image, px."""
    motions: np.ndarray
    """(frames, 6): how the handpiece moves in a frame, on the left of its pose (:mod:`cuspid.model.shutter`)."""
    points: np.ndarray
    whitened: np.ndarray
    """(cameras, m): z of each camera, zero at the prior; m is 6 + n, or 6 + n + 2 where a shutter is unknown."""
    basis: np.ndarray
    """(cameras, m, m): derivative of (motion on the left of cam_from_rig, parameters, delay and readout) by z."""


class Observations(NamedTuple):
    """Observations sorted by point."""

    pixels: np.ndarray
    frame: np.ndarray
    camera: np.ndarray
    start: np.ndarray
    """(points + 1): the observations of point p are start[p] to start[p + 1]."""


class Weighting(NamedTuple):
    """The weight of each residual, and which unknowns there are."""

    sigma_px: float
    huber_sigmas: float
    calibrated: bool


class System(NamedTuple):
    """Reduced normal equations: ``matrix @ step = -gradient``, before damping of ``diagonal``."""

    matrix: np.ndarray
    gradient: np.ndarray
    diagonal: np.ndarray


# --- one observation ---------------------------------------------------------------------------------------------


@kernel
@no_type_check
def _move(rotations, translations, which, x, out):
    """out = rotations[which] @ x + translations[which]; no slices: each would count a reference."""
    for i in range(3):
        out[i] = (
            rotations[which, i, 0] * x[0]
            + rotations[which, i, 1] * x[1]
            + rotations[which, i, 2] * x[2]
            + translations[which, i]
        )


@kernel(inline="always")
@no_type_check
def _place(state, point, frame, camera, row, x_at, x_in_rig):
    """A point in the rig at the instant of a frame, and when a row was exposed; how many frames later that was."""
    for i in range(3):
        x_in_rig[i] = state.points[point, i]
    _move(state.frame_rotation, state.frame_translation, frame, x_in_rig, x_at)
    late = state.shutters[camera, 0] + state.shutters[camera, 1] * (row / state.shutters[camera, 2] - 0.5)
    for i in range(3):
        x_in_rig[i] = x_at[i]
    if late != 0:
        motion = state.motions[frame]
        for i in range(3):
            x_in_rig[i] += late * _velocity(motion, x_at, i)
    return late


@kernel
@no_type_check
def _velocity(motion, x, i):
    """A component of how a point in the rig moves in a frame."""
    j, k = (i + 1) % 3, (i + 2) % 3
    return motion[j] * x[k] - motion[k] * x[j] + motion[3 + i]


@kernel
@no_type_check
def _is_before(model, x_in_cam):
    """Whether a point lies where a lens may show it: before a perspective one, and not almost beside it; not right
    behind an equidistant one."""
    least = _FLATTEST if model <= _LAST_PERSPECTIVE else -_FARTHEST_BACK
    return x_in_cam[2] > least * (abs(x_in_cam[0]) + abs(x_in_cam[1]))


@kernel
@no_type_check
def _times(a, rotations, which, out):
    """out (2x3) = a (2x3) @ rotations[which]."""
    for i in range(2):
        for j in range(3):
            out[i, j] = (
                a[i, 0] * rotations[which, 0, j] + a[i, 1] * rotations[which, 1, j] + a[i, 2] * rotations[which, 2, j]
            )


@kernel
@no_type_check
def _times_motion(a, x, out, at):
    """Columns ``at`` to ``at + 6`` of out: a (2x3) times the derivative [-[x]_x, I] of x under a small motion on its
    left."""
    for i in range(2):
        out[i, at] = a[i, 2] * x[1] - a[i, 1] * x[2]
        out[i, at + 1] = a[i, 0] * x[2] - a[i, 2] * x[0]
        out[i, at + 2] = a[i, 1] * x[0] - a[i, 0] * x[1]
        out[i, at + 3], out[i, at + 4], out[i, at + 5] = a[i, 0], a[i, 1], a[i, 2]


@kernel
@no_type_check
def _times_shutter(by_rig, motion, x, below, out, at):
    """Two columns of out from ``at`` on: derivatives by the delay and the readout of a camera, for a row so far below
    the middle."""
    for i in range(2):
        out[i, at] = 0.0
        for j in range(3):
            out[i, at] += by_rig[i, j] * _velocity(motion, x, j)
        out[i, at + 1] = below * out[i, at]


@kernel
@no_type_check
def _times_turn(by_rig, late, motion):
    """From derivatives by a point when a row was exposed to those by its place at the instant of the frame."""
    for i in range(2):
        a, b, c = by_rig[i]
        by_rig[i, 0] += late * (b * motion[2] - c * motion[1])
        by_rig[i, 1] += late * (c * motion[0] - a * motion[2])
        by_rig[i, 2] += late * (a * motion[1] - b * motion[0])


@kernel(inline="always")
@no_type_check
def _linearise_point(state, point, frame, camera, row, scratch, pixel, jacobian):
    """Projected pixel, seen at the height ``row``, and its derivatives by the point; the motion in the frame is held.
    False behind the camera; otherwise ``scratch`` keeps what leads there."""
    x_at, x_in_rig, x_in_cam, by_cam, by_rig, _ = scratch
    late = _place(state, point, frame, camera, row, x_at, x_in_rig)
    _move(state.camera_rotation, state.camera_translation, camera, x_in_rig, x_in_cam)
    model = state.models[camera]
    if not _is_before(model, x_in_cam):
        return False
    x, y, z = x_in_cam
    pixel[0], pixel[1] = point_jacobian(model, state.intrinsics[camera], x, y, z, by_cam)
    _times(by_cam, state.camera_rotation, camera, by_rig)
    if late != 0:
        _times_turn(by_rig, late, state.motions[frame])
    _times(by_rig, state.frame_rotation, frame, jacobian)
    return True


@kernel(inline="always")
@no_type_check
def linearise(state, point, frame, camera, row, calibrated, scratch, pixel, jacobian):
    """Projected pixel, seen at the height ``row``, and its derivatives (2xn) by point, pose and whitened calibration;
    the motion in the frame is held. False behind the camera."""
    if not _linearise_point(state, point, frame, camera, row, scratch, pixel, jacobian):
        return False
    x_at, _, x_in_cam, by_cam, by_rig, raw = scratch
    _times_motion(by_rig, x_at, jacobian, 3)
    if not calibrated:
        return True
    numbers, lens = raw.shape[1], state.intrinsics.shape[1]
    x, y, z = x_in_cam
    _times_motion(by_cam, x_in_cam, raw, 0)
    parameter_jacobian(state.models[camera], state.intrinsics[camera], x, y, z, raw, POSE)
    if numbers > POSE + lens:
        _times(by_cam, state.camera_rotation, camera, by_rig)
        below = row / state.shutters[camera, 2] - 0.5
        _times_shutter(by_rig, state.motions[frame], x_at, below, raw, POSE + lens)
    # The basis has one block for the place of the camera, and one for its lens and shutter.
    first = np.uint64(3 + POSE)
    for i in range(2):
        for j in range(np.uint64(numbers)):
            jacobian[i, first + j] = 0.0
        for k in range(numbers):
            begin, end = (np.uint64(0), np.uint64(POSE)) if k < POSE else (np.uint64(POSE), np.uint64(numbers))
            for j in range(begin, end):
                jacobian[i, first + j] += raw[i, k] * state.basis[camera, k, j]
    return True


@kernel
@no_type_check
def pose_equations(models, lenses, rotations, translations, pose, points, pixels, cameras, limit_px):
    """Normal equations of the pose of one frame alone, and the number of observations within ``limit_px``; the step is
    a small motion on its left.

    ``pose`` is (rotation, translation); an observation is a point, a pixel and the camera that saw it. Weights are
    Cauchy's at 1 px, times Tukey's, which fall to zero at the limit: as an observation crosses it, nothing jumps.
    """
    matrix, gradient, within = np.zeros((POSE, POSE)), np.zeros(POSE), 0
    x_in_rig, x_in_cam, by_cam, by_rig = np.zeros(3), np.zeros(3), np.zeros((2, 3)), np.zeros((2, 3))
    by_pose = np.zeros((2, POSE))
    for o in range(len(points)):
        camera = cameras[o]
        for i in range(3):
            x_in_rig[i] = (
                pose[0][i, 0] * points[o, 0] + pose[0][i, 1] * points[o, 1] + pose[0][i, 2] * points[o, 2] + pose[1][i]
            )
        _move(rotations, translations, camera, x_in_rig, x_in_cam)
        if not _is_before(models[camera], x_in_cam):
            continue
        x, y, z = x_in_cam
        x, y = point_jacobian(models[camera], lenses[camera], x, y, z, by_cam)
        x, y = x - pixels[o, 0], y - pixels[o, 1]
        left = 1 - (x * x + y * y) / limit_px**2
        if not left > 0:
            continue
        within += 1
        weight = left * left / (1 + x * x + y * y)
        _times(by_cam, rotations, camera, by_rig)
        _times_motion(by_rig, x_in_rig, by_pose, 0)
        for i in range(POSE):
            gradient[i] += weight * (by_pose[0, i] * x + by_pose[1, i] * y)
            for j in range(POSE):
                matrix[i, j] += weight * (by_pose[0, i] * by_pose[0, j] + by_pose[1, i] * by_pose[1, j])
    return matrix, gradient, within


@kernel
@no_type_check
def make_scratch(state):
    """Working memory of :func:`linearise`."""
    by_calibration = np.zeros((2, state.basis.shape[1]))
    return np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((2, 3)), np.zeros((2, 3)), by_calibration


@kernel
@no_type_check
def _columns(state):
    """Number of unknowns that an observation depends on."""
    return 3 + POSE + state.basis.shape[1]


@kernel
@no_type_check
def _residuals(state, observations, first, last, out):
    """Projected minus observed pixel for each observation of the points ``first`` to ``last``; NaN behind the
    camera."""
    x_at, x_in_rig, x_in_cam = np.zeros(3), np.zeros(3), np.zeros(3)
    for point in range(first, last):
        for o in range(observations.start[point], observations.start[point + 1]):
            frame, camera = observations.frame[o], observations.camera[o]
            _place(state, point, frame, camera, observations.pixels[o, 1], x_at, x_in_rig)
            _move(state.camera_rotation, state.camera_translation, camera, x_in_rig, x_in_cam)
            out[o, 0] = out[o, 1] = np.nan
            model = state.models[camera]
            if _is_before(model, x_in_cam):
                x, y = project(model, state.intrinsics[camera], x_in_cam[0], x_in_cam[1], x_in_cam[2])
                out[o, 0], out[o, 1] = x - observations.pixels[o, 0], y - observations.pixels[o, 1]


# --- normal equations --------------------------------------------------------------------------------------------


@kernel(inline="always")
@no_type_check
def _weigh(state, observations, weighting, point, o, scratch, residual, jacobian):
    """Residual and Jacobian of an observation, scaled by the root of its weight. False behind the camera."""
    frame, camera = observations.frame[o], observations.camera[o]
    row = observations.pixels[o, 1]
    if not linearise(state, point, frame, camera, row, weighting.calibrated, scratch, residual, jacobian):
        return False
    x, y, scale = residual[0] - observations.pixels[o, 0], residual[1] - row, 1 / weighting.sigma_px
    length = np.hypot(x, y) * scale
    if length > weighting.huber_sigmas:
        scale *= np.sqrt(weighting.huber_sigmas / length)
    residual[0], residual[1] = x * scale, y * scale
    # No array expressions: each would take longer than the loop.
    for i in range(2):
        for j in range(jacobian.shape[1]):
            jacobian[i, j] *= scale
    return True


@kernel
@no_type_check
def _slot(offsets, count, offset, coupling):
    """Where a block of unknowns stands among the blocks of the present point; a new one starts at zero."""
    for slot in range(count):
        if offsets[slot] == offset:
            return slot, count
    offsets[count] = offset
    coupling[count] = 0
    return count, count + 1


@kernel
@no_type_check
def _add_block(matrix, row, column, left, right):
    """matrix[row:, column:] += left^T right for 2xn factors."""
    for i in range(left.shape[1]):
        for j in range(right.shape[1]):
            matrix[row + i, column + j] += left[0, i] * right[0, j] + left[1, i] * right[1, j]


@kernel
@no_type_check
def _add_gradient(system, offset, by_block, residual):
    """Add J^T r and the diagonal of J^T J of one block of unknowns."""
    for i in range(by_block.shape[1]):
        system.gradient[offset + i] += by_block[0, i] * residual[0] + by_block[1, i] * residual[1]
        system.diagonal[offset + i] += by_block[0, i] ** 2 + by_block[1, i] ** 2


@kernel(inline="always")
@no_type_check
def _add_observation(system, blocks, jacobian, residual, pose_at, camera_at):
    """Add an observation to the direct part of the system and to the coupling of its blocks with the point."""
    offsets, widths, coupling, count = blocks
    by_point = jacobian[:, :3]
    by_pose, by_calibration = jacobian[:, 3 : 3 + POSE], jacobian[:, 3 + POSE :]
    if pose_at >= 0:
        _add_block(system.matrix, pose_at, pose_at, by_pose, by_pose)
        _add_gradient(system, pose_at, by_pose, residual)
        slot, count = _slot(offsets, count, pose_at, coupling)
        widths[slot] = POSE
        _add_block(coupling[slot], 0, 0, by_point, by_pose)
    if camera_at >= 0:
        _add_block(system.matrix, camera_at, camera_at, by_calibration, by_calibration)
        _add_gradient(system, camera_at, by_calibration, residual)
        slot, count = _slot(offsets, count, camera_at, coupling)
        widths[slot] = by_calibration.shape[1]
        _add_block(coupling[slot], 0, 0, by_point, by_calibration)
        if pose_at >= 0:
            _add_block(system.matrix, camera_at, pose_at, by_calibration, by_pose)
    return count


@kernel
@no_type_check
def _eliminate(system, offsets, widths, coupling, count, inverse, point_gradient):
    """Subtract what the blocks share through the present point: W V^-1 W^T and W V^-1 g. Lower triangle only."""
    for a in range(count):
        for i in range(widths[a]):
            row = offsets[a] + i
            w0, w1, w2 = coupling[a, 0, i], coupling[a, 1, i], coupling[a, 2, i]
            y0 = w0 * inverse[0, 0] + w1 * inverse[1, 0] + w2 * inverse[2, 0]
            y1 = w0 * inverse[0, 1] + w1 * inverse[1, 1] + w2 * inverse[2, 1]
            y2 = w0 * inverse[0, 2] + w1 * inverse[1, 2] + w2 * inverse[2, 2]
            system.gradient[row] -= y0 * point_gradient[0] + y1 * point_gradient[1] + y2 * point_gradient[2]
            for b in range(count):
                if offsets[b] > offsets[a]:
                    continue
                # Unsigned: numba would look for negative indices otherwise.
                first = np.uint64(offsets[b])
                for j in range(np.uint64(widths[b])):
                    system.matrix[row, first + j] -= (
                        y0 * coupling[b, 0, j] + y1 * coupling[b, 1, j] + y2 * coupling[b, 2, j]
                    )


@kernel
@no_type_check
def _point_inverse(hessian, inverse):
    """Inverse of a point's 3x3 block; zero where the point is not determined."""
    a, b, c = hessian[0, 0], hessian[0, 1], hessian[0, 2]
    d, e, f = hessian[1, 1], hessian[1, 2], hessian[2, 2]
    determinant = a * (d * f - e * e) - b * (b * f - e * c) + c * (b * e - d * c)
    inverse[:] = 0
    if determinant <= 1e-12 * a * d * f:
        return
    inverse[0, 0], inverse[1, 1] = (d * f - e * e) / determinant, (a * f - c * c) / determinant
    inverse[2, 2] = (a * d - b * b) / determinant
    inverse[0, 1] = inverse[1, 0] = (c * e - b * f) / determinant
    inverse[0, 2] = inverse[2, 0] = (b * e - c * d) / determinant
    inverse[1, 2] = inverse[2, 1] = (b * c - a * e) / determinant


@kernel
@no_type_check
def _offsets_of(state, observations, weighting, o):
    """Where the pose and the calibration of an observation stand in the system; -1 where they are held."""
    frame, camera = observations.frame[o], observations.camera[o]
    calibration_at = POSE * (state.frame_rotation.shape[0] - 1) + state.basis.shape[1] * camera
    return POSE * (frame - 1) if frame > 0 else -1, calibration_at if weighting.calibrated else -1


@kernel
@no_type_check
def _accumulate(state, observations, weighting, first, last, system):
    """Add the points ``first`` to ``last`` to the reduced normal equations."""
    longest, calibration = np.diff(observations.start).max(), state.basis.shape[1]
    scratch, residual, jacobian = make_scratch(state), np.zeros(2), np.zeros((2, _columns(state)))
    offsets, widths = np.zeros(2 * longest, np.int64), np.zeros(2 * longest, np.int64)
    coupling = np.zeros((2 * longest, 3, max(calibration, POSE)))
    hessian, gradient, inverse = np.zeros((3, 3)), np.zeros((3, 1)), np.zeros((3, 3))
    for point in range(first, last):
        hessian[:], gradient[:] = 0, 0
        count = 0
        for o in range(observations.start[point], observations.start[point + 1]):
            if _weigh(state, observations, weighting, point, o, scratch, residual, jacobian):
                pose_at, camera_at = _offsets_of(state, observations, weighting, o)
                _add_block(hessian, 0, 0, jacobian[:, :3], jacobian[:, :3])
                _add_block(gradient, 0, 0, jacobian[:, :3], residual.reshape(2, 1))
                blocks = (offsets, widths, coupling, count)
                count = _add_observation(system, blocks, jacobian, residual, pose_at, camera_at)
        _point_inverse(hessian, inverse)
        _eliminate(system, offsets, widths, coupling, count, inverse, gradient[:, 0])


@kernel
@no_type_check
def _scores(state, observations, weighting, first, last, out):
    """J^T r of each observation of the points ``first`` to ``last``, by its pose and its calibration."""
    scratch, residual, jacobian = make_scratch(state), np.zeros(2), np.zeros((2, _columns(state)))
    for point in range(first, last):
        for o in range(observations.start[point], observations.start[point + 1]):
            if _weigh(state, observations, weighting, point, o, scratch, residual, jacobian):
                for i in range(out.shape[1]):
                    out[o, i] = jacobian[0, 3 + i] * residual[0] + jacobian[1, 3 + i] * residual[1]


@kernel
@no_type_check
def _substitute(state, observations, weighting, steps, first, last, moved):
    """Back-substitution: the points ``first`` to ``last`` after the reduced unknowns have made each of some steps."""
    count, calibration = steps.shape[1], state.basis.shape[1]
    scratch, residual, jacobian = make_scratch(state), np.zeros(2), np.zeros((2, _columns(state)))
    hessian, inverse = np.zeros((3, 3)), np.zeros((3, 3))
    ahead, gradient = np.zeros((2, count)), np.zeros((3, count))
    for point in range(first, last):
        hessian[:], gradient[:] = 0, 0
        for o in range(observations.start[point], observations.start[point + 1]):
            if not _weigh(state, observations, weighting, point, o, scratch, residual, jacobian):
                continue
            pose_at, camera_at = _offsets_of(state, observations, weighting, o)
            for i in range(2):
                ahead[i] = residual[i]
                if pose_at >= 0:
                    _add_products(jacobian[i, 3 : 3 + POSE], steps[pose_at : pose_at + POSE], ahead[i])
                if camera_at >= 0:
                    _add_products(jacobian[i, 3 + POSE :], steps[camera_at : camera_at + calibration], ahead[i])
            _add_block(hessian, 0, 0, jacobian[:, :3], jacobian[:, :3])
            _add_block(gradient, 0, 0, jacobian[:, :3], ahead)
        _point_inverse(hessian, inverse)
        for i in range(3):
            for d in range(count):
                moved[d, point, i] = state.points[point, i] - (
                    inverse[i, 0] * gradient[0, d] + inverse[i, 1] * gradient[1, d] + inverse[i, 2] * gradient[2, d]
                )


@kernel
@no_type_check
def _add_products(left, right, out):
    """out += left @ right."""
    for k in range(len(left)):
        for d in range(len(out)):
            out[d] += left[k] * right[k, d]


@kernel(inline="always")
@no_type_check
def _point_equations(state, observations, weighting, point, scratch, residual, jacobian, hessian, gradient):
    """Normal equations of a point alone, the rest being held, and the Huber loss of its observations: infinite where it
    lies behind one of their cameras."""
    hessian[:], gradient[:] = 0, 0
    total, knee = 0.0, weighting.huber_sigmas
    for o in range(observations.start[point], observations.start[point + 1]):
        frame, camera, row = observations.frame[o], observations.camera[o], observations.pixels[o, 1]
        if not _linearise_point(state, point, frame, camera, row, scratch, residual, jacobian):
            total = np.inf
            continue
        x, y = residual[0] - observations.pixels[o, 0], residual[1] - row
        length = np.hypot(x, y) / weighting.sigma_px
        total += length * length if length <= knee else 2 * knee * length - knee * knee
        weight = 1.0 if length <= knee else knee / length
        for i in range(3):
            gradient[i] += weight * (jacobian[0, i] * x + jacobian[1, i] * y)
            for j in range(3):
                hessian[i, j] += weight * (jacobian[0, i] * jacobian[0, j] + jacobian[1, i] * jacobian[1, j])
    return total


@kernel
@no_type_check
def _settle(state, observations, weighting, first, last):
    """Move the points ``first`` to ``last`` to where their rays meet, the rest being held (Gauss-Newton)."""
    scratch, residual, jacobian = make_scratch(state), np.zeros(2), np.zeros((2, 3))
    hessian, gradient, inverse, before = np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    for point in range(first, last):
        loss = np.inf
        for step in range(_SETTLING + 1):
            lower = _point_equations(
                state, observations, weighting, point, scratch, residual, jacobian, hessian, gradient
            )
            if step > 0 and not lower < loss:
                for i in range(3):
                    state.points[point, i] = before[i]
                break
            if step == _SETTLING or (step > 0 and loss - lower < 1e-9 * lower):
                break
            loss = lower
            _point_inverse(hessian, inverse)
            for i in range(3):
                before[i] = state.points[point, i]
            for i in range(3):
                for j in range(3):
                    state.points[point, i] -= inverse[i, j] * gradient[j]


def normal_equations(state: State, observations: Observations, weighting: Weighting) -> System:
    """Reduced normal equations of all observations and of the prior of the calibration."""
    size = POSE * (len(state.frame_rotation) - 1)
    total = size + (state.whitened.size if weighting.calibrated else 0)

    def part(points: slice) -> System:
        system = System(np.zeros((total, total)), np.zeros(total), np.zeros(total))
        _accumulate(state, observations, weighting, points.start, points.stop, system)
        return system

    parts = map_slices(part, len(state.points), _PARTS, few=_FEW)
    matrix, gradient, diagonal = (sum(terms[1:], terms[0]) for terms in zip(*parts, strict=True))
    if weighting.calibrated:
        prior = np.arange(size, total)
        matrix[prior, prior] += 1
        diagonal[prior] += 1
        gradient[prior] += state.whitened.ravel()
    return System(matrix, gradient, diagonal)


def scatter_of_tracks(state: State, observations: Observations, weighting: Weighting) -> Float[np.ndarray, "k k"]:
    """Sum over the tracks of g g^T, where g is the contribution of a track to the gradient of the reduced unknowns
    without the prior, with every point where its rays meet best. It estimates the covariance of the gradient from
    independent tracks, however the errors within a track are correlated (Liang and Zeger, Biometrika 73, 1986)."""
    size = POSE * (len(state.frame_rotation) - 1)
    total = size + (state.whitened.size if weighting.calibrated else 0)
    calibration = state.basis.shape[1]
    blocks = np.zeros((len(observations.frame), POSE + calibration))
    map_slices(
        lambda points: _scores(state, observations, weighting, points.start, points.stop, blocks),
        len(state.points),
        _PARTS,
        few=_FEW,
    )
    columns = np.concatenate(
        [
            POSE * (observations.frame - 1)[:, None] + np.arange(POSE),
            size + calibration * observations.camera[:, None] + np.arange(calibration),
        ],
        axis=1,
    )
    rows = np.repeat(np.arange(len(state.points)), np.diff(observations.start))[:, None] + 0 * columns
    free = (columns >= 0) & (columns < total)
    shares = csr_array((blocks[free], (rows[free], columns[free])), shape=(len(state.points), total))
    spare = 2 * len(observations.frame) - state.points.size
    return np.asarray((shares.T @ shares).toarray()) * spare / max(spare - total, 1)


def influence(state: State, observations: Observations, weighting: Weighting) -> tuple[float, float]:
    """Sum of the squares of psi(r) = w(r) r, and the mean slope of psi (Huber, Robust Statistics, 1981, sec. 7.6)."""
    lengths = np.linalg.norm(residual_vectors(state, observations), axis=1) / weighting.sigma_px
    beyond = lengths > weighting.huber_sigmas
    slopes = np.where(beyond, weighting.huber_sigmas / (2 * np.maximum(lengths, 1e-300)), 1.0)
    return float(np.sum(np.minimum(lengths, weighting.huber_sigmas) ** 2)), float(np.mean(slopes))


def move_poses(state: State, step: Float[np.ndarray, "n"]) -> State:
    """The state after small motions on the left of all poses except the first."""
    motions = np.vstack([np.zeros((1, POSE)), step.reshape(-1, POSE)])
    turns = Rotation.from_rotvec(motions[:, :3]).as_matrix()
    return state._replace(
        frame_rotation=turns @ state.frame_rotation,
        frame_translation=np.einsum("fij,fj->fi", turns, state.frame_translation) + motions[:, 3:],
    )


def substitute(
    state: State, observations: Observations, weighting: Weighting, steps: Float[np.ndarray, "k d"]
) -> Float[np.ndarray, "d p 3"]:
    """The points after each of some steps of the reduced unknowns, given as columns."""
    moved, steps = np.empty((steps.shape[1], *state.points.shape)), np.ascontiguousarray(steps)

    def part(points: slice) -> None:
        _substitute(state, observations, weighting, steps, points.start, points.stop, moved)

    map_slices(part, len(state.points), _PARTS, few=_FEW)
    return moved


def refine_points(state: State, observations: Observations, weighting: Weighting) -> State:
    """The state with each point where its rays meet best, with poses and calibration held fixed."""
    settled = state._replace(points=state.points.copy())

    def part(points: slice) -> None:
        _settle(settled, observations, weighting, points.start, points.stop)

    map_slices(part, len(state.points), _PARTS, few=_FEW)
    return settled


def residual_vectors(state: State, observations: Observations) -> Float[np.ndarray, "o 2"]:
    """Projected minus observed pixels; NaN behind the camera."""
    residuals = np.empty_like(observations.pixels)

    def part(points: slice) -> None:
        _residuals(state, observations, points.start, points.stop, residuals)

    map_slices(part, len(state.points), _PARTS, few=_FEW)
    return residuals
