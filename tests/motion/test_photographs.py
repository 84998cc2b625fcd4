"""Photographs of one camera: located up to a similarity, whatever their names and their size, scaled by a board or by
distances; and what cannot be used is told in one line."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cuspid import cli
from cuspid.geometry import best_similarity
from cuspid.model.photographs import PhotoCamera, Photograph
from cuspid.model.reconstruction import Tracks
from cuspid.model.sparse_model import PhotoModel
from cuspid.motion.colmap import write_model
from cuspid.motion.monocular.photograph_matches import detect_in_all
from cuspid.motion.monocular.photograph_poses import take_photograph_poses
from cuspid.motion.monocular.photographs import PhotographOptions, locate_photographs
from cuspid.motion.monocular.scale import BoardSighting, PhotoScaleOptions, scale_by_board
from cuspid.pipeline import photographs as photograph_pipeline
from cuspid.runtime.errors import CuspidError, InputError, ReconstructionError
from cuspid.storage.photographs import is_photographs, read_photographs
from photo_scene import BOARD, BOARD_PLACE_MM, WIDE, relief, scene
from synthetic_scene import speckle

BOARD_OPTIONS = PhotoScaleOptions(columns=BOARD.columns, rows=BOARD.rows, square_mm=BOARD.square_mm)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return scene().write(tmp_path_factory.mktemp("photographs"))


@pytest.fixture(scope="module")
def photographs(folder):
    return read_photographs(folder, folder)


@pytest.fixture(scope="module")
def model(photographs):
    return locate_photographs(photographs)


@pytest.fixture(scope="module")
def exact():
    """The model that would be found without any error, in units of half a millimetre."""
    poses, grid = scene().poses, np.stack(np.meshgrid(*[np.linspace(-11, 11, 15)] * 2), axis=-1).reshape(-1, 2)
    points = np.column_stack([grid, relief(*grid.T)])
    frame, point = (each.ravel() for each in np.indices((len(poses), len(points))))
    tracks = Tracks(
        points=points,
        colors=np.zeros((len(points), 3), np.uint8),
        point_index=point,
        frame_index=frame,
        camera_index=np.zeros(len(point), int),
        pixels=np.concatenate([WIDE.project(pose.apply(points)) for pose in poses.values()]),
    )
    cameras, camera_of = {"camera": WIDE}, dict.fromkeys(poses, "camera")
    return PhotoModel(cameras=cameras, camera_of=camera_of, cam_from_world=poses, tracks=tracks).scaled(2.0)


def centres(poses):
    return np.array([pose.inverse().translation for pose in poses])


@pytest.mark.long
def test_poses_and_lens_are_those_of_the_camera(model):
    true = scene().poses
    assert model.frames == tuple(true)
    scale, rotation, shift = best_similarity(centres(model.cam_from_world.values()), centres(true.values()))
    off = scale * centres(model.cam_from_world.values()) @ rotation.T + shift - centres(true.values())
    extent = np.linalg.norm(np.ptp(centres(true.values()), axis=0))
    assert 0 < np.linalg.norm(off, axis=1).max() < 0.005 * extent
    turns = [model.cam_from_world[name].rotation @ rotation.T @ true[name].rotation.T for name in true]
    assert 0 < np.rad2deg(Rotation.from_matrix(turns).magnitude()).max() < 0.2
    camera = model.cameras["camera"]
    assert 0 < abs(camera.focal_px[0] / WIDE.focal_px[0] - 1) < 0.01
    assert abs(camera.distortion[0] - WIDE.distortion[0]) < 0.02
    assert 0.05 < model.reprojection_rms_px < 0.6


def test_the_board_sets_the_scale(exact, photographs):
    scale = photograph_pipeline.find_scale(exact, photographs, BOARD_OPTIONS)
    true = scene().poses
    expected, _, _ = best_similarity(centres(exact.cam_from_world.values()), centres(true.values()))
    assert 0 < abs(scale.mm_per_unit / expected - 1) < 0.001
    assert 0 < scale.sigma_share < 0.001
    assert not scale.notes
    located = photograph_pipeline.to_capture(exact, photographs, scale)
    assert located.found.has_scale
    depth = np.concatenate([depth[np.isfinite(depth)] for depth in scene().depths.values()])
    near, far = located.capture.handpiece.depth_range_mm
    assert abs(located.capture.handpiece.working_distance_mm / np.median(depth) - 1) < 0.05
    assert near < np.percentile(depth, 2)
    assert np.percentile(depth, 98) < far < 1.5 * depth.max()


def test_a_bent_board_is_told(exact, photographs, monkeypatch):
    flat = type(BOARD).corners.fget
    bent = property(lambda board: flat(board) + [[0, 0, 1.0]] * np.square(flat(board)[:, :1] / 10 - 1))
    monkeypatch.setattr(type(BOARD), "corners", bent)
    (note,) = photograph_pipeline.find_scale(exact, photographs, BOARD_OPTIONS).notes
    assert "bent" in note


@pytest.mark.parametrize("kind", ["charuco", "chessboard"])
def test_the_scale_of_exact_corners_is_exact(kind):
    """In units of half a millimetre, with half of the chessboards numbered from the other end, and a corner astray."""
    board = replace(BOARD, kind=kind)
    in_world = board.corners + [*BOARD_PLACE_MM, 0.0]
    tracks = Tracks(
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        point_index=np.zeros(0, int),
        frame_index=np.zeros(0, int),
        camera_index=np.zeros(0, int),
        pixels=np.zeros((0, 2)),
    )
    exact = PhotoModel(
        cameras={"camera": WIDE},
        camera_of=dict.fromkeys(scene().poses, "camera"),
        cam_from_world=scene().poses,
        tracks=tracks,
    ).scaled(2.0)
    sightings = []
    for k, (name, pose) in enumerate(scene().poses.items()):
        pixels = WIDE.project(pose.apply(in_world))
        pixels[5] += [0.0, 40.0] if k == 2 else 0.0
        sightings.append(
            BoardSighting(frame=name, corner=board.orders[-1 if k % 2 else 0], pixels=pixels)
            if kind == "chessboard"
            else BoardSighting(frame=name, corner=np.arange(len(pixels)), pixels=pixels)
        )
    scale = scale_by_board(exact, sightings, board, len(sightings))
    assert scale.mm_per_unit == pytest.approx(0.5, rel=1e-6)
    assert scale.residual_mm < 1e-4
    with pytest.raises(ReconstructionError, match="1 of these could be"):
        scale_by_board(exact, [replace(sightings[0], frame="elsewhere"), sightings[1]], board, 8)


def test_a_calibration_is_held(photographs):
    known = {"camera": PhotoCamera(size=(WIDE.width, WIDE.height), calibrated=WIDE)}
    found = locate_photographs(replace(photographs, cameras=known))
    assert found.cameras["camera"] is WIDE
    true = scene().poses
    scale, rotation, shift = best_similarity(centres(found.cam_from_world.values()), centres(true.values()))
    off = scale * centres(found.cam_from_world.values()) @ rotation.T + shift - centres(true.values())
    assert 0 < np.linalg.norm(off, axis=1).max() < 0.1


def test_a_measured_distance_sets_the_scale(exact, photographs):
    true = scene().poses
    ends = np.array([[*BOARD_PLACE_MM, 0.0], [-4.0, 2.0, 0.0]])
    ends[1, 2] = 0.0
    one, other = "IMG_00", "IMG_03"
    places = [WIDE.project(true[name].apply(ends)).ravel().tolist() for name in (one, other)]
    given = (*places[0], *places[1], float(np.linalg.norm(ends[1] - ends[0])))
    between = (one, f"{other}.png")
    options = PhotoScaleOptions(between=between, distance=given)
    scale = photograph_pipeline.find_scale(exact, photographs, options)
    expected, _, _ = best_similarity(centres(exact.cam_from_world.values()), centres(true.values()))
    assert scale.mm_per_unit == pytest.approx(expected, rel=1e-9)
    swapped = (*places[0], *places[1][2:], *places[1][:2], 7.0)
    with pytest.raises(InputError, match="not the same"):
        photograph_pipeline.find_scale(exact, photographs, replace(options, distance=swapped))


def test_without_a_scale_nothing_is_in_millimetres(exact, photographs, tmp_path, monkeypatch):
    monkeypatch.setattr(photograph_pipeline, "locate_photographs", lambda *_, **__: exact)
    located = photograph_pipeline.locate(photographs, tmp_path)
    assert not located.found.has_scale
    assert located.scale is None
    assert abs(located.capture.handpiece.working_distance_mm - photograph_pipeline.UNITS) < 1e-6
    assert json.loads((tmp_path / "scale.json").read_text()) == {"scale": "unknown"}
    assert json.loads((tmp_path / "reconstruction.json").read_text())["scale"] == "unknown"
    assert b"scale unknown" in (tmp_path / "points.ply").read_bytes()[:200]
    monkeypatch.setattr(photograph_pipeline, "locate_photographs", None)  # found once
    again = photograph_pipeline.locate(photographs, tmp_path)
    assert again.found.frames == located.found.frames
    assert np.array_equal(again.found.tracks.points, located.found.tracks.points)
    assert np.array_equal(again.capture.image(again.capture.frames[0], "camera"), scene().images["IMG_00"])


@pytest.mark.long
def test_names_do_not_matter(model, tmp_path):
    names = list(scene().images)
    renamed = dict(zip(names, [f"z{k}" for k in (3, 0, 7, 1, 6, 2, 5, 4)], strict=True))
    other = locate_photographs(read_photographs(scene().write(tmp_path, renamed), tmp_path))
    assert np.array_equal(other.cameras["camera"].parameters, model.cameras["camera"].parameters)
    first = {name: model.cam_from_world[name] @ model.cam_from_world[names[1]].inverse() for name in names}
    for name in names:
        assert np.allclose(other.cam_from_world[renamed[name]].matrix, first[name].matrix, atol=1e-9)


@pytest.mark.long
def test_twice_the_size_has_twice_the_focal_length(model, tmp_path):
    for name, image in scene().images.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC))
    options = PhotographOptions(max_image_px=720)
    larger = locate_photographs(read_photographs(tmp_path, tmp_path), options).cameras["camera"]
    assert (larger.width, larger.height) == (2 * WIDE.width, 2 * WIDE.height)
    assert 0 < abs(larger.focal_px[0] / (2 * model.cameras["camera"].focal_px[0]) - 1) < 0.01


@pytest.mark.long
def test_given_poses_are_taken(model, photographs, tmp_path):
    located = photograph_pipeline.to_capture(model, photographs, None)
    files = {name: f"{name}.JPG" for name in model.frames}
    write_model(tmp_path / "sparse", located.found, located.capture, files)
    half = tmp_path / "half"
    half.mkdir()
    for name, image in scene().images.items():
        cv2.imwrite(str(half / f"{name}.png"), cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    taken = take_photograph_poses(read_photographs(half, half), tmp_path)
    assert taken.frames == model.frames
    assert np.allclose(taken.cameras["camera"].focal_px, 0.5 * model.cameras["camera"].focal_px)
    for name in model.frames:
        assert np.allclose(taken.cam_from_world[name].matrix, located.found.rig_from_world[name].matrix, atol=1e-9)
    (tmp_path / "sparse/points3D.bin").unlink()
    posed = take_photograph_poses(read_photographs(half, half), tmp_path / "sparse")
    assert len(posed.tracks.points) > 100
    ratio = np.median(posed.depths) / np.median(taken.depths)
    assert 0 < abs(ratio - 1) < 0.05
    assert 0.05 < posed.reprojection_rms_px < 1.0


def test_poses_of_other_photographs_are_refused(exact, photographs, tmp_path):
    located = photograph_pipeline.to_capture(exact, photographs, None)
    write_model(tmp_path, located.found, located.capture, {name: f"other-{name}.png" for name in exact.frames})
    with pytest.raises(InputError, match=r"named like other-IMG_00\.png"):
        take_photograph_poses(photographs, tmp_path)


# --- reading -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_place_that_was_picked_is_found_in_the_grid_of_the_sensor(tmp_path, orientation):
    stored = np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(stored).save(tmp_path / "a.png", exif=exif)
    upright = np.asarray(Image.fromarray(stored).transpose(_TURN[orientation]) if orientation > 1 else stored)
    photograph = Photograph(name="a", path=tmp_path / "a.png", camera="camera", size=(60, 40), orientation=orientation)
    assert np.array_equal(photograph.pixels()[..., :3], stored)
    for v, u in np.random.default_rng(1).integers(0, 40, (20, 2)):
        x, y = np.floor(photograph.in_sensor(np.array([u + 0.5, v + 0.5]))).astype(int)
        assert np.array_equal(stored[y, x], upright[v, u])


_TURN = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}


def test_exif_tells_cameras_apart_and_their_focal_length(tmp_path):
    for name, equivalent_mm in (("a", 26), ("b", 26), ("c", 52)):
        exif = Image.Exif()
        exif[0x0112] = 6 if name == "b" else 1
        exif.get_ifd(0x8769)[0xA405] = equivalent_mm
        Image.fromarray(np.full((60, 80, 3), 128, np.uint8)).save(tmp_path / f"{name}.jpg", exif=exif)
    found = read_photographs(tmp_path, tmp_path)
    assert [each.camera for each in found.photographs] == ["camera-1", "camera-1", "camera-2"]
    assert found.size("b", "camera-1") == (80, 60)
    focal = [camera.focal_px for camera in found.cameras.values()]
    assert focal == pytest.approx([26 / 43.2666 * 100, 52 / 43.2666 * 100])


def test_masks_and_opacity_tell_what_counts(folder, tmp_path):
    for name in ("a", "b", "c"):
        Image.fromarray(np.full((60, 80, 3), 128, np.uint8)).save(tmp_path / f"{name}.png")
    (tmp_path / "masks").mkdir()
    half = np.zeros((60, 80), np.uint8)
    half[:, :40] = 255
    Image.fromarray(half).save(tmp_path / "masks/a.png")
    Image.fromarray(half).save(tmp_path / "masks/b.png.png")
    Image.fromarray(np.dstack([np.full((60, 80, 3), 9, np.uint8), 255 - half])).save(tmp_path / "c.png")
    found = read_photographs(tmp_path, tmp_path)
    assert np.array_equal(found.mask("a", "camera"), half)
    assert np.array_equal(found.mask("b", "camera"), half)
    assert np.array_equal(found.mask("c", "camera"), 255 - half)
    assert "1 of 3 photographs have no mask" in found.notes[0]


def test_keypoints_outside_of_masks_are_not_used(folder, tmp_path):
    scene().write(tmp_path)
    (tmp_path / "masks").mkdir()
    for name in scene().images:
        left = np.zeros((WIDE.height, WIDE.width), np.uint8)
        left[:, : WIDE.width // 2] = 255
        Image.fromarray(left).save(tmp_path / f"masks/{name}.png")
    found = read_photographs(tmp_path, tmp_path)
    features, _ = detect_in_all(
        found.photographs[:2],
        PhotographOptions().features,
        max_image_px=2400,
        even=False,
        progress=lambda *_: None,
    )
    assert all(len(each) > 100 and each.pixels[:, 0].max() <= WIDE.width / 2 + 1 for each in features.values())


@pytest.mark.parametrize("even", [False, True])
def test_dark_photographs_of_16_bits_have_the_keypoints_of_bright_ones(tmp_path, even):
    """Of which 8 bits would leave 16 levels of grey."""
    seen = scene().images["IMG_00"].astype(np.uint16)
    bright = 257 * seen + np.random.default_rng(0).integers(0, 257, seen.shape).astype(np.uint16)
    for name, image in (("a", bright), ("b", bright // 16)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
    found, _ = detect_in_all(
        read_photographs(tmp_path, tmp_path).photographs,
        PhotographOptions().features,
        max_image_px=2400,
        even=even,
        progress=lambda *_: None,
    )
    away, _ = cKDTree(found[1].pixels).query(found[0].pixels)
    assert len(found[0]) > 500
    assert 0 < np.median(away) < 0.02
    assert np.mean(away < 0.5) > 0.95


def test_photographs_are_told_from_captures(tmp_path, folder):
    assert is_photographs(folder)
    assert is_photographs(tmp_path / "film.mp4")
    (tmp_path / "images/left").mkdir(parents=True)
    assert not is_photographs(tmp_path)


# --- what cannot be used -----------------------------------------------------------------------------------------


def refused(source, tmp_path, capsys, *options: str) -> str:
    """The one line that is said, after which nothing is there."""
    out = tmp_path / "refused"
    with pytest.raises(SystemExit) as ended:
        cli.main(["reconstruct", str(source), "--out", str(out), *options])
    assert ended.value.code == 1
    assert not out.exists()
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("cuspid:")]
    assert len(lines) == 1
    return lines[0]


def some(folder, images):
    folder.mkdir()
    for name, image in images.items():
        Image.fromarray(image).save(folder / f"{name}.png")
    return folder


def noise(seed: int, cell: float = 6.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(160), np.arange(120))
    gray = speckle(np.stack([x, y, 0 * x + 1000 * seed], -1).reshape(-1, 3).astype(float), cell).reshape(120, 160)
    return np.repeat((255 * gray).astype(np.uint8)[..., None], 3, axis=2)


def test_one_or_two_photographs_are_too_few(tmp_path, capsys):
    assert "1 photograph(s)" in refused(some(tmp_path / "one", {"a": noise(0)}), tmp_path, capsys)
    two = some(tmp_path / "two", {"a": noise(0), "b": noise(1)})
    assert "2 photographs are too few" in refused(two, tmp_path, capsys)


def test_photographs_of_different_things_are_told(tmp_path, capsys):
    different = some(tmp_path / "different", {str(k): noise(k) for k in range(4)})
    assert "nothing in common" in refused(different, tmp_path, capsys)


def test_a_camera_that_stood_still_is_told(tmp_path, capsys):
    background = noise(7, 5.0)
    images = {}
    for k in range(4):
        images[str(k)] = background.copy()
        images[str(k)][40:80, 60:100] = noise(20 + k)[40:80, 60:100]
    said = refused(some(tmp_path / "turntable", images), tmp_path, capsys)
    assert "nothing moves" in said
    assert "mask" in said


@pytest.mark.parametrize(("shape", "value", "said"), [((30, 80), 255, "has the size of"), ((120, 160), 0, "is empty")])
def test_masks_that_do_not_fit_are_refused(tmp_path, capsys, shape, value, said):
    given = some(tmp_path / "given", {str(k): noise(k) for k in range(3)})
    (given / "masks").mkdir()
    Image.fromarray(np.full(shape, value, np.uint8)).save(given / "masks/1.png")
    line = refused(given, tmp_path, capsys)
    assert said in line
    assert "masks/1.png" in line


def test_a_board_that_no_photograph_shows_is_told(exact, photographs):
    absent = replace(BOARD_OPTIONS, dictionary="7X7_50")
    with pytest.raises(ReconstructionError, match="is seen in none of 8 photographs"):
        photograph_pipeline.find_scale(exact, photographs, absent)


def test_two_ways_to_the_scale_are_refused():
    with pytest.raises(CuspidError, match="both set the scale"):
        PhotoScaleOptions(square_mm=3.0, between=("a", "b"), distance=(1.0, 1.0, 2.0, 2.0, 1.0, 1.0, 2.0, 2.0, 5.0))


def test_damaged_photographs_are_left_out_with_a_reason(tmp_path):
    given = some(tmp_path / "given", {str(k): noise(k) for k in range(4)})
    data = (given / "2.png").read_bytes()
    (given / "2.png").write_bytes(data[: len(data) // 2])
    found = read_photographs(given, tmp_path)
    assert found.names == ("0", "1", "3")
    assert [each.what for each in found.left_out] == ["photograph 2"]
    assert "truncated" in found.left_out[0].reason


def test_strange_photographs_are_left_out_of_the_model(tmp_path):
    names = list(scene().images)[:5]
    given = some(tmp_path / "given", {name: scene().images[name] for name in names} | {"other": noise(3)})
    found = read_photographs(given, tmp_path)
    model = locate_photographs(found, PhotographOptions(enough_share=0.5))
    assert set(model.frames) <= set(names)
    assert len(model.frames) >= 3
    (dropped,) = [each for each in model.dropped if each.what == "photograph other"]
    assert "matches no other photograph" in dropped.reason
