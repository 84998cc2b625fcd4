"""Boards in terraces: their shape, what cameras see of it, and what is calibrated from it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from boards import BOARD, SIZE, options, scene, views_of
from cuspid import storage
from cuspid.calibration.calibrate import RigCalibration, calibrate_rig
from cuspid.calibration.corners import BoardView, find_corners
from cuspid.calibration.start import first_camera
from cuspid.calibration.target import PLATE_MM, target_body
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import DesignOptions, essential_four
from cuspid.model.board import Board
from cuspid.model.camera import Camera
from cuspid.runtime.errors import InputError
from cuspid.simulation.board_images import PhotographOptions, _first_hits, board_light, board_poses, take_photographs
from cuspid.simulation.raycast import pixel_rays
from verbs import refused, run

TERRACES = replace(BOARD, terraces=3, step_mm=3.0)
SMALL = Board(columns=9, rows=7, square_mm=0.7, terraces=3, step_mm=1.0)


# --- shape -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("columns", "terraces", "begin"), [(9, 3, [0, 3, 6]), (8, 3, [0, 3, 6]), (5, 2, [0, 3])])
def test_corners_are_as_high_as_their_terrace(columns, terraces, begin):
    board = Board(columns=columns, rows=4, square_mm=2.0, terraces=terraces, step_mm=0.5)
    flat = replace(board, terraces=1)
    assert np.array_equal(board.corners[:, :2], flat.corners[:, :2])
    assert np.array_equal(board.edges_mm, 2.0 * np.array([*begin, columns]))
    for (x, _, z), seen in zip(board.corners, board.saddles, strict=True):
        assert z == -0.5 * (np.searchsorted(begin, x / 2, side="right") - 1)  # towards the camera
        assert seen == (x / 2 not in begin)
    assert flat.saddles.all()
    assert not flat.corners[:, 2].any()
    assert flat.height_mm == 0
    assert board.height_mm == 0.5 * (terraces - 1)


def test_the_body_is_closed_and_as_large_as_its_terraces(tmp_path):
    run("rig", "target", "--out", tmp_path / "target.stl", *options(SMALL), "--terraces", 3, "--step-mm", 1)
    assert (tmp_path / "target.stl").stat().st_size == 84 + 50 * len(target_body(SMALL).faces)  # binary
    body = trimesh.load_mesh(tmp_path / "target.stl")
    assert body.is_watertight
    assert body.is_winding_consistent
    assert np.isclose(body.volume, 2.1 * 4.9 * (3 * PLATE_MM + 0 + 1 + 2), rtol=1e-6)
    assert np.allclose(body.bounds, [[0, 0, 0], [6.3, 4.9, PLATE_MM + 2]], atol=1e-6)


@pytest.mark.parametrize(("square_mm", "step_mm"), [(10_000.0, 0.001), (0.001, 10_000.0)])
def test_the_body_stays_closed_in_a_file(tmp_path, square_mm, step_mm):
    """Single precision keeps all of its corners."""
    storage.write_mesh(
        tmp_path / "body.stl", target_body(Board(columns=100, square_mm=square_mm, terraces=50, step_mm=step_mm))
    )
    body = trimesh.load_mesh(tmp_path / "body.stl")
    assert body.is_watertight
    assert body.volume > 0


@pytest.mark.parametrize("inverted", [False, True])
def test_the_strip_folds_onto_the_terraces(tmp_path, inverted):
    """Each place on it has the ink of the board there; risers are blank; its length is that of terraces and risers."""
    board = Board(columns=6, rows=4, square_mm=3.0, terraces=2, step_mm=2.0, inverted=inverted)
    run("rig", "target", "--out", tmp_path / "strip.png", *options(board), "--terraces", 2, "--step-mm", 2)
    gray = cv2.imread(str(tmp_path / "strip.png"), cv2.IMREAD_GRAYSCALE)
    px_per_mm, margin = 600 / 25.4, 5.0
    assert abs(gray.shape[1] - px_per_mm * (18 + 2 + 2 * margin)) <= 1
    along, down = np.meshgrid(np.arange(0.05, 20, 0.25), np.arange(0.05, 12, 0.25))
    drawn = gray[((down + margin) * px_per_mm).astype(int), ((along + margin) * px_per_mm).astype(int)] < 128
    riser = (along > 9) & (along < 11)
    folded = np.stack([np.where(along > 11, along - 2, along), down], axis=-1)
    inked = board.is_dark(folded.reshape(-1, 2)).reshape(drawn.shape)
    assert (drawn == np.where(riser, inverted, inked)).mean() > 0.98  # but for borders of bits
    assert (drawn[riser] == inverted).all()


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"terraces": 5, "columns": 9}, "5 terraces need at least 10 columns, but it has 9"),
        ({"terraces": 2, "kind": "chessboard"}, "a chessboard must be flat"),
        ({"terraces": 0}, "--terraces is 0"),
        ({"terraces": 2, "step_mm": 0.0}, "--step-mm is 0"),
    ],
)
def test_what_cannot_be_built_is_refused(given, told):
    with pytest.raises(InputError, match=told):
        Board(**given)


def test_steps_that_reach_the_cameras_are_one_line(tmp_path, capsys):
    storage.write_handpiece(tmp_path / "four.json", essential_four())
    tall = ("rig", "photograph", tmp_path / "four.json", "--out", tmp_path / "out", "--terraces", 3, "--step-mm", 2)
    assert "the last terrace is 4 mm above the first, which is too close to the cameras" in refused(capsys, *tall)
    assert not (tmp_path / "out").exists()


# --- what cameras see --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("inverted", [False, True])
def test_a_flat_board_is_seen_as_a_plane(inverted):
    """Bit for bit: where rays meet Z = 0 it is dark or not."""
    board = replace(SMALL, terraces=1, inverted=inverted)
    camera = Camera(width=80, height=60, focal_px=np.full(2, 60.0), principal_point_px=np.array([40.0, 30]))
    pose = Rigid3.from_rotation_vector(np.array([0.3, -0.4, 0.2]), np.array([-3.0, -2.0, 5.0]))
    rays = pixel_rays(camera, 2) @ pose.rotation
    eye = pose.inverse().translation
    ink = board.is_dark(eye[:2] + (-eye[2] / rays[:, 2])[:, None] * rays[:, :2]).reshape(60, 80, 4).mean(axis=2)
    light = board_light(board, camera, pixel_rays(camera, 2), pose)
    assert np.array_equal(light, np.repeat((0.75 + (0.03 - 0.75) * ink)[..., None], 3, axis=2))


def test_an_inverted_board_is_dark_where_the_other_is_light():
    """Risers, too."""
    camera = Camera(width=80, height=60, focal_px=np.full(2, 60.0), principal_point_px=np.array([40.0, 30]))
    pose = Rigid3.from_rotation_vector(np.array([0.3, -0.4, 0.2]), np.array([-3.0, -2.0, 6.0]))
    lights = [board_light(each, camera, pixel_rays(camera, 2), pose) for each in (SMALL, replace(SMALL, inverted=True))]
    assert np.allclose(lights[0] + lights[1], 0.75 + 0.03)
    assert 0.2 < lights[0].mean() < 0.6


def test_rays_end_where_they_meet_the_body():
    """As Embree finds it, from above, from aside and from below the highest terrace."""
    rng = np.random.default_rng(0)
    body = target_body(SMALL)
    height = SMALL.size_mm[1]
    tops = risers = 0
    for eye in ([3.0, 2.0, -6.0], [-4.0, 2.5, -2.5], [9.0, 3.0, -3.0], [1.0, 2.0, -1.2], [3.0, 9.0, -7.0]):
        rays = rng.uniform([0, 0, -2], [6.3, 4.9, 0], (4000, 3)) - eye
        reach, on_terrace = _first_hits(SMALL, np.array(eye), rays)
        ends = eye + reach[:, None] * rays
        inside = (np.abs(ends[:, :2] - [3.15, 2.45]) < [3.14, 2.44]).all(axis=1)
        up = np.array([1.0, -1.0, -1.0])  # the body's frame
        hits = body.cast(np.tile(up * eye + [0, height, PLATE_MM], (len(rays), 1)), up * rays)
        assert np.allclose(hits.distances[inside], reach[inside], atol=1e-5)
        assert np.array_equal(body.face_normals[hits.faces[inside], 2] > 0.5, on_terrace[inside])
        tops, risers = tops + on_terrace[inside].sum(), risers + (~on_terrace[inside]).sum()
    assert tops > 5000
    assert risers > 1000


def test_corners_are_found_where_they_were_drawn(tmp_path):
    """Also with a step through the image; none on an edge of a step."""
    handpiece, shown = essential_four(DesignOptions(width_px=300, height_px=300)), PhotographOptions(instants=4)
    take_photographs(handpiece, SMALL, tmp_path, replace(shown, supersampling=2))
    off, higher = [], 0
    for instant, rig_from_board in enumerate(board_poses(handpiece, SMALL, shown)):
        for name, mounted in handpiece.rig.cameras.items():
            gray = cv2.imread(str(tmp_path / "images" / name / f"{instant}.png"), cv2.IMREAD_GRAYSCALE)
            view = find_corners(gray, SMALL) or BoardView(np.zeros(0, int), np.zeros((0, 2)))
            assert SMALL.saddles[view.corner].all()
            true = mounted.camera.project((mounted.cam_from_rig @ rig_from_board).apply(SMALL.corners[view.corner]))
            off.append(np.linalg.norm(view.pixels - true, axis=1))
            higher += len(np.unique(SMALL.corners[view.corner, 2])) > 1
    off = np.concatenate(off)
    assert len(off) > 150
    assert higher > 8
    assert 0.02 < np.median(off) < 0.15
    assert 0.1 < np.percentile(off, 95) < 0.5


# --- what is calibrated ------------------------------------------------------------------------------------------


def calibrated(
    board: Board, seed: int, *, off_mm: float = 0.0, facing: bool = False
) -> tuple[RigCalibration, list[float]]:
    """From views with 0.1 px of noise of a board whose steps are higher; and the errors of the lenses, in stated
    standard deviations."""
    built = replace(board, step_mm=board.step_mm + off_mm)
    truth = replace(scene(seed, built), bending_mm=np.zeros(3))
    if facing:
        untilted = {name: Rigid3(np.eye(3), pose.translation) for name, pose in truth.rig_from_board.items()}
        truth = replace(truth, rig_from_board=untilted)
    views = views_of(truth, built, 0.1, np.random.default_rng(seed))
    found = calibrate_rig(views, dict.fromkeys(truth.cameras, SIZE), board)
    off = {n: found.rig[n].camera.parameters - each.parameters for n, each in truth.cameras.items()}
    solved = [each @ np.linalg.solve(found.rig[name].camera.covariance, each) / 8 for name, each in off.items()]
    return found, [float(np.sqrt(each)) for each in solved]


@pytest.mark.long
def test_errors_are_what_the_covariance_states():
    """Also those of the steps, which are 1 % off."""
    errors = []
    for seed, off_mm in enumerate([0.03, -0.03, 0.03]):
        found, off = calibrated(replace(TERRACES, step_sigma_um=30.0), seed, off_mm=off_mm)
        assert 0.09 < found.sigma_px < 0.11
        assert abs(found.bending_mm[0] - off_mm) < 0.01
        assert not found.bending_mm[1:].any()
        errors += off
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.3


@pytest.mark.long
def test_the_focal_lengths_are_known_as_well_as_the_steps_are():
    """Of boards that face the cameras, from which a flat one tells no focal length."""
    known = []
    for sigma_um in (1.0, 300.0):
        found, off = calibrated(replace(TERRACES, step_sigma_um=sigma_um), 0, facing=True)
        assert max(off) < 2.5
        cameras = [each.camera for each in found.rig.cameras.values()]
        known.append(np.mean([np.sqrt(each.covariance[0, 0]) / each.focal_px[0] for each in cameras]))
    assert 0.0004 < known[0] < 0.001
    assert 0.002 < known[1] < 0.004


def test_one_camera_begins_near_the_truth():
    truth = scene(9, TERRACES, cameras=1)
    views = views_of(replace(truth, bending_mm=np.zeros(3)), TERRACES, 0.1, np.random.default_rng(0))
    start = first_camera(list(views.values()), TERRACES, SIZE)
    assert np.abs(start.focal_px / truth.cameras["cam0"].focal_px - 1).max() < 0.05


@pytest.mark.long
def test_photographs_of_terraces_become_a_handpiece(tmp_path):
    board = (*options(SMALL), "--terraces", 3, "--step-mm", 1, "--step-sigma-um", 1)
    storage.write_handpiece(tmp_path / "four.json", essential_four(DesignOptions(width_px=240, height_px=240)))
    run(
        *("rig", "photograph", tmp_path / "four.json", "--out", tmp_path / "photos", *board, "--instants", 12),
        *("--supersampling", 2, "--manufacturing-um", 30, "--manufacturing-deg", 0.3, "--manufacturing-focal-pct", 1),
    )
    run("calibrate", tmp_path / "photos", "--out", tmp_path / "rig", *board, "--working-distance-mm", 5)
    true, found = (storage.read_handpiece(tmp_path / each / "handpiece.json").rig for each in ("photos/truth", "rig"))
    errors = []
    for name, mounted in found.cameras.items():
        off = mounted.camera.parameters - true[name].camera.parameters
        errors.append(off @ np.linalg.solve(mounted.camera.covariance, off) / 8)
        assert np.abs(mounted.camera.focal_px / true[name].camera.focal_px - 1).max() < 0.004
    assert 0.2 < np.sqrt(np.mean(errors)) < 1.8
