"""What is seen again joins the frames that saw it."""

from __future__ import annotations

import numpy as np
import pytest

from cuspid.model.reconstruction import Tracks
from cuspid.motion import MotionOptions, location
from cuspid.motion.frontend.closure import closing_pairs
from cuspid.motion.location import locate_features
from keypoint_films import OUT, errors, make_handpiece, see, there_and_back, without_far_sight, wrongly_calibrated


def no_tracks() -> Tracks:
    nothing = np.zeros(0, np.int64)
    return Tracks(
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        point_index=nothing,
        frame_index=nothing,
        camera_index=nothing,
        pixels=np.zeros((0, 2)),
    )


def every_frame_once(frames: int) -> Tracks:
    """One track that joins all frames."""
    index = np.arange(frames)
    return Tracks(
        points=np.zeros((1, 3)),
        colors=np.zeros((1, 3), np.uint8),
        point_index=0 * index,
        frame_index=index,
        camera_index=0 * index,
        pixels=np.zeros((frames, 2)),
    )


def test_only_what_sees_the_same_from_the_same_side_is_paired():
    handpiece, poses = make_handpiece(), list(there_and_back().values())
    pairs = closing_pairs(handpiece, poses, no_tracks())
    for (one, camera), (other, partner) in pairs:
        first, second = (handpiece.rig[c].cam_from_rig @ poses[f] for f, c in ((one, camera), (other, partner)))
        assert first.rotation[2] @ second.rotation[2] > np.cos(np.deg2rad(26))
        seen = [pose.inverse().apply(np.array([0.0, 0, handpiece.working_distance_mm])) for pose in (first, second)]
        assert np.linalg.norm(seen[1] - seen[0]) < 0.5 * handpiece.working_distance_mm
    assert {frame for pair in pairs for frame, _ in pair} == set(range(len(poses)))
    assert closing_pairs(handpiece, poses, every_frame_once(len(poses))) == []


@pytest.mark.long
@pytest.mark.parametrize("calibrated", [True, False])
def test_a_way_back_is_tied_to_the_way_there(monkeypatch: pytest.MonkeyPatch, calibrated: bool):
    """The frames of the end come to those of the beginning much better than by the chain alone."""
    handpiece, path = without_far_sight(), there_and_back()
    seen = see(handpiece, path, points=1000, length_mm=20.0)
    handpiece = handpiece if calibrated else wrongly_calibrated(handpiece)
    closed = locate_features(handpiece, seen, list(path), MotionOptions())
    assert closed.log["closing_matches"] > 100
    monkeypatch.setattr(location, "closing_pairs", lambda *_: [])
    open_ended = locate_features(handpiece, seen, list(path), MotionOptions())
    ratio = np.linalg.norm(errors(closed, path)[-1]) / np.linalg.norm(errors(open_ended, path)[-1])
    assert 0.02 < ratio < 0.6


def test_one_way_has_nothing_to_close():
    handpiece, path = without_far_sight(), dict(list(there_and_back().items())[:OUT])
    found = locate_features(handpiece, see(handpiece, path, points=1000, length_mm=20.0), list(path), MotionOptions())
    assert found.log["closing_matches"] == 0
