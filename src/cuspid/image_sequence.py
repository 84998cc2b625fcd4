"""The frames of one hand-held camera in order: images on disk that are read on demand."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from cuspid.camera import Camera
from cuspid.capture import read_image
from cuspid.errors import InputError


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageSequence:
    """Images of one camera in the order in which they were taken."""

    source: Path
    """What the user gave: a folder, a video or a capture."""
    paths: tuple[Path, ...] = field(repr=False)
    """One image file per frame; their stems are the frames' names."""
    size: tuple[int, int]
    """Width and height of every frame, px."""
    camera: Camera | None = None
    """Calibration, or None if it is to be found from the images."""
    working_distance_mm: float | None = None
    """Nominal distance of the camera from the teeth, if the calibration states it."""
    notes: tuple[str, ...] = ()
    """What was found while reading, one line each."""
    orientations: tuple[int, ...] = ()
    """EXIF orientation of each frame, where the camera was held in different ways: images then are taken as its sensor
    recorded them, not turned upright."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the frames."""
        return tuple(path.stem for path in self.paths)

    def __len__(self) -> int:
        return len(self.paths)

    def image(self, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """RGB image of a frame. Raises InputError where the file is missing, damaged, or of another size."""
        image = read_image(self.paths[index])
        if self.orientations:
            image = np.ascontiguousarray(recorded(image, self.orientations[index]))
        if image.shape[1::-1] != self.size:
            raise InputError(f"{self.paths[index]}: its size changed while it was in use; start again")
        return image


def exif_orientation(path: Path) -> int:
    """How an image was held when it was taken, as EXIF has it: 1 (upright) to 8; 1 where the file does not say."""
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            found = image.getexif().get(_ORIENTATION, 1)
    except Exception:  # what is wrong with the file is told where it is read
        return 1
    return found if isinstance(found, int) and 1 <= found <= 8 else 1


def recorded_size(path: Path) -> tuple[int, int]:
    """Width and height of an image as the sensor recorded it, px, of a file that was found to be an image."""
    with Image.open(path) as image:
        width, height = image.size
    return width, height


def recorded(upright: UInt8[np.ndarray, "h w c"], orientation: int) -> UInt8[np.ndarray, "h2 w2 c"]:
    """An image that was turned upright by its EXIF orientation, as the sensor recorded it."""
    across = upright.swapaxes(0, 1)
    return {
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: across,
        6: np.rot90(upright, 1),
        7: across[::-1, ::-1],
        8: np.rot90(upright, -1),
    }[orientation]


_ORIENTATION = 0x0112
