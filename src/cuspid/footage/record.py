"""Record several cameras at once: each image is written as it comes, under the number of its instant.

``<camera>/<instant>.jpg`` or ``.png``, and ``timestamps.csv`` with the time of each image that is written. Images have
the same name where they were taken in the same slot (:mod:`cuspid.footage.slots`). A file appears whole or not at all,
and before its line in the table: what was taken before a run is killed can be read.
"""

from __future__ import annotations

import errno
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, Queue
from threading import Event, Lock, Thread
from typing import Annotated

from cuspid.footage.cameras import Cameras, ExposureOptions, Ready, Shot
from cuspid.footage.slots import Slots
from cuspid.runtime.errors import CuspidError, InputError, OutputError
from cuspid.runtime.options import Options, Range
from cuspid.storage.captures import IMAGE_SUFFIXES
from cuspid.storage.files import AppendedTable, list_finished, write_bytes

TABLE = "timestamps.csv"
"""Its columns are ``camera``, ``frame`` (the name of the image) and ``time`` (s)."""
_DIGITS = 6
_WAITING_MIB, _LEAST_WAITING = 128, 4
"""Images of a camera that may wait to be written."""
_LOOK_S = 0.2
_RATE_OVER_S = 2.0
_RECENT = 8
"""Instants that are kept to be looked at."""
_LEAD_S = 0.05
"""From the moment when all cameras are ready to the first image."""


