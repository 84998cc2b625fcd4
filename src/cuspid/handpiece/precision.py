"""How precisely a point can be triangulated: the Cramer-Rao bound of any number of cameras (thesis 3.4, Eq 3.7-3.9).

Camera i sees the point X at x_i = pi(K_i (R_i X + t_i)) + noise, normal with standard deviation sigma_i px in both
directions. The Fisher matrix is I = sum_i J_i^T J_i / sigma_i^2 with J_i = d x_i / d X, and no unbiased estimate of X
has a covariance smaller than I^-1. The thesis' Eq 3.9 lost its exponents; the closed form that is right for two ideal
cameras and X in the plane of the baseline and the axes is :func:`planar_pair_bound`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from cuspid.camera import Camera
from cuspid.errors import InputError
from cuspid.geometry import Rigid3
from cuspid.handpiece.optics import Optics
from cuspid.rig import MountedCamera


@dataclass(frozen=True, kw_only=True)
class NoiseModel:
    """Standard deviation of a matched image point, as its circumstances make it worse."""

    sigma_px: float = 0.5
    """On matching a sharp point seen from nearly the same direction by all cameras."""
    convergence_deg: float | None = None
    """Angle between rays at which foreshortening has doubled the variance: sigma^2 (1 + (gamma / this)^4), gamma the
    largest angle from a camera's ray to that of another; None: no influence."""
    blur_px: float | None = None
    """Diameter of the blur disc that doubles the variance: sigma^2 (1 + (c / this)^2); None: no influence."""

    def __post_init__(self) -> None:
        if not self.sigma_px > 0 or any(v is not None and not v > 0 for v in (self.convergence_deg, self.blur_px)):
            raise InputError("noise model: sigma, convergence and blur must be larger than 0")


def projection_jacobian(
    camera: Camera, cam_from_world: Rigid3, points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 2 3"]:
    """Derivative of the image points (px) by the points in the world (mm); NaN behind the camera."""
    in_cam = cam_from_world.apply(points)
    depth = np.where(in_cam[:, 2] > 0, in_cam[:, 2], np.nan)
    x, y = in_cam[:, 0] / depth, in_cam[:, 1] / depth
    ideal = np.zeros((len(points), 2, 3))
    ideal[:, 0, 0] = ideal[:, 1, 1] = 1 / depth
    ideal[:, 0, 2], ideal[:, 1, 2] = -x / depth, -y / depth
    lens = camera.focal_px[:, None] * _distortion_jacobian(x, y, camera.distortion)
    return np.einsum("nij,njk,kl->nil", lens, ideal, cam_from_world.rotation)


def _distortion_jacobian(
    x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"], distortion: Float[np.ndarray, "4"]
) -> Float[np.ndarray, "n 2 2"]:
    """Derivative of the distorted by the ideal normalised coordinates."""
    k1, k2, p1, p2 = distortion
    r2 = x * x + y * y
    radial, slope = 1 + k1 * r2 + k2 * r2 * r2, 2 * (k1 + 2 * k2 * r2)
    xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    yy = radial + slope * y * y + 2 * p2 * x + 6 * p1 * y
    xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
    return np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-2)


def noise_px(
    cameras: Sequence[MountedCamera],
    points: Float[np.ndarray, "n 3"],
    model: NoiseModel,
    seen: Bool[np.ndarray, "c n"],
    optics: Optics | None = None,
) -> Float[np.ndarray, "c n"]:
    """Standard deviation of each camera's image of each point (rig frame, mm), in px.

    Raises InputError where the model counts blur but no optics are given.
    """
    variance = np.full((len(cameras), len(points)), model.sigma_px**2)
    growth = np.ones_like(variance)
    if model.convergence_deg is not None:
        growth += (np.rad2deg(_convergence(cameras, points, seen)) / model.convergence_deg) ** 4
    if model.blur_px is not None:
        if optics is None:
            raise InputError("noise model: blur counts, so the optics that blur must be given")
        depths = np.stack([mounted.cam_from_rig.apply(points)[:, 2] for mounted in cameras])
        growth += (optics.blur_px(np.where(depths > 0, depths, np.nan)) / model.blur_px) ** 2
    return np.sqrt(variance * growth)


