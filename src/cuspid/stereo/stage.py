"""Depth of a whole capture, kept on disk frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cuspid.capture import Capture, Frame
from cuspid.geometry import Rigid3
from cuspid.progress import Progress, silent
from cuspid.reconstruction import DepthMap
from cuspid.stereo.matching import DepthEstimator, StereoOptions
from cuspid.stereo.temporal import TemporalOptions, measure_temporal
from cuspid.storage.captures import hash_frame
from cuspid.storage.files import digest_of
from cuspid.storage.handpieces import hash_handpiece
from cuspid.storage.reconstructions import read_depth_maps, write_depth_maps
from cuspid.storage.stages import Stage
from cuspid.tolerances import held
from cuspid.workers import map_in_threads

_CODE = ("stereo",)


@dataclass(frozen=True)
class StoredDepthMaps:
    """Depth maps on disk, read while they are iterated, as often as need be."""

    made: Mapping[Path, str]
    """Files of one frame after those of another, in the order of the frames, and the key that each was made under."""

    def __iter__(self) -> Iterator[DepthMap]:
        for file in self.made:
            yield from read_depth_maps(file)

    def __or__(self, other: StoredDepthMaps) -> StoredDepthMaps:
        """These and others, frame by frame."""
        made = {**self.made, **other.made}
        place = {name: k for k, name in enumerate(dict.fromkeys(file.stem for file in made))}
        return StoredDepthMaps(dict(sorted(made.items(), key=lambda item: place[item[0].stem])))

    @property
    def digest(self) -> str:
        """Of what they were all made from."""
        return digest_of(list(self.made.values()))


def measure_depth(
    capture: Capture, folder: Path, options: StereoOptions, *, progress: Progress = silent
) -> StoredDepthMaps:
    """Depth maps of every frame, from that frame alone, kept in ``folder``."""
    estimator = DepthEstimator(capture.handpiece, options)

    def measure(frame: Frame) -> tuple[DepthMap, ...]:
        return estimator.measure(capture.images(frame), frame.name)

    def inputs(frame: Frame) -> dict[str, str]:
        return {"frame": hash_frame(capture, frame)}

    return _measure_all(capture, capture.frames, measure, inputs, Stage("depth", folder, options, _CODE), progress)


def measure_temporal_depth(
    capture: Capture,
    rig_from_world: Mapping[str, Rigid3],
    folder: Path,
    options: TemporalOptions,
    *,
    progress: Progress = silent,
) -> StoredDepthMaps:
    """Depth maps of each camera together with itself at the next located frame of the same lighting pattern, kept in
    ``folder``."""
    following = _following([frame for frame in capture.frames if frame.name in rig_from_world])

    def motion(frame: Frame) -> Rigid3:
        return rig_from_world[following[frame.name].name] @ rig_from_world[frame.name].inverse()

    def measure(frame: Frame) -> tuple[DepthMap, ...]:
        now, after = capture.images(frame), capture.images(following[frame.name])
        return measure_temporal(capture.handpiece, now, after, motion(frame), frame.name, options)

    def inputs(frame: Frame) -> dict[str, str]:
        after = hash_frame(capture, following[frame.name])
        return {"frame": hash_frame(capture, frame), "after": after, "motion": digest_of(motion(frame))}

    frames = [frame for frame in capture.frames if frame.name in following]
    stage = Stage("temporal depth", folder, options, _CODE)
    return _measure_all(capture, frames, measure, inputs, stage, progress)


def _following(located: Sequence[Frame]) -> dict[str, Frame]:
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
    handpiece = hash_handpiece(held(capture.handpiece))  # how well it is known makes no depth
    files = [stage.folder / f"{frame.name}.npz" for frame in frames]

    def keep(one: tuple[Frame, Path]) -> str:
        frame, file = one
        made_from = {"handpiece": handpiece, **inputs(frame)}
        return stage.make(made_from, [file], lambda: write_depth_maps(file, measure(frame)))

    keys = map_in_threads(keep, zip(frames, files, strict=True), stage=stage.name, progress=progress)
    return StoredDepthMaps(dict(zip(files, keys, strict=True)))
