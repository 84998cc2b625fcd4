"""Bundle adjustment: derivatives, and closed loops on synthetic scenes with a known truth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from bundle_scenes import (
    EXTRINSIC_SIGMA,
    PARAMETER_SIGMA,
    SIGMA_PX,
    Scene,
    disturbed,
    make_camera,
    make_path,
    make_rig,
    make_scene,
    pose_errors,
)
from cuspid.geometry import Rigid3
from cuspid.geometry.cameras import LENSES, MODELS
from cuspid.model.reconstruction import Reconstruction, select_tracks
from cuspid.model.rig import Rig
from cuspid.model.shutter import Shutter
from cuspid.motion.bundle import adjustment, gauge, normal_equations
from cuspid.motion.bundle.adjustment import AdjustmentOptions, adjust, left_jacobian
from cuspid.motion.bundle.expectation import covariance_factor
from cuspid.runtime.errors import ReconstructionError


def poses_of(scene: Reconstruction) -> tuple[Rigid3, ...]:
    return tuple(scene.rig_from_world.values())


def normalised_squares(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis lengths."""
    return np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])


def with_priors(rig: Rig) -> Rig:
    """The rig with a covariance on every camera."""
    return Rig(
        {
            name: replace(
                mounted,
                camera=replace(mounted.camera, covariance=np.diag(PARAMETER_SIGMA**2)),
                covariance=np.diag(EXTRINSIC_SIGMA**2),
            )
            for name, mounted in rig.cameras.items()
        }
    )


def calibration_errors(found: Rig, truth: Rig) -> tuple[np.ndarray, np.ndarray]:
    """(cameras, 6) motion on the left from the true extrinsics and (cameras, 8) difference of the parameters."""
    pairs = [(found[name], truth[name]) for name in truth.names]
    motions = [f.cam_from_rig @ t.cam_from_rig.inverse() for f, t in pairs]
    return (
        np.array([[*motion.rotation_vector, *motion.translation] for motion in motions]),
        np.array([f.camera.parameters - t.camera.parameters for f, t in pairs]),
    )


def drawn_from_priors(rig: Rig, rng: np.random.Generator) -> Rig:
    """A rig as the priors allow it to be."""
    cameras = {}
    for name, mounted in rig.cameras.items():
        motion = rng.normal(0, EXTRINSIC_SIGMA)
        camera = mounted.camera.with_parameters(mounted.camera.parameters + rng.normal(0, PARAMETER_SIGMA))
        pose = Rigid3.from_rotation_vector(motion[:3], motion[3:]) @ mounted.cam_from_rig
        cameras[name] = replace(mounted, camera=camera, cam_from_rig=pose)
    return Rig(cameras)


# --- derivatives -------------------------------------------------------------------------------------------------


def linearised(state, frame, camera, point):
    """Pixel and Jacobian of one observation."""
    pixel, jacobian = np.zeros(2), np.zeros((2, 9 + state.basis.shape[1]))
    assert normal_equations.linearise(
        state, point, frame, camera, 100.0, True, normal_equations.make_scratch(state), pixel, jacobian
    )
    return pixel, jacobian


def with_other_lenses(rig: Rig, rng: np.random.Generator) -> Rig:
    """The rig with a model of its own for each camera."""
    cameras = {}
    for model, (name, mounted) in zip(LENSES, rig.cameras.items(), strict=False):
        count = len(MODELS[model].names)
        lens = rng.normal(0, 0.02, count)
        sigma = np.concatenate([PARAMETER_SIGMA[:4], np.full(count, 1e-3)])
        camera = replace(mounted.camera, model=model, distortion=lens, covariance=np.diag(sigma**2))
        cameras[name] = replace(mounted, camera=camera)
    return Rig(cameras)


