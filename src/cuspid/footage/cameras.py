"""What images are recorded from: the interface of a camera, and what it says of its exposure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16

from cuspid.runtime.errors import OutputError
from cuspid.runtime.options import Options, Range

Pixels = UInt8[np.ndarray, "h w *c"] | UInt16[np.ndarray, "h w *c"]
"""Grey or RGB."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Shot:
    """An image as a camera delivered it."""

    time_s: float
    """When it was taken, on the monotonic clock of this machine (``time.monotonic``)."""
    data: bytes | Pixels = field(repr=False)
    """A whole JPEG file, or the pixels."""

    @property
    def suffix(self) -> str:
        """Of the file that holds it without loss."""
        return ".jpg" if isinstance(self.data, bytes) else ".png"

    @property
    def size_bytes(self) -> int:
        """What it takes of the memory."""
        return len(self.data) if isinstance(self.data, bytes) else self.data.nbytes

    def file(self) -> bytes:
        """The contents of that file. Raises OutputError where the image cannot be encoded."""
        if isinstance(self.data, bytes):
            return self.data
        shown = cv2.cvtColor(self.data, cv2.COLOR_RGB2BGR) if self.data.ndim == 3 else self.data
        is_encoded, encoded = cv2.imencode(".png", shown, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if not is_encoded:
            raise OutputError(f"an image of {self.data.shape} cannot be encoded as PNG; let the camera deliver another")
        return encoded.tobytes()

    def rgb(self) -> UInt8[np.ndarray, "h w 3"] | None:
        """RGB of 8 bits for display; None where it cannot be decoded."""
        if isinstance(self.data, bytes):
            decoded = cv2.imdecode(np.frombuffer(self.data, np.uint8), cv2.IMREAD_COLOR)
            return None if decoded is None else cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB)
        pixels = (self.data >> 8).astype(np.uint8) if self.data.dtype == np.uint16 else self.data
        return pixels if pixels.ndim == 3 else cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB)


@dataclass(frozen=True, kw_only=True)
class ExposureOptions(Options):
    """Settings that stay fixed from the first image to the last; what is not given stays where the camera's own control
    has brought it."""

    exposure_ms: Annotated[float | None, Range(0.001, 10_000)] = None
    """Exposure time."""
    gain: Annotated[float | None, Range(0, 1e6)] = None
    """Gain, in the units of the driver."""
    white_balance_k: Annotated[float | None, Range(1000, 20_000)] = None
    """Colour temperature of the white balance."""
    focus: Annotated[float | None, Range(0, 1e6)] = None
    """Position of a focus that can be moved, in the units of the driver."""
    auto: bool = False
    """Leave exposure, gain, white balance and focus to the camera; then images are not alike, and nothing is fixed."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A setting that was requested of a camera, and the value that the camera reports."""

    name: str
    """Such as ``exposure_ms``."""
    asked: float
    """The value that it was given."""
    told: float | None
    """The value read back; None where the camera has no such control."""
    is_held: bool
    """Whether the driver took the value and its automatic, where it has one, is off."""

    def __str__(self) -> str:
        if self.told is None:
            return f"{self.name} not settable"
        if self.is_held:
            return f"{self.name} {self.told:g} held"
        if self.told == self.asked:
            return f"{self.name} {self.told:g} (the driver does not allow it to be set)"
        return f"{self.name} {self.asked:g} refused (it reports {self.told:g})"


@dataclass(frozen=True, kw_only=True)
class Ready:
    """A camera that is ready to record."""

    what: str
    """What it is, for people, such as ``/dev/video0 (USB camera), MJPEG``."""
    size: tuple[int, int]
    """Width and height, px."""
    interval_s: float
    """The usual time between its images."""
    clock: str
    """Whose time stamps the images have: ``driver``, ``arrival`` or ``schedule``."""
    settings: tuple[Setting, ...] = ()
    """What it holds."""
    notes: tuple[str, ...] = ()
    """What its user should know, one line each."""


@runtime_checkable
class CameraSource(Protocol):
    """A camera, or what stands for one. Its methods are called from one thread at a time."""

    def prepare(self, exposure: ExposureOptions) -> Ready:
        """Open it, let it settle, and hold its exposure. Raises InputError where this cannot be."""
        ...

    def shots(self, start_s: float) -> Iterator[Shot]:
        """Its images from a moment of the clock on, each as soon as it is there; ends where there will be no more.

        Raises InputError where the camera fails, as when it is unplugged.
        """
        ...

    def close(self) -> None:
        """Let it go."""
        ...


Cameras = Mapping[str, CameraSource]
"""By the name of the camera."""
