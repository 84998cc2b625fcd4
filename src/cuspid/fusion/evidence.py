"""What one depth map says about a point in space: its distance to the surface that was seen, and how certain that is.

Around a pixel the surface is a plane. With normalised coordinates (x, y) inverse depth is affine there,
1/Z = a x + b y + c, so that a X + b Y + c Z = 1: with the normal n = -(a, b, c) / |(a, b, c)| and the distance of the
camera d = 1 / |(a, b, c)| a point X of the camera frame lies at the signed distance n.X + d from it, positive on the
side of the camera. A point is evaluated at the pixel nearest to its projection.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.ndimage import distance_transform_edt

from cuspid.model.reconstruction import DepthMap
from cuspid.runtime.kernels import kernel

DISTANCE, WEIGHT, NORMAL_X, NORMAL_Y, NORMAL_Z, PIXEL = range(6)
"""Outputs of :func:`observe`: signed distance (mm), weight, unit normal in the camera frame, flat index of the
pixel."""

_SAME_SURFACE = 0.5
"""A foot that lies farther than this from the plane of its own pixel, as a share of the farthest distance, is not on
the surface."""

_BEND = 0.25
"""At an edge, the tangents of the surface on both sides of a pixel differ by this much."""
_STRAIGHTER = 0.5
"""At an edge, a side whose own tangent changes by less than this share of the other's change is used alone."""

EXTRAPOLATED = 0.1
"""Weight of a pixel without depth beside pixels with depth, relative to theirs."""


class Evidence(NamedTuple):
    """A depth map prepared for queries, by kernels, too."""

    plane: Float[np.ndarray, "h w 4"]
    """Hessian normal form (n, d) of the plane at each pixel, in the camera frame, d in mm. float32."""
    weight: Float[np.ndarray, "h w"]
    """Confidence times the cosine between ray and normal, 0 where the depth is unknown. float32."""
    intrinsics: Float[np.ndarray, "4"]
    """fx, fy, cx, cy with the first pixel centre at 0."""

    def nearest(self, reach_px: int) -> Int[np.ndarray, "h w"]:
        """Flat index of the nearest pixel with a known depth, -1 if none is within reach."""
        apart, (row, column) = distance_transform_edt(self.weight <= 0, return_indices=True)
        return np.where(apart <= reach_px, row * self.weight.shape[1] + column, -1)

    @staticmethod
    def of(depth_map: DepthMap, largest_jump_mm: float) -> Evidence:
        """Prepare a depth map; neighbours that differ by more than the jump do not belong to the same surface."""
        known = depth_map.known
        inverse = np.where(known, 1 / depth_map.depth_mm, np.nan).astype(np.float32)
        focal, centre = depth_map.camera.focal_px, depth_map.camera.principal_point_px - 0.5
        intrinsics = np.concatenate([focal, centre])
        plane, cosine = _planes(inverse, intrinsics, largest_jump_mm)
        weight = np.where(known, depth_map.confidence * cosine, 0).astype(np.float32)
        plane, weight = _extend_planes(plane, weight)
        return Evidence(plane, weight, intrinsics)


@kernel
@no_type_check
def _step(inverse, row, column, d_row, d_column, jump):
    """Difference of inverse depth to a neighbour that belongs to the same surface; NaN where it does not."""
    r, c = row + d_row, column + d_column
    if not (0 <= r < inverse.shape[0] and 0 <= c < inverse.shape[1]):
        return np.nan
    here = inverse[row, column]
    difference = inverse[r, c] - here
    return difference if abs(difference) <= jump * here * here else np.nan


@kernel
@no_type_check
def _slope(inverse, row, column, d_row, d_column, jump, bend):
    """Difference of inverse depth per pixel, from the neighbours that belong to the same surface; NaN without any.

    Where the surface bends at the pixel, from the side on which it is the straighter (as ENO schemes do, A. Harten et
    al. 1987): the mean of both would round an edge off.
    """
    after = _step(inverse, row, column, d_row, d_column, jump)
    before = -_step(inverse, row, column, -d_row, -d_column, jump)
    if np.isnan(after) or np.isnan(before):
        return before if np.isnan(after) else after
    if abs(after - before) > bend * inverse[row, column]:
        further = abs(_step(inverse, row + d_row, column + d_column, d_row, d_column, jump) - after)
        farther = abs(-_step(inverse, row - d_row, column - d_column, -d_row, -d_column, jump) - before)
        if further < _STRAIGHTER * farther:
            return after
        if farther < _STRAIGHTER * further:
            return before
    return (after + before) / 2


