"""The sets of real photographs, and how each is offered to ``cuspid reconstruct``: what is not part of the project, and
whose truth no reconstruction is given."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Kind = Literal["opencas", "robovision", "dtu", "temple", "photographs"]
ROBOVISION = ("2016_10_24__17_43_02", "2016_10_24__18_26_54", "2016_10_25__12_11_32")


@dataclass(frozen=True, kw_only=True)
class Set:
    """Photographs, and what is measured on them."""

    kind: Kind
    """How they are measured."""
    folder: str
    """Within the folder of all sets."""
    left_out: tuple[str, ...] = ()
    """Cameras that the reconstruction is not shown."""
    only: tuple[str, ...] | None = None
    """Cameras that it is shown; None for all."""
    arguments: tuple[str, ...] = ()
    """More of them for the reconstruction."""


SETS: Mapping[str, Set] = {
    "opencas": Set(kind="opencas", folder="opencas"),
    **{f"robovision-{name}": Set(kind="robovision", folder=f"robovision-{name}") for name in ROBOVISION},
    "dtu": Set(kind="dtu", folder="dtu"),
    "dtu-left-out": Set(kind="dtu", folder="dtu", left_out=("c08", "c32", "c36")),
    "temple-four": Set(
        kind="temple",
        folder="middlebury-templeR",
        only=("templeR0014", "templeR0015", "templeR0016", "templeR0017"),
        left_out=("templeR0013", "templeR0018"),
    ),
    "temple": Set(kind="temple", folder="middlebury-templeR"),
    "temple-left-out": Set(
        kind="temple", folder="middlebury-templeR", left_out=("templeR0008", "templeR0024", "templeR0040")
    ),
    "temple-photographs": Set(kind="photographs", folder="middlebury-templeR"),
    "skull": Set(kind="photographs", folder="skull"),
}


def cameras_of(folder: Path) -> list[str]:
    """Names of the cameras of a capture, in order."""
    return list(json.loads((folder / "handpiece.json").read_text())["cameras"])


def offered(each: Set, data: Path, temporary: Path) -> Path:
    """The folder that the reconstruction is given, of links to the photographs, the calibration and the masks; of the
    cameras that are left out it has nothing."""
    source = data / each.folder
    temporary.mkdir(parents=True, exist_ok=True)
    if each.kind == "photographs":
        return _photographs(source, temporary)
    names = [name for name in each.only or cameras_of(source) if name not in each.left_out]
    described = json.loads((source / "handpiece.json").read_text())
    described["cameras"] = {name: described["cameras"][name] for name in names}
    (temporary / "handpiece.json").write_text(json.dumps(described))
    (temporary / "images").mkdir()
    for name in names:
        (temporary / "images" / name).symlink_to((source / "images" / name).resolve())
        mask = mask_file(source, name)
        if mask.exists():
            link = temporary / "masks" / name / "0000.png"
            link.parent.mkdir(parents=True)
            link.symlink_to(mask.resolve())
    return temporary


def mask_file(source: Path, camera: str) -> Path:
    """Where the publisher's mask of a camera would be."""
    return source / "mask" / f"{camera.lstrip('c').zfill(3)}.png"


def _photographs(source: Path, temporary: Path) -> Path:
    """One folder of photographs: as it is, or one photograph of each camera of a capture, by the camera's name."""
    images = source / "images"
    if not (source / "handpiece.json").exists():
        return images
    for name in cameras_of(source):
        file = next((images / name).iterdir())
        (temporary / f"{name}{file.suffix}").symlink_to(file.resolve())
    return temporary


def image_file(source: Path, camera: str) -> Path:
    """The photograph of a camera of a capture of one instant."""
    return next((source / "images" / camera).iterdir())
