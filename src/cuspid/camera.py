"""A pinhole camera with lens distortion, and the two projections of thesis 3.1 (Eq 3.1, 3.2 as corrected).

Frame: the camera looks along +Z, +X is right, +Y is down. Pixels are COLMAP's: the centre of the first pixel is
(0.5, 0.5). Distortion is COLMAP's OPENCV model (k1, k2, p1, p2) on normalised coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from cuspid.errors import InputError
from cuspid.geometry import read_only
from cuspid.values import shown

OPENCV_PIXEL_OFFSET = 0.5
"""COLMAP's pixel coordinate minus OpenCV's for the same place in an image."""


def distort(normalized: Float[np.ndarray, "*n 2"], distortion: Float[np.ndarray, "4 ..."]) -> Float[np.ndarray, "*n 2"]:
    """Ideal normalised coordinates to distorted ones: COLMAP's OPENCV model (k1, k2, p1, p2), with one lens for all
    points or one for each."""
    k1, k2, p1, p2 = distortion
    x, y = normalized[..., 0], normalized[..., 1]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
        ],
        axis=-1,
    )


def undistort(
    distorted: Float[np.ndarray, "*n 2"], distortion: Float[np.ndarray, "4"], iterations: int = 12
) -> Float[np.ndarray, "*n 2"]:
    """Inverse of :func:`distort` by Newton's method with a numeric Jacobian (exact to rounding for real lenses)."""
    if not np.any(distortion):
        return distorted.copy()
    ideal = distorted.astype(np.float64)
    step = 1e-7
    for _ in range(iterations):
        residual = distort(ideal, distortion) - distorted
        if np.abs(residual).max(initial=0.0) < 1e-13:
            break
        along_x = (distort(ideal + [step, 0], distortion) - distort(ideal - [step, 0], distortion)) / (2 * step)
        along_y = (distort(ideal + [0, step], distortion) - distort(ideal - [0, step], distortion)) / (2 * step)
        jacobian = np.stack([along_x, along_y], axis=-1)
        ideal = ideal - np.linalg.solve(jacobian, residual[..., None])[..., 0]
    return ideal


def project_orthographic(points: Float[np.ndarray, "*n 3"], scale_px_per_mm: float = 1.0) -> Float[np.ndarray, "*n 2"]:
    """Scaled orthographic projection x = s X, y = s Y (Eq 3.1, which prints the perspective one)."""
    return scale_px_per_mm * points[..., :2]


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """Intrinsic calibration of one camera."""

    width: int
    """Image width in px."""
    height: int
    """Image height in px."""
    focal_px: Float[np.ndarray, "2"]
    """Focal lengths (fx, fy) in px."""
    principal_point_px: Float[np.ndarray, "2"]
    """Principal point (cx, cy) in px; (width/2, height/2) is the image centre."""
    distortion: Float[np.ndarray, "4"] = field(default_factory=lambda: np.zeros(4))
    """(k1, k2, p1, p2) of COLMAP's OPENCV model."""
    covariance: Float[np.ndarray, "8 8"] | None = None
    """Covariance of (fx, fy, cx, cy, k1, k2, p1, p2); zero for an exact calibration, None if its uncertainty is not
    stated (an adjustment then holds it fixed)."""

    def __post_init__(self) -> None:
        for name in ("focal_px", "principal_point_px", "distortion"):
            object.__setattr__(self, name, read_only(np.asarray(getattr(self, name), dtype=np.float64)))
        if self.covariance is not None:
            object.__setattr__(self, "covariance", read_only(np.asarray(self.covariance, dtype=np.float64)))
        if self.width <= 0 or self.height <= 0 or not np.all(self.focal_px > 0):
            raise InputError(
                f"camera: width, height and focal length must be positive, not {self.width} x {self.height} px and "
                f"{self.focal_px} px"
            )
        if not np.isfinite(self.parameters).all():
            raise InputError(f"camera: its parameters are not finite: {shown(self.parameters)}")

    @staticmethod
    def from_field_of_view(width: int, height: int, horizontal_fov_deg: float) -> Camera:
        """Ideal camera with square pixels, central principal point and the given full horizontal angle of view."""
        focal = width / (2 * np.tan(np.deg2rad(horizontal_fov_deg) / 2))
        return Camera(
            width=width,
            height=height,
            focal_px=np.array([focal, focal]),
            principal_point_px=np.array([width / 2, height / 2]),
        )

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The calibration matrix K (Eq 3.2)."""
        (fx, fy), (cx, cy) = self.focal_px, self.principal_point_px
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    @property
    def opencv_matrix(self) -> Float[np.ndarray, "3 3"]:
        """K with the principal point in OpenCV's pixel origin."""
        matrix = self.matrix
        matrix[:2, 2] -= OPENCV_PIXEL_OFFSET
        return matrix

    @property
    def parameters(self) -> Float[np.ndarray, "8"]:
        """(fx, fy, cx, cy, k1, k2, p1, p2): COLMAP's parameter order of the OPENCV model."""
        return np.concatenate([self.focal_px, self.principal_point_px, self.distortion])

    def with_parameters(self, parameters: Float[np.ndarray, "8"]) -> Camera:
        """The same sensor with other intrinsic parameters, in the order of :attr:`parameters`."""
        return replace(
            self,
            focal_px=parameters[:2],
            principal_point_px=parameters[2:4],
            distortion=parameters[4:],
        )

    def resized(self, width: int, height: int) -> Camera:
        """The camera whose images are those of this one, resized."""
        by = np.array([width / self.width, height / self.height])
        factors = np.concatenate([by, by, np.ones(4)])
        covariance = None if self.covariance is None else factors[:, None] * self.covariance * factors
        fewer = replace(self, width=width, height=height, covariance=covariance)
        return fewer.with_parameters(factors * self.parameters)

    def project(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Perspective projection of points in the camera frame (mm) to px. NaN where Z <= 0."""
        depth = points[..., 2:]
        normalized = points[..., :2] / np.where(depth > 0, depth, np.nan)
        distorted = distort(normalized, self.distortion) if np.any(self.distortion) else normalized
        return distorted * self.focal_px + self.principal_point_px

    def rays(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """Directions with Z = 1 in the camera frame through pixels, the inverse of :meth:`project`."""
        normalized = undistort((pixels - self.principal_point_px) / self.focal_px, self.distortion)
        return np.concatenate([normalized, np.ones((*normalized.shape[:-1], 1))], axis=-1)

    def pixel_centres(self) -> Float[np.ndarray, "h w 2"]:
        """Coordinates of every pixel centre."""
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return np.stack([x, y], axis=-1)

    def contains(self, pixels: Float[np.ndarray, "*n 2"], margin_px: float = 0.0) -> np.ndarray:
        """True where a pixel lies inside the image by at least ``margin_px``; False for NaN."""
        upper = np.array([self.width, self.height]) - margin_px
        return np.all((pixels >= margin_px) & (pixels <= upper), axis=-1)


def undistortion_maps(camera: Camera) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]] | None:
    """For each pixel of the same camera without distortion, its place in the image, as float32 maps for ``cv2.remap``
    (far outside where the image does not show it); None if the camera has no distortion."""
    if not np.any(camera.distortion):
        return None
    ideal = replace(camera, distortion=np.zeros(4), covariance=None)
    pixels = camera.project(ideal.rays(ideal.pixel_centres())) - OPENCV_PIXEL_OFFSET
    pixels = np.nan_to_num(pixels, nan=-1e4).astype(np.float32)
    return np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])
