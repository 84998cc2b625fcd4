"""Stitching, against a short film of the phantom whose true poses are known, and its parts against their laws."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from cuspid import storage
from cuspid.cli import main
from cuspid.geometry import Rigid3, best_similarity
from cuspid.handpiece.intra_oral import IntraOralOptions, intra_oral_camera
from cuspid.model.arch_curve import arch_curve
from cuspid.model.camera import Camera
from cuspid.model.capture import Capture
from cuspid.model.image_sequence import ImageSequence
from cuspid.model.jaw import Jaw
from cuspid.model.reconstruction import Tracks
from cuspid.model.sparse_model import SparseModel
from cuspid.model.trueness import GroundTruth
from cuspid.motion.monocular.single import SingleOptions, locate_single, mouth_share, normalise_contrast
from cuspid.pipeline.panorama import StitchOptions, require_content, stitch
from cuspid.pipeline.scan import RenderOptions, take_images
from cuspid.runtime.errors import InputError, ReconstructionError
from cuspid.simulation.path.free import FreePathOptions, plan_free_path
from cuspid.stitching.gain_compensation import GainOptions, Samples, balance
from cuspid.stitching.height_map import HeightMapOptions, ScaleOptions, height_map, in_occlusal_frame
from cuspid.stitching.mosaic import unlit
from cuspid.stitching.ortho import Stitched
from cuspid.stitching.plane_sweep import PlaneSweepOptions
from cuspid.stitching.seams import SeamOptions, choose
from panoramas import seen_points
from verbs import refused

FRAMES = 12


@pytest.fixture(scope="module")
def film(coarse_phantom: Jaw, tmp_path_factory: pytest.TempPathFactory) -> tuple[Capture, GroundTruth]:
    """A small camera moved over three teeth, tilting a little, with the strong texture."""
    folder = tmp_path_factory.mktemp("film")
    camera = intra_oral_camera(IntraOralOptions(width_px=320, height_px=240))
    curve = arch_curve(coarse_phantom)
    rng = np.random.default_rng(4)
    poses = {}
    for index, length in enumerate(np.linspace(14.0, 26.0, FRAMES)):
        shake = Rigid3.from_rotation_vector(np.deg2rad(rng.normal(0, 2.0, 3)), rng.normal(0, 0.3, 3))
        poses[f"{index:03d}"] = shake @ curve.rig_from_world(float(length))
    return take_images(coarse_phantom, camera, poses, folder, RenderOptions(texture="artificial", supersampling=1))


@pytest.fixture(scope="module")
def sequence(film: tuple[Capture, GroundTruth], tmp_path_factory: pytest.TempPathFactory) -> ImageSequence:
    return storage.read_sequence(film[0].source.folder, tmp_path_factory.mktemp("decoded"))


@pytest.fixture(scope="module")
def stitched(sequence: ImageSequence) -> Stitched:
    (whole,) = stitch(sequence, StitchOptions())
    return whole


@pytest.mark.long
def test_every_frame_is_placed_and_pixels_show_what_lies_there(
    stitched: Stitched, film: tuple[Capture, GroundTruth], sequence: ImageSequence
) -> None:
    panorama = stitched.panorama
    assert [frame.name for frame in panorama.frames if frame.used] == [f"{n:03d}" for n in range(FRAMES)]
    assert sequence.camera is not None
    here, true = seen_points(panorama, film[1], sequence.camera)
    scale, rotation, shift = best_similarity(here, true[:, :2])
    errors = np.linalg.norm(scale * here @ rotation.T + shift - true[:, :2], axis=1)
    assert 0.9 < scale < 1.12
    # Here the smoothness of the surface limits it, see the next test for the poses.
    assert 0.001 < np.median(errors) < 0.25
    assert np.percentile(errors, 95) < 1.3


@pytest.mark.long
def test_the_camera_was_where_it_is_found(stitched: Stitched, film: tuple[Capture, GroundTruth]) -> None:
    assert stitched.motion is not None
    from_rig = film[1].handpiece.rig["camera"].cam_from_rig
    found = np.array([pose.inverse().translation for pose in stitched.motion.cam_from_world.values()])
    true = np.array([(from_rig @ pose).inverse().translation for pose in film[1].rig_from_world.values()])
    scale, rotation, shift = best_similarity(found, true)
    errors = np.linalg.norm(scale * found @ rotation.T + shift - true, axis=1)
    assert 1e-5 < errors.max() < 0.1


@pytest.mark.long
def test_the_panorama_is_not_mirrored_and_heights_are_those_of_the_jaw(
    stitched: Stitched, film: tuple[Capture, GroundTruth], sequence: ImageSequence
) -> None:
    panorama = stitched.panorama
    assert sequence.camera is not None
    assert panorama.height_mm is not None
    here, true = seen_points(panorama, film[1], sequence.camera)
    _, rotation, _ = best_similarity(here, true[:, :2])
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    pixels = np.floor(panorama.pixels_from_world(here)).astype(int)
    heights = panorama.height_mm[pixels[:, 1], pixels[:, 0]]
    assert np.corrcoef(heights, true[:, 2])[0, 1] > 0.4


@pytest.mark.long
def test_overlaps_inliers_and_notes_are_told(stitched: Stitched) -> None:
    frames = stitched.panorama.frames
    assert frames[0].overlap is None
    assert all(0.6 < frame.overlap <= 1 for frame in frames[1:] if frame.overlap is not None)
    assert all(frame.inliers is not None and frame.inliers > 30 for frame in frames)
    assert any("14 mm over the teeth" in note for note in stitched.panorama.notes)
    assert not any("came back" in note for note in stitched.panorama.notes)
    assert not any("found again on the surface" in note for note in stitched.panorama.notes)


@pytest.mark.long
def test_a_path_that_the_surface_does_not_hold_stays_and_a_note_tells(
    sequence: ImageSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cuspid.pipeline.panorama.require_content", tuple)  # there is no picture without a surface
    options = StitchOptions(plane_sweep=PlaneSweepOptions(agreement=0.99))
    (made,) = stitch(sequence, options)
    assert all(frame.used for frame in made.panorama.frames)
    assert any("found again on the surface" in note for note in made.panorama.notes)


@pytest.mark.long
def test_the_strip_is_as_long_as_the_way_of_the_camera(stitched: Stitched) -> None:
    strip = stitched.strip
    assert strip is not None
    assert strip.mm_per_px == stitched.panorama.mm_per_px
    length = np.linalg.norm(np.diff(strip.curve, axis=0), axis=1).sum()
    # The camera goes 12 mm, and sees some 8 mm farther at both ends.
    assert 18 < length < 30
    middle = strip.zone[strip.zone.shape[0] // 2]
    assert np.mean(middle == 1) > 0.9
    assert 2 in strip.zone
    assert np.all((strip.zone >= 0) == strip.covered)


@pytest.mark.long
def test_two_runs_on_the_same_frames_are_alike(stitched: Stitched, sequence: ImageSequence) -> None:
    (again,) = stitch(sequence, StitchOptions())
    assert stitched.motion is not None
    assert again.motion is not None
    for name, pose in stitched.motion.cam_from_world.items():
        np.testing.assert_array_equal(again.motion.cam_from_world[name].matrix, pose.matrix)
    np.testing.assert_array_equal(again.panorama.image, stitched.panorama.image)
    np.testing.assert_array_equal(again.panorama.frame_pixel, stitched.panorama.frame_pixel)


@pytest.mark.long
def test_a_video_is_stitched_from_the_command_line_and_its_folder_takes_no_other(
    film: tuple[Capture, GroundTruth], sequence: ImageSequence, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def video(name: str, indices: range) -> Path:
        stream = cv2.VideoWriter(str(tmp_path / name), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, sequence.size)
        for index in indices:
            stream.write(cv2.cvtColor(sequence.image(index), cv2.COLOR_RGB2BGR))
        stream.release()
        return tmp_path / name

    command = ["--calibration", str(film[0].source.folder / "handpiece.json"), "--out", str(tmp_path / "out")]
    main(["pano", "stitch", str(video("whole.avi", range(8))), *command])
    panorama = storage.read_panorama(tmp_path / "out")
    assert [frame.name for frame in panorama.frames if frame.used] == [f"{n:05d}" for n in range(8)]
    assert "another run of 'decode'" in refused(capsys, "pano", "stitch", video("other.avi", range(4, 12)), *command)


@pytest.mark.long
def test_one_camera_without_a_calibration_finds_its_focal_length(sequence: ImageSequence) -> None:
    motion = locate_single(replace(sequence, camera=None, working_distance_mm=None), SingleOptions())
    assert len(motion.parts) == 1
    assert sequence.camera is not None
    focal = motion.parts[0].camera.focal_px[0]
    assert focal == pytest.approx(sequence.camera.focal_px[0], rel=0.12)
    assert "self-calibrated" in motion.notes[0]


# --- bad sequences -----------------------------------------------------------------------------------------------


def images_in(folder: Path, images: list[np.ndarray]) -> ImageSequence:
    for index, image in enumerate(images):
        storage.write_image(folder / f"{index:03d}.png", image)
    return storage.read_sequence(folder, folder / "decoded")


@pytest.mark.long
def test_a_way_back_is_tied_to_the_way_there(coarse_phantom: Jaw, tmp_path: Path) -> None:
    camera = intra_oral_camera(IntraOralOptions(width_px=320, height_px=240))
    path = FreePathOptions(path="return", frames=60, shake=0.3)
    poses = plan_free_path(coarse_phantom, camera, path, np.random.default_rng(0))
    near = dict(list(poses.items())[20:40])
    take_images(coarse_phantom, camera, near, tmp_path, RenderOptions(texture="artificial", supersampling=1))
    again = storage.read_sequence(tmp_path / "capture", tmp_path / "decoded")
    motion = locate_single(again, SingleOptions(revisit_frames=5))
    assert any("the camera came back" in note for note in motion.notes)
    (found,) = motion.parts
    assert len(found.frames) == len(near)
    first, last = (np.full(len(found.tracks.points), pick, dtype=np.int64) for pick in (99, -1))
    np.minimum.at(first, found.tracks.point_index, found.tracks.frame_index)
    np.maximum.at(last, found.tracks.point_index, found.tracks.frame_index)
    assert np.sum((first <= 1) & (last >= len(near) - 2)) > 50, "none by steps and patches alone"


def test_a_black_or_blurred_frame_and_a_repeated_one_are_left_out_with_a_reason(
    sequence: ImageSequence, tmp_path: Path
) -> None:
    images = [sequence.image(index) for index in range(8)]
    images[2] = np.zeros_like(images[2])
    images[4] = cv2.GaussianBlur(images[4], (0, 0), 8)
    images[6] = images[5]
    broken = replace(images_in(tmp_path, images), camera=sequence.camera)
    motion = locate_single(broken, SingleOptions())
    reasons = {frame.name: frame.reason for frame in motion.frames if not frame.used}
    assert list(reasons) == ["002", "004", "006"]
    assert reasons["002"] == "black"
    assert "blurred" in str(reasons["004"])
    assert "same picture as 005" in str(reasons["006"])


def test_a_black_sequence_is_one_clear_line(tmp_path: Path) -> None:
    dark = images_in(tmp_path, [np.zeros((240, 320, 3), np.uint8)] * 4)
    with pytest.raises(ReconstructionError, match=r"4 of 4 frames \(000 to 003\) cannot be used: black"):
        locate_single(dark, SingleOptions())


def test_frames_that_have_nothing_in_common_are_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    noise = [cv2.GaussianBlur(rng.integers(0, 255, (240, 320, 3), dtype=np.uint8), (0, 0), 2) * 3 for _ in range(4)]
    with pytest.raises(ReconstructionError, match="000 to 003 have nothing in common"):
        locate_single(images_in(tmp_path, noise), SingleOptions())


@pytest.mark.long
def test_two_films_are_stitched_as_two_parts(sequence: ImageSequence, tmp_path: Path) -> None:
    """The two ends of the film, mirrored and turned for the second: no verified pair joins them."""
    first = [sequence.image(index) for index in range(5)]
    second = [np.ascontiguousarray(sequence.image(index)[::-1]) for index in range(7, 12)]
    both = replace(images_in(tmp_path, first + second), camera=sequence.camera)
    parts = stitch(both, StitchOptions())
    assert len(parts) == 2
    assert [part.panorama.part for part in parts] == [1, 2]
    assert all(part.panorama.parts == 2 for part in parts)
    assert "broke into 2 parts" in parts[0].panorama.notes[0]
    assert any(frame.reason == "in part 2" for frame in parts[0].panorama.frames)


@pytest.mark.long
def test_an_empty_picture_is_no_panorama(stitched: Stitched) -> None:
    """Of frames that hardly overlap it was one of status 0 without a pixel."""
    assert require_content([stitched]) == (stitched,)
    nothing = np.zeros_like(stitched.panorama.covered)
    empty = replace(stitched, panorama=replace(stitched.panorama, covered=nothing))
    assert len(require_content([empty, stitched])) == 2
    with pytest.raises(ReconstructionError, match=rf"the {FRAMES} frames that were placed give no picture; take them"):
        require_content([empty])
    assert stitched.motion is not None
    tracks = stitched.motion.tracks
    few = replace(tracks, **{name: getattr(tracks, name)[:40] for name in OF_OBSERVATIONS})
    with pytest.raises(ReconstructionError, match=r"no picture, as neighbours share only \d+ points; take them"):
        require_content([replace(empty, motion=replace(stitched.motion, tracks=few))])


OF_OBSERVATIONS = ("point_index", "frame_index", "camera_index", "pixels")


# --- parts -------------------------------------------------------------------------------------------------------


def test_contrast_is_evened_but_neither_noise_in_the_dark_nor_a_highlight_is_raised() -> None:
    rng = np.random.default_rng(0)
    image = np.full((160, 160, 3), 4, np.uint8) + rng.integers(0, 8, (160, 160, 1), dtype=np.uint8)
    image[:, 80:] = 255 - rng.integers(0, 8, (160, 80, 1), dtype=np.uint8)
    even = normalise_contrast(image, SingleOptions())
    assert even[40:120, 10:60].std() == 0
    assert even[40:120, 100:150].std() == 0


def test_gains_and_falloff_are_found_and_burnt_out_samples_do_not_count() -> None:
    rng = np.random.default_rng(5)
    cells, frames = 400, 6
    gains = rng.normal(0, 0.15, frames)
    gains -= gains.mean()
    own = rng.normal(4.5, 0.2, cells)
    samples = Samples.empty()
    for frame in range(frames):
        falloff = rng.normal(-5, 0.3, cells)
        level = np.exp(own + gains[frame] + 0.45 * falloff + 2.25)
        usable = (rng.random(cells) > 0.3).reshape(20, 20)
        level[~usable.ravel()] = 255.0
        color = np.repeat(level, 3).reshape(20, 20, 3)
        samples.take(frame, (slice(0, 20), slice(0, 20)), 20, color, falloff.reshape(20, 20), usable)
    light = balance(samples, frames, GainOptions())
    np.testing.assert_allclose(light.gains, gains, atol=0.03)
    assert 0.4 < light.exponent < 0.5


def test_a_burnt_out_place_is_taken_from_another_frame_and_lone_cells_are_not() -> None:
    options = SeamOptions()
    tangent2 = np.full((2, 12, 12), 0.01)
    tangent2[1] = 0.03
    glare = np.zeros((2, 12, 12))
    glare[0, 4:8, 4:8] = 1.0
    tangent2[1, 10, 10] = 0.009
    cost = np.stack([options.cost(tangent2[k], np.full((12, 12), 99.0), glare[k]) for k in range(2)])
    frame = np.stack([np.full((12, 12), k) for k in range(2)]).astype(np.int16)
    chosen = choose(cost.astype(np.float32), frame, np.zeros((2, 12, 12, 3), np.float32), options)
    assert np.all(chosen[4:8, 4:8] == 1)
    assert chosen[10, 10] == 0
    assert chosen[0, 0] == 0


def motion_over(points: np.ndarray, rng: np.random.Generator) -> SparseModel:
    """A camera 14 mm over a horseshoe path that sees points, in a model turned, moved and scaled at random."""
    angles = np.linspace(np.deg2rad(200), np.deg2rad(-20), 30)
    model_from_world = Rigid3.from_rotation_vector(rng.normal(0, 1, 3), rng.normal(0, 20, 3))
    scale = float(rng.uniform(0.1, 3))
    down = np.diag([1.0, -1.0, -1.0])
    poses = {}
    for index, angle in enumerate(angles):
        centre = np.array([25 * np.cos(angle), 30 * np.sin(angle), 14.0])
        cam_from_world = Rigid3(down, -down @ centre)
        moved = cam_from_world @ model_from_world.inverse()
        poses[f"{index}"] = Rigid3(moved.rotation, scale * moved.translation)
    number = np.arange(len(points))
    return SparseModel(
        camera=Camera.from_field_of_view(640, 480, 62.0),
        cam_from_world=poses,
        tracks=Tracks(
            points=scale * model_from_world.apply(points),
            colors=np.zeros((len(points), 3), np.uint8),
            point_index=np.repeat(number, 3),
            frame_index=np.repeat(number % 28, 3) + np.tile([0, 1, 2], len(points)),
            camera_index=np.zeros(3 * len(points), np.int64),
            pixels=np.zeros((3 * len(points), 2)),
        ),
    )


def horseshoe_points(rng: np.random.Generator) -> np.ndarray:
    """Tops at z about 0, gum 5 mm below beside them."""
    angles = rng.uniform(np.deg2rad(-20), np.deg2rad(200), 4000)
    aside = rng.uniform(-7, 7, 4000)
    z = np.where(np.abs(aside) < 4, rng.uniform(-2.0, 0.0, 4000), -5.0)
    return np.stack([(25 + aside) * np.cos(angles), (30 + aside) * np.sin(angles), z], axis=1)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_occlusal_frame_is_found_whatever_the_model_was(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = horseshoe_points(rng)
    found = in_occlusal_frame(motion_over(points, rng), ScaleOptions(working_distance_mm=14.0))
    assert found.tracks is not None
    scale, rotation, _ = best_similarity(points, found.tracks.points)
    assert scale == pytest.approx(1.0, abs=0.06)
    assert np.rad2deg(np.arccos(rotation[2, 2])) < 1.0
    assert np.rad2deg(np.arctan2(rotation[1, 0], rotation[0, 0])) == pytest.approx(0.0, abs=3.0)
    assert np.percentile(found.tracks.points[:, 2], 98) == pytest.approx(0.0, abs=1.0)


def test_a_known_width_sets_the_scale() -> None:
    rng = np.random.default_rng(7)
    found = in_occlusal_frame(motion_over(horseshoe_points(rng), rng), ScaleOptions(width_mm=58.0))
    assert found.tracks is not None
    teeth = found.tracks.points[np.abs(found.tracks.points[:, 2]) < 3]
    assert np.ptp(teeth[:, 0]) == pytest.approx(58.0, rel=0.03)
    with pytest.raises(InputError, match="width-mm"):
        ScaleOptions(width_mm=-1.0)


def test_the_height_map_follows_the_points_and_is_known_everywhere() -> None:
    rng = np.random.default_rng(2)
    points = horseshoe_points(rng)
    found = in_occlusal_frame(motion_over(points, rng), ScaleOptions(working_distance_mm=14.0))
    assert found.tracks is not None
    scale, rotation, shift = best_similarity(points, found.tracks.points)
    top, gum = scale * np.array([[0.0, 30.0, -1.0], [0.0, 36.0, -5.0]]) @ rotation.T + shift
    surface = height_map(found, HeightMapOptions())
    assert np.isfinite(surface.heights).all()
    heights = surface.interpolate(np.array([[top[:2], gum[:2]]])).ravel()
    np.testing.assert_allclose(heights, [top[2], gum[2]], atol=0.7)


@pytest.mark.parametrize(
    ("color", "alike"),
    [
        ((215, 200, 160), 1),
        ((190, 80, 75), 1),
        ((200, 200, 200), 1),
        ((60, 90, 200), 0),
        ((50, 160, 60), 0),
        ((5, 5, 9), 1),
    ],
)
def test_colours_of_a_mouth_are_told_from_others(color: tuple[int, int, int], alike: float) -> None:
    assert mouth_share(np.full((20, 20, 3), color, np.uint8)) == alike


def test_frames_of_other_colours_are_noted_by_name(sequence: ImageSequence, tmp_path: Path) -> None:
    blue = np.array([0.3, 0.5, 1.0])
    images = [sequence.image(0), *((sequence.image(index) * blue).astype(np.uint8) for index in range(1, 6))]
    notes = locate_single(images_in(tmp_path, images)).notes
    assert any("5 of 6 frames" in note and "is this a film of teeth" in note for note in notes)


def test_the_dark_beyond_the_jaw_is_nothing_but_a_dark_fissure_is_kept() -> None:
    image = np.full((200, 200, 3), 120, np.uint8)
    image[:, 100:] = 2
    image[95:101, :80] = 0
    dark = unlit(image)
    assert dark[:, 106:].all()
    assert not dark[:, :97].any()
