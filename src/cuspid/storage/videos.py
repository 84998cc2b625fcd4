"""Videos: films of a capture are written, any others are read, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import av
import cv2
import numpy as np
from jaxtyping import UInt8, UInt16

from cuspid.model.capture import Capture
from cuspid.runtime.errors import OutputError
from cuspid.runtime.inputs import require_file
from cuspid.storage.files import whole_file

FRAMES_PER_S = 30.0
"""Of a film whose frames have no times."""
_STREAMS = {".mjpeg": "mjpeg", ".mjpg": "mjpeg", ".h264": "h264", ".264": "h264"}
"""What cameras send, dumped without a container that would have times."""
VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", *_STREAMS)
# A playlist, which also can be a "video", would have other files and addresses opened.
_OPENED = {"format_whitelist": "mov,mp4,avi,matroska,webm,mjpeg,h264", "protocol_whitelist": "file"}
_MOST_PIXELS = 1 << 27


@dataclass(frozen=True, eq=False, kw_only=True)
class VideoFrame:
    """A frame of a video."""

    number: int
    """From 0 in the order in which they are shown; one that cannot be decoded leaves a gap."""
    time_s: float | None
    """Presentation time, or None where the file has none."""
    damaged: bool
    """Whether a part of it is made up, for the file is damaged there."""
    decoded: av.VideoFrame = field(repr=False)
    """As the decoder has it."""

    def rgb(self) -> UInt8[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w 3"]:
        """Upright; of 16 bits where the video has more than 8."""
        return self._pixels("rgb48le" if self._is_deep else "rgb24")

    def grey(self) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]:
        """As :meth:`rgb`, the brightness alone."""
        return self._pixels("gray16le" if self._is_deep else "gray")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in px, upright."""
        width, height = self.decoded.width, self.decoded.height
        return (height, width) if self._quarters % 2 else (width, height)

    @property
    def _quarters(self) -> int:
        """Turns by 90 degrees, counter-clockwise, that make it upright."""
        return round(self.decoded.rotation / 90)

    @property
    def _is_deep(self) -> bool:
        return max(each.bits for each in self.decoded.format.components) > 8

    def _pixels(self, layout: str) -> np.ndarray:
        return np.ascontiguousarray(np.rot90(self.decoded.to_ndarray(format=layout), self._quarters))


@dataclass(frozen=True, kw_only=True)
class VideoLength:
    """How long a video says that it is."""

    frames: int
    """Number of frames; 0 where it does not say."""
    is_counted: bool
    """Whether it says so itself, or it follows from how long it takes."""
    seconds: float
    """0 where it does not say."""

    def missing(self, frames: int, last_s: float | None) -> str | None:
        """What is missing of a video that ends after so many frames, the last one at a time; None where nothing is."""
        if self.is_counted and frames < self.frames - 1:
            return f"truncated, only {frames} of {self.frames} frames could be decoded; the rest is missing"
        if not self.is_counted and last_s is not None and frames and self.seconds > last_s * (1 + 3 / frames) + 0.1:
            return f"truncated, it ends after {last_s:.2f} of {self.seconds:.2f} s; the rest is missing"
        return None


def video_length(path: Path) -> VideoLength:
    """What the header of a video says. Raises InputError where it is no file."""
    with _open_video(path) as container:
        if container is None:
            return VideoLength(frames=0, is_counted=False, seconds=0.0)
        stream = container.streams.video[0]
        seconds = max(0, container.duration or 0) / av.time_base
        frames = max(0, stream.frames or round(seconds * float(stream.average_rate or 0)))
        return VideoLength(frames=frames, is_counted=stream.frames > 0, seconds=seconds)


def read_video(path: Path) -> Iterator[VideoFrame]:
    """The frames of a video that can be decoded, none where it is no video or of an unknown codec.

    Raises InputError where it is no file.
    """
    with _open_video(path) as container:
        if container is None:
            return
        clock_s = None if container.format.name in _STREAMS.values() else container.streams.video[0].time_base
        for number, (frame, damaged) in enumerate(_decode_frames(container)):
            if frame is not None:
                time_s = None if clock_s is None or frame.pts is None else float(frame.pts * clock_s)
                yield VideoFrame(number=number, time_s=time_s, damaged=damaged, decoded=frame)


