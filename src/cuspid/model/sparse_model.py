"""The trajectory and the surface as one camera reveals them: without scale, hence a model in its own units of length.

Frames: ``cam`` is the frame of the camera; the world frame is arbitrary.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.capture import Dropped
from cuspid.model.reconstruction import Tracks
from cuspid.runtime.errors import ReconstructionError


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
        return _depths(self.cam_from_world, self.tracks)

    def scaled(self, scale: float) -> SparseModel:
        """The same model in a unit that is smaller by this factor."""
        poses, tracks = _rescale(self.cam_from_world, self.tracks, scale)
        return replace(self, cam_from_world=poses, tracks=tracks)


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotoModel:
    """Located photographs and the points that they see, as :class:`SparseModel`, where a photograph may have its own
    focal length or size, and so its own camera."""

    cameras: Mapping[str, Camera]
    """Calibration by name."""
    camera_of: Mapping[str, str]
    """Name of the camera that took each located photograph."""
    cam_from_world: Mapping[str, Rigid3]
    """Pose of each located photograph, in the order of their names; translations in units of the model."""
    tracks: Tracks
    """The points, in units of the model, and where they were seen; cameras are numbered as in ``cameras``."""
    reprojection_rms_px: float | None = None
    """RMS reprojection error, if the model was adjusted."""
    dropped: tuple[Dropped, ...] = ()
    """Photographs that are not in the model, each with its reason."""
    log: Mapping[str, float | int] = field(default_factory=dict)
    """Counts, and durations of the stages in seconds."""
    notes: tuple[str, ...] = ()
    """What a user must know about it, one line each."""

    def __post_init__(self) -> None:
        for name in ("cameras", "camera_of", "cam_from_world"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the located photographs."""
        return tuple(self.cam_from_world)

    @property
    def depths(self) -> Float[np.ndarray, "o"]:
        """As :attr:`SparseModel.depths`."""
        return _depths(self.cam_from_world, self.tracks)

    def camera(self, frame: str) -> Camera:
        """The camera that took a photograph."""
        return self.cameras[self.camera_of[frame]]

    def scaled(self, scale: float) -> PhotoModel:
        """The same model in a unit that is smaller by this factor."""
        poses, tracks = _rescale(self.cam_from_world, self.tracks, scale)
        return replace(self, cam_from_world=poses, tracks=tracks)


@dataclass(frozen=True, kw_only=True)
class Scale:
    """How large things are, by other knowledge than the images of one camera."""

    mm_per_unit: float
    """Millimetres per unit of length of a model."""
    sigma_share: float
    """Standard deviation, as a share of it."""
    told_by: str
    """What it is from, for people."""
    residual_mm: float
    """RMS difference of what it is from (corners of a board, distances) after the scale was applied."""
    notes: tuple[str, ...] = ()
    """What a user must know about it, one line each."""


def _depths(cam_from_world: Mapping[str, Rigid3], tracks: Tracks) -> Float[np.ndarray, "o"]:
    if not len(tracks.point_index):
        raise ReconstructionError("motion: the frames share no consistent points; more surface detail is needed")
    axes = np.stack([pose.rotation[2] for pose in cam_from_world.values()])
    shifts = np.array([pose.translation[2] for pose in cam_from_world.values()])
    along = np.einsum("oj,oj->o", axes[tracks.frame_index], tracks.points[tracks.point_index])
    return np.asarray(along + shifts[tracks.frame_index])


def _rescale(cam_from_world: Mapping[str, Rigid3], tracks: Tracks, scale: float) -> tuple[dict[str, Rigid3], Tracks]:
    poses = {name: Rigid3(pose.rotation, scale * pose.translation) for name, pose in cam_from_world.items()}
    return poses, replace(tracks, points=scale * tracks.points)
