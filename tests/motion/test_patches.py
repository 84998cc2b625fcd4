"""Laws of the patches: what was truly moved is found where it went, and a lost patch says so."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import Reconstruction, Tracks, concatenate_tracks, select_tracks
from cuspid.model.rig import MountedCamera, Rig
from cuspid.model.sparse_model import SparseModel
from cuspid.motion.frontend.patches import (
    PatchOptions,
    align_patches,
    are_connected,
    cut_patches,
    follow_points,
    follow_rig_points,
    lengthen,
)
from cuspid.motion.frontend.tracks import points_across
from cuspid.motion.monocular.guided import GuidedOptions
from cuspid.runtime.errors import InputError


def wall(seed: int = 0, size: int = 400) -> np.ndarray:
    """A smooth random texture, 0 to 255."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).random((size, size)).astype(np.float32), (0, 0), 2.5)
    return np.asarray(255 * (noise - noise.min()) / np.ptp(noise), dtype=np.float32)


CENTRES = np.array([[x, y] for x in (150.0, 200.3, 251.7) for y in (150.0, 204.4, 247.2)])


def laid(
    here: np.ndarray, there: np.ndarray, places: np.ndarray, start: np.ndarray, warps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where the patches of one picture are in another."""
    options = PatchOptions()
    return align_patches(cut_patches(here, places, options.radius_px), there, start, warps, options)


@settings(max_examples=20, deadline=None)
@given(
    shift=st.tuples(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2)),
    turn_deg=st.floats(-10, 10),
    scale=st.floats(0.9, 1.1),
    gain=st.floats(0.5, 1.0),
    light=st.tuples(st.floats(-2, 2), st.floats(-2, 2)),
)
def test_a_patch_is_found_where_it_went(
    shift: tuple[float, float], turn_deg: float, scale: float, gain: float, light: tuple[float, float]
) -> None:
    """Whatever the gain, the offset and the slope of the light."""
    picture, angle = wall(), np.deg2rad(turn_deg)
    linear = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    offset = np.array([200.0, 200.0]) - linear @ [200.0, 200.0]
    # OpenCV's first pixel has its centre at 0.
    matrix = np.column_stack([linear, offset + linear @ [0.5, 0.5] - 0.5])
    moved = gain * cv2.warpAffine(picture, matrix, picture.shape[::-1], flags=cv2.INTER_CUBIC) + 9
    moved += (light[0] * np.arange(400) + light[1] * np.arange(400)[:, None]).astype(np.float32)
    true = CENTRES @ linear.T + offset
    warps = np.broadcast_to(linear, (len(CENTRES), 2, 2))
    found, correlation = laid(picture, moved, CENTRES, true + shift, warps)
    assert np.all(correlation > 0.98)
    # OpenCV warps to 1/32 px. 0.068 px is the worst of 1,500 draws.
    assert np.abs(found - true).max() < 0.08


def test_what_is_not_there_is_not_found() -> None:
    here, other, flat = wall(), wall(1), np.full((400, 400), 80, np.float32)
    warps = np.broadcast_to(np.eye(2), (len(CENTRES), 2, 2))
    _, on_other = laid(here, other, CENTRES, CENTRES, warps)
    assert not np.any(on_other > 0.85)
    assert np.isnan(laid(flat, flat, CENTRES, CENTRES, warps)[1]).all()
    for nowhere in (0.0, np.nan):
        assert np.isnan(laid(here, here, CENTRES, CENTRES, np.broadcast_to(nowhere * np.eye(2), warps.shape))[1]).all()
    border = np.full_like(CENTRES, 3.0)
    assert np.isnan(laid(here, here, border, border, warps)[1]).all()


def wall_pictures(poses: Mapping[str, Rigid3], camera: Camera) -> dict[str, np.ndarray]:
    """What a camera sees of a textured wall from each pose."""
    texture, px_per_mm = wall(3, 800), 20.0
    calibration = np.array([[camera.focal_px[0], 0, 159.5], [0, camera.focal_px[1], 119.5], [0, 0, 1]])
    onto_wall = np.array([[px_per_mm, 0, 399.5], [0, px_per_mm, 399.5], [0, 0, 1]])
    planes = {name: np.column_stack([pose.rotation[:, :2], pose.translation]) for name, pose in poses.items()}
    homographies = {name: calibration @ plane @ np.linalg.inv(onto_wall) for name, plane in planes.items()}
    return {
        name: cv2.warpPerspective(texture, homography, (320, 240)).astype(np.uint8)
        for name, homography in homographies.items()
    }


def over_a_wall(frames: int = 8, tilt_deg: float = 0) -> tuple[SparseModel, dict[str, np.ndarray]]:
    """A camera that moves over a textured wall; every point is known from two frames alone."""
    tilt = Rigid3.from_rotation_vector(np.deg2rad([0, tilt_deg, 0]), np.zeros(3))
    camera, rng, poses = Camera.from_field_of_view(320, 240, 60.0), np.random.default_rng(1), dict[str, Rigid3]()
    for k in range(frames):
        rotation = Rotation.from_rotvec(np.deg2rad([2 * np.sin(k), 1.5 * np.cos(k), 3 * np.sin(2 * k)])).as_matrix()
        turned = rotation @ np.diag([1.0, -1.0, -1.0])
        poses[f"{k}"] = Rigid3(turned, -turned @ [0.6 * k - 2.0, 0.1 * k, 14.0]) @ tilt
    points = np.column_stack([rng.uniform(-3, 3, (60, 2)), np.zeros(60)])
    pairs = [(p, f) for p in range(60) for f in (3, 4)]
    pixels = np.array([camera.project(poses[f"{f}"].apply(points[p : p + 1]))[0] for p, f in pairs])
    tracks = Tracks(
        points=points,
        colors=np.zeros((60, 3), np.uint8),
        point_index=np.array([p for p, _ in pairs]),
        frame_index=np.array([f for _, f in pairs]),
        camera_index=np.zeros(len(pairs), np.int64),
        pixels=pixels,
    )
    model = SparseModel(camera=camera, cam_from_world=poses, tracks=tracks)
    return model, wall_pictures(poses, camera)


def errors_px(model: SparseModel, tracks: Tracks) -> np.ndarray:
    """How far observations are from where the points truly are."""
    poses = list(model.cam_from_world.values())
    seen = zip(tracks.point_index, tracks.frame_index, strict=True)
    true = [model.camera.project(poses[frame].apply(tracks.points[point])) for point, frame in seen]
    return np.linalg.norm(tracks.pixels - true, axis=1)


def test_points_are_followed_into_every_frame_that_sees_them() -> None:
    model, pictures = over_a_wall()
    given_tracks = model.tracks
    longer = lengthen(model, lambda name: pictures[name], PatchOptions()).tracks
    second = longer.point_index >= len(given_tracks.points)
    assert len(longer.points) - len(given_tracks.points) >= 50
    assert np.array_equal(longer.pixels[~second], given_tracks.pixels)
    errors = errors_px(model, select_tracks(longer, second))
    assert 0 < np.median(errors) < 0.1
    assert np.quantile(errors, 0.95) < 0.3
    assert second.sum() / 60 > 5


def the_wall(z: float = 0.0) -> Mesh:
    """The wall itself, or a copy that lies higher."""
    corners = np.array([[-30, -30, z], [30, -30, z], [30, 30, z], [-30, 30, z]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


@pytest.mark.parametrize("tilt_deg", [-40, 40])
def test_what_turns_away_from_the_camera_is_followed_once_the_surface_is_known(tilt_deg: float) -> None:
    model, pictures = over_a_wall(tilt_deg=tilt_deg)
    follow = partial(follow_points, model, lambda name: pictures[name], PatchOptions())
    facing, along = follow(), follow(surface=the_wall())
    assert len(along.points) >= 50
    assert len(along.pixels) >= len(facing.pixels)
    errors = errors_px(model, along)
    assert 0 < np.median(errors) < 0.03
    # 9 times as far off without.
    assert np.quantile(errors_px(model, facing), 0.9) > 4 * np.quantile(errors, 0.9)


def test_what_the_surface_occludes_is_not_followed() -> None:
    """A plate that stands on the wall, between the first frame and places behind it, which the others see past it."""
    model, pictures = over_a_wall()
    follow = partial(follow_points, model, lambda name: pictures[name], PatchOptions())
    plate = np.array([[0.8, -9, 0.01], [0.8, 9, 0.01], [0.8, 9, 3], [0.8, -9, 3]])
    wall = the_wall()
    standing = Mesh(np.vstack([wall.vertices, plate]), np.vstack([wall.faces, wall.faces + 4]))

    def seen_first(tracks: Tracks) -> int:
        behind = np.flatnonzero((tracks.points[:, 0] > 1.3) & (tracks.points[:, 0] < 1.6))
        assert len(behind) >= 2
        return int(np.sum(np.isin(tracks.point_index, behind) & (tracks.frame_index == 0)))

    assert seen_first(follow(surface=wall)) >= 2
    assert seen_first(follow(surface=standing)) == 0


def test_what_the_surface_does_not_show_is_not_followed() -> None:
    model, pictures = over_a_wall()
    follow = partial(follow_points, model, lambda name: pictures[name], PatchOptions())
    right = the_wall().submesh(np.array([True, False]))
    assert np.all(follow(surface=right).points[:, 0] > follow(surface=right).points[:, 1])
    small = Mesh(np.array([[9.0, 9, 0], [9.1, 9, 0], [9, 9.1, 0]]), np.array([[0, 1, 2]]))
    nothing = small.submesh(np.array([False]))
    assert len(follow(surface=small).points) == len(follow(surface=nothing).points) == 0


def pair_over_a_wall() -> tuple[Reconstruction, dict[str, dict[str, np.ndarray]]]:
    """The same camera with another beside it, 1.5 mm away and turned by 6 degrees; one point is seen by both in every
    frame."""
    model, pictures = over_a_wall()
    other = Rigid3.from_rotation_vector(np.deg2rad([0, 6.0, 0]), np.array([-1.5, 0, 0]))
    beside = {name: other @ pose for name, pose in model.cam_from_world.items()}
    camera, given = model.camera, model.tracks
    middle = int(np.argmin(np.linalg.norm(given.points[:, :2], axis=1)))
    both = [
        (f, c, camera.project(pose.apply(given.points[middle, None]))[0])
        for c, poses in enumerate((model.cam_from_world, beside))
        for f, pose in enumerate(poses.values())
    ]
    others = given.point_index != middle
    tracks = replace(
        given,
        point_index=np.concatenate([given.point_index[others], np.full(len(both), middle)]),
        frame_index=np.concatenate([given.frame_index[others], [f for f, _, _ in both]]),
        camera_index=np.concatenate([given.camera_index[others], [c for _, c, _ in both]]),
        pixels=np.concatenate([given.pixels[others], [pixel for _, _, pixel in both]]),
    )
    rig = Rig({"a": MountedCamera(camera, Rigid3.identity()), "b": MountedCamera(camera, other)})
    found = Reconstruction(rig=rig, rig_from_world=model.cam_from_world, tracks=tracks)
    return found, {"a": pictures, "b": wall_pictures(beside, camera)}


def test_points_are_followed_into_all_cameras_of_a_handpiece_in_whatever_order() -> None:
    found, pictures = pair_over_a_wall()

    def follow(found: Reconstruction) -> Tracks:
        read = lambda frame, camera: pictures[camera][frame]  # noqa: E731
        return follow_rig_points(found, read, PatchOptions(), surface=the_wall())

    tracks = follow(found)
    assert len(tracks.points) >= 50
    for number, mounted in enumerate(found.rig.cameras.values()):
        poses = [mounted.cam_from_rig @ pose for pose in found.rig_from_world.values()]
        mine = np.flatnonzero(tracks.camera_index == number)
        assert len(mine) > 150
        points, frames = tracks.points[tracks.point_index[mine]], tracks.frame_index[mine]
        true = [mounted.camera.project(poses[f].apply(point)) for f, point in zip(frames, points, strict=True)]
        errors = np.linalg.norm(tracks.pixels[mine] - true, axis=1)
        assert 0 < np.median(errors) < 0.05
        assert np.quantile(errors, 0.95) < 0.2

    def sightings(tracks: Tracks, names: Sequence[str]) -> set[tuple[object, ...]]:
        seen = zip(tracks.frame_index, tracks.camera_index, tracks.pixels.round(6).tolist(), strict=True)
        return {(int(frame), names[camera], *pixel) for frame, camera, pixel in seen}

    other_way = follow(found.with_cameras_as(["b", "a"]))
    assert sightings(other_way, ["b", "a"]) == sightings(tracks, ["a", "b"])


def test_a_handpiece_of_one_camera_is_that_camera() -> None:
    model, pictures = over_a_wall()
    every = select_tracks(
        concatenate_tracks(model.tracks, replace(model.tracks, frame_index=np.tile(np.arange(8), 15))),
        np.ones(240, bool),
    )
    model = replace(model, tracks=every)
    rig = Rig({"camera": MountedCamera(model.camera, Rigid3.identity())})
    found = Reconstruction(rig=rig, rig_from_world=model.cam_from_world, tracks=every)
    options = PatchOptions()
    alone = follow_points(model, lambda name: pictures[name], options, surface=the_wall())
    mounted = follow_rig_points(found, lambda frame, _: pictures[frame], options, surface=the_wall())
    for name in ("points", "point_index", "frame_index", "camera_index", "pixels"):
        np.testing.assert_array_equal(getattr(mounted, name), getattr(alone, name))


@pytest.mark.parametrize(("lost", "held"), [((), True), ((5,), False), ((2, 3), False)])
def test_frames_hold_together_where_enough_points_are_seen_on_both_sides(lost: tuple[int, ...], held: bool) -> None:
    """Twelve points in each two frames that follow each other."""
    seen = [(12 * first + n, frame) for first in range(7) for n in range(12) for frame in (first, first + 1)]
    point, frame = np.array([each for each in seen if each[1] not in lost]).T
    tracks = Tracks(
        points=np.zeros((84, 3)),
        colors=np.zeros((84, 3), np.uint8),
        point_index=point,
        frame_index=frame,
        camera_index=np.zeros(len(point), np.int64),
        pixels=np.zeros((len(point), 2)),
    )
    assert are_connected(tracks, 8, 12) is held
    assert not are_connected(tracks, 8, 13)


def test_points_seen_in_too_few_frames_stay_as_they_were() -> None:
    model, pictures = over_a_wall()
    options = replace(PatchOptions(), min_views=9)
    longer = lengthen(model, lambda name: pictures[name], options).tracks
    assert len(longer.points) == len(model.tracks.points)


def test_tracks_are_taken_apart_and_joined() -> None:
    tracks = over_a_wall()[0].tracks
    early = tracks.frame_index == 3
    joined = concatenate_tracks(select_tracks(tracks, early), select_tracks(tracks, ~early))
    assert len(joined.points) == 2 * len(tracks.points)
    assert np.array_equal(joined.pixels, np.concatenate([tracks.pixels[early], tracks.pixels[~early]]))
    place = np.concatenate([tracks.points[tracks.point_index[each]] for each in (early, ~early)])
    assert np.array_equal(joined.points[joined.point_index], place)


def test_points_across_a_frame_are_counted() -> None:
    """One from 0 to 3, one from 1 to 2, one in 2 alone, and none with number 3."""
    point, frame = np.array([0, 0, 1, 1, 2, 4, 4]), np.array([0, 3, 2, 1, 2, 3, 4])
    assert points_across(point, frame, 5).tolist() == [1, 2, 1, 1]
    assert points_across(np.array([], np.int64), np.array([], np.int64), 3).tolist() == [0, 0]


def test_each_round_needs_a_tolerance_and_a_depth_share() -> None:
    with pytest.raises(InputError, match="3 tolerances and 2 depth shares"):
        GuidedOptions(depth_shares=(0.2, 0.1))
    with pytest.raises(InputError, match="at least one"):
        GuidedOptions(tolerances_px=(), depth_shares=())
