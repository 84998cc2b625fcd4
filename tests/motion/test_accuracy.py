"""What photographs of one camera are expected to be off by, against what they are off by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from boards import looking_at
from cuspid.geometry import Rigid3, best_similarity
from cuspid.model.camera import Camera
from cuspid.model.reconstruction import Tracks
from cuspid.model.sparse_model import PhotoModel
from cuspid.motion.monocular.accuracy import expect_accuracy

NOISE_PX, FRAMES, POINTS = 0.4, 5, 30


def tracks_of(points: np.ndarray, pixels: np.ndarray) -> Tracks:
    """Of points that all photographs see."""
    frames, count = pixels.shape[:2]
    return Tracks(
        points=points,
        colors=np.zeros((count, 3), np.uint8),
        point_index=np.tile(np.arange(count), frames),
        frame_index=np.repeat(np.arange(frames), count),
        camera_index=np.zeros(frames * count, dtype=np.int64),
        pixels=pixels.reshape(-1, 2),
    )


def truth(seed: int) -> PhotoModel:
    """A camera around a cloud of points."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-12, -12, -4], [12, 12, 4], (POINTS, 3))
    camera = Camera(
        width=800,
        height=600,
        focal_px=np.array([700.0, 700.0]),
        principal_point_px=np.array([400.0, 300.0]),
        distortion=np.array([-0.05, 0.0, 0.0, 0.0]),
    )
    angles = np.linspace(0, 2 * np.pi, FRAMES, endpoint=False)
    poses = {
        f"{k}": looking_at(np.zeros(3), np.array([22 * np.sin(a), 22 * np.cos(a), -45.0]), 40.0 * k)
        for k, a in enumerate(angles)
    }
    pixels = np.stack([camera.project(pose.apply(points)) for pose in poses.values()])
    return PhotoModel(
        cameras={"camera": camera},
        camera_of=dict.fromkeys(poses, "camera"),
        cam_from_world=poses,
        tracks=tracks_of(points, pixels),
    )


def step_by(model: PhotoModel, steps: np.ndarray) -> tuple[Camera, list[Rigid3]]:
    camera = model.cameras["camera"]
    values = camera.parameters.copy()
    values[:2] += 100 * steps[-2]
    values[4] += 0.1 * steps[-1]
    turns = steps[:-2].reshape(FRAMES, 6)
    poses = [
        Rigid3.from_rotation_vector(turn[:3], 10 * turn[3:]) @ pose
        for turn, pose in zip(turns, model.cam_from_world.values(), strict=True)
    ]
    return camera.with_parameters(values), poses


def points_from(camera: Camera, poses: list[Rigid3], pixels: np.ndarray, begin: np.ndarray) -> np.ndarray:
    """Where the rays of all points meet best, in the images."""
    points = begin.copy()
    for _ in range(6):
        normal, right = np.zeros((POINTS, 3, 3)), np.zeros((POINTS, 3))
        for pose, seen in zip(poses, pixels, strict=True):
            by_point = camera.projection_derivatives(pose.apply(points))[0] @ pose.rotation
            off = seen - camera.project(pose.apply(points))
            normal += np.einsum("nij,nik->njk", by_point, by_point)
            right += np.einsum("nij,ni->nj", by_point, off)
        points = points + np.linalg.solve(normal, right[..., None])[..., 0]
    return points


def adjust(model: PhotoModel, pixels: np.ndarray) -> tuple[Camera, list[Rigid3], np.ndarray]:
    """Least squares over poses, focal length and distortion, from the truth; the points are put where rays meet."""
    begin = model.tracks.points

    def residuals(steps: np.ndarray) -> np.ndarray:
        camera, poses = step_by(model, steps)
        points = points_from(camera, poses, pixels, begin)
        off = [seen - camera.project(pose.apply(points)) for pose, seen in zip(poses, pixels, strict=True)]
        return np.concatenate([np.ravel(off), 1e-3 * steps])  # the whole may move: it is held, softly

    found = least_squares(residuals, np.zeros(6 * FRAMES + 2), max_nfev=6)
    camera, poses = step_by(model, found.x)
    return camera, poses, points_from(camera, poses, pixels, begin)


