"""The path of the handpiece while frames come in: each is placed beside those before it, or where it has been before.

Poses are chained and never corrected here, so that they drift; :func:`cuspid.motion.location.locate` adjusts them all.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.model.pairing import stereo_pairs
from cuspid.model.rig import Handpiece
from cuspid.motion.frontend.features import Features
from cuspid.motion.frontend.odometry import Cloud, Edge, FrameFeatures, relative_pose, triangulate_frame
from cuspid.motion.frontend.revisits import WORDS, look, visual_words
from cuspid.motion.location import MotionOptions, index_frame, loosen_tolerances

Recall = Callable[[str], Mapping[tuple[str, str], Features]]
"""The keypoints of an earlier frame, by frame and camera."""
_CANDIDATES = 4
"""Frames that a lost one is compared with, those that look most like it."""


@dataclass(frozen=True, kw_only=True)
class Placed:
    """What became of a frame."""

    rig_from_world: Rigid3 | None
    """Where the handpiece was; the world is the rig frame of the first frame that could be placed. None if the frame
    could not be placed."""
    beside: str | None
    """Name of the frame that it was placed by."""
    reason: str | None
    """Why it could not be placed."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _PlacedFrame:
    """A frame that was placed."""

    name: str
    views: FrameFeatures
    cloud: Cloud


class Tracker:
    """Places frames one after the other. It remembers where each was and how it looked, and the keypoints of the last
    few; those of others are recalled where the path was lost."""

    def __init__(self, handpiece: Handpiece, options: MotionOptions, recall: Recall) -> None:
        self._handpiece, self._options = handpiece, loosen_tolerances(options, handpiece)
        self._pairs = stereo_pairs(handpiece.rig, handpiece.working_distance_mm, options.pairing)
        self._recall = recall
        self._recent = deque[_PlacedFrame](maxlen=options.odometry.reach)
        self._lost = False
        self._looks = dict[str, Float[np.ndarray, "d"]]()
        self._words: Float[np.ndarray, "k 128"] | None = None
        self.rig_from_world = dict[str, Rigid3]()
        """Where the frames are that could be placed so far."""

    def push(self, name: str, features: Mapping[tuple[str, str], Features]) -> Placed:
        """Place the next frame."""
        frame = self._index(name, features)
        least = self._options.odometry.min_matches
        if len(frame.cloud.points) < least:
            return self._lose(f"only {len(frame.cloud.points)} points seen in stereo; {least} are needed")
        if not self.rig_from_world:
            return self._keep(frame, Rigid3.identity(), None)
        found = self._match_previous(frame) or self._relocalise(frame)
        if found is None:
            return self._lose(f"fewer than {least} matches to the frames before, or too small a share of them agreed")
        other, target_from_source = found
        return self._keep(frame, target_from_source @ self.rig_from_world[other.name], other.name)

    def correct(self, rig_from_world: Mapping[str, Rigid3]) -> None:
        """Take better poses of the frames so far; those that are not among them are no longer placed."""
        self.rig_from_world = dict(rig_from_world)
        self._looks = {name: code for name, code in self._looks.items() if name in rig_from_world}
        kept = [seen for seen in self._recent if seen.name in rig_from_world]
        self._lost = len(kept) < len(self._recent)
        self._recent = deque(kept, maxlen=self._recent.maxlen)

    def _index(self, name: str, features: Mapping[tuple[str, str], Features]) -> _PlacedFrame:
        views = index_frame(self._handpiece.rig, features, name)
        return _PlacedFrame(
            name=name, views=views, cloud=triangulate_frame(self._handpiece, self._pairs, views, self._options.within)
        )

    def _keep(self, frame: _PlacedFrame, rig_from_world: Rigid3, beside: str | None) -> Placed:
        self._lost = False
        self.rig_from_world[frame.name] = rig_from_world
        self._recent.append(frame)
        descriptors = [view.features.descriptors for view in frame.views.values()]
        if self._words is None and sum(map(len, descriptors)) >= WORDS:
            self._words = visual_words(descriptors, self._options.seed)
        if self._words is not None:
            self._looks[frame.name] = look(descriptors, self._words)
        return Placed(rig_from_world=rig_from_world, beside=beside, reason=None)

    def _lose(self, reason: str) -> Placed:
        self._lost = True
        return Placed(rig_from_world=None, beside=None, reason=reason)

    def _match_previous(self, frame: _PlacedFrame) -> tuple[_PlacedFrame, Rigid3] | None:
        """The frame before, if that could be placed and this one beside it."""
        if self._lost or not self._recent:
            return None
        edge = self._edge(self._recent[-1], frame)
        return None if edge.target_from_source is None else (self._recent[-1], edge.target_from_source)

    def _relocalise(self, frame: _PlacedFrame) -> tuple[_PlacedFrame, Rigid3] | None:
        """Of the last frames and those that look most like this one, the one that it has most in common with."""
        tried = [*self._recent, *self._look_alikes(frame)]
        edges = [(other, self._edge(other, frame)) for other in tried]
        found = [(other, e.target_from_source, e.matches) for other, e in edges if e.target_from_source is not None]
        return max(found, key=lambda one: one[2])[:2] if found else None

    def _edge(self, source: _PlacedFrame, target: _PlacedFrame) -> Edge:
        options = self._options
        return relative_pose(
            self._handpiece.rig, source.cloud, source.views, target.views, options.odometry, options.seed
        )

    def _look_alikes(self, frame: _PlacedFrame) -> list[_PlacedFrame]:
        """Frames long before, as recalled."""
        if self._words is None:
            return []
        code = look([view.features.descriptors for view in frame.views.values()], self._words)
        tried = {seen.name for seen in self._recent}
        likeness = {name: float(code @ other) for name, other in self._looks.items() if name not in tried}
        best = sorted(likeness, key=likeness.__getitem__, reverse=True)[:_CANDIDATES]
        return [self._index(name, self._recall(name)) for name in best]
