"""Follow a scan while it is taken."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from cuspid import storage
from cuspid.cli.scan import reconstruct_capture
from cuspid.cli.shared import Flat, console
from cuspid.footage.arrivals import Arrivals
from cuspid.model.capture import Capture, Dropped, Frame, ImageSource
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece
from cuspid.pipeline.scan import ReconstructionOptions
from cuspid.pipeline.session import Session, Step
from cuspid.report.growing_view import GrowingView
from cuspid.runtime.errors import CuspidError, InputError, ReconstructionError
from cuspid.runtime.options import Options, Range
from cuspid.storage.handpieces import hash_handpiece

_POLL_S = 0.1


@dataclass(frozen=True, kw_only=True)
class FollowOptions(Options):
    """How frames come in."""

    watch: bool = False
    """Follow a folder into which images are still being written, instead of replaying a capture."""
    pace: Annotated[float | None, Range(0.001, 1000)] = None
    """Frames a second of a replay; default: at the times stored in the capture, without these as fast as possible."""
    late_s: Annotated[float, Range(0, 3600)] = 2.0
    """A watched frame whose images are not all there is taken without them this long after the first image of a later
    one."""
    end_s: Annotated[float, Range(0.1, 86_400)] = 60.0
    """A watched scan ends when no image has come for so long, or with Ctrl-C."""
    pause_s: Annotated[float, Range(0.1, 86_400)] = 5.0
    """When no image has come for so long, all poses are adjusted together."""


@dataclass(frozen=True, kw_only=True)
class ShowOptions(Options):
    """How the scan is shown."""

    show: bool = False
    """Show the surface in the browser while it grows. Needs the extra cuspid[view]."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 accepts connections from other machines."""
    port: Annotated[int, Range(1, 65_535)] = 8080
    """Port to listen on; if it is in use, the next free one is taken."""


def live(
    capture: Annotated[Path, Positional],
    *,
    out: Path,
    handpiece: Path | None = None,
    working_distance_mm: Annotated[float | None, Range(0.1, 100_000)] = None,
    follow: Annotated[FollowOptions, Flat] = FollowOptions(),
    view: Annotated[ShowOptions, Flat] = ShowOptions(),
    reconstruction: Annotated[ReconstructionOptions, Flat] = ReconstructionOptions(quality="draft"),
) -> None:
    """Follow a scan of textured teeth while it is taken, or replay one: each frame is placed and its surface shown as
    it comes in; at the end everything is reconstructed together, as cuspid reconstruct does.

    Args:
        capture: Folder with handpiece.json and images/<camera>/<frame>.png; with --watch the images may still come.
        out: Folder for depth/, motion/, mesh.ply and mesh.stl.
        handpiece: Calibration (default: handpiece.json in the capture folder).
        working_distance_mm: Distance from the cameras to the teeth, for a rig_config.json, which does not contain it
            (guessed unless given).
    """
    feed = (_watch_folder if follow.watch else _replay_capture)(capture, handpiece, working_distance_mm, follow)
    settings = {"follow": follow, "reconstruction": reconstruction}
    with storage.claimed_folder(out, "live", settings, {"handpiece": hash_handpiece(feed.handpiece)}):
        taken = _follow_feed(feed, out, reconstruction, _open_view(view))
    reconstruct_capture(taken, out, reconstruction)


def _open_view(options: ShowOptions) -> GrowingView | None:
    if not options.show:
        return None
    view = GrowingView(options.host, options.port)
    console.print(f"{view.address} shows the scan", highlight=False, soft_wrap=True)
    return view


@dataclass(frozen=True, eq=False, kw_only=True)
class _Feed:
    """Where frames come from."""

    handpiece: Handpiece
    source: Callable[[], ImageSource]
    frames: Iterator[Frame | None]
    """None where none has come for a while."""
    left_out: Callable[[], tuple[Dropped, ...]]
    """Images that are missing so far, and why."""


def _replay_capture(folder: Path, handpiece: Path | None, distance_mm: float | None, options: FollowOptions) -> _Feed:
    capture = storage.read_capture(folder, handpiece, distance_mm)
    return _Feed(
        handpiece=capture.handpiece,
        source=lambda: capture.source,
        frames=_pace_frames(capture, options.pace),
        left_out=lambda: capture.left_out,
    )


