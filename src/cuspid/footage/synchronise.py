"""Which images of several cameras were taken at the same instant, from their times or from what they saw.

An instant is numbered from the first frame of the camera that began first; a camera *starts* at the instant of its
first frame. Frames of a camera are numbered from 0. Nothing here depends on the order of the cameras.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from scipy.ndimage import median_filter
from scipy.signal import correlate

from cuspid.runtime.errors import InputError
from cuspid.runtime.options import SHARE, Options, Range
from cuspid.storage.sequences import name_order

Sync = Literal["names", "times", "flash", "motion", "none"]
Signals = Mapping[str, Float[np.ndarray, "_"]]
"""One number for each frame of each camera; NaN where there is none."""

_SLOW = 31
"""Number of frames; slower changes do not mark a moment."""
_MOST_FLASHES = 9
"""More rises of the brightness are a flicker."""
_RISE = 0.25
"""Share of the largest jump; a preceding frame with a larger jump than this already contains part of the flash."""
_LEAST_DN = 4.0
"""Minimum brightness of a flash."""


@dataclass(frozen=True, kw_only=True)
class SyncOptions(Options):
    """How the cameras are synchronised, and when the result is trusted."""

    sync: Sync = "names"
    """Which images belong together: those with the same name, and video frames with the same number (names); with
    nearly the same time (times); at the same number of frames from the flashes that all cameras saw (flash), or by the
    motion in the images (motion); or none (none)."""
    apart_share: Annotated[float, Range(0.01, 0.5)] = 0.25
    """Images that are farther apart than this share of the time between frames were not taken at the same instant
    (times)."""
    flash_sigmas: Annotated[float, Range(3, 1000)] = 10.0
    """Number of standard deviations of the usual changes of brightness by which a flash must stand out."""
    motion_sigmas: Annotated[float, Range(3, 1000)] = 6.0
    """Number of standard deviations of all other offsets by which the best one must stand out."""
    second_share: Annotated[float, SHARE] = 0.6
    """An offset is unambiguous if the second best reaches at most this share of it; a rise of brightness of more than
    this share of the largest one is a flash, too."""
    overlap_share: Annotated[float, Range(0.1, 1)] = 0.5
    """Minimum share of the shorter film that two films must have in common at an offset (motion)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Instant:
    """Images that were taken at the same instant."""

    name: str
    """Name of the frame."""
    numbers: Mapping[str, int]
    """For each camera that has an image of it, the number of its frame."""


@dataclass(frozen=True, kw_only=True)
class Offset:
    """How much later one camera began than another, from the motion in their images."""

    frames: int
    """Number of frames; frame 0 of the later camera is frame ``frames`` of the first one."""
    correlation: float
    """Correlation of the changes of both cameras at this offset."""
    sigmas: float
    """Number of standard deviations by which it stands out from the other offsets."""
    doubt: str | None
    """Why it is not trusted, or None."""


# --- by name, number and time --------------------------------------------------------------------------------------


def match_names(names: Mapping[str, Sequence[str]]) -> tuple[Instant, ...]:
    """Images with the same name, given for each camera the names of its frames, in the order of the numbers in them."""
    numbers = {camera: {name: k for k, name in enumerate(each)} for camera, each in names.items()}
    every = sorted(set().union(*names.values()), key=name_order)
    return tuple(
        Instant(name=name, numbers={camera: each[name] for camera, each in numbers.items() if name in each})
        for name in every
    )


def match_starts(starts: Mapping[str, int], counts: Mapping[str, int]) -> tuple[Instant, ...]:
    """Frames of the same instant, given the instant of each camera's first frame and its number of frames."""
    last = max(starts[camera] + count for camera, count in counts.items())
    running = [
        {camera: k - start for camera, start in starts.items() if 0 <= k - start < counts[camera]} for k in range(last)
    ]
    return _number_groups(running)