@pytest.mark.long
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), mixed=st.booleans(), rolling=st.booleans())
def test_jacobian_agrees_with_finite_differences(seed: int, mixed: bool, rolling: bool) -> None:
    """By point, pose, extrinsics, intrinsics and shutter, with distortion, away from the prior."""
    rng = np.random.default_rng(seed)
    rig = with_priors(make_rig())
    rig = with_other_lenses(rig, rng) if mixed else rig
    shutter = Shutter(delay_frames=0.2, delay_sigma_frames=0.01, readout=0.7, readout_sigma=0.02)
    rig = Rig({name: replace(each, shutter=shutter) for name, each in rig.cameras.items()}) if rolling else rig
    prior = adjustment._Prior.of(rig)
    assert prior.numbers == 6 + max(len(each.camera.parameters) for each in rig.cameras.values()) + 2 * rolling
    scene = Reconstruction(rig=rig, rig_from_world=make_path(2))
    point = np.array([*rng.uniform(-1, 1, 2), rng.uniform(4, 6)])
    whitened = 10 * rng.normal(size=(len(rig.names), prior.numbers))
    start = adjustment._with_calibration(
        adjustment._initial_state(poses_of(scene), point[None], prior, (0.0, 1.0)), prior, whitened
    )
    assert start.motions.any()
    camera = int(rng.integers(4))
    nothing = normal_equations.Observations(
        np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(2, np.int64)
    )
    weighting = normal_equations.Weighting(1.0, 2.0, True)

    def pixel_after(step: np.ndarray) -> np.ndarray:
        unknowns = np.zeros(6 + whitened.size)
        unknowns[:6] = step[3:9]
        unknowns[6 + prior.numbers * camera : 6 + prior.numbers * (camera + 1)] = step[9:]
        moved = adjustment._apply_step(start, nothing, weighting, prior, unknowns)
        return linearised(moved._replace(points=start.points + step[:3]), 1, camera, 0)[0]

    _, jacobian = linearised(start, 1, camera, 0)
    width = 1e-5
    steps = width * np.eye(9 + prior.numbers)
    numeric = np.stack([(pixel_after(step) - pixel_after(-step)) / (2 * width) for step in steps], axis=1)
    np.testing.assert_allclose(jacobian, numeric, atol=2e-5, rtol=1e-6)


@given(
    vector=st.lists(st.floats(-2, 2), min_size=3, max_size=3), step=st.lists(st.floats(-1, 1), min_size=3, max_size=3)
)
def test_left_jacobian_composes_rotations(vector: list[float], step: list[float]) -> None:
    """exp(w + dw) = exp(J dw) exp(w) to first order."""
    start, change, zero = np.array(vector), 1e-6 * np.array(step), np.zeros(3)
    direct = Rigid3.from_rotation_vector(start + change, zero)
    composed = Rigid3.from_rotation_vector(left_jacobian(start) @ change, zero) @ Rigid3.from_rotation_vector(
        start, zero
    )
    np.testing.assert_allclose(direct.rotation, composed.rotation, atol=1e-11)


@given(rank=st.integers(0, 6), seed=st.integers(0, 1000))
def test_covariance_factor_squares_to_the_covariance(rank: int, seed: int) -> None:
    """Also where the covariance is singular."""
    root = np.random.default_rng(seed).normal(size=(6, rank)) * EXTRINSIC_SIGMA[:, None]
    factor = covariance_factor(root @ root.T, 6)
    np.testing.assert_allclose(factor @ factor.T, root @ root.T, atol=1e-12)


def test_eliminated_points_leave_the_schur_complement() -> None:
    """Of the equations of all unknowns at once, H - W V^-1 W^T, with the residuals and derivatives of each pixel."""
    state, observations, _ = disturbed_state(3, with_priors(make_rig()))
    frames, width = len(state.frame_rotation), state.basis.shape[1]
    size, points = 6 * (frames - 1) + state.whitened.size, len(state.points)
    rows, residuals = (
        np.zeros((len(observations.pixels), 2, size + 3 * points)),
        np.zeros((len(observations.pixels), 2)),
    )
    for o, point in enumerate(np.repeat(np.arange(points), np.diff(observations.start))):
        frame, camera = observations.frame[o], observations.camera[o]
        pixel, jacobian = linearised(state, frame, camera, point)
        at = 6 * (frames - 1) + width * camera
        rows[o, :, size + 3 * point :][:, :3], rows[o, :, at : at + width] = jacobian[:, :3], jacobian[:, 9:]
        if frame:
            rows[o, :, 6 * (frame - 1) : 6 * frame] = jacobian[:, 3:9]
        residuals[o] = pixel - observations.pixels[o]
    prior = np.concatenate([np.zeros(6 * (frames - 1)), np.ones(state.whitened.size)])
    whole = np.einsum("oki,okj->ij", rows, rows) / SIGMA_PX**2
    side = np.einsum("oki,ok->i", rows, residuals) / SIGMA_PX**2
    whole[range(size), range(size)] += prior
    side[:size] += prior * np.concatenate([np.zeros(6 * (frames - 1)), state.whitened.ravel()])
    coupling, among = whole[:size, size:], whole[size:, size:]
    schur = whole[:size, :size] - coupling @ np.linalg.solve(among, coupling.T)
    found = normal_equations.normal_equations(
        state, observations, normal_equations.Weighting(SIGMA_PX, np.inf, calibrated=True)
    )
    np.testing.assert_allclose(np.tril(found.matrix), np.tril(schur), rtol=1e-6, atol=1e-8 * np.abs(schur).max())
    reduced = side[:size] - coupling @ np.linalg.solve(among, side[size:])
    np.testing.assert_allclose(found.gradient, reduced, rtol=1e-6, atol=1e-8 * np.abs(reduced).max())
    np.testing.assert_allclose(found.diagonal, np.diag(whole)[:size], rtol=1e-9)


