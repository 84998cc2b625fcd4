"""Epipolar geometry of a pair of cameras (thesis 3.2-3.3, Eq 3.4-3.6 as corrected).

``x`` is a pixel of the first image, ``x'`` (``other``) of the second, both homogeneous where a matrix acts on them:
l' = F x is the epipolar line in the second image, x'^T F x = 0, and F = [e']_x P' P^+.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera


def skew(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """[v]_x, the matrix of the cross product with ``vector``."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0.0]])


def projection_matrix(camera: Camera, cam_from_world: Rigid3) -> Float[np.ndarray, "3 4"]:
    """P = K [R | t] (Eq 3.2). Lens distortion is not part of it: undistort pixels first."""
    return camera.matrix @ cam_from_world.matrix[:3]


def fundamental_matrix(
    projection: Float[np.ndarray, "3 4"], other_projection: Float[np.ndarray, "3 4"]
) -> Float[np.ndarray, "3 3"]:
    """F = [e']_x P' P^+ (Eq 3.5), of Frobenius norm 1 where the centres differ."""
    centre = np.linalg.svd(projection)[2][-1]
    matrix = skew(other_projection @ centre) @ other_projection @ np.linalg.pinv(projection)
    norm = np.linalg.norm(matrix)
    return matrix / norm if norm > 0 else matrix


def epipolar_lines(
    fundamental: Float[np.ndarray, "3 3"], pixels: Float[np.ndarray, "*n 2"]
) -> Float[np.ndarray, "*n 3"]:
    """Lines (a, b, c) with a x' + b y' + c = 0 and a^2 + b^2 = 1 in the second image (Eq 3.4)."""
    lines = pixels @ fundamental[:, :2].T + fundamental[:, 2]
    return lines / np.linalg.norm(lines[..., :2], axis=-1, keepdims=True)


def epipolar_residuals(
    fundamental: Float[np.ndarray, "3 3"], pixels: Float[np.ndarray, "*n 2"], other: Float[np.ndarray, "*n 2"]
) -> Float[np.ndarray, "*n"]:
    """Signed distance in px of x' from the epipolar line of x; zero where Eq 3.6 holds."""
    lines = epipolar_lines(fundamental, pixels)
    return np.sum(lines[..., :2] * other, axis=-1) + lines[..., 2]


def triangulate(
    projections: Float[np.ndarray, "k 3 4"], pixels: Float[np.ndarray, "k *n 2"]
) -> Float[np.ndarray, "*n 3"]:
    """Linear (DLT) triangulation of undistorted pixels of k views to points in the world, mm."""
    rows = (
        pixels[..., :, None] * projections[:, *(None,) * (pixels.ndim - 2), 2:, :]
        - (projections[:, *(None,) * (pixels.ndim - 2), :2, :])
    )
    system = np.moveaxis(rows, 0, -3).reshape(*pixels.shape[1:-1], -1, 4)
    homogeneous = np.linalg.svd(system)[2][..., -1, :]
    return homogeneous[..., :3] / homogeneous[..., 3:]
