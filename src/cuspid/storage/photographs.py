"""Photographs of one camera: a folder of them, or a video; with masks, and what EXIF says of the lens."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from cuspid.model.camera import Camera
from cuspid.model.capture import Dropped
from cuspid.model.photographs import UPRIGHT, PhotoCamera, Photograph, Photographs
from cuspid.runtime.errors import InputError
from cuspid.runtime.image_files import exif_orientation, image_size
from cuspid.runtime.progress import Progress, silent
from cuspid.storage.captures import IMAGE_SUFFIXES
from cuspid.storage.files import digest_of, list_finished
from cuspid.storage.handpieces import read_handpiece
from cuspid.storage.sequences import LEAST_PX, images_in, read_sequence
from cuspid.storage.videos import VIDEO_SUFFIXES

_FULL_FRAME_MM = 43.2666
"""Diagonal of a 35 mm film, by which EXIF's equivalent focal length is meant."""
_UNREADABLE = (".heic", ".heif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
_ONE = "camera"
"""Name of the only camera, and the beginning of those of several."""


def is_photographs(source: Path, handpiece: Path | None = None) -> bool:
    """Whether a source is photographs of one camera: a video, a folder of images, or one with ``images/<name>.jpg``; or
    a capture whose handpiece has a single camera."""
    if not source.is_dir():
        return source.suffix.lower() in VIDEO_SUFFIXES
    images = source / "images"
    if not images.is_dir():
        return bool(images_in(source)) or bool(_unreadable_notes(source))
    known = handpiece or source / "handpiece.json"
    if any(path.is_dir() for path in list_finished(images)):
        return known.is_file() and len(read_handpiece(known).rig.names) == 1
    return True


def read_photographs(
    source: Path, decoded: Path, *, handpiece: Path | None = None, progress: Progress = silent
) -> Photographs:
    """Photographs of one camera, in the order of their names.

    A video is decoded into the folder ``decoded``. ``handpiece`` (default: ``handpiece.json`` beside the photographs,
    where there is one) calibrates them. A file that is no image is left out. Raises InputError where there are fewer
    than two photographs, or the calibration or a mask does not fit.
    """
    home, masks, is_film = source, source / "masks", not source.is_dir()
    if is_film:
        sequence = read_sequence(source, decoded, progress=progress)
        paths, notes = list(sequence.paths), list(sequence.notes)
    else:
        home = _home(source)
        masks = masks / home.name if home.parent.name == "images" else masks
        paths, notes = images_in(home), _unreadable_notes(home)
    sizes, left_out = _sizes(paths)
    if len(sizes) < 2:
        raise InputError(
            f"{source}: {len(sizes)} photograph(s){''.join(f'; {note}' for note in notes)}; a surface takes at least "
            "three that overlap, from different places"
        )
    calibrated = _calibration(source, handpiece)
    photographs, cameras = _group_by_camera(sizes, masks, calibrated)
    for each in photographs:
        each.check_mask()
    unmasked = [each.name for each in photographs if each.mask is None]
    if unmasked and len(unmasked) < len(photographs):
        notes.append(f"{len(unmasked)} of {len(photographs)} photographs have no mask (first: {unmasked[0]})")
    return Photographs(
        source=source,
        photographs=photographs,
        cameras=cameras,
        is_film=is_film,
        left_out=tuple(left_out),
        notes=tuple(notes),
    )


def hash_photographs(photographs: Photographs) -> dict[str, str]:
    """SHA-256 of photographs, their masks and what is known about their cameras."""
    each = {name: photographs.digest(name, "") for name in photographs.names}
    calibrated = {name: None if c.calibrated is None else c.calibrated for name, c in photographs.cameras.items()}
    return {"photographs": digest_of(each), "cameras": digest_of(calibrated)}


def _home(source: Path) -> Path:
    """The folder that holds the images themselves."""
    images = source / "images"
    if not images.is_dir():
        return source
    inner = sorted(path for path in list_finished(images) if path.is_dir())
    return inner[0] if inner and not images_in(images) else images


def _unreadable_notes(folder: Path) -> list[str]:
    """A note where there are photographs of a kind that is not read."""
    strange = [path for path in list_finished(folder) if path.suffix.lower() in _UNREADABLE]
    if not strange:
        return []
    kinds = ", ".join(IMAGE_SUFFIXES)
    return [f"{len(strange)} files such as {strange[0].name} cannot be read: save them as one of {kinds}"]


def _sizes(paths: Sequence[Path]) -> tuple[dict[Path, tuple[int, int]], list[Dropped]]:
    """Upright sizes of the files that are images, and those that are not. Raises InputError for tiny ones, and where
    two share a name."""
    sizes, left_out = {}, []
    for path in paths:
        try:
            sizes[path] = image_size(path)
        except InputError as error:
            left_out.append(Dropped(what=f"photograph {path.stem}", reason=str(error)))
    small = [path for path, size in sizes.items() if min(size) < LEAST_PX]
    if small:
        raise InputError(f"{small[0]}: too small; each side needs at least {LEAST_PX} px")
    again = [stem for stem, count in Counter(path.stem for path in sizes).items() if count > 1]
    if again:
        raise InputError(
            f"{paths[0].parent}: {again[0]} is there more than once, with other suffixes; keep one of each"
        )
    return sizes, left_out


def _calibration(source: Path, handpiece: Path | None) -> Camera | None:
    """The only camera of a handpiece file. Raises InputError where it has several."""
    known = handpiece or source / "handpiece.json"
    if handpiece is None and (not source.is_dir() or not known.is_file()):
        return None
    rig = read_handpiece(known).rig
    if len(rig.names) > 1:
        raise InputError(
            f"{known}: {len(rig.names)} cameras, but {source} holds photographs of one; put those of a rig into "
            "images/<camera>/<frame>.png, or give the calibration of a single camera"
        )
    return rig[rig.names[0]].camera


def _group_by_camera(
    sizes: Mapping[Path, tuple[int, int]], masks: Path, calibrated: Camera | None
) -> tuple[tuple[Photograph, ...], dict[str, PhotoCamera]]:
    """Photographs, and the cameras that took them: one for each size and focal length."""
    exif = {path: _Exif.of(path) for path in sizes}
    stored = {path: exif[path].sensor_size(size) for path, size in sizes.items()}
    kinds = {path: (stored[path], *exif[path].lens) for path in sizes}
    order = list(dict.fromkeys(kinds.values()))
    names = [_ONE] if len(order) == 1 else [f"{_ONE}-{n + 1}" for n in range(len(order))]
    first = {kind: next(path for path in sizes if kinds[path] == kind) for kind in order}
    cameras = {
        name: PhotoCamera(
            size=kind[0],
            focal_px=exif[first[kind]].focal_px(kind[0]),
            calibrated=None if calibrated is None else _require_size(calibrated, kind[0], first[kind]),
        )
        for name, kind in zip(names, order, strict=True)
    }
    photographs = [
        Photograph(
            name=path.stem,
            path=path,
            camera=names[order.index(kinds[path])],
            size=stored[path],
            orientation=exif[path].orientation,
            mask=_mask(masks, path),
        )
        for path in sizes
    ]
    return tuple(photographs), cameras


def _require_size(camera: Camera, size: tuple[int, int], path: Path) -> Camera:
    """Raises InputError where the photographs are of another size than what was calibrated."""
    if (camera.width, camera.height) == size:
        return camera
    if camera.width * size[1] != camera.height * size[0]:
        raise InputError(
            f"{path}: {size[0]} x {size[1]} px, but the calibration is for {camera.width} x {camera.height} px; give "
            "the one of this camera"
        )
    return camera.resized(*size)


def _mask(masks: Path, photograph: Path) -> Path | None:
    """``masks/<stem>.png``, or ``masks/<name with suffix>.png`` as COLMAP has it."""
    candidates = (masks / f"{photograph.name}.png", masks / f"{photograph.stem}.png")
    return next((path for path in candidates if path.is_file()), None)


class _Exif:
    """What a photograph tells of the camera."""

    def __init__(self, orientation: int = UPRIGHT, lens: tuple[str, float, float] = ("", 0.0, 0.0)) -> None:
        self.orientation, self.lens = orientation, lens

    @staticmethod
    def of(path: Path) -> _Exif:
        """Of a file; what cannot be understood counts as not told."""
        try:
            with Image.open(path) as image:
                if image.format == "TIFF":  # turned by Pillow itself
                    return _Exif()
                if image.format == "PNG" and "exif" not in image.info:  # all of it would be decoded to be asked
                    return _Exif(exif_orientation(path))
                exif = image.getexif()
                inner = exif.get_ifd(ExifTags.IFD.Exif)
            orientation = int(exif.get(ExifTags.Base.Orientation, UPRIGHT))
            lens = (
                str(exif.get(ExifTags.Base.Model, "")),
                _positive(inner.get(ExifTags.Base.FocalLengthIn35mmFilm)),
                _positive(inner.get(ExifTags.Base.FocalLength)),
            )
        except Exception:  # a reader of Pillow raises whatever EXIF makes of it, and it is not needed
            return _Exif()
        return _Exif(orientation if orientation in range(1, 9) else UPRIGHT, lens)

    def sensor_size(self, upright: tuple[int, int]) -> tuple[int, int]:
        """Size in the grid of the sensor."""
        return upright[::-1] if self.orientation >= 5 else upright

    def focal_px(self, size: tuple[int, int]) -> float | None:
        """By the focal length that a 35 mm film would need; None where that is not told."""
        equivalent_mm = self.lens[1]
        return equivalent_mm / _FULL_FRAME_MM * float(np.hypot(*size)) if equivalent_mm else None


def _positive(value: object) -> float:
    """A positive number, 0 where it is none."""
    number = float(value) if isinstance(value, int | float) or hasattr(value, "numerator") else 0.0  # type: ignore[arg-type]
    return number if np.isfinite(number) and number > 0 else 0.0
