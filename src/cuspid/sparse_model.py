"""What one camera tells about its trajectory and the surface: without scale, hence a model in its own units of length.

Frames: ``cam`` is the frame of the camera; the world frame is arbitrary.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from cuspid.camera import Camera
from cuspid.errors import ReconstructionError
from cuspid.geometry import Rigid3
from cuspid.reconstruction import Tracks


@dataclass(frozen=True, eq=False, kw_only=True)
class SparseModel:
    """Located frames of one camera and the points that they see. Its lengths are in its own unit, until they are
    :meth:`scaled` to millimetres from other knowledge."""

    camera: Camera
    """Refined calibration (the given one if it was held fixed)."""
    cam_from_world: Mapping[str, Rigid3]
    """Pose of each located frame, in the order of capture; translations in units of the model."""
    tracks: Tracks
    """The points, in units of the model, and where they were seen; the camera is always number 0."""
    reprojection_rms_px: float | None = None
    """RMS reprojection error, if the model was adjusted."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "cam_from_world", MappingProxyType(dict(self.cam_from_world)))

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the located frames."""
        return tuple(self.cam_from_world)

    @property
    def depths(self) -> Float[np.ndarray, "o"]:
        """Depth (Z) in the camera of the point of every observation, in units of the model. Raises ReconstructionError
        if there is none."""
        tracks = self.tracks
        if not len(tracks.point_index):
            raise ReconstructionError("motion: the frames share no consistent points; more surface detail is needed")
        axes = np.stack([pose.rotation[2] for pose in self.cam_from_world.values()])
        shifts = np.array([pose.translation[2] for pose in self.cam_from_world.values()])
        along = np.einsum("oj,oj->o", axes[tracks.frame_index], tracks.points[tracks.point_index])
        return np.asarray(along + shifts[tracks.frame_index])

    def scaled(self, scale: float) -> SparseModel:
        """The same model in a unit that is smaller by this factor."""
        poses = {name: Rigid3(pose.rotation, scale * pose.translation) for name, pose in self.cam_from_world.items()}
        return replace(self, cam_from_world=poses, tracks=replace(self.tracks, points=scale * self.tracks.points))