def video_rate(path: Path) -> float | None:
    """Frames a second of a video, None where its header does not say. Raises InputError where it is no file."""
    with _open_video(path) as container:
        if container is None or container.format.name in _STREAMS.values():
            return None
        rate = container.streams.video[0].average_rate
        return float(rate) if rate else None


def read_jpegs(path: Path) -> Iterator[tuple[float | None, bytes]] | None:
    """The frames of a Motion JPEG video as they are stored, with their times where it has such; None where it is of
    another codec. Raises InputError where it is no file."""
    with _open_video(path) as container:
        if container is None or container.streams.video[0].codec_context.name != "mjpeg":
            return None
    return _jpegs(path)


def _jpegs(path: Path) -> Iterator[tuple[float | None, bytes]]:
    with _open_video(path) as container:
        if container is None:
            return
        has_times = container.format.name not in _STREAMS.values()
        for packet in _packets(container):
            if packet is not None:
                pts = packet.pts if has_times else None
                yield None if pts is None else float(pts * packet.time_base), bytes(packet)


def _decode_frames(container: av.container.InputContainer) -> Iterator[tuple[av.VideoFrame | None, bool]]:
    """Each frame, None where it cannot be decoded, and whether it is damaged."""
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    stream.codec_context.options = {"max_pixels": str(_MOST_PIXELS)}
    cut = set()
    for packet in _packets(container):
        if packet is not None and packet.is_corrupt:
            cut.add(packet.dts if packet.pts is None else packet.pts)
        try:
            frames = stream.codec_context.decode(packet)
        except av.FFmpegError:
            if packet is not None:
                yield None, True
            continue
        yield from ((frame, frame.is_corrupt or frame.pts in cut) for frame in frames)


def _packets(container: av.container.InputContainer) -> Iterator[av.Packet[av.VideoStream] | None]:
    """Until the file ends or cannot be understood any more; then None, for what the decoder still holds."""
    with suppress(av.FFmpegError):
        yield from (packet for packet in container.demux(container.streams.video[0]) if packet.size)
    yield None


@contextmanager
def _open_video(path: Path) -> Iterator[av.container.InputContainer | None]:
    require_file(path, "file")
    kind = _STREAMS.get(path.suffix.lower())
    try:
        container = av.open(f"file:{path}", format=kind, options=_OPENED, metadata_errors="replace")
    except av.FFmpegError:
        yield None
        return
    with container:
        film = next(iter(container.streams.video), None)
        # A codec that is unknown has no context to decode with.
        yield None if film is None or film.codec_context is None else container


def write_video(path: Path, capture: Capture, camera: str | None = None) -> None:
    """Write the frames of a camera (the first one, where none is named) as an MPEG-4 film, whole or not at all.

    Raises OutputError.
    """
    name = camera or capture.handpiece.rig.names[0]
    model = capture.handpiece.rig[name].camera
    with whole_file(path) as temporary:
        film = cv2.VideoWriter(
            str(temporary), cv2.VideoWriter.fourcc(*"mp4v"), FRAMES_PER_S, (model.width, model.height)
        )
        if not film.isOpened():
            raise OutputError(f"{path}: this build of OpenCV cannot write this video format; use .mp4")
        for frame in capture.frames:
            film.write(cv2.cvtColor(capture.image(frame, name), cv2.COLOR_RGB2BGR))
        film.release()
        # The writer says nothing of a disk that is full.
        written = int(cv2.VideoCapture(str(temporary)).get(cv2.CAP_PROP_FRAME_COUNT))
        if written != len(capture.frames):
            raise OutputError(f"{path}: only {written} of {len(capture.frames)} frames were written; is the disk full?")
