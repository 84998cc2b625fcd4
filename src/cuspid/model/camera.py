"""A camera with its lens, and the two projections of thesis 3.1 (Eq 3.1, 3.2 as corrected).

Frame: the camera looks along +Z, +X is right, +Y is down. Pixels are COLMAP's: the centre of the first pixel is
(0.5, 0.5). Lenses are COLMAP's models (:mod:`cuspid.geometry.cameras`): OPENCV unless another one is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.geometry import read_only, unit
from cuspid.geometry.cameras import (
    MODELS,
    LensModel,
    directions_through,
    fold_radius,
    project_points,
    projection_derivatives,
)
from cuspid.runtime.errors import InputError
from cuspid.runtime.values import quote

_MOST_SLOPE = float(np.tan(np.deg2rad(70.0)))
"""Of the rays at the border of an image without distortion."""
_LEAST_AHEAD = 0.05
_RIM_TICKS = 50
"""Pixels along each side of an image that stand for all."""
OPENCV_PIXEL_OFFSET = 0.5
"""COLMAP's pixel coordinate minus OpenCV's for the same place in an image."""


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
    distortion: Float[np.ndarray, "k"] = field(default_factory=lambda: np.zeros(4))
    """Parameters of the lens, as :attr:`lens` names them: (k1, k2, p1, p2) of COLMAP's OPENCV model."""
    covariance: Float[np.ndarray, "n n"] | None = None
    """Covariance of :attr:`parameters`; zero for an exact calibration, None if its uncertainty is not stated (an
    adjustment then holds it fixed)."""
    model: str = "OPENCV"
    """The model of the lens: one of :data:`cuspid.geometry.cameras.MODELS`."""

    def __repr__(self) -> str:
        fx, fy = self.focal_px
        return f"Camera({self.width} x {self.height} px, {self.model}, focal length {fx:.1f} x {fy:.1f} px)"

    def __post_init__(self) -> None:
        for name in ("focal_px", "principal_point_px", "distortion"):
            object.__setattr__(self, name, read_only(np.asarray(getattr(self, name), dtype=np.float64)))
        if self.covariance is not None:
            object.__setattr__(self, "covariance", read_only(np.asarray(self.covariance, dtype=np.float64)))
        if self.model not in MODELS:
            raise InputError(f"camera: there is no model {self.model!r}; it must be one of {', '.join(MODELS)}")
        if self.width <= 0 or self.height <= 0 or not np.all(self.focal_px > 0):
            raise InputError(
                f"camera: width, height and focal length must be positive, not {self.width} x {self.height} px and "
                f"{self.focal_px} px"
            )
        if len(self.distortion) != len(self.lens.names):
            raise InputError(
                f"camera: a lens of the model {self.model} has the parameters {self.lens.said}, not "
                f"{len(self.distortion)} numbers"
            )
        if self.lens.splined and not self.distortion[self.lens.names.index("reach")] > 0:
            reach = self.distortion[self.lens.names.index("reach")]
            raise InputError(f"camera: the reach of its grid must be positive, not {reach:g}")
        if not np.isfinite(self.parameters).all():
            raise InputError(f"camera: its parameters are not finite: {quote(self.parameters)}")

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
    def lens(self) -> LensModel:
        """The model of its lens."""
        return MODELS[self.model]

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Of :attr:`parameters`."""
        return "fx", "fy", "cx", "cy", *self.lens.names

    @cached_property
    def parameters(self) -> Float[np.ndarray, "n"]:
        """(fx, fy, cx, cy) and those of the lens: COLMAP's order."""
        return read_only(np.concatenate([self.focal_px, self.principal_point_px, self.distortion]))

    @cached_property
    def fold_radius(self) -> float:
        """See :func:`cuspid.geometry.cameras.fold_radius`."""
        return fold_radius(self.lens, self.distortion)

    @property
    def is_pinhole(self) -> bool:
        """Whether it shows straight lines straight."""
        return not self.lens.is_equidistant and not np.any(self.distortion)

    def as_pinhole(self) -> Camera:
        """A pinhole camera with the same image size, focal length and principal point, taken as exact."""
        return replace(self, model="OPENCV", distortion=np.zeros(4), covariance=None)

    def undistorted(self) -> Camera:
        """The pinhole camera that its images are resampled to: :meth:`as_pinhole`, or for an equidistant lens one of
        the same scale on the axis whose image is large enough for what is seen up to 70 degrees from it, each way."""
        if not self.lens.is_equidistant:
            return self.as_pinhole()
        ticks = np.linspace(0, 1, 33)
        border = np.array([[t, s] for t in ticks for s in ticks if t in (0, 1) or s in (0, 1)])
        seen = self.directions(border * [self.width, self.height])
        slopes = np.nan_to_num(seen[:, :2] / np.maximum(seen[:, 2:], _LEAST_AHEAD), nan=0.0)
        low, high = np.clip([slopes.min(axis=0), slopes.max(axis=0)], -_MOST_SLOPE, _MOST_SLOPE) * self.focal_px
        if np.isnan(seen).any():  # the image is round, and its rim lies within the border
            high = _MOST_SLOPE * self.focal_px
            low = -high
        width, height = np.ceil(high - low).astype(int).tolist()
        return replace(self.as_pinhole(), width=width, height=height, principal_point_px=-low)

    def with_parameters(self, parameters: Float[np.ndarray, "n"]) -> Camera:
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
        factors = np.concatenate([by, by, np.ones(len(self.distortion))])
        covariance = None if self.covariance is None else factors[:, None] * self.covariance * factors
        fewer = replace(self, width=width, height=height, covariance=covariance)
        return fewer.with_parameters(factors * self.parameters)

    def project(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Projection of points in the camera frame (mm) to px. NaN where the lens shows nothing: behind a perspective
        camera, and so far from the axis that the model folds back."""
        return project_points(self.lens.code, self.parameters, self.fold_radius, points)

    def projection_derivatives(
        self, points: Float[np.ndarray, "*n 3"]
    ) -> tuple[Float[np.ndarray, "*n 2 3"], Float[np.ndarray, "*n 2 k"]]:
        """Derivatives of :meth:`project` by the points (px / mm), and by :attr:`parameters`."""
        return projection_derivatives(self.lens.code, self.parameters, points)

    def directions(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """Unit vectors in the camera frame through pixels, the inverse of :meth:`project`; NaN where it has none."""
        return unit(directions_through(self.lens.code, self.parameters, self.fold_radius, pixels))

    def rays(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """Directions with Z = 1 in the camera frame through pixels, the inverse of :meth:`project`; NaN where it has
        none, and for what lies 90 degrees from the axis or farther."""
        found = directions_through(self.lens.code, self.parameters, self.fold_radius, pixels)
        if not self.lens.is_equidistant:
            return found
        ahead = found[..., 2:]
        return found / np.where(ahead > 0, ahead, np.nan)

    def rim_rays(self, border: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 3"]:
        """Rays through pixels of the border of the image or, where the lens shows nothing at some of them, through a
        grid of those at which it does."""
        rays = self.rays(border)
        if np.isfinite(rays).all():
            return rays
        inner = self.rays(self.pixel_centres()[:: -(-self.height // _RIM_TICKS), :: -(-self.width // _RIM_TICKS)])
        return inner[np.isfinite(inner).all(axis=-1)]

    @cached_property
    def valid_mask(self) -> Bool[np.ndarray, "h w"] | None:
        """Where in the image the lens shows something, by its model; None where it does so everywhere."""
        edge = np.linspace(0, 1, _RIM_TICKS)[:, None] * [self.width, self.height]
        corners = np.array([[0.0, 0.0], [1, 0], [0, 1], [1, 1]]) * [self.width, self.height]
        if np.isfinite(self.directions(np.concatenate([edge, corners]))).all():
            return None
        return np.isfinite(self.directions(self.pixel_centres())).all(axis=-1)

    def pixel_centres(self) -> Float[np.ndarray, "h w 2"]:
        """Coordinates of every pixel centre."""
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return np.stack([x, y], axis=-1)

    def contains(self, pixels: Float[np.ndarray, "*n 2"], margin_px: float = 0.0) -> np.ndarray:
        """True where a pixel lies inside the image by at least ``margin_px``; False for NaN."""
        upper = np.array([self.width, self.height]) - margin_px
        return np.all((pixels >= margin_px) & (pixels <= upper), axis=-1)


def stack_lenses(cameras: Sequence[Camera]) -> tuple[Int[np.ndarray, "c"], Float[np.ndarray, "c n"]]:
    """Codes of the models of some cameras, and their parameters, with zeros after those of models that have fewer."""
    most = max(len(camera.parameters) for camera in cameras)
    rows = [np.pad(camera.parameters, (0, most - len(camera.parameters))) for camera in cameras]
    return np.array([camera.lens.code for camera in cameras], dtype=np.int64), np.stack(rows)


def undistortion_maps(
    camera: Camera, ideal: Camera | None = None
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]] | None:
    """For each pixel of an ideal camera at the same place (by default the camera as a pinhole), its place in the image,
    as float32 maps for ``cv2.remap`` (far outside where the image does not show it); None if they are the same."""
    ideal = ideal or camera.as_pinhole()
    if camera.is_pinhole and np.array_equal(camera.parameters, ideal.parameters):
        return None
    pixels = camera.project(ideal.rays(ideal.pixel_centres())) - OPENCV_PIXEL_OFFSET
    pixels = np.nan_to_num(pixels, nan=-1e4).astype(np.float32)
    return np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])
