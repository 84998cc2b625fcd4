"""What the readers of calibrations share: fields of a file, checked, and the cameras that they make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from cuspid.geometry import Rigid3
from cuspid.geometry.cameras import MODELS
from cuspid.model.camera import OPENCV_PIXEL_OFFSET, Camera
from cuspid.model.rig import MountedCamera
from cuspid.runtime.errors import InputError
from cuspid.runtime.values import LONGEST_MM, MOST_PX, number, numbers, quote, whole
from cuspid.storage.calibrations.lenses import Loss
from cuspid.storage.units import Unit

_MOST_DISTORTION = 1e4
_MOST_FOCAL_PX = 100.0 * MOST_PX
_SKEWED = 0.02
"""A matrix that is farther from a rotation was not only rounded."""
_NO_SKEW_PX = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration:
    """What a file says, in its own unit of length."""

    cameras: Mapping[str, MountedCamera]
    """By name, in order; translations are in :attr:`unit`."""
    unit: Unit | None = None
    """Of lengths; None where the file does not state it."""
    losses: Mapping[str, Loss] = field(default_factory=dict)
    """Of the cameras whose lens has no counterpart."""
    notes: tuple[str, ...] = ()
    """What was assumed, or left out."""


@dataclass(frozen=True, kw_only=True)
class Hints:
    """What the user says of a file."""

    image_size_px: tuple[int, int] | None = None
    """Of its images, where the file does not state it."""


def require_list(what: str, value: Any) -> list[Any]:
    """A list. Raises InputError for anything else."""
    if not isinstance(value, list):
        raise InputError(f"{what} is {quote(value)}; it must be a list")
    return value


def require_mapping(what: str, value: Any) -> Mapping[str, Any]:
    """A mapping with names as keys. Raises InputError for anything else."""
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise InputError(f"{what} is {quote(value)}; it must have named fields")
    return value


def matrix(what: str, value: Any, rows: int, columns: int, most: float = LONGEST_MM) -> Float[np.ndarray, "r c"]:
    """Numbers of a matrix: a list of rows, all in one list, or the matrix of OpenCV and ROS with rows, cols and
    data."""
    if isinstance(value, Mapping):
        value = value["data"]
    count = rows * columns
    flat = isinstance(value, list) and len(value) == count and not any(isinstance(each, list) for each in value)
    return numbers(what, value, (count,) if flat else (rows, columns), -most, most).reshape(rows, columns)


def vector(what: str, value: Any, size: int | None = None, most: float = LONGEST_MM) -> Float[np.ndarray, "n"]:
    """Numbers in a list, a row or a column; of any count unless one is given."""
    if isinstance(value, Mapping):
        value = value["data"]
    if isinstance(value, list):
        nested = [each for each in value if isinstance(each, list)]
        if len(nested) == len(value) and (len(value) == 1 or all(len(each) == 1 for each in nested)):
            value = [each for inner in nested for each in inner]
    return numbers(what, value, (len(value) if size is None and isinstance(value, list) else size or 0,), -most, most)


def rotation(what: str, value: Any) -> Float[np.ndarray, "3 3"]:
    """A rotation: a matrix, which may be rounded, or a vector along its axis, in rad."""
    plain = value["data"] if isinstance(value, Mapping) else value
    if isinstance(plain, list) and (len(plain) == 1 or np.size(np.asarray(plain, dtype=object)) == 3):
        return np.asarray(Rotation.from_rotvec(vector(what, plain, 3)).as_matrix())
    return nearest_rotation(what, matrix(what, value, 3, 3))


def nearest_rotation(what: str, found: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation that a rounded matrix is meant to be. Raises InputError for what is none."""
    left, lengths, right = np.linalg.svd(found)
    if np.abs(lengths - 1).max() > _SKEWED or np.linalg.det(found) < 0:
        raise InputError(f"{what} is {quote(found)}; it must be a rotation")
    return np.asarray(left @ right)


def pose(what: str, turn: Any, shift: Any) -> Rigid3:
    """A rigid motion from a rotation and a translation."""
    return Rigid3(rotation(f"{what} (rotation)", turn), vector(f"{what} (translation)", shift, 3))


def motion(what: str, value: Any) -> Rigid3:
    """A rigid motion from a 4 x 4 or 3 x 4 matrix."""
    rows = 3 if isinstance(value, list) and len(value) in (3, 12) else 4
    found = matrix(what, value, rows, 4)
    return Rigid3(nearest_rotation(what, found[:3, :3]), found[:3, 3])


def image_size(what: str, width: Any, height: Any) -> tuple[int, int]:
    """A size in px."""
    return whole(f"{what}: width", width, 1, MOST_PX), whole(f"{what}: height", height, 1, MOST_PX)


def assumed_size(principal_px: Sequence[float], hints: Hints) -> tuple[tuple[int, int], str | None]:
    """The size of images whose file does not state it: as the user says, or twice the principal point; and what is to
    be said of it."""
    if hints.image_size_px is not None:
        return hints.image_size_px, None
    width, height = (max(1, round(2 * each)) for each in principal_px)
    return (width, height), f"the file has no image size; {width} x {height} px is assumed (--image-size W H)"


def camera(
    what: str,
    size_px: tuple[int, int],
    focal_px: Any,
    centre_px: Any,
    distortion: Any,
    model: str,
    *,
    pixel_offset: float = OPENCV_PIXEL_OFFSET,
) -> Camera:
    """A camera of one of cuspid's models; ``pixel_offset`` is what COLMAP's pixel coordinates are more than those of
    the file."""
    width, height = image_size(what, *size_px)
    count = len(MODELS[model].names)
    return Camera(
        width=width,
        height=height,
        focal_px=numbers(f"{what}: focal length", focal_px, (2,), 1.0, _MOST_FOCAL_PX),
        principal_point_px=numbers(f"{what}: principal point", centre_px, (2,), -2.0 * MOST_PX, 2.0 * MOST_PX)
        + pixel_offset,
        distortion=numbers(f"{what}: distortion", distortion, (count,), -_MOST_DISTORTION, _MOST_DISTORTION),
        model=model,
    )


def calibration_matrix(what: str, value: Any) -> tuple[list[float], list[float]]:
    """Focal lengths and principal point of a matrix K. Raises InputError where it has skew."""
    found = matrix(what, value, 3, 3, _MOST_FOCAL_PX)
    if abs(found[0, 1]) > _NO_SKEW_PX or np.abs(found[[1, 2, 2], [0, 0, 1]]).max() > _NO_SKEW_PX:
        raise InputError(f"{what} is {quote(found)}; it must be [fx 0 cx; 0 fy cy; 0 0 1], without skew")
    scale = number(f"{what}: its last number", found[2, 2], 1e-9, 1e9)
    found = found / scale
    return [found[0, 0], found[1, 1]], [found[0, 2], found[1, 2]]


def brown(coefficients: Float[np.ndarray, "n"]) -> tuple[str, list[float]]:
    """Model and parameters of OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]], as short as they can be."""
    padded = np.pad(coefficients, (0, 8 - len(coefficients))).tolist()
    return ("FULL_OPENCV", padded) if any(padded[4:]) else ("OPENCV", padded[:4])


def scale_lengths(mounted: MountedCamera, factor: float) -> MountedCamera:
    """The calibration with its lengths in another unit."""
    shift = np.diag([1.0, 1, 1, factor, factor, factor])
    covariance = None if mounted.covariance is None else shift @ mounted.covariance @ shift
    moved = Rigid3(mounted.cam_from_rig.rotation, mounted.cam_from_rig.translation * factor)
    return replace(mounted, cam_from_rig=moved, covariance=covariance)
