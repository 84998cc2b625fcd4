"""Handpieces, and rigs as COLMAP writes them."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.geometry.cameras import MODELS
from cuspid.model.body import Body, Box
from cuspid.model.camera import Camera
from cuspid.model.pairing import guess_working_distance_mm
from cuspid.model.rig import Handpiece, Light, Lighting, MountedCamera, Rig, Sensor, depth_of_field_mm
from cuspid.model.shutter import Shutter
from cuspid.runtime.errors import InputError
from cuspid.runtime.values import (
    LONGEST_MM,
    MOST_PX,
    checked_name,
    covariance,
    number,
    numbers,
    quote,
    title,
    whole,
)
from cuspid.storage.files import digest_of, read_json, reading, write_json

_MOST_DISTORTION = 1e3
_BRIGHTEST, _NARROWEST_LOBE = 1e6, 1e4
_SHORTEST_QUATERNION = 1e-6
_ROUNDED = 1e-9
"""Of a correlation; a covariance whose eigenvalues are less negative is read as it is."""
_log = logging.getLogger("cuspid")
_SET_BY = "a handpiece.json or, where the command has it, --working-distance-mm"


def rigid_to_json(target_from_source: Rigid3) -> dict[str, Any]:
    """A rigid motion as quaternion and translation in mm."""
    return {
        "rotation_wxyz": target_from_source.quaternion.tolist(),
        "translation_mm": target_from_source.translation.tolist(),
    }


def rigid_from_json(value: Mapping[str, Any], what: str = "pose") -> Rigid3:
    """Inverse of :func:`rigid_to_json`. Raises InputError for what is no rigid motion."""
    quaternion = numbers(f"{what}: rotation_wxyz", value["rotation_wxyz"], (4,), -LONGEST_MM, LONGEST_MM)
    if not np.linalg.norm(quaternion) > _SHORTEST_QUATERNION:
        raise InputError(f"{what}: rotation_wxyz is {quote(value['rotation_wxyz'])}; it must not be all zeros")
    translation = numbers(f"{what}: translation_mm", value["translation_mm"], (3,), -LONGEST_MM, LONGEST_MM)
    return Rigid3.from_quaternion(quaternion, translation)


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """Intrinsic calibration of a camera; a model that is not OPENCV is named, with its parameters in COLMAP's order."""
    if camera.model != "OPENCV":
        return {
            "width_px": camera.width,
            "height_px": camera.height,
            "model": camera.model,
            "params": camera.parameters,
            "covariance_of_params": _symmetric(camera.covariance),
        }
    return {
        "width_px": camera.width,
        "height_px": camera.height,
        "focal_px": camera.focal_px,
        "principal_point_px": camera.principal_point_px,
        "distortion_k1_k2_p1_p2": camera.distortion,
        "covariance_fx_fy_cx_cy_k1_k2_p1_p2": _symmetric(camera.covariance),
    }


def camera_from_json(value: Mapping[str, Any], what: str = "camera") -> Camera:
    """Inverse of :func:`camera_to_json`. Raises InputError for what no camera can have."""
    width, height = (whole(f"{what}: {side}_px", value[f"{side}_px"], 1, MOST_PX) for side in ("width", "height"))
    if "model" in value:
        return _camera_of_model(value, width, height, what)
    matrix = value.get("covariance_fx_fy_cx_cy_k1_k2_p1_p2")
    return Camera(
        width=width,
        height=height,
        focal_px=numbers(f"{what}: focal_px", value["focal_px"], (2,), 1.0, 100.0 * MOST_PX),
        principal_point_px=numbers(
            f"{what}: principal_point_px", value["principal_point_px"], (2,), -2.0 * MOST_PX, 2.0 * MOST_PX
        ),
        distortion=numbers(
            f"{what}: distortion_k1_k2_p1_p2",
            value.get("distortion_k1_k2_p1_p2", [0, 0, 0, 0]),
            (4,),
            -_MOST_DISTORTION,
            _MOST_DISTORTION,
        ),
        covariance=None if matrix is None else covariance(f"{what}: covariance_fx_fy_cx_cy_k1_k2_p1_p2", matrix, 8),
    )


