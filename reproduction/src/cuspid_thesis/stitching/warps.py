"""Features of normal maps, and warps between frames: one homography, and one for each segment (thesis 4.1, 4.2).

Frames: pixels are COLMAP's, of frames without distortion. ``target_from_source`` homographies have a positive
determinant, so that points before the horizon have a positive third coordinate.

The weighted direct linear transformation finds, for a place c, the homography H that minimises
sum_i w_i(c)^2 |A_i h|^2 with |h| = 1, where the two rows of A_i say that H takes a point to its match (Zaragoza, Chin,
Brown and Suter, CVPR 2013). The thesis takes connected segments of the normal map for cells, c for their centroids, and
weights inversely proportional to the distance from c; as in that paper, no weight falls below a floor, which holds
segments without features to the homography of the whole frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Float, Int, Int16
from skimage.segmentation import felzenszwalb

from cuspid.model.camera import OPENCV_PIXEL_OFFSET
from cuspid.runtime.options import Options, Range

SEGMENT_PX = 4
"""Segments are found on a normal map that is smaller by this factor."""


@dataclass(frozen=True, kw_only=True)
class WarpOptions(Options):
    """Features, matches and warps."""

    kaze_threshold: Annotated[float, Range(1e-09, 1)] = 1e-4
    """Detector response above which KAZE accepts a point of the grey normal map."""
    features: Annotated[int, Range(10, 1_000_000)] = 2000
    """Maximum number of features in a frame; the strongest are kept."""
    ratio: Annotated[float, Range(0.01, 1)] = 0.8
    """A match must be nearer than the second best by this factor (ratio test)."""
    error_px: Annotated[float, Range(0.01, 1000)] = 3.0
    """Distance in px within which a match is consistent with a homography."""
    min_inliers: Annotated[int, Range(5, 100_000)] = 12
    """Minimum number of consistent matches."""
    near_px: Annotated[float, Range(0.01, 100_000)] = 40.0
    """A match has full weight up to this distance from a segment's centroid; beyond, its weight falls inversely with
    distance."""
    floor: Annotated[float, Range(1e-06, 1)] = 0.05
    """Minimum weight of a match (1 makes every segment follow the homography of the frame)."""
    segment_px: Annotated[int, Range(1, 100_000_000)] = 2500
    """Smallest area of a segment of the normal map, px."""
    segment_scale: Annotated[float, Range(0.01, 1_000_000)] = 100.0
    """Larger values make larger segments (Felzenszwalb and Huttenlocher 2004)."""


@dataclass(frozen=True, eq=False)
class Points:
    """Features of one frame."""

    pixels: Float[np.ndarray, "n 2"]
    """Places, px."""
    descriptors: Float[np.ndarray, "n d"]
    """KAZE descriptors, float32."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Link:
    """How a frame lies to the one before it."""

    fixed_from_moving: Float[np.ndarray, "3 3"]
    """Homography from RANSAC."""
    moving: Float[np.ndarray, "n 2"]
    """Matches that agree with it: px in the moving frame."""
    fixed: Float[np.ndarray, "n 2"]
    """Their px in the fixed frame."""


def find_points(grey: Float[np.ndarray, "h w"], options: WarpOptions) -> Points:
    """KAZE features of a grey normal map."""
    detector = cv2.KAZE.create(threshold=options.kaze_threshold)
    found, descriptors = detector.detectAndCompute(grey, None)
    if not found:
        return Points(np.zeros((0, 2)), np.zeros((0, 64), np.float32))
    best = np.argsort([-point.response for point in found], kind="stable")[: options.features]
    pixels = np.array([found[index].pt for index in best]) + OPENCV_PIXEL_OFFSET
    return Points(pixels, descriptors[best])