def match_times(times_s: Signals, options: SyncOptions) -> tuple[Instant, ...]:
    """Images that are no farther apart in time than a share of the time between frames.

    Starting from the earliest image, each takes the next ones of other cameras with it; an image without a time belongs
    to no instant. Raises InputError where times run backwards, or the times of a camera have nothing in common with the
    others'.
    """
    for camera, times in times_s.items():
        _check_times(camera, times)
    apart_s = options.apart_share * interval_s(times_s)
    images = sorted(
        (float(time), camera, number)
        for camera, times in times_s.items()
        for number, time in enumerate(times)
        if np.isfinite(time)
    )
    groups: list[dict[str, int]] = []
    since = -np.inf
    for time, camera, number in images:
        if time - since > apart_s or camera in groups[-1]:
            groups.append({})
            since = time
        groups[-1][camera] = number
    alone = [camera for camera in times_s if not any(camera in group and len(group) > 1 for group in groups)]
    if alone and len(times_s) > 1:
        spans = ", ".join(f"{name} {np.nanmin(each):.3f} to {np.nanmax(each):.3f} s" for name, each in times_s.items())
        raise InputError(
            f"no image of {alone[0]} was taken within {1000 * apart_s:.0f} ms of an image of another camera ({spans}); "
            "give times from a single clock, or --sync flash or motion"
        )
    return _number_groups(groups)


def separate_instants(counts: Mapping[str, int], times_s: Signals) -> tuple[Instant, ...]:
    """Each image by itself, in the order of their times if all have one, otherwise camera by camera."""
    images = [(camera, number) for camera, count in counts.items() for number in range(count)]
    if all(np.isfinite(each).all() for each in times_s.values()):
        images.sort(key=lambda image: float(times_s[image[0]][image[1]]))
    return tuple(Instant(name=f"{camera}_{number:05d}", numbers={camera: number}) for camera, number in images)


def _number_groups(groups: Sequence[Mapping[str, int]]) -> tuple[Instant, ...]:
    return tuple(Instant(name=f"{k:05d}", numbers=numbers) for k, numbers in enumerate(groups))


def interval_s(times_s: Signals) -> float:
    """The usual time between frames of the fastest camera."""
    return min(float(np.median(np.diff(each[np.isfinite(each)]))) for each in times_s.values())


def _check_times(camera: str, times_s: Float[np.ndarray, "_"]) -> None:
    known = np.flatnonzero(np.isfinite(times_s))
    if len(known) < 2:
        raise InputError(
            f"{camera}: {len(known)} of {len(times_s)} frames have a time, and at least two are needed; "
            "give --times, or use another --sync"
        )
    steps = np.diff(times_s[known])
    if (steps <= 0).any():
        at = int(np.argmax(steps <= 0))
        raise InputError(
            f"{camera}: time runs backwards, {times_s[known[at]]:.6g} s at frame {known[at]} and "
            f"{times_s[known[at + 1]]:.6g} s at frame {known[at + 1]}; correct the times, or use another --sync"
        )


def jumps_in(times_s: Float[np.ndarray, "_"]) -> tuple[int, ...]:
    """The frames before which more than half a frame interval is missing."""
    known = np.flatnonzero(np.isfinite(times_s))
    steps = np.diff(times_s[known]) / np.diff(known)
    return tuple(known[1:][steps > 1.5 * np.median(steps)].tolist()) if len(steps) else ()


@dataclass(frozen=True, eq=False, kw_only=True)
class Clock:
    """The times of the cameras on a common clock."""

    times_s: Float[np.ndarray, "i"]
    """Times of the instants; NaN where no image has a time."""
    apart_s: Float[np.ndarray, "i"]
    """Time difference within each instant, once the clocks are set."""
    interval_s: float
    """The usual time between frames."""


def synchronise_clocks(instants: Sequence[Instant], times_s: Signals, *, is_set: bool) -> Clock | None:
    """The times of instants. The clocks of the cameras are set by the median difference, unless they already are
    (``is_set``).

    None unless every camera has times.
    """
    if any(np.isfinite(each).sum() < 2 for each in times_s.values()):
        return None
    table = np.array(
        [
            [times[instant.numbers[camera]] if camera in instant.numbers else np.nan for instant in instants]
            for camera, times in sorted(times_s.items())
        ]
    )
    if not is_set:
        most = table[np.argmax(np.isfinite(table).sum(axis=1))]
        both = np.isfinite(table) & np.isfinite(most)
        shifts = [np.median((row - most)[use]) if use.any() else 0.0 for row, use in zip(table, both, strict=True)]
        table = table - np.array(shifts)[:, None]
    known = np.isfinite(table)
    first = np.where(known.any(axis=0), np.where(known, table, np.inf).min(axis=0), np.nan)
    last = np.where(known.any(axis=0), np.where(known, table, -np.inf).max(axis=0), np.nan)
    return Clock(times_s=first, apart_s=last - first, interval_s=interval_s(times_s))


# --- by a flash ----------------------------------------------------------------------------------------------------