def _camera_of_model(value: Mapping[str, Any], width: int, height: int, what: str) -> Camera:
    """A camera whose model is named."""
    name = value["model"]
    if name not in MODELS:
        raise InputError(f"{what}: model {quote(name)} is not supported; use one of {', '.join(MODELS)}")
    also = [key for key in ("focal_px", "principal_point_px", "distortion_k1_k2_p1_p2") if key in value]
    if also:
        raise InputError(f"{what}: it has both model and {also[0]}; give the parameters of {name} in params alone")
    names = ("fx", "fy", "cx", "cy", *MODELS[name].names)
    given = np.array(value["params"], dtype=np.float64).ravel()
    if len(given) != len(names):
        raise InputError(
            f"{what}: params has {len(given)} numbers; those of the model {name} are {len(names)}: fx, fy, cx, cy, "
            f"{MODELS[name].said}"
        )
    limits = np.array([100.0 * MOST_PX] * 2 + [2.0 * MOST_PX] * 2 + [_MOST_DISTORTION] * (len(names) - 4))
    for value_of, each, limit in zip(given.tolist(), names, limits.tolist(), strict=True):
        numbers(f"{what}: {each} of params", [value_of], (1,), 1.0 if each in ("fx", "fy") else -limit, limit)
    matrix = value.get("covariance_of_params")
    return Camera(
        width=width,
        height=height,
        focal_px=given[:2],
        principal_point_px=given[2:4],
        distortion=given[4:],
        covariance=None if matrix is None else covariance(f"{what}: covariance_of_params", matrix, len(names)),
        model=name,
    )


def _symmetric(covariance: Float[np.ndarray, "n n"] | None) -> Float[np.ndarray, "n n"] | None:
    """A covariance as readers take it: symmetric, and without a negative eigenvalue, however it was rounded."""
    if covariance is None:
        return None
    even = (covariance + covariance.T) / 2
    scale = np.sqrt(np.maximum(np.diag(even), 0))
    scale = np.where(scale > 0, scale, 1)
    values, axes = np.linalg.eigh(even / np.outer(scale, scale))
    if values[0] > -_ROUNDED:
        return even
    clean = (axes * np.maximum(values, 0)) @ axes.T * np.outer(scale, scale)
    return (clean + clean.T) / 2


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
            "covariance_rotation_rad_translation_mm": _symmetric(mounted.covariance),
            **{name: value for name, value in asdict(mounted.shutter).items() if value},
        }
        for name, mounted in handpiece.rig.cameras.items()
    }
    sensors = {name: _sensor_to_json(sensor) for name, sensor in handpiece.sensors.items()}
    return {
        "name": handpiece.name,
        "working_distance_mm": handpiece.working_distance_mm,
        "depth_range_mm": handpiece.depth_range_mm,
        "cameras": cameras,
        "lights": {name: _light_to_json(light) for name, light in handpiece.lights.items()},
        "lightings": handpiece.lightings,
        "sensor": _sensor_to_json(handpiece.sensor),
        **({"sensors": sensors} if sensors else {}),
    }


_LIGHT_COVARIANCE, _SENSOR_COVARIANCE = "covariance_position_mm_log_power", "covariance_log_gain_a_b_log_gamma"


def _light_to_json(light: Light) -> dict[str, Any]:
    plain = {name: getattr(light, name) for name in _LIGHT_FIELDS}
    if light.glare == 1:
        del plain["glare"]
    return plain if light.covariance is None else {**plain, _LIGHT_COVARIANCE: _symmetric(light.covariance)}


def _sensor_to_json(sensor: Sensor) -> dict[str, Any]:
    """What most sensors do not have is left out where there is none."""
    value: dict[str, Any] = {name: getattr(sensor, name) for name in _SENSOR_RANGES}
    if sensor.gain == 1:
        del value["gain"]
    if any(sensor.falloff):
        value["falloff_r2_r4"] = sensor.falloff
    if sensor.covariance is not None:
        value[_SENSOR_COVARIANCE] = _symmetric(sensor.covariance)
    return value


def _body_to_json(body: Body) -> dict[str, Any]:
    return {
        name: {"box_from_rig": rigid_to_json(box.box_from_rig), "size_mm": 2 * box.half_mm}
        for name, box in body.parts.items()
    }


