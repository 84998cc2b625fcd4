"""Several boards at once, and cameras that never share one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boards import SIZE, photograph, scene
from cuspid import storage
from cuspid.calibration import bundle
from cuspid.calibration.bundle import BoardScene, adjust_board
from cuspid.calibration.calibrate import CalibrationOptions, RigCalibration, calibrate_rig
from cuspid.calibration.corners import BoardView, Views
from cuspid.calibration.joining import hand_eye, second_turn_deg
from cuspid.geometry import Rigid3
from cuspid.model.board import Board, BoardSet
from cuspid.model.camera import Camera
from cuspid.runtime.errors import InputError, ReconstructionError
from verbs import refused, run

ONE = Board(columns=6, rows=5, square_mm=2.0)
TWO = replace(ONE, first_id=40)
THREE = Board(kind="aprilgrid", columns=3, rows=2, square_mm=3.0)
SET = BoardSet(boards=(ONE, TWO, THREE))
OPENCV = CalibrationOptions(lens="OPENCV")
MOUNTS = {
    1: Rigid3.from_rotation_vector(np.array([0.1, 0.5, 0.05]), np.array([12.5, 0.5, -2.0])),
    2: Rigid3.from_rotation_vector(np.array([-0.4, 0.1, -0.1]), np.array([1.0, 11.0, -1.0])),
}


def on_a_body(seed: int, cameras: int = 3, instants: int = 16, tilt_deg: float = 40.0) -> BoardScene:
    """Cameras over three boards that are fixed to one another."""
    rng = np.random.default_rng(seed)
    plain = scene(seed, Board(columns=11, rows=9, square_mm=2.0), cameras=cameras, instants=1)
    first, poses = plain.cam_from_rig["cam0"], {}
    for i in range(instants):
        turn = Rotation.from_euler("xyz", rng.uniform(-tilt_deg, tilt_deg, 3), degrees=True).as_matrix()
        middle = np.array([2.0 * (cameras - 1), 0, 32.0]) + rng.normal(0, [3, 3, 4])
        poses[f"{i:02d}"] = first @ Rigid3(turn, middle - turn @ np.array([11.0, 9.0, 0.0]))
    return replace(plain, rig_from_board=poses, bending_mm=np.zeros(9), body_from_board=MOUNTS)


def seen_by(
    truth: BoardScene,
    noise_px: float,
    seed: int = 0,
    *,
    who: Callable[[str, str, int], bool] = lambda camera, instant, board: True,
) -> dict[tuple[str, str], BoardView]:
    """What the cameras see of the boards that they are let see."""
    rng, views, which = np.random.default_rng(seed), {}, SET.board_of(np.arange(len(SET.corners)))
    for name, camera in truth.cameras.items():
        for instant, pose in truth.rig_from_board.items():
            numbers, places = [], []
            for board in range(3):
                if not who(name, instant, board):
                    continue
                own = np.flatnonzero(which == board)
                mount = truth.body_from_board.get(board, Rigid3.identity())
                pixels = camera.project((truth.cam_from_rig[name] @ pose @ mount).apply(SET.corners[own]))
                inside = camera.contains(pixels)
                if inside.sum() >= 8:
                    numbers.append(own[inside])
                    places.append(pixels[inside] + rng.normal(0, noise_px, (inside.sum(), 2)))
            if numbers:
                views[name, instant] = BoardView(np.concatenate(numbers), np.concatenate(places))
    return views


def calibrated(truth: BoardScene, views: Views) -> RigCalibration:
    return calibrate_rig(views, dict.fromkeys(truth.cameras, SIZE), SET, OPENCV)


def mount_errors(found: RigCalibration, truth: BoardScene) -> list[tuple[float, float]]:
    """Of the boards beside the first one: degrees, and mm."""
    off = [(found.body_from_board[k] @ truth.body_from_board[k].inverse(), k) for k in found.body_from_board]
    return [
        (each.angle_deg, float(np.linalg.norm(each.apply(SET.boards[k].corners[:1]) - SET.boards[k].corners[:1])))
        for each, k in off
    ]


def rig_errors(found: RigCalibration, truth: BoardScene) -> np.ndarray:
    """Of places and turns beside the first camera, in their stated standard deviations; lenses likewise."""
    errors = []
    for name in truth.cameras:
        camera = found.rig[name].camera
        off = camera.parameters - truth.cameras[name].parameters
        errors.append(off @ np.linalg.solve(camera.covariance, off) / len(off))
    return np.sqrt(errors)


def test_ids_tell_boards_and_may_not_meet() -> None:
    with pytest.raises(InputError, match=r"numbers 1 and 2 both have the id 10 \(0-14 and 10-24\)"):
        BoardSet(boards=(ONE, replace(ONE, first_id=10)))
    BoardSet(boards=(ONE, replace(ONE, dictionary="5X5_1000")))  # of another family
    with pytest.raises(InputError, match="number 2 is a chessboard, which cannot be distinguished from the others"):
        BoardSet(boards=(ONE, Board(kind="chessboard")))
    with pytest.raises(InputError, match="number 1 has terraces"):
        BoardSet(boards=(replace(ONE, terraces=2), TWO))
    assert SET.board_of(np.array([0, 19, 20, 39, 40, 63])).tolist() == [0, 0, 1, 1, 2, 2]


def test_jacobian_by_the_places_of_boards() -> None:
    truth = on_a_body(0, cameras=2, instants=3)
    truth = replace(truth, bending_mm=np.linspace(-0.05, 0.05, 9))
    views = seen_by(truth, 1.0)
    seen = bundle._Observations.of(views, SET, truth)
    free = bundle._Free.of(truth, seen, SET, only_boards=False)
    values = bundle._derivatives(truth, seen, bundle._project(truth, seen).in_cam)
    jacobian = np.concatenate([free.layout.rows_of(view, values) for view in range(len(seen.keys))])
    for column in range(len(free.columns)):
        step = np.zeros(len(free.columns))
        step[column] = 1e-6
        ahead, back = (bundle._project(bundle._apply_step(truth, free, sign * step), seen).raw for sign in (1, -1))
        numeric = -(ahead - back).ravel() / 2e-6
        assert np.allclose(jacobian[:, column], numeric, atol=1e-4 * max(1, np.abs(numeric).max())), column


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
def test_boards_that_are_fixed_to_one_another_are_placed(seed: int) -> None:
    truth = on_a_body(seed)
    found = calibrated(truth, seen_by(truth, 0.1, seed))
    assert found.sigma_px == pytest.approx(0.1, rel=0.06)
    assert 0.3 < np.sqrt(np.mean(rig_errors(found, truth) ** 2)) < 1.7
    assert set(found.body_from_board) == {1, 2}
    assert all(turn < 0.1 and 1e-4 < shift < 0.05 for turn, shift in mount_errors(found, truth))
    assert not any("never saw" in note for note in found.notes)


@pytest.mark.long
def test_boards_that_only_some_cameras_see_join_the_others() -> None:
    """The first camera sees the first board, the last one the third, and the one between them all."""
    truth = on_a_body(2)
    views = seen_by(
        truth, 0.1, who=lambda camera, _, board: camera == "cam1" or board == (0 if camera == "cam0" else 2)
    )
    found = calibrated(truth, views)
    assert 0.3 < np.sqrt(np.mean(rig_errors(found, truth) ** 2)) < 1.7
    assert all(turn < 0.2 and shift < 0.1 for turn, shift in mount_errors(found, truth))
    assert not any("never saw" in note for note in found.notes)


def test_a_board_that_was_never_seen_with_another_is_used_all_the_same() -> None:
    """At every second instant the second board alone is shown."""
    truth = on_a_body(3)
    views = seen_by(truth, 0.1, who=lambda _, instant, board: board == int(instant) % 2)
    found = calibrated(truth, views)
    assert found.body_from_board == {}
    assert 0.3 < np.sqrt(np.mean(rig_errors(found, truth) ** 2)) < 1.7


def apart(truth: BoardScene, views: Views) -> dict[tuple[str, str], BoardView]:
    """Without the views of the camera in the middle."""
    return {key: view for key, view in views.items() if key[0] != "cam1"}


def never_shared(truth: BoardScene, noise_px: float, seed: int = 0) -> dict[tuple[str, str], BoardView]:
    """The first camera sees the first board alone, the last one the second alone."""
    return seen_by(truth, noise_px, seed, who=lambda camera, _, board: board == (0 if camera == "cam0" else 1))


@pytest.mark.parametrize("seed", range(2))
def test_cameras_that_never_share_a_board_are_joined_by_their_motion(seed: int) -> None:
    truth = on_a_body(seed, cameras=2, instants=20)
    found = calibrated(truth, never_shared(truth, 0.1, seed))
    note = next(each for each in found.notes if "never saw a board together" in each)
    assert note.startswith("cam0 and cam1 never saw a board together: joined by how both moved")
    ours = found.rig["cam1"].cam_from_rig @ found.rig["cam0"].cam_from_rig.inverse()
    off = ours @ truth.cam_from_rig["cam1"].inverse()
    assert off.angle_deg < 0.8
    assert 1e-4 < np.linalg.norm(off.translation) < 0.3
    assert 0.3 < np.sqrt(np.mean(rig_errors(found, truth) ** 2)) < 1.7


@pytest.mark.long
def test_places_of_cameras_joined_by_motion_are_as_uncertain_as_they_state() -> None:
    """Over six rigs: the pose of one beside the other, in the standard deviations that both state."""
    errors = []
    for seed in range(10, 16):
        truth = on_a_body(seed, cameras=2, instants=14)
        found = calibrated(truth, never_shared(truth, 0.1, seed))
        motions = []
        for name in truth.cameras:
            off = found.rig[name].cam_from_rig @ truth.cam_from_rig[name].inverse()
            motions.append(np.array([*off.rotation_vector, *off.translation]))
        for own, name in zip(bundle.common_free(truth, motions), truth.cameras, strict=True):
            covariance = found.rig[name].covariance
            errors.append(own @ np.linalg.pinv(covariance, hermitian=True) @ own / 6)
    assert 0.5 < np.sqrt(np.mean(errors)) < 1.5


def test_with_too_little_turning_cameras_are_not_joined() -> None:
    truth = on_a_body(4, cameras=2)
    upright = {
        name: Rigid3(Rotation.from_rotvec([0, 0.04 * k, 0.0]).as_matrix() @ np.eye(3), pose.translation)
        for k, (name, pose) in enumerate(truth.rig_from_board.items())
    }
    truth = replace(truth, rig_from_board=upright)
    with pytest.raises(
        ReconstructionError,
        match=r"cam0 and cam1 never saw a board together, .* turned by only \d\.\d degrees about a second axis",
    ):
        calibrated(truth, never_shared(truth, 0.02))


def test_boards_that_moved_against_each_other_are_told() -> None:
    truth, rng = on_a_body(5), np.random.default_rng(0)
    views: dict[tuple[str, str], BoardView] = {}
    for instant in truth.rig_from_board:
        loose = Rigid3.from_rotation_vector(rng.normal(0, 0.3, 3), np.array([12.0, 0.0, 0.0]) + rng.normal(0, 2, 3))
        moved = replace(truth, body_from_board={**MOUNTS, 1: loose})
        views |= seen_by(replace(moved, rig_from_board={instant: truth.rig_from_board[instant]}), 0.1)
    with pytest.raises(
        ReconstructionError, match=r"agree on where board 2 is .*the boards must be fixed to one another"
    ):
        calibrated(truth, views)


def test_cameras_that_nothing_joins_are_refused() -> None:
    truth = on_a_body(6, cameras=2)
    views = never_shared(truth, 0.1)
    halves = {key: view for key, view in views.items() if (key[0] == "cam0") == (int(key[1]) % 2 == 0)}
    with pytest.raises(ReconstructionError, match="cam0 and cam1 never saw a board at the same time, nor two"):
        calibrated(truth, halves)


def test_hand_eye_without_noise_is_exact() -> None:
    rng = np.random.default_rng(0)
    x, y, *first = (Rigid3(Rotation.random(random_state=k).as_matrix(), rng.normal(0, 10, 3)) for k in range(8))
    second = [x.inverse() @ a @ y for a in first]
    for found, true in zip(hand_eye(first, second), (x, y), strict=True):
        assert np.allclose(found.matrix, true.matrix, atol=1e-9)
    turned = [Rigid3(Rotation.from_rotvec([0, 0, angle]).as_matrix(), np.zeros(3)) for angle in (0.1, 0.5, 0.9)]
    assert second_turn_deg(turned) < 1e-6 < 5 < second_turn_deg(first)


def test_boards_alone_are_placed_with_known_places_of_boards() -> None:
    truth = on_a_body(7)
    push = Rigid3.from_rotation_vector(np.array([0.02, -0.01, 0.03]), np.array([0.3, -0.2, 0.4]))
    start = replace(truth, rig_from_board={name: push @ pose for name, pose in truth.rig_from_board.items()})
    found = adjust_board(start, seen_by(truth, 0.1), SET, only_boards=True)
    assert all(np.array_equal(found.scene.body_from_board[k].matrix, MOUNTS[k].matrix) for k in MOUNTS)
    off = [(found.scene.rig_from_board[name] @ pose.inverse()).angle_deg for name, pose in truth.rig_from_board.items()]
    assert max(off) < 0.1


# --- from the command line ---------------------------------------------------------------------------------------

ALIKE = ("--columns", ONE.columns, "--rows", ONE.rows, "--square-mm", ONE.square_mm)


def test_photographs_of_two_boards_by_cameras_that_look_elsewhere(tmp_path: Path) -> None:
    """Each camera sees a board of its own, and the two move as one."""
    rng = np.random.default_rng(0)
    camera = Camera(width=320, height=240, focal_px=np.full(2, 300.0), principal_point_px=np.array([160.0, 120.0]))
    other_from_one = Rigid3.from_rotation_vector(np.array([0.1, 2.5, 0.0]), np.array([2.0, 1.0, 3.0]))
    middle = np.array([*ONE.size_mm, 0.0]) / 2
    places = [
        pose @ Rigid3(np.eye(3), np.array([0, 0, 22.0]) - middle)
        for pose in (Rigid3.identity(), other_from_one.inverse())
    ]
    boards = (ONE, replace(ONE, first_id=ONE.markers))
    for i in range(7):
        turn = Rotation.from_rotvec(rng.uniform(-0.35, 0.35, 3)).as_matrix()
        moved = Rigid3(turn, rng.normal(0, 0.3, 3))
        for name, board, rig_from_board, cam_from_rig in zip(
            ("left", "right"), boards, places, (Rigid3.identity(), other_from_one), strict=True
        ):
            image = photograph(board, camera, cam_from_rig @ moved @ rig_from_board, 2, seed=i)
            storage.write_image(tmp_path / "images" / name / f"{i}.png", np.repeat(image[..., None], 3, axis=2))
    run("calibrate", tmp_path / "images", "--out", tmp_path / "rig", *ALIKE, "--copies", 2, "--lens", "OPENCV")
    figures = storage.read_json(tmp_path / "rig" / "calibration.json")
    assert [each["ids"] for each in figures["boards"]] == [[0, 14], [15, 29]]
    assert [each["body_from_board"] is None for each in figures["boards"]] == [True, False]
    assert any(note.startswith("left and right never saw a board together") for note in figures["notes"])
    rig = storage.read_handpiece(tmp_path / "rig" / "handpiece.json").rig
    off = rig["right"].cam_from_rig @ rig["left"].cam_from_rig.inverse() @ other_from_one.inverse()
    assert 1e-3 < off.angle_deg < 1.5
    assert 1e-3 < np.linalg.norm(off.translation) < 0.6


def test_boards_are_said_once_and_drawn_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = tmp_path / "boards.yaml", tmp_path / "board.svg"
    file.write_text(
        "boards:\n- {columns: 5, rows: 4, square_mm: 3}\n- {kind: aprilgrid, columns: 2, rows: 2, square_mm: 8}\n"
    )
    run("rig", "target", "--board", file, "--out", out)
    assert sorted(path.name for path in tmp_path.glob("*.svg")) == ["board-1.svg", "board-2.svg"]
    assert "--board describes the board; leave out its other options" in refused(
        capsys, "rig", "target", "--board", file, "--columns", 4, "--out", out
    )
    (tmp_path / "images" / "left").mkdir(parents=True)
    storage.write_image(tmp_path / "images" / "left" / "0.png", np.zeros((32, 32, 3), np.uint8))
    calibrate = ("calibrate", tmp_path / "images", "--out", tmp_path / "rig")
    assert "the files describe 2 boards already" in refused(capsys, *calibrate, "--board", file, "--copies", 2)
    assert "cannot be distinguished from the others" in refused(
        capsys, *calibrate, "--kind", "chessboard", "--copies", 2
    )
    assert "no such file" in refused(capsys, *calibrate, "--board", tmp_path / "none.yaml")