def flash_starts(brightness: Signals, options: SyncOptions) -> dict[str, int]:
    """When each camera started, from the flashes that all of them saw. Raises InputError where one saw none, or others
    than the rest."""
    flashes = {camera: flashes_of(camera, each, options) for camera, each in sorted(brightness.items())}
    model = max(flashes, key=lambda camera: len(flashes[camera]))
    for camera, its in flashes.items():
        if len(its) != len(flashes[model]):
            raise InputError(
                f"{camera}: {_describe_flashes(its)}, but in {model} {_describe_flashes(flashes[model])}; cut the "
                "films so that all show the same ones, or use another --sync"
            )
        gaps, others = (np.diff(each) for each in (its, flashes[model]))
        if (np.abs(gaps - others) > 1).any():
            at = int(np.abs(gaps - others).argmax())
            raise InputError(
                f"{camera}: two flashes are {gaps[at]} frames apart, but {others[at]} in {model}: the frame rates "
                "differ, or frames were dropped; use --sync times, or film again"
            )
    return _shift_to_zero({camera: -its[0] for camera, its in flashes.items()})


def _describe_flashes(flashes: Sequence[int]) -> str:
    """How many flashes there are, and where."""
    places = ", ".join(map(str, flashes))
    return f"one flash, at frame {places}" if len(flashes) == 1 else f"{len(flashes)} flashes, at frames {places}"


def flashes_of(camera: str, brightness: Float[np.ndarray, "_"], options: SyncOptions) -> list[int]:
    """The first frame of each flash, in order. Raises InputError where there is none, or brightness always rises."""
    if len(brightness) < 6:
        raise InputError(f"{camera}: {len(brightness)} frames are too few to find a flash")
    rises = _rises(_fill_gaps(brightness))
    top = int(rises.argmax())
    usual = _robust_sigma(np.diff(_fill_gaps(brightness)))
    least = max(_LEAST_DN, options.flash_sigmas * usual)
    if rises[top] < least:
        raise InputError(
            f"{camera}: no flash; its brightness rises by {rises[top]:.1f} of 255 at most (frame {top}), and usually "
            f"changes by {usual:.1f}; film one flash that all cameras see, or use another --sync"
        )
    found, left = [], rises.copy()
    while left.max() > max(least, options.second_share * rises[top]):
        here = int(left.argmax())
        found.append(here - 1 if rises[here - 1] > _RISE * rises[here] else here)
        left[max(0, here - 2) : here + 3] = -np.inf
    if len(found) > _MOST_FLASHES:
        raise InputError(
            f"{camera}: no clear flash; its brightness rises about as much at {len(found)} frames; cut the film, or "
            "use another --sync"
        )
    return sorted(found)