_FIELDS = {
    "name", "working_distance_mm", "depth_range_mm", "cameras", "lights", "lightings", "sensor", "sensors", "body",
}  # fmt: skip
"""Of ``handpiece.json``."""
_SHORTEST_DIRECTION = 1e-6
"""Far above where the square of a number is taken for zero."""
_LIGHT_FIELDS = ("position_mm", "direction", "power", "colour", "lobe_exponent", "glare")
_SENSOR_RANGES = {"noise_dn": (0.0, 255.0), "shot_noise_share": (0.0, 1.0), "gamma": (0.1, 10.0), "gain": (1e-3, 1e3)}
_STEEPEST_FALLOFF = 10.0
_SHUTTER_RANGES = {
    "delay_frames": (-100.0, 100.0),
    "delay_sigma_frames": (0.0, 100.0),
    "readout": (-10.0, 10.0),
    "readout_sigma": (0.0, 10.0),
}
_BOX_FIELDS = {"box_from_rig", "size_mm"}


def write_handpiece(path: Path | str, handpiece: Handpiece) -> None:
    """Write ``handpiece.json``."""
    write_json(Path(path), handpiece_to_json(handpiece))


def _light_from_json(value: Mapping[str, Any], what: str) -> Light:
    strange = sorted(set(value) - {*_LIGHT_FIELDS, _LIGHT_COVARIANCE})
    if strange:
        raise InputError(f"{what}: unknown field {quote(strange[0])}; see docs/formats.md")
    direction = numbers(f"{what}: direction", value["direction"], (3,), -LONGEST_MM, LONGEST_MM)
    if not np.linalg.norm(direction) > _SHORTEST_DIRECTION:
        raise InputError(f"{what}: direction is {quote(value['direction'])}; its length must exceed 1e-6")
    matrix = value.get(_LIGHT_COVARIANCE)
    return Light(
        position_mm=numbers(f"{what}: position_mm", value["position_mm"], (3,), -LONGEST_MM, LONGEST_MM),
        direction=direction,
        power=number(f"{what}: power", value.get("power", 1.0), 0.0, _BRIGHTEST),
        colour=numbers(f"{what}: colour", value["colour"], (3,), 0.0, _BRIGHTEST),
        lobe_exponent=number(f"{what}: lobe_exponent", value.get("lobe_exponent", 1.0), 0.0, _NARROWEST_LOBE),
        glare=number(f"{what}: glare", value.get("glare", 1.0), 0.0, 1.0),
        covariance=None if matrix is None else covariance(f"{what}: {_LIGHT_COVARIANCE}", matrix, 4),
    )


def _sensor_from_json(value: Mapping[str, Any], what: str) -> Sensor:
    known = [*_SENSOR_RANGES, "falloff_r2_r4", _SENSOR_COVARIANCE]
    strange = sorted(set(value) - set(known))
    if strange:
        raise InputError(f"{what}: unknown field {quote(strange[0])}; choose from {', '.join(known)}")
    plain = {key: number(f"{what}: {key}", value[key], *_SENSOR_RANGES[key]) for key in _SENSOR_RANGES if key in value}
    falloff = value.get("falloff_r2_r4", (0.0, 0.0))
    a, b = numbers(f"{what}: falloff_r2_r4", falloff, (2,), -_STEEPEST_FALLOFF, _STEEPEST_FALLOFF).tolist()
    matrix = value.get(_SENSOR_COVARIANCE)
    known_to = None if matrix is None else covariance(f"{what}: {_SENSOR_COVARIANCE}", matrix, 4)
    return Sensor(**plain, falloff=(a, b), covariance=known_to)


def _mounted_from_json(value: Mapping[str, Any], what: str) -> MountedCamera:
    matrix = value.get("covariance_rotation_rad_translation_mm")
    return MountedCamera(
        camera_from_json(value, what),
        rigid_from_json(value["cam_from_rig"], f"{what}: cam_from_rig"),
        None if matrix is None else covariance(f"{what}: covariance_rotation_rad_translation_mm", matrix, 6),
        Shutter(
            **{
                name: number(f"{what}: {name}", value[name], *limits)
                for name, limits in _SHUTTER_RANGES.items()
                if name in value
            }
        ),
    )


