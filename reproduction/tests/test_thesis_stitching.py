"""The method of chapter 4 of the thesis: its steps against their laws, and a pan whose true places are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from builders import write_frames
from cuspid import cli, storage
from cuspid.model.camera import Camera
from cuspid.model.panorama import Panorama
from cuspid.pipeline.panorama import StitchOptions, stitch
from cuspid.runtime.errors import InputError, ReconstructionError
from cuspid_thesis.stitching.examination import ExaminationOptions, examine, frame_corners, inner_angles_deg, warp
from cuspid_thesis.stitching.method import ThesisOptions, stitch_as_thesis
from cuspid_thesis.stitching.normal_map import normal_map, rectify
from cuspid_thesis.stitching.placing import Canvas, Placed, frame_pixels, stretch
from cuspid_thesis.stitching.shading import Shape, shape_of_light
from cuspid_thesis.stitching.warps import SEGMENT_PX, WarpOptions, centroids, location_weights, weighted_dlt
from verbs import refused

CAMERA = Camera.from_field_of_view(160, 120, 62.0)
SIZE = (640, 480)


# --- shape from shading ----------------------------------------------------------------------------------------------


def directions() -> np.ndarray:
    rays = CAMERA.rays(CAMERA.pixel_centres())
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def plane(normal: list[float], distance: float = 14.0) -> tuple[np.ndarray, np.ndarray]:
    """Distance along each ray, and normals."""
    unit = np.array(normal) / np.linalg.norm(normal)
    rays = directions()
    return -distance / (rays @ unit), np.broadcast_to(unit, rays.shape)


def sphere(centre: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Distance along each ray (NaN beside it), and normals."""
    rays = directions()
    middle = rays @ centre
    root = middle**2 - centre @ centre + radius**2
    distance = middle - np.sqrt(np.where(root > 0, root, np.nan))
    return distance, (distance[..., None] * rays - centre) / radius


def shaded(distance: np.ndarray, normals: np.ndarray, iterations: int = 60) -> Shape:
    """The shape that is found from the light of a lamp at the camera."""
    cosine = -np.sum(normals * directions(), axis=-1)
    light = np.nan_to_num(300.0 * cosine / distance**2).astype(np.float32)
    return shape_of_light(light, light > 0, CAMERA, iterations)


def angles_deg(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    return np.asarray(np.rad2deg(np.arccos(np.clip(np.sum(found * true, axis=-1), -1, 1))))


@pytest.mark.parametrize("normal", [[0.0, 0.0, -1.0], [0.2, -0.1, -1.0], [-0.3, 0.25, -1.0]])
def test_shading_recovers_a_plane(normal: list[float]) -> None:
    distance, normals = plane(normal)
    found = shaded(distance, normals)
    assert 0 < np.percentile(angles_deg(found.normals, normals), 95) < 0.5
    ratio = found.depth / (distance * directions()[..., 2])
    assert 0 < np.std(ratio / np.median(ratio)) < 2e-3


def test_shading_recovers_a_sphere_and_shows_nothing_beside_it() -> None:
    distance, normals = sphere(np.array([1.0, 0.5, 14.0]), 5.0)
    found = shaded(distance, normals)
    inner = cv2.erode(np.isfinite(distance).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    error = angles_deg(found.normals, normals)[inner]
    assert 0 < np.median(error) < 1.0
    assert error.max() < 3.0
    ratio = (found.depth / (distance * directions()[..., 2]))[inner]
    assert np.ptp(ratio) / np.median(ratio) < 0.02
    np.testing.assert_array_equal(found.known, np.isfinite(distance))
    np.testing.assert_array_equal(found.normals[~found.known], np.broadcast_to([0, 0, -1], ((~found.known).sum(), 3)))


def test_spheres_about_the_camera_are_as_far_as_their_light_tells() -> None:
    """No slope is to be found, away from the gap between them: one iteration at each size is enough."""
    light = np.zeros((120, 160), np.float32)
    light[:, :90], light[:, 100:] = 1.0, np.exp(-1)
    found = shape_of_light(light, light > 0, CAMERA, 1)
    distance = np.log(found.depth / directions()[..., 2])
    np.testing.assert_allclose(distance[:, :86], 0, atol=1e-3)
    np.testing.assert_allclose(distance[:, 104:], 0.5, atol=1e-3)


def test_brightness_only_scales_the_depth() -> None:
    distance, normals = plane([0.2, -0.1, -1.0])
    light = (-np.sum(normals * directions(), axis=-1) / distance**2).astype(np.float32)
    dim, bright = (shape_of_light(light * factor, light > 0, CAMERA, 20) for factor in (np.float32(1), np.float32(50)))
    np.testing.assert_allclose(dim.normals, bright.normals, atol=1e-3)


# --- the normal map --------------------------------------------------------------------------------------------------


@given(st.floats(0, 1.4), st.floats(-3.1, 3.1))
def test_crossed_normals_lie_in_the_image_plane_and_are_as_long_as_the_sine(tilt: float, turn: float) -> None:
    normal = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])
    crossed = rectify(np.broadcast_to(normal.astype(np.float32), (12, 12, 3)), 9)
    np.testing.assert_allclose(crossed @ normal, 0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(crossed, axis=-1), np.sin(tilt), atol=1e-6)
    np.testing.assert_allclose(crossed[..., 2], 0, atol=1e-7)
    picture = normal_map(crossed)
    np.testing.assert_allclose(picture[..., 2], np.cos(tilt), atol=1e-3)
    assert picture.min() >= 0
    assert picture.max() <= 1


