"""Depth of a whole capture, kept on disk frame by frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture, Frame
from cuspid.model.pairing import camera_groups
from cuspid.model.reconstruction import DepthMap, Reconstruction, SurfacePoints
from cuspid.model.tolerances import without_covariances
from cuspid.mvs.across import (
    AcrossOptions,
    consecutive_pair,
    measure_moving_cameras,
)
from cuspid.mvs.holes import Sightings, Views, greedy_cover
from cuspid.mvs.matching import (
    DepthEstimator,
    Signal,
    StereoOptions,
)
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import map_ahead, map_in_threads
from cuspid.storage.captures import hash_frame
from cuspid.storage.files import digest_of
from cuspid.storage.handpieces import hash_handpiece
from cuspid.storage.reconstructions import read_depth_maps, write_depth_maps
from cuspid.storage.stages import Stage

_CODE = (__name__,)
_LEFT_SHARE = 0.005
"""Share of the sparse points that matching across frames need not reach."""
_LEAST_PLACES = 5
"""Number of places on a surface that make it worth matching a camera with itself."""
_TIMES = 2
"""How often a place in a hole should be matched."""
_ENOUGH_MAPS = 4
"""Number of depth maps of every second frame that make those between superfluous."""


@dataclass(frozen=True)
class StoredDepthMaps:
    """Depth maps on disk, read during iteration, as often as needed."""

    made: Mapping[Path, str]
    """Files, frame by frame in the order of the frames, and the key under which each was made."""

    def __iter__(self) -> Iterator[DepthMap]:
        for maps in map_ahead(read_depth_maps, self.made):
            yield from maps

    def __or__(self, other: StoredDepthMaps) -> StoredDepthMaps:
        """These and the others, frame by frame."""
        made = {**self.made, **other.made}
        place = {name: k for k, name in enumerate(StoredDepthMaps(made).frames)}
        return StoredDepthMaps(dict(sorted(made.items(), key=lambda item: place[item[0].stem])))

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the frames that were measured."""
        return tuple(dict.fromkeys(file.stem for file in self.made))

    @property
    def digest(self) -> str:
        """Digest of everything that they were made from."""
        return digest_of(list(self.made.values()))


def measure_depth(
    capture: Capture,
    folder: Path,
    options: StereoOptions,
    signal: Signal = "texture",
    *,
    estimator: DepthEstimator | None = None,
    progress: Progress = silent,
) -> StoredDepthMaps:
    """Depth maps of every frame, each from that frame alone, kept in ``folder``.

    ``estimator``: one for this handpiece, these options and this signal, where there is one already.
    """
    estimator = estimator or DepthEstimator(capture.handpiece, options, signal=signal)

    def measure(frame: Frame) -> tuple[DepthMap, ...]:
        return estimator.measure(
            capture.fine_images(frame),
            frame.name,
            frame.lighting,
            masks=capture.masks(frame),
            alone=len(capture.frames) == 1,
        )

    def inputs(frame: Frame) -> dict[str, str]:
        return {"frame": hash_frame(capture, frame)}

    stage = Stage("depth", folder, [options, signal], _CODE)
    return _measure_all(capture, capture.frames, measure, inputs, stage, progress)


def measure_enough_depth(
    capture: Capture,
    found: Reconstruction,
    folder: Path,
    options: StereoOptions,
    *,
    agreement_mm: float,
    left_share: float,
    progress: Progress = silent,
) -> StoredDepthMaps:
    """Depth maps of every second frame, and of those groups of cameras in the frames between that show surface which
    few of these depth maps confirm within ``agreement_mm``, kept in ``folder``.

    Frames between are measured until the sparse points that they could still confirm are no more than ``left_share`` (0
    to 1) of all points: none are measured at 1; all at 0, or if there are no sparse points.
    """
    if left_share == 0 or (found.tracks is None and left_share < 1):
        return measure_depth(capture, folder, options, progress=progress)
    every_second = _select_every_second(capture.frames)
    depths = measure_depth(replace(capture, frames=every_second), folder, options, progress=progress)
    if found.tracks is None or left_share == 1:
        return depths
    sightings = Sightings.of(found, found.tracks)
    missing = sightings.count_confirmations(depths, found.rig_from_world, agreement_mm) < _ENOUGH_MAPS
    between = _unmeasured_frames(capture, set(every_second), sightings, missing, left_share, options)
    more = measure_depth(
        replace(capture, frames=between), folder, options, progress=lambda _, *of: progress("more depth", *of)
    )
    return depths | more


