"""From keypoints, and from images, to metric poses; and what happens where that cannot be."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from builders import CAMERA
from cuspid.geometry import Rigid3
from cuspid.model.pairing import stereo_pairs
from cuspid.model.reconstruction import Expectation, Reconstruction, Tracks
from cuspid.model.rig import MountedCamera, Rig
from cuspid.motion import MotionOptions, locate
from cuspid.motion.frontend.features import detect_all
from cuspid.motion.frontend.least_squares_matching import LeastSquaresOptions
from cuspid.motion.frontend.odometry import Edge, OdometryOptions, chain, polish, triangulate_frame
from cuspid.motion.frontend.pairs import MatchingOptions, index_features
from cuspid.motion.frontend.pictures import Pictures
from cuspid.motion.location import _advice, _loose_notes, locate_features, stereo_ties
from cuspid.runtime.errors import ReconstructionError
from keypoint_films import (
    SIGMA_PX,
    blanked,
    errors,
    make_capture,
    make_handpiece,
    make_path,
    see,
    wrongly_calibrated,
)


def scattered(rig: Rig, truth: Rigid3, seed: int, wrong: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sightings of points by the first three cameras of a rig: with noise of 0.5 px, and a share of them wrong."""
    rng = np.random.default_rng(seed)
    points, cameras = rng.uniform([-2, -2, 4.5], [2, 2, 5.5], (300, 3)), rng.integers(0, 3, 300)
    images = np.stack([each.camera.project((each.cam_from_rig @ truth).apply(points)) for each in rig.cameras.values()])
    seen = images[cameras, np.arange(300)]
    off = np.where(rng.random((300, 1)) < wrong, rng.uniform(-12, 12, seen.shape), rng.normal(0, 0.5, seen.shape))
    return points, seen + off, cameras


