"""Cameras of Video4Linux (UVC), by OpenCV: their images as the driver delivers them, and their controls.

The kernel stamps a buffer on the monotonic clock, the one of ``time.monotonic``; a driver that does not is noticed, and
its images have the time of their arrival. OpenCV gives and takes the plain values of the controls: exposure times are
in 0.1 ms (V4L2_CID_EXPOSURE_ABSOLUTE), and an automatic exposure is off at 1 (V4L2_EXPOSURE_MANUAL).
"""

from __future__ import annotations

import re
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np

from cuspid.footage.cameras import ExposureOptions, Pixels, Ready, Setting, Shot
from cuspid.footage.jpeg import complete_jpeg
from cuspid.footage.quality import measure_quality, shrink_to_grey
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range

Device = Any
"""``cv2.VideoCapture``, or what behaves like it."""
_MANUAL = 1.0
_PER_MS = 10.0
"""Units of the exposure in a millisecond."""
_MOST_LATE_S = 1.0
"""A time stamp further back than this is of another clock."""
_LEAST_IMAGES = 8
_WAITING = 5
"""Images that a driver may hold back: OpenCV gives it four buffers."""
_MOST_DAMAGED = 20
_LESS = (
    "cameras on one USB hub share its bandwidth: ask for less (--width-px, --height-px, --frames-per-s), or use "
    "another socket"
)
_UNLIKE = 1.25
"""Factor by which the brightness changes where a held exposure is not the one before."""
_SAME = 0.02
"""Share by which a value that is read back may differ from the one that was set."""
_CONTROLS: dict[str, tuple[int, int | None, float]] = {
    "exposure_ms": (cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_AUTO_EXPOSURE, _PER_MS),
    "gain": (cv2.CAP_PROP_GAIN, None, 1.0),
    "white_balance_k": (cv2.CAP_PROP_WB_TEMPERATURE, cv2.CAP_PROP_AUTO_WB, 1.0),
    "focus": (cv2.CAP_PROP_FOCUS, cv2.CAP_PROP_AUTOFOCUS, 1.0),
}
"""The control of each setting, the one of its automatic, and the units of the driver in one of ours."""


@dataclass(frozen=True, kw_only=True)
class FormatOptions(Options):
    """What is asked of each camera."""

    width_px: Annotated[int | None, Range(16, 20_000)] = None
    """Width of the images (default: what the camera has chosen)."""
    height_px: Annotated[int | None, Range(16, 20_000)] = None
    """Height of the images."""
    frames_per_s: Annotated[float | None, Range(0.01, 10_000)] = None
    """Images a second (default: what the camera has chosen)."""
    pixels: Literal["mjpeg", "raw"] = "mjpeg"
    """Images that the camera has compressed, written as they come, where it has such; or uncompressed ones, written as
    PNG."""
    settle_s: Annotated[float, Range(0.1, 60)] = 1.5
    """How long each camera runs before its exposure is fixed."""


def open_device(device: str) -> Device:
    """A device of Video4Linux, whose images are taken as they are. Raises InputError where it cannot be opened."""
    if not Path(device).exists():
        raise InputError(f"{device}: no such camera; cuspid record --list names those that are there")
    with _silence_opencv():
        capture = cv2.VideoCapture(device, cv2.CAP_V4L2)
    if not capture.isOpened():
        raise InputError(
            f"{device}: cannot be opened as a camera; end the program that uses it, join the group 'video', or give "
            "another: cuspid record --list"
        )
    return capture


