"""Which model of a lens the views of a board call for: closed loops from lenses of each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boards import BOARD, LENSES_OF, SIZE, before_lens, moving, rolling_views, views_of
from cuspid.calibration.bundle import BoardScene, mounted_cameras
from cuspid.calibration.calibrate import calibrate_rig
from cuspid.calibration.lenses import as_model, choose_lens, with_spline
from cuspid.calibration.uncertainty import lens_difference_px, projection_sigma_px
from cuspid.geometry import Rigid3
from cuspid.geometry.cameras import GRID
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


def bumpy(instants: int) -> BoardScene:
    """A fisheye with a pattern of shifts of about a pixel, which no polynomial has."""
    truth = before_lens("OPENCV_FISHEYE", 1, instants=instants)
    border = np.array([[10.0, 10], [630, 10], [630, 470], [10, 470]])
    camera = with_spline(truth.cameras["cam"], border)
    shifts = np.random.default_rng(1).normal(0, 1 / 300, 2 * GRID**2)
    return replace(truth, cameras={"cam": replace(camera, distortion=np.concatenate([camera.distortion[:5], shifts]))})


@pytest.mark.long
def test_a_lens_that_no_polynomial_follows_is_splined_and_as_uncertain_as_stated() -> None:
    """Over the image, but for a turn of the camera; and halves of the views are as far apart as both state."""
    truth = bumpy(16)
    views = views_of(truth, BOARD, 0.1, np.random.default_rng(1))
    found = calibrate_rig(views, {"cam": SIZE}, BOARD)
    held_out = found.lenses["cam"].held_out_px
    assert found.lenses["cam"].model == "SPLINED_FISHEYE"
    assert 0.1 < held_out["SPLINED_FISHEYE"] < 0.6 * held_out["OPENCV_FISHEYE"]
    off = lens_difference_px(found.rig["cam"].camera, truth.cameras["cam"], found.pixels["cam"])
    in_sigmas = np.linalg.norm(off, axis=2) / projection_sigma_px(found.rig["cam"].camera) / np.sqrt(2)
    assert 0.5 < np.sqrt(np.nanmean(in_sigmas**2)) < 1.4
    assert 0.5 < found.cameras["cam"].parameters_apart < 1.3


@pytest.mark.long
def test_a_rolling_shutter_is_not_taken_for_a_richer_lens() -> None:
    """It shifts rows in a film to the same side from view to view; lenses are judged once that is accounted for."""
    truth = moving(0)
    truth = replace(truth, cameras={"cam0": truth.cameras["cam0"]}, cam_from_rig={"cam0": Rigid3.identity()})
    views = rolling_views(truth, {"cam0": 0.5}, {}, 0.05, np.random.default_rng(0))
    found = calibrate_rig(views, {"cam0": SIZE}, BOARD)
    assert found.lenses["cam0"].model == "OPENCV"
    assert found.cameras["cam0"].readout == pytest.approx(0.5, abs=0.02)
    assert found.cameras["cam0"].held_out_px < 0.06


def test_a_splined_lens_that_is_asked_for_is_its_base_where_nothing_was_seen() -> None:
    truth = before_lens("OPENCV_FISHEYE", 1, instants=8)
    views = list(views_of(truth, BOARD, 0.1, np.random.default_rng(1)).values())
    left = [replace(view, corner=view.corner[own], pixels=view.pixels[own]) for view in views
            if (own := view.pixels[:, 0] < 300).sum() > 12]  # fmt: skip
    asked, alone = choose_lens(left, BOARD, SIZE, "splined")
    camera = alone.scene.cameras[""]
    assert (asked.model, camera.model) == ("SPLINED_FISHEYE", "SPLINED_FISHEYE")
    shifts = np.abs(camera.distortion[5:].reshape(2, GRID, GRID)) * 300
    assert shifts[:, :, -3:].max() < 1e-3 < shifts[:, 3:-3, 2:6].max() < 2


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
