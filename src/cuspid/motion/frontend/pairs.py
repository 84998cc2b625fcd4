"""Which images are matched, and guided matching where the geometry allows a match.

A keypoint of one image with a depth between two bounds lies on a segment of a line in another image whose relative
pose is known. Only the keypoints near that segment are compared: within a frame the rig gives the pose and the depth of
field the bounds; across frames the odometry gives the pose, and an already triangulated point narrow bounds.

*Ideal* coordinates are normalised, without distortion: (X/Z, Y/Z).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, no_type_check

import numpy as np
from jaxtyping import Float, Int

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.motion.frontend.features import DESCRIPTOR_NORM, Features
from cuspid.runtime.kernels import kernel
from cuspid.runtime.options import SHARE, Options, Range

_CELL_PX = 12.0
_NEAREST_SHARE = 0.01
"""The part of a segment that is nearer to the other camera than this share of its farthest depth is left out."""


@dataclass(frozen=True, kw_only=True)
class MatchingOptions(Options):
    """What counts as a match."""

    tolerance_px: Annotated[float, Range(0.01, 1000)] = 2.0
    """Largest distance from the epipolar segment, px."""
    similarity: Annotated[float, SHARE] = 0.8
    """Minimum cosine between two descriptors, 0 to 1."""
    ratio: Annotated[float, Range(0.01, 1)] = 0.85
    """Largest ratio of the distance to the best descriptor to that to the second best elsewhere (ratio test)."""
    apart_px: Annotated[float, Range(0, 1000)] = 3.0
    """A second-best keypoint closer than this to the best one, px, does not count as elsewhere."""


@dataclass(frozen=True, eq=False, kw_only=True)
class IndexedFeatures:
    """Keypoints of an image, sorted into cells for guided matching."""

    features: Features
    """The keypoints."""
    ideal: Float[np.ndarray, "n 2"]
    """Ideal coordinates of the keypoints."""
    focal_px: float
    """Converts ideal distances to px."""
    order: Int[np.ndarray, "n"]
    """Keypoints sorted by cell."""
    cell_starts: Int[np.ndarray, "m"]
    """Where each cell begins in ``order``."""
    grid: tuple[float, float, int, int]
    """Ideal coordinates of the grid's corner, px, and its number of columns and rows."""


def index_features(features: Features, camera: Camera) -> IndexedFeatures:
    """Undistort the keypoints and sort them into cells."""
    ideal = np.ascontiguousarray(camera.rays(features.pixels)[:, :2])
    focal = float(np.mean(camera.focal_px))
    corner = ideal.min(axis=0, initial=0.0) * focal
    cells = np.floor((ideal * focal - corner) / _CELL_PX).astype(np.int64)
    columns, rows = (cells.max(axis=0, initial=0) + 1).tolist()
    flat = cells[:, 1] * columns + cells[:, 0]
    order = np.argsort(flat, kind="stable")
    return IndexedFeatures(
        features=features,
        ideal=ideal,
        focal_px=focal,
        order=order,
        cell_starts=np.searchsorted(flat[order], np.arange(columns * rows + 1)),
        grid=(float(corner[0]), float(corner[1]), columns, rows),
    )


@kernel
@no_type_check
def _segment(ray, low, high, rotation, translation, focal, ends):
    """Ends in px, in the other image, of depth ``low`` to ``high`` on a ray. False if all of it lies behind."""
    turned = rotation @ np.array([ray[0], ray[1], 1.0])
    near, far = low * turned[2] + translation[2], high * turned[2] + translation[2]
    nearest = _NEAREST_SHARE * high
    if max(near, far) < nearest:
        return False
    if near < nearest:
        low = (nearest - translation[2]) / turned[2]
    if far < nearest:
        high = (nearest - translation[2]) / turned[2]
    for k, depth in enumerate((low, high)):
        z = depth * turned[2] + translation[2]
        ends[k, 0] = focal * (depth * turned[0] + translation[0]) / z
        ends[k, 1] = focal * (depth * turned[1] + translation[1]) / z
    return True


@kernel
@no_type_check
def _similarity(a, b):
    """Inner product of two byte descriptors."""
    total = np.int32(0)
    for k in range(a.shape[0]):
        total += np.int32(a[k]) * np.int32(b[k])
    return total


@kernel
@no_type_check
def _off_segment(x, y, ends, tolerance):
    """Whether a place is farther than ``tolerance`` from a segment."""
    dx, dy = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
    length2 = dx * dx + dy * dy
    along = 0.0
    if length2 > 0:
        along = min(max(((x - ends[0, 0]) * dx + (y - ends[0, 1]) * dy) / length2, 0.0), 1.0)
    return (x - ends[0, 0] - along * dx) ** 2 + (y - ends[0, 1] - along * dy) ** 2 > tolerance**2


