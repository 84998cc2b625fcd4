"""A capture: what the handpiece recorded, frame by frame, read through a source of images."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import UInt8

from cuspid.model.rig import Handpiece
from cuspid.runtime.display import Displayed
from cuspid.runtime.errors import InputError
from cuspid.runtime.image_files import Pixels, as_8_bits, has_opacity, image_size, read_fine, read_image, read_rgba
from cuspid.runtime.values import checked_name


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One instant: the images that the cameras of the handpiece took together."""

    name: str
    """File stem shared by the images of all cameras."""
    cameras: tuple[str, ...]
    """The cameras that have an image of this frame."""
    lighting: str | None = None
    """Name of the handpiece's lighting pattern, or None where it is not known."""
    time_s: float | None = None
    """Time of capture, from an arbitrary zero, or None where it is not known."""

    def __post_init__(self) -> None:
        checked_name("frame", self.name)


@dataclass(frozen=True, kw_only=True)
class Dropped:
    """A frame, camera, image or point set that was left out, and why."""

    what: str
    """For example ``frame 00012`` or ``camera b2``."""
    reason: str
    """One human-readable line."""


@runtime_checkable
class ImageSource(Protocol):
    """Where the images of a capture come from."""

    @property
    def suffix(self) -> str:
        """Suffix of the image names."""
        ...

    def read(self, frame: str, camera: str) -> Pixels:
        """RGB image, with fractions of its digital numbers (float32) where more than 8 bits are stored. Raises
        InputError where it is missing or cannot be decoded whole."""
        ...

    def size(self, frame: str, camera: str) -> tuple[int, int]:
        """Width and height in px, without decoding the image. Raises InputError where it is missing or damaged."""
        ...

    def mask(self, frame: str, camera: str) -> UInt8[np.ndarray, "h w"] | None:
        """Zero where the image shows what does not belong to the object; None where all of it counts. Raises InputError
        where the mask is of another size, or leaves nothing."""
        ...

    def digest(self, frame: str, camera: str) -> str:
        """SHA-256 of the stored image and its mask. Raises InputError where it is missing."""
        ...

    def where(self, frame: str, camera: str) -> str:
        """Where the image is, for messages."""
        ...


def image_name(frame: str, camera: str, suffix: str) -> str:
    """Name of an image in COLMAP's rig layout: ``<camera>/<frame>.png``."""
    return f"{camera}/{frame}{suffix}"


def mask_paths(folder: Path, stem: str, suffix: str) -> tuple[Path, Path]:
    """Where the mask of an image may lie: under its own name as PNG, or as COLMAP has it."""
    return folder / f"{stem}.png", folder / f"{stem}{suffix}.png"


def read_mask(image: Path, mask: Path | None) -> UInt8[np.ndarray, "h w"] | None:
    """What of an image counts, from the file of its mask or else from its own opacity; None where all of it does.

    Raises InputError where the mask is damaged, of another size, or leaves nothing.
    """
    if mask is None and not has_opacity(image):
        return None
    if mask is None:
        counts = np.ascontiguousarray(read_rgba(image)[..., 3])
    else:
        if (size := image_size(mask)) != (whole := image_size(image)):
            raise InputError(f"{mask}: {size[0]} x {size[1]} px, but its image has {whole[0]} x {whole[1]} px")
        counts = read_image(mask).max(axis=2)
    if not counts.any():
        raise InputError(f"{mask or image}: the mask leaves nothing of the image; white is what counts")
    return counts


@cache
def _file_digest(path: Path, size: int, modified_ns: int) -> str:
    """SHA-256 of a file, read once for each of its states."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of an image file, read once for each of its states. Raises InputError where it is missing."""
    try:
        state = path.stat()
        return _file_digest(path, state.st_size, state.st_mtime_ns)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); put the image back") from error


@dataclass(frozen=True)
class ImageFolder:
    """Images on disk in COLMAP's rig layout, ``images/<camera>/<frame>.png``. An :class:`ImageSource`."""

    folder: Path
    """Holds ``images/``."""
    suffix: str = ".png"
    """Image file suffix."""

    def path(self, frame: str, camera: str) -> Path:
        """Path of an image."""
        return self.folder / "images" / image_name(frame, camera, self.suffix)

    def read(self, frame: str, camera: str) -> Pixels:
        """As :meth:`ImageSource.read`."""
        return read_fine(self.path(frame, camera))

    def size(self, frame: str, camera: str) -> tuple[int, int]:
        """As :meth:`ImageSource.size`."""
        return image_size(self.path(frame, camera))

    def mask_path(self, frame: str, camera: str) -> Path | None:
        """Path of the mask of an image, ``masks/<camera>/<frame>.png`` or COLMAP's ``<frame>.jpg.png``, if there is
        one."""
        beside = self.folder / "masks" / camera
        return next((path for path in mask_paths(beside, frame, self.suffix) if path.is_file()), None)

    def mask(self, frame: str, camera: str) -> UInt8[np.ndarray, "h w"] | None:
        """As :meth:`ImageSource.mask`; without a mask of its own, the opacity of the image."""
        return read_mask(self.path(frame, camera), self.mask_path(frame, camera))

    def digest(self, frame: str, camera: str) -> str:
        """As :meth:`ImageSource.digest`."""
        paths = self.path(frame, camera), self.mask_path(frame, camera)
        return " ".join(file_digest(path) for path in paths if path is not None)

    def where(self, frame: str, camera: str) -> str:
        """As :meth:`ImageSource.where`."""
        return str(self.path(frame, camera))