# --- the gauge of a free calibration -----------------------------------------------------------------------------


def disturbed_state(seed: int, rig: Rig) -> tuple[normal_equations.State, normal_equations.Observations, object]:
    """A state away from the prior, with its observations."""
    rng, prior = np.random.default_rng(seed), adjustment._Prior.of(rig)
    scene = disturbed(make_scene(frames=3, points=40), rng, rig=rig)
    every = np.ones(len(scene.tracks.point_index), dtype=bool)
    observations, points = adjustment._sort_by_point(scene.tracks, every)
    start = adjustment._initial_state(poses_of(scene), scene.tracks.points[points], prior)
    whitened = rng.normal(size=start.whitened.shape)
    return adjustment._with_calibration(start, prior, whitened), observations, prior


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    step=st.lists(st.floats(-0.3, 0.3), min_size=7, max_size=7),
)
def test_no_image_sees_a_gauge(seed: int, step: list[float]) -> None:
    """Residuals stay, and so does the first pose; what changes is the prior's cost alone."""
    state, observations, prior = disturbed_state(seed, with_priors(make_rig()))
    change = gauge.Gauge.of(np.array(step))
    whitened = state.whitened.copy()
    whitened[:, : gauge.PLACE] = prior.whitened_places(*gauge.transform_mounts(state, change))
    moved = adjustment._with_calibration(gauge.transform_world(state, change), prior, whitened)
    residuals = normal_equations.residual_vectors(state, observations)
    np.testing.assert_allclose(normal_equations.residual_vectors(moved, observations), residuals, atol=1e-7)
    np.testing.assert_allclose(moved.frame_translation[0], state.frame_translation[0], atol=1e-10)
    np.testing.assert_allclose(moved.frame_rotation[0], state.frame_rotation[0], atol=1e-10)


def test_many_gauges_leave_the_poses_rotations() -> None:
    """Rounding grew threefold in each; after some thirty an adjustment came to nothing."""
    state, observations, _ = disturbed_state(0, with_priors(make_rig()))
    residuals, world = normal_equations.residual_vectors(state, observations), state
    for _ in range(20):
        for sign in (1, -1):
            change = gauge.Gauge.of(sign * np.array([0.1, 0.2, -0.1, 0.0, 0.0, 0.0, 0.0]))
            world = gauge.transform_world(world, change)
    squares = world.frame_rotation @ np.swapaxes(world.frame_rotation, 1, 2)
    np.testing.assert_allclose(squares, np.broadcast_to(np.eye(3), squares.shape), atol=1e-12)
    np.testing.assert_allclose(normal_equations.residual_vectors(world, observations), residuals, atol=1e-7)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_no_small_gauge_lessens_the_cost_of_the_best(seed: int) -> None:
    """Stationary in all seven directions, and no worse than where it began."""
    state, _, prior = disturbed_state(seed, with_priors(make_rig()))
    best = adjustment._apply_best_gauge(state, prior)

    def cost(step: np.ndarray) -> float:
        places = prior.whitened_places(*gauge.transform_mounts(best, gauge.Gauge.of(step)))
        return float(np.sum(places**2))

    here = cost(np.zeros(7))
    assert here < np.sum(state.whitened[:, : gauge.PLACE] ** 2)
    for step in 1e-3 * np.eye(7):
        assert min(cost(step), cost(-step)) > here


def test_a_gauge_moves_nothing_that_is_held() -> None:
    """With one camera's place held only the scale about that camera is left; with all, nothing."""
    rig = with_priors(make_rig())
    held = Rig({**rig.cameras, "c0": replace(rig["c0"], covariance=None)})
    state, _, _ = disturbed_state(0, held)
    change = gauge.best_gauge(state)
    np.testing.assert_allclose(change.turn, np.eye(3), atol=1e-9)
    assert abs(change.scale - 1) > 1e-4
    rotation, translation = gauge.transform_mounts(state, change)
    np.testing.assert_allclose(rotation[0], state.camera_rotation[0], atol=1e-9)
    np.testing.assert_allclose(translation[0], state.camera_translation[0], atol=1e-4)
    fixed = Rig({name: replace(mounted, covariance=None) for name, mounted in rig.cameras.items()})
    change = gauge.best_gauge(disturbed_state(0, fixed)[0])
    assert change.scale == 1.0
    assert not change.shift.any()


