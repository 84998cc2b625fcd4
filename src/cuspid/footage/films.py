"""The film of a camera: a folder of images or a video, developed frame by frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16

from cuspid.runtime.errors import InputError
from cuspid.runtime.image_files import image_size, read_deep
from cuspid.runtime.options import Options, Range
from cuspid.storage.sequences import hash_source, images_in
from cuspid.storage.videos import VideoFrame, VideoLength, read_video, video_length

Image = UInt8[np.ndarray, "h w *c"] | UInt16[np.ndarray, "h w *c"]
"""Grey or RGB."""


@dataclass(frozen=True, kw_only=True)
class DevelopmentOptions(Options):
    """How images are made from the sensor's data."""

    bayer: Literal["none", "RGGB", "BGGR", "GRBG", "GBRG"] = "none"
    """Colours of the first four pixels (two rows) of images that have not been demosaiced; none: they are ordinary
    images."""
    bits: Annotated[int | None, Range(9, 16)] = None
    """Number of significant bits in 16-bit images; 16 unless given."""


@dataclass(frozen=True, kw_only=True)
class Film:
    """What one camera recorded."""

    camera: str
    """Name of the camera."""
    source: Path
    """A folder of images, or a video."""
    images: tuple[Path, ...]
    """The images of a folder, in order; empty for a video."""
    length: VideoLength
    """Expected number of frames."""
    digest: str
    """SHA-256 of the whole film."""

    @property
    def is_video(self) -> bool:
        """Whether it is a single file."""
        return not self.images

    def name(self, number: int) -> str:
        """Name of a frame: that of its image file, or its number in the video."""
        return f"{number:05d}" if self.is_video else self.images[number].stem


@dataclass(frozen=True, eq=False, kw_only=True)
class FilmFrame:
    """A frame of a film."""

    number: int
    """Number, from 0, in the order of the film."""
    time_s: float | None
    """Presentation time, or None where the film does not state it."""
    where: str
    """Where it is, for messages."""
    stored: Callable[[], Image]
    """Reads the stored image: grey or RGB. Raises InputError where it is damaged."""
    png: Path | None = None
    """The file itself, if it is a PNG."""


def open_film(camera: str, source: Path) -> Film:
    """The film of a camera. Raises InputError where it has no frame."""
    images = tuple(images_in(source)) if source.is_dir() else ()
    if source.is_dir() and not images:
        raise InputError(f"{source}: it contains no images; camera {camera} needs images or a video")
    stems = Counter(path.stem for path in images)
    if images and max(stems.values()) > 1:
        raise InputError(f"{source}: two images are named {stems.most_common(1)[0][0]}; each needs its own name")
    if not images and next(read_video(source), None) is None:
        raise InputError(
            f"{source}: no frame can be decoded; it is not a video, is truncated, or has an unknown codec: "
            "copy it again, or convert it"
        )
    length = VideoLength(frames=len(images), is_counted=True, seconds=0.0) if images else video_length(source)
    return Film(camera=camera, source=source, images=images, length=length, digest=hash_source(source))


def sizes_of(film: Film) -> Iterator[tuple[str, tuple[int, int]]]:
    """The place of each image and its width and height, as far as the headers state them; for a video, of the first
    frame."""
    for path in film.images:
        try:
            yield str(path), image_size(path)
        except InputError:  # it is found to be damaged when it is looked at
            continue
    if film.is_video:
        yield str(film.source), next(read_video(film.source)).size


def frames_of(film: Film, options: DevelopmentOptions) -> Iterator[FilmFrame]:
    """The existing frames of a film, in order."""
    if film.is_video:
        for frame in read_video(film.source):
            where = f"{film.source}: frame {frame.number}"
            read = partial(_convert_video_frame, frame, where, is_grey=options.bayer != "none")
            yield FilmFrame(number=frame.number, time_s=frame.time_s, where=where, stored=read)
    for number, path in enumerate(film.images):
        png = path if path.suffix == ".png" else None
        yield FilmFrame(number=number, time_s=None, where=str(path), stored=partial(read_deep, path), png=png)


def _convert_video_frame(frame: VideoFrame, where: str, *, is_grey: bool) -> Image:
    if frame.damaged:
        raise InputError(f"{where}: damaged; copy the video again")
    return frame.grey() if is_grey else frame.rgb()


def develop_image(stored: Image, options: DevelopmentOptions, where: str) -> Image:
    """The image made from the stored one: demosaiced, and scaled to the full range. Raises InputError where it cannot
    be made."""
    if options.bits is not None and stored.dtype == np.uint16:
        if stored.max() >> options.bits:
            raise InputError(
                f"{where}: has values up to {int(stored.max())}, more than {options.bits} bits can hold; correct --bits"
            )
        stored = stored << (16 - options.bits)
    if options.bayer == "none":
        return stored
    if stored.ndim != 2:
        raise InputError(f"{where}: already in colour; --bayer is for single-channel images")
    return cv2.cvtColor(stored, getattr(cv2, f"COLOR_Bayer{options.bayer}2RGB"))
