"""One bundle adjustment of rig poses and points and, where the calibration has a prior, of the calibration too.

A point X of the world is seen by camera c at frame f as ``project(c, cam_from_rig[c] @ rig_from_world[f] @ X)``.
Unknowns and how a step changes them:

- a pose, by a small motion on the left (rotation vector rad, translation mm); the first frame stays: it is the world;
- a point, by a displacement (mm);
- the calibration of a camera, by its whitened parameters z with prior N(0, 1): cam_from_rig = exp(L_e z_e) prior and
  parameters = prior + L_i z_i, where L L^T is the covariance of the prior. Without one L = 0: the calibration is fixed.
  So it is with the delay and the readout of its shutter.

Where a row is exposed a time t after the instant of its frame (:mod:`cuspid.model.shutter`), X is seen at
``cam_from_rig[c] @ exp(t v) @ rig_from_world[f] @ X``, to first order in t. The motion v in the frame follows from the
poses before and after it; it is fixed while the minimum is sought, and both are found in turn.

Levenberg-Marquardt on the Huber loss of the residuals in units of their standard deviation. The points are eliminated
(Schur complement); what remains is a dense system of 6 unknowns a frame and 14 to 18 a camera. After each step the
points are put where their rays then meet (variable projection, Golub and Pereyra 1973), because as an arch bends they
move far and not in a straight line; and the similarity of the whole rig, which no image determines, is set by the prior
alone (:mod:`cuspid.motion.bundle.gauge`). The sums run over a fixed number of parts in a fixed order, so the result
does not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.special import chdtri

from cuspid.geometry import Rigid3
from cuspid.model.camera import stack_lenses
from cuspid.model.epipolar import skew
from cuspid.model.reconstruction import Expectation, Reconstruction, Refinement, Tracks
from cuspid.model.rig import MountedCamera, Rig
from cuspid.model.shutter import film_times, motions
from cuspid.model.sparse_model import SparseModel
from cuspid.model.unrolling import is_rolling
from cuspid.motion.bundle.expectation import MOST_POINTS, covariance_factor, expectation_of, steps_drawn
from cuspid.motion.bundle.gauge import PLACE, best_gauge, gauge_basis, transform_mounts, transform_world
from cuspid.motion.bundle.misfit import CHANCE, held_misfit
from cuspid.motion.bundle.normal_equations import (
    POSE,
    Observations,
    State,
    System,
    Weighting,
    influence,
    move_poses,
    normal_equations,
    refine_points,
    residual_vectors,
    scatter_of_tracks,
    substitute,
)
from cuspid.runtime.errors import ReconstructionError
from cuspid.runtime.options import Options, Range

_LEAST_SIGMA_PX = 1e-6
_LEAST_DAMPING, _MOST_DAMPING = 1e-9, 1e6
"""Damping of a step, as shares of the diagonal of the normal equations. What moves everything at once, such as the
scale and the bending of an arch, stands out so little from that diagonal that 1e-4 of it would freeze it."""
_GAUGE_STEPS = 5
_MOTIONS, _SAME_PX = 6, 0.01
"""Maximum number of times that the motions in the frames follow the poses; and by how much they must move what is seen,
px (root mean square), to do so once more."""
_SHUTTER = 2
"""Numbers of a shutter."""


@dataclass(frozen=True, kw_only=True)
class AdjustmentOptions(Options):
    """How the bundle adjustment weights and rejects observations, and when it stops."""

    sigma_px: Annotated[float, Range(0.0001, 100)] = 0.4
    """Initial standard deviation of a keypoint, px; the adjustment re-estimates it in each round."""
    huber_sigmas: Annotated[float, Range(0.01, 1000)] = 2.0
    """Residual length, in standard deviations, beyond which an observation is down-weighted (Huber)."""
    outlier_sigmas: Annotated[float, Range(0.1, 1000)] = 4.0
    """Residual length, in standard deviations, beyond which an observation is dropped after a round."""
    start_px: Annotated[float, Range(0.01, 1_000_000_000)] = 20.0
    """Residual length beyond which an observation is dropped before the first round, px."""
    rounds: Annotated[int, Range(1, 1000)] = 3
    """Number of times that the minimum is sought, with outliers dropped in between."""
    iterations: Annotated[int, Range(1, 100_000)] = 30
    """Maximum number of steps in a round."""
    tolerance: Annotated[float, Range(1e-12, 1000)] = 0.01
    """A round ends when the cost, in squared standard deviations, would fall by less than this: all unknowns together
    are then within its square root of their best values, measured in their standard deviations."""
    min_angle_deg: Annotated[float, Range(0, 90)] = 1.0
    """Points whose rays meet at less than this angle are dropped."""


# --- states ------------------------------------------------------------------------------------------------------


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
    parameter_factor: Float[np.ndarray, "c n n"]
    """Of the lens, and of the shutter where one is unknown."""

    @staticmethod
    def of(rig: Rig) -> _Prior:
        """From the covariances that the rig carries."""
        mounted = rig.cameras.values()
        numbers = max(len(m.camera.parameters) for m in mounted)
        numbers += 0 if all(m.shutter.is_known for m in mounted) else _SHUTTER
        lenses = np.zeros((len(mounted), numbers, numbers))
        for factor, m in zip(lenses, mounted, strict=True):
            count = len(m.camera.parameters)
            if not m.shutter.is_known:
                factor[-2, -2], factor[-1, -1] = m.shutter.delay_sigma_frames, m.shutter.readout_sigma
            factor[:count, :count] = covariance_factor(m.camera.covariance, count)
        return _Prior(rig, np.stack([covariance_factor(m.covariance, 6) for m in mounted]), lenses)

    @property
    def numbers(self) -> int:
        """Unknowns of each camera: of its place, of its lens, and of its shutter."""
        return POSE + self.parameter_factor.shape[1]

    @property
    def is_free(self) -> bool:
        """Whether anything of the calibration may move."""
        return bool(np.any(self.extrinsic_factor) or np.any(self.parameter_factor))

    @property
    def free_numbers(self) -> Int[np.ndarray, "c"]:
        """How many numbers of each camera may move."""
        factors = zip(self.extrinsic_factor, self.parameter_factor, strict=True)
        return np.array([np.linalg.matrix_rank(place) + np.linalg.matrix_rank(lens) for place, lens in factors])

    def camera_at(self, index: int, whitened: Float[np.ndarray, "n"]) -> MountedCamera:
        """A camera whose calibration is ``whitened`` standard deviations from the given one."""
        mounted = self.rig.cameras[self.rig.names[index]]
        motion = self.extrinsic_factor[index] @ whitened[:6]
        shift = self.parameter_factor[index] @ whitened[6:]
        moved = Rigid3.from_rotation_vector(motion[:3], motion[3:]) @ mounted.cam_from_rig
        parameters = mounted.camera.parameters
        camera = mounted.camera.with_parameters(parameters + shift[: len(parameters)])
        shutter = mounted.shutter if mounted.shutter.is_known else mounted.shutter.later(*shift[-_SHUTTER:].tolist())
        return replace(mounted, camera=camera, cam_from_rig=moved, shutter=shutter)

    def whitened_places(
        self, rotations: Float[np.ndarray, "c 3 3"], translations: Float[np.ndarray, "c 3"]
    ) -> Float[np.ndarray, "c 6"]:
        """How many standard deviations places in the rig are from the given ones."""
        numbers = []
        for mounted, factor, rotation, translation in zip(
            self.rig.cameras.values(), self.extrinsic_factor, rotations, translations, strict=True
        ):
            motion = Rigid3(rotation, translation) @ mounted.cam_from_rig.inverse()
            numbers.append(np.linalg.pinv(factor) @ [*motion.rotation_vector, *motion.translation])
        return np.array(numbers)

    def basis_at(self, index: int, whitened: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n n"]:
        """Derivative of (motion on the left of cam_from_rig, parameters) with respect to ``whitened``."""
        motion = self.extrinsic_factor[index] @ whitened[:6]
        turn = left_jacobian(motion[:3])
        on_the_left = np.block([[turn, np.zeros((3, 3))], [skew(motion[3:]) @ turn, np.eye(3)]])
        basis = np.zeros((self.numbers, self.numbers))
        basis[:6, :6] = on_the_left @ self.extrinsic_factor[index]
        basis[6:, 6:] = self.parameter_factor[index]
        return basis


def _with_calibration(state: State, prior: _Prior, whitened: Float[np.ndarray, "c n"]) -> State:
    """The state with another calibration."""
    cameras = [prior.camera_at(index, z) for index, z in enumerate(whitened)]
    models, intrinsics = stack_lenses([m.camera for m in cameras])
    return state._replace(
        camera_rotation=np.stack([m.cam_from_rig.rotation for m in cameras]),
        camera_translation=np.stack([m.cam_from_rig.translation for m in cameras]),
        models=models,
        intrinsics=intrinsics,
        shutters=np.array(
            [[m.shutter.delay_frames, m.shutter.readout, m.camera.height] for m in cameras], dtype=np.float64
        ),
        whitened=whitened,
        basis=np.stack([prior.basis_at(index, z) for index, z in enumerate(whitened)]),
    )


def _initial_state(
    poses: Sequence[Rigid3], points: Float[np.ndarray, "p 3"], prior: _Prior, times: Sequence[float] | None = None
) -> State:
    """Poses, at the times of a film, points and the given calibration as arrays."""
    empty = np.zeros(0)
    state = State(
        frame_rotation=np.stack([pose.rotation for pose in poses]),
        frame_translation=np.stack([pose.translation for pose in poses]),
        camera_rotation=empty,
        camera_translation=empty,
        models=empty,
        intrinsics=empty,
        shutters=empty,
        motions=motions(poses, times),
        points=np.ascontiguousarray(points),
        whitened=empty,
        basis=empty,
    )
    return _with_calibration(state, prior, np.zeros((len(prior.rig.names), prior.numbers)))


def _apply_step(state: State, observations: Observations, weighting: Weighting, prior: _Prior, step: Any) -> State:
    """The state after a step of poses and calibration, with the points where their rays then meet."""
    size = POSE * (len(state.frame_rotation) - 1)
    points = substitute(state, observations, weighting, step[:, None])[0]
    moved = move_poses(state, step[:size])._replace(points=points)
    if weighting.calibrated:
        moved = _with_calibration(moved, prior, state.whitened + step[size:].reshape(state.whitened.shape))
    return _restore_in_front(refine_points(moved, observations, weighting), state.points, observations)


def _restore_in_front(state: State, before: Float[np.ndarray, "p 3"], observations: Observations) -> State:
    """A state in which points that went behind a camera are where they were before: one such point, whose rays hardly
    meet, must not hold up the others."""
    lost = ~np.isfinite(residual_vectors(state, observations)).all(axis=1)
    if not lost.any():
        return state
    points = state.points.copy()
    which = np.unique(np.repeat(np.arange(len(points)), np.diff(observations.start))[lost])
    points[which] = before[which]
    return state._replace(points=points)


# --- minimisation ------------------------------------------------------------------------------------------------


def _cost(state: State, observations: Observations, weighting: Weighting) -> float:
    """Huber loss of the residuals plus the prior; infinite if a point went behind a camera."""
    lengths = np.linalg.norm(residual_vectors(state, observations), axis=1) / weighting.sigma_px
    if not np.all(np.isfinite(lengths)):
        return np.inf
    knee = weighting.huber_sigmas
    inside = np.minimum(lengths, knee)
    loss = inside * (2 * lengths - inside)
    return float(np.sum(loss) + np.sum(state.whitened**2))


def _solve(system: System, damping: float) -> Float[np.ndarray, "n"] | None:
    """The damped step, or None where the system is not positive definite."""
    matrix = system.matrix.copy()
    on_diagonal = np.arange(len(matrix))
    matrix[on_diagonal, on_diagonal] += damping * system.diagonal + 1e-12
    try:
        return np.asarray(cho_solve(cho_factor(matrix, lower=True), -system.gradient))
    except LinAlgError:
        return None


def _apply_best_gauge(state: State, prior: _Prior) -> State:
    """The state with the least cost of the prior among those that all images see alike."""
    for _ in range(_GAUGE_STEPS):
        gauge = best_gauge(state)
        whitened = state.whitened.copy()
        whitened[:, :PLACE] = prior.whitened_places(*transform_mounts(state, gauge))
        if not np.sum(whitened**2) < (1 - 1e-9) * np.sum(state.whitened**2):
            break
        state = _with_calibration(transform_world(state, gauge), prior, whitened)
    return state


@dataclass(frozen=True, eq=False)
class _Minimum:
    """Where the search for the least cost ended."""

    state: State
    steps: int
    """Steps that were tried."""
    decrease: float
    """By which the cost would still fall, if it were quadratic."""


def _minimise(
    state: State,
    observations: Observations,
    weighting: Weighting,
    prior: _Prior,
    options: AdjustmentOptions,
) -> _Minimum:
    """Levenberg-Marquardt on poses and calibration, with the points always where their rays meet best."""
    damping, cost = _LEAST_DAMPING, _cost(state, observations, weighting)
    steps, settled = 0, False
    while steps < options.iterations and not settled and damping <= _MOST_DAMPING:
        steps += 1
        system = normal_equations(state, observations, weighting)
        full = _solve(system, _LEAST_DAMPING)
        step = full if damping == _LEAST_DAMPING else _solve(system, damping)
        decrease = np.inf if full is None else float(-full @ system.gradient)
        candidate = state if step is None else _apply_step(state, observations, weighting, prior, step)
        lower = np.inf if step is None else _cost(candidate, observations, weighting)
        settled = decrease < options.tolerance
        if lower <= cost:
            state, damping = _apply_best_gauge(candidate, prior), max(damping / 10, _LEAST_DAMPING)
            cost = _cost(state, observations, weighting) if weighting.calibrated else lower
        else:
            damping *= 10
    return _Minimum(state, steps, decrease)


def _minimise_film(
    state: State,
    observations: Observations,
    weighting: Weighting,
    prior: _Prior,
    options: AdjustmentOptions,
    times: Sequence[float] | None,
) -> _Minimum:
    """As :func:`_minimise`, with the motions in the frames as they follow from their poses."""
    minimum = _minimise(state, observations, weighting, prior, options)
    for _ in range(_MOTIONS if times is not None else 0):
        found = minimum.state
        following = found._replace(motions=motions(_poses(found), times))
        shifts = residual_vectors(following, observations) - residual_vectors(found, observations)
        if np.sqrt(np.mean(np.sum(shifts**2, axis=1))) < _SAME_PX:
            break
        again = _minimise(following, observations, weighting, prior, options)
        minimum = replace(again, steps=minimum.steps + again.steps)
    return minimum


def _poses(state: State) -> tuple[Rigid3, ...]:
    return tuple(map(Rigid3, state.frame_rotation, state.frame_translation))


def _times(rig: Rig, frames: Sequence[str]) -> tuple[float, ...] | None:
    """When the frames of a film were taken, if that matters."""
    return film_times(frames) if is_rolling(rig, frames) else None


def _sigma_px(state: State, observations: Observations, weighting: Weighting, unknowns: int) -> float:
    """Standard deviation (px) that an observation counts for in the estimate.

    For a robust loss the covariance of the estimate is a / b^2 (J^T J)^-1, with a the variance of the influence
    psi(r) = w(r) r and b its mean slope (Huber, Robust Statistics, 1981, section 7.6); so sigma^2 = a / b^2.
    """
    squares, slope = influence(state, observations, weighting)
    variance = squares / max(2 * len(observations.frame) - unknowns, 1)
    return max(float(weighting.sigma_px * np.sqrt(variance) / slope), _LEAST_SIGMA_PX)


# --- observations ------------------------------------------------------------------------------------------------


def _largest_angles_deg(state: State, observations: Observations) -> Float[np.ndarray, "p"]:
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


def _good(state: State, observations: Observations, limit_px: float, min_angle_deg: float) -> Bool[np.ndarray, "o"]:
    """Observations to keep: before the camera, near the projection, of points with two of them and enough angle."""
    counts = np.diff(observations.start)
    point = np.repeat(np.arange(len(counts)), counts)
    lengths = np.linalg.norm(residual_vectors(state, observations), axis=1)
    near = np.isfinite(lengths) & (lengths <= limit_px)
    seen = np.bincount(point, weights=near, minlength=len(counts)) >= 2
    wide = _largest_angles_deg(state, observations) >= min_angle_deg
    return near & (seen & wide)[point]


def _sort_by_point(tracks: Tracks, keep: Bool[np.ndarray, "o"]) -> tuple[Observations, Int[np.ndarray, "p"]]:
    """The kept observations sorted by point, and the indices of the points that still have any."""
    order = np.flatnonzero(keep)
    order = order[np.argsort(tracks.point_index[order], kind="stable")]
    points, counts = np.unique(tracks.point_index[order], return_counts=True)
    return (
        Observations(
            pixels=np.ascontiguousarray(tracks.pixels[order]),
            frame=np.ascontiguousarray(tracks.frame_index[order]),
            camera=np.ascontiguousarray(tracks.camera_index[order]),
            start=np.concatenate([[0], np.cumsum(counts)]),
        ),
        points,
    )


def _select(
    state: State, observations: Observations, colors: Any, keep: Bool[np.ndarray, "o"]
) -> tuple[State, Observations, Any]:
    """State, observations and colours without what is not kept."""
    kept, points = _sort_by_point(_as_tracks(state, observations, colors), keep)
    return state._replace(points=state.points[points]), kept, colors[points]


def _as_tracks(state: State, observations: Observations, colors: Any) -> Tracks:
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
    """How far (px, one standard deviation, worst camera) the rig's covariance moves points at a distance; 0 if it is
    held fixed."""
    prior, sigma = _Prior.of(rig), 0.0
    if not prior.is_free:
        return sigma
    for index, mounted in enumerate(rig.cameras.values()):
        corners = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1]]) * [mounted.camera.width, mounted.camera.height]
        in_rig = mounted.cam_from_rig.inverse().apply(distance_mm * mounted.camera.rays(corners))
        moved = [prior.camera_at(index, unit) for unit in np.eye(prior.numbers)]
        shifts = np.stack([m.camera.project(m.cam_from_rig.apply(in_rig)) - corners for m in moved])
        sigma = max(sigma, float(np.sqrt(np.sum(shifts**2, axis=(0, 2)).max())))
    return sigma


def residuals_px(reconstruction: Reconstruction) -> Float[np.ndarray, "o 2"]:
    """Projected minus observed pixel for each observation of the tracks; NaN behind the camera."""
    tracks = reconstruction.tracks
    if tracks is None:
        return np.zeros((0, 2))
    observations, points = _sort_by_point(tracks, np.ones(len(tracks.point_index), dtype=bool))
    poses = tuple(reconstruction.rig_from_world.values())
    times = _times(reconstruction.rig, reconstruction.frames)
    state = _initial_state(poses, tracks.points[points], _Prior.of(reconstruction.rig), times)
    residuals = np.empty_like(observations.pixels)
    residuals[np.argsort(tracks.point_index, kind="stable")] = residual_vectors(state, observations)
    return residuals


# --- the adjustment ----------------------------------------------------------------------------------------------


class _Posterior(NamedTuple):
    """Covariances of what was found."""

    poses: Float[np.ndarray, "f 6 6"]
    calibration: Float[np.ndarray, "c n n"] | None
    """Of each camera (motion on the left, parameters); None where it is held."""
    expectation: Expectation


def _posterior(state: State, observations: Observations, weighting: Weighting) -> _Posterior:
    """From how the gradients of the tracks scatter, for the errors of the keypoints of one hang together (covariance of
    an M-estimate with clusters: Huber, 5th Berkeley Symposium, 1967; Liang and Zeger, Biometrika 73, 1986).

    Raises LinAlgError where the observations do not determine every pose.
    """
    poses = np.zeros((len(state.frame_rotation), POSE, POSE))
    start = POSE * (len(poses) - 1)
    _, slope = influence(state, observations, weighting)
    hessian = normal_equations(state, observations, weighting._replace(huber_sigmas=np.inf)).matrix
    prior = np.diag(np.arange(len(hessian)) >= start).astype(np.float64)
    scatter = scatter_of_tracks(state, observations, weighting)
    inverse = _inverse(state, slope * (hessian - prior), scatter, prior)
    for frame in range(1, len(poses)):
        at = slice(POSE * (frame - 1), POSE * frame)
        poses[frame] = inverse[at, at]
    expectation = _expectation(state, observations, weighting, inverse)
    if not weighting.calibrated:
        return _Posterior(poses, None, expectation)
    numbers = state.basis.shape[1]
    starts = range(start, len(inverse), numbers)
    whitened = np.stack([inverse[at : at + numbers, at : at + numbers] for at in starts])
    calibration = state.basis @ whitened @ np.swapaxes(state.basis, 1, 2)
    return _Posterior(poses, calibration, expectation)


def _inverse(
    state: State,
    by_images: Float[np.ndarray, "k k"],
    scatter: Float[np.ndarray, "k k"],
    prior: Float[np.ndarray, "k k"],
) -> Float[np.ndarray, "k k"]:
    """``(by_images + prior)^-1 (scatter + prior) (by_images + prior)^-1``. What images tell is up to 1e15 times what
    the prior does, but of a similarity they tell nothing: there it is set to 0, instead of to what rounding leaves."""
    basis, blind = gauge_basis(state) if prior.any() else (np.eye(len(prior)), 0)
    information, scattered = (basis.T @ matrix @ basis for matrix in (by_images, scatter))
    for matrix in (information, scattered):
        matrix[len(matrix) - blind :] = 0
        matrix[:, len(matrix) - blind :] = 0
    held = basis.T @ prior @ basis
    factor = cho_factor(information + held, lower=True)
    inverse = cho_solve(factor, cho_solve(factor, scattered + held).T)
    return np.asarray(basis @ inverse @ basis.T)


def _expectation(
    state: State, observations: Observations, weighting: Weighting, covariance: Float[np.ndarray, "k k"]
) -> Expectation:
    """What draws from the covariance make of the points."""
    count = len(state.points)
    some = np.unique(np.linspace(0, count - 1, min(count, MOST_POINTS)).astype(np.int64))
    point = np.repeat(np.arange(count), np.diff(observations.start))
    part, seen, _ = _select(state, observations, np.zeros((count, 3), np.uint8), np.isin(point, some))
    steps = np.column_stack([np.zeros(len(covariance)), steps_drawn(covariance)])
    places = substitute(part, seen, weighting, steps)
    return expectation_of(part.points, places[1:] - places[0])


def _known_posterior(state: State, observations: Observations, weighting: Weighting) -> _Posterior:
    """As :func:`_posterior`. Raises ReconstructionError where the observations do not determine every pose."""
    try:
        return _posterior(state, observations, weighting)
    except LinAlgError as error:
        raise ReconstructionError("adjustment: the tracks do not connect all frames; more overlap is needed") from error


def _adjusted_rig(state: State, prior: _Prior, covariance: Float[np.ndarray, "c n n"] | None) -> Rig:
    """The rig with the refined calibration and what is still uncertain of it; what was held stays as given."""
    if not prior.is_free:
        return prior.rig
    cameras = {}
    for index, name in enumerate(prior.rig.names):
        mounted = prior.camera_at(index, state.whitened[index])
        if covariance is None:
            cameras[name] = mounted
            continue
        if mounted.camera.covariance is not None:
            lens = slice(POSE, POSE + len(mounted.camera.parameters))
            camera = replace(mounted.camera, covariance=covariance[index, lens, lens])
            mounted = replace(mounted, camera=camera)
        if mounted.covariance is not None:
            mounted = replace(mounted, covariance=covariance[index, :6, :6])
        if not mounted.shutter.is_known:
            delay, readout = np.sqrt(np.diag(covariance[index])[-_SHUTTER:]).tolist()
            mounted = replace(
                mounted, shutter=replace(mounted.shutter, delay_sigma_frames=delay, readout_sigma=readout)
            )
        cameras[name] = mounted
    return Rig(cameras)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Adjusted:
    """What an adjustment finds."""

    rig: Rig
    refinement: Refinement | None
    expectation: Expectation | None
    poses: tuple[Rigid3, ...]
    tracks: Tracks
    pose_covariance: Float[np.ndarray, "f 6 6"] | None
    reprojection_rms_px: float
    notes: tuple[str, ...]
    log: Mapping[str, float | int]


def adjust(
    reconstruction: Reconstruction, options: AdjustmentOptions | None = None, *, covariance: bool = True
) -> Reconstruction:
    """Refine poses, points and free calibration together; the tracks are returned without outliers.

    The covariance of the poses is relative to the first frame; that of the calibration replaces its prior. Both assume
    that tracks are independent of each other, but not the keypoints within a track. Without ``covariance`` there is
    neither one nor a note on a calibration that does not fit, which saves half of the time. Raises ReconstructionError
    where the observations do not determine every pose.
    """
    poses = tuple(reconstruction.rig_from_world.values())
    times = _times(reconstruction.rig, reconstruction.frames)
    found = _minimize(
        reconstruction.rig,
        poses,
        reconstruction.tracks,
        options or AdjustmentOptions(),
        times=times,
        covariance=covariance,
    )
    return replace(
        reconstruction,
        rig=found.rig,
        refinement=found.refinement,
        expectation=found.expectation,
        rig_from_world=dict(zip(reconstruction.frames, found.poses, strict=True)),
        tracks=found.tracks,
        pose_covariance=found.pose_covariance,
        reprojection_rms_px=found.reprojection_rms_px,
        notes=(*reconstruction.notes, *found.notes),
        log={**reconstruction.log, **found.log},
    )


def adjust_model(model: SparseModel, options: AdjustmentOptions | None = None) -> SparseModel:
    """As :func:`adjust`, for one camera. Its images leave the scale free, so no covariance is computed, and the scale
    may change a little."""
    name = "camera"
    rig = Rig({name: MountedCamera(model.camera, Rigid3.identity())})
    poses = tuple(model.cam_from_world.values())
    found = _minimize(rig, poses, model.tracks, options or AdjustmentOptions(), covariance=False)
    return replace(
        model,
        camera=found.rig[name].camera,
        cam_from_world=dict(zip(model.frames, found.poses, strict=True)),
        tracks=found.tracks,
        reprojection_rms_px=found.reprojection_rms_px,
    )


def _minimize(
    rig: Rig,
    poses: Sequence[Rigid3],
    tracks: Tracks | None,
    options: AdjustmentOptions,
    *,
    times: Sequence[float] | None = None,
    covariance: bool,
) -> _Adjusted:
    """The adjustment itself; to be judged it needs a scale. ``times``: of the frames, where shutters matter."""
    if tracks is None or len(tracks.point_index) == 0:
        raise ReconstructionError("adjustment: no tracks to adjust; more texture or more overlap is needed")
    prior = _Prior.of(rig)
    observations, points = _sort_by_point(tracks, np.ones(len(tracks.point_index), dtype=bool))
    state, colors = _initial_state(poses, tracks.points[points], prior, times), tracks.colors[points]
    sigma_px, limit_px, steps = options.sigma_px, options.start_px, 0
    for _ in range(options.rounds):
        keep = _good(state, observations, limit_px, options.min_angle_deg)
        if not keep.any():
            raise ReconstructionError("adjustment: no consistent points are left; check the handpiece's calibration")
        state, observations, colors = _select(state, observations, colors, keep)
        weighting = Weighting(sigma_px, options.huber_sigmas, prior.is_free)
        minimum = _minimise_film(state, observations, weighting, prior, options, times)
        state, steps = minimum.state, steps + minimum.steps
        unknowns = state.points.size + POSE * (len(state.frame_rotation) - 1)
        sigma_px = _sigma_px(state, observations, weighting, unknowns)
        limit_px = options.outlier_sigmas * sigma_px
    posterior = _known_posterior(state, observations, weighting) if covariance else None
    misfits = _misfits(tracks, state, weighting, prior, options) if covariance else ()
    residuals = residual_vectors(state, observations)
    return _Adjusted(
        rig=_adjusted_rig(state, prior, None if posterior is None else posterior.calibration),
        refinement=None if posterior is None else _refinement(state, prior),
        expectation=None if posterior is None else posterior.expectation,
        poses=_poses(state),
        tracks=_as_tracks(state, observations, colors),
        pose_covariance=None if posterior is None else posterior.poses,
        reprojection_rms_px=float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)))),
        notes=(*_is_unconverged(minimum, options), *_implausible(state, prior), *misfits),
        log={
            "observation_sigma_px": sigma_px,
            "observations": len(residuals),
            "adjustment_steps": steps,
        },
    )


def _misfits(
    tracks: Tracks, found: State, weighting: Weighting, prior: _Prior, options: AdjustmentOptions
) -> tuple[str, ...]:
    """Whether the images fit what is held of the calibration: all that was matched, for of a camera that is far off
    everything is dropped."""
    observations, points = _sort_by_point(tracks, np.ones(len(tracks.point_index), dtype=bool))
    state = found._replace(points=tracks.points[points])
    for _ in range(2):
        state = _restore_in_front(refine_points(state, observations, weighting), state.points, observations)
        keep = _good(state, observations, options.start_px, options.min_angle_deg)
        state, observations, _ = _select(state, observations, np.zeros((len(state.points), 3), np.uint8), keep)
    return held_misfit(refine_points(state, observations, weighting), observations, weighting, prior.rig.names)


def _is_unconverged(minimum: _Minimum, options: AdjustmentOptions) -> tuple[str, ...]:
    """Whether the adjustment stopped before it had settled."""
    if minimum.decrease < options.tolerance:
        return ()
    return (
        f"adjustment: not converged after {minimum.steps} steps; poses and scale may be wrong: check the handpiece's "
        "calibration",
    )


def _refinement(state: State, prior: _Prior) -> Refinement | None:
    if not prior.is_free:
        return None
    costs, numbers = np.sum(state.whitened**2, axis=1), np.maximum(prior.free_numbers, 1)
    return Refinement(
        rms_sigmas=float(np.sqrt(costs.sum() / prior.free_numbers.sum())),
        camera_sigmas=dict(zip(prior.rig.names, np.sqrt(costs / numbers).tolist(), strict=True)),
    )


def _implausible(state: State, prior: _Prior) -> tuple[str, ...]:
    """Whether the refined calibration lies farther from the given one than its covariance allows."""
    cost, numbers = float(np.sum(state.whitened**2)), int(prior.free_numbers.sum())
    if numbers == 0 or cost <= chdtri(numbers, CHANCE):
        return ()
    camera = int(np.argmax(np.sum(state.whitened**2, axis=1)))
    return (
        f"calibration: the images move it {np.sqrt(cost / numbers):.1f} standard deviations (root mean square of "
        f"{numbers} numbers) away from the file, camera {prior.rig.names[camera]} the most; is this the file of this "
        "handpiece, and are its covariances large enough?",
    )
