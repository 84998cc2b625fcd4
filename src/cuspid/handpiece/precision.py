"""How precisely a point can be triangulated: the Cramer-Rao bound of any number of cameras (thesis 3.4, Eq 3.7-3.9).

Camera i sees the point X at x_i = pi(K_i (R_i X + t_i)) + noise, normal with standard deviation sigma_i px in both
directions. The Fisher matrix is I = sum_i J_i^T J_i / sigma_i^2 with J_i = d x_i / d X, and no unbiased estimate of X
has a covariance smaller than I^-1. The thesis' Eq 3.9 lost its exponents; the closed form that is right for two ideal
cameras and X in the plane of the baseline and the axes is :func:`planar_pair_bound`.

The noise may depend on the circumstances. Two of them belong to a pair of cameras: the *convergence* is the angle
between their rays to X; the *deformation* is how differently their images show the surface around X. With A_i = J_i T,
T two vectors that span the tangent plane, it is the largest singular value of (A_b - A_a) ((A_a + A_b) / 2)^-1. Where
the images differ only along the epipolar lines this is the disparity gradient of stereo vision (Burt and Julesz,
Science 208, 1980): 2 tan(slant) tan(convergence / 2) straight ahead of a pair. A camera of many is matched with the
partner that resembles it most, so of its convergences or deformations the smallest counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.geometry import Rigid3, read_only
from cuspid.handpiece.optics import Optics
from cuspid.model.camera import Camera
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece, MountedCamera
from cuspid.model.visibility import VisibilityOptions, survey_visibility
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range


@dataclass(frozen=True, kw_only=True)
class NoiseModel(Options):
    """Standard deviation of a matched image point, and what increases it; the terms add up."""

    sigma_px: Annotated[float, Range(1e-06, 1000)] = 0.5
    """In each image and direction, when matching a sharp point that all cameras see perpendicularly."""
    convergence_deg: Annotated[float | None, Range(0.001, 1000)] = None
    """Convergence that doubles the variance: sigma^2 (1 + (gamma / this)^4); default: no influence."""
    deformation: Annotated[float | None, Range(1e-06, 1000)] = None
    """Deformation (dimensionless) that doubles the variance: sigma^2 (1 + (g / this)^2). Needs the surface normals;
    default: no influence."""
    blur_px: Annotated[float | None, Range(1e-06, 1000)] = None
    """Diameter of the blur disc that doubles the variance: sigma^2 (1 + (c / this)^2); default: no influence."""


def projection_jacobian(
    camera: Camera, cam_from_world: Rigid3, points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 2 3"]:
    """Derivative of the image points (px) by the points in the world (mm); NaN behind the camera."""
    by_point, _ = camera.projection_derivatives(cam_from_world.apply(points))
    return np.asarray(by_point @ cam_from_world.rotation)


def noise_px(
    cameras: Sequence[MountedCamera],
    points: Float[np.ndarray, "n 3"],
    model: NoiseModel,
    seen: Bool[np.ndarray, "c n"],
    *,
    optics: Optics | None = None,
    normals: Float[np.ndarray, "n 3"] | None = None,
) -> Float[np.ndarray, "c n"]:
    """Standard deviation of each camera's image of each point (rig frame, mm), in px.

    ``normals``: outward unit normals of the surface at the points. Raises InputError where the model counts deformation
    but no normals are given, or blur but no optics.
    """
    growth = np.ones((len(cameras), len(points)))
    if model.convergence_deg is not None:
        growth += (np.rad2deg(convergence(cameras, points, seen)) / model.convergence_deg) ** 4
    if model.deformation is not None:
        if normals is None:
            raise InputError("noise model: it includes deformation, so the surface normals must be given")
        growth += (deformation(cameras, points, normals, seen) / model.deformation) ** 2
    if model.blur_px is not None:
        if optics is None:
            raise InputError("noise model: it includes blur, so the optics must be given")
        depths = np.stack([mounted.cam_from_rig.apply(points)[:, 2] for mounted in cameras])
        growth += (optics.blur_px(np.where(depths > 0, depths, np.nan)) / model.blur_px) ** 2
    return model.sigma_px * np.sqrt(growth)


def convergence(
    cameras: Sequence[MountedCamera], points: Float[np.ndarray, "n 3"], seen: Bool[np.ndarray, "c n"]
) -> Float[np.ndarray, "c n"]:
    """Smallest angle in radians from each camera's ray to that of another; 0 for a camera without a partner there."""
    rays = np.stack([points - mounted.centre_in_rig for mounted in cameras])
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    cosines = np.einsum("ank,bnk->abn", rays, rays)
    return _min_over_partners(np.arccos(np.clip(cosines, -1.0, 1.0)), seen)


