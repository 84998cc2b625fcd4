"""Whether the images fit a calibration that is held fixed: a score test.

Parameters that are held fixed cannot follow the images, but the images pull at them. The pull is the gradient s of the
cost with respect to these parameters, once poses, points and the free part of the calibration have followed. If the
calibration is right, s has the covariance S that the gradients of independent tracks show (generalised score test:
Boos, The American Statistician 46, 1992); S is evaluated at the calibration that the images favour, because a wrong one
scatters the gradients too. No calibration is exact, and keypoints are slightly biased, so each parameter is allowed to
be off by what moves the images by some hundredths of a pixel. In such units, with H the curvature of the cost, s has
the covariance S + H H, and s^T (S + H H)^-1 s is chi-squared. What the images do not determine, such as the similarity
of the whole rig, is left out.

Everything is measured in pixels of the images themselves: neither the size of a handpiece nor its unit matters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

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
from cuspid.runtime.workers import computed_once

CHANCE = 1e-6
"""A calibration that would occur with less than this probability is rejected as not being that of the handpiece."""
_ALLOWED_PX = 0.03
"""How far each parameter that is held fixed may be off: one standard deviation, as RMS shift of the keypoints of its
camera."""
_GENEROUS = 50.0
"""Factor by which each parameter may go farther when determining what would be left."""
_OBSERVABLE = 1e-3
"""The images determine a direction of the parameters that is known to 1 / sqrt(this) of what is allowed."""


class ScoreTest(NamedTuple):
    """Score of the fixed parameters, with all others at their optimum."""

    score: Float[np.ndarray, "k"]
    curvature: Float[np.ndarray, "k k"]
    scatter: Float[np.ndarray, "k k"]

    @property
    def observable_basis(self) -> Float[np.ndarray, "k t"]:
        """Directions that the images determine."""
        values, vectors = np.linalg.eigh(self.curvature)
        return np.asarray(vectors[:, values > _OBSERVABLE])

    def one_step_estimate(self) -> tuple[Float[np.ndarray, "k"], float, int]:
        """The parameters that the images favour, how far away they are (chi-squared), and in how many directions."""
        basis = self.observable_basis
        covariance = basis.T @ (self.scatter + self.curvature @ self.curvature) @ basis
        weighed = basis @ np.linalg.solve(covariance, basis.T @ self.score)
        return -self.curvature @ weighed, float(self.score @ weighed), basis.shape[1]


@dataclass(frozen=True, eq=False)
class _Numbers:
    """The normal equations by poses, what is free of the calibration, and what is held of it."""

    raw_from_numbers: Float[np.ndarray, "n n"]
    """To poses and (motion on the left, parameters) of each camera."""
    held: Bool[np.ndarray, "n"]
    """Which of the unknowns are held; these are counted in units of what is allowed."""
    prior: Float[np.ndarray, "n n"]
    """Of what is free."""
    hessian: Float[np.ndarray, "n n"]
    gradient: Float[np.ndarray, "n"]

    @computed_once
    def _rest(self) -> Float[np.ndarray, "f f"]:
        """The lower Cholesky factor of the equations of what is free."""
        return np.asarray(cho_factor(self.hessian[np.ix_(~self.held, ~self.held)], lower=True)[0])

    @computed_once
    def _reduced_gradient(self) -> Float[np.ndarray, "k n"]:
        """What is left of a gradient for the held numbers once the rest has followed."""
        onto = np.zeros((np.count_nonzero(self.held), len(self.held)))
        following = cho_solve((self._rest, True), self.hessian[np.ix_(~self.held, self.held)])
        onto[:, self.held], onto[:, ~self.held] = np.eye(len(onto)), -following.T
        return onto

    def score_test(self, raw_scatter: Float[np.ndarray, "n n"]) -> ScoreTest:
        """With how the gradients of the tracks scatter."""
        onto, turn = self._reduced_gradient, self.raw_from_numbers
        scatter = turn.T @ raw_scatter @ turn + self.prior
        return ScoreTest(onto @ self.gradient, onto @ self.hessian @ onto.T, onto @ scatter @ onto.T)

    def raw_step(self) -> Float[np.ndarray, "n"]:
        """To where the images want all unknowns, the held ones within generous tolerances."""
        onto, step = self._reduced_gradient, np.zeros(len(self.held))
        generous = np.eye(len(onto)) / _GENEROUS**2
        step[self.held] = -np.linalg.solve(onto @ self.hessian @ onto.T + generous, onto @ self.gradient)
        step[~self.held] = -cho_solve((self._rest, True), self.gradient[~self.held])
        step[~self.held] += onto[:, ~self.held].T @ step[self.held]
        return self.raw_from_numbers @ step


def held_misfit(
    state: State, observations: Observations, weighting: Weighting, names: Sequence[str]
) -> tuple[str, ...]:
    """A note if the images hardly fit the part of the calibration of the cameras ``names`` that is held fixed.

    Poses, and the free part of the calibration, are as an adjustment left them.
    """
    held, tracks = _held_parameters(state), len(state.points)
    if not held.any():
        return ()
    raw, free = (
        state._replace(basis=np.tile(np.eye(state.basis.shape[1]), (len(names), 1, 1))),
        weighting._replace(calibrated=True),
    )
    numbers = _numbers(state, _curvature(raw, observations, free), observations, weighting, held)
    left = _apply_step(raw, observations, free, numbers.raw_step())
    test = numbers.score_test(scatter_of_tracks(left, observations, free))
    estimate, square, directions = test.one_step_estimate()
    if tracks <= directions or square * (1 - directions / tracks) <= chdtri(directions, CHANCE):
        return ()
    return (
        f"calibration: held fixed, but the images would move it {np.sqrt(square / directions):.1f} standard deviations "
        f"of {_ALLOWED_PX:g} px (root mean square of {directions} numbers) away from the file, camera "
        f"{_farthest(estimate, held, names)} the most; the reprojection error is "
        f"{_typical_px(state, observations):.2f} "
        f"px (median) where about {_typical_px(left, observations):.2f} px is expected. Is this the file of another "
        "handpiece, or of one built with errors? Calibrate the handpiece (cuspid calibrate), or let the calibration "
        "be refined, as it is for a file without covariances",
    )


def _held_parameters(state: State) -> Bool[np.ndarray, "c n"]:
    """Which numbers of each camera are held: all of its place, or all of its lens."""
    place, lens = (~state.basis[:, :, part].any(axis=(1, 2)) for part in (slice(POSE), slice(POSE, None)))
    return np.repeat(np.stack([place, lens], axis=1), [POSE, state.basis.shape[1] - POSE], axis=1)


def _curvature(raw: State, observations: Observations, weighting: Weighting) -> System:
    """What the images alone tell of poses and raw numbers: the normal equations without a prior, with the curvature of
    a robust cost."""
    _, slope = influence(raw, observations, weighting)
    whole = normal_equations(raw, observations, weighting._replace(huber_sigmas=np.inf))
    gradient = normal_equations(raw._replace(whitened=0 * raw.whitened), observations, weighting).gradient
    of_prior = np.arange(len(gradient) - raw.whitened.size, len(gradient))
    whole.matrix[of_prior, of_prior] -= 1
    whole.diagonal[of_prior] -= 1
    return System(slope * (np.tril(whole.matrix) + np.tril(whole.matrix, -1).T), gradient, whole.diagonal)


def _numbers(
    state: State, system: System, observations: Observations, weighting: Weighting, held: Bool[np.ndarray, "c n"]
) -> _Numbers:
    """What is free of the calibration is counted in standard deviations of its prior, what is held in what is allowed:
    units that move the images by so much."""
    poses, free = len(system.gradient) - held.size, ~held.ravel()
    counts = np.maximum(np.bincount(observations.camera, minlength=len(held)), 1)
    per_unit_px = weighting.sigma_px * np.sqrt(system.diagonal[poses:].reshape(held.shape) / counts[:, None])
    units = np.where(held & (per_unit_px > 0), _ALLOWED_PX / np.maximum(per_unit_px, 1e-300), 0.0)
    turn = block_diag(np.eye(poses), *(basis + np.diag(unit) for basis, unit in zip(state.basis, units, strict=True)))
    prior = np.concatenate([np.zeros(poses), free])
    return _Numbers(
        raw_from_numbers=turn,
        held=np.concatenate([np.zeros(poses, dtype=bool), ~free]),
        prior=np.diag(prior),
        hessian=turn.T @ system.matrix @ turn + np.diag(prior),
        gradient=turn.T @ system.gradient + prior * np.concatenate([np.zeros(poses), state.whitened.ravel()]),
    )


def _farthest(estimate: Float[np.ndarray, "k"], held: Bool[np.ndarray, "c n"], names: Sequence[str]) -> str:
    """The camera whose numbers have the largest sum of squares."""
    squares = np.zeros(held.shape)
    squares[held] = estimate**2
    return names[int(np.argmax(squares.sum(axis=1)))]


def _apply_step(raw: State, observations: Observations, weighting: Weighting, step: Float[np.ndarray, "n"]) -> State:
    """The state after a step of poses, motions and parameters of the cameras, with the points where rays then meet."""
    poses = len(step) - raw.whitened.size
    numbers = step[poses:].reshape(raw.whitened.shape)
    turns = Rotation.from_rotvec(numbers[:, :3]).as_matrix()
    moved = move_poses(raw, step[:poses])._replace(
        camera_rotation=turns @ raw.camera_rotation,
        camera_translation=np.einsum("cij,cj->ci", turns, raw.camera_translation) + numbers[:, 3:POSE],
        intrinsics=raw.intrinsics + numbers[:, POSE : POSE + raw.intrinsics.shape[1]],
        points=substitute(raw, observations, weighting, step[:, None])[0],
    )
    return refine_points(moved, observations, weighting)


def _typical_px(state: State, observations: Observations) -> float:
    """Median length of the residuals of points before their cameras; wrong matches are among them."""
    return float(np.nanmedian(np.linalg.norm(residual_vectors(state, observations), axis=1)))
