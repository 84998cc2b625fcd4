"""Panoramas: a picture, where it lies in the world, and which frame each of its pixels came from.

A panorama's folder holds ``panorama.png`` (RGBA, transparent where nothing was seen), ``panorama.json`` (scale, origin,
method), the world file ``panorama.pgw`` that GIS programs read beside a PNG, ``frames.csv`` and ``source.npz``.
"""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from cuspid.model.panorama import ZONES, FrameUse, Panorama, Strip
from cuspid.runtime.errors import InputError, OutputError
from cuspid.runtime.image_files import read_rgba
from cuspid.runtime.inputs import read_text
from cuspid.runtime.values import LONGEST_MM, MOST_PX, number, numbers
from cuspid.storage.files import as_declared, read_arrays, read_json, reading, write_arrays, write_bytes, write_json
from cuspid.storage.tables import write_table

_HEADER = ("method", "mm_per_px", "origin_px", "part", "parts", "notes")
_SOURCE = ("frame_index", "frame_pixel", "height_mm")


def write_panorama(folder: Path, panorama: Panorama) -> None:
    """Write a panorama into a folder. Raises OutputError."""
    rgba = np.dstack([panorama.image, np.where(panorama.covered, 255, 0).astype(np.uint8)])
    write_table(folder / "frames.csv", [dataclasses.asdict(frame) for frame in panorama.frames])
    write_bytes(folder / "panorama.pgw", world_file(panorama).encode())
    write_arrays(folder / "source.npz", _source(panorama), compressed=True)
    write_bytes(folder / "panorama.png", _png(folder / "panorama.png", rgba))
    write_json(folder / "panorama.json", _header(panorama))


def world_file(panorama: Panorama) -> str:
    """The six lines of a world file: x of a column's step, two rotations of 0, y of a row's step, and the world's place
    of the first pixel's centre, in mm (in px where the scale is unknown)."""
    step = panorama.mm_per_px or 1.0
    first = panorama.world_from_pixels(np.array([0.5, 0.5]))
    return "".join(f"{value:.9f}\n" for value in (step, 0.0, 0.0, -step, *first))


def _header(panorama: Panorama) -> dict[str, Any]:
    height, width = panorama.covered.shape
    return {
        "width_px": width,
        "height_px": height,
        **{name: getattr(panorama, name) for name in _HEADER},
        "size_mm": panorama.size_mm,
        "frame": "occlusal: XY the occlusal plane, +Z out of the gum; x = (u - u0) s, y = (v0 - v) s",
        "covered_pct": 100 * float(panorama.covered.mean()),
        "frames_used": sum(frame.used for frame in panorama.frames),
        "frames": len(panorama.frames),
    }


def _source(panorama: Panorama) -> dict[str, np.ndarray]:
    return {name: array for name in _SOURCE if (array := getattr(panorama, name)) is not None}


def read_panorama(folder: Path) -> Panorama:
    """Read what :func:`write_panorama` wrote. Raises InputError where a file is missing or damaged."""
    path = folder / "panorama.json"
    value = read_json(path)
    rgba = read_rgba(folder / "panorama.png")
    frames = _read_frames(folder / "frames.csv")
    arrays = read_arrays(folder / "source.npz", remedy="run cuspid pano stitch again")
    with reading(path):
        if len(frames) != value["frames"]:
            raise InputError(f"{folder / 'frames.csv'}: truncated; run cuspid pano stitch again")
        header: dict[str, Any] = {name: value[name] for name in _HEADER}
        header["origin_px"] = numbers("origin_px", value["origin_px"], (2,), -float(MOST_PX), float(MOST_PX))
        header["notes"] = tuple(value["notes"])
        if header["mm_per_px"] is not None:
            number("mm_per_px", header["mm_per_px"], 1e-6, LONGEST_MM)
        source: dict[str, Any] = {name: arrays[name] for name in _SOURCE if name in arrays}
        image = np.ascontiguousarray(rgba[..., :3])
        return as_declared(Panorama, image=image, covered=rgba[..., 3] > 0, frames=frames, **header, **source)


def _read_frames(path: Path) -> tuple[FrameUse, ...]:
    text = read_text(path)
    with reading(path):
        return tuple(
            FrameUse(
                name=row["name"],
                used=row["used"] == "True",
                reason=row["reason"] or None,
                inliers=int(row["inliers"]) if row["inliers"] else None,
                overlap=float(row["overlap"]) if row["overlap"] else None,
            )
            for row in csv.DictReader(text.splitlines())
        )


def write_strip(folder: Path, strip: Strip) -> None:
    """Write ``strip.png`` (RGBA), ``strip.json`` (scale, how much of each zone is seen) and ``strip.csv`` (the arch
    curve: mm along it and world x, y of each column)."""
    rgba = np.dstack([strip.image, np.where(strip.covered, 255, 0).astype(np.uint8)])
    step = strip.mm_per_px or 1.0
    write_bytes(folder / "strip.png", _png(folder / "strip.png", rgba))
    rows = [
        {"column": column, "along": column * step, "x": float(x), "y": float(y)}
        for column, (x, y) in enumerate(strip.curve)
    ]
    write_table(folder / "strip.csv", rows, digits=4)
    height, width = strip.covered.shape
    zones = {name: float(np.mean(strip.zone == number)) for number, name in enumerate(ZONES)}
    write_json(
        folder / "strip.json",
        {
            "width_px": width,
            "height_px": height,
            "mm_per_px": strip.mm_per_px,
            "length_mm": width * strip.mm_per_px if strip.mm_per_px else None,
            "share_of_zone": zones,
        },
    )


def _png(path: Path, rgba: UInt8[np.ndarray, "h w 4"]) -> bytes:
    ok, encoded = cv2.imencode(".png", cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))
    if not ok:
        raise OutputError(f"{path}: the image could not be encoded")
    return bytes(encoded)