@kernel
@no_type_check
def _planes(inverse, intrinsics, jump):
    """Plane through each pixel, and the cosine between its normal and the ray; 0 where no plane can be told."""
    height, width = inverse.shape
    fx, fy, cx, cy = intrinsics
    plane = np.zeros((height, width, 4), np.float32)
    cosine = np.zeros((height, width), np.float32)
    for row in range(height):
        for column in range(width):
            here = inverse[row, column]
            a = _slope(inverse, row, column, 0, 1, jump, _BEND / fx) * fx
            b = _slope(inverse, row, column, 1, 0, jump, _BEND / fy) * fy
            if not (np.isfinite(a) and np.isfinite(b) and np.isfinite(here)):
                continue
            x, y = (column - cx) / fx, (row - cy) / fy
            c = here - a * x - b * y
            d = 1 / np.sqrt(a * a + b * b + c * c)
            plane[row, column, 0], plane[row, column, 1], plane[row, column, 2] = -a * d, -b * d, -c * d
            plane[row, column, 3] = d
            cosine[row, column] = here * d / np.sqrt(x * x + y * y + 1)
    return plane, cosine


@kernel
@no_type_check
def _extend_planes(plane, weight):
    """Carry the planes one pixel on, for the outermost half windows and voxels would be lost at every border."""
    height, width = weight.shape
    wide_plane, wide_weight = plane.copy(), weight.copy()
    for row in range(height):
        for column in range(width):
            if weight[row, column] > 0:
                continue
            best = np.float32(0)
            for r in range(max(row - 1, 0), min(row + 2, height)):
                for c in range(max(column - 1, 0), min(column + 2, width)):
                    if weight[r, c] > best:
                        best = weight[r, c]
                        wide_plane[row, column] = plane[r, c]
            wide_weight[row, column] = EXTRAPOLATED * best
    return wide_plane, wide_weight


@kernel(inline="always")
@no_type_check
def observe(evidence, right, down, depth, seen):
    """Evaluate a point of the camera frame in front of the camera; False where the map has no answer."""
    plane, weight, intrinsics = evidence
    inverse = 1 / depth
    u = intrinsics[0] * right * inverse + intrinsics[2] + 0.5
    v = intrinsics[1] * down * inverse + intrinsics[3] + 0.5
    if not (u >= 0 and v >= 0 and u < weight.shape[1] and v < weight.shape[0]):
        return False
    column, row = int(u), int(v)
    if not weight[row, column] > 0:
        return False
    x, y, z = plane[row, column, 0], plane[row, column, 1], plane[row, column, 2]
    seen[0] = plane[row, column, 3] + x * right + y * down + z * depth
    seen[1] = weight[row, column]
    seen[2], seen[3], seen[4] = x, y, z
    seen[5] = row * weight.shape[1] + column
    return True


@kernel
@no_type_check
def observe_foot(evidence, nearest, farthest, right, down, depth, seen):
    """As :func:`observe`, for a point whose own pixel has no answer: the pixel at the foot of its perpendicular is
    used, if the surface is seen there and is not farther away than ``farthest``. A camera that looks along a slope
    looks past it through points that lie outside of it.

    ``nearest`` is the result of :meth:`Evidence.nearest`.
    """
    plane, weight, intrinsics = evidence
    height, width = weight.shape
    u = intrinsics[0] * right / depth + intrinsics[2] + 0.5
    v = intrinsics[1] * down / depth + intrinsics[3] + 0.5
    if not (u >= 0 and v >= 0 and u < width and v < height):
        return False
    pixel = nearest[int(v), int(u)]
    if pixel < 0:
        return False
    row, column = pixel // width, pixel % width
    x, y, z = plane[row, column, 0], plane[row, column, 1], plane[row, column, 2]
    distance = plane[row, column, 3] + x * right + y * down + z * depth
    if abs(distance) > farthest or depth - distance * z <= 0:
        return False
    foot = right - distance * x, down - distance * y, depth - distance * z
    if not observe(evidence, foot[0], foot[1], foot[2], seen):
        return False
    # The plane seen there lies far from the foot where the slope ended.
    if abs(seen[0]) > _SAME_SURFACE * farthest:
        return False
    seen[0] += distance * (x * seen[2] + y * seen[3] + z * seen[4])
    return abs(seen[0]) <= farthest


def colors_of(depth_map: DepthMap) -> UInt8[np.ndarray, "p 3"]:
    """RGB by flat pixel index; mid grey for a depth map without colour."""
    if depth_map.color is None:
        return np.full((depth_map.depth_mm.size, 3), 128, dtype=np.uint8)
    return depth_map.color.reshape(-1, 3)
