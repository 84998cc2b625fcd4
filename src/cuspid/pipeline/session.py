"""A scan while it is taken: frames come in one by one, and there is always a pose, a surface and a word on what is
missing.

    session = Session(handpiece, source, folder)
    for frame in frames:
        step = session.push(frame)          # where it was, or why that is not known; what changed of the surface
    reconstruction, mesh = session.finish()

Poses of frames that were just taken are chained (:mod:`cuspid.motion.tracker`); :meth:`Session.correct` adjusts all of
them together and puts the surface where they then are. At the end stands :func:`cuspid.pipeline.scan.reconstruct`, of
the images that came in and with what was kept of them: the same code and the same figures as without a session.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from cuspid.fusion.growing import GrowingSurface
from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture, Dropped, Frame, ImageSource
from cuspid.model.mesh import Mesh
from cuspid.model.pairing import detail_mm, require_stereo
from cuspid.model.reconstruction import DepthMap, Reconstruction
from cuspid.model.rig import Handpiece
from cuspid.motion.frontend.features import Features, detect_all
from cuspid.motion.frontend.pictures import Pictures
from cuspid.motion.tracker import Placed, Tracker
from cuspid.mvs.matching import DepthEstimator
from cuspid.mvs.signal import shows_detail
from cuspid.mvs.stage import StoredDepthMaps, measure_depth
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.scan import ReconstructionOptions
from cuspid.runtime.errors import InputError, ReconstructionError
from cuspid.runtime.progress import Progress, silent

_PLAIN = (
    "it shows no texture, and plain surfaces are not followed while they are scanned; run cuspid reconstruct when all "
    "images are there"
)
_MOVED_VOXELS = 0.5
"""A correction that moves the surface of a frame by less than this is not worth putting it there."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Step:
    """What a frame changed."""

    frame: str
    """Its name."""
    rig_from_world: Rigid3 | None
    """Where the handpiece was, None if that is not known."""
    reason: str | None
    """Why not."""
    changed: Mapping[int, Mesh]
    """The parts of the surface that are new or other than before, coloured, by their keys; empty ones are gone."""
    seconds: float
    """How long it took."""


