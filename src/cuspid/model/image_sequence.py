"""The frames of one hand-held camera in order: images on disk that are read on demand."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from cuspid.model.camera import Camera
from cuspid.runtime.errors import InputError
from cuspid.runtime.image_files import Pixels, as_8_bits, read_fine, undo_exif_orientation


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
    frames_per_s: float | None = None
    """Rate of the film whose frames are numbered by their names; None where nothing states it."""
    notes: tuple[str, ...] = ()
    """What was found while reading, one line each."""
    orientations: tuple[int, ...] = ()
    """EXIF orientation of each frame, where the camera was held in different ways: images then are taken as its sensor
    recorded them, not turned upright."""

    instants: tuple[str, ...] = ()
    """Names of the frames, where they are others than those of the files."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the frames."""
        return self.instants or tuple(path.stem for path in self.paths)

    def __repr__(self) -> str:
        calibrated = "not calibrated" if self.camera is None else "calibrated"
        return f"ImageSequence({len(self)} frames of {self.size[0]} x {self.size[1]} px, {calibrated}, {self.source})"

    def __len__(self) -> int:
        return len(self.paths)

    def image(self, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """RGB image of a frame. Raises InputError where the file is missing, damaged, or of another size."""
        return as_8_bits(self.fine_image(index))

    def fine_image(self, index: int) -> Pixels:
        """As :meth:`image`, with fractions of digital numbers (float32) where more than 8 bits are stored."""
        image = read_fine(self.paths[index])
        if self.orientations:
            image = np.ascontiguousarray(undo_exif_orientation(image, self.orientations[index]))
        if image.shape[1::-1] != self.size:
            raise InputError(f"{self.paths[index]}: its size changed while it was in use; start again")
        return image