def _convergence(
    cameras: Sequence[MountedCamera], points: Float[np.ndarray, "n 3"], seen: Bool[np.ndarray, "c n"]
) -> Float[np.ndarray, "c n"]:
    """Largest angle in radians between each camera's ray and that of another which sees the point."""
    rays = np.stack([points - mounted.centre_in_rig for mounted in cameras])
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    cosines = np.clip(np.einsum("ank,bnk->abn", rays, rays), -1.0, 1.0)
    return np.where(seen[None] & seen[:, None], np.arccos(cosines), 0.0).max(axis=1)


def fisher_information(
    cameras: Sequence[MountedCamera],
    points: Float[np.ndarray, "n 3"],
    model: NoiseModel = NoiseModel(),
    *,
    seen: Bool[np.ndarray, "c n"] | None = None,
    optics: Optics | None = None,
) -> Float[np.ndarray, "n 3 3"]:
    """The Fisher matrix (1/mm^2) of each point (rig frame, mm), summed over the cameras that see it (default: all)."""
    seen = np.ones((len(cameras), len(points)), dtype=bool) if seen is None else seen
    sigma = noise_px(cameras, points, model, seen, optics)
    total = np.zeros((len(points), 3, 3))
    for mounted, sees, deviation in zip(cameras, seen, sigma, strict=True):
        weighted = projection_jacobian(mounted.camera, mounted.cam_from_rig, points) / deviation[:, None, None]
        total += np.where(sees[:, None, None], np.einsum("nki,nkj->nij", weighted, weighted), 0.0)
    return total


def bound_covariance(information: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3 3"]:
    """The Cramer-Rao bound I^-1 (mm^2); NaN where fewer than two cameras see a point, so that I cannot be inverted."""
    eigenvalues = np.linalg.eigvalsh(np.nan_to_num(information))
    invertible = np.isfinite(information).all(axis=(1, 2)) & (eigenvalues[:, 0] > 1e-9 * eigenvalues[:, 2])
    covariance = np.full_like(information, np.nan)
    covariance[invertible] = np.linalg.inv(information[invertible])
    return covariance


def bound_rms_um(information: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n"]:
    """Root of tr(I^-1): the smallest RMS distance in um of an unbiased estimate from the point."""
    return 1000 * np.sqrt(np.trace(bound_covariance(information), axis1=1, axis2=2))


def ellipsoids(covariance: Float[np.ndarray, "n 3 3"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """Standard deviations (mm, ascending) along the axes of the covariance ellipsoids, and the axes as columns."""
    variances, axes = np.linalg.eigh(covariance)
    return np.sqrt(np.maximum(variances, 0.0)), axes


def planar_pair_bound(
    focal_px: float,
    sigma_px: float,
    depths_mm: tuple[float, float],
    ranges_mm: tuple[float, float],
    baseline_mm: float,
    distance_to_baseline_mm: float,
) -> float:
    """tr(I^-1) in mm^2 of two ideal cameras for a point in the plane of their baseline and axes (Eq 3.9, corrected).

    ``depths_mm`` lie along the axes, ``ranges_mm`` are distances from the projection centres.
    """
    (z0, z1), (d0, d1) = depths_mm, ranges_mm
    across = z0**2 * z1**2 / (z0**2 + z1**2)
    within = (d0**2 * z1**4 + d1**2 * z0**4) / (baseline_mm**2 * distance_to_baseline_mm**2)
    return (sigma_px / focal_px) ** 2 * (across + within)


def triangulate(
    cameras: Sequence[MountedCamera],
    images: Float[np.ndarray, "c n 2"],
    start: Float[np.ndarray, "n 3"],
    sigma_px: Float[np.ndarray, "c n"],
    iterations: int = 5,
) -> Float[np.ndarray, "n 3"]:
    """Maximum-likelihood points (rig frame, mm) from noisy image points, by Gauss-Newton from a start nearby."""
    points = start.copy()
    for _ in range(iterations):
        normal, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        for mounted, image, deviation in zip(cameras, images, sigma_px, strict=True):
            jacobian = projection_jacobian(mounted.camera, mounted.cam_from_rig, points) / deviation[:, None, None]
            residual = (image - mounted.camera.project(mounted.cam_from_rig.apply(points))) / deviation[:, None]
            normal += np.einsum("nki,nkj->nij", jacobian, jacobian)
            right += np.einsum("nki,nk->ni", jacobian, residual)
        points = points + np.linalg.solve(normal, right[..., None])[..., 0]
    return points
