"""Grey images of a capture that are used again after their keypoints were detected."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import UInt8

from cuspid.model.capture import Capture, Frame
from cuspid.runtime.image_files import Pixels, visible_grey

_BYTES = 400_000_000
"""Memory for the images that are kept."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """Reads the images of a capture, and keeps the first of them in grey, as many as fit in memory."""

    capture: Capture
    """The capture whose images are read."""
    max_bytes: int = _BYTES
    """Memory for the images that are kept, in bytes."""
    _kept: dict[tuple[str, str], UInt8[np.ndarray, "h w"]] = field(default_factory=dict, init=False, repr=False)

    def image(self, frame: Frame, camera: str) -> Pixels:
        """As :meth:`cuspid.model.capture.Capture.fine_image`, with the same errors."""
        image = self.capture.fine_image(frame, camera)
        if (len(self._kept) + 1) * image.shape[0] * image.shape[1] <= self.max_bytes:
            self._kept[frame.name, camera] = visible_grey(image)
        return image

    def grey(self, frame: Frame, camera: str) -> UInt8[np.ndarray, "h w"]:
        """The grey image, read again if it was not kept. Raises InputError as :meth:`image` does."""
        kept = self._kept.get((frame.name, camera))
        return visible_grey(self.image(frame, camera)) if kept is None else kept
