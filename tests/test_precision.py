"""The bound against its closed form, against Monte-Carlo, and its laws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid.camera import Camera
from cuspid.errors import InputError
from cuspid.geometry import Rigid3
from cuspid.handpiece.precision import (
    NoiseModel,
    bound_covariance,
    bound_rms_um,
    ellipsoids,
    fisher_information,
    noise_px,
    planar_pair_bound,
    projection_jacobian,
    triangulate,
)
from cuspid.rig import MountedCamera

CAMERA = Camera.from_field_of_view(512, 512, 62.0)


def toed_in(x_mm: float, yaw_deg: float, camera: Camera = CAMERA) -> MountedCamera:
    """A camera at (x, 0, 0) that looks along +Z, turned about +Y."""
    rotation = Rigid3.from_rotation_vector(np.array([0.0, np.deg2rad(yaw_deg), 0.0]), np.zeros(3)).rotation
    return MountedCamera(camera, Rigid3(rotation, -rotation @ np.array([x_mm, 0.0, 0.0])))


def pair(baseline_mm: float, yaw_deg: float = 0.0, camera: Camera = CAMERA) -> tuple[MountedCamera, MountedCamera]:
    return toed_in(-baseline_mm / 2, -yaw_deg, camera), toed_in(baseline_mm / 2, yaw_deg, camera)


@given(
    baseline=st.floats(0.5, 5.0),
    first_deg=st.floats(-20, 20),
    second_deg=st.floats(-20, 20),
    x=st.floats(-2.0, 2.0),
    z=st.floats(3.0, 13.0),
)
def test_the_closed_form_in_the_plane_of_baseline_and_axes(baseline, first_deg, second_deg, x, z):
    cameras = toed_in(-baseline / 2, first_deg), toed_in(baseline / 2, second_deg)
    point = np.array([[x, 0.0, z]])
    numeric = np.trace(bound_covariance(fisher_information(cameras, point, NoiseModel(sigma_px=0.5)))[0])
    depths = tuple(float(mounted.cam_from_rig.apply(point)[0, 2]) for mounted in cameras)
    ranges = tuple(float(np.linalg.norm(point - mounted.centre_in_rig)) for mounted in cameras)
    closed = planar_pair_bound(float(CAMERA.focal_px[0]), 0.5, depths, ranges, baseline, z)
    assert numeric == pytest.approx(closed, rel=1e-9)


def test_the_figures_of_the_parallel_pair_at_5_mm():
    """A longer baseline lowers the bound: against the thesis' claim, as long as the noise is constant."""
    values = [bound_rms_um(fisher_information(pair(b), np.array([[0.0, 0, 5]])))[0] for b in (1.0, 1.5, 2.5, 4.0)]
    np.testing.assert_allclose(values, [41.9, 28.3, 17.6, 11.9], atol=0.06)


def test_with_noise_that_grows_with_the_convergence_a_best_baseline_exists():
    model = NoiseModel(convergence_deg=15.0)
    baselines = np.array([0.3, 0.6, 1.0, 1.5, 2.5, 4.0, 6.0])
    values = [bound_rms_um(fisher_information(pair(b), np.array([[0.0, 0, 5]]), model))[0] for b in baselines]
    assert 0 < np.argmin(values) < len(baselines) - 1


@given(x=st.floats(-1.5, 1.5), y=st.floats(-1.5, 1.5), z=st.floats(3.0, 10.0), yaw=st.floats(-30, 30))
def test_the_jacobian_is_the_derivative_of_the_projection(x, y, z, yaw):
    lens = CAMERA.with_parameters(np.array([420.0, 410.0, 250.0, 260.0, -0.1, 0.02, 1e-3, -2e-3]))
    mounted = toed_in(0.7, yaw, lens)
    point, step = np.array([[x, y, z]]), 1e-5
    jacobian = projection_jacobian(lens, mounted.cam_from_rig, point)[0]
    project = lambda p: lens.project(mounted.cam_from_rig.apply(p))[0]  # noqa: E731
    for axis in range(3):
        move = step * np.eye(3)[axis]
        numeric = (project(point + move) - project(point - move)) / (2 * step)
        np.testing.assert_allclose(jacobian[:, axis], numeric, rtol=1e-4, atol=1e-4)


def test_monte_carlo_meets_the_bound():
    """Triangulated with noise, the points scatter as the bound says, in every direction."""
    rng = np.random.default_rng(1)
    cameras = (*pair(2.5), toed_in(0.0, 0.0, CAMERA))
    truth = np.array([0.4, -0.3, 5.2])
    many = np.broadcast_to(truth, (100_000, 3))
    model = NoiseModel(sigma_px=0.3)
    sigma = noise_px(cameras, many, model, np.ones((3, len(many)), dtype=bool))
    images = np.stack([m.camera.project(m.cam_from_rig.apply(many)) for m in cameras])
    found = triangulate(cameras, images + sigma[..., None] * rng.standard_normal(images.shape), many, sigma)
    bound = bound_covariance(fisher_information(cameras, truth[None], model))[0]
    np.testing.assert_allclose(np.cov(found.T), bound, atol=0.03 * np.trace(bound))
    spread = np.sqrt(np.trace(np.cov(found.T)) / np.trace(bound))
    assert 0.97 < spread < 1.03


def test_more_cameras_never_hurt_and_unseen_ones_do_not_count():
    points = np.random.default_rng(0).uniform([-1, -1, 4], [1, 1, 7], (50, 3))
    two, three = pair(2.0), (*pair(2.0), toed_in(0.0, 0.0))
    with_two, with_three = (
        bound_rms_um(fisher_information(two, points)),
        bound_rms_um(fisher_information(three, points)),
    )
    assert (with_three < with_two).all()
    unseen = np.array([True, True, False])[:, None] & np.ones(len(points), dtype=bool)
    np.testing.assert_allclose(bound_rms_um(fisher_information(three, points, seen=unseen)), with_two)


def test_one_camera_alone_has_no_bound():
    seen = np.array([[True], [False]])
    assert np.isnan(bound_rms_um(fisher_information(pair(2.0), np.array([[0.0, 0, 5]]), seen=seen))).all()


def test_the_ellipsoid_of_a_pair_is_longest_in_depth():
    covariance = bound_covariance(fisher_information(pair(1.5), np.array([[0.0, 0, 5]])))
    deviations, axes = ellipsoids(covariance)
    np.testing.assert_allclose(np.abs(axes[0, :, 2]), [0, 0, 1], atol=1e-9)
    assert deviations[0, 0] <= deviations[0, 1] < deviations[0, 2] / 5
    rebuilt = axes[0] @ np.diag(deviations[0] ** 2) @ axes[0].T
    np.testing.assert_allclose(rebuilt, covariance[0], rtol=1e-9, atol=1e-15)


def test_blur_needs_the_optics():
    with pytest.raises(InputError, match="optics"):
        fisher_information(pair(1.0), np.array([[0.0, 0, 5]]), NoiseModel(blur_px=2.0))