def find_segments(normal_map: Float[np.ndarray, "h w 3"], options: WarpOptions) -> Int16[np.ndarray, "r c"]:
    """Connected segments of like normals, numbered from 0, on a grid `SEGMENT_PX` times as coarse."""
    size = (normal_map.shape[1] // SEGMENT_PX, normal_map.shape[0] // SEGMENT_PX)
    small = cv2.resize(normal_map, size, interpolation=cv2.INTER_AREA)
    least = max(1, options.segment_px // SEGMENT_PX**2)
    return np.asarray(felzenszwalb(small, scale=options.segment_scale, sigma=0, min_size=least), dtype=np.int16)


def centroids(segments: Int16[np.ndarray, "r c"]) -> Float[np.ndarray, "k 2"]:
    """Centroid of each segment in px of the frame."""
    rows, columns = np.indices(segments.shape)
    count = np.bincount(segments.ravel())
    sums = [np.bincount(segments.ravel(), axis.ravel() + 0.5) for axis in (columns, rows)]
    return SEGMENT_PX * np.stack(sums, axis=1) / count[:, None]


def match(moving: Points, fixed: Points, ratio: float) -> Int[np.ndarray, "m 2"]:
    """Pairs of indices that pass the ratio test, each the other's nearest."""
    if len(moving.pixels) < 2 or len(fixed.pixels) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    matcher = cv2.BFMatcher()
    pairs = matcher.knnMatch(moving.descriptors, fixed.descriptors, k=2)
    back = {pair.queryIdx: pair.trainIdx for pair in matcher.match(fixed.descriptors, moving.descriptors)}
    good = [
        (best.queryIdx, best.trainIdx)
        for best, second in pairs
        if best.distance < ratio * second.distance and back[best.trainIdx] == best.queryIdx
    ]
    return np.array(good, dtype=np.int64).reshape(-1, 2)


def link(moving: Points, fixed: Points, options: WarpOptions) -> Link | None:
    """The homography that most matches agree with, or None where they are too few."""
    pairs = match(moving, fixed, options.ratio)
    if len(pairs) < options.min_inliers:
        return None
    source, target = moving.pixels[pairs[:, 0]], fixed.pixels[pairs[:, 1]]
    found, inlier = cv2.findHomography(source, target, cv2.RANSAC, options.error_px, maxIters=2000, confidence=0.999)
    if found is None or inlier.sum() < options.min_inliers or abs(np.linalg.det(found)) < 1e-12:
        return None
    keep = inlier.ravel() > 0
    return Link(fixed_from_moving=_upright(found), moving=source[keep], fixed=target[keep])


def _upright(homographies: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Scaled to a determinant of 1."""
    return np.asarray(homographies / np.cbrt(np.linalg.det(homographies))[..., None, None])


def location_weights(
    points: Float[np.ndarray, "n 2"], centres: Float[np.ndarray, "c 2"], options: WarpOptions
) -> Float[np.ndarray, "c n"]:
    """Weights of points as seen from centres: 1 nearby, then inverse to the distance, never below the floor."""
    distance = np.linalg.norm(points[None] - centres[:, None], axis=-1)
    return np.asarray(np.maximum(options.floor, options.near_px / np.maximum(distance, options.near_px)))


def weighted_dlt(
    source: Float[np.ndarray, "n 2"], target: Float[np.ndarray, "n 2"], weights: Float[np.ndarray, "c n"]
) -> Float[np.ndarray, "c 3 3"]:
    """Homographies ``target_from_source`` by the weighted direct linear transformation, one for each row of weights."""
    to_source, to_target = _normaliser(source), _normaliser(target)
    rows = _dlt_rows(_apply_affine(to_source, source), _apply_affine(to_target, target))
    squares = np.einsum("nri,nrj->nij", rows, rows)
    # The eigenvector of the least eigenvalue is the last right singular vector of the weighted rows.
    _, vectors = np.linalg.eigh(np.tensordot(weights**2, squares, axes=1))
    return _upright(np.linalg.inv(to_target) @ vectors[..., 0].reshape(-1, 3, 3) @ to_source)


def _normaliser(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "3 3"]:
    """Moves the centroid to 0 and the mean distance from it to sqrt(2) (Hartley 1997)."""
    centre = points.mean(axis=0)
    spread = np.linalg.norm(points - centre, axis=1).mean()
    scale = np.sqrt(2) / spread if spread > 0 else 1.0
    return np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1.0]])


def _apply_affine(matrix: Float[np.ndarray, "3 3"], points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    return points @ matrix[:2, :2].T + matrix[:2, 2]


def _dlt_rows(source: Float[np.ndarray, "n 2"], target: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2 9"]:
    """Two rows a match: (0, -x, v x) and (x, 0, -u x) for the target (u, v) and the homogeneous source x."""
    x = np.concatenate([source, np.ones((len(source), 1))], axis=1)
    zero = np.zeros_like(x)
    u, v = target[:, :1], target[:, 1:]
    return np.stack([np.hstack([zero, -x, v * x]), np.hstack([x, zero, -u * x])], axis=1)
