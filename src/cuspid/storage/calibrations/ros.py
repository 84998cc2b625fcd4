"""ROS: ``camera_info``, a YAML file for each camera, as ``camera_calibration_parsers`` and ``camera_calibration`` write
it, or as a message is printed. Pixel centres are whole numbers, lengths metres. The pose of a camera is given only for
rectified pairs: by the rotation R into the rectified frame, and by P, whose last column holds the baseline."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import yaml
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.model.rig import MountedCamera
from cuspid.runtime.errors import InputError
from cuspid.runtime.values import checked_name, quote
from cuspid.storage.calibrations.documents import Document
from cuspid.storage.calibrations.fields import (
    Calibration,
    Hints,
    brown,
    calibration_matrix,
    camera,
    image_size,
    matrix,
    nearest_rotation,
    require_mapping,
    vector,
)
from cuspid.storage.calibrations.lenses import BROWN_5, FISHEYE, RATIONAL, Lens
from cuspid.storage.calibrations.opencv import coefficients_of

LENSES: tuple[Lens, ...] = (BROWN_5, RATIONAL, FISHEYE)
_MOST_P = 1e9
_BROWN = ("plumb_bob", "rational_polynomial", "")


def recognises(files: Mapping[str, Document]) -> bool:
    """Whether each file is a camera_info."""
    return all(_is_parsed(each) or _is_message(each) for each in files.values())


def _is_parsed(document: Document) -> bool:
    return document.has("camera_matrix", "distortion_model")


def _is_message(document: Document) -> bool:
    return document.has("distortion_model", "K", "D") or document.has("distortion_model", "k", "d")


def read(files: Mapping[str, Document], hints: Hints) -> Calibration:
    """Cameras of one or several files. Raises InputError."""
    cameras: dict[str, MountedCamera] = {}
    placed: list[str] = []
    for stem, document in files.items():
        values = require_mapping("a camera_info", document.value)
        name = checked_name("camera_name", values.get("camera_name") or stem)
        if name in cameras:
            name = checked_name("camera", stem)
        cameras[name], is_placed = _mount_camera(f"camera {name}", values)
        placed += [name] if is_placed else []
    if len(cameras) == 2 and not placed:
        raise InputError("its two cameras have no baseline in projection_matrix; give those of a calibrated pair")
    if len(cameras) > 2:
        raise InputError(f"{len(cameras)} camera_info files; they give poses of a rectified pair only, so give two")
    if len(cameras) == 2 and placed[0] == next(iter(cameras)):
        cameras = dict(reversed(cameras.items()))
    return Calibration(cameras=cameras)


def _mount_camera(what: str, values: Mapping[str, Any]) -> tuple[MountedCamera, bool]:
    """A camera in the rectified frame of the first of its pair, and whether it is another than the first."""

    def field_of(*names: str) -> Any:
        return next((values[name] for name in names if name in values), None)

    size = image_size(what, field_of("image_width", "width"), field_of("image_height", "height"))
    focal, centre = calibration_matrix(f"{what}: camera_matrix", field_of("camera_matrix", "K", "k"))
    coefficients = field_of("distortion_coefficients", "D", "d")
    distortion = vector(f"{what}: distortion_coefficients", [] if coefficients is None else coefficients)
    kind = values["distortion_model"]
    if kind in ("equidistant", "fisheye"):
        model, parameters = "OPENCV_FISHEYE", distortion.tolist() or [0.0] * 4
    elif kind in _BROWN and len(distortion) in (0, 4, 5, 8):
        model, parameters = brown(distortion)
    else:
        raise InputError(
            f"{what}: distortion_model {quote(kind)} with {len(distortion)} coefficients is not known; use plumb_bob "
            "(5), rational_polynomial (8) or equidistant (4)"
        )
    turn, projection = field_of("rectification_matrix", "R", "r"), field_of("projection_matrix", "P", "p")
    rectified = np.eye(3)
    if turn is not None:
        rectified = nearest_rotation(f"{what}: rectification_matrix", matrix(what, turn, 3, 3))
    shift = np.zeros(3)
    if projection is not None:
        shift = _shift(f"{what}: projection_matrix", matrix(f"{what}: projection_matrix", projection, 3, 4, _MOST_P))
    place = Rigid3(rectified.T, rectified.T @ shift)
    return MountedCamera(camera(what, size, focal, centre, parameters, model), place), bool(np.any(shift))


def _shift(what: str, projection: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, "3"]:
    """``x_rectified = x_rectified_first + shift``: P has fx Tx and fy Ty in its last column."""
    if not projection[:, 3].any():
        return np.zeros(3)
    if not (projection[0, 0] > 0 and projection[1, 1] > 0):
        raise InputError(f"{what} is {quote(projection)}; its focal lengths must be positive")
    return np.array([projection[0, 3] / projection[0, 0], projection[1, 3] / projection[1, 1], 0.0])


def write(cameras: Mapping[str, MountedCamera], suffix: str) -> str | Mapping[str, str]:
    """The file of a single camera, or the two files of a pair, by name, with the rectification that OpenCV finds."""
    names = list(cameras)
    if len(names) == 1:
        made = cameras[names[0]].camera
        straight = np.hstack([made.opencv_matrix, np.zeros((3, 1))])
        return _text(names[0], cameras[names[0]], np.eye(3), straight)
    first, second = cameras.values()
    if (first.camera.width, first.camera.height) != (second.camera.width, second.camera.height):
        raise InputError("ROS rectifies pairs whose images have one size; convert each camera alone")
    if first.camera.lens.is_equidistant != second.camera.lens.is_equidistant:
        raise InputError("one camera has a fisheye lens and the other has none: OpenCV cannot rectify such a pair")
    rectified = _rectification(first, second)
    return {
        f"{name}.yaml": _text(name, cameras[name], turn, projection)
        for name, (turn, projection) in zip(names, rectified, strict=True)
    }


def _rectification(
    first: MountedCamera, second: MountedCamera
) -> tuple[tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 4"]], ...]:
    """R and P of both cameras."""
    between = second.cam_from_rig @ first.cam_from_rig.inverse()
    size, (turn, shift) = (first.camera.width, first.camera.height), (between.rotation.copy(), between.translation)
    if not np.any(shift):
        raise InputError("both cameras are at one place: there is no baseline to rectify")
    matrices = first.camera.opencv_matrix, second.camera.opencv_matrix
    lenses = [np.array(coefficients_of(each.camera)) for each in (first, second)]
    if first.camera.lens.is_equidistant:
        found: tuple[Any, ...] = cv2.fisheye.stereoRectify(
            matrices[0], lenses[0], matrices[1], lenses[1], size, turn, shift[:, None].copy(), cv2.CALIB_ZERO_DISPARITY
        )
    else:
        found = cv2.stereoRectify(matrices[0], lenses[0], matrices[1], lenses[1], size, turn, shift.copy(), alpha=0)
    r1, r2, p1, p2 = found[:4]
    return (r1, p1), (r2, p2)


def _text(
    name: str, mounted: MountedCamera, turn: Float[np.ndarray, "3 3"], projection: Float[np.ndarray, "3 4"]
) -> str:
    made = mounted.camera
    coefficients = coefficients_of(made)
    kind = "rational_polynomial" if len(coefficients) > 5 else "plumb_bob"
    kind = "equidistant" if made.lens.is_equidistant else kind

    def block(values: Float[np.ndarray, "r c"]) -> dict[str, Any]:
        rows, columns = values.shape
        return {"rows": rows, "cols": columns, "data": values.ravel().tolist()}

    values = {
        "image_width": made.width,
        "image_height": made.height,
        "camera_name": name,
        "camera_matrix": block(made.opencv_matrix),
        "distortion_model": kind,
        "distortion_coefficients": block(np.array([coefficients])),
        "rectification_matrix": block(turn),
        "projection_matrix": block(projection),
    }
    return yaml.safe_dump(values, default_flow_style=None, sort_keys=False)
