"""A reference render of the true jaw from above: ``view.json``, ``picture.png`` and ``surface.npz`` in a folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cuspid.capture import read_image
from cuspid.errors import InputError
from cuspid.storage.captures import write_image
from cuspid.storage.files import read_arrays, read_json, reading, write_arrays, write_json
from cuspid.trueness import ReferenceRender

REFERENCE_RENDER_FILES = ("picture.png", "surface.npz", "view.json")
"""What :func:`write_reference_render` writes."""


def write_reference_render(folder: Path, view: ReferenceRender) -> None:
    """Write a reference render; ``view.json`` comes last, so that what has one is whole."""
    write_image(folder / "picture.png", view.image)
    write_arrays(folder / "surface.npz", {"labels": view.labels, "height_mm": view.height_mm}, compressed=True)
    numbers = {name: getattr(view, name) for name in ("mm_per_px", "origin_px", "camera_height_mm")}
    write_json(folder / "view.json", numbers)


def read_reference_render(folder: Path) -> ReferenceRender:
    """Read what :func:`write_reference_render` wrote. Raises InputError where a file is missing or damaged."""
    path = folder / "view.json"
    if not path.exists():
        raise InputError(f"{folder}: no reference render of the jaw in it; make the truth with cuspid film")
    value = read_json(path)
    surface = read_arrays(folder / "surface.npz", remedy="run cuspid film again")
    with reading(path):
        return ReferenceRender(
            image=read_image(folder / "picture.png"),
            mm_per_px=value["mm_per_px"],
            origin_px=np.array(value["origin_px"], dtype=np.float64),
            camera_height_mm=value["camera_height_mm"],
            labels=surface["labels"],
            height_mm=surface["height_mm"],
        )