def _select_every_second(frames: Sequence[Frame]) -> tuple[Frame, ...]:
    """Of the frames of each lighting pattern."""
    ranks = Counter[str | None]()
    kept = []
    for frame in frames:
        if ranks[frame.lighting] % 2 == 0:
            kept.append(frame)
        ranks[frame.lighting] += 1
    return tuple(kept)


def _unmeasured_frames(
    capture: Capture,
    measured: Container[Frame],
    sightings: Sightings,
    missing: Bool[np.ndarray, "p"],
    left_share: float,
    options: StereoOptions,
) -> tuple[Frame, ...]:
    """The frames that were not measured, with the groups of cameras that show points which are missing."""
    groups = camera_groups(capture.handpiece.rig, capture.handpiece.working_distance_mm, options.pairing)
    tried = [(frame, group) for frame in capture.frames if frame not in measured for group in groups]
    shown = [sightings.in_stereo(frame.name, group) for frame, group in tried]
    taken = greedy_cover([points[missing[points]] for points in shown], len(missing), left_share * len(missing))
    cameras: dict[Frame, set[str]] = {}
    for frame, group in (tried[index] for index in taken):
        cameras.setdefault(frame, set()).update(group)
    return tuple(
        replace(frame, cameras=tuple(camera for camera in frame.cameras if camera in those))
        for frame, those in cameras.items()
    )


def measure_depth_across(
    capture: Capture,
    found: Reconstruction,
    depths: Iterable[DepthMap],
    folder: Path,
    options: AcrossOptions,
    stereo: StereoOptions,
    *,
    agreement_mm: float,
    min_maps: int,
    holes: SurfacePoints | None = None,
    progress: Progress = silent,
) -> StoredDepthMaps:
    """Depth maps of cameras matched with themselves at the next located frame of the same lighting pattern, kept in
    ``folder``, for those cameras that fill holes (:attr:`AcrossOptions.left_share`). Holes are where fewer than
    ``min_maps`` of ``depths`` confirm the sparse points within ``agreement_mm``, and the further places given as
    ``holes``."""
    steps = _steps(capture, found.rig_from_world, stereo)
    left_share = _LEFT_SHARE if options.left_share is None else options.left_share
    if found.tracks is not None and left_share > 0:
        sightings = Sightings.of(found, found.tracks)
        missing = sightings.count_confirmations(depths, found.rig_from_world, agreement_mm) < min_maps
        tried = [(step, camera) for step in steps.values() for camera in step.now.cameras]
        taken = _steps_for_missing_points(tried, sightings, missing, left_share)
        if holes is not None:
            images = [(frame.name, camera) for step, camera in tried for frame in (step.now, step.after)]
            taken |= _steps_for_small_holes(tried, taken, Views.of(holes, found, images, depths, agreement_mm))
        steps = _group_by_frame(tried, taken)

    def measure(frame: Frame) -> tuple[DepthMap, ...]:
        step = steps[frame.name]
        now, after = capture.fine_images(step.now), capture.fine_images(step.after)
        masks = capture.masks(step.now) | {f"{name}+": mask for name, mask in capture.masks(step.after).items()}
        return measure_moving_cameras(capture.handpiece, now, after, masks, step.motion, frame.name, options, stereo)

    def inputs(frame: Frame) -> dict[str, str]:
        step = steps[frame.name]
        now, after = hash_frame(capture, step.now), hash_frame(capture, step.after)
        return {"frame": now, "after": after, "motion": digest_of(step.motion)}

    stage = Stage("depth across frames", folder, [options, stereo], _CODE)
    return _measure_all(capture, [step.now for step in steps.values()], measure, inputs, stage, progress)


