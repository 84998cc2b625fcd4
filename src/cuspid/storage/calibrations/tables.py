"""caliscope's ``camera_array.toml`` and anipose's ``calibration.toml``: a table for each camera with OpenCV's matrix,
coefficients, and ``cam_from_world``."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from scipy.spatial.transform import Rotation

from cuspid.geometry import Rigid3
from cuspid.model.rig import MountedCamera
from cuspid.runtime.errors import InputError
from cuspid.runtime.values import checked_name
from cuspid.storage.calibrations.documents import Document
from cuspid.storage.calibrations.fields import (
    Calibration,
    Hints,
    brown,
    calibration_matrix,
    camera,
    image_size,
    pose,
    require_mapping,
    vector,
)
from cuspid.storage.calibrations.lenses import BROWN_5, FISHEYE, Lens
from cuspid.storage.calibrations.opencv import coefficients_of

LENSES: tuple[Lens, ...] = (BROWN_5, FISHEYE)


def _tables(document: Document) -> Iterator[tuple[str, Any]]:
    """Of cameras, by key."""
    if document.kind != "values" or not isinstance(document.value, Mapping):
        return
    nested = document.value.get("cameras")
    for key, value in (nested if isinstance(nested, Mapping) else document.value).items():
        if isinstance(value, Mapping) and "matrix" in value:
            yield str(key), value


def recognises_caliscope(files: Mapping[str, Document]) -> bool:
    """Whether it has caliscope's tables ``cameras.<number>``."""
    document, *others = files.values()
    return not others and document.has("cameras") and any(True for _ in _tables(document))


def recognises_anipose(files: Mapping[str, Document]) -> bool:
    """Whether it has anipose's tables ``cam_<number>``."""
    document, *others = files.values()
    return not others and not document.has("cameras") and any(True for _ in _tables(document))


def read(files: Mapping[str, Document], hints: Hints) -> Calibration:
    """Cameras that have a place; others, as both programs keep them, are left out, and said. Raises InputError."""
    (document,) = files.values()
    cameras: dict[str, MountedCamera] = {}
    notes: list[str] = []
    tables = list(_tables(document))
    for key, table in tables:
        name = checked_name("name", str(table.get("name", f"cam_{key}" if key.isdigit() else key)))
        if name in cameras:
            raise InputError(f"two cameras are named {name}; give each a name of its own")
        if len(tables) > 1 and not ("rotation" in table and "translation" in table):
            notes.append(f"camera {name} has no place, and is left out")
            continue
        cameras[name] = _mount_camera(f"camera {name}", table)
    if not cameras:
        raise InputError("none of its cameras has a matrix, rotation and translation")
    return Calibration(cameras=cameras, notes=tuple(notes))


def _mount_camera(what: str, table: Mapping[str, Any]) -> MountedCamera:
    table = require_mapping(what, table)
    size = image_size(what, *vector(f"{what}: size", table["size"], 2).tolist())
    focal, centre = calibration_matrix(f"{what}: matrix", table["matrix"])
    given = vector(f"{what}: distortions", table.get("distortions", []))
    if len(given) not in (0, 4, 5, 8):
        raise InputError(f"{what}: {len(given)} distortions; OpenCV has 4, 5 or 8")
    if table.get("fisheye") is True:
        model, parameters = "OPENCV_FISHEYE", given[:4].tolist() or [0.0] * 4
    else:
        model, parameters = brown(given)
    place = Rigid3.identity()
    if "rotation" in table:
        place = pose(what, table["rotation"], table["translation"])
    return MountedCamera(camera(what, size, focal, centre, parameters, model), place)


def _entries(mounted: MountedCamera) -> dict[str, Any]:
    made = mounted.camera
    return {
        "size": [made.width, made.height],
        "matrix": made.opencv_matrix.tolist(),
        "distortions": coefficients_of(made),
        "rotation": Rotation.from_matrix(mounted.cam_from_rig.rotation).as_rotvec().tolist(),
        "translation": mounted.cam_from_rig.translation.tolist(),
        "fisheye": made.lens.is_equidistant,
    }


def _toml(title: str, values: Mapping[str, Any]) -> str:
    """A table; JSON writes these values as TOML does."""
    return "\n".join([f"[{title}]", *(f"{key} = {json.dumps(value)}" for key, value in values.items()), ""])


def write_caliscope(cameras: Mapping[str, MountedCamera], suffix: str) -> str:
    """Cameras by number, in the order of the rig."""
    own = {"rotation_count": 0, "error": 0.0, "exposure": 0, "grid_count": 0, "ignore": False}
    return "\n".join(
        _toml(f"cameras.{index}", {"cam_id": index} | own | _entries(mounted))
        for index, mounted in enumerate(cameras.values())
    )


def write_anipose(cameras: Mapping[str, MountedCamera], suffix: str) -> str:
    """Cameras with their names."""
    tables = [
        _toml(f"cam_{index}", {"name": name} | _entries(mounted))
        for index, (name, mounted) in enumerate(cameras.items())
    ]
    return "\n".join([*tables, _toml("metadata", {"adjusted": False, "error": 0.0})])