class Session:
    """A scan of textured teeth that grows frame by frame. What is kept in the folder is what a reconstruction of the
    same images keeps."""

    def __init__(
        self,
        handpiece: Handpiece,
        source: ImageSource,
        folder: Path | str,
        options: ReconstructionOptions | None = None,
    ) -> None:
        """``source`` gives the images of the frames that will be pushed; ``folder`` is that of the results. Raises
        InputError where no two cameras see the same surface."""
        self._options = options or ReconstructionOptions(quality="draft")
        settled = pipeline.resolve_options(self._options)
        require_stereo(handpiece, settled.stereo.pairing)
        self._settled, self._folder = settled, Path(folder)
        self._capture = Capture(handpiece=pipeline.apply_uncertainty(handpiece, settled), frames=(), source=source)
        self._given = handpiece
        self._sized = pipeline.resize_for_quality(self._capture, settled)
        self._estimator = DepthEstimator(self._sized.handpiece, settled.stereo)
        detail, fusion = detail_mm(self._sized.handpiece), pipeline.fusion_for(self._sized.handpiece, settled)
        self._surface, self._voxel_mm = GrowingSurface(detail, fusion), fusion.voxel_for(detail)
        self._tracker = Tracker(self._capture.handpiece, settled.tracking, self._find_again)
        self._ranks = Counter[str | None]()
        self._every_second = set[str]()
        """Frames whose depth is measured where they are placed: the same ones as in the reconstruction at the end."""
        self._shown = dict[str, Rigid3]()
        """The frames whose depth is in the surface, and where it was put."""

    @property
    def frames(self) -> tuple[Frame, ...]:
        """Those that came in and could be read."""
        return self._capture.frames

    @property
    def capture(self) -> Capture:
        """What came in, with the handpiece as it was given."""
        return replace(self._capture, handpiece=self._given)

    @property
    def handpiece(self) -> Handpiece:
        """As it was given."""
        return self._given

    @property
    def rig_from_world(self) -> Mapping[str, Rigid3]:
        """Where those frames were that could be placed."""
        return self._tracker.rig_from_world

    def push(self, frame: Frame) -> Step:
        """Take the next frame. One whose images cannot be used is left out, with the reason.

        Raises InputError where the first frames show no texture, but plain surfaces.
        """
        begin = time.perf_counter()
        try:
            plain = not self.rig_from_world and self._is_plain(frame)
            features = {} if plain else self._features(frame)
        except InputError as error:
            placed = self._left_out(frame, str(error))
        else:
            if plain:
                raise InputError(f"frame {frame.name}: {_PLAIN}")
            placed = self._place_frame(frame, features)
        return Step(
            frame=frame.name,
            rig_from_world=placed.rig_from_world,
            reason=placed.reason,
            changed=self._surface.pop_changes(),
            seconds=time.perf_counter() - begin,
        )

    def correct(self, *, progress: Progress = silent) -> Mapping[int, Mesh]:
        """Adjust the poses of all frames so far together; what that changed of the surface.

        Raises ReconstructionError where too few of them can be placed; nothing is changed then.
        """
        if not self.frames:
            return {}
        found = pipeline.find_poses(self.capture, self._folder, self._options, progress=progress)
        self._tracker.correct(found.rig_from_world)
        for frame in self.frames:
            self._set_pose(frame, found.rig_from_world.get(frame.name))
        return self._surface.pop_changes()

    def missing(self) -> Float[np.ndarray, "n 3"]:
        """Places (mm) on the rims of the holes in the surface."""
        return self._surface.hole_rims()

    def finish(self, *, progress: Progress = silent) -> tuple[Reconstruction, Mesh]:
        """The reconstruction of everything that came in. Raises ReconstructionError where that is too little."""
        if not self.frames:
            raise ReconstructionError("session: no frame has come in")
        return pipeline.reconstruct(self.capture, self._folder, self._options, progress=progress)

    def _place_frame(self, frame: Frame, features: Mapping[tuple[str, str], Features]) -> Placed:
        placed = self._tracker.push(frame.name, features)
        self._capture = replace(self._capture, frames=(*self.frames, frame))
        self._ranks[frame.lighting] += 1
        if self._ranks[frame.lighting] % 2 == 1:
            self._every_second.add(frame.name)
        self._set_pose(frame, placed.rig_from_world)
        return placed

    def _is_plain(self, frame: Frame) -> bool:
        if self._options.signal != "auto":
            return self._options.signal == "shading"
        return not shows_detail(replace(self._capture, frames=(frame,)))

    def _features(self, frame: Frame) -> Mapping[tuple[str, str], Features]:
        one = replace(self._capture, frames=(frame,))
        cache = self._folder / "motion" / "cache"
        return detect_all(Pictures(one, max_bytes=0), self._settled.tracking.sought, cache=cache)

    def _find_again(self, name: str) -> Mapping[tuple[str, str], Features]:
        return self._features(next(frame for frame in self.frames if frame.name == name))

    def _set_pose(self, frame: Frame, rig_from_world: Rigid3 | None) -> None:
        """Have the depth of a frame at a place in the surface, and nowhere else."""
        if frame.name not in self._every_second:
            return
        before = self._shown.get(frame.name)
        if before is not None and rig_from_world is not None and not self._far(before, rig_from_world):
            return
        if before is None and rig_from_world is None:
            return
        depths = self._depths(frame)
        if before is not None:
            self._surface.take_out(depths, before)
            del self._shown[frame.name]
        if rig_from_world is not None:
            self._surface.add(depths, rig_from_world)
            self._shown[frame.name] = rig_from_world

    def _far(self, before: Rigid3, after: Rigid3) -> bool:
        """Whether the surface of a frame would move."""
        motion = before @ after.inverse()
        distance_mm = self._given.working_distance_mm
        moved_mm = np.linalg.norm(motion.translation) + distance_mm * np.linalg.norm(motion.rotation_vector)
        return bool(moved_mm > _MOVED_VOXELS * self._voxel_mm)

    def _depths(self, frame: Frame) -> list[DepthMap]:
        one = replace(self._sized, frames=(frame,))  # measured anew at the end, with the calibration that is found
        stored: StoredDepthMaps = measure_depth(
            one, self._folder / "live", self._settled.stereo, estimator=self._estimator
        )
        return list(stored)

    def _left_out(self, frame: Frame, reason: str) -> Placed:
        dropped = Dropped(what=f"frame {frame.name}", reason=reason)
        self._capture = replace(self._capture, left_out=(*self._capture.left_out, dropped))
        return Placed(rig_from_world=None, beside=None, reason=reason)
