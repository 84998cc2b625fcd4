"""Kalibr's camera chain (YAML): models and distortions as https://github.com/ethz-asl/kalibr/wiki/supported-models has
them, pixel centres at whole numbers, metres."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.geometry.cameras import MODELS
from cuspid.model.camera import OPENCV_PIXEL_OFFSET, Camera
from cuspid.model.rig import MountedCamera
from cuspid.runtime.errors import InputError
from cuspid.runtime.values import checked_name, quote
from cuspid.storage.calibrations.documents import Document
from cuspid.storage.calibrations.fields import Calibration, Hints, camera, image_size, motion, require_mapping, vector
from cuspid.storage.calibrations.lenses import BROWN_4, FISHEYE, Lens, Loss, fit_projection

LENSES: tuple[Lens, ...] = (BROWN_4, FISHEYE)
_EXTRA = {"pinhole": 0, "omni": 1, "ds": 2, "eucm": 2}
"""Parameters of a model before fu, fv, pu, pv."""
_COEFFICIENTS = {"radtan": 4, "equidistant": 4, "fov": 1, "none": 0}
_Values = Float[np.ndarray, "k"]


def recognises(files: Mapping[str, Document]) -> bool:
    """Whether it maps cameras to intrinsics with Kalibr's names."""
    document, *others = files.values()
    entries = document.value.values() if document.kind == "values" and isinstance(document.value, Mapping) else ()
    return not others and any(isinstance(each, Mapping) and "intrinsics" in each for each in entries)


def read(files: Mapping[str, Document], hints: Hints) -> Calibration:
    """Cameras of a chain, in its order; the first is the frame of the rig. Raises InputError."""
    (document,) = files.values()
    cameras: dict[str, MountedCamera] = {}
    losses: dict[str, Loss] = {}
    place = Rigid3.identity()
    for key, value in require_mapping("a camera chain", document.value).items():
        entry = require_mapping(key, value)
        name = checked_name("camera", key)
        if cameras:
            place = motion(f"{name}: T_cn_cnm1", entry["T_cn_cnm1"]) @ place
        made, loss = _camera(name, entry)
        cameras[name] = MountedCamera(made, place)
        losses.update({} if loss is None else {name: loss})
    return Calibration(cameras=cameras, losses=losses)