@dataclass(frozen=True)
class HalvedImages:
    """The images of another source at half their size. An :class:`ImageSource`."""

    whole: ImageSource
    """The other source."""

    @property
    def suffix(self) -> str:
        """As :attr:`ImageSource.suffix`."""
        return self.whole.suffix

    def read(self, frame: str, camera: str) -> Pixels:
        """As :meth:`ImageSource.read`."""
        image = self.whole.read(frame, camera)
        size = halved_size(image.shape[1], image.shape[0])
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))

    def size(self, frame: str, camera: str) -> tuple[int, int]:
        """As :meth:`ImageSource.size`."""
        return halved_size(*self.whole.size(frame, camera))

    def mask(self, frame: str, camera: str) -> UInt8[np.ndarray, "h w"] | None:
        """As :meth:`ImageSource.mask`."""
        mask = self.whole.mask(frame, camera)
        if mask is None:
            return None
        size = halved_size(mask.shape[1], mask.shape[0])
        return np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)

    def digest(self, frame: str, camera: str) -> str:
        """As :meth:`ImageSource.digest`."""
        return self.whole.digest(frame, camera)

    def where(self, frame: str, camera: str) -> str:
        """As :meth:`ImageSource.where`."""
        return self.whole.where(frame, camera)


def halved_size(width: int, height: int) -> tuple[int, int]:
    """Width and height of an image at half its size, px."""
    return max(round(width / 2), 1), max(round(height / 2), 1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Capture(Displayed):
    """What a handpiece recorded. Images are read on demand."""

    handpiece: Handpiece
    """Nominal or calibrated; all that the reconstruction knows besides the images."""
    frames: tuple[Frame, ...]
    """In the order of capture."""
    source: ImageSource
    """Where the images come from."""
    left_out: tuple[Dropped, ...] = ()
    """Images that are missing, and why."""

    def __repr__(self) -> str:
        images = sum(len(frame.cameras) for frame in self.frames)
        left_out = f", {len(self.left_out)} left out" if self.left_out else ""
        return f"Capture({len(self.frames)} frames, {images} images{left_out}, {self.handpiece})"

    def halved(self) -> Capture:
        """The same capture with images of half the size, and a handpiece that takes such images."""
        return replace(self, handpiece=self.handpiece.scaled(0.5), source=HalvedImages(self.source))

    def image(self, frame: Frame, camera: str) -> UInt8[np.ndarray, "h w 3"]:
        """RGB image. Raises InputError where it is missing, damaged, or not of the camera's size."""
        return as_8_bits(self.fine_image(frame, camera))

    def images(self, frame: Frame) -> dict[str, UInt8[np.ndarray, "h w 3"]]:
        """The images of all cameras that have one of a frame, as :meth:`image`."""
        return {name: self.image(frame, name) for name in frame.cameras}

    def fine_image(self, frame: Frame, camera: str) -> Pixels:
        """As :meth:`image`, with fractions of digital numbers (float32) where more than 8 bits are stored."""
        self.check_image(frame, camera)
        return self.source.read(frame.name, camera)

    def fine_images(self, frame: Frame) -> dict[str, Pixels]:
        """The images of all cameras that have one of a frame, as :meth:`fine_image`."""
        return {name: self.fine_image(frame, name) for name in frame.cameras}

    def masks(self, frame: Frame) -> dict[str, UInt8[np.ndarray, "h w"]]:
        """The masks of those cameras that have one of a frame, as :meth:`ImageSource.mask`."""
        masks = {name: self.source.mask(frame.name, name) for name in frame.cameras}
        return {name: mask for name, mask in masks.items() if mask is not None}

    def check_image(self, frame: Frame, camera: str) -> None:
        """Raise what :meth:`image` would, as far as possible without decoding the image."""
        model = self.handpiece.rig[camera].camera
        width, height = self.source.size(frame.name, camera)
        if (width, height) != (model.width, model.height):
            raise InputError(
                f"{self.source.where(frame.name, camera)}: {width} x {height} px, but camera {camera} has "
                f"{model.width} x {model.height} px; give the handpiece file that belongs to these images"
            )
