"""Strips of another scale: the picture stays, what is told in millimetres grows."""

from __future__ import annotations

import csv
from pathlib import Path

from cuspid.inputs import read_bytes, read_text
from cuspid.storage.files import read_json, reading, write_bytes, write_json
from cuspid.storage.tables import write_table
from cuspid.values import LONGEST_MM, number


def write_scaled_strip(folder: Path, out: Path, factor: float) -> None:
    """Write the strip of a panorama's folder into another folder, its lengths multiplied by ``factor`` (millimetres per
    pixel where they are pixels). Raises InputError where a file is missing or damaged."""
    value, text = read_json(folder / "strip.json"), read_text(folder / "strip.csv")
    picture = read_bytes(folder / "strip.png", "image")
    with reading(folder / "strip.json"):
        mm_per_px = factor * number("mm_per_px", value["mm_per_px"] or 1.0, 1e-6, LONGEST_MM)
        scaled = {**value, "mm_per_px": mm_per_px, "length_mm": value["width_px"] * mm_per_px}
    with reading(folder / "strip.csv"):
        rows = [
            {"column": int(row["column"]), **{name: factor * float(row[name]) for name in ("along", "x", "y")}}
            for row in csv.DictReader(text.splitlines())
        ]
    write_bytes(out / "strip.png", picture)
    write_table(out / "strip.csv", rows, digits=4)
    write_json(out / "strip.json", scaled)