def _camera(name: str, entry: Mapping[str, Any]) -> tuple[Camera, Loss | None]:
    model, distortion = entry["camera_model"], entry.get("distortion_model", "none")
    if model not in _EXTRA or distortion not in _COEFFICIENTS:
        raise InputError(
            f"{name}: camera_model {quote(model)} with distortion_model {quote(distortion)} is not known; models are "
            f"{', '.join(_EXTRA)}, distortions {', '.join(_COEFFICIENTS)}"
        )
    intrinsics = vector(f"{name}: intrinsics", entry["intrinsics"], _EXTRA[model] + 4)
    coefficients = np.zeros(0)
    if distortion != "none":
        coefficients = vector(f"{name}: distortion_coeffs", entry["distortion_coeffs"], _COEFFICIENTS[distortion])
    size = image_size(f"{name}: resolution", *vector(f"{name}: resolution", entry["resolution"], 2).tolist())
    own, focal, centre = intrinsics[:-4], intrinsics[-4:-2], intrinsics[-2:]
    exact = {"radtan": "OPENCV", "none": "OPENCV", "equidistant": "OPENCV_FISHEYE"}.get(distortion)
    if model == "pinhole" and exact is not None:
        values = np.pad(coefficients, (0, len(MODELS[exact].names) - len(coefficients)))
        return camera(name, size, focal, centre, values, exact), None
    if np.any(focal < 1):
        raise InputError(f"{name}: intrinsics are {quote(intrinsics)}; focal lengths must be at least 1 px")

    def project(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        with np.errstate(all="ignore"):
            plane = _DISTORTIONS[distortion](coefficients, _PLANES[model](own, points))
        return plane * focal + centre + OPENCV_PIXEL_OFFSET

    return fit_projection(project, size, model if distortion == "none" else f"{model} with {distortion}")


def _project_pinhole(points: Float[np.ndarray, "n 3"], depth: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 2"]:
    return points[:, :2] / np.where(depth > 1e-6, depth, np.nan)[:, None]


def _omni(own: _Values, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """C. Mei, P. Rives, ICRA 2007."""
    return _project_pinhole(points, points[:, 2] + own[0] * np.linalg.norm(points, axis=1))


def _double_sphere(own: _Values, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """V. Usenko, N. Demmel, D. Cremers, 3DV 2018, Eq. 40 to 45."""
    xi, alpha = own
    first = np.linalg.norm(points, axis=1)
    ahead = xi * first + points[:, 2]
    second = np.hypot(np.hypot(points[:, 0], points[:, 1]), ahead)
    return _project_pinhole(points, alpha * second + (1 - alpha) * ahead)


def _project_unified(own: _Values, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """B. Khomutenko, G. Garcia, P. Martinet, IEEE RA-L 1, 2016: the extended unified model."""
    alpha, beta = own
    away = np.sqrt(beta * (points[:, 0] ** 2 + points[:, 1] ** 2) + points[:, 2] ** 2)
    return _project_pinhole(points, alpha * away + (1 - alpha) * points[:, 2])


_PLANES: Mapping[str, Callable[[_Values, Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 2"]]] = {
    "pinhole": lambda own, points: _project_pinhole(points, points[:, 2]),
    "omni": _omni,
    "ds": _double_sphere,
    "eucm": _project_unified,
}


def _radial_tangential(k: _Values, plane: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    square = (plane**2).sum(axis=1, keepdims=True)
    product = plane.prod(axis=1, keepdims=True)
    sideways = 2 * product * k[2:4] + k[3:1:-1] * (square + 2 * plane**2)
    return plane * (1 + k[0] * square + k[1] * square**2) + sideways


def _equidistant(k: _Values, plane: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    radius = np.linalg.norm(plane, axis=1, keepdims=True)
    angle = np.arctan(radius)
    bent = angle * (1 + sum(each * angle ** (2 * power) for power, each in enumerate(k, start=1)))
    return plane * np.where(radius > 1e-9, bent / np.maximum(radius, 1e-9), 1.0)


def _field_of_view(k: _Values, plane: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """F. Devernay, O. Faugeras, Mach. Vision Appl. 13, 2001, Eq. 13."""
    radius = np.linalg.norm(plane, axis=1, keepdims=True)
    if k[0] == 0:
        return plane
    bent = np.arctan(2 * radius * np.tan(k[0] / 2)) / k[0]
    return plane * np.where(radius > 1e-9, bent / np.maximum(radius, 1e-9), 2 * np.tan(k[0] / 2) / k[0])


_DISTORTIONS: Mapping[str, Callable[[_Values, Float[np.ndarray, "n 2"]], Float[np.ndarray, "n 2"]]] = {
    "none": lambda k, plane: plane,
    "radtan": _radial_tangential,
    "equidistant": _equidistant,
    "fov": _field_of_view,
}


def write(cameras: Mapping[str, MountedCamera], suffix: str) -> str:
    """A chain of cam0, cam1, ... in the order of the rig; their names are in ``rostopic``."""
    chain: dict[str, Any] = {}
    before: Rigid3 | None = None
    for index, (name, mounted) in enumerate(cameras.items()):
        made = mounted.camera
        entry: dict[str, Any] = {"cam_overlaps": [other for other in range(len(cameras)) if other != index]}
        if before is not None:
            entry["T_cn_cnm1"] = (mounted.cam_from_rig @ before.inverse()).matrix.tolist()
        chain[f"cam{index}"] = entry | {
            "camera_model": "pinhole",
            "distortion_coeffs": made.distortion.tolist(),
            "distortion_model": "equidistant" if made.lens.is_equidistant else "radtan",
            "intrinsics": [*made.focal_px.tolist(), *(made.principal_point_px - OPENCV_PIXEL_OFFSET).tolist()],
            "resolution": [made.width, made.height],
            "rostopic": f"/{name}/image_raw",
        }
        before = mounted.cam_from_rig
    return yaml.safe_dump(chain, default_flow_style=None, sort_keys=False)
