"""Nerfstudio's ``transforms.json`` (https://docs.nerf.studio/quickstart/data_conventions.html): ``world_from_camera``
in OpenGL's axes (+X right, +Y up, looking along -Z), COLMAP's pixel origin."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.rig import MountedCamera
from cuspid.runtime.errors import InputError
from cuspid.runtime.values import checked_name, number, quote
from cuspid.storage.calibrations.documents import Document
from cuspid.storage.calibrations.fields import (
    Calibration,
    Hints,
    camera,
    image_size,
    motion,
    require_list,
    require_mapping,
)
from cuspid.storage.calibrations.lenses import BROWN_5, FISHEYE, Lens, Loss, fit_projection

LENSES: tuple[Lens, ...] = (BROWN_5, FISHEYE)
_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
_MODELS = ("OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE")
_MOST = 1e4


def recognises(files: Mapping[str, Document]) -> bool:
    """Whether it has frames with transforms."""
    document, *others = files.values()
    return not others and document.has("frames") and isinstance(document.value["frames"], list)


def read(files: Mapping[str, Document], hints: Hints) -> Calibration:
    """A camera for each frame, named after its image. Raises InputError."""
    (document,) = files.values()
    shared = {key: value for key, value in document.value.items() if key != "frames"}
    frames = [require_mapping("a frame", each) for each in require_list("frames", document.value["frames"])]
    paths = [PurePosixPath(str(each.get("file_path", index)).replace("\\", "/")) for index, each in enumerate(frames)]
    names = _names(paths)
    cameras: dict[str, MountedCamera] = {}
    losses: dict[str, Loss] = {}
    known: dict[str, tuple[Camera, Loss | None]] = {}
    for name, frame in zip(names, frames, strict=True):
        checked_name("file_path", name)
        if name in cameras:
            raise InputError(f"two frames have the image {name}; each needs its own")
        fields = {**shared, **frame}
        key = json.dumps(
            {each: value for each, value in fields.items() if each in _FIELDS}, sort_keys=True, default=str
        )
        if key not in known:
            known[key] = _camera(f"frame {name}", fields)
        made, loss = known[key]
        world_from_opengl = motion(f"frame {name}: transform_matrix", frame["transform_matrix"])
        world_from_camera = world_from_opengl @ Rigid3(_OPENGL_FROM_OPENCV, np.zeros(3))
        cameras[name] = MountedCamera(made, world_from_camera.inverse())
        losses.update({} if loss is None else {name: loss})
    return Calibration(cameras=cameras, losses=losses)


_FIELDS = {*("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2"), *("camera_model",)} | {
    "camera_angle_x"
}


def _names(paths: list[PurePosixPath]) -> list[str]:
    """The stems of the images, or their paths below the folder that all are in, where stems are not distinct."""
    stems = [path.stem for path in paths]
    if len(set(stems)) == len(stems):
        return stems
    parts = [[part for part in path.with_suffix("").parts if part not in (".", "..", "/")] for path in paths]
    while all(len(each) > 1 for each in parts) and len({each[0] for each in parts}) == 1:
        parts = [each[1:] for each in parts]
    return ["/".join(each) for each in parts]


def _camera(what: str, fields: Mapping[str, Any]) -> tuple[Camera, Loss | None]:
    size = image_size(what, fields["w"], fields["h"])
    width, height = size
    if "fl_x" in fields:
        fx = number(f"{what}: fl_x", fields["fl_x"], 1.0, 1e7)
    else:
        fx = width / 2 / np.tan(number(f"{what}: camera_angle_x", fields["camera_angle_x"], 1e-3, 3.1) / 2)
    focal = [fx, number(f"{what}: fl_y", fields.get("fl_y", fx), 1.0, 1e7)]
    centre = [fields.get("cx", width / 2), fields.get("cy", height / 2)]
    model = fields.get("camera_model", "OPENCV")
    if model not in _MODELS:
        raise InputError(f"{what}: camera_model {quote(model)} is not supported; use one of {', '.join(_MODELS)}")
    names = ("k1", "k2", "k3", "k4", "p1", "p2")
    k1, k2, k3, k4, p1, p2 = (number(f"{what}: {each}", fields.get(each, 0.0), -_MOST, _MOST) for each in names)
    if model == "OPENCV_FISHEYE":
        return camera(what, size, focal, centre, [k1, k2, k3, k4], model, pixel_offset=0.0), None
    distortion, kind = ([k1, k2, p1, p2], "OPENCV") if k3 == 0 else ([k1, k2, p1, p2, k3, 0.0, 0.0, 0.0], "FULL_OPENCV")
    made = camera(what, size, focal, centre, distortion, kind, pixel_offset=0.0)
    if k4 == 0:
        return made, None

    def project(points: np.ndarray) -> np.ndarray:
        """With k4 r^8, which no model of COLMAP's has."""
        plane = points[:, :2] / np.where(points[:, 2:] > 1e-6, points[:, 2:], np.nan)
        more = k4 * (plane**2).sum(axis=1, keepdims=True) ** 4 * plane * made.focal_px
        return np.where(np.isfinite(plane), made.project(points) + more, np.nan)

    return fit_projection(project, size, "k4 of a perspective lens")


def write(cameras: Mapping[str, MountedCamera], suffix: str) -> str:
    """A frame for each camera, with its own intrinsics and the image ``images/<camera>.png``."""
    frames = []
    for name, mounted in cameras.items():
        made = mounted.camera
        lens = zip(made.lens.names, made.distortion.tolist(), strict=True)
        world_from_opengl = mounted.cam_from_rig.inverse() @ Rigid3(_OPENGL_FROM_OPENCV, np.zeros(3))
        frames.append(
            {
                "file_path": f"images/{name}.png",
                "w": made.width,
                "h": made.height,
                "fl_x": made.focal_px[0],
                "fl_y": made.focal_px[1],
                "cx": made.principal_point_px[0],
                "cy": made.principal_point_px[1],
                **{key: value for key, value in lens if key in LENSES[made.lens.is_equidistant].names},
                "transform_matrix": world_from_opengl.matrix.tolist(),
            }
        )
    fisheye = {each.camera.lens.is_equidistant for each in cameras.values()}
    if len(fisheye) > 1:
        raise InputError("Nerfstudio has one camera_model for all frames; these cameras need two")
    model = "OPENCV_FISHEYE" if fisheye.pop() else "OPENCV"
    return json.dumps({"camera_model": model, "frames": frames}, indent=2) + "\n"
