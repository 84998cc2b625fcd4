"""Calibrations of other programs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from cuspid import storage
from cuspid.cli.shared import console
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Range
from cuspid.runtime.values import MOST_PX, join_names
from cuspid.storage.calibrations import (
    MOST_LOST_PX,
    Loss,
    Name,
    fit_to_format,
    format_of_name,
    read_calibration,
    write_calibration,
)


def convert(
    source: Annotated[Path, Positional, arg(metavar="IN")],
    target: Annotated[Path, Positional, arg(metavar="OUT")],
    *,
    from_: Annotated[Name | None, arg(name="from")] = None,
    to: Name | None = None,
    unit: storage.Unit | None = None,
    image_size: Annotated[tuple[int, int] | None, arg(metavar="W H"), Range(1, MOST_PX)] = None,
    working_distance_mm: Annotated[float | None, Range(0.1, 100_000)] = None,
    max_px: Annotated[float, Range(0, 1e9)] = MOST_LOST_PX,
) -> None:
    """Convert the calibration of a camera, a stereo pair or several cameras between cuspid and other programs.

    Args:
        source: File to read, or a folder where a program writes several (ROS, OpenCV's intrinsics and extrinsics).
        target: File to write: handpiece.json and other .json, rig_config.json, transforms.json, stereoParams.json,
            camchain.yaml (Kalibr), other .yml, .yaml (OpenCV), camera_array.toml (caliscope), other .toml (anipose),
            .xml (Metashape); or a folder, for two cameras of ROS.
        from_: Format of the file, where its content does not show it.
        to: Format to write, where the name does not show it.
        unit: Unit of the lengths that are read, where the file does not state it.
        image_size: Width and height of the images, px, where the file does not state them.
        working_distance_mm: Distance from the cameras to the surface, for a handpiece.json (guessed unless given).
        max_px: A lens that the other format does not have is replaced by the nearest that it has; more than this
            difference in the image is refused.
    """
    kind = to or format_of_name(target)
    if target.resolve() == source.resolve():
        raise InputError(f"convert: {target}: is the file that is read; give another name for the result")
    read = read_calibration(source, kind=from_, unit=unit, image_size_px=image_size)
    _tell(source, read.losses, read.notes, max_px)
    carried = fit_to_format(read.rig, kind)
    _tell(target, carried.losses, carried.notes, max_px)
    write_calibration(target, carried.rig, kind, working_distance_mm)
    names = list(read.rig.names)
    summary = f"{target}: {kind}, {len(names)} camera(s) ({join_names(names)}), from {read.format}"
    console.print(summary, soft_wrap=True, highlight=False)


def _tell(path: Path, losses: Mapping[str, Loss], notes: tuple[str, ...], max_px: float) -> None:
    """Say what is lost. Raises InputError where that is too much."""
    for name, loss in losses.items():
        if loss.largest_px > max_px:
            raise InputError(f"{path}: camera {name}: {loss}; --max-px {max_px:g} allows less")
    for note in (*(f"camera {name}: {loss}" for name, loss in losses.items()), *notes):
        console.print(f"note: {path}: {note}", soft_wrap=True, highlight=False)
