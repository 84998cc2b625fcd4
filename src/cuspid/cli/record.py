"""Record footage from cameras."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from rich.live import Live
from rich.table import Table
from rich.text import Text

from cuspid import storage
from cuspid.calibration.corners import BoardView, find_corners
from cuspid.calibration.coverage import Coverage, CoverageOptions, coverage_cells
from cuspid.cli.calibration import BoardFiles, target_of
from cuspid.cli.shared import Flat, console
from cuspid.footage.cameras import CameraSource, ExposureOptions, Ready
from cuspid.footage.devices import FormatOptions, V4L2Camera, find_cameras
from cuspid.footage.played import FilmCamera, RenderedCamera
from cuspid.footage.quality import measure_quality, shrink_to_grey
from cuspid.footage.record import Recording, RecordOptions, Status, Together, require_names
from cuspid.model.board import Board, Target
from cuspid.report.preview import Preview, mark_focus
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range
from cuspid.runtime.values import checked_name
from cuspid.runtime.workers import map_in_threads
from cuspid.simulation.board_images import BoardFilm, PhotographOptions
from cuspid.storage.videos import VIDEO_SUFFIXES

_REHEARSED_PER_S = 5.0
_POSE_S = 2.0
_MOST_PAIRS = 10
"""Of more, counts are not read."""
_PLAIN_EVERY_S = 5.0
"""Where the output is no terminal, a line so often."""


@dataclass(frozen=True, kw_only=True)
class WatchOptions(Options):
    """What is watched while the cameras record."""

    coach: bool = False
    """Look for the board, described as for cuspid calibrate, and say what its views still lack for a calibration."""
    until_enough: bool = False
    """End when the views of the board are enough; implies --coach."""
    show: bool = False
    """Show the images in the browser, with sharp edges marked. Needs the extra cuspid[view]."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 accepts connections from other machines."""
    port: Annotated[int, Range(1, 65_535)] = 8080
    """Port to listen on; if it is in use, the next free one is taken."""


def record(
    *,
    cameras: tuple[str, ...] = (),
    out: Path | None = None,
    list: bool = False,
    rehearse: Path | None = None,
    form: Annotated[FormatOptions, Flat] = FormatOptions(),
    exposure: Annotated[ExposureOptions, Flat] = ExposureOptions(),
    options: Annotated[RecordOptions, Flat] = RecordOptions(),
    watch: Annotated[WatchOptions, Flat] = WatchOptions(),
    board: Annotated[Board, Flat] = Board(),
    board_files: BoardFiles = (),
    copies: Annotated[int, Range(1, 50)] = 1,
    coverage: Annotated[CoverageOptions, Flat] = CoverageOptions(),
) -> None:
    """Record several cameras at once, without loss, with fixed exposure and a time for each image: footage for cuspid
    import, or images of a board for cuspid calibrate.

    Args:
        cameras: The cameras, each as NAME=SOURCE or SOURCE: a device (/dev/video0, or its number), or a video or a
            folder of images that is played back.
        out: New folder for <camera>/<instant>.jpg or .png, timestamps.csv and recording.json.
        list: Only name the cameras that are plugged in.
        board_files: YAML files that describe the board or boards, as for cuspid calibrate.
        copies: Number of boards of this kind, fixed to one another, whose ids go on from one to the next.
        rehearse: A handpiece.json whose cameras are simulated, over a board that moves, in place of --cameras.
    """
    if list:
        _print_cameras()
        return
    if out is None:
        raise InputError("record: nowhere to record to; give --out, a new folder")
    target = target_of(board, board_files, copies)
    sources = _sources(cameras, rehearse, form, target)
    require_names(sources)
    recording = Recording(sources, out, options)
    settings = {"format": form, "exposure": exposure, "record": options, "cameras": cameras, "rehearse": rehearse}
    with closing(recording), storage.claimed_folder(out, "record", settings, {}, replace=True):
        ready = recording.prepare(exposure)
        _print_ready(ready)
        watched = _Watch(ready, watch, target, coverage)
        try:
            with watched:
                recording.run(ready, watched)
        finally:
            _write_summary(out, ready, recording.status)
    _print_recorded(ready, recording.status, out)
    watched.say_coverage()


# --- cameras ---------------------------------------------------------------------------------------------------------


