"""Which images of the films form which frame of the capture, and what is left out and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import combinations
from typing import Annotated

import numpy as np
from jaxtyping import Float

from cuspid.footage.films import Film
from cuspid.footage.quality import Looks, QualityOptions, faults
from cuspid.footage.synchronise import (
    Clock,
    Instant,
    SyncOptions,
    flash_starts,
    flashes_of,
    jumps_in,
    match_names,
    match_starts,
    match_times,
    motion_starts,
    offset_between,
    separate_instants,
    synchronise_clocks,
)
from cuspid.model.capture import Dropped, Frame
from cuspid.model.rig import Handpiece
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range

FrameTimes = Mapping[str, Mapping[str, float]]
"""For each camera, the times in s of its frames, by number or name."""
Films = Mapping[str, Film]
"""Films by camera."""
_ROUNDING_S = 1e-6
"""Rounding error of times."""


@dataclass(frozen=True, kw_only=True)
class SelectionOptions(Options):
    """Which part of the footage is taken."""

    every: Annotated[int, Range(1, 100_000)] = 1
    """Take only every n-th frame."""
    start_s: Annotated[float | None, Range(0, 1e6)] = None
    """Take frames from this time after the first frame."""
    end_s: Annotated[float | None, Range(0, 1e6)] = None
    """Take frames up to this time after the first frame."""


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """Which images of footage become a capture."""

    sync: SyncOptions = field(default_factory=SyncOptions)
    """How the cameras are synchronised."""
    quality: QualityOptions = field(default_factory=QualityOptions)
    """Which images are left out."""
    selection: SelectionOptions = field(default_factory=SelectionOptions)
    """Which part of the footage is taken."""
    lightings: tuple[str, ...] = ()
    """The handpiece's lighting patterns as the frames of the film have them, one after the other and over again; empty
    where it has only one, or they are not known."""


@dataclass(frozen=True, kw_only=True)
class Bad:
    """An unusable image."""

    frame: str
    """Name of its frame in the capture."""
    camera: str
    """Camera that took it."""
    reason: str
    """Kind and value, for example ``dark: 95 % of it is below 9 of 255``."""

    @property
    def kind(self) -> str:
        """Kind of the reason, as one word."""
        return self.reason.partition(":")[0]

    def as_dropped(self) -> Dropped:
        """The image in the form that a capture stores."""
        return Dropped(what=f"camera {self.camera} of frame {self.frame}", reason=self.reason)


@dataclass(frozen=True, eq=False, kw_only=True)
class Plan:
    """What is to be made from the footage."""

    frames: tuple[Frame, ...]
    """Frames of the capture, with the cameras whose images are usable."""
    numbers: Mapping[str, Mapping[str, int]]
    """For each frame, by name, and each camera that has an image of it, used or not: its number in the film."""
    bad: tuple[Bad, ...]
    """Unusable images of these frames."""
    times_s: Mapping[str, Float[np.ndarray, "_"]]
    """For each camera, the times of its frames by its own clock; NaN where they are not known."""
    starts_frames: Mapping[str, int] | None
    """How many frames after the first camera each one began, if that was determined."""
    apart_ms: Float[np.ndarray, "f"] | None
    """Time differences within each frame, if the images were synchronised by their times."""
    notes: tuple[str, ...]
    """Findings, one line each."""


def plan_import(
    films: Films, looks: Mapping[str, Looks], handpiece: Handpiece, options: ImportOptions, times: FrameTimes | None
) -> Plan:
    """Synchronise and select. Raises InputError where the synchronisation cannot be trusted, nothing usable is left, or
    cameras that are not synchronised are to share lights."""
    check_lightings(options, handpiece)
    times_s = {
        camera: each.time_s if times is None else _times_of(films[camera], len(each.time_s), times.get(camera, {}))
        for camera, each in looks.items()
    }
    every, starts = _instants(films, looks, times_s, options.sync)
    clock = synchronise_clocks(every, times_s, is_set=options.sync.sync == "times")
    notes = [
        *_film_notes(films, looks, handpiece),
        *_sync_notes(every, looks, times_s, clock, options.sync),
        *_depth_notes(looks),
        *_lighting_notes(options.lightings, handpiece),
    ]
    is_kept = [options.sync.sync == "none" or len(films) == 1 or len(instant.numbers) > 1 for instant in every]
    notes += _lone_image_notes([instant for instant, kept in zip(every, is_kept, strict=True) if not kept])
    chosen = _select_instants(np.flatnonzero(is_kept).tolist(), clock, options.selection)
    wrong = {camera: faults(each, options.quality) for camera, each in looks.items()}
    lit = _lightings(every, clock, options.lightings, handpiece)
    taken = [(every[k], _time(clock, k), lit[k]) for k in chosen]
    frames, bad = _judge_frames(taken, wrong, handpiece)
    return Plan(
        frames=frames,
        numbers={every[k].name: every[k].numbers for k in chosen},
        bad=bad,
        times_s=times_s,
        starts_frames=starts,
        apart_ms=1000 * clock.apart_s[chosen] if clock is not None and options.sync.sync == "times" else None,
        notes=tuple(notes),
    )


# --- times -----------------------------------------------------------------------------------------------------------


def _times_of(film: Film, count: int, table: Mapping[str, float]) -> Float[np.ndarray, "_"]:
    """The time of each frame, from a table that names frames by image or by number, of the film or of a longer one."""
    numbers = {film.name(k): k for k in range(count)}
    if not set(table) <= set(numbers):
        numbers = _index_by_number(film, count, table)
    found = np.full(count, np.nan)
    found[[numbers[frame] for frame in table]] = list(table.values())
    return found


def _index_by_number(film: Film, count: int, table: Mapping[str, float]) -> dict[str, int]:
    if all(frame.isascii() and frame.isdigit() for frame in table):
        ordered = sorted(table, key=int)
        if int(ordered[-1]) < count:
            return {frame: int(frame) for frame in ordered}
        if len(ordered) == count:
            return {frame: k for k, frame in enumerate(ordered)}
    raise InputError(
        f"the table of times lists {len(table)} frames of {film.camera}, {min(table)} to {max(table)}, but "
        f"{film.source} has {count} frames, numbered differently; give the table that belongs to the films"
    )


def _time(clock: Clock | None, instant: int) -> float | None:
    """Of an instant, where it is known."""
    if clock is None or not np.isfinite(clock.times_s[instant]):
        return None
    return float(clock.times_s[instant])


# --- instants --------------------------------------------------------------------------------------------------------


def _instants(
    films: Films, looks: Mapping[str, Looks], times_s: Mapping[str, np.ndarray], options: SyncOptions
) -> tuple[tuple[Instant, ...], dict[str, int] | None]:
    """The instants, and where it was found when each camera began."""
    counts = {camera: len(each.level_dn) for camera, each in looks.items()}
    if options.sync == "none":
        return separate_instants(counts, times_s), None
    if options.sync == "times":
        return match_times(times_s, options), None
    if options.sync == "names" or len(films) == 1:
        return match_names(_names(films, counts)), None
    starts = (
        flash_starts({camera: each.level_dn for camera, each in looks.items()}, options)
        if options.sync == "flash"
        else motion_starts({camera: each.change_dn for camera, each in looks.items()}, options)
    )
    return match_starts(starts, counts), starts


def _names(films: Films, counts: Mapping[str, int]) -> dict[str, list[str]]:
    if len({film.is_video for film in films.values()}) > 1:
        raise InputError("folders and videos have no names in common; give --sync times, flash or motion")
    names = {camera: [film.name(k) for k in range(counts[camera])] for camera, film in films.items()}
    shared = Counter(name for each in names.values() for name in each)
    for camera, each in names.items():
        if len(films) > 1 and all(shared[name] == 1 for name in each):
            raise InputError(
                f"{films[camera].source}: no image shares its name with one of another camera (first: {each[0]}); "
                "give images taken at the same time the same name, or give --sync times, flash, motion or none"
            )
    return names


def _select_instants(instants: Sequence[int], clock: Clock | None, options: SelectionOptions) -> list[int]:
    """Those of the instants that are asked for. Raises InputError where none is, or times are not known."""
    if options.start_s is None and options.end_s is None:
        return list(instants[:: options.every])
    if clock is None:
        raise InputError(
            "--start-s and --end-s need frame times, which are missing; give --times, or leave these options out"
        )
    times = clock.times_s - np.nanmin(clock.times_s)
    start, end = options.start_s or 0.0, np.inf if options.end_s is None else options.end_s
    chosen = [k for k in instants if start - _ROUNDING_S <= times[k] <= end + _ROUNDING_S]
    if not chosen:
        raise InputError(f"no frame lies between {start:g} and {end:g} s; the footage lasts {np.nanmax(times):.2f} s")
    return chosen[:: options.every]


# --- judging ---------------------------------------------------------------------------------------------------------


def check_lightings(options: ImportOptions, handpiece: Handpiece) -> None:
    """Raise InputError for a lighting pattern that the handpiece does not have, and where cameras that are not
    synchronised would share it."""
    for name in options.lightings:
        handpiece.lights_on(name)
    if options.lightings and options.sync.sync == "none":
        raise InputError("--lightings: alternating lights require cameras that expose together; give --sync")


def _lightings(
    instants: Sequence[Instant], clock: Clock | None, in_turn: Sequence[str], handpiece: Handpiece
) -> list[str | None]:
    """The lighting pattern of each instant. Where times are known they tell of lost frames, which had one, too."""
    if not in_turn:
        return [handpiece.only_lighting] * len(instants)
    steps = np.ones(max(len(instants) - 1, 0), dtype=int)
    if clock is not None:
        apart = np.diff(clock.times_s) / clock.interval_s
        steps = np.where(np.isfinite(apart), np.maximum(np.rint(apart), 1), 1).astype(int)
    turns = np.concatenate([[0], np.cumsum(steps)])[: len(instants)] % len(in_turn)
    return [in_turn[turn] for turn in turns]


def _judge_frames(
    taken: Sequence[tuple[Instant, float | None, str | None]],
    wrong: Mapping[str, Mapping[int, str]],
    handpiece: Handpiece,
) -> tuple[tuple[Frame, ...], tuple[Bad, ...]]:
    """The frames with their good images, and the bad ones, from instants with their times and lighting patterns. Raises
    InputError where nothing good is left."""
    frames, found = [], []
    for instant, time_s, lighting in taken:
        bad = {camera: wrong[camera][k] for camera, k in instant.numbers.items() if k in wrong[camera]}
        good = tuple(camera for camera in handpiece.rig.names if camera in instant.numbers and camera not in bad)
        found += [Bad(frame=instant.name, camera=camera, reason=bad[camera]) for camera in sorted(bad)]
        if good:
            frames.append(Frame(name=instant.name, cameras=good, lighting=lighting, time_s=time_s))
    if not frames:
        kinds = ", ".join(f"{count} {kind}" for kind, count in kinds_of(found).items())
        raise InputError(
            f"no image of {len(taken)} frames is usable: {kinds}; check the images, and --blurred-below, "
            "--dark-below-dn, --burnt-above, --same-below-dn and --bits"
        )
    return tuple(frames), tuple(found)


def kinds_of(bad: Sequence[Bad]) -> dict[str, int]:
    """Number of unusable images for each kind of reason, the most frequent first."""
    return dict(Counter(each.kind for each in bad).most_common())


# --- notes -----------------------------------------------------------------------------------------------------------


def _film_notes(films: Films, looks: Mapping[str, Looks], handpiece: Handpiece) -> Iterator[str]:
    for camera in handpiece.rig.names:
        if camera not in films:
            yield f"camera {camera} has no footage and is left out of the capture"
    counts = {camera: len(each.level_dn) for camera, each in looks.items()}
    for camera, film in films.items():
        if missing := film.length.missing(counts[camera], float(looks[camera].time_s[-1])):
            yield f"{film.source.name}: {missing}"
    if len(set(counts.values())) > 1:
        yield f"the films differ in length: {', '.join(f'{name} {count}' for name, count in counts.items())} frames"


def _lighting_notes(in_turn: Sequence[str], handpiece: Handpiece) -> Iterator[str]:
    if len(handpiece.lightings) > 1 and not in_turn:
        names = " ".join(each.name for each in handpiece.lightings)
        yield (
            "the lighting pattern of each frame is unknown, but plain teeth need it; if the patterns alternate, give "
            f"--lightings {names} in their order"
        )


def _lone_image_notes(instants: Sequence[Instant]) -> Iterator[str]:
    """Images that no other camera has one with."""
    if instants:
        counts = Counter(camera for instant in instants for camera in instant.numbers)
        (camera, number), *_ = instants[0].numbers.items()
        each = ", ".join(f"{count} of {name}" for name, count in sorted(counts.items()))
        yield f"images without a match from another camera are left out: {each} (first: frame {number} of {camera})"


def _depth_notes(looks: Mapping[str, Looks]) -> Iterator[str]:
    for camera, each in looks.items():
        peak = float(np.nanmax(each.peak, initial=0.0))
        if 0 < peak < 1 << 14:
            bits = max(9, int(peak).bit_length())
            yield f"{camera}: 16-bit images with values below {1 << bits}; if that is white, give --bits {bits}"


def _sync_notes(
    instants: Sequence[Instant],
    looks: Mapping[str, Looks],
    times_s: Mapping[str, np.ndarray],
    clock: Clock | None,
    options: SyncOptions,
) -> Iterator[str]:
    """Raises InputError where the times of the films contradict what was taken for at once."""
    for camera, times in times_s.items():
        if jumps := jumps_in(times):
            yield f"{camera}: frames are missing; time jumps before frame {jumps[0]}, {len(jumps)} times in total"
    if options.sync == "none" or len(looks) == 1:
        return
    if clock is not None and options.sync != "times":
        _require_one_rate(instants, clock)
    if options.sync != "motion":
        yield from _doubts_by_motion(instants, looks, options)
    if options.sync != "flash":
        yield from _doubts_by_flash(instants, looks, options)


def _require_one_rate(instants: Sequence[Instant], clock: Clock) -> None:
    worst = int(np.nanargmax(clock.apart_s))
    if clock.apart_s[worst] > clock.interval_s / 2:
        raise InputError(
            f"according to their times, the images of frame {instants[worst].name} are "
            f"{1000 * clock.apart_s[worst]:.0f} ms apart (a frame lasts {1000 * clock.interval_s:.0f} ms): "
            "frames were dropped, or the frame rates differ; give --sync times"
        )


def _doubts_by_motion(instants: Sequence[Instant], looks: Mapping[str, Looks], options: SyncOptions) -> Iterator[str]:
    """Cameras whose motion would fit together better if one had begun earlier or later."""
    for one, other in combinations(sorted(looks), 2):
        both = [instant.numbers for instant in instants if one in instant.numbers and other in instant.numbers]
        signals = [looks[camera].change_dn[[numbers[camera] for numbers in both]] for camera in (one, other)]
        found = offset_between(signals[0], signals[1], options)
        if found.doubt is None and abs(found.frames) > 1:
            later, earlier = (other, one) if found.frames > 0 else (one, other)
            yield (
                f"judging by the motion in the images, {later} is {abs(found.frames)} frames later than {earlier}, "
                f"but --sync {options.sync} treats them as simultaneous; check both, or give --sync motion"
            )


def _doubts_by_flash(instants: Sequence[Instant], looks: Mapping[str, Looks], options: SyncOptions) -> Iterator[str]:
    """Cameras that saw a single flash at other instants."""
    seen: dict[str, int] = {}
    for camera, each in sorted(looks.items()):
        with suppress(InputError, StopIteration):
            flashes = flashes_of(camera, each.level_dn, options)
            if len(flashes) == 1:
                seen[camera] = next(k for k, at in enumerate(instants) if at.numbers.get(camera) == flashes[0])
    if seen and max(seen.values()) - min(seen.values()) > 1:
        places = ", ".join(f"{camera} {instants[k].name}" for camera, k in seen.items())
        yield f"the cameras saw a flash at different frames ({places}); check them, or give --sync flash"
