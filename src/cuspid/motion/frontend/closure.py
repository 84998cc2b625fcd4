"""Loop closure: images that see the same surface again, long after the tracks of the first pass have ended."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.spatial import KDTree

from cuspid.geometry import Rigid3
from cuspid.model.reconstruction import Tracks
from cuspid.model.rig import Handpiece

Image = tuple[int, str]
"""Index of a frame, and a camera name."""

_LARGEST_ANGLE_DEG = 25.0
_LARGEST_SHIFT = 0.4
"""Largest distance between the places that two images look at, as a share of the smaller side of what an image sees."""
_PARTNERS = 2
"""Number of other images, the nearest ones, with which an image is matched again."""


def closing_pairs(handpiece: Handpiece, poses: Sequence[Rigid3], tracks: Tracks) -> list[tuple[Image, Image]]:
    """Pairs of images that see the same surface from about the same side, although no track connects their frames."""
    names = handpiece.rig.names
    images = [(frame, camera) for frame in range(len(poses)) for camera in names]
    looked_at, axes = _looks(handpiece, poses)
    frame = np.repeat(np.arange(len(poses)), len(names))
    reach_mm = _LARGEST_SHIFT * _seen_mm(handpiece)
    near = KDTree(looked_at).query_pairs(reach_mm, output_type="ndarray")
    alike = np.einsum("ij,ij->i", axes[near[:, 0]], axes[near[:, 1]]) > np.cos(np.deg2rad(_LARGEST_ANGLE_DEG))
    near = near[alike & ~_share_tracks(tracks, len(poses))[frame[near[:, 0]], frame[near[:, 1]]]]
    apart_mm = np.linalg.norm(looked_at[near[:, 0]] - looked_at[near[:, 1]], axis=1)
    return [(images[i], images[j]) for i, j in near[_nearest(near, apart_mm)].tolist()]


def _looks(handpiece: Handpiece, poses: Sequence[Rigid3]) -> tuple[Float[np.ndarray, "i 3"], Float[np.ndarray, "i 3"]]:
    """Where each image looks at in the working distance, and its axis, frame by frame, in the world."""
    mounted = handpiece.rig.cameras.values()
    axes = np.array([each.axis_in_rig for each in mounted])
    points = np.array([each.centre_in_rig for each in mounted]) + handpiece.working_distance_mm * axes
    world_from_rig = [pose.inverse() for pose in poses]
    return (
        np.concatenate([each.apply(points) for each in world_from_rig]),
        np.concatenate([each.rotate(axes) for each in world_from_rig]),
    )


def _seen_mm(handpiece: Handpiece) -> float:
    """The smaller side of what an image sees in the working distance; the median over the cameras."""
    cameras = [mounted.camera for mounted in handpiece.rig.cameras.values()]
    shares = [min(each.width / each.focal_px[0], each.height / each.focal_px[1]) for each in cameras]
    return handpiece.working_distance_mm * float(np.median(shares))


def _share_tracks(tracks: Tracks, frames: int) -> Bool[np.ndarray, "f f"]:
    """Whether some track joins two frames."""
    seen = coo_array(
        (np.ones(len(tracks.frame_index), np.int64), (tracks.frame_index, tracks.point_index)),
        shape=(frames, len(tracks.points)),
    ).tocsr()
    return np.asarray((seen @ seen.T).toarray() > 0)


def _nearest(pairs: Int[np.ndarray, "p 2"], apart_mm: Float[np.ndarray, "p"]) -> Int[np.ndarray, "k"]:
    """The pairs that are among the nearest of either of their images."""
    images = np.concatenate([pairs[:, 0], pairs[:, 1]])
    which = np.tile(np.arange(len(pairs)), 2)
    order = np.lexsort((which, np.tile(apart_mm, 2), images))
    starts = np.searchsorted(images[order], images[order])
    first = np.arange(len(order)) - starts < _PARTNERS
    return np.unique(which[order[first]])