@dataclass(frozen=True, kw_only=True)
class RecordOptions(Options):
    """How much is recorded."""

    seconds: Annotated[float | None, Range(0.01, 1e6)] = None
    """How long (default: until Ctrl-C, or the films that are played end)."""
    every_s: Annotated[float | None, Range(0.001, 1e5)] = None
    """Keep one image of each camera so often, all at the same instants (default: every image)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraStatus:
    """What has come of a camera so far."""

    written: int
    """Images on disk."""
    missing: int
    """Instants between the first and the latest of which it has no image."""
    unwritten: int
    """Images that the disk or the processor were too slow for; they are among the missing."""
    per_s: float
    """Images a second, lately."""
    latest: Shot | None
    """The latest image."""


Status = Mapping[str, CameraStatus]
"""By camera."""
Together = Mapping[str, Shot]
"""Images of one instant, by camera."""
_Item = tuple[int, Shot] | None
"""What is to be written: an image and its number, and None at the end."""


class Recording:
    """Cameras that are being recorded into a folder."""

    def __init__(self, cameras: Cameras, folder: Path, options: RecordOptions) -> None:
        """Raises OutputError where the folder holds images already."""
        require_no_footage(folder, cameras)
        self._cameras, self._folder, self._options = cameras, folder, options
        self._stop = Event()
        self._error: BaseException | None = None
        self._lock = Lock()
        self._tallies = {name: _Tally() for name in cameras}
        self._recent = dict[int, dict[str, Shot]]()

    def prepare(self, exposure: ExposureOptions) -> dict[str, Ready]:
        """Open all cameras and hold their exposure, all at the same time. Raises InputError where one cannot be."""
        with ThreadPoolExecutor(len(self._cameras)) as pool:
            jobs = {name: pool.submit(camera.prepare, exposure) for name, camera in self._cameras.items()}
            return {name: job.result() for name, job in jobs.items()}

    def run(self, ready: Mapping[str, Ready], watch: Callable[[Recording], bool]) -> None:
        """Record until the time is up, all films have ended, Ctrl-C, or ``watch``, which is called several times a
        second, returns True. Raises InputError where a camera fails, OutputError where nothing more can be written;
        what was taken before stays."""
        slots = Slots(time.monotonic() + _LEAD_S, {name: each.interval_s for name, each in ready.items()})
        self._folder.mkdir(parents=True, exist_ok=True)
        with AppendedTable(self._folder / TABLE, ("camera", "frame", "time")) as table:
            queues: dict[str, Queue[_Item]] = {name: Queue() for name in self._cameras}
            takers = [Thread(target=self._guard, args=(self._take, each, slots, queues[each])) for each in queues]
            writers = [Thread(target=self._guard, args=(self._write, each, queues[each], table)) for each in queues]
            for thread in (*takers, *writers):
                thread.daemon = True  # a camera that hangs does not hold the program
                thread.start()
            try:
                while any(thread.is_alive() for thread in takers) and not self._stop.is_set():
                    if watch(self):
                        break
                    self._stop.wait(_LOOK_S)
            except KeyboardInterrupt:
                pass
            finally:
                self._stop.set()
                for thread in (*takers, *writers):
                    thread.join(_HANGS_S)
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Let all cameras go."""
        for camera in self._cameras.values():
            camera.close()

    @property
    def status(self) -> Status:
        """How far each camera is."""
        with self._lock:
            return {name: tally.status() for name, tally in self._tallies.items()}

    def together(self, after: int) -> tuple[int, Together] | None:
        """The latest instant later than another of which all cameras have an image, and its images."""
        with self._lock:
            whole = [k for k, shots in self._recent.items() if k > after and len(shots) == len(self._cameras)]
            return (max(whole), dict(self._recent[max(whole)])) if whole else None

    # --- in threads ----------------------------------------------------------------------------------------------

    def _guard(self, work: Callable[..., None], name: str, *given: object) -> None:
        """The first error of any thread ends the recording."""
        try:
            work(name, *given)
        except BaseException as error:
            with self._lock:
                if self._error is None:
                    named = isinstance(error, CuspidError) and not isinstance(error, OutputError)
                    self._error = type(error)(f"camera {name}: {error}") if named else error
            self._stop.set()

    def _take(self, name: str, slots: Slots, queue: Queue[_Item]) -> None:
        last = None if self._options.seconds is None else self._options.seconds / slots.length_s
        every = max(1, round((self._options.every_s or 0) / slots.length_s))
        try:
            for shot in self._cameras[name].shots(slots.start_s):
                number = slots.number(name, shot.time_s)
                if self._stop.is_set() or (last is not None and (number or 0) >= last - _ROUNDING):
                    return
                if number is not None and number % every == 0:
                    self._hand_over(name, number, every, shot, queue)
        finally:
            queue.put(None)

    def _hand_over(self, name: str, number: int, every: int, shot: Shot, queue: Queue[_Item]) -> None:
        is_room = queue.qsize() < max(_LEAST_WAITING, (_WAITING_MIB << 20) // shot.size_bytes)
        if is_room:
            queue.put((number, shot))
        with self._lock:
            self._tallies[name].count(number, every, shot, is_room)
            if is_room:
                self._recent.setdefault(number, {})[name] = shot
                while len(self._recent) > _RECENT:
                    del self._recent[min(self._recent)]

    def _write(self, name: str, queue: Queue[_Item], table: AppendedTable) -> None:
        while (item := self._next(queue)) is not None:
            number, shot = item
            frame = f"{number:0{_DIGITS}d}"
            with _report_full_disk():
                write_bytes(self._folder / name / f"{frame}{shot.suffix}", shot.file())
                table.add(name, frame, f"{shot.time_s:.6f}")
            with self._lock:
                self._tallies[name].written += 1

    def _next(self, queue: Queue[_Item]) -> _Item:
        """What is to be written; None at the end, and where a camera hangs after all others have stopped."""
        while True:
            try:
                return queue.get(timeout=_HANGS_S)
            except Empty:
                if self._stop.is_set():
                    return None


_HANGS_S = 12.0
"""OpenCV waits ten seconds for an image."""
_ROUNDING = 1e-6


@contextmanager
def _report_full_disk() -> Iterator[None]:
    """A recording is not continued, as other work is, once there is room."""
    try:
        yield
    except OutputError as error:
        if isinstance(error.__cause__, OSError) and error.__cause__.errno == errno.ENOSPC:
            path = str(error).partition(": ")[0]
            raise OutputError(
                f"{path}: the disk is full; what was taken is kept: free some space, and record into another folder"
            ) from error
        raise


class _Tally:
    """Counts of a camera."""

    def __init__(self) -> None:
        self.written = self.unwritten = self.missing = 0
        self.last: int | None = None
        self.latest: Shot | None = None
        self.times = deque[float]()

    def count(self, number: int, every: int, shot: Shot, is_room: bool) -> None:
        if self.last is not None:
            self.missing += (number - self.last) // every - 1
        self.last, self.latest = number, shot
        self.unwritten += not is_room
        self.missing += not is_room
        self.times.append(shot.time_s)
        while self.times[-1] - self.times[0] > _RATE_OVER_S and len(self.times) > 2:
            self.times.popleft()

    def status(self) -> CameraStatus:
        span_s = self.times[-1] - self.times[0] if self.times else 0.0
        return CameraStatus(
            written=self.written,
            missing=self.missing,
            unwritten=self.unwritten,
            per_s=(len(self.times) - 1) / span_s if span_s > 0 else 0.0,
            latest=self.latest,
        )


def require_no_footage(folder: Path, cameras: Cameras) -> None:
    """Raise OutputError where a folder holds a recording: nothing is mixed, and nothing replaced."""
    if not folder.is_dir():
        return
    for name in cameras:
        place = folder / name
        if place.is_dir() and any(path.suffix.lower() in IMAGE_SUFFIXES for path in list_finished(place)):
            raise OutputError(f"{place}: holds images already; give another --out for this recording")
    if (folder / TABLE).exists():
        raise OutputError(f"{folder / TABLE}: is of another recording; give another --out")


def require_names(cameras: Cameras) -> None:
    """Raise InputError where nothing is to be recorded."""
    if not cameras:
        raise InputError("record: no camera is given; name them: --cameras left=/dev/video0 right=/dev/video2")