def test_the_mean_filter_spreads_a_normal_over_its_window() -> None:
    normals = np.broadcast_to(np.array([0, 0, -1], np.float32), (31, 31, 3)).copy()
    normals[15, 15] = (1, 0, 0)
    changed = np.abs(rectify(normals, 9)).max(axis=-1) > 1e-9
    assert changed.sum() == 81
    np.testing.assert_allclose(rectify(normals, 9)[15, 15, 1], 1 / 81, rtol=1e-5)


# --- the examination -------------------------------------------------------------------------------------------------


def about_centre(linear: list[list[float]], shift: tuple[float, float] = (0, 0), width: int = 640) -> np.ndarray:
    """A homography that turns, scales or shears a frame about its centre, and shifts it."""
    matrix, centre = np.eye(3), np.array([width / 2, 0.75 * width / 2])
    matrix[:2, :2] = linear
    matrix[:2, 2] = centre - np.array(linear) @ centre + shift
    return matrix


@pytest.mark.parametrize(
    ("homography", "names"),
    [
        (np.eye(3), []),
        (about_centre([[0.995, -0.1], [0.1, 0.995]], (60, -45)), []),
        (about_centre([[1.1, 0], [0, 1.1]]), []),
        (about_centre([[1, 0.4], [0, 1]]), ["corner angle"]),
        (about_centre([[1, 0], [0, 1]], (66, 0)), ["translation"]),
        (about_centre([[1, 0], [0, 1]], (0, -50)), ["translation"]),
        (about_centre([[0.8, 0], [0, 0.8]]), ["scale"]),
        (about_centre([[1.25, 0], [0, 1.25]]), ["scale"]),
        (about_centre([[0.8, 0], [0, 0.8]], (200, 0)), ["translation", "scale"]),
        (about_centre([[-1, 0], [0, 1]]), ["corner angle", "scale"]),
        (np.array([[1, 0, 0], [0, 1, 0], [-0.01, 0, 1.0]]), ["corner angle"]),
    ],
)
def test_each_test_of_the_examination_names_its_reason(homography: np.ndarray, names: list[str]) -> None:
    reasons = examine(homography, SIZE, ExaminationOptions())
    assert [reason.split(":")[0] for reason in reasons] == names


def test_the_limits_of_the_examination_are_options() -> None:
    lenient = ExaminationOptions(min_angle_deg=50.0, max_angle_deg=130.0, max_translation=0.5, min_scale=0.7)
    for homography in (about_centre([[1, 0.4], [0, 1]]), about_centre([[0.8, 0], [0, 0.8]], (200, 0))):
        assert examine(homography, SIZE, ExaminationOptions())
        assert not examine(homography, SIZE, lenient)
    with pytest.raises(InputError, match="angle-deg"):
        ExaminationOptions(min_angle_deg=95.0)


