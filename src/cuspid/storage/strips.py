"""Strips of another scale: the picture stays, its lengths in millimetres are scaled."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cuspid.runtime.image_files import read_rgba
from cuspid.runtime.inputs import read_bytes, read_text
from cuspid.runtime.values import LONGEST_MM, number
from cuspid.storage.files import read_json, reading, write_bytes, write_json
from cuspid.storage.tables import write_table


class ScaledStrip(NamedTuple):
    """The files of a strip."""

    header: Mapping[str, Any]
    """Of ``strip.json``."""
    columns: Sequence[Mapping[str, int | float]]
    """The rows of ``strip.csv``: mm along the arch curve, and world x, y of each column, mm."""
    picture: bytes
    """Of ``strip.png``."""


def read_scaled_strip(folder: Path, factor: float) -> ScaledStrip:
    """The strip of a panorama's folder, its lengths multiplied by ``factor`` (millimetres per pixel where they are
    pixels). Raises InputError where a file is missing or damaged."""
    value, text = read_json(folder / "strip.json"), read_text(folder / "strip.csv")
    picture = read_bytes(folder / "strip.png", "image")
    read_rgba(folder / "strip.png")  # which is to be shown
    with reading(folder / "strip.json"):
        mm_per_px = factor * number("mm_per_px", value["mm_per_px"] or 1.0, 1e-6, LONGEST_MM)
        header = {**value, "mm_per_px": mm_per_px, "length_mm": value["width_px"] * mm_per_px}
    with reading(folder / "strip.csv"):
        columns = [
            {"column": int(row["column"]), **{name: factor * float(row[name]) for name in ("along", "x", "y")}}
            for row in csv.DictReader(text.splitlines())
        ]
    return ScaledStrip(header, columns, picture)


def write_scaled_strip(folder: Path, strip: ScaledStrip) -> None:
    """Write a strip into a folder. Raises OutputError."""
    write_bytes(folder / "strip.png", strip.picture)
    write_table(folder / "strip.csv", strip.columns, digits=4)
    write_json(folder / "strip.json", strip.header)
