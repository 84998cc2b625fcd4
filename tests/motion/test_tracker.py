"""Frames are placed as they come, lost where nothing is seen, and found again where the camera has been before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from cuspid.geometry import Rigid3
from cuspid.model.rig import Handpiece
from cuspid.motion import MotionOptions
from cuspid.motion.frontend.features import Features
from cuspid.motion.tracker import Placed, Tracker
from keypoint_films import Keypoints, blanked, make_handpiece, make_path, see, there_and_back, without_far_sight

LONG = {"points": 1000, "length_mm": 20.0}


def of_frame(seen: Keypoints, name: str) -> Mapping[tuple[str, str], Features]:
    return {key: features for key, features in seen.items() if key[0] == name}


def follow(handpiece: Handpiece, seen: Keypoints, names: list[str]) -> tuple[Tracker, dict[str, Placed], list[str]]:
    """The tracker, what became of the frames, and which of them were recalled."""
    recalled: list[str] = []

    def recall(name: str) -> Mapping[tuple[str, str], Features]:
        recalled.append(name)
        return of_frame(seen, name)

    tracker = Tracker(handpiece, MotionOptions(), recall)
    return tracker, {name: tracker.push(name, of_frame(seen, name)) for name in names}, recalled


def off(found: Rigid3 | None, path: dict[str, Rigid3], name: str) -> tuple[float, float]:
    """Distance and angle (mm, rad) of a pose from the true one."""
    assert found is not None
    motion = found @ path[name].inverse()
    return float(np.linalg.norm(motion.translation)), float(np.linalg.norm(motion.rotation_vector))


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_frames_are_placed_one_by_one(scale: float) -> None:
    """In millimetres, without any scale given."""
    handpiece, path = make_handpiece(), make_path(6)
    if scale != 1:
        cameras = {
            name: replace(each, cam_from_rig=Rigid3(each.cam_from_rig.rotation, scale * each.cam_from_rig.translation))
            for name, each in handpiece.rig.cameras.items()
        }
        far = scale * handpiece.working_distance_mm, tuple(scale * np.array(handpiece.depth_range_mm))
        handpiece = replace(
            handpiece, rig=replace(handpiece.rig, cameras=cameras), working_distance_mm=far[0], depth_range_mm=far[1]
        )
        path = {name: Rigid3(pose.rotation, scale * pose.translation) for name, pose in path.items()}
    tracker, placed, recalled = follow(handpiece, see(handpiece, path, scale=scale), list(path))
    assert tracker.rig_from_world == {name: each.rig_from_world for name, each in placed.items()}
    for name, each in placed.items():
        distance, angle = off(each.rig_from_world, path, name)
        assert distance < 0.02 * scale
        assert angle < 0.01
    names = list(path)
    assert [each.beside for each in placed.values()] == [None, *names[:-1]]
    assert recalled == []


def test_a_blind_stretch_loses_nothing_and_the_scan_goes_on() -> None:
    """Frames that see nothing lie between; the handpiece comes back to where it was long before."""
    handpiece, path = without_far_sight(), there_and_back()
    names = list(path)
    seen = see(handpiece, path, **LONG)
    blind = names[10:23]
    for name in blind:
        seen = blanked(seen, name)
    tracker, placed, recalled = follow(handpiece, seen, names)
    assert {name for name, each in placed.items() if each.rig_from_world is None} == set(blind)
    assert all("0 points seen in stereo" in (placed[name].reason or "") for name in blind)
    back = names[23]
    assert placed[back].beside in names[1:5], "it looks like a frame of the way there"
    assert placed[back].beside in recalled
    for name in set(names) - set(blind):
        distance, angle = off(tracker.rig_from_world[name], path, name)
        assert distance < 0.05
        assert angle < 0.03


def test_what_was_never_seen_is_not_placed() -> None:
    """A jump to another part: no match is made up. Back again, the frames are placed again."""
    handpiece, path = without_far_sight(), make_path(4)
    elsewhere = see(handpiece, path, seed=7)
    seen = see(handpiece, path) | {(f"x{name}", camera): each for (name, camera), each in elsewhere.items()}
    names = ["00000", "00001", "x00001", "x00002", "00002", "00003"]
    _, placed, _ = follow(handpiece, seen, names)
    assert [name for name in names if placed[name].rig_from_world is None] == ["x00001", "x00002"]
    assert "matches to the frames before" in (placed["x00001"].reason or "")
    assert placed["00002"].beside == "00001"


def test_a_scan_begins_with_the_first_frame_that_shows_something() -> None:
    handpiece, path = make_handpiece(), make_path(3)
    _, placed, _ = follow(handpiece, blanked(see(handpiece, path), "00000", keep=3), list(path))
    assert placed["00000"].rig_from_world is None
    assert np.array_equal(placed["00001"].rig_from_world.matrix, np.eye(4))


def test_frames_follow_corrected_poses() -> None:
    """And what a correction leaves out is no longer followed."""
    handpiece, path = make_handpiece(), make_path(4)
    seen, names = see(handpiece, path), list(path)
    tracker, _, _ = follow(handpiece, seen, names[:3])
    aside = Rigid3(np.eye(3), np.array([3.0, -1.0, 2.0]))
    better = {name: path[name] @ aside for name in names[:2]}
    tracker.correct(better)
    placed = tracker.push(names[3], of_frame(seen, names[3]))
    assert placed.beside == names[1]
    distance, _ = off(placed.rig_from_world, {names[3]: path[names[3]] @ aside}, names[3])
    assert distance < 0.03
    assert tracker.rig_from_world.keys() == {*names[:2], names[3]}
    for _ in range(2):
        tracker.correct({"00000": better["00000"]})
    tracker.correct({"elsewhere": Rigid3.identity()})
    tracker.correct({"elsewhere": Rigid3.identity()})
    assert tracker.push("again", {("again", c): f for (_, c), f in of_frame(seen, names[3]).items()}).beside is None
