"""A reference render of the true jaw from above: ``view.json``, ``picture.png`` and ``surface.npz`` in a folder."""

from __future__ import annotations

from pathlib import Path

from cuspid.model.trueness import ReferenceRender
from cuspid.runtime.errors import InputError
from cuspid.runtime.image_files import read_image
from cuspid.runtime.values import LONGEST_MM, MOST_PX, number, numbers
from cuspid.storage.captures import write_image
from cuspid.storage.files import as_declared, read_arrays, read_json, reading, write_arrays, write_json

REFERENCE_RENDER_FILES = ("picture.png", "surface.npz", "view.json")
"""What :func:`write_reference_render` writes."""


def write_reference_render(folder: Path, view: ReferenceRender) -> None:
    """Write a reference render; ``view.json`` comes last, so that what has one is whole."""
    write_image(folder / "picture.png", view.image)
    write_arrays(folder / "surface.npz", {"labels": view.labels, "height_mm": view.height_mm}, compressed=True)
    write_json(
        folder / "view.json", {name: getattr(view, name) for name in ("mm_per_px", "origin_px", "camera_height_mm")}
    )


def read_reference_render(folder: Path) -> ReferenceRender:
    """Read what :func:`write_reference_render` wrote. Raises InputError where a file is missing or damaged."""
    path = folder / "view.json"
    if not path.exists():
        raise InputError(f"{folder}: it contains no reference render of the jaw; make one with cuspid pano film")
    value = read_json(path)
    surface = read_arrays(folder / "surface.npz", remedy="run cuspid pano film again")
    with reading(path):
        height_mm = value["camera_height_mm"]
        return as_declared(
            ReferenceRender,
            image=read_image(folder / "picture.png"),
            mm_per_px=number("mm_per_px", value["mm_per_px"], 1e-6, LONGEST_MM),
            origin_px=numbers("origin_px", value["origin_px"], (2,), -float(MOST_PX), float(MOST_PX)),
            camera_height_mm=None if height_mm is None else number("camera_height_mm", height_mm, 1e-3, LONGEST_MM),
            labels=surface["labels"],
            height_mm=surface["height_mm"],
        )