@dataclass(frozen=True, eq=False)
class _Step:
    """Two images of each of some cameras, and how the handpiece moved between them."""

    now: Frame
    after: Frame
    motion: Rigid3

    def with_cameras(self, cameras: Sequence[str]) -> _Step:
        """With these cameras only."""
        now, after = (replace(frame, cameras=tuple(cameras)) for frame in (self.now, self.after))
        return replace(self, now=now, after=after)


def _steps(capture: Capture, rig_from_world: Mapping[str, Rigid3], stereo: StereoOptions) -> dict[str, _Step]:
    """From each located frame, by its name, to the next of its lighting pattern, with the cameras that moved enough."""
    following = _next_frames([frame for frame in capture.frames if frame.name in rig_from_world])
    cameras, steps = capture.handpiece.rig.in_own_order().names, dict[str, _Step]()
    for now in capture.frames:
        if now.name in following:
            after = following[now.name]
            motion = rig_from_world[after.name] @ rig_from_world[now.name].inverse()
            both = [camera for camera in cameras if camera in now.cameras and camera in after.cameras]
            moved = [c for c in both if consecutive_pair(capture.handpiece, c, motion, stereo.pairing) is not None]
            if moved:
                steps[now.name] = _Step(now, after, motion).with_cameras(moved)
    return steps


def _steps_for_missing_points(
    tried: Sequence[tuple[_Step, str]], sightings: Sightings, missing: Bool[np.ndarray, "p"], left_share: float
) -> set[int]:
    """Which steps of a camera show points that are missing."""
    if missing.sum() <= left_share * len(missing):
        return set()
    shown = [sightings.both((step.now.name, camera), (step.after.name, camera)) for step, camera in tried]
    return set(greedy_cover([points[missing[points]] for points in shown], len(missing), left_share * len(missing)))


def _steps_for_small_holes(tried: Sequence[tuple[_Step, str]], taken: set[int], views: Views) -> set[int]:
    """Which further steps of a camera it takes to show each place several times: one alone leaves gaps of its own."""
    shown = [views.both((step.now.name, camera), (step.after.name, camera)) for step, camera in tried]
    times, further = np.zeros(views.count, dtype=np.int64), set[int]()
    for index in taken:
        times[shown[index]] += 1
    for few in range(1, _TIMES + 1):
        left = times < few
        untaken = [places[left[places]] for places in shown]
        for index in taken | further:
            untaken[index] = untaken[index][:0]
        more = greedy_cover(untaken, views.count, least=_LEAST_PLACES)
        for index in more:
            times[shown[index]] += 1
        further |= set(more)
    return further


def _group_by_frame(tried: Sequence[tuple[_Step, str]], taken: set[int]) -> dict[str, _Step]:
    """The steps that were taken, by the names of their frames, each with its cameras."""
    cameras: dict[str, list[str]] = {}
    steps: dict[str, _Step] = {}
    for step, camera in (tried[index] for index in sorted(taken)):
        steps[step.now.name] = step
        cameras.setdefault(step.now.name, []).append(camera)
    return {name: step.with_cameras(cameras[name]) for name, step in steps.items()}


def _next_frames(located: Sequence[Frame]) -> dict[str, Frame]:
    """For each frame, but the last of each lighting pattern, the next one of that pattern."""
    following: dict[str, Frame] = {}
    latest: dict[str | None, Frame] = {}
    for frame in located:
        if frame.lighting in latest:
            following[latest[frame.lighting].name] = frame
        latest[frame.lighting] = frame
    return following


def _measure_all(
    capture: Capture,
    frames: Sequence[Frame],
    measure: Callable[[Frame], tuple[DepthMap, ...]],
    inputs: Callable[[Frame], Mapping[str, str]],
    stage: Stage,
    progress: Progress,
) -> StoredDepthMaps:
    handpiece = hash_handpiece(without_covariances(capture.handpiece))  # how well it is known makes no depth
    files = [stage.folder / f"{frame.name}.npz" for frame in frames]

    def keep(one: tuple[Frame, Path]) -> str:
        frame, file = one
        made_from = {"handpiece": handpiece, **inputs(frame)}
        return stage.make(made_from, [file], lambda: write_depth_maps(file, measure(frame)))

    keys = map_in_threads(keep, zip(frames, files, strict=True), stage=stage.name, progress=progress)
    return StoredDepthMaps(dict(zip(files, keys, strict=True)))
