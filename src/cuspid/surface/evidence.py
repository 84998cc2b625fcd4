"""What one depth map says about a point in space: its distance to the surface that was seen, and how sure that is.

Around a pixel the surface is a plane. With normalised coordinates (x, y) inverse depth is affine there,
1/Z = a x + b y + c, so that the plane is n.X = 1 with n = (a, b, c), and a point X = (x, y, 1) z lies at the signed
distance (1 - z/Z) / |n| from it, positive on the side of the camera. Inverse depth between pixels is bilinear, which is
exact for planes; where the depth jumps there is no answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float, UInt8
from numba import njit

from cuspid.reconstruction import DepthMap

DISTANCE, WEIGHT, NORMAL_X, NORMAL_Y, NORMAL_Z, PIXEL = range(6)
"""What :func:`observe` writes: signed distance (mm), weight, unit normal in the camera, flat index of the pixel."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """A depth map prepared for questions."""

    inverse_depth: Float[np.ndarray, "h w"]
    """1/Z in 1/mm, NaN where unknown. float32."""
    weight: Float[np.ndarray, "h w"]
    """Confidence times the cosine between ray and normal. float32."""
    plane: Float[np.ndarray, "h w 3"]
    """n of the plane through each pixel, in the camera frame, 1/mm. float32."""
    intrinsics: Float[np.ndarray, "5"]
    """fx, fy, cx, cy with the first pixel centre at 0, and the largest jump of depth between neighbours in mm."""

    @property
    def arrays(self) -> tuple[Any, ...]:
        """For numba."""
        return self.inverse_depth, self.weight, self.plane, self.intrinsics

    @staticmethod
    def of(depth_map: DepthMap, largest_jump_mm: float) -> Evidence:
        """Prepare a depth map."""
        known = np.isfinite(depth_map.depth_mm) & (depth_map.confidence > 0)
        inverse = np.where(known, 1 / depth_map.depth_mm, np.nan).astype(np.float32)
        (fx, fy), (cx, cy) = depth_map.camera.focal_px, depth_map.camera.principal_point_px - 0.5
        intrinsics = np.array([fx, fy, cx, cy, largest_jump_mm])
        plane, cosine = _planes(inverse, intrinsics)
        weight = np.where(known, depth_map.confidence * cosine, 0).astype(np.float32)
        return Evidence(inverse, weight, plane, intrinsics)


@njit(cache=True, nogil=True)
@no_type_check
def _slope(inverse, row, column, d_row, d_column, jump):
    """Difference of inverse depth per pixel, from the neighbours that belong to the same surface; NaN without any."""
    here = inverse[row, column]
    total, count = 0.0, 0
    for side in (-1, 1):
        r, c = row + side * d_row, column + side * d_column
        if 0 <= r < inverse.shape[0] and 0 <= c < inverse.shape[1]:
            difference = inverse[r, c] - here
            if abs(difference) <= jump * here * here:
                total += side * difference
                count += 1
    return total / count if count > 0 else np.nan


@njit(cache=True, nogil=True)
@no_type_check
def _planes(inverse, intrinsics):
    """Plane through each pixel, and the cosine between its normal and the ray; 0 where no plane can be told."""
    height, width = inverse.shape
    fx, fy, cx, cy, jump = intrinsics
    plane = np.zeros((height, width, 3), np.float32)
    cosine = np.zeros((height, width), np.float32)
    for row in range(height):
        for column in range(width):
            here = inverse[row, column]
            a = _slope(inverse, row, column, 0, 1, jump) * fx
            b = _slope(inverse, row, column, 1, 0, jump) * fy
            if not (np.isfinite(a) and np.isfinite(b) and np.isfinite(here)):
                continue
            x, y = (column - cx) / fx, (row - cy) / fy
            c = here - a * x - b * y
            plane[row, column, 0], plane[row, column, 1], plane[row, column, 2] = a, b, c
            cosine[row, column] = here / np.sqrt((a * a + b * b + c * c) * (x * x + y * y + 1))
    return plane, cosine


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def observe(evidence, right, down, depth, seen):
    """Ask about a point of the camera frame in front of the camera; False where the map has no answer."""
    inverse, weight, plane, intrinsics = evidence
    u = intrinsics[0] * right / depth + intrinsics[2]
    v = intrinsics[1] * down / depth + intrinsics[3]
    if not (u >= 0 and v >= 0 and u < inverse.shape[1] - 1 and v < inverse.shape[0] - 1):
        return False
    column, row = int(u), int(v)
    a, b = inverse[row, column], inverse[row, column + 1]
    c, d = inverse[row + 1, column], inverse[row + 1, column + 1]
    low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    if not (high - low <= intrinsics[4] * low * high) or np.isnan(a + b + c + d):
        return False
    fx, fy = u - column, v - row
    near_column, near_row = column + (fx > 0.5), row + (fy > 0.5)
    n = plane[near_row, near_column]
    length = np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
    if length == 0:
        return False
    top, bottom = a + fx * (b - a), c + fx * (d - c)
    seen[0] = (1 - depth * (top + fy * (bottom - top))) / length
    seen[1] = weight[near_row, near_column]
    seen[2], seen[3], seen[4] = -n[0] / length, -n[1] / length, -n[2] / length
    seen[5] = near_row * inverse.shape[1] + near_column
    return seen[1] > 0


def colors_of(depth_map: DepthMap) -> UInt8[np.ndarray, "p 3"]:
    """RGB by flat pixel index; mid grey for a depth map without colour."""
    if depth_map.color is None:
        return np.full((depth_map.depth_mm.size, 3), 128, dtype=np.uint8)
    return depth_map.color.reshape(-1, 3)
