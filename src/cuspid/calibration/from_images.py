"""Calibrates a handpiece from images of a board: finds the board in each, calibrates the rig, and then its
photometry."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import UInt8

from cuspid.calibration.calibrate import CalibrationOptions, RigCalibration, calibrate_rig, in_frame_of, size_notes
from cuspid.calibration.causes import MOST_TRIED, cause_of_absence, is_part_of_a_larger_one
from cuspid.calibration.circle_centres import measure_circle_share
from cuspid.calibration.corners import BoardView, Views, find_corners
from cuspid.calibration.instants import common_instants
from cuspid.calibration.photometry import Photometry, PhotometryOptions, calibrate_light, look_at_patches
from cuspid.calibration.start import LEAST_VIEWS
from cuspid.model.board import Board, BoardSet, Target
from cuspid.model.image_sequence import ImageSequence
from cuspid.model.rig import Handpiece, depth_of_field_mm
from cuspid.runtime.errors import ReconstructionError
from cuspid.runtime.image_files import Pixels, full_range_grey
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.values import join_names
from cuspid.runtime.workers import map_in_threads

_OTHER_CIRCLES = 0.06
"""Error of the diameter of circles, as a share, that is told."""
_OTHER_RATE = 0.01
"""Share by which films have different rates."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration:
    """A calibrated handpiece, and how well the images of the board agree with it."""

    handpiece: Handpiece
    """The drawn handpiece with what was found, or one of what was found alone."""
    rig: RigCalibration
    """The cameras, and what was left out and why."""
    light: Photometry | None
    """What the cameras make of light; None if that was not asked for, or there are several boards."""


def calibrate(
    images: Mapping[str, ImageSequence],
    board: Target = Board(),
    options: CalibrationOptions = CalibrationOptions(),
    *,
    photometry: PhotometryOptions = PhotometryOptions(),
    drawn: Handpiece | None = None,
    working_distance_mm: float | None = None,
    progress: Progress = silent,
) -> Calibration:
    """Calibrate the cameras of a rig from the images that each, by name, took of a board. Those of one instant share a
    name, or the number in it.

    ``drawn``: the handpiece as it was designed, whose lights, and no others, lit the board. ``working_distance_mm``:
    from the cameras to the teeth; by default that of the drawn handpiece, or else the median distance of the board.
    Raises ReconstructionError, which names the cause, where a camera hardly saw the board as it was described, and
    InputError where nothing shows which images were taken together.
    """
    _require_images(images)
    images, named_notes = _match_frames(images)
    views = _views(images, board, progress)
    _require_views(images, views, board)
    if options.frames_per_s is None:
        options = replace(options, frames_per_s=_common_rate(images))
    found = calibrate_rig(views, {name: each.size for name, each in images.items()}, board, options)
    drawn_notes = () if drawn is None else size_notes(found.rig, drawn.rig, board)
    drawn_notes += tuple(_other_circles(images, views, board))
    found = found if drawn is None else in_frame_of(found, drawn.rig)
    light = None
    if photometry.photometry and isinstance(board, Board):
        light = _light(found, images, board, drawn, photometry, progress)
    read = (note for each in images.values() for note in each.notes)
    found = replace(found, notes=(*read, *named_notes, *_missed_board_notes(images, views), *drawn_notes, *found.notes))
    return Calibration(handpiece=_handpiece(found, light, drawn, working_distance_mm), rig=found, light=light)


def _require_images(sequences: Mapping[str, ImageSequence]) -> None:
    """Raise ReconstructionError where a camera cannot be calibrated whatever its images show."""
    few = [f"{name} {len(each)}" for name, each in sequences.items() if len(each) < LEAST_VIEWS]
    if few:
        raise ReconstructionError(
            f"calibration: images of the board at {LEAST_VIEWS} instants or more are needed of each camera, but there "
            f"are fewer ({', '.join(few)}); hold it in further places, tilted by 20 to 50 degrees"
        )


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

    def image(camera: str, instant: str) -> Pixels:
        return sequences[camera].fine_image(index[camera][instant])

    patches = look_at_patches(found, image, board, options, progress=progress)
    return calibrate_light(found, patches, board, drawn, options)


