"""HALCON's camera parameters (``write_cam_par``, .dat), read only, and in the same folder the pose of a second camera
in the frame of the first (``write_pose``). Metres, pixel centres at whole numbers. The lens takes distorted places on
the sensor to undistorted ones, by the division model or by a polynomial (reference manual, chapter Calibration)."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.rig import MountedCamera
from cuspid.runtime.errors import InputError
from cuspid.runtime.values import checked_name, number, quote
from cuspid.storage.calibrations.documents import Document
from cuspid.storage.calibrations.fields import Calibration, Hints, camera, image_size, vector
from cuspid.storage.calibrations.lenses import Lens, Loss, fit_projection

LENSES: tuple[Lens, ...] = ()
_FIELD = re.compile(r"^\s*([A-Za-z]\w*)\s*:\s*\w+\s*:\s*([^;:]+?)\s*;", re.MULTILINE)
_POSE = re.compile(r"^\s*([frt])\s+(.+)$", re.MULTILINE)
_POLYNOMIAL = ("Poly1", "Poly2", "Poly3", "Poly4", "Poly5")


def recognises(files: Mapping[str, Document]) -> bool:
    """Whether there are camera parameters, with at most one pose."""
    cameras = [each for each in files.values() if _is_camera(each)]
    return bool(cameras) and sum(map(_is_pose, files.values())) == len(files) - len(cameras) <= 1


def _is_camera(document: Document) -> bool:
    return document.kind == "text" and "ParGroup: Camera: Parameter" in document.value


def _is_pose(document: Document) -> bool:
    return document.kind == "text" and {found[0] for found in _POSE.findall(document.value)} == {"f", "r", "t"}


def read(files: Mapping[str, Document], hints: Hints) -> Calibration:
    """One camera, or two in the order of their names and the pose of the second. Raises InputError."""
    poses = [_pose(each.value) for each in files.values() if _is_pose(each)]
    found = {name: _camera(checked_name("file", name), each.value) for name, each in files.items() if _is_camera(each)}
    if len(found) != len(poses) + 1:
        raise InputError(f"{len(found)} cameras and {len(poses)} poses: give one camera, or two and a pose")
    places = [Rigid3.identity(), *(first_from_second.inverse() for first_from_second in poses)]
    return Calibration(
        cameras={name: MountedCamera(found[name][0], place) for name, place in zip(found, places, strict=True)},
        losses={name: loss for name, (_, loss) in found.items() if loss is not None},
    )


def _pose(text: str) -> Rigid3:
    """HALCON's usual pose, type 0: turned by R_x(a) R_y(b) R_z(c), degrees."""
    fields = dict(_POSE.findall(text))
    if fields["f"].strip() != "0":
        raise InputError(f"its pose has the type {quote(fields['f'])}; convert it to type 0 (convert_pose_type)")
    angles, shift = (vector("pose", [float(word) for word in fields[each].split()], 3) for each in ("r", "t"))
    return Rigid3(Rotation.from_euler("XYZ", angles, degrees=True).as_matrix(), shift)


def _camera(what: str, text: str) -> tuple[Camera, Loss | None]:
    fields = {name: float(value) for name, value in _FIELD.findall(text) if name != "ParGroup"}
    size = image_size(what, fields["ImageWidth"], fields["ImageHeight"])
    focus, sx, sy = (number(f"{what}: {each}", fields[each], 1e-9, 1e3) for each in ("Focus", "Sx", "Sy"))
    focal, centre = np.array([focus / sx, focus / sy]), np.array([fields["Cx"], fields["Cy"]])
    pinhole = camera(what, size, focal, centre, [0.0] * 4, "OPENCV")
    if "Kappa" not in fields and not all(each in fields for each in _POLYNOMIAL):
        raise InputError(f"{what}: it has neither Kappa nor {', '.join(_POLYNOMIAL)}; only area scan cameras are read")
    if not any(fields.get(each, 0.0) for each in ("Kappa", *_POLYNOMIAL)):
        return pinhole, None
    if "Kappa" in fields:
        kappa = number(f"{what}: Kappa", fields["Kappa"], -1e12, 1e12) * focus**2
        return fit_projection(lambda points: _distort_division(kappa, pinhole, points), size, "the division model")
    k1, k2, k3, p1, p2 = (fields[each] for each in _POLYNOMIAL)
    values = [k1 * focus**2, k2 * focus**4, p2 * focus, p1 * focus, k3 * focus**6, 0.0, 0.0, 0.0]
    inverse = camera(what, size, focal, centre, values, "FULL_OPENCV")
    return fit_projection(lambda points: _invert_division(inverse, points), size, "the polynomial model")


def _plane(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    return points[:, :2] / np.where(points[:, 2:] > 1e-6, points[:, 2:], np.nan)


def _pixels(pinhole: Camera, plane: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    return plane * pinhole.focal_px + pinhole.principal_point_px


def _distort_division(kappa: float, pinhole: Camera, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Of d with u = d / (1 + kappa d^2) in units of the focal length."""
    plane = _plane(points)
    root = 1 - 4 * kappa * (plane**2).sum(axis=1, keepdims=True)
    return _pixels(pinhole, 2 * plane / (1 + np.sqrt(np.where(root >= 0, root, np.nan))))


def _invert_division(inverse: Camera, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """With a lens that takes distorted places to undistorted ones as one of OpenCV's takes them the other way."""
    plane = _plane(points)
    seen = np.isfinite(plane).all(axis=1)
    bent = np.full(plane.shape, np.nan)
    bent[seen] = inverse.rays(_pixels(inverse, plane[seen]))[:, :2]
    return _pixels(inverse, bent)