@pytest.mark.parametrize("wrong", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("seed", range(3))
def test_polishing_ends_at_the_same_bits_wherever_it_starts(seed: int, wrong: float) -> None:
    """COLMAP's estimates, and what it takes for outliers, differ from call to call: a run that goes on must give the
    mesh that it would have given."""
    rig, rng = make_handpiece().rig, np.random.default_rng(5)
    truth = Rigid3.from_rotation_vector(np.array([0.1, -0.05, 0.2]), np.array([-0.9, 0.1, 0.05]))
    points, pixels, cameras = scattered(rig, truth, seed, wrong)
    starts = [
        Rigid3.from_rotation_vector(*rng.normal(0, size, (2, 3))) @ truth for size in (1e-8, 1e-6, 1e-5, 1e-4, 1e-3)
    ]
    found = [polish(rig, start, points, pixels, cameras, 4.0) for start in starts]
    assert {(pose.matrix.tobytes(), within) for pose, within in found} == {(found[0][0].matrix.tobytes(), found[0][1])}
    pose, within = found[0]
    assert 0 < np.linalg.norm(pose.translation - truth.translation) < 0.05
    errors = [
        np.linalg.norm(each.camera.project((each.cam_from_rig @ pose).apply(points)) - pixels, axis=1)
        for each in rig.cameras.values()
    ]
    assert within == np.sum(np.array(errors)[cameras, np.arange(300)] < 4)
    assert within >= np.floor(300 * (1 - wrong) * 0.9)


def test_sightings_beyond_the_limit_do_not_move_a_pose() -> None:
    rig, truth = make_handpiece().rig, Rigid3(np.eye(3), np.array([-0.9, 0.1, 0.05]))
    points, pixels, cameras = scattered(rig, truth, 3, 0.0)
    usual = polish(rig, truth, points, pixels, cameras, 4.0)
    wrong = pixels[:40] + 20
    behind = points[:40] * [1, 1, -1]
    with_wrong = polish(
        rig,
        truth,
        np.vstack([points, points[:40], behind]),
        np.vstack([pixels, wrong, pixels[:40]]),
        np.concatenate([cameras, cameras[:40], cameras[:40]]),
        4.0,
    )
    assert with_wrong[1] == usual[1]
    assert with_wrong[0].matrix == pytest.approx(usual[0].matrix, abs=1e-8)


def test_polishing_of_junk_ends_with_a_finite_pose() -> None:
    rig, rng = make_handpiece().rig, np.random.default_rng(8)
    for count in (1, 2, 4, 30):
        points, cameras = rng.uniform([-2, -2, 4.5], [2, 2, 5.5], (count, 3)), rng.integers(0, 3, count)
        pose, within = polish(rig, Rigid3.identity(), points, rng.uniform(0, 400, (count, 2)), cameras, 1000.0)
        assert np.isfinite(pose.matrix).all()
        assert 0 <= within <= count


def test_closed_loop_is_metric_and_as_good_as_it_says() -> None:
    """Poses to micrometres, without any scale given; errors fit the covariance."""
    handpiece, path = make_handpiece(), make_path(6)
    squares = []
    for seed in range(3):
        found = locate_features(handpiece, see(handpiece, path, seed=seed), list(path), MotionOptions())
        assert found.frames == tuple(path)
        assert not found.dropped
        off = errors(found, path)
        assert not off[0].any()
        assert 0 < np.abs(off[:, 3:]).max() < 0.01
        covariance = found.pose_covariance[1:]
        squares.append(np.einsum("fi,fi->f", off[1:], np.linalg.solve(covariance, off[1:, :, None])[..., 0]))
        assert found.log["observation_sigma_px"] == pytest.approx(SIGMA_PX, rel=0.1)
    assert 2.5 < np.mean(squares) < 12


def test_tracks_lie_on_the_surface() -> None:
    """The sparse model is in millimetres too, and the observations name images in which it is seen."""
    handpiece, path = make_handpiece(), make_path(4)
    tracks = locate_features(handpiece, see(handpiece, path), list(path), MotionOptions()).tracks
    x, y, z = tracks.points.T
    off = z - (5 + 0.5 * np.sin(1.3 * x) * np.cos(y))
    assert 0 < np.median(np.abs(off)) < 0.01
    assert set(np.unique(tracks.frame_index)) == set(range(4))
    assert set(np.unique(tracks.camera_index)) == set(range(4))
    assert np.all(tracks.colors[np.unique(tracks.point_index)] == 200)


def test_what_lies_behind_the_depth_of_field_is_not_taken_for_nearer() -> None:
    """A scan goes on over a gap, where nothing is in focus but what is far away; farther, it moves less."""
    handpiece, path = make_handpiece(), make_path(4)
    assert handpiece.depth_range_mm[1] < 3.5 * 4.5
    seen = see(handpiece, path, points=1500, scale=3.5)
    found = locate_features(handpiece, seen, list(path), MotionOptions())
    assert found.frames == tuple(path)
    assert 0 < np.abs(errors(found, path)[:, 3:]).max() < 0.03


def test_a_motion_with_which_few_matches_agree_is_none() -> None:
    """Of matches to what is not there, many may agree by chance or by what they have in common."""
    handpiece, path = make_handpiece(), make_path(2)
    seen, names = see(handpiece, path), list(path)
    rng = np.random.default_rng(0)
    for key in seen:
        if key[0] == names[1]:
            mixed = rng.permutation(len(seen[key].pixels))[: int(0.7 * len(seen[key].pixels))]
            pixels = seen[key].pixels.copy()
            pixels[mixed] = rng.permutation(pixels[mixed])
            seen[key] = replace(seen[key], pixels=pixels)
    with pytest.raises(ReconstructionError, match="of its matches to its neighbours agree; too small a share"):
        locate_features(handpiece, seen, names, MotionOptions())


def test_result_is_repeatable() -> None:
    """Bit for bit, whatever the threads do."""
    handpiece, path = make_handpiece(), make_path(4)
    seen = see(handpiece, path)
    one, other = (locate_features(handpiece, seen, list(path), MotionOptions()) for _ in range(2))
    for name, pose in one.rig_from_world.items():
        np.testing.assert_array_equal(pose.matrix, other.rig_from_world[name].matrix)


def test_a_camera_without_an_image_is_left_out_of_that_frame_alone() -> None:
    """The rest of the frame is used, and every frame is placed about as well as with all images."""
    handpiece, path = make_handpiece(), make_path(6)
    seen = see(handpiece, path)
    names = handpiece.rig.names
    missing = {("00001", names[0]), ("00003", names[0]), ("00003", names[2])}
    whole = locate_features(handpiece, seen, list(path), MotionOptions())
    rest = {key: each for key, each in seen.items() if key not in missing}
    found = locate_features(handpiece, rest, list(path), MotionOptions())
    assert found.frames == tuple(path)
    assert 0 < np.abs(errors(found, path)).max() < 3 * np.abs(errors(whole, path)).max()
    images = set(zip(found.tracks.frame_index.tolist(), found.tracks.camera_index.tolist(), strict=True))
    frames = list(path)
    assert not images & {(frames.index(frame), names.index(camera)) for frame, camera in missing}
    assert len(images) == len(path) * len(names) - len(missing)


def test_a_blurred_frame_is_dropped_and_bridged() -> None:
    """Its neighbours are tied to each other at +2; the message says how many matches it had."""
    handpiece, path = make_handpiece(), make_path(6)
    found = locate_features(handpiece, blanked(see(handpiece, path), "00003", keep=4), list(path), MotionOptions())
    assert found.frames == tuple(name for name in path if name != "00003")
    assert [d.what for d in found.dropped] == ["frame 00003"]
    assert "matches to its neighbours; 15 are needed" in found.dropped[0].reason
    assert np.abs(errors(found, path)[:, 3:]).max() < 0.01


def test_of_a_broken_scan_the_largest_part_is_kept() -> None:
    """After frame 3 the handpiece jumps to a place that it had not seen."""
    handpiece, path = make_handpiece(), make_path(7)
    seen = see(handpiece, path)
    elsewhere = see(handpiece, path, seed=1)
    mixed = {key: elsewhere[key] if key[0] > "00003" else f for key, f in seen.items()}
    found = locate_features(handpiece, mixed, list(path), MotionOptions())
    assert found.frames == tuple(path)[:4]
    assert [d.what for d in found.dropped] == [f"frame {name}" for name in tuple(path)[4:]]
    assert "2 others" in found.dropped[0].reason


@pytest.mark.parametrize("points", [0, 12])
def test_too_little_texture_is_told_in_one_line(points: int) -> None:
    """No crash and no poses: how many frames, which not, why, and what to change."""
    handpiece, path = make_handpiece(), make_path(6)
    with pytest.raises(ReconstructionError) as raised:
        locate_features(handpiece, see(handpiece, path, points=points), list(path), MotionOptions())
    message = str(raised.value)
    assert "\n" not in message
    assert "of 6 frames could be placed" in message
    assert "frame 0000" in message
    assert "texture" in message


def test_a_single_frame_is_located_at_the_origin() -> None:
    """One frame is metric by itself."""
    handpiece, path = make_handpiece(), make_path(1)
    found = locate_features(handpiece, see(handpiece, path), list(path), MotionOptions())
    np.testing.assert_array_equal(found.rig_from_world["00000"].matrix, np.eye(4))
    assert len(found.tracks.points) > 20


def test_wrong_matches_do_not_harm() -> None:
    """A third of the descriptors is that of another point."""
    handpiece, path = make_handpiece(), make_path(5)
    rng, seen = np.random.default_rng(0), see(handpiece, path)
    for key, f in seen.items():
        order = np.arange(len(f))
        some = rng.permutation(len(f))[: len(f) // 3]
        order[some] = np.roll(some, 1)
        seen[key] = replace(f, descriptors=f.descriptors[order])
    found = locate_features(handpiece, seen, list(path), MotionOptions())
    assert found.frames == tuple(path)
    assert np.abs(errors(found, path)[:, 3:]).max() < 0.02


def test_an_uncertain_calibration_is_refined() -> None:
    """Given with its covariance, the extrinsic calibration comes back nearer to the truth."""
    truth, path = make_handpiece(), make_path(6)
    nominal = wrongly_calibrated(truth)
    found = locate_features(nominal, see(truth, path), list(path), MotionOptions())

    def relative(rig: Rig) -> np.ndarray:
        b_from_a = rig["b"].cam_from_rig @ rig["a"].cam_from_rig.inverse()
        true = truth.rig["b"].cam_from_rig @ truth.rig["a"].cam_from_rig.inverse()
        return (b_from_a @ true.inverse()).rotation_vector

    assert np.linalg.norm(relative(found.rig)) < 0.3 * np.linalg.norm(relative(nominal.rig))
    assert found.log["observation_sigma_px"] == pytest.approx(SIGMA_PX, rel=0.15)


def test_a_frame_is_triangulated_in_the_rig_frame() -> None:
    """Points of one frame are where they are, seen by two or more cameras of the group only."""
    handpiece, path = make_handpiece(), make_path(1)
    seen = see(handpiece, path)
    views = {c: index_features(seen["00000", c], m.camera) for c, m in handpiece.rig.cameras.items()}
    cloud = triangulate_frame(handpiece, stereo_pairs(handpiece.rig, 5.0), views, MatchingOptions())
    x, y, z = cloud.points.T
    assert len(z) > 100
    assert np.median(np.abs(z - (5 + 0.5 * np.sin(1.3 * x) * np.cos(y)))) < 0.02
    assert np.all(cloud.point_of["side"] == -1)
    depths = cloud.depths(handpiece.rig, "a")
    assert np.nanmin(depths) > 4
    assert np.array_equal(np.isfinite(depths), cloud.point_of["a"] >= 0)


def test_chain_follows_edges_in_both_directions() -> None:
    """Poses come from the edges whatever frame they start at; the first located frame is the world."""
    step = Rigid3.from_rotation_vector(np.array([0, 0, 0.1]), np.array([1.0, 0, 0]))
    none = Edge(target_from_source=None, matches=3, sought=3)
    edges = {
        (0, 1): none,
        (1, 2): Edge(target_from_source=step, matches=90, sought=90),
        (0, 2): none,
        (1, 3): Edge(target_from_source=step @ step, matches=80, sought=80),
        (2, 3): none,
    }
    path = chain(edges, ["p", "q", "r", "s"], OdometryOptions())
    assert list(path.rig_from_world) == [1, 2, 3]
    np.testing.assert_array_equal(path.rig_from_world[1].matrix, np.eye(4))
    np.testing.assert_allclose(
        (path.rig_from_world[3] @ path.rig_from_world[2].inverse()).matrix, step.matrix, atol=1e-12
    )
    assert path.dropped[0].what == "frame p"
    assert path.dropped[0].reason == "only 3 matches to its neighbours; 15 are needed"


# --- images ------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_images_are_located(tmp_path: Path) -> None:
    """Speckled plane, three cameras with distortion, three frames: poses to a few micrometres; stages are reported."""
    rig = Rig({name: m for name, m in make_handpiece().rig.cameras.items() if name != "side"})
    path = {
        f"{k:05d}": Rigid3.from_rotation_vector(np.array([0.03 * k, -0.02 * k, 0.03 * k]), np.array([-0.6 * k, 0, 0]))
        for k in range(3)
    }
    stages: list[str] = []
    capture = make_capture(tmp_path, rig, path)
    found = locate(capture, progress=lambda stage, done, total: stages.append(stage))
    plain = locate(capture, replace(MotionOptions(), least_squares=LeastSquaresOptions(enabled=False)))
    for one, most_mm, max_px in ((found, 0.003, 0.1), (plain, 0.01, 0.5)):
        assert one.frames == tuple(path)
        assert 0 < np.abs(errors(one, path)[:, 3:]).max() < most_mm
        assert 0 < one.reprojection_rms_px < max_px
    assert list(dict.fromkeys(stages)) == ["features", "triangulation", "matching", "patches"]
    assert {"features_s", "odometry_s", "adjustment_s", "observations"} <= set(found.log)


@pytest.mark.long
def test_where_no_patch_is_found_keypoints_are_taken(tmp_path: Path) -> None:
    """As behind glare that comes up after the keypoints were found: nothing is lost but exactness, and that is said."""
    rig = Rig({name: m for name, m in make_handpiece().rig.cameras.items() if name != "side"})
    path = {f"{k:05d}": Rigid3(np.eye(3), np.array([-0.6 * k, 0, 0])) for k in range(3)}
    capture = make_capture(tmp_path, rig, path)
    seen = detect_all(Pictures(capture), MotionOptions().features)

    def read(frame: str, camera: str) -> np.ndarray:
        image = capture.source.read(frame, camera)[..., 0]
        return np.full_like(image, 250) if frame == "00001" else image

    found = locate_features(capture.handpiece, seen, list(path), MotionOptions(), read=read)
    assert found.frames == tuple(path)
    assert 0 < np.abs(errors(found, path)[:, 3:]).max() < 0.01
    assert "1 frames (first: 00001)" in "".join(found.notes)
    assert not locate(capture).notes


def test_what_single_cameras_tie_is_told():
    """Points seen in stereo in frames 0 to 1 and 2 to 3; between them by one camera each, which fixes no length."""
    rows = [(p, f, c) for p in range(20) for f in (0, 1) for c in (0, 1)]
    rows += [(p, f, c) for p in range(20, 40) for f in (2, 3) for c in (0, 1)]
    rows += [(p, f, p % 2) for p in range(40, 90) for f in (1, 2)]
    point, frame, camera = np.array(rows).T
    tracks = Tracks(
        points=np.zeros((90, 3)),
        colors=np.zeros((90, 3), dtype=np.uint8),
        point_index=point,
        frame_index=frame,
        camera_index=camera,
        pixels=np.zeros((len(rows), 2)),
    )
    assert stereo_ties(tracks, 4).tolist() == [20, 0, 20]
    rig = Rig({"a": MountedCamera(CAMERA, Rigid3.identity()), "b": MountedCamera(CAMERA, Rigid3.identity())})
    poses = {f"{k:05d}": Rigid3.identity() for k in range(4)}
    (note,) = _loose_notes(Reconstruction(rig=rig, rig_from_world=poses, tracks=tracks), 15)
    assert "connect frames 00001 and 00002 (0): parts" in note
    assert _loose_notes(Reconstruction(rig=rig, rig_from_world=poses, tracks=tracks), 0) == ()


@pytest.mark.parametrize(
    ("scale_ppm", "span_um", "told"),
    [(100, 8.0, []), (2000, 110.0, ["the scale is known"]), (100, 40.0, ["apart from the scale"])],
)
def test_what_would_tell_more_is_said_where_it_is_loosely_known(
    scale_ppm: float, span_um: float, told: list[str]
) -> None:
    """Over 55 mm: a scale that the calibration leaves open, and a path that may be bent."""
    expected = Expectation(
        points=np.zeros((1, 3)),
        covariance=np.zeros((1, 3, 3)),
        scale_sigma_ppm=float(scale_ppm),
        span_mm=55.0,
        span_sigma_um=span_um,
    )
    found = Reconstruction(
        rig=Rig({"a": MountedCamera(CAMERA, Rigid3.identity())}),
        rig_from_world={"0": Rigid3.identity()},
        expectation=expected,
    )
    notes = list(_advice(found))
    assert len(notes) == len(told)
    assert all(words in note for words, note in zip(told, notes, strict=True))
    assert not list(_advice(replace(found, expectation=None)))
