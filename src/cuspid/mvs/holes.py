"""Where depth left holes, and which images would fill them.

The sparse points of the motion represent the surface: they are spread evenly over the images, and also lie where only
one camera of a group sees it. They are too few to represent a narrow strip, such as the slope of a cusp; there, the
places that a coarse fusion leaves open represent it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.reconstruction import DepthMap, Reconstruction, SurfacePoints, Tracks
from cuspid.runtime.workers import map_ahead, map_in_threads

Image = tuple[str, str]
"""Names of a frame and of one of its cameras."""
_STEEPEST_DEG = 70.0
"""Largest angle between the line of sight and the normal of a place that is worth another look."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """Which sparse points each image shows."""

    points: Float[np.ndarray, "p 3"]
    """Sparse points in the world frame, mm."""
    shown: Mapping[Image, Int[np.ndarray, "_"]]
    """Indices of the points in each image, ascending."""

    @staticmethod
    def of(found: Reconstruction, tracks: Tracks) -> Sightings:
        """The sightings in the sparse model of a reconstruction."""
        cameras = found.rig.names
        seen = np.unique(
            np.stack([tracks.frame_index * len(cameras) + tracks.camera_index, tracks.point_index], axis=1), axis=0
        )
        images, starts = np.unique(seen[:, 0], return_index=True)
        parts = np.split(seen[:, 1], starts[1:])
        named = [(found.frames[image // len(cameras)], cameras[image % len(cameras)]) for image in images]
        return Sightings(tracks.points, dict(zip(named, parts, strict=True)))

    def both(self, one: Image, other: Image) -> Int[np.ndarray, "_"]:
        """Points that two images show."""
        return np.intersect1d(self.shown.get(one, ()), self.shown.get(other, ()), assume_unique=True).astype(np.int64)

    def in_stereo(self, frame: str, cameras: Sequence[str]) -> Int[np.ndarray, "_"]:
        """Points that at least two of the given cameras show in a frame."""
        shown = [self.shown[frame, camera] for camera in cameras if (frame, camera) in self.shown]
        points, count = np.unique(np.concatenate([np.zeros(0, np.int64), *shown]), return_counts=True)
        return points[count >= 2]

    def count_confirmations(
        self, depth_maps: Iterable[DepthMap], rig_from_world: Mapping[str, Rigid3], agreement_mm: float
    ) -> Int[np.ndarray, "p"]:
        """For each point, the number of depth maps of located frames that have it on their surface, whether or not
        their image shows it (keypoints come and go)."""

        def on_surface(depth_map: DepthMap) -> Bool[np.ndarray, "p"]:
            cam_from_world = depth_map.cam_from_rig @ rig_from_world[depth_map.frame]
            return _on_surface(depth_map, cam_from_world.apply(self.points), agreement_mm)

        count = np.zeros(len(self.points), dtype=np.int64)
        for points in map_ahead(on_surface, (each for each in depth_maps if each.frame in rig_from_world)):
            count += points
        return count


def _on_surface(depth_map: DepthMap, in_cam: Float[np.ndarray, "n 3"], agreement_mm: float) -> Bool[np.ndarray, "n"]:
    """Which points in the frame of its camera lie on the surface of a depth map."""
    pixels = depth_map.camera.project(in_cam)  # NaN behind the camera
    on = depth_map.camera.contains(pixels, 1e-6)
    column, row = pixels[on].astype(np.int64).T
    near = np.abs(depth_map.depth_mm[row, column] - in_cam[on, 2]) < agreement_mm
    on[on] = near & depth_map.known[row, column]
    return on


@dataclass(frozen=True, eq=False)
class Views:
    """Which of some places on a surface each image shows."""

    count: int
    """Number of places."""
    shown: Mapping[Image, Bool[np.ndarray, "p"]]

    @staticmethod
    def of(
        places: SurfacePoints,
        found: Reconstruction,
        images: Iterable[Image],
        depth_maps: Iterable[DepthMap],
        agreement_mm: float,
    ) -> Views:
        """The views of images of located frames. A place is hidden by a depth that is nearer by more than
        ``agreement_mm``; if an image has no depth map, nothing is hidden."""

        def by_depth(depth_map: DepthMap) -> tuple[Image, Bool[np.ndarray, "p"]]:
            cam_from_world = depth_map.cam_from_rig @ found.rig_from_world[depth_map.frame]
            shows = _facing(places, depth_map.camera, cam_from_world)
            shows[shows] = ~_hidden(depth_map, cam_from_world.apply(places.points[shows]), agreement_mm)
            return (depth_map.frame, depth_map.camera_name), shows

        def without_depth(image: Image) -> tuple[Image, Bool[np.ndarray, "p"]]:
            mounted = found.rig[image[1]]
            return image, _facing(places, mounted.camera, mounted.cam_from_rig @ found.rig_from_world[image[0]])

        shown = dict(map_ahead(by_depth, (each for each in depth_maps if each.frame in found.rig_from_world)))
        return Views(len(places.points), shown | dict(map_in_threads(without_depth, set(images) - set(shown))))

    def both(self, one: Image, other: Image) -> Int[np.ndarray, "_"]:
        """Indices of the places that two images show."""
        return np.flatnonzero(self.shown[one] & self.shown[other])


def _facing(places: SurfacePoints, camera: Camera, cam_from_world: Rigid3) -> Bool[np.ndarray, "p"]:
    """Which places lie in the image of a camera and are not turned too far away from it."""
    towards = cam_from_world.inverse().translation - places.points
    cosine = np.sum(towards * places.normals, axis=1) / np.linalg.norm(towards, axis=1)
    inside = camera.contains(camera.project(cam_from_world.apply(places.points)), 1e-6)
    return np.asarray(inside & (cosine > np.cos(np.deg2rad(_STEEPEST_DEG))))


def _hidden(depth_map: DepthMap, in_cam: Float[np.ndarray, "n 3"], agreement_mm: float) -> Bool[np.ndarray, "n"]:
    """Which points in the frame of its camera, all in its image, lie behind the surface of a depth map."""
    column, row = depth_map.camera.project(in_cam).astype(np.int64).T
    nearer = depth_map.depth_mm[row, column] < in_cam[:, 2] - agreement_mm
    return np.asarray(nearer & depth_map.known[row, column])


def greedy_cover(
    candidates: Sequence[Int[np.ndarray, "_"]], count: int, left: float = 0, *, least: int = 1
) -> list[int]:
    """Indices (ascending) of sets of points, out of ``count``, that cover what all sets cover together, except for at
    most ``left`` points: greedily the set that adds most, as long as it adds at least ``least`` (>= 1)."""
    missing = np.zeros(count, dtype=bool)
    for points in candidates:
        missing[points] = True
    gain = np.array([len(points) for points in candidates], dtype=np.int64)
    taken: list[int] = []
    while missing.sum() > left:
        best = int(gain.argmax())
        if gain[best] < least:
            break
        # Gains only fall: the best of the old ones that keeps its gain is the best.
        now = int(missing[candidates[best]].sum())
        if now == gain[best]:
            taken.append(best)
            missing[candidates[best]] = False
            now = 0
        gain[best] = now
    return sorted(taken)
