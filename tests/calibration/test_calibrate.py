"""Calibration from views of a board: closed loops from known cameras, and what is refused."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from boards import (
    BOARD,
    SIZE,
    moving,
    moving_pose,
    options,
    photograph,
    photographs,
    pose_before,
    rolling_views,
    scene,
    undistorted,
    views_of,
)
from cuspid import storage
from cuspid.calibration import bundle, calibrate, from_images
from cuspid.calibration.board_shape import BoardShape
from cuspid.calibration.bundle import BoardScene, adjust_board
from cuspid.calibration.calibrate import CalibrationOptions, RigCalibration, calibrate_rig
from cuspid.calibration.corners import BoardView, find_corners
from cuspid.calibration.start import board_pose, first_camera, renumber_instant
from cuspid.calibration.timing import adjust_scene, allow_delays, allow_rolling
from cuspid.geometry import Rigid3
from cuspid.model.board import Board
from cuspid.model.camera import Camera
from cuspid.model.image_sequence import ImageSequence
from cuspid.model.rig import Rig
from cuspid.model.shutter import PLAIN, frame_numbers
from cuspid.runtime.errors import InputError, ReconstructionError
from cuspid.runtime.progress import silent
from verbs import refused, run

CHESS = Board(kind="chessboard", columns=8, rows=8, square_mm=2.0)


def calibrated(truth: BoardScene, views: dict, board: Board = BOARD) -> RigCalibration:
    return calibrate_rig(views, dict.fromkeys(truth.cameras, SIZE), board, CalibrationOptions(lens="OPENCV"))


def lens_error(found: RigCalibration, truth: BoardScene, name: str) -> float:
    """Of the parameters, in stated standard deviations (RMS)."""
    camera = found.rig[name].camera
    difference = camera.parameters - truth.cameras[name].parameters
    return float(np.sqrt(difference @ np.linalg.solve(camera.covariance, difference) / 8))


def between(found: RigCalibration, truth: BoardScene, name: str) -> Rigid3:
    """The place of a camera beside the first one as found, over the true one."""
    ours = found.rig[name].cam_from_rig @ found.rig["cam0"].cam_from_rig.inverse()
    return ours @ truth.cam_from_rig[name].inverse()


# --- boards ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize(("columns", "rows"), [(5, 7), (4, 6), (5, 6), (4, 5)])
def test_a_board_is_the_one_of_opencv(columns, rows, legacy):
    board = Board(columns=columns, rows=rows, square_mm=10.0, marker_share=0.6, legacy=legacy)
    picture = np.full((40 * rows, 40 * columns), 255, np.uint8)
    for (x, y), side in zip(*board.dark, strict=True):
        picture[round(4 * y) : round(4 * (y + side)), round(4 * x) : round(4 * (x + side))] = 0
    assert np.array_equal(picture, board.opencv.generateImage((40 * columns, 40 * rows), marginSize=0))
    assert np.allclose(board.opencv.getChessboardCorners(), board.corners)


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("kind", ["charuco", "chessboard"])
def test_ink_is_where_the_squares_are(kind, legacy, inverted):
    board = Board(kind=kind, columns=5, rows=6, square_mm=3.0, marker_share=0.6, legacy=legacy, inverted=inverted)
    places, sides = board.dark
    assert board.is_dark(places + sides[:, None] * [0.5, 0.5]).all() != inverted
    points = np.random.default_rng(0).uniform([-1, -1], [16, 19], (5000, 2))
    printed = np.zeros(len(points), dtype=bool)
    for place, side in zip(places, sides, strict=True):
        printed |= ((points >= place) & (points < place + side)).all(axis=1)
    assert np.array_equal(board.is_dark(points), printed ^ inverted)


def test_a_chessboard_is_numbered_in_as_many_ways_as_it_looks_alike():
    assert len(BOARD.orders) == 1
    assert len(Board(kind="chessboard", columns=8, rows=6).orders) == 2
    assert len(CHESS.orders) == 4
    for order in CHESS.orders:  # a turn: distances on the board stay
        turned = CHESS.corners[order]
        assert np.allclose(
            np.linalg.norm(turned[1:] - turned[:-1], axis=1), np.linalg.norm(np.diff(CHESS.corners, axis=0), axis=1)
        )


def test_too_many_markers_are_refused():
    with pytest.raises(InputError, match="75 markers are needed, but the dictionary 4X4_50 has 50"):
        Board(columns=10, rows=15, dictionary="4X4_50")


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("kind", ["charuco", "chessboard"])
def test_a_drawn_board_is_found_where_it_was_drawn(tmp_path, kind, inverted):
    board = Board(kind=kind, columns=7, rows=6, square_mm=2.0, inverted=inverted)
    run("rig", "target", "--out", tmp_path / "board.png", *options(board))
    gray = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    found = find_corners(gray, board)
    px_per_mm = 600 / 25.4
    expected = [(board.corners[order, :2] + 5.0) * px_per_mm for order in board.orders]
    assert len(found.corner) == 30
    assert min(np.abs(found.pixels - each[found.corner]).max() for each in expected) < 1.0


@pytest.mark.parametrize("square_mm", [0.5, 3.0, 25.0])
def test_a_page_is_as_large_as_it_says(tmp_path, square_mm):
    board = Board(columns=6, rows=5, square_mm=square_mm)
    for suffix in ("pdf", "svg"):
        run("rig", "target", "--out", tmp_path / f"board.{suffix}", *options(board))
    margin = max(5.0, square_mm / 2)
    width, height = 6 * square_mm + 2 * margin, 5 * square_mm + 2 * margin + 7
    page = (tmp_path / "board.pdf").read_bytes().split(b"/MediaBox [ 0 0 ")[1].split(b"]")[0]
    assert np.allclose([float(each) for each in page.split()], np.array([width, height]) * 72 / 25.4, atol=0.01)
    svg = (tmp_path / "board.svg").read_text()
    assert f'width="{width * 72 / 25.4:.6f}'[:12] in svg


# --- closed loops ------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("exposure", ["together", "apart", "rolling"])
def test_jacobian_agrees_with_finite_differences(exposure):
    truth = scene(0, cameras=2, instants=4) if exposure == "together" else moving(0, instants=6)
    views = views_of(truth, BOARD, 1.0, np.random.default_rng(0))
    if exposure != "together":
        frame, rng = frame_numbers(truth.rig_from_board), np.random.default_rng(1)
        truth = allow_delays(truth, frame, views)
        truth = allow_rolling(truth, frame, views) if exposure == "rolling" else truth
        later = [rng.normal(0, 0.2, count) for count in (3, len(truth.timing.readout), len(views))]
        truth = replace(truth, timing=truth.timing.later(*later))
    even = BoardShape.even(BOARD)
    truth = replace(truth, shape=even.with_step(np.random.default_rng(2).normal(0, 0.05, even.offsets_mm.size)))
    seen = bundle._Observations.of(views, BOARD, truth)
    free = bundle._Free.of(truth, seen, BOARD, only_boards=False)
    values = bundle._derivatives(truth, seen, bundle._project(truth, seen).in_cam)
    jacobian = np.concatenate([free.layout.rows_of(view, values) for view in range(len(seen.keys))])
    for column in range(len(free.columns)):
        step = np.zeros(len(free.columns))
        step[column] = 1e-6
        ahead, back = (bundle._project(bundle._apply_step(truth, free, sign * step), seen).raw for sign in (1, -1))
        numeric = -(ahead - back).ravel() / 2e-6
        assert np.allclose(jacobian[:, column], numeric, atol=1e-4 * max(1, np.abs(numeric).max())), column


@pytest.mark.long
def test_without_noise_the_cameras_are_found_exactly():
    truth = replace(scene(1), bending_mm=np.zeros(3))
    middle = np.array(SIZE) / 2  # where the prior has it
    lenses = {n: replace(undistorted(camera), principal_point_px=middle) for n, camera in truth.cameras.items()}
    truth = replace(truth, cameras=lenses)
    found = calibrated(truth, views_of(truth, BOARD, 0.0, np.random.default_rng(0)))
    for name, camera in truth.cameras.items():
        assert np.allclose(found.rig[name].camera.parameters, camera.parameters, atol=1e-3)
        assert np.linalg.norm(between(found, truth, name).translation) < 1e-4
    assert found.notes == ()


@pytest.mark.long
def test_errors_are_what_the_covariance_states():
    """Over ten rigs: of the lenses, and what is left over is the noise."""
    errors, held_out, apart = [], [], []
    for seed in range(10):
        truth = scene(seed)
        found = calibrated(truth, views_of(truth, BOARD, 0.1, np.random.default_rng(seed)))
        assert 0.09 < found.sigma_px < 0.11
        errors += [lens_error(found, truth, name) for name in truth.cameras]
        held_out += [check.held_out_px for check in found.cameras.values()]
        apart += [check.parameters_apart for check in found.cameras.values()]
    assert 0.8 < np.sqrt(np.mean(np.square(errors))) < 1.2
    assert 0.8 < np.sqrt(np.mean(np.square(apart))) < 1.25
    assert 0.1 < np.mean(held_out) < 0.11


@pytest.mark.long
@pytest.mark.parametrize("scale", [0.01, 50.0])
def test_a_larger_board_gives_a_larger_rig(scale):
    found = []
    for each in (1.0, scale):
        board, truth = replace(BOARD, square_mm=2 * each), scene(2, scale=each)
        found.append(calibrated(truth, views_of(truth, board, 0.1, np.random.default_rng(0)), board))
    for name in found[0].rig.names:
        assert np.allclose(found[0].rig[name].camera.parameters, found[1].rig[name].camera.parameters, atol=0.02)
        assert np.allclose(
            scale * found[0].rig[name].centre_in_rig, found[1].rig[name].centre_in_rig, atol=0.01 * scale
        )


@pytest.mark.long
def test_cameras_that_saw_it_one_after_the_other_are_chained():
    """Each pair of neighbours at instants of its own."""
    truth = scene(3, cameras=4, instants=24)
    views = views_of(truth, BOARD, 0.1, np.random.default_rng(0))
    names, instants = list(truth.cameras), list(truth.rig_from_board)
    shown = {instant: names[k % 3 : k % 3 + 2] for k, instant in enumerate(instants)}
    found = calibrated(truth, {key: view for key, view in views.items() if key[0] in shown[key[1]]})
    assert all(np.linalg.norm(between(found, truth, name).translation) < 0.15 for name in names)
    apart = {key: view for key, view in views.items() if (key[0] in names[:2]) == (int(key[1]) % 2 == 0)}
    with pytest.raises(ReconstructionError, match="cam0, cam1 and cam2, cam3 never saw the board at the same time"):
        calibrated(truth, apart)


@pytest.mark.long
def test_a_chessboard_is_numbered_alike_in_all_cameras():
    truth = scene(4, CHESS)
    rng = np.random.default_rng(0)
    views = views_of(truth, CHESS, 0.05, rng)
    turned = {}
    for key, view in views.items():
        order = CHESS.orders[rng.integers(4)]
        turned[key] = BoardView(np.arange(len(order)), view.pixels[order])
    found = calibrated(truth, turned, CHESS)
    assert found.sigma_px < 0.06
    assert all(np.linalg.norm(between(found, truth, name).translation) < 0.05 for name in truth.cameras)


@pytest.mark.parametrize("filmed", [False, True])
def test_an_instant_that_is_numbered_otherwise_is_found_before_an_uneven_board(filmed):
    """Its corners, rotated by half a turn, are those of another place of the board as it was given."""
    truth = replace(scene(4, CHESS, cameras=2, instants=8), bending_mm=np.zeros(3))
    off_mm = np.random.default_rng(1).normal(0, 0.02, (len(CHESS.corners), 3))
    uneven = replace(truth, shape=replace(BoardShape.even(CHESS), offsets_mm=off_mm))
    seen = bundle._Observations.of(views_of(truth, CHESS, 0.02, np.random.default_rng(0)), CHESS, uneven)
    pixels = np.split(seen.pixels - bundle._project(uneven, seen).raw, seen.starts[1:-1])
    views = {key: BoardView(np.arange(49), each) for key, each in zip(seen.keys, pixels, strict=True)}
    order = CHESS.orders[2]
    turned = {key: view.renumbered(order) if key[1] == "05" else view for key, view in views.items()}
    about = Rigid3(np.diag([-1.0, -1.0, 1.0]), np.array([*CHESS.size_mm, 0.0]))
    poses = {**uneven.rig_from_board, "05": uneven.rig_from_board["05"] @ about}
    start = replace(uneven, rig_from_board=poses)
    start = allow_delays(start, frame_numbers(poses), turned) if filmed else start
    found = renumber_instant(adjust_scene(start, turned, CHESS, only_boards=True), turned, CHESS)
    assert found is not None
    assert all(np.array_equal(view.corner, views[key].corner) for key, view in found[1].items())
    assert np.allclose(found[0].rig_from_board["05"].matrix, uneven.rig_from_board["05"].matrix, atol=0.01)
    assert renumber_instant(adjust_scene(uneven, views, CHESS, only_boards=True), views, CHESS) is None


@pytest.mark.long
def test_a_view_of_another_instant_is_left_out_and_named():
    truth = scene(5)
    views = views_of(truth, BOARD, 0.1, np.random.default_rng(0))
    shifted = views["cam1", "03"]
    views["cam1", "03"] = BoardView(shifted.corner, shifted.pixels + [3.0, -2.0])
    found = calibrated(truth, views)
    assert len(found.notes) == 1
    assert found.notes[0].startswith("camera cam1, 03: left out")
    assert max(lens_error(found, truth, name) for name in truth.cameras) < 2.5


def test_a_lens_that_the_model_does_not_have_is_known_less_well():
    """Than the scatter of its corners tells, as its views disagree; those of the others do not."""
    truth = scene(6)
    views = views_of(truth, BOARD, 0.02, np.random.default_rng(0))
    middle = np.array(SIZE) / 2
    for key, view in views.items():
        if key[0] == "cam0":
            away = (view.pixels - middle) / middle
            bent = view.pixels + 2.0 * np.sin(9 * away[:, :1]) * np.array([0.0, 1.0])
            views[key] = BoardView(view.corner, bent)
    found = adjust_board(truth, views, BOARD)
    by_corners = np.sqrt(np.diag(found.covariance)[: 8 * len(truth.cameras)]).reshape(-1, 8)
    stated = [np.sqrt(np.diag(each.camera.covariance)) for each in bundle.mounted_cameras(found).values()]
    wider = np.array(stated) / by_corners
    assert (wider[0] > 3).all()
    assert (wider[0] < 10).all()
    assert (wider[1:] < 1.6).all()


@pytest.mark.long
def test_a_view_that_no_board_explains_is_left_out_and_named():
    truth = scene(5)
    rng = np.random.default_rng(0)
    views = views_of(truth, BOARD, 0.1, rng)
    for instant in ("03", "08"):
        corner = views["cam1", instant].corner
        views["cam1", instant] = BoardView(corner, rng.uniform(0, 480, (len(corner), 2)))
    found = calibrated(truth, views)
    assert [note[:22] for note in found.notes] == ["camera cam1, 03: left ", "camera cam1, 08: left "]
    assert max(lens_error(found, truth, name) for name in truth.cameras) < 2.5


@pytest.mark.long
def test_a_camera_that_saw_no_board_is_refused_by_name():
    truth = scene(5)
    rng = np.random.default_rng(0)
    views = views_of(truth, BOARD, 0.1, rng)
    wild = {
        key: BoardView(view.corner, rng.uniform(0, 480, view.pixels.shape)) if key[0] == "cam2" else view
        for key, view in views.items()
    }
    with pytest.raises(ReconstructionError, match="camera cam2: no camera model fits its views of the board"):
        calibrated(truth, wild)
    with pytest.raises(
        ReconstructionError, match=r"camera cam0: no camera model fits its views of the board \(error \d+ px\)"
    ):
        calibrated(truth, views_of(truth, BOARD, 20.0, rng))
    with pytest.raises(ReconstructionError, match="camera cam0: no camera model fits its views of the board"):
        calibrated(truth, {key: BoardView(view.corner[:8], view.pixels[:8]) for key, view in views.items()})


@pytest.mark.long
def test_cameras_that_were_not_triggered_together_are_refused():
    """The second saw the board one instant later than its names say."""
    truth = scene(5)
    views = views_of(truth, BOARD, 0.1, np.random.default_rng(0))
    count = len(truth.rig_from_board)
    late = {(name, f"{(int(instant) + (name == 'cam1')) % count:02d}"): view for (name, instant), view in views.items()}
    told = (
        r"only \d+ of 16 instants agree on the pose of cam1 relative to cam0, but 15 of 15 do if cam0 began 1 instant "
    )
    with pytest.raises(ReconstructionError, match=told):
        calibrated(truth, late)


def shaken():
    """A rig, and views in which the second camera saw each board a little aside."""
    truth, rng = scene(5), np.random.default_rng(0)
    views = views_of(truth, BOARD, 0.05, rng)
    return truth, {
        key: BoardView(view.corner, view.pixels + rng.normal(0, 0.6, 2)) if key[0] == "cam1" else view
        for key, view in views.items()
    }


@pytest.mark.long
def test_cameras_that_moved_against_each_other_are_told_of():
    """The second saw each board a little aside: less than what makes a view odd, more than its own views leave."""
    truth, views = shaken()
    found = calibrated(truth, views)
    assert any(note.startswith("camera cam1") and "px alone; they may not have seen" in note for note in found.notes)
    assert found.cameras["cam1"].alone_px < 0.1 < 3 * found.cameras["cam1"].alone_px < found.cameras["cam1"].rms_px


def freely_running(
    truth: BoardScene, seed: int, delays: dict[str, float], jitter: float, noise_px: float
) -> dict[tuple[str, str], BoardView]:
    """What cameras see of a moving board that expose so many frames late, each time with an error."""
    rng, views = np.random.default_rng(seed), {}
    for name, delay in delays.items():
        times = {instant: int(instant) + delay + rng.normal(0, jitter) for instant in truth.rig_from_board}
        late = replace(
            truth,
            cameras={name: truth.cameras[name]},
            rig_from_board={instant: moving_pose(time) for instant, time in times.items()},
        )
        views |= views_of(late, BOARD, noise_px, rng)
    return views


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
def test_cameras_that_run_freely_are_calibrated_along_the_path_of_the_board(seed):
    """One is 0.7 frames late, and none keeps time."""
    truth, delays = moving(seed), {"cam0": 0.0, "cam1": 0.7, "cam2": 0.2}
    views = freely_running(truth, seed, delays, 0.1, 0.05)
    found = calibrated(truth, views)
    told = next(note for note in found.notes if note.startswith("the cameras did not expose together"))
    for name, check in found.cameras.items():
        assert lens_error(found, truth, name) < 2.5
        assert np.linalg.norm(between(found, truth, name).translation) < 0.15
        assert check.held_out_px < 0.15
        assert check.delay_frames == pytest.approx(delays[name] - 0.3, abs=0.1)
        assert 0.05 < check.delay_spread_frames < 0.2
        assert f"{name} {check.delay_frames:+.2f} ± {check.delay_spread_frames:.2f}" in told


@pytest.mark.long
def test_without_an_order_of_time_cameras_that_run_freely_are_doubted():
    """As if they were together, errors are many times what is stated."""
    truth = moving(0)
    views = freely_running(truth, 0, {"cam0": 0.0, "cam1": 0.7, "cam2": 0.2}, 0.1, 0.05)
    together = calibrated(truth, {(camera, f"a{instant}"): view for (camera, instant), view in views.items()})
    assert all(check.delay_frames is None and check.rms_px > 0.25 for check in together.cameras.values())
    assert any("may not have seen the board at the same moment" in note for note in together.notes)


def test_halves_are_runs_of_time_where_cameras_do_not_expose_together():
    """Instants follow each other by their numbers, not by their names, of which 10 would come before 2."""
    view = BoardView(np.zeros(0, dtype=np.int64), np.zeros((0, 2)))
    views = {(name, str(instant)): view for name in ("cam0", "cam1") for instant in range(24)}
    timing = bundle.Timing(frame={str(k): k for k in range(24)}, near={}, by_camera={}, by_view={})
    halves = calibrate._halves(views, timing)
    early = {*range(6), *range(12, 18)}
    assert [{int(instant) for _, instant in half} for half in halves] == [early, set(range(24)) - early]
    assert sum(len(half) for half in halves) == len(views)
    assert {instant for _, instant in calibrate._halves(views, None)[0]} == set(sorted(timing.frame)[::2])


@pytest.mark.long
def test_cameras_that_expose_together_have_no_delays():
    truth = moving(0)
    found = calibrated(truth, freely_running(truth, 0, dict.fromkeys(truth.cameras, 0.0), 0.0, 0.1))
    assert found.notes == ()
    assert all(check.delay_frames is None and check.alone_apart < 1.5 for check in found.cameras.values())


def test_a_few_views_judge_no_calibration():
    truth = scene(2, BOARD, cameras=2, instants=5)
    found = calibrated(truth, views_of(truth, BOARD, 0.1, np.random.default_rng(2)))
    assert all(check.alone_apart is None and check.parameters_apart is None for check in found.cameras.values())
    assert not any("standard deviations" in note for note in found.notes)


@pytest.mark.long
@pytest.mark.parametrize("worse", ["undetermined", "no better", "few views", "no halves"])
def test_delays_that_explain_nothing_are_not_taken(monkeypatch, worse):
    """Doubtful views are tried with delays; the calibration without stays where these fail, or leave much out."""
    truth, views = shaken()
    usual, tried = calibrate._describe, []

    def described(found, *rest):
        made = usual(found, *rest)
        if found.scene.timing is None:
            unchecked = {name: replace(each, held_out_px=None) for name, each in made.cameras.items()}
            return replace(made, cameras=unchecked) if worse == "no halves" else made
        tried.append(worse)
        if worse == "undetermined":
            raise ReconstructionError("calibration: the images do not determine all parameters")
        held_out = 1e-3 if worse in ("few views", "no halves") else 10.0
        some = dict(list(made.views.items())[:20]) if worse == "few views" else made.views
        return replace(
            made, views=some, cameras={n: replace(each, held_out_px=held_out) for n, each in made.cameras.items()}
        )

    monkeypatch.setattr(calibrate, "_describe", described)
    found = calibrated(truth, views)
    assert tried == [worse]
    assert all(check.delay_frames is None for check in found.cameras.values())


def test_a_polynomial_goes_through_what_it_is_of():
    frames = np.array([[4.0, 2.0, 5.0], [7.0, 8.0, np.nan], [3.0, np.nan, np.nan]])
    times, paths = np.array([4.6, 7.4, 3.9]), ([0.5, -2.0, 1.0], [3.0, 1.0], [2.0])
    weights, slopes = bundle.interpolation(frames, times)
    assert np.allclose(weights.sum(axis=1), 1)
    assert np.allclose(slopes.sum(axis=1), 0)
    for path, weight, frame, time in zip(paths, weights, frames, times, strict=True):
        assert weight @ np.polyval(path, np.nan_to_num(frame)) == pytest.approx(np.polyval(path, time))
    ahead, back = (bundle.interpolation(frames, times + step)[0] for step in (1e-6, -1e-6))
    assert np.allclose(slopes, (ahead - back) / 2e-6, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize(("facing", "told"), [(True, {"cam0", "cam1", "cam2"}), (False, set())])
def test_boards_that_always_faced_the_cameras_leave_the_focal_length_open(facing, told):
    truth = scene(0)
    if facing:
        untilted = {name: Rigid3(np.eye(3), pose.translation) for name, pose in truth.rig_from_board.items()}
        truth = replace(truth, rig_from_board=untilted)
    found = calibrated(truth, views_of(truth, BOARD, 0.1, np.random.default_rng(0)))
    assert {note.split(":")[0].split()[1] for note in found.notes if "its focal length is known" in note} == told
    for name in truth.cameras:
        assert lens_error(found, truth, name) < 2.5


@pytest.mark.long
def test_halves_without_common_boards_give_no_cross_validation():
    """The third camera shares only every fourth instant with the others, so that the odd half has none."""
    truth = scene(4, instants=16)
    views = views_of(truth, BOARD, 0.1, np.random.default_rng(0))
    kept = {
        key: view for key, view in views.items() if (int(key[1]) % 2 == 0) or ((key[0] == "cam2") == (key[1] > "07"))
    }
    found = calibrated(truth, kept)
    assert all(each.held_out_px is None and each.place_apart is None for each in found.cameras.values())
    assert all(lens_error(found, truth, name) < 2.5 for name in truth.cameras)


@pytest.mark.long
def test_covariances_are_widened_by_the_square_of_how_far_halves_are_apart_beyond_chance(monkeypatch):
    truth = scene(6)
    views = views_of(truth, BOARD, 0.1, np.random.default_rng(0))
    plain = calibrated(truth, views)
    factors = dict.fromkeys(truth.cameras, (3.0, 5.0))
    monkeypatch.setattr(calibrate, "_cross_validated", lambda *given: (dict.fromkeys(factors, 0.1), factors))
    wide = calibrated(truth, views)
    for name in truth.cameras:
        assert max(plain.cameras[name].parameters_apart, plain.cameras[name].place_apart) < 2
        assert (plain.widened[name], wide.widened[name]) == (1, 3)
        assert np.allclose(wide.rig[name].camera.covariance / 3**2, plain.rig[name].camera.covariance)
        assert np.allclose(wide.rig[name].covariance / 5**2, plain.rig[name].covariance)


@pytest.mark.long
def test_a_search_that_did_not_end_is_told_of(monkeypatch):
    truth = scene(6)
    views = views_of(truth, BOARD, 0.1, np.random.default_rng(0))
    start = replace(truth, cameras={name: undistorted(camera) for name, camera in truth.cameras.items()})
    assert adjust_board(start, views, BOARD).settled
    monkeypatch.setattr(bundle, "_STEPS", 1)
    assert not adjust_board(start, views, BOARD).settled
    assert any("did not converge" in note for note in calibrated(truth, views).notes)


def test_too_few_views_are_refused():
    truth = scene(7)
    views = views_of(truth, BOARD, 0.1, np.random.default_rng(0))
    few = {key: view for key, view in views.items() if key[0] != "cam2" or key[1] in ("00", "01")}
    with pytest.raises(ReconstructionError, match=r"3 instants or more by each camera, but is at fewer \(cam2 2\)"):
        calibrated(truth, few)


def test_boards_alone_are_placed_in_a_known_rig():
    truth = scene(8)
    views = views_of(truth, BOARD, 0.1, np.random.default_rng(0))
    push = Rigid3.from_rotation_vector(np.array([0.02, -0.01, 0.03]), np.array([0.3, -0.2, 0.4]))
    start = replace(truth, rig_from_board={name: push @ pose for name, pose in truth.rig_from_board.items()})
    found = adjust_board(start, views, BOARD, only_boards=True)
    assert all(np.array_equal(found.scene.cameras[n].parameters, truth.cameras[n].parameters) for n in truth.cameras)
    off = [(found.scene.rig_from_board[name] @ pose.inverse()).angle_deg for name, pose in truth.rig_from_board.items()]
    assert max(off) < 0.1


def test_a_few_corners_almost_on_a_line_have_a_pose():
    """Five in a row and one beside it, at which the method for planes gives up."""
    board = Board(columns=9, rows=7, square_mm=0.7)
    camera = Camera(width=250, height=250, focal_px=np.full(2, 207.3), principal_point_px=np.array([123.7, 126.3]))
    pixels = [[81.6, 203.9], [105.1, 199.3], [130.3, 194.0], [156.1, 189.1], [191.6, 213.1], [183.7, 183.4]]
    view = BoardView(np.array([7, 15, 23, 31, 38, 39]), np.array(pixels))
    found = camera.project(board_pose(view, board, camera).apply(board.corners[view.corner]))
    assert np.linalg.norm(found - view.pixels, axis=1).max() < 1


def test_one_camera_begins_near_the_truth():
    truth = scene(9, cameras=1)
    views = views_of(truth, BOARD, 0.1, np.random.default_rng(0))
    start = first_camera(list(views.values()), BOARD, SIZE)
    assert np.abs(start.focal_px / truth.cameras["cam0"].focal_px - 1).max() < 0.05


# --- from images -------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("kind", ["charuco", "chessboard"])
def test_photographs_of_a_board_become_a_handpiece(tmp_path, capsys, kind):
    board = Board(kind=kind, columns=8, rows=8, square_mm=2.0)
    flat = replace(scene(10, board, cameras=2, instants=10), bending_mm=np.zeros(3))
    truth = replace(flat, cameras={name: undistorted(camera) for name, camera in flat.cameras.items()})
    photographs(tmp_path / "images", truth, board)
    run("calibrate", tmp_path / "images", "--out", tmp_path / "rig", *options(board))
    handpiece = storage.read_handpiece(tmp_path / "rig" / "handpiece.json")
    checks = storage.read_json(tmp_path / "rig" / "calibration.json")["cameras"]
    assert set(handpiece.rig.names) == {"cam0", "cam1"}
    assert all(check["rms_px"] < 0.1 and check["held_out_px"] < 0.1 for check in checks.values())
    for name, camera in truth.cameras.items():
        assert np.abs(handpiece.rig[name].camera.focal_px / camera.focal_px - 1).max() < 0.01
        assert handpiece.rig[name].covariance is not None
    ours, true = (
        np.linalg.norm(places["cam1"].inverse().translation - places["cam0"].inverse().translation)
        for places in ({n: m.cam_from_rig for n, m in handpiece.rig.cameras.items()}, truth.cam_from_rig)
    )
    assert abs(ours - true) < 0.05
    assert (tmp_path / "rig" / "residuals.png").stat().st_size > 5_000
    assert "Calibration" in capsys.readouterr().err


def test_what_cannot_be_calibrated_is_one_line(tmp_path, capsys):
    out = tmp_path / "rig"
    assert "no such folder" in refused(capsys, "calibrate", tmp_path / "none", "--out", out)
    (tmp_path / "empty").mkdir()
    assert "each camera needs one" in refused(capsys, "calibrate", tmp_path / "empty", "--out", out)
    for index in range(3):
        storage.write_image(tmp_path / "gray" / "left" / f"{index}.png", np.full((64, 64, 3), 128, np.uint8))
    message = refused(capsys, "calibrate", tmp_path / "gray", "--out", out)
    assert "is at fewer (left 0)" in message
    (tmp_path / "gray" / "left" / "2.png").unlink()
    message = refused(capsys, "calibrate", tmp_path / "gray", "--out", out)
    assert "at 3 instants or more are needed of each camera, but there are fewer (left 2)" in message
    assert not out.exists()
    assert "a board is written as .pdf" in refused(capsys, "rig", "target", "--out", tmp_path / "board.txt")


@pytest.mark.long
def test_a_calibration_that_fails_leaves_the_one_before(tmp_path, capsys):
    board = Board(columns=8, rows=8, square_mm=2.0)
    flat = replace(scene(11, board, cameras=1, instants=4), bending_mm=np.zeros(3))
    truth = replace(flat, cameras={name: undistorted(camera) for name, camera in flat.cameras.items()})
    photographs(tmp_path / "photos", truth, board)
    run("calibrate", tmp_path / "photos", "--out", tmp_path / "rig", *options(board))
    before = {path.name: path.read_bytes() for path in (tmp_path / "rig").iterdir()}
    other = options(replace(board, kind="chessboard", columns=5))
    assert "give --kind charuco --dictionary 4X4_1000 --columns 8 --rows 8, with its --square-mm" in refused(
        capsys, "calibrate", tmp_path / "photos", "--out", tmp_path / "rig", *other
    )
    assert {path.name: path.read_bytes() for path in (tmp_path / "rig").iterdir()} == before


@pytest.mark.long
@pytest.mark.parametrize("kind", ["charuco", "chessboard"])
def test_a_dark_board_of_16_bits_has_the_corners_of_a_bright_one(tmp_path, kind):
    """Of which 8 bits would leave 16 levels of grey."""
    board = Board(kind=kind, columns=8, rows=8, square_mm=2.0)
    truth = undistorted(scene(10, board, cameras=1, instants=1).cameras["cam0"])
    pose = pose_before(board, 24.0, 35.0, roll_deg=120.0)
    seen = np.dstack([photograph(board, truth, pose, seed=5).astype(np.uint16)] * 3)
    bright = 257 * seen + np.random.default_rng(0).integers(0, 257, seen.shape).astype(np.uint16)
    storage.write_image(tmp_path / "cam/1.png", bright)
    storage.write_image(tmp_path / "cam/2.png", bright // 16)
    views = from_images._views({"cam": storage.read_sequence(tmp_path / "cam")}, board, silent)
    one, other = views["cam", "1"], views["cam", "2"]
    assert np.array_equal(one.corner, other.corner)
    assert len(one.corner) >= 48
    assert 0 < np.abs(one.pixels - other.pixels).max() < 0.02


def test_films_tell_their_rate_where_they_have_one(tmp_path):
    def sequence(rate):
        return ImageSequence(source=tmp_path, paths=(), size=SIZE, frames_per_s=rate)

    for rates, common in (((25.0, 25.1), 25.0), ((25.0, 30.0), None), ((25.0, None), None), ((None,), None)):
        assert from_images._common_rate({str(k): sequence(rate) for k, rate in enumerate(rates)}) == common


def test_photographs_that_are_there_are_not_taken_again(tmp_path):
    run("rig", "build", "--design", "four", "--width-px", 60, "--height-px", 60, "--out", tmp_path / "drawn")
    take = ("rig", "photograph", tmp_path / "drawn" / "handpiece.json", "--out", tmp_path / "out", "--instants", 3)
    run(*take)
    files = sorted((tmp_path / "out" / "images").rglob("*.png"))
    before, times = [file.read_bytes() for file in files], [file.stat().st_mtime_ns for file in files]
    files[4].unlink()
    files[7].write_bytes(b"cut")
    run(*take)
    assert [file.read_bytes() for file in files] == before
    assert [k for k, file in enumerate(files) if file.stat().st_mtime_ns != times[k]] == [4, 7]


@pytest.mark.long
def test_a_rehearsed_calibration_finds_the_handpiece_that_was_built(tmp_path):
    """Four cameras of an intra-oral size, off from the drawn ones, with lenses that distort."""
    board = ("--columns", 9, "--rows", 7, "--square-mm", 0.7)
    run("rig", "build", "--design", "four", "--width-px", 240, "--height-px", 240, "--out", tmp_path / "drawn")
    run(
        *("rig", "photograph", tmp_path / "drawn" / "handpiece.json", "--out", tmp_path / "photos", *board),
        *("--instants", 14, "--supersampling", 2, "--manufacturing-um", 30, "--manufacturing-deg", 0.3),
        *("--manufacturing-focal-pct", 1, "--manufacturing-centre-px", 3, "--manufacturing-k1", 0.05),
    )
    run("calibrate", tmp_path / "photos", "--out", tmp_path / "rig", *board, "--working-distance-mm", 5)
    drawn, true, found = (
        storage.read_handpiece(tmp_path / folder / "handpiece.json").rig for folder in ("drawn", "photos/truth", "rig")
    )
    errors = []
    for name, mounted in found.cameras.items():
        off = mounted.camera.parameters - true[name].camera.parameters
        errors.append(off @ np.linalg.solve(mounted.camera.covariance, off) / 8)
    assert 0.3 < np.sqrt(np.mean(errors)) < 1.7
    assert apart_um(found, true) < 0.2 * apart_um(drawn, true)


def apart_um(one: Rig, other: Rig) -> float:
    """RMS difference of the distances between the cameras."""
    centres = (np.array([each.centre_in_rig for each in rig.cameras.values()]) for rig in (one, other))
    ours, theirs = (np.linalg.norm(each[:, None] - each, axis=2) for each in centres)
    return float(1000 * np.sqrt(np.mean((ours - theirs) ** 2)))


def upside_down(camera: Camera, views: dict) -> tuple[Camera, dict]:
    """A camera that is turned by half a turn about its axis, and what it sees."""
    size, (k1, k2, p1, p2) = np.array(SIZE), camera.distortion
    turned = replace(
        camera, principal_point_px=size - camera.principal_point_px, distortion=np.array([k1, k2, -p1, -p2])
    )
    return turned, {key: BoardView(view.corner, size - view.pixels) for key, view in views.items()}


def test_a_readout_is_found_along_the_path_of_the_board_and_turns_with_the_camera():
    """Within what is stated, and the lens too, which is wrong if the readout is ignored; a board that is held still
    tells none."""
    whole = moving(3, instants=20)
    truth = replace(whole, cameras={"cam1": whole.cameras["cam1"]})
    views = rolling_views(truth, {"cam1": 0.6}, {}, 0.1, np.random.default_rng(3))
    how = CalibrationOptions(lens="OPENCV", frames_per_s=20.0)
    found = calibrate_rig(views, {"cam1": SIZE}, BOARD, how)
    check, shutter = found.cameras["cam1"], found.rig["cam1"].shutter
    assert (shutter.readout, shutter.readout_sigma) == (check.readout, check.readout_sigma)
    assert check.delay_frames is None
    assert 0 < check.readout_sigma < 0.02
    assert abs(check.readout - 0.6) < 3 * check.readout_sigma
    assert lens_error(found, truth, "cam1") < 2
    told = f"cam1 {check.readout:+.3f} ± {check.readout_sigma:.3f} ({50 * check.readout:+.1f} ms)"
    assert any(told in note for note in found.notes)
    ignored = calibrate_rig(views, {"cam1": SIZE}, BOARD, CalibrationOptions(lens="OPENCV", shutter="global"))
    assert ignored.cameras["cam1"].readout is None
    assert ignored.rig["cam1"].shutter == PLAIN
    assert ignored.cameras["cam1"].rms_px > 1.3 * check.rms_px
    turned, seen = upside_down(truth.cameras["cam1"], views)
    again = calibrate_rig(seen, {"cam1": SIZE}, BOARD, CalibrationOptions(lens="OPENCV"))
    assert again.cameras["cam1"].readout == pytest.approx(-check.readout, abs=0.1 * check.readout_sigma)
    assert np.allclose(again.rig["cam1"].camera.focal_px, found.rig["cam1"].camera.focal_px, rtol=1e-4)
    assert np.allclose(again.rig["cam1"].camera.principal_point_px, turned.principal_point_px, atol=3)


@pytest.mark.parametrize("film", [True, False])
def test_a_global_shutter_and_a_board_at_rest_tell_no_readout(film):
    whole = moving(4, instants=16) if film else scene(4, cameras=2)
    truth = replace(whole, cameras={"cam1": whole.cameras["cam1"]})
    views = views_of(truth, BOARD, 0.1, np.random.default_rng(4))
    found = calibrate_rig(views, {"cam1": SIZE}, BOARD, CalibrationOptions(lens="OPENCV"))
    assert found.cameras["cam1"].readout is None
    assert found.rig["cam1"].shutter == PLAIN
    assert not any("rows" in note for note in found.notes)
