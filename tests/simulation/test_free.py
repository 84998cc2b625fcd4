"""A camera moved by a shaky hand."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cuspid import storage
from cuspid.cli import main
from cuspid.handpiece.intra_oral import IntraOralOptions, intra_oral_camera
from cuspid.model.arch_curve import arch_curve
from cuspid.model.jaw import Jaw
from cuspid.model.room import Room
from cuspid.runtime.errors import InputError
from cuspid.simulation.path.free import REACH, FreePathOptions, hand_noise, plan_free_path
from horseshoe import horseshoe, with_palate
from verbs import refused

CAMERA = intra_oral_camera()


def poses_of(jaw: Jaw, seed: int = 0, **options: float | str) -> list[np.ndarray]:
    path = plan_free_path(jaw, CAMERA, FreePathOptions(**options), np.random.default_rng(seed))
    return [pose.matrix for pose in path.values()]


def centres_of(poses: list[np.ndarray]) -> np.ndarray:
    eye = CAMERA.rig["camera"].centre_in_rig
    return np.array([pose[:3, :3].T @ (eye - pose[:3, 3]) for pose in poses])


def test_the_camera_of_the_trial_sees_a_tooth_from_14_mm() -> None:
    mounted = CAMERA.rig["camera"]
    np.testing.assert_allclose(mounted.centre_in_rig, [0, 0, 14], atol=1e-12)
    np.testing.assert_allclose(mounted.axis_in_rig, [0, 0, -1], atol=1e-12)
    in_camera = mounted.cam_from_rig.apply(np.array([[8.4, 0, 0], [0, 6.3, 0]]))
    np.testing.assert_allclose(mounted.camera.project(in_camera), [[640, 240], [320, 0]], atol=1.0)


@given(leds=st.integers(1, 12), ring=st.floats(0, 6), distance=st.floats(3, 30))
def test_the_leds_stand_around_the_lens(leds: int, ring: float, distance: float) -> None:
    made = intra_oral_camera(IntraOralOptions(leds=leds, led_ring_mm=ring, working_distance_mm=distance))
    offsets = [light.position_mm - made.rig["camera"].centre_in_rig for light in made.lights.values()]
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), ring, atol=1e-9)
    assert len(made.lightings[0].lights) == leds


@pytest.mark.parametrize(
    "wrong", [{"width_px": 0}, {"field_of_view_deg": 180.0}, {"working_distance_mm": 0.0}, {"leds": 0}]
)
def test_impossible_cameras_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match="intra oral: --"):
        IntraOralOptions(**wrong)


def test_the_same_seed_gives_the_same_hand(coarse_phantom: Jaw) -> None:
    np.testing.assert_array_equal(poses_of(coarse_phantom), poses_of(coarse_phantom))
    assert np.abs(np.subtract(poses_of(coarse_phantom), poses_of(coarse_phantom, seed=1))).max() > 0.5


def test_a_steady_hand_goes_evenly_along_the_arch(coarse_phantom: Jaw) -> None:
    poses = poses_of(coarse_phantom, shake=0.0, frames=40)
    curve = arch_curve(coarse_phantom)
    steps = np.linalg.norm(np.diff([np.linalg.inv(pose)[:3, 3] for pose in poses], axis=0), axis=1)
    np.testing.assert_allclose(steps, curve.lengths_mm[-1] / 39, rtol=0.02)
    np.testing.assert_allclose(np.linalg.inv(poses[0])[:3, 3], curve.points[0], atol=1e-9)
    np.testing.assert_allclose(np.linalg.inv(poses[-1])[:3, 3], curve.points[-1], atol=1e-9)


def test_noise_has_the_spread_that_is_asked_and_a_bound() -> None:
    noise = hand_noise(FreePathOptions(frames=20_000), 6, np.random.default_rng(0))
    # The bound takes a little of the spread: the sd of 2.5 tanh(x / 2.5) is 0.89 for a standard normal x.
    assert np.all(np.abs(noise.std(axis=0) - 0.89) < 0.05)
    assert np.abs(noise).max() <= REACH
    correlations = np.corrcoef(noise.T) - np.eye(6)
    assert np.abs(correlations).max() < 0.15


@pytest.mark.parametrize(("tremor", "least", "most"), [(0.0, 0.06, 0.14), (0.15, 0.10, 0.20), (1.0, 0.45, 0.8)])
def test_the_tremor_is_quick_and_the_drift_slow(tremor: float, least: float, most: float) -> None:
    noise = hand_noise(FreePathOptions(frames=5000, tremor=tremor), 1, np.random.default_rng(0))
    assert least < np.diff(noise, axis=0).std() < most


def test_a_full_shake_spreads_as_documented(coarse_phantom: Jaw) -> None:
    steady = np.array(poses_of(coarse_phantom, shake=0.0, speed=0.0, frames=300))
    shaken = np.array(poses_of(coarse_phantom, shake=1.0, speed=0.0, frames=300))
    moved = shaken @ np.linalg.inv(steady)
    spread = moved[:, :3, 3].std(axis=0) / [1.0, 1.0, 1.5]
    assert np.all((spread > 0.5) & (spread < 1.3))
    tilts = np.rad2deg(np.arccos(moved[:, 2, 2]))
    assert 4 < np.sqrt(np.mean(tilts**2)) < 11
    half = np.array(poses_of(coarse_phantom, shake=0.5, speed=0.0, frames=300)) @ np.linalg.inv(steady)
    np.testing.assert_allclose(half[:, :3, 3], moved[:, :3, 3] / 2, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_the_camera_never_comes_near_the_teeth_and_never_turns_back(coarse_phantom: Jaw, seed: int) -> None:
    poses = poses_of(coarse_phantom, seed=seed)
    centres = centres_of(poses)
    assert coarse_phantom.mesh.closest(centres)[0].min() > 14 - 1.5 * REACH - 2


def test_the_hand_goes_at_a_changing_speed_but_never_back(coarse_phantom: Jaw) -> None:
    spreads = []
    for seed in range(4):
        poses = poses_of(coarse_phantom, seed, position_mm=0.0, distance_mm=0.0, tilt_deg=0.0, turn_deg=0.0)
        steps = np.diff([np.linalg.inv(pose)[:3, 3] for pose in poses], axis=0)
        assert np.sum(steps[1:] * steps[:-1], axis=1).min() > 0
        spreads.append(np.log(np.linalg.norm(steps, axis=1)).std())
    assert 0.2 < np.mean(spreads) < 0.45


def test_a_return_ends_where_it_began_and_passes_each_place_twice(coarse_phantom: Jaw) -> None:
    poses = np.array(poses_of(coarse_phantom, shake=0.0, frames=41, path="return"))
    np.testing.assert_allclose(poses, poses[::-1], atol=1e-9)
    np.testing.assert_allclose(poses[:21], poses_of(coarse_phantom, shake=0.0, frames=21), atol=1e-9)


def test_an_s_shape_swings_about_the_same_places(coarse_phantom: Jaw) -> None:
    straight, swung = (
        np.array(poses_of(coarse_phantom, shake=0.0, frames=200, path=path)) for path in ("arch", "s-shape")
    )
    rolls = Rotation.from_matrix((swung @ np.linalg.inv(straight))[:, :3, :3]).as_rotvec()
    np.testing.assert_allclose(rolls[:, 1:], 0, atol=1e-9)
    assert np.rad2deg(np.min(rolls)) == pytest.approx(-20, abs=0.3)
    assert np.rad2deg(np.max(rolls)) == pytest.approx(20, abs=0.3)
    places = [np.linalg.inv(poses)[:, :3, 3] for poses in (straight, swung)]
    np.testing.assert_allclose(places[0], places[1], atol=1e-9)


def test_a_way_across_ends_on_the_other_side_without_jumps() -> None:
    upper = with_palate(horseshoe(), 6.0)
    poses = poses_of(upper, shake=0.0, frames=200, path="cross")
    places, curve = np.linalg.inv(poses)[:, :3, 3], arch_curve(upper)
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps.max() < 1.6 * np.median(steps), "down into the vault and up again"
    end = np.argmin(np.linalg.norm(curve.points - places[-1], axis=1))
    assert curve.lengths_mm[end] < 0.2 * curve.lengths_mm[-1]
    np.testing.assert_allclose(places[0], curve.points[0], atol=1e-9)


def test_where_nothing_lies_between_the_sides_there_is_no_way_across() -> None:
    with pytest.raises(InputError, match="no surface between the sides"):
        poses_of(horseshoe(), path="cross")


def test_a_camera_that_would_touch_the_teeth_is_lifted(coarse_phantom: Jaw) -> None:
    near = intra_oral_camera(IntraOralOptions(working_distance_mm=3.0))
    room = Room(coarse_phantom.mesh, near.solid, 2.0)
    free, kept = (
        plan_free_path(coarse_phantom, near, FreePathOptions(clearance_mm=mm), np.random.default_rng(0))
        for mm in (0.0, 2.0)
    )
    assert min(room.clearance(pose)[0] for pose in free.values()) < 2
    assert 1.98 < min(room.clearance(pose)[0] for pose in kept.values()) < 2.5
    for name, pose in kept.items():
        lift = pose @ free[name].inverse()
        np.testing.assert_allclose(lift.rotation, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(lift.translation[:2], 0, atol=1e-9)
        assert lift.translation[2] <= 1e-9


@pytest.mark.parametrize(
    "wrong", [{"frames": 1}, {"shake": -1.0}, {"speed": -0.1}, {"tremor": 1.5}, {"drift_frames": 0.0}]
)
def test_impossible_hands_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match="free path"):
        FreePathOptions(**wrong)


SMALL = ("--camera.width-px", "64", "--camera.height-px", "48", "--supersampling", "1", "--frames", "3")


@pytest.mark.long
def test_film_writes_what_stitch_and_its_evaluation_read(coarse_phantom: Jaw, tmp_path: Path) -> None:
    storage.write_jaw(tmp_path / "jaw.ply", coarse_phantom)
    main(["pano", "film", str(tmp_path / "jaw.ply"), "--out", str(tmp_path / "film"), "--video", *SMALL])
    capture = storage.read_capture(tmp_path / "film" / "capture")
    truth = storage.read_truth(tmp_path / "film" / "truth")
    assert [frame.name for frame in capture.frames] == list(truth.rig_from_world) == ["00000", "00001", "00002"]
    assert capture.image(capture.frames[1], "camera").mean() > 20
    assert (tmp_path / "film" / "film.mp4").stat().st_size > 500


def test_a_refused_film_leaves_nothing(coarse_phantom: Jaw, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    storage.write_jaw(tmp_path / "jaw.ply", coarse_phantom)
    near = ("--clearance-mm", "60")
    refused(capsys, "pano", "film", tmp_path / "jaw.ply", "--out", tmp_path / "film", *SMALL, *near)
    assert not (tmp_path / "film").exists()
