"""Captures: images, calibration, and the list of frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16

from cuspid.model.capture import Capture, Dropped, Frame, ImageFolder
from cuspid.model.rig import Handpiece, Rig
from cuspid.runtime.errors import InputError, OutputError
from cuspid.runtime.workers import map_in_threads
from cuspid.storage.files import as_declared, digest_of, list_finished, read_json, reading, write_bytes, write_json
from cuspid.storage.handpieces import hash_handpiece, read_handpiece, write_handpiece, write_rig_config

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


def write_capture(folder: Path, capture: Capture) -> None:
    """Write what belongs to a capture besides its images: handpiece, rig configuration and list of frames."""
    write_handpiece(folder / "handpiece.json", capture.handpiece)
    write_rig_config(folder / "rig_config.json", capture.handpiece.rig)
    write_json(folder / "capture.json", {"frames": capture.frames})


def write_image(path: Path, image: UInt8[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w 3"]) -> None:
    """Write an RGB image as PNG of its depth, whole or not at all."""
    ok, encoded = cv2.imencode(path.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not ok:
        raise OutputError(f"{path}: the image could not be encoded")
    write_bytes(path, encoded.tobytes())


def read_capture(
    folder: Path | str, handpiece: Path | str | None = None, working_distance_mm: float | None = None
) -> Capture:
    """A capture folder: ``images/<camera>/<frame>.*`` and a handpiece file (default ``handpiece.json`` in it), or a rig
    with its working distance, as :func:`cuspid.storage.handpieces.read_handpiece` takes them.

    Without ``capture.json`` the frames are those of the image folders, in the order of their names. A camera that has
    no image of a frame is left out of that frame, one that has none at all out of the handpiece (see ``left_out``).
    Raises InputError where a folder belongs to no camera of the handpiece, a frame that ``capture.json`` names has no
    image at all, or an image is truncated or of another size than its camera's.
    """
    folder = Path(folder)
    images = folder / "images"
    if not images.is_dir():
        raise InputError(
            f"{folder}: it contains no folder 'images'; give the folder that holds images/<camera>/<frame>.png, or one "
            "of photographs"
        )
    known = read_handpiece(handpiece or folder / "handpiece.json", working_distance_mm)
    unknown = folders_of_images(images) - set(known.rig.names)
    if unknown:
        raise InputError(
            f"{images}: no camera of the handpiece matches the folder {', '.join(sorted(unknown))}; the cameras "
            f"are {', '.join(known.rig.names)}"
        )
    suffix, stems = _image_stems(images, known.rig.names)
    frames, left_out = _present(_list_frames(folder, known, stems), stems, folder)
    used = Rig({name: mounted for name, mounted in known.rig.cameras.items() if stems[name]})
    capture = Capture(
        handpiece=known.with_cameras(used), frames=frames, source=ImageFolder(folder, suffix), left_out=left_out
    )
    for frame in frames:
        for name in frame.cameras:
            capture.check_image(frame, name)
    return capture


def folders_of_images(images: Path) -> set[str]:
    """The folders in which images lie, at any depth, as cameras are named: ``left``, ``rig/left``."""
    found, left = set[str](), [path for path in list_finished(images) if path.is_dir()]
    while left:
        folder = left.pop()
        inner = [path for path in list_finished(folder) if path.is_dir()]
        if not inner or any(path.suffix.lower() in IMAGE_SUFFIXES for path in list_finished(folder)):
            found.add(folder.relative_to(images).as_posix())
        left += inner
    return found


def _list_frames(folder: Path, handpiece: Handpiece, stems: Mapping[str, set[str]]) -> list[Frame]:
    """The frames that there should be, with all cameras that should have an image."""
    manifest = folder / "capture.json"
    if not manifest.exists():
        every = sorted(set().union(*stems.values()))
        return [Frame(name=stem, cameras=handpiece.rig.names, lighting=handpiece.only_lighting) for stem in every]
    value = read_json(manifest)
    with reading(manifest):
        listed = [as_declared(Frame, **{**frame, "cameras": tuple(frame["cameras"])}) for frame in value["frames"]]
        for frame in listed:
            for name in frame.cameras:
                handpiece.rig[name]
    return listed


def _present(
    listed: Sequence[Frame], stems: Mapping[str, set[str]], folder: Path
) -> tuple[tuple[Frame, ...], tuple[Dropped, ...]]:
    """The frames with the cameras that do have an image, and what is missing."""
    frames = [replace(frame, cameras=tuple(c for c in frame.cameras if frame.name in stems[c])) for frame in listed]
    empty = [frame.name for frame in frames if not frame.cameras]
    if empty:
        raise InputError(
            f"{folder}: {len(empty)} of {len(frames)} frames have no images (first: {empty[0]}); "
            "finish the capture with the command that started it"
        )
    idle = [name for name, known in stems.items() if not known]
    left_out = [Dropped(what=f"camera {name}", reason="it has no images") for name in idle]
    left_out += [
        Dropped(what=f"camera {name} of frame {frame.name}", reason="its image is missing")
        for frame, whole in zip(frames, listed, strict=True)
        for name in whole.cameras
        if name not in frame.cameras and name not in idle
    ]
    return tuple(frames), tuple(left_out)


def _image_stems(images: Path, cameras: Sequence[str]) -> tuple[str, dict[str, set[str]]]:
    """Image suffix, and the stems of each camera's images."""
    files = {
        camera: [path for path in list_finished(images / camera) if path.suffix.lower() in IMAGE_SUFFIXES]
        for camera in cameras
        if (images / camera).is_dir()
    }
    suffixes = {path.suffix for paths in files.values() for path in paths}
    if not suffixes:
        raise InputError(f"{images}: it contains no images")
    if len(suffixes) > 1:
        raise InputError(f"{images}: mixed image types {', '.join(sorted(suffixes))}; convert them to one")
    return suffixes.pop(), {camera: {path.stem for path in files.get(camera, ())} for camera in cameras}


def hash_frame(capture: Capture, frame: Frame) -> str:
    """SHA-256 of a frame of a capture with the contents of its images."""
    return digest_of([frame, [capture.source.digest(frame.name, name) for name in frame.cameras]])


def hash_capture(capture: Capture) -> dict[str, str]:
    """SHA-256 of a capture's handpiece and of its frames with the contents of their images."""
    frames = map_in_threads(lambda frame: hash_frame(capture, frame), capture.frames)
    return {"handpiece": hash_handpiece(capture.handpiece), "images": digest_of(frames)}
