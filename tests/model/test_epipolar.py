import numpy as np
from hypothesis import assume, given

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.epipolar import (
    epipolar_lines,
    epipolar_residuals,
    fundamental_matrix,
    projection_matrix,
    skew,
    triangulate,
)
from strategies import rigid3s, vectors

CAMERA = Camera.from_field_of_view(500, 500, 62.0)
OTHER_CAMERA = Camera.from_field_of_view(640, 480, 70.0)
POINTS = np.random.default_rng(1).uniform([-2, -2, 4], [2, 2, 8], (20, 3))


def near(rotation: np.ndarray, translation: np.ndarray) -> Rigid3:
    return Rigid3.from_rotation_vector(0.05 * rotation, translation)


@given(vectors(), vectors())
def test_skew_is_the_cross_product(a, b):
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-12)


@given(rigid3s(), vectors(1.0), vectors(1.0))
def test_corresponding_points_meet_their_epipolar_lines(first_from_world, rotation, translation):
    assume(np.linalg.norm(translation) > 0.05)
    second_from_world = near(rotation, translation) @ first_from_world
    world = first_from_world.inverse().apply(POINTS)
    first, second = CAMERA.project(POINTS), OTHER_CAMERA.project(second_from_world.apply(world))
    fundamental = fundamental_matrix(
        projection_matrix(CAMERA, first_from_world), projection_matrix(OTHER_CAMERA, second_from_world)
    )
    assert np.abs(np.linalg.svd(fundamental)[1][2]) < 1e-10
    np.testing.assert_allclose(epipolar_residuals(fundamental, first, second), 0, atol=1e-6)
    shifted = second + 3.0 * epipolar_lines(fundamental, first)[:, :2]
    np.testing.assert_allclose(epipolar_residuals(fundamental, first, shifted), 3.0, atol=1e-6)


@given(rigid3s(), vectors(1.0), vectors(1.0))
def test_triangulation_returns_the_point(first_from_world, rotation, translation):
    assume(np.linalg.norm(translation) > 0.2)
    second_from_world = near(rotation, translation) @ first_from_world
    world = first_from_world.inverse().apply(POINTS)
    projections = np.stack([projection_matrix(CAMERA, first_from_world), projection_matrix(CAMERA, second_from_world)])
    pixels = np.stack([CAMERA.project(frame.apply(world)) for frame in (first_from_world, second_from_world)])
    np.testing.assert_allclose(triangulate(projections, pixels), world, atol=1e-5)


def test_rectified_pair_has_horizontal_epipolar_lines():
    right_from_left = Rigid3(np.eye(3), np.array([-2.5, 0, 0]))
    fundamental = fundamental_matrix(
        projection_matrix(CAMERA, Rigid3.identity()), projection_matrix(CAMERA, right_from_left)
    )
    lines = epipolar_lines(fundamental, np.array([[100.0, 200.0]]))
    np.testing.assert_allclose(np.abs(lines[0, :2]), [0, 1], atol=1e-12)
    assert epipolar_residuals(fundamental, np.array([[100.0, 200.0]]), np.array([[50.0, 200.0]]))[0] < 1e-9
