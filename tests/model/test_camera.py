from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid.model.camera import OPENCV_PIXEL_OFFSET, Camera, project_orthographic
from cuspid.runtime.errors import InputError
from strategies import cameras


@given(cameras(), st.floats(0.05, 0.95), st.floats(0.05, 0.95), st.floats(0.5, 50))
def test_projection_inverts_rays(camera, u, v, depth):
    ray = np.array([[(u - 0.5) * 1.2, (v - 0.5) * 1.2, 1.0]])
    pixel = camera.project(ray * depth)
    np.testing.assert_allclose(camera.rays(pixel), ray, atol=1e-8)


@given(cameras())
def test_agrees_with_opencv(camera):
    points = np.array([[0.3, -0.2, 1.0], [-1.0, 0.8, 2.5], [0, 0, 1.0]])
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.opencv_matrix, camera.distortion)
    np.testing.assert_allclose(camera.project(points), theirs[:, 0] + OPENCV_PIXEL_OFFSET, atol=1e-9)


@given(cameras())
def test_parameters_round_trip(camera):
    again = camera.with_parameters(camera.parameters)
    np.testing.assert_array_equal(again.parameters, camera.parameters)
    np.testing.assert_array_equal(again.matrix, camera.matrix)


def test_field_of_view_spans_the_image():
    camera = Camera.from_field_of_view(500, 400, 62.0)
    edge = camera.rays(np.array([[0.0, 200.0], [500.0, 200.0]]))
    angle = np.rad2deg(np.arccos(edge[0] @ edge[1] / np.linalg.norm(edge[0]) / np.linalg.norm(edge[1])))
    assert angle == pytest.approx(62.0, abs=1e-9)


def test_points_behind_the_camera_have_no_image():
    camera = Camera.from_field_of_view(500, 500, 62.0)
    pixels = camera.project(np.array([[0, 0, -1.0], [0, 0, 0.0], [0, 0, 1.0]]))
    assert np.isnan(pixels[:2]).all()
    assert list(camera.contains(pixels)) == [False, False, True]


def test_pixel_centres_start_at_one_half():
    centres = Camera.from_field_of_view(5, 4, 60.0).pixel_centres()
    assert centres.shape == (4, 5, 2)
    np.testing.assert_array_equal(centres[0, 0], [0.5, 0.5])
    np.testing.assert_array_equal(centres[3, 4], [4.5, 3.5])


def test_undistortion_is_exact_at_the_corner():
    camera = replace(Camera.from_field_of_view(800, 800, 62.0), distortion=np.array([-0.2, 0.05, 0.002, -0.003]))
    rays = np.array([[0.6, 0.6, 1], [-0.6, 0.5, 1], [0.0, 0.0, 1]])
    np.testing.assert_allclose(camera.rays(camera.project(rays)), rays, atol=1e-11)


def test_orthographic_projection_ignores_depth():
    points = np.array([[1.0, 2.0, 3.0], [1.0, 2.0, 30.0]])
    np.testing.assert_array_equal(project_orthographic(points, 10.0), [[10, 20], [10, 20]])


def test_a_resized_camera_sees_the_same_in_smaller_pixels():
    camera = Camera.from_field_of_view(500, 401, 62.0)
    camera = camera.with_parameters(camera.parameters + [0, 3, 2, -1, -0.08, 0.02, 1e-3, 0])
    uncertain = replace(camera, covariance=np.diag([4.0, 4, 1, 1, 1e-4, 1e-4, 0, 0]))
    points = np.array([[0.3, -0.2, 5.0], [-1.0, 1.0, 4.0], [0, 0, 6.0]])
    small = uncertain.resized(250, 200)
    np.testing.assert_allclose(small.project(points), camera.project(points) * [0.5, 200 / 401])
    assert (small.width, small.height) == (250, 200)
    np.testing.assert_allclose(np.diag(small.covariance)[[0, 3, 4]], [1.0, (200 / 401) ** 2, 1e-4])


def test_a_camera_needs_a_positive_focal_length():
    with pytest.raises(InputError, match="focal length"):
        Camera(width=5, height=5, focal_px=np.array([0.0, 1.0]), principal_point_px=np.ones(2))