@pytest.mark.long
def test_errors_of_points_by_poses_and_lens_are_as_large_as_expected() -> None:
    ratios = []
    for seed in range(8):
        model = truth(seed)
        true_pixels = model.tracks.pixels.reshape(FRAMES, POINTS, 2)
        noise = np.random.default_rng(100 + seed).normal(0, NOISE_PX, true_pixels.shape)
        camera, poses, points = adjust(model, true_pixels + noise)
        found = replace(
            model,
            cameras={"camera": camera},
            cam_from_world=dict(zip(model.frames, poses, strict=True)),
            tracks=tracks_of(points, true_pixels + noise),
        )
        expected = expect_accuracy(found, 0.0)
        assert expected is not None
        # Of the same spots, seen without noise: what is left is by poses and lens, up to a similarity.
        spots = points_from(camera, poses, true_pixels, model.tracks.points)
        scale, rotation, shift = best_similarity(spots, model.tracks.points)
        off = scale * spots @ rotation.T + shift - model.tracks.points
        ratios.append(np.sum(off**2) / np.trace(expected.covariance, axis1=1, axis2=2).sum())
        assert expected.scale_sigma_ppm == pytest.approx(0.0, abs=1e-3)
    assert 0.7 < np.sqrt(np.mean(ratios)) < 1.35


def test_the_scale_is_as_uncertain_as_it_is_told() -> None:
    model = truth(0)
    noise = np.random.default_rng(0).normal(0, 0.02, model.tracks.pixels.shape)
    noisy = replace(model, tracks=replace(model.tracks, pixels=model.tracks.pixels + noise))
    expected = expect_accuracy(noisy, 1e-3)
    assert expected is not None
    assert 700 < expected.scale_sigma_ppm < 1300
    assert 0.7 < expected.span_sigma_um / expected.span_mm < 1.4


@pytest.mark.parametrize("factor", [0.25, 3.0])
def test_a_unit_of_another_length_changes_lengths_alone(factor: float) -> None:
    model = truth(1)
    noise = np.random.default_rng(1).normal(0, NOISE_PX, model.tracks.pixels.shape)
    noisy = replace(model, tracks=replace(model.tracks, pixels=model.tracks.pixels + noise))
    one, other = expect_accuracy(noisy, 0.0), expect_accuracy(noisy.scaled(factor), 0.0)
    assert one is not None
    assert other is not None
    ratio = np.trace(other.covariance, axis1=1, axis2=2) / np.trace(one.covariance, axis1=1, axis2=2)
    assert ratio == pytest.approx(factor**2, rel=0.5)


def test_a_lens_that_was_given_makes_the_surface_surer() -> None:
    model = truth(2)
    noise = np.random.default_rng(2).normal(0, NOISE_PX, model.tracks.pixels.shape)
    noisy = replace(model, tracks=replace(model.tracks, pixels=model.tracks.pixels + noise))
    free, held = expect_accuracy(noisy, 0.0), expect_accuracy(noisy, 0.0, frozenset({"camera"}))
    assert free is not None
    assert held is not None
    assert np.trace(held.covariance.sum(axis=0)) < 0.9 * np.trace(free.covariance.sum(axis=0))


def test_two_photographs_from_one_place_tell_nothing() -> None:
    model = truth(3)
    pose = model.cam_from_world["0"]
    still = {name: Rigid3(pose.rotation, pose.translation) for name in model.frames}
    pixels = np.stack([model.cameras["camera"].project(pose.apply(model.tracks.points))] * FRAMES)
    assert (
        expect_accuracy(replace(model, cam_from_world=still, tracks=tracks_of(model.tracks.points, pixels)), 0.0)
        is None
    )