@kernel
@no_type_check
def _candidates(ends, tolerance, ideal, focal, order, cell_starts, grid, out):
    """Keypoints within ``tolerance`` of a segment; their number."""
    corner_x, corner_y, columns, rows = grid
    count = 0
    first_row = max(int((min(ends[0, 1], ends[1, 1]) - tolerance - corner_y) // _CELL_PX), 0)
    last_row = min(int((max(ends[0, 1], ends[1, 1]) + tolerance - corner_y) // _CELL_PX), rows - 1)
    first_column = max(int((min(ends[0, 0], ends[1, 0]) - tolerance - corner_x) // _CELL_PX), 0)
    last_column = min(int((max(ends[0, 0], ends[1, 0]) + tolerance - corner_x) // _CELL_PX), columns - 1)
    reach = tolerance + 0.75 * _CELL_PX
    for row in range(first_row, last_row + 1):
        for column in range(first_column, last_column + 1):
            x, y = corner_x + (column + 0.5) * _CELL_PX, corner_y + (row + 0.5) * _CELL_PX
            if _off_segment(x, y, ends, reach):
                continue
            cell = row * columns + column
            for at in range(cell_starts[cell], cell_starts[cell + 1]):
                j = order[at]
                if not _off_segment(ideal[j, 0] * focal, ideal[j, 1] * focal, ends, tolerance):
                    out[count] = j
                    count += 1
    return count


@kernel
@no_type_check
def _best(descriptor, candidates, count, descriptors, ideal, apart, least, ratio):
    """The most similar candidate, or -1 where it is not similar or not distinct enough."""
    best, best_value, second = -1, np.int32(0), np.int32(0)
    for k in range(count):
        j = candidates[k]
        value = _similarity(descriptor, descriptors[j])
        near = best >= 0 and np.hypot(ideal[j, 0] - ideal[best, 0], ideal[j, 1] - ideal[best, 1]) < apart
        if value > best_value:
            if not near:
                second = best_value
            best, best_value = j, value
        elif value > second and not near:
            second = value
    unit = DESCRIPTOR_NORM**2
    if best_value < least * unit:
        return -1
    return best if max(unit - best_value, 0) < ratio**2 * (unit - second) else -1


@kernel
@no_type_check
def _match_one_way(a, b, low, high, rotation, translation, options):
    """For each keypoint of a the best one of b, or -1. ``a`` = (ideal, descriptors), ``b`` = those and the grid."""
    ideal_a, descriptors_a = a
    ideal_b, descriptors_b, focal, order, cell_starts, grid = b
    tolerance, least, ratio, apart = options
    ends, candidates = np.zeros((2, 2)), np.zeros(len(ideal_b), np.int64)
    found = np.full(len(ideal_a), -1)
    for i in range(len(ideal_a)):
        if not _segment(ideal_a[i], low[i], high[i], rotation, translation, focal, ends):
            continue
        count = _candidates(ends, tolerance, ideal_b, focal, order, cell_starts, grid, candidates)
        found[i] = _best(descriptors_a[i], candidates, count, descriptors_b, ideal_b, apart / focal, least, ratio)
    return found


def _match_guided(
    a: IndexedFeatures,
    b: IndexedFeatures,
    b_from_a: Rigid3,
    bounds_mm: tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]],
    options: MatchingOptions,
) -> Int[np.ndarray, "n"]:
    """For each keypoint of ``a`` its best match in ``b``, or -1."""
    return np.asarray(
        _match_one_way(
            (a.ideal, a.features.descriptors),
            (b.ideal, b.features.descriptors, b.focal_px, b.order, b.cell_starts, b.grid),
            *bounds_mm,
            b_from_a.rotation,
            b_from_a.translation,
            (options.tolerance_px, options.similarity, options.ratio, options.apart_px),
        )
    )


def _mutual(forward: Int[np.ndarray, "n"], backward: Int[np.ndarray, "m"]) -> Int[np.ndarray, "k 2"]:
    """Pairs of indices that chose each other."""
    first = np.flatnonzero(forward >= 0)
    first = first[backward[forward[first]] == first]
    return np.stack([first, forward[first]], axis=1)


def match_guided(
    a: IndexedFeatures,
    b: IndexedFeatures,
    b_from_a: Rigid3,
    bounds_a_mm: tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]],
    bounds_b_mm: tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]],
    options: MatchingOptions | None = None,
) -> Int[np.ndarray, "k 2"]:
    """Mutually best pairs of keypoints; the bounds are the least and greatest depth of each keypoint in its camera."""
    options = options or MatchingOptions()
    if not len(a.features) or not len(b.features):
        return np.zeros((0, 2), dtype=np.int64)
    forward = _match_guided(a, b, b_from_a, bounds_a_mm, options)
    return _mutual(forward, _match_guided(b, a, b_from_a.inverse(), bounds_b_mm, options))


def match_unguided(a: Features, b: Features, options: MatchingOptions | None = None) -> Int[np.ndarray, "k 2"]:
    """Mutually best pairs among all keypoints, if nothing is known about the relative pose."""
    options = options or MatchingOptions()
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    one, other = (f.descriptors.astype(np.float32) / np.float32(DESCRIPTOR_NORM) for f in (a, b))
    cosine = one @ other.T
    best, backward = cosine.argmax(axis=1), cosine.argmax(axis=0)
    top = np.partition(cosine, -2, axis=1)[:, -2:]
    distinct = np.maximum(1 - top[:, 1], 0) < options.ratio**2 * (1 - top[:, 0])
    return _mutual(np.where(distinct & (top[:, 1] >= options.similarity), best, -1), backward)


def frame_pairs(count: int, reach: int) -> tuple[tuple[int, int], ...]:
    """Pairs of frames that are 1 to ``reach`` frames apart."""
    return tuple((i, i + k) for i in range(count) for k in range(1, reach + 1) if i + k < count)
