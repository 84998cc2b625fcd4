"""MATLAB's ``stereoParameters`` as JSON, ``jsonencode(toStruct(stereoParams))``; and ``cameraParameters`` alone. Pixels
count from 1, vectors are rows (``x_2 = x_1 R + t``), so IntrinsicMatrix and RotationOfCamera2 are transposed; newer
versions write K and PoseCamera2, which are not."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.rig import MountedCamera
from cuspid.runtime.errors import InputError
from cuspid.runtime.values import quote
from cuspid.storage.calibrations.documents import Document
from cuspid.storage.calibrations.fields import (
    Calibration,
    Hints,
    assumed_size,
    brown,
    calibration_matrix,
    camera,
    image_size,
    matrix,
    nearest_rotation,
    require_mapping,
    vector,
)
from cuspid.storage.calibrations.lenses import BROWN_5, Lens
from cuspid.storage.units import Unit

LENSES: tuple[Lens, ...] = (BROWN_5,)
_PIXEL_OFFSET = -0.5
"""COLMAP's pixel coordinate minus MATLAB's."""
_UNITS: Mapping[str, Unit] = {
    **dict.fromkeys(("mm", "millimeters", "millimeter", "millimetres"), "mm"),
    **dict.fromkeys(("cm", "centimeters", "centimeter", "centimetres"), "cm"),
    **dict.fromkeys(("m", "meters", "meter", "metres"), "m"),
    **dict.fromkeys(("in", "inches", "inch"), "in"),
    **dict.fromkeys(("um", "micrometers", "microns", "micrometres"), "um"),
}


def recognises(files: Mapping[str, Document]) -> bool:
    """Whether it has the fields of toStruct."""
    document, *others = files.values()
    return not others and (document.has("CameraParameters1") or document.has("RadialDistortion"))


def read(files: Mapping[str, Document], hints: Hints) -> Calibration:
    """A pair, or one camera. Raises InputError."""
    (document,) = files.values()
    values = document.value
    if "CameraParameters1" not in values:
        made, note = _camera("camera", values, hints)
        alone = {"camera": MountedCamera(made, Rigid3.identity())}
        return Calibration(
            cameras=alone,
            unit=_unit(values),
            notes=(note,) if note else (),
        )
    both = [require_mapping(key, values[key]) for key in ("CameraParameters1", "CameraParameters2")]
    found = [_camera(f"CameraParameters{index}", each, hints) for index, each in enumerate(both, start=1)]
    return Calibration(
        cameras={
            "camera1": MountedCamera(found[0][0], Rigid3.identity()),
            "camera2": MountedCamera(found[1][0], _second_from_first(values)),
        },
        unit=_unit(both[0]),
        notes=tuple(dict.fromkeys(note for _, note in found if note)),
    )


def _unit(values: Mapping[str, Any]) -> Unit | None:
    named = values.get("WorldUnits")
    return _UNITS.get(named.lower()) if isinstance(named, str) else None


def _second_from_first(values: Mapping[str, Any]) -> Rigid3:
    if "RotationOfCamera2" in values:
        turn = matrix("RotationOfCamera2", values["RotationOfCamera2"], 3, 3).T
        shift = vector("TranslationOfCamera2", values["TranslationOfCamera2"], 3)
    else:
        pose = require_mapping("PoseCamera2", values["PoseCamera2"])
        if "A" in pose:
            whole = matrix("PoseCamera2", pose["A"], 4, 4)
            turn, shift = whole[:3, :3], whole[:3, 3]
        else:
            turn, shift = matrix("PoseCamera2", pose["R"], 3, 3), vector("PoseCamera2", pose["Translation"], 3)
    return Rigid3(nearest_rotation("the rotation of camera 2", turn), shift)


def _camera(what: str, values: Mapping[str, Any], hints: Hints) -> tuple[Camera, str | None]:
    if "K" in values:
        focal, centre = calibration_matrix(f"{what}: K", values["K"])
    else:
        found = matrix(f"{what}: IntrinsicMatrix", values["IntrinsicMatrix"], 3, 3, 1e7)
        if abs(found[1, 0]) > 1e-6:
            raise InputError(f"{what}: IntrinsicMatrix is {quote(found)}; calibrate without skew")
        focal, centre = calibration_matrix(f"{what}: IntrinsicMatrix", found.T.tolist())
    told, note = values.get("ImageSize"), None
    if told:
        height, width = vector(f"{what}: ImageSize", told, 2).tolist()
        size = image_size(what, width, height)
    else:
        size, note = assumed_size([each + _PIXEL_OFFSET for each in centre], hints)
    radial = vector(f"{what}: RadialDistortion", values["RadialDistortion"])
    tangential = vector(f"{what}: TangentialDistortion", values.get("TangentialDistortion", [0.0, 0.0]), 2)
    if len(radial) not in (2, 3):
        raise InputError(f"{what}: RadialDistortion has {len(radial)} coefficients; MATLAB has 2 or 3")
    model, parameters = brown(np.concatenate([radial[:2], tangential, radial[2:]]))
    return camera(what, size, focal, centre, parameters, model, pixel_offset=_PIXEL_OFFSET), note


def write(cameras: Mapping[str, MountedCamera], suffix: str) -> str:
    """For ``stereoParameters(jsondecode(fileread(...)))``, or ``cameraParameters`` of one camera."""
    structs = [_struct(each.camera) for each in cameras.values()]
    if len(structs) == 1:
        return json.dumps(structs[0], indent=2) + "\n"
    first, second = cameras.values()
    second_from_first = second.cam_from_rig @ first.cam_from_rig.inverse()
    values = {
        "CameraParameters1": structs[0],
        "CameraParameters2": structs[1],
        "RotationOfCamera2": second_from_first.rotation.T.tolist(),
        "TranslationOfCamera2": second_from_first.translation.tolist(),
    }
    return json.dumps(values, indent=2) + "\n"


def _struct(made: Camera) -> dict[str, Any]:
    k1, k2, p1, p2, k3 = [*made.distortion.tolist(), 0.0][:5]
    own = made.matrix
    own[:2, 2] -= _PIXEL_OFFSET
    return {
        "RadialDistortion": [k1, k2, k3] if k3 else [k1, k2],
        "TangentialDistortion": [p1, p2],
        "ImageSize": [made.height, made.width],
        "WorldUnits": "millimeters",
        "EstimateSkew": False,
        "NumRadialDistortionCoefficients": 3 if k3 else 2,
        "EstimateTangentialDistortion": True,
        "IntrinsicMatrix": own.T.tolist(),
    }
