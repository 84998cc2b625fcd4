"""Images as they would be if all their rows had been exposed at the instants of their frames.

What a row shows a time t after that instant has moved in the image: by the motion v of the handpiece in the frame
(:mod:`cuspid.model.shutter`), and by the less the farther away it is. A pixel x with the depth z shows the point
``exp(-t v) rig_from_cam z ray(x)`` of the rig at the instant. Depth is that of the sparse points that the image shows,
interpolated between them: where the surface is 1 % farther away than that, what is left is 1 % of the shift.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.interpolate import RBFInterpolator

from cuspid.model.capture import Capture, ImageSource
from cuspid.model.reconstruction import Reconstruction, Tracks
from cuspid.model.rig import MountedCamera, Rig
from cuspid.model.shutter import PLAIN, displace_points, film_times, motions
from cuspid.runtime.image_files import Pixels
from cuspid.runtime.workers import computed_once

_FEWEST = 4
"""Points of an image that tell how deep it is."""
_SMOOTHING = 0.01
"""Of the interpolated depth, where places are shares of the width of the image."""
_GRID_PX = 12
"""Distance of the pixels whose shift is computed; it is interpolated between them."""
_ROUNDS = 4
"""How often a row is looked for whose time depends on the row."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Unrolling:
    """How one image is set right."""

    mounted: MountedCamera
    """Its camera."""
    motion: Float[np.ndarray, "6"]
    """How the handpiece moves in its frame."""
    places: Float[np.ndarray, "n 2"]
    """Where the image shows sparse points, px, and"""
    nearness: Float[np.ndarray, "n"]
    """the inverse of their depth there, 1/mm."""

    @computed_once
    def _field(self) -> RBFInterpolator:
        width = self.mounted.camera.width
        return RBFInterpolator(self.places / width, self.nearness, kernel="linear", smoothing=_SMOOTHING, degree=0)

    def depth_mm(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Along the axis of the camera, when the image was taken."""
        found = self._field(pixels / self.mounted.camera.width)
        return np.asarray(1 / np.clip(found, self.nearness.min(), self.nearness.max()))

    def at_instant(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Where what some pixels show is seen at the instant of the frame."""
        camera, cam_from_rig = self.mounted.camera, self.mounted.cam_from_rig
        late = self.mounted.shutter.late(pixels[:, 1] / camera.height)
        in_cam = camera.rays(pixels) * self.depth_mm(pixels)[:, None]
        in_rig = displace_points(cam_from_rig.inverse().apply(in_cam), self.motion, -late)
        there = camera.project(cam_from_rig.apply(in_rig))
        return np.where(np.isfinite(there), there, pixels)

    @computed_once
    def map_px(self) -> Float[np.ndarray, "h w 2"]:
        """For each pixel at the instant, where the image shows it (OpenCV's origin)."""
        width, height = self.mounted.camera.width, self.mounted.camera.height
        columns, rows = max(width // _GRID_PX, 2), max(height // _GRID_PX, 2)
        coarse = np.stack(
            np.meshgrid((np.arange(columns) + 0.5) * width / columns, (np.arange(rows) + 0.5) * height / rows), axis=-1
        )
        shifts = self.at_instant(coarse.reshape(-1, 2)).reshape(coarse.shape) - coarse
        fine = cv2.resize(shifts.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
        target = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
        source = target - fine
        for _ in range(_ROUNDS):
            source = target - cv2.remap(fine, source, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(source)

    @computed_once
    def digest(self) -> str:
        """SHA-256 of all that it depends on."""
        camera, pose, shutter = self.mounted.camera, self.mounted.cam_from_rig.matrix, self.mounted.shutter
        parts = (camera.parameters, pose, np.array([shutter.delay_frames, shutter.readout]), self.motion)
        return hashlib.sha256(
            b"".join(np.ascontiguousarray(p).tobytes() for p in (*parts, self.places, self.nearness))
        ).hexdigest()


@dataclass(frozen=True, eq=False)
class UnrolledImages:
    """The images of another source, set right. An :class:`ImageSource`."""

    rolled: ImageSource
    """The other source."""
    unrollings: Mapping[tuple[str, str], Unrolling]
    """By frame and camera; images without one stay as they are."""

    @property
    def suffix(self) -> str:
        """As :attr:`ImageSource.suffix`."""
        return self.rolled.suffix

    def read(self, frame: str, camera: str) -> Pixels:
        """As :meth:`ImageSource.read`."""
        image, unrolling = self.rolled.read(frame, camera), self.unrollings.get((frame, camera))
        if unrolling is None:
            return image
        return np.asarray(cv2.remap(image, unrolling.map_px, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))

    def size(self, frame: str, camera: str) -> tuple[int, int]:
        """As :meth:`ImageSource.size`."""
        return self.rolled.size(frame, camera)

    def mask(self, frame: str, camera: str) -> UInt8[np.ndarray, "h w"] | None:
        """As :meth:`ImageSource.mask`; what the image did not show does not count."""
        mask, unrolling = self.rolled.mask(frame, camera), self.unrollings.get((frame, camera))
        if unrolling is None:
            return mask
        whole = np.full(unrolling.map_px.shape[:2], 255, np.uint8) if mask is None else mask
        return np.asarray(cv2.remap(whole, unrolling.map_px, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT))

    def digest(self, frame: str, camera: str) -> str:
        """As :meth:`ImageSource.digest`."""
        digest, unrolling = self.rolled.digest(frame, camera), self.unrollings.get((frame, camera))
        return digest if unrolling is None else f"{digest} {unrolling.digest}"

    def where(self, frame: str, camera: str) -> str:
        """As :meth:`ImageSource.where`."""
        return self.rolled.where(frame, camera)


def is_rolling(rig: Rig, frames: Sequence[str]) -> bool:
    """Whether the shutters of cameras matter for frames: where they are those of a film."""
    return film_times(frames) is not None and not all(each.shutter.is_plain for each in rig.cameras.values())


def unrollings(found: Reconstruction) -> dict[tuple[str, str], Unrolling]:
    """Unrollings, by frame and camera, of the images that were not exposed at once at the instants of their frames and
    that show enough sparse points. Empty where the frames are no film."""
    rolling = [name for name in found.rig.names if not found.rig[name].shutter.is_plain]
    times, tracks = film_times(found.frames), found.tracks
    if not rolling or times is None or tracks is None:
        return {}
    moving = motions(tuple(found.rig_from_world.values()), times)
    images = tracks.frame_index * len(found.rig.names) + tracks.camera_index
    made = {}
    for f, frame in enumerate(found.frames):
        for name in rolling:
            seen = np.flatnonzero(images == f * len(found.rig.names) + found.rig.names.index(name))
            if len(seen) >= _FEWEST and moving[f].any():
                made[frame, name] = _unrolling(found, tracks, seen, frame, name, moving[f])
    return made


def _unrolling(
    found: Reconstruction,
    tracks: Tracks,
    seen: np.ndarray,
    frame: str,
    camera: str,
    motion: Float[np.ndarray, "6"],
) -> Unrolling:
    """From the points that an image shows."""
    mounted, pixels = found.rig[camera], tracks.pixels[seen]
    in_rig = found.rig_from_world[frame].apply(tracks.points[tracks.point_index[seen]])
    late = mounted.shutter.late(pixels[:, 1] / mounted.camera.height)
    depth = mounted.cam_from_rig.apply(displace_points(in_rig, motion, late))[:, 2]
    return Unrolling(mounted=mounted, motion=motion, places=pixels, nearness=1 / np.maximum(depth, 1e-9))


def unroll_capture(capture: Capture, found: Reconstruction) -> Capture:
    """A capture whose images show what they would if all rows had been exposed at the instants of their frames, and
    whose handpiece says so; the capture itself where they are."""
    made = unrollings(found)
    if not made:
        return capture
    plain = {name: replace(mounted, shutter=PLAIN) for name, mounted in capture.handpiece.rig.cameras.items()}
    handpiece = replace(capture.handpiece, rig=Rig(plain))
    return replace(capture, handpiece=handpiece, source=UnrolledImages(capture.source, made))