@given(st.floats(-3, 3), st.floats(0.2, 5), st.floats(-0.3, 0.3))
def test_inner_angles_of_a_quadrilateral_sum_to_a_full_turn(turn: float, scale: float, shear: float) -> None:
    turned = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ [[1, shear], [0, 1]]
    angles = inner_angles_deg(frame_corners(SIZE) @ turned.T)
    assert angles.sum() == pytest.approx(360)
    assert angles[0] == pytest.approx(angles[2])
    assert angles[0] == pytest.approx(90 - np.rad2deg(np.arctan(shear)))


# --- the weighted direct linear transformation -----------------------------------------------------------------------


@st.composite
def homographies(draw: st.DrawFn) -> np.ndarray:
    """Near the identity, as between frames, of determinant 1."""
    small = np.array([draw(st.floats(-1, 1)) for _ in range(8)]) * [0.2, 0.2, 60, 0.2, 0.2, 60, 2e-4, 2e-4]
    matrix = np.eye(3) + np.append(small, 0).reshape(3, 3)
    return np.asarray(matrix / np.cbrt(np.linalg.det(matrix)))


@settings(max_examples=30)
@given(homographies(), st.integers(0, 100))
def test_exact_points_give_their_homography_everywhere(homography: np.ndarray, seed: int) -> None:
    source = np.random.default_rng(seed).uniform(0, 1, (20, 2)) * SIZE
    target = warp(np.broadcast_to(homography, (20, 3, 3)), source)
    places = np.array([[0.0, 0.0], [320.0, 240.0], [640.0, 480.0]])
    found = weighted_dlt(source, target, location_weights(source, places, WarpOptions()))
    np.testing.assert_allclose(warp(found, places), warp(np.broadcast_to(homography, (3, 3, 3)), places), atol=1e-5)


def test_two_planes_give_each_place_its_own_homography() -> None:
    rng = np.random.default_rng(2)
    source = rng.uniform(0, 1, (200, 2)) * SIZE
    left = source[:, :1] < 320
    target = source + np.where(left, [10.0, 0.0], [30.0, 5.0])
    places = np.array([[60.0, 240.0], [580.0, 240.0]])

    def shifts(options: WarpOptions) -> np.ndarray:
        weights = location_weights(source, places, options)
        return np.asarray(warp(weighted_dlt(source, target, weights), places) - places)

    near = np.abs(shifts(WarpOptions(near_px=10.0)) - [[10, 0], [30, 5]]).max(axis=1)
    whole = np.abs(shifts(WarpOptions(floor=1.0)) - [[10, 0], [30, 5]]).max(axis=1)
    assert (near < whole / 2).all()
    np.testing.assert_allclose(location_weights(source, places, WarpOptions(floor=1.0)), 1)


def test_weights_fall_inversely_with_the_distance_down_to_the_floor() -> None:
    points = np.array([[0.0, 0.0], [40.0, 0.0], [80.0, 0.0], [400.0, 0.0], [4000.0, 0.0]])
    weights = location_weights(points, np.zeros((1, 2)), WarpOptions(near_px=40.0, floor=0.05))
    np.testing.assert_allclose(weights, [[1, 1, 0.5, 0.1, 0.05]])


# --- placing ---------------------------------------------------------------------------------------------------------


