"""A capture: what the handpiece recorded, images on disk in COLMAP's rig layout ``images/<camera>/<frame>.png``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from cuspid.errors import InputError
from cuspid.rig import Handpiece

PNG_END = b"IEND\xaeB`\x82"
"""The last bytes of a whole PNG file."""


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """An 8-bit RGB image. Raises InputError where the file is missing or cannot be decoded whole."""
    image_size(path)
    image = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    if image is None:
        raise InputError(f"{path}: not an image that can be decoded; copy the image again")
    return np.asarray(image, dtype=np.uint8)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in px, from the header. Raises InputError where the file is missing, no image, or cut short."""
    try:
        with path.open("rb") as stream:
            size = Image.open(stream).size
            stream.seek(max(0, path.stat().st_size - len(PNG_END)))
            end = stream.read()
    except UnidentifiedImageError as error:
        raise InputError(f"{path}: not an image, or truncated; copy the image again") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); put the image back") from error
    if path.suffix.lower() == ".png" and end != PNG_END:
        raise InputError(f"{path}: truncated PNG; copy the image again")
    return size


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One position of the handpiece: all cameras exposed together."""

    name: str
    """File stem common to the images of all cameras."""
    exposure: str = "all"
    """Name of the exposure in the handpiece."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Capture:
    """Images and the handpiece that took them. Images are read when asked for."""

    folder: Path
    """Holds ``handpiece.json`` and ``images/``."""
    handpiece: Handpiece
    """Nominal or calibrated; all that reconstruction knows besides the images."""
    frames: tuple[Frame, ...]
    """In the order of capture."""
    suffix: str = ".png"
    """Image file suffix."""

    def image_path(self, frame: Frame | str, camera: str) -> Path:
        """Where the image of a camera at a frame lies."""
        name = frame if isinstance(frame, str) else frame.name
        return self.folder / "images" / camera / f"{name}{self.suffix}"

    def image(self, frame: Frame | str, camera: str) -> UInt8[np.ndarray, "h w 3"]:
        """RGB image. Raises InputError where the file is missing, broken, or of another size than the camera's."""
        self.check_image(frame, camera)
        return read_image(self.image_path(frame, camera))

    def images(self, frame: Frame | str) -> dict[str, UInt8[np.ndarray, "h w 3"]]:
        """The images of all cameras at a frame, as :meth:`image`."""
        return {name: self.image(frame, name) for name in self.handpiece.rig.names}

    def check_image(self, frame: Frame | str, camera: str) -> None:
        """Raise what :meth:`image` would, as far as a glance at the file tells."""
        path, model = self.image_path(frame, camera), self.handpiece.rig[camera].camera
        width, height = image_size(path)
        if (width, height) != (model.width, model.height):
            raise InputError(
                f"{path}: {width} x {height} px, but camera {camera} has {model.width} x {model.height} px; "
                "give the handpiece file that belongs to these images"
            )

    def gray(self, frame: Frame | str, camera: str) -> UInt8[np.ndarray, "h w"]:
        """The image in grey (Rec. 601), as :meth:`image`."""
        return np.asarray(cv2.cvtColor(self.image(frame, camera), cv2.COLOR_RGB2GRAY), dtype=np.uint8)
