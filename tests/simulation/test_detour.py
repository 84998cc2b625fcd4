"""What comes too near to the jaw is repaired, smoothly, and never refused."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from builders import any_pose, sphere
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import essential_four, twelve_cameras
from cuspid.model.body import Body, Box
from cuspid.model.jaw import Jaw
from cuspid.model.room import Room
from cuspid.simulation.path.detour import repair_path
from cuspid.simulation.path.scan import ScanPathOptions, plan_scan_path

CUBE = Body({"cube": Box(Rigid3.identity(), np.array([1.0, 1.0, 1.0]))})
BALL = Room(sphere(10.0), CUBE, 0.5)


def over_the_ball(heights_mm: np.ndarray) -> list[Rigid3]:
    """``rig_from_world`` along a meridian of the ball, a millimetre apart, upright over it at these heights."""
    poses = []
    for index, height in enumerate(heights_mm):
        turn = Rotation.from_euler("y", 0.1 * (index - len(heights_mm) / 2))
        poses.append(Rigid3(turn.as_matrix().T, np.array([0.0, 0.0, -10.0 - height])))
    return poses


def away_mm(one: Rigid3, other: Rigid3) -> float:
    return float(np.linalg.norm(one.inverse().translation - other.inverse().translation))


def test_frames_that_fit_are_left_as_they_are() -> None:
    poses = over_the_ball(np.full(12, 1.6))
    assert all(found is pose for found, pose in zip(repair_path(BALL, poses), poses, strict=True))


def test_a_frame_that_nearly_fits_is_lifted_a_little_and_its_neighbours_with_it() -> None:
    heights = np.full(21, 1.6)
    heights[10] = 1.4
    poses = over_the_ball(heights)
    found = repair_path(BALL, poses)
    moves = np.array([away_mm(*pair) for pair in zip(found, poses, strict=True)])
    assert BALL.clearance(poses[10])[0] < 0.5 <= min(BALL.clearance(pose)[0] for pose in found)
    assert 0.09 < moves[10] < 0.35
    assert (moves <= moves[10] + 1e-9).all()
    assert not moves[:6].any()
    assert not moves[15:].any()


def test_a_large_repair_begins_before_it_is_needed() -> None:
    heights = np.full(21, 1.6)
    heights[10] = -1.4
    poses = over_the_ball(heights)
    found = repair_path(BALL, poses)
    assert min(BALL.clearance(pose)[0] for pose in found) >= 0.5
    moves = np.array([away_mm(*pair) for pair in zip(found, poses, strict=True)])
    assert 2.5 < moves[10] < 4.5
    assert (np.diff(moves[5:11]) > 0).sum() >= 4
    assert np.abs(np.diff(moves)).max() < 0.5 * moves[10]


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6))
def test_whatever_the_frames_all_fit_afterwards(seed: int) -> None:
    """Frames beside, in and far from a ball, turned in any way; fitting ones far from the others are not touched."""
    rng = np.random.default_rng(seed)
    poses = [any_pose(int(each), 9.0) for each in rng.integers(0, 10**6, 6)]
    far = [Rigid3(np.eye(3), np.array([0.0, 0.0, -14.0 - index])) for index in range(8)]
    found = repair_path(BALL, [*poses, *far])
    assert min(BALL.clearance(pose)[0] for pose in found) >= 0.5
    assert all(pose is untouched for pose, untouched in zip(found[-4:], far[-4:], strict=True))


def test_where_nothing_else_fits_it_goes_straight_out() -> None:
    room, inside = Room(sphere(40.0), CUBE, 0.5), any_pose(3, 1.0)
    (found,) = repair_path(room, [inside])
    assert room.clearance(found)[0] >= 0.5
    np.testing.assert_allclose(found.rotation, inside.rotation, atol=1e-9)
    way = found.inverse().translation - inside.inverse().translation
    assert way[2] > 35
    np.testing.assert_allclose(way[:2], 0, atol=1e-9)


def test_the_room_for_a_pose_is_its_clearance(coarse_phantom: Jaw) -> None:
    """Found by two ways: a search with bounds, and the distance of every point."""
    rng, clearances = np.random.default_rng(0), []
    room = Room(coarse_phantom.mesh, twelve_cameras().solid, 0.5)
    places = coarse_phantom.mesh.face_centres[rng.integers(0, len(coarse_phantom.mesh.faces), 60)]
    poses = [any_pose(index, 6.0) @ Rigid3(np.eye(3), -place) for index, place in enumerate(places)]
    clearances = np.array([room.clearance(pose)[0] for pose in poses])
    assert 10 < np.sum(clearances >= 0.5) < 50
    for limit in (0.5, 0.05, 3.0):
        found = Room(coarse_phantom.mesh, twelve_cameras().solid, limit).fits_at(poses)
        np.testing.assert_array_equal(found, clearances >= limit)


def test_a_hand_that_trembles_between_the_stations_is_not_refused(coarse_phantom: Jaw) -> None:
    """Of the frames of this one, one would come too near, although it fits half a millimetre before and after it."""
    options = ScanPathOptions(
        tooth=46, clearance_mm=4.3, jitter_mm=1.0, jitter_deg=10.0, jitter_length_mm=1.0, min_overlap=0.3
    )
    four = essential_four()
    path = plan_scan_path(coarse_phantom, four, options, np.random.default_rng(1))
    room = Room(coarse_phantom.mesh, four.solid, 4.3)
    assert min(room.clearance(pose)[0] for pose in path.rig_from_world.values()) >= 4.3
