"""Make a capture from what cameras recorded: folders of images, or videos."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.table import Table
from tyro.conf import Positional

from cuspid import storage
from cuspid.cli.shared import Flat, console, show_progress
from cuspid.footage.films import DevelopmentOptions
from cuspid.footage.plan import Films, ImportOptions, Plan, SelectionOptions, check_lightings, kinds_of, plan_import
from cuspid.footage.quality import Looks, QualityOptions
from cuspid.footage.stage import develop, open_films, survey
from cuspid.footage.synchronise import SyncOptions
from cuspid.runtime.options import Range

_SHOWN = 5
"""Number of frames named for each reason; import.json lists all."""


def import_(
    footage: Annotated[Path, Positional],
    *,
    handpiece: Path,
    out: Path,
    times: Path | None = None,
    lightings: tuple[str, ...] = (),
    working_distance_mm: Annotated[float | None, Range(0.1, 100_000)] = None,
    sync: Annotated[SyncOptions, Flat] = SyncOptions(),
    quality: Annotated[QualityOptions, Flat] = QualityOptions(),
    development: Annotated[DevelopmentOptions, Flat] = DevelopmentOptions(),
    selection: Annotated[SelectionOptions, Flat] = SelectionOptions(),
) -> None:
    """Make a capture from footage: synchronise the cameras, and drop blurred, dark, burnt-out and duplicate images.

    Args:
        footage: Folder with a subfolder of images, or a video, for each camera, named like the camera in the handpiece.
        handpiece: A handpiece.json, or COLMAP's rig_config.json.
        out: Folder for the capture, the input of cuspid reconstruct.
        times: CSV file with the columns camera, frame and time (s); default: times.csv or timestamps.csv in the footage
            folder, if there is one.
        lightings: Lighting patterns of the handpiece that take turns, in the order in which the frames of the film have
            them (default: its only one).
        working_distance_mm: Distance from the cameras to the teeth, for a rig_config.json, which does not contain it
            (guessed unless given).
    """
    options = ImportOptions(sync=sync, quality=quality, selection=selection, lightings=lightings)
    known = storage.read_handpiece(handpiece, working_distance_mm)
    check_lightings(options, known)
    films = open_films(storage.rig_sources(footage), known)
    table = times or next((footage / name for name in storage.TIMES_FILES if (footage / name).is_file()), None)
    taken = None if table is None else storage.read_frame_times(table, list(films))
    hashes = {name: film.digest for name, film in films.items()}
    given = {"handpiece": storage.hash_file(handpiece)} | ({} if table is None else {"times": storage.hash_file(table)})
    settings = {"import": options, "development": development, "working_distance_mm": working_distance_mm}
    with show_progress() as progress:
        with storage.claimed_folder(out, "footage", {}, hashes, replace=True):
            looks = survey(films, out, development, progress)
            plan = plan_import(films, looks, known, options, taken)
        with storage.claimed_folder(out, "import", settings, {**hashes, **given}):
            develop(films, plan, known, out, development, progress)
    storage.write_table(out / "frames.csv", _rows(plan, films, looks))
    storage.write_json(out / "import.json", _figures(plan, films, looks, options))
    _print(plan, looks, out)


def _rows(plan: Plan, films: Films, looks: Mapping[str, Looks]) -> list[dict[str, object]]:
    """A row for each image that a frame could have."""
    reasons = {(each.frame, each.camera): each.reason for each in plan.bad}
    return [
        {
            "frame": frame,
            "camera": camera,
            "source": films[camera].name(number),
            "time_s": _format_value(plan.times_s[camera][number], 6),
            "level_dn": _format_value(looks[camera].level_dn[number], 2),
            "sharpness": _format_value(looks[camera].sharpness[number], 4),
            "change_dn": _format_value(looks[camera].change_dn[number], 3),
            "left_out": reasons.get((frame, camera)),
        }
        for frame, numbers in plan.numbers.items()
        for camera, number in numbers.items()
    ]


def _figures(plan: Plan, films: Films, looks: Mapping[str, Looks], options: ImportOptions) -> dict[str, object]:
    return {
        "sync": options.sync.sync,
        "starts_frames": plan.starts_frames,
        "apart_ms": None if plan.apart_ms is None else {"median": _median(plan.apart_ms), "max": _max(plan.apart_ms)},
        "frames": len(plan.frames),
        "cameras": {
            name: {
                "source": film.source.name,
                "frames": len(looks[name].level_dn),
                "used": sum(name in frame.cameras for frame in plan.frames),
                "left_out": kinds_of([each for each in plan.bad if each.camera == name]),
            }
            for name, film in films.items()
        },
        "left_out": [{"frame": each.frame, "camera": each.camera, "reason": each.reason} for each in plan.bad],
        "notes": plan.notes,
    }


def _format_value(value: float, digits: int) -> float | None:
    return round(float(value), digits) if np.isfinite(value) else None


def _median(values: np.ndarray) -> float:
    return round(float(np.nanmedian(values)), 3)


def _max(values: np.ndarray) -> float:
    return round(float(np.nanmax(values)), 3)


def _print(plan: Plan, looks: Mapping[str, Looks], out: Path) -> None:
    for note in plan.notes:
        console.print(f"note: {note}", soft_wrap=True)
    table = Table(title="Import")
    for heading in ("camera", "film", "began after", "images", "left out"):
        table.add_column(heading, justify="left" if heading in ("camera", "left out") else "right")
    for name, each in looks.items():
        began = "-" if plan.starts_frames is None else f"{plan.starts_frames[name]} frames"
        used = sum(name in frame.cameras for frame in plan.frames)
        table.add_row(name, f"{len(each.level_dn)} frames", began, str(used), "; ".join(_drop_notes(plan, name)) or "-")
    console.print(table)
    if plan.apart_ms is not None:
        apart = f"{_median(plan.apart_ms):.1f} ms apart at the median, {_max(plan.apart_ms):.1f} at most"
        console.print(f"according to their times, the images of a frame are {apart}")
    console.print(f"{out}: {len(plan.frames)} frames of {len(looks)} cameras")


def _drop_notes(plan: Plan, camera: str) -> Iterator[str]:
    """What was left out of a camera's images: ``2 blurred (00004, 00007)``."""
    bad = [each for each in plan.bad if each.camera == camera]
    for kind, count in kinds_of(bad).items():
        names = [each.frame for each in bad if each.kind == kind]
        yield f"{count} {kind} ({', '.join(names[:_SHOWN])}{', ...' if count > _SHOWN else ''})"
