"""Handpieces, and rigs as COLMAP writes them."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cuspid.body import Body, Box
from cuspid.camera import Camera
from cuspid.errors import InputError
from cuspid.geometry import Rigid3
from cuspid.pairing import guess_working_distance_mm
from cuspid.rig import Handpiece, Light, Lighting, MountedCamera, Rig, Sensor, depth_of_field_mm
from cuspid.storage.files import digest_of, read_json, reading, write_json

_log = logging.getLogger("cuspid")
_SET_BY = "a handpiece.json or, where the verb has it, --working-distance-mm"


def rigid_to_json(target_from_source: Rigid3) -> dict[str, Any]:
    """A rigid motion as quaternion and translation in mm."""
    return {
        "rotation_wxyz": target_from_source.quaternion.tolist(),
        "translation_mm": target_from_source.translation.tolist(),
    }


def rigid_from_json(value: Mapping[str, Any]) -> Rigid3:
    """Inverse of :func:`rigid_to_json`."""
    return Rigid3.from_quaternion(
        np.array(value["rotation_wxyz"], dtype=np.float64),
        np.array(value["translation_mm"], dtype=np.float64),
    )


def covariance_from_json(value: Any) -> np.ndarray | None:
    """A covariance matrix, or None."""
    return None if value is None else np.array(value, dtype=np.float64)


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """Intrinsic calibration of a camera."""
    return {
        "width_px": camera.width,
        "height_px": camera.height,
        "focal_px": camera.focal_px,
        "principal_point_px": camera.principal_point_px,
        "distortion_k1_k2_p1_p2": camera.distortion,
        "covariance_fx_fy_cx_cy_k1_k2_p1_p2": camera.covariance,
    }


def camera_from_json(value: Mapping[str, Any]) -> Camera:
    """Inverse of :func:`camera_to_json`."""
    return Camera(
        width=int(value["width_px"]),
        height=int(value["height_px"]),
        focal_px=np.array(value["focal_px"], dtype=np.float64),
        principal_point_px=np.array(value["principal_point_px"], dtype=np.float64),
        distortion=np.array(value.get("distortion_k1_k2_p1_p2", np.zeros(4)), dtype=np.float64),
        covariance=covariance_from_json(value.get("covariance_fx_fy_cx_cy_k1_k2_p1_p2")),
    )


def handpiece_to_json(handpiece: Handpiece) -> dict[str, Any]:
    """All of a handpiece (docs/formats.md)."""
    known = {} if handpiece.body is None else {"body": _body_to_json(handpiece.body)}
    return {**_optics_to_json(handpiece), **known}


def _optics_to_json(handpiece: Handpiece) -> dict[str, Any]:
    """What takes images and gives light, which is all that images depend on."""
    cameras = {
        name: {
            **camera_to_json(mounted.camera),
            "cam_from_rig": rigid_to_json(mounted.cam_from_rig),
            "covariance_rotation_rad_translation_mm": mounted.covariance,
        }
        for name, mounted in handpiece.rig.cameras.items()
    }
    return {
        "name": handpiece.name,
        "working_distance_mm": handpiece.working_distance_mm,
        "depth_range_mm": handpiece.depth_range_mm,
        "cameras": cameras,
        "lights": handpiece.lights,
        "lightings": handpiece.lightings,
        "sensor": handpiece.sensor,
    }


def _body_to_json(body: Body) -> dict[str, Any]:
    return {
        name: {"box_from_rig": rigid_to_json(box.box_from_rig), "size_mm": 2 * box.half_mm}
        for name, box in body.parts.items()
    }


_FIELDS = {"name", "working_distance_mm", "depth_range_mm", "cameras", "lights", "lightings", "sensor", "body"}
"""Of ``handpiece.json``."""
_BOX_FIELDS = {"box_from_rig", "size_mm"}


def write_handpiece(path: Path, handpiece: Handpiece) -> None:
    """Write ``handpiece.json``."""
    write_json(path, handpiece_to_json(handpiece))


def _light_from_json(value: Mapping[str, Any]) -> Light:
    arrays = {key: np.array(value[key], dtype=np.float64) for key in ("position_mm", "direction", "colour")}
    return Light(**{**value, **arrays})


def read_handpiece(path: Path, working_distance_mm: float | None = None) -> Handpiece:
    """Read ``handpiece.json``, or COLMAP's ``rig_config.json``, which has no working distance: that is the one given
    here, or else guessed, and said. Its frame is then on the surface, as :meth:`cuspid.rig.Rig.over_surface` has it.

    Raises InputError that names a missing or unusable field, where nothing can be guessed, and where a file that has a
    working distance is given another.
    """
    value = read_json(path)
    if isinstance(value, list):
        return _of_rig(path, read_rig_config(path), working_distance_mm)
    if working_distance_mm is not None:
        raise InputError(f"{path}: it has a working distance of its own; change it there, and give none here")
    with reading(path):
        strange = sorted(set(value) - _FIELDS)
        if strange:
            raise InputError(f"{path}: the field {strange[0]!r} is not known; it has {', '.join(sorted(_FIELDS))}")
        cameras = {
            name: MountedCamera(
                camera_from_json(camera),
                rigid_from_json(camera["cam_from_rig"]),
                covariance_from_json(camera.get("covariance_rotation_rad_translation_mm")),
            )
            for name, camera in value["cameras"].items()
        }
        near, far = value["depth_range_mm"]
        return Handpiece(
            rig=Rig(cameras),
            lights={name: _light_from_json(light) for name, light in value.get("lights", {}).items()},
            lightings=tuple(
                Lighting(name=each["name"], lights=tuple(each["lights"])) for each in value.get("lightings", [])
            ),
            sensor=Sensor(**value.get("sensor", {})),
            working_distance_mm=float(value["working_distance_mm"]),
            depth_range_mm=(float(near), float(far)),
            body=None if value.get("body") is None else _body_from_json(path, value["body"]),
            name=str(value.get("name", path.stem)),
        )


def _body_from_json(path: Path, value: Any) -> Body:
    if not (isinstance(value, dict) and value):
        raise InputError(f"{path}: body must be boxes by name, one at least; leave it out where it is not known")
    return Body({name: _box_from_json(f"{path}: body, {name}", box) for name, box in value.items()})


def _box_from_json(where: str, value: Any) -> Box:
    if not (isinstance(value, dict) and set(value) == _BOX_FIELDS):
        raise InputError(f"{where}: a box has the fields {' and '.join(sorted(_BOX_FIELDS))}, no more and no less")
    pose = value["box_from_rig"]
    if not (isinstance(pose, dict) and set(pose) == {"rotation_wxyz", "translation_mm"}):
        raise InputError(f"{where}: box_from_rig has the fields rotation_wxyz and translation_mm")
    rotation, translation, size = pose["rotation_wxyz"], pose["translation_mm"], value["size_mm"]
    if not (_are_numbers(rotation, 4) and any(rotation)):
        raise InputError(f"{where}: rotation_wxyz is {rotation}; it must be four numbers that are not all 0")
    if not _are_numbers(translation, 3):
        raise InputError(f"{where}: translation_mm is {translation}; it must be three numbers")
    if not (_are_numbers(size, 3) and min(size) > 0):
        raise InputError(f"{where}: size_mm is {size}; it must be three positive lengths")
    return Box(rigid_from_json(pose), np.array(size, dtype=np.float64) / 2)


def _are_numbers(value: Any, count: int) -> bool:
    """Whether it is a list of so many finite numbers."""
    numbers = isinstance(value, list) and all(type(each) in (int, float) for each in value)
    return numbers and len(value) == count and bool(np.isfinite(value).all())


def _of_rig(path: Path, rig: Rig, working_distance_mm: float | None) -> Handpiece:
    distance_mm = _guessed_mm(path, rig) if working_distance_mm is None else working_distance_mm
    return Handpiece(
        rig=rig.over_surface(distance_mm),
        working_distance_mm=distance_mm,
        depth_range_mm=depth_of_field_mm(distance_mm),
        name=path.stem,
    )


def _guessed_mm(path: Path, rig: Rig) -> float:
    try:
        distance_mm, source = guess_working_distance_mm(rig)
    except InputError as error:
        raise InputError(f"{path}: {error}; give {_SET_BY}") from error
    near_mm, far_mm = depth_of_field_mm(distance_mm)
    _log.info(
        f"{path}: it has no working distance; {distance_mm:.3g} mm are guessed from {source}. Depths of "
        f"{near_mm:.3g} to {far_mm:.3g} mm are kept; {_SET_BY} sets others"
    )
    return distance_mm


def hash_handpiece(handpiece: Handpiece) -> str:
    """SHA-256 of all of a handpiece that a reconstruction depends on: not of its body."""
    return digest_of(_optics_to_json(handpiece))


def write_rig_config(path: Path, rig: Rig) -> None:
    """Write COLMAP's ``rig_config.json``; the reference sensor is the first camera."""
    rebased, _ = rig.rebased()
    cameras: list[dict[str, Any]] = []
    for index, (name, mounted) in enumerate(rebased.cameras.items()):
        entry: dict[str, Any] = {
            "image_prefix": f"{name}/",
            "camera_model_name": "OPENCV",
            "camera_params": mounted.camera.parameters,
            "camera_size": [mounted.camera.width, mounted.camera.height],
        }
        if index == 0:
            entry["ref_sensor"] = True
        else:
            entry["cam_from_rig_rotation"] = mounted.cam_from_rig.quaternion
            entry["cam_from_rig_translation"] = mounted.cam_from_rig.translation
        cameras.append(entry)
    write_json(path, [{"cameras": cameras}])


