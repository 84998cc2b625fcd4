"""How well a calibrated camera knows where it projects to."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from cuspid.model.camera import Camera

_STEP_PX, _STEP = 1e-3, 1e-6
"""Steps of the differences: of focal lengths and principal point, and of distortion and rotations."""

_ROUNDS, _LEAST_PX = 10, 1e-6
_BACK_PX = 0.01
"""A pixel whose ray is projected farther from it has none."""


def projection_sigma_px(camera: Camera, columns: int = 32) -> Float[np.ndarray, "r c"]:
    """Standard deviation of the projection of points far away, in its worst direction, px: on a grid of square cells
    over the image, by the covariance of the intrinsics (zeros without one). NaN where the lens model has no inverse.

    A turn of the camera is no error of its lens: of what the intrinsics may do, the rotation that explains most of it
    is taken off, where the lens is known well (D. Kogan, mrcal: projection uncertainty, "implied rotation").
    """
    pixels, rows = _grid(camera, columns)
    rays = camera.rays(pixels)
    steps = np.array([*[_STEP_PX] * 4, *[_STEP] * len(camera.distortion)])
    numbers = len(steps)
    by_lens = [
        (camera.with_parameters(camera.parameters + step).project(rays) - camera.project(rays)) / step.sum()
        for step in np.diag(steps)
    ]
    by_turn = [
        (camera.project(Rotation.from_rotvec(_STEP * axis).apply(rays)) - camera.project(rays)) / _STEP
        for axis in np.eye(3)
    ]
    lens, turn = (np.stack(each, axis=-1).reshape(-1, len(each)) for each in (by_lens, by_turn))
    known = np.linalg.norm(camera.project(rays) - pixels, axis=1) < _BACK_PX
    covariance = np.zeros((numbers, numbers)) if camera.covariance is None else camera.covariance
    sigma = np.full(len(known), np.nan)
    sigma[known] = _sigma_without_turn(lens.reshape(-1, 2, numbers)[known], turn.reshape(-1, 2, 3)[known], covariance)
    return sigma.reshape(rows, columns)


def lens_difference_px(
    camera: Camera, other: Camera, seen: Float[np.ndarray, "n 2"], columns: int = 32
) -> Float[np.ndarray, "r c 2"]:
    """How far another lens would move a camera's projections of distant points, px, on a grid of square cells over the
    image; NaN where either has no inverse or shows nothing.

    The other camera is turned so that it agrees best where corners were seen: a turn is no difference between lenses.
    """
    pixels, rows = _grid(camera, columns)
    known, rays = camera.rays(seen), camera.rays(pixels)
    turn = Rotation.identity()
    for _ in range(_ROUNDS):
        turned = turn.apply(known)
        left = seen - other.project(turned)
        steps = [other.project(Rotation.from_rotvec(_STEP * axis).apply(turned)) for axis in np.eye(3)]
        by_turn = np.stack([(each - other.project(turned)) / _STEP for each in steps], axis=-1)
        sound = np.isfinite(by_turn).all(axis=(1, 2)) & np.isfinite(left).all(axis=1)
        step = np.linalg.lstsq(by_turn[sound].reshape(-1, 3), left[sound].ravel(), rcond=None)[0]
        turn = Rotation.from_rotvec(step) * turn
    moved = other.project(turn.apply(rays)) - pixels
    sound = np.linalg.norm(camera.project(rays) - pixels, axis=1) < _BACK_PX
    return np.where(sound[:, None], moved, np.nan).reshape(rows, columns, 2)


def _grid(camera: Camera, columns: int) -> tuple[Float[np.ndarray, "n 2"], int]:
    """The middles of square cells over the image, and how many rows they are in."""
    cell = camera.width / columns
    rows = max(1, round(camera.height / cell))
    across, down = np.meshgrid((np.arange(columns) + 0.5) * cell, (np.arange(rows) + 0.5) * camera.height / rows)
    return np.stack([across, down], axis=-1).reshape(-1, 2), rows


def _sigma_without_turn(
    lens: Float[np.ndarray, "n 2 k"], turn: Float[np.ndarray, "n 2 3"], covariance: Float[np.ndarray, "k k"]
) -> Float[np.ndarray, "n"]:
    """Standard deviations, from derivatives of the projections by the intrinsics and by a turn, each place weighted by
    what is left of it."""
    sigma = np.ones(len(lens))
    for _ in range(_ROUNDS):
        weighted = (turn / np.maximum(sigma, _LEAST_PX)[:, None, None] ** 2).reshape(-1, 3)
        away = np.linalg.pinv(weighted.T @ turn.reshape(-1, 3)) @ weighted.T @ lens.reshape(-1, lens.shape[2])
        left = lens - turn @ away
        spread = np.einsum("nik,kl,njl->nij", left, covariance, left)
        sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(spread)[:, -1], 0))
    return sigma