def _sources(
    named: Sequence[str], rehearse: Path | None, form: FormatOptions, board: Target
) -> dict[str, CameraSource]:
    if rehearse is not None and named:
        raise InputError("record: --rehearse simulates cameras; leave out --cameras")
    if rehearse is not None:
        return _simulate_cameras(rehearse, form, board)
    found = dict[str, tuple[str, CameraSource]]()
    for each in named:
        name, source = _parse_camera(each)
        if name in found:
            raise InputError(f"record: --cameras {each}: two cameras are named {name}; give names: left={source}")
        twice = next(
            (other for other, (place, _) in found.items() if Path(place).resolve() == Path(source).resolve()), None
        )
        if twice is not None:
            raise InputError(f"record: --cameras {each}: {source} is camera {twice} already; give another")
        found[name] = source, _source(name, source, form)
    return {name: camera for name, (_, camera) in found.items()}


def _parse_camera(text: str) -> tuple[str, str]:
    """Name and source of a camera."""
    name, is_named, source = text.rpartition("=")
    source = f"/dev/video{source}" if source.isascii() and source.isdigit() else source
    return checked_name("record: --cameras", name if is_named else Path(source).stem), source


def _source(name: str, source: str, form: FormatOptions) -> CameraSource:
    place = Path(source)
    if place.is_dir() or place.suffix.lower() in VIDEO_SUFFIXES:
        return FilmCamera(name, place, form.frames_per_s)
    if place.is_file():
        raise InputError(f"{source}: is not a camera, video or folder of images; give a device such as /dev/video0")
    return V4L2Camera(source, form)


def _simulate_cameras(handpiece: Path, form: FormatOptions, board: Target) -> dict[str, CameraSource]:
    if not isinstance(board, Board):
        raise InputError("record: --rehearse shows one board; describe one")
    known = storage.read_handpiece(handpiece)
    film = BoardFilm(known, board, PhotographOptions(supersampling=2), _POSE_S)

    def camera(name: str) -> CameraSource:
        model = known.rig[name].camera
        return RenderedCamera(
            lambda time_s: film.image(name, time_s),
            size=(model.width, model.height),
            rate_per_s=form.frames_per_s or _REHEARSED_PER_S,
        )

    return {name: camera(name) for name in known.rig.names}


def _print_cameras() -> None:
    found = find_cameras()
    if not found:
        console.print("no camera is plugged in (there is no /dev/video* that delivers images)", soft_wrap=True)
        return
    table = Table(title="Cameras")
    for heading in ("device", "camera", "pixels", "stays the same"):
        table.add_column(heading, overflow="fold")
    for each in found:
        table.add_row(each.device, each.card, ", ".join(each.formats) or "-", each.place)
    console.print(table)


# --- while they record -----------------------------------------------------------------------------------------------


