"""COLMAP's ``rig_config.json``, and its sparse models as text (``cameras.txt`` and ``images.txt``); and cuspid's own
``handpiece.json``. Only the last of them states a unit."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.rig import MountedCamera, Rig
from cuspid.runtime.errors import InputError
from cuspid.runtime.values import checked_name, quote
from cuspid.storage.calibrations.documents import Document
from cuspid.storage.calibrations.fields import Calibration, Hints
from cuspid.storage.calibrations.lenses import ALL, Lens
from cuspid.storage.handpieces import (
    camera_from_colmap,
    camera_from_json,
    rig_from_config,
    rig_from_handpiece,
    rig_to_config,
    rigid_from_json,
)

LENSES: tuple[Lens, ...] = ALL


def recognises_config(files: Mapping[str, Document]) -> bool:
    """Whether it is a list of rigs."""
    document, *others = files.values()
    rigs = document.value if isinstance(document.value, list) else []
    return not others and any(isinstance(each, Mapping) and "cameras" in each for each in rigs)


def read_config(files: Mapping[str, Document], hints: Hints) -> Calibration:
    """The cameras of a rig. Raises InputError."""
    (document,) = files.values()
    rig = rig_from_config(document.value, hints.image_size_px)
    has_size = hints.image_size_px or all("camera_size" in each for each in document.value[0]["cameras"])
    guessed = "the file has no image sizes; twice the principal point is assumed (--image-size W H)"
    return Calibration(cameras=rig.cameras, notes=() if has_size else (guessed,))


def write_config(cameras: Mapping[str, MountedCamera], suffix: str) -> str:
    """Writes the configuration with ``camera_size``, which COLMAP ignores."""
    return json.dumps(rig_to_config(Rig(cameras)), indent=2) + "\n"


def recognises_handpiece(files: Mapping[str, Document]) -> bool:
    """Whether it is a handpiece of cuspid's, or one of its cameras."""
    document, *others = files.values()
    if others or not isinstance(document.value, Mapping):
        return False
    return document.has("width_px", "height_px") or document.has("cameras", "working_distance_mm")


def read_handpiece(files: Mapping[str, Document], hints: Hints) -> Calibration:
    """The cameras of a handpiece. Raises InputError."""
    (document,) = files.values()
    if "cameras" not in document.value:
        alone = camera_from_json(document.value)
        return Calibration(cameras={"camera": MountedCamera(alone, Rigid3.identity())}, unit="mm")
    lost = [each for each in ("lights", "body") if document.value.get(each)]
    notes = (f"only cameras are carried over, not its {' and '.join(lost)}",) if lost else ()
    return Calibration(cameras=rig_from_handpiece(document.value).cameras, unit="mm", notes=notes)


def recognises_model(files: Mapping[str, Document]) -> bool:
    """Whether these are a model's cameras, and perhaps its images."""
    files = _as_cameras(files)
    if "cameras" not in files or not set(files) <= {"cameras", "images", "points3D", "rigs", "frames"}:
        return False
    rows = _rows(files["cameras"])
    return bool(rows) and len(rows[0]) > 4 and rows[0][0].isdigit() and rows[0][1].isupper()


def read_model(files: Mapping[str, Document], hints: Hints) -> Calibration:
    """A camera for each image, or, without images, one alone. Raises InputError."""
    files = _as_cameras(files)
    lenses = {row[0]: _lens(row) for row in _rows(files["cameras"])}
    if "images" not in files:
        if len(lenses) != 1:
            raise InputError(f"it holds {len(lenses)} cameras; their places are in images.txt: give the folder of both")
        return Calibration(cameras={"camera": MountedCamera(next(iter(lenses.values())), Rigid3.identity())})
    cameras: dict[str, MountedCamera] = {}
    for row in _image_rows(files["images"]):
        name = checked_name("images.txt", str(PurePosixPath(row[9]).with_suffix("")))
        if row[8] not in lenses:
            raise InputError(f"images.txt: {quote(row[9])} has the camera {quote(row[8])}, which cameras.txt lacks")
        w, x, y, z, *shift = (float(each) for each in row[1:8])
        cameras[name] = MountedCamera(
            lenses[row[8]], rigid_from_json({"rotation_wxyz": [w, x, y, z], "translation_mm": shift}, name)
        )
    return Calibration(cameras=cameras)


def _as_cameras(files: Mapping[str, Document]) -> Mapping[str, Document]:
    """A single file, whatever its name, has the cameras."""
    return {"cameras": next(iter(files.values()))} if len(files) == 1 else files


def _rows(document: Document) -> list[list[str]]:
    if document.kind != "text":
        return []
    return [line.split() for line in document.value.splitlines() if line.strip() and not line.startswith("#")]


def _image_rows(document: Document) -> list[list[str]]:
    """Those of the images: of each pair of lines the first, the second has its points and may be empty."""
    if document.kind != "text":
        raise InputError("images.txt is not a list of COLMAP's images")
    lines = [line.split() for line in document.value.splitlines() if not line.startswith("#")]
    rows = [row for row in lines[::2] if row]
    if any(len(row) < 10 for row in rows):
        raise InputError("images.txt: a line has fewer than 10 fields; two lines belong to each image")
    return [[*row[:9], " ".join(row[9:])] for row in rows]


def _lens(row: list[str]) -> Camera:
    _, model, width, height, *parameters = row
    entry: dict[str, Any] = {"camera_model_name": model, "camera_params": [float(value) for value in parameters]}
    return camera_from_colmap(entry, (int(width), int(height)))
