"""Turns footage into a capture: look at every frame once (:func:`survey`), plan (:mod:`cuspid.footage.plan`), and make
the usable images (:func:`develop`).

The measures of each frame are kept, and so is what each image was made from: an interrupted import resumes, and another
attempt at synchronising does not read the films again.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from cuspid.footage.films import DevelopmentOptions, Film, FilmFrame, develop_image, frames_of, open_film, sizes_of
from cuspid.footage.plan import Bad, Films, Plan
from cuspid.footage.quality import Looks, measure_quality, shrink_to_grey
from cuspid.model.capture import Capture, ImageFolder
from cuspid.model.rig import Handpiece
from cuspid.runtime.errors import InputError
from cuspid.runtime.inputs import read_bytes
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import map_in_threads
from cuspid.storage.captures import write_capture, write_image
from cuspid.storage.files import read_arrays, write_arrays, write_bytes
from cuspid.storage.stages import Stage

_CODE = (__name__,)


def open_films(sources: Mapping[str, Path], handpiece: Handpiece) -> dict[str, Film]:
    """The films of the cameras, by name. Raises InputError where a name is not a camera of the handpiece, a film has no
    frame, or its images do not have the camera's size."""
    unknown = sorted(set(sources) - set(handpiece.rig.names))
    if unknown:
        raise InputError(
            f"{sources[unknown[0]]}: no camera of the handpiece is named {unknown[0]}; it has "
            f"{', '.join(handpiece.rig.names)}: rename the folder or video"
        )
    films = {camera: open_film(camera, sources[camera]) for camera in sorted(sources)}
    for camera, film in films.items():
        model = handpiece.rig[camera].camera
        for where, size in sizes_of(film):
            _check_size(where, size, (model.width, model.height), camera)
    return films


def _check_size(where: str, size: tuple[int, int], expected: tuple[int, int], camera: str) -> None:
    if size != expected:
        raise InputError(
            f"{where}: {size[0]} x {size[1]} px, but camera {camera} has {expected[0]} x {expected[1]} px; give the "
            "handpiece file that belongs to this footage"
        )


# --- looking ---------------------------------------------------------------------------------------------------------


def survey(films: Films, folder: Path, options: DevelopmentOptions, progress: Progress = silent) -> dict[str, Looks]:
    """Measures of each frame, by camera; kept in ``survey/``. Raises InputError where a film changes its image size."""
    stage = Stage("survey", folder, options, _CODE)

    def survey_film(film: Film) -> Looks:
        file = folder / "survey" / f"{film.camera}.npz"
        stage.make({"film": film.digest}, [file], lambda: write_arrays(file, vars(_looks(film, options, progress))))
        return Looks(**read_arrays(file, remedy="delete it"))

    return dict(zip(films, map_in_threads(survey_film, films.values()), strict=True))


def _looks(film: Film, options: DevelopmentOptions, progress: Progress) -> Looks:
    rows: dict[int, tuple[float, ...]] = {}
    size, before = None, None
    for frame in frames_of(film, options):
        time = np.nan if frame.time_s is None else frame.time_s
        shown, highest = _judge_image(frame, options)
        if shown is None:
            rows[frame.number] = (time, *[np.nan] * 6)
        elif shown.shape != (size or shown.shape):
            raise InputError(f"{frame.where}: its size differs from the frames before it; cut the film there")
        else:
            rows[frame.number] = (time, *measure_quality(shown, before), highest)
            size, before = shown.shape, shown
        progress(film.camera, frame.number + 1, max(film.length.frames, frame.number + 1))
    table = np.full((max(rows) + 1, 7), np.nan)
    table[list(rows)] = list(rows.values())
    time_s, level, bright, burnt, sharpness, change, peak = table.T.copy()
    return Looks(
        time_s=time_s, level_dn=level, bright_dn=bright, burnt=burnt, sharpness=sharpness, change_dn=change, peak=peak
    )


def _judge_image(frame: FilmFrame, options: DevelopmentOptions) -> tuple[np.ndarray | None, float]:
    """A frame as it is judged, None where it cannot be read; and its largest value, 0 of 8 bits."""
    try:
        stored = frame.stored()
    except InputError:
        return None, 0.0
    image = develop_image(stored, options, frame.where)
    return shrink_to_grey(image), float(stored.max()) if stored.dtype == np.uint16 else 0.0


# --- developing ------------------------------------------------------------------------------------------------------


def develop(
    films: Films,
    plan: Plan,
    handpiece: Handpiece,
    folder: Path,
    options: DevelopmentOptions,
    progress: Progress = silent,
) -> Capture:
    """The capture made by a plan, in a folder; existing images are kept."""
    images = ImageFolder(folder)
    stage = Stage("images", folder, options, _CODE)
    targets: dict[str, dict[int, Path]] = {camera: {} for camera in films}
    for frame in plan.frames:
        for camera in frame.cameras:
            targets[camera][plan.numbers[frame.name][camera]] = images.path(frame.name, camera)
    map_in_threads(lambda film: _develop(film, targets[film.camera], stage, options, progress), films.values())
    capture = Capture(
        handpiece=handpiece, frames=plan.frames, source=images, left_out=tuple(map(Bad.as_dropped, plan.bad))
    )
    write_capture(folder, capture)
    return capture


def _develop(
    film: Film, targets: Mapping[int, Path], stage: Stage, options: DevelopmentOptions, progress: Progress
) -> None:
    """Write the wanted images of a film, by the numbers of its frames, that are not there yet."""
    keys = {number: stage.key({"film": film.digest, "frame": str(number)}) for number in targets}
    left = {number for number, path in targets.items() if not stage.has(keys[number], [path])}
    frames = frames_of(film, options)
    while left:
        frame = next(frames)
        if frame.number in left:
            _write(frame, targets[frame.number], options)
            stage.record(keys[frame.number], [targets[frame.number]])
            left.remove(frame.number)
            progress(f"{film.camera} images", len(targets) - len(left), len(targets))


def _write(frame: FilmFrame, path: Path, options: DevelopmentOptions) -> None:
    """A PNG that needs nothing is kept as it is."""
    if frame.png is not None and options == DevelopmentOptions():
        write_bytes(path, read_bytes(frame.png, "image"))
        return
    image = develop_image(frame.stored(), options, frame.where)
    write_image(path, image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2))
