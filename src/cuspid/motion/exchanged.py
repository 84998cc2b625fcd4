"""Whether some cameras show the images of others: cables, or folders, that were exchanged.

The keypoints of a frame are matched between all of its images, whatever the rig says. A match of two images agrees with
two cameras if it lies near their epipolar lines, in front of both, at a depth that they are made for. As a rule nearly
all do; of images that were exchanged nearly none do, but nearly all agree with the cameras that took them. These are
sought as the assignment of images to cameras with which most matches agree: a quadratic one, by a beam search.

Groups of cameras that see nothing in common may be exchanged as a whole, and everything agrees within a frame. The
motion of the handpiece to the next frame then distinguishes them: all groups moved with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.model.capture import Capture
from cuspid.model.epipolar import epipolar_residuals, skew
from cuspid.model.pairing import camera_groups, stereo_pairs
from cuspid.model.rig import Handpiece
from cuspid.motion.frontend.features import Features, detect_all
from cuspid.motion.frontend.odometry import Edge, relative_pose, triangulate_frame
from cuspid.motion.frontend.pairs import match_unguided
from cuspid.motion.frontend.pictures import Pictures
from cuspid.motion.location import MotionOptions, index_frame
from cuspid.runtime.errors import InputError
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import computed_once, map_in_threads

_FRAMES, _KEYPOINTS = 3, 500
"""Frames that are looked at, and keypoints of each image."""
_NEAR_PX, _LOOSE_PX, _DEPTH_SLACK = 3.0, 12.0, 1.5
"""A match agrees so near to its epipolar line, at depths that lie out of the range by no more than this factor. With
the camera that it is given as it may lie farther away: the calibration may be that far off."""
_LEAST, _TIED_SHARE, _SHARE, _NAMED_SHARE = 15, 0.25, 0.5, 0.6
"""Two images belong to two cameras where at least so many of their matches agree, and the first share of them (a tenth
does by chance). Images belong to their camera where the second share of all their matches agrees. Another camera is
named where the third share of the matches of those that belong together does."""
_GAIN = 2.0
"""An exchange must have this many times as many matches agree."""
_MOST_CAMERAS, _BEAM, _NEARLY, _MOST_RIVALS = 16, 2000, 0.9, 24
_TOLD, _LOST_SHARE = 30, 0.2
"""Matches of a pair from which on a share of them is told, and the share below which a camera contradicts another."""
_MOVED_SHARE = 0.8
"""Share of the matches to the next frame that agree on one motion where no group is exchanged."""

Slots = Int[np.ndarray, "c"]
"""For each camera's images the index of the camera that took them."""


@dataclass(frozen=True, kw_only=True)
class CameraCheck:
    """What the images say of which camera took them."""

    taken_by: Mapping[str, str]
    """By camera whose images are those of another one: that other one."""
    agreeing: int
    """Matches of these images that agree with the cameras that took them."""
    before: int
    """Matches of these images that agree with the cameras that they are given as."""
    contradicted: tuple[str, ...]
    """Cameras whose images agree with no others, and are not found to be those of another camera."""

    @property
    def exchange(self) -> str | None:
        """What was exchanged, in words."""
        if not self.taken_by:
            return None
        pairs = ", ".join(f"{given} holds those of {true}" for given, true in self.taken_by.items())
        return (
            f"the images of {len(self.taken_by)} cameras are exchanged: {pairs} ({self.agreeing:,} of their matches "
            f"agree so, and {self.before:,} as they are)"
        )


_NOTHING = CameraCheck(taken_by={}, agreeing=0, before=0, contradicted=())


