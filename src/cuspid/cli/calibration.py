"""Boards to print, and the calibration of a rig from images of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.table import Table
from tyro.conf import Positional, arg

from cuspid import storage
from cuspid.calibration.calibrate import (
    CalibrationOptions,
    RigCalibration,
)
from cuspid.calibration.from_images import calibrate as calibrate_images
from cuspid.calibration.lenses import LensChoice
from cuspid.calibration.photometry import Photometry, PhotometryOptions
from cuspid.calibration.target import PLATE_MM, target_body
from cuspid.calibration.uncertainty import lens_difference_px, projection_sigma_px
from cuspid.cli.report import report
from cuspid.cli.shared import Flat, console, show_progress
from cuspid.model.board import Board, BoardSet, Target
from cuspid.model.rig import Handpiece, Light
from cuspid.report.figures.calibration import (
    save_board,
    save_lenses_picture,
    save_photometry_picture,
    save_residuals_picture,
    save_uncertainty_picture,
)
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Range
from cuspid.simulation.board_images import PhotographOptions, take_photographs
from cuspid.simulation.manufacturing import ManufacturingOptions, sample_built

BoardFiles = Annotated[tuple[Path, ...], arg(name="board")]
"""Boards that are described by files."""


def target(*, out: Path, board: Annotated[Board, Flat] = Board(), board_files: BoardFiles = ()) -> None:
    """Draw a board at true size for printing, or make the body that the print is mounted on.

    Args:
        out: PDF, SVG or PNG file for the pattern (with terraces, a strip to be folded over them), or STL file for the
            body. Of several boards each has its number appended.
        board_files: YAML files that describe the board or boards, instead of options: Kalibr's, or options by name.
    """
    boards = target_of(board, board_files).boards
    for number, each in enumerate(boards, 1):
        _draw(out if len(boards) == 1 else out.with_stem(f"{out.stem}-{number}"), each)


def target_of(board: Board, files: Sequence[Path], copies: int = 1) -> Target:
    """What cameras are calibrated from. Raises InputError where it is said twice."""
    if files and board != Board():
        raise InputError("--board describes the board; leave out its other options")
    boards = [each for path in files for each in storage.read_boards(path)] or [board]
    if copies > 1:
        if len(boards) > 1:
            raise InputError(f"--copies {copies}: the files describe {len(boards)} boards already")
        first = boards[0]
        boards = [replace(first, first_id=first.first_id + k * first.markers) for k in range(copies)]
    return boards[0] if len(boards) == 1 else BoardSet(boards=tuple(boards))


def _draw(out: Path, board: Board) -> None:
    width, height = board.size_mm
    if out.suffix.lower() == ".stl":
        storage.write_mesh(out, target_body(board))
        size = f"{width:g} x {height:g} x {PLATE_MM + board.height_mm:g} mm"
        console.print(f"{out}: {size}; measure its steps, and give the measured values")
        return
    save_board(out, board)
    size = f"{width + board.height_mm:g} x {height:g} mm"
    console.print(f"{out}: {size}; measure the ruler on the print, and give the length of one of its parts")


def photograph(
    handpiece: Annotated[Path, Positional],
    *,
    out: Path,
    board: Annotated[Board, Flat] = Board(),
    options: Annotated[PhotographOptions, Flat] = PhotographOptions(),
    manufacturing: Annotated[ManufacturingOptions, Flat] = ManufacturingOptions(),
) -> None:
    """Photograph a board with a handpiece in simulation, to rehearse its calibration.

    Args:
        handpiece: A handpiece.json, or COLMAP's rig_config.json.
        out: Folder for images/, the input of cuspid calibrate, and truth/handpiece.json, the handpiece that took them.
    """
    settings = {"board": board, "options": options, "manufacturing": manufacturing}
    hashes = {"handpiece": storage.hash_file(handpiece)}
    true = sample_built(storage.read_handpiece(handpiece), manufacturing)
    with storage.claimed_folder(out, "photograph", settings, hashes), show_progress() as progress:
        take_photographs(true, board, out, options, progress=progress)
    console.print(f"{out / 'images'}: {options.instants} instants of {len(true.rig.names)} cameras")


def calibrate(
    images: Annotated[Path, Positional],
    *,
    out: Path,
    board: Annotated[Board, Flat] = Board(),
    board_files: BoardFiles = (),
    copies: Annotated[int, Range(1, 50)] = 1,
    working_distance_mm: Annotated[float | None, Range(0.1, 100_000)] = None,
    drawn: Path | None = None,
    options: Annotated[CalibrationOptions, Flat] = CalibrationOptions(),
    photometry: Annotated[PhotometryOptions, Flat] = PhotometryOptions(),
) -> None:
    """Calibrate the cameras of a rig from images of a board: handpiece.json, with the covariance of every parameter.

    Args:
        images: Folder with a subfolder of images, or a video, for each camera; images taken at the same instant share a
            name.
        out: Folder for handpiece.json, rig_config.json, calibration.json (the quality of each camera), residuals.png,
            uncertainty.png, lenses.png (what a richer lens model would change), photometry.png and report.html.
        board_files: YAML files that describe the board or boards, instead of options: Kalibr's, or options by name.
            Several boards must be fixed to one another, and have markers with different ids.
        copies: Number of boards of this kind, fixed to one another, whose ids go on from one to the next.
        working_distance_mm: Distance from the cameras to the teeth; default: that of the drawn handpiece, or else the
            median distance of the board.
        drawn: handpiece.json of the handpiece as it was drawn (its design). Its lights, and no others, must have lit
            the board; they are calibrated too.
    """
    shown = target_of(board, board_files, copies)
    settings = {
        "board": shown,
        "options": options,
        "working_distance_mm": working_distance_mm,
        "photometry": photometry,
    }
    hashes = {name: storage.hash_source(path) for name, path in storage.rig_sources(images).items()}
    given = None if drawn is None else storage.read_handpiece(drawn)
    drawn_hash = {} if drawn is None else {"drawn": storage.hash_file(drawn)}
    with storage.claimed_folder(out, "frames", {}, hashes), show_progress() as progress:
        sequences = storage.read_sequences(images, out / "frames", progress=progress)
        calibration = calibrate_images(
            sequences,
            shown,
            options,
            photometry=photometry,
            drawn=given,
            working_distance_mm=working_distance_mm,
            progress=progress,
        )
    found, light = calibration.rig, calibration.light
    with storage.claimed_folder(out, "calibrate", settings, hashes | drawn_hash, replace=True):
        _write(found, light, calibration.handpiece, shown, out)
    _print(found, out)
    if light is not None:
        _print_light(light)
    report(out)


def _write(found: RigCalibration, light: Photometry | None, handpiece: Handpiece, board: Target, out: Path) -> None:
    storage.write_handpiece(out / "handpiece.json", handpiece)
    storage.write_rig_config(out / "rig_config.json", handpiece.rig)
    storage.write_json(out / "calibration.json", {**_figures(found, board), **_light_figures(light)})
    cameras = {name: mounted.camera for name, mounted in handpiece.rig.cameras.items()}
    save_residuals_picture(out / "residuals.png", cameras, found.pixels, found.residuals, title="residuals")
    sigma_px = {name: projection_sigma_px(camera) for name, camera in cameras.items()}
    save_uncertainty_picture(out / "uncertainty.png", cameras, sigma_px)
    _draw_rivals(found, out / "lenses.png")
    if light is not None and light.sensors:
        shown = {name: (each.levels_dn, each.variances_dn2) for name, each in light.noise.items()}
        save_photometry_picture(out / "photometry.png", light.sensors, shown, light.residuals_pct)


def _draw_rivals(found: RigCalibration, path: Path) -> None:
    """What another lens model would change, where more than one was tried."""
    path.unlink(missing_ok=True)
    tried = {
        name: (choice.chosen, choice.rival)
        for name, choice in found.lenses.items()
        if choice.chosen is not None and choice.rival is not None
    }
    if tried:
        moved = {name: lens_difference_px(*pair, found.pixels[name]) for name, pair in tried.items()}
        save_lenses_picture(path, tried, moved, found.pixels)


def _figures(found: RigCalibration, board: Target) -> dict[str, object]:
    bent = {"board_bending_mm": found.bending_mm}
    steps = {"board_step_mm": board.step_mm + found.bending_mm[0]} if isinstance(board, Board) else {}
    return {
        "sigma_px": found.sigma_px,
        "board_uneven_mm": found.uneven_mm,
        "views_loose_px": found.loose_px,
        **(bent if board.terraces == 1 else steps),
        **({"boards": _boards(found, board)} if isinstance(board, BoardSet) else {}),
        "board_distance_mm": found.distance_mm,
        "frames_per_s": found.frames_per_s,
        "cameras": {
            name: {**asdict(each), "widened": found.widened[name], "lens": _lens_figures(found.lenses[name])}
            for name, each in found.cameras.items()
        },
        "notes": found.notes,
    }


def _boards(found: RigCalibration, boards: BoardSet) -> list[dict[str, object]]:
    """Each of several boards, and where it is on the body that they are fixed to; the others carry its frame."""
    return [
        {
            "kind": board.kind,
            "ids": [board.ids[0], board.ids[-1]],
            "body_from_board": found.body_from_board[number].matrix if number in found.body_from_board else None,
            "views": sum((boards.board_of(view.corner) == number).any() for view in found.views.values()),
        }
        for number, board in enumerate(boards.boards)
    ]


def _lens_figures(choice: LensChoice) -> dict[str, object]:
    return {"model": choice.model, "held_out_px": choice.held_out_px}


def _light_figures(light: Photometry | None) -> dict[str, object]:
    if light is None:
        return {}
    lights = {name: _lamp_figures(lamp) for name, lamp in light.lights.items() if lamp.covariance is not None}
    return {
        "photometry": {
            "cameras": {name: asdict(each) for name, each in light.cameras.items()},
            "lights": lights,
            "light_deviation_pct": light.light_deviation_pct,
            "halves_apart": light.halves_apart,
            "notes": light.notes,
        }
    }


def _lamp_figures(lamp: Light) -> dict[str, object]:
    sigma = np.sqrt(np.diag(np.zeros((4, 4)) if lamp.covariance is None else lamp.covariance))
    return {
        "position_mm": lamp.position_mm,
        "position_sigma_um": 1000 * sigma[:3],
        "power": lamp.power,
        "power_sigma_pct": 100 * sigma[3],
    }


def _print(found: RigCalibration, out: Path) -> None:
    for note in found.notes:
        console.print(f"note: {note}")
    table = Table(title="Calibration")
    for heading in (
        "camera",
        "lens",
        "views",
        "corners",
        "RMS px",
        "alone px",
        "held out px",
        "halves apart: lens, place",
    ):
        table.add_column(heading, justify="left" if heading in ("camera", "lens") else "right")
    for name, each in found.cameras.items():
        apart = [_format_value(value, 1) for value in (each.parameters_apart, each.place_apart)]
        pixels = [_format_value(value) for value in (each.rms_px, each.alone_px, each.held_out_px)]
        model = found.lenses[name].model
        table.add_row(name, model, str(each.views), str(each.corners), *pixels, ", ".join(apart))
    console.print(table)
    for name, choice in found.lenses.items():
        if choice.model != "OPENCV" and choice.held_out_px:
            console.print(f"  lens of {name}: {choice.summary}")
    console.print(f"{out / 'handpiece.json'}: {len(found.cameras)} cameras, corners to {found.sigma_px:.2f} px")


def _print_light(light: Photometry) -> None:
    for note in light.notes:
        console.print(f"note: {note}")
    table = Table(title="Light")
    for heading in ("camera", "gain ±%", "corners %", "gamma ±%", "noise", "before %", "held out"):
        table.add_column(heading, justify="left" if heading == "camera" else "right", no_wrap=True)
    for name, each in light.cameras.items():
        gain = f"{each.gain:.3f} ±{each.gain_sigma_pct:.1f}"
        loss, sigma = each.corner_loss_pct, each.corner_loss_sigma_pct
        corner = "-" if loss is None or sigma is None else f"{-loss:.1f} ±{sigma:.1f}"
        gamma = f"{each.gamma:.2f} ±{each.gamma_sigma_pct:.1f}"
        left = [_format_value(value) for value in (each.noise_dn, each.before_pct, each.held_out_pct)]
        table.add_row(name, gain, corner, gamma, *left)
    console.print(table)
    found = [np.sqrt(np.diag(lamp.covariance)) for lamp in light.lights.values() if lamp.covariance is not None]
    if found:
        place, power = 1000 * np.median([each[:3] for each in found]), 100 * np.median([each[3] for each in found])
        console.print(
            f"{len(found)} lights: positions to {place:.0f} um along each axis, powers to {power:.1f} % (medians)"
        )


def _format_value(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
