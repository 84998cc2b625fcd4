"""AprilGrids and grids of circles: drawn, found, and calibrated from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from boards import SIZE, options, photograph, pose_before, scene, undistorted
from cuspid import storage
from cuspid.calibration.bundle import BoardScene
from cuspid.calibration.calibrate import CalibrationOptions, _calibrate_once, calibrate_rig
from cuspid.calibration.circle_centres import centre_shifts, measure_circle_share
from cuspid.calibration.corners import BoardView, find_corners
from cuspid.geometry import Rigid3
from cuspid.model.board import Board
from cuspid.model.board.circles import turned_orders
from cuspid.model.camera import Camera
from cuspid.runtime.errors import InputError
from verbs import run

TAGS = Board(kind="aprilgrid", columns=4, rows=3, square_mm=3.0, first_id=20)
CIRCLES = Board(kind="circles", columns=7, rows=5, square_mm=2.5)
SHIFTED = Board(kind="asymmetric-circles", columns=4, rows=9, square_mm=1.6, circle_share=0.6)
OPENCV = CalibrationOptions(lens="OPENCV")
BOARDS = (TAGS, CIRCLES, SHIFTED)
WIDE = Camera(
    width=320,
    height=240,
    focal_px=np.array([170.0, 171.0]),
    principal_point_px=np.array([163.0, 118.0]),
    distortion=np.array([-0.03, 0.01, -0.004, 5e-4]),
    model="OPENCV_FISHEYE",
)


def errors_px(view: BoardView, board: Board, camera: Camera, cam_from_board: Rigid3) -> np.ndarray:
    """How far the corners lie from where they are to be seen, under the numbering that fits best."""
    true = camera.project(cam_from_board.apply(board.corners))
    numbered = [order[view.corner] for order in board.orders]
    if board.has_circles:
        true = true + centre_shifts(camera, cam_from_board, board, np.arange(len(true)))
    return min((view.pixels - true[each] for each in numbered), key=lambda off: np.abs(off).max())


# --- what is printed ---------------------------------------------------------------------------------------------


def test_tags_are_kalibrs() -> None:
    """Ids from the bottom left, along the rows; tag 0 of the family as its authors print it; and the dark squares."""
    code = 0xD5D628584  # of id 0, bits along the rows from the top left
    bits = np.array([[code >> (35 - (6 * row + column)) & 1 for column in range(6)] for row in range(6)])
    board = Board(kind="aprilgrid", columns=3, rows=2, square_mm=10.0, spacing_share=0.3)
    below_left = board.corners[[12, 13, 18, 19], :2]  # of six to a row
    assert np.allclose(below_left, [[3, 16], [13, 16], [3, 26], [13, 26]])
    middles = below_left[0] + 2.5 + np.stack(np.meshgrid(np.arange(6), np.arange(6)), axis=-1)
    assert np.array_equal(~board.is_dark(middles.reshape(-1, 2)).reshape(6, 6), bits.astype(bool))
    assert board.is_dark(np.array([[1.5, 1.5], [14.5, 14.5], [4.0, 24.0], [40.0, 27.0]])).all()
    assert not board.is_dark(np.array([[1.5, 8.0], [14.5, 20.0], [8.0, 14.5], [-0.1, 1.0], [43.0, 1.0]])).any()
    assert board.tags.ids.tolist() == [[3, 4, 5], [0, 1, 2]]


@pytest.mark.parametrize("board", BOARDS)
def test_a_drawn_board_is_as_it_is_said_to_be(tmp_path: Path, board: Board) -> None:
    run("rig", "target", "--out", tmp_path / "board.png", *options(board))
    gray = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    places = np.random.default_rng(0).uniform([0, 0], board.size_mm, (2000, 2))
    inner = [board.is_dark(places + shift) for shift in ([0.05, 0], [-0.05, 0], [0, 0.05], [0, -0.05])]
    clear = np.ptp(np.stack(inner).astype(int), axis=0) == 0
    margin, px_per_mm = max(5.0, board.square_mm / 2), 600 / 25.4
    across, down = np.floor((places + margin) * px_per_mm).astype(int).T
    dark = gray[down, across] < 128
    assert 0.1 < dark.mean() < 0.9
    assert np.array_equal(dark[clear], board.is_dark(places)[clear])


def test_grids_of_circles_are_numbered_in_as_many_ways_as_they_look_alike() -> None:
    assert [len(Board(kind="circles", columns=c, rows=r).orders) for c, r in ((7, 5), (6, 6))] == [2, 4]
    shifted = [Board(kind="asymmetric-circles", columns=4, rows=rows) for rows in (11, 10)]
    assert [len(board.orders) for board in shifted] == [1, 2]
    for order in turned_orders(Board(kind="circles", columns=6, rows=6).corners[:, :2]):
        assert sorted(order) == list(range(36))


def test_shifted_rows_are_opencvs() -> None:
    places = [((2 * (k % 4) + (k // 4) % 2), k // 4) for k in range(36)]
    assert np.allclose(SHIFTED.corners[:, :2] - SHIFTED.corners[0, :2], SHIFTED.square_mm * np.array(places))


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"kind": "aprilgrid", "columns": 25, "rows": 25}, "625 markers are needed, but .* APRILTAG_36h11 has 587"),
        ({"kind": "circles", "terraces": 2}, "a grid of circles must be flat"),
        ({"kind": "charuco", "columns": 2}, "at least 3 x 3 squares, not 2 x 11"),
    ],
)
def test_what_no_board_can_be_is_refused(given: dict, told: str) -> None:
    with pytest.raises(InputError, match=told):
        Board(**given)


# --- what is found -----------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("tilt_deg", [0.0, 40.0])
@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("board", BOARDS)
def test_a_board_is_found_through_a_wide_lens(board: Board, inverted: bool, tilt_deg: float) -> None:
    board = replace(board, inverted=inverted)
    pose = pose_before(board, 14.0, tilt_deg)
    view = find_corners(photograph(board, WIDE, pose), board)
    assert view is not None
    assert len(view.corner) >= 0.75 * len(board.corners)
    off = errors_px(view, board, WIDE, pose)
    assert 0.002 < np.sqrt(np.mean(off**2)) < (0.08 if board.kind == "aprilgrid" else 0.04)
    assert np.abs(off).max() < 0.4


def test_a_part_of_a_chart_of_tags_is_enough_and_others_are_no_part_of_it() -> None:
    """Half of it lies beyond the image; tags of another chart beside it count for nothing."""
    chart = Board(kind="aprilgrid", columns=8, rows=6, square_mm=3.0, first_id=20)
    camera = undistorted(scene(0).cameras["cam0"]).resized(320, 240)
    pose = pose_before(chart, 14.0, 20.0)
    image = photograph(chart, camera, pose)
    view = find_corners(image, chart)
    assert view is not None
    assert 16 <= len(view.corner) < len(chart.corners) / 2
    assert np.abs(errors_px(view, chart, camera, pose)).max() < 0.4
    assert find_corners(image, replace(chart, first_id=300)) is None


@pytest.mark.parametrize("board", BOARDS)
def test_a_mirrored_print_is_not_found_unless_it_is_the_same(board: Board) -> None:
    image = np.ascontiguousarray(photograph(board, WIDE, pose_before(board, 14.0, 20.0))[:, ::-1])
    other = replace(board, rows=10) if board.kind == "asymmetric-circles" else board
    assert (find_corners(image, board) is None) == (board.kind == "aprilgrid")
    assert find_corners(image, other) is None or board is other


@pytest.mark.parametrize("board", [CIRCLES, SHIFTED])
def test_hidden_circles_are_left_out_and_part_of_a_grid_is_none(board: Board) -> None:
    pose = pose_before(board, 14.0, 20.0)
    image = photograph(board, WIDE, pose)
    seen = np.rint(WIDE.project(pose.apply(board.corners))).astype(int)
    for x, y in seen[[9, 17]]:
        cv2.circle(image, (int(x), int(y)), 8, 215, -1)
    view = find_corners(image, board)
    assert view is not None
    assert len(board.corners) - 3 <= len(view.corner) <= len(board.corners) - 2
    assert np.abs(errors_px(view, board, WIDE, pose)).max() < 0.4
    assert find_corners(image, replace(board, columns=board.columns + 1)) is None
    assert find_corners(image, replace(board, rows=board.rows - 1)) is None


def test_the_size_of_circles_is_measured_in_one_image() -> None:
    image = photograph(CIRCLES, WIDE, pose_before(CIRCLES, 14.0, 20.0))
    assert measure_circle_share(image, CIRCLES) == pytest.approx(CIRCLES.circle_share, rel=0.04)
    assert measure_circle_share(np.full_like(image, 90), CIRCLES) is None


# --- calibration -------------------------------------------------------------------------------------------------


def seen_circles(truth: BoardScene, board: Board, noise_px: float, seed: int) -> dict[tuple[str, str], BoardView]:
    """What is measured of circles: the middles of what is seen, not their centres."""
    rng, every, views = np.random.default_rng(seed), np.arange(len(board.corners)), {}
    for name, camera in truth.cameras.items():
        for instant, pose in truth.rig_from_board.items():
            cam_from_board = truth.cam_from_rig[name] @ pose
            pixels = camera.project(cam_from_board.apply(board.corners))
            if camera.contains(pixels, 5.0).all():
                shift = centre_shifts(camera, cam_from_board, board, every)
                views[name, instant] = BoardView(every, pixels + shift + rng.normal(0, noise_px, pixels.shape))
    return views


def focal_sigmas(cameras: Sequence[tuple[Camera, Camera]]) -> float:
    """Error of focal lengths and principal points, in stated standard deviations (RMS)."""
    off = [(found.parameters[:4] - true.parameters[:4], found.covariance[:4, :4]) for found, true in cameras]
    return float(np.sqrt(np.mean([d @ np.linalg.solve(covariance, d) / 4 for d, covariance in off])))


@pytest.mark.long
def test_the_middle_of_what_is_seen_of_a_circle_is_not_its_centre() -> None:
    """With the middles of the ellipses, lenses are off by many sigmas; corrected, by about one."""
    board = Board(kind="asymmetric-circles", columns=4, rows=11, square_mm=1.5, circle_share=0.7)
    truth = replace(scene(1, board, cameras=2, instants=16), bending_mm=np.zeros(3))
    views, sizes = seen_circles(truth, board, 0.02, 1), dict.fromkeys(truth.cameras, SIZE)
    from_middles = _calibrate_once(views, sizes, board, OPENCV)
    from_centres = calibrate_rig(views, sizes, board, OPENCV)
    before, after = (
        focal_sigmas([(found.rig[name].camera, truth.cameras[name]) for name in truth.cameras])
        for found in (from_middles, from_centres)
    )
    assert before > 4
    assert 0.3 < after < 2
    assert from_centres.sigma_px == pytest.approx(0.02, rel=0.1)


def test_the_shift_of_a_centre_is_that_of_an_ellipse() -> None:
    """Of a pinhole: the middle of the conic that the outline is projected to."""
    camera = undistorted(scene(0).cameras["cam0"])
    pose = pose_before(CIRCLES, 14.0, 45.0)
    shift = centre_shifts(camera, pose, CIRCLES, np.array([0]))[0]
    x, y = CIRCLES.corners[0, :2]
    r = CIRCLES.circle_mm / 2
    circle = np.array([[1, 0, -x], [0, 1, -y], [-x, -y, x * x + y * y - r * r]])
    plane = camera.matrix @ np.column_stack([pose.rotation[:, :2], pose.translation])
    conic = np.linalg.inv(plane).T @ circle @ np.linalg.inv(plane)
    middle = -np.linalg.solve(conic[:2, :2], conic[:2, 2])
    assert np.linalg.norm(shift) > 0.05
    assert np.allclose(camera.project(pose.apply(CIRCLES.corners[:1]))[0] + shift, middle, atol=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("board", BOARDS)
def test_photographs_become_a_handpiece(tmp_path: Path, board: Board) -> None:
    """From the command line: images of a known camera, and its focal length from them."""
    camera = undistorted(scene(0).cameras["cam0"]).resized(320, 240)
    for k, (tilt, roll) in enumerate([(0, 10), (35, 20), (-35, 0), (30, 95), (-30, 80)]):
        image = photograph(board, camera, pose_before(board, 22.0, tilt, roll_deg=roll), 2, seed=k)
        storage.write_image(tmp_path / "images" / "cam" / f"{k}.png", np.repeat(image[..., None], 3, axis=2))
    run("calibrate", tmp_path / "images", "--out", tmp_path / "rig", "--lens", "OPENCV", *options(board))
    found = storage.read_handpiece(tmp_path / "rig" / "handpiece.json").rig["cam"].camera
    assert np.abs(found.focal_px / camera.focal_px - 1).max() < 0.01
    assert storage.read_json(tmp_path / "rig" / "calibration.json")["sigma_px"] < 0.1


@pytest.mark.long
@pytest.mark.parametrize("board", [CIRCLES, SHIFTED])
def test_circles_of_another_size_are_told(tmp_path: Path, board: Board) -> None:
    camera = undistorted(scene(0).cameras["cam0"]).resized(320, 240)
    for k, (tilt, roll) in enumerate([(0, 10), (35, 20), (-35, 90)]):
        image = photograph(board, camera, pose_before(board, 18.0, tilt, roll_deg=roll), 3, seed=k)
        storage.write_image(tmp_path / "images" / "cam" / f"{k}.png", np.repeat(image[..., None], 3, axis=2))
        assert measure_circle_share(image, board) == pytest.approx(board.circle_share, rel=0.04)
    given = [*options(replace(board, circle_share=0.8)), "--lens", "OPENCV", "--no-photometry"]
    run("calibrate", tmp_path / "images", "--out", tmp_path / "rig", *given)
    told = " ".join(storage.read_json(tmp_path / "rig" / "calibration.json")["notes"])
    assert f"the circles are {board.circle_share:.1f}" in told
    assert "not 0.8: give --circle-share 0." in told


# --- files -------------------------------------------------------------------------------------------------------

KALIBR = """target_type: 'aprilgrid' #gridtype
tagCols: 6               #number of apriltags
tagRows: 5               #number of apriltags
tagSize: 0.088           #size of apriltag, edge to edge [m]
tagSpacing: 0.3          #ratio of space between tags to tagSize
codeOffset: 7
"""


@pytest.mark.parametrize(
    ("text", "board"),
    [
        (KALIBR, Board(kind="aprilgrid", columns=6, rows=5, square_mm=88.0, spacing_share=0.3, first_id=7)),
        (
            "target_type: checkerboard\ntargetCols: 6\ntargetRows: 7\nrowSpacingMeters: 0.06\ncolSpacingMeters: 0.06\n",
            Board(kind="chessboard", columns=7, rows=8, square_mm=60.0),
        ),
        (
            "target_type: circlegrid\ntargetCols: 6\ntargetRows: 7\nspacingMeters: 0.02\nasymmetricGrid: false\n",
            Board(kind="circles", columns=6, rows=7, square_mm=20.0),
        ),
        (
            "kind: charuco\ncolumns: 9\nrows: 7\nsquare-mm: 1.2\nlegacy: true\n",
            Board(columns=9, rows=7, square_mm=1.2, legacy=True),
        ),
    ],
)
def test_files_of_boards_are_read(tmp_path: Path, text: str, board: Board) -> None:
    (tmp_path / "board.yaml").write_text(text)
    assert storage.read_boards(tmp_path / "board.yaml") == (board,)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("target_type: dots\n", "target_type is 'dots'; it must be one of aprilgrid, checkerboard, circlegrid"),
        (KALIBR.replace("tagSize: 0.088", "tagSize: 88.0"), r"tagSize is 88.0; it must lie between 1e-06 and 10"),
        (KALIBR.replace("tagCols: 6 ", "tagCols: six "), "tagCols is 'six'; it must be a number"),
        ("target_type: aprilgrid\n", "the field 'tagCols' is missing"),
        ("columns: 5\nsquares: 3\n", "'squares' is not an option of a board"),
        ("columns: 5\n", "square_mm is missing"),
        ("columns: 5.5\nsquare_mm: 1\n", "columns is 5.5; it must be a whole number"),
        ("legacy: 1\nsquare_mm: 1\n", "legacy is 1; it must be true or false"),
        ("kind: dots\nsquare_mm: 1\n", "--kind is 'dots'; choose"),
        ("boards: []\n", "0 of them; it must be 1 to 100"),
        ("- 1\n", "a board is"),
    ],
)
def test_files_that_describe_no_board_are_refused(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "board.yaml").write_text(text)
    with pytest.raises(InputError, match=told):
        storage.read_boards(tmp_path / "board.yaml")