def halves(left: np.ndarray, right: np.ndarray) -> Placed:
    """A frame of 160 x 120 px with two segments, side by side."""
    segments = np.zeros((120 // SEGMENT_PX, 160 // SEGMENT_PX), np.int16)
    segments[:, 20:] = 1
    return Placed(index=0, size=(160, 120), canvas_from_frame=left, cells=np.stack([left, right]), segments=segments)


def test_centroids_of_segments_are_in_px() -> None:
    np.testing.assert_allclose(centroids(halves(np.eye(3), np.eye(3)).segments), [[40, 60], [120, 60]])


def test_px_of_a_canvas_lead_back_to_where_they_are() -> None:
    placed = halves(about_centre([[1, 0.1], [0, 1.05]], width=160), about_centre([[1, 0.12], [0, 1.05]], width=160))
    canvas = Canvas.from_frames([placed])
    rows, columns = canvas.window(placed)
    pixels = frame_pixels(canvas, placed, (rows, columns))
    seen = np.isfinite(pixels).all(axis=-1)
    assert 0.8 < seen.mean() < 1
    row, column = np.nonzero(seen)
    there = np.column_stack([column + columns.start, row + rows.start]) + 0.5 - canvas.offset
    away = np.linalg.norm(placed.apply(pixels[seen].astype(np.float64)) - there, axis=1)
    assert np.percentile(away, 95) < 1e-2
    assert away.max() < 5


def test_stretch_is_that_of_the_longer_or_the_shorter_side() -> None:
    given_ = np.stack([np.diag([2.0, 1.0, 1.0]), np.diag([1.0, 0.25, 1.0]), np.diag([1.0, 1.0, -1.0])])
    np.testing.assert_allclose(stretch(given_, np.ones((3, 2))), [2, 4, np.inf])


# --- the whole -------------------------------------------------------------------------------------------------------

FRAME = (240, 180)
SHIFTS = np.array([[0, 0], [14, 3], [26, -4], [40, 2], [52, 8]]) + [20, 20]


@pytest.fixture(scope="module")
def wall() -> np.ndarray:
    """A large picture of soft blobs."""
    noise = np.random.default_rng(0).standard_normal((260, 380))
    blobs = sum(cv2.GaussianBlur(noise, (0, 0), sigma) * sigma for sigma in (3.0, 6.0, 12.0))
    grey = 130 + 35 * (blobs - blobs.mean()) / blobs.std()
    return np.clip(np.dstack([grey, 0.95 * grey, 0.85 * grey]), 60, 235).astype(np.uint8)


def cut(wall: np.ndarray, shift: np.ndarray) -> np.ndarray:
    x, y = shift
    return np.asarray(wall[y : y + FRAME[1], x : x + FRAME[0]])


def stitched(folder: Path, examination: bool = True, **options: object) -> tuple[Panorama, ...]:
    sequence = storage.read_sequence(folder, folder / "decoded")
    return stitch_as_thesis(sequence, ThesisOptions(**options), examination=examination)


def errors_px(panorama: Panorama, shifts: np.ndarray) -> np.ndarray:
    """How far px of the panorama are from where they should be, after the best shift."""
    seen = panorama.frame_index >= 0
    rows, columns = np.nonzero(seen)
    true = panorama.frame_pixel[seen] + shifts[panorama.frame_index[seen]]
    away = np.column_stack([columns, rows]) + 0.5 - true
    return np.asarray(np.linalg.norm(away - np.median(away, axis=0), axis=1))


@pytest.fixture(scope="module")
def pan(wall: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_frames(tmp_path_factory.mktemp("pan"), [cut(wall, shift) for shift in SHIFTS])


def test_a_pan_is_stitched_where_it_truly_was(pan: Path) -> None:
    (panorama,) = stitched(pan)
    assert all(frame.used for frame in panorama.frames)
    assert panorama.mm_per_px is None
    np.testing.assert_array_equal(panorama.covered, panorama.frame_index >= 0)
    height, width = panorama.covered.shape
    assert abs(width - (FRAME[0] + 52)) < 12
    assert abs(height - (FRAME[1] + 12)) < 12
    error = errors_px(panorama, SHIFTS)
    assert 0 < np.median(error) < 1.0
    assert np.percentile(error, 95) < 4.0
    overlaps = [frame.overlap for frame in panorama.frames[1:]]
    assert all(overlap is not None and 0.85 < overlap < 1 for overlap in overlaps)


def test_the_examination_leaves_out_a_frame_and_says_why(wall: np.ndarray, tmp_path: Path) -> None:
    frames = [cut(wall, shift) for shift in SHIFTS[:3]]
    x, y = SHIFTS[2]
    frames.insert(2, cv2.resize(wall[y + 25 : y + 155, x + 33 : x + 207], FRAME, interpolation=cv2.INTER_CUBIC))
    folder = write_frames(tmp_path / "frames", frames)
    (strict,), (lenient,) = stitched(folder), stitched(folder, examination=False)
    assert [frame.used for frame in strict.frames] == [True, True, False, True]
    assert (strict.frames[2].reason or "").startswith("scale: ")
    assert all(frame.used for frame in lenient.frames)


def test_a_black_frame_ends_nothing_and_black_frames_alone_are_refused(pan: Path, tmp_path: Path) -> None:
    frames = [cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB) for path in sorted(pan.glob("*.png"))[:4]]
    black = np.zeros_like(frames[0])
    (panorama,) = stitched(write_frames(tmp_path / "one", [frames[0], black, frames[1], frames[2]]))
    assert [frame.used for frame in panorama.frames] == [True, False, True, True]
    assert (panorama.frames[1].reason or "").startswith("matches: ")
    with pytest.raises(ReconstructionError, match="no two of 3 frames"):
        stitched(write_frames(tmp_path / "black", [black] * 3))


def test_what_collapses_is_a_part_and_said_to_be_one(pan: Path) -> None:
    sequence = storage.read_sequence(pan, pan / "decoded")
    small = 0.0513  # Enough for three frames.
    first, *others = stitched(pan, max_canvas_mpx=small)
    assert others
    assert first.parts == 1 + len(others)
    assert first.covered.size <= 1e6 * small
    assert any("collapses" in note for note in first.notes)
    used = [{frame.name for frame in part.frames if frame.used} for part in (first, *others)]
    assert sum(len(names) for names in used) == len(set().union(*used)) <= len(sequence)
    assert any(frame.reason == "in part 2" for frame in first.frames)


def test_the_lens_is_taken_into_account(wall: np.ndarray, tmp_path: Path) -> None:
    camera = replace(Camera.from_field_of_view(*FRAME, 62.0), distortion=np.array([-0.1, 0.0, 0.0, 0.0]))
    rays = camera.rays(camera.pixel_centres())
    ideal = replace(camera, distortion=np.zeros(4)).project(rays).astype(np.float32) - np.float32(0.5)
    frames = [cv2.remap(wall, ideal + shift.astype(np.float32), None, cv2.INTER_LINEAR) for shift in SHIFTS[:3]]
    sequence = storage.read_sequence(write_frames(tmp_path / "frames", frames), tmp_path / "decoded")
    (part,) = stitch(replace(sequence, camera=camera), StitchOptions(method="thesis"))
    seen = part.panorama.frame_index >= 0
    straight = replace(camera, distortion=np.zeros(4)).project(
        camera.rays(part.panorama.frame_pixel[seen].astype(float))
    )
    rows, columns = np.nonzero(seen)
    away = np.column_stack([columns, rows]) - straight - SHIFTS[part.panorama.frame_index[seen]]
    error = np.linalg.norm(away - np.median(away, axis=0), axis=1)
    assert 0 < np.median(error) < 1.0


def test_the_verb_writes_a_panorama_and_its_help_holds_the_patent_notice(
    wall: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_frames(tmp_path / "frames", [cut(wall, shift) for shift in SHIFTS[:2]])
    cli.main(["pano", "stitch", str(folder), "--method", "thesis", "--no-examination", "--out", str(tmp_path / "pano")])
    panorama = storage.read_panorama(tmp_path / "pano")
    assert panorama.method == "thesis"
    assert not (tmp_path / "pano" / "poses.json").exists()
    with pytest.raises(SystemExit):
        cli.main(["pano", "stitch", "--help"])
    printed = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "11,044,400" in printed


def test_the_verb_refuses_black_frames_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_frames(tmp_path / "frames", [np.zeros((180, 240, 3), np.uint8)] * 2)
    refused(capsys, "pano", "stitch", folder, "--method", "thesis", "--out", tmp_path / "pano")
    assert not (tmp_path / "pano" / "panorama.png").exists()
