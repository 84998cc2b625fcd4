"""OpenCV's calibrations as its FileStorage keeps them in YAML, JSON or XML: of one camera, of a stereo pair (with the
names of its sample ``stereo_calib``, and others in use), and of several cameras."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any
from xml.etree.ElementTree import Element

import cv2
import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.model.camera import OPENCV_PIXEL_OFFSET, Camera
from cuspid.model.rig import MountedCamera
from cuspid.runtime.errors import InputError
from cuspid.runtime.values import checked_name
from cuspid.storage.calibrations.documents import Document
from cuspid.storage.calibrations.fields import (
    Calibration,
    Hints,
    assumed_size,
    brown,
    calibration_matrix,
    camera,
    image_size,
    pose,
    require_list,
    require_mapping,
    vector,
)
from cuspid.storage.calibrations.lenses import FISHEYE, RATIONAL, Lens, Loss, fit_projection

LENSES: tuple[Lens, ...] = (RATIONAL, FISHEYE)
_MEANINGS = {
    "matrix": ("m", "k", "mtx", "cameramatrix", "intrinsic", "intrinsics", "intrinsicmatrix"),
    "distortion": (
        *("d", "dist", "distcoeffs", "distcoeff", "distcoefs", "distortion", "distortioncoefficients"),
        *("distortioncoeffs", "distcoefficients", "distortioncoeffiecients"),
    ),
    "width": ("imagewidth", "width"),
    "height": ("imageheight", "height"),
    "size": ("imagesize", "size", "resolution"),
    "fisheye": ("fisheyemodel", "fisheye", "isfisheye"),
    "name": ("cameraname",),
}
_OF_PAIR = {"rotation": ("r", "rotation", "rotationmatrix", "rot"), "shift": ("t", "translation", "trans", "tvec")}
_SIDES = {"1": 0, "2": 1, "0": 0, "left": 0, "right": 1, "l": 0, "r": 1}
_SIDE = r"(left|right|l|r|[012])"
_COUNTS = (0, 1, 4, 5, 8, 12, 14)
"""Of coefficients; a single one is that of an empty matrix."""


def recognises(files: Mapping[str, Document]) -> bool:
    """Whether there is a camera matrix under one of the names in use."""
    try:
        values = _merge_files(files)
    except InputError:
        return False
    return bool("matrix" in _single(values) or any("matrix" in each for each in _sides(values)) or _several(values))


def read(files: Mapping[str, Document], hints: Hints) -> Calibration:
    """Cameras of OpenCV's files, of a pair also where intrinsics and extrinsics are in two. Raises InputError."""
    values = _merge_files(files)
    notes: list[str] = []
    losses: dict[str, Loss] = {}

    def camera_of(name: str, found: Mapping[str, Any]) -> Camera:
        made, loss, note = _camera(f"camera {name}", found, hints)
        notes.extend([note] if note and note not in notes else [])
        losses.update({} if loss is None else {name: loss})
        return made

    if _several(values):
        cameras = {}
        for each in require_list("cameras", values["cameras"]):
            entry = require_mapping("a camera", each)
            name = checked_name("name", entry["name"])
            placed = pose(f"camera {name}: R and T", entry["R"], entry["T"])
            cameras[name] = MountedCamera(camera_of(name, _single(entry)), placed)
    elif all("matrix" in each for each in _sides(values)):
        sides = _sides(values)
        shared = {key: value for key, value in _single(values).items() if key in ("width", "height", "size", "fisheye")}
        first, second = (_name(side, usual) for side, usual in zip(sides, ("left", "right"), strict=True))
        if first == second:
            raise InputError(f"both of its cameras are named {first}")
        between = _find_fields(values, _OF_PAIR)
        if len(between) < 2:
            raise InputError("it has two cameras but no R and T between them; give both files in one folder")
        second_from_first = pose("R and T", between["rotation"], between["shift"])
        cameras = {
            first: MountedCamera(camera_of(first, shared | sides[0]), Rigid3.identity()),
            second: MountedCamera(camera_of(second, shared | sides[1]), second_from_first),
        }
    else:
        name = _name(_single(values), "camera")
        cameras = {name: MountedCamera(camera_of(name, _single(values)), Rigid3.identity())}
    return Calibration(cameras=cameras, losses=losses, notes=tuple(notes))


def _name(found: Mapping[str, Any], default: str) -> str:
    return checked_name("camera_name", found.get("name", default))


def _merge_files(files: Mapping[str, Document]) -> Mapping[str, Any]:
    merged: dict[str, Any] = {}
    for document in files.values():
        values = _of_xml(document.value) if document.kind == "xml" else document.value
        merged.update(require_mapping("an OpenCV calibration", values))
    return merged


def _of_xml(element: Element) -> Any:
    """The value of an element of OpenCV's XML."""
    inner = list(element)
    if inner and all(each.tag == "_" for each in inner):
        return [_of_xml(each) for each in inner]
    if inner:
        return {each.tag: _of_xml(each) for each in inner}
    words = (element.text or "").split()
    try:
        found = [float(word) for word in words]
    except ValueError:
        return (element.text or "").strip().strip('"')
    return found[0] if len(found) == 1 and element.tag not in ("data", "image_size") else found


def _plain(key: str) -> str:
    return re.sub(r"[^a-z0-9]", "", key.lower())


def _find_fields(values: Mapping[str, Any], meanings: Mapping[str, tuple[str, ...]]) -> dict[str, Any]:
    return {
        meaning: value
        for key, value in values.items()
        for meaning, names in meanings.items()
        if isinstance(key, str) and _plain(key) in names and value is not None
    }


def _single(values: Mapping[str, Any]) -> dict[str, Any]:
    return _find_fields(values, _MEANINGS)