def _rises(brightness: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """By how much each frame is brighter than the one before, and than was usual before: a dark frame ends in none."""
    before = [
        max(brightness[k - 1], np.median(brightness[max(0, k - _SLOW // 2) : k])) for k in range(1, len(brightness))
    ]
    return np.concatenate([[0.0], brightness[1:] - before])


# --- by the motion in the images -----------------------------------------------------------------------------------


def motion_starts(motion: Signals, options: SyncOptions) -> dict[str, int]:
    """When each camera started, from the times of much and little change in its images.

    All pairs of cameras are compared, and the offsets that can be trusted must agree. Raises InputError where a
    camera's motion resembles that of no other, or they do not agree.
    """
    offsets = {
        pair: offset_between(motion[pair[0]], motion[pair[1]], options) for pair in combinations(sorted(motion), 2)
    }
    trusted = {pair: each for pair, each in offsets.items() if each.doubt is None}
    starts = dict.fromkeys(sorted(motion)[:1], 0)
    while joined := {pair: each for pair, each in trusted.items() if (pair[0] in starts) != (pair[1] in starts)}:
        one, other = best = max(joined, key=lambda pair: joined[pair].sigmas)
        if one in starts:
            starts[other] = starts[one] + trusted[best].frames
        else:
            starts[one] = starts[other] - trusted[best].frames
    for camera in sorted(motion):
        if camera not in starts:
            near = {pair: each for pair, each in offsets.items() if camera in pair}
            pair = max(near, key=lambda pair: near[pair].sigmas)
            raise InputError(
                f"{camera}: no offset found from motion can be trusted; the best, with {pair[pair[0] == camera]}: "
                f"{near[pair].doubt}; use another --sync"
            )
    for (one, other), each in trusted.items():
        if abs(starts[other] - starts[one] - each.frames) > 1:
            raise InputError(
                f"{one} and {other}: from motion, {each.frames} frames apart, but "
                f"{starts[other] - starts[one]} by way of the other cameras; use another --sync"
            )
    return _shift_to_zero(starts)


def offset_between(one: Float[np.ndarray, "m"], other: Float[np.ndarray, "n"], options: SyncOptions) -> Offset:
    """How much later the other camera began, by the correlation of the quick changes in both signals."""
    first, second = _high_pass(one), _high_pass(other)
    offsets, found, overlaps = _correlations(first, second)
    usable = overlaps >= max(2 * _SLOW, options.overlap_share * min(len(one), len(other)))
    if usable.sum() < _SLOW:
        return Offset(frames=0, correlation=0.0, sigmas=0.0, doubt=f"{min(len(one), len(other))} frames are too few")
    heights = np.where(usable, found * np.sqrt(overlaps), -np.inf)
    best = int(heights.argmax())
    far = usable & (np.abs(offsets - offsets[best]) > 3)
    usual = _robust_sigma(heights[far])
    sigmas = float(heights[best] / usual) if usual > 0 else 0.0
    second_best = int(np.where(far, heights, -np.inf).argmax())
    frames = int(offsets[best])
    doubt: str | None
    if sigmas < options.motion_sigmas:
        doubt = f"an offset of {frames} frames stands out by only {sigmas:.1f} standard deviations"
    elif heights[second_best] > options.second_share * heights[best]:
        doubt = f"an offset of {offsets[second_best]} frames is about as good as one of {frames}"
    else:
        doubt = _disagreement(first, second, frames)
    return Offset(frames=frames, correlation=float(found[best]), sigmas=sigmas, doubt=doubt)


def _disagreement(one: Float[np.ndarray, "m"], other: Float[np.ndarray, "n"], frames: int) -> str | None:
    """Whether the two halves of what both saw want other offsets, as where cameras have other rates."""
    start, end = max(0, frames), min(len(one), len(other) + frames)
    middle = (start + end) // 2
    halves = []
    for part in (slice(start, middle), slice(middle, end)):
        offsets, found, overlaps = _correlations(one[part], other[part.start - frames : part.stop - frames])
        heights = np.where(np.abs(offsets) <= _SLOW, found * np.sqrt(overlaps), -np.inf)
        halves.append(frames + int(offsets[heights.argmax()]))
    if max(abs(each - frames) for each in halves) <= 1:
        return None
    return (
        f"an offset of {halves[0]} frames in the first half and {halves[1]} in the second; the frame rates may differ"
    )


def _correlations(
    one: Float[np.ndarray, "m"], other: Float[np.ndarray, "n"]
) -> tuple[np.ndarray, Float[np.ndarray, "o"], Float[np.ndarray, "o"]]:
    """Each offset, the correlation at it, and how many frames of both there are."""
    known = np.isfinite(one), np.isfinite(other)
    first, second = np.where(known[0], one, 0.0), np.where(known[1], other, 0.0)
    products = correlate(first, second)
    powers = correlate(first**2, 1.0 * known[1]), correlate(1.0 * known[0], second**2)
    overlaps = np.rint(correlate(1.0 * known[0], 1.0 * known[1]))
    power = np.sqrt(np.maximum(powers[0] * powers[1], 1e-12))
    return np.arange(len(one) + len(other) - 1) - (len(other) - 1), products / power, overlaps


def _high_pass(signal: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """What changes quickly, in its usual size; NaN where there was none."""
    logs = np.log(_fill_gaps(signal) + 0.1)
    quick = logs - median_filter(logs, _SLOW, mode="nearest")
    scale = quick.std()
    return np.where(np.isfinite(signal), quick / scale if scale > 0 else np.nan, np.nan)


def _fill_gaps(signal: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """With a straight line where there is nothing."""
    known = np.flatnonzero(np.isfinite(signal))
    if not len(known):
        return np.zeros_like(signal)
    return np.interp(np.arange(len(signal)), known, signal[known])


def _robust_sigma(values: Float[np.ndarray, "n"]) -> float:
    """Standard deviation, from the median of the deviations."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def _shift_to_zero(starts: Mapping[str, int]) -> dict[str, int]:
    first = min(starts.values())
    return {camera: start - first for camera, start in starts.items()}