@contextmanager
def _silence_opencv() -> Iterator[None]:
    """What OpenCV would print of a device that fails is told in one line."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


class V4L2Camera:
    """A :class:`cuspid.footage.cameras.CameraSource` of a device."""

    def __init__(
        self,
        device: str,
        form: FormatOptions,
        *,
        open_device: Callable[[str], Device] = open_device,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._device, self._form, self._open, self._clock = device, form, open_device, clock
        self._capture: Device = None
        self._is_stamped, self._has_read = True, False

    def prepare(self, exposure: ExposureOptions) -> Ready:
        """See the protocol."""
        self._capture = self._open(self._device)
        code, size = self._set_form()
        before = self._grab(self._form.settle_s)
        settings = () if exposure.auto else self._hold(exposure)
        after = self._grab(self._form.settle_s / 2)
        times = np.array([each.time_s for each in (*before, *after)])
        self._is_stamped = self._is_stamped and bool((np.diff(times) > 0).all())
        return Ready(
            what=f"{self._device}, {code}",
            size=size,
            interval_s=float(np.median(np.diff([each.time_s for each in after]))),
            clock="driver" if self._is_stamped else "arrival",
            settings=settings,
            notes=tuple(self._notes(before[-1], after[-1], exposure)),
        )

    def shots(self, start_s: float) -> Iterator[Shot]:
        """See the protocol."""
        if not self._is_stamped:  # what has waited since would have the time at which it is fetched
            for _ in range(_WAITING):
                self._next()
        while True:
            shot = self._next()
            if shot is not None and shot.time_s >= start_s:
                yield shot

    def close(self) -> None:
        """See the protocol."""
        if self._capture is not None:
            self._capture.release()

    def _set_form(self) -> tuple[str, tuple[int, int]]:
        """The code of the pixels and the size that are delivered. Raises InputError where the size is not the one that
        was asked for."""
        form, capture = self._form, self._capture
        code = "MJPG" if form.pixels == "mjpeg" else "YUYV"
        capture.set(cv2.CAP_PROP_FOURCC, float(cv2.VideoWriter.fourcc(*code)))
        for control, value in (
            (cv2.CAP_PROP_FRAME_WIDTH, form.width_px),
            (cv2.CAP_PROP_FRAME_HEIGHT, form.height_px),
            (cv2.CAP_PROP_FPS, form.frames_per_s),
        ):
            if value is not None:
                capture.set(control, float(value))
        code = int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode("ascii", "replace").strip()
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 0.0 if code in _AS_DELIVERED else 1.0)
        size = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        size_px = form.width_px or size[0], form.height_px or size[1]
        if size != size_px:
            raise InputError(
                f"{self._device}: delivers {size[0]} x {size[1]} px, not {size_px[0]} x {size_px[1]}; give a size that "
                "it has with --width-px and --height-px"
            )
        return code, size

    def _grab(self, seconds: float) -> list[Shot]:
        """Images of some seconds, at least a few. Raises InputError where they are damaged."""
        end_s, found, damaged = self._clock() + seconds, list[Shot](), 0
        while self._clock() < end_s or len(found) < _LEAST_IMAGES:
            shot = self._next()
            found += [] if shot is None else [shot]
            damaged += shot is None
            if damaged > _MOST_DAMAGED + len(found):
                raise InputError(f"{self._device}: most of its images arrive cut off; {_LESS}")
        return found

    def _hold(self, exposure: ExposureOptions) -> tuple[Setting, ...]:
        """Switch each automatic off, and set what was given, or else what it has come to."""
        capture, settings = self._capture, []
        for name, (control, automatic, units) in _CONTROLS.items():
            given, found = getattr(exposure, name), capture.get(control)
            if automatic is not None:
                capture.set(automatic, _MANUAL if name == "exposure_ms" else 0.0)
            if found < 0 and given is None:  # it has no such control, and nobody asks for it
                continue
            requested = found / units if given is None else given
            is_taken = capture.set(control, round(requested * units))
            reported = capture.get(control) / units
            is_off = automatic is None or capture.get(automatic) in (-1.0, _MANUAL if name == "exposure_ms" else 0.0)
            is_same = abs(reported - requested) <= max(_SAME * requested, 0.5 / units)
            settings.append(
                Setting(
                    name=name,
                    asked=float(requested),
                    told=None if found < 0 else float(reported),
                    is_held=bool(found >= 0 and is_taken and is_off and is_same),
                )
            )
        return tuple(settings)

    def _notes(self, before: Shot, after: Shot, exposure: ExposureOptions) -> Iterator[str]:
        if exposure.auto:
            yield "exposure, gain and white balance are left to the camera; do not calibrate light from these images"
            return
        levels = [
            None if (rgb := each.rgb()) is None else measure_quality(shrink_to_grey(rgb), None)[0]
            for each in (before, after)
        ]
        first, second = (each or 0.0 for each in levels)
        ratio = max(first, 1.0) / max(second, 1.0)
        if exposure.exposure_ms is None and exposure.gain is None and not 1 / _UNLIKE < ratio < _UNLIKE:
            yield (
                f"its images are {1 / ratio:.2f} times as bright since the exposure was fixed: the camera does not "
                f"report what its automatic had chosen; give --exposure-ms and --gain"
            )
        if not self._is_stamped:
            yield "its driver does not stamp images on this machine's clock; they have the time of their arrival"

    def _next(self) -> Shot | None:
        """The next image, None where it is damaged. Raises InputError where none comes."""
        is_read, delivered = self._capture.read()
        now_s = self._clock()
        if not is_read:
            if not Path(self._device).exists():
                raise InputError(f"{self._device}: it is unplugged; plug it in, and record again")
            if not self._has_read:
                raise InputError(f"{self._device}: delivers no images; {_LESS}")
            raise InputError(f"{self._device}: delivers no more images; check its plug, and record again")
        self._has_read = True
        stamp_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        self._is_stamped = self._is_stamped and now_s - _MOST_LATE_S < stamp_s <= now_s
        data = _whole_image(delivered)
        return None if data is None else Shot(time_s=stamp_s if self._is_stamped else now_s, data=data)


_AS_DELIVERED = ("MJPG", "JPEG", "GREY", "Y10", "Y12", "Y16")
"""Pixels that OpenCV hands over as they are, compressed or grey; it converts others to BGR."""


def _whole_image(found: np.ndarray) -> bytes | Pixels | None:
    """A JPEG file, or pixels; None where it is damaged."""
    if found.dtype == np.uint8 and found.ndim == 2 and min(found.shape) == 1:
        return complete_jpeg(found.tobytes())
    return cv2.cvtColor(found, cv2.COLOR_BGR2RGB) if found.ndim == 3 and found.shape[2] == 3 else found.copy()


# --- which there are -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class FoundCamera:
    """A camera that is plugged in."""

    device: str
    """Its device file."""
    card: str
    """What it calls itself."""
    place: str
    """A name of the device that stays where several cameras are alike; the device itself where there is none."""
    formats: tuple[str, ...]
    """Codes of the pixels that it delivers."""


_QUERY, _FORMATS = 0x80685600, 0xC0405602
"""VIDIOC_QUERYCAP and VIDIOC_ENUM_FMT (linux/videodev2.h)."""
_HAS_OWN, _CAPTURES = 0x80000000, 0x1
_MOST_FORMATS = 32


def find_cameras(root: Path = Path("/dev")) -> tuple[FoundCamera, ...]:
    """The cameras that are plugged in; devices that deliver no images, as of metadata, are left out."""
    devices = [path for path in root.glob("video*") if re.fullmatch(r"video\d+", path.name)]
    ordered = sorted(devices, key=lambda path: int(path.name.removeprefix("video")))
    return tuple(found for device in ordered if (found := _query_device(device, root)) is not None)


def _query_device(device: Path, root: Path) -> FoundCamera | None:
    """What a device says of itself; None where it is no camera, or may not be asked."""
    import fcntl  # only where there are such devices

    with suppress(OSError), device.open("rb", buffering=0) as stream:
        reply = fcntl.ioctl(stream, _QUERY, bytes(104))
        card = reply[16:48].split(b"\0")[0].decode(errors="replace")
        all_of_it, own = struct.unpack("II", reply[84:92])
        if (own if all_of_it & _HAS_OWN else all_of_it) & _CAPTURES:
            place = next((link for link in sorted(root.glob("v4l/by-path/*")) if link.samefile(device)), device)
            return FoundCamera(device=str(device), card=card, place=str(place), formats=tuple(_formats(stream)))
    return None


def _formats(stream: Any) -> Iterator[str]:
    import fcntl

    with suppress(OSError):
        for index in range(_MOST_FORMATS):
            reply = fcntl.ioctl(stream, _FORMATS, struct.pack("II", index, 1) + bytes(56))
            yield reply[44:48].decode(errors="replace").strip()
