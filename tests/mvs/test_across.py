"""Depth across frames: right where the motion is right, and modest beside depth of a single frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cuspid.geometry import Rigid3
from cuspid.model.pairing import PairingOptions
from cuspid.model.rig import Handpiece, Rig, Sensor
from cuspid.mvs.across import AcrossOptions, consecutive_pair, measure_moving_cameras
from cuspid.mvs.matching import StereoOptions
from synthetic_scene import cast_depth, diamond, height_field, render

HILLS = height_field(lambda x, y: 5 + 0.25 * np.sin(1.8 * x) * np.cos(1.5 * y))
STEP = Rigid3.from_rotation_vector(np.array([0.01, -0.02, 0.03]), np.array([-1.1, 0.15, 0.05]))


def lone_camera() -> Handpiece:
    handpiece = diamond()
    return replace(handpiece, rig=Rig({"west": handpiece.rig["west"]}))


@pytest.mark.long
@pytest.mark.parametrize("sensors", [{}, {"west": Sensor(gamma=1.8), "east": Sensor(gamma=2.0)}])
def test_one_moving_camera_measures_depth(sensors: dict[str, Sensor]) -> None:
    """Also of a handpiece of which the sensor of every camera is known."""
    handpiece, rng = lone_camera(), np.random.default_rng(0)
    handpiece = replace(diamond(), sensors=sensors) if sensors else handpiece
    mounted = handpiece.rig["west"]
    images = [{"west": render(HILLS, mounted, pose, rng)} for pose in (Rigid3.identity(), STEP)]
    options = AcrossOptions(confidence_share=0.1), StereoOptions()
    found = measure_moving_cameras(handpiece, images[0], images[1], {}, STEP, "00000", *options)
    assert [depth_map.camera_name for depth_map in found] == ["west", "west+"]
    for depth_map in found:
        # Both are given in the rig frame of the first frame, which is the world here.
        error = 1000 * (depth_map.depth_mm - cast_depth(HILLS, depth_map.camera, depth_map.cam_from_rig))
        error = error[np.isfinite(error)]
        assert depth_map.frame == "00000"
        assert error.size > 0.4 * depth_map.depth_mm.size
        assert 0.5 < np.median(np.abs(error)) < 20
        assert abs(np.median(error)) < 5
        assert 0.05 < depth_map.confidence.max() <= 0.1


def test_a_camera_that_hardly_moved_is_left_out() -> None:
    still = Rigid3(np.eye(3), np.array([-0.1, 0, 0]))
    assert consecutive_pair(lone_camera(), "west", still, PairingOptions()) is None
    assert consecutive_pair(lone_camera(), "west", STEP, PairingOptions()) is not None


def test_a_camera_that_moved_along_its_axis_or_turned_away_is_left_out() -> None:
    closer = Rigid3(np.eye(3), np.array([-0.5, 0, 1.5]))
    turned = Rigid3.from_rotation_vector(np.array([0, 0.6, 0]), np.array([-1.1, 0, 0]))
    away = Rigid3(np.eye(3), np.array([-5.0, 0, 0]))
    for motion in (closer, turned, away):
        assert consecutive_pair(lone_camera(), "west", motion, PairingOptions()) is None
