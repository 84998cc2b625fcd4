"""A capture: what the handpiece recorded, images on disk in COLMAP's rig layout ``images/<camera>/<frame>.png``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from cuspid.errors import InputError
from cuspid.rig import Handpiece


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """An 8-bit RGB image. Raises InputError where the file is missing or cannot be decoded whole."""
    try:
        encoded = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); put the image back or drop its frame") from error
    if path.suffix.lower() == ".png" and b"IEND" not in encoded[-16:].tobytes():
        raise InputError(f"{path}: truncated PNG; copy the image again")
    image = cv2.imdecode(encoded, cv2.IMREAD_COLOR_RGB) if encoded.size else None
    if image is None:
        raise InputError(f"{path}: not an image that can be decoded; copy the image again")
    return np.asarray(image, dtype=np.uint8)


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
        path = self.image_path(frame, camera)
        image = read_image(path)
        model = self.handpiece.rig[camera].camera
        if image.shape[:2] != (model.height, model.width):
            raise InputError(
                f"{path}: {image.shape[1]} x {image.shape[0]} px, but camera {camera} has "
                f"{model.width} x {model.height} px; give the handpiece file that belongs to these images"
            )
        return image

    def gray(self, frame: Frame | str, camera: str) -> UInt8[np.ndarray, "h w"]:
        """The image in grey (Rec. 601), as :meth:`image`."""
        return np.asarray(cv2.cvtColor(self.image(frame, camera), cv2.COLOR_RGB2GRAY), dtype=np.uint8)
