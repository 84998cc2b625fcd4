"""What the standard deviations of a calibration are worth where corners do not err independently of each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boards import BOARD, SIZE, before_lens, scene, views_of
from cuspid.calibration.board_shape import BoardShape, nodes_of
from cuspid.calibration.bundle import adjust_board, mounted_cameras
from cuspid.calibration.calibrate import CalibrationOptions, calibrate_rig
from cuspid.calibration.corners import BoardView
from cuspid.calibration.scatter import covariance_of
from cuspid.calibration.uncertainty import lens_difference_px
from cuspid.model.board import Board

OPENCV = CalibrationOptions(lens="OPENCV")


def test_corners_that_err_together_widen_the_covariance() -> None:
    """Errors that are smooth over each view: the scatter of the corners states too little, that of the views does
    not."""
    by_corners, stated = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        truth = before_lens("OPENCV", seed)
        views = {}
        for (_, instant), view in views_of(truth, BOARD, 0.05, rng).items():
            wave = np.cos(BOARD.corners[view.corner, :2] @ rng.normal(0, 0.25, 2) + rng.uniform(0, 6.28))
            views["cam", instant] = BoardView(view.corner, view.pixels + np.outer(wave, rng.normal(0, 0.25, 2)))
        found = adjust_board(truth, views, BOARD)
        camera = mounted_cameras(found)["cam"].camera
        off = camera.parameters - truth.cameras["cam"].parameters
        count = len(off)
        by_corners.append(in_sigmas(off, found.covariance[:count, :count]))
        stated.append(in_sigmas(off, np.asarray(camera.covariance)))
    assert rms(by_corners) > 1.5
    assert 0.6 < rms(stated) < 1.3


@pytest.mark.parametrize("instants", [3, 200])
def test_few_instants_leave_a_multiple_and_many_their_scatter(instants: int) -> None:
    rng = np.random.default_rng(0)
    by_corners = np.diag([1.0, 4.0, 1e-6])
    true = by_corners * np.array([4.0, 9.0, 4.0])
    moved = rng.multivariate_normal(np.zeros(3), true / instants, instants)
    found = covariance_of(by_corners, moved)
    ratio = np.sqrt(np.diag(found) / np.diag(by_corners))
    if instants == 3:
        assert np.linalg.matrix_rank(found / np.sqrt(np.outer(np.diag(found), np.diag(found)))) == 3
    else:
        assert np.allclose(ratio, [2, 3, 2], rtol=0.15)
    assert np.allclose(covariance_of(by_corners, np.zeros((0, 3))), by_corners)


def test_an_uneven_board_is_found_uneven() -> None:
    rng = np.random.default_rng(0)
    truth, off = scene(8, cameras=1, instants=12), rng.normal(0, [0.01, 0.01, 0.03], BOARD.corners.shape)
    views = {}
    for (camera, instant), view in views_of(truth, BOARD, 0.05, rng).items():
        pose = truth.cam_from_rig[camera] @ truth.rig_from_board[instant]
        places = BOARD.corners[view.corner]
        moved = [truth.cameras[camera].project(pose.apply(each)) for each in (places, places + off[view.corner])]
        views[camera, instant] = BoardView(view.corner, view.pixels + moved[1] - moved[0])
    found = calibrate_rig(views, dict.fromkeys(truth.cameras, SIZE), BOARD, OPENCV)
    assert found.uneven_mm is not None
    assert found.uneven_mm[0] == pytest.approx(0.01, rel=0.4)
    assert found.uneven_mm[1] == pytest.approx(0.03, rel=0.4)
    assert 0.04 < found.sigma_px < 0.06


def test_an_even_board_stays_even() -> None:
    truth = before_lens("OPENCV", 3)
    views = views_of(truth, BOARD, 0.1, np.random.default_rng(3))
    assert calibrate_rig(views, {"cam": SIZE}, BOARD, OPENCV).uneven_mm is None


def test_cameras_that_see_the_board_elsewhere_are_loose() -> None:
    rng = np.random.default_rng(0)
    truth = scene(9, cameras=2, instants=8)
    views = {
        key: BoardView(view.corner, view.pixels + rng.normal(0, 0.5, 2))
        for key, view in views_of(truth, BOARD, 0.05, rng).items()
    }
    rigid = adjust_board(truth, views, BOARD)
    found = adjust_board(replace(rigid.scene, loose_px=rigid.sigma_px), views, BOARD)
    assert 0.1 < found.scene.loose_px < 0.8
    assert found.sigma_px < 0.06 < rigid.sigma_px
    cameras = mounted_cameras(found)
    errors = [
        in_sigmas(cameras[name].camera.parameters - each.parameters, np.asarray(cameras[name].camera.covariance))
        for name, each in truth.cameras.items()
    ]
    assert 0.3 < rms(errors) < 1.4


def test_nodes_carry_their_corners() -> None:
    """A plane through the nodes of a coarser grid is one through the corners."""
    board = Board(kind="chessboard", columns=31, rows=21, square_mm=2.0)
    nodes, shares = nodes_of(board)
    assert np.allclose(shares.sum(axis=1), 1)
    shape = BoardShape.even(board)
    across = np.linspace(2, 60, 14)
    down = np.linspace(2, 40, 14)
    plane = np.stack([*np.meshgrid(across, down), np.zeros((14, 14))], axis=-1).reshape(-1, 3)
    shape = shape.with_step(plane.ravel())
    assert np.allclose(shape.interpolate(nodes, shares), board.corners * [1, 1, 0])


def test_the_difference_of_lenses_leaves_out_a_turn() -> None:
    camera = before_lens("OPENCV", 0).cameras["cam"]
    seen = np.random.default_rng(0).uniform([80, 60], [560, 420], (100, 2))
    nearly = replace(camera, principal_point_px=camera.principal_point_px + [3.0, -2.0])
    moved = np.linalg.norm(lens_difference_px(camera, nearly, seen), axis=2)
    assert 0 < np.nanmedian(moved) < 0.3
    longer = replace(camera, focal_px=1.01 * camera.focal_px)
    assert 1 < np.nanmedian(np.linalg.norm(lens_difference_px(camera, longer, seen), axis=2)) < 3


def in_sigmas(difference: np.ndarray, covariance: np.ndarray) -> float:
    return float(np.sqrt(difference @ np.linalg.pinv(covariance, hermitian=True) @ difference / len(difference)))


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
