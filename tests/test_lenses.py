"""Which model of a lens the views of a board call for: closed loops from lenses of each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boards import BOARD, LENSES_OF, SIZE, before_lens, views_of
from cuspid.calibration.bundle import mounted_cameras
from cuspid.calibration.calibrate import calibrate_rig
from cuspid.calibration.lenses import as_model, choose_lens
from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.runtime.errors import ReconstructionError


def error_sigmas(found: Camera, truth: Camera) -> float:
    """Of the parameters, in stated standard deviations (RMS)."""
    assert found.covariance is not None
    off = found.parameters - truth.parameters
    return float(np.sqrt(off @ np.linalg.pinv(found.covariance, hermitian=True) @ off / len(off)))


@pytest.mark.long
@pytest.mark.parametrize("model", LENSES_OF)
def test_the_model_of_a_lens_is_found(model: str) -> None:
    truth = before_lens(model, 1, instants=12)
    views = list(views_of(truth, BOARD, 0.1, np.random.default_rng(1)).values())
    choice, alone = choose_lens(views, BOARD, SIZE)
    assert choice.model == model
    assert 0.07 < choice.held_out_px[model] < 0.14
    assert choice.held_out_px[model] <= 1.05 * min(choice.held_out_px.values())
    assert 0.2 < error_sigmas(mounted_cameras(alone)[""].camera, truth.cameras["cam"]) < 2
    assert f"{model} 0." in choice.summary


def test_a_few_views_tell_no_model() -> None:
    views = list(views_of(before_lens("FULL_OPENCV", 0, instants=5), BOARD, 0.1, np.random.default_rng(0)).values())
    choice, alone = choose_lens(views, BOARD, SIZE)
    assert (choice.model, choice.held_out_px, choice.summary) == ("OPENCV", {}, "OPENCV")
    assert alone.scene.cameras[""].model == "OPENCV"
    asked, alone = choose_lens(views, BOARD, SIZE, "FULL_OPENCV")
    assert asked.model == alone.scene.cameras[""].model == "FULL_OPENCV"


def test_views_of_no_camera_are_refused() -> None:
    rng = np.random.default_rng(0)
    views = list(views_of(before_lens("OPENCV", 0, instants=7), BOARD, 0.1, rng).values())
    scattered = [replace(view, pixels=rng.uniform(0, 480, view.pixels.shape)) for view in views]
    with pytest.raises(ReconstructionError, match="no camera model fits"):
        choose_lens(scattered, BOARD, SIZE)


@pytest.mark.long
def test_cameras_of_a_rig_may_have_different_lenses() -> None:
    """Side by side, each with its own number of parameters."""
    narrow, wide = before_lens("OPENCV", 2), before_lens("THIN_PRISM_FISHEYE", 2)
    truth = replace(
        narrow,
        cameras={"narrow": narrow.cameras["cam"], "wide": wide.cameras["cam"]},
        cam_from_rig={
            "narrow": Rigid3.identity(),
            "wide": Rigid3.from_rotation_vector(np.zeros(3), np.array([3.0, 0, 0])),
        },
        rig_from_board=narrow.rig_from_board,
    )
    views = views_of(truth, BOARD, 0.1, np.random.default_rng(2))
    auto = calibrate_rig(views, dict.fromkeys(truth.cameras, SIZE), BOARD)
    assert auto.lenses["narrow"].model == "OPENCV"
    assert auto.lenses["wide"].model != "OPENCV"
    assert auto.cameras["wide"].rms_px < 0.12
    apart = auto.rig["wide"].centre_in_rig - auto.rig["narrow"].centre_in_rig
    assert apart == pytest.approx([-3, 0, 0], abs=0.05)


@pytest.mark.parametrize("model", ["OPENCV_FISHEYE", "THIN_PRISM_FISHEYE", "FULL_OPENCV"])
def test_another_model_begins_near_a_camera(model: str) -> None:
    camera = replace(Camera.from_field_of_view(640, 480, 70.0), distortion=np.array([-0.2, 0.05, 1e-3, 0.0]))
    pixels = np.random.default_rng(0).uniform([80, 60], [560, 420], (200, 2))
    other = as_model(camera, model, pixels)
    assert other.model == model
    assert np.abs(other.project(camera.rays(pixels)) - pixels).max() < 4
