"""A model of one camera has lengths of its own, and is adjusted as a handpiece is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.reconstruction import Tracks
from cuspid.model.sparse_model import SparseModel
from cuspid.motion.bundle.adjustment import AdjustmentOptions, adjust_model
from cuspid.runtime.errors import ReconstructionError

FRAMES, POINTS, AWAY = 6, 80, 14.0
CAMERA = Camera.from_field_of_view(640, 480, 60.0)


def over_a_relief(noise_px: float = 0.0, shaken: float = 0.0) -> SparseModel:
    """A camera that moves over points, each of which all frames see; ``shaken`` off its true places."""
    rng = np.random.default_rng(5)
    points = rng.uniform([-3, -3, -1], [3, 3, 1], (POINTS, 3))
    poses = [Rigid3(np.eye(3), np.array([1.0 - 0.4 * k, 0.1 * k, AWAY])) for k in range(FRAMES)]
    pixels = np.concatenate([CAMERA.project(pose.apply(points)) for pose in poses])
    off = [np.zeros(3), *rng.normal(0, shaken, (FRAMES - 1, 3))]
    return SparseModel(
        camera=CAMERA,
        cam_from_world={f"{k}": Rigid3(pose.rotation, pose.translation + off[k]) for k, pose in enumerate(poses)},
        tracks=Tracks(
            points=points,
            colors=np.zeros((POINTS, 3), np.uint8),
            point_index=np.tile(np.arange(POINTS), FRAMES),
            frame_index=np.repeat(np.arange(FRAMES), POINTS),
            camera_index=np.zeros(FRAMES * POINTS, np.int64),
            pixels=pixels + rng.normal(0, noise_px, pixels.shape) if noise_px else pixels,
        ),
    )


@given(st.floats(1e-3, 1e3))
def test_a_scaled_model_looks_the_same(scale: float) -> None:
    model = over_a_relief()
    scaled = model.scaled(scale)
    np.testing.assert_allclose(scaled.depths, scale * model.depths)
    for name, pose in scaled.cam_from_world.items():
        seen, before = pose.apply(scaled.tracks.points), model.cam_from_world[name].apply(model.tracks.points)
        np.testing.assert_allclose(CAMERA.project(seen), CAMERA.project(before))


def test_depths_are_those_of_the_observations() -> None:
    model = over_a_relief()
    depths = model.depths.reshape(FRAMES, POINTS)
    np.testing.assert_allclose(depths, np.tile(AWAY + model.tracks.points[:, 2], (FRAMES, 1)))


def test_a_shaken_model_is_adjusted_up_to_its_scale() -> None:
    true = over_a_relief()
    found = adjust_model(over_a_relief(noise_px=0.1, shaken=0.05), AdjustmentOptions(sigma_px=0.1))
    assert found.frames == true.frames
    assert found.camera is CAMERA
    assert found.reprojection_rms_px is not None
    assert 0.05 < found.reprojection_rms_px < 0.2
    ways = [
        np.diff([pose.inverse().translation for pose in each.cam_from_world.values()], axis=0) for each in (found, true)
    ]
    steps, right = (np.linalg.norm(way, axis=1) for way in ways)
    assert 0 < np.abs(steps / steps.mean() - right / right.mean()).max() < 0.03


def test_a_model_without_points_is_told() -> None:
    model = over_a_relief()
    none = np.zeros(0, np.int64)
    empty = replace(model.tracks, point_index=none, frame_index=none, camera_index=none, pixels=np.zeros((0, 2)))
    with pytest.raises(ReconstructionError, match="share no consistent points"):
        _ = replace(model, tracks=empty).depths
    with pytest.raises(ReconstructionError, match="no tracks to adjust"):
        adjust_model(replace(model, tracks=empty))
