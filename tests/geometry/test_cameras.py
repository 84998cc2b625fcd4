"""Each camera model against COLMAP's own, its derivatives against differences, and its inverse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cuspid.geometry import Rigid3
from cuspid.geometry.cameras import GRID, LENSES, MODELS, fold_radius, projection_derivatives
from cuspid.model.camera import Camera, undistortion_maps
from cuspid.model.rig import MountedCamera, Rig
from cuspid.runtime.errors import InputError
from strategies import LENS_LIMITS, lenses


def in_view(camera: Camera, seed: int, widest_deg: float, count: int = 60) -> np.ndarray:
    """Points up to an angle from the axis, at many distances."""
    rng = np.random.default_rng(seed)
    angle, about = np.deg2rad(widest_deg) * rng.uniform(0, 1, count), rng.uniform(0, 2 * np.pi, count)
    sideways = np.stack([np.cos(about), np.sin(about)], axis=1) * np.sin(angle)[:, None]
    return np.hstack([sideways, np.cos(angle)[:, None]]) * rng.uniform(0.5, 50, (count, 1))


@pytest.mark.parametrize("model", LENSES)
@given(data=st.data())
@settings(max_examples=25)
def test_agrees_with_colmap(model: str, data: st.DataObject) -> None:
    camera = data.draw(lenses(model))
    theirs = pycolmap.Camera(
        model=model, width=camera.width, height=camera.height, params=camera.parameters.tolist(), camera_id=1
    )
    points = in_view(camera, 0, 40)
    np.testing.assert_allclose(camera.project(points), theirs.img_from_cam(points), rtol=0, atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
@given(data=st.data())
@settings(max_examples=25)
def test_rays_invert_the_projection(model: str, data: st.DataObject) -> None:
    camera = data.draw(lenses(model))
    points = in_view(camera, 1, 80 if MODELS[model].is_equidistant else 45)
    pixels = camera.project(points)
    assert np.isfinite(pixels).all(axis=1).mean() > 0.5
    shown = np.isfinite(pixels).all(axis=1)
    np.testing.assert_allclose(camera.project(camera.rays(pixels[shown])), pixels[shown], rtol=0, atol=1e-10)
    inside = shown & (np.linalg.norm(points[:, :2], axis=1) < 0.5 * points[:, 2])
    np.testing.assert_allclose(camera.rays(pixels[inside]), points[inside] / points[inside, 2:], rtol=0, atol=1e-9)


def test_rays_are_found_where_the_image_is_about_to_fold() -> None:
    camera = Camera(
        width=64,
        height=64,
        focal_px=np.array([300.0, 300.0]),
        principal_point_px=np.array([100.0, 100.0]),
        distortion=np.array([0.140625, 0.03125, 0.0, -0.015625]),
        model="OPENCV_FISHEYE",
    )
    angle = np.linspace(0.0, 0.9999 * camera.fold_radius, 200)
    pixels = camera.project(np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1))
    np.testing.assert_allclose(camera.project(camera.rays(pixels)), pixels, rtol=0, atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
@given(data=st.data())
@settings(max_examples=10)
def test_derivatives_are_those_of_differences(model: str, data: st.DataObject) -> None:
    camera = data.draw(lenses(model))
    points = in_view(camera, 2, 40, count=8)
    by_point, by_parameters = camera.projection_derivatives(points)
    assert by_parameters.shape == (8, 2, len(camera.parameters))
    for axis in range(3):
        step = 1e-5 * points[:, 2:] * np.eye(3)[axis]
        difference = (camera.project(points + step) - camera.project(points - step)) / (2 * step[:, axis : axis + 1])
        scale = np.abs(by_point).max()
        np.testing.assert_allclose(by_point[:, :, axis], difference, rtol=0, atol=1e-7 * scale)
    for number in range(len(camera.parameters)):
        step = np.eye(len(camera.parameters))[number] * 1e-5
        ahead, behind = (camera.with_parameters(camera.parameters + sign * step) for sign in (1, -1))
        difference = (ahead.project(points) - behind.project(points)) / 2e-5
        scale = max(np.abs(by_parameters).max(), 1)
        np.testing.assert_allclose(by_parameters[:, :, number], difference, rtol=0, atol=1e-6 * scale)


def test_derivatives_hold_on_the_axis() -> None:
    """Of an equidistant lens they are limits there."""
    for model in ("OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"):
        lens = np.array([0.1, -0.2, 0.01, 0.02, 0.1, 0.05, 0.01, -0.02])[: len(MODELS[model].names)]
        parameters = np.array([300.0, 310, 200, 150, *lens])
        for near in (0.0, 1e-9, 1e-5, 1e-3):
            points = np.array([[near, -near / 2, 2.0]])
            by_point, _ = projection_derivatives(MODELS[model].code, parameters, points)
            assert np.isfinite(by_point).all()
            np.testing.assert_allclose(by_point[0, :, :2], np.diag([150.0, 155.0]), atol=0.5)


def test_a_fisheye_sees_beyond_a_right_angle() -> None:
    camera = replace(
        Camera.from_field_of_view(400, 400, 60.0), model="OPENCV_FISHEYE", focal_px=np.array([100.0, 100.0])
    )
    behind = np.array([[1.0, 0.0, -0.3], [0.0, 0.0, -1.0]])
    pixels = camera.project(behind)
    assert pixels[0] == pytest.approx([200 + 100 * np.arctan2(1, -0.3), 200])
    np.testing.assert_allclose(camera.directions(pixels[:1]), behind[:1] / np.linalg.norm(behind[0]), atol=1e-12)
    assert np.isnan(camera.rays(pixels[:1])).all()
    assert np.isnan(camera.directions(np.array([[200.0 + 100 * 3.2, 200.0]]))).all()


@pytest.mark.parametrize(
    ("model", "lens", "radius"),
    [
        ("OPENCV", [0.0, 0, 0, 0], np.inf),
        ("OPENCV", [-1 / 3, 0, 0.01, 0], 1.0),
        ("OPENCV", [0.1, 0.2, 0, 0], np.inf),
        ("FULL_OPENCV", [0, 0, 0, 0, -1 / 7, 0, 0, 0], 1.0),
        ("FULL_OPENCV", [0, 0, 0, 0, 0, 1.0, 0, 0], 1.0),  # r / (1 + r^2)
        ("OPENCV_FISHEYE", [0.0, 0, 0, 0], np.pi),
        ("OPENCV_FISHEYE", [-1 / 3, 0, 0, 0], 1.0),
        ("THIN_PRISM_FISHEYE", [0, 0, 0, 0, 0, -1 / 9, 0, 0], 1.0),
    ],
)
def test_where_a_model_folds_back(model: str, lens: list[float], radius: float) -> None:
    assert fold_radius(MODELS[model], np.array(lens)) == pytest.approx(radius)


@pytest.mark.parametrize("model", MODELS)
def test_what_is_folded_back_is_not_shown(model: str) -> None:
    """Far from the axis it would be seen in the middle of the image."""
    names = np.array(MODELS[model].names)
    lens = np.where(names == "k1", -0.4, 0.0) + (names == "reach")
    camera = replace(Camera.from_field_of_view(400, 400, 60.0), model=model, distortion=lens)
    angles = np.linspace(0, 1.5, 400)
    pixels = camera.project(np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1))
    shown = np.isfinite(pixels[:, 0])
    assert 100 < shown.sum() < 399
    assert (np.diff(pixels[shown, 0]) > 0).all()
    assert not shown[np.argmin(shown) :].any()
    beyond = np.array([[pixels[shown, 0].max() + 5, 200.0]])
    assert np.isnan(camera.directions(beyond)).all()


def test_a_lens_is_of_a_known_model_with_its_parameters() -> None:
    camera = Camera.from_field_of_view(40, 30, 60.0)
    with pytest.raises(InputError, match="FULL_OPENCV"):
        replace(camera, model="BROWN")
    with pytest.raises(InputError, match="k1, k2, p1, p2, k3"):
        replace(camera, model="FULL_OPENCV", distortion=np.zeros(5))
    with pytest.raises(InputError, match="k4, reach and 11 x 11 control points of x, then of y, not 5 numbers"):
        replace(camera, model="SPLINED_FISHEYE", distortion=np.zeros(5))
    with pytest.raises(InputError, match="reach of its grid must be positive, not 0"):
        replace(camera, model="SPLINED_FISHEYE", distortion=np.zeros(len(MODELS["SPLINED_FISHEYE"].names)))


@given(camera=lenses("SPLINED_FISHEYE"), at=st.tuples(st.integers(0, GRID - 1), st.integers(0, GRID - 1)))
@settings(max_examples=25)
def test_a_splined_lens_is_its_base_but_where_a_control_point_shifts_it(camera: Camera, at: tuple[int, int]) -> None:
    """By as much as a cubic B-spline does, within two control points of it."""
    base = replace(camera, model="OPENCV_FISHEYE", distortion=camera.distortion[:4])
    straight = np.concatenate([camera.distortion[:5], np.zeros(2 * GRID**2)])
    points = in_view(camera, 3, 80)
    assert np.array_equal(replace(camera, distortion=straight).project(points), base.project(points), equal_nan=True)
    bump, (row, column) = straight.copy(), at
    bump[5 + GRID**2 + row * GRID + column] = 0.01
    step = 2 * camera.distortion[4] / (GRID - 3)
    middle = (np.array([column, row]) - (GRID - 1) / 2) * step
    places = middle + step * np.array([[0.0, 0.0], [1, 0], [1, -1], [2.01, 0], [0, -2.01]])
    angles = np.linalg.norm(places, axis=1, keepdims=True)
    rays = np.hstack([places * np.sinc(angles / np.pi), np.cos(angles)])
    shift = replace(camera, distortion=bump).project(rays) - base.project(rays)
    expected = 0.01 * camera.focal_px[1] * np.array([4 / 9, 1 / 9, 1 / 36, 0, 0])
    shown = np.isfinite(shift[:, 0])
    np.testing.assert_allclose(shift[shown, 1], expected[shown], atol=1e-9)
    np.testing.assert_allclose(shift[shown, 0], 0, atol=1e-9)


def test_wide_lenses_are_straightened_into_a_given_pinhole() -> None:
    wide = replace(Camera.from_field_of_view(400, 300, 60.0), model="OPENCV_FISHEYE", focal_px=np.array([150.0, 150.0]))
    ideal = Camera.from_field_of_view(200, 150, 90.0)
    maps = undistortion_maps(wide, ideal)
    assert maps is not None
    point = np.array([[0.4, -0.3, 1.0]])
    column, row = (ideal.project(point)[0] - 0.5).astype(int)
    expected = wide.project(ideal.rays(np.array([[column + 0.5, row + 0.5]])))[0] - 0.5
    np.testing.assert_allclose([maps[0][row, column], maps[1][row, column]], expected, atol=1e-4)
    assert undistortion_maps(ideal, ideal) is None


def test_the_limits_of_the_lenses_cover_every_parameter() -> None:
    assert {name for model in LENSES for name in MODELS[model].names} == set(LENS_LIMITS)


def test_a_lens_that_folds_within_its_image_is_used_where_it_shows_something() -> None:
    """As that of a laparoscope whose calibration has a third radial term of -4 (real ones have -15)."""
    lens = np.array([-0.7, 2.9, 0, 0, -4.0, 0, 0, 0])
    camera = replace(Camera.from_field_of_view(360, 288, 80.0), model="FULL_OPENCV", distortion=lens)
    assert camera.valid_mask is not None
    assert 0.3 < camera.valid_mask.mean() < 0.95
    assert camera.valid_mask[144, 180]
    assert not camera.valid_mask[0, 0]
    assert Camera.from_field_of_view(360, 288, 80.0).valid_mask is None
    border = np.array([[0.0, 0.0], [360.0, 0.0], [360.0, 288.0]])
    rays = camera.rim_rays(border)
    assert np.isfinite(rays).all()
    assert np.linalg.norm(rays[:, :2], axis=1).max() < camera.fold_radius
    rig = Rig(
        {
            name: MountedCamera(camera, Rigid3(np.eye(3), np.array([x, 0.0, 0.0])))
            for name, x in (("left", 0.0), ("right", -1.0))
        }
    )
    assert rig.overlap("left", "right", 20.0) > 0.8