def deformation(
    cameras: Sequence[MountedCamera],
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    seen: Bool[np.ndarray, "c n"],
) -> Float[np.ndarray, "c n"]:
    """Smallest deformation between each camera's image and another's; 0 for a camera without a partner there."""
    span = _tangents(normals)
    images = np.stack([projection_jacobian(m.camera, m.cam_from_rig, points) @ span for m in cameras])
    first, second = images[:, None], images[None]
    difference, mean = second - first, (first + second) / 2
    determinant = mean[..., 0, 0] * mean[..., 1, 1] - mean[..., 0, 1] * mean[..., 1, 0]
    adjugate = np.stack(
        [
            np.stack([mean[..., 1, 1], -mean[..., 0, 1]], axis=-1),
            np.stack([-mean[..., 1, 0], mean[..., 0, 0]], axis=-1),
        ],
        axis=-2,
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        between = _largest_singular_value(difference @ adjugate) / np.abs(determinant)
    return _min_over_partners(np.where(np.isnan(between), np.inf, between), seen)


def _min_over_partners(between: Float[np.ndarray, "c c n"], seen: Bool[np.ndarray, "c n"]) -> Float[np.ndarray, "c n"]:
    """For each camera that sees a point the smallest value to another one that does."""
    partners = seen[:, None] & seen[None] & ~np.eye(len(seen), dtype=bool)[..., None]
    smallest = np.where(partners, between, np.inf).min(axis=1)
    return np.where(partners.any(axis=1), smallest, 0.0)


def _tangents(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 2"]:
    """Two unit vectors square to each normal and to each other, as columns."""
    aside = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, aside)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first)], axis=-1)


def _largest_singular_value(matrices: Float[np.ndarray, "*n 2 2"]) -> Float[np.ndarray, "*n"]:
    """In closed form: the squares have the sum |M|^2 and the product det(M)^2."""
    squares = np.sum(matrices**2, axis=(-2, -1))
    determinant = matrices[..., 0, 0] * matrices[..., 1, 1] - matrices[..., 0, 1] * matrices[..., 1, 0]
    return np.asarray(np.sqrt((squares + np.sqrt(np.maximum(squares**2 - 4 * determinant**2, 0.0))) / 2))


def fisher_information(
    cameras: Sequence[MountedCamera],
    points: Float[np.ndarray, "n 3"],
    model: NoiseModel = NoiseModel(),
    *,
    seen: Bool[np.ndarray, "c n"] | None = None,
    optics: Optics | None = None,
    normals: Float[np.ndarray, "n 3"] | None = None,
) -> Float[np.ndarray, "n 3 3"]:
    """The Fisher matrix (1/mm^2) of each point (rig frame, mm), summed over the cameras that see it (default: all)."""
    seen = np.ones((len(cameras), len(points)), dtype=bool) if seen is None else seen
    sigma = noise_px(cameras, points, model, seen, optics=optics, normals=normals)
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
    return rms_um(bound_covariance(information))


def rms_um(covariance: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n"]:
    """Root of the trace of covariances (mm^2): RMS distance in um."""
    return np.asarray(1000 * np.sqrt(np.trace(covariance, axis1=1, axis2=2)))


def ellipsoids(covariance: Float[np.ndarray, "n 3 3"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """Standard deviations (mm, ascending) along the axes of the covariance ellipsoids, and the axes as columns."""
    variances, axes = np.linalg.eigh(covariance)
    return np.sqrt(np.maximum(variances, 0.0)), axes


@dataclass(frozen=True, eq=False, kw_only=True)
class PrecisionMap:
    """How precisely each face of a mesh could be triangulated from one position of a handpiece."""

    cameras_at_once: Int[np.ndarray, "f"]
    """How many cameras see it."""
    covariance: Float[np.ndarray, "f 3 3"]
    """Cramer-Rao bound at its centre in the frame of the mesh, mm^2; NaN where fewer than two cameras see it."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras_at_once", read_only(self.cameras_at_once))
        object.__setattr__(self, "covariance", read_only(self.covariance))

    @property
    def rms_um(self) -> Float[np.ndarray, "f"]:
        """Root of the bound's trace: RMS distance; NaN where fewer than two cameras see the face."""
        return rms_um(self.covariance)

    def normal_um(self, normals: Float[np.ndarray, "f 3"]) -> Float[np.ndarray, "f"]:
        """Standard deviation along the unit normal of each face, which is what a surface comparison measures."""
        return np.asarray(1000 * np.sqrt(np.einsum("fi,fij,fj->f", normals, self.covariance, normals)))


def precision_map(
    mesh: Mesh,
    handpiece: Handpiece,
    rig_from_world: Rigid3,
    model: NoiseModel = NoiseModel(),
    *,
    visibility: VisibilityOptions = VisibilityOptions(),
    optics: Optics | None = None,
) -> PrecisionMap:
    """The bound over a mesh (world frame): each face by the cameras that see it from one pose."""
    seen = survey_visibility(mesh, handpiece, [rig_from_world], visibility).by_camera.T
    faces = np.flatnonzero(seen.sum(axis=0) >= 2)
    cameras = tuple(handpiece.rig.cameras.values())
    in_rig = rig_from_world.apply(mesh.face_centres[faces])
    normals = rig_from_world.rotate(mesh.face_normals[faces])
    information = fisher_information(cameras, in_rig, model, seen=seen[:, faces], optics=optics, normals=normals)
    covariance = np.full((len(mesh.faces), 3, 3), np.nan)
    world_from_rig = rig_from_world.rotation.T
    covariance[faces] = world_from_rig @ bound_covariance(information) @ world_from_rig.T
    return PrecisionMap(cameras_at_once=seen.sum(axis=0), covariance=covariance)


def best_of_positions(maps: Sequence[PrecisionMap]) -> PrecisionMap:
    """The best of several positions for each face, by the trace of the bound."""
    covariances = np.array([each.covariance for each in maps])
    traces = np.nan_to_num(np.trace(covariances, axis1=2, axis2=3), nan=np.inf)
    best, faces = traces.argmin(axis=0), np.arange(traces.shape[1])
    counts = np.array([each.cameras_at_once for each in maps])
    return PrecisionMap(cameras_at_once=counts.max(axis=0), covariance=covariances[best, faces])


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