def read_handpiece(path: Path | str, working_distance_mm: float | None = None) -> Handpiece:
    """Read ``handpiece.json``, or COLMAP's ``rig_config.json``, which has no working distance: that is the one given
    here, or else guessed, and said. Its frame is then on the surface, as :meth:`cuspid.model.rig.Rig.over_surface` has
    it.

    Raises InputError that names a missing or unusable field, where nothing can be guessed, and where a file that has a
    working distance is given another.
    """
    path = Path(path)
    value = read_json(path)
    if isinstance(value, list):
        return handpiece_of_rig(path, read_rig_config(path), working_distance_mm)
    if working_distance_mm is not None:
        raise InputError(f"{path}: it already has a working distance; change it there instead of giving another")
    with reading(path):
        rig = rig_from_handpiece(value, f"{path}: ")
        distance_mm = number(f"{path}: working_distance_mm", value["working_distance_mm"], 0.0, LONGEST_MM)
        near, far = numbers(f"{path}: depth_range_mm", value["depth_range_mm"], (2,), 0.0, LONGEST_MM).tolist()
        return Handpiece(
            rig=rig,
            lights={
                checked_name(f"{path}: lights", key): _light_from_json(light, f"{path}: light {quote(key)}")
                for key, light in value.get("lights", {}).items()
            },
            lightings=tuple(
                Lighting(name=checked_name(f"{path}: lightings", each["name"]), lights=tuple(each["lights"]))
                for each in value.get("lightings", [])
            ),
            sensor=_sensor_from_json(value.get("sensor", {}), f"{path}: sensor"),
            sensors={
                checked_name(f"{path}: sensors", key): _sensor_from_json(sensor, f"{path}: sensor {quote(key)}")
                for key, sensor in value.get("sensors", {}).items()
            },
            working_distance_mm=distance_mm,
            depth_range_mm=(near, far),
            body=None if value.get("body") is None else _body_from_json(path, value["body"]),
            name=title(f"{path}: name", value["name"]) if "name" in value else path.stem,
        )


def rig_from_handpiece(value: Mapping[str, Any], where: str = "") -> Rig:
    """The cameras of ``handpiece.json``. Raises InputError that begins with ``where``."""
    strange = sorted(set(value) - _FIELDS)
    if strange:
        raise InputError(f"{where}unknown field {quote(strange[0])}; choose from {', '.join(sorted(_FIELDS))}")
    return Rig(
        {
            checked_name(f"{where}cameras", key): _mounted_from_json(camera, f"{where}camera {quote(key)}")
            for key, camera in value["cameras"].items()
        }
    )


def _body_from_json(path: Path, value: Any) -> Body:
    if not (isinstance(value, dict) and value):
        raise InputError(f"{path}: body must map names to boxes, at least one; leave it out if it is unknown")
    return Body({name: _box_from_json(f"{path}: body, {name}", box) for name, box in value.items()})


def _box_from_json(where: str, value: Any) -> Box:
    if not (isinstance(value, dict) and set(value) == _BOX_FIELDS):
        raise InputError(f"{where}: a box must have exactly the fields {' and '.join(sorted(_BOX_FIELDS))}")
    pose = value["box_from_rig"]
    if not (isinstance(pose, dict) and set(pose) == {"rotation_wxyz", "translation_mm"}):
        raise InputError(f"{where}: box_from_rig must have exactly the fields rotation_wxyz and translation_mm")
    size = numbers(f"{where}: size_mm", value["size_mm"], (3,), 0.0, LONGEST_MM)
    if not size.all():
        raise InputError(f"{where}: size_mm is {quote(value['size_mm'])}; it must be three positive lengths")
    return Box(rigid_from_json(pose, f"{where}: box_from_rig"), size / 2)


def handpiece_of_rig(path: Path, rig: Rig, working_distance_mm: float | None) -> Handpiece:
    """A handpiece of nothing but the cameras of a file: see :func:`read_handpiece`."""
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
        f"{path}: it has no working distance; {distance_mm:.3g} mm is assumed, from {source}. Depths from "
        f"{near_mm:.3g} to {far_mm:.3g} mm are kept; to change them, give {_SET_BY}"
    )
    return distance_mm


def hash_handpiece(handpiece: Handpiece) -> str:
    """SHA-256 of all of a handpiece that a reconstruction depends on: not of its body."""
    return digest_of(_optics_to_json(handpiece))


