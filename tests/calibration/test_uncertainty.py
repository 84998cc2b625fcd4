"""How well a lens is known, over its image."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cuspid.calibration.uncertainty import projection_sigma_px
from cuspid.model.camera import Camera

CAMERA = replace(Camera.from_field_of_view(320, 240, 50.0), distortion=np.array([-0.1, 0.02, 1e-3, -1e-3]))
SIGMA = np.array([0.8, 0.8, 0.6, 0.6, 4e-3, 4e-3, 5e-4, 5e-4])


def known(sigma: np.ndarray) -> Camera:
    return replace(CAMERA, covariance=np.diag(sigma**2))


def test_an_exact_lens_projects_exactly():
    assert projection_sigma_px(CAMERA).shape == (24, 32)
    assert not projection_sigma_px(CAMERA).any()
    assert not projection_sigma_px(known(np.zeros(8))).any()


@pytest.mark.parametrize("factor", [0.1, 7.0])
def test_twice_the_errors_are_twice_the_uncertainty(factor):
    one, other = (projection_sigma_px(known(scale * SIGMA), 16) for scale in (1.0, factor))
    assert np.allclose(other, factor * one, rtol=1e-3)


def test_a_shifted_principal_point_is_nearly_a_turn():
    shifted = projection_sigma_px(known(np.array([0, 0, 1.0, 1.0, 0, 0, 0, 0])))
    assert np.median(shifted) < 0.1
    assert shifted.max() > np.median(shifted)


def test_a_focal_length_matters_at_the_rim():
    """Both by the same factor: a shift along the radius, which no turn undoes."""
    covariance = np.zeros((8, 8))
    covariance[:2, :2] = 1.0
    camera = replace(CAMERA, distortion=np.zeros(4), covariance=covariance)
    sigma = projection_sigma_px(camera, 32)
    cell = camera.width / 32
    x, y = np.meshgrid((np.arange(32) + 0.5) * cell - 160, (np.arange(24) + 0.5) * cell - 120)
    assert np.allclose(sigma, np.hypot(x, y) / camera.focal_px[0], rtol=0.02, atol=1e-3)


def test_it_is_the_scatter_of_cameras_that_are_drawn():
    """Each turned so that it fits the true one best, by the same weights."""
    camera, rng = known(SIGMA), np.random.default_rng(0)
    sigma = projection_sigma_px(camera, 16)
    cell = camera.width / 16
    at = np.stack(np.meshgrid((np.arange(16) + 0.5) * cell, (np.arange(12) + 0.5) * cell), axis=-1).reshape(-1, 2)
    rays, weights = camera.rays(at), 1 / sigma.ravel()
    squares = []
    for _ in range(300):
        drawn = camera.with_parameters(camera.parameters + rng.normal(0, SIGMA))
        seen = drawn.rays(at)
        turn, _ = Rotation.align_vectors(
            seen / np.linalg.norm(seen, axis=1, keepdims=True),
            rays / np.linalg.norm(rays, axis=1, keepdims=True),
            weights=weights**2,
        )
        squares.append((drawn.project(turn.apply(rays)) - at) ** 2)
    scatter = np.sqrt(np.mean(squares, axis=0).max(axis=1))
    assert 0.75 < np.median(scatter / sigma.ravel()) < 1.1  # along the axes, not in the worst direction


def test_a_lens_without_an_inverse_has_none():
    folded = replace(CAMERA, distortion=np.array([-0.9, 0.0, 0.0, 0.0]), covariance=np.diag(SIGMA**2))
    sigma = projection_sigma_px(folded)
    assert np.isnan(sigma).any()
    assert np.isfinite(sigma[8:16, 12:20]).all()
    nowhere = replace(folded, principal_point_px=np.array([-2e4, -2e4]))
    assert np.isnan(projection_sigma_px(nowhere)).all()
