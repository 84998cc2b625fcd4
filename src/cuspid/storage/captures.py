"""Captures, and what only the simulator knows of them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from cuspid.capture import Capture, Frame
from cuspid.errors import InputError, OutputError
from cuspid.storage.files import finished, read_json, reading, to_plain, write_bytes, write_json
from cuspid.storage.handpieces import handpiece_to_json, read_handpiece, write_handpiece, write_rig_config
from cuspid.storage.jaws import read_jaw, write_jaw
from cuspid.storage.reconstructions import read_poses, write_poses
from cuspid.trueness import GroundTruth

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


def write_capture(capture: Capture) -> None:
    """Write what belongs to a capture besides its images: handpiece, rig configuration and list of frames."""
    write_handpiece(capture.folder / "handpiece.json", capture.handpiece)
    write_rig_config(capture.folder / "rig_config.json", capture.handpiece.rig)
    write_json(capture.folder / "capture.json", {"suffix": capture.suffix, "frames": capture.frames})


def write_image(path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write an RGB image as PNG, whole or not at all."""
    ok, encoded = cv2.imencode(path.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not ok:
        raise OutputError(f"{path}: the image could not be encoded")
    write_bytes(path, encoded.tobytes())


def read_capture(folder: Path, handpiece: Path | None = None) -> Capture:
    """A capture folder: ``images/<camera>/<frame>.*`` and a handpiece file (default ``handpiece.json`` in it).

    Without ``capture.json`` the frames are those of the image folders. Raises InputError where a camera's folder is
    missing, a folder belongs to no camera of the handpiece, the frames differ between cameras, or
    an image is truncated or of another size than its camera's.
    """
    if not (folder / "images").is_dir():
        raise InputError(f"{folder}: no folder 'images' in it; give the folder that holds images/<camera>/<frame>.png")
    known = read_handpiece(handpiece or folder / "handpiece.json")
    present = {path.name for path in (folder / "images").iterdir() if path.is_dir()}
    missing, unknown = set(known.rig.names) - present, present - set(known.rig.names)
    if missing:
        raise InputError(f"{folder / 'images'}: no folder for camera {', '.join(sorted(missing))} of the handpiece")
    if unknown:
        raise InputError(
            f"{folder / 'images'}: the folder {', '.join(sorted(unknown))} is no camera of the handpiece, "
            f"which has {', '.join(known.rig.names)}"
        )
    suffix, stems = _image_stems(folder / "images", known.rig.names)
    manifest = folder / "capture.json"
    if not manifest.exists():
        frames = tuple(Frame(name=stem) for stem in stems)
        return _checked(Capture(folder=folder, handpiece=known, frames=frames, suffix=suffix))
    value = read_json(manifest)
    with reading(manifest):
        frames = tuple(Frame(**frame) for frame in value["frames"])
        suffix = value["suffix"]
    absent = sorted({frame.name for frame in frames} - set(stems))
    if absent:
        raise InputError(
            f"{folder}: {len(absent)} of {len(frames)} frames have no images (first: {absent[0]}); "
            "finish the capture with the command that began it"
        )
    return _checked(Capture(folder=folder, handpiece=known, frames=frames, suffix=suffix))


def _checked(capture: Capture) -> Capture:
    for name in capture.handpiece.rig.names:
        for frame in capture.frames:
            capture.check_image(frame, name)
    return capture


def _image_stems(images: Path, cameras: Sequence[str]) -> tuple[str, list[str]]:
    files = {
        camera: [path for path in finished(images / camera) if path.suffix.lower() in IMAGE_SUFFIXES]
        for camera in cameras
    }
    stems = {camera: {path.stem for path in paths} for camera, paths in files.items()}
    first = cameras[0]
    for camera in cameras:
        odd = sorted(stems[camera] ^ stems[first])
        if odd:
            raise InputError(
                f"{images}: frames differ between cameras: {odd[0]} is in only one of {first} and {camera}; "
                "each frame needs an image of every camera"
            )
    suffixes = {path.suffix for paths in files.values() for path in paths}
    if not suffixes:
        raise InputError(f"{images}: no images in it")
    if len(suffixes) > 1:
        raise InputError(f"{images}: mixed image types {', '.join(sorted(suffixes))}; convert them to one")
    return suffixes.pop(), sorted(stems[first])


def write_truth(folder: Path, truth: GroundTruth) -> None:
    """Write what only the simulator knows: ``jaw.ply``, ``handpiece.json``, ``poses.json``."""
    write_jaw(folder / "jaw.ply", truth.jaw)
    write_handpiece(folder / "handpiece.json", truth.handpiece)
    write_poses(folder / "poses.json", truth.rig_from_world)


def read_truth(folder: Path) -> GroundTruth:
    """Read what :func:`write_truth` wrote."""
    return GroundTruth(
        jaw=read_jaw(folder / "jaw.ply"),
        handpiece=read_handpiece(folder / "handpiece.json"),
        rig_from_world=read_poses(folder / "poses.json"),
    )


def write_overlap(path: Path, minimum: float, mean: float) -> None:
    """Write the share of the surface in an image that the same camera's next image also sees."""
    write_json(path, {"minimum_overlap": minimum, "mean_overlap": mean})


def hash_capture(capture: Capture) -> dict[str, str]:
    """SHA-256 of a capture's handpiece and of its list of frames with the sizes of their images.

    The contents of the images are not read: that would take longer than finding a broken one when it is used.
    """
    listing = [
        (path.name, path.stat().st_size)
        for name in capture.handpiece.rig.names
        for frame in capture.frames
        if (path := capture.image_path(frame, name)).exists()
    ]
    parts = {"handpiece": handpiece_to_json(capture.handpiece), "images": listing}
    return {name: hashlib.sha256(json.dumps(to_plain(part)).encode()).hexdigest() for name, part in parts.items()}