def require_own_images(
    capture: Capture, options: MotionOptions, *, cache: Path | None = None, progress: Progress = silent
) -> tuple[str, ...]:
    """Notes on cameras whose images agree with those of no other one.

    Raises InputError where images are those of other cameras, and names them.
    """
    if len(capture.handpiece.rig.names) < 2:
        return ()
    found = check_cameras(capture, options, cache=cache, progress=progress)
    if found.exchange is not None:
        raise InputError(f"{found.exchange}; exchange the folders, or the cameras' names in the handpiece file")
    if not found.contradicted:
        return ()
    return (
        f"motion: hardly a match of the images of {', '.join(found.contradicted)} agrees with its neighbours, while "
        f"those of others do: check whether it is in its place, and whether its images are its own",
    )


def check_cameras(
    capture: Capture, options: MotionOptions, *, cache: Path | None = None, progress: Progress = silent
) -> CameraCheck:
    """Look whether each camera's images are its own, in some frames of a capture."""
    handpiece, count = capture.handpiece, len(capture.frames)
    first = max(0, (count - _FRAMES) // 2)
    few = replace(capture, frames=capture.frames[first : first + _FRAMES])
    names = [frame.name for frame in few.frames]
    features = detect_all(Pictures(few, max_bytes=0), options.sought, progress=progress, cache=cache)
    return check_features(handpiece, features, names, options)


def check_features(
    handpiece: Handpiece, features: Mapping[tuple[str, str], Features], frames: Sequence[str], options: MotionOptions
) -> CameraCheck:
    """As :func:`check_cameras`, from the keypoints by (frame, camera) of consecutive frames."""
    names = handpiece.rig.names
    few = {key: _sample_features(each) for key, each in features.items()}
    motion, own = _Motion(handpiece, few, frames, options), np.arange(len(names))
    beside = [(names.index(a), names.index(b)) for a, b in _pairs(handpiece, options)]
    matches = _Matches.of(handpiece, few, frames, options, beside)
    agreeing = matches.agreeing_as(own)
    if bool(_fits(agreeing, matches.counts).all()) and motion.is_one(own):
        return _NOTHING
    lost = _contradicted_cameras(matches.agreeing_as(own, _LOOSE_PX), matches.counts)
    contradicted = tuple(names[k] for k in np.flatnonzero(lost))
    nothing = replace(_NOTHING, contradicted=contradicted)
    if len(names) > _MOST_CAMERAS:
        return nothing
    matches = _Matches.of(handpiece, few, frames, options, list(combinations(range(len(names)), 2)))
    slots = _best(_rivals(matches), motion)
    moved = np.flatnonzero(slots != own)
    agreeing, after = matches.agreeing_as(own, _LOOSE_PX), matches.agreeing_as(slots)
    before, gained = (int(each[moved].sum()) for each in (agreeing, after))
    ties = ((after >= _LEAST) & (after >= _TIED_SHARE * matches.counts))[moved]
    tied = ties.any(axis=1).all() and (after[moved][ties].sum() >= _NAMED_SHARE * matches.counts[moved][ties].sum())
    if len(moved) and tied and (gained >= _GAIN * before or motion.is_preferred(slots, own)):
        taken_by = {names[k]: names[slots[k]] for k in moved}
        return CameraCheck(taken_by=taken_by, agreeing=gained, before=before, contradicted=())
    return nothing


def _pairs(handpiece: Handpiece, options: MotionOptions) -> tuple[tuple[str, str], ...]:
    return stereo_pairs(handpiece.rig, handpiece.working_distance_mm, options.pairing)


def _sample_features(features: Features) -> Features:
    chosen = np.unique(np.linspace(0, len(features) - 1, _KEYPOINTS).astype(int)) if len(features) else slice(0)
    return Features(
        pixels=features.pixels[chosen], descriptors=features.descriptors[chosen], colors=features.colors[chosen]
    )


@dataclass(frozen=True, eq=False)
class _Matches:
    """Matches of every two cameras' images."""

    handpiece: Handpiece
    pixels: Mapping[tuple[int, int], tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k 2"]]]

    @staticmethod
    def of(
        handpiece: Handpiece,
        features: Mapping[tuple[str, str], Features],
        frames: Sequence[str],
        options: MotionOptions,
        pairs: Sequence[tuple[int, int]],
    ) -> _Matches:
        names = handpiece.rig.names

        def match(pair: tuple[int, int]) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k 2"]]:
            found = [(np.zeros((0, 2)), np.zeros((0, 2)))]
            for frame in frames:
                one, other = (features.get((frame, names[k])) for k in pair)
                if one is not None and other is not None:
                    rows = match_unguided(one, other, options.odometry.unguided)
                    found.append((one.pixels[rows[:, 0]], other.pixels[rows[:, 1]]))
            first, second = zip(*found, strict=True)
            return np.concatenate(first), np.concatenate(second)

        return _Matches(handpiece, dict(zip(pairs, map_in_threads(match, pairs), strict=True)))

    @property
    def counts(self) -> Int[np.ndarray, "c c"]:
        """Matches of every two."""
        counts = np.zeros((len(self.handpiece.rig.names),) * 2, dtype=np.int64)
        for (i, j), (first, _) in self.pixels.items():
            counts[i, j] = counts[j, i] = len(first)
        return counts

    def agreeing(self, images: tuple[int, int], cameras: tuple[int, int], near_px: float = _NEAR_PX) -> int:
        """Matches of two images that agree with two cameras."""
        rig, (low, high) = self.handpiece.rig, self.handpiece.depth_range_mm
        mounted = [rig[rig.names[k]] for k in cameras]
        x, y = (each.camera.rays(pixels) for each, pixels in zip(mounted, self.pixels[images], strict=True))
        there_from_here = mounted[1].cam_from_rig @ mounted[0].cam_from_rig.inverse()
        turned, shift = there_from_here.rotate(x), there_from_here.translation
        essential = skew(shift) @ there_from_here.rotation
        across = np.cross(turned, y)
        with np.errstate(invalid="ignore", divide="ignore"):
            off_px = mounted[1].camera.focal_px.mean() * np.abs(epipolar_residuals(essential, x[:, :2], y[:, :2]))
            here_mm = -np.einsum("ni,ni->n", across, np.cross(shift, y)) / np.einsum("ni,ni->n", across, across)
            there_mm = here_mm * turned[:, 2] + shift[2]
            near, far = low / _DEPTH_SLACK, high * _DEPTH_SLACK
            within = (here_mm > near) & (here_mm < far) & (there_mm > near) & (there_mm < far)
        return int(np.count_nonzero(within & (off_px < near_px)))

    def agreeing_as(self, slots: Slots, near_px: float = _NEAR_PX) -> Int[np.ndarray, "c c"]:
        """Matches of every two images that agree with the cameras that they are assigned to."""
        found = np.zeros((len(slots),) * 2, dtype=np.int64)
        for i, j in self.pixels:
            found[i, j] = found[j, i] = self.agreeing((i, j), (int(slots[i]), int(slots[j])), near_px)
        return found

    def agreeing_anywhere(self) -> Int[np.ndarray, "c c c c"]:
        """Matches of every two images that agree with every two cameras."""
        n = len(self.handpiece.rig.names)
        found = np.zeros((n, n, n, n), dtype=np.int64)
        for i, j in self.pixels:
            for p in range(n):
                for q in range(n):
                    if p != q:
                        found[i, j, p, q] = found[j, i, q, p] = self.agreeing((i, j), (p, q))
        return found


def _fits(agreeing: Int[np.ndarray, "c c"], counts: Int[np.ndarray, "c c"]) -> Bool[np.ndarray, "c"]:
    """Which cameras' images agree with most of those beside them."""
    all_of, those = counts.sum(axis=1), agreeing.sum(axis=1)
    return np.asarray((those >= _LEAST) & (those >= _SHARE * all_of))


def _contradicted_cameras(agreeing: Int[np.ndarray, "c c"], counts: Int[np.ndarray, "c c"]) -> Bool[np.ndarray, "c"]:
    """Cameras of which hardly a match with those beside them agrees, while those of others do."""
    sufficient = counts >= _TOLD
    lost = sufficient.any(axis=1) & ~(sufficient & (agreeing >= _LOST_SHARE * counts)).any(axis=1)
    return np.asarray(lost & (sufficient & (agreeing >= _SHARE * counts)).any())


@dataclass(frozen=True, eq=False)
class _Motion:
    """How the images of consecutive frames agree on the motion of a rig whose cameras are of several groups."""

    handpiece: Handpiece
    features: Mapping[tuple[str, str], Features]
    frames: Sequence[str]
    options: MotionOptions

    @computed_once
    def is_decidable(self) -> bool:
        """Whether there is something to agree on."""
        groups = camera_groups(self.handpiece.rig, self.handpiece.working_distance_mm, self.options.pairing)
        return len(groups) > 1 and len(self.frames) > 1

    def is_one(self, slots: Slots) -> bool:
        """Whether nearly all that was matched moved as one."""
        edges = self._edges(slots)
        return not self.is_decidable or sum(e.matches for e in edges) >= _MOVED_SHARE * sum(e.sought for e in edges)

    def agreeing(self, slots: Slots) -> int:
        """Matches to the next frames that agree on one motion."""
        return sum(edge.matches for edge in self._edges(slots))

    def is_preferred(self, slots: Slots, others: Slots) -> bool:
        """Whether far more moved as one than with other slots."""
        return self.is_decidable and self.agreeing(slots) >= max(_GAIN * self.agreeing(others), _LEAST)

    def _edges(self, slots: Slots) -> list[Edge]:
        if not self.is_decidable:
            return []
        names, rig = self.handpiece.rig.names, self.handpiece.rig
        camera = {name: names[k] for name, k in zip(names, slots, strict=True)}
        assigned = {(frame, camera[image]): each for (frame, image), each in self.features.items()}
        views = [index_frame(rig, assigned, frame) for frame in self.frames]
        pairs = _pairs(self.handpiece, self.options)
        clouds = [triangulate_frame(self.handpiece, pairs, each, self.options.within) for each in views[:-1]]
        steps = zip(clouds, pairwise(views), strict=True)
        odometry, seed = self.options.odometry, self.options.seed
        return [relative_pose(rig, cloud, *step, odometry, seed) for cloud, step in steps]


def _best(rivals: Sequence[tuple[Slots, int]], motion: _Motion) -> Slots:
    """With which most matches agree, within frames and between them; of equals the first one."""
    return max(rivals, key=lambda rival: rival[1] + motion.agreeing(rival[0]))[0]


def _rivals(matches: _Matches) -> list[tuple[Slots, int]]:
    """The assignments of images to cameras with which most matches agree, and how many; those that move the fewest come
    first."""
    table, counts = matches.agreeing_anywhere(), matches.counts
    n = len(counts)
    order = [int(counts.sum(axis=1).argmax())]
    while len(order) < n:
        tied = counts[:, order].sum(axis=1)
        tied[order] = -1
        order.append(int(tied.argmax()))
    slots, scores = np.zeros((1, 0), dtype=np.int64), np.zeros(1, dtype=np.int64)
    for at, image in enumerate(order):
        grown = np.tile(scores[:, None], (1, n))
        for k in range(at):
            grown += table[image, order[k]][:, slots[:, k]].T
        np.put_along_axis(grown, slots, -1, axis=1)
        kept = np.argsort(-grown, axis=None, kind="stable")[: min(_BEAM, np.count_nonzero(grown >= 0))]
        state, camera = np.unravel_index(kept, grown.shape)
        slots, scores = np.column_stack([slots[state], camera]), grown[state, camera]
    assigned = np.empty_like(slots)
    assigned[:, order] = slots
    near = np.flatnonzero(scores >= _NEARLY * scores.max())
    moves = (assigned[near] != np.arange(n)).sum(axis=1)
    return [(assigned[k], int(scores[k])) for k in near[np.lexsort((-scores[near], moves))][:_MOST_RIVALS]]
