"""Give a panorama the scale of distances that were measured in the mouth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.console import Console
from rich.table import Table
from tyro.conf import Positional, UseAppendAction, arg

from cuspid import storage
from cuspid.cli.panorama import clear, save_path_picture
from cuspid.cli.report import report
from cuspid.cli.shared import console
from cuspid.geometry import Rigid3
from cuspid.report.figures.panorama import save_distances
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Range
from cuspid.runtime.values import LONGEST_MM
from cuspid.stitching.rescaling import MeasuredDistance, Rescaled, rescale_panorama, scaled_pose
from cuspid.storage.files import read_manifest
from cuspid.storage.strips import read_scaled_strip, write_scaled_strip

_LEAST_MM = 0.1


def rescale(
    panorama: Annotated[Path, Positional],
    *,
    out: Path,
    distance: Annotated[
        UseAppendAction[tuple[tuple[float, float, float, float, float], ...]],
        arg(metavar="U1 V1 U2 V2 MM"),
        Range(-LONGEST_MM, LONGEST_MM),
    ],
) -> None:
    """Scale a panorama by distances that were measured in the mouth, with callipers between two cusps on either side of
    the arch, for example. Pictures stay as they are, all lengths become those of the measurement.

    Args:
        panorama: Folder that cuspid pano stitch wrote; of a sequence that broke, that of a part.
        out: Folder for the scaled panorama: the files of stitch, and distances.json and distances.png.
        distance: Two places of panorama.png, in px from its upper left corner, and how many mm lie between them. The
            page of the panorama gives the pixels of places that are clicked on. Of several (give it again), the scale
            is their least-squares fit, and the residual of each is printed.
    """
    if not distance:
        raise InputError("rescale: give at least one --distance U1 V1 U2 V2 MM")
    measured = tuple(_parse_distance(each) for each in distance)
    if out.resolve() == panorama.resolve():
        raise InputError(f"rescale: {out}: is the panorama itself; give another folder as --out")
    if not (panorama / "panorama.json").exists() and (panorama / "part-1").is_dir():
        raise InputError(f"{panorama}: has parts; give one of them: {panorama / 'part-1'}")
    if "stitch" in read_manifest(out):
        raise InputError(f"rescale: {out}: holds a panorama of cuspid pano stitch; give another folder as --out")
    before, poses = storage.read_panorama(panorama), _poses(panorama)
    found = rescale_panorama(before, measured)
    strip = read_scaled_strip(panorama, found.factor) if (panorama / "strip.json").exists() else None
    hashes = {name: storage.hash_file(panorama / name) for name in ("panorama.json", "panorama.png", "source.npz")}
    with storage.claimed_folder(out, "rescale", {"distance": distance}, hashes, replace=True):
        clear(out)
        if strip is not None:
            write_scaled_strip(out, strip)
        _write(out, found, poses, measured)
    _print(found, measured, unit="px" if before.mm_per_px is None else "mm")
    report(out)


def _parse_distance(given: tuple[float, float, float, float, float]) -> MeasuredDistance:
    """A distance of the command line."""
    if given[-1] < _LEAST_MM:
        raise InputError(f"rescale: --distance: {given[-1]:g} mm; it must be {_LEAST_MM} mm or more")
    return MeasuredDistance(places_px=np.reshape(given[:4], (2, 2)), mm=given[-1])


def _poses(panorama: Path) -> Mapping[str, Rigid3]:
    """Of the camera, none where the method locates none."""
    file = panorama / "poses.json"
    return storage.read_poses(file) if file.exists() else {}


def _write(out: Path, found: Rescaled, poses: Mapping[str, Rigid3], measured: tuple[MeasuredDistance, ...]) -> None:
    """All but the strip in the new millimetres, and what they are from."""
    if poses:
        scaled = {name: scaled_pose(pose, found.factor) for name, pose in poses.items()}
        storage.write_poses(out / "poses.json", scaled)
        save_path_picture(out, found.panorama, scaled)
    rows = [
        {"places_px": each.places_px, "measured_mm": each.mm, "panorama_mm": length}
        for each, length in zip(measured, found.lengths_mm, strict=True)
    ]
    storage.write_json(out / "distances.json", {"factor": found.factor, "distances": rows})
    save_distances(
        out / "distances.png",
        found.panorama,
        [each.places_px for each in measured],
        [each.mm for each in measured],
        found.lengths_mm.tolist(),
    )
    storage.write_panorama(out, found.panorama)


def _print(found: Rescaled, measured: tuple[MeasuredDistance, ...], unit: str) -> None:
    table = Table(title="Distances", title_justify="left")
    for head in ("between", "measured, mm", f"before, {unit}", "now, mm", "off, %"):
        table.add_column(head, justify="left" if head == "between" else "right")
    for each, length in zip(measured, found.lengths_mm, strict=True):
        first, second = (f"({u:g}, {v:g})" for u, v in each.places_px)
        off = f"{100 * (length / each.mm - 1):+.2f}"
        table.add_row(f"{first} {second}", f"{each.mm:g}", f"{length / found.factor:.2f}", f"{length:.2f}", off)
    Console().print(table)
    for note in found.panorama.notes:
        console.print(f"note: {note}")