# --- closed loops ------------------------------------------------------------------------------------------------


def test_the_last_vectors_of_a_gauge_basis_are_what_no_image_sees() -> None:
    rig = with_priors(make_rig())
    held = Rig({**rig.cameras, "c0": replace(rig["c0"], covariance=None)})
    fixed = Rig({name: replace(mounted, covariance=None) for name, mounted in rig.cameras.items()})
    for each, blind in ((rig, 7), (held, 1), (fixed, 0)):
        state, observations, prior = disturbed_state(0, each)
        basis, count = gauge.gauge_basis(state)
        assert count == blind
        assert np.linalg.cond(basis) < 1e6
        hidden = basis[:, len(basis) - count :].T
        assert all(seen_change(state, observations, prior, step) < 1e-4 for step in hidden)
        if each is rig:
            assert min(seen_change(state, observations, prior, step) for step in basis[:, :-count].T) > 1e-2


def seen_change(state, observations, prior, step: np.ndarray) -> float:
    """How much the images change, px per unit of a step, once the points have followed it."""
    weighting, change = normal_equations.Weighting(1.0, np.inf, True), []
    poses = 6 * (len(state.frame_rotation) - 1)
    for sign in (1, -1):
        moved = normal_equations.move_poses(state, sign * 1e-5 * step[:poses])
        whitened = state.whitened + sign * 1e-5 * step[poses:].reshape(state.whitened.shape)
        moved = adjustment._with_calibration(moved, prior, whitened)
        settled = normal_equations.refine_points(moved, observations, weighting)
        change.append(normal_equations.residual_vectors(settled, observations))
    return float(np.abs(change[0] - change[1]).max() / 2e-5)


@pytest.mark.parametrize("calibrated", [False, True])
def test_points_follow_each_of_many_steps_as_that_step_alone_and_in_proportion(calibrated: bool) -> None:
    state, observations, _ = disturbed_state(5, with_priors(make_rig()))
    weighting = normal_equations.Weighting(1.0, 2.0, calibrated)
    size = 6 * (len(state.frame_rotation) - 1) + calibrated * 14 * len(state.camera_rotation)
    one, other = np.random.default_rng(6).normal(0, 1e-3, (2, size))
    steps = np.column_stack([np.zeros(size), one, other, one + 2 * other])
    places = normal_equations.substitute(state, observations, weighting, steps)
    for step, there in zip(steps.T, places, strict=True):
        alone = normal_equations.substitute(state, observations, weighting, step[:, None])
        np.testing.assert_allclose(there, alone[0], rtol=0, atol=1e-12)
    by_one, by_other, by_both = places[1:] - places[0]
    np.testing.assert_allclose(by_both, by_one + 2 * by_other, rtol=0, atol=1e-10)
    assert min(np.abs(each).mean() for each in (by_one, by_other)) > 1e-4


@pytest.mark.long
@pytest.mark.parametrize("sigma_px", [1e-3, 1e-6])
def test_sharp_images_do_not_drown_what_the_prior_alone_knows(sigma_px: float) -> None:
    """Of the scale; rounding in what the images tell made it some ten times as uncertain for an arch."""
    rig = with_priors(make_rig())
    scene = make_scene(rig=rig, points=120)
    observations, points = adjustment._sort_by_point(scene.tracks, np.ones(len(scene.tracks.pixels), dtype=bool))
    state = adjustment._initial_state(poses_of(scene), scene.tracks.points[points], adjustment._Prior.of(rig))
    expected = [
        adjustment._posterior(state, observations, normal_equations.Weighting(sigma, np.inf, True)).expectation
        for sigma in (0.1, sigma_px)
    ]
    assert expected[1].scale_sigma_ppm == pytest.approx(expected[0].scale_sigma_ppm, rel=0.25)


