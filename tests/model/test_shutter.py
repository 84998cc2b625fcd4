"""Rolling shutters and delays: the motion of a film, what is adjusted by it, and images that are set right."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from builders import handpiece
from bundle_scenes import Scene, disturbed, make_rig, make_scene, observe, pose_errors
from cuspid import storage
from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.capture import Capture, Frame, ImageFolder
from cuspid.model.epipolar import skew
from cuspid.model.reconstruction import Reconstruction, Tracks
from cuspid.model.rig import MountedCamera, Rig
from cuspid.model.shutter import PLAIN, Shutter, displace_points, film_times, motions
from cuspid.model.unrolling import unroll_capture, unrollings
from cuspid.motion.bundle.adjustment import adjust, residuals_px
from cuspid.runtime.errors import InputError
from cuspid.simulation.optics import OpticsOptions, with_shutters

FRAMES = 7
SHUTTERS = (
    Shutter(readout=0.5),
    Shutter(delay_frames=0.3, readout=-0.4),
    Shutter(delay_frames=-0.2, readout=0.8),
    Shutter(delay_frames=-0.3),
    PLAIN,
    Shutter(readout=0.2),
)


def screw(turn: np.ndarray, shift: np.ndarray, time: float) -> Rigid3:
    """exp(time (turn, shift))."""
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = skew(turn), shift
    return Rigid3.from_matrix(expm(time * generator))


# --- when, and how it moves ---------------------------------------------------------------------------------------


def test_names_tell_the_times_of_a_film_only_where_they_are_numbers_in_order():
    assert film_times(["00003", "00004", "00006"]) == (3.0, 4.0, 6.0)
    for names in (["4", "3"], ["1a", "2a"], ["7"], ["01", "1"], []):
        assert film_times(names) is None


vectors = st.lists(st.floats(-1, 1), min_size=3, max_size=3).map(np.array)


@settings(max_examples=25, deadline=None)
@given(turn=vectors, shift=vectors, place=vectors, new=vectors)
def test_the_motion_of_a_steady_film_is_found_whatever_the_world(turn, shift, place, new):
    """Also across a missing frame; not across two."""
    turn, start = 0.05 * turn, Rigid3.from_rotation_vector(place, 5 * place)
    other = Rigid3.from_rotation_vector(new, 30 * new)
    for times in ([0.0, 1.0, 2.0], [0.0, 2.0, 3.0]):
        poses = [screw(turn, shift, time) @ start for time in times]
        for some in (poses, [pose @ other for pose in poses]):
            np.testing.assert_allclose(motions(some, times), np.tile([*turn, *shift], (3, 1)), atol=1e-5)
    assert not motions([screw(turn, shift, time) for time in (0.0, 3.0)], [0.0, 3.0]).any()
    assert not motions([start, start @ other], None).any()


def test_a_row_is_late_by_its_height():
    shutter = Shutter(delay_frames=0.1, readout=0.4)
    np.testing.assert_allclose(shutter.late(np.array([0.0, 0.5, 1.0])), [-0.1, 0.1, 0.3])
    turned = Shutter(delay_frames=0.1, readout=-0.4)  # the camera upside down
    np.testing.assert_allclose(turned.late(1 - np.array([0.0, 0.3])), shutter.late(np.array([0.0, 0.3])))


# --- files --------------------------------------------------------------------------------------------------------


def test_shutters_return_from_a_file_and_old_files_have_none(tmp_path):
    file, plain = tmp_path / "handpiece.json", handpiece("a", "b")
    shutter = Shutter(delay_frames=-0.25, delay_sigma_frames=0.01, readout=0.5, readout_sigma=0.02)
    cameras = {"a": replace(plain.rig["a"], shutter=shutter), "b": plain.rig["b"]}
    storage.write_handpiece(file, replace(plain, rig=Rig(cameras)))
    again = storage.read_handpiece(file)
    assert again.rig["a"].shutter == shutter
    assert again.rig["b"].shutter == PLAIN
    storage.write_handpiece(file, plain)
    assert "readout" not in file.read_text()
    assert "delay" not in file.read_text()
    file.write_text(file.read_text().replace('"width_px"', '"readout_sigma": -1, "width_px"', 1))
    with pytest.raises(InputError, match="readout_sigma is -1; it must lie between 0 and 10"):
        storage.read_handpiece(file)


def test_a_simulated_handpiece_exposes_as_asked():
    plain = handpiece("a", "b")
    assert with_shutters(plain, OpticsOptions()) is plain
    asked = with_shutters(plain, OpticsOptions(readout=0.5, delays_frames=(0.0, -0.3)))
    assert asked.rig["a"].shutter == Shutter(readout=0.5)
    assert asked.rig["b"].shutter == Shutter(readout=0.5, delay_frames=-0.3)
    with pytest.raises(InputError, match="--delays-frames has 1 numbers; give one for each of the 2 cameras: a, b"):
        with_shutters(plain, OpticsOptions(delays_frames=(0.1,)))


# --- the adjustment -----------------------------------------------------------------------------------------------


def steady_path(frames: int = FRAMES) -> dict[str, Rigid3]:
    turn, shift = np.array([0.012, -0.02, 0.03]), np.array([-0.6, 0.15, 0.05])
    return {f"{k:05d}": screw(turn, shift, float(k)) for k in range(frames)}


def rolled(tracks: Tracks, rig: Rig, path: dict[str, Rigid3]) -> Tracks:
    """The observations where rolling shutters have them: their rows depend on their times, and these on the rows."""
    pixels, moving = tracks.pixels.copy(), motions(tuple(path.values()), film_times(list(path)))
    for f, pose in enumerate(path.values()):
        for c, mounted in enumerate(rig.cameras.values()):
            own = np.flatnonzero((tracks.frame_index == f) & (tracks.camera_index == c))
            in_rig = pose.apply(tracks.points[tracks.point_index[own]])
            for _ in range(30):
                late = mounted.shutter.late(pixels[own, 1] / mounted.camera.height)
                then = displace_points(in_rig, moving[f], late)
                pixels[own] = mounted.camera.project(mounted.cam_from_rig.apply(then))
    return replace(tracks, pixels=pixels)


def film(shutters: tuple[Shutter, ...] = SHUTTERS) -> tuple[Rig, dict[str, Rigid3], Tracks]:
    cameras = zip(make_rig().cameras.items(), shutters, strict=True)
    rig, path = Rig({name: replace(each, shutter=shutter) for (name, each), shutter in cameras}), steady_path()
    scene = make_scene(rig=rig, frames=1, points=120)
    return rig, path, rolled(observe(rig, path, scene.tracks.points), rig, path)


def rough(rig: Rig, path: dict[str, Rigid3], tracks: Tracks) -> Reconstruction:
    return disturbed(Scene(rig, path, tracks), np.random.default_rng(3), rig=rig)


def with_all(rig: Rig, change) -> Rig:
    return Rig({name: replace(each, shutter=change(each.shutter)) for name, each in rig.cameras.items()})


def test_a_film_of_rolling_shutters_is_located_as_well_as_one_of_others():
    rig, path, tracks = film()
    start = rough(rig, path, tracks)
    plain = with_all(rig, lambda shutter: PLAIN)
    known, ignored = (adjust(replace(start, rig=each), covariance=False) for each in (rig, plain))
    errors, wrong = (np.sqrt(np.mean(pose_errors(each, path)[1:, 3:] ** 2)) for each in (known, ignored))
    assert 0 < errors < 0.3 * wrong, (errors, wrong)
    assert known.reprojection_rms_px < 0.6 < ignored.reprojection_rms_px
    np.testing.assert_allclose(
        np.sqrt(np.mean(np.sum(residuals_px(known) ** 2, axis=1))), known.reprojection_rms_px, rtol=0.02
    )


def test_unknown_readouts_are_found_with_their_standard_deviations():
    rig, path, tracks = film(tuple(Shutter(readout=each.readout) for each in SHUTTERS))
    unknown = with_all(rig, lambda shutter: Shutter(readout_sigma=0.5))
    found = adjust(rough(unknown, path, tracks))
    z = []
    for name, mounted in found.rig.cameras.items():
        assert mounted.shutter.readout_sigma < 0.05
        assert mounted.shutter.delay_sigma_frames == 0
        z.append((mounted.shutter.readout - rig[name].shutter.readout) / mounted.shutter.readout_sigma)
    assert 0.3 < np.sqrt(np.mean(np.square(z))) < 2


def test_shutters_of_frames_that_are_no_film_change_nothing():
    rig, path, tracks = film()
    start = rough(rig, {f"{name}a": pose for name, pose in path.items()}, tracks)
    found = adjust(start, covariance=False)
    plain = adjust(replace(start, rig=with_all(rig, lambda shutter: PLAIN)), covariance=False)
    for name in start.frames:
        np.testing.assert_array_equal(found.rig_from_world[name].matrix, plain.rig_from_world[name].matrix)


# --- images -------------------------------------------------------------------------------------------------------


def test_images_are_set_right(tmp_path):
    """A camera that moves over a plane: the pattern on it is where it would be at the instant, to a small part of what
    it was off by, and what the image did not show does not count."""
    camera, shift = Camera.from_field_of_view(160, 120, 60.0), np.array([-0.4, 0.1, 0.0])
    shutter = Shutter(delay_frames=0.4, readout=0.7)
    rig = Rig({"cam": MountedCamera(camera, Rigid3.identity(), shutter=shutter)})
    path = {f"{k:05d}": Rigid3(np.eye(3), k * shift) for k in range(3)}

    def pattern(pixels: np.ndarray) -> np.ndarray:
        x, y = (6.0 * camera.rays(pixels.reshape(-1, 2))[:, :2] - shift[:2]).T
        return np.reshape(128 + 50 * np.sin(3 * x + 1) + 50 * np.cos(2.5 * y - x), pixels.shape[:-1])

    centres = camera.pixel_centres()
    late = shutter.late(centres[..., 1] / camera.height)
    focal = camera.focal_px[0] / 6.0
    taken = np.rint(pattern(centres - focal * late[..., None] * shift[:2])).astype(np.uint8)
    grid = np.stack(np.meshgrid(np.linspace(10, 150, 8), np.linspace(10, 110, 6)), axis=-1).reshape(-1, 2)
    then = 6.0 * camera.rays(grid) - shift - shutter.late(grid[:, 1] / camera.height)[:, None] * shift
    tracks = Tracks(
        points=then,
        colors=np.zeros((len(grid), 3), np.uint8),
        point_index=np.arange(len(grid)),
        frame_index=np.ones(len(grid), np.int64),
        camera_index=np.zeros(len(grid), np.int64),
        pixels=grid,
    )
    found = Reconstruction(rig=rig, rig_from_world=path, tracks=tracks)
    ((key, unrolling),) = unrollings(found).items()
    assert key == ("00001", "cam")
    np.testing.assert_allclose(unrolling.depth_mm(centres.reshape(-1, 2)), 6.0, rtol=1e-6)
    frame = Frame(name="00001", cameras=("cam",))
    source = ImageFolder(tmp_path)
    storage.write_image(source.path("00001", "cam"), np.dstack([taken] * 3))
    capture = Capture(handpiece=replace(handpiece("cam"), rig=rig), frames=(frame,), source=source)
    right = unroll_capture(capture, found)
    image, mask = right.image(frame, "cam")[..., 0], right.masks(frame)["cam"] > 0
    off, left = (np.abs(each.astype(float) - pattern(centres))[mask] for each in (taken, image))
    assert left.mean() < 1.0 < 10 < off.mean()
    assert 0.75 < mask.mean() < 0.97
    assert right.source.digest("00001", "cam") != source.digest("00001", "cam")
    assert unroll_capture(capture, replace(found, rig=with_all(rig, lambda shutter: PLAIN))) is capture


def test_keypoints_move_to_where_the_image_that_is_set_right_shows_them():
    rig, path, tracks = film()
    found = Reconstruction(rig=rig, rig_from_world=path, tracks=tracks)
    made = unrollings(found)
    assert set(made) == {(f, c) for f in path for c in rig.names if not rig[c].shutter.is_plain}
    for frame, camera in [("00002", "c0"), ("00003", "c2")]:
        f, c = list(path).index(frame), rig.names.index(camera)
        own = np.flatnonzero((tracks.frame_index == f) & (tracks.camera_index == c))
        cam_from_world = rig[camera].cam_from_rig @ path[frame]
        there = rig[camera].camera.project(cam_from_world.apply(tracks.points[tracks.point_index[own]]))
        right = made[frame, camera].at_instant(tracks.pixels[own])
        before, after = (np.linalg.norm(each - there, axis=1) for each in (tracks.pixels[own], right))
        assert np.median(after) < 0.05 * np.median(before)
        x, y = np.rint(right - 0.5).astype(int).T.clip(0, 499)
        back = cv2.remap(made[frame, camera].map_px, x.astype(np.float32), y.astype(np.float32), cv2.INTER_NEAREST)
        np.testing.assert_allclose(back.reshape(-1, 2) + 0.5, tracks.pixels[own], atol=1.5)