def read_rig_config(path: Path, image_size_px: tuple[int, int] | None = None) -> Rig:
    """Read COLMAP's ``rig_config.json`` (one rig, calibrated cameras of a PINHOLE or OPENCV family).

    The format has no image size: it is taken from cuspid's own extra field ``camera_size``, else from the argument,
    else twice the principal point.
    """
    value = read_json(path)
    with reading(path):
        if len(value) != 1:
            raise InputError(f"{path}: {len(value)} rigs; cuspid works with one")
        cameras: dict[str, MountedCamera] = {}
        for entry in value[0]["cameras"]:
            name = str(entry["image_prefix"]).strip("/")
            cam_from_rig = (
                Rigid3.identity()
                if entry.get("ref_sensor")
                else Rigid3.from_quaternion(
                    np.array(entry["cam_from_rig_rotation"], dtype=np.float64),
                    np.array(entry["cam_from_rig_translation"], dtype=np.float64),
                )
            )
            cameras[name] = MountedCamera(camera_from_colmap(entry, image_size_px), cam_from_rig)
        return Rig(cameras)


_COLMAP_PARAMETERS: Mapping[str, Sequence[int]] = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3),
    "RADIAL": (0, 0, 1, 2, 3, 4),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
}
"""Where (fx, fy, cx, cy, k1, k2, p1, p2) stand among a COLMAP model's parameters."""


def camera_from_colmap(entry: Mapping[str, Any], image_size_px: tuple[int, int] | None) -> Camera:
    model = entry["camera_model_name"]
    if model not in _COLMAP_PARAMETERS:
        raise InputError(f"camera model {model} is not known here; use one of {', '.join(_COLMAP_PARAMETERS)}")
    given = np.array(entry["camera_params"], dtype=np.float64)
    parameters = np.zeros(8)
    chosen = given[list(_COLMAP_PARAMETERS[model])]
    parameters[: len(chosen)] = chosen
    width, height = entry.get("camera_size") or image_size_px or np.rint(2 * parameters[2:4]).astype(int)
    return Camera(
        width=int(width),
        height=int(height),
        focal_px=parameters[:2],
        principal_point_px=parameters[2:4],
        distortion=parameters[4:],
    )
