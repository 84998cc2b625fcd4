"""Images resampled to ideal pinholes: one camera without its distortion, or a pair with common rows.

Frames: ``ideal`` is a camera's own frame, ``rect`` a frame common in orientation to the two cameras of a pair, with
+X along the baseline from the first to the second. Everything that OpenCV sees here goes through
:func:`resampling_map`, where the pixel origin is converted.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from cuspid.geometry import Rigid3
from cuspid.model.camera import OPENCV_PIXEL_OFFSET, Camera, undistortion_maps
from cuspid.model.rig import MountedCamera
from cuspid.runtime.errors import InputError


def resampling_map(
    source: MountedCamera, target: Camera, target_from_rig: Rigid3
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Place of each pixel of a camera with the same centre in the source image, as maps for ``cv2.remap``."""
    rays = target.rays(target.pixel_centres())
    source_from_target = source.cam_from_rig.rotation @ target_from_rig.rotation.T
    pixels = source.camera.project(rays @ source_from_target.T) - OPENCV_PIXEL_OFFSET
    pixels = np.nan_to_num(pixels, nan=-1e4).astype(np.float32)
    return np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])


@dataclass(frozen=True, eq=False)
class IdealView:
    """A camera without its distortion."""

    name: str
    """Name in the rig."""
    camera: Camera
    """The real camera without its distortion (:meth:`cuspid.model.camera.Camera.undistorted`)."""
    cam_from_rig: Rigid3
    """As for the real camera."""
    maps: tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]] | None
    """For ``cv2.remap``; None if the real camera has no distortion."""

    @staticmethod
    def of(name: str, mounted: MountedCamera) -> IdealView:
        """The ideal view of a mounted camera."""
        ideal = mounted.camera.undistorted()
        return IdealView(name, ideal, mounted.cam_from_rig, undistortion_maps(mounted.camera, ideal))

    def resample(
        self, image: UInt8[np.ndarray, "h w *c"] | Float32[np.ndarray, "h w *c"]
    ) -> UInt8[np.ndarray, "h w *c"] | Float32[np.ndarray, "h w *c"]:
        """The image as the ideal camera would have taken it; black where the real one saw nothing."""
        return image if self.maps is None else np.asarray(cv2.remap(image, *self.maps, cv2.INTER_CUBIC))

    def resample_mask(self, mask: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
        """As :meth:`resample`, for the nearest pixel; zero where the real camera saw nothing."""
        if self.maps is None:
            return mask
        return np.asarray(cv2.remap(mask, *self.maps, cv2.INTER_NEAREST), dtype=np.uint8)

    def resample_values(self, values: Float32[np.ndarray, "h w 3"], beyond: float) -> Float32[np.ndarray, "h w 3"]:
        """As :meth:`resample`, for values of pixels, linearly; ``beyond`` where the real camera saw nothing."""
        if self.maps is None:
            return values
        return np.asarray(cv2.remap(values, *self.maps, cv2.INTER_LINEAR, borderValue=(beyond,) * 3))


@dataclass(frozen=True, eq=False)
class RectifiedPair:
    """Two virtual cameras with parallel axes, equal focal length and common rows."""

    names: tuple[str, str]
    """The first camera is the left one: its disparities are positive."""
    camera: Camera
    """Intrinsics of both cameras."""
    first_from_rig: Rigid3
    """Pose of the first virtual camera."""
    second_from_rig: Rigid3
    """Pose of the second virtual camera."""
    maps: tuple[tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]], ...]
    """For ``cv2.remap``, of the first and the second image."""
    baseline_mm: float
    """Distance between the two projection centres."""

    def disparity(self, depth_mm: float) -> float:
        """Disparity in px of a point at this depth."""
        return float(self.camera.focal_px[0] * self.baseline_mm / depth_mm)

    def resample(
        self, first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"]
    ) -> tuple[UInt8[np.ndarray, "r c"], UInt8[np.ndarray, "r c"]]:
        """Both images with common rows; black where nothing was seen."""
        # At half resolution a centre falls between four pixels, so that bilinear is their mean.
        return cv2.remap(first, *self.maps[0], cv2.INTER_LINEAR), cv2.remap(second, *self.maps[1], cv2.INTER_LINEAR)


def rectify(names: tuple[str, str], first: MountedCamera, second: MountedCamera, scale: float) -> RectifiedPair:
    """Rectify a pair at ``scale`` times the resolution of the images. Raises InputError if a pair cannot be
    rectified."""
    baseline = second.centre_in_rig - first.centre_in_rig
    length = float(np.linalg.norm(baseline))
    rotation = _rectified_rotation(baseline, first.axis_in_rig + second.axis_in_rig)
    if rotation is None:
        raise InputError(
            f"rig: cameras {names[0]} and {names[1]} lie one behind the other; stereo needs a sideways baseline"
        )
    places = [Rigid3(rotation, -rotation @ mounted.centre_in_rig) for mounted in (first, second)]
    camera = _common_camera([_field_of_view(mounted, rotation) for mounted in (first, second)], first.camera, scale)
    maps = tuple(resampling_map(mounted, camera, place) for mounted, place in zip((first, second), places, strict=True))
    return RectifiedPair(names, camera, places[0], places[1], maps, length)


def _rectified_rotation(
    baseline: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"] | None:
    """Rows: baseline, down, and the mean axis made orthogonal; None where the cameras look along their baseline."""
    length = np.linalg.norm(baseline)
    if length == 0:
        return None
    x = baseline / length
    z = axis - (axis @ x) * x
    if np.linalg.norm(z) < 0.5 * np.linalg.norm(axis):
        return None
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z])


def _field_of_view(mounted: MountedCamera, rect_from_rig: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "2 2"]:
    """Lower and upper corner of what a camera sees, in normalised coordinates of the rectified frame."""
    width, height = mounted.camera.width, mounted.camera.height
    along_x, along_y = np.linspace(0, width, 9), np.linspace(0, height, 9)
    edge = [(x, y) for x in along_x for y in (0, height)] + [(x, y) for x in (0, width) for y in along_y]
    if mounted.camera.lens.is_equidistant:  # the border may lie behind the camera
        ideal = mounted.camera.undistorted()
        return _field_of_view(replace(mounted, camera=ideal), rect_from_rig)
    rays = mounted.camera.rim_rays(np.array(edge, dtype=np.float64)) @ mounted.cam_from_rig.rotation @ rect_from_rig.T
    normalized = rays[:, :2] / np.maximum(rays[:, 2:], 0.2)
    return np.stack([normalized.min(axis=0), normalized.max(axis=0)])


def _common_camera(fields: Iterable[Float[np.ndarray, "2 2"]], source: Camera, scale: float) -> Camera:
    """A virtual camera that covers both fields across the baseline's columns and their common rows."""
    lower, upper = np.moveaxis(np.stack(list(fields)), 1, 0)
    low = np.array([lower[:, 0].min(), lower[:, 1].max()])
    high = np.array([upper[:, 0].max(), upper[:, 1].min()])
    focal = float(source.focal_px.mean() * scale)
    width, height = np.maximum(np.ceil((high - low) * focal), 16).astype(int)
    return Camera(
        width=int(width), height=int(height), focal_px=np.array([focal, focal]), principal_point_px=-low * focal
    )
