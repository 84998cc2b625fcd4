"""Which images are compared to find a surface: frames of one camera, or cameras of one instant."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import UInt8

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.capture import Frame
from cuspid.model.reconstruction import Reconstruction
from cuspid.model.rig import Handpiece, Sensor
from cuspid.model.sparse_model import SparseModel

_REACH = 14
"""How many frames later a partner may be."""
_METERED, _USUAL_DN = 40, (40, 230)
"""Images of each camera whose brightness is compared, and grey levels that are."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Compared:
    """Images, where they were taken from, and which of them are compared."""

    names: tuple[str, ...]
    """By which the images are read, in order of capture."""
    cameras: tuple[Camera, ...]
    cam_from_world: tuple[Rigid3, ...]
    pairs: tuple[tuple[int, int], ...]
    """Each a stereo baseline apart; a later image is second."""
    baseline_share: float
    """Baseline as a share of the distance to the teeth (approximate)."""
    gammas: tuple[float, ...]
    """Exponent of the tone curve of each image."""
    same_lights: bool
    """Whether the two images of a pair were taken at one instant: a place is then as bright in one as in the other."""

    def in_world(self, world_from_new: Rigid3) -> Compared:
        """The same in another world."""
        return replace(self, cam_from_world=tuple(pose @ world_from_new for pose in self.cam_from_world))


def frames_beside(motion: SparseModel, share: float) -> Compared:
    """The frames of one camera, each with a later one a stereo baseline from it."""
    names = motion.frames
    poses = tuple(motion.cam_from_world.values())
    return Compared(
        names=names,
        cameras=(motion.camera,) * len(names),
        cam_from_world=poses,
        pairs=tuple(partners(motion, share).items()),
        baseline_share=share,
        gammas=(Sensor().gamma,) * len(names),
        same_lights=False,
    )


def cameras_beside(
    found: Reconstruction, frames: Iterable[Frame], pairs: Sequence[tuple[str, str]], handpiece: Handpiece
) -> Compared:
    """The images that two cameras of a rig took of the teeth at one instant, named ``camera/frame``. The same lights
    were on for both, so that their light and shade are of the surface."""
    located = [frame for frame in frames if frame.name in found.rig_from_world]
    together = [
        ((frame.name, one), (frame.name, other))
        for frame in located
        for one, other in pairs
        if one in frame.cameras and other in frame.cameras
    ]
    images = sorted({image for pair in together for image in pair}, key=_capture_order(located, found.rig.names))
    place = {image: number for number, image in enumerate(images)}
    apart = [np.linalg.norm(np.diff([found.rig[name].centre_in_rig for name in pair], axis=0)) for pair in pairs]
    return Compared(
        names=tuple(f"{name}/{frame}" for frame, name in images),
        cameras=tuple(found.rig[name].camera for _, name in images),
        cam_from_world=tuple(found.rig[name].cam_from_rig @ found.rig_from_world[frame] for frame, name in images),
        pairs=tuple((place[one], place[other]) for one, other in together),
        baseline_share=float(np.median(apart)) / handpiece.working_distance_mm,
        gammas=tuple(handpiece.sensor_of(name).gamma for _, name in images),
        same_lights=True,
    )


def _capture_order(frames: Sequence[Frame], cameras: Sequence[str]) -> Callable[[tuple[str, str]], tuple[int, int]]:
    """Sorts images, each by the names of its frame and its camera, in order of capture."""
    frame_of = {frame.name: number for number, frame in enumerate(frames)}
    return lambda image: (frame_of[image[0]], cameras.index(image[1]))


def partners(motion: SparseModel, share: float) -> dict[int, int]:
    """For each frame that has one a later frame beside it, whose baseline is nearest to ``share`` of the distance to
    the points (within a factor 1.8), mostly sideways, looking in about the same direction."""
    poses = [pose.inverse() for pose in motion.cam_from_world.values()]
    centres = np.array([pose.translation for pose in poses])
    axes = np.array([pose.rotation[:, 2] for pose in poses])
    baseline = share * float(np.median(motion.depths))
    found: dict[int, int] = {}
    for one in range(len(poses) - 1):
        others = np.arange(one + 1, min(one + 1 + _REACH, len(poses)))
        shift, axis = centres[others] - centres[one], axes[others] + axes[one]
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        along = np.sum(shift * axis, axis=1)
        sideways = np.linalg.norm(shift - along[:, None] * axis, axis=1)
        off = np.abs(np.log(np.maximum(sideways, 1e-9) / baseline))
        alike = (sideways >= 2 * np.abs(along)) & (axes[others] @ axes[one] > np.cos(np.deg2rad(20)))
        off[~alike] = np.inf
        if off.min() < np.log(1.8):
            found[one] = int(others[off.argmin()])
    return found


def camera_gains(names: Sequence[str], read: Callable[[str], UInt8[np.ndarray, "h w 3"]]) -> dict[str, float]:
    """How much brighter each camera shows the same surface than the first one, from images ``camera/frame`` in order of
    capture: cameras of one instant see about the same, under the same lights."""
    images = dict[str, list[str]]()
    for name in names:
        images.setdefault(name.rpartition("/")[0], []).append(name)
    instants = slice(None, None, max(1, len(names) // len(images) // _METERED))
    levels = {camera: np.log([_usual_level(read(name)) for name in each[instants]]) for camera, each in images.items()}
    first = next(iter(levels.values()))
    ratios = {camera: each - first for camera, each in levels.items()}
    return {c: float(np.exp(np.nanmedian(each))) if np.isfinite(each).any() else 1.0 for c, each in ratios.items()}


def _usual_level(image: UInt8[np.ndarray, "h w 3"]) -> float:
    """Mean grey level of what is neither dark nor burnt out; NaN where there is nothing."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[::4, ::4]
    usual = gray[(gray > _USUAL_DN[0]) & (gray < _USUAL_DN[1])]
    return float(usual.mean()) if len(usual) else float("nan")
