"""Sequences of one camera: a folder of images, a video file, or a capture with one camera; and its calibration."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

from cuspid.model.camera import Camera
from cuspid.model.capture import ImageFolder
from cuspid.model.image_sequence import ImageSequence
from cuspid.model.rig import Handpiece, Rig
from cuspid.runtime.errors import InputError
from cuspid.runtime.image_files import exif_orientation, image_size, recorded_size
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.values import checked_name
from cuspid.storage.calibrations import MOST_LOST_PX, read_calibration
from cuspid.storage.captures import IMAGE_SUFFIXES, read_capture, write_image
from cuspid.storage.files import digest_of, hash_file, list_finished, read_json
from cuspid.storage.handpieces import read_handpiece
from cuspid.storage.videos import VIDEO_SUFFIXES, read_video, video_length, video_rate

LEAST_PX = 32
"""Side of a frame that shows something."""
MOST_FRAMES = 300
"""A longer video is thinned evenly to about as many frames."""

_UNUSED_SHUTTER = (
    "shutter: the readout of the handpiece's file is not taken into account: a film of one camera is located with all "
    "rows of a frame at its instant; move slowly, or take two cameras"
)
_NUMBERS = re.compile(r"(\D*)(\d*)")


def read_sequence(
    source: Path | str,
    decoded: Path | str | None = None,
    *,
    calibration: Path | str | None = None,
    progress: Progress = silent,
) -> ImageSequence:
    """Frames of one camera from a folder of images, a video or a capture.

    A video is decoded into the folder ``decoded``. Raises InputError where there are fewer than two frames, a frame is
    truncated or of another size than the others, or the calibration belongs to another size.
    """
    source = Path(source)
    if source.is_dir():
        found = _capture_sequence(source) if (source / "images").is_dir() else _folder_sequence(source)
    elif source.suffix.lower() in VIDEO_SUFFIXES and source.is_file():
        if decoded is None:
            raise InputError(f"{source}: a video needs a folder for its frames; name one")
        found = _video_sequence(source, Path(decoded), progress)
    elif source.is_file():
        raise InputError(f"{source}: neither a folder of images nor a video ({', '.join(VIDEO_SUFFIXES)})")
    else:
        raise InputError(f"{source}: no such folder or video")
    return found if calibration is None else _with_calibration(found, Path(calibration))


def read_sequences(
    folder: Path | str, decoded: Path | str | None = None, *, progress: Progress = silent
) -> dict[str, ImageSequence]:
    """The frames of each camera of a rig, by name, as :func:`rig_sources` finds them and :func:`read_sequence` reads
    them; those of videos are decoded into subfolders of ``decoded``."""
    return {
        name: read_sequence(path, None if decoded is None else Path(decoded) / name, progress=progress)
        for name, path in rig_sources(Path(folder)).items()
    }


def rig_sources(folder: Path) -> dict[str, Path]:
    """For each camera of a rig, by name, its folder of images or its video, all in one folder or in ``images`` in it.

    Raises InputError where there is none, or two have one name.
    """
    home = folder / "images" if (folder / "images").is_dir() else folder
    if not home.is_dir():
        raise InputError(f"{folder}: no such folder")
    sources = sorted(path for path in list_finished(home) if path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES)
    if not sources:
        raise InputError(f"{home}: it contains no folder of images and no video; each camera needs one")
    named = {checked_name(f"{home}: cameras", path.name if path.is_dir() else path.stem): path for path in sources}
    if len(named) < len(sources):
        raise InputError(f"{home}: two folders or videos have the same name; each camera needs its own")
    return named


def hash_source(source: Path) -> str:
    """SHA-256 of a video, or of the images of a folder and their names."""
    if source.is_file():
        return hash_file(source)
    return digest_of({path.name: hash_file(path) for path in sorted(images_in(source))})


def images_in(folder: Path) -> list[Path]:
    """The images of a folder, in the order of the numbers in their names."""
    images = [path for path in list_finished(folder) if path.suffix.lower() in IMAGE_SUFFIXES]
    return sorted(images, key=lambda path: name_order(path.name))


def name_order(name: str) -> list[tuple[str, int]]:
    """What names are sorted by: ``2`` comes before ``10``."""
    return [(text, int(digits or 0)) for text, digits in _NUMBERS.findall(name)]


def _folder_sequence(folder: Path) -> ImageSequence:
    paths = images_in(folder)
    orientations = tuple(map(exif_orientation, paths))
    ways = set(orientations)
    if len(ways) < 2:
        return ImageSequence(source=folder, paths=tuple(paths), size=_common_size(folder, paths))
    note = (
        f"{folder.name}: EXIF says that the camera was held in {len(ways)} orientations; its images are used as the "
        f"sensor recorded them, not turned upright"
    )
    size = _common_size(folder, paths, as_recorded=True)
    return ImageSequence(source=folder, paths=tuple(paths), size=size, notes=(note,), orientations=orientations)


def _capture_sequence(folder: Path) -> ImageSequence:
    capture = read_capture(folder)
    names = capture.handpiece.rig.names
    if len(names) > 1:
        raise InputError(
            f"{folder}: a capture of {len(names)} cameras; give the images of one, "
            f"such as {folder / 'images' / names[0]}"
        )
    images = ImageFolder(folder, capture.source.suffix)
    paths = [images.path(frame.name, names[0]) for frame in capture.frames]
    found = ImageSequence(source=folder, paths=tuple(paths), size=_common_size(folder, paths))
    return _with_handpiece(found, capture.handpiece, folder / "handpiece.json")


def _common_size(folder: Path, paths: list[Path], *, as_recorded: bool = False) -> tuple[int, int]:
    """Of images that are turned upright, or not. Raises InputError where there are fewer than two frames, or they are
    tiny or not of one size."""
    if len(paths) < 2:
        raise InputError(f"{folder}: {len(paths)} image(s); a sequence needs at least two")
    sizes = {path: image_size(path) for path in paths}
    sizes = {path: recorded_size(path) for path in paths} if as_recorded else sizes
    usual = Counter(sizes.values()).most_common(1)[0][0]
    odd = [path for path, size in sizes.items() if size != usual]
    if odd:
        raise InputError(
            f"{odd[0]}: {sizes[odd[0]][0]} x {sizes[odd[0]][1]} px, but most frames have {usual[0]} x {usual[1]} px "
            f"({len(odd)} of {len(paths)} differ); leave them out, or put each size into a folder of its own"
        )
    if min(usual) < LEAST_PX:
        raise InputError(
            f"{folder}: frames of {usual[0]} x {usual[1]} px are too small; each side needs at least {LEAST_PX} px"
        )
    return usual


def _video_sequence(video: Path, decoded: Path, progress: Progress) -> ImageSequence:
    length = video_length(video)
    step = max(1, -(-length.frames // MOST_FRAMES))
    paths, number, time_s = [], 0, None
    for frame in read_video(video):
        if frame.number % step == 0:
            path = decoded / f"{frame.number:05d}.png"
            if not path.exists():
                write_image(path, frame.rgb())
            paths.append(path)
        number, time_s = frame.number + 1, frame.time_s
        progress("decoding", number, max(length.frames, number))
    if len(paths) < 2:
        raise InputError(
            f"{video}: {len(paths)} frame(s) could be decoded; it is not a video, is truncated, or has a single frame"
        )
    notes = []
    if missing := length.missing(number, time_s):
        notes.append(f"{video.name}: {missing}")
    if step > 1:
        notes.append(f"{video.name}: {number} frames; one in every {step} is used")
    size = _common_size(decoded, paths)
    return ImageSequence(
        source=video, paths=tuple(paths), size=size, frames_per_s=video_rate(video), notes=tuple(notes)
    )


# --- calibration ---------------------------------------------------------------------------------------------------


def _with_calibration(sequence: ImageSequence, path: Path) -> ImageSequence:
    """With the calibration of one camera, of any program; the working distance is told by handpiece.json alone."""
    found = read_calibration(path, image_size_px=sequence.size)
    for loss in found.losses.values():
        if loss.largest_px > MOST_LOST_PX:
            raise InputError(f"{path}: {loss}; calibrate with a lens model that cuspid has")
    calibrated = _with_rig(sequence, found.rig, path)
    if found.format != "handpiece" or len(found.rig.names) > 1:
        return calibrated
    value = read_json(path)
    return calibrated if "cameras" not in value else _with_handpiece(sequence, read_handpiece(path), path)


def _with_handpiece(sequence: ImageSequence, handpiece: Handpiece, path: Path) -> ImageSequence:
    found = _with_rig(sequence, handpiece.rig, path)
    rolls = not all(each.shutter.is_plain for each in handpiece.rig.cameras.values())
    notes = (*found.notes, _UNUSED_SHUTTER) if rolls else found.notes
    return replace(found, working_distance_mm=handpiece.working_distance_mm, notes=notes)


def _with_rig(sequence: ImageSequence, rig: Rig, path: Path) -> ImageSequence:
    cameras = list(rig.cameras.values())
    if len(cameras) > 1:
        raise InputError(f"{path}: it holds {len(cameras)} cameras; give the calibration of a single one")
    return _with_camera(sequence, cameras[0].camera, path)


def _with_camera(sequence: ImageSequence, camera: Camera, path: Path) -> ImageSequence:
    if (camera.width, camera.height) != sequence.size:
        raise InputError(
            f"{path}: the calibration is for {camera.width} x {camera.height} px, but the frames are "
            f"{sequence.size[0]} x {sequence.size[1]} px; give the matching calibration, or none"
        )
    return replace(sequence, camera=camera)