def test_a_point_behind_a_camera_holds_up_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its rays hardly meet, so that a small step may throw it there; then no step at all could be taken."""
    state, observations, prior = disturbed_state(0, make_rig())
    weighting = normal_equations.Weighting(0.1, np.inf, True)
    nothing = np.zeros(6 * (len(state.frame_rotation) - 1) + state.whitened.size)
    thrown = state.points + 0.01
    thrown[[3, 7]] *= -1
    monkeypatch.setattr(adjustment, "refine_points", lambda moved, *_: moved._replace(points=thrown))
    found = adjustment._apply_step(state, observations, weighting, prior, nothing)
    assert np.flatnonzero(np.any(found.points != thrown, axis=1)).tolist() == [3, 7]
    np.testing.assert_array_equal(found.points[[3, 7]], state.points[[3, 7]])
    assert np.isfinite(adjustment._cost(found, observations, weighting))
    assert np.isinf(adjustment._cost(found._replace(points=thrown), observations, weighting))


def test_perfect_observations_give_the_truth() -> None:
    """Without noise the truth is the minimum, and it is found from a rough start."""
    scene = make_scene()
    start = disturbed(scene, np.random.default_rng(0))
    found = adjust(replace(start, tracks=replace(start.tracks, pixels=scene.tracks.pixels)))
    assert np.abs(pose_errors(found, scene.rig_from_world)).max() < 1e-6
    assert len(found.tracks.pixels) == len(scene.tracks.pixels)


@pytest.mark.long
def test_poses_are_as_uncertain_as_their_covariance_says() -> None:
    """Mean normalised error squared (NEES) over seeds is that of chi-square with six degrees of freedom."""
    scene = make_scene(points=150)
    squares = []
    for seed in range(12):
        found = adjust(disturbed(scene, np.random.default_rng(seed)))
        errors = pose_errors(found, scene.rig_from_world)
        assert not errors[0].any()
        squares.append(normalised_squares(errors[1:], found.pose_covariance[1:]))
        assert found.log["observation_sigma_px"] == pytest.approx(SIGMA_PX, rel=0.05)
        assert found.reprojection_rms_px < 2 * SIGMA_PX
    assert 4.6 < np.mean(squares) < 7.6


@pytest.mark.long
def test_errors_that_hang_together_within_a_track_are_accounted_for() -> None:
    """A keypoint slides over the surface from frame to frame, in all cameras alike: a walk for each point."""
    scene = make_scene(frames=8, points=300)
    tracks, squares, ignored = scene.tracks, [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        start = disturbed(scene, rng)
        walks = np.cumsum(rng.normal(0, 0.4, (len(tracks.points), 8, 2)), axis=1)
        pixels = start.tracks.pixels + walks[tracks.point_index, tracks.frame_index]
        found = adjust(replace(start, tracks=replace(start.tracks, pixels=pixels)))
        errors = pose_errors(found, scene.rig_from_world)[1:]
        squares.append(normalised_squares(errors, found.pose_covariance[1:]))
        ignored.append(normalised_squares(errors, independent(found)[1:]))
    assert 4.5 < np.mean(squares) < 8.0
    assert np.mean(ignored) > 10


def independent(found: Reconstruction) -> np.ndarray:
    """Covariance of the poses if every keypoint had an error of its own."""
    prior = adjustment._Prior.of(found.rig)
    observations, points = adjustment._sort_by_point(found.tracks, np.ones(len(found.tracks.pixels), dtype=bool))
    state = adjustment._initial_state(poses_of(found), found.tracks.points[points], prior)
    weighting = normal_equations.Weighting(found.log["observation_sigma_px"], np.inf, False)
    inverse = np.linalg.inv(lower_to_full(normal_equations.normal_equations(state, observations, weighting).matrix))
    blocks = [inverse[k : k + 6, k : k + 6] for k in range(0, len(inverse), 6)]
    return np.stack([np.zeros((6, 6)), *blocks])


def lower_to_full(matrix: np.ndarray) -> np.ndarray:
    return np.tril(matrix) + np.tril(matrix, -1).T


def size_of(points: np.ndarray) -> float:
    """Root mean square distance from their middle."""
    return float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))))


def as_the_motion_has_it(found: Reconstruction, scene: Scene) -> np.ndarray:
    """Where the true points come to lie when they are seen without error from the poses and cameras that were found."""
    observations, points = adjustment._sort_by_point(scene.tracks, np.ones(len(scene.tracks.pixels), dtype=bool))
    state = adjustment._initial_state(poses_of(found), scene.tracks.points[points], adjustment._Prior.of(found.rig))
    return normal_equations.refine_points(state, observations, normal_equations.Weighting(1.0, np.inf, False)).points


@pytest.mark.long
@pytest.mark.parametrize("free", [False, True])
def test_the_surface_is_as_uncertain_as_is_expected(free: bool) -> None:
    nominal = with_priors(make_rig()) if free else make_rig()
    squares, scales, spans = [], [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        rig = drawn_from_priors(nominal, rng) if free else nominal
        scene = make_scene(rig=rig, points=120)
        found = adjust(disturbed(scene, rng, rig=nominal))
        expected, true, ours = found.expectation, scene.tracks.points, as_the_motion_has_it(found, scene)
        squares.append(np.mean(np.sum((fitted(ours, true) - true) ** 2, axis=1)))
        squares[-1] /= np.einsum("nii->n", expected.covariance).mean()
        scales.append(1e6 * (size_of(ours) / size_of(true) - 1) / expected.scale_sigma_ppm)
        assert 8 < expected.span_mm < 10
        along = np.argsort(true @ np.linalg.svd(true - true.mean(axis=0))[2][0])
        lengths = [
            np.linalg.norm(np.subtract(*(each[ends].mean(axis=0) for ends in (along[:5], along[-5:]))))
            for each in (ours, true)
        ]
        spans.append(1000 * (lengths[0] - lengths[1]) / expected.span_sigma_um)
    assert (0.15 if free else 0.5) < np.mean(squares) < 2.0  # of a free calibration one number decides, the scale
    assert 0.5 < np.sqrt(np.mean(np.square(scales))) < 1.7
    assert 0.5 < np.sqrt(np.mean(np.square(spans))) < 1.7


def fitted(points: np.ndarray, onto: np.ndarray) -> np.ndarray:
    """After the best rigid motion."""
    turn, _ = Rotation.align_vectors(onto - onto.mean(axis=0), points - points.mean(axis=0))
    return turn.apply(points - points.mean(axis=0)) + onto.mean(axis=0)


@pytest.mark.long
def test_calibration_is_as_uncertain_as_its_covariance_says() -> None:
    """Truth drawn from the priors: poses, extrinsics and intrinsics are recovered within their covariance."""
    nominal = with_priors(make_rig())
    poses, extrinsics, parameters, before, after = [], [], [], [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        scene = make_scene(rig=drawn_from_priors(nominal, rng), points=100)
        found = adjust(disturbed(scene, rng, rig=nominal))
        motions, shifts = calibration_errors(found.rig, scene.rig)
        mounted = list(found.rig.cameras.values())
        extrinsics.append(normalised_squares(motions, np.stack([m.covariance for m in mounted])))
        parameters.append(normalised_squares(shifts, np.stack([m.camera.covariance for m in mounted])))
        errors = pose_errors(found, scene.rig_from_world)
        poses.append(normalised_squares(errors[1:], found.pose_covariance[1:]))
        before.append(calibration_errors(nominal, scene.rig)[1])
        after.append(shifts)
        assert found.refinement.rms_sigmas < 1.3
        assert set(found.refinement.camera_sigmas) == set(nominal.names)
    assert 4.5 < np.mean(poses) < 7.8
    assert 4.8 < np.mean(extrinsics) < 7.4
    assert 6.6 < np.mean(parameters) < 9.6
    assert np.std(after, axis=(0, 1))[4] < 0.5 * np.std(before, axis=(0, 1))[4]


@pytest.mark.long
@pytest.mark.parametrize("size", [0.97, 1.03])
def test_the_start_does_not_decide_the_scale(size: float) -> None:
    """Only the prior knows the scale of a free rig; the size of poses and points at the start is no news."""
    nominal = with_priors(make_rig())
    rng = np.random.default_rng(4)
    start = disturbed(make_scene(rig=drawn_from_priors(nominal, rng), frames=12, points=200), rng, rig=nominal)
    resized = replace(
        start,
        rig_from_world={n: Rigid3(p.rotation, size * p.translation) for n, p in start.rig_from_world.items()},
        tracks=replace(start.tracks, points=size * start.tracks.points),
    )
    options = AdjustmentOptions(start_px=1e6)
    one, other = adjust(start, options), adjust(resized, options)
    assert not one.notes
    for name, pose in one.rig_from_world.items():
        np.testing.assert_allclose(other.rig_from_world[name].matrix, pose.matrix, atol=2e-5)


def test_a_search_that_ends_too_soon_says_so() -> None:
    nominal = with_priors(make_rig())
    rng = np.random.default_rng(2)
    start = disturbed(make_scene(rig=drawn_from_priors(nominal, rng), points=150), rng, rig=nominal)
    assert any("not converged" in note for note in adjust(start, AdjustmentOptions(rounds=1, iterations=1)).notes)
    assert not adjust(start).notes


def test_a_calibration_of_another_handpiece_is_told() -> None:
    """The truth lies far from the file for its covariance; the worst camera is named."""
    nominal = with_priors(make_rig())
    moved = Rigid3.from_rotation_vector(np.zeros(3), np.array([0.0, 0.6, 0.0])) @ nominal["c4"].cam_from_rig
    truth = Rig({**nominal.cameras, "c4": replace(nominal["c4"], cam_from_rig=moved)})
    rng = np.random.default_rng(3)
    found = adjust(disturbed(make_scene(rig=truth, points=150), rng, rig=nominal), AdjustmentOptions(start_px=200.0))
    assert len(found.notes) == 1
    assert "camera c4" in found.notes[0]


def test_calibration_without_prior_is_held() -> None:
    """Only the focal length of one camera is free; all else comes back as given."""
    scene = make_scene()
    focal = replace(make_camera(), covariance=np.diag([4.0, 4, 0, 0, 0, 0, 0, 0]))
    nominal = Rig(
        {
            **scene.rig.cameras,
            "c1": replace(
                scene.rig["c1"], camera=focal.with_parameters(focal.parameters + np.array([2.0, -1, 0, 0, 0, 0, 0, 0]))
            ),
        }
    )
    adjusted = adjust(disturbed(scene, np.random.default_rng(3), rig=nominal))
    found, refinement = adjusted.rig, adjusted.refinement
    _, shifts = calibration_errors(found, scene.rig)
    assert 0 < np.abs(shifts[1, :2]).max() < 1
    shifts[1, :2] = 0
    assert not shifts.any()
    np.testing.assert_array_equal(found["c0"].cam_from_rig.matrix, scene.rig["c0"].cam_from_rig.matrix)
    assert found["c0"].covariance is None
    assert refinement.camera_sigmas["c0"] == 0 < refinement.camera_sigmas["c1"]
    assert 0 < found["c1"].camera.covariance[0, 0] < 1


def test_outliers_are_rejected() -> None:
    """A tenth of the observations is wrong; they go, the rest stays and the poses do not notice."""
    scene, rng = make_scene(), np.random.default_rng(5)
    start = disturbed(scene, rng)
    wrong = rng.random(len(start.tracks.pixels)) < 0.1
    pixels = start.tracks.pixels + wrong[:, None] * rng.choice([-1, 1], (len(wrong), 2)) * rng.uniform(
        5, 60, (len(wrong), 2)
    )
    found = adjust(replace(start, tracks=replace(start.tracks, pixels=pixels)))
    kept = {tuple(pixel) for pixel in found.tracks.pixels}
    survived = np.array([tuple(pixel) in kept for pixel in pixels])
    assert survived[wrong].mean() < 0.02
    assert survived[~wrong].mean() > 0.97
    squares = normalised_squares(pose_errors(found, scene.rig_from_world)[1:], found.pose_covariance[1:])
    assert np.mean(squares) < 20


def test_result_does_not_depend_on_the_gauge() -> None:
    """Moving the whole start by a rigid motion moves the result by it and leaves the rest."""
    scene = make_scene()
    start = disturbed(scene, np.random.default_rng(7))
    new_from_old = Rigid3.from_rotation_vector(np.array([0.5, -1.0, 0.3]), np.array([10.0, -20, 5]))
    moved = replace(
        start,
        rig_from_world={n: p @ new_from_old.inverse() for n, p in start.rig_from_world.items()},
        tracks=replace(start.tracks, points=new_from_old.apply(start.tracks.points)),
    )
    one, other = adjust(start), adjust(moved)
    for name, pose in one.rig_from_world.items():
        np.testing.assert_allclose((other.rig_from_world[name] @ new_from_old).matrix, pose.matrix, atol=2e-6)
    np.testing.assert_allclose(other.pose_covariance, one.pose_covariance, rtol=1e-3, atol=1e-12)
    assert other.reprojection_rms_px == pytest.approx(one.reprojection_rms_px, rel=1e-6)


def test_result_is_repeatable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit, for the sums have a fixed order; in threads and, of few points, without them."""
    start = disturbed(make_scene(), np.random.default_rng(8))
    alone = adjust(start)
    monkeypatch.setattr(normal_equations, "_FEW", 0)
    for found in (adjust(start), adjust(start)):
        np.testing.assert_array_equal(found.tracks.points, alone.tracks.points)