def _match_frames(sequences: Mapping[str, ImageSequence]) -> tuple[dict[str, ImageSequence], tuple[str, ...]]:
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


def _common_rate(sequences: Mapping[str, ImageSequence]) -> float | None:
    """Frames a second of all films; None where one does not state it, or they differ."""
    rates = [each.frames_per_s for each in sequences.values()]
    known = [each for each in rates if each is not None]
    return known[0] if len(known) == len(rates) and max(known) < (1 + _OTHER_RATE) * min(known) else None


def _views(sequences: Mapping[str, ImageSequence], board: Target, progress: Progress) -> Views:
    """The board in every image that shows it."""
    images = [(camera, index) for camera, sequence in sequences.items() for index in range(len(sequence))]

    def find(image: tuple[str, int]) -> BoardView | None:
        camera, index = image
        return find_corners(full_range_grey(sequences[camera].fine_image(index)), board)

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
            if isinstance(board, Board) and is_part_of_a_larger_one(_sample_images(sequence, seen), board):
                raise ReconstructionError(
                    f"calibration: the board in the images of camera {name} has a square more each way; the corners "
                    f"were counted, not the squares: give --columns {board.columns + 1} --rows {board.rows + 1}"
                )
        elif (cause := cause_of_absence(_sample_images(sequence, unseen), board)) is not None:
            raise ReconstructionError(
                f"calibration: the board is found in {len(seen)} of {len(sequence)} images of camera {name}; {cause}"
            )


def _other_circles(sequences: Mapping[str, ImageSequence], views: Views, board: Target) -> Iterator[str]:
    """Where circles are not as large as was said, so that their centres are not corrected as they should be."""
    if isinstance(board, BoardSet) or not board.has_circles:
        return
    name, sequence = next(iter(sequences.items()))
    seen = [index for index, instant in enumerate(sequence.names) if (name, instant) in views]
    shares = [
        each
        for each in (measure_circle_share(image, board) for image in _sample_images(sequence, seen))
        if each is not None
    ]
    share = float(np.median(shares)) if shares else board.circle_share
    if abs(share / board.circle_share - 1) > _OTHER_CIRCLES:
        yield (
            f"the circles are {share:.2f} of their distance wide, not {board.circle_share:g}: give --circle-share "
            f"{share:.2f}, for their centres are not seen in the middle, by how much depends on it"
        )


def _sample_images(sequence: ImageSequence, indices: Sequence[int]) -> list[UInt8[np.ndarray, "h w"]]:
    """A few of some images, evenly, in grey."""
    tried = [indices[k] for k in np.unique(np.linspace(0, len(indices) - 1, MOST_TRIED).astype(int))] if indices else []
    return [full_range_grey(sequence.fine_image(index)) for index in tried]


def _missed_board_notes(sequences: Mapping[str, ImageSequence], views: Views) -> Iterator[str]:
    """In which images the board was not found."""
    for name, sequence in sequences.items():
        unseen = [instant for instant in sequence.names if (name, instant) not in views]
        if unseen:
            missed = f"{len(unseen)} of {len(sequence)} images: {join_names(unseen)}"
            yield f"camera {name}: the board was not found in {missed}"


def _handpiece(
    found: RigCalibration, light: Photometry | None, drawn: Handpiece | None, working_distance_mm: float | None
) -> Handpiece:
    """The drawn handpiece with what was found, or one of what was found alone."""
    sensors = {} if light is None else light.sensors
    if drawn is not None:
        lights = drawn.lights if light is None else light.lights
        known = replace(drawn, rig=found.rig, lights=lights, sensors={**drawn.sensors, **sensors}, name="calibrated")
        return known if working_distance_mm is None else _focus_at(known, working_distance_mm)
    distance_mm = found.distance_mm if working_distance_mm is None else working_distance_mm
    return _focus_at(
        Handpiece(rig=found.rig.over_surface(distance_mm), sensors=sensors, name="calibrated"), distance_mm
    )


def _focus_at(handpiece: Handpiece, distance_mm: float) -> Handpiece:
    return replace(handpiece, working_distance_mm=distance_mm, depth_range_mm=depth_of_field_mm(distance_mm))
