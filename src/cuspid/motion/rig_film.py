"""Where a handpiece of two or more cameras was that films bare teeth by hand: as :mod:`cuspid.motion.location`, on
contrast-normalised images with many weak keypoints.

Cameras of one instant see the same lights, and know how far they are apart: the scale is theirs, and does not drift
along the arch, as it does for one camera alone.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import UInt8

from cuspid.model.capture import Capture, ImageSource
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import Reconstruction, select_tracks
from cuspid.model.sparse_model import SparseModel
from cuspid.motion.bundle.adjustment import adjust
from cuspid.motion.frontend.patches import PatchOptions, are_connected, follow_rig_points
from cuspid.motion.location import MotionOptions, add_advice, locate
from cuspid.motion.monocular.single import ENAMEL, SingleOptions, normalise_contrast
from cuspid.runtime.errors import ReconstructionError
from cuspid.runtime.progress import Progress, silent


@dataclass(frozen=True, eq=False)
class _EvenContrast:
    """The images of another source with even local contrast. An :class:`cuspid.model.capture.ImageSource`."""

    source: ImageSource
    options: SingleOptions

    @property
    def suffix(self) -> str:
        return self.source.suffix

    def read(self, frame: str, camera: str) -> UInt8[np.ndarray, "h w 3"]:
        return np.dstack([normalise_contrast(self.source.read(frame, camera), self.options)] * 3)

    def size(self, frame: str, camera: str) -> tuple[int, int]:
        return self.source.size(frame, camera)

    def mask(self, frame: str, camera: str) -> UInt8[np.ndarray, "h w"] | None:
        return self.source.mask(frame, camera)

    def digest(self, frame: str, camera: str) -> str:
        return self.source.digest(frame, camera)

    def where(self, frame: str, camera: str) -> str:
        return self.source.where(frame, camera)


def film_options() -> MotionOptions:
    """The options of :func:`cuspid.motion.location.locate` for bare teeth. Their tracks are short and uncertain: many
    are needed."""
    return MotionOptions(features=ENAMEL, cell_px=16.0, reach=4)


def locate_rig_film(
    capture: Capture, options: MotionOptions, contrast: SingleOptions, *, progress: Progress = silent
) -> Reconstruction:
    """Metric poses of the frames, and the points that they see.

    Raises InputError where no two cameras see the same surface, and ReconstructionError where too few frames can be
    placed.
    """
    return locate(replace(capture, source=_EvenContrast(capture.source, contrast)), options, progress=progress)


def surface_patches() -> PatchOptions:
    """The options of :func:`refine_rig_on_surface`. The path is true to scale already: what is found farther away is
    wrong more often than not."""
    return PatchOptions(radius_px=5, limit_px=1.5)


def refine_rig_on_surface(
    found: Reconstruction,
    surface: Mesh,
    capture: Capture,
    options: MotionOptions,
    contrast: SingleOptions,
    patches: PatchOptions,
    *,
    progress: Progress = silent,
) -> Reconstruction | None:
    """What :func:`locate_rig_film` found, with its points followed over the surface that the frames show, in its world,
    and all adjusted to that; None where too few are found to hold a frame, or what lies before one and behind it,
    together, or to agree on the poses."""
    source = _EvenContrast(capture.source, contrast)

    def read(frame: str, camera: str) -> UInt8[np.ndarray, "h w"]:
        return source.read(frame, camera)[..., 0]

    followed = follow_rig_points(found, read, patches, surface=surface, progress=progress)
    least = options.odometry.min_matches
    if not are_connected(followed, len(found.frames), least):
        return None
    rig = capture.handpiece.rig.in_own_order()
    start = replace(found, tracks=followed, notes=()).with_cameras_as(rig.names)
    try:
        # The calibration as it was given: the images have told once what they know of it.
        adjusted = adjust(replace(start, rig=rig), options.adjustment)
    except ReconstructionError:
        return None
    return add_advice(adjusted, least).with_cameras_as(found.rig.names)


def trajectory_of_camera(found: Reconstruction, camera: str, frames: Collection[str]) -> SparseModel:
    """The trajectory of one camera of the handpiece over those of the frames that were located, and the points that it
    sees there; in millimetres."""
    assert found.tracks is not None
    tracks, mounted = found.tracks, found.rig[camera]
    has = np.array([name in frames for name in found.frames], dtype=bool)
    mine = (tracks.camera_index == found.rig.names.index(camera)) & has[tracks.frame_index]
    seen = select_tracks(tracks, mine)
    return SparseModel(
        camera=mounted.camera,
        cam_from_world={
            name: mounted.cam_from_rig @ pose for name, pose in found.rig_from_world.items() if name in frames
        },
        tracks=replace(
            seen,
            frame_index=(np.cumsum(has) - 1)[seen.frame_index],
            camera_index=np.zeros(len(seen.camera_index), np.int64),
        ),
    )