def write_rig_config(path: Path, rig: Rig) -> None:
    """Write COLMAP's ``rig_config.json``; the reference sensor is the first camera."""
    write_json(path, rig_to_config(rig))


def rig_to_config(rig: Rig) -> list[dict[str, Any]]:
    """See :func:`write_rig_config`."""
    rebased, _ = rig.rebased()
    cameras: list[dict[str, Any]] = []
    for index, (name, mounted) in enumerate(rebased.cameras.items()):
        entry: dict[str, Any] = {
            "image_prefix": f"{name}/",
            "camera_model_name": mounted.camera.model,
            "camera_params": mounted.camera.parameters.tolist(),
            "camera_size": [mounted.camera.width, mounted.camera.height],
        }
        if index == 0:
            entry["ref_sensor"] = True
        else:
            entry["cam_from_rig_rotation"] = mounted.cam_from_rig.quaternion.tolist()
            entry["cam_from_rig_translation"] = mounted.cam_from_rig.translation.tolist()
        cameras.append(entry)
    return [{"cameras": cameras}]


def read_rig_config(path: Path, image_size_px: tuple[int, int] | None = None) -> Rig:
    """Read COLMAP's ``rig_config.json`` (one rig, calibrated cameras of any model that cuspid has or contains).

    The format has no image size: it is taken from cuspid's own extra field ``camera_size``, else from the argument,
    else twice the principal point.
    """
    value = read_json(path)
    with reading(path):
        return rig_from_config(value, image_size_px)


def rig_from_config(value: Any, image_size_px: tuple[int, int] | None = None) -> Rig:
    """See :func:`read_rig_config`."""
    if len(value) != 1:
        raise InputError(f"it holds {len(value)} rigs; cuspid supports only one")
    cameras: dict[str, MountedCamera] = {}
    for entry in value[0]["cameras"]:
        key = checked_name("image_prefix", str(entry["image_prefix"]).rstrip("/"))
        what = f"camera {quote(key)}"
        cam_from_rig = Rigid3.identity() if entry.get("ref_sensor") else _place_in_rig(entry, what)
        cameras[key] = MountedCamera(camera_from_colmap(entry, image_size_px, what), cam_from_rig)
    return Rig(cameras)


def _place_in_rig(entry: Mapping[str, Any], what: str) -> Rigid3:
    rotation, translation = entry["cam_from_rig_rotation"], entry["cam_from_rig_translation"]
    return rigid_from_json({"rotation_wxyz": rotation, "translation_mm": translation}, what)


_COLMAP_PARAMETERS: Mapping[str, Sequence[int]] = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3),
    "RADIAL": (0, 0, 1, 2, 3, 4),
    "SIMPLE_RADIAL_FISHEYE": (0, 0, 1, 2, 3),
    "RADIAL_FISHEYE": (0, 0, 1, 2, 3, 4),
}
"""Of smaller models of COLMAP's: where the first parameters of the one that contains them stand among theirs."""
_CONTAINED = {
    **dict.fromkeys(_COLMAP_PARAMETERS, "OPENCV"),
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
}


def camera_from_colmap(entry: Mapping[str, Any], image_size_px: tuple[int, int] | None, what: str = "camera") -> Camera:
    """A camera of ``rig_config.json``; see :func:`read_rig_config`. Raises InputError for what no camera can have."""
    model = entry["camera_model_name"]
    if model not in _COLMAP_PARAMETERS and model not in MODELS:
        known = ", ".join([*_COLMAP_PARAMETERS, *MODELS])
        raise InputError(f"{what}: model {quote(model)} is not supported; use one of {known}")
    parameters = np.array(entry["camera_params"], dtype=np.float64)
    if model in _COLMAP_PARAMETERS:
        chosen = parameters[list(_COLMAP_PARAMETERS[model])]
        model = _CONTAINED[model]
        parameters = np.pad(chosen, (0, 4 + len(MODELS[model].names) - len(chosen)))
    width, height = entry.get("camera_size") or image_size_px or np.rint(2 * parameters[2:4]).tolist()
    return camera_from_json({"width_px": width, "height_px": height, "model": model, "params": parameters}, what)