def _pace_frames(capture: Capture, pace: float | None) -> Iterator[Frame]:
    begin = time.monotonic()
    first_s = capture.frames[0].time_s if capture.frames else None
    for number, frame in enumerate(capture.frames):
        due = None if pace is None else number / pace
        if pace is None and first_s is not None and frame.time_s is not None:
            due = frame.time_s - first_s
        if due is not None:
            time.sleep(max(0.0, begin + due - time.monotonic()))
        yield frame


def _watch_folder(folder: Path, handpiece: Path | None, distance_mm: float | None, options: FollowOptions) -> _Feed:
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the one in which images/<camera>/<frame>.png appear")
    known = storage.read_handpiece(handpiece or folder / "handpiece.json", distance_mm)
    arrivals = Arrivals(folder, known, late_s=options.late_s)

    def source() -> ImageSource:
        assert arrivals.source is not None  # a frame has come
        return arrivals.source

    frames = _await_frames(arrivals, options)
    return _Feed(handpiece=known, source=source, frames=frames, left_out=lambda: arrivals.left_out)


def _await_frames(arrivals: Arrivals, options: FollowOptions) -> Iterator[Frame | None]:
    """Frames as they come; ends when none has come for long."""
    latest, paused = time.monotonic(), False
    while time.monotonic() - latest < options.end_s:
        for frame in arrivals.news(time.monotonic()):
            yield frame
            latest, paused = time.monotonic(), False
        if not paused and time.monotonic() - latest > options.pause_s:
            paused = True
            yield None
        time.sleep(_POLL_S)
    yield from arrivals.rest()


def _follow_feed(feed: _Feed, out: Path, options: ReconstructionOptions, view: GrowingView | None) -> Capture:
    """What came in, until it ends or Ctrl-C."""
    session: Session | None = None
    words, begin = _Words(), time.monotonic()
    try:
        for frame in feed.frames:
            if frame is None:
                changed = {} if session is None else _describe_corrections(session)
            else:
                session = session or Session(feed.handpiece, feed.source(), out, options)
                changed = words.report(session.push(frame))
            if view is not None and session is not None:
                view.show(session, changed, words.lost)
    except KeyboardInterrupt:
        console.print("scan ended; reconstructing what came in")
    except CuspidError as error:
        if session is None or not session.rig_from_world:
            raise
        console.print(f"note: {error}; scan ended; reconstructing what came in", soft_wrap=True)
    left_out = feed.left_out()
    if session is None or not session.frames:
        why = next((f" ({each.what}: {each.reason})" for each in left_out), "")
        raise InputError(f"no usable frame has arrived{why}; check whether images appear, and in which folder")
    seconds = time.monotonic() - begin
    console.print(
        f"{len(session.rig_from_world)} of {len(session.frames)} frames placed as they came, "
        f"{len(session.frames) / seconds:.1f} frames a second"
    )
    return replace(session.capture, left_out=(*left_out, *session.capture.left_out))


def _describe_corrections(session: Session) -> Mapping[int, Mesh]:
    try:
        return session.correct()
    except ReconstructionError as error:
        console.print(f"note: {error}")
        return {}


class _Words:
    """Tells when the path is lost, and when it is found again."""

    def __init__(self) -> None:
        self._last: str | None = None
        self.lost = 0
        """Number of the latest frames that could not be placed."""

    def report(self, step: Step) -> Mapping[int, Mesh]:
        """Tell of a step; what it changed."""
        if step.rig_from_world is None:
            back = "" if self._last is None else f"; go back to where frame {self._last} was taken"
            if self.lost == 0:
                console.print(f"frame {step.frame}: not placed, {step.reason}{back}", soft_wrap=True, highlight=False)
            self.lost += 1
            return step.changed
        if self.lost and self._last is not None:
            console.print(f"frame {step.frame}: found again; {self.lost} frames before it were not placed")
        self._last, self.lost = step.frame, 0
        return step.changed