def test_a_frame_without_observations_is_an_error() -> None:
    """Not a singular matrix."""
    start = disturbed(make_scene(), np.random.default_rng(9))
    kept = start.tracks.frame_index != 3
    names = ("point_index", "frame_index", "camera_index", "pixels")
    tracks = replace(start.tracks, **{name: getattr(start.tracks, name)[kept] for name in names})
    with pytest.raises(ReconstructionError, match="overlap"):
        adjust(replace(start, tracks=tracks), AdjustmentOptions(rounds=1))


# --- an oracle ---------------------------------------------------------------------------------------------------


def moved(motions: np.ndarray, rotations: np.ndarray, translations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses after small motions on the left (rotation vector, translation)."""
    turns = Rotation.from_rotvec(motions[:, :3]).as_matrix()
    return turns @ rotations, np.einsum("nij,nj->ni", turns, translations) + motions[:, 3:]


def by_general_least_squares(given: Reconstruction, sigma_px: float, knee: float) -> tuple[np.ndarray, ...]:
    """What the adjustment is to find, the least sum of Huber's losses and of the prior's: rotations and translations of
    the frames, points, and calibrations in standard deviations. By a solver that knows no points and poses, with
    differences for derivatives and OpenCV's projection."""
    tracks, mounted = given.tracks, list(given.rig.cameras.values())
    assert tracks is not None
    frame, camera, point = tracks.frame_index, tracks.camera_index, tracks.point_index
    poses = np.stack([pose.matrix for pose in poses_of(given)])
    places = np.stack([each.cam_from_rig.matrix for each in mounted])
    parameters = np.stack([each.camera.parameters for each in mounted])
    sizes = np.cumsum([6 * (len(poses) - 1), tracks.points.size])

    def unpacked(x: np.ndarray) -> tuple[np.ndarray, ...]:
        steps, points, whitened = np.split(x, sizes)
        motions = np.concatenate([np.zeros((1, 6)), steps.reshape(-1, 6)])
        return *moved(motions, poses[:, :3, :3], poses[:, :3, 3]), points.reshape(-1, 3), whitened.reshape(-1, 14)

    def residuals(x: np.ndarray) -> np.ndarray:
        rotations, translations, points, whitened = unpacked(x)
        in_rig = np.einsum("oij,oj->oi", rotations[frame], points[point]) + translations[frame]
        turns, shifts = moved(EXTRINSIC_SIGMA * whitened[:, :6], places[:, :3, :3], places[:, :3, 3])
        in_cam = np.einsum("oij,oj->oi", turns[camera], in_rig) + shifts[camera]
        found = np.empty_like(tracks.pixels)
        for c, (fx, fy, cx, cy, *lens) in enumerate(parameters + PARAMETER_SIGMA * whitened[:, 6:]):
            matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
            seen, _ = cv2.projectPoints(in_cam[camera == c], np.zeros(3), np.zeros(3), matrix, np.array(lens))
            found[camera == c] = seen[:, 0]
        sigmas = (found - tracks.pixels) / sigma_px
        lengths = np.linalg.norm(sigmas, axis=1, keepdims=True)
        inside = np.minimum(lengths, knee)
        return np.concatenate([(sigmas * np.sqrt(inside * (2 * lengths - inside)) / lengths).ravel(), whitened.ravel()])

    start = np.concatenate([np.zeros(sizes[0]), tracks.points.ravel(), np.zeros(14 * len(mounted))])
    least = least_squares(residuals, start, "3-point", x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-12)
    return unpacked(least.x)


@pytest.mark.parametrize(("knee", "points_mm"), [(1000.0, 1e-6), (1.5, 5e-6)])
def test_the_minimum_is_that_of_a_general_solver(knee: float, points_mm: float) -> None:
    """With free cameras; and with a loss in which many residuals do not count in full, whose kinks such a solver gets
    over slowly: its gradient ends a hundred times larger."""
    cameras = make_rig().cameras
    scene = make_scene(rig=Rig({name: cameras[name] for name in ("c0", "c4")}), frames=3, points=24)
    well_seen = np.bincount(scene.tracks.point_index, minlength=24) >= 4
    scene = replace(scene, tracks=select_tracks(scene.tracks, well_seen[scene.tracks.point_index]))
    given = disturbed(scene, np.random.default_rng(3), rig=with_priors(scene.rig))
    exactly = AdjustmentOptions(
        sigma_px=SIGMA_PX, huber_sigmas=knee, rounds=1, iterations=500, tolerance=1e-12, start_px=1e9
    )
    found = adjust(given, exactly, covariance=False)
    rotations, translations, points, whitened = by_general_least_squares(given, SIGMA_PX, knee)
    assert found.tracks is not None
    np.testing.assert_allclose([pose.rotation for pose in poses_of(found)], rotations, atol=1e-6)
    np.testing.assert_allclose([pose.translation for pose in poses_of(found)], translations, atol=1e-6)
    np.testing.assert_allclose(found.tracks.points, points, atol=points_mm)
    motions, parameters = calibration_errors(found.rig, scene.rig)
    np.testing.assert_allclose(parameters / PARAMETER_SIGMA, whitened[:, 6:], atol=1e-5)
    np.testing.assert_allclose(motions[:, :3] / EXTRINSIC_SIGMA[:3], whitened[:, :3], atol=1e-5)
    assert np.abs(whitened).max() > 0.1
    assert np.abs(translations - [pose.translation for pose in poses_of(given)]).max() > 1e-3
