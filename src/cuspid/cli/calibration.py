"""Boards to print, and the calibration of a rig from images of one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import UInt8
from rich.table import Table
from tyro.conf import Positional, arg

from cuspid import storage
from cuspid.board import Board, BoardSet, Target
from cuspid.calibration.calibrate import (
    CalibrationOptions,
    RigCalibration,
    calibrate_rig,
    in_frame_of,
    size_notes,
)
from cuspid.calibration.causes import MOST_TRIED, cause_of_absence, is_part_of_a_larger_one
from cuspid.calibration.circle_centres import measured_share
from cuspid.calibration.corners import BoardView, Views, find_corners
from cuspid.calibration.instants import common_instants
from cuspid.calibration.lenses import LensChoice
from cuspid.calibration.photometry import Photometry, PhotometryOptions, calibrate_light, look_at_patches
from cuspid.calibration.start import LEAST_VIEWS
from cuspid.calibration.target import PLATE_MM, target_body
from cuspid.calibration.uncertainty import lens_difference_px, projection_sigma_px
from cuspid.cli.report import report
from cuspid.cli.shared import Flat, console, named, show_progress
from cuspid.errors import InputError, ReconstructionError
from cuspid.image_sequence import ImageSequence
from cuspid.options import Range
from cuspid.progress import Progress
from cuspid.reporting.figures.calibration import (
    save_board,
    save_lenses_picture,
    save_photometry_picture,
    save_residuals_picture,
    save_uncertainty_picture,
)
from cuspid.rig import Handpiece, Light, depth_of_field_mm
from cuspid.simulation.board_images import PhotographOptions, take_photographs
from cuspid.simulation.manufacturing import ManufacturingOptions, built
from cuspid.workers import map_in_threads

_OTHER_CIRCLES = 0.06
"""Error of the diameter of circles, as a share, that is told."""
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
    true = built(storage.read_handpiece(handpiece), manufacturing)
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
    sources = storage.rig_sources(images)
    hashes = {name: storage.hash_source(path) for name, path in sources.items()}
    given = None if drawn is None else storage.read_handpiece(drawn)
    drawn_hash = {} if drawn is None else {"drawn": storage.hash_file(drawn)}
    with storage.claimed_folder(out, "frames", {}, hashes), show_progress() as progress:
        sequences = {
            name: storage.read_sequence(path, out / "frames" / name, progress=progress)
            for name, path in sources.items()
        }
        sequences, named_notes = _matched(sequences)
        views = _views(sequences, shown, progress)
        _require_views(sequences, views, shown)
        found = calibrate_rig(views, {name: each.size for name, each in sequences.items()}, shown, options)
        drawn_notes = () if given is None else size_notes(found.rig, given.rig, shown)
        drawn_notes += tuple(_other_circles(sequences, views, shown))
        found = found if given is None else in_frame_of(found, given.rig)
        light = None
        if photometry.photometry and isinstance(shown, Board):
            light = _light(found, sequences, shown, given, photometry, progress)
    read = (note for each in sequences.values() for note in each.notes)
    notes = (*read, *named_notes, *_unseen(sequences, views), *drawn_notes, *found.notes)
    found = replace(found, notes=notes)
    with storage.claimed_folder(out, "calibrate", settings, hashes | drawn_hash, replace=True):
        _write(found, light, _handpiece(found, light, given, working_distance_mm), shown, out)
    _print(found, out)
    if light is not None:
        _print_light(light)
    report(out)


def _light(
    found: RigCalibration,
    sequences: Mapping[str, ImageSequence],
    board: Board,
    drawn: Handpiece | None,
    options: PhotometryOptions,
    progress: Progress,
) -> Photometry:
    """What the cameras make of light, from the images that were used."""
    index = {name: {frame: k for k, frame in enumerate(each.names)} for name, each in sequences.items()}

    def image(camera: str, instant: str) -> UInt8[np.ndarray, "h w 3"]:
        return sequences[camera].image(index[camera][instant])

    patches = look_at_patches(found, image, board, options, progress=progress)
    return calibrate_light(found, patches, board, drawn, options)


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


def _matched(sequences: Mapping[str, ImageSequence]) -> tuple[dict[str, ImageSequence], tuple[str, ...]]:
    """With frames that have one name where they were taken at one instant, and how they were matched if not by theirs.
    Raises InputError where nothing tells."""
    instants = common_instants({camera: each.names for camera, each in sequences.items()})
    if instants is None:
        return dict(sequences), ()
    (one, first), (other, second) = [(camera, each.names[0]) for camera, each in sequences.items()][:2]
    note = (
        f"images are matched by the numbers in their names ({one}: {first} is {instants[one][0]}, {other}: {second} is "
        f"{instants[other][0]})"
    )
    return {camera: replace(each, instants=instants[camera]) for camera, each in sequences.items()}, (note,)


def _views(sequences: Mapping[str, ImageSequence], board: Target, progress: Progress) -> Views:
    """The board in every image that shows it."""
    images = [(camera, index) for camera, sequence in sequences.items() for index in range(len(sequence))]

    def find(image: tuple[str, int]) -> BoardView | None:
        camera, index = image
        return find_corners(cv2.cvtColor(sequences[camera].image(index), cv2.COLOR_RGB2GRAY), board)

    found = map_in_threads(find, images, stage="corners", progress=progress)
    return {
        (camera, sequences[camera].names[index]): view
        for (camera, index), view in zip(images, found, strict=True)
        if view is not None
    }


def _require_views(sequences: Mapping[str, ImageSequence], views: Views, board: Target) -> None:
    """Raise ReconstructionError, which names the cause, where a camera hardly saw the board as it was described, or saw
    a larger one."""
    for name, sequence in sequences.items():
        seen = [index for index, instant in enumerate(sequence.names) if (name, instant) in views]
        unseen = [index for index in range(len(sequence)) if index not in set(seen)]
        if len(seen) >= LEAST_VIEWS:
            if isinstance(board, Board) and is_part_of_a_larger_one(_some(sequence, seen), board):
                raise ReconstructionError(
                    f"calibration: the board in the images of camera {name} has a square more each way; the corners "
                    f"were counted, not the squares: give --columns {board.columns + 1} --rows {board.rows + 1}"
                )
        elif (cause := cause_of_absence(_some(sequence, unseen), board)) is not None:
            raise ReconstructionError(
                f"calibration: the board is found in {len(seen)} of {len(sequence)} images of camera {name}; {cause}"
            )


def _other_circles(sequences: Mapping[str, ImageSequence], views: Views, board: Target) -> Iterator[str]:
    """Where circles are not as large as was said, so that their centres are not corrected as they should be."""
    if isinstance(board, BoardSet) or not board.has_circles:
        return
    name, sequence = next(iter(sequences.items()))
    seen = [index for index, instant in enumerate(sequence.names) if (name, instant) in views]
    shares = [each for each in (measured_share(image, board) for image in _some(sequence, seen)) if each is not None]
    share = float(np.median(shares)) if shares else board.circle_share
    if abs(share / board.circle_share - 1) > _OTHER_CIRCLES:
        yield (
            f"the circles are {share:.2f} of their distance wide, not {board.circle_share:g}: give --circle-share "
            f"{share:.2f}, for their centres are not seen in the middle, by how much depends on it"
        )


def _some(sequence: ImageSequence, indices: Sequence[int]) -> list[UInt8[np.ndarray, "h w"]]:
    """A few of some images, evenly, in grey."""
    tried = [indices[k] for k in np.unique(np.linspace(0, len(indices) - 1, MOST_TRIED).astype(int))] if indices else []
    return [cv2.cvtColor(sequence.image(index), cv2.COLOR_RGB2GRAY) for index in tried]


def _unseen(sequences: Mapping[str, ImageSequence], views: Views) -> Iterator[str]:
    """In which images the board was not found."""
    for name, sequence in sequences.items():
        unseen = [instant for instant in sequence.names if (name, instant) not in views]
        if unseen:
            yield f"camera {name}: the board was not found in {len(unseen)} of {len(sequence)} images: {named(unseen)}"


def _handpiece(
    found: RigCalibration, light: Photometry | None, drawn: Handpiece | None, working_distance_mm: float | None
) -> Handpiece:
    """The drawn handpiece with what was found, or one of what was found alone."""
    sensors = {} if light is None else light.sensors
    if drawn is not None:
        lights = drawn.lights if light is None else light.lights
        known = replace(drawn, rig=found.rig, lights=lights, sensors={**drawn.sensors, **sensors}, name="calibrated")
        return known if working_distance_mm is None else _focused(known, working_distance_mm)
    distance_mm = found.distance_mm if working_distance_mm is None else working_distance_mm
    return _focused(Handpiece(rig=found.rig.over_surface(distance_mm), sensors=sensors, name="calibrated"), distance_mm)


def _focused(handpiece: Handpiece, distance_mm: float) -> Handpiece:
    return replace(handpiece, working_distance_mm=distance_mm, depth_range_mm=depth_of_field_mm(distance_mm))


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
        apart = [_shown(value, 1) for value in (each.parameters_apart, each.place_apart)]
        pixels = [_shown(value) for value in (each.rms_px, each.alone_px, each.held_out_px)]
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
        left = [_shown(value) for value in (each.noise_dn, each.before_pct, each.held_out_pct)]
        table.add_row(name, gain, corner, gamma, *left)
    console.print(table)
    found = [np.sqrt(np.diag(lamp.covariance)) for lamp in light.lights.values() if lamp.covariance is not None]
    if found:
        place, power = 1000 * np.median([each[:3] for each in found]), 100 * np.median([each[3] for each in found])
        console.print(
            f"{len(found)} lights: positions to {place:.0f} um along each axis, powers to {power:.1f} % (medians)"
        )


def _shown(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
