"""Sections 3.1 to 3.4, computed: projections, epipolar geometry, likelihood and bound of a pair.

*Residual*: largest difference between a formula and another way to the same number.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import product
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.handpiece.precision import (
    NoiseModel,
    bound_rms_um,
    fisher_information,
    planar_pair_bound,
    projection_jacobian,
)
from cuspid.model.camera import Camera, project_orthographic
from cuspid.model.epipolar import epipolar_lines, epipolar_residuals, fundamental_matrix, projection_matrix, skew
from cuspid.model.rig import MountedCamera
from cuspid.studies.camera_pair import CameraPairOptions, camera_pair
from cuspid_thesis.results import Figures

_ENDS: Mapping[str, Callable[[tuple[float, ...]], float]] = MappingProxyType({"least": min, "largest": max})
BASELINES_MM = (1.0, 1.5, 2.5, 4.0)
"""Between 1 and 4 mm, the range of its section 3.4."""


def _largest(values: np.ndarray) -> float:
    return float(np.abs(values).max())


def _camera(px: int = 512) -> Camera:
    return Camera.from_field_of_view(px, px, 62.0)


def _random_pose(rng: np.random.Generator, turn: float = 0.2) -> Rigid3:
    return Rigid3.from_rotation_vector(turn * rng.standard_normal(3), 0.5 * rng.standard_normal(3))


def _points(rng: np.random.Generator, count: int = 200) -> Float[np.ndarray, "n 3"]:
    """Before the cameras, mm."""
    return rng.uniform([-1.5, -1.5, 4.0], [1.5, 1.5, 8.0], (count, 3))


def projections() -> Figures:
    """Eq 3.1 and Fig 3.3: x = f X / Z; how large two equal lengths at 5 and 10 mm look, in both projections."""
    camera, points = _camera(), _points(np.random.default_rng(0))
    by_hand = camera.focal_px * points[:, :2] / points[:, 2:] + camera.principal_point_px
    ends = np.array([[[0, 0, z], [1.0, 0, z]] for z in (5.0, 10.0)])
    perspective = np.diff(camera.project(ends.reshape(-1, 3)).reshape(2, 2, 2), axis=1)[:, 0, 0]
    flat = np.diff(project_orthographic(ends), axis=1)[:, 0, 0]
    return {
        "residual_px": _largest(camera.project(points) - by_hand),
        "perspective_ratio": float(perspective[0] / perspective[1]),
        "orthographic_ratio": float(flat[0] / flat[1]),
    }


def projection_matrices() -> Figures:
    """Eq 3.2 and 3.7: P = K [R | t] times the homogeneous point against the camera; the free parameters of P."""
    rng = np.random.default_rng(1)
    camera, pose, points = _camera(), _random_pose(rng), _points(rng)
    projected = np.column_stack([points, np.ones(len(points))]) @ projection_matrix(camera, pose).T
    places = projected[:, :2] / projected[:, 2:]
    return {
        "residual_px": _largest(places - camera.project(pose.apply(points))),
        "parameters": float(np.linalg.matrix_rank(_matrix_jacobian(), tol=1e-5)),
    }


def _matrix_jacobian() -> Float[np.ndarray, "12 12"]:
    """How P, brought to norm 1, changes with focal lengths, skew, principal point, rotation and translation, and with
    one scale too many."""
    start = np.array([2.0, 2.1, 0.5, 1.2, 1.3, 0.4, -0.5, 0.6, 1.5, -1.4, 2.0, 1.0])
    relative = 1e-5
    changes = [_unit_matrix(start + step) - _unit_matrix(start - step) for step in np.diag(relative * np.abs(start))]
    return np.stack(changes, axis=1) / (2 * relative)


def _unit_matrix(parameters: Float[np.ndarray, "12"]) -> Float[np.ndarray, "12"]:
    fx, fy, skewed, cx, cy = parameters[:5]
    pose = Rigid3.from_rotation_vector(parameters[5:8], parameters[8:11])
    matrix = parameters[11] * np.array([[fx, skewed, cx], [0, fy, cy], [0, 0, 1.0]]) @ pose.matrix[:3]
    return np.asarray(matrix.ravel() / np.linalg.norm(matrix))


def epipolar() -> Figures:
    """Eq 3.3 to 3.6 with the skew matrices that the print leaves out, for twenty random pairs of cameras.

    ``plane_residual``: F by a homography over a plane against F by the projections, both of norm 1.
    """
    rng = np.random.default_rng(2)
    worst = {"line_residual_px": 0.0, "constraint_residual_px": 0.0, "plane_residual": 0.0}
    for _ in range(20):
        camera, (first, second), points = _camera(), (_random_pose(rng), _random_pose(rng)), _points(rng)
        projections = [projection_matrix(camera, pose) for pose in (first, second)]
        x, other = (camera.project(pose.apply(points)) for pose in (first, second))
        matrix = fundamental_matrix(*projections)
        lines = epipolar_lines(matrix, x)
        found = {
            "line_residual_px": _largest(np.sum(lines[:, :2] * other, axis=1) + lines[:, 2]),
            "constraint_residual_px": _largest(epipolar_residuals(matrix, x, other)),
            "plane_residual": _plane_residual(camera, first, second, matrix),
        }
        worst = {name: max(value, found[name]) for name, value in worst.items()}
    return dict(worst)


def _plane_residual(camera: Camera, first: Rigid3, second: Rigid3, matrix: Float[np.ndarray, "3 3"]) -> float:
    """F = [e']_x H with H induced by the plane Z = 6 mm of the first camera, up to scale and sign."""
    second_from_first = second @ first.inverse()
    translation = second_from_first.matrix[:3, 3]
    plane = second_from_first.rotation + np.outer(translation, [0, 0, 1 / 6.0])
    by_plane = skew(camera.matrix @ translation) @ camera.matrix @ plane @ np.linalg.inv(camera.matrix)
    by_plane /= np.linalg.norm(by_plane)
    return min(_largest(by_plane - matrix), _largest(by_plane + matrix))


def pair_parameters() -> Figures:
    """Fig 3.6: baseline and angle of the axes of a pair that was made with them."""
    residual = 0.0
    for baseline, angle in product((1.0, 2.5, 4.0), (0.0, 9.0, 40.0)):
        left, right = camera_pair(baseline, angle, _camera()).cameras.values()
        found = np.rad2deg(np.arctan2(np.linalg.norm(np.cross(*(_axes(left, right)))), np.dot(*_axes(left, right))))
        apart = np.linalg.norm(left.centre_in_rig - right.centre_in_rig)
        residual = max(residual, abs(float(found) - angle), abs(float(apart) - baseline))
    return {"residual_mm_deg": residual}


def _axes(left: MountedCamera, right: MountedCamera) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    return left.axis_in_rig, right.axis_in_rig


def likelihood() -> Figures:
    """Eq 3.8: the scatter of the likelihood's slope over noisy images against the Fisher matrix, relative."""
    rng = np.random.default_rng(3)
    cameras = tuple(camera_pair(2.5, 5.0, _camera()).cameras.values())
    point, sigma = np.array([[0.3, -0.2, 5.0]]), 0.5
    information = fisher_information(cameras, point, NoiseModel(sigma_px=sigma))[0]
    slopes = np.zeros((200_000, 3))
    for mounted in cameras:
        jacobian = projection_jacobian(mounted.camera, mounted.cam_from_rig, point)[0]
        slopes += sigma * rng.standard_normal((len(slopes), 2)) @ jacobian / sigma**2
    scatter = slopes.T @ slopes / len(slopes)
    return {"relative_difference": float(np.linalg.norm(scatter - information) / np.linalg.norm(information))}


def closed_form() -> Figures:
    """Eq 3.9 with the exponents 4 against the numeric Fisher matrix, and with the exponents 1 as printed.

    ``printed_ratio_*``: root of the printed over the true value at 5 mm, parallel, for the smallest and the largest
    baseline.
    """
    rng, worst = np.random.default_rng(4), 0.0
    for _ in range(200):
        baseline, angle = float(rng.uniform(0.5, 4)), float(rng.uniform(0, 40))
        point = np.array([[rng.uniform(-1, 1), 0.0, rng.uniform(3, 13)]])
        cameras = tuple(camera_pair(baseline, angle, _camera()).cameras.values())
        numeric = float(np.trace(np.linalg.inv(fisher_information(cameras, point, NoiseModel(sigma_px=0.5))[0])))
        worst = max(worst, abs(_closed_form_mm2(cameras, point, baseline) / numeric - 1))
    ratios = {f"printed_ratio_{b:g}_mm": _printed_ratio(b, 5.0) for b in (BASELINES_MM[0], BASELINES_MM[-1])}
    return {"relative_residual": worst, **ratios}


def _closed_form_mm2(cameras: tuple[MountedCamera, ...], point: Float[np.ndarray, "1 3"], baseline_mm: float) -> float:
    (z0, z1) = (float(each.cam_from_rig.apply(point)[0, 2]) for each in cameras)
    (d0, d1) = (float(np.linalg.norm(point[0] - each.centre_in_rig)) for each in cameras)
    focal = float(cameras[0].camera.focal_px[0])
    return planar_pair_bound(focal, 0.5, (z0, z1), (d0, d1), baseline_mm, float(point[0, 2]))


def _printed_ratio(baseline_mm: float, depth_mm: float) -> float:
    """Root of tr I^-1 with the printed exponents over the true one, straight ahead of a parallel pair."""
    z, d2 = depth_mm, depth_mm**2 + baseline_mm**2 / 4
    across = z**2 / 2
    printed = across + 2 * d2 * z / (baseline_mm**2 * z**2)
    return float(np.sqrt(printed / (across + 2 * d2 * z**4 / (baseline_mm**2 * z**2))))


def baseline_bound() -> Figures:
    """The bound of a parallel pair at 5 mm for the baselines of section 3.4, 512 px, 62 degrees, noise 0.5 px."""
    point = np.array([[0.0, 0.0, 5.0]])
    bounds = {
        baseline: float(
            bound_rms_um(
                fisher_information(
                    tuple(camera_pair(baseline, 0.0, _camera()).cameras.values()), point, NoiseModel(sigma_px=0.5)
                )
            )[0]
        )
        for baseline in BASELINES_MM
    }
    return {f"rms_{baseline:g}_mm_um": value for baseline, value in bounds.items()}


def pair_grid() -> Figures:
    """Fig 3.9: what the study of pairs spans."""
    options = CameraPairOptions()
    axes = {
        "baseline_mm": options.baselines_mm,
        "angle_deg": options.axis_angles_deg,
        "distance_mm": options.distances_mm,
    }
    return {f"{end}_{name}": pick(values) for name, values in axes.items() for end, pick in _ENDS.items()}