def _sides(values: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """What is told of each camera of a pair. Where sides count from 0, 1 is the second."""
    pattern = re.compile(rf"^(?:{_SIDE}(?P<a>[a-z]+)|(?P<b>[a-z]+?){_SIDE})$")
    matrices = {key: value for key, value in values.items() if isinstance(value, list | Mapping | str)}
    hits = [(found, value) for key, value in matrices.items() if (found := pattern.match(_plain(str(key))))]
    from_zero = any("0" in (found[1], found[4]) for found, _ in hits)
    sides: tuple[dict[str, Any], dict[str, Any]] = ({}, {})
    for found, value in hits:
        side = found[1] or found[4]
        index = 1 if from_zero and side == "1" else _SIDES[side]
        sides[index].update(_find_fields({found["a"] or found["b"]: value}, _MEANINGS))
    return sides


def _several(values: Mapping[str, Any]) -> bool:
    cameras = values.get("cameras")
    return isinstance(cameras, list) and all(isinstance(each, Mapping) and "R" in each for each in cameras)


def _camera(what: str, found: Mapping[str, Any], hints: Hints) -> tuple[Camera, Loss | None, str | None]:
    focal, centre = calibration_matrix(f"{what}: camera matrix", found["matrix"])
    note = None
    if "size" in found:
        size = image_size(what, *vector(f"{what}: image size", found["size"], 2).tolist())
    elif "width" in found and "height" in found:
        size = image_size(what, found["width"], found["height"])
    else:
        size, note = assumed_size([each + OPENCV_PIXEL_OFFSET for each in centre], hints)
    given = vector(f"{what}: distortion", found["distortion"], most=1e6) if "distortion" in found else np.zeros(0)
    if found.get("fisheye"):
        if len(given) not in (0, 4):
            raise InputError(f"{what}: {len(given)} distortion coefficients; a fisheye lens has 4")
        return camera(what, size, focal, centre, given.tolist() or [0.0] * 4, "OPENCV_FISHEYE"), None, note
    if len(given) not in _COUNTS:
        raise InputError(f"{what}: {len(given)} distortion coefficients; OpenCV has 4, 5, 8, 12 or 14")
    if np.any(given[8:]):
        model, parameters = brown(given[:8])
        plain = camera(what, size, focal, centre, parameters, model)
        made, loss = fit_projection(lambda points: _prism(plain, given, points), size, f"{len(given)} coefficients")
        return made, loss, note
    model, parameters = brown(given[:8])
    return camera(what, size, focal, centre, parameters, model), None, note


def _prism(
    plain: Camera, coefficients: Float[np.ndarray, "k"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 2"]:
    """Projection with thin prisms and a tilted sensor."""
    ahead = np.where(points[:, 2:] > 0.05, points, np.nan)
    safe = np.where(np.isfinite(ahead), ahead, [0.0, 0.0, 1.0])
    found, _ = cv2.projectPoints(safe, np.zeros(3), np.zeros(3), plain.opencv_matrix, coefficients)
    return np.where(np.isfinite(ahead[:, :2]), found.reshape(-1, 2) + OPENCV_PIXEL_OFFSET, np.nan)


def coefficients_of(made: Camera) -> list[float]:
    """k1 k2 p1 p2 and, where they are not zero, k3 and k4 to k6 (at least five, as OpenCV's programs write them), or
    the four of a fisheye lens."""
    values = made.distortion.tolist()
    if made.lens.is_equidistant:
        return values
    values = values + [0.0] * (8 - len(values))
    return values if any(values[5:]) else values[:5]


def write(cameras: Mapping[str, MountedCamera], suffix: str) -> str:
    """As OpenCV's samples write a camera or a pair (x_right = R x_left + T); or as a list of cameras with R and T from
    the frame of the rig."""
    file = cv2.FileStorage(suffix or ".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    mounted = list(cameras.values())
    sizes = {(each.camera.width, each.camera.height) for each in mounted}
    kinds = {each.camera.lens.is_equidistant for each in mounted}
    if len(mounted) == 1:
        file.write("camera_name", next(iter(cameras)))
        _write_camera(file, mounted[0].camera, "camera_matrix", "distortion_coefficients")
    elif len(mounted) == 2 and len(sizes) == 1 and len(kinds) == 1:
        for index, name in enumerate(cameras, start=1):
            file.write(f"camera_name{index}", name)
        _write_camera(file, mounted[0].camera, "M1", "D1")
        second_from_first = mounted[1].cam_from_rig @ mounted[0].cam_from_rig.inverse()
        file.write("M2", mounted[1].camera.opencv_matrix)
        file.write("D2", np.array([coefficients_of(mounted[1].camera)]))
        _write_pose(file, second_from_first)
    else:
        file.startWriteStruct("cameras", cv2.FileNode_SEQ)
        for name, each in cameras.items():
            file.startWriteStruct("", cv2.FileNode_MAP)
            file.write("name", name)
            _write_camera(file, each.camera, "camera_matrix", "distortion_coefficients")
            _write_pose(file, each.cam_from_rig)
            file.endWriteStruct()
        file.endWriteStruct()
    return str(file.releaseAndGetString())


def _write_camera(file: cv2.FileStorage, made: Camera, matrix_name: str, distortion_name: str) -> None:
    file.write("image_width", made.width)
    file.write("image_height", made.height)
    if made.lens.is_equidistant:
        file.write("fisheye_model", 1)
    file.write(matrix_name, made.opencv_matrix)
    file.write(distortion_name, np.array([coefficients_of(made)]))


def _write_pose(file: cv2.FileStorage, target_from_source: Rigid3) -> None:
    file.write("R", np.array(target_from_source.rotation))
    file.write("T", target_from_source.translation[:, None].copy())
