"""What stands for a camera: a film or a folder of images that is played back, or images that are rendered."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

from cuspid.footage.cameras import ExposureOptions, Pixels, Ready, Shot
from cuspid.footage.films import DevelopmentOptions, frames_of, open_film, sizes_of
from cuspid.footage.jpeg import complete_jpeg
from cuspid.runtime.errors import InputError
from cuspid.runtime.inputs import read_bytes
from cuspid.storage.videos import read_jpegs, video_rate

USUAL_PER_S = 30.0
"""Rate of a film that does not state its own."""
_JPEG = (".jpg", ".jpeg")

Sleep = Callable[[float], None]


class FilmCamera:
    """A :class:`cuspid.footage.cameras.CameraSource` that plays a film or the images of a folder; JPEG images, those of
    Motion JPEG too, are handed over as they are stored."""

    def __init__(self, camera: str, source: Path, rate_per_s: float | None, *, sleep: Sleep = time.sleep) -> None:
        """Play a film at its own times, or at a rate."""
        self._film, self._asked, self._sleep = open_film(camera, source), rate_per_s, sleep
        self._rate = rate_per_s or (video_rate(source) if self._film.is_video else None) or USUAL_PER_S

    def prepare(self, exposure: ExposureOptions) -> Ready:
        """See the protocol. Nothing of the exposure can be set."""
        _, size = next(sizes_of(self._film))
        return Ready(what=f"{self._film.source}, played back", size=size, interval_s=1 / self._rate, clock="schedule")

    def shots(self, start_s: float) -> Iterator[Shot]:
        """See the protocol."""
        first_s: float | None = None
        for number, (time_s, data) in enumerate(self._images()):
            first_s = time_s if first_s is None else first_s
            after_s = number / self._rate
            if self._asked is None and time_s is not None and first_s is not None:
                after_s = time_s - first_s
            yield Shot(time_s=_wait_until(start_s + after_s, self._sleep), data=data)

    def close(self) -> None:
        """See the protocol."""

    def _images(self) -> Iterator[tuple[float | None, bytes | Pixels]]:
        film = self._film
        if film.is_video and (packets := read_jpegs(film.source)) is not None:
            yield from ((time_s, jpeg) for time_s, sent in packets if (jpeg := complete_jpeg(sent)) is not None)
        elif film.images and all(path.suffix.lower() in _JPEG for path in film.images):
            yield from ((None, read_bytes(path, "image")) for path in film.images)
        else:
            yield from ((frame.time_s, frame.stored()) for frame in frames_of(film, DevelopmentOptions()))


class RenderedCamera:
    """A :class:`cuspid.footage.cameras.CameraSource` whose images are computed; one that takes longer than its interval
    comes late, with the time at which it was due."""

    def __init__(
        self,
        render: Callable[[float], Pixels],
        *,
        size: tuple[int, int],
        rate_per_s: float,
        delay_s: float = 0.0,
        sleep: Sleep = time.sleep,
    ) -> None:
        """Images of moments after the start, at a rate, the first after a delay."""
        if rate_per_s <= 0:
            raise InputError(f"a rendered camera takes {rate_per_s:g} images a second; it must be more than 0")
        self._render, self._size, self._rate, self._delay_s, self._sleep = render, size, rate_per_s, delay_s, sleep

    def prepare(self, exposure: ExposureOptions) -> Ready:
        """See the protocol. Nothing of the exposure can be set."""
        return Ready(what="rendered", size=self._size, interval_s=1 / self._rate, clock="schedule")

    def shots(self, start_s: float) -> Iterator[Shot]:
        """See the protocol; there is no end."""
        number = 0
        while True:
            after_s = self._delay_s + number / self._rate
            data = self._render(after_s)
            yield Shot(time_s=_wait_until(start_s + after_s, self._sleep), data=data)
            number += 1

    def close(self) -> None:
        """See the protocol."""


def _wait_until(due_s: float, sleep: Sleep) -> float:
    """A moment, once it has come."""
    if (left_s := due_s - time.monotonic()) > 0:
        sleep(left_s)
    return due_s