class _Watch:
    """What is said and shown while cameras record; called several times a second."""

    def __init__(
        self, ready: Mapping[str, Ready], options: WatchOptions, board: Target, enough: CoverageOptions
    ) -> None:
        self._options, self._board, self._enough = options, board, enough
        self._is_coached = options.coach or options.until_enough
        self._coverage = Coverage.of_nothing({name: each.size for name, each in ready.items()})
        self._after, self._best = -1, dict.fromkeys(ready, 0.0)
        self._said_s, self._told = time.monotonic(), list[str]()
        self._preview = Preview(options.host, options.port, list(ready)) if options.show else None
        self._shows = console.is_terminal or options.show
        self._live = Live(console=console, transient=True, auto_refresh=False) if console.is_terminal else nullcontext()

    def __enter__(self) -> _Watch:
        if self._preview is not None:
            console.print(f"{self._preview.address} shows the cameras", highlight=False, soft_wrap=True)
        console.print("recording; Ctrl-C ends it")
        self._live.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._live.__exit__(None, None, None)
        if self._preview is not None:
            self._preview.stop()

    def __call__(self, recording: Recording) -> bool:
        status = recording.status
        latest = {name: each.latest for name, each in status.items() if each.latest and self._shows}
        shown = {name: rgb for name, shot in latest.items() if (rgb := shot.rgb()) is not None}
        if self._is_coached and (found := recording.together(self._after)) is not None:
            self._after = found[0]
            self._coverage = self._coverage.with_instant(self._views(found[1]), self._board, self._enough)
        advice = list(self._advice()) if self._is_coached else []
        if isinstance(self._live, Live):
            self._live.update(self._table(status, shown, advice), refresh=True)
        elif time.monotonic() - self._said_s > _PLAIN_EVERY_S:
            self._said_s = time.monotonic()
            counts = ", ".join(
                f"{name} {each.written} images ({each.missing} missing)" for name, each in status.items()
            )
            news = [line for line in advice if line not in self._told]
            self._told = advice
            console.print(counts, *news, sep="\n", soft_wrap=True, highlight=False)
        if self._preview is not None:
            self._preview.show({name: mark_focus(rgb, self._cells(name)) for name, rgb in shown.items()}, advice)
        return self._options.until_enough and self._coverage.is_enough(self._enough)

    def say_coverage(self) -> None:
        """What is still missing at the end."""
        if self._is_coached:
            console.print(*self._advice(), sep="\n", soft_wrap=True, highlight=False)

    def _views(self, images: Together) -> dict[str, BoardView | None]:
        def find(name: str) -> BoardView | None:
            rgb = images[name].rgb()
            return None if rgb is None else find_corners(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), self._board)

        return dict(zip(images, map_in_threads(find, images), strict=True))

    def _cells(self, name: str) -> np.ndarray | None:
        return coverage_cells(self._coverage.cameras[name], self._enough) if self._is_coached else None

    def _advice(self) -> list[str]:
        missing, apart = self._coverage.missing(self._enough), self._coverage.apart(self._enough)
        said = [
            f"{name}: {each.views} views of the board; lacks {', '.join(missing[name])}"
            if name in missing
            else f"{name}: {each.views} views of the board, enough"
            for name, each in self._coverage.cameras.items()
        ]
        counts = [f"{' + '.join(pair)} {count}" for pair, count in self._coverage.shared.items() if count]
        if counts and len(self._coverage.shared) <= _MOST_PAIRS:
            said.append(f"seen together: {', '.join(counts)}")
        if len(apart) > 1:
            said.append(f"not yet joined by boards seen together: {' | '.join(', '.join(each) for each in apart)}")
        return [*said, "enough for a calibration"] if self._coverage.is_enough(self._enough) else said

    def _table(self, status: Status, shown: Mapping[str, np.ndarray], advice: Sequence[str]) -> Table:
        table = Table(title="Recording", caption=Text("\n".join(advice)), caption_justify="left")
        for heading in ("camera", "images", "a second", "missing", "sharpness", "of the best", "white", "mean grey"):
            table.add_column(heading, justify="left" if heading == "camera" else "right")
        for name, each in status.items():
            looks = ["-"] * 4
            if name in shown:
                level, _, white, sharpness, _ = measure_quality(shrink_to_grey(shown[name]), None)
                self._best[name] = max(self._best[name], sharpness)
                best = sharpness / self._best[name] if self._best[name] > 0 else 0.0
                looks = [f"{sharpness:.3f}", f"{100 * best:.0f} %", f"{100 * white:.1f} %", f"{level:.0f}"]
            table.add_row(name, str(each.written), f"{each.per_s:.1f}", str(each.missing), *looks)
        return table


# --- afterwards ------------------------------------------------------------------------------------------------------


def _print_ready(ready: Mapping[str, Ready]) -> None:
    for name, each in ready.items():
        held = f"; {', '.join(map(str, each.settings))}" if each.settings else ""
        size, rate = f"{each.size[0]} x {each.size[1]} px", f"{1 / each.interval_s:.4g} images a second"
        console.print(f"{name}: {each.what}, {size}, {rate}{held}", soft_wrap=True, highlight=False)
        for note in each.notes:
            console.print(f"note: camera {name}: {note}", soft_wrap=True, highlight=False)


def _write_summary(out: Path, ready: Mapping[str, Ready], status: Status) -> None:
    if not any(each.written for each in status.values()):
        return
    cameras = {
        name: {
            "source": each.what,
            "size_px": each.size,
            "interval_s": each.interval_s,
            "clock": each.clock,
            "settings": each.settings,
            "notes": each.notes,
            "images": status[name].written,
            "missing": status[name].missing,
            "unwritten": status[name].unwritten,
        }
        for name, each in ready.items()
    }
    storage.write_json(out / "recording.json", {"cameras": cameras})


def _print_recorded(ready: Mapping[str, Ready], status: Status, out: Path) -> None:
    for name, each in status.items():
        if each.unwritten:
            console.print(
                f"note: camera {name}: {each.unwritten} images came faster than they could be written; record fewer "
                "(--every-s, --frames-per-s), smaller ones, or onto a faster disk",
                soft_wrap=True,
            )
    counts = ", ".join(f"{name} {each.written}" for name, each in status.items())
    missing = sum(each.missing for each in status.values())
    console.print(f"{out}: {counts} images; {missing} missing", soft_wrap=True, highlight=False)
